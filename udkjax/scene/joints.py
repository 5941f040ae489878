"""One class per joint. A joint writes only its position residual; everything else is derived from it.

Conventions that hold throughout: `bodies` names the bodies that the joint connects, in the order in which `residual` gets
their frames; `points` are the attachments, each in its body's own frame (m); `axis` is the direction of a line in body 1's
frame, an angle (rad) or a vector (x, y); angles are in rad, anticlockwise; rows come in the order in which `residual` returns
them. A number that is None when a joint is made ("as in the initial guess") is filled in by the mechanism.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.printing import PrintsLine
from udkjax.scene.bodies import GROUND, Frame, Point, between
from udkjax.scene.fields import (
    BODY,
    POSITIVE,
    PROFILE_ANGLES,
    PROFILE_RADII,
    ROUNDING,
    Number,
    Numbers,
    array_namespace,
    given_direction,
    given_names,
    given_number,
    given_or_guess,
    number,
)
from udkjax.scene.splines import count_knots, periodic_spline, wrap


class Constraint(PrintsLine):
    """Anything that holds Psi(t, q) = 0: a joint or a driver. A subclass writes `residual`, nothing more.

    Args:
        bodies: the names of the bodies whose frames `residual` gets.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    n_bodies: ClassVar[int] = 2  # number of `bodies` of a type of the scene format

    @abstractmethod
    def residual(self, t: Number, *frames: Frame) -> Sequence[Number]:
        """Return Psi, one scalar a row, from the time (s) and the frames of the attached bodies."""

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The bodies whose frames `residual` gets, in that order."""
        return self.bodies

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where Psi is not smooth, though it and its rate are continuous. By default none."""
        return ()

    def piece(self, t: Number, *frames: Frame) -> Number | None:
        """Return the number of the smooth piece in which Psi is, or None where it is smooth everywhere (the default).

        Where pieces meet, Psi has continuous second derivatives. No interpolation reaches from one piece to another.
        """
        return None

    def complete(self, *frames: Frame) -> Self:
        """Return the constraint with the numbers that it leaves to the initial guess, from its bodies' frames there."""
        return self


AnyConstraint = TypeVar("AnyConstraint", bound=Constraint)
Completion = TypeVar("Completion", bound=Callable)


def fills(name: str) -> Callable[[Completion], Completion]:
    """Mark a `complete` that does nothing but set the number `name` where it is absent: elsewhere nobody has to call it."""

    def mark(complete: Completion) -> Completion:
        complete.fills = name  # pyright: ignore[reportFunctionMemberAccess]
        return complete

    return mark


class Joint(Constraint):
    """A constraint that does not depend on time. Subclass it to write a joint of your own.

    Args:
        bodies: the names of the bodies whose frames `residual` gets; "ground" is the fixed frame.
    """


