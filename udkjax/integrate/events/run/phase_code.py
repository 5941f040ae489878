"""Machine code of the phases of runs with events, for batches: integration to the next crossing, evaluation at single states."""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.equations.terms import switches as switching
from udkjax.integrate.compiled_mechanism import CompiledMechanism
from udkjax.integrate.events.instant.runs import RunState
from udkjax.integrate.events.instant.system import StateValues
from udkjax.integrate.events.law.event_plan import EventPlan
from udkjax.integrate.events.law.kinks import KinkPlaces, places_of_sides
from udkjax.integrate.events.law.phases import SWITCHED, Phases, Switches
from udkjax.integrate.events.run.added_joints import AddedJoint, places_of_joints
from udkjax.integrate.events.run.passed_events import NumberPlaces, PassedEvents, passed_events
from udkjax.integrate.native_engine import integrator_output, run_inputs
from udkjax.integrate.problem import IntegratorOutput, Problem
from udkjax.native.loaded_code import MemberCalls
from udkjax.native.operations import EvaluateEvents, MarkRows, StateOperation
from udkjax.native.runs import RunWatched
from udkjax.native.watching.conditions import Conditions

INPUT_NAMES = RunWatched.input_names
STATE_INPUTS = slice(INPUT_NAMES.index("ts"), INPUT_NAMES.index("v") + 1)  # the inputs of a run that are times and initial state
PHASE_ARRAYS = ("numbers", "settings", "rows", "breaks", "rank_tol")  # arrays of a phase, followed by its samples if it has any
ONE_MEMBER_MASK = np.ones(1, bool)  # of one member


class ValuesLayout:
    """The layout of `StateValues` in the flat results of the operation `EvaluateEvents`.

    Args:
        operation: the operation.
        switches: the switches of the phases.
    """

    def __init__(self, operation: EvaluateEvents, switches: Switches):
        conditions = operation.conditions
        assert conditions is not None  # the operation evaluates them
        n, E = operation.code.coordinate_count, conditions.own_count
        self._directed, self._holds = list(operation.directed), np.flatnonzero(np.array(switches.rows, int) >= 0)
        self._conditions, self._count = conditions, E
        (self.size,) = operation.outputs((), 2)[0]
        self._places, start = [], 0
        for shape in ((n,), (E,), (E,), (E,), (E,), (E, n), (E, n)):  # of the fields of `StateValues` before directions
            self._places.append((slice(start, start + math.prod(shape)), shape))
            start += math.prod(shape)

    def values(self, results: Float[Any, "b K"], xp: ModuleType) -> StateValues:
        """Return the values of b states from the results (b, K) of the operation."""
        b, conditions, E = len(results), self._conditions, self._count
        values = [xp.reshape(results[:, place], (b, *shape)) for place, shape in self._places]
        n = self._places[0][1][0]
        start, end = self._places[-1][0].stop, results.shape[1] - (conditions.force_count + (conditions.forces is not None))
        directions = [xp.zeros((b, E, n)), xp.zeros((b, E, n))]
        if self._directed:
            found = xp.reshape(results[:, start:end], (b, -1, len(self._directed), n))
            for k in range(found.shape[1]):
                directions[k] = _put(directions[k], self._directed, found[:, k], xp)
        forces, safe = xp.ones((b, E)), xp.ones(b, bool)
        if conditions.force_count:
            forces, safe = _put(forces, self._holds, results[:, end:-1], xp), results[:, -1] > 0.5
        return StateValues._make([*values, *directions, forces, safe])


def _put(x: Any, columns: Any, new: Any, xp: ModuleType) -> Any:
    """Return an array with `new` values in some columns; a NumPy array changes in place."""
    if xp is not np:
        return x.at[:, columns].set(new)
    x[:, columns] = new
    return x


