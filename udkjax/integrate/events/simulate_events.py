"""Simulate with events: prepare a hybrid system of a mechanism, run it, and say how it went."""

import warnings
from collections import OrderedDict
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PyTree

from udkjax.equations.analysis import Analysis
from udkjax.equations.formulations import Formulation
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate import native_engine
from udkjax.integrate.assembly import Closure, State
from udkjax.integrate.events.event import Event, Events, ExpandsToEvents, expand_events
from udkjax.integrate.events.hybrid import Hybrid
from udkjax.integrate.events.phases import Phases, phases_of
from udkjax.integrate.events.replay import EventRun, RunInput, run_events
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.outcome import increases, usable
from udkjax.integrate.projection import violation
from udkjax.integrate.solution import Result, Solution
from udkjax.native.steps import LEAST_ATOL
from udkjax.pinv import Pseudoinverse
from udkjax.scene.checks import quote
from udkjax.scene.mechanism import Mechanism

if TYPE_CHECKING:
    import diffrax

UNRESOLVED = "conditions of events vary too quickly for the shortest window, 1e-9 T; crossings may be missed: {}"
CACHE_SIZE = 64  # mechanisms with events whose phases are stored


class Choices(eqx.Module):
    """The arguments of `simulate` besides the mechanism, the events and the times."""

    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    method: Pseudoinverse
    baumgarte: Baumgarte | None
    formulation: Formulation | None
    drift_tol: Float[Array, ""]
    dt0: Float[Array, ""] | None
    smallest_step: float = eqx.field(static=True)
    projects: bool = eqx.field(static=True)
    solver: "diffrax.AbstractSolver | None" = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    max_events: int = eqx.field(static=True)
    engine: str = eqx.field(static=True)


class Given(NamedTuple):
    """What is compiled for: a mechanism's phases, and the start and the choices of a run."""

    phases: Phases
    events: tuple[Event, ...]
    ts: Float[Array, "T"]
    state: State | None
    closure: Closure | None  # in place of the state
    choices: Choices


def simulate_events(
    mechanism: Mechanism,
    events: ExpandsToEvents | Sequence[ExpandsToEvents],
    analysis: Analysis,
    ts: Float[Array, "T"],
    state: State | None,
    closure: Closure | None,
    choices: Choices,
) -> Solution:
    """Run a mechanism with events.

    Args:
        mechanism: the scene.
        events: one event or several, ready-made ones among them.
        analysis: that of the mechanism.
        ts: the output times (s).
        state: the initial state, or None: that of `closure`.
        closure: the assembled initial guess.
        choices: all other arguments of `simulate`.

    Raises:
        ValueError: the events do not fit the mechanism, or machine code was asked for and cannot run it.
    """
    listed, phases = _prepare(mechanism, events, analysis)
    given = Given(phases, listed, ts, state, closure, choices)
    traced = any(isinstance(x, Tracer) for x in jax.tree.leaves(given))
    found, reasons = _run(*eqx.partition(given, eqx.is_array))
    count = None if traced else int(found.count)
    if count is not None and np.isfinite(found.unresolved).any():
        fast = [f"{quote(e.name)} from {t:.6g} s on" for e, t in zip(listed, found.unresolved, strict=True) if np.isfinite(t)]
        warnings.warn(UNRESOLVED.format(", ".join(fast)), stacklevel=3)
    return _solution(mechanism, tuple(e.name for e in listed), ts, choices, found, reasons, count)


Prepared = tuple[tuple[Event, ...], Phases]
# What was prepared of mechanisms and events, keyed by their identities, and holding them, so that these last.
_cache: OrderedDict[tuple[int, ...], tuple[Prepared, PyTree]] = OrderedDict()


def _prepare(mechanism: Mechanism, events: ExpandsToEvents | Sequence[ExpandsToEvents], analysis: Analysis) -> Prepared:
    """Return all events by their names, and the phases that they lead to; from the cache where numbers are known."""
    listed = tuple(events) if isinstance(events, Sequence) else (events,)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((mechanism, listed, analysis))):
        return _expand(mechanism, listed, analysis)
    key = id(mechanism), *map(id, listed), id(analysis)
    if key not in _cache:
        with jax.ensure_compile_time_eval():
            _cache[key] = _expand(mechanism, listed, analysis), (mechanism, listed, analysis)
        while len(_cache) > CACHE_SIZE:
            _cache.popitem(last=False)
    return _cache[key][0]


def _expand(mechanism: Mechanism, events: Sequence[ExpandsToEvents], analysis: Analysis) -> Prepared:
    found = expand_events(events, mechanism)
    return found, phases_of(mechanism, found, analysis)


