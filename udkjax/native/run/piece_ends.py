"""The search for the end of a piece within a step, and the polynomial of the step that it evaluates."""

from collections.abc import Callable

from udkjax.native.language.ir import DOUBLE, INT, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import EDGE_STEP, NEAR_END_FRACTION, PIECE_HALVINGS


def locate_end(f: Function, lanes: Value, at_end: Value, look_at: Callable[[Value], tuple[Value, Value]]) -> Value:
    """Locate the end of the piece within a step, in some lanes, as exactly as the next attempt needs it.

    The method is bisection, or false position (the Illinois variant) where the piece ends at a zero of the load of an edge, which
    is continuous.

    Args:
        f: The function to which the search is added.
        lanes: The mask of the lanes that search.
        at_end: The smallest load of an edge at the end of the step, relative to the load at its start.
        look_at: A function of a fraction of the step. It returns the mask of the lanes whose state there has left the piece, and
            the smallest relative load of an edge there.

    Returns:
        An upper bound of the end of the piece, as a fraction of the step; one in other lanes.
    """
    low, high, side, count = f.variable(0.0), f.variable(1.0), f.variable(0.0), f.variable(0, INT, 1)
    load_low, load_high = f.variable(1.0), f.variable(at_end)

    def width() -> Value:
        is_near_end = (low.value < NEAR_END_FRACTION) | (high.value > 1 - NEAR_END_FRACTION)
        return f.select(is_near_end, f.const(EDGE_STEP / 8, DOUBLE, f.width), NEAR_END_FRACTION / 8)

    def is_open() -> Value:
        return lanes & (high.value - low.value > width())

    with f.while_(lambda: f.any_of(is_open()) & (count.value < PIECE_HALVINGS)):
        open_, a, b, margin = is_open(), low.value, high.value, width() * 0.5
        has_sign = (load_low.value > 0.0) & (load_high.value < 0.0)
        zero = f.fma(load_low.value / (load_low.value - load_high.value), b - a, a)
        zero = f.min(f.max(zero, a + margin), b - margin)
        trial = f.select(has_sign, zero, (a + b) * 0.5)
        has_left, load = look_at(trial)
        leaves, stays = open_ & has_left, open_ & ~has_left
        load_low.where(leaves & (side.value > 0.5), load_low.value * 0.5)
        load_high.where(stays & (side.value < -0.5), load_high.value * 0.5)
        for mask, x, load_there, sign in ((leaves, high, load_high, 1.0), (stays, low, load_low, -1.0)):
            x.where(mask, trial)
            load_there.where(mask, load)
            side.where(mask, sign)
        count.value = count.value + 1
    return high.value


def moves_by_tolerance(module: Module, f: Function, s: Lane) -> Value:
    """Return the lanes in which a step, from the latest point to `corrected q` and `result v`, changes the state noticeably.

    It does so if the state changes by more than its tolerance. At the end of a piece, derivatives of accelerations jump. The
    effect of this jump on a step within the tolerance around the end is less than the admissible error, and is ignored. If it
    were not, rounding errors would make a mechanism at rest there step to and fro across the end for ever.
    """
    rtol = module.broadcast(f, s.rtol)
    changes = [("point3 q", "corrected q", "atol q")]
    if module.code.has_piecewise_loads:
        changes.append(("point3 v", "result v", "atol v"))

    def ratios(r: Value) -> list[Value]:
        sizes = []
        for start, end, scale in changes:
            y0, y1 = module.vector(f, start, r), module.vector(f, end, r)
            sizes.append(f.abs(y1 - y0) / f.fma(rtol, f.max(f.abs(y0), f.abs(y1)), module.vector(f, scale, r)))
        return sizes

    return module.largest(f, ratios) > 1.0


def interpolate_step(module: Module, f: Function, share: Value, step: Value, r: Value) -> tuple[Value, Value]:
    """Return q and v at a fraction `share` of the step, on the polynomial through its two ends (one register)."""
    x, h = module.broadcast(f, share), module.broadcast(f, step)

    def polynomial(*coefficients: float) -> Value:
        total = f.const(coefficients[-1], DOUBLE, module.plan.vector)
        for c in reversed(coefficients[:-1]):
            total = f.fma(total, x, c)
        return total

    ends = [module.vector(f, name, r) for name in ("point3 q", "corrected q", "point3 v", "result v", "point3 a", "result a")]
    hermite = [  # coefficients of the quintic polynomial that belongs to each end value, the constant first
        (1.0, 0.0, 0.0, -10.0, 15.0, -6.0),
        (0.0, 0.0, 0.0, 10.0, -15.0, 6.0),
        (0.0, 1.0, 0.0, -6.0, 8.0, -3.0),
        (0.0, 0.0, 0.0, -4.0, 7.0, -3.0),
        (0.0, 0.0, 0.5, -1.5, 1.5, -0.5),
        (0.0, 0.0, 0.0, 0.5, -1.0, 0.5),
    ]
    scales = (None, None, h, h, h * h, h * h)
    q = v = f.const(0.0, DOUBLE, module.plan.vector)
    for end, c, scale in zip(ends, hermite, scales, strict=True):
        scaled = end if scale is None else end * scale
        q = f.fma(polynomial(*c), scaled, q)
        v = f.fma(polynomial(*(k * c[k] for k in range(1, 6))), scaled, v)
    return q, v / h
