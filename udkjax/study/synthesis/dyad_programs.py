"""The equations of path synthesis in isotropic coordinates, as a program of Newton steps and tangents for batches of paths.

A point p = (px, py) of the plane is the pair of complex numbers z = px + i py and Z = px - i py; both are unknowns of their
own, so that complex solutions count, too. A dyad has its moving joint at x from the traced point, and its crank leads there
from the fixed one by r, both with the link in its first position. Where the point has gone by d and the link has turned by the
angle of 1 + f, |1 + f| = 1, the joint has gone by e, and the crank is as long as before:

    g(x, X, r, R, f; d, D) = e E + e R + E r = 0,      e = d + f x,      E = D + F X,      F = 1 / (1 + f) - 1.

Of a four-bar, two dyads (x, r) and (y, s) share f. Nine points give eight displacements: sixteen equations for x, X, r, R, y,
Y, s, S and f_1 to f_8. Each f_j is in two of them, and is eliminated first. Written in this way nothing is lost where links are
long: their turns f are small then, and no large terms cancel.
"""

from udkjax.expressions import Graph, ScalarProgram
from udkjax.expressions.complex_scalars import ComplexScalar, solve_complex
from udkjax.expressions.selection import absolute

JOINTS = 8  # unknowns besides the turns: x, X, r, R, y, Y, s, S
POINTS = 8  # displacements from the first of nine points
UNKNOWNS = JOINTS + POINTS
LEAST = 1e-3  # unit: least scale of a joint, so that pivots are chosen by their effect


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
    sizes = [absolute(z.re) + absolute(z.im) + LEAST for z in unknowns[:JOINTS]]
    for j, f in enumerate(unknowns[JOINTS:]):
        d, D = (start[k] + s * rates[k] for k in (j, j + POINTS))
        moves = rates[j], rates[j + POINTS]
        dyads = [_dyad(unknowns[k : k + 4], f, d, D, moves) for k in (0, 4)]
        (u, row, r), (v, other, q) = dyads
        size = one / (u.squared_modulus + v.squared_modulus)
        scale = graph.sqrt(size)
        left, cross = v.scaled(scale), -u.scaled(scale)
        entries = [*(left * x for x in row), *(cross * x for x in other)]
        entries = [x.scaled(size) for x, size in zip(entries, sizes, strict=True)]
        weight = one / sum((absolute(x.re) + absolute(x.im) for x in entries), graph.constant(0.0))
        matrix.append([x.scaled(weight) for x in entries])
        right.append([(left * a + cross * b).scaled(weight) for a, b in zip(r, q, strict=True)])
        turns.append((u.conjugate.scaled(size), v.conjugate.scaled(size), dyads))
    found = [[x.scaled(size) for x in row] for row, size in zip(solve_complex(matrix, right), sizes, strict=True)]
    for u, v, ((_, row, r), (_, other, q)) in turns:
        rest = [_minus(r, row, found[:4]), _minus(q, other, found[4:JOINTS])]
        found.append([u * a + v * b for a, b in zip(*rest, strict=True)])
    outputs = [getattr(row[k], part) for k in (0, 1) for part in ("re", "im") for row in found]
    return ScalarProgram(graph, inputs, outputs)


def _dyad(
    joints: list[ComplexScalar], f: ComplexScalar, d: ComplexScalar, D: ComplexScalar, moves: tuple[ComplexScalar, ComplexScalar]
) -> tuple[ComplexScalar, list[ComplexScalar], list[ComplexScalar]]:
    """Return the derivative of g by f, those by x, X, r, R, and minus g and minus its derivative by s."""
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
