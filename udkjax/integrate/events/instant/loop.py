"""The loop of runs with events: integrate to the next crossing, apply its events, and repeat.

Members of a batch at the same stage proceed together. A `System` takes them to their next crossings: by machine code, all members
at once, or in its plain form, one window of a single member at a time.
"""

from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Int

from udkjax.integrate.events.instant.hops import ends_hop, return_to_top
from udkjax.integrate.events.instant.impacts import CLOSED_TOL, OPEN
from udkjax.integrate.events.instant.jumps import apply_event
from udkjax.integrate.events.instant.runs import AFTER_EVENT, AT_START, RECORD_FIELDS, MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.instant.sticking import begin_with_friction
from udkjax.integrate.events.instant.system import StateValues, System, condition_values
from udkjax.integrate.events.law.crossings import (
    NO_EVENT,
    ZERO_RATE_TOL,
    ZERO_TOL,
    ConditionValues,
    crosses,
    first_crossing,
    side_of_zero,
)
from udkjax.integrate.events.law.kinks import FREE_SIDE, MOST_KINKS
from udkjax.integrate.solution import Result
from udkjax.native.watching.conditions import RESOLUTION

CONTACT_STATE_FIELD, INDEX_FIELD = RECORD_FIELDS.index("contact_state"), RECORD_FIELDS.index("event_index")


def run_loop(system: System, runs: MemberRuns) -> MemberRuns:
    """Return the runs, led from their start to the last output time or to an event that ends them."""
    if system.plan.sticking:
        runs = begin(system, runs)
        runs = runs._replace(first_phase=runs.phase + False, first_sides=system.sides(None, runs.joints) + 0.0)

    def change(runs: MemberRuns) -> MemberRuns:
        runs = system.when(runs.running & (runs.event == NO_EVENT), system.advance, runs)
        return settle(system, runs)

    return system.repeat(change, runs)


def begin(system: System, runs: MemberRuns) -> MemberRuns:
    """Return the runs at their start, with the modes of all joints that may stick decided."""
    return system.when(runs.running, partial(begin_with_friction, system), runs)


def settle(system: System, runs: MemberRuns) -> MemberRuns:
    """Return the runs after the next event at their present times, if any; `event` is AFTER_EVENT if another may follow."""
    if system.plan.held_at_rest.sum() > 1:
        runs = system.when(ends_hop(system, runs), partial(return_to_top, system), runs)
    return system.when(runs.running, partial(_settle, system), runs)


