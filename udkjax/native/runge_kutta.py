"""One step of an explicit Runge-Kutta method, with the estimate of its error."""

import numpy as np

from udkjax.native.ir import DOUBLE, Function, Value
from udkjax.native.layout import Lane
from udkjax.native.manifold import newton, with_threshold
from udkjax.native.module import Module
from udkjax.native.steps import NORMAL_ERROR_WEIGHT, ROUNDING_PIVOT


def write_attempt(t: Module):
    """From P3 by `step` to `t1`: the state there in X q, O v, O a; its `error` and `distance`, of lanes that are `stepping`."""
    f, s = t.function("attempt")
    method, stages = t.method, t.method.stages
    one = lambda: f.const(1.0, DOUBLE, f.width)  # noqa: E731
    s.ok = one()
    s.distance = f.const(np.inf, DOUBLE, f.width)
    begins = f.all_of((s.begin > 0.5) | (s.stepping < 0.5))

    def take_stages():
        for i in range(1, stages):
            stage_state(t, f, s, i)
            t.accelerate_stage(f, i)
            check_pivots(t, f, s, f"A{i}")
            t.record_stage(f, s, i)

    def clear_stages():
        # They may hold what is no number, of a member that failed: no time at all would still multiply that.
        with f.each(t.rowcount) as r:
            for i in range(1, stages):
                t.put(f, f"A{i}", r, f.const(0.0, DOUBLE, t.plan.vector))

    f.choose(begins, clear_stages, take_stages)
    stage_state(t, f, s, stages)
    setattr(s, "X t", s.t1)
    if not t.plan.projected:
        t.invoke(f, "accelerations", "O a")
        check_pivots(t, f, s, "O a")
        with f.each(t.rowcount) as r:
            t.put(f, "O v", r, t.vector(f, "X v", r))
        estimate_errors(t, f, s, "O a", "O dq", "O dv")
        with f.each(t.rowcount) as r:
            for d in ("dq", "dv"):
                t.put(f, f"X {d}", r, t.vector(f, f"O {d}", r))
    else:
        if not method.ends:
            estimate_errors(t, f, s, None, "X dq", "X dv")
        newton(t, f, s)
        t.invoke(f, "project_and_accelerate" if method.ends else "end_of_step")
        unsafe = (s.stepping > 0.5) & (s.safe < 0.5)
        if t.falls_back:
            s.where(unsafe, ok=0.0)
        if method.ends:
            estimate_errors(t, f, s, "O a", "X dq", "X dv")
            threshold = f.const(ROUNDING_PIVOT, DOUBLE, f.width)
            with_threshold(f, t.drop_tol_place, threshold, lambda: t.invoke(f, "tangent_part"))
        if t.falls_back:
            again = (s.stepping > 0.5) & (s.fallback > 0.5)
            with f.if_(f.any_of(again)):
                t.invoke(f, "finish_by_fallback")
                s.where(again, ok=1.0)
    q0, v0, q1, v1 = "P3 q", "P3 v", "X q", "O v"
    rtol = t.broadcast(f, s.rtol)
    taken = NORMAL_ERROR_WEIGHT if t.plan.projected else 0.0

    def relative(r: Value) -> list[Value]:
        found = []
        for d, scale, y0, y1 in (("dq", "scale q", q0, q1), ("dv", "scale v", v0, v1)):
            left = t.vector(f, f"O {d}", r)
            if taken:
                left = f.fma(t.vector(f, f"X {d}", r) - left, taken, left)
            size = f.max(f.abs(t.vector(f, y0, r)), f.abs(t.vector(f, y1, r)))
            found.append(f.abs(left) / f.fma(rtol, size, t.vector(f, scale, r)))
        return found

    # A number that is not finite is the largest of no comparison: zero times it is looked for instead.
    check = f.variable(0.0, width=t.plan.vector)
    with f.each(t.rowcount) as r:
        for x in (*relative(r), t.vector(f, "O a", r)):
            check.value = f.fma(x, 0.0, check.value)
    total = check.value if t.plan.width > 1 else t.total(f, check.value)
    s.error = t.largest(f, relative)
    s.where((s.ok < 0.5) | total.is_not(0.0), error=np.nan)
    s.where(~(s.distance >= 0.0), distance=0.0)


def stage_state(t: Module, f: Function, s: Lane, i: int, start: str = "P3", step: Value | None = None):
    """t, q and v of stage i in X, of the step from a point."""
    step = s.step if step is None else step
    method, h, names = t.method, t.broadcast(f, step), [f"{start} a", *t.stage_accelerations[1:]]
    setattr(s, "X t", f.fma(step, float(method.nodes[i]), getattr(s, f"T{start[1:]}")))
    with f.each(t.rowcount) as r:
        q, v = t.vector(f, f"{start} q", r), t.vector(f, f"{start} v", r)
        sum_q, sum_v = t.weighted_sum(f, method.q[i], r, names), t.weighted_sum(f, method.v[i], r, names)
        slope = v * float(method.nodes[i]) if sum_q is None else f.fma(h, sum_q, v * float(method.nodes[i]))
        t.put(f, "X q", r, f.fma(h, slope, q))
        t.put(f, "X v", r, v if sum_v is None else f.fma(h, sum_v, v))


def check_pivots(t: Module, f: Function, s: Lane, name: str):
    """What becomes of accelerations whose pivots are too small to be trusted."""
    if not t.falls_back:
        return
    unsafe = (s.stepping > 0.5) & (s.safe < 0.5)
    with f.if_(f.any_of(unsafe)):
        f.choose(
            f.any_of(unsafe & (s.fallback > 0.5)),
            lambda: t.invoke(f, "accelerate_by_fallback", name),
            lambda: s.where(unsafe, ok=0.0),
        )


def estimate_errors(t: Module, f: Function, s: Lane, end: str | None, to_q: str, to_v: str):
    """Of q and v, from the accelerations of all stages; `end`: those at the end, where they are the last stage's."""
    h = t.broadcast(f, s.step)
    names = list(t.stage_accelerations)
    if t.method.ends and end:
        names[-1] = end
    saved, t.stage_accelerations = t.stage_accelerations, names
    with f.each(t.rowcount) as r:
        error_q, error_v = t.weighted_sum(f, t.method.error_q, r), t.weighted_sum(f, t.method.error_v, r)
        zero = f.const(0.0, DOUBLE, t.plan.vector)
        t.put(f, to_q, r, zero if error_q is None else h * (h * error_q))
        t.put(f, to_v, r, zero if error_v is None else h * error_v)
    t.stage_accelerations = saved
