"""Linear algebra of small matrices, expanded into operations on their elements: LU decomposition and triangular systems.

`jnp.linalg.solve`, `inv`, `det` and `slogdet` consist of these. Rows are exchanged by choices between scalars, with the pivots of
LAPACK. Beyond `MOST_ROWS` rows the choices are too many, and the primitive stays one opaque node.
"""

from typing import Any

import numpy as np
from jax import lax

from udkjax.expressions.scalars.graph import Graph, Scalar
from udkjax.expressions.scalars.selection import absolute, apply, greater, where

MOST_ROWS = 6  # a decomposition of n rows takes about n^3 operations


def is_small(*arrays: np.ndarray) -> bool:
    """Return True if the matrices in arrays are small enough to be expanded."""
    return all(max(a.shape, default=0) <= MOST_ROWS for a in arrays)


def decompose(graph: Graph, inputs: list[Any], equation: Any) -> list[np.ndarray] | None:
    """Return the outputs of `lu`, expanded; None if the matrices are too large.

    The outputs are L below the diagonal and U in one array, the row with which each row was exchanged, and the order of the rows.
    """
    matrices = inputs[0]
    *batch, m, n = matrices.shape
    if not is_small(matrices):
        return None
    dtype = np.dtype(equation.outvars[1].aval.dtype)
    number = [graph.constant(k, dtype) for k in range(m)]
    factors, pivots, orders = matrices.copy(), np.empty((*batch, min(m, n)), object), np.empty((*batch, m), object)
    for place in np.ndindex(*batch):
        rows = [[*row, k] for row, k in zip(matrices[place], number, strict=True)]  # each with its number
        for k in range(min(m, n)):
            pivots[(*place, k)] = pivot = _largest(rows, k, number)
            _exchange(rows, k, pivot, number)
            _eliminate(rows, k, n)
        for i, row in enumerate(rows):
            factors[(*place, i)], orders[(*place, i)] = row[:n], row[n]
    return [factors, pivots, orders]


def _largest(rows: list[list[Scalar]], k: int, number: list[Scalar]) -> Scalar:
    """Return the number of the first row, from k on, whose entry in column k has the largest absolute value."""
    best, pivot = absolute(rows[k][k]), number[k]
    for i in range(k + 1, len(rows)):
        size = absolute(rows[i][k])
        is_larger = greater(size, best)
        best, pivot = where(is_larger, size, best), where(is_larger, number[i], pivot)
    return pivot


def _exchange(rows: list[list[Scalar]], k: int, pivot: Scalar, number: list[Scalar]) -> None:
    top = rows[k]
    for i in range(k + 1, len(rows)):
        is_pivot = apply(lax.eq_p, bool, pivot, number[i])
        rows[k] = [where(is_pivot, x, y) for x, y in zip(rows[i], rows[k], strict=True)]
        rows[i] = [where(is_pivot, x, y) for x, y in zip(top, rows[i], strict=True)]


def _eliminate(rows: list[list[Scalar]], k: int, columns: int) -> None:
    """Subtract multiples of row k from those below it; LAPACK leaves a column of zeros as it is."""
    pivot = rows[k][k]
    one, zero = pivot.graph.constant(1.0, pivot.node.dtype), pivot.graph.constant(0.0, pivot.node.dtype)
    divisor = where(apply(lax.eq_p, bool, pivot, zero), one, pivot)
    for row in rows[k + 1 :]:
        row[k] = row[k] / divisor
        for j in range(k + 1, columns):
            row[j] = row[j] - row[k] * rows[k][j]


def solve_triangular(graph: Graph, inputs: list[Any], equation: Any) -> list[np.ndarray] | None:
    """Return the X of `triangular_solve`, expanded: of A X = B or X A = B, with A or its transpose.

    None if A is too large, or if its numbers are not real floating-point numbers.
    """
    A, B = inputs
    options = equation.params
    if not is_small(A) or not np.issubdtype(np.dtype(equation.outvars[0].aval.dtype), np.floating):
        return None
    is_lower, is_transposed = options["lower"], options["transpose_a"]
    if not options["left_side"]:  # the transpose of the system
        B, is_transposed = np.swapaxes(B, -1, -2), not is_transposed
    if is_transposed:
        A, is_lower = np.swapaxes(A, -1, -2), not is_lower
    X, n = B.copy(), A.shape[-1]
    order = range(n) if is_lower else range(n - 1, -1, -1)
    for place in np.ndindex(*B.shape[:-2]):
        for column in range(B.shape[-1]):
            x = X[(*place, slice(None), column)]
            for count, i in enumerate(order):
                for j in order[:count]:
                    x[i] = x[i] - A[(*place, i, j)] * x[j]
                if not options["unit_diagonal"]:
                    x[i] = x[i] / A[(*place, i, i)]
    return [X if options["left_side"] else np.swapaxes(X, -1, -2)]
