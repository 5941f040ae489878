"""The members of a batch of runs with events: their states, what is known of their conditions, and the events that are noted."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from udkjax.integrate.events.added_joints import AddedJoint, evaluate_joint
from udkjax.integrate.events.crossings import ConditionValues
from udkjax.integrate.events.impacts import Contacts
from udkjax.integrate.events.phase_code import PhaseCode, PhasePlan, States
from udkjax.integrate.events.phases import Tables
from udkjax.integrate.solution import Result


class EventPlan(NamedTuple):
    """All that a run with events depends on besides its numbers; hashable."""

    phases: tuple[PhasePlan, ...]
    tables: Tables
    directions: tuple[int, ...]  # of each event
    by_velocity: tuple[bool, ...]
    impacts: tuple[bool, ...]
    hold: tuple[bool, ...]  # impacts that are held at rest
    stop_at_rest: tuple[bool, ...]
    changes: tuple[bool, ...]  # events that do more than to take note or to stop
    stops: tuple[bool, ...]
    max_steps: int
    max_events: int
    added: tuple[AddedJoint, ...]  # by events


class MemberUnits(NamedTuple):
    """Numbers of each member (B,)."""

    smallest: Any  # step (s)
    rate: Any  # of the system and the run (1/s)
    length: Any  # m
    scene_rate: Any  # 1/s
    mass: Any  # kg
    drift_tol: Any


class RunMembers:
    """The runs of all members of a batch, as far as they are.

    Args:
        plan: common part of all runs.
        phases: the machine code of each phase.
        ts: output times (B, T).
        q: initial positions (B, n).
        v: initial velocities (B, n).
        code: of each member, the `Result` that is known before (B,).
        units: numbers of each member.
        restitution: of all events (B, E).
        inverse_mass: of all coordinates (B, n).
        joints: the numbers of joints that events add, as the code of the phases takes them.
        joint_numbers: the numbers of these that no state decides (B, k).
    """

    def __init__(
        self,
        plan: EventPlan,
        phases: list[PhaseCode],
        ts: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        code: np.ndarray,
        units: MemberUnits,
        restitution: np.ndarray,
        inverse_mass: np.ndarray,
        joints: Sequence[np.ndarray],
        joint_numbers: np.ndarray,
    ):
        self.plan, self.phases, self.ts, self.units = plan, phases, ts, units
        self._restitution, self.inverse_mass = restitution, inverse_mass
        self._joints, self._joint_numbers = joints, joint_numbers
        (B, T), n, E, K = ts.shape, q.shape[1], len(plan.directions), plan.max_events
        self.held = np.array(plan.tables.held)  # of phases and events, the rows
        self.after, self.resting, self.freed = (np.array(x) for x in plan.tables[:3])
        self.impacts, self.changes, self.stops = (np.array(x) for x in (plan.impacts, plan.changes, plan.stops))
        self._hold, self._stop_at_rest = np.array(plan.hold), np.array(plan.stop_at_rest)
        self._watched = [np.append(np.arange(E), E + np.flatnonzero(rows >= 0)) for rows in self.held]
        self.directions = np.array([*plan.directions, *[-1] * E])
        self.unit = np.tile(np.stack([units.length, units.length, np.ones(B)], axis=1), n // 3)
        self.t, self.q, self.v, self.phase = ts[:, 0].copy(), q.copy(), v.copy(), np.zeros(B, int)
        self.sides, self.scale, self.carried = np.zeros((B, 2 * E), int), np.zeros((B, E)), np.zeros((B, E), bool)
        self.code, self.running = code.astype(int), code == Result.successful
        self.unsure, self.undefined = np.zeros(B, bool), np.zeros((B, E), bool)
        self.qs, self.vs, self.totals = np.full((B, T, n), np.inf), np.full((B, T, n), np.inf), np.zeros((B, 4), int)
        # Of events there is room for one more, which takes what is not to be noted.
        self.event_time, self.count = np.full((B, K + 1), np.inf), np.zeros(B, int)
        self.event_index, self.event_phase = np.full((B, K + 1), -1), np.full((B, K + 1), -1)
        self.event_q, self.event_v = np.full((B, K + 1, 2, n), np.inf), np.full((B, K + 1, 2, n), np.inf)
        self.together, self.closed = np.zeros((B, K + 1), bool), np.zeros((B, K + 1, E), int)

    @property
    def event_count(self) -> int:
        """The number E of events."""
        return len(self.plan.directions)

    def note(
        self,
        some: Int[np.ndarray, "b"],
        others: Int[np.ndarray, "b 3E"],
        first: Int[np.ndarray, "b"],
        full: Bool[np.ndarray, "b"],
        before: tuple[np.ndarray, np.ndarray],
        closed: Int[np.ndarray, "b E"],
        phase: Int[np.ndarray, "b"],
    ):
        """Note the event that happens to each of some members, and those that happen with it; nothing where there is no room.

        Args:
            some: the members.
            others: the numbers of events that happen with it; -1: none.
            first: the number of the event.
            full: where there is no room.
            before: positions and velocities before.
            closed: the states of all contacts.
            phase: following phases.
        """
        index = np.concatenate([first[:, None], others], axis=1)
        is_noted = (index >= 0) & ~full[:, None]
        rows = np.where(is_noted, self.count[some, None] + np.cumsum(is_noted, axis=1) - 1, self.plan.max_events)
        at = some[:, None], rows
        self.event_time[at], self.event_index[at] = self.t[some, None], index
        self.event_phase[at], self.together[at] = phase[:, None], index >= 0
        self.together[some, rows[:, 0]] = False
        self.closed[at] = closed[:, None]
        q, v = (np.stack([x, getattr(self, name)[some]], axis=1) for x, name in zip(before, "qv", strict=True))
        self.event_q[at], self.event_v[at] = q[:, None], v[:, None]
        self.count[some] += is_noted.sum(1)

    def contacts_of(self, some: Int[np.ndarray, "b"]) -> Contacts:
        """Return the contacts of some members, as far as no state changes them."""
        return Contacts(self.impacts, self._hold, self._stop_at_rest, self._restitution[some], self.units.rate[some])

    def add_joints(self, some: Int[np.ndarray, "b"], event: Int[np.ndarray, "b"]) -> Bool[np.ndarray, "b"]:
        """Take the numbers of joints from the states of members to which events add them; tell to which they do."""
        adds, start = np.zeros(len(some), bool), 0
        for joint, numbers in zip(self.plan.added, self._joints, strict=True):
            count = len(joint.program.inputs) - self.q.shape[1]
            is_new = event == joint.event
            new = some[is_new]
            if new.size:
                numbers[new] = evaluate_joint(joint, self.q[new], self._joint_numbers[new, start : start + count])
            adds, start = adds | is_new, start + count
        return adds

    def watched_of(self, phase: int) -> Int[np.ndarray, "C"]:
        """Return which conditions, and, from E on, which contact forces machine code watches in a phase."""
        return self._watched[phase]

    def watched(self, some: Int[np.ndarray, "b"]) -> Bool[np.ndarray, "b 2E"]:
        """Tell which conditions and contact forces count."""
        held = self.held[self.phase[some]] >= 0
        return np.concatenate([~held & ~self.carried[some], held], axis=1)

    def write_here(self, some: Int[np.ndarray, "b"]):
        """Write the states of members to outputs that are due right now."""
        b, k = np.nonzero(self.ts[some] == self.t[some, None])
        self.qs[some[b], k], self.vs[some[b], k] = self.q[some[b]], self.v[some[b]]

    def look(self, some: Int[np.ndarray, "b"], at: tuple[np.ndarray, ...] | None = None) -> tuple[ConditionValues, States]:
        """Evaluate the conditions of members at their states, or at others (phase, q, v). Scales do not become smaller."""
        phases, q, v = (self.phase[some], self.q[some], self.v[some]) if at is None else at
        found: list[np.ndarray] = []
        for phase in set(phases.tolist()):
            of_phase = phases == phase
            states = self.phases[phase].at(some[of_phase], self.t[some[of_phase]], q[of_phase], v[of_phase])
            if of_phase.all():
                found = list(states)
                break
            found = found or [np.empty((len(some), *x.shape[1:])) for x in states]
            for to, x in zip(found, states, strict=True):
                to[of_phase] = x
        states = States(*found)
        if at is None:
            rate, t, unit = self.units.rate[some, None], np.abs(self.t[some, None]), self.unit[some]
            by_q = np.abs(states.by_q) * np.maximum(unit, np.abs(q))[:, None]
            by_v = np.abs(states.by_v) * np.maximum(unit * rate, np.abs(v))[:, None]
            size = np.maximum(np.maximum(by_q, by_v).max(2), np.abs(states.by_t) * np.maximum(1 / rate, t))
            self.scale[some] = np.maximum(np.where(np.isfinite(size), size, 0.0), self.scale[some])
        return ConditionValues(states.g, states.rate, states.rate_2, states.a, self.scale[some]), states
