"""One step of a Runge-Kutta method with error estimate."""

import numpy as np

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import FACTORS, NORMAL_ERROR_WEIGHT, STAGE_SHRINK
from udkjax.native.module.tableau import Method


def write_attempt(module: Module):
    """Write `attempt`: a step from point 3 to `t1`, of length `step`, in lanes that are `stepping`.

    It computes the state at `t1` as `state q`, `result v` and `result a`, with its `error` and `distance`.
    """
    if module.plan.measures_speed:
        write_measure_speed(module)
    f, s = module.function("attempt")
    method, stages = module.method, module.method.stages
    ones = lambda: f.const(1.0, DOUBLE, f.width)  # noqa: E731
    s.ok = ones()
    s.distance = f.const(np.inf, DOUBLE, f.width)
    if module.accelerations.highest_rank(s) is not None:
        s.highest_rank = f.const(0.0, DOUBLE, f.width)
    begins = f.all_of((s.begin > 0.5) | (s.stepping < 0.5))

    def take_stages():
        for i in range(1, stages):
            stage_state(module, f, s, i)
            module.projection.close_stage(f, s)
            module.accelerate_stage(f, i)
            module.accelerations.check_pivots(f, s, f"stage{i} a")
            module.record_stage(f, s, i)
        if module.plan.measures_speed:
            _watch_speed(module, f, s)

    def take_stages_by_method():
        if not module.implicit:
            take_stages()
            return
        stepping = s.stepping
        for take, mask in ((take_stages, s.begin > -0.5), (lambda: f.call("take_stages_from_point3", f.given["work"]), implicit)):
            if take is take_stages and method.is_implicit:
                continue
            mask = (stepping > 0.5) & mask
            with f.if_(f.any_of(mask)):
                s.stepping = f.select(mask, ones(), 0.0)
                take()
        s.stepping = stepping

    def clear_stages():
        # Stages may hold NaN of a failed member, which would survive multiplication by a step of zero.
        with f.each(module.rowcount) as r:
            for i in range(1, module.stages):
                module.put(f, f"stage{i} a", r, f.const(0.0, DOUBLE, module.plan.vector))

    implicit = s.begin < -0.5
    module.projection.begin_step(f, s)
    f.choose(begins, clear_stages, take_stages_by_method)
    for each_method, mask in module.methods(f, s):
        stage_state(module, f, s, each_method.stages, method=each_method, mask=mask)
    setattr(s, "state t", s.t1)
    module.projection.end_step(f, s)
    if module.implicit:
        with f.if_(f.any_of(implicit)):
            module.copy(f, f"stage{module.implicit.stages - 1} a", "result a", implicit)
    _measure_error(module, f, s)
    if module.implicit:
        repeated = (FACTORS.safety / STAGE_SHRINK) ** module.implicit.order
        fails = s.diverged > 0.5
        if module.plan.stiff:
            fails = fails | ((s.trial > 0.0) & ~(s.error < np.inf))
        s.where(fails & implicit & (s.stepping > 0.5), error=repeated)


def _watch_speed(module: Module, f: Function, s: Lane):
    """Set `speed` of an explicit step in attempts in which it is to be measured, otherwise zero."""
    is_due = (s.stepping > 0.5) & (s.tried >= s.watch)
    s.speed = f.const(0.0, DOUBLE, f.width)
    with f.if_(f.any_of(is_due)):
        f.call("measure_speed", f.given["work"])
        s.where(~is_due, speed=0.0)


