"""One class per joint. A joint defines only its position residual; everything else is derived from it.

Conventions that hold throughout: body 1 and body 2 are the first and second of `bodies`, and `residual` takes their frames in
this order; `points` are point 1 on body 1 and point 2 on body 2, each in the frame of its body (m); `axis` is the direction of a
line in body 1's frame, as an angle (rad) or a vector (x, y), and its normal points to the left of it; angles are in rad,
anticlockwise positive, and not wrapped; rows are in the order in which `residual` returns them. The joint's force on a body is
-Psi_q^T lambda. A number left out ("as in the initial guess") is None until the mechanism fills it in.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import ClassVar, Self, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number, Numbers
from udkjax.arrays import ROUNDING, array_namespace, number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.bodies import GROUND, Frame, Point, between
from udkjax.scene.elements.fields import (
    BODY,
    NOT_EMPTY,
    POSITIVE,
    given_direction,
    given_names,
    given_number,
    given_or_guess,
    given_or_none,
)
from udkjax.scene.elements.profiles import AbstractProfile, SwingProfile, as_profile


class Constraint(PrintsLine):
    """A constraint Psi(t, q) = 0: a joint or a driver. A subclass need only define `residual`.

    Args:
        bodies: the names of the bodies whose frames `residual` receives.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    n_bodies: ClassVar[int] = 2  # number of `bodies`, for types of the scene format

    @abstractmethod
    def residual(self, t: Number, *frames: Frame) -> Sequence[Number]:
        """Return Psi, one scalar per row, at a time (s), for the frames of the attached bodies."""

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The bodies whose frames `residual` receives, in order."""
        return self.bodies

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where Psi is not smooth; Psi and its rate must be continuous there. Empty by default."""
        return ()

    def piece(self, t: Number, *frames: Frame) -> Number | None:
        """Return the index of the current smooth piece of Psi, or None if it is smooth everywhere (the default).

        Second derivatives of Psi are continuous where pieces meet. No interpolation crosses from one piece to another. If the
        index depends on t, runs have no second derivatives.
        """
        return None

    def complete(self, *frames: Frame) -> Self:
        """Return the constraint with its missing numbers computed from the frames of its bodies in the initial guess."""
        return self


AnyConstraint = TypeVar("AnyConstraint", bound=Constraint)
Completion = TypeVar("Completion", bound=Callable)


def fills(name: str) -> Callable[[Completion], Completion]:
    """Decorate a `complete` that only sets the number `name`: it is called only if that number is absent."""

    def mark(complete: Completion) -> Completion:
        complete.fills = name  # pyright: ignore[reportFunctionMemberAccess]
        return complete

    return mark


class Joint(Constraint):
    """A constraint that does not depend on time. Subclass it to write your own joint.

    Args:
        bodies: the names of the bodies whose frames `residual` receives; "ground" is the fixed frame.
    """


