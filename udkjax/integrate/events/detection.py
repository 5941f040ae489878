"""Crossings of zero within a window: which there are for certain, which may be, and where the window is too coarse to tell.

At the nodes of a window the conditions are known, and their rates where they depend on positions alone. Between two nodes a
condition is Hermite's cubic up to E x^2 (1 - x)^2, with E measured: how far the cubic over two intervals misses the value and the
rate at the node in between, of which one interval makes a sixteenth, or less. A crossing is certain where Bernstein's
coefficients of the cubic plus and minus this change their sign once (Descartes' rule), none where they do not change it. A cubic
that comes near zero and leaves again is a dip, whose extremum is then sought in the motion itself. All else is refined.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.crossings import (
    ZERO,
    Cubic,
    carry_signs,
    crosses,
    cubic_extremum,
    cubic_root,
    cubic_slope,
    cubic_value,
)
from udkjax.native.conditions import FAR, MISS, RESOLVED

INTERVALS = 32  # of a window
# The nodes, of a window's length: not quite uniform, so that no oscillation is zero at all of them.
_shift = 0.2 * np.sin(np.arange(INTERVALS + 1) * 2.4)
_shift[[0, -1]] = 0.0
NODES = (np.arange(INTERVALS + 1) + _shift) / INTERVALS
BENDS = 3.0  # times as much as beside it a smooth condition bends in an interval that is fine enough, at most
INTERVALS_OF_JUMP = 6  # intervals too coarse to resolve a jump or a kink, at every scale

BESIDE = 4  # intervals before one that is too coarse that are done again

ROOT, FIRST_OF_TWO, SECOND_OF_TWO = 0, 1, 2  # the target: a root, or the extremum, and then the root before it or behind it


class Nodes(NamedTuple):
    """The conditions and contact forces at the nodes of a window."""

    t: Float[Array, "G"]
    g: Float[Array, "G C"]
    g_dot: Float[Array, "G C"]
    good: Bool[Array, "G"]  # whether the run got there


class Detection(NamedTuple):
    """The first crossing of conditions in a window."""

    sides: Int[Array, "G C"]  # of zero, at the nodes
    place: Int[Array, ""]  # the interval of the first crossing
    is_found: Bool[Array, ""]
    event: Int[Array, ""]
    root: Float[Array, ""]  # or the extremum, in the interval, from 0 to 1
    seeks: Int[Array, ""]  # ROOT, FIRST_OF_TWO or SECOND_OF_TWO
    side: Int[Array, ""]  # before it
    is_coarse: Bool[Array, ""]  # whether an interval before, or that one, is too coarse
    last_sure: Int[Array, ""]  # the node up to which all is certain, where an interval is too coarse
    coarse: Bool[Array, "C"]  # of which conditions
    undefined: Bool[Array, "C"]  # conditions that are not a number at its end


def detect(
    nodes: Nodes,
    has_rates: Bool[np.ndarray, "C"],
    direction: Int[np.ndarray, "C"],
    sides: Int[Array, "C"],
    scale: Float[Array, "C"],
    watched: Bool[Array, "C"],
    quiet: Float[Array, "C"],
    is_short: Bool[Array, ""],
    unresolved: Bool[Array, "C"],
) -> Detection:
    """Find the first crossing in a window, or the first interval that is too coarse.

    Args:
        nodes: the conditions at the nodes of the window.
        has_rates: of which conditions the rates are known; of others they are taken from differences.
        direction: the direction in which the zero of each counts, 0 for either.
        sides: the sides of zero at the first node.
        scale: scale of each condition.
        watched: mask of the conditions that count.
        quiet: the time up to which the dips of each are known.
        is_short: whether the window is so short that what is too coarse in it may be a jump.
        unresolved: mask of the conditions not to be refined.
    """
    t, g, g_dot, good = nodes
    finite = jnp.isfinite(g)
    g = jnp.where(finite, g, 0.0)
    signs = jnp.where((jnp.abs(g) <= ZERO * scale) | ~good[:, None] | ~finite, 0, jnp.sign(g)).astype(int)
    sides = carry_signs(sides, signs.at[0].set(0))
    before, after = sides[:-1], sides[1:]
    step = jnp.diff(t)[:, None]
    slope = _slopes(t, g, g_dot, has_rates)
    cubic: Cubic = (g[:-1], step * slope[:-1], g[1:], step * slope[1:])
    error = _errors(t, g, slope, has_rates)

    side = jnp.where(before != 0, before, after)
    low, high = (_coefficients(cubic, side, 8 / 3 * x) for x in (error, -error))  # 16 x^2 (1 - x)^2 is 8/3 of the middle one
    resolved = error <= RESOLVED * (jnp.max(high, 0) - jnp.min(low, 0))
    hits = (after == -before) & (before != 0)
    single = (_sign_changes(low) == 1) & (_sign_changes(high) == 1) & resolved
    away = (jnp.min(low, 0) >= -ZERO * scale) & (resolved | (jnp.min(low, 0) >= FAR * error - ZERO * scale))
    away = away | (t[1:, None] <= quiet)
    valley = ~hits & ~away & resolved & (before * cubic[1] < 0) & (before * cubic[3] > 0) & _bends_as_beside(step, slope)
    lowest = cubic_extremum(cubic, before)
    dips = valley & (before * cubic_value(cubic, lowest) <= error + ZERO * scale)
    usable = good[1:, None] & watched
    certain = jnp.where(hits, single, away | valley)
    coarse = (usable & ~unresolved & ~certain) | (good[1:, None] & ~finite[1:])
    # Intervals too coarse in a short window, and only there, hold a jump or a kink: finer windows would not tell more.
    jumps = is_short & (jnp.sum(coarse, 0) <= INTERVALS_OF_JUMP) & jnp.all(finite, 0)
    coarse = coarse & ~jumps

    enters = dips & crosses(direction, before, -before)
    leaves = dips & ~enters & crosses(direction, -before, before)
    found = ((hits & crosses(direction, before, after)) | enters | leaves) & usable
    place = jnp.argmax(jnp.any(found, axis=1))
    coarse_place = jnp.argmax(jnp.any(coarse, axis=1))
    last_sure = jnp.maximum(coarse_place - BESIDE, 0)  # intervals before may only look fine enough
    cubic, side, here, enters, leaves, lowest = jax.tree.map(lambda x: x[place], (cubic, before, found, enters, leaves, lowest))
    root = jnp.where(enters | leaves, lowest, cubic_root(cubic, side))
    event = jnp.argmin(jnp.where(here, root, jnp.inf))
    seeks = jnp.where(enters, FIRST_OF_TWO, jnp.where(leaves, SECOND_OF_TWO, ROOT))
    is_found = jnp.any(found)
    is_coarse = jnp.any(coarse) & ~(is_found & (place < last_sure))
    return Detection(
        sides,
        place,
        is_found & ~is_coarse,
        event,
        root[event],
        seeks[event],
        side[event],
        is_coarse,
        last_sure,
        coarse[coarse_place],
        ~finite[coarse_place + 1],
    )


def _slopes(
    t: Float[Array, "G"], g: Float[Array, "G C"], g_dot: Float[Array, "G C"], has_rates: Bool[np.ndarray, "C"]
) -> Float[Array, "G C"]:
    """Return the rates at the nodes; by differences, of second order, where they are not known or not finite."""
    step = jnp.diff(t)[:, None]
    secant = jnp.diff(g, axis=0) / jnp.where(step > 0, step, 1.0)
    total = step[1:] + step[:-1]
    inner = (step[1:] * secant[:-1] + step[:-1] * secant[1:]) / jnp.where(total > 0, total, 1.0)
    ends = 2 * secant[0] - inner[0], 2 * secant[-1] - inner[-1]
    by_differences = jnp.concatenate([ends[0][None], inner, ends[1][None]])
    return jnp.where(has_rates & jnp.isfinite(g_dot), g_dot, by_differences)


def _bends_as_beside(step: Float[Array, "I 1"], slope: Float[Array, "G C"]) -> Bool[Array, "I C"]:
    """Tell where a condition bends as it does in the intervals beside; in a kink, which looks like a parabola, it bends more."""
    bend = jnp.abs(jnp.diff(slope, axis=0)) / jnp.where(step > 0, step, 1.0)
    beside = jnp.pad(bend, ((1, 1), (0, 0)))
    return bend <= BENDS * jnp.maximum(beside[:-2], beside[2:])


def _errors(
    t: Float[Array, "G"], g: Float[Array, "G C"], slope: Float[Array, "G C"], has_rates: Bool[np.ndarray, "C"]
) -> Float[Array, "I C"]:
    """Return the error of the cubic that counts in each interval: of those over two intervals, it and those beside it."""
    start, middle, end = t[:-2:2, None], t[1:-1:2, None], t[2::2, None]
    length = end - start
    x = (middle - start) / jnp.where(length > 0, length, 1.0)
    cubic: Cubic = (g[:-2:2], length * slope[:-2:2], g[2::2], length * slope[2::2])
    miss = jnp.abs(g[1:-1:2] - cubic_value(cubic, x))
    # The rate tells a kink from what is smooth, of which it misses less.
    of_rate = jnp.abs(length * slope[1:-1:2] - cubic_slope(cubic, x)) * MISS
    miss = jnp.where(has_rates, jnp.maximum(MISS * miss, of_rate), miss)
    beside = jnp.pad(miss, ((1, 1), (0, 0)))
    return jnp.repeat(jnp.maximum(jnp.maximum(beside[:-2], beside[2:]), miss), 2, axis=0)


def _coefficients(cubic: Cubic, side: Int[Array, "I C"], error: Float[Array, "I C"]) -> Float[Array, "5 I C"]:
    """Return Bernstein's coefficients of degree 4 of the cubic, times its side of zero, less an error in the middle one."""
    a, da, b, db = (side * x for x in cubic)
    one, two = a + da / 3, b - db / 3
    return jnp.stack([a, (a + 3 * one) / 4, (one + two) / 2 - error, (3 * two + b) / 4, b])


def _sign_changes(x: Float[Array, "5 I C"]) -> Int[Array, "I C"]:
    """Return the number of changes of sign of the coefficients, from the positive one that the first stands for."""
    signs = (x > 0).at[0].set(True)
    return jnp.sum(signs[1:] != signs[:-1], axis=0)
