"""Joints of a drawing other than pins: slides, slots, gears, screws, cams."""

from dataclasses import replace
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import array_namespace, by_numpy
from udkjax.scene.drawing.pin_forms import norm
from udkjax.scene.drawing.placement import (
    DrawnElement,
    Parts,
    PinLayout,
    Placement,
    SlidingLink,
    line_mistakes,
    pair_mistakes,
)
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Gear, Screw
from udkjax.scene.elements.fields import LINK, PIN, POSITIVE, SLIDE, given_direction, given_names, given_number, given_or_none
from udkjax.scene.elements.joints import Cam, Prismatic, Slot
from udkjax.scene.elements.profiles import AbstractProfile, LawProfile, SwingProfile, as_profile
from udkjax.wording import quote


class Slide(DrawnElement):
    """A joint with which a `link` slides along a line of another link or of the ground, without relative rotation."""

    link: str = eqx.field(static=True, metadata=LINK)
    along: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)  # two pins
    direction: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)  # rad or a vector; instead of `along`
    on: str = eqx.field(static=True, default=GROUND, metadata=LINK)

    def mistakes(self, layout):
        yield from line_mistakes(self.along, self.direction)
        if self.link not in layout.links:
            yield f"link: {quote(self.link)} must be a link with a pin"
        if self.on == self.link:
            yield f"on: {quote(self.on)} is connected to itself"

    def parts(self, placement):
        pair, points, axis = placement.guide(self)  # pyright: ignore[reportArgumentType]  # converters
        return Parts(joint=Prismatic(pair, points, axis, placement.angle_between(*pair)))

    @property
    def anchors(self):
        return self.along


class PinInSlot(DrawnElement):
    """A joint that keeps a `pin` on a line of a link or of the ground: through two pins, or through itself in a direction."""

    pin: str = eqx.field(static=True, metadata=PIN)
    along: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=PIN)  # two pins
    direction: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)  # rad or a vector; instead of `along`
    on: str = eqx.field(static=True, default=GROUND, metadata=LINK)
    link: str | None = eqx.field(static=True, default=None, metadata=LINK)  # the guided link; needed if `on` shares the pin

    def mistakes(self, layout):
        yield from line_mistakes(self.along, self.direction)
        if not self._guided_link(layout):
            yield f"pin: {quote(self.pin)} is on no link but {quote(self.on)}, whose slot it should slide in"
        if self.link is not None and self.link not in layout.members(self.pin):
            yield f"link: {quote(self.link)} has no pin {quote(self.pin)}"

    def parts(self, placement):
        pair = (self.on, self._guided_link(placement))
        pin = placement.places[self.pin]
        points = placement.points(pair, (placement.places[self.along[0]] if self.along else pin, pin))
        return Parts(joint=Slot(pair, points, placement.direction(self.on, self.along, self.direction)))

    def _guided_link(self, layout: PinLayout) -> str:
        return self.link or next((member for member in layout.members(self.pin) if member != self.on), "")

    @property
    def anchors(self):
        return self.along


