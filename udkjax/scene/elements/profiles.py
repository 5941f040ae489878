"""Outlines of cams, given by points or by laws of lift over the angle of the cam."""

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import is_array
from udkjax.printing import PrintsLine
from udkjax.scene.elements.fields import (
    LAW_ANGLES,
    LIFTS,
    POSITIVE,
    PROFILE_ANGLES,
    PROFILE_RADII,
    SWINGS,
    given_names,
    given_number,
    given_or_none,
)
from udkjax.scene.elements.splines import count_knots, periodic_spline, wrap

LawName = Literal["dwell", "cycloidal", "harmonic", "3-4-5", "4-5-6-7"]


class AbstractProfile(PrintsLine):
    """The closed outline of a cam in its frame, as a distance from the centre that depends on an angle, the turn.

    If a point of the follower stays on the cam, the distance is that of the point, and the turn its polar angle. If a `flat` face
    of the follower touches the cam, the distance is that of the face, and the turn the angle of its normal. In a `LawProfile`,
    the turn is the angle by which the cam has turned.
    """

    @abstractmethod
    def __call__(self, turn: Number, flat: bool = False) -> Array:
        """Return the distance (m) of the point or of the flat face at a turn (rad)."""

    @abstractmethod
    def piece(self, turn: Number) -> Array:
        """Return the index of the smooth piece at a turn (rad)."""

    def turn(self, distance: Number, angle: Number, flat: bool = False) -> Number:
        """Return the turn (rad) at which a follower at this distance (m) and angle (rad) in the cam's frame would touch."""
        return angle

    def bearing(self, turn: Number, flat: bool = False) -> Number:
        """Return the polar angle of the point, or the angle of the normal of the face, in the cam's frame at a turn (rad)."""
        return turn

    def rim(self, count: int, flat: bool = False) -> Float[np.ndarray, "count 2"]:
        """Return `count` points (m) of the outline in the cam's frame: places of the follower's point.

        For a `flat` face they are points of the envelope of its positions.
        """

        def contact(turn: Array) -> Array:
            return jnp.stack([self(turn, flat), self.bearing(turn, flat)])

        turns = jnp.asarray(np.linspace(0.0, 2 * np.pi, count, endpoint=False))
        (r, angle), (slope, turning) = (np.asarray(x) for x in jax.jvp(jax.vmap(contact, out_axes=1), (turns,), (0 * turns + 1,)))
        along, across = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)
        return r[:, None] * along + ((slope / turning)[:, None] * across if flat else 0.0)


class Profile(AbstractProfile):
    """The closed outline of a cam by points: a periodic cubic spline.

    Args:
        angle: polar angles (rad), anticlockwise, increasing within less than one turn; at least three. The first is not repeated.
        radius: radius at each angle (m), greater than zero.
    """

    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_ANGLES)  # rad, increasing, less than one turn
    radius: Float[Array, "n"] = eqx.field(converter=given_number, metadata=PROFILE_RADII)  # m

    def __call__(self, turn: Number, flat: bool = False) -> Array:
        """Return the radius (m) at a polar angle (rad)."""
        return periodic_spline(turn, self.angle, self.radius, 2 * jnp.pi)

    def piece(self, turn: Number) -> Array:
        """Return the index of the cubic at a polar angle (rad)."""
        return count_knots(wrap(turn, self.angle[0], 2 * jnp.pi), self.angle)


def _dwell(x: Array) -> Array:
    return 0.0 * x  # NaN stays


def _cycloidal(x: Array) -> Array:
    return x - jnp.sin(2 * jnp.pi * x) / (2 * jnp.pi)


def _harmonic(x: Array) -> Array:
    return 0.5 - 0.5 * jnp.cos(jnp.pi * x)


def _345(x: Array) -> Array:
    return x**3 * (10.0 + x * (6.0 * x - 15.0))


def _4567(x: Array) -> Array:
    return x**4 * (35.0 + x * (x * (70.0 - 20.0 * x) - 84.0))


# Laws by name: the share of the lift over the share of the angle, both from 0 to 1.
LIFT_LAWS: Mapping[str, Callable[[Array], Array]] = {
    "dwell": _dwell,
    "cycloidal": _cycloidal,
    "harmonic": _harmonic,
    "3-4-5": _345,
    "4-5-6-7": _4567,
}


