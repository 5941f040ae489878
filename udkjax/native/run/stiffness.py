"""Stiff motions: the change of a run to an implicit method, and its return to the explicit one.

A module has one of these parts, or `StiffnessPart` if all its steps are explicit and no run leaves it:

    LeavingIfStiff     explicit steps; runs leave the module (module/leaving.py) where long implicit steps may be accurate
    ImplicitSteps      all steps by an implicit method
    ChosenSteps        explicit or implicit steps, chosen for each step in each lane

Numbers of a lane `s`: `speed` is the length of an explicit step times the largest rate of the equations; `trial` the length of an
implicit step that is tried next, or now; `stiff` tells whether the next step is implicit, or that the run leaves.
"""

from collections.abc import Callable, Iterator

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.text import apart
from udkjax.native.module import leaving
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import BeginMember, StiffnessPart
from udkjax.native.module.steps import (
    CORRECTION_COST,
    FACTORS,
    MEASURING_PERIOD,
    NODE_COUNT,
    PAYING_MARGIN,
    SLOPE_COST,
    SLOPE_COST_IN_LANES,
    STABILITY_LIMIT,
    STAGE_SHRINK,
    STIFF_LIMIT,
    UNPAID_STEPS,
)
from udkjax.native.module.tableau import Method
from udkjax.native.pseudoinverses.dense import DenseMatrices
from udkjax.native.run.runge_kutta import stage_state
from udkjax.native.run.stage_equations import StageEquations, StagesOfChosenSteps


def stiffness_of(module: Module, is_differentiated: bool) -> StiffnessPart:
    """Return the part for stiff motions that the plan of a module asks for.

    `is_differentiated`: True if the module computes derivatives, which need the matrix at solved stages.
    """
    plan = module.plan
    if plan.method.is_implicit:
        return ImplicitSteps(module, plan.method, is_differentiated)
    if plan.stiff is not None:
        return ChosenSteps(module, plan.stiff, is_differentiated)
    return LeavingIfStiff(module) if plan.leaves else StiffnessPart(plan)


class LeavingIfStiff(StiffnessPart):
    """Explicit steps alone: `speed` is measured now and then, and a run leaves the module when it exceeds `STIFF_LIMIT`."""

    pointers = leaving.GLOBALS

    def __init__(self, module: Module):
        super().__init__(module.plan)
        self._in = module

    def write_measurement(self):
        _write_measure_speed(self._in)

    def take_stages(self, f: Function, s: Lane, implicit: Value, explicit: Callable[[], None]):
        explicit()
        _watch_speed(self._in, f, s)

    def choose_next(self, f: Function, s: Lane, stepping: Value, accept: Value, implicit: Value, tries: Value | None):
        measured = accept & (s.begin < 0.5) & (s.tried > s.watch)
        with f.if_(f.any_of(measured)):
            s.where(measured, watch=s.tried + MEASURING_PERIOD)
            s.where(measured & (s.speed > STIFF_LIMIT), stiff=1.0)

    def begin_run(self, f: Function):
        leaving.go_on_if_loaded(f)

    def stays(self, f: Function, s: Lane, goes_on: Value, present: Callable[[], Value]) -> Value:
        return goes_on & ~f.any_of(present() & (s.stiff > 0.5))

    def if_leaving(self, do: Callable[[], None]):
        do()

    def end_run(self, f: Function, s: Lane, free: Callable[[], None]):
        module = self._in
        left = leaving.members_in_lanes(module, f, s, module.present(f, s))
        is_left = f.any_of(module.present(f, s) & (s.stiff > 0.5))
        module.release(f, s)
        free()
        with f.if_(is_left):
            leaving.go_on(module, f, left)

    def mark(self, text: str) -> str:
        return f"{apart(leaving.DIFFERENT_FUNCTIONS)}\n{text}"


