"""The loop of a run with events: integrate a window, locate the first crossing in it, apply the event, go on.

One pass of the loop is one run of the integrator, or one jump, so that the members of a batch each take their own course through
one program.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.actions import Impact, Stop
from udkjax.integrate.events.crossings import NO_EVENT, ZERO, first_crossing, side_of_zero
from udkjax.integrate.events.hybrid import ConditionValues, Hybrid, RunState
from udkjax.integrate.events.jumps import apply_event, comes_to_rest
from udkjax.integrate.events.window import (
    Search,
    WindowResult,
    choose,
    integrate_window,
    no_search,
    plan_window,
    step_search,
)
from udkjax.integrate.solution import Result

BEGIN = -2  # instead of an event: the conditions at the start are not known yet


class EventRecord(NamedTuple):
    """The events so far, with room for K."""

    t: Float[Array, "K"]
    index: Int[Array, "K"]  # of the event; plus E where a contact is released, plus 2 E where it comes to rest
    phase: Int[Array, "K"]  # after it
    q: Float[Array, "K 2 n"]  # before and after
    v: Float[Array, "K 2 n"]
    count: Int[Array, ""]
    last: Float[Array, ""]  # the time of the last one


class LoopState(NamedTuple):
    """Everything that changes in the loop."""

    state: RunState
    values: ConditionValues
    sides: Int[Array, "2E"]  # the last known side of zero of each condition: -1, 1, or 0: not known
    pending: Int[Array, ""]  # the event that happens now; or NO_EVENT, or BEGIN
    search: Search
    reach: Float[Array, ""]  # how far the next window goes (s)
    quiet: Float[Array, ""]  # the time up to which there is no crossing in pairs
    q: Float[Array, "T n"]  # outputs
    v: Float[Array, "T n"]
    written: Int[Array, ""]  # how many of them
    record: EventRecord
    code: Int[Array, ""]
    running: Bool[Array, ""]
    totals: Int[Array, "4"]  # steps tried, accepted, right-hand sides, projections


def run_loop(
    hybrid: Hybrid,
    ts: Float[Array, "T"],
    state: RunState,
    code: Int[Array, ""],
    drift_tol: Float[Array, ""],
    max_events: int,
) -> LoopState:
    """Run from a state to the last of the output times, or an event that stops.

    Args:
        hybrid: the system.
        ts: the output times (s).
        state: where the run begins.
        code: the `Result` as far as it is known before.
        drift_tol: the violation of the constraints that ends the run.
        max_events: how many events may happen.
    """
    first = _first_loop_state(hybrid, ts, state, code, max_events)

    def integrate(loop: LoopState) -> WindowResult:
        window = plan_window(hybrid, ts, loop.state, loop.search, loop.reach, loop.written)
        sides, scale = loop.sides[: hybrid.count], loop.values.scale[: hybrid.count]
        return integrate_window(hybrid, window, loop.state, sides, scale, loop.search, loop.quiet, drift_tol)

    def body(loop: LoopState) -> LoopState:
        happens = loop.pending != NO_EVENT
        nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(integrate, loop))
        jumped = jax.lax.cond(loop.pending >= 0, lambda: _apply_pending(hybrid, loop, max_events), lambda: loop)
        result = jax.lax.cond(happens, lambda: nothing, lambda: integrate(loop))
        values = hybrid.values(choose(happens, jumped.state, result.end))
        values = values._replace(scale=jnp.maximum(values.scale, loop.values.scale))
        loop = jax.lax.cond(
            happens, lambda: _after_event(hybrid, loop, jumped, values), lambda: _after_window(hybrid, loop, result, values)
        )
        more = (loop.state.t < ts[-1]) | (loop.pending >= 0)
        too_long = (loop.totals[0] >= hybrid.max_steps) & loop.running & more
        code = jnp.where(too_long, Result.step_limit, loop.code)
        return loop._replace(code=code, running=loop.running & more & ~too_long)

    return _fill_end(jax.lax.while_loop(lambda loop: loop.running, body, first), ts)


def _first_loop_state(hybrid: Hybrid, ts: Float[Array, "T"], state: RunState, code: Int[Array, ""], max_events: int) -> LoopState:
    E, n, T = hybrid.count, len(state.q), len(ts)
    nothing = jnp.full((T, n), jnp.nan, float)
    none, zeros = jnp.full(max_events, -1, int), jnp.zeros(2 * E)
    states, times = jnp.full((max_events, 2, n), jnp.nan, float), jnp.full(max_events, jnp.nan, float)
    return LoopState(
        state=state,
        values=ConditionValues(zeros, zeros, zeros, jnp.zeros((E, n)), jnp.zeros(n), zeros),
        sides=jnp.zeros(2 * E, int),
        pending=jnp.array(BEGIN),
        search=no_search(ts[0]),
        reach=ts[-1] - ts[0],
        quiet=ts[0],
        q=nothing,
        v=nothing,
        written=jnp.array(0),
        record=EventRecord(times, none, none, states, states, jnp.zeros((), int), ts[0]),
        code=code,
        running=code == Result.successful,
        totals=jnp.zeros(4, int),
    )


def _after_event(hybrid: Hybrid, loop: LoopState, jumped: LoopState, values: ConditionValues) -> LoopState:
    """Return the loop after an event, or at the start, with the event that happens at once."""
    new = jax.lax.cond(loop.pending == BEGIN, lambda: _begin(hybrid, jumped, values), lambda: jumped)
    pending = first_crossing(hybrid, new.state.phase, new.sides, side_of_zero(values, hybrid.rate))
    return new._replace(values=values, pending=jnp.where(new.running, pending, NO_EVENT))


def _begin(hybrid: Hybrid, loop: LoopState, values: ConditionValues) -> LoopState:
    """Return the loop with the sides of zero of the conditions at the start."""
    is_zero = jnp.abs(values.h) <= ZERO * values.scale
    # Contacts are approached from the side that is allowed: what is zero and falls at the start happens at once.
    impacts = np.append(hybrid.impacts, np.zeros(hybrid.count, bool))
    sides = jnp.where(impacts & is_zero, 1, side_of_zero(values, hybrid.rate))
    beyond = jnp.any(impacts & (values.h < 0) & ~is_zero)
    code = jnp.where(beyond, Result.beyond_contact, loop.code)
    return loop._replace(sides=sides, code=code, running=loop.running & ~beyond)


def _after_window(hybrid: Hybrid, loop: LoopState, result: WindowResult, values: ConditionValues) -> LoopState:
    """Return the loop after a run of the integrator: it goes on, searches on, or an event is pending."""
    E, end = hybrid.count, result.end
    step, now = step_search(hybrid, result, values), side_of_zero(values, hybrid.rate)
    k = jnp.maximum(result.search.event, 0)
    # A contact that would have to pull at the end of the window is released within it.
    pulls = hybrid.is_held(end.phase) & (loop.sides[E:] > 0) & (now[E:] < 0)
    is_free = (step.is_found & (k < E)) | (result.search.event < 0)
    releases = is_free & jnp.any(pulls) & ~result.fails & (end.t > loop.state.t)
    middle = (loop.state.t + end.t) / 2
    release = Search(E + jnp.argmax(pulls), middle, loop.state.t, end.t, jnp.array(0), jnp.array(True), jnp.array(1), end.t)
    is_found, repeats = step.is_found & ~releases, step.continues | releases

    search = choose(releases, release, choose(is_found | step.is_lost, no_search(loop.state.t), step.search))
    h = step.change
    at_event = end._replace(t=end.t + h, q=end.q + h * end.v + h**2 / 2 * values.a, v=end.v + h * values.a)
    state = choose(is_found, at_event, choose(repeats, loop.state, result.reached))
    # At the end of the run every condition that is not zero tells its side; what is located tells it by happening.
    others = (np.arange(2 * E) != jnp.where(is_found, k, -1)) & (jnp.abs(values.h) > ZERO * values.scale)
    sides = jnp.append(choose(repeats, loop.sides[:E], result.sides), loop.sides[E:])
    is_over = (search.event < 0) & ~step.is_lost & ~result.fails
    pending = jnp.where(is_over, first_crossing(hybrid, end.phase, sides, now), NO_EVENT)
    pending = jnp.where(is_found, k, pending)
    sides = jnp.where(is_found & others, now, sides)
    sides = sides.at[k].set(jnp.where(is_found, result.search.side, sides[k]))
    output, due = result.window.output, result.window.due
    rows = jnp.where((output < len(loop.q)) & (due < state.t), output, len(loop.q))
    return loop._replace(
        state=state,
        values=values._replace(rate=values.rate + h * values.rate_2),
        sides=sides,
        pending=jnp.where(result.fails, NO_EVENT, pending),
        search=search,
        reach=jnp.where(search.event >= 0, loop.reach, 2 * loop.reach),
        quiet=jnp.where(step.is_lost, result.search.until, loop.quiet),
        q=loop.q.at[rows].set(result.q, mode="drop"),
        v=loop.v.at[rows].set(result.v, mode="drop"),
        written=loop.written + jnp.sum(rows < len(loop.q)),
        totals=loop.totals + result.totals,
        code=jnp.where(result.fails, result.code, loop.code),
        running=loop.running & ~result.fails,
    )


def _apply_pending(hybrid: Hybrid, loop: LoopState, max_events: int) -> LoopState:
    """Apply the event that is pending, and record it."""
    E, k, state, record = hybrid.count, jnp.maximum(loop.pending, 0), loop.state, loop.record
    rests = comes_to_rest(hybrid, k, loop.values)
    found = apply_event(hybrid, k, rests, state, loop.values)
    full, place = record.count >= max_events, jnp.where(record.count < max_events, record.count, max_events)
    put = lambda x, y: x.at[place].set(y, mode="drop")  # noqa: E731
    e = k % E
    code = jnp.where(jnp.array(hybrid.mask(Stop))[e] & (k < E), Result.event_stop, loop.code)
    code = jnp.where(rests & jnp.array(_stops_at_rest(hybrid))[e], Result.at_rest, code)
    code = jnp.where(found.blocked, Result.event_impossible, code)
    code = jnp.where(full, Result.event_limit, code)
    contact = jnp.array(hybrid.impacts)[e] | (k >= E)
    sides = loop.sides.at[e].set(jnp.where(contact, 1, -loop.sides[e])).at[E + e].set(1)
    interval = state.t - record.last
    return loop._replace(
        state=choose(full | found.blocked, state, found.state),
        sides=sides,
        pending=jnp.array(NO_EVENT),
        reach=jnp.where(interval > 0, jnp.minimum(loop.reach, 2 * interval), loop.reach),
        record=EventRecord(
            put(record.t, state.t),
            put(record.index, jnp.where(rests, 2 * E + k, k)),
            put(record.phase, found.state.phase),
            put(record.q, jnp.stack([state.q, found.state.q])),
            put(record.v, jnp.stack([state.v, found.state.v])),
            record.count + jnp.where(full, 0, 1),
            state.t,
        ),
        code=code,
        running=loop.running & (code == Result.successful),
    )


def _stops_at_rest(hybrid: Hybrid) -> Bool[np.ndarray, "E"]:
    """Tell which impacts end the run when they come to rest."""
    return np.array([isinstance(e.action, Impact) and e.action.at_rest == "stop" for e in hybrid.events])


def _fill_end(loop: LoopState, ts: Float[Array, "T"]) -> LoopState:
    """Fill the outputs at the very end, an event's time or the last, with the state there."""
    end = (np.arange(len(ts)) >= loop.written) & (ts <= loop.state.t)
    q, v = (jnp.where(end[:, None], x, y) for x, y in ((loop.state.q, loop.q), (loop.state.v, loop.v)))
    return loop._replace(q=q, v=v, written=loop.written + jnp.sum(end))
