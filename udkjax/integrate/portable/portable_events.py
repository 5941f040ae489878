"""Events of a portable engine: their data for a page, and the operations that run to the next event and evaluate states."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from udkjax.equations.rows.analysis import Analysis
from udkjax.integrate.events.instant import impacts as law
from udkjax.integrate.events.law.crossings import ZERO, ZERO_RATE, ZERO_RATE_2
from udkjax.integrate.events.law.event import Event, ExpandsToEvents, expand_events
from udkjax.integrate.events.law.phases import HeldContact, Switches
from udkjax.integrate.events.run.condition_program import condition_numbers, watched_conditions, with_forces
from udkjax.native.language.program import UnsupportedError
from udkjax.native.operations import EvaluateEvents
from udkjax.native.runs import RunStates
from udkjax.native.watching.conditions import Conditions
from udkjax.requirements import ArgumentError
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import join_names, quote

CONTACT = "{}.contact"  # name of the joint that holds the contact of an event
MOST_EVENTS = 1000  # largest number in a run of a page; nobody would look at more
TOLERANCES = {
    "zero": ZERO,
    "zero_rate": ZERO_RATE,
    "zero_rate_2": ZERO_RATE_2,
    "closed": law.CLOSED,
    "still": law.STILL,
    "rest": law.REST,
    "blocked": law.BLOCKED,
    "coupled": law.COUPLED,
}


def unknown_friction(mechanism: Mechanism, events: Sequence[Event] = ()) -> str:
    """Return which friction a page cannot compute, and the cure; empty if it can compute all.

    Args:
        mechanism: the scene.
        events: the events of its runs, expanded.

    Returns:
        The sentence of a refusal.
    """
    joints = [force.joint for force in mechanism.forces.values() if isinstance(force, Friction) and force.sticks]
    contacts = [event.name for event in events if event.action.friction is not None]
    if joints:
        which, cure = f"joints that stick ({join_names(list(map(quote, joints)))})", 'give their friction law="smooth"'
    elif contacts:
        which, cure = f"friction of contacts ({join_names(list(map(quote, contacts)))})", "leave out their coefficients"
    else:
        return ""
    return f"a page cannot compute {which} yet: {cure}, or leave out `live` to play the run as it is"


class PortableEvents:
    """The events, if any, of the runs of a portable engine.

    Raises:
        ArgumentError: an event changes the constraints.
        UnsupportedError: a condition has an operation without a machine instruction.
    """

    def __init__(self, events: Sequence[ExpandsToEvents], mechanism: Mechanism):
        self._given = tuple(events)
        self._events = expand_events(events, mechanism) if events else ()
        if refused := unknown_friction(mechanism, self._events):
            raise ArgumentError(f"live: {refused}")
        for event in self._events:
            if not event.action.on_page:
                kind, cure = type(event.action).__name__, "a page knows Log, Stop and Impact; leave out live"
                raise ArgumentError(f"live: the jump of event {quote(event.name)} ({kind}) cannot run in a page yet: {cure}")
        self._conditions = watched_conditions(self._events, mechanism) if events else None
        if self._conditions is None and events:
            raise UnsupportedError("the condition of an event")

    @property
    def holding(self) -> list[int]:
        """The indices of events whose contacts are held at rest."""
        return [k for k, e in enumerate(self._events) if e.action.rest == "hold"]

    def with_contact(self, mechanism: Mechanism, event: int) -> Mechanism:
        """Return the mechanism with the contact of an event at rest, as a joint."""
        held = expand_events(self._given, mechanism)[event]
        joints = {**mechanism.joints, CONTACT.format(held.name): HeldContact.of(held, mechanism)}
        return Mechanism(mechanism.bodies, joints, mechanism.drivers, mechanism.forces, mechanism.gravity, mechanism.name)

    def row(self, analysis: Analysis, event: int) -> int:
        """Return the row of Psi of the contact of an event."""
        return [name for name, _ in analysis.row_names].index(CONTACT.format(self._events[event].name))

    def data(self, analysis: Analysis) -> dict[str, Any] | None:
        """Return the events as data of a page; None without events."""
        if not self._events:
            return None
        assert self._conditions is not None  # since there are events
        return {
            "names": [event.name for event in self._events],
            "directions": [event.direction for event in self._events],
            "by_velocity": list(self._conditions.by_velocity),
            "stops": [event.action.stops for event in self._events],
            "restitution": [float(event.action.rebound) if event.action.is_impact else None for event in self._events],
            "ends_at_rest": [event.action.rest == "stop" for event in self._events],
            "slowest": float(analysis.scales.rate),
            "most": MOST_EVENTS,
            "head": Conditions.head,
            "tolerances": TOLERANCES,
        }

    def numbers(self, mechanism: Mechanism) -> Sequence[Array | np.ndarray]:
        """Return the numbers of the conditions, which may depend on the numbers of the mechanism."""
        return condition_numbers(expand_events(self._given, mechanism)) if self._given else ()

    def watched_by(self, operation: RunStates, rows: tuple[int, ...] = ()) -> RunStates:
        """Return the run that ends where a condition, or the force of a contact in one of the rows of Psi, crosses zero."""
        if self._conditions is None:
            return operation
        E, m = len(self._events), operation.code.row_count
        held = Switches(rows=(*rows, *[-1] * (E - len(rows))), joint_rows=((),) * E)
        return operation.watching(with_forces(self._conditions, self._events, held, m))

    def states_of(self, run: RunStates) -> EvaluateEvents:
        """Return the operation that evaluates conditions, their rates and slopes, and directions of impulses at states."""
        assert self._conditions is not None  # since there are events
        impacts = tuple(k for k, event in enumerate(self._events) if event.action.is_impact)
        return run.accelerations.of_events(self._conditions, impacts)
