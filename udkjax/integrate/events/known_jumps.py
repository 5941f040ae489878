"""Jumps of members of a batch of runs with events, by NumPy: as `jumps`, by what machine code knows of their states."""

import numpy as np
from jaxtyping import Bool, Int

from udkjax.integrate.events.crossings import NO_EVENT, ZERO, ConditionValues, first_crossing, side_of_zero
from udkjax.integrate.events.impacts import ATTACHABLE, OPEN, ContactChanges, hit_contacts, rows_of_directions
from udkjax.integrate.events.phase_code import States
from udkjax.integrate.events.run_members import RunMembers
from udkjax.integrate.solution import Result


def apply_events(
    members: RunMembers, some: Int[np.ndarray, "b"], event: Int[np.ndarray, "b"], values: ConditionValues, states: States
):
    """Apply the events that happen to some members, if any, and those that follow at the same instant.

    Args:
        members: all members.
        some: indices of the members concerned.
        event: of each, what happens: `NO_EVENT`, or the number of an event, from E on of a contact that lets go.
        values: their conditions.
        states: their derivatives, and directions of impulses.
    """
    while True:
        happens = event != NO_EVENT
        idle = some[~happens]
        members.running[idle] &= members.t[idle] < members.ts[idle, -1]
        if not happens.any():
            return
        some, event = some[happens], event[happens]
        values, states = ConditionValues(*(x[happens] for x in values)), States(*(x[happens] for x in states))
        event = _apply(members, some, event, values, states)
        runs = members.running[some]
        some, event = some[runs], event[runs]
        if (event == NO_EVENT).all():
            members.running[some] &= members.t[some] < members.ts[some, -1]
            return
        values, states = members.look(some)


def _apply(
    members: RunMembers, some: Int[np.ndarray, "b"], k: Int[np.ndarray, "b"], values: ConditionValues, states: States
) -> Int[np.ndarray, "b"]:
    """Apply one event to each of some members, and note it; return what then happens at once."""
    E, K, rows = members.event_count, members.plan.max_events, np.arange(len(some))
    e, releases, phase = k % E, k >= E, members.phase[some]
    held, v, after = members.held[phase] >= 0, members.v[some], np.where(releases, phase, members.after[phase, e])
    acts, carried = releases | members.changes[e], members.carried[some].copy()
    code = np.where(members.stops[e] & ~releases, Result.event_stop, members.code[some])
    sides = members.sides[some].copy()
    sides[rows, e] = np.where(members.impacts[e] | releases, 1, -sides[rows, e])
    closed, happens, noted = np.full((len(some), E), OPEN), np.zeros((len(some), 3 * E), bool), k.copy()
    q, blocked = members.q[some], np.zeros(len(some), bool)
    if members.plan.added:
        q, v, blocked = _attach(members, some, k, after)
    if members.impacts.any() and acts.any():
        j = np.flatnonzero(acts)
        found, free = _hit(members, some[j], k[j], after[j], (q[j], v[j]), held[j], values, states, j)
        rests = (found.held & ~held[j]) | found.ends
        happens[j] = np.concatenate([found.hits, held[j] & ~found.held, rests], axis=1)
        own, at = np.arange(len(j)), e[j]
        # The event itself is noted first, be it a contact that only comes to rest.
        noted[j] = np.where(~releases[j] & ~found.hits[own, at] & rests[own, at], 2 * E + k[j], k[j])
        closed[j], v[j], blocked[j] = found.closed, found.v, blocked[j] | found.blocked
        carried = np.where(closed > OPEN, _put(carried, j, found.carried), carried)
        code[j] = np.where(found.ends.any(1), Result.at_rest, code[j])
        sides = np.where(np.tile(closed > OPEN, 2), 1, sides)
        after[j] = _with_contacts(members, free, found.held)
    code = np.where(blocked, Result.event_impossible, code)
    others = happens & (np.arange(3 * E) != noted[:, None])
    count = 1 + others.sum(1)
    full = members.count[some] + count > K
    code = np.where(full, Result.event_limit, code)
    changes = ~(full | blocked)
    before = members.q[some], members.v[some]
    members.q[some] = np.where(changes[:, None], q, members.q[some])
    members.v[some] = np.where(changes[:, None], v, members.v[some])
    members.phase[some] = np.where(changes, after, phase)
    members.sides[some], members.carried[some], members.code[some] = sides, carried, code
    members.note(some, np.where(others, np.arange(3 * E), -1), noted, full, before, closed, after)
    members.running[some] = code == Result.successful
    return _find_following(members, some, values, closed > OPEN, (np.arange(E) == e[:, None]) & ~acts[:, None])