class Revolute(Joint):
    """Two points coincide. 2 rows: the x and y components of point 2 minus point 1 (m).

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the pin in both bodies, in each body's own frame (m).
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)

    def residual(self, t, *frames):
        gap = between(self.points, *frames)
        return [gap.x, gap.y]


class Prismatic(Joint):
    """Body 2 slides along a line of body 1 without turning on it.

    2 rows: the distance of point 2 from the line through point 1 along `axis` (m, positive on its left), and
    theta2 - theta1 - `angle` (rad; default: as in the initial guess).

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: a point of the line in body 1, and the point of body 2 that slides on it (m).
        axis: the direction of the line in body 1's frame, as an angle (rad) or as a vector.
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        one, two = frames
        return [_lateral_distance(self.axis, self.points, one, two), two.angle - one.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Slot(Joint):
    """A pin of body 2 slides along a line of body 1, free to turn. 1 row: its distance from the line, as in `Prismatic`.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: a point of the line in body 1, and the pin in body 2 (m).
        axis: the direction of the line in body 1's frame, as an angle (rad) or as a vector.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)

    def residual(self, t, *frames):
        return [_lateral_distance(self.axis, self.points, *frames)]


class Weld(Joint):
    """No relative motion. 3 rows: those of `Revolute`, and theta2 - theta1 - `angle` (rad; default: as in the initial guess).

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the point where they meet, in each body's own frame (m).
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        one, two = frames
        gap = between(self.points, one, two)
        return [gap.x, gap.y, two.angle - one.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Distance(Joint):
    """A massless rod of `length` L joins two points. 1 row: (d.d - L^2) / (2 L) (m), d the vector from point 1 to point 2.

    Its gradient at d.d = L^2 is the unit vector along the rod, so its multiplier is the rod's force (N), positive in compression.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the two points that it connects, each in its own body's frame (m).
        length: of the rod (m), greater than zero; by default as in the initial guess.
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
        # The rounding between points that coincide has no direction: a length of zero, which the mechanism refuses.
        return fill(self, "length", array_namespace(length).where(length > ROUNDING * reach, length, 0.0))


class Angle(Joint):
    """The relative angle is fixed. 1 row: theta2 - theta1 - `angle` (rad; default: as in the initial guess).

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        angle: theta2 - theta1 (rad); by default as in the initial guess.
    """

    angle: Float[Array, ""] = eqx.field(converter=given_or_guess, default=None)

    def residual(self, t, *frames):
        one, two = frames
        return [two.angle - one.angle - self.angle]

    @fills("angle")
    def complete(self, *frames):
        return fill(self, "angle", frames[1].angle - frames[0].angle)


class Gear(Joint):
    """Two wheels mesh, their centres held by the `carrier` c (a body or the ground).

    1 row (m): r1 (theta1 - theta_c) + r2 (theta2 - theta_c) - constant, with r2 negated where wheel 1 is an `internal` gear
    (or wheel 2 is: the sign does not tell). The constant is the initial guess's.

    Args:
        bodies: the names of the two wheels.
        radii: of wheel 1 and of wheel 2 (m), greater than zero.
        internal: whether one of them is an internal gear.
        carrier: the body that holds both centres.
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

    def _rolling_distance(self, one: Frame, two: Frame, carrier: Frame | None = None) -> Number:
        first, second = (one.angle, two.angle) if carrier is None else (one.angle - carrier.angle, two.angle - carrier.angle)
        rolled = self.radii[1] * second
        return self.radii[0] * first - rolled if self.internal else self.radii[0] * first + rolled


class Rack(Joint):
    """Body 2, a pinion of `radius` r centred at its centre of mass, rolls on a rack along `axis` of body 1, on the rack's left.

    1 row (m): s + r (theta2 - theta1) - constant, s the displacement of body 2's origin from body 1's along the axis. The
    constant is the initial guess's. Only the rolling is held: another joint, a `Slot`, keeps the pinion at its height.

    Args:
        bodies: the names of the rack and of the pinion.
        radius: of the pinion (m), greater than zero.
        axis: the direction of the rack in body 1's frame, as an angle (rad) or as a vector.
    """

    radius: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)
    axis: Float[Array, ""] = eqx.field(converter=given_direction)
    constant: Float[Array, ""] = eqx.field(init=False, default_factory=lambda: None)

    def residual(self, t, *frames):
        return [self._rolling_distance(*frames) - self.constant]

    def complete(self, *frames):
        return _replace(self, "constant", self._rolling_distance(*frames))

    def _rolling_distance(self, one: Frame, two: Frame) -> Number:
        along = one.vector((jnp.cos(self.axis), jnp.sin(self.axis)))
        return along.dot(Point(two.x - one.x, two.y - one.y)) + self.radius * (two.angle - one.angle)


class Profile(PrintsLine):
    """A cam's outline: a closed curve, radius over polar angle, by a periodic cubic spline. The first point is not repeated.

    Args:
        angle: polar angles (rad), increasing, within less than one turn; three at least.
        radius: at each of them (m), greater than zero.
    """

    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_ANGLES)  # rad, increasing, less than one turn
    radius: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_RADII)  # m

    def __call__(self, angle: Number) -> Array:
        """Return the radius (m) at a polar angle (rad)."""
        return periodic_spline(angle, self.angle, self.radius, 2 * jnp.pi)

    def piece(self, angle: Number) -> Array:
        """Return the number of the cubic at a polar angle (rad)."""
        return count_knots(wrap(angle, self.angle[0], 2 * jnp.pi), self.angle)


def as_profile(value: Any) -> Any:
    """Return a profile, which may be given as a table; anything else as it is, for the mechanism to refuse."""
    return Profile(**value) if isinstance(value, Mapping) and value.keys() == {"angle", "radius"} else value


class Cam(Joint):
    """A follower, point 2, stays on body 1's closed `profile` around point 1.

    1 row (m): |d| - radius(phi), with d the vector from point 1 to point 2 in body 1's frame, and phi its polar angle.

    Args:
        bodies: the names of the cam and of the follower.
        points: the centre of the profile in body 1, and the point of body 2 that stays on it (m).
        profile: a `Profile`, or a table of its angles and radii.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    profile: Profile = eqx.field(converter=as_profile)

    def residual(self, t, *frames):
        d = self._arm(*frames)
        return [d.norm() - self.profile(jnp.arctan2(d.y, d.x))]

    def piece(self, t, *frames):
        d = self._arm(*frames)
        return self.profile.piece(jnp.arctan2(d.y, d.x))

    def _arm(self, one: Frame, two: Frame) -> Point:
        """Return the vector from point 1 to point 2 in body 1's frame."""
        return one.local(between(self.points, one, two))


def _lateral_distance(axis: Number, points: Float[Array, "2 2"], one: Frame, two: Frame) -> Number:
    """Return the distance of point 2 to the left of the line through point 1 along `axis` of body 1 (m)."""
    normal = one.vector((-jnp.sin(axis), jnp.cos(axis)))
    return normal.dot(between(points, one, two))


def _replace(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    return eqx.tree_at(lambda c: getattr(c, name), constraint, number(value), is_leaf=lambda leaf: leaf is None)


def fill(constraint: AnyConstraint, name: str, value: Numbers) -> AnyConstraint:
    """Return the constraint with its number `name` set to `value` where it is absent (None)."""
    return constraint if getattr(constraint, name) is not None else _replace(constraint, name, value)
