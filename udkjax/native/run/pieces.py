"""Steps that leave a piece of the state space in which the motion is smooth (one cubic of a cam's profile)."""

from collections.abc import Callable

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import AIM_ACROSS, AIM_BEFORE, AIM_BEYOND, EDGE, FACTORS, HALVINGS, NEAR_END, TRIES
from udkjax.native.run.runge_kutta import stage_state


def write_end_piece(module: Module):
    """Write `end_piece`: decide in lanes of `again` whether a step that ends in another piece is accepted or repeated.

    Such a step is repeated to end just before the end of the piece. A tiny step then crosses the end, and the run begins anew:
    the accelerations of all points of an interpolation must belong to one piece. So must those of all stages of a step, since
    their derivatives jump: a step that ends in its piece, but has a stage near its end in another, is repeated to end earlier.
    Only a jump that follows from constraints may remain if states are projected, which makes their derivatives right.
    """
    f, s = module.function("end_piece")
    where, yes, inf = f.select, f.const(1.0, DOUBLE, f.width), f.const(np.inf, DOUBLE, f.width)

    def find_pieces(time: Value, state: Callable[[Value], tuple[Value, Value]]):
        setattr(s, "state t", time)
        with f.each(module.rowcount) as r:
            for x, value in zip("qv", state(r), strict=True):
                module.put(f, f"state {x}", r, value)
        module.invoke(f, "pieces")

    def moved() -> Value:
        differs = f.variable(f.const(False, BOOL, f.width), BOOL)
        with f.each(module.pieces) as k:
            current, previous = (module.entry(f, x, k) for x in ("pieces", "pieces before"))
            differs.value = differs.value | current.is_not(previous)
        return differs.value

    with f.each(module.rowcount) as r:
        module.put(f, "corrected q", r, module.vector(f, "state q", r))
    find_pieces(s.point3_t, lambda r: (module.vector(f, "point3 q", r), module.vector(f, "point3 v", r)))
    with f.each(module.pieces) as k:
        module.put_entry(f, "pieces before", k, module.entry(f, "pieces", k))
    strays = f.const(False, BOOL, f.width)
    if not module.plan.projected or module.code.has_piecewise_loads:
        for i in np.flatnonzero(module.method.nodes[: module.method.stages] > 1 - NEAR_END).tolist():
            stage_state(module, f, s, i)
            module.invoke(f, "pieces")
            strays = strays | moved()
    find_pieces(s.t1, lambda r: (module.vector(f, "corrected q", r), module.vector(f, "result v", r)))
    stepping, step = s.again > 0.5, s.t1 - s.point3_t
    # The polynomial of a step is no motion where its error is so large that the controller shortens it as far as it may.
    is_motion = s.error < FACTORS.shrink**-module.method.order
    can_leave = stepping & (s.begin < 0.5) & is_motion & moves_by_tolerance(module, f, s)
    leaves = can_leave & moved()
    s.share, s.low = yes, f.const(0.0, DOUBLE, f.width)
    with f.if_(f.any_of(leaves)), f.each(HALVINGS):
        middle = (s.low + s.share) * 0.5
        find_pieces(f.fma(middle, step, s.point3_t), lambda r: interpolate_step(module, f, middle, step, r))
        has_left = moved()
        s.where(leaves & has_left, share=middle)
        s.where(leaves & ~has_left, low=middle)
    setattr(s, "state t", s.t1)
    with f.each(module.rowcount) as r:
        module.put(f, "state q", r, module.vector(f, "corrected q", r))
        module.put(f, "state v", r, module.vector(f, "result v", r))
    share, aim, is_accurate = s.share, s.aim, s.error < 1.0
    again = aim.is_not(float(AIM_ACROSS)) & (s.tries < float(TRIES))
    repeats, shortens = leaves & again, can_leave & strays & ~leaves & again
    is_near_end = f.min(share, yes - share) <= NEAR_END
    s.where(leaves & ~repeats, lands=1.0)
    s.where(stepping, crosses=where(leaves & aim.is_(float(AIM_ACROSS)), yes, 0.0))
    short = (s.t1 < s.crossing - s.smallest) & (s.lands < 0.5)
    reached = stepping & is_accurate & ~leaves & ~shortens & ~short & aim.is_(float(AIM_BEFORE))
    across = reached | (repeats & (share <= EDGE))
    before, beyond = (f.const(float(x), DOUBLE, f.width) for x in (AIM_BEFORE, AIM_BEYOND))
    aim = where(repeats, where(is_near_end, before, beyond), where(short, aim, beyond))
    expected = f.fma(where(is_near_end, share - EDGE / 2, share + NEAR_END / 2), step, s.point3_t)
    crossing = where(repeats, expected, where(short, s.crossing, inf))
    crossing = where(across, f.fma(s.h, EDGE, where(reached, s.t1, s.point3_t)), crossing)
    aim = where(shortens, beyond, aim)
    farthest = max(1.0, float(module.method.nodes.max()))  # some methods have stages after the end of the step
    crossing = where(shortens, f.fma(step, (1 - NEAR_END) / farthest, s.point3_t), crossing)
    repeats = repeats | shortens
    tries = where(repeats, s.tries + 1.0, where(is_accurate, 0.0, s.tries))
    s.where(stepping, crossing=crossing, aim=where(across, f.const(float(AIM_ACROSS), DOUBLE, f.width), aim), tries=tries)
    s.again = where(repeats, yes, 0.0)


def moves_by_tolerance(module: Module, f: Function, s: Lane) -> Value:
    """Return whether the state changes by more than its tolerance in a step from the latest point to `corrected q`, `result v`.

    At an end of a piece, derivatives of accelerations jump. What this adds to a step that begins and ends so close to it is less
    than its error may be. A mechanism at rest there would step to and fro across the end by rounding errors for ever.
    """
    rtol = module.broadcast(f, s.rtol)
    changes = [("point3 q", "corrected q", "scale q")]
    if module.code.has_piecewise_loads:
        changes.append(("point3 v", "result v", "scale v"))

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
