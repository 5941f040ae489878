"""Sparse rows: which entries of a matrix can be nonzero, and the straight-line elimination that this fixes.

For independent rows, D^+ = D^T (D D^T)^-1. D D^T is formed and factorized as L diag(p) L^T on scalars, in an order of least
fill that is chosen once: no loop, no index and no structural zero is left in the program. A pivot that is small against the
diagonal entry of its row (both are squares of lengths: p_i is what remains of row i when the rows before it are taken out)
says that the row depends on them; it is dropped, and counted out of the rank.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from udkjax.expressions import Graph, Scalar
from udkjax.expressions.differential import Row
from udkjax.expressions.selection import absolute, greater, maximum, where
from udkjax.pinv.elimination_order import minimum_degree

AnyArray = TypeVar("AnyArray", jax.Array, np.ndarray)


class PatternEntry(NamedTuple):
    """A nonzero entry: `sign` times the value number `value`. Equal entries share their value."""

    row: int
    column: int
    value: int
    sign: int


class Pattern(NamedTuple):
    """Where the entries of an (m, n) matrix lie; the matrix itself is the vector of its distinct values."""

    shape: tuple[int, int]
    entries: tuple[PatternEntry, ...]

    @property
    def value_count(self) -> int:
        return 1 + max((e.value for e in self.entries), default=-1)

    def dense(self, values: AnyArray, numpy: ModuleType) -> AnyArray:
        """Return the matrix of the given values (value_count,)."""
        place, sign = np.full(self.shape, self.value_count), np.zeros(self.shape)
        for e in self.entries:
            place[e.row, e.column], sign[e.row, e.column] = e.value, e.sign
        return numpy.append(values, 0.0)[place] * sign


def find_pattern(rows: Sequence[Row], columns: int) -> tuple[Pattern, list[Scalar]]:
    """Return the pattern of rows of scalars, and the distinct scalars themselves."""
    slots: dict[int, int] = {}
    values: list[Scalar] = []
    entries = []
    for i, row in enumerate(rows):
        for k, scalar in sorted(row.items()):
            if scalar.index not in slots:
                slots[scalar.index] = len(values)
                values.append(Scalar(scalar.graph, scalar.index))
            entries.append(PatternEntry(i, k, slots[scalar.index], scalar.sign))
    return Pattern((len(rows), columns), tuple(entries)), values


class SparseFactors(NamedTuple):
    """L diag(p) L^T, factorized in the given order."""

    order: list[int]
    lower: list[dict[int, Scalar]]  # by columns, without the unit diagonal
    inverse_pivots: list[Scalar]
    pivots: list[tuple[Scalar, Scalar]]  # each with its row's diagonal entry

    def exceeding(self, fraction: Scalar | float) -> list[Scalar]:
        """Whether each pivot exceeds this fraction of its row's diagonal entry, in the order of elimination."""
        return [greater(pivot, diagonal * fraction) for pivot, diagonal in self.pivots]

    def distance(self, graph: Graph) -> Scalar:
        """The distance from dependence: the root of the smallest pivot relative to its diagonal entry; infinite of no rows."""
        one = graph.constant(1.0)
        times = [absolute(diagonal * (one / pivot)) for pivot, diagonal in self.pivots]  # by the reciprocals that are there
        while len(times) > 1:  # by halves, so that few wait for others
            times = [*map(maximum, times[::2], times[1::2]), *times[len(times) // 2 * 2 :]]
        return one / graph.sqrt(times[0]) if times else graph.constant(np.inf)


def factorize(rows: Sequence[Row], graph: Graph, drop_tol: Scalar | None = None) -> SparseFactors:
    """D D^T = L diag(p) L^T. A pivot that does not exceed `drop_tol` times its row's diagonal entry takes its row out.

    Zero stands for its reciprocal. Without `drop_tol` no pivot is looked at, and no other waits for that.
    """
    order = minimum_degree([set(row) for row in rows])
    place = {row: j for j, row in enumerate(order)}
    meets: dict[int, list[int]] = {}
    for i, row in enumerate(rows):
        for k in row:
            meets.setdefault(k, []).append(i)
    zero = graph.constant(0.0)
    column: list[dict[int, Scalar]] = [{} for _ in rows]  # the lower triangle of D D^T, by columns
    for k in sorted(meets):
        for i in meets[k]:
            for j in meets[k]:
                if place[j] <= place[i]:
                    target = column[place[j]]
                    target[place[i]] = target.get(place[i], zero) + rows[i][k] * rows[j][k]
    return SparseFactors(order, column, *eliminate(column, len(rows), graph, drop_tol))


def eliminate(
    column: list[dict[int, Scalar]], count: int, graph: Graph, drop_tol: Scalar | None = None
) -> tuple[list[Scalar], list[tuple[Scalar, Scalar]]]:
    """Eliminate the first rows of a symmetric matrix, given by the columns of its lower triangle.

    Their columns become those of L, without the unit diagonal; what is left of the others is in their place. Returns the
    reciprocals of the pivots, and the pivots, each with its row's diagonal entry.
    """
    zero, one = graph.constant(0.0), graph.constant(1.0)
    diagonal = [column[j].get(j, zero) for j in range(count)]
    inverse, pivots = [], []
    for j in range(count):
        d = column[j].get(j, zero)
        inverse.append(one / d if drop_tol is None else where(greater(d, diagonal[j] * drop_tol), one / d, zero))
        pivots.append((d, diagonal[j]))
        below = sorted(i for i in column[j] if i > j)
        lower = {i: column[j][i] * inverse[j] for i in below}
        for i in below:
            for k in below:
                if k <= i:
                    column[k][i] = column[k].get(i, zero) - lower[i] * column[j][k]
        column[j] = lower
    return inverse, pivots


def solve(factors: SparseFactors, b: Sequence[Scalar]) -> list[Scalar]:
    """y with D D^T y = b, zero where a row was dropped."""
    y = substitute_backward(
        factors.lower, factors.inverse_pivots, substitute_forward(factors.lower, [b[i] for i in factors.order])
    )
    result: list[Scalar] = [b[0]] * len(b)
    for j, i in enumerate(factors.order):
        result[i] = y[j]
    return result


def substitute_forward(lower: Sequence[dict[int, Scalar]], b: Sequence[Scalar]) -> list[Scalar]:
    """L^-1 b; for rows beyond the columns of L, the remainder."""
    y = list(b)
    for j, entries in enumerate(lower):
        for i, entry in entries.items():
            y[i] = y[i] - entry * y[j]
    return y


def substitute_backward(
    lower: Sequence[dict[int, Scalar]], inverse_pivots: Sequence[Scalar], y: Sequence[Scalar]
) -> list[Scalar]:
    """x with diag(p) L^T x = y; beyond the columns of L, y is x."""
    x = list(y)
    for j in reversed(range(len(inverse_pivots))):
        x[j] = x[j] * inverse_pivots[j]
        for i, entry in reversed(lower[j].items()):  # what was found last comes last: nothing else waits for it
            x[j] = x[j] - entry * x[i]
    return x


def transpose_times(rows: Sequence[Row], y: Sequence[Scalar], columns: int, zero: Scalar) -> list[Scalar]:
    """D^T y."""
    x = [zero] * columns
    for row, multiplier in zip(rows, y, strict=True):
        for k, entry in row.items():
            x[k] = x[k] + entry * multiplier
    return x
