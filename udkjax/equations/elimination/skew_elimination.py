"""Elimination by blocks of a matrix that is not symmetric, J C (J + S^T)^T with C = M^(-1) and J = Psi_q.

S are the slopes of the friction of joints by their own multipliers. The friction of a joint acts on the bodies of the joint
alone: the matrix has the blocks of J C J^T, which block_elimination.py orders and factorizes. A block is stored twice, below and
above the diagonal.
"""

from functools import cached_property

import numpy as np

from udkjax.equations.elimination.block_elimination import BlockElimination
from udkjax.equations.elimination.front_substitution import FrontFactors, triangle
from udkjax.equations.terms.scene_layout import BODIES, BODY_CONSTANTS, ENTRIES, RIGHT, SLOPES, ConstraintGroup
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, compliance, dot
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, Reset
from udkjax.expressions.scalars.selection import absolute, both, greater, where
from udkjax.pinv.elimination_order import Fronts

FACTORS = FrontFactors("skew_factors", is_symmetric=False)


class SkewElimination:
    """Loops that form J C (J + S^T)^T from the entries in `psi_q` and `slopes`, factorize it and solve with the factors.

    Their arrays are added to the layout after those of J C J^T in `symmetric`. `base` is J C J^T in the layout of `gram`; `skew`
    is the whole matrix: diagonal blocks, then for each pair of coupled blocks the lower and the upper one. `skew_factors` holds
    L, D and U in the same places. Rows that `symmetric` leaves out are left out here. `negative` counts the
    pivots below zero: without friction there are none.
    """

    def __init__(self, terms: SceneTerms, symmetric: BlockElimination):
        self.terms, self._symmetric = terms, symmetric
        layout, sizes, pairs = terms.layout, symmetric.sizes, symmetric.off_diagonals
        layout.sizes |= {"base": layout.sizes["gram"], "skew": 0, "negative": 1}
        self._diagonals = [layout.reserve("skew", p * p) for p in sizes]
        self._lower = {pair: layout.reserve("skew", sizes[pair[0]] * sizes[pair[1]]) for pair in pairs}
        self._upper = {pair: layout.reserve("skew", sizes[pair[0]] * sizes[pair[1]]) for pair in pairs}
        layout.sizes["skew_factors"] = layout.sizes["skew"]

    # --- programs

    @cached_property
    def form_symmetric(self) -> list[KernelLoop | Reset]:
        """The loops that form J C J^T in `base`, since elimination has overwritten it in `gram`."""
        return [self._renamed(part) for part in self._symmetric.form()]

    def factorize(self) -> ProgramParts:
        """Yield loops that form the matrix from `base` and `slopes`, and factorize it."""
        yield from self._assemble
        yield Reset("negative", 0, 1)
        yield from self._factors

    def substitute(self, solve: int, **names: str) -> ProgramParts:
        """Yield loops that compute x = (J C (J + S^T)^T)^(-1) right; `names` rename arrays of the system, such as x="x2"."""
        yield from FACTORS.substitute(self.terms, self._symmetric.order, self._front_table, solve, **names)

    # --- the matrix

    @staticmethod
    def _renamed(part: KernelLoop | Reset) -> KernelLoop | Reset:
        if isinstance(part, Reset):
            return part._replace(array="base")
        return part._replace(names={**part.names, "gram": "base"})

    @cached_property
    def _assemble(self) -> list[KernelLoop | Reset]:
        """The loops that form the matrix from `base` and `slopes`."""
        return [*self._copies(), *self._diagonal_changes(), *self._off_diagonal_changes()]

    def _copies(self) -> ProgramParts:
        symmetric = self._symmetric
        for p in sorted(set(symmetric.sizes)):

            def copy_diagonal(w: KernelWriter, p: int = p):
                for i in range(p):
                    for j in range(p):
                        w.write(w.read("base", 0, p + triangle(max(i, j), min(i, j))), "skew", 1, i * p + j)

            places = zip(symmetric.sizes, symmetric.diagonals, self._diagonals, strict=True)
            table = [[start, to] for size, start, to in places if size == p]
            yield KernelLoop(self.terms.kernel(("copy diagonal", p), copy_diagonal), np.array(table))
        tables: dict[tuple[int, int], list[list[int]]] = {}
        for pair, start in symmetric.off_diagonals.items():
            shape = symmetric.sizes[pair[0]], symmetric.sizes[pair[1]]
            tables.setdefault(shape, []).append([start, self._lower[pair], self._upper[pair]])
        for (rows, columns), table in tables.items():

            def copy_pair(w: KernelWriter, rows: int = rows, columns: int = columns):
                for i in range(rows):
                    for j in range(columns):
                        s = w.read("base", 0, i * columns + j)
                        w.write(s, "skew", 1, i * columns + j)
                        w.write(s, "skew", 2, j * rows + i)

            yield KernelLoop(self.terms.kernel(("copy pair", rows, columns), copy_pair), np.array(table))

    def _diagonal_changes(self) -> ProgramParts:
        start = 0
        for group in self.terms.layout.eliminated:
            places = self._diagonals[start : start + len(group.members)]
            start += len(group.members)
            if group.rubbing is None:
                continue
            p, to = len(group.rows), group.table.shape[1]

            def write(w: KernelWriter, group: ConstraintGroup = group, p: int = p, to: int = to):
                entries = [group.entries(w, row) for row in group.rows]
                for j, row in enumerate(group.rows):
                    slopes = group.slopes(w, row)
                    falls = [
                        s if s.is_zero else s * compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS)
                        for k, s in enumerate(slopes)
                    ]
                    for i in range(p):
                        w.write(dot(w.graph, entries[i], falls), "skew", to, i * p + j, ADD)

            table = np.concatenate([group.table, np.array(places)[:, None]], 1)
            yield KernelLoop(self.terms.kernel(("diagonal slopes", group), write), table)

    def _off_diagonal_changes(self) -> ProgramParts:
        tables: dict[tuple[ConstraintGroup, int, ConstraintGroup, int], list[list[int]]] = {}
        for (late, late_slot), (early, early_slot), body in self._symmetric.shared_bodies():
            groups = [self._symmetric.elements[k][0] for k in (late, early)]
            if all(group.rubbing is None for group in groups):
                continue
            columns = [ENTRIES, *([SLOPES] if groups[0].rubbing else [])], [ENTRIES, *([SLOPES] if groups[1].rubbing else [])]
            starts = [
                [self._symmetric.place(k, group.column(c) if c < 0 else c) for c in of]
                for k, group, of in zip((late, early), groups, columns, strict=True)
            ]
            row = [starts[0][0], starts[1][0], starts[0][-1], starts[1][-1], self._lower[late, early], self._upper[late, early]]
            tables.setdefault((groups[0], late_slot, groups[1], early_slot), []).append([*row, self.terms.layout.of_body(body)])
        for key, table in tables.items():

            def write(w: KernelWriter, key: tuple[ConstraintGroup, int, ConstraintGroup, int] = key):
                late, late_slot, early, early_slot = key
                _write_products(w, (late, late_slot, 0, 2), (early, early_slot, 1, 3), 4)
                _write_products(w, (early, early_slot, 1, 3), (late, late_slot, 0, 2), 5)

            yield KernelLoop(self.terms.kernel(("slope product", *key), write), np.array(table))

    @property
    def _factors(self) -> ProgramParts:
        for fronts in self._symmetric.order:

            def write(w: KernelWriter, fronts: Fronts = fronts):
                _eliminate(w, fronts.size, fronts.later_sizes)

            key = "eliminate skew", fronts.size, fronts.later_sizes
            yield KernelLoop(self.terms.kernel(key, write), self._front_table(fronts))

    def _front_table(self, fronts: Fronts) -> np.ndarray:
        """Return the table of fronts of the same sizes.

        The columns are start indices: first of the block's factors, of its right-hand side, and of its symmetric factors; then,
        for each later block, of the lower and the upper block that couple the two and of the later block's right-hand side; last,
        of the blocks that couple the later blocks, row by row.
        """
        table, symmetric = [], self._symmetric
        for k, later in zip(fronts.blocks, fronts.later, strict=True):
            row = [self._diagonals[k], symmetric.place(k, RIGHT), symmetric.diagonals[k]]
            for a in later:
                row += [self._lower[a, k], self._upper[a, k], symmetric.place(a, RIGHT)]
            row += [self._block(a, b) for a in later for b in later]
            table.append(row)
        return np.array(table)

    def _block(self, a: int, b: int) -> int:
        if a == b:
            return self._diagonals[a]
        return self._lower[a, b] if (a, b) in self._lower else self._upper[b, a]


