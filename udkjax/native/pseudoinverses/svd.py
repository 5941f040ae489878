"""D^+ by singular values (`udkjax.pinv.SVD`): one-sided Jacobi rotations of the rows of R, where D = Q R with column pivoting.

Pairs of rows of [R I] are rotated until all rows of R are mutually orthogonal (Hestenes 1958): R = U^T S, where the lengths of
the rows s_i of S are the singular values of D, to high relative accuracy, and

    D^+ b = sum_i s_i (U Q^T b)_i / |s_i|^2    over all rows longer than the threshold.

The rows of R are nearly orthogonal initially, which saves sweeps (Drmac, Veselic, SIAM J. Matrix Anal. 29 (2008) 1322).
"""

from dataclasses import dataclass

from udkjax.native.language.ir import INT, Operand, Value
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod, MatrixRow
from udkjax.native.pseudoinverses.qr import apply_q, apply_q_transposed, pivoted_qr, qr_matrices

SWEEPS = 30  # maximum number of sweeps; six to eight are usual
ORTHOGONAL_TOL = 1e-15  # largest cosine of the angle between rows that count as orthogonal


@dataclass(frozen=True)
class SVDCode(DenseMethod):
    """The method of singular values.

    Rows of D become the right singular vectors times the singular values; rows of `u`, multiplied by Q, are the left singular
    vectors. Entries of `lengths` become the inverse squares of the singular values, or zero beyond the rank.
    """

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        steps = min(m, n)
        return qr_matrices(m, n) | {"u": (steps, steps), "lengths": (1, steps)}

    def factor(self, d: DenseMatrices):
        f, squares = d.f, d.row("lengths")
        pivoted_qr(d, lambda _: d.wide(0.0))
        with f.each(d.steps) as i:
            row = d.row("u", i)
            row.clear()
            row.put(i, d.wide(1.0))
        has_rotated, sweep = f.variable(1, INT, 1), f.variable(0, INT, 1)
        with f.while_(lambda: (has_rotated.value > 0) & (sweep.value < SWEEPS)):
            has_rotated.value = 0
            sweep.value = sweep.value + 1
            with f.each(d.steps) as i:
                row = d.row("D", i)
                squares.put(i, d.dot(row, row))
            with f.each(d.steps) as i, f.each(d.steps, i + 1) as j:
                row_i, row_j = d.row("D", i), d.row("D", j)
                a, c, g = squares.entry(i), squares.entry(j), d.dot(row_i, row_j)
                rotates = g * g > a * c * (ORTHOGONAL_TOL * ORTHOGONAL_TOL)
                with f.if_(f.any_of(rotates)):
                    has_rotated.value = 1
                    zeta = (c - a) / f.select(rotates, g * 2.0, 1.0)
                    root = d.sqrt(f.fma(zeta, zeta, 1.0))
                    tangent = f.select(zeta < 0.0, -1.0, d.wide(1.0)) / (f.abs(zeta) + root)
                    tangent = f.select(rotates, tangent, 0.0)
                    cosine = 1.0 / d.sqrt(f.fma(tangent, tangent, 1.0))
                    sine = cosine * tangent
                    self._turn(d, row_i, row_j, cosine, sine)
                    self._turn(d, d.row("u", i), d.row("u", j), cosine, sine)
                    squares.put(i, a - tangent * g)
                    squares.put(j, f.fma(tangent, g, c))
        longest = f.variable(0.0)
        with f.each(d.steps) as i:
            row = d.row("D", i)
            square = d.dot(row, row)
            squares.put(i, square)
            longest.value = f.max(square, longest.value)
        threshold, rank = d.threshold(self, longest.value), f.variable(0.0)
        with f.each(d.steps) as i:
            square = squares.entry(i)
            counts = square > threshold
            rank.value = rank.value + f.select(counts, d.wide(1.0), 0.0)
            squares.put(i, f.select(counts, 1.0 / f.select(counts, square, 1.0), 0.0))
        d.row("rank").put(0, rank.value)

    def _turn(self, d: DenseMatrices, row_i: MatrixRow, row_j: MatrixRow, cosine: Value, sine: Value):
        f, c, s = d.f, d.spread(cosine), d.spread(sine)

        def turn(r: Operand):
            p, q = row_i[r], row_j[r]
            row_i[r] = f.fma(c, p, -(s * q))
            row_j[r] = f.fma(s, p, c * q)

        d.over_registers(row_i.registers, turn)

    def solve(self, d: DenseMatrices):
        b, x = d.row("b"), d.row("x")
        apply_q_transposed(d)
        x.clear()
        with d.f.each(d.steps) as i:
            d.axpy(d.dot(d.row("u", i), b) * d.row("lengths").entry(i), d.row("D", i), x)

    def solve_transposed(self, d: DenseMatrices):
        """Write the transposed solution: the row `b` becomes (D^+)^T x."""
        b, x = d.row("b"), d.row("x")
        b.clear()
        with d.f.each(d.steps) as i:
            d.axpy(d.dot(d.row("D", i), x) * d.row("lengths").entry(i), d.row("u", i), b)
        apply_q(d)