def write_measure_speed(module: Module):
    """Write `measure_speed`: `speed`, the length of an explicit step times the largest rate of the equations.

    The last two stages are both at the end of the step, and their states differ by errors in which the fastest motions dominate
    (Hairer and Wanner, IV.2). With J the Jacobian of (q, v) -> (v, a), the rate is the root of |J J x| / |x| for this difference
    x: that is right for a motion that decays as well as for one that swings, where |J x| / |x| would depend on the phase.
    """
    f, s = module.function("measure_speed")
    method, h, omega = module.method, module.broadcast(f, s.step), module.broadcast(f, s.omega)
    last = method.stages - 1
    end, distance, safe = f"stage{last} a", s.distance, s.safe
    in_q, in_v, in_a = "state dq", "state dv", "result dv"  # x and J x
    with f.each(module.rowcount) as r:
        sum_q, sum_v = (module.weighted_sum(f, row[last] - row[last - 1], r) for row in (method.q, method.v))
        assert sum_q is not None and sum_v is not None
        change_a = module.vector(f, end, r) - module.vector(f, f"stage{last - 1} a", r)
        for name, change in ((in_q, h * (h * sum_q)), (in_v, h * sum_v), (in_a, change_a)):
            module.put(f, name, r, change)

    def norm(of_q: str, of_v: str) -> Value:
        def sizes(r: Value) -> list[Value]:
            unit = module.vector(f, "inverse unit", r)
            return [f.abs(module.vector(f, of_q, r)) * omega * unit, f.abs(module.vector(f, of_v, r)) * unit]

        return module.largest(f, sizes)

    size = norm(in_q, in_v)
    s.speed = size / norm(in_v, in_a)  # the time in which J x changes the state by as much as x does
    stage_state(module, f, s, last)
    with f.each(module.rowcount) as r:
        for x, change in (("state q", in_v), ("state v", in_a)):
            scaled = module.broadcast(f, s.speed) * module.vector(f, change, r)
            module.put(f, x, r, module.vector(f, x, r) + scaled)
    module.accelerations.accelerate(f, "result a")
    with f.each(module.rowcount) as r:
        change = module.vector(f, "result a", r) - module.vector(f, end, r)
        module.put(f, "result a", r, change / module.broadcast(f, s.speed))
    s.distance, s.safe = distance, safe
    s.speed = s.step * f.intrinsic("sqrt", norm(in_a, "result a") / size)


def _measure_error(module: Module, f: Function, s: Lane):
    """Compute `error`, the maximum over coordinates of the error over its tolerance; NaN if any is NaN."""
    q0, v0, q1, v1 = "point3 q", "point3 v", "state q", "result v"
    rtol = module.broadcast(f, s.rtol)
    weight = NORMAL_ERROR_WEIGHT if module.plan.projected else 0.0

    # The largest ratio of an error to its tolerance is found by products: divisions take longer, most of all those of zero.
    # Comparisons ignore NaN, so non-finite numbers are detected by their product with zero.
    check, error, tolerance = (f.variable(x, width=module.plan.vector) for x in (0.0, 0.0, 1.0))
    with f.each(module.rowcount) as r:
        for d, scale, y0, y1 in (("dq", "scale q", q0, q1), ("dv", "scale v", v0, v1)):
            tangent_error = module.vector(f, f"result {d}", r)
            if weight:
                tangent_error = f.fma(module.vector(f, f"state {d}", r) - tangent_error, weight, tangent_error)
            size = f.max(f.abs(module.vector(f, y0, r)), f.abs(module.vector(f, y1, r)))
            given = f.fma(rtol, size, module.vector(f, scale, r))
            tangent_error = f.abs(tangent_error)
            is_larger = tangent_error * tolerance.value > error.value * given
            error.where(is_larger, tangent_error)
            tolerance.where(is_larger, given)
            check.value = f.fma(tangent_error, 0.0, check.value)
            check.value = f.fma(given, 0.0, check.value)
        check.value = f.fma(module.vector(f, "result a", r), 0.0, check.value)
    total = check.value if module.plan.width > 1 else f.total(check.value)
    ratio = error.value / tolerance.value
    s.error = ratio if module.plan.width > 1 else f.largest_of(ratio)
    s.where((s.ok < 0.5) | total.is_not(0.0), error=np.nan)
    s.where(~(s.distance >= 0.0), distance=0.0)


def stage_state(
    module: Module,
    f: Function,
    s: Lane,
    i: int,
    start: str = "point3",
    step: Value | None = None,
    method: Method | None = None,
    mask: Value | None = None,
):
    """Compute the state of stage i of the step from a point, by one of the module's methods, in all or some lanes."""
    step, method = s.step if step is None else step, method or module.method
    h, names = module.broadcast(f, step), [f"{start} a", *module.stage_accelerations[1:]]
    setattr(s, "state t", f.fma(step, float(method.nodes[i]), getattr(s, f"{start}_t")))
    with f.each(module.rowcount) as r:
        q, v = module.vector(f, f"{start} q", r), module.vector(f, f"{start} v", r)
        sum_q, sum_v = module.weighted_sum(f, method.q[i], r, names), module.weighted_sum(f, method.v[i], r, names)
        slope = v * float(method.nodes[i]) if sum_q is None else f.fma(h, sum_q, v * float(method.nodes[i]))
        for x, new in (("q", f.fma(h, slope, q)), ("v", v if sum_v is None else f.fma(h, sum_v, v))):
            old = None if mask is None else module.vector(f, f"state {x}", r)
            module.put(f, f"state {x}", r, new if mask is None or old is None else f.select(mask, new, old))


def error_of_velocities(module: Module) -> str:
    """Return the name of the array of estimated errors of velocities, before their projection."""
    return "state dv" if module.plan.projected else "result dv"
