"""Simulate: from a mechanism and output times to a trajectory."""

from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from udkjax.equations.assembly import Closure, State, close, is_closed, require_closed
from udkjax.equations.formulations import Formulation
from udkjax.equations.general import ConstrainedSystem
from udkjax.equations.motion import Motion
from udkjax.equations.partitioning import Partitioned
from udkjax.equations.quantities import equations_of
from udkjax.equations.redundancy import redundant_rows
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate.counting import NOT_KNOWN, Counting, evaluations
from udkjax.integrate.outcome import Run, counts, outcome
from udkjax.integrate.projection import Constrained, Projection, project_all
from udkjax.integrate.solution import Result, SimulationError, Solution
from udkjax.integrate.undifferentiated import undifferentiated
from udkjax.pinv import Auto, Pseudoinverse
from udkjax.scene.fields import number
from udkjax.scene.mechanism import Mechanism

MAX_STEPS = 100_000
# m and rad. Projection leaves rounding errors, unless the rows that it does not see drift. Without it drift is what one looks at,
# up to where a run is lost: the paper's linkage, not stabilized, is 1.6 rad off the exact solution when its loops are 2e-3 open.
DRIFT_PROJECTED, DRIFT_FREE = 1e-6, 1e-3
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
    dt0: ArrayLike | None = None,
    formulation: Formulation | None = None,
    throw: bool = True,
    progress: Any = None,
) -> Solution:
    """Integrate the motion of a mechanism; return its states at the times `ts` (T,), in s. The motion starts at ts[0].

    Without `state` the scene's initial guess is assembled; a given state is taken as it is. `method` is any pseudoinverse
    (default `Auto`), `stabilization` is `Projection()`, a `Baumgarte` or None, `solver` any diffrax solver for ordinary
    differential equations (default Dopri8: of those measured in benchmarks/ the fastest at equal error, but for the tightest
    tolerances through singular configurations). `rtol` and `atol` hold for every coordinate and velocity. `dt0` is the first
    step that is tried, in s; by default it is chosen, which takes one right-hand side. `formulation` finds the accelerations in
    another way than by the Udwadia-Kalaba equation: `Augmented`, `NullSpaceQR`, `NullSpaceSVD` or `CoordinatePartitioning`;
    `method` then serves projection and derivatives. `progress=True` prints how far the run is.

    All numbers may be traced: one compilation serves all values of parameters, tolerances, gains and output times, under jit and
    vmap as well. For forward mode give `adjoint=diffrax.ForwardMode()`; reverse mode works as it is.

    A run that does not reach its end raises `SimulationError`, which carries the solution; with `throw=False`, or when numbers
    are traced, `Solution.result` tells instead. A violation of Psi above `drift_tol` (m, rad) at an output time ends the
    solution there. A guess that cannot be closed raises `AssemblyError`.
    """
    ts = _times(ts)
    if state is None and isinstance(mechanism, ConstrainedSystem):
        raise ValueError("a ConstrainedSystem has no initial guess to assemble: give the initial state, State(q, v)")
    drift = number((DRIFT_PROJECTED if isinstance(stabilization, Projection) else DRIFT_FREE) if drift_tol is None else drift_tol)
    method = Auto() if method is None else method
    numbers = (state, number(rtol), number(atol), method, stabilization, drift, _step(dt0), formulation)
    choices = (solver or diffrax.Dopri8(), adjoint or diffrax.RecursiveCheckpointAdjoint(), max_steps, _meter(progress))

    solution, closure, missed = _simulate(mechanism, ts, *numbers, *choices)
    if isinstance(solution.code, Tracer):
        return solution
    if isinstance(mechanism, Mechanism) and missed:  # the numbers made rows independent that were left out: choose again
        mechanism = mechanism.with_left_out(redundant_rows(mechanism))
        solution, closure, missed = _simulate(mechanism, ts, *numbers, *choices)
    if throw and isinstance(mechanism, Mechanism) and closure is not None:
        require_closed(mechanism, closure)
    if throw and solution.result != Result.successful:
        raise SimulationError(solution.cause, solution)
    return solution


