"""Places for texts in a picture, chosen one after another, so that each covers least of earlier texts and of lines."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from udkjax.segments import distances_from_segments

T = TypeVar("T")
PagePoint = Float[np.ndarray, "2"]
Box = tuple[PagePoint, PagePoint, PagePoint]  # middle, and half of two sides that are at right angles
Segment = tuple[PagePoint, PagePoint]

LETTER_WIDTH = 0.58  # usual width of a letter, relative to its height
TEXT_SAMPLES = 9  # places of a text that are tested
# A pin: shift, and share to the left.
PLACES_AROUND_PIN = [[9, -12, 0], [9, 14, 0], [-9, -12, 1], [-9, 14, 1], [0, -20, 0.5], [0, 22, 0.5]]
OUTSIDE_COST, ON_TEXT_COST, ON_LINE_COST = 4.0, 2.0, 1.0  # costs of a tested place outside the picture, on other texts, on lines


class TextPlaces:
    """The texts placed in a picture so far, and the lines of the picture.

    Args:
        width: width of the picture, in any unit of length; coordinates begin at zero.
        height: height of the picture, in the same unit as all further lengths.
        size: height of letters.
        boxes: boxes that texts keep clear.
        lines: lines, from a start to an end, that texts keep clear.
    """

    def __init__(self, width: float, height: float, size: float, boxes: Sequence[Box] = (), lines: Sequence[Segment] = ()):
        self.limits, self.size = np.array([width, height]), size
        self.boxes, self.lines = list(boxes), list(lines)

    def width(self, words: str) -> float:
        """Return the usual width of a text."""
        return LETTER_WIDTH * self.size * len(words)

    def level(self, middle: PagePoint, words: str) -> Box:
        """Return the box of a text that is written along x around a middle."""
        return middle, np.array([self.width(words) / 2, 0.0]), np.array([0.0, self.size / 2])

    def cheapest(
        self,
        choices: Sequence[T],
        box: Callable[[T], Box],
        own: Segment | None = None,
        more: Callable[[T], Sequence[PagePoint]] = lambda _: (),
    ) -> T:
        """Return the choice whose text covers least; of several such choices, the first.

        Args:
            choices: choices, the best first.
            box: function that returns the box of the text of a choice.
            own: a line that the text may cover; None if there is none.
            more: function that returns further points of a choice that should lie within the picture.
        """
        costs = [self._cost(box(choice), own, more(choice)) for choice in choices]
        return choices[int(np.argmin(costs))]

    def put(self, choices: Sequence[PagePoint], words: str) -> PagePoint:
        """Return the middle, of several choices, at which a text along x covers least, and keep its box clear of later texts."""
        found = self.cheapest(choices, lambda middle: self.level(middle, words))
        self.boxes.append(self.level(found, words))
        return found

    def put_around(self, place: PagePoint, words: str, unit: float = 1.0) -> PagePoint:
        """Return the middle of the name of a pin, near the pin, and keep the name's box clear of later texts.

        Args:
            place: the pin.
            words: the name.
            unit: unit of the shifts in `PLACES_AROUND_PIN`, in the unit of the picture.
        """
        wide = self.width(words)
        shifts = [((0.5 - share) * wide + dx * unit, dy * unit) for dx, dy, share in PLACES_AROUND_PIN]
        return self.put([place + np.array(shift) for shift in shifts], words)

    def _cost(self, box: Box, own: Segment | None, more: Sequence[PagePoint]) -> float:
        middle, u, v = box
        places = middle + np.array([s * u + t * v for s in np.linspace(-1, 1, TEXT_SAMPLES) for t in (-1, 0, 1)])
        outside = np.any((places < 0) | (places > self.limits), axis=1).sum()
        cost = OUTSIDE_COST * float(outside + sum(np.any((p < 0) | (p > self.limits)) for p in more))
        for other, a, b in self.boxes:
            d = places - other
            cost += ON_TEXT_COST * float(np.sum((np.abs(d @ a) <= a @ a) & (np.abs(d @ b) <= b @ b)))
        for line in self.lines:
            if own is None or (line is not own and not all(np.allclose(x, y) for x, y in zip(line, own, strict=True))):
                cost += ON_LINE_COST * float(np.sum(distances_from_segments(places, *np.array(line)[:, None]) < self.size / 2))
        return cost
