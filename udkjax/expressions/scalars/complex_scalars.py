"""Complex numbers made of scalars, and complex linear systems with pivots chosen separately for each member of a batch."""

from collections.abc import Sequence
from typing import NamedTuple

from udkjax.expressions.scalars.graph import Scalar
from udkjax.expressions.scalars.selection import absolute, greater, where


class ComplexScalar(NamedTuple):
    """A complex number by its real and imaginary parts."""

    re: Scalar
    im: Scalar

    def __add__(self, other: "ComplexScalar") -> "ComplexScalar":
        return ComplexScalar(self.re + other.re, self.im + other.im)

    def __sub__(self, other: "ComplexScalar") -> "ComplexScalar":
        return ComplexScalar(self.re - other.re, self.im - other.im)

    def __neg__(self) -> "ComplexScalar":
        return ComplexScalar(-self.re, -self.im)

    def __mul__(self, other: "ComplexScalar") -> "ComplexScalar":
        return ComplexScalar(self.re * other.re - self.im * other.im, self.re * other.im + self.im * other.re)

    def scaled(self, factor: Scalar) -> "ComplexScalar":
        """Return this number times a real factor."""
        return ComplexScalar(self.re * factor, self.im * factor)

    @property
    def conjugate(self) -> "ComplexScalar":
        """The complex conjugate."""
        return ComplexScalar(self.re, -self.im)

    @property
    def squared_modulus(self) -> Scalar:
        """The squared modulus, |z|^2."""
        return self.re * self.re + self.im * self.im

    def inverse(self) -> "ComplexScalar":
        """Return 1/z."""
        return self.conjugate.scaled(1.0 / self.squared_modulus)


def solve_complex(
    matrix: Sequence[Sequence[ComplexScalar]], right: Sequence[Sequence[ComplexScalar]]
) -> list[list[ComplexScalar]]:
    """Solve A X = B by Gaussian elimination with partial pivoting, separately for each member of a batch.

    Args:
        matrix: The rows of A (n, n).
        right: The rows of B (n, k).

    Returns:
        The rows of X (n, k).
    """
    n = len(matrix)
    rows = [[*a, *b] for a, b in zip(matrix, right, strict=True)]
    inverses = []
    for k in range(n):
        for i in range(k + 1, n):
            rows[k], rows[i] = _larger_first(rows[k], rows[i], k)
        inverses.append(rows[k][k].inverse())
        for i in range(k + 1, n):
            factor = rows[i][k] * inverses[k]
            rows[i] = [*rows[i][: k + 1], *(x - factor * y for x, y in zip(rows[i][k + 1 :], rows[k][k + 1 :], strict=True))]
    for k in reversed(range(n)):
        solution = rows[k][n:]
        for j in range(k + 1, n):
            solution = [x - rows[k][j] * y for x, y in zip(solution, rows[j][n:], strict=True)]
        rows[k] = [*rows[k][:n], *(x * inverses[k] for x in solution)]
    return [row[n:] for row in rows]


def _larger_first(a: list[ComplexScalar], b: list[ComplexScalar], k: int) -> tuple[list[ComplexScalar], list[ComplexScalar]]:
    """Return two rows, the row with the larger entry k first; entries before k are not exchanged."""
    swap = greater(absolute(b[k].re) + absolute(b[k].im), absolute(a[k].re) + absolute(a[k].im))

    def choose(yes: ComplexScalar, no: ComplexScalar) -> ComplexScalar:
        return ComplexScalar(where(swap, yes.re, no.re), where(swap, yes.im, no.im))

    pairs = list(zip(a[k:], b[k:], strict=True))
    return [*a[:k], *(choose(y, x) for x, y in pairs)], [*b[:k], *(choose(x, y) for x, y in pairs)]
