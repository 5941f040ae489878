"""Marks of a pose as lines and circles in pixels, with y downwards, for an SVG, a DXF or the frame of a film.

These are the same symbols (symbols.py) as in the player, with the same colours and proportions.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.mark_places import to_ground
from udkjax.show.player.marks.marks import Mark
from udkjax.show.player.marks.symbols import Symbol, symbols_of

THEMES: dict[str, dict[str, Any]] = {
    "light": {
        "back": "#ffffff", "ink": "#1b2430", "soft": "#5a6676", "grid": "#edf0f4", "accent": "#0067b0", "tint": 0.74,
        "force": "#b3261e",
        "bodies": ["#0072b2", "#d55e00", "#009e73", "#c2559a", "#3a9bdc", "#b87a00", "#6b5bb5"],
    },
    "dark": {
        "back": "#11161d", "ink": "#e7ecf3", "soft": "#9aa7b8", "grid": "#1c232d", "accent": "#5cb3f2", "tint": 0.68,
        "force": "#ff8a80",
        "bodies": ["#4fb0ec", "#ff9055", "#3fcfa4", "#ea9fcb", "#93d2f6", "#f0bb4a", "#ab9cf2"],
    },
}  # fmt: skip
UNIT_PICTURE_SIDE = 420.0  # shorter side (px) of a picture in which the unit of symbols is one pixel
MARGIN = 44.0  # margin of a picture (px)
ARROW_LENGTH, LONGEST_ARROW = 70.0, 3.0  # arrow of the usual force in units of symbols; the longest arrow relative to this one
HEAD_LENGTH, HEAD_ANGLE, ARROW_WIDTH = 7.5, 0.42, 2.2  # head and width in units of symbols; half of the head's angle (rad)
NOT_UNIQUE_TINT = 0.5  # fraction of the background colour mixed into the colour of a force
STUCK_RING = 8.0, 3.5  # radius and width, in units of symbols, of the ring around a joint that sticks
TOUCHING_LAYER, TOUCHING_TINT = "touching", 0.5  # layer of links that touch; fraction of the background mixed into their colour
SOLID_MARKS = (MarkKind.LINK, MarkKind.DISC, MarkKind.WHEEL, MarkKind.OUTLINE, MarkKind.BLOCK)  # marks of the outlines of links
PATH_WIDTH, PATH_TINT = 1.2, 0.4  # width in units of symbols; fraction of the background colour mixed into the colour of a body


class TracedPath(NamedTuple):
    """The path of a point of a body, by the body's index: places (n, 2) on the ground (m)."""

    body: int
    points: Float[np.ndarray, "n 2"]


class ForceArrow(NamedTuple):
    """A force on a point (m) of a body, by its index: x and y relative to the usual force, and True if the force is unique."""

    body: int
    at: tuple[float, float]
    force: tuple[float, float]
    unique: bool


class View(NamedTuple):
    """A map from metres to pixels, (x + scale X, y - scale Y), for a picture of width x height px.

    `pt` is the unit of symbols (px).
    """

    scale: float
    x: float
    y: float
    width: int
    height: int
    pt: float


class Line(NamedTuple):
    """A line through points (px), open or closed, filled or not; its width (px) is zero if only its fill is drawn.

    Its layer is the kind of its mark, or another name; "" stands for no stroke or no fill.
    """

    layer: str
    points: np.ndarray
    width: float = 0.0
    stroke: str = ""
    fill: str = ""
    closed: bool = False


class Text(NamedTuple):
    """A line of text about its middle (px), turned anticlockwise by an angle (deg)."""

    layer: str
    place: np.ndarray
    words: str
    size: float
    colour: str
    angle: float = 0.0


class Circle(NamedTuple):
    """A circle (px), filled or not; its width is that of its stroke, and "" stands for no stroke or no fill."""

    layer: str
    centre: np.ndarray
    radius: float
    width: float = 0.0
    stroke: str = ""
    fill: str = ""


def view_of(bounds: Sequence[float], width: int, times: int = 1, has_arrows: bool = False) -> View:
    """Return the view of a picture, `width` px wide, that contains `bounds` (left, bottom, right, top in m), enlarged by `times`.

    With `has_arrows` the margin has room for the arrow of the usual force.
    """
    left, bottom, right, top = bounds
    margin = min(MARGIN + ARROW_LENGTH, 0.24 * width) if has_arrows else min(MARGIN, 0.12 * width)
    height = int(np.clip((width - 2 * margin) / (right - left) * (top - bottom) + 2 * margin, 0.25 * width, 1.25 * width))
    scale = times * min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom))
    pt = times * float(np.clip(min(width, height) / UNIT_PICTURE_SIDE, 0.75, 1.5))
    wide, high = times * width, times * height
    return View(scale, wide / 2 - scale * (left + right) / 2, high / 2 + scale * (bottom + top) / 2, wide, high, pt)


