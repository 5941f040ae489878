"""The scale of a mechanism's forces, to which residual loads are compared, also if all loads vanish.

The rounding errors of balanced loads are relative to their parts: gravity, each force element, and the change of the loads along
a characteristic length, which is nonzero even for a spring at its natural length.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import AnyArray, Time
from udkjax.arrays import ArrayLibrary
from udkjax.equations import loads
from udkjax.equations.programs.scales import Scales
from udkjax.scene.mechanism import Mechanism


class LoadScale(NamedTuple):
    """The scales of forces and stiffnesses in the metric of the mass matrix; zero without loads at the position and nearby."""

    force: Float[Array, ""]  # N/sqrt(kg): of M^(-1/2) F
    stiffness: Float[Array, ""]  # (rad/s)^2: of M^(-1/2) F_q M^(-1/2)


def load_scale(mechanism: Mechanism, scales: Scales, t: Time, q: Float[Array, "n"]) -> LoadScale:
    """Return the scales of forces and stiffnesses at rest in a position q at time t (s), without derivatives."""
    mechanism, scales, t, q = jax.lax.stop_gradient((mechanism, scales, t, q))
    at_rest = jnp.zeros_like(q)
    slopes = jax.jacfwd(lambda q: loads.force(mechanism, t, q, at_rest))(q)
    return scale_of(load_sizes(mechanism, t, q, at_rest), slopes, loads.mass(mechanism), scales.coordinates(len(q)), jnp)


def scale_of(sizes: AnyArray, slopes: AnyArray, mass: AnyArray, units: AnyArray, xp: ArrayLibrary) -> LoadScale:
    """Return the scales from absolute loads (n,), F_q (n, n), the diagonal of M and the units of coordinates."""
    root = xp.sqrt(mass)
    force = xp.linalg.norm((sizes + xp.abs(slopes) @ units) / root)
    return LoadScale(force, force / xp.linalg.norm(root * units))


def load_sizes(mechanism: Mechanism, t: Time, q: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "n"]:
    """Return the sum of the absolute loads (N, N m) of gravity and of each force element on each coordinate."""
    total = jnp.abs(loads.mass(mechanism).reshape(-1, 3) * jnp.append(mechanism.gravity, 0.0))
    for kind, values in loads.evaluate_forces(lambda e, *frames: loads.loads_on_frames(e, t, *frames), mechanism, q, v):
        total = total.at[kind.bodies.T].add(jnp.abs(values[:, ~np.array(kind.structure.ground)]))
    return total.ravel()
