"""Simulate: from a mechanism and output times to a trajectory."""

import warnings
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from udkjax.annotations import Numbers, Scalar
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.formulations import Formulation
from udkjax.equations.general import ConstrainedSystem
from udkjax.equations.partitioning import PartitionedSystem
from udkjax.equations.quantities import equations_of
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate.assembly import Closure, State, close, require_closed
from udkjax.integrate.assembly_moves import warn_of_moves
from udkjax.integrate.causes.explained import explained
from udkjax.integrate.derivatives import differentiable
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.native_engine import independent_row_count, integrate_known, reason_for_diffrax
from udkjax.integrate.outcome import Run, counts, increases, outcome, usable
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import Projection
from udkjax.integrate.solution import SimulationError, Solution
from udkjax.native.steps import LEAST_ATOL, SMALLEST_STEP
from udkjax.pinv import Auto, Pseudoinverse
from udkjax.scene.arguments import checked
from udkjax.scene.checks import traced_numbers_hold
from udkjax.scene.fields import number, optional_number
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.requirements import ArgumentError, ArgumentTypeError, describe, require_output_times

if TYPE_CHECKING:
    import diffrax

MAX_STEPS = 100_000
MAX_EVENTS = 64
GEOMETRY_TRACED = (
    "the geometry of the mechanism is traced: its redundant rows are not known, and the run takes singular values, with diffrax, "
    "hundreds of times slower. Make it of plain numbers and change them by with_parameters, or pass analysis=analyse(...)"
)
# Of the rows' scales. Projection leaves rounding errors, unless the rows that it does not see drift. Without it drift is what one
# looks at, up to where a run is lost: the paper's linkage, not stabilized, is 1.6 rad off the exact solution when its loops are
# 2e-3 open.
DRIFT_PROJECTED, DRIFT_FREE = 1e-6, 1e-3