@eqx.filter_jit
def _run(arrays: Given, static: Given) -> tuple[EventRun, tuple[str, ...]]:
    """Run, and return with the result why machine code does not serve each phase."""
    phases, events, ts, state, closure, choices = eqx.combine(arrays, static)
    if closure is None:
        assert state is not None  # one of them is given
        closed = jnp.array(True)
    else:
        state, closed = closure.state, jnp.asarray(closure.is_closed)
    q, v = jnp.ravel(jnp.asarray(state.q)), jnp.ravel(jnp.asarray(state.v))
    good, in_order = usable(*stop_gradients((q, v, choices.rtol, choices.atol, choices.drift_tol, choices.dt0))), increases(ts)
    good, ts = (good & in_order) | ~closed, jnp.where(in_order, ts, jnp.arange(len(ts)))
    scales = phases.analyses[0].scales
    rate = jnp.maximum(jnp.maximum(scales.rate, scales.size(v)), 1 / (ts[-1] - ts[0]))
    length, rate = stop_gradients((scales.length, rate))
    ulp = np.finfo(float).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    hybrid = Hybrid(
        phases,
        events,
        choices.rtol,
        jnp.maximum(choices.atol, LEAST_ATOL),
        choices.smallest_step * ulp,
        choices.dt0,
        length,
        rate,
        choices.method,
        choices.baumgarte,
        choices.formulation,
        solver=choices.solver,
        projects=choices.projects,
        max_steps=choices.max_steps,
        engine=choices.engine,
    )
    reasons = hybrid.reasons()
    if choices.engine == "native" and any(reasons):
        raise ValueError(f'engine="native" cannot: {next(filter(None, reasons))}. engine="auto" takes diffrax instead')
    code = jnp.where(closed, Result.successful, Result.could_not_assemble)
    if closure is None:
        y = jnp.concatenate([q, v])
        is_open = ~(violation(hybrid.problem_of_guess(0).equations, ts[0], y) <= choices.drift_tol)
        code = jnp.where(is_open, Result.initial_state_open, code)
    if not reasons[0] and closure is not None:  # the closed state may take rows that the analysis says are redundant
        code = jnp.where(
            closed & (closure.rank > native_engine.independent_row_count(hybrid.problem_of_guess(0))), Result.drift, code
        )
    code = jnp.where(good & stop_gradients(hybrid.has_usable_numbers), code, Result.invalid_argument)
    return run_events(hybrid, RunInput(ts, q, v, code, choices.drift_tol), choices.max_events), reasons


def _solution(
    mechanism: Mechanism,
    names: tuple[str, ...],
    ts: Float[Array, "T"],
    choices: Choices,
    found: EventRun,
    reasons: tuple[str, ...],
    count: int | None,
) -> Solution:
    """Return the solution; its events are `count`, or padded to the most that there may be where that is None."""
    bodies = (-1, len(mechanism.body_names), 3)

    def trim(x: Array, padding: float = np.inf) -> Array:
        if count is not None:
            return x[:count]
        is_event = (jnp.arange(choices.max_events) < found.count).reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(is_event, x, padding)

    event_q, event_v = trim(found.event_q), trim(found.event_v)
    listing = Events(
        time=trim(found.event_time),
        index=trim(found.event_index, -1),
        q_before=event_q[:, 0].reshape(*bodies),
        v_before=event_v[:, 0].reshape(*bodies),
        q_after=event_q[:, 1].reshape(*bodies),
        v_after=event_v[:, 1].reshape(*bodies),
        count=found.count,
        unresolved=found.unresolved,
        undefined=found.undefined,
        names=(*names, *(f"{name} lets go" for name in names), *(f"{name} rests" for name in names)),
    )
    stats = {
        "steps": found.totals[0],
        "accepted": found.totals[1],
        "rejected": found.totals[0] - found.totals[1],
        "right_hand_sides": found.totals[2],
        "projections": found.totals[3],
        "events": found.count,
    }
    why = next(filter(None, reasons), "")
    settings = (
        ("method", type(choices.method).__name__),
        ("formulation", "UdwadiaKalaba" if choices.formulation is None else type(choices.formulation).__name__),
        ("stabilization", "Projection" if choices.projects else type(choices.baumgarte).__name__),
        ("solver", "Dopri8" if choices.solver is None else type(choices.solver).__name__),
        ("max_steps", str(choices.max_steps)),
        ("max_events", str(choices.max_events)),
        ("first_step", "chosen" if choices.dt0 is None else "given"),
        ("engine", f"diffrax: {why}" if all(reasons) else f"native, in some phases diffrax: {why}" if why else "native"),
    )
    with jax.debug_nans(False):  # they stand for outputs behind the end of a run, and alarm nobody
        q, v = (jnp.where(jnp.isinf(x), jnp.nan, x).reshape(len(x), *bodies[1:]) for x in (found.q, found.v))
    return Solution(
        ts=ts,
        q=q,
        v=v,
        code=found.code,
        time=found.time,
        stats=stats,
        rtol=choices.rtol,
        atol=choices.atol,
        bodies=mechanism.body_names,
        choices=settings,
        events=listing,
    )
