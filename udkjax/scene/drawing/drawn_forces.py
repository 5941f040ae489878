"""Elements of a drawing that drive or load its links: motors, springs, dampers, loads."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import array_namespace, by_numpy
from udkjax.scene.drawing.placement import DrawnElement, Parts, PinLayout, Placement, pair_mistakes
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.drivers import Driver, Motion, Polynomial, Sine, Spline
from udkjax.scene.elements.fields import LINK, NOT_NEGATIVE, PIN, SLIDE, given_names, given_number, given_or_none
from udkjax.scene.elements.forces import Force, Spring, Torque, TorsionSpring
from udkjax.wording import quote


class Motor(DrawnElement):
    """A motor that turns a link at a `pin` or moves a `slide`, or a cylinder `between` two pins.

    At a pin, the second of two links turns relative to the first. A motor prescribes a `speed` or a `motion`, or applies a
    `torque` at a pin, anticlockwise positive on the second link. Speed and motion are relative to the drawn position; for a
    cylinder they refer to the distance between its pins.
    """

    pin: str | None = eqx.field(static=True, default=None, metadata=PIN)
    slide: str | None = eqx.field(static=True, default=None, metadata=SLIDE)
    between: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)
    of: tuple[str, ...] = eqx.field(
        static=True, converter=given_names, default=(), metadata=LINK
    )  # the two links, if more than two meet
    speed: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # rad/s; m/s for a slide or a cylinder
    motion: Motion | None = None  # rad or m, relative to the drawn position
    torque: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # N m

    @property
    def measured_as(self):
        return "Motor" if self.pin is not None else "SlideMotor"

    def mistakes(self, layout):
        if (self.pin is not None) + (self.slide is not None) + bool(self.between) != 1:
            yield "pin: give a pin, a slide, or two pins that it is between"
        elif self.slide is None:
            yield from _mistakes_of_ends(layout, self.between, self.pin, self.of)
        if sum(x is not None for x in (self.speed, self.motion, self.torque)) != 1:
            yield "speed: give one of speed, motion and torque"
        elif self.pin is None and self.torque is not None:
            yield f"torque: a {'slide' if self.slide else 'cylinder'} does not turn: write a [[load]] with a force"

    def parts(self, placement):
        if self.slide is not None:
            pair, points, axis = placement.guide(placement.slides[self.slide])
            return Parts(driver=Driver(pair, "x", self._law(0.0), points, axis))
        if self.pin is None:
            law, ends = self._law(placement.distance(*self.between)), placement.ends(self.between)
            return Parts(driver=Driver(ends, "distance", law, _points_of(placement, self.between)))
        pair = placement.pair(self.pin, self.of)
        if self.torque is not None:
            return Parts(force=Torque(pair, self.torque))
        return Parts(driver=Driver(pair, "angle", self._law(placement.angle_between(*pair))))

    @property
    def anchors(self):
        return self.between

    def _law(self, start: Number) -> Motion:
        if self.motion is not None:
            return shift_motion(jax.tree.map(by_numpy, self.motion), start)
        assert self.speed is not None
        speed = by_numpy(self.speed)
        return Polynomial(array_namespace(start, speed).stack([start, speed]))


class PinSpring(DrawnElement):
    """A spring `between` two pins with a free `length`, or a torsion spring at a `pin` with a free `angle`.

    By default springs are unloaded in the drawn position. The angle is that of the second link relative to the first, measured
    from the drawn position.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)  # N/m; N m/rad in torsion
    between: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)
    pin: str | None = eqx.field(static=True, default=None, metadata=PIN)
    of: tuple[str, ...] = eqx.field(
        static=True, converter=given_names, default=(), metadata=LINK
    )  # the two links, if more than two meet
    damping: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    length: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)  # m
    angle: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # rad

    @property
    def measured_as(self):
        return "Spring" if self.pin is None else "TorsionSpring"

    def mistakes(self, layout):
        yield from _mistakes_of_ends(layout, self.between, self.pin, self.of)
        if self.pin is not None and self.length is not None:
            yield "length: a spring at a pin has an angle"
        if self.between and self.angle is not None:
            yield "angle: a spring between pins has a length"

    def parts(self, placement):
        if self.pin is not None:
            pair = placement.pair(self.pin, self.of)
            free = placement.angle_between(*pair) + (0.0 if self.angle is None else by_numpy(self.angle))
            return Parts(force=TorsionSpring(pair, self.stiffness, self.damping, free))
        length = placement.distance(*self.between) if self.length is None else self.length
        return Parts(force=_spring_between(placement, self.between, self.stiffness, length, self.damping))

    @property
    def anchors(self):
        return self.between


