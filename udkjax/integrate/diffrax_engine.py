"""Integration by `diffrax.diffeqsolve`, with any of its solvers, adjoints and progress meters."""

from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.integrate.compiled_mechanism import eliminates
from udkjax.integrate.constrained import Constrained
from udkjax.integrate.drift import DriftController, max_rank
from udkjax.integrate.native_equations import equations_for_diffrax
from udkjax.integrate.outcome import status_at_end
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.integrate.projection import STATES_AT_ONCE, project, project_all, violation
from udkjax.integrate.solvers import is_explicit
from udkjax.integrate.solvers.counting import NOT_COUNTED, CountingController, evaluations
from udkjax.native.module.steps import FACTORS, Status
from udkjax.transforms.gradients import stop_gradients


def integrate_by_diffrax(
    problem: Problem, adjoint: diffrax.AbstractAdjoint | None = None, meter: diffrax.AbstractProgressMeter | None = None
) -> IntegratorOutput:
    """Integrate one problem with any diffrax solver (by default Dopri8) and adjoint (by default checkpoints for reverse mode)."""
    ts = _leave_breakpoints(problem)
    y0 = initial = jnp.concatenate([problem.q, problem.v])
    equations = equations_for_diffrax(problem)
    if problem.compiled.plan.projected:  # as machine code does, whose derivatives are combined with those of this engine
        y0 = project(equations, ts[0], y0)
    measures_drift = equations.constrained and not problem.compiled.plan.projected
    controller = CountingController(_given_controller(problem) or _controller(problem))
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(derivative),
        Constrained(problem.compiled.plan.solver or diffrax.Dopri8(), problem.compiled.plan.projected, problem.stabilization),
        t0=ts[0],
        t1=ts[-1],
        dt0=_first_step(problem, equations, y0) if problem.h is None else problem.h,
        y0=y0,
        args=equations,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)], controller_state=True),
        stepsize_controller=DriftController(controller, problem.drift_tol) if measures_drift else controller,
        adjoint=adjoint or diffrax.RecursiveCheckpointAdjoint(),
        max_steps=int(np.asarray(problem.max_steps)),  # the loops of diffrax need a concrete number
        progress_meter=meter or diffrax.NoProgressMeter(),
        throw=False,
    )
    saved: Any = (run.ys, run.ts)
    (ys, end), (_, t_end) = saved
    reached = ts <= t_end[0]
    later = reached & (jnp.arange(len(ts)) > 0)
    ys = jnp.where(later[:, None], ys, y0)  # a run without an accepted step has no saved states
    projected = project_all(equations, ts[1:], ys[1:]) if problem.compiled.plan.projected else ys[1:]
    ys = jnp.concatenate([initial[None], projected])
    violated = jax.lax.map(lambda x: violation(problem.equations, *x), (ts, ys), batch_size=STATES_AT_ONCE)
    first_drifted = jnp.min(jnp.where(reached & ~(violated <= problem.drift_tol), np.arange(float(len(ts))), np.inf))
    status = jnp.where(run.result == diffrax.RESULTS.max_steps_reached, Status.STEP_LIMIT, Status.STEP_TOO_SMALL)
    status = jnp.where(run.result == diffrax.RESULTS.successful, Status.DONE, status)
    status = status_at_end(problem.equations, ts[-1] - ts[0], status, t_end[0], end[0])
    equations = problem.equations
    if isinstance(equations, TextbookEquations) and equations.redundant != () and not eliminates(equations.method):
        # machine code looks after every step
        is_held = equations.rank(t_end[0], jnp.split(end[0], 2)[0]) > stop_gradients(max_rank(problem, equations))
        status = jnp.where(is_held & jnp.isfinite(problem.drift_tol), Status.SPURIOUS_RANK, status)
    if isinstance(equations, TextbookEquations) and problem.compiled.plan.projected:
        mean_step = (t_end[0] - ts[0]) / jnp.maximum(run.stats["num_accepted_steps"], 1)
        misses = reached & _misses_rows(problem, equations, ts, ys, mean_step)
        status = jnp.where(jnp.any(misses), Status.MISSING_RANK, status)
    controller_state: Any = run.controller_state
    if measures_drift:
        controller_state, drifted = controller_state.inner, controller_state.status
        status = jnp.where(drifted == Status.RUNNING, status, drifted)
    count = evaluations(controller_state)
    right_hand_sides = jnp.where(count == NOT_COUNTED, NOT_COUNTED, count + (problem.h is None))  # one chooses the step
    steps = run.stats["num_steps"], run.stats["num_accepted_steps"]
    q, v = jnp.split(ys, 2, axis=1)
    output = IntegratorOutput(q, v, reached, first_drifted, status, t_end[0], end[0], *steps, right_hand_sides, jnp.array(0))
    q, v = (jnp.where(output.kept[:, None], y, jnp.nan) for y in (q, v))
    return output._replace(q=q, v=v)


def _misses_rows(problem: Problem, equations: TextbookEquations, ts: Array, ys: Array, step: Array) -> Bool[Array, "T"]:
    """Return a mask of the outputs at which the velocities would open Psi too far within a step of the length `step` (s).

    Projected velocities do so if independent rows were left out. Machine code applies the same rule at the end of each step. The
    first output, the given state, is never marked, since its velocities were not projected.
    """

    def misses(at: tuple[Array, Array]) -> Array:
        t, y = stop_gradients(at)
        rate = equations.violation_size(equations.violation(t, *jnp.split(y, 2))[1])
        return rate * step > jnp.maximum(problem.drift_tol, problem.rtol + problem.atol)

    return jax.lax.map(misses, (ts, ys), batch_size=STATES_AT_ONCE) & (np.arange(len(ts)) > 0)


