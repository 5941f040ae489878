"""Times where the motion is not smooth: a step ends just before each of them, and the run starts anew just behind it.

Between the two nothing moves; but accelerations may differ, and no polynomial goes through states of both sides. The distances
are in units of rounding of the end time, so that no stage of a step, its time rounded, is on the other side.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from udkjax.native.steps import BEGINS_BEHIND, ENDS_BEFORE, SAME


def last_end(breakpoints: Array, t: Array, smallest: Array) -> Array:
    """The time just before the next of the breakpoints (K, *lanes) after t: where a step from t ends at the latest."""
    ahead = jnp.where(breakpoints > t + smallest, breakpoints, jnp.inf)
    return jnp.min(ahead, axis=0) - ENDS_BEFORE * smallest


def new_start(breakpoints: Array, t: Array, smallest: Array) -> Array:
    """The time just behind all breakpoints at t, or t where there is none."""
    behind = jnp.where(breakpoints <= t + SAME * smallest, breakpoints + BEGINS_BEHIND * smallest, -jnp.inf)
    latest = jnp.max(behind, axis=0)
    return jnp.where(latest > t, latest, t)


def is_new_start(before: Array, to: Array, smallest: Array) -> Bool[Array, "*lanes"]:
    """Whether between two points of a run, one after the other, it has started anew, and not taken a step."""
    return to - before <= 2 * SAME * smallest * (1.0 - ENDS_BEFORE)


def breakpoint_at(breakpoints: Array, t: Array, smallest: Array) -> tuple[Array, Bool[Array, ""]]:
    """Which breakpoint a point of a single run is beside, and whether it is beside any."""
    apart = jnp.abs(breakpoints - t)
    return jnp.argmin(apart), jnp.min(apart) <= 2 * ENDS_BEFORE * smallest
