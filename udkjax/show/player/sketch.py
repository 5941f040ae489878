"""Marks at a pose as lines and circles, in pixels, y downwards: what an SVG, a DXF or the frame of a film is made of.

It draws what `MarkPainter` in marks.js draws, in the same colours and proportions.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from udkjax.show.player.marks import Mark, to_ground

THEMES: dict[str, dict[str, Any]] = {
    "light": {
        "back": "#ffffff", "ink": "#1b2430", "soft": "#5a6676", "grid": "#edf0f4", "accent": "#0067b0", "tint": 0.74,
        "bodies": ["#0072b2", "#d55e00", "#009e73", "#c2559a", "#3a9bdc", "#b87a00", "#6b5bb5"],
    },
    "dark": {
        "back": "#11161d", "ink": "#e7ecf3", "soft": "#9aa7b8", "grid": "#1c232d", "accent": "#5cb3f2", "tint": 0.68,
        "bodies": ["#4fb0ec", "#ff9055", "#3fcfa4", "#ea9fcb", "#93d2f6", "#f0bb4a", "#ab9cf2"],
    },
}  # fmt: skip
POINT = 420.0  # px: of pictures whose shorter side is this long a symbol's unit is one pixel
MARGIN = 44.0  # px
ROUND = 48  # corners of a circle that is drawn as a line
Points = Float[np.ndarray, "points 2"] | Sequence[np.ndarray]


class View(NamedTuple):
    """Metres to pixels: (x + scale X, y - scale Y), in a picture of so many pixels; `pt` is the unit of symbols (px)."""

    scale: float
    x: float
    y: float
    width: int
    height: int
    pt: float


class Line(NamedTuple):
    """A line through points, closed or not, filled or not; of no width where there is only a filling."""

    layer: str
    points: np.ndarray
    width: float = 0.0
    stroke: str = ""
    fill: str = ""
    closed: bool = False


class Circle(NamedTuple):
    """A circle."""

    layer: str
    centre: np.ndarray
    radius: float
    width: float = 0.0
    stroke: str = ""
    fill: str = ""


def view_of(bounds: Sequence[float], width: int, times: int = 1) -> View:
    """Return the view of a picture of this width that holds `bounds` (left, bottom, right, top, in m), so many times as large."""
    left, bottom, right, top = bounds
    margin = min(MARGIN, 0.12 * width)
    height = int(np.clip((width - 2 * margin) / (right - left) * (top - bottom) + 2 * margin, 0.25 * width, 1.25 * width))
    scale = times * min((width - 2 * margin) / (right - left), (height - 2 * margin) / (top - bottom))
    pt = times * float(np.clip(min(width, height) / POINT, 0.75, 1.5))
    wide, high = times * width, times * height
    return View(scale, wide / 2 - scale * (left + right) / 2, high / 2 + scale * (bottom + top) / 2, wide, high, pt)


def mix(one: str, two: str, t: float) -> str:
    """Return a colour on the way from one (t = 0) to another (t = 1)."""
    parts = [[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in (one, two)]
    return "#" + "".join(f"{round(a * (1 - t) + b * t):02x}" for a, b in zip(*parts, strict=True))


class Sketch:
    """The shapes of a mechanism's marks at one pose, in the order in which they cover one another."""

    def __init__(self, marks: Sequence[Mark], pose: Float[np.ndarray, "bodies 3"], view: View, theme: str = "light"):
        self.pose, self.view, self.theme = pose, view, THEMES[theme]
        self.pt = view.pt
        self.shapes: list[Line | Circle] = []
        for mark in marks:
            self.layer = mark["kind"]
            getattr(self, f"_{mark['kind']}")(mark)

    def px(self, places: Points) -> np.ndarray:
        """Return places in metres in pixels."""
        return np.array([self.view.x, self.view.y]) + self.view.scale * np.asarray(places) * [1, -1]

    def _body(self, body: int) -> np.ndarray:
        return np.zeros(3) if body < 0 else self.pose[body]

    def _anchor(self, body: float, x: float, y: float) -> np.ndarray:
        return self.px(to_ground((x, y), self._body(int(body))[None])[0])

    def _at(self, mark: Mark) -> np.ndarray:
        return self._anchor(mark["body"], *mark["at"])

    def _edge(self, body: int) -> str:
        return self.theme["soft"] if body < 0 else self.theme["bodies"][body % len(self.theme["bodies"])]

    def _fill(self, body: int) -> str:
        return mix(self._edge(body), self.theme["back"], self.theme["tint"])

    def _line(self, points: ArrayLike, width: float, stroke: str, fill: str = "", closed: bool = False) -> None:
        self.shapes.append(Line(self.layer, np.asarray(points, float), width * self.pt, stroke, fill, closed))

    def _circle(self, centre: ArrayLike, radius: float, fill: str = "", stroke: str = "", width: float = 1.5) -> None:
        self.shapes.append(Circle(self.layer, np.asarray(centre, float), radius, width * self.pt, stroke, fill))

    def _rotate(self, place: np.ndarray, angle: float, points: ArrayLike) -> np.ndarray:
        """Points of a frame of pixels (y downwards) at a place, whose x axis is turned anticlockwise by an angle."""
        cos, sin = np.cos(angle), np.sin(angle)
        return place + np.asarray(points, float) @ np.array([[cos, -sin], [sin, cos]])

    def _hatch(self, place: np.ndarray, angle: float, x0: float, x1: float, y: float) -> None:
        step = 5 * self.pt
        for x in np.arange(x0 + step, x1 + 0.01 * self.pt, step):
            self._line(self._rotate(place, angle, [(x, y), (x - step, y + step)]), 1, self.theme["soft"])

    def _link(self, mark: Mark) -> None:
        corners = [self._anchor(mark["body"], *point) for point in mark["points"]]
        edge, fill, closed = self._edge(mark["body"]), self._fill(mark["body"]), mark["closed"]
        self._line(corners, 11, edge, edge if closed else "", closed)
        self._line(corners, 8, fill, fill if closed else "", closed)

    def _disc(self, mark: Mark) -> None:
        radius = max(self.view.scale * mark["radius"], 7 * self.pt)
        self._circle(self._at(mark), radius, self._fill(mark["body"]), self._edge(mark["body"]))
        r = 4.5 * self.pt
        self._circle(self._at(mark), r, self.theme["back"], self.theme["ink"], 1)
        for start in (0, np.pi):
            angles = start - self._body(mark["body"])[2] + np.linspace(0, np.pi / 2, 9)
            corners = [self._at(mark), *(self._at(mark) + r * np.column_stack([np.cos(angles), np.sin(angles)]))]
            self._line(corners, 0, "", self.theme["ink"], True)

    def _wheel(self, mark: Mark) -> None:
        radius, edge, fill = self.view.scale * mark["radius"], self._edge(mark["body"]), self._fill(mark["body"])
        place, angle = self._at(mark), self._body(mark["body"])[2]
        depth = min(4 * self.pt, 0.12 * radius)
        teeth = int(np.clip(round(2 * np.pi * radius / (9 * self.pt) / 4) * 4, 12, 96))
        parts = np.array([(0, -1), (0.25, -1), (0.35, 1), (0.65, 1), (0.75, -1)])
        turn = 2 * np.pi / teeth * (np.arange(teeth)[:, None] + parts[:, 0]).ravel()
        reach = np.tile(radius + parts[:, 1] * depth / 2, teeth)
        rim = self._rotate(place, angle, reach[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]))
        if mark["internal"]:
            self._circle(place, radius + depth + 5 * self.pt, fill, edge)
            self._line(rim, 1.3, edge, self.theme["back"], True)
            return
        self._line(rim, 1.3, edge, fill, True)
        for spoke in 2 * np.pi * np.arange(3) / 3:
            ends = np.array([min(9 * self.pt, 0.3 * radius), 0.8 * radius])[:, None] * [np.cos(spoke), np.sin(spoke)]
            self._line(self._rotate(place, angle, ends), 2.2, mix(edge, fill, 0.25))

    def _outline(self, mark: Mark) -> None:
        corners = [self._anchor(mark["body"], *point) for point in mark["points"]]
        self._line(corners, 1.6, self._edge(mark["body"]), self._fill(mark["body"]), True)

    def _rail_frame(self, mark: Mark) -> tuple[np.ndarray, float, float, float]:
        a, b = (self.view.scale * s for s in mark["span"])
        return self._at(mark), self._body(mark["body"])[2] + mark["axis"], a, b

    def _rail(self, mark: Mark) -> None:
        place, angle, a, b = self._rail_frame(mark)
        r, y = 6.5 * self.pt, 9 * self.pt
        if mark["slot"]:
            turn = np.linspace(-np.pi / 2, np.pi / 2, 9)
            ends = r * np.column_stack([np.cos(turn), np.sin(turn)])
            outline = np.concatenate([[b - r, 0] + ends, [a + r, 0] - ends])
            self._line(self._rotate(place, angle, outline), 1.3, self._edge(mark["body"]), self.theme["back"], True)
        elif mark["body"] >= 0:
            self._line(self._rotate(place, angle, [(a, 0), (b, 0)]), 3, self._edge(mark["body"]))
        else:
            self._line(self._rotate(place, angle, [(a, y), (b, y)]), 1.5, self.theme["soft"])
            self._hatch(place, angle, a, b, y)

    def _rack(self, mark: Mark) -> None:
        place, angle, a, b = self._rail_frame(mark)
        pt, step, colour = self.pt, 9 * self.pt, self._edge(mark["body"])
        parts = ((0, 2), (0.3, -2), (0.7, -2), (1, 2))
        teeth = [(x + part * step, y * pt) for x in np.arange(a, b, step) for part, y in parts]
        self._line(self._rotate(place, angle, teeth), 1.4, colour)
        self._line(self._rotate(place, angle, [(a, 7 * pt), (b, 7 * pt)]), 1.4, colour)
        if mark["body"] < 0:
            self._hatch(place, angle, a, b, 7 * pt)

    def _block(self, mark: Mark) -> None:
        x, y = 15 * self.pt, 9 * self.pt
        corners = self._rotate(self._at(mark), self._body(mark["body"])[2] + mark["axis"], [(-x, -y), (x, -y), (x, y), (-x, y)])
        self._line(corners, 1.5, self._edge(mark["body"]), self._fill(mark["body"]), True)

    def _support(self, mark: Mark) -> None:
        place, pt, soft = self._at(mark), self.pt, self.theme["soft"]
        self._line(place + [(0, 0), (-10 * pt, 17 * pt), (10 * pt, 17 * pt)], 1.4, soft, self.theme["back"], True)
        self._line(place + [(-15 * pt, 17 * pt), (15 * pt, 17 * pt)], 1.4, soft)
        self._hatch(place, 0.0, -15 * pt, 15 * pt, 17 * pt)

    def _pin(self, mark: Mark) -> None:
        self._circle(self._at(mark), 4.2 * self.pt, self.theme["back"], self.theme["ink"], 1.7)

    def _roller(self, mark: Mark) -> None:
        self._circle(self._at(mark), 4.8 * self.pt, self._fill(mark["body"]), self.theme["ink"], 1.7)
        self._circle(self._at(mark), 1.2 * self.pt, self.theme["ink"])

    def _weld(self, mark: Mark) -> None:
        r = 4.5 * self.pt
        corners = self._rotate(self._at(mark), self._body(mark["body"])[2], [(-r, -r), (r, -r), (r, r), (-r, r)])
        self._line(corners, 0, "", self.theme["ink"], True)

    def _rod(self, mark: Mark) -> None:
        self._line([self._anchor(*mark["a"]), self._anchor(*mark["b"])], 2.4, self.theme["ink"])

    def _along(self, mark: Mark) -> tuple[np.ndarray, float, float]:
        start, end = self._anchor(*mark["a"]), self._anchor(*mark["b"])
        x, y = end - start
        for place in (start, end):
            self._circle(place, 2.6 * self.pt, self.theme["ink"])
        return start, -np.arctan2(y, x), float(np.hypot(x, y))

    def _spring(self, mark: Mark) -> None:
        place, angle, length = self._along(mark)
        pt, ink, damper = self.pt, self.theme["ink"], mark["damper"]
        end, high, shift = min(10 * pt, 0.15 * length), (5 if damper else 7) * pt, -5 * pt if damper else 0.0
        turns = 2 * int(np.clip(round(length / (11 * pt)), 6, 24))
        zigzag = [(end + (length - 2 * end) * (k + 0.5) / turns, shift + (high if k % 2 else -high)) for k in range(turns)]
        beside = ([(end, shift)], [(length - end, shift)]) if damper else ([], [])
        line = [(0, 0), (end, 0), *beside[0], *zigzag, *beside[1], (length - end, 0), (length, 0)]
        self._line(self._rotate(place, angle, line), 1.5, ink)
        if damper:
            y, box, right, piston = 9 * pt, 0.38 * length, 0.62 * length, 0.5 * length
            for width, points in (
                (1.5, [(end, 0), (end, y), (piston, y)]),
                (1.8, [(piston, y - 3 * pt), (piston, y + 3 * pt)]),
                (1.5, [(box, y - 5 * pt), (right, y - 5 * pt), (right, y + 5 * pt), (box, y + 5 * pt)]),
                (1.5, [(right, y), (length - end, y), (length - end, 0)]),
            ):
                self._line(self._rotate(place, angle, points), width, ink)

    def _spiral(self, mark: Mark) -> None:
        k = np.arange(61)
        line = ((5 + 8 * k / 60) * self.pt)[:, None] * np.column_stack([np.cos(0.25 * k), np.sin(0.25 * k)])
        self._line(self._rotate(self._at(mark), self._body(mark["body"])[2], line), 1.3, self.theme["ink"])

    def _piston(self, mark: Mark) -> None:
        place, angle, length = self._along(mark)
        for end, width, colour in ((1.0, 3, "ink"), (0.55, 9, "ink"), (0.55, 6, "back")):
            self._line(self._rotate(place, angle, [(0, 0), (end * length, 0)]), width, self.theme[colour])

    def _motor(self, mark: Mark) -> None:
        self._turn(self._at(mark), 11, 1)

    def _torque(self, mark: Mark) -> None:
        self._turn(self._at(mark), 16, mark["sign"])

    def _friction(self, mark: Mark) -> None:
        place, pt = self._at(mark), self.pt
        self._circle(place, 8 * pt, stroke=self.theme["soft"], width=1.2)
        for angle in np.pi / 4 * np.arange(8):
            ray = np.array([np.cos(angle), np.sin(angle)])
            self._line([place + 8 * pt * ray, place + 11 * pt * ray], 1.2, self.theme["soft"])

    def _force(self, mark: Mark) -> None:
        x, y = mark["vector"]
        angle = np.arctan2(y, x) + (self._body(mark["body"])[2] if mark["turns"] else 0.0)
        tip, place = np.array([np.cos(angle), -np.sin(angle)]), self._at(mark)
        self._line([place, place + 37 * self.pt * tip], 2.2, self.theme["accent"])
        self._head(place + 42 * self.pt * tip, tip)

    def _turn(self, place: np.ndarray, radius: float, sign: int) -> None:
        """A round arrow: sign 1 is anticlockwise."""
        flip = np.array([1, -sign])
        angles = np.linspace(-0.5, 3.5, ROUND)
        line = radius * self.pt * np.column_stack([np.cos(angles), np.sin(angles)])
        direction = np.array([-np.sin(3.5), np.cos(3.5)])
        self._line(place + flip * line, 1.8, self.theme["accent"])
        self._head(place + flip * (line[-1] + 4 * self.pt * direction), flip * direction)

    def _head(self, tip: np.ndarray, direction: np.ndarray) -> None:
        size, wide = 7.5 * self.pt, 0.42
        side = np.array([-direction[1], direction[0]])
        back = tip - size * np.cos(wide) * direction
        corners = [tip, back + size * np.sin(wide) * side, back - size * np.sin(wide) * side]
        self._line(corners, 0, "", self.theme["accent"], True)