def _leave_breakpoints(problem: Problem) -> Float[Array, "T"]:
    """Return the times of a run; a first or last time at a breakpoint is moved just inside the run.

    A breakpoint closer than the smallest step counts as equal, since no step is that short.
    """
    ts, breakpoints = problem.ts, problem.compiled.breakpoints
    if breakpoints is None:
        return ts
    inf, is_near = np.inf, lambda t: jnp.abs(breakpoints - t) <= problem.smallest
    start = jnp.max(jnp.where(is_near(ts[0]), jnp.nextafter(breakpoints, inf), -inf), initial=-inf)
    end = jnp.min(jnp.where(is_near(ts[-1]), jnp.nextafter(breakpoints, -inf), inf), initial=inf)
    return ts + stop_gradients(jnp.clip(ts, start, end) - ts)


def derivative(t: Float[ArrayLike, ""], y: Float[Array, "2n"], equations: AbstractSystem) -> Float[Array, "2n"]:
    """Return the time derivative of y = (q, v): (v, a), or the rates that the equations have integrated instead."""
    return jnp.concatenate(equations.rates(t, *jnp.split(y, 2)))


def _first_step(problem: Problem, equations: AbstractSystem, y0: Array) -> Array:
    ts, unit = problem.ts, jnp.concatenate(problem.units())
    return first_step(
        y0, derivative(ts[0], stop_gradients(y0), stop_gradients(equations)), ts[-1] - ts[0], problem.rtol, problem.atol, unit
    )


def first_step(y: Array, slope: Array, span: Array, rtol: Array, atol: Array, unit: Array) -> Array:
    """Return a step over which the state y (n,), with this slope, changes by a hundredth of itself or, if more, of its unit.

    As in Hairer, Norsett, Wanner, II.4, without the second evaluation: the controller corrects the step. The `unit`, in which
    `atol` is given, is needed for states that are zero, exactly or up to rounding.
    """
    y, slope, span, rtol, atol, unit = stop_gradients((y, slope, span, rtol, atol, unit))
    scale = atol * unit + rtol * jnp.abs(y)
    size = jnp.max(jnp.maximum(jnp.abs(y), unit) / scale, initial=0.0)
    rate = jnp.max(jnp.abs(slope) / scale, initial=0.0)
    ordinary = jnp.isfinite(rate) & (rate > 0)
    return jnp.where(ordinary, jnp.minimum(0.01 * size / jnp.where(ordinary, rate, 1.0), span), 1e-4 * span)


def _controller(problem: Problem) -> diffrax.AbstractStepSizeController:
    # Every coordinate and velocity must meet its tolerance; a mean over a large mechanism would hide large errors of a few.
    settings: dict[str, Any] = {"norm": optx.max_norm, "dtmin": problem.smallest, "force_dtmin": False}
    if is_explicit(problem.compiled.plan.solver):  # the same steps as by machine code
        settings |= {"safety": FACTORS.safety, "factormin": FACTORS.shrink, "factormax": FACTORS.grow}
    tolerances: dict[str, Any] = {"rtol": problem.rtol, "atol": problem.atol * jnp.concatenate(problem.units())}
    if problem.compiled.breakpoints is None:
        return diffrax.PIDController(**tolerances, **settings)
    return diffrax.ClipStepSizeController(_FrozenSteps(**tolerances, **settings), jump_ts=problem.compiled.breakpoints)


def _given_controller(problem: Problem) -> diffrax.AbstractStepSizeController | None:
    """Return the step size controller that was given, None if there is none.

    An adaptive one also steps to breakpoints; one without tolerances gets those of the run, which root finders need.
    """
    given, breakpoints = problem.stepper, problem.compiled.breakpoints
    if given is not None and not isinstance(given, diffrax.AbstractAdaptiveStepSizeController):
        return _WithTolerances(
            controller=given, rtol=problem.rtol, atol=problem.atol * jnp.concatenate(problem.units()), norm=optx.max_norm
        )
    if given is None or breakpoints is None:
        return given
    return diffrax.ClipStepSizeController(given, jump_ts=breakpoints)


class _WithTolerances(diffrax.AbstractAdaptiveStepSizeController):
    """A step size controller that has no tolerances, such as `ConstantStepSize`, with tolerances for root finders of solvers."""

    controller: diffrax.AbstractStepSizeController
    rtol: Array
    atol: Array
    norm: Callable[[Any], Any]

    def wrap(self, direction: Any) -> "_WithTolerances":
        return _WithTolerances(controller=self.controller.wrap(direction), rtol=self.rtol, atol=self.atol, norm=self.norm)

    def init(self, *args: Any, **kwargs: Any) -> Any:
        return self.controller.init(*args, **kwargs)

    def adapt_step_size(self, *args: Any, **kwargs: Any) -> Any:
        return self.controller.adapt_step_size(*args, **kwargs)


class _FrozenSteps(diffrax.PIDController):
    """A step controller whose steps have no derivatives.

    Each step depends on the previous one. After a step that a breakpoint has shortened, the following steps grow by factors of up
    to ten, and their derivatives with respect to the shortened step would grow equally fast.
    """

    def adapt_step_size(self, *args: Any, **kwargs: Any) -> Any:
        keep, t0, t1, *rest = super().adapt_step_size(*args, **kwargs)
        return keep, t0, t0 + stop_gradients(t1 - t0), *rest
