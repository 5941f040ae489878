"""Linear systems: factorizations and triangular solutions, by loops over numbers in new memory."""

from typing import Any

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, Operand, Value
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.arrays import Array, Stored
from udkjax.native.lowering.lowering import Lowering


def lu(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Factorize P A = L U; return both factors in one matrix, the row of the pivot of each step, and the permutation.

    The pivot of a column is its largest entry; a column of zeros is left as it is.
    """
    (x,), f = _matrices(to, equation, inputs), to.f
    (m, n), steps = x.shape, min(x.shape)
    a, pivots, order = to.new((m, n), DOUBLE, x.varies), to.new((steps,), INT, x.varies), to.new((m,), INT, x.varies)
    to.fill(a, x)
    with f.each(m) as i:
        order.write(f, (i,), i)
    with f.each(steps) as k:
        place = _pivot(to, a, k)
        pivots.write(f, (k,), place)
        with f.each(n) as j:
            _exchange(to, a, (k, j), (place, j))
        _exchange(to, order, (k,), (place,))
        pivot = a.read(f, (k, k))
        is_regular = pivot.is_not(0.0)
        with f.each(m, k + 1) as i:
            entry = a.read(f, (i, k))
            factor = f.select(is_regular, entry / pivot, entry)
            a.write(f, (i, k), factor)
            with f.each(n, k + 1) as j:
                a.write(f, (i, j), a.read(f, (i, j)) - factor * a.read(f, (k, j)))
    return [a, pivots, order]


def _pivot(to: Lowering, a: Stored, k: Value) -> Value:
    """Return the row of the largest entry of column k, from row k on."""
    f, lanes = to.f, to.f.width if a.varies else 1
    largest, place = f.variable(f.abs(a.read(f, (k, k))), DOUBLE, lanes), f.variable(k, INT, lanes)
    with f.each(a.shape[0], k + 1) as i:
        size = f.abs(a.read(f, (i, k)))
        takes = size > largest.value
        largest.where(takes, size)
        place.where(takes, i)
    return place.value


def _exchange(to: Lowering, a: Stored, one: tuple[Operand, ...], other: tuple[Operand, ...]):
    f = to.f
    x, y = a.read(f, one), a.read(f, other)
    a.write(f, one, y)
    a.write(f, other, x)


def cholesky(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Factorize A = L L^T; return L, which is NaN if A is not positive definite."""
    (a,), f = _matrices(to, equation, inputs), to.f
    n, lanes = a.shape[0], f.width if a.varies else 1
    factor, least = to.new(a.shape, DOUBLE, a.varies), f.variable(np.inf, DOUBLE, lanes)
    to.each(a.shape, lambda index: factor.write(f, index, f.const(0.0)))
    with f.each(n) as j:
        with f.each(n, j) as i:
            total = f.variable(a.read(f, (i, j)), DOUBLE, lanes)
            with f.each(j) as k:
                total.value = total.value - factor.read(f, (i, k)) * factor.read(f, (j, k))
            factor.write(f, (i, j), total.value)
        square = factor.read(f, (j, j))
        least.value = f.intrinsic("minimum", least.value, square)
        root = f.intrinsic("sqrt", square)
        with f.each(n, j) as i:
            factor.write(f, (i, j), factor.read(f, (i, j)) / root)
    is_definite = least.value > 0.0
    to.each(a.shape, lambda index: factor.write(f, index, f.select(is_definite, factor.read(f, index), np.nan)))
    return [factor]


def triangular_solve(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Return the solution X of A X = B or X A = B, with a triangular A or its transpose."""
    (a, b), f, p = _matrices(to, equation, inputs), to.f, equation.params
    left, is_lower, n = p["left_side"], bool(p["lower"]), a.shape[0]
    swaps = bool(p["transpose_a"]) == bool(left)  # X A = B is A^T X^T = B^T
    varies = a.varies or b.varies
    x = to.new(b.shape, DOUBLE, varies)
    to.fill(x, b)

    def matrix(i: Value, j: Value) -> Value:
        return a.read(f, (j, i) if swaps else (i, j))

    def place(i: Value, column: Value) -> tuple[Value, Value]:
        return (i, column) if left else (column, i)

    with f.each(n) as k, f.each(b.shape[1 if left else 0]) as column:
        forward = is_lower != swaps
        i = k if forward else (n - 1) - k
        total = f.variable(x.read(f, place(i, column)), DOUBLE, f.width if varies else 1)
        with f.each(i if forward else n, 0 if forward else i + 1) as j:
            total.value = total.value - matrix(i, j) * x.read(f, place(j, column))
        x.write(f, place(i, column), total.value if p["unit_diagonal"] else total.value / matrix(i, i))
    return [x]


def linear_solve(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Lower the function `solve` of a `jax.lax.custom_linear_solve`, whose other functions serve derivatives only."""
    lengths, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
    first = lengths.matvec + lengths.vecmat
    return to.closed(solve, [*inputs[first : first + lengths.solve], *inputs[sum(lengths) :]])


def _matrices(to: Lowering, equation: Any, inputs: list[Array]) -> list[Array]:
    """Return the operands of an equation, which must be matrices, with their elements computed."""
    if any(len(x.shape) != 2 for x in inputs):
        raise UnsupportedError(f"the operation {equation.primitive.name} of batches")
    return [to.stored(x) for x in inputs]
