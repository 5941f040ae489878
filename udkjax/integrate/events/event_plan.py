"""The part of runs with events that does not depend on numbers: tables of the phases, and kinds of the events."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.events.actions import Action
from udkjax.integrate.events.conditions import sees_velocity
from udkjax.integrate.events.event import Event
from udkjax.integrate.events.kinks import MOST_KINKS
from udkjax.integrate.events.phases import Phases, Tables


@dataclass(frozen=True)
class EventPlan:
    """The part of a run's events and phases that does not depend on numbers; runs with equal plans share their code."""

    tables: Tables
    directions: tuple[int, ...]  # for each event
    by_velocity: tuple[bool, ...]  # whether its condition depends on velocities
    actions: tuple[type[Action], ...]
    at_rest: tuple[str, ...]  # consequence of rest, for impacts
    max_steps: int
    max_events: int  # without kinks
    turns: tuple[tuple[int, float, float] | None, ...]  # the side that it turns, with factor and shift
    side_count: int  # the number S of sides

    @cached_property
    def kinks(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that turn a side."""
        return np.array([x is not None for x in self.turns], bool)

    @cached_property
    def side_of(self) -> Int[np.ndarray, "E"]:
        """The side that an event turns; 0 for those that turn none."""
        return np.array([0 if x is None else x[0] for x in self.turns], int)

    @cached_property
    def side_changes(self) -> Float[np.ndarray, "2 E S"]:
        """The factor and the shift of each side at an event."""
        changes = np.stack([np.ones((self.count, self.side_count)), np.zeros((self.count, self.side_count))])
        for k, turn in enumerate(self.turns):
            if turn is not None:
                changes[:, k, turn[0]] = turn[1:]
        return changes

    @property
    def room(self) -> int:
        """The largest number of events with all kinks."""
        return self.max_events + (MOST_KINKS if self.side_count else 0)

    @property
    def count(self) -> int:
        """The number E of events."""
        return len(self.directions)

    @cached_property
    def both_directions(self) -> Int[np.ndarray, "2E"]:
        """The directions in which zeros count: of conditions, then of contact forces, which fall below zero."""
        return np.array([*self.directions, *[-1] * self.count])

    @cached_property
    def impacts(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that are impacts."""
        return np.array([x.is_impact for x in self.actions])

    @cached_property
    def stops(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that end the run."""
        return np.array([x.stops for x in self.actions])

    @cached_property
    def changes(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that do more than record or stop."""
        return np.array([x.changes for x in self.actions])

    @cached_property
    def adds(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that add a joint."""
        return np.array([x.adds for x in self.actions])

    @cached_property
    def held_at_rest(self) -> Bool[np.ndarray, "E"]:
        """Mask of the impacts that are held where they come to rest."""
        return np.array([x == "hold" for x in self.at_rest])

    @cached_property
    def stops_at_rest(self) -> Bool[np.ndarray, "E"]:
        """Mask of the impacts that end the run where they come to rest."""
        return np.array([x == "stop" for x in self.at_rest])

    @cached_property
    def held(self) -> Bool[np.ndarray, "phases E"]:
        """Mask of the contacts at rest in each phase."""
        return np.array(self.tables.held) >= 0

    @cached_property
    def after(self) -> Int[np.ndarray, "phases E"]:
        """The phase that follows an event."""
        return np.array(self.tables.after)

    @cached_property
    def free(self) -> Int[np.ndarray, "phases"]:
        """The phase that follows when all contacts at rest open."""
        free = np.arange(len(self.tables.held))
        for k in np.flatnonzero(self.impacts):
            free = np.array(self.tables.freed)[free, k]
        return free

    def with_contacts(self, phase: Int[Any, "*m"], held: Bool[Any, "*m E"], xp: ModuleType) -> Int[Any, "*m"]:
        """Return the phase that follows when contacts come to rest."""
        resting = xp.asarray(np.array(self.tables.resting))
        for k in np.flatnonzero(self.held_at_rest):
            phase = xp.where(held[..., k], resting[phase, k], phase)
        return phase

    def watched(self, phase: Int[Any, "*m"], carried: Bool[Any, "*m E"], xp: ModuleType) -> Bool[Any, "*m 2E"]:
        """Return a mask of the conditions, and of the contact forces, that count."""
        held = xp.asarray(self.held)[phase]
        return xp.concatenate([~held & ~carried, held], axis=-1)


def event_plan(phases: Phases, events: Sequence[Event], max_steps: int, max_events: int) -> EventPlan:
    """Return the plan of a run.

    Args:
        phases: the phases.
        events: all events.
        max_steps: the largest number of steps that are tried.
        max_events: the largest number of events.
    """
    return EventPlan(
        tables=phases.tables,
        directions=tuple(e.direction for e in events),
        by_velocity=tuple(sees_velocity(e.condition, phases.mechanisms[0]) for e in events),
        actions=tuple(type(e.action) for e in events),
        at_rest=tuple(e.action.rest for e in events),
        max_steps=max_steps,
        max_events=max_events,
        turns=tuple(e.action.turn for e in events),
        side_count=sum(held.smooth.count for held in phases.held),
    )
