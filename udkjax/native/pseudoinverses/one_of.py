"""D^+ by one of several methods, chosen by an index in each lane (`udkjax.pinv.OneOf`)."""

from collections.abc import Iterator
from dataclasses import dataclass

from udkjax.native.language.ir import Operand, Value
from udkjax.native.pseudoinverses.dense import DenseMatrices, DenseMethod


@dataclass(frozen=True)
class OneOfCode(DenseMethod):
    """Code of several dense methods, each with its own matrices and a copy of D and b; a method runs if a lane has chosen it."""

    methods: tuple[DenseMethod, ...]

    def matrices(self, m: int, n: int) -> dict[str, tuple[int, int]]:
        matrices = {"rank": (1, 1)}
        for k, method in enumerate(self.methods):
            shapes = {"D": (m, n), "b": (1, m), "x": (1, n), **method.matrices(m, n)}
            matrices |= {_prefix(k) + name: shape for name, shape in shapes.items()}
        return matrices

    def factor(self, d: DenseMatrices):
        rank = d.row("rank")
        for method, part, chosen in self._chosen(d):
            with d.f.each(d.m) as i:
                d.copy(d.row("D", i), part.row("D", i))
            method.factor(part)
            rank.put(0, d.f.select(chosen, part.row("rank").entry(0), rank.entry(0)))

    def solve(self, d: DenseMatrices):
        x = d.row("x")
        for method, part, chosen in self._chosen(d):
            d.copy(d.row("b"), part.row("b"))
            method.solve(part)
            share, solution = d.spread(d.f.select(chosen, d.wide(1.0), 0.0)) > 0.5, part.row("x")

            def take(r: Operand, share=share, solution=solution):
                x[r] = d.f.select(share, solution[r], x[r])

            d.over_registers(x.registers, take)

    def _chosen(self, d: DenseMatrices) -> Iterator[tuple[DenseMethod, DenseMatrices, Value]]:
        """Yield each method with its matrices and the mask of the lanes that have chosen it.

        The code that the caller adds is in a branch that is taken if any lane has chosen the method.
        """
        for k, method in enumerate(self.methods):
            chosen = d.method_number.is_(float(k))
            with d.f.if_(d.f.any_of(chosen)):
                yield method, d.part(_prefix(k)), chosen


def _prefix(k: int) -> str:
    return f"{k} "
