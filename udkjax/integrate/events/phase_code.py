"""Machine code of the phases of a run with events, for the members of a batch: to the next crossing, and at single states."""

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
from udkjax.integrate.events.system import StateValues
from udkjax.integrate.native_engine import run_inputs
from udkjax.integrate.problem import Problem
from udkjax.native.operations import EvaluateEvents, MarkRows, StateOperation
from udkjax.native.primitive import call_members
from udkjax.native.runs import RunWatched
from udkjax.native.watching.conditions import Conditions

INPUTS = RunWatched.input_names
STATE = slice(INPUTS.index("ts"), INPUTS.index("v") + 1)  # of the inputs of a run: times and the initial state
PARTS = ("numbers", "settings", "rows", "breaks", "rank_tol")  # of a phase, as arrays; then its samples, if there are some


class PhasePlan(NamedTuple):
    """The operations of a phase; hashable."""

    run: RunWatched
    states: EvaluateEvents
    marking: MarkRows | None  # of independent rows, if the run has to find them
    projected: bool
    project: StateOperation | None  # to the joints that events add, where they do
    joints: tuple[tuple[int, ...], ...]  # of each such joint: the places of its numbers, none where the phase does not have it

    @property
    def count(self) -> int:
        """The number of its arrays."""
        return len(PARTS) + bool(self.run.sampled)