class PinDamper(DrawnElement):
    """A damper `between` two pins, or a rotational damper at a `pin`."""

    damping: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)  # N s/m; N m s/rad in rotation
    between: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)
    pin: str | None = eqx.field(static=True, default=None, metadata=PIN)
    of: tuple[str, ...] = eqx.field(
        static=True, converter=given_names, default=(), metadata=LINK
    )  # the two links, if more than two meet

    @property
    def measured_as(self):
        return "Spring" if self.pin is None else "TorsionSpring"

    def mistakes(self, layout):
        yield from _mistakes_of_ends(layout, self.between, self.pin, self.of)

    def parts(self, placement):
        if self.pin is not None:
            return Parts(force=TorsionSpring(placement.pair(self.pin, self.of), 0.0, self.damping))
        return Parts(force=_spring_between(placement, self.between, 0.0, 0.0, self.damping))

    @property
    def anchors(self):
        return self.between


class Load(DrawnElement):
    """A constant `force` at a pin or at a link's centre of mass, or a constant `torque` on a link."""

    pin: str | None = eqx.field(static=True, default=None, metadata=PIN)
    link: str | None = eqx.field(static=True, default=None, metadata=LINK)  # the link that is loaded, if the pin has several
    force: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # N
    torque: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None)  # N m, with its reaction on the ground
    frame: Literal["ground", "body"] = eqx.field(static=True, default="ground")  # the axes of the force

    def mistakes(self, layout):
        if (self.force is None) == (self.torque is None):
            yield "force: give a force, or a torque"
        if self.torque is not None and (self.link is None or self.pin is not None):
            yield "torque: name the link that it is on, and no pin"
        elif not self._body(layout):
            yield "pin: give a pin of a link, or a link"
        elif self._body(layout) == GROUND:
            yield f'link: "{GROUND}" does not move; name a link'
        elif self.pin is not None and self.link is not None and self.link not in layout.members(self.pin):
            yield f"link: {quote(self.link)} has no pin {quote(self.pin)}"

    def parts(self, placement):
        body = self._body(placement)
        if self.torque is not None:
            return Parts(force=Torque((GROUND, body), self.torque))
        assert self.force is not None
        point = (0.0, 0.0) if self.pin is None else placement.local(body, placement.places[self.pin])
        vector = self.force
        if self.frame == "body":  # the vector is drawn in world coordinates, and turns with the body
            vector = _turn_back(by_numpy(self.force), placement.angle(body))
        return Parts(force=Force(body, vector, point, self.frame))

    def _body(self, layout: PinLayout) -> str:
        if self.link is not None or self.pin is None:
            return self.link or ""
        return next((m for m in layout.members(self.pin) if m != GROUND), "")


def shift_motion(motion: Motion, start: Number) -> Motion:
    """Return the motion law motion(t) + start."""
    if isinstance(motion, Polynomial):
        xp = array_namespace(motion.coefficients, start)
        first = xp.zeros(len(motion.coefficients))
        first = xp.concatenate([xp.stack([start]), first[1:]])
        return Polynomial(motion.coefficients + first)
    if isinstance(motion, Sine):
        return replace(motion, offset=motion.offset + start)
    if isinstance(motion, Spline):
        return replace(motion, values=motion.values + start)
    return ShiftedMotion(motion, start)


class ShiftedMotion(Motion):
    """A user-written motion law plus a constant."""

    motion: Motion
    start: Float[Array, ""] = eqx.field(converter=given_number)

    def __call__(self, t):
        return self.motion(t) + self.start

    @property
    def breakpoints(self):
        return self.motion.breakpoints


def _turn_back(vector: Array, angle: Number) -> Array:
    xp = array_namespace(vector, angle)
    c, s = xp.cos(angle), xp.sin(angle)
    return xp.stack([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]])


def _spring_between(
    placement: Placement, between: tuple[str, ...], stiffness: Number, length: Number, damping: Number | None
) -> Spring:
    return Spring(placement.ends(between), _points_of(placement, between), stiffness, length, damping)


def _points_of(placement: Placement, between: tuple[str, ...]) -> Array:
    """Return the positions of two pins, each in the frame of its first link."""
    return placement.points(placement.ends(between), [placement.places[pin] for pin in between])


def _mistakes_of_ends(layout: PinLayout, between: tuple[str, ...], pin: str | None, of: tuple[str, ...]) -> Iterator[str]:
    """Iterate over the mistakes in an element between two pins, or at one pin."""
    if bool(between) == (pin is not None):
        yield "between: give two pins, or one pin to turn at"
    elif pin is not None:
        yield from pair_mistakes(layout, pin, of)
    elif len(between) != 2 or between[0] == between[1]:
        yield "between: must name two pins"
    else:
        members1, members2 = map(layout.members, between)
        yield from (
            f"between: no link has pin {quote(p)}, nor the ground"
            for p, members in zip(between, (members1, members2), strict=True)
            if not members
        )
        yield from (
            f"between: both pins are on {quote(members)}, so their distance never changes"
            for members in members1
            if members in members2
        )
