"""Events that machine code passes by itself (native/watching/passing.py): their selection, and their records."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.complementarity.stick_or_slip import AT_REST, BLOCK_STEPS, SINGLE_STEPS
from udkjax.expressions import ScalarProgram
from udkjax.integrate.events.law.crossings import REVERSAL_SPEED, ZERO_TOL
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.law.kinks import KinkPlaces
from udkjax.integrate.events.law.phases import Phases
from udkjax.integrate.events.run.added_joints import AddedJoint
from udkjax.native.language.program import vector_function
from udkjax.native.watching.conditions import Conditions


class NumberPlaces(NamedTuple):
    """Indices among the numbers of a mechanism: those of sides, of added joints, of switches and of marks."""

    sides: tuple[int, ...]  # of all sides; -1: the mechanism lacks the force
    joints: Sequence[tuple[int, ...]] = ()  # of the numbers of each joint that events add
    switches: Sequence[tuple[int, int]] = ()  # of the numbers that switch constraints on, each with the index of the switch
    first_mark: int = -1  # of the mark of the first row of Psi; -1: rows have no marks


def passed_events(
    plan: EventPlan, phases: Phases, conditions: Conditions, of_kinks: KinkPlaces, added: Sequence[AddedJoint], at: NumberPlaces
) -> dict[str, Any]:
    """Return the arguments of `RunStates.watching` for the events that runs of a mechanism pass; empty if there are none.

    Args:
        plan: the plan of the events.
        phases: the phases.
        conditions: the conditions that runs of this mechanism watch.
        of_kinks: places of kinks among the numbers of events.
        added: the joints that events add.
        at: places among the numbers of the mechanism.
    """
    # Contacts take part in the decisions about the joints that rub in them.
    slides = None if plan.has_rubbing_contacts or not plan.sticking else _slides(plan, conditions, added)
    if not phases.held and slides is None:
        return {}
    of_scene = [(place, "sides", side) for side, place in enumerate(at.sides) if place >= 0]
    if slides and slides["locks"]:
        of_scene += _numbers_of_locks(plan, slides["locks"], added, at)
    return {
        "kinks": _kinks(phases, conditions, of_kinks) if phases.held else None,
        "slides": slides,
        "sides": plan.side_count,
        "of_scene": tuple(of_scene),
        "zero": ZERO_TOL,
    }


def _kinks(phases: Phases, conditions: Conditions, of_kinks: KinkPlaces) -> dict[str, Any]:
    turns, renewals = [], []
    for held, numbers in zip(phases.held, of_kinks.elements, strict=True):
        turns += [(held.first + side, factor, shift) for side, factor, shift in held.smooth.turns]
        own = [("sides", held.first + k) for k in range(held.smooth.count)]
        q, v = ([(name, k) for k in held.coordinates] for name in ("state q", "result v"))
        given = held.smooth.inputs([("condition numbers", k) for k in numbers], ("state t", 0), q, v, own)
        renewals.append((held.smooth, tuple(given), held.first))
    return {
        "first": conditions.own_count - len(turns),
        "turns": tuple(turns),
        "of_conditions": of_kinks.sides,
        "renewals": tuple(renewals),
    }


def _slides(plan: EventPlan, conditions: Conditions, added: Sequence[AddedJoint]) -> dict[str, Any]:
    locks, first_force = [], -1
    if conditions.force_count:
        first_force = int(np.sum(np.array(plan.switches.rows[: plan.forwards[0]], int) >= 0))
        for joint in added[len(added) - len(plan.sticking) :]:
            outputs = [joint.program.outputs[i] for i in joint.changing]
            program = ScalarProgram(joint.program.graph, joint.program.inputs, outputs)
            locks.append({"key": vector_function(program, "lock", "in", "out").text(), "program": program})
    return {
        "count": len(plan.sticking),
        "first": int(plan.forwards[0]),
        "first_force": first_force,
        "locks": tuple(locks),
        "closed": AT_REST.closed,
        "slow": REVERSAL_SPEED,
        "still": AT_REST.still,
        "block_steps": BLOCK_STEPS,
        "single_steps": SINGLE_STEPS,
    }


def _numbers_of_locks(
    plan: EventPlan, locks: Sequence[dict[str, Any]], added: Sequence[AddedJoint], at: NumberPlaces
) -> list[tuple[int, str, int]]:
    """Return the numbers of the mechanism that are numbers of locks: triples (index, "locks", index among the latter)."""
    lock_count, found = len(locks), []
    first_lock = len(added) - lock_count  # locks are the last joints that events add
    start = 2 * lock_count  # numbers of locks: first all switches, then all marks of rows, then numbers that depend on q
    for j, (switch, joint) in enumerate(zip(plan.locks, added[first_lock:], strict=True)):
        found += [(place, "locks", j) for place, of_switch in at.switches if of_switch == switch]
        if at.first_mark >= 0:
            found.append((at.first_mark + plan.switches.rows[plan.forwards[j]], "locks", lock_count + j))
        places = at.joints[first_lock + j]
        found += [(places[i], "locks", start + k) for k, i in enumerate(joint.changing)]
        start += len(joint.changing)
    return found


def put_locks(plan: EventPlan, added: Sequence[AddedJoint], joints: Any, members: Any, locks: Float[np.ndarray, "b L"]):
    """Copy the numbers of locks (b, L), as runs return them, into `joints`, the numbers of all joints that events have added."""
    start, first = 2 * len(plan.sticking), len(added) - len(plan.sticking)
    for numbers, joint in zip(joints[first:-1], added[first:], strict=True):
        places = joint.changing
        numbers[members[:, None], places] = locks[:, start : start + len(places)]
        start += len(places)


class PassedEvents(NamedTuple):
    """The events that b runs have passed, at most K in each."""

    locks: Float[np.ndarray, "b L"]  # the numbers of all locks at the end
    count: Int[np.ndarray, "b"]
    event: Int[np.ndarray, "b K"]  # the index of the watched condition
    t: Float[np.ndarray, "b K"]
    q: Float[np.ndarray, "b K n"]
    v: Float[np.ndarray, "b K n"]
    v_after: Float[np.ndarray, "b K n"]
    sides: Float[np.ndarray, "b K S"]  # after the event
    locked: Bool[np.ndarray, "b K F"]  # the joints that stick after the event; of width 0 for a mechanism without locks

    @classmethod
    def of(cls, record: Float[np.ndarray, "b R"], passing: Any, n: int) -> "PassedEvents":
        """Return the events in the records of b runs; `passing` is the `Passing` of their machine code."""
        count, first = record[:, 0].astype(int), 1 + passing.locks
        rows = record[:, first:].reshape(len(record), passing.most, -1)[:, : count.max(initial=0)]
        event, t, q, v, v_after, sides, locked = np.split(rows, np.cumsum([1, 1, n, n, n, passing.sides]), axis=2)
        last = np.where(count[:, None] > 0, record[:, 1:first], np.nan)
        index = np.where(np.arange(event.shape[1]) < count[:, None], event[..., 0], 0).astype(int)
        return cls(last, count, index, t[..., 0], q, v, v_after, sides, locked > 0.5)
