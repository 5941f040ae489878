"""Elimination of Psi_q M^(-1) Psi_q^T by loops: block by block, in an order of least fill that is chosen once.

A diagonal block belongs to one constraint, an off-diagonal block to two constraints that share a body. A front is a block with
the later blocks that its elimination changes; fronts of the same sizes are eliminated by the same kernel. A row whose pivot does
not exceed `drop_tol` times its diagonal entry is left out: the reciprocal of its pivot is set to zero.
"""

from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import cached_property

import numpy as np

from udkjax.equations.elimination.front_substitution import FrontFactors, triangle
from udkjax.equations.terms.scene_layout import BODIES, BODY_CONSTANTS, DROP_TOL, ENTRIES, RIGHT, ROW, SAFE_TOL, ConstraintGroup
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, compliance, dot
from udkjax.expressions import Scalar
from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, KernelLoop, KernelWriter, Reset
from udkjax.expressions.scalars.selection import absolute, greater, where
from udkjax.pinv.elimination_order import Fronts, order_blocks

FACTORS = FrontFactors("factors", is_symmetric=True)


class BlockElimination:
    """Loops that form Psi_q M^(-1) Psi_q^T, factorize it and solve with the factors, in arrays added to the layout of `terms`.

    `gram` holds the diagonal blocks, each followed by its diagonal before elimination, and then the off-diagonal blocks.
    `factors` has the same layout: the reciprocals of the pivots and L for a diagonal block, a part of L for an off-diagonal one.
    `nearness` is the largest ratio of a diagonal entry to its pivot; `trusted` is one if all pivots exceed `safe_tol` times their
    diagonal entries.
    """

    def __init__(self, terms: SceneTerms):
        self.terms, layout = terms, terms.layout
        # For each block: its group, and the index of its element within the group.
        self.elements = [(group, i) for group in layout.eliminated for i in range(len(group.members))]
        self.sizes = [len(group.rows) for group, _ in self.elements]
        bodies = [set(group.bodies[:, i].tolist()) for group, i in self.elements]
        self.order: list[Fronts] = order_blocks(self.sizes, bodies)
        self.diagonals = [layout.reserve("gram", p + p * (p + 1) // 2) for p in self.sizes]
        self._position = {k: j for j, k in enumerate(k for fronts in self.order for k in fronts.blocks)}
        self._off_diagonal_start, self.off_diagonals = layout.sizes["gram"], {}
        for fronts in self.order:
            for k, later in zip(fronts.blocks, fronts.later, strict=True):
                for a in later:
                    self.off_diagonals[a, k] = layout.reserve("gram", self.sizes[a] * self.sizes[k])
        self._off_diagonal_size = layout.sizes["gram"] - self._off_diagonal_start
        layout.add_solves()

    def place(self, block: int, column: int) -> int:
        """Return the number in a column of the table of a block's group, in the row of the block's element."""
        group, i = self.elements[block]
        return int(group.table[i, column])

    # --- programs

    def factorize(self, dropping: bool) -> ProgramParts:
        """Yield loops that form Psi_q M^(-1) Psi_q^T from the entries in `psi_q`, and factorize it.

        With `dropping`, rows with small pivots are left out.
        """
        yield from self.form()
        yield Reset("nearness", 0, 1)
        yield Reset("trusted", 0, 1, 1.0)
        layout = self.terms.layout
        first_mark = layout.first_mark if layout.leaves_out_marked else None
        for fronts in self.order:

            def write(w: KernelWriter, fronts: Fronts = fronts):
                _eliminate(w, fronts.size, fronts.later_sizes, dropping, first_mark)

            key = ("eliminate", fronts.size, fronts.later_sizes, dropping, first_mark)
            yield KernelLoop(self.terms.kernel(key, write), self._front_table(fronts))

    def form(self) -> ProgramParts:
        """Yield loops that form Psi_q M^(-1) Psi_q^T in `gram` from the entries in `psi_q`."""
        if self._off_diagonal_size:
            yield Reset("gram", self._off_diagonal_start, self._off_diagonal_size)
        yield from self._gram

    def solve(self, solve: int = 0) -> ProgramParts:
        """Yield loops that compute x = (Psi_q M^(-1) Psi_q^T)^(-1) right and jt_x = Psi_q^T x of a linear system."""
        yield from self.substitute(solve)
        yield from self.terms.jt(solve)

    def substitute(self, solve: int, **names: str) -> ProgramParts:
        """Yield loops that compute x = (Psi_q M^(-1) Psi_q^T)^(-1) right; `names` rename arrays of the system, such as x="x2"."""
        yield from FACTORS.substitute(self.terms, self.order, self._front_table, solve, **names)

    def safe(self) -> KernelLoop:
        """Return the loop that sets `safe`: one if all pivots exceed `safe_tol` times their diagonal entries, else zero."""

        def write(w: KernelWriter):
            w.write(w.read("trusted", None), "safe", None)

        return self.terms.single_iteration("safe", write)

    def distance(self) -> KernelLoop:
        """Return the loop that sets `distance` from dependence: the root of the smallest pivot relative to its diagonal entry."""

        def write(w: KernelWriter):
            w.write(w.graph.constant(1.0) / w.graph.sqrt(w.read("nearness", None)), "distance", None)

        return self.terms.single_iteration("distance", write)

    def rank(self) -> ProgramParts:
        """Yield loops that set `rank` to the number of rows that the last factorization retained."""
        yield Reset("rank", 0, 1)
        for p in sorted(set(self.sizes)):

            def count(w: KernelWriter, p: int = p):
                zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
                for j in range(p):
                    inverse = w.read("factors", 0, p + triangle(j, j))
                    w.write(where(greater(absolute(inverse), zero), one, zero), "rank", None, 0, ADD)

            blocks = [start for start, size in zip(self.diagonals, self.sizes, strict=True) if size == p]
            yield KernelLoop(self.terms.kernel(("rank", p), count), np.array(blocks)[:, None])

    def independent(self) -> ProgramParts:
        """Yield loops that set `independent`: one for each row that the last factorization retained, zero for dropped rows."""
        starts: dict[int, list[list[int]]] = {}
        for block, (start, size) in enumerate(zip(self.diagonals, self.sizes, strict=True)):
            starts.setdefault(size, []).append([start, self.place(block, ROW)])
        for p, table in sorted(starts.items()):

            def mark(w: KernelWriter, p: int = p):
                zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
                for j in range(p):
                    inverse = w.read("factors", 0, p + triangle(j, j))
                    w.write(where(greater(absolute(inverse), zero), one, zero), "independent", 1, j)

            yield KernelLoop(self.terms.kernel(("independent", p), mark), np.array(table))

    # --- the matrix

    @cached_property
    def _gram(self) -> list[KernelLoop]:
        loops, start = [], 0
        for group in self.terms.layout.eliminated:
            loops.append(self._diagonal_blocks(group, self.diagonals[start : start + len(group.members)]))
            start += len(group.members)
        return loops + self._off_diagonal_blocks()

    def _diagonal_blocks(self, group: ConstraintGroup, places: Sequence[int]) -> KernelLoop:
        p, base = len(group.rows), group.table.shape[1]

        def write(w: KernelWriter):
            entries = [group.entries(w, row) for row in group.rows]
            scaled = [_scaled(w, row, lambda body: BODIES + 3 * body + BODY_CONSTANTS) for row in entries]
            for i in range(p):
                for j in range(i + 1):
                    s = dot(w.graph, entries[i], scaled[j])
                    if i == j:
                        w.write(s, "gram", base, i)
                    w.write(s, "gram", base, p + triangle(i, j))

        table = np.concatenate([group.table, np.array(places)[:, None]], 1)
        return KernelLoop(self.terms.kernel(("diagonal", group), write), table)

    def _off_diagonal_blocks(self) -> list[KernelLoop]:
        """Return the loops over shared bodies that fill the off-diagonal blocks, one loop for each kind of pair of elements."""
        tables: dict[tuple[ConstraintGroup, int, ConstraintGroup, int], list[list[int]]] = {}
        for (late, late_slot), (early, early_slot), body in self.shared_bodies():
            entries = self.place(late, ENTRIES), self.place(early, ENTRIES)
            key = self.elements[late][0], late_slot, self.elements[early][0], early_slot
            row = [*entries, self.off_diagonals[late, early], self.terms.layout.of_body(body)]
            tables.setdefault(key, []).append(row)
        return [KernelLoop(self._product(*key), np.array(table)) for key, table in tables.items()]

    def shared_bodies(self) -> Iterator[tuple[tuple[int, int], tuple[int, int], int]]:
        """Iterate over pairs of blocks that share a body: the later block, the earlier one, and the body.

        Each block comes with the index of the body among the bodies of its element.
        """
        holders: dict[int, list[tuple[int, int]]] = {}  # for each body: its blocks, and its index among the bodies of each
        for block, (group, i) in enumerate(self.elements):
            for slot, body in enumerate(group.bodies[:, i].tolist()):
                holders.setdefault(body, []).append((block, slot))
        for body, blocks in holders.items():
            blocks.sort(key=lambda x: self._position[x[0]])
            for j, early in enumerate(blocks):
                yield from ((late, early, body) for late in blocks[j + 1 :] if early[0] != late[0])

    def _product(self, late: ConstraintGroup, late_slot: int, early: ConstraintGroup, early_slot: int):
        def write(w: KernelWriter):
            late_entries = [[late.entry(w, row, 3 * late_slot + k, 0) for k in range(3)] for row in late.rows]
            early_entries = [
                _scaled(w, [early.entry(w, row, 3 * early_slot + k, 1) for k in range(3)], lambda _: 3) for row in early.rows
            ]
            for i, x in enumerate(late_entries):
                for j, y in enumerate(early_entries):
                    w.write(dot(w.graph, x, y), "gram", 2, i * len(early_entries) + j, ADD)

        key: Hashable = ("product", late, late_slot, early, early_slot)
        return self.terms.kernel(key, write)

    def _front_table(self, fronts: Fronts) -> np.ndarray:
        """Return the table of fronts of the same sizes.

        The columns are start indices: first of the block's factors and of its right-hand side; then, for each later block, of the
        off-diagonal block that couples the two and of the later block's right-hand side; last, of the blocks that couple the
        later blocks with each other, as a lower triangle, row by row.
        """
        table = []
        for k, later in zip(fronts.blocks, fronts.later, strict=True):
            row = [self.diagonals[k], self.place(k, RIGHT)]
            for a in later:
                row += [self.off_diagonals[a, k], self.place(a, RIGHT)]
            for i, a in enumerate(later):
                row += [self.off_diagonals[a, b] for b in later[:i]] + [self.diagonals[a]]
            table.append(row)
        return np.array(table)


def _scaled(w: KernelWriter, row: list[Scalar], base: Callable[[int], int]) -> list[Scalar]:
    """Return a row of Psi_q times M^(-1); `base` returns the table column of a body's constants."""
    return [s * compliance(w, k % 3, base(k // 3)) for k, s in enumerate(row)]


# Kernels of a front: `p` is the number of rows of its block; `later` holds the numbers of rows of its later blocks.


def _eliminate(w: KernelWriter, p: int, later: tuple[int, ...], dropping: bool, first_mark: int | None) -> None:
    drop_tol, safe_tol = (w.read("constants", None, tol) for tol in (DROP_TOL, SAFE_TOL))
    zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
    S = [[w.read("gram", 0, p + triangle(i, j)) for j in range(i + 1)] for i in range(p)]
    below = [[[w.read("gram", 2 + 2 * a, i * p + j) for j in range(p)] for i in range(size)] for a, size in enumerate(later)]
    rows = [row for block in below for row in block]
    for j in range(p):
        pivot, diagonal = S[j][j], w.read("gram", 0, j)
        inverse = reciprocal = one / pivot
        if dropping:
            inverse = where(greater(pivot, diagonal * drop_tol), reciprocal, zero)
        nearness, trusted = absolute(diagonal * reciprocal), greater(pivot, diagonal * safe_tol)
        if first_mark is not None:
            is_independent = greater(w.read("constants", 1, first_mark + j), zero)
            inverse, nearness = (where(is_independent, x, zero) for x in (inverse, nearness))
            trusted = where(is_independent, trusted, w.graph.constant(True, bool))
        w.write(nearness, "nearness", None, 0, MAXIMUM)
        w.write(trusted, "trusted", None, 0, ALL)
        for i in range(j + 1, p):
            lower = S[i][j] * inverse
            for k in range(j + 1, i + 1):
                S[i][k] = S[i][k] - lower * S[k][j]
            for row in rows:
                row[i] = row[i] - lower * row[j]
            w.write(lower, "factors", 0, p + triangle(i, j))
        w.write(inverse, "factors", 0, p + triangle(j, j))
        S[j][j] = inverse
    scaled = [[[s * S[j][j] for j, s in enumerate(row)] for row in block] for block in below]
    for a, block in enumerate(scaled):
        for i, row in enumerate(block):
            for j, s in enumerate(row):
                w.write(s, "factors", 2 + 2 * a, i * p + j)
    base = 2 + 2 * len(later)
    for a, block in enumerate(scaled):
        for b in range(a + 1):
            for i, row in enumerate(block):
                for j, other in enumerate(below[b]):
                    if a > b or j <= i:
                        offset = i * later[b] + j if a > b else later[a] + triangle(i, j)
                        w.write(-dot(w.graph, row, other), "gram", base, offset, ADD)
            base += 1
