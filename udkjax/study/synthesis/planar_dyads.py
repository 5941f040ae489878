"""The equations of dyads and four-bars in real coordinates, for numbers and for balls.

A dyad has its moving joint at x from the traced point and its fixed joint at a, both in the first position, from where the
point was there. Where the point has moved by d and the link has turned by the angle of cosine c and sine s, the crank is as
long as before:

    g(x, a) = (d - a) . R x + |d|^2 / 2 - d . a + x . a = 0,      R = [[c, -s], [s, c]].
"""

from typing import Any, NamedTuple

import numpy as np

from udkjax.study.synthesis.balls import LONG, Ball

Numbers = Any  # arrays or balls


class Displacements(NamedTuple):
    """Ways of the traced point from its first position (J, 1), and cosines and sines of its link's turns, where known."""

    x: Numbers
    y: Numbers
    c: Numbers = None
    s: Numbers = None


class DyadEquations(NamedTuple):
    """g at all displacements (J, M), and its derivatives by x (two), a (two), c and s, (6, J, M)."""

    g: Numbers
    slopes: tuple[Numbers, ...]


def dyad_equations(x: Numbers, y: Numbers, a: Numbers, b: Numbers, d: Displacements) -> DyadEquations:
    """Return the equations of a moving joint (x, y) and a fixed joint (a, b)."""
    c, s = d.c, d.s
    ex, ey = d.x - a, d.y - b
    turned_x, turned_y = c * x - s * y, s * x + c * y
    g = ex * turned_x + ey * turned_y + 0.5 * (d.x * d.x + d.y * d.y) - (d.x * a + d.y * b) + (x * a + y * b)
    by_joint = ex * c + ey * s + a, ey * c - ex * s + b
    by_pivot = x - turned_x - d.x, y - turned_y - d.y
    return DyadEquations(g, (*by_joint, *by_pivot, ex * x + ey * y, ey * x - ex * y))


def dyad_system(d: Displacements):
    """Return the system of one dyad whose link's angles are given: four equations for x, y, a, b."""

    def system(u: Ball) -> tuple[Ball, Ball]:
        x, y, a, b = (u.part(k) for k in range(4))
        found = dyad_equations(x, y, a, b, d)
        slopes = found.slopes[:4]
        mid, rad = (np.stack([_full(getattr(s, part), found.g.mid.shape) for s in slopes], 1) for part in Ball._fields)
        return found.g, Ball(mid, rad)

    return system


def four_bar_system(d: Displacements):
    """Return the system of a four-bar through points: for two dyads, and the cosines and sines of the J turns of their link.

    The unknowns are x, y, a, b of the first dyad and of the second one, J cosines, J sines; the equations g of both, and
    (c^2 + s^2 - 1) / 2 = 0.
    """

    def system(u: Ball) -> tuple[Ball, Ball]:
        J = len(d.x.mid)
        c, s = u.part(slice(8, 8 + J)), u.part(slice(8 + J, 8 + 2 * J))
        turned, places = d._replace(c=c, s=s), np.arange(J)
        x, y, a, b, *others = [u.part(k) for k in range(8)]
        parts = [dyad_equations(x, y, a, b, turned), dyad_equations(*others, d=turned)]
        unit = (c * c + s * s - 1.0) * 0.5
        values = [*(part.g for part in parts), unit]
        F = Ball(*(np.concatenate([getattr(v, name) for v in values]) for name in Ball._fields))
        shape, M = (3 * J, 8 + 2 * J), u.mid.shape[1]
        mid, rad = np.zeros((*shape, M), LONG), np.zeros((*shape, M))
        for k, part in enumerate(parts):
            rows = k * J + places
            columns = [*range(4 * k, 4 * k + 4), 8 + places, 8 + J + places]
            for column, slope in zip(columns, part.slopes, strict=True):
                mid[rows, column], rad[rows, column] = slope.mid, slope.rad
        for column, slope in ((8, c), (8 + J, s)):
            mid[2 * J + places, column + places], rad[2 * J + places, column + places] = slope.mid, slope.rad
        return F, Ball(mid, rad)

    return system


def _full(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(x, shape)
