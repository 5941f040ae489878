"""Symbolic factorization of a sparse matrix of scalars, done while the graph is built.

Constant entries are the first pivots, in the sparsest rows and columns: no input can make them small. The rest of the
matrix A (m, n), m >= n, of full column rank, is triangularized by Givens rotations, which need no pivoting either: all members of
a batch run the same operations. With E for the row operations, E A = [U, V; 0, B], B = Q R,

    A x = b:      B x_2 = (E b)_2 by R x_2 = Q^T (E b)_2, then U x_1 = (E b)_1 - V x_2,
    A^T y = c:    the same operations transposed, in the reverse order.

If redundant rows contradict each other, x solves the remaining rows by least squares.
"""

from collections.abc import Sequence

from udkjax.expressions.algebra.differential import SparseRow
from udkjax.expressions.scalars.graph import Graph, Scalar

# Smallest constant pivot, relative to the largest constant entry of its row: the cosine of a right angle, 6e-17, is not a pivot.
# Other pivots lose at most three digits.
LEAST_PIVOT = 1e-3


class SymbolicFactors:
    """The factors of a sparse matrix of scalars.

    Args:
        graph: The graph of all entries.
        rows: The entries of each row by column; absent entries are zero.
        columns: The number n of columns.

    Raises:
        ValueError: There are fewer rows than columns, or a column that no row can determine.
    """

    def __init__(self, graph: Graph, rows: Sequence[SparseRow], columns: int):
        if len(rows) < columns:
            raise ValueError(f"{len(rows)} rows cannot determine {columns} unknowns")
        self._graph = graph
        self._rows = [{k: x for k, x in row.items() if not x.is_zero} for row in rows]
        self._sizes = [max((abs(x.constant) for x in row.values() if x.constant is not None), default=0.0) for row in self._rows]
        self._pivots: list[tuple[int, int]] = []
        self._operations: list[tuple[int, int, Scalar]] = []  # (i, r, factor): row i minus factor times row r
        while (pivot := self._sparsest_constant()) is not None:
            self._eliminate(*pivot)
        pivot_columns = {c for _, c in self._pivots}
        used = {r for r, _ in self._pivots}
        self.open_columns = [c for c in range(columns) if c not in pivot_columns]
        self._open_rows = [r for r in range(len(rows)) if r not in used]
        zero = graph.constant(0.0)
        self.block = [[self._rows[r].get(c, zero) for c in self.open_columns] for r in self._open_rows]
        """The block B: the remaining rows, in the columns without a constant pivot."""
        self._rotations: list[tuple[int, int, Scalar, Scalar]] = []
        self.triangle = self._rotate([list(row) for row in self.block])

    def solve(self, right: Sequence[Scalar]) -> list[Scalar]:
        """Solve A x = b for x."""
        b = list(right)
        for i, r, factor in self._operations:
            b[i] = b[i] - factor * b[r]
        y = [b[r] for r in self._open_rows]
        for i, j, c, s in self._rotations:
            y[i], y[j] = c * y[i] + s * y[j], c * y[j] - s * y[i]
        R, count = self.triangle, len(self.open_columns)
        for k in reversed(range(count)):
            y[k] = (y[k] - sum((R[k][j] * y[j] for j in range(k + 1, count)), self._graph.constant(0.0))) / R[k][k]
        x = dict(zip(self.open_columns, y, strict=False))
        for r, c in reversed(self._pivots):
            row = self._rows[r]
            other_terms = sum((a * x[j] for j, a in row.items() if j != c), self._graph.constant(0.0))
            x[c] = (b[r] - other_terms) / row[c]
        return [x[c] for c in range(len(x))]

    def solve_transposed(self, right: Sequence[Scalar]) -> list[Scalar]:
        """Solve A^T y = c for y.

        With more rows than columns, y is not unique: its entries in the rows of B are those of least norm.
        """
        c, y = list(right), [self._graph.constant(0.0)] * len(self._rows)
        for r, k in self._pivots:
            y[r] = c[k] / self._rows[r][k]
            for j, a in self._rows[r].items():
                if j != k:
                    c[j] = c[j] - a * y[r]
        for r, x in zip(self._open_rows, self.block_transposed([c[k] for k in self.open_columns]), strict=True):
            y[r] = x
        for i, r, factor in reversed(self._operations):
            y[r] = y[r] - factor * y[i]
        return y

    def block_transposed(self, right: Sequence[Scalar]) -> list[Scalar]:
        """Return y = Q R^(-T) c, for which B^T y = c."""
        R, count = self.triangle, len(self.open_columns)
        y = [*right, *[self._graph.constant(0.0)] * (len(self._open_rows) - count)]
        for k in range(count):
            y[k] = (y[k] - sum((R[j][k] * y[j] for j in range(k)), self._graph.constant(0.0))) / R[k][k]
        for i, j, c, s in reversed(self._rotations):
            y[i], y[j] = c * y[i] - s * y[j], s * y[i] + c * y[j]
        return y

    def _sparsest_constant(self) -> tuple[int, int] | None:
        """Return the row and the column of the constant entry that causes the least fill as a pivot; None if none is left.

        Entries that are small compared with their row are no pivots (`LEAST_PIVOT`).
        """
        used = {r for r, _ in self._pivots}
        counts: dict[int, int] = {}
        remaining = [(r, row) for r, row in enumerate(self._rows) if r not in used]
        for _, row in remaining:
            for c in row:
                counts[c] = counts.get(c, 0) + 1
        costs = [
            ((len(row) - 1) * (counts[c] - 1), r, c)
            for r, row in remaining
            for c, a in row.items()
            if a.constant is not None and abs(a.constant) >= LEAST_PIVOT * self._sizes[r]
        ]
        return min(costs)[1:] if costs else None

    def _eliminate(self, r: int, c: int):
        used, pivot = {row for row, _ in self._pivots}, self._rows[r]
        self._pivots.append((r, c))
        for i, row in enumerate(self._rows):
            if i == r or i in used or c not in row:
                continue
            factor = row.pop(c) / pivot[c]
            self._operations.append((i, r, factor))
            for j, a in pivot.items():
                if j != c:
                    row[j] = row[j] - factor * a if j in row else -(factor * a)
            self._rows[i] = {k: x for k, x in row.items() if not x.is_zero}

    def _rotate(self, a: list[list[Scalar]]) -> list[list[Scalar]]:
        """Triangularize B = `a` in place by rotations of pairs of its rows, note these in `self._rotations`, and return R."""
        graph = self._graph
        for k in range(len(self.open_columns)):
            for j in range(k + 1, len(a)):
                if a[j][k].is_zero:
                    continue
                if a[k][k].is_zero:
                    c, s = graph.constant(0.0), graph.constant(1.0)
                else:
                    inverse = 1.0 / graph.sqrt(a[k][k] * a[k][k] + a[j][k] * a[j][k])
                    c, s = a[k][k] * inverse, a[j][k] * inverse
                self._rotations.append((k, j, c, s))
                a[k], a[j] = (
                    [c * x + s * y for x, y in zip(a[k], a[j], strict=True)],
                    [c * y - s * x for x, y in zip(a[k], a[j], strict=True)],
                )
                a[j][k] = graph.constant(0.0)
            if a[k][k].is_zero:
                raise ValueError(f"no row determines unknown {self.open_columns[k]}")
        return a
