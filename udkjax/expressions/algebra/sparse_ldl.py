"""The factorization A = L diag(p) L^T of a symmetric matrix of scalars, unrolled: structural zeros are never computed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from udkjax.expressions.algebra.differential import SparseRow
from udkjax.expressions.scalars.graph import Graph, Scalar


class SparseLDL(NamedTuple):
    """The factors of a symmetric matrix A.

    They solve A x = b, or the system of only the first `count` rows and columns in the order of elimination (None: of all).
    """

    order: Sequence[int]  # of elimination
    inverse: Sequence[Scalar]  # 1 / p by row; zero for a row that is left out
    below: Sequence[SparseRow]  # for each row r, the entries L[i, r] of the rows i after it

    def forward(self, b: Sequence[Scalar], count: int | None = None) -> list[Scalar]:
        """Return L^(-1) b of the first `count` rows and columns of the order; the other entries of b are returned unchanged."""
        y, rows = list(b), self.order[:count]
        for r in rows:
            for i, entry in self.below[r].items():
                if i in rows:
                    y[i] = y[i] - entry * y[r]
        return y

    def backward(self, y: Sequence[Scalar], count: int | None = None) -> list[Scalar]:
        """Return L^(-T) y of the first `count` rows and columns of the order; the other entries of y are returned unchanged."""
        x, rows = list(y), self.order[:count]
        for r in reversed(rows):
            for i, entry in self.below[r].items():
                if i in rows:
                    x[r] = x[r] - entry * x[i]
        return x

    def transposed(self, x: Sequence[Scalar]) -> list[Scalar]:
        """Return L^T x."""
        return [sum((entry * x[i] for i, entry in self.below[r].items()), x[r]) for r in range(len(x))]

    def solve(self, b: Sequence[Scalar], count: int | None = None) -> list[Scalar]:
        """Return A^(-1) b of the first `count` rows and columns of the order; the other entries of the result are zero."""
        y, rows = self.forward(b, count), self.order[:count]
        scaled = [s * inverse if r in rows else s.graph.constant(0.0) for r, (s, inverse) in enumerate(zip(y, self.inverse))]
        return self.backward(scaled, count)


def factorize(
    graph: Graph, matrix: Sequence[SparseRow], order: Sequence[int], invert: Callable[[int, Scalar, Scalar], Scalar]
) -> SparseLDL:
    """Factorize a symmetric matrix in a given order, without pivoting.

    Args:
        graph: The graph of the entries.
        matrix: The rows of the matrix, each by column. Only the lower triangle is read.
        order: The order of elimination.
        invert: Function that returns the reciprocal of a pivot, given the index of its row, the pivot, and the diagonal entry of
            that row in `matrix`; zero leaves the row out.

    Returns:
        The factors.
    """
    place, zero = {r: k for k, r in enumerate(order)}, graph.constant(0.0)
    columns: list[SparseRow] = [{} for _ in matrix]  # the entries of rows at or after r
    for i, row in enumerate(matrix):
        for j, entry in row.items():
            if j <= i and not entry.is_zero:
                first, later = sorted((i, j), key=place.__getitem__)
                columns[first][later] = entry
    inverse: dict[int, Scalar] = {}
    below: list[SparseRow] = [{} for _ in matrix]
    for r in order:
        column = columns[r]
        inverse[r] = invert(r, column.pop(r, zero), matrix[r].get(r, zero))
        below[r] = {i: entry * inverse[r] for i, entry in sorted(column.items(), key=lambda x: place[x[0]])}
        rows = list(below[r])
        for k, j in enumerate(rows):
            for i in rows[k:]:
                change = below[r][i] * column[j]
                columns[j][i] = columns[j][i] - change if i in columns[j] else -change
    return SparseLDL(order, [inverse[r] for r in range(len(matrix))], below)