def mix(first: str, second: str, t: float) -> str:
    """Return a mixture of two colours, from the first (t = 0) to the second (t = 1)."""
    channels = [[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in (first, second)]
    return "#" + "".join(f"{round(a * (1 - t) + b * t):02x}" for a, b in zip(*channels, strict=True))


class Sketch:
    """The paths and symbols of a mechanism's marks at one pose as shapes in pixels, from back to front.

    Args:
        marks: marks of the mechanism.
        pose: coordinates of its bodies.
        view: view of the picture.
        theme: name of a theme in `THEMES`.
        paths: paths of traced points.
        arrows: arrows of joint forces.
        stuck: anchors [body, x, y] of joints that stick, which get a ring.
        touching: outlines {body, points, radius} of parts of links that touch others.
    """

    def __init__(
        self,
        marks: Sequence[Mark],
        pose: Float[np.ndarray, "bodies 3"],
        view: View,
        theme: str = "light",
        paths: Sequence[TracedPath] = (),
        arrows: Sequence[ForceArrow] = (),
        stuck: Sequence[Sequence[float]] = (),
        touching: Sequence[JsonObject] = (),
    ):
        self.pose, self.view, self.theme = pose, view, THEMES[theme]
        symbols = symbols_of(marks, view.pt / view.scale)
        self.shapes: list[Line | Circle | Text] = [*map(self._path, paths), *map(self._shape, symbols)]
        last = max((k for k, shape in enumerate(self.shapes) if shape.layer in SOLID_MARKS), default=-1)
        self.shapes[last + 1 : last + 1] = map(self._touching, touching)  # over the links, and below their pins
        for body, x, y in stuck:
            ring = self.anchor(body, x, y), STUCK_RING[0] * view.pt, STUCK_RING[1] * view.pt, self.theme["force"]
            self.shapes.append(Circle("sticking", *ring))
        for arrow in arrows:
            self.shapes += self._arrow(arrow)

    def _path(self, path: TracedPath) -> Line:
        points = np.array([self.view.x, self.view.y]) + self.view.scale * path.points * [1, -1]
        colour = mix(self._colour(f"edge:{path.body}"), self.theme["back"], PATH_TINT)
        return Line("path", points, PATH_WIDTH * self.view.pt, colour)

    def _touching(self, part: JsonObject) -> Line | Circle:
        """Return the outline of a part of a link that touches another one."""
        colour, radius = mix(self.theme["force"], self.theme["back"], TOUCHING_TINT), self.view.scale * part["radius"]
        places = np.array([self.anchor(part["body"], *point) for point in part["points"]])
        if len(places) == 1:
            return Circle(TOUCHING_LAYER, places[0], radius, fill=colour)
        is_area = len(places) > 2
        return Line(TOUCHING_LAYER, places, 2 * radius, colour, colour if is_area else "", closed=is_area)

    def _arrow(self, arrow: ForceArrow) -> list[Line]:
        """Return the shaft and the head of an arrow; [] if it is too short to be seen."""
        force, pt = np.array(arrow.force), self.view.pt
        size = float(np.hypot(*force))
        length = ARROW_LENGTH * pt * min(size, LONGEST_ARROW)
        if length <= HEAD_LENGTH * pt:
            return []
        direction, start = force / size * [1, -1], self.anchor(arrow.body, *arrow.at)
        tip, side = start + length * direction, np.array([-direction[1], direction[0]])
        back = tip - HEAD_LENGTH * pt * np.cos(HEAD_ANGLE) * direction
        colour = mix(self.theme["force"], self.theme["back"], 0.0 if arrow.unique else NOT_UNIQUE_TINT)
        wing = HEAD_LENGTH * pt * np.sin(HEAD_ANGLE) * side
        shaft = Line("reaction", np.array([start, back]), ARROW_WIDTH * pt, colour)
        return [shaft, Line("reaction", np.array([tip, back + wing, back - wing]), fill=colour, closed=True)]

    def _shape(self, symbol: Symbol) -> Line | Circle:
        look = symbol["width"] * self.view.pt, self._colour(symbol["stroke"]), self._colour(symbol["fill"])
        origin, axis, scale = self._frame(symbol["frame"])
        if "radius" in symbol:
            metres, units, least = symbol["radius"]
            radius = max(self.view.scale * metres + self.view.pt * units, self.view.pt * least)
            return Circle(symbol["layer"], origin, radius, *look)
        points = np.array(symbol["points"], float)
        local = scale * points[:, :2] + (self.view.pt * points[:, 2:] if points.shape[1] > 2 else 0.0)
        return Line(symbol["layer"], origin + local @ np.array([axis * [1, -1], -axis[::-1]]), *look, symbol["closed"])

    def _frame(self, frame: list) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the origin of a frame (px), the cosine and sine of the angle of its x axis, and its unit of length (px)."""
        if len(frame) == 2:
            start, end = (self.anchor(*anchor) for anchor in frame)
            axis = (end - start) * [1, -1]
            length = float(np.hypot(*axis))
            return start, axis / (length or 1.0), length
        body, x, y, angle, turns = frame
        angle += self.pose[body][2] if turns and body >= 0 else 0.0
        return self.anchor(body, x, y), np.array([np.cos(angle), np.sin(angle)]), self.view.scale

    def anchor(self, body: float, x: float, y: float) -> np.ndarray:
        """Return the place (px) of a point (m) of a body, given by its index; -1 is the ground."""
        place = to_ground((x, y), (np.zeros(3) if body < 0 else self.pose[int(body)])[None])[0]
        return np.array([self.view.x, self.view.y]) + self.view.scale * place * [1, -1]

    def _colour(self, name: str) -> str:
        kind, _, body = name.partition(":")
        if not body:
            return self.theme[name] if name else ""
        edge = self.theme["soft"] if int(body) < 0 else self.theme["bodies"][int(body) % len(self.theme["bodies"])]
        tint = mix(edge, self.theme["back"], self.theme["tint"])
        return {"edge": edge, "tint": tint, "spoke": mix(edge, tint, 0.25)}[kind]
