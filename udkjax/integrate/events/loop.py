"""The loop of a run with events: integrate a window, locate the first crossing in it, apply the event, go on.

One pass of the loop is one run of the integrator, or one jump, so that the members of a batch each take their own course through
one program.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.events.actions import Stop
from udkjax.integrate.events.crossings import NO_EVENT, ZERO, ConditionValues, first_crossing, side_of_zero
from udkjax.integrate.events.hybrid import Hybrid, RunState
from udkjax.integrate.events.impacts import CLOSED, OPEN
from udkjax.integrate.events.jumps import apply_event
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
from udkjax.native.conditions import FINER

BEGIN = -2  # instead of an event: the conditions at the start are not known yet


class EventRecord(NamedTuple):
    """The events so far, with room for K."""

    t: Float[Array, "K"]
    index: Int[Array, "K"]  # of the event; plus E where a contact is released, plus 2 E where it comes to rest
    phase: Int[Array, "K"]  # after it
    q: Float[Array, "K 2 n"]  # before and after
    v: Float[Array, "K 2 n"]
    together: Bool[Array, "K"]  # whether it happens with the one before it, as one event
    closed: Int[Array, "K E"]  # the states of all contacts, as in `ContactChanges`
    count: Int[Array, ""]
    last: Float[Array, ""]  # the time of the last one


class LoopState(NamedTuple):
    """Everything that changes in the loop."""

    state: RunState
    values: ConditionValues
    sides: Int[Array, "2E"]  # the last known side of zero of each condition: -1, 1, or 0: not known
    carried: Bool[Array, "E"]  # the contacts that are held at zero by others that are at rest
    pending: Int[Array, ""]  # the event that happens now; or NO_EVENT, or BEGIN
    search: Search
    reach: Float[Array, ""]  # length of the next window (s)
    quiet: Float[Array, "2E"]  # the time up to which each condition has no crossings in pairs
    unresolved: Float[Array, "2E"]  # the time from which on a condition varies too quickly to be sure of its crossings, or inf
    undefined: Bool[Array, "E"]  # the conditions that are not a number where the run ends by that
    q: Float[Array, "T n"]  # outputs
    v: Float[Array, "T n"]
    written: Int[Array, ""]  # number of these
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
        state: state at the beginning of the run.
        code: the `Result` as far as it is known before.
        drift_tol: the violation of the constraints that ends the run.
        max_events: most events that may happen.
    """
    first = _first_loop_state(hybrid, ts, state, code, max_events)

    def jump(loop: LoopState) -> LoopState:
        applied = jax.lax.cond(loop.pending >= 0, lambda loop: _apply_pending(hybrid, loop, max_events), lambda loop: loop, loop)
        return _after_event(hybrid, loop, applied, _values(hybrid, loop, applied.state))

    def go_on(loop: LoopState) -> LoopState:
        result = _integrate(hybrid, ts, drift_tol, loop)
        return _after_window(hybrid, loop, result, _values(hybrid, loop, result.end))

    def body(loop: LoopState) -> LoopState:
        loop = jax.lax.cond(loop.pending != NO_EVENT, jump, go_on, loop)
        more = (loop.state.t < ts[-1]) | (loop.pending >= 0)
        too_long = (loop.totals[0] >= hybrid.max_steps) & loop.running & more
        code = jnp.where(too_long, Result.step_limit, loop.code)
        return loop._replace(code=code, running=loop.running & more & ~too_long)

    return _fill_end(jax.lax.while_loop(lambda loop: loop.running, body, first), ts)


def _values(hybrid: Hybrid, loop: LoopState, state: RunState) -> ConditionValues:
    """Return the conditions in a state, whose scales do not become smaller than they were."""
    values = hybrid.values(state)
    scale = jnp.where(jnp.isfinite(values.scale), values.scale, 0.0)  # beyond where a condition is a number it has no scale
    return values._replace(scale=jnp.maximum(scale, loop.values.scale))


def _watched(hybrid: Hybrid, loop: LoopState) -> Bool[Array, "2E"]:
    """Return a mask of the conditions and contact forces that count."""
    held = hybrid.is_held(loop.state.phase)
    return jnp.append(~held & ~loop.carried, held)


def _integrate(hybrid: Hybrid, ts: Float[Array, "T"], drift_tol: Float[Array, ""], loop: LoopState) -> WindowResult:
    window = plan_window(hybrid, ts, loop.state, loop.search, loop.reach, loop.quiet, loop.written)
    looked_at = loop.sides, loop.values.scale, _watched(hybrid, loop), loop.search, loop.quiet, jnp.isfinite(loop.unresolved)
    return integrate_window(hybrid, window, loop.state, *looked_at, drift_tol)


