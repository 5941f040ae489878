"""Machine code of the phases of runs with events, for batches: integration to the next crossing, evaluation at single states."""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from udkjax.equations.scene_programs import scene_programs
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.integrate.events.added_joints import places_of_joints
from udkjax.integrate.events.kinks import HeldElement, places_of_sides
from udkjax.integrate.events.system import StateValues
from udkjax.integrate.native_engine import run_inputs
from udkjax.integrate.problem import Problem
from udkjax.native.operations import EvaluateEvents, MarkRows, StateOperation
from udkjax.native.primitive import call_members
from udkjax.native.runs import RunWatched
from udkjax.native.watching.conditions import Conditions

INPUTS = RunWatched.input_names
STATE = slice(INPUTS.index("ts"), INPUTS.index("v") + 1)  # the inputs of a run that are times and initial state
PARTS = ("numbers", "settings", "rows", "breaks", "rank_tol")  # arrays of a phase, followed by its samples if it has any


class PhasePlan(NamedTuple):
    """The operations of a phase; hashable."""

    run: RunWatched
    states: EvaluateEvents
    marking: MarkRows | None  # marks independent rows; None if this is not needed
    projected: bool
    project: StateOperation | None  # projects to the joints that events add; None without any
    # For each such joint the places of its numbers, empty if the phase lacks it; then those of the sides of comparisons.
    joints: tuple[tuple[int, ...], ...]
    sides_of_events: tuple[tuple[int, int], ...]  # places of sides among the numbers of events, with the index of the side

    @property
    def count(self) -> int:
        """The number of arrays of the phase."""
        return len(PARTS) + bool(self.run.sampled)


def phase_plan(
    compiled: CompiledMechanism,
    conditions: Conditions,
    held: Sequence[int],
    impacts: Sequence[int],
    added: Sequence[str],
    forces: Sequence[HeldElement],
    of_kinks: tuple[tuple[int, int], ...],
) -> PhasePlan:
    """Return the operations of a phase.

    Args:
        compiled: the mechanism of the phase.
        conditions: conditions of all events.
        held: for each event the row of Psi that holds its contact; -1: none.
        impacts: the events that are impacts.
        added: the names of joints that events add.
        forces: the forces with held sides.
        of_kinks: the places of sides among the numbers of events, each with the index of its side.
    """
    run = compiled.plan.operation
    assert run is not None  # checked by the caller
    rows = tuple(row for row in held if row >= 0)
    states = run.accelerations.of_events(conditions, tuple(impacts))
    marking = None
    if run.code.marks_rows:
        marking = MarkRows(scene_programs(compiled.textbook.mechanism.at(0.0)).with_all_rows)
    project = run.accelerations.projection if added else None
    joints = places_of_joints(compiled.textbook.mechanism, added)
    if forces:
        joints = (*joints, places_of_sides(compiled.samples.stand_in(compiled.textbook.mechanism), forces))
    else:
        joints = (*joints, ())
    return PhasePlan(
        run.watching(replace(conditions, rows=rows)), states, marking, compiled.plan.projected, project, joints, of_kinks
    )


def phase_arrays(problem: Problem, plan: PhasePlan, xp: ModuleType = jnp) -> list[Any]:
    """Return the arrays of a phase, with a leading axis for members."""
    if plan.marking is not None:
        problem = replace(problem, marks=np.ones(plan.run.code.row_count))
    inputs = run_inputs(problem, plan.run, xp)
    tol = problem.textbook.scales.rank_tol**2 if plan.marking is not None else 0.0
    return [
        *inputs[: STATE.start],
        *inputs[STATE.stop : len(INPUTS)],
        xp.reshape(xp.asarray(tol, float), (1, 1)),
        *inputs[len(INPUTS) :],
    ]


class StretchEnd(NamedTuple):
    """The ends of runs, at a crossing or elsewhere, and their outputs; integers are stored as floats."""

    q: Float[np.ndarray, "b T n"]  # at the requested times
    v: Float[np.ndarray, "b T n"]
    violation: Float[np.ndarray, "b T"]
    info: Float[np.ndarray, "b K"]  # `RunStates.info_names`, and the last state of the integrator
    event: Float[np.ndarray, "b"]  # index of the watched quantity that crosses; -1: none
    t: Float[np.ndarray, "b"]  # the end (s); no event happens before
    worst: Float[np.ndarray, "b"]  # largest violation at a node
    sides: Float[np.ndarray, "b C"]
    q_end: Float[np.ndarray, "b n"]  # at t
    v_end: Float[np.ndarray, "b n"]