class ImplicitSteps(StiffnessPart):
    """Steps by an implicit method alone."""

    stages: type[StageEquations] = StageEquations

    def __init__(self, module: Module, method: Method, is_differentiated: bool):
        """`is_differentiated`: True if the module computes derivatives, which need the matrix at solved stages."""
        super().__init__(module.plan)
        self._in, self.method, self._by, self._is_differentiated = module, method, method, is_differentiated

    def write(self):
        """Lay out and write the stage equations.

        They come after all else, so that all other functions are the same as in a module without implicit steps.
        """
        module = self._in
        self._equations, first = self.stages(module, self._by, self._is_differentiated), len(module.functions)
        self._equations.write()
        self._functions = {f.name for f in module.functions[first:]}

    def exact(self, f: Function) -> DenseMatrices:
        return self._equations.exact(f)

    def write_stages(self, start: str):
        self._equations.write_stages(start)

    def take_stages(self, f: Function, s: Lane, implicit: Value, explicit: Callable[[], None]):
        stepping = s.stepping
        self._take_explicit_stages(f, s, stepping, s.begin > -0.5, explicit)
        self._take_stages_in(f, s, stepping, implicit, lambda: f.call("take_stages_from_point3", f.given["work"]))
        s.stepping = stepping

    def _take_explicit_stages(self, f: Function, s: Lane, stepping: Value, mask: Value, explicit: Callable[[], None]):
        """Hook: take the explicit stages in lanes of `mask`. Does nothing here, as no step is explicit."""

    def _take_stages_in(self, f: Function, s: Lane, stepping: Value, mask: Value, take: Callable[[], None]):
        mask = (stepping > 0.5) & mask
        with f.if_(f.any_of(mask)):
            s.stepping = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
            take()

    def end_step(self, f: Function, s: Lane, implicit: Value):
        with f.if_(f.any_of(implicit)):
            self._in.copy(f, f"stage{self._by.stages - 1} a", "result a", implicit)

    def repeat_diverged(self, f: Function, s: Lane, implicit: Value):
        repeated = (FACTORS.safety / STAGE_SHRINK) ** self._by.order
        s.where(self._fails(s) & implicit & (s.stepping > 0.5), error=repeated)

    def _fails(self, s: Lane) -> Value:
        """Return the lanes whose implicit step has to be repeated."""
        return s.diverged > 0.5

    def cost(self, f: Function, s: Lane, implicit: Value, explicit: Value) -> Value:
        return f.select(implicit, s.iterations + 1.0, explicit)

    def choose_next(self, f: Function, s: Lane, stepping: Value, accept: Value, implicit: Value, tries: Value | None):
        s.where(accept & implicit, implicit=s.implicit + 1.0)

    def splits(self, s: Lane, splits: Value) -> Value:
        return splits & (s.stiff < 0.5)  # a step suffices for its outputs

    def begin_anew(self, f: Function, s: Lane) -> Value:
        return -s.stiff


