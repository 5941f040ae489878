"""Names of points and lengths of links, written into pictures where they cover least."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.marks import Mark
from udkjax.show.player.marks.sketch import Line, Sketch, Text
from udkjax.text_places import Box, TextPlaces

Anchor = tuple[int, float, float]  # a place of a body, by its index; -1 is the ground
Pixels = Float[np.ndarray, "2"]

LETTER_HEIGHT = 12.0  # height of letters; all lengths are in units of symbols
PIN_CLEARANCE = 7.0  # half of the side of the square around a pin that texts keep clear
DIMENSION_LEVELS = (17.0, 31.0, 45.0)  # distances from a link to its dimension line, the best first
TEXT_OFFSET = 8.0  # distance from a dimension line to the middle of its text
ARROW_LENGTH, ARROW_WIDTH = 7.0, 2.0  # length and half of the width of an arrow
EXTENSION_GAP, EXTENSION_BEYOND = 6.0, 4.0  # of an extension line: from the point, and beyond the dimension line


class LinkDimension(NamedTuple):
    """The text of a length, and the two points between which it is measured."""

    words: str
    start: Anchor
    end: Anchor


class PictureLabels(NamedTuple):
    """The places of points by the names to be written there, and the lengths of links to be drawn as dimensions."""

    names: dict[str, Anchor]
    dimensions: list[LinkDimension]


def labels_of(mechanism: Mechanism, marks: Sequence[Mark]) -> PictureLabels:
    """Return the names of a mechanism's points, and the lengths of its links in the units of its drawing.

    Without a drawing, these are the names of pins alone.
    """
    drawing = mechanism.drawing
    if drawing is None:
        pins = [mark for mark in marks if mark["kind"] == MarkKind.PIN]
        return PictureLabels({mark["name"]: (mark["body"], *mark["at"]) for mark in pins}, [])
    names: dict[str, Anchor] = {}
    for name in drawing.groups["pin"]:
        body, place = drawing.locate_pin(name)  # pyright: ignore[reportGeneralTypeIssues]
        x, y = np.asarray(place, float).tolist()
        names[name] = (mechanism.body_names.index(body) if body in mechanism.body_names else -1, x, y)
    found: dict[frozenset[str], LinkDimension] = {}
    for (a, b), words in drawing.dimensions().items():
        found.setdefault(frozenset((a, b)), LinkDimension(words, names[a], names[b]))
    return PictureLabels(names, list(found.values()))


class PlacedDimension(NamedTuple):
    """A dimension in a picture: its text, its two points (px), and the distance of its line to their left (px).

    A negative distance is to the right of the way from the first point to the second.
    """

    words: str
    start: Pixels
    end: Pixels
    off: float


class Placing:
    """The names and dimensions of a picture, placed one after another, each where it covers least of the others and of the links.

    Args:
        labels: names of points and lengths of links.
        sketch: the sketch of the pose in the picture.
    """

    def __init__(self, labels: PictureLabels, sketch: Sketch):
        self.sketch, self.pt = sketch, sketch.view.pt
        self.size = LETTER_HEIGHT * self.pt
        self.points = {name: sketch.anchor(*anchor) for name, anchor in labels.names.items()}
        ends = [(d.words, sketch.anchor(*d.start), sketch.anchor(*d.end)) for d in labels.dimensions]
        pins = [(place, *(PIN_CLEARANCE * self.pt * np.eye(2))) for place in self.points.values()]
        bars = [(start, end) for _, start, end in ends]
        self.texts = TextPlaces(sketch.view.width, sketch.view.height, self.size, pins, bars)
        self.dimensions = [
            self._dimension(*entry) for entry in ends if np.hypot(*(entry[2] - entry[1])) > 2 * PIN_CLEARANCE * self.pt
        ]
        self.names = [self._name(name, place) for name, place in self.points.items()]

    def shapes(self) -> list[Line | Text]:
        """Return the lines of dimensions, and the texts above them."""
        found = [shape for dimension in self.dimensions for shape in self._lines(dimension)]
        return [*(s for s in found if isinstance(s, Line)), *(s for s in found if isinstance(s, Text)), *self.names]

    def _dimension(self, words: str, start: Pixels, end: Pixels) -> PlacedDimension:
        along = (end - start) / np.hypot(*(end - start))
        left = np.array([along[1], -along[0]])
        middle, own = (start + end) / 2, (start, end)
        inwards = np.mean([*self.points.values(), middle], axis=0) - middle
        sides = (-1.0, 1.0) if inwards @ left > 0 else (1.0, -1.0)
        half = (self.texts.width(words) / 2 * along, self.size / 2 * left)

        def box(off: float) -> Box:
            return middle + (off + np.sign(off) * TEXT_OFFSET * self.pt) * left, *half

        offs = [side * level * self.pt for level in DIMENSION_LEVELS for side in sides]
        off = self.texts.cheapest(offs, box, own, lambda off: [start + off * left, end + off * left])
        self.texts.boxes.append(box(off))
        self.texts.lines.append((start + off * left, end + off * left))
        return PlacedDimension(words, start, end, off)

    def _name(self, name: str, place: Pixels) -> Text:
        found = self.texts.put_around(place, name, self.pt)
        return Text("name", found, name, self.size, self.sketch.theme["ink"])

    def _lines(self, dimension: PlacedDimension) -> list[Line | Text]:
        words, start, end, off = dimension
        pt, colour = self.pt, self.sketch.theme["soft"]
        length = float(np.hypot(*(end - start)))
        along, side = (end - start) / length, np.sign(off)
        left = np.array([along[1], -along[0]])
        a, b = start + off * left, end + off * left
        found: list[Line | Text] = [Line("dimension", np.array([a, b]), 0.9 * pt, colour)]
        for foot, tip, inwards in ((start, a, along), (end, b, -along)):
            reach = np.array([foot + side * EXTENSION_GAP * pt * left, tip + side * EXTENSION_BEYOND * pt * left])
            head = min(ARROW_LENGTH * pt, length / 4)
            corners = [tip, *(tip + head * inwards + s * head * ARROW_WIDTH / ARROW_LENGTH * left for s in (1, -1))]
            found += [Line("dimension", reach, 0.7 * pt, colour)]
            found += [Line("dimension", np.array(corners), 0.0, "", colour, True)]
        place = (a + b) / 2 + side * TEXT_OFFSET * pt * left
        angle = float(np.degrees(np.arctan2(-along[1], along[0])))
        upright = angle if -90.0 < round(angle, 6) <= 90.0 else angle - 180.0 * np.sign(angle)
        return [*found, Text("dimension", place, words, self.size, colour, upright)]
