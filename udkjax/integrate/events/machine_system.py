"""Runs with events by machine code: all members of a batch together, from one crossing to the next.

Members whose conditions vary too quickly for machine code, or are NaN, are `unresolved` and stop: the plain form (`plain_system`)
runs them.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.added_joints import AddedJoint, evaluate_joint
from udkjax.integrate.events.crossings import NO_EVENT, ZERO
from udkjax.integrate.events.event_plan import EventPlan
from udkjax.integrate.events.impacts import Contacts
from udkjax.integrate.events.phase_code import PhaseCode, PhasePlan, StretchEnd
from udkjax.integrate.events.runs import Change, MemberIndices, MemberRuns, RunState, take
from udkjax.integrate.events.system import StateValues
from udkjax.integrate.solution import Result
from udkjax.native.base.steps import Status
from udkjax.native.runs import RunStates

STATUS, TIME, COUNTS, WRITTEN = 0, 1, slice(2, 5), 5  # of `RunStates.info_names`
INFO = len(RunStates.info_names)


class MachinePlan(NamedTuple):
    """All that a run by machine code depends on besides its numbers; hashable."""

    events: EventPlan
    phases: tuple[PhasePlan, ...]
    added: tuple[AddedJoint, ...]  # by events


class MemberUnits(NamedTuple):
    """Numbers of each member (B,)."""

    rate: Any  # of the system and the run (1/s)
    length: Any  # m
    scene_rate: Any  # 1/s
    mass: Any  # kg
    drift_tol: Any


class MachineSystem:
    """The motion of the members of a batch (`system.System`) by machine code.

    Args:
        plan: common part of all runs.
        phases: the machine code of each phase.
        ts: output times (B, T).
        units: numbers of each member.
        restitution: of all events (B, E).
        inverse_mass: of all coordinates (B, n).
        joint_numbers: the numbers of joints that events add, except those that the state decides (B, k).
    """

    xp = np

    def __init__(
        self,
        plan: MachinePlan,
        phases: list[PhaseCode],
        ts: np.ndarray,
        units: MemberUnits,
        restitution: np.ndarray,
        inverse_mass: np.ndarray,
        joint_numbers: np.ndarray,
    ):
        self.plan, self._added, self._is_projected = plan.events, plan.added, [x.projected for x in plan.phases]
        self._phases, self.ts, self._units, self._restitution = phases, ts, units, restitution
        self.inverse_mass, self._joint_numbers = inverse_mass, joint_numbers
        (B, _), n = ts.shape, inverse_mass.shape[1]
        self.end, self.rate, self.unresolved, self._all = ts[:, -1], units.rate, np.zeros(B, bool), np.arange(B)
        self.coordinates = np.tile(np.stack([units.length, units.length, np.ones(B)], axis=1), n // 3)
        E = self.plan.count
        self._watched = [np.append(np.arange(E), E + np.flatnonzero(held)) for held in self.plan.held]
        self._watches = [self._watch_before(*phase) for phase in zip(plan.phases, self._watched, strict=True)]

    def contacts(self, some: MemberIndices) -> Contacts:
        """Return the contacts of some members."""
        plan = self.plan
        numbers = take(self._restitution, some), take(self.rate, some)
        return Contacts(plan.impacts, plan.held_at_rest, plan.stops_at_rest, *numbers)

    def look(self, some: MemberIndices, at: RunState, is_free: bool = False) -> StateValues:
        """Evaluate some members at states."""
        return StateValues(*self._by_phase(some, at, PhaseCode.at))

    def project(self, some: MemberIndices, at: RunState, is_free: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities that the phases of states allow."""
        q, v = self._by_phase(some, at, PhaseCode.project)
        return q, v

    def _by_phase(self, some: MemberIndices, at: RunState, function: Callable[..., Sequence[np.ndarray]]) -> Sequence[np.ndarray]:
        members, found = self._all if some is None else some, []
        for phase in set(at.phase.tolist()):
            of_phase = at.phase == phase
            if of_phase.all():
                return function(self._phases[phase], members, *at[:3])
            values = function(self._phases[phase], members[of_phase], *(x[of_phase] for x in at[:3]))
            found = found or [np.empty((len(members), *x.shape[1:])) for x in values]
            for to, x in zip(found, values, strict=True):
                to[of_phase] = x
        return found

    def add_joints(self, some: MemberIndices, event: Int[np.ndarray, "b"], q: np.ndarray, joints: Any) -> Any:
        """Return the numbers of the joints that events have added, with those that some events add at q; -1: none."""
        members, start = self._all if some is None else some, 0
        for joint, numbers in zip(self._added, joints, strict=True):
            count, new = len(joint.program.inputs) - q.shape[1], event == joint.event
            if new.any():
                given = self._joint_numbers[members[new], start : start + count]
                numbers[members[new]] = evaluate_joint(joint, q[new], given)
            start += count
        return joints

    def when(self, those: Bool[np.ndarray, "B"], change: Change, runs: MemberRuns) -> MemberRuns:
        """Return the runs with a change of the masked members."""
        some = np.flatnonzero(those)
        return runs if not some.size else change(runs, None if some.size == those.size else some)

    def repeat(self, change: Callable[[MemberRuns], MemberRuns], runs: MemberRuns) -> MemberRuns:
        """Return the runs after changing them until none is running."""
        with np.errstate(all="ignore"):
            while runs.running.any():
                runs = change(runs)
        return runs

    def advance(self, runs: MemberRuns, some: MemberIndices) -> MemberRuns:
        """Take some members to their next crossings, or to their ends, by one call of machine code for each phase."""
        members = self._all if some is None else some
        phases = runs.phase[members]
        for phase in set(phases.tolist()):
            self._run_phase(runs, phase, members[phases == phase])
        return runs

    def _run_phase(self, runs: MemberRuns, phase: int, some: Int[np.ndarray, "b"]):
        ts, start, tol = self.ts[some], runs.t[some], self._units.drift_tol[some, None]
        # The state after an event may itself be due as an output. Machine code writes the later outputs, up to the first that is
        # infinite, and then the end.
        b, k = np.nonzero(ts == start[:, None])
        if b.size:
            runs.qs[some[b], k], runs.vs[some[b], k] = runs.q[some[b]], runs.v[some[b]]
        (count, T), later = ts.shape, (ts <= start[:, None]).sum(1)
        output = later[:, None] + np.arange(T - later.min())
        times = np.empty((count, output.shape[1] + 2))
        times[:, 0], times[:, -1] = start, ts[:, -1]
        times[:, 1:-1] = np.where(output < T - 1, ts[np.arange(count)[:, None], np.minimum(output, T - 1)], np.inf)
        found = self._phases[phase].run(some, times, runs.q[some], runs.v[some], self._watch(runs, phase, some))
        status, counts = found.info[:, STATUS], found.info[:, COUNTS].astype(int)
        rows = (np.arange(times.shape[1]) <= found.info[:, WRITTEN, None]) & (times <= found.t[:, None])
        rows[:, -1] = status == Status.DONE
        lost = rows & ~(found.violation <= tol)
        drifts = lost.any(1) | ~(found.worst <= tol[:, 0])
        kept = rows & (np.cumsum(lost, axis=1) == 0) if drifts.any() else rows
        b, k = np.nonzero((kept & (times < found.t[:, None]))[:, 1:-1])
        if b.size:
            places = some[b], output[b, k]
            runs.qs[places], runs.vs[places] = found.q[b, k + 1], found.v[b, k + 1]
        runs.totals[some, :3] += counts
        if self._is_projected[phase]:
            runs.totals[some, 3] += counts[:, 0] + 2 * (rows.sum(1) - 1)
        known, watched = ((status == Status.CROSSED) | (status == Status.DONE)) & ~drifts, self._watched[phase]
        event = np.where(found.event >= 0, watched[found.event.astype(int)], NO_EVENT)
        runs.put(some, t=found.t, q=found.q_end, v=found.v_end, event=event, running=known)
        if known.all():
            runs.sides[some[:, None], watched] = found.sides
        else:
            runs.sides[some[known, None], watched] = found.sides[known]
            self._fail(runs, some, found, known, drifts)
        if drifts.any():  # the last state that was none too far from the manifold
            last_kept, those = np.where(kept, times, -np.inf).argmax(1)[drifts], some[drifts]
            runs.t[those], runs.q[those], runs.v[those] = (x[drifts, last_kept] for x in (times, found.q, found.v))
            is_open = drifts & lost[:, 0] & (start == ts[:, 0])
            runs.code[some[is_open]], runs.t[some[is_open]] = Result.initial_state_open, start[is_open]

    def _fail(
        self,
        runs: MemberRuns,
        some: Int[np.ndarray, "b"],
        found: StretchEnd,
        known: Bool[np.ndarray, "b"],
        drifts: Bool[np.ndarray, "b"],
    ):
        """Store the results and ends of the runs that stop."""
        status, (n, fails) = found.info[:, STATUS], (runs.q.shape[1], ~known)
        self.unresolved[some] |= (status == Status.UNRESOLVED) & ~drifts
        code = np.where(status == Status.STEP_LIMIT, Result.step_limit, Result.step_too_small)
        code = np.where(status == Status.NOT_FINITE, Result.not_finite, code)
        code = np.where((status == Status.LOST) | drifts, Result.drift, code)
        last = found.info[fails, TIME], found.info[fails, INFO : INFO + n], found.info[fails, INFO + n :]
        runs.code[some[fails]] = code[fails]
        runs.t[some[fails]], runs.q[some[fails]], runs.v[some[fails]] = last

    def _watch(self, runs: MemberRuns, phase: int, some: Int[np.ndarray, "b"]) -> Float[np.ndarray, "b K"]:
        """Return all that machine code watches in a phase: room for numbers, sides, whether each counts, floors, directions."""
        where, E, watch = self._watched[phase], self.plan.count, self._watches[phase][some]
        room, C = watch.shape[1] - 1 - 4 * len(where), len(where)
        watch[:, room : room + C] = runs.sides[some[:, None], where]
        watch[:, room + C : room + 2 * C] = self.plan.watched(runs.phase[some], runs.carried[some], np)[:, where]
        watch[:, room + 2 * C : room + 2 * C + E] = ZERO * runs.scale[some]
        return watch

    def _watch_before(self, plan: PhasePlan, watched: Int[np.ndarray, "C"]) -> Float[np.ndarray, "B K"]:
        """Return the array of `_watch` before a run, with the entries that stay constant."""
        units, B = self._units, len(self.end)
        assert plan.run.conditions is not None  # it watches some
        room, ones = plan.run.conditions.number_count + 2 * len(watched), np.ones((B, 1))
        force = ZERO * units.mass * units.length * units.rate**2
        rest = force[:, None] * np.ones(len(watched)), self.plan.both_directions[watched] * ones, units.scene_rate[:, None]
        return np.concatenate([np.zeros((B, room)), *rest], axis=1)
