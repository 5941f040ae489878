"""The step controller, which accepts or rejects a step, and chooses the length of the next one.

Numbers of a lane `s` (layout.py has them all):

    point3_t, t1            time of the latest accepted state, and end of the attempted step (s)
    h                       step length chosen by the controller (s)
    error, rate             error of the attempt, relative to the tolerance; error of the previous step divided by length^order
    begin, last, lands      one if the attempt begins a run; if it ends the run; if it ends at a breakpoint
    fallback, fallback_due  one if the fallback makes this attempt; if it must make the next one
    retries, distance       number of successive attempts shortened because of a pivot; distance from singular configurations
    distance0 to 2          distances of the previous accepted states, the latest last
"""

from typing import Any

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value
from udkjax.native.language.power import power
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import (
    BREAK_GAP,
    FACTORS,
    LARGEST_STRETCH,
    NODE_COUNT,
    RESTART_FACTOR,
    Status,
)
from udkjax.native.parts.manifold import velocity_tolerance


def write_decide(module: Module):
    """Write `decide(work)`: accept or reject the step of lanes that are `stepping`, and choose the next one.

    It also sets `until`, the time up to which outputs are due, and the status `code` of runs that end.
    """
    f, s = module.function("decide")
    where, yes, inf = f.select, f.const(1.0, DOUBLE, f.width), f.const(np.inf, DOUBLE, f.width)
    stepping, fallback, error, begin = s.stepping > 0.5, s.fallback > 0.5, s.error, s.begin > 0.5
    failed = stepping & ~(error < np.inf)
    tries = module.stiffness.trials(s, stepping)
    stepping, shortens, time_left = module.fallback.retry(f, s, stepping, failed, tries)
    repeats = f.const(False, BOOL, f.width)
    tried = where(stepping, s.tried + 1.0, s.tried)
    if module.pieces:
        s.again = where(stepping, yes, 0.0)
        f.call("end_piece", f.given["work"])
        repeats = s.again > 0.5
    accept = stepping & (error < module.fallback.limit_of_error(f, s, time_left)) & ~shortens & ~repeats
    if module.edges:
        with f.each(module.edges) as k:
            new, old = (module.entry(f, name, k) for name in ("edges", "edges before"))
            module.put_entry(f, "edges before", k, where(accept, new, old))
    stepped, begun, step = ~begin, stepping & begin, s.t1 - s.point3_t
    factor, rate = _step_factor(module, f, s, accept, step, tries)
    h = where(stepping, step * where(shortens, f.const(FACTORS.safety, DOUBLE, f.width), factor), s.h)
    h = where(repeats, s.h, h)
    h = module.fallback.step_around(f, s, accept, lambda: stepping & stepped & ~repeats, time_left, step, h)
    if tries is not None:  # a trial that fails leaves no trace
        h = where(tries & ~accept, s.h, h)
    chosen = f.variable(h)
    with f.if_(f.any_of(begun)):
        chosen.value = where(begun, first_step(module, f, s), chosen.value)
    h = chosen.value
    if module.plan.breaks:
        h = where(accept & stepped & (step < s.h - s.smallest), f.max(h, s.h), h)
        h = where(begun & (tried > 0.0), s.h * RESTART_FACTOR, h)
    code = where(stepping & (h < s.smallest), f.const(Status.STEP_TOO_SMALL, DOUBLE, f.width), s.code)
    is_over = code.is_(float(Status.RUNNING)) & stepping & (tried >= s.max_steps)
    code = where(is_over, where(s.max_steps < 0.0, f.const(Status.INTERRUPTED, DOUBLE, f.width), Status.STEP_LIMIT), code)
    code = where(stepping & failed & begin & ~accept, where(code.is_(float(Status.RUNNING)), Status.STEP_TOO_SMALL, code), code)
    code = where(accept & (s.last > 0.5), Status.DONE, code)
    lost = _accept_step(module, f, s, accept)
    goes_on = code.is_(float(Status.RUNNING)) | (code.is_(float(Status.DONE)) & (lost >= float(Status.SINGULAR)))
    code = where((lost > 0.0) & goes_on, lost, code)
    s.where(accept & stepped, rate=rate)
    if module.plan.breaks:
        s.where(begun, rate=inf, distance0=inf, distance1=inf)
        s.where(stepping, steps=where(begin, s.steps + where(begun & accept, yes, 0.0), s.steps + where(accept, yes, 0.0)))
        s.where(accept & (s.lands > 0.5), steps=-1.0)
    implicit = s.begin < -0.5
    per_step = module.stiffness.cost(f, s, implicit, f.const(float(module.method.stages), DOUBLE, f.width))
    cost = where(begin, f.const(1.0, DOUBLE, f.width), per_step)
    cost = where(fallback, cost * 2.0 + where(begin, f.const(0.0, DOUBLE, f.width), 1.0), cost)
    s.where(stepping, evaluations=s.evaluations + cost, tried=tried, h=h, code=code)
    # Points beyond a sudden change, which shorten steps again and again, say nothing of the motion before.
    abrupt = stepping & ~accept & (s.h * LARGEST_STRETCH < s.point3_t - s.point2_t)
    s.abrupt = where(abrupt, yes, 0.0)
    s.until = where(abrupt, s.point3_t, _due_until(module, f, s, accept, stepping & begin))
    s.where(accept, accepted=s.accepted + 1.0)
    module.stiffness.choose_next(f, s, stepping, accept, implicit, tries)


