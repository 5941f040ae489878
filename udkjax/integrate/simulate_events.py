"""Simulate with events: prepare a hybrid system of a mechanism, run it, and say how it went."""

from collections import OrderedDict
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from udkjax.integrate import native_engine
from udkjax.integrate.event_run import Start, Trace, trace
from udkjax.integrate.events import Event, Events, expanded
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.hybrid import Hybrid
from udkjax.integrate.phases import Phases, phases_of
from udkjax.integrate.solution import Result, Solution
from udkjax.scene.mechanism import Mechanism


class Choices(eqx.Module):
    """What `simulate` was told of a run besides the mechanism, the events and the times."""

    rtol: Any
    atol: Any
    method: Any
    baumgarte: Any
    formulation: Any
    drift_tol: Any
    dt0: Any
    smallest_step: float = eqx.field(static=True)
    projects: bool = eqx.field(static=True)
    solver: Any = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    max_events: int = eqx.field(static=True)
    engine: str = eqx.field(static=True)


def simulate_events(
    mechanism: Mechanism, events: Any, analysis: Any, ts: Any, state: Any, closure: Any, choices: Choices
) -> Solution:
    """Run a mechanism with events; `state` or `closure` is where it starts."""
    if not isinstance(choices.max_events, int) or choices.max_events < 1:
        raise ValueError(f"max_events must be a whole number, at least 1, not {choices.max_events!r}")
    events, phases = _prepared(mechanism, events, analysis)
    names = tuple(e.name for e in events)
    given = phases, events, ts, state, closure, choices
    traced = any(isinstance(x, Tracer) for x in jax.tree.leaves(given))
    arrays, static = eqx.partition(given, eqx.is_array)
    found, engine = _compiled(arrays, static)
    count = int(found.count) if not traced else None
    return _solution(mechanism, names, ts, choices, found, engine, count)


# What was prepared of mechanisms and events that still exist: keyed by their identities, and holding them, so that these last.
_latest: OrderedDict[Any, Any] = OrderedDict()
MOST = 64


def _prepared(mechanism: Mechanism, events: Any, analysis: Any) -> tuple[tuple[Event, ...], Phases]:
    """All events by their names, and the phases that they lead to; found again where numbers are known and objects the same."""
    listed = tuple(events) if isinstance(events, list | tuple) else (events,)
    if any(isinstance(x, Tracer) for x in jax.tree.leaves((mechanism, listed, analysis))):
        found = expanded(listed, mechanism)
        return found, phases_of(mechanism, found, analysis)
    key = id(mechanism), *map(id, listed), id(analysis)
    if key not in _latest:
        with jax.ensure_compile_time_eval():
            found = expanded(listed, mechanism)
            _latest[key] = found, phases_of(mechanism, found, analysis), (mechanism, listed, analysis)
        while len(_latest) > MOST:
            _latest.popitem(last=False)
    return _latest[key][:2]


def _run(arrays: Any, static: Any) -> tuple[Trace, Any]:
    phases, events, ts, state, closure, choices = eqx.combine(arrays, static)
    closed = jnp.array(True) if closure is None else jnp.asarray(closure.is_closed)
    state = closure.state if closure is not None else state
    q, v = jnp.ravel(jnp.asarray(state.q)), jnp.ravel(jnp.asarray(state.v))
    scales = phases.analyses[0].scales
    rate = jnp.maximum(jnp.maximum(scales.rate, scales.size(v)), 1 / (ts[-1] - ts[0]))
    length, rate = stop_gradients((scales.length, rate))
    ulp = np.finfo(float).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    hybrid = Hybrid(
        phases,
        events,
        choices.rtol,
        choices.atol,
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
    if not reasons[0] and closure is not None:  # the closed state may take rows that the analysis says are redundant
        code = jnp.where(closed & (closure.rank > native_engine.rows_kept(hybrid.first_problem())), Result.drift, code)
    return trace(hybrid, Start(ts, q, v, code, choices.drift_tol), choices.max_events), reasons


_compiled = eqx.filter_jit(_run)


def _solution(
    mechanism: Mechanism,
    names: tuple[str, ...],
    ts: Any,
    choices: Choices,
    found: Trace,
    reasons: tuple[str, ...],
    count: int | None,
) -> Solution:
    bodies = (-1, len(mechanism.body_names), 3)
    here = (jnp.arange(choices.max_events) < found.count) if count is None else slice(0, count)

    def listed(x: Any, nothing: Any = jnp.nan) -> Any:
        """Those that there were: as many, or padded."""
        return x[here] if isinstance(here, slice) else jnp.where(here.reshape(-1, *[1] * (x.ndim - 1)), x, nothing)

    q, v = (listed(x) for x in (found.event_q, found.event_v))
    before_after = [x[:, k].reshape(*bodies) for k in (0, 1) for x in (q, v)]
    names = (*names, *(f"{name} lets go" for name in names), *(f"{name} rests" for name in names))
    listing: Any = (listed(found.event_time), listed(found.event_index, -1), *before_after, found.count, names)
    events = Events(*listing)
    stats = {
        "steps": found.tallies[0],
        "accepted": found.tallies[1],
        "rejected": found.tallies[0] - found.tallies[1],
        "right_hand_sides": found.tallies[2],
        "projections": found.tallies[3],
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
    q, v = (x.reshape(len(x), *bodies[1:]) for x in (found.q, found.v))
    fields: Any = (ts, q, v, found.code, found.time, stats, choices.rtol, choices.atol, mechanism.body_names, settings, events)
    return Solution(*fields)
