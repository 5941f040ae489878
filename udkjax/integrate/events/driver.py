"""Runs with events by machine code: from event to event, all members of a batch together.

In each round every member that still runs goes on to its next crossing, or to the end, by one call of machine code for each
phase; then the events that happen are applied, those of all members at once. What cannot be told from a crossing at once, where
conditions vary too quickly or are no numbers, is left to the plain form of such runs (`loop`).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.crossings import NO_EVENT, ZERO, first_crossing, side_of_zero
from udkjax.integrate.events.impacts import CLOSED
from udkjax.integrate.events.known_jumps import apply_events
from udkjax.integrate.events.phase_code import StretchEnd
from udkjax.integrate.events.run_members import RunMembers
from udkjax.integrate.solution import Result
from udkjax.native.steps import CROSSED, DONE, LOST, NOT_FINITE, STEP_LIMIT, UNSURE


def run(members: RunMembers):
    """Run all members to their ends."""
    with np.errstate(all="ignore"):
        _begin(members, np.flatnonzero(members.running))
        while (some := np.flatnonzero(members.running)).size:
            _advance(members, some)
        members.write_here(np.arange(len(members.t)))


def _begin(members: RunMembers, some: Int[np.ndarray, "b"]):
    """Find the sides of zero of all conditions at the start, and apply what happens at once."""
    if not some.size:
        return
    E, (values, states) = members.event_count, members.look(some)
    is_zero = np.abs(values.h) <= ZERO * values.scale
    now = side_of_zero(values, members.units.rate[some], np)
    # Contacts are approached from the side that is allowed: what is zero and falls at the start happens at once.
    members.sides[some, :E] = np.where(members.impacts & is_zero, 1, now)
    undefined = ~np.isfinite(values.h)
    beyond = np.any(members.impacts & (values.h < 0) & ~is_zero, axis=1)
    code = np.where(beyond, Result.beyond_contact, members.code[some])
    members.code[some] = np.where(undefined.any(1), Result.undefined_condition, code)
    members.undefined[some] = undefined
    members.running[some] = members.code[some] == Result.successful
    event = first_crossing(members.directions[:E], members.watched(some)[:, :E], members.sides[some, :E], now, np)
    apply_events(members, some, np.where(members.running[some], event, NO_EVENT), values, states)


def _advance(members: RunMembers, some: Int[np.ndarray, "b"]):
    """Take members to their next crossings, or to their ends."""
    event = np.full(len(some), NO_EVENT)
    for phase in set(members.phase[some].tolist()):
        of_phase = members.phase[some] == phase
        event[of_phase] = _run_phase(members, phase, some[of_phase])
    event, some = event[members.running[some]], some[members.running[some]]
    if not some.size:
        return
    E, (values, states) = members.event_count, members.look(some)
    floor = ZERO * values.scale
    now = np.sign(values.h).astype(int)
    is_clear, is_own = np.abs(values.h) > floor, np.arange(E) == event[:, None]
    sides = members.sides[some, :E]
    at_end = event == NO_EVENT
    if at_end.any() and not is_clear[at_end].all():
        at_zero = side_of_zero(values, members.units.rate[some], np)
        event = np.where(at_end, first_crossing(members.directions[:E], members.watched(some)[:, :E], sides, at_zero, np), event)
    members.sides[some, :E] = np.where(is_clear & ~is_own, now, sides)
    members.carried[some] &= np.abs(values.h) <= CLOSED * values.scale
    unsure = ~np.isfinite(values.h).all(1)
    members.unsure[some] |= unsure
    members.running[some] &= ~unsure
    apply_events(members, some, event, values, states)


def _run_phase(members: RunMembers, phase: int, some: Int[np.ndarray, "b"]) -> Int[np.ndarray, "b"]:
    """Run members of one phase to their next crossings, which are returned, or to their ends."""
    members.write_here(some)
    ts, start, tol = members.ts[some], members.t[some], members.units.drift_tol[some, None]
    later = np.sum(ts > start[:, None], axis=1)
    last = ts.shape[1] - 1
    output = (ts.shape[1] - later)[:, None] + np.arange(later.max())
    # Machine code writes outputs up to the first that is infinite, and then the end.
    due = np.where(output < last, np.take_along_axis(ts, np.minimum(output, last), 1), np.inf)
    times = np.concatenate([start[:, None], due, ts[:, -1:]], axis=1)
    found = members.phases[phase].run(some, times, members.q[some], members.v[some], _watch(members, phase, some))
    rows = (np.arange(times.shape[1]) <= found.written[:, None]) & (times <= found.t[:, None])
    rows[:, -1] = found.status == DONE
    lost = rows & ~(found.violation <= tol)
    kept = rows & (np.cumsum(lost, axis=1) == 0)
    b, k = np.nonzero(kept[:, 1:-1] & (due < found.t[:, None]))
    members.qs[some[b], output[b, k]], members.vs[some[b], output[b, k]] = found.q[b, k + 1], found.v[b, k + 1]
    projections = members.plan.phases[phase].projected * (found.counts[:, 0] + 2 * (rows.sum(1) - 1))
    members.totals[some] += np.concatenate([found.counts, projections[:, None]], axis=1)
    drifts = lost.any(1) | ~(found.worst <= tol[:, 0])
    _take_end(members, some, found, drifts, phase)
    if drifts.any():  # the last state that was none too far from the manifold
        last_kept = np.where(kept, times, -np.inf).argmax(1)[drifts]
        members.t[some[drifts]] = times[drifts, last_kept]
        members.q[some[drifts]], members.v[some[drifts]] = found.q[drifts, last_kept], found.v[drifts, last_kept]
        is_open = drifts & lost[:, 0] & (start == ts[:, 0])
        members.code[some[is_open]] = Result.initial_state_open
        members.t[some[is_open]] = start[is_open]
    return np.where(found.event >= 0, members.watched_of(phase)[found.event], NO_EVENT)


def _take_end(members: RunMembers, some: Int[np.ndarray, "b"], found: StretchEnd, drifts: Bool[np.ndarray, "b"], phase: int):
    """Take over how some runs have ended, and where."""
    n, known = members.q.shape[1], ((found.status == CROSSED) | (found.status == DONE)) & ~drifts
    members.unsure[some] |= (found.status == UNSURE) & ~drifts
    code = np.where(found.status == STEP_LIMIT, Result.step_limit, Result.step_too_small)
    code = np.where(found.status == NOT_FINITE, Result.not_finite, code)
    code = np.where((found.status == LOST) | drifts, Result.drift, code)
    too_long = (members.totals[some, 0] >= members.plan.max_steps) & ((found.event >= 0) | (found.t < members.ts[some, -1]))
    members.code[some] = code = np.where(known, np.where(too_long, Result.step_limit, Result.successful), code)
    members.running[some] = known & (code == Result.successful)
    members.t[some] = np.where(known, found.t, found.raw[:, 0])
    members.q[some] = np.where(known[:, None], found.y[:, :n], found.raw[:, 1 : 1 + n])
    members.v[some] = np.where(known[:, None], found.y[:, n:], found.raw[:, 1 + n :])
    places = some[:, None], members.watched_of(phase)
    members.sides[places] = np.where(known[:, None], found.sides, members.sides[places])


def _watch(members: RunMembers, phase: int, some: Int[np.ndarray, "b"]) -> Float[np.ndarray, "b K"]:
    """Return the numbers of all that machine code watches in a phase: sides, whether each counts, floors, directions."""
    units, E = members.units, members.event_count
    where = members.watched_of(phase)
    force = units.mass[some] * units.length[some] * units.rate[some] ** 2
    floors = ZERO * np.concatenate([members.scale[some], np.repeat(force[:, None], len(where) - E, axis=1)], axis=1)
    directions = np.broadcast_to(members.directions[where], floors.shape)
    parts = members.sides[some][:, where], members.watched(some)[:, where], floors, directions, units.scene_rate[some, None]
    return np.concatenate([np.asarray(x, float) for x in parts], axis=1)
