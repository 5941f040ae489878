"""Joints that restrict velocities alone: knife edges and wheels of sleighs and carts, seen from above."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.scene.elements.bodies import Frame, Point
from udkjax.scene.elements.couplings import mistakes_of_pair
from udkjax.scene.elements.fields import BODY, POSITIVE, given_direction, given_names, given_number
from udkjax.scene.elements.joints import Joint


class RollingJoint(Joint):
    """A joint with rows A(t, q) v = 0, which restrict velocities and no positions. A subclass defines `rates`.

    In the equations A takes the place of Psi_q, and A v that of Psi_dot; Psi is zero. No function of positions has these rates:
    after a tour, a sleigh may stand at any place.
    """

    @abstractmethod
    def rates(self, t: Number, *frames: Frame) -> Sequence[Number]:
        """Return A v, one scalar per row, at a time (s), for the frames of the bodies; it must be linear in their velocities."""

    def residual(self, t, *frames):
        at_rest = (frame._replace(vx=0.0, vy=0.0, omega=0.0) for frame in frames)
        return [0.0 for _ in self.rates(t, *at_rest)]


def rolling_joints(mechanism: Any) -> list[str]:
    """Return the names of the rolling joints of a mechanism; an empty list for any other model."""
    joints = getattr(mechanism, "joints", {})
    return [name for name, joint in joints.items() if isinstance(joint, RollingJoint)]


class KnifeEdge(RollingJoint):
    """An edge of body 2 that cannot move sideways: the runner of a sleigh, a skate, a wheel that rolls without resistance.

    1 row (m/s): the velocity of the point relative to body 1, across `axis`, positive to the left. The multiplier is the force of
    the edge on body 1 (N) along this normal.

    Args:
        bodies: the names of the plane's body, usually "ground", and of the body with the edge.
        point: the edge, in the frame of body 2 (m).
        axis: the direction of the edge in body 2's frame, as an angle (rad) or a vector.
    """

    point: Float[Array, "2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)

    def rates(self, t, *frames):
        return [_across_and_along(self.point, self.axis, *frames)[0]]


class Wheel(RollingJoint):
    """A wheel of body 2 that rolls without slip on the plane.

    2 rows (m/s): the row of a `KnifeEdge`; and the velocity of the point along `axis`, relative to body 1, minus `radius` times
    the angular velocity of the second of the `turning` bodies relative to the first. The axle lies in the plane: let the body of
    the rim turn on a pin of the ground, so that its angular velocity is that about the axle alone.

    Args:
        bodies: the names of the plane's body, usually "ground", and of the body with the axle.
        point: the wheel, in the frame of body 2 (m).
        axis: the direction in which the wheel rolls, in body 2's frame, as an angle (rad) or a vector.
        turning: the names of the two bodies whose relative angle is that of the wheel.
        radius: radius of the wheel (m), greater than zero.
    """

    point: Float[Array, "2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    turning: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    radius: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)

    @property
    def frame_names(self):
        return tuple(dict.fromkeys((*self.bodies, *self.turning)))

    def rates(self, t, *frames):
        at = dict(zip(self.frame_names, frames, strict=True))
        across, along = _across_and_along(self.point, self.axis, *(at[body] for body in self.bodies))
        first, second = (at[body].omega for body in self.turning)
        return [across, along - self.radius * (second - first)]

    @staticmethod
    def mistakes(table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the mistakes in the pair of bodies that turn, each with its key."""
        yield from mistakes_of_pair(table, "turning")


def _across_and_along(point: Float[Array, "2"], axis: Number, one: Frame, two: Frame) -> tuple[Number, Number]:
    """Return the velocity (m/s) of a point of body 2 relative to body 1, across an axis of body 2, to its left, and along it."""
    place, speed = two.point(point), two.velocity(point)
    x, y = place.x - one.x, place.y - one.y  # from the origin of body 1
    relative = Point(speed.x - one.vx + one.omega * y, speed.y - one.vy - one.omega * x)
    direction = two.vector((jnp.cos(axis), jnp.sin(axis)))
    return relative.y * direction.x - relative.x * direction.y, relative.dot(direction)
