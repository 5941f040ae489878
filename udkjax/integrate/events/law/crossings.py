"""Zero crossings: the side of zero of each condition, the resulting events, and the roots of Hermite cubics."""

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

# Bounds below which a condition, its first rate (per T) and its second rate (per T^2) are zero, relative to the condition's
# scale: its change by a displacement of L or a turn of one radian. Rounding errors of a state are about 1e-15.
ZERO_TOL, ZERO_RATE_TOL, ZERO_RATE_2_TOL = 1e-12, 1e-12, 1e-10
# Speeds of joints that stick or slip, in absolute tolerances: smaller ones are no reversals. Steps leave errors of their
# tolerance in the speed of a joint that hardly moves, and the polynomials between steps at the limit of stability several times
# as much.
REVERSAL_SPEED = 10.0
BRACKET_PARTS, BRACKET_DIVISIONS = 32, 6  # the bracket of a cubic's root is divided into 32 parts 6 times: to 1e-9 of its length
NO_EVENT = -1

Cubic = tuple[Array, Array, Array, Array]  # value and slope at 0, value and slope at 1


class ConditionValues(NamedTuple):
    """The values of the conditions of E events at a state, and their rates along the motion."""

    h: Float[Any, "*m E"]  # values
    rate: Float[Any, "*m E"]  # first rates
    rate_2: Float[Any, "*m E"]  # second rates; 0 for conditions that depend on velocities
    a: Float[Any, "*m n"]  # accelerations
    scale: Float[Any, "*m E"]  # the change of a condition by a displacement of L, by a turn of one radian, or within T


def zero_of(slides: Bool[np.ndarray, "E"], atol: Float[Any, "*b 1"], xp: ModuleType = jnp) -> Float[Any, "*b E"]:
    """Return the bounds, relative to the scales of conditions, below which conditions count as zero.

    Args:
        slides: mask of the conditions that are speeds of joints.
        atol: absolute tolerance of each member, in units of the scene.
        xp: jax.numpy, or NumPy.
    """
    return xp.where(slides, xp.maximum(REVERSAL_SPEED * atol, ZERO_TOL), ZERO_TOL)


def side_of_zero(values: ConditionValues, rate: Float[Any, "*m"], xp: ModuleType = jnp) -> Int[Any, "*m C"]:
    """Return the side of zero of each condition, -1 or 1; at zero the side that it is about to enter, or 0 if unknown.

    Args:
        values: the conditions and their rates.
        rate: characteristic rate of the system (1/s).
        xp: jax.numpy, or NumPy.
    """
    h, dh, ddh, _, scale = values
    unit = scale * rate[..., None]
    by_second_rate = xp.where(xp.abs(ddh) > ZERO_RATE_2_TOL * unit * rate[..., None], xp.sign(ddh), 0.0)
    by_rate = xp.where(xp.abs(dh) > ZERO_RATE_TOL * unit, xp.sign(dh), by_second_rate)
    return xp.where(xp.abs(h) > ZERO_TOL * scale, xp.sign(h), by_rate).astype(int)


def first_crossing(
    direction: Int[np.ndarray, "C"],
    watched: Bool[Any, "*m C"],
    before: Int[Any, "*m C"],
    after: Int[Any, "*m C"],
    xp: ModuleType = jnp,
) -> Int[Any, "*m"]:
    """Return the index of the first event, in the order of events, whose condition changes its side of zero; else `NO_EVENT`.

    Args:
        direction: direction in which each condition has to cross zero; 0: either.
        watched: mask of the watched conditions.
        before: the sides of zero before.
        after: the sides of zero now.
        xp: jax.numpy, or NumPy.
    """
    happens = crosses(direction, before, after) & watched
    return xp.where(xp.any(happens, -1), xp.argmax(happens, -1), NO_EVENT)


def crosses(direction: Int[np.ndarray, "C"], before: Int[Array, "*G C"], after: Int[Array, "*G C"]) -> Bool[Array, "*G C"]:
    """Return a mask of the conditions that cross zero, by their sides before and after, in their `direction` (0: either)."""
    return (before != 0) & (after == -before) & ((direction == 0) | (after == direction))


def carry_signs(first: Int[Any, "E"], signs: Int[Any, "G E"], xp: ModuleType = jnp) -> Int[Any, "G E"]:
    """Return signs along a grid, each zero replaced by the last nonzero sign before; `first` are the signs before the grid."""
    last = xp.where(signs != 0, np.arange(1, len(signs) + 1)[:, None], 0)
    last = np.maximum.accumulate(last, axis=0) if xp is np else jax.lax.cummax(last, axis=0)
    return xp.take_along_axis(xp.concatenate([first[None], signs]), last, axis=0)


def cubic_value(cubic: Cubic, x: Array) -> Array:
    """Return Hermite's cubic on [0, 1] at x."""
    a, da, b, db = cubic
    return a + x * (da + x * (3 * (b - a) - 2 * da - db + x * (2 * (a - b) + da + db)))


def cubic_slope(cubic: Cubic, x: Array) -> Array:
    """Return the slope of Hermite's cubic on [0, 1] at x."""
    a, da, b, db = cubic
    return da + x * (2 * (3 * (b - a) - 2 * da - db) + 3 * x * (2 * (a - b) + da + db))


def cubic_root(cubic: Cubic, side: Any, xp: ModuleType = jnp) -> Any:
    """Return the zero in [0, 1] of Hermite's cubic that is on `side` (-1 or 1) of zero at 0, and on the other side at 1."""
    low, width, places = xp.zeros_like(cubic[0]), 1.0, np.arange(1, BRACKET_PARTS)
    for _ in range(BRACKET_DIVISIONS):
        width /= BRACKET_PARTS
        x = low + width * places.reshape(-1, *[1] * low.ndim)
        low = low + width * xp.sum(cubic_value(cubic, x) * side > 0, axis=0)
    middle = low + width / 2
    slope = cubic_slope(cubic, middle)
    step = cubic_value(cubic, middle) / xp.where(slope == 0, 1.0, slope)  # one Newton step is enough for so short a part
    return xp.clip(middle - step, low, low + width)
