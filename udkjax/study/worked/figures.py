"""Figures of worked solutions as SVG: the drawing with its dimensions, and polygons of velocities and accelerations to scale."""

from collections.abc import Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.study.worked.loops import Geometry
from udkjax.study.worked.terms import NumberStyle
from udkjax.text_places import TextPlaces

FIGURE_WIDTH, MARGIN = 560.0, 46.0  # of a figure, in its units
MOST_HEIGHT = 460.0
HEAD_LENGTH = 9.0  # length of an arrow's head
NICE_FACTORS = (1.0, 2.0, 5.0)  # times a power of ten: the scales of polygons
PER_CM = 37.8  # units of a figure in a centimetre
LETTER_HEIGHT, BASELINE = 13.0, 4.5  # height of letters, and the baseline below their middle
TEXT_CLEARANCE, PIN_CLEARANCE = 4.0, 6.0  # from a line to its text, and around a pin
EXTRA_DISTANCES = 0.0, 14.0, 28.0  # farther from the line, where there is no room next to it
TEXT_SHARES = 0.5, 0.35, 0.65, 0.2, 0.8  # places of a text along a line


class PolygonSide(NamedTuple):
    """An arrow of a polygon, from one point to another, with its name.

    Attributes:
        start, end: ends of the arrow (m/s or m/s^2).
        name: name of the arrow: a letter, and the index after an underscore.
        kind: "pole" from the pole to a pin, "relative" between two pins.
    """

    start: np.ndarray
    end: np.ndarray
    name: str
    kind: str


class _Frame:
    """The map from coordinates to the units of a figure, with the same scale along both axes; y points up.

    `scale` is the ratio of lengths in the figure to lengths in coordinates; by default, the points fill the figure.
    """

    def __init__(self, points: Sequence[np.ndarray], scale: float | None = None):
        low, high = np.min(points, axis=0), np.max(points, axis=0)
        size = np.maximum(high - low, 1e-300)
        self.scale = scale or float(min((FIGURE_WIDTH - 2 * MARGIN) / size[0], (MOST_HEIGHT - 2 * MARGIN) / size[1]))
        self.width, self.height = np.maximum(self.scale * (high - low) + 2 * MARGIN, 160.0)
        self.low, self.middle = low, 0.5 * (low + high)

    def at(self, point: np.ndarray) -> tuple[float, float]:
        x, y = self.scale * (np.asarray(point) - self.middle)
        return float(0.5 * self.width + x), float(0.5 * self.height - y)

    def texts(self) -> TextPlaces:
        return TextPlaces(float(self.width), float(self.height), LETTER_HEIGHT)

    def svg(self, parts: Sequence[str], title: str) -> str:
        box = f"0 0 {self.width:.1f} {self.height:.1f}"
        inner = "".join(parts)
        return f'<svg viewBox="{box}" role="img" aria-label="{escape(title)}" xmlns="http://www.w3.org/2000/svg">{inner}</svg>'


def drawing_figure(geometry: Geometry, style: NumberStyle, names: bool = True) -> str:
    """Return an SVG of the drawing in its position: links, slots, pins with their names and, if `names`, the lengths of bars."""
    drawing, places = geometry.drawing, _all_places(geometry)
    frame, parts = _Frame(list(places.values())), []
    for start, way, _ in geometry.lines.values():
        middle, along = geometry.places[start], np.array([np.cos(way), np.sin(way)])
        ends = [middle + s * 0.6 * geometry.extent * along for s in (-0.3, 1.6)]
        parts.append(_line(frame, ends[0], ends[1], "guide"))
    texts = frame.texts()
    of_pins = {pin: np.array(frame.at(place)) for pin, place in places.items()}
    texts.boxes += [(place, *(PIN_CLEARANCE * np.eye(2))) for place in of_pins.values()]
    texts.boxes += [(of_pins[pin] + [0.0, 8.0], *(8.0 * np.eye(2))) for pin in drawing.ground if pin in of_pins]
    pairs = dict.fromkeys(pair for link in drawing.links.values() for pair in link.sides if places.keys() >= set(pair))
    sides = [(a, b) for a, b in pairs if np.any(places[b] - places[a])]
    texts.lines += [(of_pins[a], of_pins[b]) for a, b in sides]
    labels = []
    for link in drawing.links.values():
        corners = [places[pin] for pin in link.pins if pin in places]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(frame.at, corners))
        tag, kind = ("polygon", "link plate") if link.kind == "plate" else ("polyline", "link")
        parts.append(f'<{tag} points="{path}" class="{kind}"/>' if len(corners) > 1 else "")
    for a, b in sides if names else []:
        words = style.number(float(np.hypot(*(places[b] - places[a]))), "m")
        labels.append(_text(_beside(texts, of_pins[a], of_pins[b], words), words))
    for pin, place in places.items():
        x, y = frame.at(place)
        fixed = pin in drawing.ground
        parts.append(f'<path d="M{x:.1f},{y:.1f}l-8,13h16z" class="fixed"/>' if fixed else "")
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" class="pin"/>')
        labels.append(_text(texts.put_around(of_pins[pin], pin), escape(pin)))
    return frame.svg([*parts, *labels], "the drawing in this position")