def phase_plan(
    compiled: CompiledMechanism, conditions: Conditions, held: Sequence[int], impacts: Sequence[int], added: Sequence[str]
) -> PhasePlan:
    """Return the operations of a phase.

    Args:
        compiled: its mechanism.
        conditions: conditions of all events.
        held: of each event, the row of Psi that holds its contact; -1: none.
        impacts: the events that are impacts.
        added: the names of joints that events add.
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
    return PhasePlan(run.watching(replace(conditions, rows=rows)), states, marking, compiled.plan.projected, project, joints)


def phase_arrays(problem: Problem, plan: PhasePlan, xp: ModuleType = jnp) -> list[Any]:
    """Return the arrays of a phase, with the member first."""
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
    """The ends of some runs, at a crossing or not, and their outputs; whole numbers as floats."""

    q: Float[np.ndarray, "b T n"]  # at the requested times
    v: Float[np.ndarray, "b T n"]
    violation: Float[np.ndarray, "b T"]
    info: Float[np.ndarray, "b K"]  # `RunStates.info_names`, and the last state of the integrator
    event: Float[np.ndarray, "b"]  # index of the watched quantity that crosses; -1: none
    t: Float[np.ndarray, "b"]  # up to which nothing else happens
    worst: Float[np.ndarray, "b"]  # violation at a node
    sides: Float[np.ndarray, "b C"]
    q_end: Float[np.ndarray, "b n"]  # at t
    v_end: Float[np.ndarray, "b n"]


class PhaseCode:
    """The machine code of a phase, with the numbers of all members of a batch.

    Args:
        plan: its operations.
        arrays: arrays by `phase_arrays`, of one member or of all.
        event_numbers: the numbers of all events.
        inverse_mass: one over the mass of each coordinate.
        members: number of members.
        joints: the numbers of the joints that events have added, of all members; they change.
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
        assert plan.states.conditions is not None  # it evaluates some
        n, E = inverse_mass.shape[1], plan.states.conditions.own_count
        self._places, start = [], 0
        for shape in ((n,), (E,), (E,), (E,), (E,), (E, n), (E, n)):  # of the fields of `StateValues`
            self._places.append((slice(start, start + math.prod(shape)), shape))
            start += math.prod(shape)
        self._marks = np.full((members, plan.run.code.row_count), np.nan)

    def run(self, some: Int[np.ndarray, "b"], ts: np.ndarray, q: np.ndarray, v: np.ndarray, watch: np.ndarray) -> StretchEnd:
        """Run some members over times (b, T) to the first crossing; `watch` is what is watched, with room for its numbers."""
        operation, conditions = self.plan.run, self.plan.run.conditions
        assert conditions is not None  # it watches some
        numbers = self._with_marks(some, ts[:, 0], q, v)
        own = [_of(x, some) for x in (self._settings, self._rows, self._breaks, *self._samples)]
        watch[:, : conditions.number_count] = _of(self._event_numbers, some)
        qs, vs, violation, info, crossing = call_members(numbers, ts, q, v, *own, watch, operation=operation, times=ts.shape[1])
        behind, n = Conditions.head + conditions.count, q.shape[1]
        sides, q_end, v_end = crossing[:, Conditions.head : behind], crossing[:, behind : behind + n], crossing[:, behind + n :]
        return StretchEnd(qs, vs, violation, info, crossing[:, 0], crossing[:, 1], crossing[:, 2], sides, q_end, v_end)

    def at(self, some: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> StateValues:
        """Evaluate some members at states."""
        operation, conditions, (b, n) = self.plan.states, self.plan.states.conditions, q.shape
        assert conditions is not None  # it evaluates some
        numbers = self._with_marks(some, t, q, v)
        if self._samples:
            numbers = _spread(numbers, b).copy()
            row = np.sum(_of(self._breaks, some) <= t[:, None], axis=1)
            numbers[:, list(self.plan.run.sampled)] = _spread(_of(self._samples[0], some), b)[np.arange(b), row]
        given = numbers, np.stack([t, t], axis=1), q, v, _of(self._of_states, some), _of(self._rows, some), np.zeros((1, 0))
        (found,) = call_members(*given, _of(self._numbers_of_states, some), operation=operation, times=2)
        values = [found[:, place].reshape(b, *shape) for place, shape in self._places]
        directions = np.zeros((b, conditions.own_count, n))
        if operation.impacts:
            directions[:, list(operation.impacts)] = found[:, self._places[-1][0].stop :].reshape(b, -1, n)
        return StateValues._make([*values, directions])

    def project(self, some: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions and velocities of some members to the constraints of the phase."""
        operation, n = self.plan.project, q.shape[1]
        assert operation is not None  # events add joints
        further = _of(self._of_states, some), _of(self._rows, some), np.zeros((1, 0))
        given = self._with_marks(some, t, q, v), np.stack([t, t], axis=1), q, v
        (found,) = call_members(*given, *further, operation=operation, times=2)
        return found[:, :n], found[:, n:]

    def _numbers_of(self, some: Int[np.ndarray, "b"]) -> np.ndarray:
        """Return the numbers of some members, those of joints as events have added them."""
        numbers = _of(self._numbers, some)
        if any(self.plan.joints):
            numbers = _spread(numbers, len(some)).copy()
            for places, joint in zip(self.plan.joints, self._joints, strict=True):
                if places:
                    numbers[:, list(places)] = joint[some]
        return numbers

    def _with_marks(self, some: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the numbers of some members, with the marks of the rows that are independent near where they came first."""
        numbers, marking = self._numbers_of(some), self.plan.marking
        if marking is None:
            return numbers
        m = self.plan.run.code.row_count
        if np.isnan(self._marks[some]).any():
            own = numbers[:, : marking.code.number_count - 2]
            tol = _spread(_of(self._tol, some), len(numbers))
            given = np.concatenate([own, tol, np.zeros((len(numbers), 1))], axis=1), np.stack([t, t], axis=1), q, v
            further = _of(self._settings, some)[:, self._of_marking], _of(self._rows, some), np.zeros((1, 0))
            (self._marks[some],) = call_members(*given, *further, operation=marking, times=2)
        numbers = _spread(numbers, len(some)).copy()
        numbers[:, -2 - m : -2] = self._marks[some]
        return numbers


def _of(x: np.ndarray, some: Int[np.ndarray, "b"]) -> np.ndarray:
    """Return the rows of some members, or the one that all share."""
    return x if len(x) == 1 else x[some]


def _spread(x: np.ndarray, count: int) -> np.ndarray:
    return np.broadcast_to(x, (count, *x.shape[1:]))
