"""The loop of runs with events: integrate to the next crossing, apply what happens there, and repeat.

Members of a batch that are at the same stage go on together. What takes them to their next crossings is a `System`:
machine code, all members at once, or the plain form, one window of one member at a time.
"""

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from udkjax.integrate.events.crossings import NO_EVENT, ZERO, ConditionValues, first_crossing, side_of_zero
from udkjax.integrate.events.impacts import CLOSED, OPEN
from udkjax.integrate.events.jumps import apply_event
from udkjax.integrate.events.runs import AGAIN, BEGIN, RECORD, MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.system import StateValues, System
from udkjax.integrate.solution import Result
from udkjax.transforms.gradients import stop_gradients

CLOSED_FIELD, INDEX_FIELD = RECORD.index("closed"), RECORD.index("event_index")


def run_loop(system: System, runs: MemberRuns) -> MemberRuns:
    """Run from the start to the last of the output times, or an event that stops."""

    def change(runs: MemberRuns) -> MemberRuns:
        runs = system.when(runs.running & (runs.event == NO_EVENT), system.advance, runs)
        return system.when(runs.running, partial(_settle, system), runs)

    return system.repeat(change, runs)


def _settle(system: System, runs: MemberRuns, some: MemberIndices) -> MemberRuns:
    """Return the runs with all that happens now to some members: at the start, after an event, or at a crossing."""
    plan, xp, E = system.plan, system.xp, system.plan.count
    state, event, sides = runs.state(some), take(runs.event, some), take(runs.sides, some)
    values, found = condition_values(system, some, state)
    values = values._replace(scale=xp.maximum(values.scale, take(runs.scale, some)))  # they do not become smaller
    size, own = xp.abs(values.h), np.arange(E) == event[:, None]
    carried = take(runs.carried, some) & (size <= CLOSED * values.scale)
    undefined, ends = ~xp.isfinite(values.h), state.t >= take(system.end, some)
    # A condition that is located keeps its side until the event happens; one that is not zero is on the side of its sign.
    known = (event >= NO_EVENT)[:, None] & ~own & (size > ZERO * values.scale)
    after = xp.where(known, xp.sign(values.h).astype(int), sides[:, :E])
    code = xp.where(take(runs.totals, some)[:, 0] >= plan.max_steps, Result.step_limit, Result.successful)
    unknown = (event < NO_EVENT) | ((event == NO_EVENT) & ends)  # elsewhere what is zero is about to cross, and is located
    if xp is not np or unknown.any():
        begins = event == BEGIN
        is_zero, now = size <= ZERO * values.scale, side_of_zero(values, take(system.rate, some), xp)
        # Contacts are approached from the side that is allowed: what is zero and falls at the start happens at once.
        before = xp.where(begins[:, None], xp.where(plan.impacts & is_zero, 1, now), sides[:, :E])
        watched = plan.watched(state.phase, carried, xp)[:, :E]
        watched = watched & ~((event == AGAIN)[:, None] & _settled(system, runs, some))
        crossing = first_crossing(plan.both_directions[:E], watched, before, now, xp)
        after = xp.where(begins[:, None], before, after)
        beyond = begins & xp.any(plan.impacts & (values.h < 0) & ~is_zero, -1)
        code = xp.where(beyond, Result.beyond_contact, xp.where(begins, Result.successful, code))
        event = xp.where(unknown, crossing, event)
    goes_on = (event >= 0) | ~ends
    code = xp.where(goes_on | (code != Result.step_limit), code, Result.successful)
    code = xp.where(xp.any(undefined, -1), Result.undefined_condition, code)
    runs = runs.put(
        some,
        event=event,
        sides=xp.concatenate([after, sides[:, E:]], axis=1),
        scale=values.scale,
        carried=carried,
        undefined=undefined,
        code=code,
        running=goes_on & (code == Result.successful),
    )
    happens = runs.running & (runs.event >= 0)

    def jump(runs: MemberRuns, those: MemberIndices) -> MemberRuns:
        if those is None:
            return _jump(system, runs, those, values, found)
        chosen = take(happens, some)
        of = ConditionValues(*(x[chosen] for x in values)), StateValues(*(x[chosen] for x in found))
        return _jump(system, runs, those, *of)

    return system.when(happens, jump, runs)


def condition_values(system: System, some: MemberIndices, at: RunState) -> tuple[ConditionValues, StateValues]:
    """Return the conditions of some members at their states, and the other quantities evaluated there."""
    xp, found, unit = system.xp, system.look(some, at), take(system.coordinates, some)
    rate, t = take(system.rate, some)[:, None], at.t[:, None]
    by_q = xp.abs(found.by_q) * xp.maximum(unit, xp.abs(at.q))[:, None]
    by_v = xp.abs(found.by_v) * xp.maximum(unit * rate, xp.abs(at.v))[:, None]
    scale = xp.maximum(xp.maximum(by_q, by_v).max(2), xp.abs(found.by_t) * xp.maximum(1 / rate, xp.abs(t)))
    scale = xp.where(xp.isfinite(scale), scale, 0.0)  # beyond where a condition is a number it has no scale
    return ConditionValues(found.g, found.rate, found.rate_2, found.a, scale if xp is np else stop_gradients(scale)), found