def _all_places(geometry: Geometry) -> dict[str, np.ndarray]:
    """Return the places of all pins of links, in the position of the geometry."""
    found = dict(geometry.places)
    for pin in geometry.drawing.pins:
        located = geometry.drawing.locate_pin(pin)
        if pin in found or located is None or (located[0] == GROUND and pin not in geometry.drawing.ground):
            continue
        x, y, angle = geometry.frames[located[0]]
        (px, py), c, s = np.asarray(located[1]), np.cos(angle), np.sin(angle)
        found[pin] = np.array([x + c * px - s * py, y + s * px + c * py])
    return found


def polygon_figure(sides: Sequence[PolygonSide], style: NumberStyle, unit: str, title: str) -> str:
    """Return a polygon to scale as HTML, with a caption that names the scale; a sentence if all arrows are zero."""
    points = [np.zeros(2), *(x for side in sides for x in (side.start, side.end))]
    size = float(np.max(np.ptp(points, axis=0)))
    if size == 0.0:
        return f"<p>{escape(title)}: all are zero.</p>"
    fits = _Frame(points).scale
    shown = style.size(unit)
    per_cm = PER_CM / fits / shown  # of the shown unit
    power = 10.0 ** np.floor(np.log10(per_cm))
    nice = next((k * power for k in NICE_FACTORS if k * power >= per_cm * (1 - 1e-9)), 10 * power)
    frame = _Frame(points, PER_CM / (nice * shown))
    texts, pole = frame.texts(), np.array(frame.at(np.zeros(2)))
    texts.lines += [(np.array(frame.at(side.start)), np.array(frame.at(side.end))) for side in sides]
    texts.boxes.append((pole, *(PIN_CLEARANCE * np.eye(2))))
    parts = [_arrow(frame, side, texts) for side in sides]
    parts.append(f'<circle cx="{pole[0]:.1f}" cy="{pole[1]:.1f}" r="3" class="pin"/>{_text(texts.put_around(pole, "o"), "o")}')
    caption = f"{title}; 1 cm is {nice:g} {style.unit(unit)}"
    svg = frame.svg(parts, title).replace("<svg ", f'<svg style="width:{frame.width / PER_CM:.2f}cm" ', 1)
    return f'<figure class="scaled">{svg}<figcaption>{escape(caption)}.</figcaption></figure>'


def _line(frame: _Frame, start: np.ndarray, end: np.ndarray, kind: str) -> str:
    (x1, y1), (x2, y2) = frame.at(start), frame.at(end)
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" class="{kind}"/>'


def _beside(texts: TextPlaces, start: np.ndarray, end: np.ndarray, words: str) -> np.ndarray:
    """Return the place of the middle of a text beside a line, where there is room."""
    way = end - start
    across = np.array([way[1], -way[0]]) / np.hypot(*way)
    off = TEXT_CLEARANCE + 0.5 * (texts.width(words) * abs(across[0]) + LETTER_HEIGHT * abs(across[1]))
    offs = [side * (off + far) for far in EXTRA_DISTANCES for side in (1, -1)]
    return texts.put([start + share * way + x * across for x in offs for share in TEXT_SHARES], words)


def _text(middle: np.ndarray, words: str) -> str:
    return f'<text x="{middle[0]:.1f}" y="{middle[1] + BASELINE:.1f}" text-anchor="middle">{words}</text>'


def _arrow(frame: _Frame, side: PolygonSide, texts: TextPlaces) -> str:
    (x1, y1), (x2, y2) = frame.at(side.start), frame.at(side.end)
    way = np.array([x2 - x1, y2 - y1])
    length = float(np.hypot(*way))
    if length < 1.0:
        return ""
    unit = way / length
    across, base = np.array([-unit[1], unit[0]]), np.array([x2, y2]) - min(HEAD_LENGTH, 0.5 * length) * unit
    corners = [np.array([x2, y2]), base + 3.2 * across, base - 3.2 * across]
    head = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
    letter, _, index = side.name.partition("_")
    label = f'{escape(letter)}<tspan dy="4" font-size="10">{escape(index)}</tspan>'
    middle = _beside(texts, np.array([x1, y1]), np.array([x2, y2]), letter + index)
    name = _text(middle - [0.0, 2.0], label)  # the index is lower
    line = f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{base[0]:.1f}" y2="{base[1]:.1f}" class="{side.kind}"/>'
    return f'{line}<polygon points="{head}" class="{side.kind}"/>{name}'