class PhasePlan(NamedTuple):
    """The operations of the phases of one mechanism; hashable."""

    run: RunWatched
    states: EvaluateEvents
    marking: MarkRows | None  # marks independent rows; None if no marks are needed
    projected: bool  # whether each step is projected onto the constraints
    project: StateOperation  # of states whose velocities an event has changed; compiled by its first call
    joints: tuple[tuple[int, ...], ...]  # places of the numbers of each joint that events add, then of all sides
    active: tuple[tuple[int, int], ...]  # places of the numbers that switch constraints on, each with the index of the switch
    sides_of_events: tuple[tuple[int, int], ...]  # places of sides among the numbers of events, with the index of the side

    @property
    def number_count(self) -> int:
        """The number of the numbers that conditions depend on."""
        return 0 if self.run.conditions is None else self.run.conditions.number_count

    @property
    def force_count(self) -> int:
        """The number of watched forces."""
        return 0 if self.run.conditions is None else self.run.conditions.force_count

    @property
    def count(self) -> int:
        """The number of arrays of `phase_arrays`."""
        return len(PHASE_ARRAYS) + bool(self.run.sampled)


def phase_plan(
    which: int,
    plan: EventPlan,
    phases: Phases,
    compiled: CompiledMechanism,
    conditions: Conditions,
    added: Sequence[AddedJoint],
    of_kinks: KinkPlaces,
) -> PhasePlan:
    """Return the operations of the phases of the mechanism `which`, SCENE or SWITCHED.

    Args:
        which: SCENE or SWITCHED.
        plan: the plan of the events.
        phases: all phases.
        compiled: the mechanism, compiled.
        conditions: conditions of all events, with forces.
        added: the joints that events add.
        of_kinks: the places of kinks among the numbers of events.
    """
    run, names, active = compiled.plan.operation, [name for _, name in phases.added_by], ()
    assert run is not None  # checked by the caller
    mechanism, joints = compiled.samples.stand_in(compiled.textbook.mechanism), [()] * len(added)
    directed = tuple(int(k) for k in (*np.flatnonzero(plan.impacts), *plan.forwards))  # with directions of impulses
    without = replace(conditions, forces=None, force_key="")
    has_forces = any(which == SWITCHED or x.contact < 0 for x in phases.sticking)
    if which == SWITCHED:
        active, joints = switching.places_of_switches(mechanism, phases.switches.names), places_of_joints(mechanism, names)
    sides = places_of_sides(mechanism, phases.sided) if phases.sided else ()
    watched = conditions if which == SWITCHED else without  # nothing is held that could let go
    first_mark = run.code.marks.start if run.code.marks_rows else -1
    places = NumberPlaces(sides, joints, active, first_mark)
    return PhasePlan(
        run=run.watching(watched, **passed_events(plan, phases, watched, of_kinks, added, places)),
        states=run.accelerations.of_events(conditions if has_forces else without, directed),
        marking=_marking(compiled.textbook) if run.code.marks_rows and not run.code.weighs_rows else None,
        projected=compiled.plan.projected,
        project=run.accelerations.jump,
        joints=(*joints, sides),
        active=active,
        sides_of_events=of_kinks.sides,
    )


def _marking(textbook: Any) -> MarkRows:
    """Return the operation that marks independent rows among those that its inputs mark as candidates."""
    return MarkRows(textbook.programs_of_marked_rows)


def phase_arrays(problem: Problem, plan: PhasePlan, xp: ModuleType = jnp) -> list[Any]:
    """Return the arrays of the phases of one mechanism, each with a leading axis of length one: `PHASE_ARRAYS`, then samples."""
    if plan.marking is not None:
        problem = replace(problem, marks=np.ones(plan.run.code.row_count))
    inputs = run_inputs(problem, plan.run, xp)
    tol = problem.textbook.scales.rank_tol**2 if plan.marking is not None else 0.0
    return [
        *inputs[: STATE_INPUTS.start],
        *inputs[STATE_INPUTS.stop : len(INPUT_NAMES)],
        xp.reshape(xp.asarray(tol, float), (1, 1)),
        *inputs[len(INPUT_NAMES) :],
    ]


