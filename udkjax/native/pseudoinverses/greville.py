"""D^+ by Greville's recursion, one row at a time (`udkjax.pinv.Greville`)."""

from dataclasses import dataclass

from udkjax.native.language.ir import Operand
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod


@dataclass(frozen=True)
class GrevilleCode(DenseMethod):
    """Greville's recursion: the rows of `plus` are the columns of D^+; each row of D adds one, and corrects those before."""

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        return {"plus": (m, n), "d": (1, m), "c": (1, n), "rank": (1, 1)}

    def factor(self, d: DenseMatrices):
        f, products, c = d.f, d.row("d"), d.row("c")
        scale = f.variable(0.0)
        with f.each(d.m) as i:
            row = d.row("D", i)
            scale.value = f.max(d.dot(row, row), scale.value)
        threshold, rank = f.variable(d.threshold(self, scale.value)), f.variable(0.0)
        with f.each(d.m) as i:
            row, column = d.row("D", i), d.row("plus", i)
            d.copy(row, c)
            length = f.variable(0.0)
            with f.each(i) as j:
                part = d.dot(row, d.row("plus", j))
                products.put(j, part)
                length.value = f.fma(part, part, length.value)
                d.axpy(-part, d.row("D", j), c)
            square = d.dot(c, c)
            is_independent = square > threshold.value
            rank.value = rank.value + f.select(is_independent, d.wide(1.0), 0.0)
            share = d.spread(f.select(is_independent, 1.0 / f.select(is_independent, square, 1.0), 0.0))

            def set_column(r: Operand):
                column[r] = c[r] * share

            d.over_registers(column.registers, set_column)
            with f.if_(f.any_of(~is_independent)):
                share = f.select(is_independent, 0.0, 1.0 / (length.value + 1.0))
                with f.each(i) as j:
                    d.axpy(products.entry(j) * share, d.row("plus", j), column)
            with f.each(i) as j:
                d.axpy(-products.entry(j), column, d.row("plus", j))
        d.row("rank").put(0, rank.value)

    def solve(self, d: DenseMatrices):
        x = d.row("x")
        x.clear()
        with d.f.each(d.m) as i:
            d.axpy(d.row("b").entry(i), d.row("plus", i), x)
