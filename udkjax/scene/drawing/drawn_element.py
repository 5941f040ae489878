"""An element of a drawing besides pins and links: what each of them has to say.

It is attached to pins and links by name, and becomes a joint, a driver or a force element of the mechanism when the drawing is
made one: `parts`, whose numbers are NumPy's or traced. Motions, and free angles of springs, count from the drawn position.
"""

from abc import abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

from udkjax.printing import PrintsLine
from udkjax.scene.checks import quote
from udkjax.scene.drawing.placement import PinLayout, Placement
from udkjax.scene.drivers import Driver
from udkjax.scene.fields import (
    Number,
)
from udkjax.scene.forces import ForceElement
from udkjax.scene.joints import Joint


class Parts(NamedTuple):
    """Parts of the mechanism that an element of a drawing becomes, under its own name."""

    joint: Joint | None = None
    driver: Driver | None = None
    force: ForceElement | None = None


class DrawnElement(PrintsLine):
    """An element of a drawing besides pins and links."""

    @abstractmethod
    def mistakes(self, layout: PinLayout) -> Iterator[str]:
        """Iterate over what is wrong with it in a layout, each a key and a text; all names are known."""

    @abstractmethod
    def parts(self, placement: Placement) -> Parts:
        """Return what it becomes in the mechanism."""

    @property
    def measured_as(self) -> str:
        """The name of the class whose numbers are measured in the same units."""
        return type(self).__name__

    @property
    def anchors(self) -> tuple[str, ...]:
        """The pins that it needs, which may then be on the ground without a link."""
        return ()


def line_mistakes(along: tuple[str, ...], direction: Number | None) -> Iterator[str]:
    """Iterate over what is wrong with a line, which two pins or a direction give."""
    if bool(along) == (direction is not None):
        yield "along: give two pins, or a direction"
    elif along and (len(along) != 2 or along[0] == along[1]):
        yield "along: must name two pins"


def pair_mistakes(layout: PinLayout, pin: str, of: tuple[str, ...]) -> Iterator[str]:
    """Iterate over what is wrong with an element between two links that meet at a pin."""
    members = layout.members(pin)
    listed = ", ".join(members) or "none"
    if not of and len(members) != 2:
        yield f"pin: at {quote(pin)} there must meet two links, or one and the ground; there are {listed}" + (
            "; say which two, such as of = [" + ", ".join(map(quote, members[:2])) + "]" if len(members) > 2 else ""
        )
    elif of and (len(of) != 2 or of[0] == of[1]):
        yield "of: must name two links"
    else:
        yield from (
            f"of: {quote(name)} is not at pin {quote(pin)}, where there are {listed}" for name in of if name not in members
        )