@eqx.filter_jit
def _simulate(
    mechanism, ts, state, rtol, atol, method, stabilization, drift_tol, dt0, formulation, solver, adjoint, max_steps, meter
):
    """Return the solution, the closure that it starts from, and whether that closure needs rows which the method leaves out."""
    equations = equations_of(mechanism, method, stabilization if isinstance(stabilization, Baumgarte) else None, formulation)
    projected = equations.constrained and (isinstance(stabilization, Projection) or isinstance(equations, Partitioned))
    start, closure, closed, missed = _start(mechanism, equations, ts[0], state)
    y0 = jnp.concatenate([start.q.ravel(), start.v.ravel()])
    # A member of a batch that cannot be closed is run through in a few steps, instead of holding up the others.
    loose_rtol, loose_atol = (jnp.where(closed, tol, 1e3) for tol in (rtol, atol))
    run = diffrax.diffeqsolve(
        diffrax.ODETerm(derivative),
        Constrained(solver, projected),
        t0=ts[0],
        t1=ts[-1],
        dt0=_first_step(equations, ts, y0, loose_rtol, loose_atol) if dt0 is None else dt0,
        y0=y0,
        args=equations,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)], controller_state=True),
        stepsize_controller=Counting(_controller(loose_rtol, loose_atol, ts)),
        adjoint=adjoint,
        max_steps=max_steps,
        progress_meter=meter,
        throw=False,
    )
    saved: Any = (run.ys, run.ts)
    (ys, end), (_, t_end) = saved
    reached = ts <= t_end[0]
    ys = jnp.where(reached[:, None], ys, y0).at[0].set(y0)  # a run without any accepted step has saved nothing
    if projected:
        ys = jnp.concatenate([ys[:1], project_all(equations, ts[1:], ys[1:])])
    seen = undifferentiated(Run(equations, run.result, ts, ys, reached, t_end[0], end[0], closed, missed, drift_tol))
    code, time, reached = outcome(seen)
    ys = jnp.where(reached[:, None], ys, jnp.nan)
    q, v = (y.reshape(len(ts), *start.q.shape) for y in jnp.split(ys, 2, axis=1))
    found = evaluations(run.controller_state)
    right_hand_sides = jnp.where(found == NOT_KNOWN, NOT_KNOWN, found + (dt0 is None))  # one chooses the first step
    stats = counts(run.stats, right_hand_sides, projected, len(ts))
    settings = (
        ("method", type(method).__name__),
        ("formulation", "UdwadiaKalaba" if formulation is None else type(formulation).__name__),
        ("stabilization", type(stabilization).__name__),
        ("solver", type(solver).__name__),
        ("max_steps", str(max_steps)),
        ("first_step", "chosen" if dt0 is None else "given"),
    )
    names = getattr(mechanism, "body_names", ())
    return Solution(ts, q, v, code, time, stats, rtol, atol, names, settings), closure, missed


def derivative(t: Any, y: Float[Array, "2n"], equations: Motion) -> Float[Array, "2n"]:
    """(v, a)."""
    return jnp.concatenate(equations.rates(t, *jnp.split(y, 2)))


def _start(mechanism: Any, equations: Any, t: Any, state: State | None) -> tuple[State, Closure | None, Any, Any]:
    """The initial state; how it was closed, if it was; whether it is closed; whether that takes rows left out as redundant."""
    if state is not None:
        return state, None, jnp.array(True), jnp.array(False)
    closure = close(mechanism, t)
    closed, kept = is_closed(closure), len(closure.psi) - len(equations.left_out)
    return closure.state, closure, closed, closed & (closure.rank > kept)


def _first_step(equations: Any, ts: Array, y0: Array, rtol: Any, atol: Any) -> Array:
    """A step over which the state changes by a small part of itself.

    As in Hairer, Norsett, Wanner, II.4, without its second evaluation: the controller corrects what is off.
    """
    equations, y0, rtol, atol = undifferentiated((equations.quick, y0, rtol, atol))
    scale = atol + rtol * jnp.abs(y0)
    size, slope = jnp.max(jnp.abs(y0) / scale), jnp.max(jnp.abs(derivative(ts[0], y0, equations)) / scale)
    span = ts[-1] - ts[0]
    ordinary = jnp.isfinite(slope) & (slope > 0) & (size > 0)
    return jnp.where(ordinary, jnp.minimum(0.01 * size / jnp.where(ordinary, slope, 1.0), span), 1e-4 * span)


def _controller(rtol: Any, atol: Any, ts: Array) -> diffrax.PIDController:
    ulp = jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    # Every coordinate and velocity meets its tolerance: the mean over a large mechanism would hide one that does not.
    return diffrax.PIDController(rtol=rtol, atol=atol, norm=optx.max_norm, dtmin=SMALLEST_STEP * ulp, force_dtmin=False)


def _times(ts: ArrayLike) -> Float[Array, "T"]:
    ts = number(ts)
    if ts.ndim != 1 or len(ts) < 2:
        raise ValueError(f"ts must be a vector of at least two output times, from the start on; its shape is {ts.shape}")
    if not isinstance(ts, Tracer) and not np.all(np.diff(ts) > 0):  # by NumPy: while something else is traced, jnp would trace it
        raise ValueError("ts must increase from each output time to the next")
    return ts


def _step(dt0: ArrayLike | None) -> Array | None:
    if dt0 is None:
        return None
    dt0 = number(dt0)
    if dt0.shape:
        raise ValueError(f"dt0 is one time, in s; its shape is {dt0.shape}")
    if not isinstance(dt0, Tracer) and not 0 < float(dt0) < jnp.inf:
        raise ValueError(f"the first step dt0 must be positive, not {float(dt0)} s")
    return dt0


def _meter(progress: Any) -> diffrax.AbstractProgressMeter:
    if progress is None or progress is False:
        return diffrax.NoProgressMeter()
    return diffrax.TextProgressMeter() if progress is True else progress
