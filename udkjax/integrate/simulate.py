"""Simulate: from a mechanism and output times to a trajectory."""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import COUNT, NOT_NEGATIVE, OUTPUT_TIMES, POSITIVE, POSITIVE_OR_INFINITE
from udkjax.arrays import float_type, is_traced, is_within_jit, make_module, number, put_arrays, without_derivatives
from udkjax.devices import on_host
from udkjax.equations.laws.formulations import Formulation
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis, analysis_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.causes.find import explained
from udkjax.integrate.compiled_mechanism import compile_concrete, compile_mechanism
from udkjax.integrate.derivatives import differentiable, integrate_by_diffrax
from udkjax.integrate.native_engine import integrate_concrete
from udkjax.integrate.outcome import LEAST_ATOL, FinishedRun, counts, outcome
from udkjax.integrate.prepare import (
    AUTO,
    DRIFT_FREE,
    DRIFT_PROJECTED,
    Choices,
    PreparedRun,
    begin,
    begin_concrete,
    jax_adjoint,
    may_stick,
    prepare_run,
    progress_meter,
    with_held_pins,
    with_kinks,
)
from udkjax.integrate.problem import IntegratorOutput
from udkjax.integrate.projection import Projection
from udkjax.integrate.solution import SUCCESSES, Result, SimulationError, Solution
from udkjax.integrate.solvers.diffrax_arguments import ADJOINT, CONTROLLER, SOLVER
from udkjax.integrate.stabilization import Stabilization
from udkjax.pinv import Pseudoinverse
from udkjax.positions.assembling.assembly import AssemblyWarning, Closure, State, close, require_closed
from udkjax.programs.deferred import deferred
from udkjax.requirements import ArgumentError
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.transforms.gradients import stop_gradients

if TYPE_CHECKING:
    import diffrax

MAX_STEPS = 100_000  # default; at a few microseconds per step, a small scene that gets stuck ends within a second
MAX_EVENTS, MAX_EVENTS_STICKING = 64, 256  # defaults, without and with joints that stick; also the length of the arrays of events


