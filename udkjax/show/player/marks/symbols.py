"""Symbols of marks as lines and circles in moving frames; the player and the writers of pictures paint them in the same way.

    symbol   layer, frame, stroke, width, fill, and points (a line, `closed` or not) or a radius (a circle about its origin)

A frame is [body, x, y, angle, turns]: its origin is a place (m) of a body, and its x axis is at an angle (rad) to the body's, or
to the ground's if `turns` is 0. Or it is two anchors [[body, x, y], [body, x, y]], with its x axis from the first to the second.
A point is [x, y, px, py]: x and y in m, or relative to the distance of the anchors; px and py, which may be left out, in the unit
of symbols, which does not depend on the size of the scene. A radius [m, units, smallest] is the sum of a length in m and a number
of these units, at least `smallest` units. Colours are names of a theme, or "edge:3", "tint:3", "spoke:3" of a body.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from udkjax.annotations import Numbers
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.marks import Mark

Symbol = Mark
CIRCLE_VERTICES = 48  # vertices of a circle drawn as a polyline
COIL_LENGTH = 11.0  # units per coil of a spring of usual length
FEWEST_TEETH, MOST_TEETH = 4, 400  # of a wheel: others have as many as fit its size
STRAIGHT_END, LARGEST_PART = 10.0, 0.15  # straight ends of a spring in units; their largest fraction of its length


def symbols_of(marks: Sequence[Mark], unit: float) -> list[Symbol]:
    """Return the symbols of marks, from back to front.

    Args:
        marks: marks of one mechanism.
        unit: the unit of symbols (m) without zoom; it determines the spacing of teeth and of strokes along rails.
    """
    return [{"layer": mark["kind"]} | symbol for mark in marks for symbol in SYMBOLS[mark["kind"]](mark, unit)]


def _line(frame: list, points: Numbers, stroke: str, width: float, fill: str = "", closed: bool = False) -> Symbol:
    rows = [[float(f"{x:.7g}") for x in row] for row in np.asarray(points, float)]
    return {"frame": frame, "points": rows, "stroke": stroke, "width": width, "fill": fill, "closed": closed}


def _circle(frame: list, radius: Sequence[float], fill: str = "", stroke: str = "", width: float = 1.5) -> Symbol:
    return {"frame": frame, "radius": [float(r) for r in (*radius, 0.0, 0.0)[:3]], "stroke": stroke, "width": width, "fill": fill}


def _offsets(points: Numbers) -> np.ndarray:
    """Return points (n, 4) at the origin of a frame, shifted by offsets (n, 2) in the unit of symbols."""
    points = np.asarray(points, float)
    return np.hstack([np.zeros_like(points), points])


def _round(angles: Numbers) -> np.ndarray:
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _at(mark: Mark, angle: float = 0.0, turns: bool = True) -> list:
    return [mark["body"], *mark["at"], angle, int(turns)]


def _edge(body: int) -> str:
    return f"edge:{body}"


def _tint(body: int) -> str:
    return f"tint:{body}"


def _hatch(frame: list, places: Numbers, y: float, in_units: bool = False) -> Iterator[Symbol]:
    """Draw the hatching of the ground: short strokes to the lower left of a line at height y."""
    for x in np.asarray(places, float):
        start = [0.0, 0.0, x, y] if in_units else [x, 0.0, 0.0, y]
        yield _line(frame, [start, np.add(start, [0, 0, -5, -5])], "soft", 1)


def _link(mark: Mark, unit: float) -> Iterator[Symbol]:
    body, closed = mark["body"], mark["closed"]
    for width, colour in ((11, _edge(body)), (8, _tint(body))):
        yield _line([body, 0, 0, 0, 1], mark["points"], colour, width, colour if closed else "", closed)
    for hole in mark.get("holes", ()):
        yield _line([body, 0, 0, 0, 1], hole, _edge(body), 1.3, "back", True)


def _disc(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _circle(_at(mark), (mark["radius"], 0, 7), _tint(mark["body"]), _edge(mark["body"]))
    yield _circle(_at(mark), (0, 4.5), "back", "ink", 1)  # symbol of a centre of mass; it shows the rotation of the body
    for start in (0, np.pi):
        yield _line(_at(mark), _offsets([(0, 0), *(4.5 * _round(start - np.linspace(0, np.pi / 2, 9)))]), "", 0, "ink", True)


def _wheel(mark: Mark, unit: float) -> Iterator[Symbol]:
    radius, body, frame = mark["radius"], mark["body"], _at(mark, mark["phase"] or 0.0)
    by_size = int(np.clip(round(2 * np.pi * radius / (9 * unit) / 4) * 4, 12, 96))
    teeth = min(mark["teeth"], MOST_TEETH) if mark["teeth"] >= FEWEST_TEETH else by_size
    depth = min(np.pi * radius / teeth if mark["teeth"] else 4 * unit, 0.12 * radius)
    tooth = np.array([(0, -1), (0.25, -1), (0.35, 1), (0.65, 1), (0.75, -1)])
    turn = 2 * np.pi / teeth * (np.arange(teeth)[:, None] + tooth[:, 0]).ravel()
    rim = np.tile(radius + tooth[:, 1] * depth / 2, teeth)[:, None] * _round(turn)
    if mark["internal"]:
        yield _circle(frame, (radius + depth, 5), _tint(body), _edge(body))
    yield _line(frame, rim, _edge(body), 1.3, "back" if mark["internal"] else _tint(body), True)
    for spoke in () if mark["internal"] else _round(2 * np.pi * np.arange(3) / 3):
        yield _line(frame, [min(9 * unit, 0.3 * radius) * spoke, 0.8 * radius * spoke], f"spoke:{body}", 2.2)


def _outline(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _line(_at(mark), mark["points"], _edge(mark["body"]), 1.6, _tint(mark["body"]), True)


def _rail(mark: Mark, unit: float) -> Iterator[Symbol]:
    (a, b), body, frame = mark["span"], mark["body"], _at(mark, mark["axis"])
    if mark["slot"]:
        ends = 6.5 * (_round(np.linspace(-np.pi / 2, np.pi / 2, 9)) - [1, 0])
        outline = [*([b, 0, *p] for p in ends), *([a, 0, *-p] for p in ends)]
        yield _line(frame, outline, _edge(body), 1.3, "back", True)
    elif body >= 0:
        yield _line(frame, [(a, 0), (b, 0)], _edge(body), 3)
    else:
        yield _line(frame, [(a, 0, 0, -9), (b, 0, 0, -9)], "soft", 1.5)
        yield from _hatch(frame, np.arange(a + 5 * unit, b, 5 * unit), -9)


def _floor(mark: Mark, unit: float) -> Iterator[Symbol]:
    (a, b), frame = mark["span"], _at(mark, mark["axis"])
    yield _line(frame, [(a, 0), (b, 0)], "soft" if mark["body"] < 0 else _edge(mark["body"]), 1.5)
    yield from _hatch(frame, np.arange(a + 5 * unit, b, 5 * unit), 0)


def _rack(mark: Mark, unit: float) -> Iterator[Symbol]:
    (a, b), body, frame = mark["span"], mark["body"], _at(mark, mark["axis"])
    teeth = [
        (x + x_in_tooth * 9 * unit, 0, 0, y)
        for x in np.arange(a, b, 9 * unit)
        for x_in_tooth, y in ((0, -2), (0.3, 2), (0.7, 2), (1, -2))
    ]
    yield _line(frame, teeth, _edge(body), 1.4)
    yield _line(frame, [(a, 0, 0, -7), (b, 0, 0, -7)], _edge(body), 1.4)
    if body < 0:
        yield from _hatch(frame, np.arange(a + 5 * unit, b, 5 * unit), -7)


def _block(mark: Mark, unit: float) -> Iterator[Symbol]:
    corners = _offsets([(-15, -9), (15, -9), (15, 9), (-15, 9)])
    yield _line(_at(mark, mark["axis"]), corners, _edge(mark["body"]), 1.5, _tint(mark["body"]), True)


def _support(mark: Mark, unit: float) -> Iterator[Symbol]:
    frame = _at(mark, turns=False)
    yield _line(frame, _offsets([(0, 0), (-10, -17), (10, -17)]), "soft", 1.4, "back", True)
    yield _line(frame, _offsets([(-15, -17), (15, -17)]), "soft", 1.4)
    yield from _hatch(frame, np.arange(-10, 16, 5), -17, in_units=True)


def _pin(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _circle(_at(mark), (0, 4.2), "back", "ink", 1.7)


def _traced(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _circle(_at(mark), (0, 3), _edge(mark["body"]), "back", 1)


def _roller(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _circle(_at(mark), (0, 4.8), _tint(mark["body"]), "ink", 1.7)
    yield _circle(_at(mark), (0, 1.2), "ink")


def _weld(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _line(_at(mark), _offsets([(-4.5, -4.5), (4.5, -4.5), (4.5, 4.5), (-4.5, 4.5)]), "", 0, "ink", True)


def _target(mark: Mark, unit: float) -> Iterator[Symbol]:
    for x, y in ((4.5, 4.5), (4.5, -4.5)):
        yield _line(_at(mark), _offsets([(-x, -y), (x, y)]), "accent", 1.6)


def _rod(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield _line([mark["a"], mark["b"]], [(0, 0), (1, 0)], "ink", 2.4)


def _ends(mark: Mark) -> Iterator[Symbol]:
    for body, x, y in (mark["a"], mark["b"]):
        yield _circle([body, x, y, 0, 1], (0, 2.6), "ink")


def _spring(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield from _ends(mark)
    frame, damper, length = [mark["a"], mark["b"]], mark["damper"], max(mark["length"] / unit, STRAIGHT_END)
    end, turns = min(LARGEST_PART, STRAIGHT_END / length), 2 * int(np.clip(round(length / COIL_LENGTH), 6, 24))
    high, shift = (5, 5) if damper else (7, 0)
    xs = end + (1 - 2 * end) * (np.arange(turns) + 0.5) / turns
    sides = [(x, 0, 0, shift + (-high if k % 2 else high)) for k, x in enumerate(xs)]
    line = [(0, 0, 0, 0), (end, 0, 0, 0), (end, 0, 0, shift), *sides, (1 - end, 0, 0, shift), (1 - end, 0, 0, 0), (1, 0, 0, 0)]
    yield _line(frame, line, "ink", 1.5)
    if damper:
        for width, points in (
            (1.5, [(end, 0), (end, -9), (0.5, -9)]),
            (1.8, [(0.5, -6), (0.5, -12)]),
            (1.5, [(0.38, -4), (0.62, -4), (0.62, -14), (0.38, -14)]),
            (1.5, [(0.62, -9), (1 - end, -9), (1 - end, 0)]),
        ):
            yield _line(frame, [(x, 0, 0, y) for x, y in points], "ink", width)


def _spiral(mark: Mark, unit: float) -> Iterator[Symbol]:
    k = np.arange(61)
    yield _line(_at(mark), _offsets((5 + 8 * k / 60)[:, None] * _round(-0.25 * k)), "ink", 1.3)


def _piston(mark: Mark, unit: float) -> Iterator[Symbol]:
    yield from _ends(mark)
    for end, width, colour in ((1.0, 3, "ink"), (0.55, 9, "ink"), (0.55, 6, "back")):
        yield _line([mark["a"], mark["b"]], [(0, 0), (end, 0)], colour, width)


def _turn(mark: Mark, radius: float, sign: int) -> Iterator[Symbol]:
    """Draw a circular arrow; sign 1 is anticlockwise."""
    frame, flip = _at(mark, turns=False), np.array([1, sign])
    line, direction = radius * _round(np.linspace(-0.5, 3.5, CIRCLE_VERTICES)), np.array([-np.sin(3.5), np.cos(3.5)])
    yield _line(frame, _offsets(flip * line), "accent", 1.8)
    yield _head(frame, flip * (line[-1] + 4 * direction), flip * direction)


def _head(frame: list, tip: np.ndarray, direction: np.ndarray) -> Symbol:
    side, back = np.array([-direction[1], direction[0]]), tip - 7.5 * np.cos(0.42) * direction
    corners = [tip, back + 7.5 * np.sin(0.42) * side, back - 7.5 * np.sin(0.42) * side]
    return _line(frame, _offsets(corners), "", 0, "accent", True)


def _motor(mark: Mark, unit: float) -> Iterator[Symbol]:
    return _turn(mark, 11, 1)


def _torque(mark: Mark, unit: float) -> Iterator[Symbol]:
    return _turn(mark, 16, mark["sign"])


def _friction(mark: Mark, unit: float) -> Iterator[Symbol]:
    frame = _at(mark, turns=False)
    yield _circle(frame, (0, 8), stroke="soft", width=1.2)
    for ray in _round(np.pi / 4 * np.arange(8)):
        yield _line(frame, _offsets([8 * ray, 11 * ray]), "soft", 1.2)


def _force(mark: Mark, unit: float) -> Iterator[Symbol]:
    x, y = mark["vector"]
    frame = _at(mark, float(np.arctan2(y, x)), mark["turns"])
    yield _line(frame, _offsets([(0, 0), (37, 0)]), "accent", 2.2)
    yield _head(frame, np.array([42.0, 0.0]), np.array([1.0, 0.0]))


SYMBOLS = {
    MarkKind.LINK: _link,
    MarkKind.DISC: _disc,
    MarkKind.WHEEL: _wheel,
    MarkKind.OUTLINE: _outline,
    MarkKind.RAIL: _rail,
    MarkKind.FLOOR: _floor,
    MarkKind.RACK: _rack,
    MarkKind.BLOCK: _block,
    MarkKind.SUPPORT: _support,
    MarkKind.PIN: _pin,
    MarkKind.ROLLER: _roller,
    MarkKind.TRACED: _traced,
    MarkKind.WELD: _weld,
    MarkKind.TARGET: _target,
    MarkKind.ROD: _rod,
    MarkKind.SPRING: _spring,
    MarkKind.SPIRAL: _spiral,
    MarkKind.PISTON: _piston,
    MarkKind.MOTOR: _motor,
    MarkKind.TORQUE: _torque,
    MarkKind.FRICTION: _friction,
    MarkKind.FORCE: _force,
}