@checked
def simulate(
    mechanism: Mechanism | ConstrainedSystem,
    ts: Numbers | Sequence[float],
    state: State | Closure | None = None,
    rtol: Scalar = 1e-8,
    atol: Scalar = 1e-8,
    method: Pseudoinverse | None = None,
    stabilization: Projection | Baumgarte | None = Projection(),
    solver: "diffrax.AbstractSolver | None" = None,
    adjoint: "diffrax.AbstractAdjoint | None" = None,
    max_steps: int = MAX_STEPS,
    drift_tol: Scalar | None = None,
    dt0: Scalar | None = None,
    formulation: Formulation | None = None,
    throw: bool = True,
    progress: Any = None,
    analysis: Analysis | None = None,
    engine: Literal["auto", "native", "diffrax"] = "auto",
    events: Any = None,
    max_events: int = MAX_EVENTS,
) -> Solution:
    """Integrate the equations of motion q'' = a(t, q, q') of a mechanism; return its states at output times.

    All numbers may be traced: one compilation serves all values of parameters, tolerances, gains and output times, under jit and
    vmap as well. The result has derivatives of any order, forward and reverse; those beyond the first take the time of a hundred
    runs and minutes to compile. A violation of Psi above `drift_tol` at an output time ends the solution there.

    Args:
        mechanism: the mechanism, or a `ConstrainedSystem`.
        ts: output times (T,) in s, increasing; the motion starts at ts[0].
        state: the initial `State`, taken as it is, or the `Closure` of an assembly. By default the scene's guess is assembled.
        rtol: relative tolerance of every coordinate and velocity.
        atol: tolerance relative to the mechanism's own scales: x may err by rtol |x| + atol L, an angle by rtol |angle| + atol,
            their rates by 1/T of that, with L the characteristic length (`analyse`) and T the shortest of the characteristic
            time, the time in which the initial velocities move the mechanism by L, and the span of `ts`. So the same tolerances
            mean the same accuracy at any scale. L = T = 1 for a `ConstrainedSystem`.
        method: the pseudoinverse; by default `Auto()`.
        stabilization: `Projection()`, a `Baumgarte`, or None.
        solver: any diffrax solver for ordinary differential equations; by default Dopri8, of those measured in benchmarks/ the
            fastest at equal error, but for the tightest tolerances through singular configurations.
        adjoint: an adjoint of diffrax; by default derivatives are those of JAX.
        max_steps: the largest number of steps that are tried.
        drift_tol: the largest violation of Psi, of L or in rad.
        dt0: the first step that is tried, in s; by default it is chosen.
        formulation: finds the accelerations in another way than by the Udwadia-Kalaba equation: `Augmented`, `NullSpaceQR`,
            `NullSpaceSVD` or `CoordinatePartitioning`; `method` then serves projection and derivatives.
        throw: whether a run that does not reach its end raises; where numbers are traced, it never does.
        progress: True prints how far the run is; a progress meter of diffrax is used as it is.
        analysis: that of `analyse`, by default made here; a mechanism all of whose numbers are traced needs one to be fast.
        engine: "native" is machine code made of the scene's expressions, on the CPU: explicit Runge-Kutta methods with
            elimination, under vmap in lanes that step each on its own. "diffrax" is `diffrax.diffeqsolve`: every solver,
            adjoint, progress meter, device and method. "auto" takes the first where it can; `Solution.settings` says which it
            was, and why.
        events: what happens where a condition crosses zero: `Event`, `JointLimit`, `Contact`, one or a list of them, with
            actions `Stop`, `Log`, `Impact`, `Release`, `Attach` and `Lock`. They are located to rounding, whatever `ts` is, and
            the run starts anew behind each; contacts that act on one another are hit together. Both engines serve them, and
            batches: each member has its own events. Such runs have first derivatives, forward and reverse, through the times of
            the events (saltation), but none by `ts`.
        max_events: how many events may happen.

    Returns:
        A `Solution` with q and v (T, bodies, 3): x, y in m and angle in rad, and their rates. `Solution.result` tells how the
        run ended, `Solution.events` the times of events with the states before and after; an output at the very time of an
        event is the state after it.

    Raises:
        SimulationError: the run does not reach its end; it carries the solution.
        AssemblyError: the initial guess cannot be closed.
        ValueError: an argument cannot be used, or the engine that is asked for cannot run this.

    Source:
        D. de Falco, E. Pennestri, L. Vita, The Udwadia-Kalaba formulation, ECCOMAS Multibody Dynamics 2005.
    """
    require_output_times("ts", ts)
    rtol, atol, ts = number(rtol), number(atol), number(ts)
    if not isinstance(rtol, Tracer) and not isinstance(atol, Tracer) and float(rtol) + float(atol) < LEAST_ATOL:
        raise ArgumentError(f"rtol = {rtol:g} and atol = {atol:g} are below rounding, which no step can meet: raise one of them")
    if state is None and isinstance(mechanism, ConstrainedSystem):
        raise ValueError("a ConstrainedSystem has no initial guess to assemble: give the initial state, State(q, v)")
    drift = number((DRIFT_PROJECTED if isinstance(stabilization, Projection) else DRIFT_FREE) if drift_tol is None else drift_tol)
    method = Auto() if method is None else method
    settings = (rtol, atol, method, stabilization, drift, optional_number(dt0), formulation)
    choices = (solver, _adjoint(adjoint), max_steps, _meter(progress))

    start = ts[0] if isinstance(ts, Tracer) else np.asarray(ts)[0]
    state, closure = (None, state) if isinstance(state, Closure) else (state, None)
    bare: Any = mechanism
    if isinstance(mechanism, Mechanism):
        if analysis is None:
            analysis = analyse(mechanism)
            if analysis.redundant_rows is None and not mechanism.is_concrete and type(method) is Auto and engine == "auto":
                warnings.warn(GEOMETRY_TRACED, stacklevel=2)
        bare = mechanism.without_origin
        if state is None and closure is None:
            closure = close(mechanism, start, analysis=analysis)
            if mechanism.is_concrete:
                warn_of_moves(mechanism, start, closure, stacklevel=3)
        if throw and closure is not None:
            require_closed(mechanism, closure, start)  # before anything runs

    if events is not None:
        if not isinstance(mechanism, Mechanism) or choices[1] is not None or choices[3] is not None:
            what = (
                "a ConstrainedSystem"
                if not isinstance(mechanism, Mechanism)
                else "an adjoint of diffrax's"
                if choices[1]
                else "progress"
            )
            raise ValueError(f"a run with events takes a Mechanism, JAX's own derivatives and no progress meter: not {what}")
        from udkjax.integrate.events.simulate_events import Choices, simulate_events  # a dozen modules that other runs do without

        assert analysis is not None  # a mechanism has one
        more = (SMALLEST_STEP, isinstance(stabilization, Projection), solver, max_steps, max_events, engine)
        baumgarte = stabilization if isinstance(stabilization, Baumgarte) else None
        given: Any = (rtol, atol, method, baumgarte, formulation, drift, optional_number(dt0), *more)
        solution = simulate_events(mechanism, events, analysis, ts, state, closure, Choices(*given))
        if not _has_failed(solution) or not mechanism.is_concrete or int(solution.stats["events"]):
            return _required(solution, throw)  # events may have changed what moved
        return _required(explained(solution, mechanism, analysis, drift, solver), throw)

    def run(analysis: Analysis | None) -> tuple[Solution, Any, Any]:
        return _run(bare, analysis, ts, state, closure, *settings, *choices, engine)

    solution, missed, end = run(analysis)
    if isinstance(solution.code, Tracer):
        return solution
    if isinstance(mechanism, Mechanism) and missed and mechanism.is_concrete:
        analysis = analyse(mechanism)
        solution, _, end = run(analysis)  # the analysis was of other numbers, in which a row depended
    if isinstance(mechanism, Mechanism) and mechanism.is_concrete and _has_failed(solution):
        solution = explained(solution, mechanism, analysis, drift, solver, end)
    return _required(solution, throw)


