"""Events of a portable engine: their data for a page, and the operations that run to the next event and evaluate states."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.complementarity.stick_or_slip import SIDES
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.terms import switches as switching
from udkjax.integrate.events.instant.listing import names_of_events
from udkjax.integrate.events.law.actions import numbers_of_actions
from udkjax.integrate.events.law.crossings import NO_EVENT, ZERO_TOL, zero_of
from udkjax.integrate.events.law.event import Event, ExpandsToEvents, expand_events
from udkjax.integrate.events.law.event_plan import EventPlan, event_plan
from udkjax.integrate.events.law.kinks import places_of_sides
from udkjax.integrate.events.law.phases import Phases, events_and_phases
from udkjax.integrate.events.run.added_joints import added_joints, joint_numbers, places_of_joints
from udkjax.integrate.events.run.condition_program import condition_numbers, watched_conditions, with_forces
from udkjax.integrate.events.run.phase_code import ValuesLayout
from udkjax.integrate.portable.instants import CHANGED_FIELDS, LAST_EVENT_FIELDS, Instants
from udkjax.integrate.solution import Result
from udkjax.native.language.program import UnsupportedError
from udkjax.native.operations import EvaluateEvents, StateOperation
from udkjax.native.runs import RunStates
from udkjax.native.watching.conditions import Conditions
from udkjax.scene.mechanism import Mechanism

MOST_EVENTS = 1000  # largest number in a run of a page; nobody would look at more
# Why a run ends at an event; those that are not here have an event's name on the page, or go on.
END_REASONS = {
    Result.beyond_contact: "it begins beyond a contact",
    Result.event_impossible: "the constraints allow no impulse, or no friction obeys its law",
    Result.painleve_paradox: "no forces of the contacts obey the law of friction (Painleve's paradox)",
}
PAGE_RESULTS = Result.successful, Result.event_stop, Result.at_rest, Result.undefined_condition


def names_of_run(mechanism: Mechanism, events: Sequence[Event]) -> tuple[str, ...]:
    """Return the names of all events that a run may list.

    Args:
        mechanism: the scene.
        events: the events of its runs, where each that stands for several is replaced by these (`expanded`).
    """
    return names_of_events(*events_and_phases(mechanism, events, analyse(mechanism))[1:])


class PortableEvents:
    """The events of the runs of a portable engine, including those of joints with set-valued friction, and their phases.

    Args:
        events: the events, as for `simulate`.
        scene: the mechanism of all runs, with the springs by which a page pulls bodies.
        analysis: the analysis of that mechanism.

    Raises:
        UnsupportedError: a condition has an operation without a machine instruction.
    """

    def __init__(self, events: Sequence[ExpandsToEvents], scene: Mechanism, analysis: Analysis):
        self._given, self._of_scene = tuple(events), analysis
        self.events, self.phases = self._prepared(scene)
        conditions = watched_conditions(self.events, self.phases.mechanisms[0]) if self.events else None
        if conditions is None and self.events:
            raise UnsupportedError("the condition of an event")
        self._conditions = conditions
        self.analysis: Any = self.phases.analyses[-1]

    def _prepared(self, scene: Mechanism) -> tuple[tuple[Event, ...], Phases]:
        """Return all events, and the phases that they lead to."""
        given = expand_events(self._given, scene) if self._given else ()
        _, events, phases = events_and_phases(scene, given, self._of_scene)
        return events, phases

    def mechanism(self, scene: Mechanism) -> Mechanism:
        """Return the mechanism that serves all phases, with the numbers of a scene, maybe traced, in the first phase."""
        _, phases = self._prepared(scene)
        added = *phases.first_added(), jnp.zeros(SIDES * len(phases.sticking))
        return phases.mechanism(len(phases.mechanisms) - 1, jnp.asarray(self.plan.first), added)

    def numbers(self, scene: Mechanism) -> list[list[Array]]:
        """Return the numbers of the conditions, the actions, and the joints that events add: three lists of arrays."""
        if not self.events:
            return [[], [], []]
        events, phases = self._prepared(scene)
        actions = numbers_of_actions([e.action for e in events], jnp)
        return [condition_numbers(events), [actions], joint_numbers(phases)]

    @cached_property
    def plan(self) -> EventPlan:
        """The plan of the events, with room for those of one instant: each may happen, let go and rest."""
        most = 2 + 3 * len(self.events)
        by_velocity = () if self._conditions is None else self._conditions.by_velocity
        return event_plan(self.phases, self.events, np.iinfo(np.int32).max, most, by_velocity)

    def _watched(self, operation: RunStates) -> Conditions:
        assert self._conditions is not None  # there are events
        return with_forces(self._conditions, self.events, self.phases.switches, operation.code.row_count)

    def watched_by(self, operation: RunStates) -> RunStates:
        """Return the operation of a run that ends where a condition or a force crosses zero; the given one without events."""
        return operation.watching(self._watched(operation)) if self.events else operation

    def states_of(self, run: RunStates) -> EvaluateEvents:
        """Return the operation that evaluates conditions, their rates and slopes, directions of impulses and forces at states."""
        directed = tuple(int(k) for k in (*np.flatnonzero(self.plan.impacts), *self.plan.forwards))
        return run.accelerations.of_events(self._watched(run), directed)

    def projection_of(self, run: RunStates) -> StateOperation:
        """Return the operation that projects states whose velocities an event has changed."""
        return run.accelerations.jump

    def instants(self, run: RunStates) -> Instants:
        """Return the code of everything that happens at an instant."""
        values = ValuesLayout(self.states_of(run), self.phases.switches)
        n = self.phases.mechanisms[0].coordinate_count
        return Instants(self.plan, added_joints(self.phases), values, n, (self.events, self.phases))

    def data(self, dressed: Mechanism, instants: Instants, atol: float) -> dict[str, Any]:
        """Return the events as data of a page.

        Args:
            dressed: the mechanism that serves all phases.
            instants: the code of everything that happens at an instant.
            atol: the absolute tolerance of runs, in units of the scene.
        """
        plan, phases, switches = self.plan, self.phases, self.phases.switches
        joints = places_of_joints(dressed, [name for _, name in phases.added_by])
        sides = places_of_sides(dressed, phases.sided) if phases.sided else ()
        places = [place for of_joint in (*joints, sides) for place in of_joint]
        locks = zip(phases.sticking, plan.locks, strict=True) if phases.sticking else ()
        watched = [*range(plan.count), *(plan.count + k for k, row in enumerate(switches.rows) if row >= 0)]
        return {
            "names": names_of_events(self.events, phases),
            "kept": [*(x for x in CHANGED_FIELDS if x not in ("t", "q", "v")), *(f"last_{x}" for x in LAST_EVENT_FIELDS)],
            "watched": watched,
            "directions": plan.both_directions[watched].tolist(),
            "zeros": zero_of(plan.slides, np.array([atol]), np).tolist(),
            "zero": ZERO_TOL,
            "slowest": float(self.analysis.scales.rate),
            "most": MOST_EVENTS,
            "head": Conditions.head,
            "switches": switching.places_of_switches(dressed, switches.names) if switches.names else [],
            "switch_of_row": list(switches.switch_of_row),
            "joints": places,
            "sticking": {x.name: [int(lock), len(places) - plan.side_count + x.first + 1] for x, lock in locks},
            "starts": instants.starts,
            "no_event": NO_EVENT,
            "results": {x.name: int(x) for x in PAGE_RESULTS},
            "words": {int(result): words for result, words in END_REASONS.items()},
        }