def _put(x: np.ndarray, rows: np.ndarray, y: np.ndarray) -> np.ndarray:
    found = x.copy()
    found[rows] = y
    return found


def _hit(
    members: RunMembers,
    some: Int[np.ndarray, "b"],
    k: Int[np.ndarray, "b"],
    phase: Int[np.ndarray, "b"],
    after: tuple[np.ndarray, np.ndarray],
    held: Bool[np.ndarray, "b E"],
    values: ConditionValues,
    states: States,
    j: Int[np.ndarray, "b"],
) -> tuple[ContactChanges, Int[np.ndarray, "b"]]:
    """Hit the contacts of members that are closed at an event; return the phase without contacts at rest, too.

    `after` are positions and velocities with the joints that the event adds.
    """
    (q, v), free = after, _without_contacts(members, phase)
    values, own = ConditionValues(*(x[j] for x in values)), States(*(x[j] for x in states))
    if members.plan.added or not np.array_equal(free, members.phase[some]):
        own = members.look(some, (free, q, v))[1]
    rows = rows_of_directions(own.by_q, own.directions, members.inverse_mass[some])
    contacts = members.contacts_of(some)

    def second_rates(v: np.ndarray) -> np.ndarray:
        return members.look(some, (free, q, v))[1].rate_2

    return hit_contacts(contacts, k, v, held, values, rows, own.rate, second_rates, None, np), free


def _attach(
    members: RunMembers, some: Int[np.ndarray, "b"], k: Int[np.ndarray, "b"], phase: Int[np.ndarray, "b"]
) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "b"]]:
    """Return positions and velocities of members with the joints that events add, and to which these cannot be added.

    Velocities jump to a state that the phase allows, but for contacts at rest, which may be left.
    """
    q, v, adds = members.q[some].copy(), members.v[some].copy(), members.add_joints(some, k)
    free = _without_contacts(members, phase)
    for kind in np.unique(phase[adds]):
        j = np.flatnonzero(adds & (phase == kind))
        t, at = members.t[some[j]], members.phases[int(kind)]
        q[j] = at.project(some[j], t, q[j], v[j])[0]
        for without in np.unique(free[j]):
            i = j[free[j] == without]
            v[i] = members.phases[int(without)].project(some[i], members.t[some[i]], q[i], v[i])[1]
    moved = np.abs(q - members.q[some]) / members.unit[some]
    return q, v, adds & (moved.max(1) > ATTACHABLE)


def _without_contacts(members: RunMembers, phase: Int[np.ndarray, "b"]) -> Int[np.ndarray, "b"]:
    """Return the phases that follow when all contacts at rest let go."""
    for contact in np.flatnonzero(members.impacts):
        phase = members.freed[phase, contact]
    return phase


def _with_contacts(members: RunMembers, phase: Int[np.ndarray, "b"], held: Bool[np.ndarray, "b E"]) -> Int[np.ndarray, "b"]:
    """Return the phases that follow when contacts come to rest."""
    for contact in np.flatnonzero(members.impacts):
        phase = np.where(held[:, contact], members.resting[phase, contact], phase)
    return phase


def _find_following(
    members: RunMembers,
    some: Int[np.ndarray, "b"],
    values: ConditionValues,
    settled: Bool[np.ndarray, "b E"],
    own: Bool[np.ndarray, "b E"],
) -> Int[np.ndarray, "b"]:
    """Return the events right behind others; `settled`: the contacts that took part; `own`: the conditions that crossed."""
    E = members.event_count
    watched = members.watched(some)[:, :E] & ~own
    unclear = watched & ~settled & (np.abs(values.h) <= ZERO * values.scale)
    if not (unclear.any() or any(members.plan.by_velocity)):
        return np.full(len(some), NO_EVENT)
    sides = members.sides[some, :E]
    now = side_of_zero(members.look(some)[0], members.units.rate[some], np)
    return first_crossing(members.directions[:E], watched & ~settled, sides, now, np)