class GearPair(DrawnElement):
    """Two wheels that mesh, or that a `belt` connects. Their centres are the pins about which they turn on the `carrier`.

    `teeth` or `radii` give the ratio. An open belt turns both wheels in the same direction, a crossed one in opposite directions;
    neither slips. A belt needs radii; a chain has teeth and a `pitch`, the length of a link.
    """

    links: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=LINK)
    teeth: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)
    radii: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m
    internal: bool = eqx.field(static=True, default=False)
    carrier: str = eqx.field(static=True, default=GROUND, metadata=LINK)
    belt: Literal["open", "crossed"] | None = eqx.field(static=True, default=None)
    pitch: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m, of a chain

    def mistakes(self, layout):
        if self.belt is None and self.pitch is not None:
            yield 'pitch: is that of a chain: add belt = "open", or leave it out'
        elif self.belt is not None and (self.teeth is None) != (self.pitch is None):
            yield "belt: give radii, or for a chain teeth and a pitch"
        elif self.belt is not None and self.internal:
            yield "internal: a belt is open or crossed: leave this out"
        if len(self.links) != 2 or self.links[0] == self.links[1]:
            yield "links: must name two links"
            return
        if (self.teeth is None) == (self.radii is None):
            yield "teeth: give teeth, or radii"
        for wheel in self.links:
            if layout.centre(wheel, self.carrier) is None:
                yield (
                    f"links: {quote(wheel)} must share one pin, its centre, with {quote(self.carrier)}, on which it turns; "
                    "carrier = names another link to turn on"
                )

    def parts(self, placement):
        radii = self.radii
        if self.belt is not None:
            if radii is None:  # the chain advances by its pitch for each tooth
                radii = by_numpy(self.teeth) * by_numpy(self.pitch) / (2 * np.pi)
            return Parts(joint=Gear(self.links, radii, self.belt == "open", self.carrier))
        if radii is None:  # chosen so that the wheels touch
            assert self.teeth is not None
            centre1, centre2 = (placement.centre(wheel, self.carrier) or "" for wheel in self.links)
            teeth = by_numpy(self.teeth)
            radii = teeth * (placement.distance(centre1, centre2) / self._apart(teeth))
        return Parts(joint=Gear(self.links, radii, self.internal, self.carrier))

    def misfit(self, placement: Placement) -> tuple[float, float] | None:
        """Return the distance between the centres, and the distance required by the radii (m); None if any distance fits."""
        if self.radii is None or self.belt is not None:
            return None
        centre1, centre2 = (placement.centre(wheel, self.carrier) or "" for wheel in self.links)
        return float(placement.distance(centre1, centre2)), float(self._apart(self.radii))

    def _apart(self, sizes: Array) -> Number:
        difference = array_namespace(sizes).abs(sizes[0] - sizes[1])
        return difference if self.internal else sizes[0] + sizes[1]


class ScrewPair(DrawnElement):
    """A screw that turns at a `pin` and moves a `slide` by its `lead` for each turn.

    Its axis may lie in the plane; anticlockwise turns of the second link at the pin, relative to the first, move the slide along
    its direction, or against it if the lead is negative.
    """

    slide: str = eqx.field(static=True, metadata=SLIDE)
    pin: str = eqx.field(static=True, metadata=PIN)
    lead: Float[Array, ""] = eqx.field(converter=given_number)  # m for one turn
    of: tuple[str, ...] = eqx.field(
        static=True, converter=given_names, default=(), metadata=LINK
    )  # the two links, if more than two meet

    def mistakes(self, layout):
        yield from pair_mistakes(layout, self.pin, self.of)

    def parts(self, placement):
        pair, points, axis = placement.guide(placement.slides[self.slide])
        return Parts(joint=Screw(pair, points, axis, placement.pair(self.pin, self.of), self.lead))


