"""How steps come past singular configurations.

Stages on one, or too close to it, are there by chance: their accelerations are no numbers, or amplify what the stage is off the
constraint manifold. Another step misses it, and costs less than care: one whose nodes are far from where it is reached.
"""

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.native.steps import BEFORE, EXPECTED, LONGEST, NEAREST, SHORTEST, SURE
from udkjax.native.tableau import Method


def far(distance: Array, step: Array, tolerance: Array, rounding: float = BEFORE) -> Array:
    """Whether a step, in units of the characteristic time, may begin so far away from singular configurations."""
    return (distance > NEAREST) & (distance**3 * tolerance > rounding * step)


def ahead(times: tuple[Array, ...], distances: tuple[Array, ...]) -> Array:
    """The time that is left until a singular configuration; not positive, or not a number, where none is ahead.

    The distances from it, at the last three accepted times, the latest last, go to zero by the first power of that time: it is
    the root of a parabola, to first order in its curvature.
    """
    (t2, t1, t0), (d2, d1, d0) = times, distances
    slope, before = (d0 - d1) / (t0 - t1), (d1 - d2) / (t1 - t2)
    curve = (slope - before) / (t0 - t2)
    slope = slope + curve * (t0 - t1)
    return -d0 / (slope - curve * (d0 / slope))


def passed(left: Array, step: Array, before: Array, after: Array) -> Array:
    """Whether a step has come past a configuration that was ahead, by its distances before and after it."""
    return (left > 0.0) & (left < SURE * step) & (after * left > EXPECTED * before * (step - left))


def around(method: Method, left: Array, step: Array, far_enough: Array, otherwise: Array) -> Array:
    """In place of a step that failed, one with its nodes far from the configuration, if it may have failed by that.

    Where that is beyond the last nodes: one from whose end the next, if it is as long as this, has its nodes far from it.
    """
    low, high = method.clearings
    share = left / step
    across = left / jnp.where(share < low, low, high)
    up_to = jnp.where((share < 1.0 + low) & far_enough, left - low * step, step)
    found = jnp.where(share < high, across, up_to)
    apt = (found > SHORTEST * step) & (found < LONGEST * step)
    return jnp.where(apt, found, otherwise)