def _settle(system: System, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
    """Return the runs after the next event, if any, of members at their present times: at the start, a crossing or an event."""
    plan, xp, E = system.plan, system.xp, system.plan.count
    state, event, sides = runs.state(members), take(runs.event, members), take(runs.sides, members)
    values, state_values = condition_values(system, members, state)
    values = values._replace(scale=xp.maximum(values.scale, take(runs.scale, members)))  # scales never decrease
    size, is_current = xp.abs(values.h), np.arange(E) == event[:, None]
    carried = _carried(system, members, take(runs.carried, members) & (size <= CLOSED_TOL * values.scale), state.joints)
    undefined, ends = ~xp.isfinite(values.h), state.t >= take(system.end, members)
    # A located condition keeps its side until its event happens, and so does one that has crossed zero just before a located one:
    # it is located next, unless it has just had its event, and is late by the error of the event's time. Any other nonzero
    # condition is on the side of its sign.
    watched, sign = plan.watched(state.phase, carried, xp)[:, :E], xp.sign(values.h).astype(int)
    is_late = size * take(system.rate, members)[:, None] <= RESOLUTION.late * state_values.rate * sides[:, :E]
    has_crossed = crosses(plan.both_directions[:E], sides[:, :E], sign)
    keeps = watched & (has_crossed | is_late) & (event >= 0)[:, None]
    # The side of a joint's speed is that of its direction, until its event: it is zero below a larger bound (`zero_of`).
    known = (event >= NO_EVENT)[:, None] & ~is_current & (size > ZERO_TOL * values.scale) & ~keeps & ~plan.slides
    after = xp.where(known, sign, sides[:, :E])
    code = xp.where(take(runs.totals, members)[:, 0] >= plan.max_steps, Result.step_limit, Result.successful)
    unknown = (event < NO_EVENT) | ((event == NO_EVENT) & ends)  # otherwise conditions at zero will be located as they cross
    hits = (event >= 0) & (event < E) & xp.asarray(plan.impacts & ~plan.impacts.all())[event % E]
    if xp is not np or (unknown | hits).any():
        begins, falling = event == AT_START, plan.impacts | plan.kinks | plan.slides
        is_zero, now = size <= ZERO_TOL * values.scale, side_of_zero(values, take(system.rate, members), xp)
        # Contacts are approached from the allowed side: an impact whose condition is zero at the start and falls happens at once.
        before = xp.where(begins[:, None], xp.where(falling & is_zero, 1, now), sides[:, :E])
        now = xp.where(
            plan.slides & ~begins[:, None] & ~is_zero, before, now
        )  # a reversal at a speed that counts as zero is none
        watched = watched & ~((event == AFTER_EVENT)[:, None] & _settled(system, runs, members))
        crossing = first_crossing(plan.both_directions[:E], watched, before, now, xp)
        # A condition that an impact turns back at zero has reached zero before: its event comes first.
        others = first_crossing(plan.both_directions[:E], watched & is_zero & ~plan.impacts, before, now, xp)
        crossing = xp.where(others != NO_EVENT, others, crossing)
        after = xp.where(begins[:, None], before, after)
        beyond = begins & xp.any(plan.impacts & (values.h < 0) & ~is_zero, -1)
        code = xp.where(beyond, Result.beyond_contact, xp.where(begins, Result.successful, code))
        event = xp.where(unknown, crossing, xp.where(hits & (others != NO_EVENT), others, event))
    goes_on = (event >= 0) | ~ends
    code = xp.where(goes_on | (code != Result.step_limit), code, Result.successful)
    code = xp.where(xp.any(undefined, -1), Result.undefined_condition, code)
    runs = runs.put(
        members,
        event=event,
        sides=xp.concatenate([after, sides[:, E:]], axis=1),
        scale=values.scale,
        carried=carried,
        undefined=undefined,
        code=code,
        running=goes_on & (code == Result.successful),
    )
    happens = runs.running & (runs.event >= 0)

    def jump(runs: MemberRuns, jumping: MemberIndices) -> MemberRuns:
        if jumping is None:
            return _jump(system, runs, jumping, values, state_values)
        mask = take(happens, members)
        selected = ConditionValues(*(x[mask] for x in values)), StateValues(*(x[mask] for x in state_values))
        return _jump(system, runs, jumping, *selected)

    return system.when(happens, jump, runs)


def _settled(system: System, runs: MemberRuns, members: MemberIndices) -> Bool[Any, "b E"]:
    """Return a mask of the conditions that the last event has settled: of its contacts, and its own if it changes nothing."""
    xp, plan = system.xp, system.plan
    last = xp.maximum(take(runs.count, members) - 1, 0)
    indices = np.arange(len(runs.t)) if members is None else members
    contact_state, index = (runs.record[k][indices, last] for k in (CONTACT_STATE_FIELD, INDEX_FIELD))
    return (contact_state > OPEN) | ((np.arange(plan.count) == index[:, None]) & ~plan.changes)


def _jump(
    system: System, runs: MemberRuns, members: MemberIndices, values: ConditionValues, state_values: StateValues
) -> MemberRuns:
    """Return the runs after the events of members, which are recorded with the contacts that take part."""
    plan, xp, E, K = system.plan, system.xp, system.plan.count, system.plan.room
    k, before = take(runs.event, members), runs.state(members)
    sides, carried = take(runs.sides, members), take(runs.carried, members)
    was_free = system.sides(members, before.joints) == FREE_SIDE
    releases, e = k >= E, k % E
    held, acts = plan.held(before.phase, xp), releases | xp.asarray(plan.changes)[e]
    after, contacts, result = apply_event(system, members, k, before, values, state_values)
    code = xp.where(xp.asarray(plan.stops)[e] & ~releases, Result.event_stop, Result.successful)
    is_current = np.arange(2 * E) == e[:, None]
    falls = xp.asarray(plan.impacts | plan.kinks | plan.slides)[e] | releases
    sides = xp.where(is_current, xp.where(falls[:, None], 1, -sides), sides)
    if plan.adds.any():
        sides = xp.where(is_current & _stands(system, members, e, after, values, state_values)[:, None], 0, sides)
    noted, others, contact_state = k[:, None], xp.zeros((len(k), 0), bool), xp.full(held.shape, OPEN)
    if contacts is not None:
        contact_state = contacts.contact_state
        rests = (contacts.held & ~held) | contacts.ends
        happens = xp.concatenate([contacts.hits, held & ~contacts.held, rests], axis=1)
        # The event itself is recorded first, even if its contact only comes to rest.
        only_rests = xp.any(is_current[:, :E] & ~contacts.hits & rests, -1) & ~releases
        first = xp.where(only_rests, 2 * E + k, k)[:, None]
        others = happens & (np.arange(3 * E) != first)
        noted = xp.concatenate([first, xp.zeros_like(first) + np.arange(3 * E)], axis=1)
        carried = xp.where(contact_state > OPEN, contacts.carried, carried)
        code = xp.where(xp.any(contacts.ends, -1), Result.at_rest, code)
        turned_back = ~plan.impacts & (xp.abs(values.h) <= ZERO_TOL * values.scale) & xp.any(contact_state > OPEN, -1)[:, None]
        is_closed = xp.concatenate([contact_state, contact_state], axis=1) > OPEN
        sides = xp.where(is_closed, 1, xp.where(xp.concatenate([turned_back, xp.zeros_like(turned_back)], axis=1), 0, sides))
    blocked = result != Result.successful
    code = xp.where(blocked, result, code)
    if plan.sticking:  # joints slide, and forces stay, on the allowed side of zero
        sides = xp.where(np.append(plan.slides, plan.slides), 1, sides)

    count = take(runs.count, members)
    is_noted = xp.concatenate([xp.ones_like(others, shape=(len(k), 1)), others], axis=1)
    total = xp.sum(is_noted, axis=1)
    is_kink = xp.asarray(plan.kinks)[e] & ~releases
    kinks, turned = runs.kink_count(plan, members), system.sides(members, after.joints)
    is_full = (count - kinks + total > plan.max_events) & ~is_kink
    # So many kinks are a force that chatters: its comparisons are not held any more, also after later events.
    chatters = (is_kink & (kinks + 1 >= MOST_KINKS))[:, None]
    turned = xp.where((chatters | was_free) & (np.arange(plan.side_count) >= plan.first_kink_side), FREE_SIDE, turned)
    after = after._replace(joints=system.with_sides(members, after.joints, turned))
    carried = _carried(system, members, carried, after.joints)
    code = xp.where(is_full, Result.event_limit, code)
    rows = xp.where(is_noted & ~is_full[:, None], count[:, None] + xp.cumsum(is_noted, axis=1) - 1, K)
    stays = (is_full | blocked)[:, None]
    q, v = xp.where(stays, before.q, after.q), xp.where(stays, before.v, after.v)
    runs = runs.note(
        members,
        rows,
        before.t[:, None],
        xp.concatenate([before.q[:, None], q[:, None]], axis=1)[:, None],
        xp.concatenate([before.v[:, None], v[:, None]], axis=1)[:, None],
        noted,
        after.phase[:, None],
        np.arange(noted.shape[1])[None] > 0,
        contact_state[:, None],
        turned[:, None],
    )
    follows = _may_follow(
        system, values, plan.watched(after.phase, carried, xp)[:, :E], contact_state, is_current[:, :E] & ~acts[:, None]
    )
    return runs.put(
        members,
        q=q,
        v=v,
        phase=xp.where(stays, before.phase, after.phase),
        event=xp.where(follows, AFTER_EVENT, NO_EVENT),
        sides=sides,
        carried=carried,
        count=count + xp.where(is_full, 0, total),
        code=code,
        running=(code == Result.successful) & (follows | (before.t < take(system.end, members))),
    )._replace(joints=after.joints)


def _stands(
    system: System, members: MemberIndices, e: Int[Any, "b"], after: RunState, values: ConditionValues, found: StateValues
) -> Bool[Any, "b"]:
    """Return a mask of the members in which a joint that event e adds stops its condition, which then stays at zero."""
    xp, own = system.xp, np.arange(system.plan.count) == e[:, None]
    rate = found.by_t + xp.sum(found.by_q * after.v[:, None], axis=-1)
    slow = xp.abs(rate) <= ZERO_RATE_TOL * values.scale * take(system.rate, members)[:, None]
    counts = system.plan.adds & ~system.plan.follows_velocity
    return xp.any(own & slow & counts, axis=-1)


def _carried(system: System, members: MemberIndices, carried: Bool[Any, "b E"], joints: Any) -> Bool[Any, "b E"]:
    """Return a mask of the conditions that are not watched.

    These are the conditions of carried contacts, of directions in which joints do not slide, and of kinks whose sides are free.
    """
    plan, sides = system.plan, system.sides(members, joints)
    if plan.sticking:
        carried = (carried & ~plan.slides) | plan.not_sliding(sides, system.xp)
    return carried | (~system.xp.isfinite(sides)[:, plan.side_of] & plan.kinks) if plan.has_kinks else carried


def _may_follow(
    system: System, values: ConditionValues, watched: Bool[Any, "b E"], contact_state: Int[Any, "b E"], settled: Bool[Any, "b E"]
) -> Bool[Any, "b"]:
    """Return a mask of the members whose event may cause another one at the same instant.

    A condition depends on velocities, or a watched one is zero, not `settled`, and of no closed contact. `contact_state` has the
    states of contacts at the event (OPEN, REBOUNDS, SLOW); `settled` marks an event that changes nothing. Joints with set-valued
    friction are left out: a single decision covers every joint at rest.
    """
    unclear = watched & ~settled & (contact_state == OPEN) & (system.xp.abs(values.h) <= ZERO_TOL * values.scale)
    return system.xp.any((unclear | system.plan.follows_velocity) & ~system.plan.slides, axis=-1)
