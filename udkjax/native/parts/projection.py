"""States at the ends of steps and at outputs: projected onto the constraints, or left as the method computes them."""

import numpy as np

from udkjax.native.language.ir import DOUBLE, Function, Value, Variable
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import ProjectionPart
from udkjax.native.module.steps import CLOSED_TOL, LOST_TOL, OUTPUT_STEPS, ROUNDING_PIVOT, SINGLE_STEP_TOL, Status
from udkjax.native.parts.elimination import EliminatedAccelerations
from udkjax.native.parts.manifold import iterate_newton, largest_violation, newton, take_newton_step, with_threshold
from udkjax.pinv.auto import NEAR_SHARE


class Unprojected(ProjectionPart):
    """No projection: states remain as the method computes them, and runs end that drift too far from the constraints."""

    def __init__(self, module: Module, accelerations: EliminatedAccelerations):
        self._in, self._accelerations = module, accelerations
        self.programs = [accelerations.measured] if module.m else []

    @property
    def solving(self) -> list[str]:
        return ["accelerations"]

    def end_step(self, f: Function, s: Lane):
        self.accelerate_end(f, s)
        estimate_errors(self._in, f, s, "result a", "result dq", "result dv")
        for d in ("dq", "dv"):
            self._in.copy(f, f"result {d}", f"state {d}")

    def accelerate_end(self, f: Function, s: Lane):
        """Compute `result a`, the accelerations at the end of a step; `result v` becomes `state v`."""
        module, accelerations = self._in, self._accelerations
        if module.m:
            accelerations.accelerate_and_measure(f)
        else:
            accelerations.accelerate(f, "result a")
        accelerations.check_pivots(f, s, "result a")
        with f.each(module.rowcount) as r:
            module.put(f, "result v", r, module.vector(f, "state v", r))

    def project_output(self, f: Function, s: Lane, mask: Value):
        module = self._in
        module.invoke(f, "psi")
        with f.each(module.rowcount) as r:
            module.put(f, "result v", r, module.vector(f, "state v", r))
        s.violated = largest_violation(module, f)

    def drift(self, f: Function) -> Value | None:
        return largest_violation(self._in, f) if self._in.m else None

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        if self._in.m:
            lost.value = self._drifted(f, s, accept)

    def _drifted(self, f: Function, s: Lane, accept: Value) -> Value:
        """Return the status `LOST` or `SINGULAR` in lanes whose new point has drifted too far from the constraints, else zero.

        Where the distance from singular configurations is d, a violation x of Psi moves the state by x / d and turns its velocity
        by x / d^2: near the intersection of two branches, the curves of constant Psi are hyperbolas, and lead from one branch to
        the other. Therefore the bound of x is `drift_tol` times d^2 max(d, NEAR_SHARE), with d relative to the largest distance
        of the run. Steps that are short compared to d follow such a curve, while a longer step passes the configuration: d is the
        distance of that end of the step which is farther from it, and at least the distance below which the method leaves rows
        out.
        """
        module = self._in
        nearest = module.accelerations.nearest(f, s)
        s.where(accept, farthest=f.max(s.farthest, s.distance))
        farther = f.max(s.distance, f.select(s.distance1 < np.inf, s.distance1, 0.0))
        nearness = f.max(farther, nearest) / f.max(s.farthest, nearest)
        violated, status = largest_violation(module, f), lambda code: f.const(float(code), DOUBLE, f.width)
        is_turned = accept & (violated > s.drift_tol * (nearness * nearness * f.max(nearness, NEAR_SHARE)))
        return f.select(is_turned, f.select(violated > s.drift_tol, status(Status.LOST), status(Status.SINGULAR)), 0.0)


