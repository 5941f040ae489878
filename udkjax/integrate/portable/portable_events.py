"""Events of a portable engine: what a page knows of them, and the program by which it looks at their conditions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array

from udkjax.equations.analysis import Analysis
from udkjax.integrate.events.actions import Log, Stop
from udkjax.integrate.events.condition_program import condition_numbers, watched_conditions
from udkjax.integrate.events.crossings import ZERO
from udkjax.integrate.events.event import ExpandsToEvents, expand_events
from udkjax.native.conditions import HEAD
from udkjax.native.ir import Function
from udkjax.native.operations import RunStates
from udkjax.native.program import UnsupportedError, consecutive, write
from udkjax.scene.checks import quote
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.requirements import ArgumentError

MOST_EVENTS = 1000  # of a run in a page: beyond, nobody would look at them


class PortableEvents:
    """The events of the runs of a portable engine; there may be none.

    Raises:
        ArgumentError: an event changes the motion.
        UnsupportedError: a condition takes what machine code has no instruction for.
    """

    def __init__(self, events: Sequence[ExpandsToEvents], mechanism: Mechanism):
        self._given = tuple(events)
        self._events = expand_events(events, mechanism) if events else ()
        for event in self._events:
            if not isinstance(event.action, Log | Stop):
                kind, cure = type(event.action).__name__, "a page knows Log and Stop alone; leave out live"
                raise ArgumentError(f"live: the jump of event {quote(event.name)} ({kind}) is no program yet: {cure}")
        self._conditions = watched_conditions(self._events, mechanism) if events else None
        if self._conditions is None and events:
            raise UnsupportedError("the condition of an event")

    def data(self, analysis: Analysis) -> dict[str, Any] | None:
        """Return what a page knows of the events; None where there are none."""
        if not self._events:
            return None
        return {
            "names": [event.name for event in self._events],
            "directions": [event.direction for event in self._events],
            "stops": [isinstance(event.action, Stop) for event in self._events],
            "slowest": float(analysis.scales.rate),
            "zero": ZERO,
            "most": MOST_EVENTS,
            "head": HEAD,
        }

    def numbers(self, mechanism: Mechanism) -> Sequence[Array | np.ndarray]:
        """Return the numbers of the conditions, some of which follow from those of the mechanism."""
        return condition_numbers(expand_events(self._given, mechanism)) if self._given else ()

    def watched_by(self, operation: RunStates) -> RunStates:
        """Return the run that ends where a condition crosses zero."""
        return operation if self._conditions is None else operation.watching(self._conditions)

    def functions(self) -> list[Function]:
        """Return `conditions(in, out)`: of t, q, v and their numbers each condition, and its derivatives by t, q and v."""
        if self._conditions is None:
            return []
        program = self._conditions.slopes
        places = consecutive("in", len(program.inputs)), consecutive("out", len(program.outputs))
        return [write(program, "conditions", 1, ("in", "out"), *places)]
