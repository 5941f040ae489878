"""A run with events: what it is given, what it finds, and its plain form."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.hybrid import Hybrid, RunState
from udkjax.integrate.events.loop import run_loop


class EventRun(NamedTuple):
    """The outputs and events of a run, infinite where it did not get. In derivatives a field is None that has none."""

    q: Float[Any, "T n"]
    v: Float[Any, "T n"]
    time: Float[Any, ""]  # the end of the run
    event_time: Float[Any, "K"]
    event_q: Float[Any, "K 2 n"]  # before and after
    event_v: Float[Any, "K 2 n"]
    event_index: Int[Any, "K"]
    event_phase: Int[Any, "K"]
    together: Bool[Any, "K"]
    closed: Int[Any, "K E"]
    count: Int[Any, ""]
    unresolved: Float[Any, "E"]
    undefined: Bool[Any, "E"]
    code: Int[Any, ""]
    totals: Int[Any, "4"]


class RunInput(NamedTuple):
    """The initial state of a run with events, and its output times."""

    ts: Float[Array, "T"]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    code: Int[Array, ""]  # a `Result` that is known before
    drift_tol: Float[Array, ""]


def run_plain(hybrid: Hybrid, given: RunInput, max_events: int) -> EventRun:
    """Run a system with events, window by window."""
    state = RunState(given.ts[0], given.q, given.v, jnp.array(0), hybrid.phases.first_added())
    loop = run_loop(hybrid, given.ts, state, given.code, given.drift_tol, max_events)
    record, smooth = loop.record, (loop.q, loop.v, loop.state.t)
    events = record.t, record.q, record.v, record.index, record.phase, record.together, record.closed, record.count
    # Before it is no number, a condition may vary quickly: the end of the run says so.
    faults = jnp.where(loop.undefined, jnp.inf, loop.unresolved[: hybrid.count]), loop.undefined
    return EventRun(*smooth, *events, *faults, loop.code, loop.totals)
