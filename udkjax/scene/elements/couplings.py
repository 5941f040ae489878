"""Joints that couple two coordinates, each an angle or a slide: gears, racks, screws, and polynomials.

Their conventions are those of joints.py. They constrain the ratio of the coordinates alone: other joints guide the bodies.
"""

from collections.abc import Iterator, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.scene.elements.bodies import GROUND, Frame, Point, between
from udkjax.scene.elements.fields import BODY, NOT_EMPTY, POSITIVE, given_direction, given_names, given_number, given_or_none
from udkjax.scene.elements.joints import Joint, with_number


class Gear(Joint):
    """Two gear wheels that mesh, with their centres held by the `carrier` c (a body or the ground).

    1 row (m): r1 (theta1 - theta_c) + r2 (theta2 - theta_c) - constant for external gears, which turn in opposite directions
    relative to the carrier; with -r2 for an `internal` gear, with which both turn in the same direction. The sign is the same
    whichever wheel is the internal one. The constant is the value in the initial guess.

    Args:
        bodies: the names of the two wheels.
        radii: pitch radii of wheel 1 and wheel 2 (m), both greater than zero.
        internal: True if one of the wheels is an internal gear.
        carrier: the body that holds both centres; other joints must hold them.
    """

    radii: Float[Array, "2"] = eqx.field(converter=given_number, metadata=POSITIVE)
    internal: bool = eqx.field(static=True, default=False)
    carrier: str = eqx.field(static=True, default=GROUND, metadata=BODY)
    constant: Float[Array, ""] = eqx.field(init=False, default_factory=lambda: None)

    @property
    def frame_names(self):
        return self.bodies if self.carrier == GROUND else (*self.bodies, self.carrier)

    def residual(self, t, *frames):
        return [self._rolling_distance(*frames) - self.constant]

    def complete(self, *frames):
        return with_number(self, "constant", self._rolling_distance(*frames))

    def _rolling_distance(self, frame1: Frame, frame2: Frame, carrier: Frame | None = None) -> Number:
        first, second = (
            (frame1.angle, frame2.angle) if carrier is None else (frame1.angle - carrier.angle, frame2.angle - carrier.angle)
        )
        rolled = self.radii[1] * second
        return self.radii[0] * first - rolled if self.internal else self.radii[0] * first + rolled


class Rack(Joint):
    """A rack along `axis` on body 1, and to its left a pinion, body 2, of `radius` r about its centre of mass, which rolls on it.

    1 row (m): s + r (theta2 - theta1) - constant, s the displacement along `axis` of body 2's origin from body 1's: moving along
    the axis, the pinion turns clockwise. The constant is the value in the initial guess. Only rolling is constrained; another
    joint, such as a `Slot`, must keep the pinion at its distance from the rack.

    Args:
        bodies: the names of the rack and of the pinion.
        radius: pitch radius of the pinion (m), greater than zero.
        axis: the direction of the rack in body 1's frame, as an angle (rad) or a vector; the pinion is on its left.
    """

    radius: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    constant: Float[Array, ""] = eqx.field(init=False, default_factory=lambda: None)

    def residual(self, t, *frames):
        return [self._rolling_distance(*frames) - self.constant]

    def complete(self, *frames):
        return with_number(self, "constant", self._rolling_distance(*frames))

    def _rolling_distance(self, frame1: Frame, frame2: Frame) -> Number:
        direction = frame1.vector((jnp.cos(self.axis), jnp.sin(self.axis)))
        return direction.dot(Point(frame2.x - frame1.x, frame2.y - frame1.y)) + self.radius * (frame2.angle - frame1.angle)


def coordinate_of(axis: Number | None, points: Float[Array, "2 2"] | None, frame1: Frame, frame2: Frame) -> Number:
    """Return the displacement (m) of point 2 from point 1 along `axis` of body 1, or without axis the relative angle (rad)."""
    if axis is None:
        return frame2.angle - frame1.angle
    direction = frame1.vector((jnp.cos(axis), jnp.sin(axis)))
    return direction.dot(between(((0.0, 0.0), (0.0, 0.0)) if points is None else points, frame1, frame2))


