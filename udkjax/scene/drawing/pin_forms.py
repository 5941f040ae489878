"""Pins as a drawing gives them: by coordinates, by lengths and angles, where circles meet, on a line.

A pin that is not given by coordinates refers to other pins. The order in which pins are written is free: `places_of` follows
their references.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import ROUNDING, array_namespace, by_numpy
from udkjax.printing import PrintsLine
from udkjax.scene.elements.fields import PIN, POSITIVE, given_names, given_number, given_or_none
from udkjax.scene.tables.checks import SceneEntry
from udkjax.scene.tables.schema import table_of
from udkjax.wording import quote

PointArray = Float[Array, "n 2"] | np.ndarray
Places = Mapping[str, PointArray]  # world coordinates of pins (m)


class AbstractPin(PrintsLine):
    """A point where links meet, and its initial velocity."""

    velocity: eqx.AbstractVar[Float[Array, "2"] | None]

    @property
    @abstractmethod
    def references(self) -> tuple[str, ...]:
        """The names of the pins from which the place of this one follows."""

    @abstractmethod
    def place(self, places: Places) -> PointArray:
        """Return the world coordinates (m) of the pin, given those of the pins that it refers to; NumPy or traced numbers."""

    def mistakes(self) -> Iterator[str]:
        """Iterate over mistakes in the form of the pin, each with its key (".key: message")."""
        yield from ()

    def misplacement(self, places: Places, text: Callable[[float], str]) -> str:
        """Return a message if no point has this form, such as circles that do not meet; "" if there is one.

        Numbers are concrete; `text` formats a length (m).
        """
        return ""

    def touches(self, places: Places) -> bool:
        """Return True if circles only touch, or a length just reaches a line, so that the place has no derivative.

        Numbers are concrete.
        """
        return False


class Pin(AbstractPin):
    """A pin in world coordinates."""

    position: Float[Array, "2"] = eqx.field(converter=given_number)  # m
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return ()

    def place(self, places):
        return by_numpy(self.position)


class PolarPin(AbstractPin):
    """A pin at a `length` from another one, at an `angle` from the x axis or from a `line`; or `along` a vector.

    Its place is from + length (cos a, sin a), where a is the angle, plus the angle of the line through two pins if there is one.
    """

    from_: str = eqx.field(static=True, metadata=PIN)
    length: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # m
    angle: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # rad, anticlockwise
    line: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)  # two pins
    along: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # a vector of any length
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return (self.from_, *self.line)

    def place(self, places):
        length, along = by_numpy(self.length), by_numpy(self.along)
        if along is not None:
            unit = along / norm(along)
        else:
            angle = by_numpy(self.angle)
            xp = array_namespace(angle)
            unit = xp.stack([xp.cos(angle), xp.sin(angle)])
        if self.line:
            axis = places[self.line[1]] - places[self.line[0]]
            axis = axis / norm(axis)
            unit = unit[0] * axis + unit[1] * _left_of(axis)
        return places[self.from_] + length * unit

    def mistakes(self):
        if (self.angle is None) == (self.along is None):
            yield ".angle: give an angle, or along, a direction such as [0, 1]"
        elif self.line and (len(self.line) != 2 or self.line[0] == self.line[1]):
            yield ".line: must name two pins"
        elif self.line and self.angle is None:
            yield ".line: an angle is counted from it: give an angle instead of along"
        elif isinstance(by_numpy(self.along), np.ndarray) and not np.any(np.asarray(self.along)):
            yield ".along: must have a direction, not [0, 0]"


class CirclesPin(AbstractPin):
    """The pin at given lengths from two others: one of the two points where circles meet, on a given side of the line of centres.

    With the distance d of the pins A and B, lengths r and s, the unit vector e from A to B and n to its left, the pin is
    A + x e +- y n, where x = (d^2 + r^2 - s^2) / (2 d) and y = sqrt(r^2 - x^2). Circles that touch have the pin y = 0, which has
    no derivative: NaN. Circles that do not meet have NaN.
    """

    from_: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=PIN)
    length: Float[Array, "2"] = eqx.field(converter=given_number, metadata=POSITIVE)  # m
    side: Literal["left", "right"] = eqx.field(static=True)  # of the direction from the first pin to the second
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return self.from_

    def place(self, places):
        start, end = (places[name] for name in self.from_)
        length, axis = by_numpy(self.length), end - start
        (r, s), xp, d = length, array_namespace(axis, length), norm(axis)
        unit = axis / d
        x = (d**2 + r**2 - s**2) / (2 * d)
        product, touches = _heron(d, r, s)
        # Where circles touch, the root of 0 * product is 0, and its derivative NaN.
        y = xp.sqrt(xp.where(touches, 0.0 * product, product)) / (2 * d)
        return start + x * unit + (y if self.side == "left" else -y) * _left_of(unit)

    def mistakes(self):
        if len(self.from_) != 2 or self.from_[0] == self.from_[1]:
            yield ".from: must name two pins, the centres of the circles"

    def misplacement(self, places, text):
        start, end = (places[name] for name in self.from_)
        r, s = np.asarray(self.length).tolist()
        distance = float(np.linalg.norm(end - start))
        product, touches = _heron(distance, r, s)
        if distance > 0.0 and (product > 0.0 or touches):
            return ""
        need = f"between {text(abs(r - s))} and {text(r + s)}" if r != s else f"more than 0, and at most {text(r + s)}"
        apart = f"{' and '.join(self.from_)} are {text(distance)} apart"
        return f"{apart}; circles of {text(r)} and {text(s)} do not meet: they need {need}"

    def touches(self, places):
        start, end = (places[name] for name in self.from_)
        return bool(_heron(float(np.linalg.norm(end - start)), *np.asarray(self.length).tolist())[1])


class RailPin(AbstractPin):
    """The pin at a given length from another one, on the line through the pin `on` along a vector, such as that of a slider.

    With the foot F of the first pin on the line, at a distance h, and the unit vector e along the line, the pin is
    F +- sqrt(length^2 - h^2) e, ahead of the foot or on its other side. A length that just reaches the line gives F, without
    a derivative.
    """

    from_: str = eqx.field(static=True, metadata=PIN)
    length: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # m
    on: str = eqx.field(static=True, metadata=PIN)
    along: Float[Array, "2"] = eqx.field(converter=given_number)  # a vector of any length
    side: Literal["ahead", "behind"] = eqx.field(static=True, default="ahead")
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return (self.from_, self.on)

    def place(self, places):
        along, length = by_numpy(self.along), by_numpy(self.length)
        xp, arm, unit = array_namespace(along, length), places[self.from_] - places[self.on], along / norm(along)
        height = _left_of(unit) @ arm
        square, touches = _leg(length, height)
        way = xp.sqrt(xp.where(touches, 0.0 * square, square))
        return places[self.on] + (unit @ arm + (way if self.side == "ahead" else -way)) * unit

    def mistakes(self):
        if isinstance(along := by_numpy(self.along), np.ndarray) and not np.any(along):
            yield ".along: must have a direction, not [0, 0]"

    def misplacement(self, places, text):
        along, length = np.asarray(self.along), float(np.asarray(self.length))
        height = abs(float(_left_of(along / norm(along)) @ (places[self.from_] - places[self.on])))
        square, touches = _leg(length, height)
        if square > 0.0 or touches:
            return ""
        return f"{self.from_} is {text(height)} off the line through {self.on}; a length of {text(length)} does not reach it"

    def touches(self, places):
        along = np.asarray(self.along)
        height = _left_of(along / norm(along)) @ (places[self.from_] - places[self.on])
        return bool(_leg(float(np.asarray(self.length)), float(height))[1])


class LinePin(AbstractPin):
    """A pin on the line through two others, at a `share` of their distance or a `length` from the first, `off` to its left."""

    from_: str = eqx.field(static=True, metadata=PIN)
    to: str = eqx.field(static=True, metadata=PIN)
    share: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # 0 at the first pin, 1 at the second
    length: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # m, from the first pin
    off: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # m, to the left of the line
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return (self.from_, self.to)

    def place(self, places):
        start, end = places[self.from_], places[self.to]
        axis = end - start
        unit = axis / norm(axis)
        place = start + (by_numpy(self.share) * axis if self.length is None else by_numpy(self.length) * unit)
        return place if self.off is None else place + by_numpy(self.off) * _left_of(unit)

    def mistakes(self):
        if (self.share is None) == (self.length is None):
            yield ".share: give a share of the distance, or a length from the first pin"
        if self.from_ == self.to:
            yield ".to: must be another pin than from"


class StackedPin(AbstractPin):
    """A pin at the place of another one, in another layer: the links of the two are not joined to each other there."""

    stacked: str = eqx.field(static=True, metadata=PIN)  # the other pin
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest

    @property
    def references(self):
        return (self.stacked,)

    def place(self, places):
        return places[self.stacked]


def lowest_of_stack(pins: Mapping[str, AbstractPin], name: str) -> str:
    """Return the pin on which a pin is stacked, directly or through others; the pin itself if it is not a `StackedPin`."""
    while isinstance(pin := pins[name], StackedPin):
        name = pin.stacked
    return name


def norm(vector: PointArray) -> Any:
    """Return the length of a vector."""
    return array_namespace(vector).sqrt(vector @ vector)


def _heron(d: Any, r: Any, s: Any) -> tuple[Any, Any]:
    """Return (2 d y)^2, with the height y of the triangle of sides d, r, s over d, and True if y is zero up to rounding.

    A product of differences of lengths loses fewer digits than the difference of their squares.
    """
    product = (s - d + r) * (s + d - r) * (d + r - s) * (d + r + s)
    return product, abs(product) <= 16 * ROUNDING * d * r * s * (r + s)


def _leg(length: Any, height: Any) -> tuple[Any, Any]:
    """Return the square of the other leg of a right triangle with hypotenuse `length`, and True if it is zero up to rounding."""
    square = (length - height) * (length + height)
    return square, abs(square) <= 2 * ROUNDING * length * length


def _left_of(vector: PointArray) -> PointArray:
    """Return a vector turned by a right angle to its left."""
    return array_namespace(vector).stack([-vector[1], vector[0]])


def form_of(table: Mapping[str, object]) -> type[AbstractPin]:
    """Return the class of a pin whose table has these keys."""
    if "stacked" in table:
        return StackedPin
    if "on" in table:
        return RailPin
    if isinstance(table.get("from"), list | tuple) or "side" in table:
        return CirclesPin
    if {"to", "share", "off"} & table.keys():
        return LinePin
    return Pin if "position" in table else PolarPin


def pin_entries(pins: Mapping[str, Any], velocities: Mapping[str, object]) -> Iterator[SceneEntry]:
    """Iterate over the entries of pins, each given as a pin, as a table, or by its coordinates.

    `velocities` are the initial velocities, by name, of pins that are given as tables or coordinates.
    """
    for k, (name, pin) in enumerate(pins.items()):
        if isinstance(pin, AbstractPin):
            yield SceneEntry("pin", k, name, type(pin), table_of(pin), element=pin)
            continue
        speed = {"velocity": velocities[name]} if name in velocities else {}
        table = {**(pin if isinstance(pin, Mapping) else {"position": pin}), **speed}
        yield SceneEntry("pin", k, name, form_of(table), table)


def places_of(pins: Mapping[str, AbstractPin]) -> dict[str, PointArray]:
    """Return the world coordinates (m) of all pins by name, in their order; NumPy or traced numbers."""
    found: dict[str, PointArray] = {}
    for name in in_order(pins):
        found[name] = pins[name].place(found)
    return {name: found[name] for name in pins}


def in_order(pins: Mapping[str, AbstractPin]) -> list[str]:
    """Return the names of pins, each after those that it refers to; pins whose references lead to a circle are left out."""
    rank, found = {name: k for k, name in enumerate(pins)}, []
    missing = {name: len(set(pin.references)) for name, pin in pins.items()}  # references that are not placed yet
    users: dict[str, list[str]] = {}
    for name, pin in pins.items():
        for other in set(pin.references):
            users.setdefault(other, []).append(name)
    ready = [name for name, count in missing.items() if not count]
    while ready:
        found += ready
        following = [user for name in ready for user in users.get(name, ())]
        for user in following:
            missing[user] -= 1
        ready = sorted({user for user in following if not missing[user]}, key=rank.__getitem__)
    return found


def reference_mistakes(pins: Mapping[str, AbstractPin]) -> Iterator[str]:
    """Iterate over mistakes in the references of pins to each other; all names exist."""
    reached, reported = set(in_order(pins)), set()
    waiting = [name for name in pins if name not in reached]
    for name in waiting:
        circle = _circle_from(name, pins, reached)
        if name not in circle:
            yield f"pins.{name}: is never reached, as it refers to {quote(circle[0])}, which cannot be placed"
        elif not reported & {*circle}:
            reported |= {*circle}
            steps = ", ".join(f"{a} from {b}" for a, b in zip(circle, (*circle[1:], circle[0]), strict=True))
            cure = f"give {name} by coordinates, or from other pins"
            yield (
                f"pins.{name}: refers to itself" if len(circle) == 1 else f"pins.{name}: a circle of references, {steps}: {cure}"
            )


def _circle_from(name: str, pins: Mapping[str, AbstractPin], reached: set[str]) -> list[str]:
    """Return the pins of the circle to which a pin leads if one follows each pin's first reference that cannot be placed."""
    path = {name: 0}
    while True:
        name = next(other for other in pins[name].references if other not in reached)
        if name in path:
            return list(path)[path[name] :]
        path[name] = len(path)