class PhaseCode:
    """The machine code of a phase, with the numbers of all members of a batch.

    Args:
        plan: the operations of the phase.
        arrays: arrays from `phase_arrays`, for one member or for all.
        event_numbers: the numbers of all events.
        inverse_mass: one over the mass of each coordinate.
        members: number of members.
        joints: the numbers of the joints that events have added, for all members; changed in place.
    """

    def __init__(
        self,
        plan: PhasePlan,
        arrays: Sequence[np.ndarray],
        event_numbers: np.ndarray,
        inverse_mass: np.ndarray,
        members: int,
        joints: Sequence[np.ndarray],
    ):
        self.plan, (self._numbers, self._settings, self._rows, self._breaks, self._tol, *self._samples) = plan, arrays
        names = plan.run.all_settings
        self._of_states = self._settings[:, [names.index(name) for name in plan.states.all_settings]]
        self._of_marking = [] if plan.marking is None else [names.index(name) for name in plan.marking.all_settings]
        self._event_numbers, self._joints = event_numbers, joints
        rows = max(len(event_numbers), len(inverse_mass))
        self._numbers_of_states = np.concatenate([_spread(x, rows) for x in (event_numbers, inverse_mass)], axis=1)
        assert plan.states.conditions is not None  # this code has conditions
        n, E = inverse_mass.shape[1], plan.states.conditions.own_count
        self._places, start = [], 0
        for shape in ((n,), (E,), (E,), (E,), (E,), (E, n), (E, n)):  # of the fields of `StateValues`
            self._places.append((slice(start, start + math.prod(shape)), shape))
            start += math.prod(shape)
        self._marks = np.full((members, plan.run.code.row_count), np.nan)

    def run(self, members: Int[np.ndarray, "b"], ts: np.ndarray, q: np.ndarray, v: np.ndarray, watch: np.ndarray) -> StretchEnd:
        """Run members over times (b, T) to the first crossing; `watch` describes the conditions, with room for their numbers."""
        operation, conditions = self.plan.run, self.plan.run.conditions
        assert conditions is not None  # this code has conditions
        numbers = self._with_marks(members, ts[:, 0], q, v)
        further = [_of(x, members) for x in (self._settings, self._rows, self._breaks, *self._samples)]
        watch[:, : conditions.number_count] = _of(self._event_numbers, members)
        self._put_sides(watch, members)
        inputs = numbers, ts, q, v, *further, watch
        qs, vs, violation, info, crossing = call_members(*inputs, operation=operation, times=ts.shape[1])
        last_side, n = Conditions.head + conditions.count, q.shape[1]
        (event, t, worst), sides = crossing[:, :3].T, crossing[:, Conditions.head : last_side]
        q_end, v_end = crossing[:, last_side : last_side + n], crossing[:, last_side + n :]
        return StretchEnd(qs, vs, violation, info, event, t, worst, sides, q_end, v_end)

    def at(self, members: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> StateValues:
        """Evaluate the conditions of members at states."""
        operation, conditions, (b, n) = self.plan.states, self.plan.states.conditions, q.shape
        assert conditions is not None  # this code has conditions
        numbers = self._with_marks(members, t, q, v)
        if self._samples:
            numbers = _spread(numbers, b).copy()
            row = np.sum(_of(self._breaks, members) <= t[:, None], axis=1)
            numbers[:, list(self.plan.run.sampled)] = _spread(_of(self._samples[0], members), b)[np.arange(b), row]
        further = _of(self._of_states, members), _of(self._rows, members), np.zeros((1, 0))
        inputs = numbers, np.stack([t, t], axis=1), q, v, *further
        of_states = _of(self._numbers_of_states, members)
        if self.plan.sides_of_events:
            of_states = _spread(of_states, b).copy()
            self._put_sides(of_states, members)
        (results,) = call_members(*inputs, of_states, operation=operation, times=2)
        values = [results[:, place].reshape(b, *shape) for place, shape in self._places]
        directions = np.zeros((b, conditions.own_count, n))
        if operation.impacts:
            directions[:, list(operation.impacts)] = results[:, self._places[-1][0].stop :].reshape(b, -1, n)
        return StateValues._make([*values, directions])

    def project(
        self, members: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities of members, projected to the constraints of the phase."""
        operation, n = self.plan.project, q.shape[1]
        assert operation is not None  # events add joints
        further = _of(self._of_states, members), _of(self._rows, members), np.zeros((1, 0))
        inputs = self._with_marks(members, t, q, v), np.stack([t, t], axis=1), q, v
        (results,) = call_members(*inputs, *further, operation=operation, times=2)
        return results[:, :n], results[:, n:]

    def _put_sides(self, numbers: np.ndarray, members: Int[np.ndarray, "b"]):
        """Put the sides of comparisons into the numbers of events."""
        for place, side in self.plan.sides_of_events:
            numbers[:, place] = self._joints[-1][members, side]

    def _numbers_of(self, members: Int[np.ndarray, "b"]) -> np.ndarray:
        """Return the numbers of members, with those of the joints that events have added."""
        numbers = _of(self._numbers, members)
        if any(self.plan.joints):
            numbers = _spread(numbers, len(members)).copy()
            for places, joint in zip(self.plan.joints, self._joints, strict=True):
                if places:
                    numbers[:, list(places)] = joint[members]
        return numbers

    def _with_marks(self, members: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the numbers of members, with marks of independent rows, determined where each member enters the phase first."""
        numbers, marking = self._numbers_of(members), self.plan.marking
        if marking is None:
            return numbers
        m = self.plan.run.code.row_count
        if np.isnan(self._marks[members]).any():
            scene_numbers = numbers[:, : marking.code.number_count - 2]
            tol = _spread(_of(self._tol, members), len(numbers))
            inputs = np.concatenate([scene_numbers, tol, np.zeros((len(numbers), 1))], axis=1), np.stack([t, t], axis=1), q, v
            further = _of(self._settings, members)[:, self._of_marking], _of(self._rows, members), np.zeros((1, 0))
            (self._marks[members],) = call_members(*inputs, *further, operation=marking, times=2)
        numbers = _spread(numbers, len(members)).copy()
        numbers[:, -2 - m : -2] = self._marks[members]
        return numbers


def _of(x: np.ndarray, members: Int[np.ndarray, "b"]) -> np.ndarray:
    """Return the rows of members, or the single row that all share."""
    return x if len(x) == 1 else x[members]


def _spread(x: np.ndarray, count: int) -> np.ndarray:
    return np.broadcast_to(x, (count, *x.shape[1:]))
