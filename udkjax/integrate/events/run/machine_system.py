"""Runs with events by machine code: all members of a batch together, from one crossing to the next.

Members whose conditions vary too quickly for machine code, or are NaN, go on window by window (`machine_windows`). A member whose
forces machine code cannot compute in a window stops as `unresolved`: its run is repeated in the plain form (`plain_system`).

A stretch is the motion of a member from one event to the next crossing, or to the end of its run.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.instant.impacts import OPEN
from udkjax.integrate.events.instant.runs import Change, MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.instant.system import StateValues
from udkjax.integrate.events.law.crossings import NO_EVENT, ZERO_TOL, zero_of
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.law.kinks import FREE_SIDE, MOST_KINKS, HeldElement
from udkjax.integrate.events.law.phases import SCENE, SWITCHED
from udkjax.integrate.events.run.added_joints import AddedJoint, evaluate_joint
from udkjax.integrate.events.run.machine_windows import MachineMotion
from udkjax.integrate.events.run.passed_events import PassedEvents, put_locks
from udkjax.integrate.events.run.phase_code import PhaseCode, PhasePlan, StretchEnd
from udkjax.integrate.events.run.windows import WatchedConditions, Window, WindowUnits, advance_window, first_window
from udkjax.integrate.outcome import failure
from udkjax.integrate.solution import Result
from udkjax.native.module.steps import Status
from udkjax.native.runs import RunStates

STATUS, TIME, COUNTS, WRITTEN, IMPLICIT = 0, 1, slice(2, 5), 5, 7  # of `RunStates.info_names`
INFO_LENGTH = len(RunStates.info_names)
# Where forces vary too quickly, tolerances are multiplied by TIGHTENING_FACTOR, once or several times, but not below
# TIGHTEST_TOL, where errors of steps are rounding errors. With a thousandth there are at most two tries at usual tolerances, and
# each costs only the steps of a start.
TIGHTENING_FACTOR, TIGHTEST_TOL = 1e-3, 1e-12


class MachinePlan(NamedTuple):
    """The static part of runs by machine code; hashable."""

    events: EventPlan
    phases: tuple[PhasePlan, ...]
    added: tuple[AddedJoint, ...]  # the joints that events add
    held: tuple[tuple[HeldElement, tuple[int, ...]], ...]  # forces with held sides, each with the places of its event numbers


class MemberUnits(NamedTuple):
    """The characteristic units of each of B members, and the tolerance of drift."""

    rate: Any  # characteristic rate of the system and the run (1/s)
    length: Any  # (m)
    scene_rate: Any  # (1/s)
    mass: Any  # (kg)
    drift_tol: Any  # violation of Psi, relative to the scales of the rows, that ends a run


class MachineSystem:
    """The motion of the members of a batch (`system.System`) by machine code.

    Args:
        plan: static part of all runs.
        phases: the machine code of the phases of each mechanism.
        ts: output times (B, T).
        units: characteristic units of each member.
        of_actions: the numbers of all actions (B, N, E), as `actions.numbers_of_actions`.
        inverse_mass: one over the mass of each coordinate (B, n).
        joint_numbers: the numbers of joints that events add, except those that depend on the state (B, k).
        event_numbers: the numbers of all events (1 or B, K).
    """

    xp = np

    def __init__(
        self,
        plan: MachinePlan,
        phases: list[PhaseCode],
        ts: np.ndarray,
        units: MemberUnits,
        of_actions: np.ndarray,
        inverse_mass: np.ndarray,
        joint_numbers: np.ndarray,
        event_numbers: np.ndarray,
    ):
        self._event_numbers, self._held = event_numbers, plan.held
        self.lost_kinks = np.full(len(ts), np.inf)  # times (s) from which the sides of kinks are free
        self.plan, self._added, self._is_projected = plan.events, plan.added, [x.projected for x in plan.phases]
        self._phases, self.ts, self._units, self._of_actions = phases, ts, units, of_actions
        self.inverse_mass, self._joint_numbers = inverse_mass, joint_numbers
        (B, _), n = ts.shape, inverse_mass.shape[1]
        self._windows: dict[int, Window] = {}  # of the members that go on window by window
        self._tightened = np.ones(B)  # factors of tolerances
        self.end, self.rate, self.unresolved, self._all = ts[:, -1], units.rate, np.zeros(B, bool), np.arange(B)
        units_of_body = np.stack([units.length, units.length, np.ones(B)], axis=1)  # all are one without bodies
        self.coordinates = np.tile(units_of_body, -(-n // 3))[:, :n]
        E = self.plan.count
        holds = np.flatnonzero(np.array(self.plan.switches.rows, int) >= 0)
        self._watched = [np.append(np.arange(E), E + holds[: x.force_count]) for x in plan.phases]
        self._rooms = [x.number_count for x in plan.phases]
        self._most_passed = [None if x.run.passing is None else x.run.passing.most for x in plan.phases]
        self._watches = [self._watch_before(*phase) for phase in zip(plan.phases, self._watched, strict=True)]

    def numbers_of_actions(self, members: MemberIndices) -> np.ndarray:
        """Return the numbers of the actions of members."""
        return take(self._of_actions, members)

    def look(
        self, members: MemberIndices, at: RunState, is_free: bool = False, is_directed: bool = False, has_forces: bool = False
    ) -> StateValues:
        """Return the values of the conditions of members at states; see `System.look`."""
        return StateValues(*self._by_phase(members, at, PhaseCode.at))

    def project(self, members: MemberIndices, at: RunState, is_free: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q and v projected onto the constraints of their phases, and the largest |Psi_dot_i| left, per scale (b,)."""
        q, v, left = self._by_phase(members, at, PhaseCode.project)
        return q, v, left

    def _by_phase(
        self, members: MemberIndices, at: RunState, function: Callable[..., Sequence[np.ndarray]]
    ) -> Sequence[np.ndarray]:
        indices, results = self._all if members is None else members, []
        for which, here in self._mechanisms(at.phase):
            if here.all():
                return function(self._phases[which], indices, at)
            values = function(self._phases[which], indices[here], at.where(here))
            results = results or [np.empty((len(indices), *x.shape[1:])) for x in values]
            for array, x in zip(results, values, strict=True):
                array[here] = x
        return results

    def _mechanisms(self, phase: Bool[np.ndarray, "b C"]) -> Iterator[tuple[int, Bool[np.ndarray, "b"]]]:
        """Yield the mechanisms of phases, SCENE, SWITCHED or both, each with a mask of the phases that belong to it."""
        is_first = self.plan.is_first(phase)
        yield from ((which, here) for which, here in ((SCENE, is_first), (SWITCHED, ~is_first)) if here.any())

    def add_joints(self, members: MemberIndices, new: Bool[np.ndarray, "b A"], q: np.ndarray, joints: Any) -> Any:
        """Return `joints` after adding the joints that are masked in `new` at positions q; their numbers change in place."""
        indices, start = self._all if members is None else members, 0
        for joint, numbers, here in zip(self._added, joints[:-1], new.T, strict=True):
            count = len(joint.program.inputs) - q.shape[1]
            if here.any():
                inputs = self._joint_numbers[indices[here], start : start + count]
                numbers[indices[here]] = evaluate_joint(joint, q[here], inputs)
            start += count
        return joints

    def sides(self, members: MemberIndices, joints: Any) -> Float[np.ndarray, "b S"]:
        """Return all sides of members (b, S): the last entry of `joints`."""
        return take(joints[-1], members)

    def with_sides(self, members: MemberIndices, joints: Any, sides: Float[np.ndarray, "b S"]) -> Any:
        """Return `joints` after replacing all sides of members, in place."""
        joints[-1][self._all if members is None else members] = sides
        return joints

    def turned(self, members: MemberIndices, k: Int[np.ndarray, "b"], at: RunState) -> Float[np.ndarray, "b S"]:
        """Return all sides of members (b, S) after event k at their states."""
        factor, shift = self.plan.side_changes
        return self._renew(members, at, self.sides(members, at.joints) * factor[k] + shift[k])

    def first_sides(self, at: RunState) -> Float[np.ndarray, "B S"]:
        """Return all sides of all members at the start (B, S)."""
        unknown = np.full_like(at.joints[-1], FREE_SIDE)
        unknown[:, : self.plan.first_kink_side] = 0.0
        return self._renew(None, at, unknown)

    def _renew(self, members: MemberIndices, at: RunState, sides: np.ndarray) -> np.ndarray:
        result = sides.copy()
        for held, places in self._held:
            numbers = take(self._event_numbers, members if len(self._event_numbers) > 1 else None)
            own = np.broadcast_to(numbers[:, list(places)], (len(at.t), len(places))).T
            given = held.renewed(list(own), at.t, at.q.T, at.v.T, result[:, held.sides].T)
            result[:, held.sides] = np.stack(held.smooth.renewal.by_numpy(given), axis=1)
        return result

    def when(self, mask: Bool[np.ndarray, "B"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the runs after `change(runs, members)` of the masked members."""
        members = np.flatnonzero(mask)
        return runs if not members.size else change(runs, None if members.size == mask.size else members)

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the runs after repeating a change until none of them is running."""
        with np.errstate(all="ignore"):
            while runs.running.any():
                runs = change(runs)
        return runs

    def advance(self, runs: MemberRuns, members: MemberIndices) -> MemberRuns:
        """Return the runs with members at their next crossings, or at their ends, by one call of machine code for each mechanism.

        Members that go on window by window advance by one window.
        """
        indices = self._all if members is None else members
        if self._windows:
            by_windows = np.isin(indices, list(self._windows))
            for member in indices[by_windows]:
                self._advance_window(runs, int(member))
            indices = indices[~by_windows]
        for which, here in self._mechanisms(runs.phase[indices]):
            self._run_mechanism(runs, which, indices[here])
        return runs

    def go_on_by_windows(self, members: Int[np.ndarray, "b"], t: Float[np.ndarray, "b"]):
        """Let members go on window by window, from the times t (s)."""
        for member, start in zip(members, t, strict=True):
            self._windows[int(member)] = first_window(self.ts[member], start, self.plan.count, np)

    def unresolved_from(self, runs: MemberRuns) -> Float[np.ndarray, "B E"]:
        """Return the times (s) from which conditions vary too quickly to be resolved, or sides of kinks are free; else inf."""
        found = np.where(self.plan.kinks, self.lost_kinks[:, None], np.inf)
        for member, window in self._windows.items():
            # A condition may vary quickly before it becomes NaN, but the result of the run already reports the NaN.
            times = np.where(runs.undefined[member], np.inf, window.unresolved[: self.plan.count])
            found[member] = np.minimum(found[member], times)
        return found

    def _advance_window(self, runs: MemberRuns, member: int):
        """Take a member to the end of its next window, or to a crossing in it."""
        one, units = np.array([member]), MemberUnits(*(x[member] for x in self._units))
        (which, _), *_ = self._mechanisms(runs.phase[one])
        watched = self.plan.watched(runs.phase[one], runs.carried[one], np)[0]
        state, code = runs.state(one), self._phases[which]
        force, smallest = units.mass * units.length * units.rate**2, code.setting("smallest", member)
        of_window = WindowUnits(units.rate, units.scene_rate, force, smallest, code.setting("atol", member))
        motion = MachineMotion(self.plan, code, member, self.ts[member], of_window, self.coordinates[member], watched)
        start = RunState(state.t[0], state.q[0], state.v[0], state.phase[0], state.joints)
        end = advance_window(
            motion, self._windows[member], start, WatchedConditions(runs.sides[member], runs.scale[member], watched)
        )
        if motion.lacks_forces:
            self.unresolved[member], runs.running[member] = True, False
            return
        inside = end.rows < self.ts.shape[1]
        runs.qs[member, end.rows[inside]], runs.vs[member, end.rows[inside]] = (x[inside] for x in end.outputs)
        runs.totals[member] += end.totals
        names = ("t", "q", "v", "event", "sides", "code", "undefined")
        runs.put(one, running=end.goes_on, **{name: getattr(end, name) for name in names})
        self._windows[member] = end.window

    def _run_mechanism(self, runs: MemberRuns, which: int, members: Int[np.ndarray, "b"]):
        ts, start, tol = self.ts[members], runs.t[members], self._units.drift_tol[members, None]
        # The state after an event may itself be a requested output. Machine code writes the later outputs, up to the first
        # infinite time, and then the end.
        b, k = np.nonzero(ts == start[:, None])
        if b.size:
            runs.qs[members[b], k], runs.vs[members[b], k] = runs.q[members[b]], runs.v[members[b]]
        (count, T), later = ts.shape, (ts <= start[:, None]).sum(1)
        output = later[:, None] + np.arange(T - later.min())
        times = np.empty((count, output.shape[1] + 2))
        times[:, 0], times[:, -1] = start, ts[:, -1]
        times[:, 1:-1] = np.where(output < T - 1, ts[np.arange(count)[:, None], np.minimum(output, T - 1)], np.inf)
        stretch = self._phases[which].run(
            members, times, runs.state(members), self._watch(runs, which, members), self._tightened[members]
        )
        status, counts = stretch.info[:, STATUS], stretch.info[:, COUNTS].astype(int)
        rows = (np.arange(times.shape[1]) <= stretch.info[:, WRITTEN, None]) & (times <= stretch.t[:, None])
        rows[:, -1] = status == Status.DONE
        lost = rows & ~(stretch.violation <= tol)
        drifts = lost.any(1) | ~(stretch.worst <= tol[:, 0])
        kept = rows & (np.cumsum(lost, axis=1) == 0) if drifts.any() else rows
        b, k = np.nonzero((kept & (times < stretch.t[:, None]))[:, 1:-1])
        if b.size:
            places = members[b], output[b, k]
            runs.qs[places], runs.vs[places] = stretch.q[b, k + 1], stretch.v[b, k + 1]
        # Outputs between the last step and a crossing, whose time was corrected after the step.
        b, k = np.nonzero((~rows & (times < stretch.t[:, None]) & (status == Status.CROSSED)[:, None])[:, 1:-1])
        if b.size:
            n, last = runs.q.shape[1], stretch.info[b]
            span = stretch.t[b] - last[:, TIME]
            share = np.where(span > 0, (times[b, k + 1] - stretch.t[b]) / np.where(span > 0, span, 1.0), 0.0)[:, None]
            places = members[b], output[b, k]
            runs.qs[places] = stretch.q_end[b] + share * (stretch.q_end[b] - last[:, INFO_LENGTH : INFO_LENGTH + n])
            runs.vs[places] = stretch.v_end[b] + share * (stretch.v_end[b] - last[:, INFO_LENGTH + n :])
        runs.totals[members, :3] += counts
        runs.totals[members, 4] += stretch.info[:, IMPLICIT].astype(int)
        if self._is_projected[which]:
            runs.totals[members, 3] += counts[:, 0] + 2 * (rows.sum(1) - 1)
        known, watched = ((status == Status.CROSSED) | (status == Status.DONE)) & ~drifts, self._watched[which]
        event = np.where(stretch.event >= 0, watched[stretch.event.astype(int)], NO_EVENT)
        runs.put(members, t=stretch.t, q=stretch.q_end, v=stretch.v_end, event=event, running=known)
        self._tightened[members[known]] = 1.0
        if known.all():
            runs.sides[members[:, None], watched] = stretch.sides
        else:
            sure = known | ((status == Status.UNRESOLVED) & ~drifts)
            runs.sides[members[sure, None], watched] = stretch.sides[sure]
            self._fail(runs, which, members, stretch, known, drifts)
        if drifts.any():  # return to the last state close enough to the manifold
            last_kept, drifting = np.where(kept, times, -np.inf).argmax(1)[drifts], members[drifts]
            runs.t[drifting], runs.q[drifting], runs.v[drifting] = (x[drifts, last_kept] for x in (times, stretch.q, stretch.v))
            is_open = drifts & lost[:, 0] & (start == ts[:, 0])
            runs.code[members[is_open]], runs.t[members[is_open]] = Result.initial_state_open, start[is_open]
        if stretch.passed is not None:
            self._note_passed(runs, which, members, stretch.passed)

    def _note_passed(self, runs: MemberRuns, which: int, members: Int[np.ndarray, "b"], passed: PassedEvents):
        """Record the events that machine code has passed (passed_events.py), and update sides, phases and locks accordingly."""
        noted = (np.arange(passed.t.shape[1]) < passed.count[:, None]) & (passed.t <= runs.t[members, None])
        b, k = np.nonzero(noted)
        if not b.size:
            return
        plan, here, sides, phase = self.plan, members[b], passed.sides[b, k], runs.phase[members[b]]
        if passed.locked.shape[2]:
            phase = plan.with_locks(phase, passed.locked[b, k], np)
        q, v = (np.stack([x[b, k], y[b, k]], axis=1) for x, y in ((passed.q, passed.q), (passed.v, passed.v_after)))
        new = passed.t[b, k], q, v, self._watched[which][passed.event[b, k]], phase, False, OPEN, sides
        for array, x in zip(runs.record, new, strict=True):
            array[here, runs.count[here] + k] = x
        last = k == noted.sum(1)[b] - 1
        ended = here[last]
        runs.joints[-1][ended], runs.phase[ended] = sides[last], phase[last]
        runs.count[members] += noted.sum(1)
        if plan.sticking:
            runs.carried[ended] = (runs.carried[ended] & ~plan.slides) | plan.not_sliding(sides[last], np)
        if passed.locked.shape[2]:
            put_locks(plan, self._added, runs.joints, ended, passed.locks[b[last]])

    def _tighten(self, runs: MemberRuns, which: int, members: Int[np.ndarray, "b"]) -> Bool[np.ndarray, "b"]:
        """Tighten the tolerances of members until their next event, and return a mask of those where that may help.

        Where a damper is stiff, velocities within the tolerance have forces that are much less exact, and contacts at rest seem
        to let go and to hold in turn.
        """
        holds = self.plan.watched(runs.phase[members], runs.carried[members], np)[:, self.plan.count :].any(axis=1)
        before = self._tightened[members]
        tighter = np.maximum(TIGHTENING_FACTOR * before, TIGHTEST_TOL / self._phases[which].tolerances(members))
        helps = holds & (tighter < before)
        self._tightened[members[helps]] = tighter[helps]
        return helps

    def _fail(
        self,
        runs: MemberRuns,
        which: int,
        members: Int[np.ndarray, "b"],
        stretch: StretchEnd,
        known: Bool[np.ndarray, "b"],
        drifts: Bool[np.ndarray, "b"],
    ):
        """Handle members whose stretch ended neither at a crossing nor at the end of the run.

        They repeat it with tighter tolerances, go on with free sides or window by window, or end with a `Result`.
        """
        status, (n, fails) = stretch.info[:, STATUS], (runs.q.shape[1], ~known)
        unresolved = (status == Status.UNRESOLVED) & ~drifts
        repeated = unresolved & self._tighten(runs, which, members)
        runs.running[members[repeated]] = True
        fails, unresolved = fails & ~repeated, unresolved & ~repeated
        if self.plan.has_kinks:  # perhaps a force that chatters: the run goes on with its comparisons
            of_kinks = runs.joints[-1][:, self.plan.first_kink_side :]
            chatters = unresolved & np.isfinite(of_kinks[members]).all(1)
            freed, unresolved = members[chatters], unresolved & ~chatters
            of_kinks[freed], self.lost_kinks[freed], runs.running[freed] = FREE_SIDE, runs.t[freed], True
            fails = fails & ~chatters
        self.go_on_by_windows(members[unresolved], stretch.t[unresolved])
        runs.running[members[unresolved]] = True
        fails = fails & ~unresolved
        code = np.where(drifts, Result.drift, failure(status, np))
        last = (
            stretch.info[fails, TIME],
            stretch.info[fails, INFO_LENGTH : INFO_LENGTH + n],
            stretch.info[fails, INFO_LENGTH + n :],
        )
        runs.code[members[fails]] = code[fails]
        runs.t[members[fails]], runs.q[members[fails]], runs.v[members[fails]] = last

    def _watch(self, runs: MemberRuns, which: int, members: Int[np.ndarray, "b"]) -> Float[np.ndarray, "b K"]:
        """Return the input of machine code that describes watched conditions: room for numbers, sides, masks, tolerances, ..."""
        where, E, watch = self._watched[which], self.plan.count, self._watches[which][members]
        room, C = self._rooms[which], len(where)
        watch[:, room : room + C] = runs.sides[members[:, None], where]
        watch[:, room + C : room + 2 * C] = self.plan.watched(runs.phase[members], runs.carried[members], np)[:, where]
        zero = zero_of(self.plan.slides, self._phases[which].atol(members), np)
        watch[:, room + 2 * C : room + 2 * C + E] = zero * runs.scale[members]
        if (most := self._most_passed[which]) is not None:
            watch[:, room + 4 * C + 1] = self._events_to_pass(runs, members, most)
        return watch

    def _events_to_pass(self, runs: MemberRuns, members: Int[np.ndarray, "b"], most: int) -> Int[np.ndarray, "b"]:
        """Return the number of events that the next call may pass: `most`, or fewer if a limit of events or kinks is near."""
        kinks = runs.kink_count(self.plan, members)
        return np.minimum(np.minimum(MOST_KINKS - 1 - kinks, self.plan.max_events - (runs.count[members] - kinks)), most)

    def _watch_before(self, plan: PhasePlan, watched: Int[np.ndarray, "C"]) -> Float[np.ndarray, "B K"]:
        """Return the array of `_watch` before a run, with the entries that stay constant."""
        units, B = self._units, len(self.end)
        room, ones = plan.number_count + 2 * len(watched), np.ones((B, 1))
        force = ZERO_TOL * units.mass * units.length * units.rate**2
        constants = force[:, None] * np.ones(len(watched)), self.plan.both_directions[watched] * ones, units.scene_rate[:, None]
        of_passing = []
        if plan.run.passing is not None:  # the locks of joints that stick are the last of the joints that events add
            count, numbers = plan.run.passing.constants(self.inverse_mass.shape[1]), self._joint_numbers
            locks = numbers[:, numbers.shape[1] - count :]
            of_passing = [np.zeros((B, 1)), np.broadcast_to(locks, (B, count))]
        return np.concatenate([np.zeros((B, room)), *constants, *of_passing], axis=1)