class CamPair(DrawnElement):
    """A cam around the first of two `pins`, and a follower: the second pin, which stays on the cam's `profile`.

    The polar angle of the profile is measured from the cam's x axis: from its first pin towards its second, or the world's x axis
    for a cam with one pin. Laws begin in the drawn position. Those of a `LiftProfile` move the follower along its slide, if it
    slides on the link that carries the cam; those of a `SwingProfile` turn it about its pin on this link. `face` is the direction
    of the normal of a flat face, away from the cam.
    """

    pins: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=PIN)
    profile: AbstractProfile = eqx.field(converter=as_profile)
    face: Float[Array, ""] | None = eqx.field(converter=given_direction, default=None)  # rad or a vector
    links: tuple[str, ...] = eqx.field(static=True, converter=given_names, default=(), metadata=LINK)  # cam and follower

    def mistakes(self, layout):
        if len(self.pins) != 2:
            yield "pins: must name two pins, the centre of the cam and the follower"
            return
        pair = self._pair(layout)
        if len(pair) != 2 or any(p not in layout.members(pin) for p, pin in zip(pair, self.pins, strict=False)):
            yield "links: name two, the cam with the first pin and the follower with the second"
        elif isinstance(self.profile, SwingProfile) and self._pivot(layout) is None:
            carrier = f"the link, or the ground, that carries the cam at {quote(self.pins[0])}"
            yield f"profile.swing: {quote(pair[1])} must turn about one pin of {carrier}; or give lift"

    def parts(self, placement):
        pair, places = self._pair(placement), [placement.places[pin] for pin in self.pins]
        face = None if self.face is None else by_numpy(self.face)
        profile = self.profile
        if isinstance(profile, LawProfile):
            profile = self._guided(profile, placement)
        face = None if face is None else face - placement.angle(pair[1])
        return Parts(joint=Cam(pair, placement.points(pair, places), profile, face))

    def unreachable(self, placement: Placement) -> str:
        """Return a message, beginning with a key, if the follower as it is guided cannot follow the laws; "" if it can."""
        profile = self.profile
        return self._guided(profile, placement).unreachable(self.face is not None) if isinstance(profile, LawProfile) else ""

    def _guided(self, profile: LawProfile, placement: Placement) -> LawProfile:
        """Return the profile with the numbers that are not given, from the drawn place of the follower and its slide or pivot."""
        cam = self._pair(placement)[0]
        centre, point = (placement.places[pin] for pin in self.pins)
        arm, face, numbers = point - centre, None if self.face is None else by_numpy(self.face), {}
        place = axis = None
        if isinstance(profile, SwingProfile):
            place = placement.places[self._pivot(placement) or ""]
        elif face is None and (slide := self._slide(placement)):
            axis = placement.direction(slide.on, slide.along, slide.direction) + placement.angle(slide.on)
        xp = array_namespace([x for x in (arm, face, place, axis) if x is not None])
        toward = xp.arctan2(arm[1], arm[0]) if face is None else face
        if place is not None:
            line, x, y = place - centre, xp.cos(toward), xp.sin(toward)
            left = line[0] * y - line[1] * x >= 0
            distance = norm(line)
            numbers["pivot"] = xp.where(left, distance, -distance)
            held = point - place
            numbers["arm"] = norm(held) if face is None else held[0] * x + held[1] * y
            toward = xp.arctan2(line[1], line[0])
        elif axis is not None:
            axis = axis + xp.where(xp.cos(axis - toward) < 0, np.pi, 0.0)  # away from the cam
            numbers["eccentricity"] = arm[1] * xp.cos(axis) - arm[0] * xp.sin(axis)
            toward = axis
        numbers["start"] = toward - placement.angle(cam)
        return replace(profile, **{key: x for key, x in numbers.items() if getattr(profile, key) is None})

    def _carriers(self, layout: PinLayout) -> list[str]:
        """Return the links, or the ground, that meet the cam at its centre."""
        return [member for member in layout.members(self.pins[0]) if member != self._pair(layout)[0]]

    def _slide(self, layout: PinLayout) -> SlidingLink | None:
        """Return the slide of the follower on the link that carries the cam; None if there is no such slide."""
        pairs = [{carrier, self._pair(layout)[1]} for carrier in self._carriers(layout)]
        return next((slide for slide in layout.slides.values() if {slide.link, slide.on} in pairs), None)

    def _pivot(self, layout: PinLayout) -> str | None:
        """Return the pin about which the follower turns on the link that carries the cam; None unless there is exactly one."""
        found = [layout.centre(self._pair(layout)[1], carrier) for carrier in self._carriers(layout)]
        return found[0] if len(found) == 1 else None

    def _pair(self, layout: PinLayout) -> tuple[str, ...]:
        """Return the cam and the follower: `links`, by default the only moving link at each pin."""
        moving = [[member for member in layout.members(pin) if member != GROUND] for pin in self.pins]
        return self.links or tuple(members[0] for members in moving if len(members) == 1)