def _step_factor(module: Module, f: Function, s: Lane, accept: Value, step: Value, tries: Value | None) -> tuple[Value, Value]:
    """Return the ratio of the next step to this one, of length `step`, and the error of this one divided by length^order.

    `tries`: the lanes whose attempt is a trial of an implicit step; None if there are no trials.
    """
    chosen, used = (f.variable(0.0), f.variable(0.0))
    # A trial is by another method than the step before.
    before = s.rate if tries is None else f.select(tries, f.const(np.inf, DOUBLE, f.width), s.rate)
    for method, mask in module.stiffness.methods(f, s):
        for variable, new in zip((chosen, used), _factor_of_order(f, before, s.error, accept, step, method.order), strict=True):
            variable.value = new if mask is None else f.select(mask, new, variable.value)
    return chosen.value, used.value


def _factor_of_order(f: Function, before: Value, error: Value, accept: Value, step: Value, order: float) -> tuple[Value, Value]:
    where = f.select
    # Errors are bounded below by the error at which a step grows by `grow`, as smaller errors may be rounding.
    size = where(f.is_finite(error), f.max(error, FACTORS.grow ** -float(order)), 1e30)
    rate = size / power(f, step, float(int(order)), whole=True)
    foreseen = size * (rate / before)  # the error of an equal step if errors continue to grow (Gustafsson 1994)
    grows = accept & (foreseen > 1.0)
    factor = power(f, where(grows, foreseen, size), -1.0 / order) * FACTORS.safety
    factor = f.max(factor, where(accept & ~grows, f.const(1.0, DOUBLE, f.width), FACTORS.shrink))
    return f.min(factor, where(accept, f.const(FACTORS.grow, DOUBLE, f.width), FACTORS.safety)), rate


