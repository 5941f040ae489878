"""Solution of a linear system by factors L D U of fronts, of a symmetric matrix or not.

A front is a block of rows with the later blocks that its elimination changes (block_elimination.py). Its table has one row for
each front of the same sizes: start indices of the block's factors and of its right-hand side come first.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from udkjax.equations.terms.scene_layout import arrays_of_solve
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, dot
from udkjax.expressions import Scalar
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, Reset
from udkjax.pinv.elimination_order import Fronts


def triangle(i: int, j: int) -> int:
    """Return the index of entry (i, j) in a lower triangle that is stored row by row."""
    return i * (i + 1) // 2 + j


class FrontFactors(NamedTuple):
    """The array of factors L D U, and the places of the factors of a front in it.

    A diagonal block holds the reciprocals of D on its diagonal, L below and U above it; L and U have ones on their diagonals. A
    later block has a part of L, and one of U that is stored as its transpose. If the matrix is symmetric, U is the transpose of L
    and is not stored; the diagonal block then comes after the diagonal of the matrix.
    """

    array: str
    is_symmetric: bool

    def inner(self, p: int, i: int, j: int) -> int:
        """Return the index of entry (i, j) of L, 1/D or U in a diagonal block of p rows."""
        return p + triangle(max(i, j), min(i, j)) if self.is_symmetric else i * p + j

    @property
    def columns(self) -> int:
        """The number of columns of each later block in the table of fronts, and of the columns before the first later block."""
        return 2 if self.is_symmetric else 3

    def below(self, a: int) -> int:
        """Return the table's column for the block of L that couples the later block a."""
        return self.columns * (a + 1)

    def beside(self, a: int) -> int:
        """Return the table's column for the block of U that couples the later block a."""
        return self.below(a) + (0 if self.is_symmetric else 1)

    def right(self, a: int) -> int:
        """Return the table's column for the right-hand side of the later block a."""
        return self.beside(a) + 1

    def substitute(
        self, terms: SceneTerms, order: list[Fronts], table: Callable[[Fronts], np.ndarray], solve: int, **names: str
    ) -> ProgramParts:
        """Yield loops that compute x of a linear system from its right-hand side.

        Args:
            terms: The terms of the scene.
            order: The fronts in the order of elimination.
            table: Returns the table of fronts.
            solve: Number of the linear system.
            names: Arrays that replace those of the system, such as x="x2".
        """
        names = arrays_of_solve(solve) | names
        yield Reset(names["sum"], 0, terms.layout.sizes[names["sum"]])
        for fronts in order:

            def forward(w: KernelWriter, fronts: Fronts = fronts):
                self._write_forward(w, fronts.size, fronts.later_sizes)

            kernel = terms.kernel(("forward", self, fronts.size, fronts.later_sizes), forward)
            yield KernelLoop(kernel, table(fronts), names)
        for fronts in reversed(order):

            def backward(w: KernelWriter, fronts: Fronts = fronts):
                self._write_backward(w, fronts.size, fronts.later_sizes)

            kernel = terms.kernel(("backward", self, fronts.size, fronts.later_sizes), backward)
            yield KernelLoop(kernel, table(fronts)[::-1], names)

    # Kernels of a front: `p` is the number of rows of its block; `later` holds the numbers of rows of its later blocks.

    def _write_forward(self, w: KernelWriter, p: int, later: tuple[int, ...]) -> None:
        y = [w.read("right", 1, i) - w.read("sum", 1, i) for i in range(p)]
        for i in range(p):
            for j in range(i):
                y[i] = y[i] - w.read(self.array, 0, self.inner(p, i, j)) * y[j]
            w.write(y[i], "y", 1, i)
        for a, size in enumerate(later):
            for i in range(size):
                row: list[Scalar] = [w.read(self.array, self.below(a), i * p + j) for j in range(p)]
                w.write(dot(w.graph, row, y), "sum", self.right(a), i, ADD)

    def _write_backward(self, w: KernelWriter, p: int, later: tuple[int, ...]) -> None:
        x = [w.read("y", 1, i) * w.read(self.array, 0, self.inner(p, i, i)) for i in range(p)]
        for a, size in enumerate(later):
            for i in range(size):
                s = w.read("x", self.right(a), i)
                for j in range(p):
                    x[j] = x[j] - w.read(self.array, self.beside(a), i * p + j) * s
        for j in reversed(range(p)):
            for i in range(j + 1, p):
                x[j] = x[j] - w.read(self.array, 0, self.inner(p, j, i)) * x[i]
            w.write(x[j], "x", 1, j)