class LawProfile(AbstractProfile):
    """The outline of a cam on which a follower moves by laws, one after another over a turn of the cam, exactly.

    While the cam turns by the k-th angle b from the end of the one before, the follower's own coordinate changes by its step h:
    s = (sum of the steps before) + h f(x), with x from 0 to 1 over the angle. The laws f:

        dwell        0
        cycloidal    x - sin(2 pi x) / (2 pi)
        harmonic     (1 - cos(pi x)) / 2
        3-4-5        10 x^3 - 15 x^4 + 6 x^5
        4-5-6-7      35 x^4 - 84 x^5 + 70 x^6 - 20 x^7

    The distance r from the centre of the cam determines s, and with it the direction in which the centre sees the follower,
    relative to the line or to the pivot that guides it. A point of the cam's plane thus has one turn at which the follower would
    be there, and the outline is the curve r = r(s(turn)), without any table of radii.

    Args:
        base: the distance of the follower from the centre where the travel is zero (m): the radius of the base circle for a knife
            edge or a flat face, of the prime circle (base circle and roller) for the centre of a roller.
        law: the names of the laws.
        angle: the angles of the cam (rad), which add up to a turn.
        start: direction of the slide, or from the centre to the pivot, in the cam's frame when the first law begins (rad); in a
            drawing by default as drawn, else zero.
        clockwise: True if the cam turns clockwise.
    """

    base: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # m
    law: tuple[LawName, ...] = eqx.field(static=True, converter=given_names)
    angle: Float[Array, "n"] = eqx.field(converter=given_number, metadata=LAW_ANGLES)  # rad
    start: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, kw_only=True)  # rad
    clockwise: bool = eqx.field(static=True, default=False, kw_only=True)
    step_field: ClassVar[str]  # name of the field with the steps of the follower's coordinate

    @abstractmethod
    def distance(self, travel: Number, flat: bool) -> Number:
        """Return the distance (m) of the follower from the centre when its travel from the base circle is `travel` (m or rad)."""

    @abstractmethod
    def sight(self, distance: Number, flat: bool) -> Number:
        """Return the angle (rad) of a follower at a distance (m), seen from the centre, relative to its slide or pivot."""

    @abstractmethod
    def unreachable(self, flat: bool) -> str:
        """Return a message, with its key, if the follower cannot be on the base circle or at its highest place; "" if it can."""

    def __call__(self, turn: Number, flat: bool = False) -> Number:
        """Return the distance (m) of the point, or of the flat face, when the cam has turned by this angle (rad)."""
        steps = getattr(self, self.step_field)
        turned, ends, heights = wrap(turn, 0.0, 2 * jnp.pi), jnp.cumsum(self.angle), jnp.cumsum(steps)
        travel = 0.0 * turned  # not zero: an undefined angle gives an undefined travel
        for k, name in enumerate(self.law):
            begin, below = (ends[k - 1], heights[k - 1]) if k else (0.0, 0.0)
            risen = below + steps[k] * LIFT_LAWS[name]((turned - begin) / self.angle[k])
            travel = jnp.where(turned >= begin, risen, travel)
        return self.distance(travel, flat)

    def piece(self, turn: Number) -> Array:
        """Return the index of the law when the cam has turned by this angle (rad)."""
        return count_knots(wrap(turn, 0.0, 2 * jnp.pi), jnp.cumsum(self.angle)[:-1])

    def turn(self, distance: Number, angle: Number, flat: bool = False) -> Number:
        """Return the angle (rad) by which the cam has turned when its follower is at this distance (m) and angle (rad)."""
        clockwise = angle - self._start - self.sight(distance, flat)
        return clockwise if self.clockwise else -clockwise

    def bearing(self, turn: Number, flat: bool = False) -> Number:
        """Return the polar angle in the cam's frame (rad) of the follower's point, or, if `flat`, of the normal of its face.

        `turn` (rad) is the angle by which the cam has turned.
        """
        return self._start + self.sight(self(turn, flat), flat) + (turn if self.clockwise else -turn)

    @property
    def _start(self) -> Number:
        return 0.0 if self.start is None else self.start

    @classmethod
    def mistakes(cls, table: Mapping[str, object]) -> Iterator[str]:
        """Iterate over the mistakes in a table that concern several keys, each with its key."""
        law, angle = table.get("law"), table.get("angle")
        is_list = isinstance(angle, list | tuple) or (is_array(angle) and np.ndim(angle) == 1)  # pyright: ignore
        if isinstance(law, list | tuple) and is_list and len(law) != len(angle):  # pyright: ignore
            yield f"law: must have as many entries as angle and {cls.step_field}"


class LiftProfile(LawProfile):
    """The outline of a cam by laws of the lift of a follower that slides.

    The follower's point slides on a line past the centre at the `eccentricity` e (m, positive if the line is to the left of the
    centre as seen along the slide). With y the way along the line from the foot of the perpendicular, r^2 = e^2 + y^2, and y
    follows the laws from y0^2 = base^2 - e^2. Without an eccentricity, r itself follows the laws, as for a flat face across
    its slide.

    Args:
        lift: the lifts (m), which add up to zero: positive for a rise, negative for a return, zero for a dwell.
        eccentricity: distance of the line of the follower's point from the centre (m); in a drawing by default as drawn,
            else zero.
    """

    lift: Float[Array, "n"] = eqx.field(converter=given_number, metadata=LIFTS)  # m
    eccentricity: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # m
    step_field = "lift"

    def distance(self, travel: Number, flat: bool) -> Number:
        """Return the distance (m) of the follower from the centre at a lift (m)."""
        if flat or self.eccentricity is None:
            return self.base + travel
        e = self.eccentricity
        way = jnp.sqrt(self.base**2 - e**2) + travel
        return jnp.sqrt(e**2 + way**2)

    def sight(self, distance: Number, flat: bool) -> Number:
        """Return the angle (rad) from the direction of the slide to that of a follower at a distance (m) from the centre."""
        if flat or self.eccentricity is None:
            return 0.0
        return jnp.arctan2(self.eccentricity, _root((distance - self.eccentricity) * (distance + self.eccentricity)))

    def unreachable(self, flat: bool) -> str:
        """Return a message if the base circle does not reach the line of the follower; "" if it does."""
        if flat or self.eccentricity is None or float(self.base) > abs(float(self.eccentricity)):
            return ""
        off = abs(float(self.eccentricity))
        return f"base: a circle of {float(self.base):.4g} m does not reach the line of the follower, {off:.4g} m off the centre"


