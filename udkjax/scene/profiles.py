"""Outlines of cams, given by points or by laws of lift over the angle of the cam."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.printing import PrintsLine
from udkjax.scene.fields import (
    LAW_ANGLES,
    LIFTS,
    POSITIVE,
    PROFILE_ANGLES,
    PROFILE_RADII,
    given_names,
    given_number,
    given_or_none,
)
from udkjax.scene.splines import count_knots, periodic_spline, wrap

LawName = Literal["dwell", "cycloidal", "harmonic", "3-4-5", "4-5-6-7"]


class AbstractProfile(PrintsLine):
    """The closed outline of a cam: its radius over the polar angle.

    For a flat follower it is the distance of the face from the centre of the cam, over the angle of its normal.
    """

    @abstractmethod
    def __call__(self, angle: Number) -> Array:
        """Return the radius (m) at a polar angle (rad)."""

    @abstractmethod
    def piece(self, angle: Number) -> Array:
        """Return the index of the smooth piece at a polar angle (rad)."""


class Profile(AbstractProfile):
    """The closed outline of a cam by points: a periodic cubic spline.

    Args:
        angle: polar angles (rad), anticlockwise, increasing within less than one turn; at least three. The first is not repeated.
        radius: radius at each angle (m), greater than zero.
    """

    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_ANGLES)  # rad, increasing, less than one turn
    radius: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_RADII)  # m

    def __call__(self, angle: Number) -> Array:
        """Return the radius (m) at a polar angle (rad)."""
        return periodic_spline(angle, self.angle, self.radius, 2 * jnp.pi)

    def piece(self, angle: Number) -> Array:
        """Return the index of the cubic at a polar angle (rad)."""
        return count_knots(wrap(angle, self.angle[0], 2 * jnp.pi), self.angle)


def _dwell(x: Array) -> Array:
    return 0.0 * x


def _cycloidal(x: Array) -> Array:
    return x - jnp.sin(2 * jnp.pi * x) / (2 * jnp.pi)


def _harmonic(x: Array) -> Array:
    return 0.5 - 0.5 * jnp.cos(jnp.pi * x)


def _345(x: Array) -> Array:
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def _4567(x: Array) -> Array:
    return x**4 * (35.0 + x * (x * (70.0 - 20.0 * x) - 84.0))


# Laws by name: the share of the lift over the share of the angle, both from 0 to 1.
LAWS: Mapping[str, Callable[[Array], Array]] = {
    "dwell": _dwell,
    "cycloidal": _cycloidal,
    "harmonic": _harmonic,
    "3-4-5": _345,
    "4-5-6-7": _4567,
}


class LiftProfile(AbstractProfile):
    """The outline of a cam by laws of lift, one after another over a turn of the cam.

    While the cam turns by the k-th angle b from the end of the one before, the radius changes by its lift h:
    r = base + (sum of the lifts before) + h f(x), with x from 0 to 1 over the angle. The laws f:

        dwell        0
        cycloidal    x - sin(2 pi x) / (2 pi)
        harmonic     (1 - cos(pi x)) / 2
        3-4-5        10 x^3 - 15 x^4 + 6 x^5
        4-5-6-7      35 x^4 - 84 x^5 + 70 x^6 - 20 x^7

    A follower that slides on a line through the centre of the cam thus moves by the laws, exactly. The first law begins at the
    polar angle `start`, and the cam turns anticlockwise, unless `clockwise`.

    Args:
        base: the least radius if all lifts begin with a rise (m): that of the base circle for a knife edge or a flat face, of the
            prime circle (base circle and roller) for the centre of a roller.
        law: the names of the laws.
        angle: the angles of the cam (rad), which add up to a turn.
        lift: the lifts (m), which add up to zero: positive for a rise, negative for a return, zero for a dwell.
        start: polar angle at which the first law begins (rad); in a drawing by default at the follower as drawn, else zero.
        clockwise: whether the cam turns clockwise.
    """

    base: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # m
    law: tuple[LawName, ...] = eqx.field(static=True, converter=given_names)
    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=LAW_ANGLES)  # rad
    lift: Float[Array, "n"] = eqx.field(converter=given_number, metadata=LIFTS)  # m
    start: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # rad
    clockwise: bool = eqx.field(static=True, default=False)

    def __call__(self, angle: Number) -> Array:
        """Return the radius (m) at a polar angle (rad)."""
        turned, ends, heights = self._turned(angle), jnp.cumsum(self.angle), jnp.cumsum(self.lift)
        found = self.base + 0.0 * turned
        for k, name in enumerate(self.law):
            begin, below = (ends[k - 1], heights[k - 1]) if k else (0.0, 0.0)
            rise = below + self.lift[k] * LAWS[name]((turned - begin) / self.angle[k])
            found = jnp.where(turned >= begin, self.base + rise, found)
        return found

    def piece(self, angle: Number) -> Array:
        """Return the index of the law at a polar angle (rad)."""
        return count_knots(self._turned(angle), jnp.cumsum(self.angle)[:-1])

    def _turned(self, angle: Number) -> Array:
        """Return by how much the cam has turned since the first law began when its follower is at a polar angle (rad)."""
        since = angle - (0.0 if self.start is None else self.start)
        return wrap(since if self.clockwise else -since, 0.0, 2 * jnp.pi)


def profile_class(table: Mapping[str, object]) -> type[AbstractProfile]:
    """Return the class of a profile whose table has these keys."""
    return LiftProfile if {"base", "law", "lift"} & table.keys() else Profile


def as_profile(value: Any) -> Any:
    """Convert a table to a profile; return anything else unchanged, to be refused by the mechanism."""
    if not isinstance(value, Mapping):
        return value
    try:
        return profile_class(value)(**value)
    except TypeError:  # an unknown or a missing key
        return value
