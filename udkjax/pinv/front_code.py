"""Fronts of one structure, eliminated by straight-line code along all of them.

Of the rows D of a front only what can be nonzero is fetched, and nothing is padded. Factors are not kept: what they are made of
is, and each of the three programs factorizes anew. As fusions these have few results, and what they compute on the way stays in
vector registers; to write a factor to memory, and to read it again, takes longer than to compute it.
"""

from functools import lru_cache
from typing import Any, NamedTuple

from jax import Array

from udkjax.pinv.sparse import all_of, backward, eliminate, forward, greater
from udkjax.straightline import Graph, Loop, Program, Scalar, along_elements


class Structure(NamedTuple):
    """Of a front: its rows, first those eliminated, and what its part of D D^T and its right-hand side are sums of.

    (row, column) are places in the lower triangle. Of the boundary only children say anything.
    """

    eliminated: int
    boundary: int
    products: tuple[tuple[int, int, int, int], ...]  # row, column, and which two of the entries of D make a summand there
    sent: tuple[tuple[int, int], ...]  # row and column of what the children add, one after the other
    carried: tuple[int, ...]  # and of what they add to the right-hand side

    @property
    def operations(self) -> int:
        """How many multiplications it takes to form and eliminate a front."""
        below: list[set[int]] = [set() for _ in range(self.eliminated + self.boundary)]
        for i, j in {*((i, j) for i, j, _, _ in self.products), *self.sent}:
            if i != j:
                below[j].add(i)
        count = len(self.products)
        for j in range(self.eliminated):
            count += len(below[j]) * (len(below[j]) + 3) // 2
            for i in below[j]:
                below[i].update(k for k in below[j] if k > i)
        return count


class FrontCode:
    """The programs of a structure, for arrays (number, fronts)."""

    def __init__(self, structure: Structure):
        graph = Graph()
        e, n = structure.eliminated, structure.eliminated + structure.boundary

        def inputs(name: str, count: int) -> list[Scalar]:
            return [graph.input(k, name) for k in range(count)]

        D = inputs("D", 1 + max((k for _, _, *factors in structure.products for k in factors), default=-1))
        sent, r, carried = inputs("sent", len(structure.sent)), inputs("right", e), inputs("carried", len(structure.carried))
        above, drop = inputs("above", n - e), graph.input("drop", "drop")
        zero = graph.constant(0.0)
        lower: list[dict[int, Scalar]] = [{} for _ in range(n)]
        summands = [(i, j, D[a] * D[b]) for i, j, a, b in structure.products]
        summands += [(i, j, entry) for (i, j), entry in zip(structure.sent, sent, strict=True)]
        for i, j, summand in summands:
            lower[j][i] = lower[j].get(i, zero) + summand
        inverse, pivots = eliminate(lower, e, graph)
        safe = all_of([greater(pivot, diagonal * drop) for pivot, diagonal in pivots], graph)
        update = [lower[i].get(j, zero) for i in range(e, n) for j in range(i, n)]
        right = [*r, *[zero] * (n - e)]
        for i, part in zip(structure.carried, carried, strict=True):
            right[i] = right[i] + part
        y = forward(lower[:e], right)
        self._up = Program(graph, [*D, *sent, drop], [safe, *update])
        self._forward = Program(graph, [*D, *sent, *r, *carried], y[e:])
        self._backward = Program(graph, [*D, *sent, *r, *carried, *above], backward(lower[:e], inverse, [*y[:e], *above])[:e])

    def up(self, D: Array, sent: Array, drop: Any, loop: Loop | None) -> tuple[list[Array], Array]:
        """What is left of the boundary: the upper triangle row by row, each an array (fronts,). And whose pivots are safe."""
        safe, *update = along_elements(self._up, loop, D.shape[-1], D, sent, drop)
        return update, safe

    def forward(self, D: Array, sent: Array, r: Array, carried: Array, loop: Loop | None) -> list[Array]:
        """What is left of the right-hand side at the boundary."""
        return along_elements(self._forward, loop, D.shape[-1], D, sent, r, carried)

    def backward(self, D: Array, sent: Array, r: Array, carried: Array, above: Array, loop: Loop | None) -> list[Array]:
        """The solution at the rows eliminated, where that at the boundary is known."""
        return along_elements(self._backward, loop, D.shape[-1], D, sent, r, carried, above)


@lru_cache(maxsize=1024)
def front_code(structure: Structure) -> FrontCode:
    """Write the programs of a structure, once."""
    return FrontCode(structure)