@checked
def simulate(
    mechanism: Mechanism | ConstrainedSystem,
    ts: Annotated[Numbers | Sequence[float], OUTPUT_TIMES],
    state: State | Closure | None = None,
    rtol: Annotated[NumberLike, NOT_NEGATIVE] = 1e-8,
    atol: Annotated[NumberLike, NOT_NEGATIVE] = 1e-8,
    method: Pseudoinverse | None = None,
    stabilization: Projection | Baumgarte | Stabilization | None = Projection(),
    solver: Annotated["diffrax.AbstractSolver", SOLVER] | None = None,
    adjoint: Annotated["diffrax.AbstractAdjoint", ADJOINT] | None = None,
    max_steps: Annotated[int, COUNT] = MAX_STEPS,
    drift_tol: Annotated[NumberLike, POSITIVE_OR_INFINITE] | None = None,
    dt0: Annotated[NumberLike, POSITIVE] | None = None,
    formulation: Formulation | None = None,
    throw: bool = True,
    progress: Any = None,
    analysis: Analysis | None = None,
    engine: Literal["auto", "native", "diffrax", "jax"] = "auto",
    events: Any = None,
    max_events: Annotated[int, COUNT] | None = None,
    stepsize_controller: Annotated["diffrax.AbstractStepSizeController", CONTROLLER] | None = None,
) -> Solution:
    """Integrate the equations of motion q'' = a(t, q, q') of a mechanism; return its states at output times.

    All numbers may be traced: one compilation serves all values of parameters, tolerances, gains and output times, under jit and
    vmap as well. The result has derivatives of any order, forward and reverse; second and higher ones take as long as a hundred
    runs, and minutes to compile.

    A violation of Psi above `drift_tol` at an output time ends the solution there. Machine code also ends a run if the violation
    after the projection of a step exceeds the largest of `drift_tol`, a hundred tolerances and the threshold of pivots, or 0.01
    (relative to L, or rad). Where rows become dependent, a run that is not projected may lose its energy or change its branch: it
    ends as `singular` at a step whose violation of Psi exceeds `drift_tol` d^2, where d is the distance of the farther end of the
    step from such a configuration, relative to the largest distance in the run. Where rows depend on others along the whole
    motion, a run whose method finds a larger rank ends as `spurious_rank`. Where a method leaves out rows that are independent, a
    projected run ends as `missing_rank` as soon as a step with such velocities opens Psi by more than `drift_tol` and more than
    the tolerance. Machine code checks this after each step, other solvers at outputs or at the end. With an infinite `drift_tol`
    none of these rules ends a run.

    Args:
        mechanism: the mechanism, or a `ConstrainedSystem`.
        ts: output times (T,) in s, increasing; the motion starts at ts[0].
        state: the initial `State`, used as given, or the `Closure` of an assembly. By default the scene's guess is assembled, or
            q0 and v0 of a `ConstrainedSystem`.
        rtol: relative tolerance of every coordinate and velocity. The sizes of steps are not differentiated, so there
            are no derivatives with respect to tolerances or `dt0`.
        atol: tolerance relative to the mechanism's own scales: x may err by rtol |x| + atol L, an angle by rtol |angle| + atol,
            and a rate by the same over T, with L the characteristic length (`analyse`) and T the shortest of the characteristic
            time, the time in which the initial velocities move the mechanism by L, and the span of `ts`. Equal tolerances thus
            mean equal accuracy at any scale. L = T = 1 for a `ConstrainedSystem`.
        method: the pseudoinverse; by default `Auto()`.
        stabilization: `Projection()`, a `Baumgarte`, a `Stabilization` of your own, or None.
        solver: any diffrax solver for ordinary differential equations; by default Dopri8, the fastest at equal error in
            benchmarks/, except for the tightest tolerances through singular configurations. Where a stiff force, not the
            tolerance, would limit its steps, machine code goes on with Kvaerno5, and returns where that does not pay:
            `Solution.stats["implicit"]` counts these steps.
        adjoint: an adjoint of diffrax; by default JAX differentiates the run.
        max_steps: the largest number of steps tried.
        drift_tol: the largest violation of Psi, relative to L or in rad.
        dt0: the first step tried (s); by default chosen automatically.
        formulation: the equations for accelerations, other than that of Udwadia and Kalaba: `Augmented`, `NullSpaceQR`,
            `NullSpaceSVD` or `CoordinatePartitioning`; `method` is then used for projection and derivatives only.
        throw: whether a run that does not reach its end raises; a traced run never does.
        progress: True prints the progress of the run; a progress meter of diffrax is used as it is.
        analysis: the mechanism's `Analysis`; by default computed here.
        engine: "native" is machine code generated from the scene's expressions, on the CPU: Runge-Kutta methods, explicit or
            singly diagonally implicit, under vmap in lanes that step independently. "diffrax" is `diffrax.diffeqsolve`: every
            solver, adjoint, progress meter and method; machine code evaluates the equations where possible. "jax" is
            "diffrax" with equations in plain JAX, on every device. "auto" uses machine code where possible;
            `Solution.settings` names the engine and the reason.
        events: actions where conditions cross zero: an `Event`, `JointLimit` or `Contact`, or several, in a list or by name, with
            the actions `Stop`, `Log`, `Impact`, `Release`, `Attach` and `Lock`. Events are located to machine precision,
            independently of `ts`, and the run restarts after each; contacts that act on one another are hit together. Both
            engines support events, also in batches, where each member has its own events. Such runs have first derivatives,
            forward and reverse, which include the changes of event times (saltation), but no derivatives with respect to `ts`;
            with only `Log` and `Stop` they also have second derivatives. Jumps and kinks of user-defined forces (`where`, `max`,
            `abs`, `floor` of the state) are located in the same way, without being listed; `Solution.unlocated` is the time from
            which they are not located.
        max_events: the largest number of events; by default 64, and 256 with friction by which joints stick.
        stepsize_controller: a step size controller of diffrax, for constant steps `diffrax.ConstantStepSize()` with `dt0`; by
            default a controller of every coordinate and velocity, by rtol and atol.

    Returns:
        A `Solution` with q and v (T, bodies, 3): x, y in m and angle in rad, and their rates. `Solution.result` is the
        way in which the run ended, and `Solution.events` has the times of events with the states before and after; an output at
        the time of an event is the state after the event.

    Raises:
        SimulationError: the run does not reach its end; the error carries the solution.
        AssemblyError: the initial guess cannot be closed.
        ArgumentError: the tolerances are below rounding.
        ValueError: an argument is invalid, or the requested engine cannot integrate the mechanism.

    Source:
        D. de Falco, E. Pennestri, L. Vita, The Udwadia-Kalaba formulation, ECCOMAS Multibody Dynamics 2005.
    """
    ts = jnp.asarray(ts) if is_traced(ts) else ts  # also a list with tracers
    if not isinstance(rtol, Tracer) and not isinstance(atol, Tracer) and np.asarray(rtol) + np.asarray(atol) < LEAST_ATOL:
        raise ArgumentError(
            f"rtol = {rtol:g} and atol = {atol:g} are below rounding errors, and no step can meet them: raise one of them"
        )
    if state is None and not mechanism.has_bodies:
        times: Any = ts
        state = close(mechanism, times[0])
    if drift_tol is None:
        drift_tol = DRIFT_PROJECTED if isinstance(stabilization, Projection) else DRIFT_FREE
    choices = Choices(
        rtol=rtol,
        atol=atol,
        drift_tol=drift_tol,
        dt0=dt0,
        method=AUTO if method is None else method,
        stabilization=stabilization,
        formulation=formulation,
        solver=solver,
        adjoint=None if adjoint is None else jax_adjoint(adjoint),
        meter=None if progress is None else progress_meter(progress),
        max_steps=max_steps,
        engine=engine,
        stepper=stepsize_controller,
    )
    mechanism, analysis, choices = with_held_pins(mechanism, events, analysis, choices)
    system: Any = mechanism if mechanism.has_bodies else mechanism.traced(math.prod(mechanism.state_shape(state)))
    is_concrete = system.has_programs and system.is_concrete
    state, closure = (None, state) if isinstance(state, Closure) else (state, None)
    all_concrete = is_concrete and not is_traced((ts, analysis, state, closure, choices))
    start = ts[0] if isinstance(ts, Tracer) else np.asarray(ts)[0]
    begun = (begin_concrete if all_concrete else begin)(mechanism, start, analysis, state, closure)
    analysis, closure = begun.analysis, begun.closure
    if begun.moves:
        warnings.warn(begun.moves, AssemblyWarning, stacklevel=3)
    if throw and closure is not None and begun.is_open:
        require_closed(mechanism, closure, start)  # before anything runs

    choices, locates_kinks = with_kinks(system, choices)
    run = _Run(mechanism, system, analysis, ts, state, closure, choices, is_concrete, all_concrete, may_stick(mechanism))
    if events is not None or locates_kinks or run.sticks:
        found = _with_events(run, events, max_events)
        if not (locates_kinks and _has_failed(found.code) and events is None and is_concrete and not run.sticks):
            return _required(found, throw)
        return _without_events(run, throw, found)  # perhaps it succeeds where kinks are not located
    return _without_events(run, throw)