def _accept_step(module: Module, f: Function, s: Lane, accept: Value) -> Value:
    """Make the end of a step the latest point in lanes that `accept`.

    Returns:
        The `Status` with which the new point ends a run; zero in lanes that go on.
    """
    lost = f.variable(0.0)
    with f.if_(f.any_of(accept)):
        with f.if_(f.any_of(accept & module.interpolates(f, s))):
            for k in range(NODE_COUNT - 1):
                module.copy_point(f, accept, f"point{k + 1}", f"point{k}")
        for k in range(NODE_COUNT - 1):
            s.where(accept, **{f"point{k}_t": getattr(s, f"point{k + 1}_t")})
        module.copy_point(f, accept, ("state q", "result v", "result a"), f"point{NODE_COUNT - 1}")
        s.where(accept, point3_t=s.t1)
        module.stiffness.shift_points(f, s, accept)
        s.where(accept, distance0=s.distance1)
        s.where(accept, distance1=s.distance2)
        s.where(accept, distance2=s.distance)
        module.projection.judge(f, s, accept, lost)
        rank = module.accelerations.highest_rank(s)
        if rank is not None:
            # Rows that depend on others along the whole motion are independent where these are violated, or by rounding, unless
            # the threshold of the rank is larger: they then hold back what is free to move.
            is_held = accept & (rank > s.max_rank) & lost.value.is_(0.0)
            lost.value = f.select(is_held, f.const(Status.SPURIOUS_RANK, DOUBLE, f.width), lost.value)
        if module.m:
            s.where(accept, tolerance=velocity_tolerance(module, f, s, "point3 v"))
        module.record_step(f, s, accept)
    return lost.value


def _due_until(module: Module, f: Function, s: Lane, accept: Value, begun: Value) -> Value:
    """Return the time up to which outputs are due after an attempt; minus infinity if they have to wait for further steps.

    `begun`: the lanes whose attempt was the beginning of a run.
    """
    begin, alone = s.begin > 0.5, s.begin < -0.5
    # Outputs of the first step are interpolated after the second, unless the motion ends or changes there; by an implicit method
    # each step serves its own.
    ready = accept & ((s.accepted > 0.0) | (~begin & ((s.last > 0.5) | (s.lands > 0.5))) | alone)
    # The last step may end slightly before a breakpoint at the end of the run, where outputs are also due.
    until = f.select(ready, f.select(s.last > 0.5, f.max(s.t1, s.end), s.t1), -np.inf)
    if module.plan.breaks:
        enough = ~begun & (alone | (s.steps >= float(NODE_COUNT - 1)) | (s.lands > 0.5) | (s.last > 0.5) | (s.steps < 0.0))
        until = f.select(enough, until + f.select(s.lands > 0.5, s.smallest * BREAK_GAP, 0.0), -np.inf)
    if module.pieces:  # interpolation through both ends of the tiny step that follows would amplify rounding errors
        until = f.select(module.steps_across_next(s), s.point3_t, until)
    return until


def first_step(module: Module, f: Function, s: Lane) -> Value:
    """Return the length of the first step (s): `first` if it is given, else one in which the state changes by one hundredth.

    The change is relative to the state or, where this is smaller, to its unit; tolerances weight the coordinates.

    The rule is that of `first_step` in integrate/diffrax_engine.py.
    """
    rtol, atol, omega = (module.broadcast(f, x) for x in (s.rtol, s.atol, s.omega))

    def relative(of_q: str, of_v: str, least: float) -> Any:
        def ratios(r: Value) -> list[Value]:
            per_unit, sizes = module.vector(f, "inverse unit", r), []
            for name, y, per in ((of_q, "state q", per_unit), (of_v, "result v", per_unit / omega)):
                floor = f.select(per > 0.0, f.const(least, DOUBLE, module.plan.vector), 0.0)  # zero for the padding of registers
                x = f.max(f.abs(module.vector(f, name, r)) * per, floor)
                sizes.append(x / f.fma(rtol, f.abs(module.vector(f, y, r)) * per, atol))
            return sizes

        return ratios

    size, rate = module.largest(f, relative("state q", "result v", 1.0)), module.largest(f, relative("result v", "result a", 0.0))
    span = s.end - s.start
    ordinary = f.is_finite(rate) & (rate > 0.0)
    chosen = f.select(ordinary, f.min(size / f.select(ordinary, rate, 1.0) * 0.01, span), span * 1e-4)
    return f.select(s.first > 0.0, f.min(s.first, span), chosen)
