"""Joints with set-valued friction: they slide one way or the other, or they stick, as a constraint.

A friction with the set-valued law becomes a `DirectedFriction`: the direction of sliding is a number, with which its loads are
smooth. A sticking joint is locked by a constraint, whose multiplier is its force. Each direction of sliding has an event: its
speed falls to zero while the joint slides in that direction; its force reaches the limit while the joint sticks.

A contact with friction is such a joint, too, while it rests: a slot, whose normal force is that of the contact.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import make_module, number
from udkjax.complementarity.stick_or_slip import SIDES
from udkjax.equations.friction.directed_friction import DirectedFriction
from udkjax.integrate.events.law.actions import Action, Displacement
from udkjax.integrate.events.law.conditions import BodyCondition, Frames
from udkjax.integrate.events.law.event import Event
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Angle, Joint, Revolute, Slot


class ContactFriction(DirectedFriction):
    """Friction of a contact, in the slot that holds it at rest: its load has a sign, and is negative where the contact pulls."""

    def edge_loads(self, joint, multipliers):
        return []

    def _load_of(self, joint, multipliers):
        return -multipliers[0]


class SlidingSpeed(BodyCondition):
    """The condition of sliding in the direction `sign`: the speed; while the joint sticks, `reserve` takes its place."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    joint: Joint
    friction: Friction
    sign: Float[Array, ""]

    by_velocity = True

    def of_bodies(self, names):
        return make_module(SlidingSpeed, **vars(self) | {"bodies": names})

    def __call__(self, t: Number, frames: Frames) -> Number:
        return self.sign * Friction.sliding_speed(self.joint, *(frames[name] for name in self.bodies))

    def reserve(self, multipliers: Sequence[Number], lock: Number) -> Number:
        """Return the largest force minus the force in the direction `sign`: negative where the joint must slide.

        Args:
            multipliers: The multipliers of the joint.
            lock: The multiplier of the constraint by which the joint sticks.
        """
        return self.friction.largest_force(self.joint, multipliers) - self.sign * lock


class StickOrSlip(Action):
    """The action by which a joint with set-valued friction begins to slide, stops or reverses; the run decides which of these."""


class StickingJoint(NamedTuple):
    """The static description of a joint with set-valued friction, or of a contact with friction; hashable."""

    name: str  # of the joint, or of the contact
    force: int  # index of the friction among the forces; those of contacts come last, beyond the forces of the scene
    event: int  # index of the event of sliding in the positive direction; that of the other direction follows
    first: int  # index of its first side among all sides
    contact: int = -1  # index of the event of the contact; -1: it is a joint of the scene

    @property
    def events(self) -> tuple[int, int]:
        return self.event, self.event + 1

    @property
    def sides(self) -> slice:
        return slice(self.first, self.first + SIDES)


class Sticking(NamedTuple):
    """A mechanism with directed friction, its joints that may stick, and the events of these joints."""

    mechanism: Any
    joints: tuple[StickingJoint, ...]
    events: tuple[Event, ...]  # two for each joint


def with_sticking_joints(mechanism: Any, others: Sequence[Event]) -> Sticking:
    """Return a mechanism with directed frictions, its joints that may stick, and their events.

    Args:
        mechanism: The scene.
        others: All other events, which come first, contacts with friction among them.
    """
    contacts = [k for k, e in enumerate(others) if e.action.friction is not None]
    if not contacts and not Friction.may_stick(mechanism.forces.values()):
        return Sticking(mechanism, (), ())
    directed, joints, events = DirectedFriction.put_in(mechanism), [], []

    def add(name: str, joint: Joint, friction: Friction, force: int, contact: int = -1) -> None:
        joints.append(StickingJoint(name, force, len(others) + len(events), SIDES * len(joints), contact))
        for sign, text in ((1.0, "forwards"), (-1.0, "backwards")):
            condition = SlidingSpeed(joint.bodies, joint, friction, number(sign))
            events.append(Event(condition, StickOrSlip(), -1, f"{name} slides {text}"))

    for name, k in directed.joints:
        add(name, mechanism.joints[name], cast(Friction, mechanism._forces[k]), k)
    for k, contact in enumerate(contacts, start=len(mechanism._forces)):
        name = others[contact].name
        name = f"{name} (contact)" if name in mechanism.joints else name
        add(name, line_of(others[contact]), friction_of(others[contact], name), k, contact)
    return Sticking(directed.mechanism, tuple(joints), tuple(events))


def line_of(contact: Event) -> Slot:
    """Return the joint that holds a contact at rest: a slot along its line, whose coordinate is the gap."""
    gap: Any = contact.condition
    body, on = gap.bodies
    axis = jnp.arctan2(-gap.normal[0], gap.normal[1])  # the normal is to its left
    return make_module(Slot, bodies=(on, body), points=jnp.stack([gap.through, gap.point]), axis=axis)


def friction_of(contact: Event, joint: str) -> ContactFriction:
    """Return the friction of a contact, in the joint that holds it."""
    action: Any = contact.action
    return ContactFriction(
        joint=joint, coefficient=action.coefficient, static_coefficient=action.static_coefficient, law="set-valued"
    )


def lock_of(joint: Any) -> Joint:
    """Return the constraint by which a joint sticks, without the position at which it does."""
    return Angle(joint.bodies) if isinstance(joint, Revolute) else Displacement(joint.bodies, joint.points, joint.axis)


def forces_of(
    events: Sequence[Event], rows: Sequence[int], joint_rows: Sequence[tuple[int, ...]], multipliers: Sequence[Number]
) -> dict[int, Number]:
    """Return, by the index of its event, the force of each contact at rest, and the reserve of each sticking joint.

    Args:
        events: All events.
        rows: The row of Psi that holds the contact or the joint of an event; -1: none.
        joint_rows: For each event of sliding, the rows of its joint; else empty.
        multipliers: The multipliers of all rows of a mechanism. That of the scene lacks the rows by which contacts and joints are
            held: the force of a contact is then 1, and a joint does not stick.
    """
    found: dict[int, Number] = {}
    for k, row in enumerate(rows):
        if row < 0:
            continue
        condition: Any = events[k].condition
        is_held = row < len(multipliers)
        if joint_rows[k] and max(joint_rows[k]) < len(multipliers):
            found[k] = condition.reserve([multipliers[r] for r in joint_rows[k]], multipliers[row] if is_held else 0.0)
        else:
            found[k] = -multipliers[row] if is_held else jnp.ones(())
    return found
