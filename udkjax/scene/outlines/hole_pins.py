"""Pins of links at the round holes of their outlines: those of the drawing by position, and new ones at other holes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from udkjax.printing import format_number
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.outlines.outline import Outline, RoundHole
from udkjax.wording import quote

# Relative to a hole's radius: a pin that is nearer to its centre, or a difference of diameters that is smaller, fits the hole.
HOLE_TOL = 1e-3


class HolePins:
    """The pins of a drawing, found by their positions, and the pins that are added at holes.

    Args:
        pins: the table of pins of the scene; those by coordinates have known places.
        units: the units of the scene.
    """

    def __init__(self, pins: Mapping[str, Any], units: Units):
        self.pins, self._units = dict(pins), units
        read = {name: units.convert(f"pins.{name}", given, "m", []) for name, given in pins.items() if isinstance(given, list)}
        self._places = {name: np.array(x, float) for name, x in read.items() if isinstance(x, list) and len(x) == 2}
        self._unknown = [name for name in pins if name not in self._places]

    def of_link(self, name: str, outline: Outline, diameter: float | None, problems: list[str]) -> list[str]:
        """Return the names of the pins at the round holes of a link, from left to right; a hole without a pin gets a new one.

        Args:
            name: the name of the link, with which names of new pins begin.
            outline: its outline.
            diameter: diameter of the holes with pins (m); None for all round holes.
            problems: mistakes are added.
        """
        holes = [x for x in outline.circles if diameter is None or abs(2 * x.radius - diameter) <= HOLE_TOL * diameter]
        if not holes:
            sizes = ", ".join(dict.fromkeys(self._units.text(2 * x.radius, "m") for x in outline.circles))
            wanted = (
                "" if diameter is None else f" of diameter {self._units.text(diameter, 'm')}; there are holes of {sizes or 'no'}"
            )
            problems.append(f"no round hole for a pin{wanted}")
        found = [self._at(hole, problems) for hole in holes]
        if None in found and self._unknown:
            problems.append(
                f"pins at holes are found by coordinates, which {self._unknown[0]} has not: name the pins of the link"
            )
        for k, (pin, hole) in enumerate(zip(found, holes, strict=True)):
            if pin is None:
                found[k] = self._added(f"{name}{k + 1}", hole)
        return [pin for pin in found if pin is not None]

    def _at(self, hole: RoundHole, problems: list[str]) -> str | None:
        """Return the name of the pin in a hole; None if the hole has no pin."""
        for name, place in self._places.items():
            off = float(np.hypot(*(place - hole.centre)))
            if off < hole.radius:
                if off > HOLE_TOL * hole.radius:
                    x, y = (format_number(x / self._units.size("m")) for x in hole.centre)
                    off_text, unit = self._units.text(off, "m"), self._units.shown("m")
                    problems.append(
                        f"pin {quote(name)} is {off_text} off the centre of its hole, [{x}, {y}] {unit}: move one of them"
                    )
                return name
        return None

    def _added(self, name: str, hole: RoundHole) -> str:
        while name in self.pins:
            name += "_"
        self._places[name] = np.asarray(hole.centre, float)
        self.pins[name] = [self._units.write(float(x), "m") for x in hole.centre]
        return name


def names_of_links(links: Sequence[Any]) -> list[str]:
    """Return the names of links in the order of a scene, "link1", ... for links without one; "" for an entry that is no table."""
    return [str(link.get("name") or f"link{k + 1}") if isinstance(link, Mapping) else "" for k, link in enumerate(links)]
