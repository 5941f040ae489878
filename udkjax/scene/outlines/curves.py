"""Pieces of contours, and integrals over the areas that they enclose.

With p(t) along a closed contour and c = p x dp/dt, Green's theorem gives the area, its first moments and its second moment about
the origin as the integrals of c / 2, p c / 3 and |p|^2 c / 4. Gauss's rule with twelve nodes integrates them exactly for lines
and for splines of up to degree six, and to rounding for arcs of up to a quarter turn.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

GAUSS_NODES, GAUSS_WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(12))
GAUSS_NODES = GAUSS_NODES + 0.5
QUARTER_TURN = np.pi / 2


class Bezier(NamedTuple):
    """A line or a spline, by its control points."""

    points: Float[np.ndarray, "degree+1 2"]

    @property
    def count(self) -> int:
        """The number of stretches that Gauss's rule integrates one by one."""
        return 1

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places and derivatives at parameters from 0 to 1."""
        stage = np.repeat(self.points[:, None], len(t), 1)
        while len(stage) > 2:  # de Casteljau
            stage = stage[:-1] + t[:, None] * np.diff(stage, axis=0)
        way = stage[1] - stage[0]
        return stage[0] + t[:, None] * way, (len(self.points) - 1) * way

    def reverse(self) -> "Bezier":
        """Return the piece from its end to its start."""
        return Bezier(self.points[::-1])


class Arc(NamedTuple):
    """An arc of a circle or an ellipse, centre + cos(angle) x + sin(angle) y, from angle `start` to `start` + `sweep` (rad)."""

    centre: Float[np.ndarray, "2"]
    x: Float[np.ndarray, "2"]
    y: Float[np.ndarray, "2"]
    start: float
    sweep: float

    @property
    def count(self) -> int:
        """The number of stretches that Gauss's rule integrates one by one."""
        return max(1, int(np.ceil(abs(self.sweep) / QUARTER_TURN - 1e-9)))

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places and derivatives at parameters from 0 to 1."""
        angle = (self.start + self.sweep * t)[:, None]
        cos, sin = np.cos(angle), np.sin(angle)
        return self.centre + cos * self.x + sin * self.y, self.sweep * (cos * self.y - sin * self.x)

    def reverse(self) -> "Arc":
        """Return the piece from its end to its start."""
        return self._replace(start=self.start + self.sweep, sweep=-self.sweep)


Piece = Bezier | Arc


def line(start: Sequence[float] | np.ndarray, end: Sequence[float] | np.ndarray) -> Bezier:
    """Return the line between two points."""
    return Bezier(np.array([start, end], float))


def circle(centre: Sequence[float] | np.ndarray, radius: float) -> Arc:
    """Return a whole circle, anticlockwise from its rightmost point."""
    return Arc(np.array(centre, float), np.array([radius, 0.0]), np.array([0.0, radius]), 0.0, 2 * np.pi)


def bulge(start: Sequence[float] | np.ndarray, end: Sequence[float] | np.ndarray, tangent: float) -> Piece:
    """Return the arc between two points whose angle is four times the arc tangent of a number, as in DXF; a line for zero."""
    p, q = np.array(start, float), np.array(end, float)
    angle = 4.0 * np.arctan(tangent)
    if abs(angle) < 1e-9:  # the arc is within rounding of its chord
        return line(p, q)
    way = q - p
    centre = 0.5 * (p + q) + np.array([-way[1], way[0]]) * (1 - tangent**2) / (4 * tangent)
    x = p - centre
    return Arc(centre, x, np.array([-x[1], x[0]]), 0.0, float(angle))


def ends(piece: Piece) -> Float[np.ndarray, "2 2"]:
    """Return the start and the end of a piece."""
    return piece.at(np.array([0.0, 1.0]))[0]


def corners(piece: Piece, chord: float) -> Float[np.ndarray, "n 2"]:
    """Return points of a piece from its start on, without its end, whose chords are nearer to it than `chord`."""
    if isinstance(piece, Arc):
        radius = max(np.hypot(*piece.x), np.hypot(*piece.y))
        step = 2 * np.arccos(max(0.0, 1 - chord / radius)) if chord < radius else QUARTER_TURN
        count = int(np.ceil(abs(piece.sweep) / min(step, QUARTER_TURN)))
    elif len(piece.points) == 2:
        count = 1
    else:  # the chord is off by at most the largest second derivative times h^2 / 8
        degree = len(piece.points) - 1
        bend = degree * (degree - 1) * np.hypot(*np.diff(piece.points, 2, axis=0).T).max()
        count = int(np.ceil(np.sqrt(bend / (8 * chord)))) or 1
    return piece.at(np.arange(count) / count)[0]


def moments(pieces: Sequence[Piece], about: Float[np.ndarray, "2"]) -> tuple[float, Float[np.ndarray, "2"], float]:
    """Return the area within a contour, negative if clockwise, and its first and second moments about a point."""
    area, first, second = 0.0, np.zeros(2), 0.0
    for piece in pieces:
        for k in range(piece.count):
            p, way = piece.at((k + GAUSS_NODES) / piece.count)
            p = p - about
            cross = (p[:, 0] * way[:, 1] - p[:, 1] * way[:, 0]) * GAUSS_WEIGHTS / piece.count
            area += cross.sum() / 2
            first += cross @ p / 3
            second += cross @ (p * p).sum(1) / 4
    return float(area), first, float(second)
