"""Uniqueness of the loads on which the friction of joints depends, and of the accelerations that it causes."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.equations.states.textbook import TextbookEquations


class JointFriction(NamedTuple):
    """The uniqueness of a joint's friction.

    Attributes:
        load: True if the load of the joint on which the friction depends is unique.
        accelerations: True if the accelerations that the friction causes are unique.
    """

    load: bool
    accelerations: bool


def joint_friction(
    equations: TextbookEquations, t: float, q: Float[ArrayLike, "n"], N: Float[ArrayLike, "m k"]
) -> dict[str, JointFriction]:
    """Return the uniqueness of the friction in each joint whose friction depends on the load of the joint, by name.

    Accelerations are those of a motion in which all joints slide that can slide.

    Args:
        equations: The equations of the mechanism.
        t: Time (s).
        q: Coordinates (m, rad), (n,).
        N: Basis of the null space of Psi_q^T, for multipliers in units of one over their rows' scales.
    """
    if not equations.rubbing_joints:
        return {}
    found = equations.loose_friction(t, jnp.asarray(q), jnp.asarray(N))
    slides, loads = np.asarray(found.slides), np.asarray(found.loads)
    sources = loose = np.asarray(found.loose)
    while np.any(sources := sources & slides) and np.any(new := loads[sources].any(0) & ~loose):
        loose, sources = loose | new, new
    return {
        joint: JointFriction(not is_loose, not is_loose or not does_slide)
        for joint, is_loose, does_slide in zip(equations.rubbing_joints, loose, slides, strict=True)
    }
