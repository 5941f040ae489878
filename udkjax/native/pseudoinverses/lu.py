"""Solution of D x = b for a square matrix, by LU with partial pivoting.

If D is singular, the solution is dominated by rounding errors, or is NaN if the method refuses singular matrices.
"""

from dataclasses import dataclass

import numpy as np

from udkjax.native.language.ir import Operand, Value
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod, MatrixRow
from udkjax.native.pseudoinverses.qr import reversed_each


@dataclass(frozen=True)
class LUCode(DenseMethod):
    """The factorization P D = L U: row k of `upper` is the pivot row of step k; row k of `lower` holds its multipliers.

    If `refuses_singular`, a pivot that is a rounding error of the other entries in its column of U counts as zero, and the
    solution is NaN: see `udkjax.equations.laws.formulations.solve_regular`.
    """

    refuses_singular: bool = False

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        largest = {"largest": (1, m)} if self.refuses_singular else {}
        return largest | {
            "upper": (m, n),
            "lower": (m, m),
            "inverse": (1, m),
            "order": (1, m),
            "unused": (1, m),
            "y": (1, m),
        }

    def factor(self, d: DenseMatrices):
        f, unused = d.f, d.row("unused")
        in_register = max(d.vector // f.width, 1)  # columns
        with f.each(d.m) as i:
            unused.put(i, d.wide(1.0))
        if self.refuses_singular:
            d.row("largest").clear()
        with f.each(d.m) as k:
            best, pivot = f.variable(-1.0), f.variable(0.0)
            with f.each(d.m) as i:
                size = f.select(unused.entry(i) > 0.5, f.abs(d.row("D", i).entry(k)), -1.0)
                larger = size > best.value
                pivot.where(larger, d.number(i))
                best.where(larger, size)
            upper, lower = d.row("upper", k), d.row("lower", k)
            d.gather("D", d.whole(pivot.value), upper)
            inverse = 1.0 / upper.entry(k)
            d.row("inverse").put(k, self._unless_singular(d, k, best.value, inverse) if self.refuses_singular else inverse)
            d.row("order").put(k, pivot.value)
            with f.each(d.m) as i:
                row = d.row("D", i)
                remains = f.select(d.number(i).is_(pivot.value), 0.0, unused.entry(i))
                unused.put(i, remains)
                factor = f.select(remains > 0.5, row.entry(k) * inverse, 0.0)
                lower.put(i, factor)
                with f.if_(f.any_of(factor.is_not(0.0))):
                    wide = d.spread(-factor)
                    with f.each(row.registers, f.arithmetic("div", k, in_register)) as r:
                        row[r] = f.fma(wide, upper[r], row[r])

    def _unless_singular(self, d: DenseMatrices, k: Value, size: Value, inverse: Value) -> Value:
        """Return `inverse`, the inverse of pivot k, or NaN if the pivot, of the magnitude `size`, is a rounding error.

        The row `largest` holds the largest magnitude in each column of U so far.
        """
        f, upper, largest = d.f, d.row("upper", k), d.row("largest")

        def include(r: Operand):
            largest[r] = f.max(f.abs(upper[r]), largest[r])

        d.over_registers(largest.registers, include)
        return f.select(size > largest.entry(k) * (d.m * float(np.finfo(float).eps)), inverse, float("nan"))

    def _forward(self, d: DenseMatrices) -> tuple[MatrixRow, MatrixRow]:
        """Write the solution of L y = P b; return the rows `x`, which is set to zero, and `y`."""
        b, x, y = d.row("b"), d.row("x"), d.row("y")
        with d.f.each(d.m) as k:
            entry = b.at(d.whole(d.row("order").entry(k)))
            y.put(k, entry)
            d.axpy(-entry, d.row("lower", k), b)
        x.clear()
        return x, y

    def solve(self, d: DenseMatrices):
        x, y = self._forward(d)
        with reversed_each(d, d.m) as k:  # entries left of the diagonal multiply coordinates that are still zero
            x.put(k, (y.entry(k) - d.dot(d.row("upper", k), x)) * d.row("inverse").entry(k))

    def solve_transposed(self, d: DenseMatrices):
        b, x, y = d.row("b"), d.row("x"), d.row("y")
        with d.f.each(d.m) as k:  # entries left of the diagonal change coordinates that have been used
            entry = x.entry(k) * d.row("inverse").entry(k)
            y.put(k, entry)
            d.axpy(-entry, d.row("upper", k), x)
        b.clear()
        with reversed_each(d, d.m) as k:
            b.put_at(d.whole(d.row("order").entry(k)), y.entry(k) - d.dot(d.row("lower", k), b))

    def sign(self, d: DenseMatrices) -> Value:
        """Return the sign of det D: the product of the signs of the pivots, and of -1 for each inversion of rows."""
        f, order, sign = d.f, d.row("order"), d.f.variable(1.0)
        with f.each(d.m) as k:
            place = order.entry(k)
            sign.value = f.select(d.row("inverse").entry(k) < 0.0, -sign.value, sign.value)
            with f.each(k) as i:
                sign.value = f.select(order.entry(i) > place, -sign.value, sign.value)
        return sign.value


@dataclass(frozen=True)
class OrderedLUCode(LUCode):
    """LU whose solutions are the same for any number of lanes, bit for bit.

    It avoids scalar products, whose terms are added in an order that depends on the number of lanes.

    Row k of `columns` is column k of U.
    """

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        return super().matrices(m, n) | {"columns": (n, m)}

    def factor(self, d: DenseMatrices):
        super().factor(d)
        with d.f.each(d.m) as k:
            upper = d.row("upper", k)
            with d.f.each(d.n, k) as j:
                d.row("columns", j).put(k, upper.entry(j))

    def solve(self, d: DenseMatrices):
        x, y = self._forward(d)
        with reversed_each(d, d.m) as k:  # entries below the diagonal change numbers that have been used
            entry = y.entry(k) * d.row("inverse").entry(k)
            x.put(k, entry)
            d.axpy(-entry, d.row("columns", k), y)