def _has_failed(solution: Solution) -> bool:
    """Whether a single run, of known numbers, has not reached its end."""
    return not isinstance(solution.code, Tracer) and not solution.result.is_success


def _required(solution: Solution, throw: bool) -> Solution:
    """A solution; raise what a run that failed raises."""
    if throw and _has_failed(solution):
        raise SimulationError(solution.cause, solution)
    return solution


def _run(mechanism, analysis, ts, state, closure, *settings) -> Any:
    """Return the solution, whether it takes rows that the method leaves out, and the last state (t, (q, v)) of the integrator.

    Machine code is called at once where all numbers are known, by NumPy; everything else is traced.
    """
    given = (mechanism, analysis, ts, state, closure, *settings)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(given)):
        return _simulate(jnp, *given)
    with jax.ensure_compile_time_eval():  # while something else is traced
        known = _simulate(np, *given)
    return _compiled(*given) if known is None else known


def _simulate(
    xp,
    mechanism,
    analysis,
    ts,
    state,
    closure,
    rtol,
    atol,
    method,
    stabilization,
    drift_tol,
    dt0,
    formulation,
    solver,
    adjoint,
    max_steps,
    meter,
    engine,
) -> Any:
    """As `_run`; by NumPy, None where machine code cannot."""
    if xp is np:
        ts, rtol, atol, drift_tol = (np.asarray(x) for x in (ts, rtol, atol, drift_tol))
    baumgarte = stabilization if isinstance(stabilization, Baumgarte) else None
    equations = equations_of(mechanism, method, baumgarte, formulation, analysis)
    if xp is np:  # each operation of JAX on known numbers would be a program to compile
        equations, closure, state, dt0 = jax.tree.map(_by_numpy, (equations, closure, state, dt0))
    projected = equations.constrained and (isinstance(stabilization, Projection) or isinstance(equations, PartitionedSystem))
    if state is None:
        assert closure is not None
        state, closed = closure.state, xp.asarray(closure.is_closed)
    else:
        closed = xp.array(True)
    q, v = xp.ravel(xp.asarray(state.q)), xp.ravel(xp.asarray(state.v))
    good, given_ts = xp.array(True), ts
    if xp is jnp:  # what is known has passed the door
        good = usable(*stop_gradients((q, v, rtol, atol, drift_tol, dt0))) | ~closed  # pyright: ignore[reportArgumentType]
        if isinstance(mechanism, Mechanism):
            good = good & stop_gradients(traced_numbers_hold(mechanism.elements))
    if isinstance(ts, Tracer):
        in_order = increases(stop_gradients(ts))
        good, ts = good & in_order, jnp.where(in_order, ts, jnp.arange(len(ts)))
    # A member of a batch that cannot be closed is run through in a few steps, instead of holding up the others.
    loose_rtol, loose_atol = (xp.where(good & closed, tol, 1e3) for tol in (rtol, xp.maximum(atol, LEAST_ATOL)))
    ulp = np.finfo(float).eps * xp.maximum(xp.abs(ts[0]), xp.abs(ts[-1]))
    length, rate = units_of_run(analysis, ts, v, xp)
    problem = Problem(
        equations=equations,
        ts=ts,  # pyright: ignore[reportArgumentType]
        q=q,
        v=v,
        rtol=loose_rtol,
        atol=loose_atol,
        smallest=SMALLEST_STEP * ulp,
        h=dt0,
        length=length,
        rate=rate,
        solver=solver,
        projected=projected,
        max_steps=max_steps,
        breakpoints=mechanism.breakpoints,
    )
    why = "it was asked for" if engine == "diffrax" else reason_for_diffrax(problem, adjoint, meter)
    if engine == "native" and why:
        raise ValueError(f'engine="native" cannot: {why}. engine="auto" takes diffrax instead')
    if xp is np and why:
        return None
    if adjoint is not None or meter is not None:
        raw = integrate_by_diffrax(problem, adjoint, meter)
    else:
        raw = integrate_known(problem) if xp is np else differentiable(problem, native=not why)
    missed = xp.array(False) if why or closure is None else closed & (closure.rank > independent_row_count(problem))
    later = (raw.reached & (np.arange(len(ts)) > 0))[:, None]
    q, v = xp.where(later, raw.q, q), xp.where(later, raw.v, v)
    ends: Any = (raw, given_ts, good, closed, missed, drift_tol)
    seen = Run(*ends)
    code, time, reached = outcome(seen if xp is np else stop_gradients(seen), xp)
    q, v = (xp.where(reached[:, None], y, xp.nan).reshape(-1, *np.shape(state.q)) for y in (q, v))
    stats = counts(raw, projected, len(ts), xp)
    chosen = (
        ("method", type(method).__name__),
        ("formulation", "UdwadiaKalaba" if formulation is None else type(formulation).__name__),
        ("stabilization", type(stabilization).__name__),
        ("solver", "Dopri8" if solver is None else type(solver).__name__),
        ("max_steps", str(max_steps)),
        ("first_step", "chosen" if dt0 is None else "given"),
        ("engine", f"diffrax: {why}" if why else "native"),
    )
    arrays = jax.tree.map(jnp.asarray if xp is jnp else jax.device_put, (given_ts, q, v, code, time, stats, rtol, atol))
    fields: Any = (*arrays, getattr(mechanism, "body_names", ()), chosen)
    return Solution(*fields), missed, (raw.t, raw.y)