def _settled(system: System, runs: MemberRuns, some: MemberIndices) -> Bool[Any, "b E"]:
    """Return a mask of the conditions settled by the last event: its contacts, and its own if it only took note."""
    xp, plan = system.xp, system.plan
    last = xp.maximum(take(runs.count, some) - 1, 0)
    members = np.arange(len(runs.t)) if some is None else some
    closed, index = (runs.record[k][members, last] for k in (CLOSED_FIELD, INDEX_FIELD))
    return (closed > OPEN) | ((np.arange(plan.count) == index[:, None]) & ~plan.changes)


def _jump(system: System, runs: MemberRuns, some: MemberIndices, values: ConditionValues, found: StateValues) -> MemberRuns:
    """Apply the events that happen to some members, and note them with the contacts that take part in them."""
    plan, xp, E, K = system.plan, system.xp, system.plan.count, system.plan.max_events
    k, before, sides, carried = take(runs.event, some), runs.state(some), take(runs.sides, some), take(runs.carried, some)
    releases, e = k >= E, k % E
    held, acts = xp.asarray(plan.held)[before.phase], releases | xp.asarray(plan.changes)[e]
    after, contacts, blocked = apply_event(system, some, k, before, values, found)
    code = xp.where(xp.asarray(plan.stops)[e] & ~releases, Result.event_stop, Result.successful)
    own = np.arange(2 * E) == e[:, None]
    sides = xp.where(own, xp.where((xp.asarray(plan.impacts)[e] | releases)[:, None], 1, -sides), sides)
    noted, others, closed = k[:, None], xp.zeros((len(k), 0), bool), xp.full(held.shape, OPEN)
    if contacts is not None:
        closed = contacts.closed
        rests = (contacts.held & ~held) | contacts.ends
        happens = xp.concatenate([contacts.hits, held & ~contacts.held, rests], axis=1)
        # The event itself is noted first, be it a contact that only comes to rest.
        only_rests = xp.any(own[:, :E] & ~contacts.hits & rests, -1) & ~releases
        first = xp.where(only_rests, 2 * E + k, k)[:, None]
        others = happens & (np.arange(3 * E) != first)
        noted = xp.concatenate([first, xp.zeros_like(first) + np.arange(3 * E)], axis=1)
        carried = xp.where(closed > OPEN, contacts.carried, carried)
        code = xp.where(xp.any(contacts.ends, -1), Result.at_rest, code)
        sides = xp.where(xp.concatenate([closed, closed], axis=1) > OPEN, 1, sides)
    code = xp.where(blocked, Result.event_impossible, code)

    count = take(runs.count, some)
    is_noted = xp.concatenate([xp.ones_like(others, shape=(len(k), 1)), others], axis=1)
    total = xp.sum(is_noted, axis=1)
    full = count + total > K
    code = xp.where(full, Result.event_limit, code)
    rows = xp.where(is_noted & ~full[:, None], count[:, None] + xp.cumsum(is_noted, axis=1) - 1, K)
    stays = (full | blocked)[:, None]
    q, v = xp.where(stays, before.q, after.q), xp.where(stays, before.v, after.v)
    runs = runs.note(
        some,
        rows,
        before.t[:, None],
        xp.concatenate([before.q[:, None], q[:, None]], axis=1)[:, None],
        xp.concatenate([before.v[:, None], v[:, None]], axis=1)[:, None],
        noted,
        after.phase[:, None],
        np.arange(noted.shape[1])[None] > 0,
        closed[:, None],
    )
    follows = _may_follow(system, values, plan.watched(after.phase, carried, xp)[:, :E], closed, own[:, :E] & ~acts[:, None])
    return runs.put(
        some,
        q=q,
        v=v,
        phase=xp.where(stays[:, 0], before.phase, after.phase),
        event=xp.where(follows, AGAIN, NO_EVENT),
        sides=sides,
        carried=carried,
        count=count + xp.where(full, 0, total),
        code=code,
        running=(code == Result.successful) & (follows | (before.t < take(system.end, some))),
    )._replace(joints=after.joints)


def _may_follow(
    system: System, values: ConditionValues, watched: Bool[Any, "b E"], closed: Int[Any, "b E"], own: Bool[Any, "b E"]
) -> Bool[Any, "b"]:
    """Return a mask of the members that another event may follow at once: a condition is zero, or depends on velocities."""
    unclear = watched & ~own & (closed == OPEN) & (system.xp.abs(values.h) <= ZERO * values.scale)
    return system.xp.any(unclear | np.array(system.plan.by_velocity), axis=-1)
