"""Machine code of the phases of a run with events, for the members of a batch: to the next crossing, and at single states."""

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
from udkjax.integrate.native_engine import run_inputs
from udkjax.integrate.problem import Problem
from udkjax.native.conditions import HEAD, Conditions
from udkjax.native.layout import INFO, INPUTS
from udkjax.native.operations import EvaluateEvents, MarkRows, ProjectStates
from udkjax.native.primitive import call_members
from udkjax.native.runs import RunWatched

STATE = slice(INPUTS.index("ts"), INPUTS.index("v") + 1)  # of the inputs of a run: times and the initial state
PARTS = ("numbers", "settings", "rows", "breaks", "rank_tol")  # of a phase, as arrays; then its samples, if there are some


class PhasePlan(NamedTuple):
    """The operations of a phase; hashable."""

    run: RunWatched
    states: EvaluateEvents
    marking: MarkRows | None  # of independent rows, where they are not known beforehand
    projected: bool
    project: ProjectStates | None  # to the joints that events add, where they do
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
    states = EvaluateEvents(run.code, run.pseudoinverse, run.formulation, conditions, tuple(impacts))
    marking = None
    if run.code.marks_rows:
        marking = MarkRows(scene_programs(compiled.textbook.mechanism.at(0.0)).with_all_rows)
    project = ProjectStates(run.code, run.pseudoinverse, run.formulation) if added else None
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
    """The ends of some runs, at a crossing or not, and their outputs."""

    q: Float[np.ndarray, "b T n"]  # at the times that were asked for
    v: Float[np.ndarray, "b T n"]
    violation: Float[np.ndarray, "b T"]
    written: Int[np.ndarray, "b"]  # the number of the last output, counted from the start as 0
    status: Int[np.ndarray, "b"]  # one of native/steps.py
    raw: Float[np.ndarray, "b 2n+1"]  # the last time and state of the integrator
    counts: Int[np.ndarray, "b 3"]  # steps tried, accepted, right-hand sides
    event: Int[np.ndarray, "b"]  # of what is watched: which crosses; -1: none
    t: Float[np.ndarray, "b"]  # up to which nothing else happens
    worst: Float[np.ndarray, "b"]  # violation at a node
    sides: Int[np.ndarray, "b C"]
    y: Float[np.ndarray, "b 2n"]  # at t


class States(NamedTuple):
    """Conditions at some states, with their derivatives and what impulses along them do."""

    a: Float[np.ndarray, "b n"]
    g: Float[np.ndarray, "b E"]
    rate: Float[np.ndarray, "b E"]
    rate_2: Float[np.ndarray, "b E"]
    by_t: Float[np.ndarray, "b E"]
    by_q: Float[np.ndarray, "b E n"]
    by_v: Float[np.ndarray, "b E n"]
    directions: Float[np.ndarray, "b E n"]  # of impulses; zero of events that are no impacts


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
        self._of_states = [names.index(name) for name in plan.states.all_settings]
        self._of_marking = [] if plan.marking is None else [names.index(name) for name in plan.marking.all_settings]
        self._event_numbers, self._inverse_mass, self._joints = event_numbers, inverse_mass, joints
        self._marks = np.full((members, plan.run.code.row_count), np.nan)

    def run(self, some: Int[np.ndarray, "b"], ts: np.ndarray, q: np.ndarray, v: np.ndarray, watch: np.ndarray) -> StretchEnd:
        """Run some members over times (b, T) to the first crossing; `watch` is what is watched besides (b, K)."""
        operation, conditions = self.plan.run, self.plan.run.conditions
        assert conditions is not None  # it watches some
        numbers = self._with_marks(some, ts[:, 0], q, v)
        own = [_of(x, some) for x in (self._settings, self._rows, self._breaks, *self._samples)]
        watch = np.concatenate([_spread(_of(self._event_numbers, some), len(some)), watch], axis=1)
        qs, vs, violation, info, crossing = call_members(numbers, ts, q, v, *own, watch, operation=operation, times=ts.shape[1])
        count = conditions.count
        code, t, *counts, written = (info[:, k] for k in range(len(INFO)))
        return StretchEnd(
            q=qs,
            v=vs,
            violation=violation,
            written=written.astype(int),
            status=code.astype(int),
            raw=np.concatenate([t[:, None], info[:, len(INFO) :]], axis=1),
            counts=np.stack(counts, axis=1).astype(int),
            event=crossing[:, 0].astype(int),
            t=crossing[:, 1],
            worst=crossing[:, 2],
            sides=crossing[:, HEAD : HEAD + count].astype(int),
            y=crossing[:, HEAD + count :],
        )

    def at(self, some: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> States:
        """Evaluate some members at states."""
        operation, conditions, (b, n) = self.plan.states, self.plan.states.conditions, q.shape
        assert conditions is not None  # it evaluates some
        numbers = self._with_marks(some, t, q, v)
        if self._samples:
            numbers = _spread(numbers, b).copy()
            row = np.sum(_of(self._breaks, some) <= t[:, None], axis=1)
            numbers[:, list(self.plan.run.sampled)] = _spread(_of(self._samples[0], some), b)[np.arange(b), row]
        settings = _of(self._settings, some)[:, self._of_states]
        further = np.concatenate([_spread(_of(x, some), b) for x in (self._event_numbers, self._inverse_mass)], axis=1)
        ts = np.stack([t, t], axis=1)
        (found,) = call_members(
            numbers, ts, q, v, settings, _of(self._rows, some), np.zeros((1, 0)), further, operation=operation, times=2
        )
        E = conditions.own_count
        a, g, rate, rate_2, by_t, by_q, by_v, of_impacts = np.split(found, np.cumsum([n, E, E, E, E, E * n, E * n]), axis=1)
        directions = np.zeros((b, E, n))
        directions[:, list(operation.impacts)] = of_impacts.reshape(b, -1, n)
        return States(a, g, rate, rate_2, by_t, by_q.reshape(b, E, n), by_v.reshape(b, E, n), directions)

    def project(self, some: Int[np.ndarray, "b"], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions and velocities of some members to the constraints of the phase."""
        operation, n = self.plan.project, q.shape[1]
        assert operation is not None  # events add joints
        further = _of(self._settings, some)[:, self._of_states], _of(self._rows, some), np.zeros((1, 0))
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