def _first_loop_state(hybrid: Hybrid, ts: Float[Array, "T"], state: RunState, code: Int[Array, ""], max_events: int) -> LoopState:
    E, n, T = hybrid.count, len(state.q), len(ts)
    nothing = jnp.full((T, n), jnp.inf, float)
    none, zeros = jnp.full(max_events, -1, int), jnp.zeros(2 * E)
    states, times = jnp.full((max_events, 2, n), jnp.inf, float), jnp.full(max_events, jnp.inf, float)
    open_ = jnp.full((max_events, E), OPEN, int)
    return LoopState(
        state=state,
        values=ConditionValues(zeros, zeros, zeros, jnp.zeros(n), zeros),
        sides=jnp.zeros(2 * E, int),
        carried=jnp.zeros(E, bool),
        pending=jnp.array(BEGIN),
        search=no_search(ts[0]),
        reach=ts[-1] - ts[0],
        quiet=jnp.full(2 * E, ts[0]),
        unresolved=jnp.full(2 * E, jnp.inf),
        undefined=jnp.zeros(E, bool),
        q=nothing,
        v=nothing,
        written=jnp.array(0),
        record=EventRecord(times, none, none, states, states, none > 0, open_, jnp.zeros((), int), ts[0]),
        code=code,
        running=code == Result.successful,
        totals=jnp.zeros(4, int),
    )


def _after_event(hybrid: Hybrid, loop: LoopState, jumped: LoopState, values: ConditionValues) -> LoopState:
    """Return the loop after an event, or at the start, with the event that happens at once."""
    new = choose(loop.pending == BEGIN, _begin(hybrid, jumped, values), jumped)
    # The contacts that were closed are settled: their next event takes time.
    settled = (loop.pending >= 0) & (new.record.closed[jnp.maximum(new.record.count - 1, 0)] > OPEN)
    now = jnp.where(jnp.append(settled, jnp.zeros_like(settled)), new.sides, side_of_zero(values, hybrid.rate))
    pending = first_crossing(hybrid.directions, _watched(hybrid, new), new.sides, now)
    return new._replace(values=values, pending=jnp.where(new.running, pending, NO_EVENT))


def _begin(hybrid: Hybrid, loop: LoopState, values: ConditionValues) -> LoopState:
    """Return the loop with the sides of zero of the conditions at the start."""
    is_zero = jnp.abs(values.h) <= ZERO * values.scale
    # Contacts are approached from the side that is allowed: a condition that is zero and falls at the start happens at once.
    impacts = np.append(hybrid.impacts, np.zeros(hybrid.count, bool))
    sides = jnp.where(impacts & is_zero, 1, side_of_zero(values, hybrid.rate))
    beyond = jnp.any(impacts & (values.h < 0) & ~is_zero)
    undefined = ~jnp.isfinite(values.h[: hybrid.count])
    code = jnp.where(beyond, Result.beyond_contact, loop.code)
    code = jnp.where(jnp.any(undefined), Result.undefined_condition, code)
    return loop._replace(sides=sides, undefined=undefined, code=code, running=loop.running & (code == Result.successful))


def _after_window(hybrid: Hybrid, loop: LoopState, result: WindowResult, values: ConditionValues) -> LoopState:
    """Return the loop after a run of the integrator: it goes on, searches on, or an event is pending."""
    E, end = hybrid.count, result.end
    step, now = step_search(hybrid, result, values), side_of_zero(values, hybrid.rate)
    k = jnp.maximum(result.search.event, 0)
    search = choose(step.is_found | step.is_lost, no_search(loop.state.t), step.search)
    h = step.change
    at_event = end._replace(t=end.t + h, q=end.q + h * end.v + h**2 / 2 * values.a, v=end.v + h * values.a)
    state = choose(step.is_found, at_event, choose(step.continues, loop.state, result.reached))
    # At the end of the run every condition that is not zero tells its side; what is located tells it by happening.
    others = (np.arange(2 * E) != jnp.where(step.is_found, k, -1)) & (jnp.abs(values.h) > ZERO * values.scale)
    sides = jnp.where(step.continues, loop.sides, result.sides)
    goes_on = (search.event < 0) & ~result.is_coarse  # else the end of the window lies beyond the motion
    is_over = (search.event < 0) & ~step.is_lost & ~result.fails & ~result.is_coarse
    pending = jnp.where(is_over, first_crossing(hybrid.directions, _watched(hybrid, loop), sides, now), NO_EVENT)
    pending = jnp.where(step.is_found, k, pending)
    sides = jnp.where(step.is_found & others, now, sides)
    sides = sides.at[k].set(jnp.where(step.is_found, result.search.side, sides[k]))
    output, due = result.window.output, result.window.due
    rows = jnp.where((output < len(loop.q)) & (due < state.t), output, len(loop.q))
    length = result.window.times[-1] - result.window.times[0]
    reach = jnp.where(result.is_coarse, length / FINER, jnp.where(search.event >= 0, loop.reach, 2 * loop.reach))
    return loop._replace(
        state=state,
        values=values._replace(rate=values.rate + h * values.rate_2, scale=jnp.where(goes_on, values.scale, loop.values.scale)),
        sides=sides,
        carried=loop.carried & (jnp.abs(values.h[:E]) <= CLOSED * values.scale[:E]),
        pending=jnp.where(result.fails, NO_EVENT, pending),
        search=search,
        reach=reach,
        quiet=loop.quiet.at[k].set(jnp.where(step.is_lost, result.search.until, loop.quiet[k])),
        unresolved=jnp.where(result.unresolved & jnp.isinf(loop.unresolved), state.t, loop.unresolved),
        undefined=result.undefined,
        q=loop.q.at[rows].set(result.q, mode="drop"),
        v=loop.v.at[rows].set(result.v, mode="drop"),
        written=loop.written + jnp.sum(rows < len(loop.q)),
        totals=loop.totals + result.totals,
        code=jnp.where(result.fails, result.code, loop.code),
        running=loop.running & ~result.fails,
    )