class _Run(NamedTuple):
    """A run that is about to begin."""

    mechanism: Mechanism | ConstrainedSystem
    system: Any  # the mechanism, or a traced system
    analysis: Analysis | None
    ts: Any
    state: State | None
    closure: Closure | None
    choices: Choices
    is_concrete: bool  # whether all numbers of the mechanism are concrete
    all_concrete: bool  # whether all other numbers of the run are concrete, too
    sticks: bool  # whether friction may hold a joint

    def explained(self, solution: Solution, end: Any) -> Solution:
        """Return a failed solution with its cause, found from `end`, the last time and state (t, y) of the integrator.

        A system that could not be closed is explained by its initial guess.
        """
        q, v = self.mechanism.q0, self.mechanism.v0
        if self.analysis is None and q is not None and v is not None and int(solution.code) == Result.could_not_assemble:
            end = self.ts[0], np.concatenate([q, v])
        return explained(solution, self.mechanism, self.analysis, self.choices.drift_tol, self.choices.solver, end)


def _with_events(run: _Run, events: Any, max_events: int | None) -> Solution:
    """Return the solution of a run that locates events, kinks of forces, and the sticking of joints."""
    if without := run.choices.without_events:
        raise ValueError(f"a run with events needs JAX's own derivatives, its own steps and no progress meter: not {without}")
    # The times of events are located to 1e-9 T, far below the rounding of a time in float32.
    is_located = events is not None or run.sticks or not run.system.has_programs
    if is_located and float_type() != np.float64:
        raise ValueError("events and joints that stick need float64, which is off in JAX: leave JAX_ENABLE_X64 unset")
    from udkjax.integrate.events.simulate_events import simulate_events  # imports a dozen modules that other runs do not need

    most = (MAX_EVENTS_STICKING if run.sticks else MAX_EVENTS) if max_events is None else max_events
    given = run.analysis, run.ts, run.state, run.closure, run.choices
    solution, end = simulate_events(run.system, events, *given, most, run.all_concrete)
    if not run.is_concrete or not _has_failed(solution.code):
        return solution
    if events is not None and (not run.mechanism.has_bodies or _may_move_otherwise(solution)):
        return solution
    return run.explained(solution, end) if events is not None or run.sticks else solution


