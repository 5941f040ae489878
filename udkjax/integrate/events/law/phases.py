"""Phases: the sets of constraints that hold one after another, as events release or add some and contacts come to rest.

A phase is a mask of the *switches*: the constraints that events release or add, and the contacts that are held at rest. A run
begins with the mechanism of the scene. All other phases share one mechanism with all switches. Its numbers switch the constraints
on and off (equations/terms/switches.py), so no phase needs its own equations or code.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool

from udkjax.annotations import Number
from udkjax.arrays import number
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.terms import switches as switching
from udkjax.integrate.events.law.conditions import BodyCondition, Frames, frames_of
from udkjax.integrate.events.law.event import Event
from udkjax.integrate.events.law.kinks import HeldElement, has_sides, sides_in
from udkjax.integrate.events.law.sticking_joints import StickingJoint, friction_of, line_of, lock_of, with_sticking_joints
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME_AT_REST
from udkjax.scene.elements.joints import Constraint, Joint
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote, suggestion

Added = tuple[Any, ...]  # the joints that events add, with their current numbers, and the sides of comparisons
SCENE, SWITCHED = 0, 1  # the mechanisms of a run


class Switches(NamedTuple):
    """The C switches, their changes at the E events, and the m rows of Psi with all switches; hashable."""

    names: tuple[str, ...] = ()  # their constraints in the mechanism with all switches
    first: tuple[bool, ...] = ()  # the phase in which a run begins: constraints of the scene are on, all others are off
    removed: tuple[tuple[bool, ...], ...] = ()  # (E, C)
    added: tuple[tuple[bool, ...], ...] = ()  # (E, C)
    contacts: tuple[int, ...] = ()  # (E,): the switch that holds the contact, or the joint that may stick, of an event; -1: none
    rows: tuple[int, ...] = ()  # (E,): the row of Psi of that switch; -1: none
    joint_rows: tuple[tuple[int, ...], ...] = ()  # (E,): the rows of the joint that this switch locks; empty: it locks none
    switch_of_row: tuple[int, ...] = ()  # (m,): the switch of each row of Psi; -1: a row of the scene that no event changes
    redundant: tuple[bool, ...] = ()  # (m,): rows of the scene that depend on others while all constraints of the scene hold

    def on(self, phase: Bool[Any, "*m C"]) -> Bool[Any, "*m m"]:
        """Return a mask of the rows of Psi that hold in a phase."""
        switch = np.array(self.switch_of_row, int)
        return (switch < 0) | phase[..., np.maximum(switch, 0)]

    def independent(self, phase: Bool[Any, "*m C"], xp: ModuleType) -> Bool[Any, "*m m"]:
        """Return a mask of the rows of Psi that may be independent in a phase."""
        is_whole = xp.all(phase | ~np.array(self.first, bool), axis=-1, keepdims=True)
        return self.on(phase) & ~(np.array(self.redundant, bool) & is_whole)


class Phases(eqx.Module):
    """The mechanism of the scene, and the mechanism with all switches if there are any; their analyses, and the switches."""

    mechanisms: tuple[Any, ...]  # mechanisms, or one traced system
    analyses: tuple[Analysis | None, ...]
    added: tuple[Joint, ...]  # joints of `Attach` and `Lock`, and of sticking, without the numbers that depend on the state
    added_by: tuple[tuple[int, str], ...] = eqx.field(static=True)  # for each added joint its event and its switch
    switches: Switches = eqx.field(static=True)
    held: tuple[HeldElement, ...] = eqx.field(static=True, default=())  # the forces with held sides
    sticking: tuple[StickingJoint, ...] = eqx.field(static=True, default=())  # the joints that may stick

    @property
    def sided(self) -> tuple[StickingJoint | HeldElement, ...]:
        """All joints that may stick and forces with held sides, in the order of their sides."""
        return (*self.sticking, *self.held)

    def mechanism(self, which: int, phase: Bool[Array, "C"], added: Added) -> Any:
        """Return the mechanism of a phase, with the joints that events have added and the sides of its comparisons.

        Args:
            which: SCENE (only for the phase in which a run begins) or SWITCHED.
            phase: the phase, a mask of switches.
            added: the joints that events have added, then all sides.
        """
        mechanism, (*joints, sides) = self.mechanisms[which], added
        for sided in self.sided:
            if has_sides(mechanism, sided.force):
                at = partial(sides_in, force=sided.force)
                mechanism = eqx.tree_at(at, mechanism, sides[sided.sides])
        if which == SCENE:
            return mechanism
        for (_, name), joint in zip(self.added_by, joints, strict=True):
            index = mechanism.joint_names.index(name)
            mechanism = eqx.tree_at(lambda m, index=index: m._joints[index], mechanism, switching.switched(joint))
        return switching.switch(mechanism, self.switches.names, list(jnp.asarray(phase, float)))

    def first_added(self) -> tuple[Joint, ...]:
        """Return the joints that events add, as they would be at the initial guess."""
        return tuple(self.joint_at(k, self.mechanisms[SCENE].q0.ravel()) for k in range(len(self.added)))

    def with_kinks(self, model: Any, held: tuple[HeldElement, ...], count: int) -> "Phases":
        """Return the phases with the held loads of a model, and with `count` further events, those at kinks."""
        switches, none = self.switches, (False,) * len(self.switches.names)
        more = {name: (*getattr(switches, name), *[none] * count) for name in ("removed", "added")}
        more |= {name: (*getattr(switches, name), *[-1] * count) for name in ("contacts", "rows")}
        more |= {"joint_rows": (*switches.joint_rows, *[()] * count)}
        found = replace(self, held=held, switches=switches._replace(**more))
        if not model.has_bodies:
            return replace(found, mechanisms=(model,))
        places = [x.force for x in held if x.force is not None]
        forces = [model._forces[k] for _ in self.mechanisms for k in places]
        return eqx.tree_at(lambda p: [m._forces[k] for m in p.mechanisms for k in places], found, forces)

    def joint_at(self, k: int, q: Array) -> Joint:
        """Return the k-th joint that events add, with the numbers that it takes from the state when it is added at q."""
        joint, frames = self.added[k], frames_of(self.mechanisms[SCENE].body_names, q)
        return jax.tree.map(number, joint.complete(*(frames[name] for name in joint.frame_names)))


class _Switch(NamedTuple):
    """A constraint that is switched on or off during a run."""

    name: str  # in the mechanism with all switches
    public: str  # the name by which events release it; "" for contacts
    constraint: Constraint
    event: int  # the event that adds it, or whose contact or joint it holds; -1: it is a constraint of the scene
    locks: str = ""  # the joint that it locks


def phases_of(
    mechanism: Any, events: Sequence[Event], analysis: Analysis | None, sticking: tuple[StickingJoint, ...] = ()
) -> Phases:
    """Return the phases of a mechanism or a system with these events; a system has one phase alone."""
    E = len(events)
    switches = _switches(mechanism, events, sticking) if mechanism.has_bodies else []
    if not switches:
        none = Switches(removed=((),) * E, added=((),) * E, contacts=(-1,) * E, rows=(-1,) * E, joint_rows=((),) * E)
        return Phases((mechanism.without_origin,), (analysis,), (), (), none)
    assert analysis is not None  # a mechanism has one
    whole = _with(mechanism, switches, events)
    # A joint that an event adds may depend on others.
    adds_any = any(x.public and x.event >= 0 for x in switches)
    with_all = analysis.with_rows_of(whole, only_switched=analysis.redundant_rows == () and not adds_any)
    row_names, names = [name for name, _ in with_all.row_names], [x.name for x in switches]
    contacts = {x.event: k for k, x in enumerate(switches) if not x.public}
    locks = [(event, k) for k, x in enumerate(switches) if x.locks for event in (x.event, x.event + 1)]
    contacts, locked = contacts | dict(locks), {event: switches[k].locks for event, k in locks}
    table = Switches(
        names=tuple(names),
        first=tuple(x.event < 0 for x in switches),
        removed=tuple(tuple(x.public != "" and x.public in _names_removed(mechanism, e) for x in switches) for e in events),
        added=tuple(tuple(x.public != "" and x.event == k for x in switches) for k in range(E)),
        contacts=tuple(contacts.get(k, -1) for k in range(E)),
        rows=tuple(row_names.index(names[contacts[k]]) if k in contacts else -1 for k in range(E)),
        joint_rows=tuple(tuple(r for r, name in enumerate(row_names) if name == locked.get(k)) for k in range(E)),
        switch_of_row=tuple(names.index(name) if name in names else -1 for name in row_names),
        redundant=tuple(row in analysis.redundant for row in with_all.row_names),
    )
    added = [x for x in switches if (x.public and x.event >= 0) or x.locks]
    mechanisms = mechanism.without_origin, whole
    joints: Any = tuple(x.constraint for x in added)
    added_by = tuple((x.event, x.name) for x in added)
    return Phases(mechanisms, (analysis, with_all), joints, added_by, table, sticking=sticking)


def events_and_phases(
    mechanism: Any, events: Sequence[Event], analysis: Analysis | None
) -> tuple[Any, tuple[Event, ...], Phases]:
    """Return a mechanism with directed frictions, all events including those of joints that may stick, and the phases.

    Args:
        mechanism: The scene, or a system.
        events: The events of the user, expanded.
        analysis: The analysis of the scene; None for a system.
    """
    sticking = with_sticking_joints(mechanism, events)
    found = (*events, *sticking.events)
    return sticking.mechanism, found, phases_of(sticking.mechanism, found, analysis, sticking.joints)


def _names_removed(mechanism: Mechanism, event: Event) -> frozenset[str]:
    """Return the names of the constraints that an event removes; a joint that it adds replaces another one of the same name."""
    addition = event.action.addition(mechanism, f"event {quote(event.name)}")
    return event.action.removed | ({addition[0]} if addition else frozenset())


def _switches(mechanism: Mechanism, events: Sequence[Event], sticking: Sequence[StickingJoint]) -> list[_Switch]:
    """Return the switches: of constraints of the scene, joints that events add, contacts, and locks of joints that stick.

    Raise `ValueError` for unknown names.
    """
    additions = [(k, e.action.addition(mechanism, f"event {quote(e.name)}")) for k, e in enumerate(events)]
    added = [(k, *found) for k, found in additions if found is not None]
    known, released = [*mechanism.constraints, *(name for _, name, _ in added)], set()
    for event in events:
        for name in sorted(event.action.removed.difference(known)):
            raise ValueError(f"event {quote(event.name)}: no joint or driver named {quote(name)}{suggestion(name, known)}")
        released |= event.action.removed
    for k, name, _ in added:
        if name in mechanism.constraints and name not in released:
            cure = "attach the joint under another name, or release this one before"
            raise ValueError(f"event {quote(events[k].name)}: {quote(name)} is in the scene already; {cure}")
    found = [_Switch(name, name, x, -1) for name, x in mechanism.constraints.items() if name in released]
    taken = set(mechanism.constraints)

    def unique(name: str) -> str:
        name = next(x for x in (name, *(f"{name} {k}" for k in range(2, len(events) + 3))) if x not in taken)
        taken.add(name)
        return name

    found += [_Switch(unique(name), name, joint, k) for k, name, joint in added]
    contacts = [(k, e) for k, e in enumerate(events) if e.action.rest == "hold"]
    rubbing = {x.contact: line_of(events[x.contact]) for x in sticking if x.contact >= 0}
    lines = {k: _Switch(unique(f"{e.name}.contact"), "", rubbing.get(k) or HeldContact.of(e, mechanism), k) for k, e in contacts}
    found += lines.values()
    joints = {
        x: (lines[x.contact].name, rubbing[x.contact]) if x.contact >= 0 else (x.name, mechanism.joints[x.name]) for x in sticking
    }
    return found + [_Switch(unique(f"{x.name}.stick"), "", lock_of(j), x.event, name) for x, (name, j) in joints.items()]


def _with(mechanism: Mechanism, switches: Sequence[_Switch], events: Sequence[Event]) -> Mechanism:
    """Return the mechanism with all switches, switched on, and the friction of contacts."""
    rubbing = [x for x in switches if not x.public and not x.locks and events[x.event].action.friction is not None]
    return switching.with_switches(
        mechanism,
        [x.name for x in switches if x.event < 0],
        {x.name: x.constraint for x in switches if x.event >= 0},  # pyright: ignore[reportArgumentType]
        {x.name: friction_of(events[x.event], x.name) for x in rubbing},
    )


class HeldContact(Joint):
    """A contact at rest: its condition stays zero. 1 row, in the condition's unit."""

    labels: tuple[str, ...] = eqx.field(static=True)  # the names by which the condition knows the bodies
    condition: Callable[[Number, Frames], ArrayLike]

    @classmethod
    def of(cls, event: Event, mechanism: Mechanism) -> "HeldContact":
        """Return the contact of an event; its bodies are those in the attribute `bodies` of the condition, else all."""
        condition, bodies = event.condition, getattr(event.condition, "bodies", mechanism.body_names)
        if not isinstance(condition, BodyCondition):
            return cls(bodies=bodies, labels=tuple(bodies), condition=condition)
        # Contacts that differ in their bodies alone share their programs.
        labels = tuple(str(k) for k in range(len(bodies)))
        return cls(bodies=bodies, labels=labels, condition=condition.of_bodies(labels))

    def residual(self, t, *frames):
        return [self.condition(t, {GROUND: GROUND_FRAME_AT_REST, **dict(zip(self.labels, frames, strict=True))})]