class Projected(ProjectionPart):
    """Projection of the ends of steps, and of outputs, by Newton's method."""

    def __init__(self, module: Module):
        self._in = module
        self._drops_rows = (
            module.m > 0 and not module.code.policy.reports
        )  # dependent rows are left out without a check of their pivots
        self.shared = ("velocities",) if self._drops_rows else ()

    @property
    def solving(self) -> list[str]:
        of_step = ["project_and_accelerate", "tangent_part"] if self._in.method.ends else ["end_of_step"]
        return ["accelerations", "newton_q", *of_step, "newton_v_and_psi", "project"]

    @property
    def checks(self) -> list[str]:
        return ["psi_dot"] if self._drops_rows else []

    def end_step(self, f: Function, s: Lane):
        module, method = self._in, self._in.method
        if not method.ends:
            estimate_errors(module, f, s, None, "state dq", "state dv")
        newton(module, f, s)
        module.invoke(f, "project_and_accelerate" if method.ends else "end_of_step")
        module.accelerations.accelerate_end(f)
        unsafe = (s.stepping > 0.5) & (s.safe < 0.5)
        module.fallback.note_unsafe(s, unsafe)
        if method.ends:
            estimate_errors(module, f, s, "result a", "state dq", "state dv")
            threshold = f.const(ROUNDING_PIVOT, DOUBLE, f.width)
            with_threshold(f, module.drop_tol_place, threshold, lambda: module.invoke(f, "tangent_part"))
        module.fallback.finish_step(f, s)

    def project_output(self, f: Function, s: Lane, mask: Value):
        module = self._in

        def iterate(lanes: Value):
            iterate_newton(module, f, s, lanes, lambda _: module.invoke(f, "newton_q"), OUTPUT_STEPS)
            module.invoke(f, "newton_v_and_psi")

        def project():
            module.invoke(f, "project")
            s.violated = largest_violation(module, f)
            is_far = mask & ~(take_newton_step(module, f, mask) <= SINGLE_STEP_TOL)
            with f.if_(f.any_of(is_far)):
                with f.each(module.rowcount) as r:  # other lanes keep their states
                    module.put(f, "result dv", r, module.vector(f, "result v", r))
                iterate(is_far)
                with f.each(module.rowcount) as r:
                    new, old = (module.vector(f, x, r) for x in ("result v", "result dv"))
                    module.put(f, "result v", r, f.select(is_far, new, old))
                s.where(is_far, violated=largest_violation(module, f))
            module.fallback.close_output(f, s, mask)

        module.fallback.keeping_rows(f, project)

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        module = self._in
        if module.m:
            lost.value = lost_in(module, f, s, accept)
        if self._drops_rows:
            misses = accept & lost.value.is_(0.0) & self._misses_rows(f, s)
            lost.value = f.select(misses, f.const(Status.MISSING_RANK, DOUBLE, f.width), lost.value)

    def _misses_rows(self, f: Function, s: Lane) -> Value:
        """Return the lanes in which the projected velocities of the new point violate Psi_dot too much.

        They do so if, at this rate, Psi would exceed its bound in a step of the same length. Psi_dot is linear in the velocities:
        a row stays violated only if it was left out as dependent although it is independent. The motion then has more freedom
        than the mechanism, and projection would undo a part of the motion as soon as the row is used again.
        """
        module = self._in
        module.copy(f, "state v", "saved v")
        module.copy(f, "result v", "state v")
        module.invoke(f, "psi_dot")
        module.copy(f, "saved v", "state v")
        return largest_violation(module, f) * s.step > f.max(s.drift_tol, s.rtol + s.atol)


def lost_in(module: Module, f: Function, s: Lane, accept: Value) -> Value:
    """Return the status `LOST` in lanes whose new point violates Psi too much despite its projection, else zero."""
    module.invoke(f, "psi")
    bound = f.min(f.const(LOST_TOL, DOUBLE, f.width), f.max(s.open_tol, (s.rtol + s.atol) * CLOSED_TOL))
    is_lost = accept & (largest_violation(module, f) > bound)
    return f.select(is_lost, f.const(Status.LOST, DOUBLE, f.width), 0.0)


def estimate_errors(module: Module, f: Function, s: Lane, end: str | None, to_q: str, to_v: str):
    """Estimate the errors of a step in q and v from the accelerations of its stages.

    Args:
        module: The module.
        f: The function to which the code is added.
        s: The numbers of its lanes.
        end: The array of the accelerations at the end of the step, for methods whose last stage is there; None: the array of the
            last stage.
        to_q: The array that receives the errors of q.
        to_v: The array that receives the errors of v.
    """
    h, zero = module.broadcast(f, s.step), f.const(0.0, DOUBLE, module.plan.vector)
    for method, mask in module.stiffness.methods(f, s):
        names = list(module.stage_accelerations)
        if method.ends and end:
            names[-1] = end
        with f.each(module.rowcount) as r:
            error_q, error_v = (module.weighted_sum(f, weights, r, names) for weights in (method.error_q, method.error_v))
            new_q = zero if error_q is None else h * (h * error_q)
            slips = module.weighted_sum(f, method.error_v, r, module.stage_slips) if module.stage_slips else None
            new_q = new_q if slips is None else f.fma(h, slips, new_q)
            for to, new in ((to_q, new_q), (to_v, zero if error_v is None else h * error_v)):
                module.put(f, to, r, new if mask is None else f.select(mask, new, module.vector(f, to, r)))
    module.stiffness.smooth_error(f, s)
