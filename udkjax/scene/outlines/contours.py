"""Closed contours from loose pieces, and checks of them: open ends, crossings, and which contour is a hole."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.scene.outlines.curves import Arc, Piece, corners, ends

JOINING_TOL = 1e-6  # of the size of the drawing: ends nearer than this meet
CROSSING_CHORD = 1e-4  # of the size: chords by which crossings are looked for


class DrawnPiece(NamedTuple):
    """A piece of a file, with its name in the file."""

    piece: Piece
    name: str


class Contour(NamedTuple):
    """A closed contour: its pieces in order, and the name of its first one."""

    pieces: tuple[Piece, ...]
    name: str

    @property
    def circle(self) -> tuple[Float[np.ndarray, "2"], float] | None:
        """The centre and the radius, if the contour is a circle; otherwise None."""
        arcs = [piece for piece in self.pieces if isinstance(piece, Arc)]
        if len(arcs) < len(self.pieces) or abs(abs(sum(x.sweep for x in arcs)) - 2 * np.pi) > 1e-9:
            return None
        radii = np.array([[np.hypot(*x.x), np.hypot(*x.y)] for x in arcs])
        off = np.ptp([x.centre for x in arcs], axis=0).max()
        return (arcs[0].centre, float(radii[0, 0])) if max(off, np.ptp(radii)) <= JOINING_TOL * radii[0, 0] else None

    def polygon(self, chord: float) -> Float[np.ndarray, "n 2"]:
        """Return points in order whose chords are nearer to the contour than `chord`."""
        return np.concatenate([corners(piece, chord) for piece in self.pieces])


def size_of_pieces(drawn: Sequence[DrawnPiece]) -> float:
    """Return the longer side of the bounding box of pieces, by points on them."""
    points = np.concatenate([x.piece.at(np.linspace(0, 1, 9))[0] for x in drawn])
    return float(np.ptp(points, axis=0).max())


def contours_of(drawn: Sequence[DrawnPiece], scale: float, unit: str) -> tuple[list[Contour], list[str]]:
    """Return closed contours of pieces, joined end to end, and mistakes, with places in the unit of the file.

    Args:
        drawn: pieces in m, in any order and direction.
        scale: the file's unit (m).
        unit: the name of the file's unit.
    """
    near, problems, found = JOINING_TOL * size_of_pieces(drawn), [], []

    def place(p: np.ndarray) -> str:
        return f"({p[0] / scale:.6g}, {p[1] / scale:.6g}) {unit}"

    # A circle of SVG ends with a line whose length is rounding.
    rest = [x for x in drawn if np.ptp(x.piece.at(np.linspace(0, 1, 9))[0], axis=0).max() > near]
    while rest:
        first = rest.pop(0)
        chain, name = [first.piece], f"contour {len(found) + 1} ({first.name})"
        while True:
            end, start = ends(chain[-1])[1], ends(chain[0])[0]
            if np.hypot(*(end - start)) <= near:
                break
            distances = [np.hypot(*(ends(x.piece) - end).T) for x in rest]
            meeting = [k for k, d in enumerate(distances) if d.min() <= near]
            if not meeting:
                others = [*(d.min() for d in distances), np.hypot(*(end - start))]
                closest = min(others)
                problems.append(f"{name} is open at {place(end)}: the nearest other end is {closest / scale:.3g} {unit} away")
                break
            if len(meeting) > 1:
                problems.append(f"{name} branches at {place(end)}, where {len(meeting) + 1} ends meet")
            following = rest.pop(meeting[0]).piece
            chain.append(following if np.hypot(*(ends(following)[0] - end)) <= near else following.reverse())
        found.append(Contour(tuple(chain), first.name))
    if not problems:
        problems = _crossings(found, CROSSING_CHORD * size_of_pieces(drawn), place)
    return found, problems


def _crossings(found: Sequence[Contour], chord: float, place: Callable[[np.ndarray], str]) -> list[str]:
    """Return mistakes for each two contours that cross, and for contours that cross themselves."""
    polygons = [contour.polygon(chord) for contour in found]
    owner = np.repeat(np.arange(len(found)), [len(x) for x in polygons])
    start, end = np.concatenate(polygons), np.concatenate([np.roll(x, -1, axis=0) for x in polygons])
    index = np.concatenate([np.arange(len(x)) for x in polygons])
    count, problems = np.array([len(x) for x in polygons])[owner], {}
    way = end - start
    for k in range(len(start) - 1):
        r, others = start[k + 1 :] - start[k], way[k + 1 :]
        cross = way[k, 0] * others[:, 1] - way[k, 1] * others[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (r[:, 0] * others[:, 1] - r[:, 1] * others[:, 0]) / cross
            u = (r[:, 0] * way[k, 1] - r[:, 1] * way[k, 0]) / cross
        apart = (index[k + 1 :] - index[k]) % count[k]
        beside = (owner[k + 1 :] == owner[k]) & ((apart == 1) | (apart == count[k] - 1))
        for j in np.flatnonzero((t >= 0) & (t <= 1) & (u >= 0) & (u <= 1) & ~beside) + k + 1:
            one, other = (f"contour {owner[x] + 1} ({found[owner[x]].name})" for x in (k, j))
            where = place(start[k] + t[j - k - 1] * way[k])
            what = f"{one} crosses itself" if one == other else f"{one} and {other} cross"
            problems.setdefault((owner[k], owner[j]), f"{what} at {where}")
    return list(problems.values())


def contains(polygon: Float[np.ndarray, "n 2"], point: Float[np.ndarray, "2"]) -> bool:
    """Return True if a point is inside a polygon."""
    p, q = polygon - point, np.roll(polygon, -1, axis=0) - point
    spans = (p[:, 1] > 0) != (q[:, 1] > 0)
    p, q = p[spans], q[spans]
    return bool(((p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1] > 0) == (q[:, 1] > p[:, 1])).sum() % 2)