def _may_move_otherwise(solution: Solution) -> bool:
    """Return True if constraints at the end of a run may differ from those of the scene, apart from locks of sticking joints."""
    changes, found = solution.scene_changes, solution.events
    if changes is None or found is None or not int(found.count):
        return False
    last = int(np.isfinite(np.asarray(solution.q)).all((1, 2)).sum()) - 1
    of_scene = np.arange(changes.holds.shape[1]) < changes.scene_constraint_count
    is_late = np.asarray(found.time) > solution.ts[max(last, 0)]
    return last < 0 or bool(is_late.any() or (np.asarray(changes.holds)[last] != of_scene).any())


def _without_events(run: _Run, throw: bool, located: Solution | None = None) -> Solution:
    """Return the solution of a run that locates no events; if it fails and `throw` is set, raise its error.

    `located` is the failed solution of the same run with its kinks located, if there was such a run. If both fail, `located` is
    returned, or its error raised; else its last time becomes `Solution.unlocated`.
    """
    solution, missed, end, code = _integrate(run)
    if throw and not run.is_concrete and run.mechanism.has_bodies and _has_failed(code):
        given = solution if located is None else located, run.mechanism, run.analysis, run.choices.drift_tol, end
        if not is_traced(found := without_derivatives(given)):  # as in a call of `jax.grad`
            failed, mechanism, analysis, tol, last = found
            return _required(explained(failed, mechanism, analysis, tol, run.choices.solver, last), throw)
    if not run.is_concrete or isinstance(solution.code, Tracer):
        solution = solution if located is None else dataclasses.replace(solution, unlocated=located.time)
        return solution if isinstance(code, Tracer) else _required(solution, throw)
    if missed:  # with the numbers of the given analysis more rows were redundant
        run = run._replace(analysis=analysis_of(run.mechanism))
        solution, _, end, code = _integrate(run)
    if int(code) in SUCCESSES:
        return solution if located is None else dataclasses.replace(solution, unlocated=located.time)
    return _required(run.explained(solution if located is None else located, end), throw)


