"""Crossings of zero: the side of zero of each condition, the events that happen, and the roots of Hermite's cubics."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.hybrid import ConditionValues, Hybrid

# Of a condition's scale, that is what a displacement of L or a turn of one radian changes in it: below it the condition is zero,
# and so are its first and second rate, per T and T^2. Rounding errors of a state are some 1e-15 of it.
ZERO, ZERO_RATE, ZERO_RATE_2 = 1e-12, 1e-12, 1e-10
BISECTIONS = 40  # to a root of a cubic, which Newton's method on the event time then improves
NO_EVENT = -1  # no index of an event

Cubic = tuple[Array, Array, Array, Array]  # value and slope at 0, value and slope at 1


def side_of_zero(values: ConditionValues, rate: Float[Array, ""]) -> Int[Array, "2E"]:
    """Return the side of zero of each condition, -1 or 1; at zero the side that it is about to enter, 0 where that is unknown.

    Args:
        values: the conditions and their rates.
        rate: that of the system (1/s).
    """
    h, dh, ddh, scale = values.h, values.rate, values.rate_2, values.scale
    by_second_rate = jnp.where(jnp.abs(ddh) > ZERO_RATE_2 * scale * rate**2, jnp.sign(ddh), 0.0)
    by_rate = jnp.where(jnp.abs(dh) > ZERO_RATE * scale * rate, jnp.sign(dh), by_second_rate)
    return jnp.where(jnp.abs(h) > ZERO * scale, jnp.sign(h), by_rate).astype(int)


def first_crossing(
    hybrid: Hybrid, phase: Int[Array, ""], carried: Bool[Array, "E"], before: Int[Array, "2E"], after: Int[Array, "2E"]
) -> Int[Array, ""]:
    """Return the first event that happens as conditions change their sides of zero; `NO_EVENT` where none does.

    Args:
        hybrid: the system.
        phase: the phase.
        carried: the contacts that others hold at zero.
        before: the sides of zero before.
        after: the sides of zero now.
    """
    held = hybrid.is_held(phase)
    happens = crosses(hybrid.directions, before, after) & jnp.append(~held & ~carried, held)
    return jnp.where(jnp.any(happens), jnp.argmax(happens), NO_EVENT)


def crosses(direction: Int[np.ndarray, "C"], before: Int[Array, "*G C"], after: Int[Array, "*G C"]) -> Bool[Array, "*G C"]:
    """Tell which conditions cross zero in the direction that counts, 0 for either."""
    return (before != 0) & (after == -before) & ((direction == 0) | (after == direction))


def carry_signs(first: Int[Array, "E"], signs: Int[Array, "G E"]) -> Int[Array, "G E"]:
    """Replace each zero of signs along a grid by the sign before it."""

    def step(side: Array, sign: Array) -> tuple[Array, Array]:
        side = jnp.where(sign != 0, sign, side)
        return side, side

    return jax.lax.scan(step, first, signs)[1]


def cubic_value(cubic: Cubic, x: Array) -> Array:
    """Return Hermite's cubic on [0, 1] at x."""
    a, da, b, db = cubic
    return a + x * (da + x * (3 * (b - a) - 2 * da - db + x * (2 * (a - b) + da + db)))


def cubic_slope(cubic: Cubic, x: Array) -> Array:
    """Return the slope of Hermite's cubic on [0, 1] at x."""
    a, da, b, db = cubic
    return da + x * (2 * (3 * (b - a) - 2 * da - db) + 3 * x * (2 * (a - b) + da + db))


def cubic_extremum(cubic: Cubic, side: Array) -> Array:
    """Return where a cubic on `side` of zero is nearest to it, or farthest beyond, if it approaches at 0 and leaves at 1."""
    zero = jnp.zeros_like(cubic[0])
    return bisect(lambda x: cubic_slope(cubic, x) * side < 0, zero, zero + 1)


def bisect(is_before: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return where `is_before` changes from true to false between `low` and `high`."""

    def halve(_: int, bracket: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = bracket
        middle = (low + high) / 2
        before = is_before(middle)
        return jnp.where(before, middle, low), jnp.where(before, high, middle)

    low, high = jax.lax.fori_loop(0, BISECTIONS, halve, (low, high))
    return (low + high) / 2