class StretchEnd(NamedTuple):
    """The results of stretches of b members, which end at a crossing, at the end of the run or with a failure.

    Integers are stored as floats.
    """

    q: Float[np.ndarray, "b T n"]  # at the requested times
    v: Float[np.ndarray, "b T n"]
    violation: Float[np.ndarray, "b T"]  # of Psi, over the scales of the rows
    info: Float[np.ndarray, "b K"]  # `RunStates.info_names`, and the last state of the integrator
    event: Float[np.ndarray, "b"]  # index of the watched quantity that crosses; -1: none
    t: Float[np.ndarray, "b"]  # the end (s); no event happens before
    worst: Float[np.ndarray, "b"]  # largest violation at a node
    sides: Float[np.ndarray, "b C"]  # of zero, of the watched conditions and forces at t
    q_end: Float[np.ndarray, "b n"]  # at t
    v_end: Float[np.ndarray, "b n"]
    passed: PassedEvents | None  # None if this machine code passes no events


class PhaseCode:
    """The machine code of the phases of one mechanism, with the numbers of all members of a batch.

    Args:
        plan: the operations of the phases.
        switches: the switches of the phases.
        arrays: arrays from `phase_arrays`, for one member or for all.
        event_numbers: the numbers of all events.
        inverse_mass: one over the mass of each coordinate.
        joints: the numbers of the joints that events have added, then all sides, for all members; changed in place.
        widths: the number of numbers of each joint, then of sides.
    """

    def __init__(
        self,
        plan: PhasePlan,
        switches: Switches,
        arrays: Sequence[np.ndarray],
        event_numbers: np.ndarray,
        inverse_mass: np.ndarray,
        joints: Float[np.ndarray, "B K"],
        widths: Sequence[int],
    ):
        self.plan, (self._numbers, self._settings, self._rows, self._breaks, self._tol, *self._samples) = plan, arrays
        names = plan.run.all_settings
        self._tolerances = [names.index(name) for name in ("rtol", "atol")]
        self._of_states = self._settings[:, [names.index(name) for name in plan.states.all_settings]]
        self._of_marking = [] if plan.marking is None else [names.index(name) for name in plan.marking.all_settings]
        self._event_numbers, self._joints = event_numbers, joints
        rows = max(len(event_numbers), len(inverse_mass))
        self._numbers_of_states = np.concatenate([_spread(x, rows) for x in (event_numbers, inverse_mass)], axis=1)
        self._layout, self._switches = ValuesLayout(plan.states, switches), switches
        places = np.concatenate([np.array(x or [-1] * width, int) for x, width in zip(plan.joints, widths, strict=True)])
        self._columns, self._first_side = np.flatnonzero(places >= 0), joints.shape[1] - widths[-1]
        self._places_of_joints = places[self._columns]
        self._of_switches = np.array(plan.active, int).reshape(-1, 2).T
        self._run, self._evaluate = MemberCalls(plan.run), MemberCalls(plan.states).at_states
        self._mark_rows = plan.marking and MemberCalls(plan.marking).at_states
        self._project = MemberCalls(plan.project).at_states
        self._seen: tuple[bytes, ...] = ()  # the states that were evaluated last, and their values
        self._values: StateValues | None = None
        self._marks: dict[bytes, np.ndarray] = {}  # by the phase, of all members; NaN: not known yet
        self._no_marks = np.full((len(joints), plan.run.code.row_count), np.nan)

    def atol(self, members: Int[np.ndarray, "b"]) -> Float[np.ndarray, "#b 1"]:
        """Return the absolute tolerance of members, in units of the scene, as a column."""
        return _of(self._settings, members)[:, [self.plan.run.all_settings.index("atol")]]

    def tolerances(self, members: Int[np.ndarray, "b"]) -> Float[np.ndarray, "b"]:
        """Return the smaller nonzero tolerance of members: the relative one, or the absolute one in units of the scene."""
        both = _of(self._settings, members)[:, self._tolerances]
        return np.broadcast_to(np.where(both > 0, both, np.inf).min(axis=1), len(members))

    def run(
        self, members: Int[np.ndarray, "b"], ts: np.ndarray, state: RunState, watch: np.ndarray, tightened: Float[np.ndarray, "b"]
    ) -> StretchEnd:
        """Integrate members over times (b, T), up to their first crossing.

        Args:
            members: the indices of the members.
            ts: the times (s).
            state: the states of the members.
            watch: the input that describes the watched conditions (`MachineSystem._watch`); this function puts their numbers
                and the sides of comparisons in it.
            tightened: factors of the tolerances of members.
        """
        _, q, v, *_ = state
        conditions = self.plan.run.conditions
        assert conditions is not None  # this code has conditions
        numbers = self._with_marks(members, state)
        settings, *further = [_of(x, members) for x in (self._settings, self._rows, self._breaks, *self._samples)]
        if (tightened != 1.0).any():
            settings = _spread(settings, len(members)).copy()
            settings[:, self._tolerances] *= tightened[:, None]
        watch[:, : conditions.number_count] = _of(self._event_numbers, members)
        self._put_sides(watch, members)
        inputs = numbers, ts, q, v, settings, *further, watch
        qs, vs, violation, info, crossing, *record = self._run(*inputs, times=ts.shape[1])
        last_side, n = Conditions.head + conditions.count, q.shape[1]
        (event, t, worst), sides = crossing[:, :3].T, crossing[:, Conditions.head : last_side]
        q_end, v_end = crossing[:, last_side : last_side + n], crossing[:, last_side + n :]
        passing = self.plan.run.passing
        passed = None if passing is None else PassedEvents.of(record[0], passing, n)
        return StretchEnd(qs, vs, violation, info, event, t, worst, sides, q_end, v_end, passed)

    def flow(self, member: int, ts: Float[np.ndarray, "T"], state: RunState) -> IntegratorOutput:
        """Integrate a member over times without watching conditions; its state has a leading axis of length one."""
        members, run = np.array([member]), MemberCalls(self.plan.run.unwatched)
        further = [_of(x, members) for x in (self._settings, self._rows, self._breaks, *self._samples)]
        return integrator_output(run(self._with_marks(members, state), ts[None], state.q, state.v, *further, times=len(ts)))

    def breakpoints(self, member: int) -> Float[np.ndarray, "k"]:
        """Return the times (s) at which the motion of a member is not smooth."""
        return self._breaks[member if len(self._breaks) > 1 else 0]

    def setting(self, name: str, member: int) -> float:
        """Return the setting with this name of a member."""
        return self._settings[member if len(self._settings) > 1 else 0, self.plan.run.all_settings.index(name)]

    def at(self, members: Int[np.ndarray, "b"], state: RunState) -> StateValues:
        """Return the values of the conditions of members at states."""
        t, q, v, *_ = state
        b = len(q)
        numbers = self._with_samples(members, t, self._with_marks(members, state))
        given = tuple([x.tobytes() for x in (members, t, q, v, numbers)])
        if self._values is not None and given == self._seen:
            return self._values
        further = _of(self._of_states, members), _of(self._rows, members), np.zeros((1, 0))
        inputs = numbers, np.stack([t, t], axis=1), q, v, *further
        of_states = _of(self._numbers_of_states, members)
        if self.plan.sides_of_events:
            of_states = _spread(of_states, b).copy()
            self._put_sides(of_states, members)
        (results,) = self._evaluate(*inputs, of_states)
        self._seen, self._values = given, self._layout.values(results.copy(), np)
        return self._values

    def project(self, members: Int[np.ndarray, "b"], state: RunState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q and v of members, projected onto the constraints of their phases, and the largest remaining |Psi_dot_i|."""
        t, q, v, *_ = state
        n = q.shape[1]
        further = _of(self._of_states, members), _of(self._rows, members), np.zeros((1, 0))
        numbers = self._with_samples(members, t, self._with_marks(members, state))
        (results,) = self._project(numbers, np.stack([t, t], axis=1), q, v, *further)
        return results[:, :n].copy(), results[:, n:-1].copy(), results[:, -1].copy()

    def _put_sides(self, numbers: np.ndarray, members: Int[np.ndarray, "b"]):
        """Put the sides of the comparisons in forces into the numbers of the events of members, in place."""
        for place, side in self.plan.sides_of_events:
            numbers[:, place] = self._joints[members, self._first_side + side]

    def _numbers_of(self, members: Int[np.ndarray, "b"], phase: Bool[np.ndarray, "b C"]) -> np.ndarray:
        """Return the numbers of members in their phases, with those of the joints that events have added."""
        numbers = np.empty((len(members), self._numbers.shape[1]))
        numbers[:] = _of(self._numbers, members)
        numbers[:, self._places_of_joints] = self._joints[members[:, None], self._columns]
        places, switches = self._of_switches
        numbers[:, places] = phase[:, switches]
        return numbers

    def _with_samples(self, members: Int[np.ndarray, "b"], t: Float[np.ndarray, "b"], numbers: np.ndarray) -> np.ndarray:
        """Return the numbers of members with the samples at their times; only a run takes the samples of all times."""
        if not self._samples:
            return numbers
        numbers, b = _spread(numbers, len(t)).copy(), len(t)
        row = np.sum(_of(self._breaks, members) <= t[:, None], axis=1)
        numbers[:, list(self.plan.run.sampled)] = _spread(_of(self._samples[0], members), b)[np.arange(b), row]
        return numbers

    def _with_marks(self, members: Int[np.ndarray, "b"], state: RunState) -> np.ndarray:
        """Return the numbers of members with marks of independent rows, determined when a member first enters a phase."""
        numbers = self._numbers_of(members, state.phase)
        if self.plan.marking is None:
            return numbers
        is_one = len(members) == 1
        for phase in state.phase if is_one else np.unique(state.phase, axis=0):
            marks, here = self._marks.get(phase.tobytes()), ONE_MEMBER_MASK if is_one else (state.phase == phase).all(axis=1)
            if marks is None:
                marks = self._marks[phase.tobytes()] = self._no_marks.copy()
            unknown = here & np.isnan(marks[members, 0])  # all marks of a member become known together
            if unknown.any():
                found = self._mark(members[unknown], numbers[unknown], state.where(unknown))
                marks[members[unknown]] = found
            numbers[here, self.plan.run.code.marks] = marks[members[here]]
        return numbers

    def _mark(self, members: Int[np.ndarray, "b"], numbers: np.ndarray, state: RunState) -> np.ndarray:
        """Return the marks of independent rows of members at their states."""
        marking, (t, q, v, phase, _), m = self.plan.marking, state, self.plan.run.code.row_count
        assert marking is not None and self._mark_rows is not None  # checked by the caller
        numbers = self._with_samples(members, t, numbers)
        scene_numbers, tol = numbers[:, : marking.code.marks.start], _spread(_of(self._tol, members), len(numbers))
        among = np.ones((len(numbers), m))
        if self.plan.active:
            among = self._switches.independent(phase, np).astype(float)
        inputs = np.concatenate([scene_numbers, among, tol, np.zeros((len(numbers), 1))], axis=1), np.stack([t, t], axis=1), q, v
        further = _of(self._settings, members)[:, self._of_marking], _of(self._rows, members), np.zeros((1, 0))
        (marks,) = self._mark_rows(*inputs, *further)
        if not self.plan.run.code.shares_by_marks:
            return marks * among
        return np.where(marks * among > 0, 1.0, -1.0) * (self._switches.on(phase) if self.plan.active else 1.0)


def _of(x: np.ndarray, members: Int[np.ndarray, "b"]) -> np.ndarray:
    """Return the rows of members, or the single row that all share."""
    return x if len(x) == 1 else x[members]


def _spread(x: np.ndarray, count: int) -> np.ndarray:
    return np.broadcast_to(x, (count, *x.shape[1:]))
