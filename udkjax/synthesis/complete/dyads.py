"""Equations of dyads and four-bars: in real coordinates for arrays and balls, in isotropic ones as a program for path tracking.

x points from the traced point of a dyad to its moving joint, and r from its fixed joint to the moving one, both in the first
position. If the point moves by d and the link turns by the angle with cosine 1 + p and sine s, the joint moves by e, and the
length of the crank is constant:

    g(x, r) = e . e / 2 + e . r = 0,      e = d + [[p, -s], [s, p]] x.

In isotropic coordinates a point p = (px, py) is the pair of complex numbers z = px + i py and Z = px - i py; they are
independent unknowns, so that complex solutions are included. With a turn by the angle of the complex number 1 + f, |1 + f| = 1,

    g(x, X, r, R, f; d, D) = e E + e R + E r = 0,      e = d + f x,      E = D + F X,      F = 1 / (1 + f) - 1.

The two dyads (x, r) and (y, s) of a four-bar share f. Nine points give eight displacements: sixteen equations for x, X, r, R, y,
Y, s, S and f_1 to f_8. Each f_j occurs in two of them, and is eliminated first. This form remains accurate if links are long:
their turns f are small, and no large terms cancel.
"""

from typing import Any, NamedTuple

import numpy as np

from udkjax.expressions import Graph, ScalarProgram
from udkjax.expressions.scalars.complex_scalars import ComplexScalar, solve_complex
from udkjax.expressions.scalars.selection import absolute
from udkjax.synthesis.complete.balls import LONG_DOUBLE, Ball

ArrayOrBall = Any  # arrays or balls


class Displacements(NamedTuple):
    """Displacements x, y of the traced point from its first position (J, 1), optionally with turns: cosines - 1, and sines."""

    x: ArrayOrBall
    y: ArrayOrBall
    p: ArrayOrBall = None
    s: ArrayOrBall = None


class DyadEquations(NamedTuple):
    """The values of g at all displacements (J, M), and six derivatives (J, M) each: by x (two), r (two), p and s."""

    g: ArrayOrBall
    slopes: tuple[ArrayOrBall, ...]


def dyad_equations(x: ArrayOrBall, y: ArrayOrBall, a: ArrayOrBall, b: ArrayOrBall, d: Displacements) -> DyadEquations:
    """Return the equations g of a dyad with the moving joint (x, y) and the crank (a, b), at displacements d."""
    p, s = d.p, d.s
    ex, ey = d.x + (p * x - s * y), d.y + (s * x + p * y)
    wx, wy = ex + a, ey + b
    g = (ex * ex + ey * ey) * 0.5 + (ex * a + ey * b)
    return DyadEquations(g, (p * wx + s * wy, p * wy - s * wx, ex, ey, wx * x + wy * y, wy * x - wx * y))


def dyad_system(d: Displacements):
    """Return the system of one dyad through five poses, as `certify` requires it: a function of the joint and the crank (4, M).

    It returns four equations and their derivatives, as balls. `d` includes the turns of the link.
    """

    def system(u: Ball) -> tuple[Ball, Ball]:
        x, y, a, b = (u.part(k) for k in range(4))
        equations = dyad_equations(x, y, a, b, d)
        slopes = equations.slopes[:4]
        mid, rad = (np.stack([_full(getattr(s, part), equations.g.mid.shape) for s in slopes], 1) for part in Ball._fields)
        return equations.g, Ball(mid, rad)

    return system


def four_bar_system(d: Displacements):
    """Return the system of a four-bar through points, as `certify` requires it: a function of unknowns (8 + 2 J, M).

    The unknowns are joint and crank of the first dyad, joint and crank of the second, J cosines minus one, and J sines of the
    turns of the coupler. The equations are g = 0 for both dyads, and (p^2 + s^2) / 2 + p = 0.
    """

    def system(u: Ball) -> tuple[Ball, Ball]:
        J = len(d.x.mid)
        p, s = u.part(slice(8, 8 + J)), u.part(slice(8 + J, 8 + 2 * J))
        turned, places = d._replace(p=p, s=s), np.arange(J)
        x, y, a, b, *second = [u.part(k) for k in range(8)]
        dyads = [dyad_equations(x, y, a, b, turned), dyad_equations(*second, d=turned)]
        unit = (p * p + s * s) * 0.5 + p
        values = [*(dyad.g for dyad in dyads), unit]
        F = Ball(*(np.concatenate([getattr(v, name) for v in values]) for name in Ball._fields))
        shape, M = (3 * J, 8 + 2 * J), u.mid.shape[1]
        mid, rad = np.zeros((*shape, M), LONG_DOUBLE), np.zeros((*shape, M))
        for k, dyad in enumerate(dyads):
            rows = k * J + places
            columns = [*range(4 * k, 4 * k + 4), 8 + places, 8 + J + places]
            for column, slope in zip(columns, dyad.slopes, strict=True):
                mid[rows, column], rad[rows, column] = slope.mid, slope.rad
        for column, slope in ((8, p + 1.0), (8 + J, s)):
            mid[2 * J + places, column + places], rad[2 * J + places, column + places] = slope.mid, slope.rad
        return F, Ball(mid, rad)

    return system