class SwingProfile(LawProfile):
    """The outline of a cam by laws of the swing of a follower that turns about a pivot.

    With the pivot at the distance c from the centre, the point of the follower on an arm l, and psi the angle at the pivot
    between the directions to the centre and to the point, r^2 = c^2 + l^2 - 2 c l cos(psi). A flat face whose normal is at nu
    from the direction to the pivot is at the distance r = c cos(nu) + l, with l that of the face from the pivot along the normal.
    psi, or -nu, follows the laws from where r is `base`.

    Args:
        swing: the angles (rad) by which the follower turns away from the cam, which add up to zero.
        pivot: distance of the pivot from the centre (m), positive if the follower touches the cam to the left of the direction
            from the centre to the pivot, else negative; in a drawing by default as drawn.
        arm: distance of the point from the pivot, or of the face from the pivot along its normal (m); in a drawing by default as
            drawn.
    """

    swing: Float[Array, "n"] = eqx.field(converter=given_number, metadata=SWINGS)  # rad
    pivot: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # m
    arm: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # m
    step_field = "swing"

    def distance(self, travel: Number, flat: bool) -> Number:
        """Return the distance (m) of the follower from the centre at a swing (rad)."""
        c, arm, base = self._lengths
        if flat:
            return arm + c * jnp.cos(_angle(base - arm, c) - travel)
        at_base = jnp.arctan2(_root(_area(base, c, arm)), c**2 + arm**2 - base**2)
        return jnp.sqrt(c**2 + arm**2 - 2 * c * arm * jnp.cos(at_base + travel))

    def sight(self, distance: Number, flat: bool) -> Number:
        """Return the angle (rad) from the direction of the pivot to that of a follower at a distance (m) from the centre."""
        assert self.pivot is not None
        c, arm, _ = self._lengths
        angle = _angle(distance - arm, c) if flat else jnp.arctan2(_root(_area(distance, c, arm)), c**2 + distance**2 - arm**2)
        return jnp.where(self.pivot >= 0, angle, -angle)

    def unreachable(self, flat: bool) -> str:
        """Return a message if the follower does not reach the base circle, or turns beyond its dead position; otherwise ""."""
        c, arm, base = (float(x) for x in self._lengths)
        low, high = (arm - c, arm + c) if flat else (abs(c - arm), c + arm)
        if not low < base < high:
            return f"base: the follower can be at {max(low, 0):.4g} to {high:.4g} m from the centre, not at {base:.4g} m"
        farthest = float(np.max(np.cumsum(np.asarray(self.swing)), initial=0.0))
        room = math.acos((base - arm) / c) if flat else math.pi - math.acos((c**2 + arm**2 - base**2) / (2 * c * arm))
        if farthest < room:
            return ""
        wanted, possible = math.degrees(farthest), math.degrees(room)
        return f"swing: the follower is stretched out {possible:.4g} deg from the base circle, and should swing {wanted:.4g} deg"

    @property
    def _lengths(self) -> tuple[Number, Number, Number]:
        """The distance of the pivot from the centre, the arm, and the base (m)."""
        assert self.pivot is not None and self.arm is not None  # a drawing, or the file, has them
        return jnp.abs(self.pivot), self.arm, self.base


def _root(x: Number) -> Array:
    """Return the square root; zero, with zero derivatives, for a negative number, as trial positions of an assembly may give."""
    return jnp.where(x > 0.0, jnp.sqrt(jnp.where(x > 0.0, x, 1.0)), 0.0)


def _angle(along: Number, length: Number) -> Array:
    """Return the angle (rad, 0 to pi) at which a vector of a length has a component `along`."""
    return jnp.arctan2(_root((length - along) * (length + along)), along)


def _area(a: Number, b: Number, c: Number) -> Number:
    """Return the square of four times the area of a triangle by its sides; negative if they do not close."""
    return ((b + c) ** 2 - a**2) * (a**2 - (b - c) ** 2)


def profile_class(table: Mapping[str, object]) -> type[AbstractProfile]:
    """Return the class of a profile whose table has these keys."""
    if "swing" in table:
        return SwingProfile
    return LiftProfile if {"base", "law", "lift"} & table.keys() else Profile


def as_profile(value: Any) -> Any:
    """Convert a table to a profile; return anything else unchanged, to be refused by the mechanism."""
    if not isinstance(value, Mapping):
        return value
    try:
        return profile_class(value)(**value)
    except TypeError:  # an unknown or a missing key
        return value