def _apply_pending(hybrid: Hybrid, loop: LoopState, max_events: int) -> LoopState:
    """Apply the event that is pending, and record it with the contacts that take part in it."""
    E, k, state, record = hybrid.count, jnp.maximum(loop.pending, 0), loop.state, loop.record
    held, e = hybrid.is_held(state.phase), k % E
    found = apply_event(hybrid, k, state, loop.values)
    code = jnp.where(jnp.array(hybrid.mask(Stop))[e] & (k < E), Result.event_stop, loop.code)
    sides = loop.sides.at[e].set(jnp.where(jnp.array(hybrid.impacts)[e] | (k >= E), 1, -loop.sides[e]))
    carried, happens, closed = loop.carried, np.arange(3 * E) == k, jnp.full(E, OPEN)
    if found.contacts is not None:
        contacts = found.contacts
        closed = contacts.closed
        rests = (contacts.held & ~held) | contacts.ends
        happens = jnp.concatenate([contacts.hits, held & ~contacts.held, rests])
        # The event itself is noted first, be it a contact that only comes to rest.
        k = jnp.where((k < E) & ~contacts.hits[e] & rests[e], 2 * E + k, k)
        carried = jnp.where(closed > OPEN, contacts.carried, carried)
        code = jnp.where(jnp.any(contacts.ends), Result.at_rest, code)
        sides = jnp.where(jnp.tile(closed > OPEN, 2), 1, sides)
    code = jnp.where(found.blocked, Result.event_impossible, code)
    others = happens & (np.arange(3 * E) != k)
    count = 1 + jnp.sum(others)
    full = record.count + count > max_events
    code = jnp.where(full, Result.event_limit, code)
    rows = jnp.append(record.count, record.count + jnp.cumsum(others))
    rows = jnp.where(jnp.append(True, others) & ~full, rows, max_events)
    put = lambda x, y: x.at[rows].set(y, mode="drop")  # noqa: E731
    interval = state.t - record.last
    return loop._replace(
        state=choose(full | found.blocked, state, found.state),
        sides=sides,
        carried=carried,
        pending=jnp.array(NO_EVENT),
        reach=jnp.where(interval > 0, jnp.minimum(loop.reach, 2 * interval), loop.reach),
        record=EventRecord(
            put(record.t, state.t),
            put(record.index, jnp.append(k, np.arange(3 * E))),
            put(record.phase, found.state.phase),
            put(record.q, jnp.stack([state.q, found.state.q])),
            put(record.v, jnp.stack([state.v, found.state.v])),
            put(record.together, jnp.append(False, others)),
            put(record.closed, closed),
            record.count + jnp.where(full, 0, count),
            state.t,
        ),
        code=code,
        running=loop.running & (code == Result.successful),
    )


def _fill_end(loop: LoopState, ts: Float[Array, "T"]) -> LoopState:
    """Fill the outputs at the very end, an event's time or the last, with the state there."""
    end = (np.arange(len(ts)) >= loop.written) & (ts <= loop.state.t)
    q, v = (jnp.where(end[:, None], x, y) for x, y in ((loop.state.q, loop.q), (loop.state.v, loop.v)))
    return loop._replace(q=q, v=v, written=loop.written + jnp.sum(end))
