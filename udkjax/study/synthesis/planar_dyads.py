"""The equations of dyads and four-bars in real coordinates, for numbers and for balls.

A dyad has its moving joint at x from the traced point, and its crank leads there from the fixed joint by r, both in the first
position. Where the point has moved by d and the link has turned by the angle of cosine 1 + p and sine s, the joint has moved by
e, and the crank is as long as before:

    g(x, r) = e . e / 2 + e . r = 0,      e = d + [[p, -s], [s, p]] x.
"""

from typing import Any, NamedTuple

import numpy as np

from udkjax.study.synthesis.balls import LONG, Ball

Numbers = Any  # arrays or balls


class Displacements(NamedTuple):
    """Ways of the traced point from its first position (J, 1), and cosines less one and sines of turns, where known."""

    x: Numbers
    y: Numbers
    p: Numbers = None
    s: Numbers = None


class DyadEquations(NamedTuple):
    """g at all displacements (J, M), and its derivatives by x (two), r (two), p and s, (6, J, M)."""

    g: Numbers
    slopes: tuple[Numbers, ...]


def dyad_equations(x: Numbers, y: Numbers, a: Numbers, b: Numbers, d: Displacements) -> DyadEquations:
    """Return the equations of a moving joint (x, y) and a crank (a, b)."""
    p, s = d.p, d.s
    ex, ey = d.x + (p * x - s * y), d.y + (s * x + p * y)
    wx, wy = ex + a, ey + b
    g = (ex * ex + ey * ey) * 0.5 + (ex * a + ey * b)
    return DyadEquations(g, (p * wx + s * wy, p * wy - s * wx, ex, ey, wx * x + wy * y, wy * x - wx * y))


def dyad_system(d: Displacements):
    """Return the system of one dyad whose link's angles are given: four equations for the joint and the crank."""

    def system(u: Ball) -> tuple[Ball, Ball]:
        x, y, a, b = (u.part(k) for k in range(4))
        found = dyad_equations(x, y, a, b, d)
        slopes = found.slopes[:4]
        mid, rad = (np.stack([_full(getattr(s, part), found.g.mid.shape) for s in slopes], 1) for part in Ball._fields)
        return found.g, Ball(mid, rad)

    return system


def four_bar_system(d: Displacements):
    """Return the system of a four-bar through points: for two dyads and the J turns of their link.

    The unknowns are joint and crank of the first dyad, of the second one, J cosines less one, J sines; the equations g of both,
    and (p^2 + s^2) / 2 + p = 0.
    """

    def system(u: Ball) -> tuple[Ball, Ball]:
        J = len(d.x.mid)
        p, s = u.part(slice(8, 8 + J)), u.part(slice(8 + J, 8 + 2 * J))
        turned, places = d._replace(p=p, s=s), np.arange(J)
        x, y, a, b, *others = [u.part(k) for k in range(8)]
        parts = [dyad_equations(x, y, a, b, turned), dyad_equations(*others, d=turned)]
        unit = (p * p + s * s) * 0.5 + p
        values = [*(part.g for part in parts), unit]
        F = Ball(*(np.concatenate([getattr(v, name) for v in values]) for name in Ball._fields))
        shape, M = (3 * J, 8 + 2 * J), u.mid.shape[1]
        mid, rad = np.zeros((*shape, M), LONG), np.zeros((*shape, M))
        for k, part in enumerate(parts):
            rows = k * J + places
            columns = [*range(4 * k, 4 * k + 4), 8 + places, 8 + J + places]
            for column, slope in zip(columns, part.slopes, strict=True):
                mid[rows, column], rad[rows, column] = slope.mid, slope.rad
        for column, slope in ((8, p + 1.0), (8 + J, s)):
            mid[2 * J + places, column + places], rad[2 * J + places, column + places] = slope.mid, slope.rad
        return F, Ball(mid, rad)

    return system


def _full(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(x, shape)
