"""The static part of runs with events: the phases to which events lead, and masks of kinds of events."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.complementarity.stick_or_slip import SIDES
from udkjax.integrate.events.law.actions import Action
from udkjax.integrate.events.law.conditions import sees_velocity
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.kinks import MOST_KINKS
from udkjax.integrate.events.law.phases import SCENE, Phases, Switches
from udkjax.integrate.events.law.sticking_joints import StickingJoint


@dataclass(frozen=True)
class EventPlan:
    """The part of a run's events and phases that does not depend on numbers; runs with equal plans share their code."""

    switches: Switches
    directions: tuple[int, ...]  # of each event
    by_velocity: tuple[bool, ...]  # whether the condition of each event depends on velocities
    actions: tuple[type[Action], ...]
    at_rest: tuple[str, ...]  # `Action.rest` of each event
    max_steps: int
    max_events: int  # without kinks
    turns: tuple[tuple[int, float, float] | None, ...]  # `Action.turn` of each event
    side_count: int  # the number S of sides
    added_by: tuple[int, ...]  # for each joint that events add, its event; the last ones are the locks of joints that stick
    sticking: tuple[StickingJoint, ...]  # the joints that may stick, F
    has_bodies: bool = True  # whether coordinates are those of bodies, with masses of their own

    @cached_property
    def kinks(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events at kinks, which change the side of a comparison."""
        return np.array([x is not None for x in self.turns], bool)

    @cached_property
    def side_of(self) -> Int[np.ndarray, "E"]:
        """Index of the side that an event changes; 0 for events that change none."""
        return np.array([0 if x is None else x[0] for x in self.turns], int)

    @cached_property
    def side_changes(self) -> Float[np.ndarray, "2 2E S"]:
        """The factors and the shifts of all sides at each event, then where its contact opens (factor 1, shift 0)."""
        changes = np.stack([np.ones((2 * self.count, self.side_count)), np.zeros((2 * self.count, self.side_count))])
        for k, turn in enumerate(self.turns):
            if turn is not None:
                changes[:, k, turn[0]] = turn[1:]
        return changes

    @property
    def first_kink_side(self) -> int:
        """The index of the first side of a kink; the sides before belong to joints that may stick."""
        return SIDES * len(self.sticking)

    @property
    def has_kinks(self) -> bool:
        """True if some sides are those of kinks, not of joints that stick."""
        return self.side_count > self.first_kink_side

    @property
    def room(self) -> int:
        """The largest number of recorded events: `max_events`, plus `MOST_KINKS` if forces have kinks."""
        return self.max_events + (MOST_KINKS if self.has_kinks else 0)

    @property
    def count(self) -> int:
        """The number E of events."""
        return len(self.directions)

    @cached_property
    def both_directions(self) -> Int[np.ndarray, "2E"]:
        """The directions in which zeros are events: of all conditions, then of all forces (-1, where they fall below zero)."""
        return np.array([*self.directions, *[-1] * self.count])

    @cached_property
    def follows_velocity(self) -> Bool[np.ndarray, "E"]:
        """Mask of the conditions that depend on velocities."""
        return np.array(self.by_velocity, bool)

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
        """Mask of the events whose contacts are held where they come to rest."""
        return np.array([x == "hold" for x in self.at_rest])

    @cached_property
    def stops_at_rest(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events that end the run where their contacts come to rest."""
        return np.array([x == "stop" for x in self.at_rest])

    # Phases are masks of the switches (*m, C).

    @cached_property
    def first(self) -> Bool[np.ndarray, "C"]:
        """The phase in which runs begin."""
        return np.array(self.switches.first, bool)

    @cached_property
    def _changes(self) -> Bool[np.ndarray, "2 E C"]:
        """Masks of the switches that each event turns off, and of those that it turns on."""
        return np.array([self.switches.removed, self.switches.added], bool).reshape(2, self.count, len(self.first))

    @cached_property
    def _contacts(self) -> Bool[np.ndarray, "E C"]:
        """Mask of the switch that holds the contact, or locks the joint, of each event; no switch for other events."""
        return np.array(self.switches.contacts, int)[:, None] == np.arange(len(self.first))

    @cached_property
    def _switches_of_contacts(self) -> Bool[np.ndarray, "C"]:
        return self._contacts.any(axis=0)

    @cached_property
    def has_only_contacts(self) -> bool:
        """True if all switches belong to contacts and to joints that stick."""
        return bool(self._switches_of_contacts.all())

    # Joints that may stick, F.

    @cached_property
    def slides(self) -> Bool[np.ndarray, "E"]:
        """Mask of the events of sliding, two for each joint that may stick."""
        return np.isin(np.arange(self.count), [x.events for x in self.sticking])

    @cached_property
    def forwards(self) -> Int[np.ndarray, "F"]:
        """Index of the event of sliding in the positive direction of each joint; that of the negative direction is the next."""
        return np.array([x.event for x in self.sticking], int)

    @cached_property
    def directions_of_sliding(self) -> Int[np.ndarray, "F"]:
        """Index of the side that is the direction of sliding of each joint; the next side tells whether the joint is at rest."""
        return np.array([x.first for x in self.sticking], int)

    @cached_property
    def contacts_that_rub(self) -> Int[np.ndarray, "F"]:
        """Index of the event of the contact in which each joint rubs; -1: the joint is not in a contact."""
        return np.array([x.contact for x in self.sticking], int)

    @cached_property
    def tangents(self) -> Int[np.ndarray, "E"]:
        """Index of the event of sliding in the positive direction, for each event that is a contact with friction; else -1."""
        found = np.full(self.count, -1)
        for x in self.sticking:
            if x.contact >= 0:
                found[x.contact] = x.event
        return found

    @cached_property
    def has_rubbing_contacts(self) -> bool:
        """True if there is a contact with friction."""
        return bool(np.any(self.contacts_that_rub >= 0))

    @cached_property
    def has_sticking_joints(self) -> bool:
        """True if a joint of the scene may stick."""
        return bool(np.any(self.contacts_that_rub < 0))

    @cached_property
    def locks(self) -> Int[np.ndarray, "F"]:
        """Index of the switch by which each joint sticks."""
        return np.array(self.switches.contacts, int)[self.forwards]

    @cached_property
    def _switches_of_locks(self) -> Bool[np.ndarray, "C"]:
        return np.isin(np.arange(len(self.first)), self.locks)

    def locked(self, phase: Bool[Any, "*m C"]) -> Bool[Any, "*m F"]:
        """Return a mask of the joints that stick in a phase."""
        return phase[..., self.locks]

    def with_locks(self, phase: Bool[Any, "*m C"], locked: Bool[Any, "*m F"], xp: ModuleType) -> Bool[Any, "*m C"]:
        """Return the phase with exactly the masked joints stuck."""
        return (phase & ~self._switches_of_locks) | xp.any(locked[..., None] & self._pairs_of_locks, axis=-2)

    @cached_property
    def _pairs_of_locks(self) -> Bool[np.ndarray, "F C"]:
        """A mask: True where switch c is the lock of joint f."""
        return self.locks[:, None] == np.arange(len(self.first))

    def not_sliding(self, sides: Float[Any, "*m S"], xp: ModuleType) -> Bool[Any, "*m E"]:
        """Return a mask of the events of sliding whose joint neither slides in their direction nor waits for drivers.

        The conditions of these events are not watched.
        """
        direction, at_rest = (sides[..., self.directions_of_sliding + k] for k in range(2))
        either = [((direction * sign < 0.5) | (at_rest > 0.5)) & (at_rest < 1.5) for sign in (1, -1)]
        position, is_backwards = self._joints_of_slides
        return self.slides & xp.where(is_backwards, either[1][..., position], either[0][..., position])

    @cached_property
    def _joints_of_slides(self) -> tuple[Int[np.ndarray, "E"], Bool[np.ndarray, "E"]]:
        """Index of the joint of each event of sliding, and a mask of the negative direction; 0 and False for other events."""
        position, own = np.zeros((2, self.count), int)
        position[self.forwards], position[self.forwards + 1] = np.arange(len(self.forwards)), np.arange(len(self.forwards))
        own[self.forwards + 1] = 1
        return position, own == 1

    def is_first(self, phase: Bool[Any, "*m C"]) -> Bool[Any, "*m"]:
        """Return a mask of the members whose phase is that in which runs begin."""
        return (phase == self.first).all(axis=-1)

    def held(self, phase: Bool[Any, "*m C"], xp: ModuleType) -> Bool[Any, "*m E"]:
        """Return a mask of the events whose contact rests, or whose joint sticks, in a phase."""
        if xp is np and not phase[..., self._switches_of_contacts].any():  # the usual case
            return np.zeros((*phase.shape[:-1], self.count), bool)
        return xp.any(phase[..., None, :] & self._contacts, axis=-1)

    def after(self, phase: Bool[Any, "*m C"], k: Int[Any, "*m"], xp: ModuleType) -> Bool[Any, "*m C"]:
        """Return the phase that follows event k."""
        off, on = xp.asarray(self._changes)[:, k]
        return (phase & ~off) | on

    def free(self, phase: Bool[Any, "*m C"]) -> Bool[Any, "*m C"]:
        """Return the phase with all contacts at rest opened, and all sticking joints released."""
        return phase & ~self._switches_of_contacts

    def without_contacts(self, phase: Bool[Any, "*m C"]) -> Bool[Any, "*m C"]:
        """Return the phase with all contacts at rest opened."""
        of_joints = np.isin(np.arange(len(self.first)), self.locks[self.contacts_that_rub < 0])
        return phase & ~(self._switches_of_contacts & ~of_joints)

    def with_contacts(self, phase: Bool[Any, "*m C"], held: Bool[Any, "*m E"], xp: ModuleType) -> Bool[Any, "*m C"]:
        """Return the phase in which, in addition, the contacts or joints of the masked events are held."""
        return phase | xp.any(held[..., None] & self._contacts, axis=-2)

    def watched(self, phase: Bool[Any, "*m C"], carried: Bool[Any, "*m E"], xp: ModuleType) -> Bool[Any, "*m 2E"]:
        """Return a mask of the watched conditions, then of the watched forces.

        A condition is watched unless it is held or `carried`; a force is watched while it holds.
        """
        held = self.held(phase, xp)
        return xp.concatenate([~held & ~carried, held], axis=-1)


def event_plan(
    phases: Phases, events: Sequence[Event], max_steps: int, max_events: int, by_velocity: tuple[bool, ...] | None = None
) -> EventPlan:
    """Return the plan of runs with these phases and events.

    Args:
        phases: the phases.
        events: all events.
        max_steps: the largest number of steps that are tried.
        max_events: the largest number of events.
        by_velocity: mask of the conditions that depend on velocities; None: a trial of each condition shows this.
    """
    if by_velocity is None:
        by_velocity = tuple(sees_velocity(e.condition, phases.mechanisms[SCENE]) for e in events)
    return EventPlan(
        switches=phases.switches,
        directions=tuple(e.direction for e in events),
        by_velocity=by_velocity,
        actions=tuple(type(e.action) for e in events),
        at_rest=tuple(e.action.rest for e in events),
        max_steps=max_steps,
        max_events=max_events,
        turns=tuple(e.action.turn for e in events),
        side_count=max([x.sides.stop for x in phases.sided], default=0),
        added_by=tuple(event for event, _ in phases.added_by),
        sticking=phases.sticking,
        has_bodies=phases.mechanisms[SCENE].has_bodies,
    )
