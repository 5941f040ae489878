"""Steps that leave a piece of the state space in which the motion is smooth (one cubic of a cam's profile)."""

from collections.abc import Callable

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import (
    ACROSS_EDGE,
    ACROSS_PIECE,
    AIM_ACROSS,
    AIM_BEFORE,
    AIM_BEYOND,
    EDGE,
    FACTORS,
    HALVINGS,
    NEAR_END,
    NEAR_ZERO,
    NO_LOAD,
    TRIES,
)
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
    first_edge = module.pieces - module.edges
    goes_across, per_unit = s.aim.is_(float(AIM_ACROSS)), module.entry(f, "inverse unit", f.const(0, INT))
    loaded = s.tolerance * NO_LOAD * s.omega / ((s.t1 - s.point3_t) * per_unit)  # (m/s^2)

    def look():
        if module.edges:
            distance, safe = s.distance, s.safe
            module.friction.settle(f, "piece a")
            s.distance, s.safe = distance, safe
        module.invoke(f, "pieces")

    def find_pieces(time: Value, state: Callable[[Value], tuple[Value, Value]]):
        setattr(s, "state t", time)
        with f.each(module.rowcount) as r:
            for x, value in zip("qv", state(r), strict=True):
                module.put(f, f"state {x}", r, value)

    def any_edge(meets: Callable[[Value, Value], Value]) -> Value:
        found = f.variable(f.const(False, BOOL, f.width), BOOL)
        if not module.edges:
            return found.value
        with f.each(module.edges) as k:
            found.value = found.value | meets(module.entry(f, "pieces", k + first_edge), module.entry(f, "edges before", k))
        return found.value

    def turned() -> Value:
        """Return whether the load of an edge has another sign; loads that are nearly zero before count only in a step across."""

        def differs(current: Value, previous: Value) -> Value:
            now, before = current > 0.0, previous > 0.0
            return ((now & ~before) | (before & ~now)) & ((f.abs(previous) > loaded) | goes_across)

        return any_edge(differs)

    def least_load() -> Value:
        """Return the smallest load of an edge that counts, relative to that at the start of the step; infinite if none does."""
        least = f.variable(inf)
        if module.edges:
            with f.each(module.edges) as k:
                current, previous = module.entry(f, "pieces", k + first_edge), module.entry(f, "edges before", k)
                least.value = f.min(least.value, where(f.abs(previous) > loaded, current / previous, inf))
        return least.value

    def moved() -> Value:
        differs = f.variable(turned(), BOOL)
        with f.each(first_edge) as k:
            current, previous = (module.entry(f, x, k) for x in ("pieces", "pieces before"))
            differs.value = differs.value | current.is_not(previous)
        return differs.value

    with f.each(module.rowcount) as r:
        module.put(f, "corrected q", r, module.vector(f, "state q", r))
    if module.edges:
        module.invoke(f, "pieces")  # the loads at the end of the step have settled last
        with f.each(module.edges) as k:
            module.put_entry(f, "edges", k, module.entry(f, "pieces", k + first_edge))
    if first_edge:
        find_pieces(s.point3_t, lambda r: (module.vector(f, "point3 q", r), module.vector(f, "point3 v", r)))
        module.invoke(f, "pieces")
        with f.each(first_edge) as k:
            module.put_entry(f, "pieces before", k, module.entry(f, "pieces", k))
    strays = f.variable(f.const(False, BOOL, f.width), BOOL)

    def look_at_last_stages(lanes: Value):
        for i in np.flatnonzero(module.method.nodes[: module.method.stages] > 1 - NEAR_END).tolist():
            stage_state(module, f, s, i)
            look()
            strays.value = strays.value | (moved() & lanes)

    if module.edges:
        is_near = any_edge(lambda current, previous: f.abs(current) < f.abs(previous) * NEAR_ZERO)
        lanes = (s.again > 0.5) & (is_near | f.const(first_edge > 0, BOOL, f.width))
        with f.if_(f.any_of(lanes)):
            look_at_last_stages(lanes)
    elif not module.plan.projected or module.code.has_piecewise_loads:
        look_at_last_stages(s.again > 0.5)
    find_pieces(s.t1, lambda r: (module.vector(f, "corrected q", r), module.vector(f, "result v", r)))
    if first_edge:
        module.invoke(f, "pieces")
    if module.edges:
        with f.each(module.edges) as k:
            module.put_entry(f, "pieces", k + first_edge, module.entry(f, "edges", k))
    stepping, step = s.again > 0.5, s.t1 - s.point3_t
    # The polynomial of a step is no motion where its error is so large that the controller shortens it as far as it may.
    is_motion = s.error < FACTORS.shrink**-module.method.order
    can_leave = stepping & (s.begin < 0.5) & is_motion & (goes_across | moves_by_tolerance(module, f, s))
    turns = turned()
    leaves = can_leave & moved()
    again = s.aim.is_not(float(AIM_ACROSS)) & (s.tries < float(TRIES))

    def look_at(share: Value) -> tuple[Value, Value]:
        find_pieces(f.fma(share, step, s.point3_t), lambda r: interpolate_step(module, f, share, step, r))
        look()
        return moved(), least_load()

    share = locate_end(f, leaves & again, least_load(), look_at)
    setattr(s, "state t", s.t1)
    with f.each(module.rowcount) as r:
        module.put(f, "state q", r, module.vector(f, "corrected q", r))
        module.put(f, "state v", r, module.vector(f, "result v", r))
    aim, is_accurate = s.aim, s.error < 1.0
    repeats, shortens = leaves & again, can_leave & strays.value & ~leaves & again
    is_near_end = f.min(share, yes - share) <= NEAR_END
    s.where(leaves & ~repeats, lands=1.0)
    s.where(stepping, crosses=where(leaves & goes_across, where(turns, f.const(ACROSS_EDGE, DOUBLE, f.width), ACROSS_PIECE), 0.0))
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


def locate_end(f: Function, lanes: Value, at_end: Value, look_at: Callable[[Value], tuple[Value, Value]]) -> Value:
    """Locate the end of the piece in some lanes, as exactly as the next attempt needs.

    By bisection, or by false position (the Illinois variant) where the load of an edge, which is continuous, has another sign.

    Args:
        f: The function.
        lanes: The lanes.
        at_end: The smallest relative load of an edge at the end of the step.
        look_at: Returns, at a fraction of the step, whether the state has left the piece, and the smallest relative load.

    Returns:
        An upper bound, as a fraction of the step; one in other lanes.
    """
    low, high, side, count = f.variable(0.0), f.variable(1.0), f.variable(0.0), f.variable(0, INT, 1)
    load_low, load_high = f.variable(1.0), f.variable(at_end)

    def width() -> Value:
        is_near_end = (low.value < NEAR_END) | (high.value > 1 - NEAR_END)
        return f.select(is_near_end, f.const(EDGE / 8, DOUBLE, f.width), NEAR_END / 8)

    def is_open() -> Value:
        return lanes & (high.value - low.value > width())

    with f.while_(lambda: f.any_of(is_open()) & (count.value < HALVINGS)):
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
