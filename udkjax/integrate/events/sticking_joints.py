"""Joints with set-valued friction: they slide one way or the other, or they stick, as a constraint.

A friction with the set-valued law becomes a `DirectedFriction`: the direction of sliding is a number, with which its loads are
smooth. A sticking joint is locked by a constraint, whose multiplier is its force. Each direction of sliding has an event: its
speed falls to zero while the joint slides in that direction; its force reaches the limit while the joint sticks.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import make_module, number
from udkjax.integrate.events.actions import Action, Displacement
from udkjax.integrate.events.conditions import BodyCondition, Frames
from udkjax.integrate.events.event import Event
from udkjax.scene.fields import given_number
from udkjax.scene.friction import Friction
from udkjax.scene.joints import Angle, Joint, Revolute
from udkjax.scene.mechanism import Mechanism

SIDES = 2  # numbers of a `DirectedFriction` among all sides


class DirectedFriction(Friction):
    """Set-valued friction of a joint that slides in a given direction, or sticks.

    Its `sides` are the direction of sliding, 1 or -1 (0: the friction has no force), and one if the joint is at rest although no
    constraint of its own locks it, so that the coefficient is the static one; two if it waits for its drivers.
    """

    sides: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))

    @property
    def may_have_kinks(self):
        return False

    def _direction(self, speed):
        return self.sides[0]

    def _coefficient_at(self, speed):
        assert self.coefficient is not None
        static = self.coefficient if self.static_coefficient is None else self.static_coefficient
        total = self.sides[0] * jnp.where(self.sides[1] > 0.5, static, self.coefficient)
        return total if self.viscous is None else total + self.viscous * speed


class SlidingSpeed(BodyCondition):
    """The condition of sliding in the direction `sign`: the speed, and while the joint sticks, what its force lacks to slide."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    joint: Joint
    friction: Friction
    sign: Float[Array, ""]

    def of_bodies(self, names):
        return make_module(SlidingSpeed, **vars(self) | {"bodies": names})

    def __call__(self, t: Number, frames: Frames) -> Number:
        return self.sign * Friction.sliding_speed(self.joint, *(frames[name] for name in self.bodies))

    def reserve(self, multipliers: Sequence[Number], lock: Number) -> Number:
        """Return the largest force less the force in the direction: negative where the joint must slide.

        Args:
            multipliers: The multipliers of the joint.
            lock: The multiplier of the constraint by which it sticks.
        """
        return self.friction.largest_force(self.joint, multipliers) - self.sign * lock


class StickOrSlip(Action):
    """A joint with set-valued friction begins to slide, ends sliding or turns round; the run decides which."""


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
    mechanism = mechanism.without_origin
    forces, joints, events = list(mechanism._forces), [], []
    for k, force in enumerate(forces):
        if not isinstance(force, Friction) or not force.sticks:
            continue
        joint, name = mechanism.joints[force.joint], force.joint
        forces[k] = make_module(DirectedFriction, **vars(force), sides=jnp.zeros(SIDES))
        joints.append(StickingJoint(name, k, first_event + len(events), SIDES * len(joints)))
        for sign, text in ((1.0, "forwards"), (-1.0, "backwards")):
            condition = SlidingSpeed(joint.bodies, joint, force, number(sign))
            events.append(Event(condition, StickOrSlip(), -1, f"{name} slides {text}"))
    mechanism = eqx.tree_at(lambda m: m._forces, mechanism, tuple(forces))
    return Sticking(mechanism, tuple(joints), tuple(events))


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
