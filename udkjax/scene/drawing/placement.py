"""Pins of a drawing, their positions, and the links that meet at them, to which other elements are attached."""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import array_namespace, by_numpy
from udkjax.printing import PrintsLine
from udkjax.scene.drawing.link import DrawnBody, Link
from udkjax.scene.drawing.pin_forms import PointArray, norm
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Frame
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.joints import Joint
from udkjax.wording import quote


class SlidingLink(Protocol):
    """A slide: a link, and its line on another link, given by two pins or a direction (rad)."""

    link: str
    on: str
    along: tuple[str, ...]
    direction: Array | None


class PinLayout:
    """The connections of a drawing: its links, its fixed pins and its slides, and the names of the links that meet at a pin."""

    def __init__(self, links: Mapping[str, Link], ground: Sequence[str], slides: Mapping[str, SlidingLink]):
        self.links, self.ground, self.slides = links, ground, slides

    def members(self, pin: str) -> tuple[str, ...]:
        """Return the ground, if the pin is fixed, and the links that share the pin, in order."""
        fixed = (GROUND,) if pin in self.ground else ()
        return (*fixed, *(name for name, link in self.links.items() if pin in link.pins))

    def pair(self, pin: str, of: Sequence[str]) -> tuple[str, ...]:
        """Return the two members of a pin between which an element acts: `of`, by default the only two."""
        return tuple(of) or self.members(pin)

    def ends(self, between: Sequence[str]) -> tuple[str, ...]:
        """Return the first member of each of two pins: a force at a pin has the same effect on whichever link it acts."""
        return tuple(self.members(pin)[0] for pin in between)

    def centre(self, wheel: str, carrier: str) -> str | None:
        """Return the pin about which a wheel turns on its carrier; None unless there is exactly one such pin."""
        pins = self.ground if wheel == GROUND else self.links[wheel].pins if wheel in self.links else ()
        shared = [pin for pin in pins if carrier in self.members(pin)]
        return shared[0] if len(shared) == 1 else None


class Placement(PinLayout):
    """A layout with the positions of its pins (m) and links, and the frames of bodies that are not drawn."""

    def __init__(
        self, layout: PinLayout, places: Mapping[str, PointArray], drawn: Mapping[str, DrawnBody], frames: Mapping[str, Frame]
    ):
        super().__init__(layout.links, layout.ground, layout.slides)
        self.places, self.drawn = places, drawn
        self._frames = {GROUND: GROUND_FRAME} | {name: body.frame for name, body in drawn.items()} | dict(frames)

    def angle(self, body: str) -> Number:
        """Return the angle of a body (rad)."""
        return self._frames[body].angle

    def angle_between(self, body1: str, body2: str) -> Number:
        """Return the angle of body 2 relative to body 1 (rad)."""
        return self.angle(body2) - self.angle(body1)

    def local(self, body: str, position: PointArray) -> Float[Array, "2"]:
        """Transform a position (m) from world coordinates to the frame of a body."""
        frame = self._frames[body]
        x, y = frame.local((position[0] - frame.x, position[1] - frame.y))
        return array_namespace(x, y).stack([x, y])

    def points(self, bodies: Sequence[str], places: Sequence[PointArray]) -> Float[Array, "2 2"]:
        """Return two positions, each in the frame of its body (m)."""
        positions = [self.local(body, position) for body, position in zip(bodies, places, strict=True)]
        return array_namespace(*positions).stack(positions)

    def distance(self, pin1: str, pin2: str) -> Number:
        """Return the distance between two pins (m)."""
        return norm(self.places[pin2] - self.places[pin1])

    def direction(self, on: str, along: Sequence[str], direction: Number | None) -> Number:
        """Return the direction of a line in the frame of a body (rad), given by two pins or by its angle in world coordinates."""
        if along:
            line = self.places[along[1]] - self.places[along[0]]
            direction = array_namespace(line).arctan2(line[1], line[0])
        assert direction is not None  # given, because `along` is not
        angle: Number = by_numpy(direction)
        return angle if on == GROUND else angle - self.angle(on)

    def guide(self, slide: SlidingLink) -> tuple[tuple[str, str], Float[Array, "2 2"], Number]:
        """Return the two links of a slide, its points in their frames (m), and its direction in the frame of the first (rad)."""
        pair, position = (slide.on, slide.link), self.places[self.links[slide.link].pins[0]]
        return pair, self.points(pair, (position, position)), self.direction(slide.on, slide.along, slide.direction)


class Parts(NamedTuple):
    """The joint, driver or force element that an element of a drawing becomes, under the same name."""

    joint: Joint | None = None
    driver: Driver | None = None
    force: ForceElement | None = None


class DrawnElement(PrintsLine):
    """An element of a drawing other than pins and links, attached to these by name.

    In the mechanism it becomes a joint, a driver or a force element: its `parts`, with NumPy or traced numbers. Motions, and free
    angles of springs, are relative to the drawn position.
    """

    @abstractmethod
    def mistakes(self, layout: PinLayout) -> Iterator[str]:
        """Iterate over the element's mistakes in a layout, each with its key ("key: message"); all names exist."""

    @abstractmethod
    def parts(self, placement: Placement) -> Parts:
        """Return the joint, driver or force element of the mechanism that the element becomes."""

    @property
    def measured_as(self) -> str:
        """The name of the class under which the units of the element's numbers are listed."""
        return type(self).__name__

    @property
    def anchors(self) -> tuple[str, ...]:
        """The pins that the element needs as points; if they are fixed to the ground, they may have no link. Empty by default."""
        return ()


def line_mistakes(along: tuple[str, ...], direction: Number | None) -> Iterator[str]:
    """Iterate over the mistakes in a line given by two pins or a direction."""
    if bool(along) == (direction is not None):
        yield "along: give two pins, or a direction"
    elif along and (len(along) != 2 or along[0] == along[1]):
        yield "along: must name two pins"


def pair_mistakes(layout: PinLayout, pin: str, of: tuple[str, ...]) -> Iterator[str]:
    """Iterate over the mistakes in an element between two links that meet at a pin."""
    members = layout.members(pin)
    listed = ", ".join(members) or "none"
    if not of and len(members) != 2:
        yield f"pin: {quote(pin)} must join two links, or a link and the ground; it joins {listed}" + (
            "; say which two, such as of = [" + ", ".join(map(quote, members[:2])) + "]" if len(members) > 2 else ""
        )
    elif of and (len(of) != 2 or of[0] == of[1]):
        yield "of: must name two links"
    else:
        yield from (
            f"of: {quote(name)} is not at pin {quote(pin)}, where there are {listed}" for name in of if name not in members
        )