class Screw(Joint):
    """A screw and a nut, body 2, which slides by a `lead` along `axis` of body 1 for each turn of the screw.

    The screw's axis may lie in the plane.

    1 row (m): s - lead theta / (2 pi) - constant, s the displacement of point 2 from point 1 along the axis, theta the angle of
    the second of the `turning` bodies relative to the first. The constant is the value in the initial guess. Only the ratio is
    constrained; other joints, such as a `Prismatic` and a `Revolute`, must guide the nut and the screw. The multiplier is the
    force on body 1 (N) along the axis; the torque on the second of the turning bodies is lead / (2 pi) times as large.

    Args:
        bodies: the names of the guide and of the nut; "ground" is the fixed frame.
        points: a point of the line on the guide, and the point of the nut on it, each in the frame of its body (m).
        axis: the direction of the line in body 1's frame, as an angle (rad) or a vector.
        turning: the names of the bearing and of the screw, between which it turns.
        lead: travel of the nut for one turn (m): pitch times number of starts; negative for the opposite hand.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    turning: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    lead: Float[Array, ""] = eqx.field(converter=given_number)
    constant: Float[Array, ""] = eqx.field(init=False, default_factory=lambda: None)

    @property
    def frame_names(self):
        return tuple(dict.fromkeys((*self.bodies, *self.turning)))

    def residual(self, t, *frames):
        return [self._travel(*frames) - self.constant]

    def complete(self, *frames):
        return with_number(self, "constant", self._travel(*frames))

    @staticmethod
    def mistakes(table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the mistakes in the pair of bodies that turn, each with its key."""
        yield from mistakes_of_pair(table, "turning")

    def _travel(self, *frames: Frame) -> Number:
        """Return the displacement of the nut (m) minus the displacement that belongs to the angle of the screw."""
        at = dict(zip(self.frame_names, frames, strict=True))
        slid = coordinate_of(self.axis, self.points, *(at[body] for body in self.bodies))
        return slid - self.lead * (coordinate_of(None, None, *(at[body] for body in self.turning)) / (2 * np.pi))


class Coupling(Joint):
    """A coupling of two coordinates, each an angle or a slide between two bodies, by a polynomial: y = c0 + c1 x + c2 x^2 + ...

    1 row: y - c0 - c1 x - c2 x^2 - ..., in the unit of y: m for a slide, rad for an angle. y belongs to `bodies`, x to the
    bodies `to`. With an axis, a coordinate is the displacement of point 2 from point 1 along this axis of its first body;
    otherwise it is the angle of the second body relative to the first. Only the ratio is constrained; other joints must guide
    the bodies.

    Args:
        bodies: the names of the two bodies of y; "ground" is the fixed frame.
        to: the names of the two bodies of x.
        coefficients: c0, c1, c2, ..., in the unit of y per power of the unit of x.
        axis: if y is a slide: its direction in the frame of the first of its bodies, as an angle (rad) or a vector.
        to_axis: the same for x.
        points: if y is a slide: its points, each in the frame of its body (m); by default the origins.
        to_points: the same for x.
    """

    to: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    coefficients: Float[Array, "n"] = eqx.field(converter=given_number, metadata=NOT_EMPTY)
    axis: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)
    to_axis: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)
    points: Float[Array, "2 2"] | None = eqx.field(converter=given_or_none, default=None)
    to_points: Float[Array, "2 2"] | None = eqx.field(converter=given_or_none, default=None)

    @property
    def frame_names(self):
        return tuple(dict.fromkeys((*self.bodies, *self.to)))

    def residual(self, t, *frames):
        at = dict(zip(self.frame_names, frames, strict=True))
        x = coordinate_of(self.to_axis, self.to_points, *(at[body] for body in self.to))
        value = self.coefficients[-1]
        for k in reversed(range(self.coefficients.size - 1)):
            value = value * x + self.coefficients[k]
        return [coordinate_of(self.axis, self.points, *(at[body] for body in self.bodies)) - value]

    @staticmethod
    def mistakes(table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the mistakes in the second pair of bodies, and in points without an axis, each with its key."""
        yield from mistakes_of_pair(table, "to")
        for points, axis in (("points", "axis"), ("to_points", "to_axis")):
            if table.get(points) is not None and table.get(axis) is None:
                yield f"{points}: an angle has no points: give {axis} for a slide, or leave them out"


def mistakes_of_pair(table: Mapping[str, object], key: str) -> Iterator[str]:
    """Iterate over the mistakes in the second pair of bodies of an element, which its table has under a key."""
    names = table.get(key)
    if isinstance(names, list | tuple) and (len(names) != 2 or names[0] == names[1]):
        yield f"{key}: must name two bodies"