class Revolute(Joint):
    """Two points coincide. 2 rows: the x and y components, in ground axes, of point 2 minus point 1 (m).

    The multipliers are the x and y components of the force of body 2 on body 1 (N), in ground axes.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the pin in both bodies, in the frame of each body (m).
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)

    def residual(self, t, *frames):
        gap = between(self.points, *frames)
        return [gap.x, gap.y]


class Prismatic(Joint):
    """Body 2 slides along a line of body 1 without relative rotation.

    2 rows: the distance of point 2 from the line through point 1 along `axis` (m), positive to the left of the axis, and
    theta2 - theta1 - `angle` (rad). The line and its normal turn with body 1: exchanging the bodies gives another joint.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: a point of the line on body 1, and the point of body 2 that slides on it, each in the frame of its body (m).
        axis: the direction of the line in body 1's frame, as an angle (rad) or a vector.
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        frame1, frame2 = frames
        return [_lateral_distance(self.axis, self.points, frame1, frame2), frame2.angle - frame1.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Slot(Joint):
    """A pin of body 2 slides along a line of body 1, free to turn.

    1 row: the distance of point 2 from the line through point 1 along `axis` (m), positive to the left of the axis. The line
    turns with body 1. The multiplier is the force of the pin on body 1 (N) along this normal.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: a point of the line on body 1, and the pin on body 2, each in the frame of its body (m).
        axis: the direction of the line in body 1's frame, as an angle (rad) or a vector.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)

    def residual(self, t, *frames):
        return [_lateral_distance(self.axis, self.points, *frames)]


class Weld(Joint):
    """No relative motion. 3 rows: the two of `Revolute` (m), then theta2 - theta1 - `angle` (rad).

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the common point, in the frame of each body (m).
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        frame1, frame2 = frames
        gap = between(self.points, frame1, frame2)
        return [gap.x, gap.y, frame2.angle - frame1.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Distance(Joint):
    """A massless rod of `length` L joins two points. 1 row: (d.d - L^2) / (2 L) (m), d the vector from point 1 to point 2.

    At d.d = L^2 the gradient with respect to point 2 is the unit vector d / L, so that the multiplier is the force in the rod
    (N), positive in tension. The order of the bodies does not matter.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the ends of the rod, each in the frame of its body (m).
        length: length of the rod (m), greater than zero; by default as in the initial guess.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    length: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None, metadata=POSITIVE)

    def residual(self, t, *frames):
        d = between(self.points, *frames)
        return [0.5 * (d.dot(d) / self.length - self.length)]

    @fills("length")
    def complete(self, *frames):
        length = between(self.points, *frames).norm()
        reach = sum(abs(x) for frame, point in zip(frames, self.points, strict=True) for x in (frame.x, frame.y, *point))
        # Coincident points, up to rounding, give no direction: set the length to zero, which the mechanism refuses.
        return fill(self, "length", array_namespace(length).where(length > ROUNDING * reach, length, 0.0))


class Angle(Joint):
    """The relative angle is fixed. 1 row: theta2 - theta1 - `angle` (rad). Relative translation is free.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        frame1, frame2 = frames
        return [frame2.angle - frame1.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Gear(Joint):
    """Two gear wheels mesh, their centres held by the `carrier` c (a body or the ground).

    1 row (m): r1 (theta1 - theta_c) + r2 (theta2 - theta_c) - constant for external gears, which turn in opposite directions
    relative to the carrier; with -r2 for an `internal` gear, with which both turn in the same direction. The sign is the same
    whichever wheel is the internal one. The constant is the value in the initial guess.

    Args:
        bodies: the names of the two wheels.
        radii: pitch radii of wheel 1 and wheel 2 (m), both greater than zero.
        internal: whether one of the wheels is an internal gear.
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
        return _replace(self, "constant", self._rolling_distance(*frames))

    def _rolling_distance(self, frame1: Frame, frame2: Frame, carrier: Frame | None = None) -> Number:
        first, second = (
            (frame1.angle, frame2.angle) if carrier is None else (frame1.angle - carrier.angle, frame2.angle - carrier.angle)
        )
        rolled = self.radii[1] * second
        return self.radii[0] * first - rolled if self.internal else self.radii[0] * first + rolled


class Rack(Joint):
    """Body 2, a pinion of `radius` r centred at its centre of mass, rolls on a rack of body 1 along `axis`, to its left.

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
        return _replace(self, "constant", self._rolling_distance(*frames))

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
    """A nut, body 2, slides by a `lead` along `axis` of body 1 for each turn of a screw: its axis may lie in the plane.

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
        return _replace(self, "constant", self._travel(*frames))

    @staticmethod
    def mistakes(table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the mistakes in the pair of bodies that turn, each with its key."""
        yield from mistakes_of_pair(table, "turning")

    def _travel(self, *frames: Frame) -> Number:
        """Return the displacement of the nut (m) minus the travel of the screw."""
        at = dict(zip(self.frame_names, frames, strict=True))
        slid = coordinate_of(self.axis, self.points, *(at[body] for body in self.bodies))
        return slid - self.lead * (coordinate_of(None, None, *(at[body] for body in self.turning)) / (2 * np.pi))


class Coupling(Joint):
    """One coordinate is a polynomial of another, each an angle or a slide between two bodies: y = c0 + c1 x + c2 x^2 + ...

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


class Cam(Joint):
    """A point of a follower, body 2, stays on the closed `profile` of a cam, body 1; or a flat face of the follower touches it.

    1 row (m): |d| - radius, positive outside the profile, with d the vector from point 1 to point 2 in body 1's frame, and the
    profile's radius at its polar angle. With a `face`, n . d - radius, at the angle of its outward normal n in body 1's frame:
    radius is then the distance of the tangent across n. A profile by laws finds its radius at the turn of the cam that belongs
    to |d|, or n . d, and to the angle. The constraint acts in both directions: the follower cannot lift off.

    Args:
        bodies: the names of the cam and of the follower.
        points: the centre of the profile on body 1, and the point of body 2 that stays on it, each in the frame of its body (m).
        profile: a `Profile`, a `LiftProfile` or a `SwingProfile`, or the table of one.
        face: the direction of the normal of a flat face, away from the cam, in body 2's frame, as an angle (rad) or a vector.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    profile: AbstractProfile = eqx.field(converter=as_profile)
    face: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)

    def residual(self, t, *frames):
        distance, turn = self._contact(*frames)
        return [distance - self.profile(turn, self.face is not None)]

    def piece(self, t, *frames):
        return self.profile.piece(self._contact(*frames)[1])

    @staticmethod
    def mistakes(table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the numbers that a joint's profile lacks, and a drawing would find, each with its key."""
        profile = table.get("profile")
        if isinstance(profile, SwingProfile) or (isinstance(profile, Mapping) and "swing" in profile):
            given = profile if isinstance(profile, Mapping) else vars(profile)
            yield from (f"profile.{key}: missing" for key in ("pivot", "arm") if given.get(key) is None)

    def _contact(self, frame1: Frame, frame2: Frame) -> tuple[Number, Number]:
        """Return the distance (m) of the point or the face from the centre, and the turn of the profile there (rad)."""
        d = self._arm(frame1, frame2)
        if self.face is None:
            distance, angle = d.norm(), jnp.arctan2(d.y, d.x)
        else:
            angle = self.face + frame2.angle - frame1.angle
            distance = d.x * jnp.cos(angle) + d.y * jnp.sin(angle)
        return distance, self.profile.turn(distance, angle, self.face is not None)

    def _arm(self, frame1: Frame, frame2: Frame) -> Point:
        """Return the vector from point 1 to point 2 in body 1's frame."""
        return frame1.local(between(self.points, frame1, frame2))


def mistakes_of_pair(table: Mapping[str, object], key: str) -> Iterator[str]:
    """Iterate over the mistakes in a second pair of bodies."""
    names = table.get(key)
    if isinstance(names, list | tuple) and (len(names) != 2 or names[0] == names[1]):
        yield f"{key}: must name two bodies"


def _lateral_distance(axis: Number, points: Float[Array, "2 2"], frame1: Frame, frame2: Frame) -> Number:
    """Return the distance (m) of point 2 from the line through point 1 along `axis` of body 1, positive to the left."""
    normal = frame1.vector((-jnp.sin(axis), jnp.cos(axis)))
    return normal.dot(between(points, frame1, frame2))


def _replace(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    return eqx.tree_at(lambda c: getattr(c, name), constraint, number(value), is_leaf=lambda leaf: leaf is None)


def fill(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    """Return the constraint with its number `name` set to `value` if it is absent (None)."""
    return constraint if getattr(constraint, name) is not None else _replace(constraint, name, value)