def _write_products(
    w: KernelWriter, rows: tuple[ConstraintGroup, int, int, int], columns: tuple[ConstraintGroup, int, int, int], to: int
) -> None:
    """Write code that adds the part of J C S that belongs to a shared body to an off-diagonal block.

    `rows` and `columns` are the two constraints of the block: a group, the index of the body among those of an element, and the
    columns of the table with the start indices of the entries and slopes. `to` is the column with the start index of the block.
    """
    group, slot, entries, _ = rows
    other, other_slot, _, slopes = columns
    if other.rubbing is None:
        return
    for j, column in enumerate(other.rows):
        falls = [other.slope(w, column, 3 * other_slot + k, slopes) for k in range(3)]
        falls = [s if s.is_zero else s * compliance(w, k, 6) for k, s in enumerate(falls)]
        for i, row in enumerate(group.rows):
            product = dot(w.graph, [group.entry(w, row, 3 * slot + k, entries) for k in range(3)], falls)
            if not product.is_zero:
                w.write(product, "skew", to, i * len(other.rows) + j, ADD)


# Kernels of a front: `p` is the number of rows of its block; `later` holds the numbers of rows of its later blocks.


def _eliminate(w: KernelWriter, p: int, later: tuple[int, ...]) -> None:
    zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
    S = [[w.read("skew", 0, i * p + j) for j in range(p)] for i in range(p)]
    below = [
        [[w.read("skew", FACTORS.below(a), i * p + j) for j in range(p)] for i in range(size)] for a, size in enumerate(later)
    ]
    right = [
        [[w.read("skew", FACTORS.beside(a), j * size + i) for i in range(size)] for j in range(p)] for a, size in enumerate(later)
    ]
    for j in range(p):
        is_kept = greater(absolute(w.read("factors", 2, p + triangle(j, j))), zero)
        w.write(where(both(is_kept, greater(zero, S[j][j])), one, zero), "negative", None, 0, ADD)
        inverse = where(is_kept, one / S[j][j], zero)
        for i in range(j + 1, p):
            lower = S[i][j] * inverse
            for k in range(j + 1, p):
                S[i][k] = S[i][k] - lower * S[j][k]
            for block, size in zip(right, later, strict=True):
                for k in range(size):
                    block[i][k] = block[i][k] - lower * block[j][k]
            S[i][j] = lower
        for block in below:
            for row in block:
                row[j] = row[j] * inverse
                for k in range(j + 1, p):
                    row[k] = row[k] - row[j] * S[j][k]
        S[j][j] = inverse
    for i in range(p):
        for j in range(p):
            w.write(S[i][j] * S[i][i] if j > i else S[i][j], "skew_factors", 0, FACTORS.inner(p, i, j))
    for a, size in enumerate(later):
        for i in range(size):
            for j in range(p):
                w.write(below[a][i][j], "skew_factors", FACTORS.below(a), i * p + j)
                w.write(right[a][j][i] * S[j][j], "skew_factors", FACTORS.beside(a), i * p + j)
    base = 3 + 3 * len(later)
    for a, size in enumerate(later):
        for b, other in enumerate(later):
            for i in range(size):
                for j in range(other):
                    product = dot(w.graph, below[a][i], [right[b][k][j] for k in range(p)])
                    w.write(-product, "skew", base, i * other + j, ADD)
            base += 1
