"""Drivers prescribe a motion: the constraints that depend on time, and the motion laws that they follow."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.printing import PrintsLine
from udkjax.scene.bodies import Point, between
from udkjax.scene.fields import CALLED, KNOTS, NOT_EMPTY, Number, given_direction, given_number, given_or_guess
from udkjax.scene.joints import Constraint, fill, fills
from udkjax.scene.splines import natural_spline


class Motion(PrintsLine):
    """A motion law. Subclass it to write one of your own: `__call__` maps the time (s) to a value (rad, m).

    A law that is smooth in pieces names the times where they meet in `breakpoints`; its value and rate are continuous there.
    """

    @abstractmethod
    def __call__(self, t: Number) -> Number:
        """Return the prescribed value at time t; it is differentiated twice."""

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where the law is not smooth: steps end there, and no interpolation reaches across. By default none."""
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
        frequency: in rad/s: 2 pi times the cycles in a second.
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
    """A natural cubic spline through (times, values), at least two; outside its times it goes on as a straight line.

    Args:
        times: in s, increasing; two at least.
        values: at these times, in the unit of the coordinate (rad or m).
    """

    times: Float[Array, "n"] = eqx.field(converter=given_number, metadata=KNOTS)
    values: Float[Array, "n"] = eqx.field(converter=given_number)

    def __call__(self, t):
        return natural_spline(t, self.times, self.values)

    @property
    def breakpoints(self):
        return self.times if self.times.size > 2 else ()  # through two points it is one straight line


class Driver(Constraint):
    """Prescribe one `coordinate` of body 2 relative to body 1. 1 row: the coordinate minus motion(t).

    `angle`: theta2 - theta1 (rad). `x`, `y`: point 2 from point 1, along the axes of body 1's frame (m): with point 1 at the
    origin, the default, the coordinates of point 2 in that frame; `axis` turns these axes in it, by an angle (rad) or as a
    vector. `distance`: between the points (m), which must not meet.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        coordinate: "angle", "x", "y" or "distance".
        motion: the prescribed value as a function of time: `Polynomial`, `Sine`, `Spline`, or a `Motion` of your own.
        points: for x, y and distance, each in its own body's frame (m); by default the origins.
        axis: for x and y: the direction of x in body 1's frame, as an angle (rad) or as a vector; by default its own.
    """

    coordinate: Literal["angle", "x", "y", "distance"] = eqx.field(static=True)
    motion: Motion = eqx.field(metadata=CALLED)
    points: Float[Array, "2 2"] = eqx.field(converter=given_or_guess, default=None)
    axis: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)  # of x, for `x`, `y`; None: that of body 1

    def residual(self, t, *frames):
        one, two = frames
        if self.coordinate == "angle":
            return [two.angle - one.angle - self.motion(t)]
        d = between(self.points, one, two)
        if self.coordinate == "distance":
            return [d.norm() - self.motion(t)]
        d = one.local(d)
        if self.axis is not None:
            c, s = jnp.cos(self.axis), jnp.sin(self.axis)
            d = Point(c * d.x + s * d.y, c * d.y - s * d.x)
        return [getattr(d, self.coordinate) - self.motion(t)]

    @property
    def breakpoints(self):
        return self.motion.breakpoints

    @property
    def effort_unit(self) -> str:
        """The unit of what it exerts along its coordinate."""
        return "N m" if self.coordinate == "angle" else "N"

    @fills("points")
    def complete(self, *frames):
        return self if self.coordinate == "angle" else fill(self, "points", ((0.0, 0.0), (0.0, 0.0)))