def _has_failed(code: Any) -> bool:
    """Return True if `code` is the concrete `Result` of a single run that has not reached its end; False if it is traced."""
    return not isinstance(code, Tracer) and int(code) not in SUCCESSES


def _required(solution: Solution, throw: bool) -> Solution:
    """Return a solution; if it is that of a failed run and `throw` is set, raise `SimulationError`.

    The error carries the solution without derivatives. In a program, where numbers are traced, nothing is raised.
    """
    if throw and _has_failed(solution.code) and not is_traced(found := without_derivatives(solution)):
        raise SimulationError(found.cause, found)
    return solution


def _integrate(run: _Run) -> tuple[Solution, Any, Any, Any]:
    """Return the solution, whether rows left out as redundant are independent, the last time and state (t, y), and the `Result`.

    The `Result` is a NumPy number if machine code is called by NumPy: reading it from a solution on a graphics card takes long.
    With concrete numbers NumPy calls machine code directly; everything else is traced.
    """
    _, system, analysis, ts, state, closure, choices, _, all_concrete, _ = run
    if all_concrete:
        with jax.ensure_compile_time_eval():  # concrete even while something else is traced
            compiled = compile_concrete(system, analysis, *choices.of_mechanism)
            if compiled.plan.is_native:
                prepared = prepare_run(compiled, analysis, np.asarray(ts, float), state, closure, choices, np)
                return _finish(prepared, integrate_concrete(prepared.problem), system.body_names, choices, np)
    arguments = system.without_origin, analysis, number(ts), state, closure, choices.arrays(), not is_traced(ts)
    if is_within_jit():  # concrete numbers become tracers, too
        return _simulate(*arguments)
    # Runs by diffrax are compiled at once: each step has hundreds of operations.
    return (_compiled if choices.take_diffrax or not system.has_programs else _deferred)(*arguments)


def _simulate(
    system: Any,
    analysis: Analysis | None,
    ts: Array,
    state: State | None,
    closure: Closure | None,
    choices: Choices,
    has_fixed_times: bool,
) -> tuple[Solution, Any, Any, Any]:
    compiled = compile_mechanism(system, analysis, *choices.of_mechanism)
    run = prepare_run(compiled, analysis, ts, state, closure, choices)
    if choices.adjoint is not None or choices.meter is not None:
        raw = integrate_by_diffrax(run.problem, choices.adjoint, choices.meter)
    else:
        raw = differentiable(run.problem, has_fixed_times)
    return _finish(run, raw, system.body_names, choices)


_compiled, _deferred = on_host(eqx.filter_jit(_simulate)), deferred(_simulate)


def _finish(
    run: PreparedRun, raw: IntegratorOutput, bodies: tuple[str, ...], choices: Choices, xp: ModuleType = jnp
) -> tuple[Solution, Any, Any, Any]:
    """Return the results of `_integrate`, from the output of the integrator."""
    problem, ts = run.problem, run.ts
    ending = FinishedRun(raw, ts, run.is_usable, run.is_closed, run.has_missed_rows)
    code, time = outcome(ending if xp is np else stop_gradients(ending), xp)
    q, v = (y.reshape(-1, *run.state_shape) for y in (raw.q, raw.v))
    stats = counts(raw, problem.compiled.plan.projected, len(ts), xp)
    rtol, atol = xp.asarray(choices.rtol, float), xp.asarray(choices.atol, float)
    code_found = code
    if xp is np:
        ts, q, v, code, time, stats, rtol, atol = put_arrays((ts, q, v, code, time, stats, rtol, atol))
    names = choices.settings(problem.compiled.plan.why_not_native)
    solution = make_module(
        Solution,
        ts=ts,
        q=q,
        v=v,
        code=code,
        time=time,
        stats=stats,
        rtol=rtol,
        atol=atol,
        bodies=bodies,
        choices=names,
        events=None,
        found_cause=None,
    )
    return solution, run.has_missed_rows, (raw.t, raw.y), code_found