def _by_numpy(leaf: Any) -> Any:
    return np.asarray(leaf) if eqx.is_array(leaf) else leaf


_compiled = eqx.filter_jit(partial(_simulate, jnp))


def units_of_run(analysis: Analysis | None, ts: Any, v: Any, xp: Any) -> tuple[Any, Any]:
    """The length and the rate that `atol` is relative to."""
    if analysis is None:
        return None, xp.ones(())
    scales = analysis.scales if xp is jnp else jax.tree.map(np.asarray, analysis.scales)
    units = scales.length, xp.maximum(xp.maximum(scales.rate, scales.size(v, xp)), 1 / (ts[-1] - ts[0]))
    return units if xp is np else stop_gradients(units)


def integrate_by_diffrax(problem: Problem, adjoint: Any, meter: Any) -> Any:
    """As in diffrax_engine.py: diffrax is imported where it is asked for, since that takes as long as all of JAX."""
    from udkjax.integrate.diffrax_engine import integrate_by_diffrax

    return integrate_by_diffrax(problem, adjoint, meter)


def _adjoint(adjoint: Any) -> Any:
    """An adjoint of diffrax's; None where derivatives are those of JAX, which `ForwardMode` leaves them to."""
    if adjoint is None:
        return None
    import diffrax

    return None if type(adjoint) is diffrax.ForwardMode else adjoint


def _meter(progress: Any) -> "diffrax.AbstractProgressMeter | None":
    if progress is None or progress is False:
        return None
    import diffrax

    if not isinstance(progress, bool | diffrax.AbstractProgressMeter):
        raise ArgumentTypeError(f"progress must be True, False or a progress meter of diffrax's, {describe(progress)}")
    meter: Any = diffrax.TextProgressMeter() if progress is True else progress
    return None if isinstance(meter, diffrax.NoProgressMeter) else meter