def _full(x: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return np.broadcast_to(x, shape)


# --- in isotropic coordinates

JOINT_UNKNOWNS = 8  # unknowns x, X, r, R, y, Y, s, S
DISPLACEMENTS = 8  # displacements from the first of nine points
UNKNOWNS = JOINT_UNKNOWNS + DISPLACEMENTS
LEAST_SCALE = 1e-3  # smallest scale of a joint coordinate, for the choice of pivots


def newton_and_tangent() -> ScalarProgram:
    """Return the program that maps unknowns, s, displacements at s = 0 and their rates to the Newton step and the rate dz/ds.

    Inputs: real parts, then imaginary parts, of the 16 unknowns, of s, of the displacements d_1 to d_8, D_1 to D_8 at s = 0, and
    of the derivatives of these with respect to s. Outputs: real and imaginary parts of the step and of the rate.
    """
    graph, inputs = Graph(), []

    def numbers(name: str, count: int) -> list[ComplexScalar]:
        parts = [[graph.input(f"{name}{part}{k}", name) for k in range(count)] for part in ("re", "im")]
        inputs.extend([*parts[0], *parts[1]])
        return [ComplexScalar(*pair) for pair in zip(*parts, strict=True)]

    unknowns, (s,) = numbers("z", UNKNOWNS), numbers("s", 1)
    start, rates = numbers("p", 2 * DISPLACEMENTS), numbers("v", 2 * DISPLACEMENTS)
    unit = graph.constant(1.0)
    matrix, right, turns = [], [], []
    sizes = [absolute(z.re) + absolute(z.im) + LEAST_SCALE for z in unknowns[:JOINT_UNKNOWNS]]
    for j, f in enumerate(unknowns[JOINT_UNKNOWNS:]):
        d, D = (start[k] + s * rates[k] for k in (j, j + DISPLACEMENTS))
        moves = rates[j], rates[j + DISPLACEMENTS]
        dyads = [_dyad(unknowns[k : k + 4], f, d, D, moves) for k in (0, 4)]
        (u, row, r), (v, other, q) = dyads
        size = unit / (u.squared_modulus + v.squared_modulus)
        scale = graph.sqrt(size)
        left, cross = v.scaled(scale), -u.scaled(scale)
        entries = [*(left * x for x in row), *(cross * x for x in other)]
        entries = [x.scaled(size) for x, size in zip(entries, sizes, strict=True)]
        weight = unit / sum((absolute(x.re) + absolute(x.im) for x in entries), graph.constant(0.0))
        matrix.append([x.scaled(weight) for x in entries])
        right.append([(left * a + cross * b).scaled(weight) for a, b in zip(r, q, strict=True)])
        turns.append((u.conjugate.scaled(size), v.conjugate.scaled(size), dyads))
    solution = [[x.scaled(size) for x in row] for row, size in zip(solve_complex(matrix, right), sizes, strict=True)]
    for u, v, ((_, row, r), (_, other, q)) in turns:
        remainders = [_minus(r, row, solution[:4]), _minus(q, other, solution[4:JOINT_UNKNOWNS])]
        solution.append([u * a + v * b for a, b in zip(*remainders, strict=True)])
    outputs = [getattr(row[k], part) for k in (0, 1) for part in ("re", "im") for row in solution]
    return ScalarProgram(graph, inputs, outputs)


def _dyad(
    joints: list[ComplexScalar], f: ComplexScalar, d: ComplexScalar, D: ComplexScalar, moves: tuple[ComplexScalar, ComplexScalar]
) -> tuple[ComplexScalar, list[ComplexScalar], list[ComplexScalar]]:
    """Return the derivatives of a dyad's g by f and by x, X, r, R, and the right-hand sides -g and -dg/ds.

    `moves` are the derivatives of d and D by s.
    """
    x, X, r, R = joints
    inverse = ComplexScalar(f.re + 1.0, f.im).inverse()
    F = -(f * inverse)
    e, E = d + f * x, D + F * X
    by_e, by_E = E + R, e + r
    g = e * by_e + E * r
    by_f = x * by_e - inverse * inverse * (X * by_E)
    return by_f, [f * by_e, F * by_E, E, e], [-g, -(by_e * moves[0] + by_E * moves[1])]


def _minus(right: list[ComplexScalar], row: list[ComplexScalar], found: list[list[ComplexScalar]]) -> list[ComplexScalar]:
    for a, x in zip(row, found, strict=True):
        right = [r - a * y for r, y in zip(right, x, strict=True)]
    return right
