"""The equations of path synthesis in isotropic coordinates, as a program of Newton steps and tangents for batches of paths.

A point p = (px, py) of the plane is the pair of complex numbers z = px + i py and Z = px - i py; both are unknowns of their
own, so that complex solutions count, too. A dyad has its moving joint at x from the traced point, its fixed one at a, both
with the link in its first position; where the point has gone by d and the link has turned by the angle of t, |t| = 1, the
crank is as long as before:

    g(x, X, a, A, t; d, D) = t x (D - A) + X (d - a) / t + d D - a D - A d + x A + X a = 0.

Of a four-bar, two dyads (x, a) and (y, b) share t. Nine points give eight displacements: sixteen equations for x, X, a, A, y,
Y, b, B and t_1 to t_8. Each t_j is in two of them, and is eliminated first.
"""

from udkjax.expressions import Graph, ScalarProgram
from udkjax.expressions.complex_scalars import ComplexScalar, solve_complex

JOINTS = 8  # unknowns besides the turns: x, X, a, A, y, Y, b, B
POINTS = 8  # displacements from the first of nine points
UNKNOWNS = JOINTS + POINTS


def newton_and_tangent() -> ScalarProgram:
    """Return the program: from unknowns, s and displacements at s = 0 and their rates to the Newton step and the rate dz/ds.

    Inputs: real parts, then imaginary parts of the 16 unknowns; of s; of the displacements d_1 to d_8, D_1 to D_8 at s = 0; of
    their derivatives by s. Outputs: real and imaginary parts of the step; of the rate.
    """
    graph, inputs = Graph(), []

    def numbers(name: str, count: int) -> list[ComplexScalar]:
        parts = [[graph.input(f"{name}{part}{k}", name) for k in range(count)] for part in ("re", "im")]
        inputs.extend([*parts[0], *parts[1]])
        return [ComplexScalar(*pair) for pair in zip(*parts, strict=True)]

    unknowns, (s,) = numbers("z", UNKNOWNS), numbers("s", 1)
    start, rates = numbers("p", 2 * POINTS), numbers("v", 2 * POINTS)
    one = graph.constant(1.0)
    matrix, right, turns = [], [], []
    for j, t in enumerate(unknowns[JOINTS:]):
        d, D = (start[k] + s * rates[k] for k in (j, j + POINTS))
        moves = rates[j], rates[j + POINTS]
        dyads = [_dyad(unknowns[k : k + 4], t, d, D, moves) for k in (0, 4)]
        (u, row, r), (v, other, q) = dyads
        size = one / (u.squared_modulus + v.squared_modulus)
        scale = graph.sqrt(size)
        left, cross = v.scaled(scale), -u.scaled(scale)
        matrix.append([*(left * x for x in row), *(cross * x for x in other)])
        right.append([left * a + cross * b for a, b in zip(r, q, strict=True)])
        turns.append((u.conjugate.scaled(size), v.conjugate.scaled(size), dyads))
    found = solve_complex(matrix, right)
    for u, v, ((_, row, r), (_, other, q)) in turns:
        rest = [_minus(r, row, found[:4]), _minus(q, other, found[4:JOINTS])]
        found.append([u * a + v * b for a, b in zip(*rest, strict=True)])
    outputs = [getattr(row[k], part) for k in (0, 1) for part in ("re", "im") for row in found]
    return ScalarProgram(graph, inputs, outputs)


def _dyad(
    joints: list[ComplexScalar], t: ComplexScalar, d: ComplexScalar, D: ComplexScalar, moves: tuple[ComplexScalar, ComplexScalar]
) -> tuple[ComplexScalar, list[ComplexScalar], list[ComplexScalar]]:
    """Return the derivative of g by t, those by x, X, a, A, and minus g and minus its derivative by s."""
    x, X, a, A = joints
    inverse = t.inverse()
    turned, back = t * x, inverse * X
    e, E = d - a, D - A
    g = turned * E + back * e + d * D - a * D - A * d + x * A + X * a
    by_d, by_D = back + E, turned + e
    by_t = x * E - inverse * (back * e)
    return by_t, [t * E + A, inverse * e + a, X - back - D, x - turned - d], [-g, -(by_d * moves[0] + by_D * moves[1])]


def _minus(right: list[ComplexScalar], row: list[ComplexScalar], found: list[list[ComplexScalar]]) -> list[ComplexScalar]:
    for a, x in zip(row, found, strict=True):
        right = [r - a * y for r, y in zip(right, x, strict=True)]
    return right
