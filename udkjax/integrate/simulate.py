"""Simulate: from a mechanism and output times to a trajectory."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, ArrayLike, Float

from udkjax.equations.assembly import State, close, is_closed, require_closed
from udkjax.equations.general import ConstrainedSystem
from udkjax.equations.quantities import equations_of
from udkjax.equations.redundancy import redundant_rows
from udkjax.equations.udwadia_kalaba import Baumgarte, Equations
from udkjax.integrate.projection import Projection, constrained, project_all
from udkjax.integrate.solution import Result, SimulationError, Solution
from udkjax.pinv import Auto, Pseudoinverse
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

MAX_STEPS = 100_000
# m and rad. Projection leaves rounding errors, unless the rows that it does not see drift; without it drift is what one looks at,
# and a run is lost when the parts visibly come apart.
DRIFT_PROJECTED, DRIFT_FREE = 1e-6, 1e-2
AHEAD = 1e-6  # of the span: how far beyond the end of a run that stopped one looks for what is not finite
SMALLEST_STEP = 100.0  # ulps of the end time: below it time does not advance


def simulate(
    mechanism: Mechanism | ConstrainedSystem,
    ts: ArrayLike,
    state: State | None = None,
    rtol: ArrayLike = 1e-8,
    atol: ArrayLike = 1e-8,
    method: Pseudoinverse | None = None,
    stabilization: Projection | Baumgarte | None = Projection(),
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int = MAX_STEPS,
    drift_tol: ArrayLike | None = None,
    throw: bool = True,
    progress: Any = None,
) -> Solution:
    """Integrate the motion of a mechanism; return its states at the times `ts` (T,), in s. The motion starts at ts[0].

    Without `state` the scene's initial guess is assembled; a given state is taken as it is. `method` is any pseudoinverse
    (default `Auto`), `stabilization` is `Projection()`, a `Baumgarte` or None, `solver` any diffrax solver for ordinary
    differential equations (default Dopri8, the fastest of diffrax's at every accuracy that was measured). `rtol` and `atol`
    are those of diffrax's `PIDController`.

    All numbers may be traced: one compilation serves all values of parameters, tolerances, gains and output times, under jit and
    vmap as well. For forward mode give `adjoint=diffrax.ForwardMode()`; reverse mode works as it is.

    A run that does not reach its end raises `SimulationError`, which carries the solution; with `throw=False`, or when numbers
    are traced, `Solution.result` tells instead. A violation of Psi above `drift_tol` (m, rad) at an output time ends the
    solution there. A guess that cannot be closed raises `AssemblyError`.
    """
    ts = _times(ts)
    if state is None and isinstance(mechanism, ConstrainedSystem):
        raise ValueError("a ConstrainedSystem has no initial guess to assemble: give the initial state, State(q, v)")
    arguments = (number(rtol), number(atol), Auto() if method is None else method, stabilization)
    tolerance = DRIFT_PROJECTED if isinstance(stabilization, Projection) else DRIFT_FREE
    choices = (solver or diffrax.Dopri8(), adjoint or diffrax.RecursiveCheckpointAdjoint(), max_steps, _meter(progress))
    drift = number(tolerance if drift_tol is None else drift_tol)
    solution, closure, missed = _simulate(mechanism, ts, state, *arguments, drift, *choices)
    if isinstance(missed, jax.core.Tracer):
        return solution
    if jnp.ndim(missed) == 0 and missed:  # the numbers made rows independent that were left out: choose again
        mechanism = mechanism.with_left_out(redundant_rows(mechanism))
        solution, closure, missed = _simulate(mechanism, ts, state, *arguments, drift, *choices)
    if throw and solution.result == Result.could_not_assemble:
        require_closed(mechanism, closure)
    if throw and solution.result != Result.successful:
        raise SimulationError(solution.cause, solution)
    return solution


@eqx.filter_jit
def _simulate(mechanism, ts, state, rtol, atol, method, stabilization, drift_tol, solver, adjoint, max_steps, meter):
    baumgarte = stabilization if isinstance(stabilization, Baumgarte) else None
    equations = equations_of(mechanism, method, baumgarte)
    projected = isinstance(stabilization, Projection) and equations.constrained
    closure = close(mechanism, ts[0]) if state is None else None
    start = state if closure is None else closure.state
    closed = jnp.array(True) if closure is None else is_closed(closure)
    y0 = jnp.concatenate([number(start.q).ravel(), number(start.v).ravel()])
    # A member of a batch that cannot be closed is run through in a few steps, instead of holding up the others.
    rtol, atol = (jnp.where(closed, tol, 1e3) for tol in (rtol, atol))
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(derivative),
        constrained(solver, projected, adjoint),
        t0=ts[0],
        t1=ts[-1],
        dt0=_first_step(equations, ts, y0, rtol, atol),
        y0=y0,
        args=equations,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=_controller(rtol, atol, ts),
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=meter,
        throw=False,
    )
    ys, (end,), (t_end,) = run.ys[0], run.ys[1], run.ts[1]
    reached = ts <= t_end
    ys = jnp.where(reached[:, None], ys, y0)
    if projected:
        ys = jnp.concatenate([ys[:1], project_all(equations, ts[1:], ys[1:])])
    q, v = jnp.split(ys, 2, axis=1)
    state_of_play = jax.lax.stop_gradient((equations, ts, t_end, end, q, drift_tol))
    code, time, reached = _outcome(run.result, reached, closed, *state_of_play)
    missed = jnp.array(False)
    if closure is not None and equations.left_out:
        missed = closed & (closure.rank > len(closure.psi) - len(equations.left_out))
        code, time = jnp.where(missed, Result.drift, code), jnp.where(missed, ts[0], time)
    q, v = (jnp.where(reached[:, None], x, jnp.nan).reshape(len(ts), *start.q.shape) for x in (q, v))
    settings = (
        ("method", type(method).__name__),
        ("stabilization", type(stabilization).__name__),
        ("solver", type(solver).__name__),
        ("max_steps", str(max_steps)),
    )
    stats = _stats(run.stats, solver, projected, len(ts))
    stats |= {"rtol": rtol, "atol": atol}
    return Solution(ts, q, v, code, time, stats, getattr(mechanism, "body_names", ()), settings), closure, missed


def _first_step(equations: Any, ts: Array, y0: Array, rtol: Any, atol: Any) -> Array:
    """A step over which the state changes by a small part of itself (Hairer, Norsett, Wanner, II.4, without its second evaluation:
    the controller corrects what is off)."""
    equations, y0, rtol, atol = jax.lax.stop_gradient((equations.quick, y0, rtol, atol))
    scale = atol + rtol * jnp.abs(y0)
    size, slope = jnp.max(jnp.abs(y0) / scale), jnp.max(jnp.abs(derivative(ts[0], y0, equations)) / scale)
    span = ts[-1] - ts[0]
    ordinary = jnp.isfinite(slope) & (slope > 0) & (size > 0)
    return jnp.where(ordinary, jnp.minimum(0.01 * size / jnp.where(ordinary, slope, 1.0), span), 1e-4 * span)


def derivative(t: Any, y: Float[Array, "2n"], equations: Equations) -> Float[Array, "2n"]:
    """(v, a)."""
    q, v = jnp.split(y, 2)
    return jnp.concatenate([v, equations.accelerations(t, q, v)])


def _controller(rtol: Any, atol: Any, ts: Array) -> diffrax.PIDController:
    ulp = jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    # Every coordinate and velocity meets its tolerance, however many there are: the mean over a large mechanism would hide one.
    return diffrax.PIDController(rtol=rtol, atol=atol, norm=optx.max_norm, dtmin=SMALLEST_STEP * ulp, force_dtmin=False)


def _outcome(result, reached, closed, equations, ts, t_end, end, q, drift_tol):
    """The code, the time that belongs to it, and which output times count."""
    q_end, v_end = jnp.split(end, 2)
    times = t_end + jnp.array([0.0, AHEAD]) * (ts[-1] - ts[0])
    finite = jnp.all(jax.vmap(lambda t: equations.is_finite(t, q_end + (t - t_end) * v_end, v_end))(times))
    stopped = jnp.where(finite, Result.step_too_small, Result.not_finite)
    stopped = jnp.where(result == diffrax.RESULTS.max_steps_reached, Result.step_limit, stopped)
    code = jnp.where(result == diffrax.RESULTS.successful, Result.successful, stopped)
    code = jnp.where(closed, code, Result.could_not_assemble)
    time = jnp.where(closed, t_end, ts[0])
    reached = reached & (closed | (jnp.arange(len(ts)) == 0))
    if equations.constrained:
        psi = jax.vmap(lambda t, q: equations.violation(t, q, q)[0])(ts, q)
        lost = reached & closed & ~(jnp.max(jnp.abs(psi), axis=1, initial=0.0) <= drift_tol)
        first = jnp.argmax(lost)
        drifted = jnp.any(lost)
        code, time = jnp.where(drifted, Result.drift, code), jnp.where(drifted, ts[first], time)
        reached = reached & (~drifted | (jnp.arange(len(ts)) <= first))
    return code, time, reached


def _stats(stats: dict[str, Any], solver: Any, projected: bool, outputs: int) -> dict[str, Any]:
    """Steps, and what follows from them: a projected step of an explicit Runge-Kutta method takes all of its stages anew."""
    steps, counts = stats["num_steps"], {}
    counts["steps"], counts["accepted"], counts["rejected"] = steps, stats["num_accepted_steps"], stats["num_rejected_steps"]
    if isinstance(solver, diffrax.AbstractERK):
        stages, reused = solver.tableau.num_stages, solver.tableau.fsal and not projected
        counts["right_hand_sides"] = 1 + (steps * (stages - 1) + 1 if reused else steps * stages)  # 1: the first step's size
    else:
        counts["right_hand_sides"] = jnp.full_like(steps, -1)  # an implicit stage takes as many as its root finder needs: not known
    counts["projections"] = steps + 2 * (outputs - 1) if projected else jnp.zeros_like(steps)
    return counts


def _times(ts: ArrayLike) -> Float[Array, "T"]:
    ts = number(ts)
    if ts.ndim != 1 or len(ts) < 2:
        raise ValueError(f"ts must be a vector of at least two output times, from the start on; its shape is {ts.shape}")
    if not isinstance(ts, jax.core.Tracer) and not bool(jnp.all(jnp.diff(ts) > 0)):
        raise ValueError("ts must increase from each output time to the next")
    return ts


def _meter(progress: Any) -> diffrax.AbstractProgressMeter:
    if progress is None or progress is False:
        return diffrax.NoProgressMeter()
    return diffrax.TextProgressMeter() if progress is True else progress
