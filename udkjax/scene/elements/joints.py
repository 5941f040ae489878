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
from jaxtyping import Array, Float

from udkjax.annotations import Number, Numbers
from udkjax.arrays import ROUNDING, array_namespace, number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.bodies import Frame, Point, between
from udkjax.scene.elements.fields import (
    BODY,
    POSITIVE,
    given_direction,
    given_names,
    given_number,
    given_or_guess,
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

        Second derivatives of Psi must be continuous where pieces meet. No interpolation crosses from one piece to another. If the
        index depends on t, runs have no second derivatives.
        """
        return None

    def complete(self, *frames: Frame) -> Self:
        """Return the constraint with its missing numbers computed from the frames of its bodies in the initial guess.

        By default, no number is missing, and the constraint returns itself.
        """
        return self


AnyConstraint = TypeVar("AnyConstraint", bound=Constraint)
Completion = TypeVar("Completion", bound=Callable)


def fills(name: str) -> Callable[[Completion], Completion]:
    """Return a decorator for methods `complete` that only set the number `name`; they are called only if it is absent."""

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
    """A pin joint: two points coincide. 2 rows: the x and y components, in ground axes, of point 2 minus point 1 (m).

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
    """A sliding joint: body 2 slides along a line of body 1 without relative rotation.

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
    """A pin in a slot: a point of body 2 slides along a line of body 1, and the bodies are free to turn.

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
    """A rigid connection of two bodies. 3 rows: the two of `Revolute` (m), then theta2 - theta1 - `angle` (rad).

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
    """A massless rod of `length` L between two points. 1 row: (d.d - L^2) / (2 L) (m), d the vector from point 1 to point 2.

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
    """A joint that fixes the relative angle of two bodies. 1 row: theta2 - theta1 - `angle` (rad). They may translate freely.

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


class Cam(Joint):
    """A cam, body 1, and a follower, body 2: a point of the follower stays on the cam's `profile`, or a flat face touches it.

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
        """Iterate over the missing numbers of a joint's `SwingProfile`, each with its key; only a drawing can supply them."""
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


def _lateral_distance(axis: Number, points: Float[Array, "2 2"], frame1: Frame, frame2: Frame) -> Number:
    """Return the distance (m) of point 2 from the line through point 1 along `axis` of body 1, positive to the left."""
    normal = frame1.vector((-jnp.sin(axis), jnp.cos(axis)))
    return normal.dot(between(points, frame1, frame2))


def with_number(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    """Return the constraint with another value of its number `name`."""
    return eqx.tree_at(lambda c: getattr(c, name), constraint, number(value), is_leaf=lambda leaf: leaf is None)


def fill(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    """Return the constraint with its number `name` set to `value` if it is absent (None)."""
    return constraint if getattr(constraint, name) is not None else with_number(constraint, name, value)
