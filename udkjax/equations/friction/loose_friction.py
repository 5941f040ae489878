"""Friction of joints whose loads equilibrium does not determine, and its consequences.

The multipliers that agree with equilibrium and with friction G are lambda = L(G(lambda)) + N y, for any y, with the null space N
of Psi_q^T (determinacy.py). G of each joint is homogeneous: G(N y) = 0 for all y if and only if the load of the joint does not
depend on y. In a sliding joint, the power lost to friction grows with the load, and no other joint compensates for this, as the
power of all friction is negative. So accelerations are unique if and only if no sliding joint has a load that depends on y (a
*loose* load). If they are not unique, the loads of all joints that respond to the friction of these joints are loose as well.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.annotations import Time, Vector
from udkjax.equations.friction import rubbing
from udkjax.equations.laws import udwadia_kalaba as uk
from udkjax.equations.programs.scales import Scales
from udkjax.equations.rows.determinacy import UNIQUE_TOL
from udkjax.programs.deferred import deferred
from udkjax.scene.mechanism import Mechanism


class LooseFriction(NamedTuple):
    """Masks over j joints with friction: undetermined load, sliding, and which joint (row) loads which other joint (column)."""

    loose: Bool[Array, "j"]
    slides: Bool[Array, "j"]
    loads: Bool[Array, "j j"]


@deferred
def loose_friction(mechanism: Mechanism, t: Time, q: Vector, N: Float[Array, "m k"], scales: Scales) -> LooseFriction:
    """Find the joints with friction whose load equilibrium leaves open, even if the friction of all others is given.

    The marks are those of a random motion, in which all joints slide that can.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,).
        N: Basis of the null space of Psi_q^T, for multipliers in units of one over their rows' scales.
        scales: Scales of the scene.

    Returns:
        `LooseFriction`, in the order of `rubbing_names`.
    """
    random, unit = np.random.default_rng(0), jnp.asarray(scales.coordinates(q.size))
    some_load, some_mix = (jnp.asarray(random.normal(size=size)) for size in N.shape)
    rate = jnp.where(jnp.asarray(scales.rate) > 0, scales.rate, 1.0)  # without loads and velocities, there is no time
    sliding = jnp.asarray(random.normal(size=q.size)) * unit * rate  # velocities at which all joints slide
    D, root = uk.D(mechanism, t, q, scales.weights), uk.inverse_sqrt_mass(mechanism)
    plus = _inverse_of_rank(D, len(D) - N.shape[1])  # of the rank that N has, near a singular configuration, too
    v = sliding - root * (plus @ (D @ (sliding / root)))

    def frictions(speeds: Array, multipliers: Array) -> Array:
        """Return the loads of friction of each joint (j, n) in N m: forces are multiplied by L."""
        found = rubbing.single_rubbing_loads(mechanism, t, q, speeds, multipliers / jnp.asarray(scales.rows))
        return jnp.stack(list(found.values())) * unit

    def sizes(speeds: Array, multipliers: Array) -> Array:
        return jnp.linalg.norm(frictions(speeds, multipliers), axis=1)

    usual = sizes(sliding, some_load)
    loose = sizes(sliding, N @ some_mix) > UNIQUE_TOL * usual
    drags = frictions(v, some_load)
    slides = jnp.linalg.norm(drags, axis=1) > UNIQUE_TOL * usual

    def response(drag: Array) -> Array:
        """Return the size of each joint's friction (j,) that the reactions to a load `drag` (n,) cause, if all joints slide."""
        multipliers = uk.weigh(scales.weights, plus.T @ (plus @ (D @ (root * (drag / unit)))))
        return sizes(sliding, multipliers * jnp.asarray(scales.rows))

    answers = jax.vmap(response)(drags / jnp.where(slides, jnp.linalg.norm(drags, axis=1), jnp.inf)[:, None])
    return LooseFriction(loose, slides, answers > UNIQUE_TOL * usual)


def _inverse_of_rank(D: Float[Array, "m n"], rank: int) -> Float[Array, "n m"]:
    """Return the pseudoinverse of D from its `rank` largest singular values."""
    u, sigma, vt = jnp.linalg.svd(D, full_matrices=False)
    return (vt[:rank].T / sigma[:rank]) @ u[:, :rank].T