class ChosenSteps(ImplicitSteps):
    """Explicit steps, and implicit ones where stability limits the length of explicit ones, as long as they pay."""

    entry = leaving.RESUME, ("call", "members")
    stages = StagesOfChosenSteps

    def write_measurement(self):
        _write_measure_speed(self._in)

    def methods(self, f: Function, s: Lane) -> Iterator[tuple[Method, Value | None]]:
        yield self._in.method, None
        mask = s.begin < -0.5
        with f.if_(f.any_of(mask)):
            yield self._by, mask

    def _take_explicit_stages(self, f: Function, s: Lane, stepping: Value, mask: Value, explicit: Callable[[], None]):
        def take():
            explicit()
            _watch_speed(self._in, f, s)

        self._take_stages_in(f, s, stepping, mask, take)

    def smooth_error(self, f: Function, s: Lane):
        with f.if_(f.any_of((s.stepping > 0.5) & (s.trial > 0.0))):
            f.call("smooth_error", f.given["work"])

    def _fails(self, s: Lane) -> Value:
        return super()._fails(s) | ((s.trial > 0.0) & ~(s.error < np.inf))

    def trials(self, s: Lane, stepping: Value) -> Value:
        return stepping & (s.trial > 0.0)

    def shift_points(self, f: Function, s: Lane, accept: Value):
        for k in range(NODE_COUNT - 1):
            s.where(accept, **{f"point{k}_solved": getattr(s, f"point{k + 1}_solved")})
        s.where(accept, point3_solved=f.max(-s.begin, 0.0))

    def return_to_point(self, s: Lane, mask: Value, k: int):
        s.where(mask, point3_solved=getattr(s, f"point{k}_solved"))

    def between_explicit(self, s: Lane, near: Value, k: int) -> Value:
        return near & (getattr(s, f"point{k}_solved") + getattr(s, f"point{k - 1}_solved") < 0.5)

    def choose_next(self, f: Function, s: Lane, stepping: Value, accept: Value, implicit: Value, tries: Value | None):
        super().choose_next(f, s, stepping, accept, implicit, tries)
        assert tries is not None
        implicit = stepping & (s.begin < -0.5)
        measured = accept & (s.begin < 0.5) & (s.begin > -0.5) & (s.tried > s.watch)
        with f.if_(f.any_of(measured | implicit)):
            length = STABILITY_LIMIT * self.gain  # length of a step that pays, times the largest rate
            s.where(accept & tries, stiff=1.0)
            pays = s.growth >= (self._by.diagonal * length) ** 2  # a lower bound: stiff dampers make the growth smaller
            s.where(implicit, unpaid=f.select(pays | tries, f.const(0.0, DOUBLE, f.width), s.unpaid + 1.0))
            returns = implicit & (s.unpaid >= UNPAID_STEPS)
            fails = returns | (tries & ~accept)
            s.where(returns, stiff=0.0, rate=np.inf)
            s.where(fails, patience=s.patience * 2.0)
            s.where(fails | measured, watch=s.tried + s.patience)
            is_near = measured & (s.speed > STIFF_LIMIT)
            trial = f.select(is_near, s.step * (length * PAYING_MARGIN) / f.select(is_near, s.speed, 1.0), 0.0)
            s.where(stepping, trial=trial)

    @property
    def gain(self) -> float:
        """The ratio of the length of an implicit step to that of an explicit one above which the implicit step pays."""
        module = self._in
        slopes = module.n * (SLOPE_COST_IN_LANES if module.plan.unrolled else SLOPE_COST)
        return (CORRECTION_COST * (self._by.stages - 1) + slopes) / module.method.stages

    # --- the end of the next step

    def plan_length(self, f: Function, s: Lane, begin: Value, start: Value, stop: Value) -> Value:
        h = s.h
        # A trial that has to end earlier would not show whether longer steps pay.
        is_late = begin | (start + s.trial >= f.min(stop, s.end) - s.smallest)
        s.trial = f.select(is_late, f.const(0.0, DOUBLE, f.width), s.trial)
        return f.select(s.trial > 0.0, s.trial, h)

    def splits(self, s: Lane, splits: Value) -> Value:
        return super().splits(s, splits) & (s.trial <= 0.0)

    def ends_at_output(self, f: Function, s: Lane, begin: Value, start: Value, t1: Value, stop: Value) -> Value:
        # A jump at the breakpoint beside a stiff damper is over at once, and its acceleration says nothing of states between
        # the ends of a step: the first outputs are ends of steps.
        is_output = (s.stiff > 0.5) & (s.trial <= 0.0) & (s.steps < float(NODE_COUNT - 1)) & ~begin
        return is_output & (s.next > start + s.smallest * 2.0) & (s.next < f.min(t1, stop) - s.smallest * 2.0)

    def next_begin(self, f: Function, s: Lane) -> Value:
        return f.select(s.trial > 0.0, -f.const(1.0, DOUBLE, f.width), -s.stiff)

    # --- the module that runs resume in

    def begin_members(self, f: Function, take: Callable[[], Value], begin: BeginMember, fill: Callable[[], None]):
        with f.each(f.width) as k:
            member = f.variable(f.load(f.given["members"], k, base=INT), INT, 1)
            with f.if_(member.value < 0):
                member.value = take()
            begin(k, member.value)

    def write_entries(self) -> list[Function]:
        run = Function("run", [(POINTER, "call")], self._in.plan.width)
        leaving.write_run(run)
        return [run]

    def mark(self, text: str) -> str:
        return f"{apart(self._functions | leaving.DIFFERENT_FUNCTIONS)}\n{text}"


def _watch_speed(module: Module, f: Function, s: Lane):
    """Set `speed` in lanes that are due to measure it in this attempt at an explicit step; set it to zero in others."""
    is_due = (s.stepping > 0.5) & (s.tried >= s.watch)
    s.speed = f.const(0.0, DOUBLE, f.width)
    with f.if_(f.any_of(is_due)):
        f.call("measure_speed", f.given["work"])
        s.where(~is_due, speed=0.0)


def _write_measure_speed(module: Module):
    """Write `measure_speed(work)`: compute `speed`, the length of an explicit step times the largest rate of the equations.

    The last two stages are both at the end of the step, and their states differ by errors in which the fastest motions dominate
    (Hairer and Wanner, IV.2). With J the Jacobian of (q, v) -> (v, a), the rate is the root of |J J x| / |x| for this difference
    x. This holds for motions that decay and for oscillations; of the latter, |J x| / |x| would depend on the phase.
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
