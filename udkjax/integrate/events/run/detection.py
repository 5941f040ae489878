"""Zero crossings within a window: certain ones, and intervals that are too coarse to decide.

The conditions are evaluated at the nodes of a window, and their rates if they depend on positions alone. Between two nodes a
condition is a Hermite cubic up to E x^2 (1 - x)^2. E is estimated from the error of the cubic over two intervals, in value and
rate at the node between them; the error in one interval is at most a sixteenth of that. There is exactly one crossing if the
Bernstein coefficients of the cubic plus and minus this error change sign once (Descartes' rule), and no crossing if they do not
change sign. Other intervals are refined.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.law.crossings import ZERO_TOL, Cubic, carry_signs, crosses, cubic_root, cubic_slope, cubic_value
from udkjax.native.watching.conditions import RESOLUTION

WINDOW_INTERVALS = 32  # number of intervals of a window
# The nodes, relative to a window's length: slightly irregular, so that no oscillation is zero at all of them.
_shift = 0.2 * np.sin(np.arange(WINDOW_INTERVALS + 1) * 2.4)
_shift[[0, -1]] = 0.0
NODES = (np.arange(WINDOW_INTERVALS + 1) + _shift) / WINDOW_INTERVALS
INTERVALS_OF_JUMP = 6  # a jump or a kink makes at most this many intervals coarse, at every scale

REPEATED_INTERVALS = 4  # intervals before a coarse one that are repeated


class _Arithmetic(NamedTuple):
    """The functions `min` and `max` of arrays, for `Resolution.classify_interval`."""

    min: Callable[..., Any]
    max: Callable[..., Any]


class Nodes(NamedTuple):
    """The conditions and contact forces at the nodes of a window."""

    t: Float[Any, "G"]
    g: Float[Any, "G C"]
    g_dot: Float[Any, "G C"]
    good: Bool[Any, "G"]  # whether the run reached the node


class Detection(NamedTuple):
    """The first crossing of conditions in a window."""

    sides: Int[Any, "G C"]  # sides of zero at the nodes
    place: Int[Any, ""]  # the last node before the first crossing where the crossing condition is not zero
    next_node: Int[Any, ""]  # the first node after the crossing
    is_found: Bool[Any, ""]
    event: Int[Any, ""]
    root: Float[Any, ""]  # place of the crossing between these nodes, from 0 to 1
    is_exact: Bool[Any, ""]  # whether the root is exact up to rounding
    is_coarse: Bool[Any, ""]  # whether this or an earlier interval is too coarse
    last_sure: Int[Any, ""]  # the last node before a coarse interval that is certain
    coarse: Bool[Any, "C"]  # conditions for which that interval is too coarse
    undefined: Bool[Any, "C"]  # conditions that are NaN at the end of that interval


def detect(
    nodes: Nodes,
    has_rates: Bool[np.ndarray, "C"],
    direction: Int[np.ndarray, "C"],
    sides: Int[Any, "C"],
    scale: Float[Any, "C"],
    zero: Float[Any, "C"],
    located: Int[Any, ""],
    watched: Bool[Any, "C"],
    late: Float[Any, ""],
    is_short: Bool[Any, ""],
    unresolved: Bool[Any, "C"],
    xp: ModuleType = jnp,
) -> Detection:
    """Find the first crossing in a window, or the first coarse interval.

    Args:
        nodes: the conditions at the nodes of the window.
        has_rates: mask of the conditions with given rates; the rates of others are estimated by differences.
        direction: direction of the crossings of each condition, 0 for either.
        sides: the sides of zero at the first node.
        scale: scale of each condition.
        zero: bound below which each condition is zero, relative to its scale.
        located: the condition that certainly crosses zero in this window; -1: none.
        watched: mask of the watched conditions.
        late: time (s) by which an event may be early: at the first node, its condition may still be on the other side.
        is_short: whether the window is so short that coarse intervals must be due to a jump.
        unresolved: mask of the conditions that are not refined.
        xp: jax.numpy, or NumPy.
    """
    t, g, g_dot, good = nodes
    finite = xp.isfinite(g)
    g = xp.where(finite, g, 0.0)
    zero_tol = xp.where(np.arange(len(scale)) == located, 0.0, zero * scale)
    signs = xp.where((xp.abs(g) <= zero_tol) | ~good[:, None] | ~finite, 0, xp.sign(g)).astype(int)
    sides = carry_signs(sides, xp.concatenate([0 * signs[:1], signs[1:]]), xp)
    before, after = sides[:-1], sides[1:]
    step = xp.diff(t)[:, None]
    slope = _slopes(t, g, g_dot, has_rates, xp)
    is_late = (g[0] * sides[0] < 0) & (slope[0] * sides[0] > 0) & (xp.abs(g[0]) <= xp.abs(slope[0]) * late)
    g = xp.concatenate([xp.where(is_late, 0.0, g[0])[None], g[1:]])
    cubic: Cubic = (g[:-1], step * slope[:-1], g[1:], step * slope[1:])
    error = _errors(t, g, slope, has_rates, xp)

    side = xp.where(before != 0, before, after)
    hits = (after == -before) & (before != 0)
    ends = g[:-1], slope[:-1], g[1:], slope[1:]
    single, away = RESOLUTION.classify_interval(_Arithmetic(xp.minimum, xp.maximum), ends, step, error, side, zero * scale)
    usable = good[1:, None] & watched
    coarse = (usable & ~unresolved & ~xp.where(hits, single, away)) | (good[1:, None] & ~finite[1:])
    # A few coarse intervals in a short window contain a jump or a kink: finer windows would not help.
    jumps = is_short & (xp.sum(coarse, 0) <= INTERVALS_OF_JUMP) & xp.all(finite, 0)
    coarse = coarse & ~jumps

    is_crossing = hits & crosses(direction, before, after) & usable
    place, coarse_place = (xp.argmax(xp.any(x, axis=1)) for x in (is_crossing, coarse))
    last_sure = xp.maximum(coarse_place - REPEATED_INTERVALS, 0)  # earlier intervals may only look fine enough
    at_place: Cubic = (cubic[0][place], cubic[1][place], cubic[2][place], cubic[3][place])
    root = xp.where(is_crossing[place], cubic_root(at_place, before[place], xp), xp.inf)
    event, is_found = xp.argmin(root), xp.any(is_crossing)
    is_before = ((signs[:, event] != 0) | (np.arange(len(t)) == 0)) & (np.arange(len(t)) <= place)
    last_before = xp.where(event == located, place, xp.max(xp.where(is_before, np.arange(len(t)), 0)))
    is_coarse = xp.any(coarse) & ~(is_found & (place < last_sure))
    return Detection(
        sides=sides,
        place=last_before,
        next_node=place + 1,
        is_found=is_found & ~is_coarse,
        event=event,
        root=root[event],
        is_exact=(single & (error <= ZERO_TOL / 10 * scale))[place, event] & (place == last_before),
        is_coarse=is_coarse,
        last_sure=last_sure,
        coarse=coarse[coarse_place],
        undefined=~finite[coarse_place + 1],
    )


def _slopes(
    t: Float[Any, "G"], g: Float[Any, "G C"], g_dot: Float[Any, "G C"], has_rates: Bool[np.ndarray, "C"], xp: ModuleType
) -> Float[Any, "G C"]:
    """Return the rates of conditions at the nodes: those given, or differences of second order if none are given or finite."""
    step = xp.diff(t)[:, None]
    secant = xp.diff(g, axis=0) / xp.where(step > 0, step, 1.0)
    total = step[1:] + step[:-1]
    inner = (step[1:] * secant[:-1] + step[:-1] * secant[1:]) / xp.where(total > 0, total, 1.0)
    ends = 2 * secant[0] - inner[0], 2 * secant[-1] - inner[-1]
    by_differences = xp.concatenate([ends[0][None], inner, ends[1][None]])
    return xp.where(has_rates & xp.isfinite(g_dot), g_dot, by_differences)


def _errors(
    t: Float[Any, "G"], g: Float[Any, "G C"], slope: Float[Any, "G C"], has_rates: Bool[np.ndarray, "C"], xp: ModuleType
) -> Float[Any, "I C"]:
    """Return the error of the cubic in each interval: the largest over its pair of intervals and the neighbouring pairs."""
    start, middle, end = t[:-2:2, None], t[1:-1:2, None], t[2::2, None]
    length = end - start
    x = (middle - start) / xp.where(length > 0, length, 1.0)
    cubic: Cubic = (g[:-2:2], length * slope[:-2:2], g[2::2], length * slope[2::2])
    miss = xp.abs(g[1:-1:2] - cubic_value(cubic, x))
    # The error of the rate distinguishes a kink from a smooth condition, whose error is smaller.
    of_rate = xp.abs(length * slope[1:-1:2] - cubic_slope(cubic, x)) * RESOLUTION.miss
    miss = xp.where(has_rates, xp.maximum(RESOLUTION.miss * miss, of_rate), miss)
    neighbours = xp.pad(miss, ((1, 1), (0, 0)))
    return xp.repeat(xp.maximum(xp.maximum(neighbours[:-2], neighbours[2:]), miss), 2, axis=0)
