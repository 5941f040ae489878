"""Householder reflections: QR with column pivoting, and reflections from the right."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from udkjax.native.language.ir import BOOL, INT, Operand, Value
from udkjax.native.pseudoinverses.dense import DenseMatrices, MatrixRow


def qr_matrices(m: int, n: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of the matrices of `pivoted_qr`, by name.

    They are the reflectors and their factors, the diagonal of R, the pivot columns in their order, the rank, the squared lengths
    of columns, marks of unused columns, and room for a product.
    """
    steps = min(m, n)
    return {
        "v": (steps, m),
        "tau": (1, steps),
        "diagonal": (1, steps),
        "order": (1, steps),
        "rank": (1, 1),
        "squares": (1, n),
        "unused": (1, n),
        "product": (1, n),
    }


def start_pivoting(d: DenseMatrices) -> Value:
    """Mark all columns of D as unused, compute the squares of their lengths, and return the largest of these."""
    unused, squares = d.row("unused"), d.row("squares")

    def of_column(r: Operand):
        total = d.f.variable(0.0, width=d.vector)
        with d.f.each(d.m) as i:
            x = d.row("D", i)[r]
            total.value = d.f.fma(x, x, total.value)
        squares[r] = total.value
        unused[r] = d.register(1.0)

    d.over_registers(squares.registers, of_column)
    return d.largest(squares, d.n)


def choose_pivot(d: DenseMatrices) -> tuple[Value, Value]:
    """Return the squared length of the longest unused column, and its index; of equal columns, the first."""
    f, squares = d.f, d.row("squares")
    best, pivot = f.variable(-1.0), f.variable(0.0)
    with f.each(d.n) as j:
        x = squares.entry(j)
        longer = x > best.value
        pivot.where(longer, d.number(j))
        best.where(longer, x)
    return best.value, pivot.value


def use_column(d: DenseMatrices, pivot: Value, r: Operand, square: Value):
    """Store the squared lengths of the columns in register r, -1 for used ones, and mark the pivot column as used.

    `pivot`: the index of the pivot column; -1 in lanes without a pivot.
    """
    f, unused, squares = d.f, d.row("unused"), d.row("squares")
    remains = f.select(d.row("index")[r].is_(d.spread(pivot)), 0.0, unused[r])
    unused[r] = remains
    squares[r] = f.select(remains > 0.5, square, -1.0)


def combine_rows(d: DenseMatrices, weights: MatrixRow, r: Operand, start: Operand = 0) -> Value:
    """Return the weighted sum of the rows of D from `start` on, for the columns in register r."""
    total = d.f.variable(0.0, width=d.vector)
    with d.f.each(d.m, start) as i:
        total.value = d.f.fma(d.spread(weights.entry(i)), d.row("D", i)[r], total.value)
    return total.value


def add_to_rows(d: DenseMatrices, weights: MatrixRow, change: Value, r: Operand, start: Operand = 0) -> Value:
    """Add multiples of `change` to the rows of D from `start` on, in the columns of register r.

    `weights` holds the factor of each row. Returns the squared lengths of these columns in these rows.
    """
    square = d.f.variable(0.0, width=d.vector)
    with d.f.each(d.m, start) as i:
        row = d.row("D", i)
        row[r] = x = d.f.fma(d.spread(weights.entry(i)), change, row[r])
        square.value = d.f.fma(x, x, square.value)
    return square.value


def pivoted_qr(d: DenseMatrices, threshold: Callable[[Value], Value]):
    """Write D = Q R without moving columns: D becomes R; each step uses the longest unused column.

    Rows of `v` are the reflectors of Q. Each lane stops when the longest column is at most the threshold; `threshold` returns its
    square from the square of the longest column of D.
    """
    f = d.f
    limit = f.variable(threshold(start_pivoting(d)))
    going, rank = f.variable(d.yes(), BOOL), f.variable(0.0)
    with f.each(d.steps) as k:
        square, pivot = choose_pivot(d)
        goes_on = going.value & (square > limit.value)
        going.value = goes_on
        rank.value = rank.value + f.select(goes_on, d.wide(1.0), 0.0)
        place, norm, used = d.whole(pivot), d.sqrt(square), f.select(goes_on, pivot, -1.0)
        top = d.row("D", k).at(place)
        end = f.select(top > 0.0, -norm, norm)  # the sign that avoids cancellation
        tau = f.select(goes_on, 1.0 / (square + f.abs(top) * norm), 0.0)
        v = d.row("v", k)
        v.clear()
        v.put(k, top - end)
        with f.each(d.m, k + 1) as i:
            v.put(i, d.row("D", i).at(place))
        for name, x in (("tau", tau), ("diagonal", end), ("order", pivot)):
            d.row(name).put(k, x)
        wide_tau = d.spread(tau)

        def reflect(r: Operand):
            change = -(combine_rows(d, v, r, k) * wide_tau)
            first = d.row("D", k)
            first[r] = f.fma(d.spread(v.entry(k)), change, first[r])
            use_column(d, used, r, add_to_rows(d, v, change, r, k + 1))

        d.over_registers(d.row("D", 0).registers, reflect)
    d.row("rank").put(0, rank.value)


def apply_q_transposed(d: DenseMatrices):
    """Write the multiplication of the row `b` by Q^T, in place."""
    b = d.row("b")
    with d.f.each(d.steps) as k:
        v = d.row("v", k)
        d.axpy(-(d.dot(v, b) * d.row("tau").entry(k)), v, b)


def apply_q(d: DenseMatrices, name: str = "b", i: Operand = 0):
    """Write the multiplication of row i of a matrix, by default of the row `b`, by Q, in place."""
    with reversed_each(d, d.steps) as k:
        apply_reflector(d, "v", "tau", k, name, i)


def reflect_row(d: DenseMatrices, name: str, k: Value, is_active: Value, reflectors: str, factors: str) -> Value:
    """Write a reflector from the right that would clear row k of a matrix after column k; the row itself stays.

    The reflector becomes row k of the matrix `reflectors`, and its factor entry k of the row `factors`, zero in lanes that are
    not `is_active`.

    Returns:
        The entry in column k after the reflection.
    """
    f, row, z = d.f, d.row(name, k), d.row(reflectors, k)
    number = d.spread(d.number(k))

    def copy(r: Operand):
        z[r] = f.select(d.row("index")[r] >= number, row[r], 0.0)

    d.over_registers(row.registers, copy)
    square, first = d.dot(z, z), row.entry(k)
    norm = d.sqrt(square)
    end = f.select(first > 0.0, -norm, norm)
    z.put(k, first - end)
    divisor = square + f.abs(first) * norm
    counts = is_active & (divisor > 0.0)
    d.row(factors).put(k, f.select(counts, 1.0 / f.select(counts, divisor, 1.0), 0.0))
    return end


def apply_reflector(d: DenseMatrices, reflectors: str, factors: str, k: Value, name: str, i: Operand = 0):
    """Write the reflection of row i of the matrix `name` by reflector k, in place."""
    z, row = d.row(reflectors, k), d.row(name, i)
    d.axpy(-(d.dot(z, row) * d.row(factors).entry(k)), z, row)


@contextmanager
def reversed_each(d: DenseMatrices, count: Operand) -> Iterator[Value]:
    """Run the block for every integer from `count` - 1 down to zero."""
    with d.f.each(count) as k:
        yield d.f.like(count, INT, 1) - 1 - k
