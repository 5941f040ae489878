"""D^+ by modified Gram-Schmidt on the columns of D and then on the rows of R (`udkjax.pinv.GramSchmidt`)."""

from dataclasses import dataclass

from udkjax.native.language.ir import BOOL, Operand
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod
from udkjax.native.pseudoinverses.qr import add_to_rows, choose_pivot, combine_rows, start_pivoting, use_column


@dataclass(frozen=True)
class GramSchmidtCode(DenseMethod):
    """The method of Gram and Schmidt: D = Q R with column pivoting, then R = L Z^T, so that D^+ = Z L^(-1) Q^T.

    The rows of R up to the rank are independent, so the second factorization needs no pivots. `twice`: True to orthogonalize each
    vector twice, which makes the columns of Q and Z orthogonal to rounding.
    """

    twice: bool = True

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        steps = min(m, n)
        return {
            "q": (steps, m),
            "column": (1, m),
            "above": (1, steps),
            "r": (steps, n),
            "squares": (1, n),
            "unused": (1, n),
            "rank": (1, 1),
            "l": (steps, steps),
            "inverse": (1, steps),
            "y": (1, steps),
        }

    def factor(self, d: DenseMatrices):
        self._orthogonalize_columns(d)
        self._orthogonalize_rows(d)

    def _orthogonalize_columns(self, d: DenseMatrices):
        """Write the factorization D = Q R: rows of `q` become the columns of Q, `r` becomes R, and D what remains."""
        f, column, above = d.f, d.row("column"), d.row("above")
        threshold = f.variable(d.threshold(self, start_pivoting(d)))
        going, rank = f.variable(d.yes(), BOOL), f.variable(0.0)
        with f.each(d.steps) as k:
            _, pivot = choose_pivot(d)
            place, q = d.whole(pivot), d.row("q", k)
            column.clear()
            with f.each(d.m) as i:
                column.put(i, d.row("D", i).at(place))
            if self.twice:
                with f.each(k) as j:
                    above.put(j, d.dot(d.row("q", j), column))
                with f.each(k) as j:
                    d.axpy(-above.entry(j), d.row("q", j), column)
            square = d.dot(column, column)
            norm = d.sqrt(square)
            goes_on = going.value & (square > threshold.value)
            going.value = goes_on
            rank.value = rank.value + f.select(goes_on, d.wide(1.0), 0.0)
            inverse = f.select(goes_on, 1.0 / norm, 0.0)
            used, wide = f.select(goes_on, pivot, -1.0), d.spread(inverse)

            def unit(r: Operand):
                q[r] = column[r] * wide

            d.over_registers(q.registers, unit)
            row = d.row("r", k)

            def subtract(r: Operand):
                is_left = (d.row("unused")[r] > 0.5) & d.row("index")[r].is_not(d.spread(pivot))
                row[r] = product = f.select(is_left, combine_rows(d, q, r), 0.0)
                use_column(d, used, r, add_to_rows(d, q, -product, r))

            d.over_registers(row.registers, subtract)
            with f.if_(f.any_of(goes_on)):
                row.put_at(place, f.select(goes_on, norm, row.at(place)))
                if self.twice:
                    with f.each(k) as j:
                        earlier = d.row("r", j)
                        correction = f.select(goes_on, above.entry(j), 0.0)
                        earlier.put_at(place, earlier.at(place) + correction)
        d.row("rank").put(0, rank.value)

    def _orthogonalize_rows(self, d: DenseMatrices):
        """Write the factorization R = L Z^T: rows of `r` become the columns of Z."""
        f, above = d.f, d.row("above")
        rank = f.variable(d.row("rank").entry(0))
        with f.each(d.steps) as k:
            d.row("l", k).clear()
        with f.each(d.steps) as k:
            row = d.row("r", k)
            if self.twice:
                with f.each(k) as j:
                    correction = d.dot(d.row("r", j), row)
                    above.put(j, correction)
                    d.row("l", k).put(j, d.row("l", k).entry(j) + correction)
                with f.each(k) as j:
                    d.axpy(-above.entry(j), d.row("r", j), row)
            square = d.dot(row, row)
            counts = (d.number(k) < rank.value) & (square > 0.0)
            inverse = f.select(counts, 1.0 / d.sqrt(f.select(counts, square, 1.0)), 0.0)
            d.row("inverse").put(k, inverse)
            wide = d.spread(inverse)

            def unit(r: Operand):
                row[r] = row[r] * wide

            d.over_registers(row.registers, unit)
            with f.each(d.steps, k + 1) as i:
                later = d.row("r", i)
                product = d.dot(row, later)
                d.row("l", i).put(k, product)
                d.axpy(-product, row, later)

    def solve(self, d: DenseMatrices):
        f, b, x, y = d.f, d.row("b"), d.row("x"), d.row("y")
        x.clear()
        y.clear()
        with f.each(d.steps) as k:
            right = d.dot(d.row("q", k), b)
            entry = (right - d.dot(d.row("l", k), y)) * d.row("inverse").entry(k)
            y.put(k, entry)
            d.axpy(entry, d.row("r", k), x)
