"""Drivers, the constraints that depend on time, and the motion laws that they prescribe."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.bodies import Point, between
from udkjax.scene.elements.fields import CALLED, KNOTS, NOT_EMPTY, given_direction, given_number, given_or_guess
from udkjax.scene.elements.joints import Constraint, fill, fills
from udkjax.scene.elements.splines import natural_spline


class Motion(PrintsLine):
    """A motion law. Subclass it to write your own: `__call__` maps the time (s) to a value (rad, m).

    A piecewise smooth law lists the times where its pieces meet in `breakpoints`; value and rate must be continuous there.
    """

    @abstractmethod
    def __call__(self, t: Number) -> Number:
        """Return the prescribed value at time t (s); it must be twice differentiable."""

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where the law is not smooth: steps end there, and no interpolation crosses them. Empty by default."""
        return ()


class Polynomial(Motion):
    """c0 + c1 t + c2 t^2 + ...

    Args:
        coefficients: c0, c1, c2, ..., in the unit of the coordinate (rad or m) per power of seconds.
    """

    coefficients: Float[Array, "n"] = eqx.field(converter=given_number, metadata=NOT_EMPTY)

    def __call__(self, t):
        value = self.coefficients[-1]
        for k in reversed(range(self.coefficients.size - 1)):
            value = value * t + self.coefficients[k]
        return value


class Sine(Motion):
    """offset + amplitude sin(frequency t + phase), frequency in rad/s.

    Args:
        amplitude: in the unit of the coordinate (rad or m).
        frequency: angular frequency (rad/s).
        phase: in rad.
        offset: in the unit of the coordinate.
    """

    amplitude: Float[Array, ""] = eqx.field(converter=given_number)
    frequency: Float[Array, ""] = eqx.field(converter=given_number)
    phase: Float[Array, ""] = eqx.field(converter=given_number, default=0.0)
    offset: Float[Array, ""] = eqx.field(converter=given_number, default=0.0)

    def __call__(self, t):
        return self.offset + self.amplitude * jnp.sin(self.frequency * t + self.phase)


class Spline(Motion):
    """A natural cubic spline through at least two points (times, values); outside them it continues as a straight line.

    Args:
        times: in s, increasing; at least two.
        values: at these times, in the unit of the coordinate (rad or m).
    """

    times: Float[Array, "n"] = eqx.field(converter=given_number, metadata=KNOTS)
    values: Float[Array, "n"] = eqx.field(converter=given_number)

    def __call__(self, t):
        return natural_spline(t, self.times, self.values)

    @property
    def breakpoints(self):
        return self.times if self.times.size > 2 else ()  # two points: a straight line


def effort_unit(coordinate: str) -> str:
    """Return the unit of the effort along a coordinate of this kind.

    Args:
        coordinate: the kind, as of a `Driver`.

    Returns:
        "N m" along an angle, else "N".
    """
    return "N m" if coordinate == "angle" else "N"


class Driver(Constraint):
    """A constraint that prescribes one `coordinate` of body 2 relative to body 1. 1 row: the coordinate minus motion(t).

    With d the vector from point 1 to point 2, the coordinates are
        `angle`: theta2 - theta1 (rad), anticlockwise positive, not wrapped: body 1 is usually the ground or the base;
        `x`, `y`: the components of d (m) along axes fixed to body 1: x along `axis`, y to its left. With point 1 at the origin
            and the default axis they are the coordinates of point 2 in body 1's frame;
        `distance`: |d| (m), which must not become zero.
    Exchanging the bodies reverses the sign of the angle. The multiplier of the row is minus the effort, the torque (N m) or force
    (N) that the driver exerts on body 2 along the coordinate.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        coordinate: "angle", "x", "y" or "distance".
        motion: the prescribed value as a function of time: `Polynomial`, `Sine`, `Spline`, or a `Motion` of your own.
        points: for x, y and distance: point 1 and point 2, each in the frame of its body (m); by default the origins.
        axis: for x and y: the direction of x in body 1's frame, as an angle (rad) or a vector; by default the frame's x axis.
    """

    coordinate: Literal["angle", "x", "y", "distance"] = eqx.field(static=True)
    motion: Motion = eqx.field(metadata=CALLED)
    points: Float[Array, "2 2"] = eqx.field(converter=given_or_guess, default=None)
    axis: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)  # None: the x axis of body 1

    def residual(self, t, *frames):
        frame1, frame2 = frames
        if self.coordinate == "angle":
            return [frame2.angle - frame1.angle - self.motion(t)]
        d = between(self.points, frame1, frame2)
        if self.coordinate == "distance":
            return [d.norm() - self.motion(t)]
        d = frame1.local(d)
        if self.axis is not None:
            c, s = jnp.cos(self.axis), jnp.sin(self.axis)
            d = Point(c * d.x + s * d.y, c * d.y - s * d.x)
        return [getattr(d, self.coordinate) - self.motion(t)]

    @property
    def breakpoints(self):
        return self.motion.breakpoints

    @property
    def effort_unit(self) -> str:
        """The unit of the effort along the coordinate."""
        return effort_unit(self.coordinate)

    @fills("points")
    def complete(self, *frames):
        return self if self.coordinate == "angle" else fill(self, "points", ((0.0, 0.0), (0.0, 0.0)))
