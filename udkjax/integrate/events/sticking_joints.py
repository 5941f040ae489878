"""Joints with set-valued friction: they slide one way or the other, or they stick, as a constraint.

A friction with the set-valued law becomes a `DirectedFriction`: the direction of sliding is a number, with which its loads are
smooth. A sticking joint is locked by a constraint, whose multiplier is its force. Each direction of sliding has an event: its
speed falls to zero while the joint slides in that direction; its force reaches the limit while the joint sticks.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import make_module, number
from udkjax.complementarity.stick_or_slip import SIDES
from udkjax.equations.directed_friction import with_directed_friction
from udkjax.integrate.events.actions import Action, Displacement
from udkjax.integrate.events.conditions import BodyCondition, Frames
from udkjax.integrate.events.event import Event
from udkjax.scene.friction import Friction
from udkjax.scene.joints import Angle, Joint, Revolute
from udkjax.scene.mechanism import Mechanism


class SlidingSpeed(BodyCondition):
    """Condition of sliding in the direction `sign`: the speed, or while the joint sticks, the limit minus its force."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    joint: Joint
    friction: Friction
    sign: Float[Array, ""]

    def of_bodies(self, names):
        return make_module(SlidingSpeed, **vars(self) | {"bodies": names})

    def __call__(self, t: Number, frames: Frames) -> Number:
        return self.sign * Friction.sliding_speed(self.joint, *(frames[name] for name in self.bodies))

    def reserve(self, multipliers: Sequence[Number], lock: Number) -> Number:
        """Return the largest force minus the force in the direction `sign`: negative where the joint must slide.

        Args:
            multipliers: The multipliers of the joint.
            lock: The multiplier of the constraint by which it sticks.
        """
        return self.friction.largest_force(self.joint, multipliers) - self.sign * lock


class StickOrSlip(Action):
    """A joint with set-valued friction begins to slide, stops sliding or reverses; the run decides which."""


class StickingJoint(NamedTuple):
    """A joint with set-valued friction; hashable."""

    name: str  # of the joint
    force: int  # index of the friction among the forces
    event: int  # index of the event of sliding in the positive direction; that of the other direction follows
    first: int  # index of its first side

    @property
    def events(self) -> tuple[int, int]:
        return self.event, self.event + 1

    @property
    def sides(self) -> slice:
        return slice(self.first, self.first + SIDES)


class Sticking(NamedTuple):
    """A mechanism with directed frictions."""

    mechanism: Any
    joints: tuple[StickingJoint, ...]
    events: tuple[Event, ...]  # two for each joint


def with_sticking_joints(mechanism: Any, first_event: int) -> Sticking:
    """Return a mechanism with directed frictions, and their events.

    Args:
        mechanism: The scene.
        first_event: The number of other events, which come first.
    """
    if not isinstance(mechanism, Mechanism) or not Friction.may_stick(mechanism._forces):
        return Sticking(mechanism, (), ())
    directed, joints, events = with_directed_friction(mechanism), [], []
    for name, k in directed.joints:
        joint, friction = mechanism.joints[name], cast(Friction, mechanism._forces[k])
        joints.append(StickingJoint(name, k, first_event + len(events), SIDES * len(joints)))
        for sign, text in ((1.0, "forwards"), (-1.0, "backwards")):
            condition = SlidingSpeed(joint.bodies, joint, friction, number(sign))
            events.append(Event(condition, StickOrSlip(), -1, f"{name} slides {text}"))
    return Sticking(directed.mechanism, tuple(joints), tuple(events))


def lock_of(joint: Any) -> Joint:
    """Return the constraint by which a joint sticks, without its position."""
    return Angle(joint.bodies) if isinstance(joint, Revolute) else Displacement(joint.bodies, joint.points, joint.axis)


def forces_of(
    events: Sequence[Event], rows: Sequence[int], joint_rows: Sequence[tuple[int, ...]], multipliers: Float[Array, "m"]
) -> dict[int, Number]:
    """Return, by the index of its event, the force of each contact at rest, and the reserve of each sticking joint.

    Args:
        events: All events.
        rows: The row of Psi that holds the contact or the joint of an event; -1: none.
        joint_rows: The rows of the joint that may stick.
        multipliers: The multipliers of all rows; of a mechanism without the rows that hold, no contact rests and no joint sticks.
    """
    found: dict[int, Number] = {}
    for k, row in enumerate(rows):
        if row < 0:
            continue
        condition: Any = events[k].condition
        of_joint, is_held = [multipliers[r] for r in joint_rows[k]], row < len(multipliers)
        if of_joint:
            found[k] = condition.reserve(of_joint, multipliers[row] if is_held else 0.0)
        else:
            found[k] = -multipliers[row] if is_held else jnp.ones(())
    return found
