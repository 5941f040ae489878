"""One step of a Runge-Kutta method with error estimate."""

import numpy as np

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import NORMAL_ERROR_WEIGHT
from udkjax.native.module.tableau import Method


def write_attempt(module: Module):
    """Write `attempt(work)`: take a step of length `step` to `t1`, in lanes that are `stepping`.

    It begins at point 3, the latest accepted state. The state at `t1` becomes `state q`, `result v` and `result a`. `error` is
    the error of the step relative to its tolerance, `distance` the distance from singular configurations.
    """
    module.stiffness.write_measurement()
    f, s = module.function("attempt")
    stages = module.method.stages
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
            module.projection.end_stage(f, i)
            module.record_stage(f, s, i)

    def clear_stages():
        # Stages may hold NaN of a failed member, which would survive multiplication by a step of zero.
        with f.each(module.rowcount) as r:
            for name in (*module.stage_accelerations[1:], *module.stage_slips[1:]):
                module.put(f, name, r, f.const(0.0, DOUBLE, module.plan.vector))

    implicit = s.begin < -0.5
    module.projection.begin_step(f, s)
    f.choose(begins, clear_stages, lambda: module.stiffness.take_stages(f, s, implicit, take_stages))
    for each_method, mask in module.stiffness.methods(f, s):
        stage_state(module, f, s, each_method.stages, method=each_method, mask=mask)
    setattr(s, "state t", s.t1)
    module.projection.end_step(f, s)
    module.stiffness.end_step(f, s, implicit)
    _measure_error(module, f, s)
    module.stiffness.repeat_diverged(f, s, implicit)


def _measure_error(module: Module, f: Function, s: Lane):
    """Compute `error`, the maximum over coordinates of the error over its tolerance; NaN if any is NaN."""
    q0, v0, q1, v1 = "point3 q", "point3 v", "state q", "result v"
    rtol = module.broadcast(f, s.rtol)
    weight = NORMAL_ERROR_WEIGHT if module.plan.projected else 0.0

    # The largest ratio of an error to its tolerance is found by products: divisions take longer, most of all those of zero.
    # Comparisons ignore NaN, so non-finite numbers are detected by their product with zero.
    check, error, tolerance = (f.variable(x, width=module.plan.vector) for x in (0.0, 0.0, 1.0))
    with f.each(module.rowcount) as r:
        for d, scale, y0, y1 in (("dq", "atol q", q0, q1), ("dv", "atol v", v0, v1)):
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
    """Compute the state of stage i of a step, as `state t`, `state q` and `state v`.

    Args:
        module: The module.
        f: The function to which the code is added.
        s: The numbers of its lanes.
        i: The index of the stage; the number of stages means the end of the step.
        start: The point from which the step starts.
        step: The length of the step (s); None: `s.step`.
        method: The method; None: `module.method`.
        mask: The lanes whose `state q` and `state v` change; None: all lanes.
    """
    step, method = s.step if step is None else step, method or module.method
    h, names = module.broadcast(f, step), list(module.stage_accelerations)
    names[0] = names[0] if start == "point3" else f"{start} a"
    setattr(s, "state t", f.fma(step, float(method.nodes[i]), getattr(s, f"{start}_t")))
    with f.each(module.rowcount) as r:
        q, v = module.vector(f, f"{start} q", r), module.vector(f, f"{start} v", r)
        sum_q, sum_v = module.weighted_sum(f, method.q[i], r, names), module.weighted_sum(f, method.v[i], r, names)
        slope = v * float(method.nodes[i]) if sum_q is None else f.fma(h, sum_q, v * float(method.nodes[i]))
        slips = module.weighted_sum(f, method.v[i], r, module.stage_slips) if module.stage_slips else None
        slope = slope if slips is None else slope + slips
        for x, new in (("q", f.fma(h, slope, q)), ("v", v if sum_v is None else f.fma(h, sum_v, v))):
            old = None if mask is None else module.vector(f, f"state {x}", r)
            module.put(f, f"state {x}", r, new if mask is None or old is None else f.select(mask, new, old))


def error_of_velocities(module: Module) -> str:
    """Return the name of the array that holds the estimated errors of velocities, before these errors are projected."""
    return "state dv" if module.plan.projected else "result dv"
