"""Rows in blocks, each on a few blocks of columns: D^+ of thousands of rows by elimination of D D^T, level by level (levels.py).

A block holds the rows of one constraint, and is stored as `columns`: entry (r, c, s) is what slot s has in row r and column c.
Slot s = k blocks + i is the k-th block of columns that block i meets. Blocks of fewer rows are padded with
zeros. A matrix is this one array, whatever its size.
"""

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import combinations
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from udkjax.pinv.levels import Levels
from udkjax.pinv.places import take
from udkjax.pinv.stretching import MANY, Stretched, stretch
from udkjax.pinv.written_out import WrittenOut

GATHERED = 4  # terms of a sum that are fetched; what is beyond, in a few sums of many terms, is sent


class Sums:
    """Sums of slots by targets: x[..., k] is the sum of values[..., s] over the slots s with targets[s] = k (none where < 0)."""

    def __init__(self, targets: np.ndarray, count: int):
        slots = np.flatnonzero(targets >= 0)
        slots = slots[np.argsort(targets[slots], kind="stable")]
        target = targets[slots]
        rank = np.arange(len(slots)) - np.searchsorted(target, target)  # of a slot among those of its target
        depth = min(GATHERED, int(rank.max(initial=-1)) + 1)
        self.near = np.full((depth, count), len(targets))
        for k in range(depth):
            self.near[k, target[rank == k]] = slots[rank == k]
        self.far, self.there = slots[rank >= depth], target[rank >= depth]
        self.count = count

    def __call__(self, values: Float[Array, "*shape slots"]) -> Float[Array, "*shape count"]:
        padded = jnp.concatenate([values, jnp.zeros_like(values[..., :1])], -1)
        total = jnp.zeros((*values.shape[:-1], self.count), values.dtype)
        for fetched in self.near:
            total = total + take(padded, fetched)
        return total.at[..., self.there].add(take(values, self.far)) if len(self.far) else total


class BlockPattern:
    """Which blocks of columns (of `width` columns each, `count` of them) each block of rows meets, and how many rows it has.

    `present` (rows of a block, width) says which places are not zero in all blocks: for the others nothing is computed.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        meets: Sequence[Sequence[int]],
        width: int,
        count: int,
        many: float = MANY,
        present: np.ndarray | None = None,
    ):
        self.sizes, self.width, self.count = np.asarray(sizes, int), width, count
        self.blocks, self.rows = len(sizes), max(sizes, default=0)
        self.present = np.ones((self.rows, width), bool) if present is None else present
        self.deep = max((len(m) for m in meets), default=1) or 1
        self.columns = np.full((self.deep, self.blocks), -1)  # of each slot: the block of columns, or -1
        for i, met in enumerate(meets):
            self.columns[: len(met), i] = met
        self.columns = self.columns.ravel()
        self.by_column = Sums(self.columns, count)
        cut = stretch(meets, many)
        self.copies = Copies(self, cut) if cut.welds else None

    @cached_property
    def levels(self) -> "Levels | Copies":
        """The elimination of D D^T."""
        return Levels.of(self.sizes.tolist(), self.coupled[0].tolist()) if self.copies is None else self.copies

    @cached_property
    def written_out(self) -> WrittenOut | None:
        """The same by code written out, if that is not too much."""
        found = WrittenOut(self) if self.copies is None and self.blocks else None
        return found if found is not None and found.worthwhile else None

    @cached_property
    def parts(self) -> list["Parts"]:
        """The parts that do not touch each other, those of equal shape together."""
        slot = np.arange(len(self.columns))
        met = self.columns >= 0
        links = coo_array(
            (np.ones(met.sum()), (slot[met] % self.blocks, self.blocks + self.columns[met])),
            shape=(self.blocks + self.count,) * 2,
        )
        label = connected_components(links, directed=False)[1]
        within = np.arange(self.rows)[:, None] < self.sizes  # (rows, blocks)
        place = np.arange(self.rows) + self.rows * np.arange(self.blocks)[:, None]  # (blocks, rows)
        found: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
        order = np.argsort(label, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
            blocks, touched = members[members < self.blocks], members[members >= self.blocks] - self.blocks
            rows = place[blocks][within.T[blocks]]
            columns = (self.width * touched[:, None] + np.arange(self.width)).ravel()
            if len(rows):
                found.setdefault((len(rows), len(columns)), []).append((rows, columns))
        return [Parts.of(self, np.stack([r for r, _ in same]), np.stack([c for _, c in same])) for same in found.values()]

    @cached_property
    def coupled(self) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
        """The pairs of blocks that meet the same columns; and in turns: pairs, and the slots of both in which they meet."""
        order = np.argsort(self.columns, kind="stable")
        order = order[self.columns[order] >= 0]
        ends = np.flatnonzero(np.diff(self.columns[order])) + 1
        found: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for slots in np.split(order, ends) if len(order) else []:
            for one, two in combinations(sorted((s % self.blocks, s) for s in slots.tolist()), 2):
                found.setdefault((one[0], two[0]), []).append((one[1], two[1]))
        turns = max(map(len, found.values()), default=0)
        shares = []
        for turn in range(turns):
            which = [p for p, slots in enumerate(found.values()) if len(slots) > turn]
            slots = np.array([slots[turn] for slots in found.values() if len(slots) > turn])
            shares.append((np.array(which), slots[:, 0], slots[:, 1]))
        return np.array(list(found), int).reshape(-1, 2), shares

    def gram(self, D: Float[Array, "r c s"]) -> tuple[Float[Array, "blocks r r"], Float[Array, "pairs r r"]]:
        """The blocks of D D^T: those on the diagonal, and [i, j] for each of the pairs (i, j)."""
        pairs, shares = self.coupled
        r, c, _ = D.shape
        whole = D.reshape(r, c, self.deep, self.blocks)

        def product(i: int, j: int, left: Array, right: Array) -> Array:
            """Row i of some blocks by row j of others."""
            terms = (left[i, k] * right[j, k] for k in range(c) if self.present[i, k] and self.present[j, k])
            return sum(terms, jnp.zeros(left.shape[2:], D.dtype))

        half = [[jnp.sum(product(i, j, whole, whole), 0) for j in range(i + 1)] for i in range(r)]
        diagonal = jnp.stack([jnp.stack([half[max(i, j)][min(i, j)] for j in range(r)], -1) for i in range(r)], -2)
        coupling = jnp.zeros((len(pairs), r, r), D.dtype)
        for turn, (which, one, two) in enumerate(shares):
            left, right = take(D, one), take(D, two)
            met = jnp.stack([jnp.stack([product(i, j, left, right) for j in range(r)], -1) for i in range(r)], -2)
            coupling = coupling.at[which].add(met) if turn else met
        return diagonal, coupling

    def matvec(self, D: Float[Array, "r c s"], x: Float[Array, "c count"]) -> Float[Array, "r blocks"]:
        """D x, with x by blocks of columns."""
        fetched, none = take(x, np.maximum(self.columns, 0)), jnp.zeros(D.shape[-1], D.dtype)
        rows = [[k for k in range(self.width) if self.present[i, k]] for i in range(self.rows)]
        product = jnp.stack([sum((D[i, k] * fetched[k] for k in some), none) for i, some in enumerate(rows)])
        return jnp.sum(product.reshape(self.rows, self.deep, self.blocks), 1)

    def rmatvec(self, D: Float[Array, "r c s"], y: Float[Array, "r blocks"]) -> Float[Array, "c count"]:
        """D^T y."""
        y, none = jnp.tile(y, (1, self.deep)), jnp.zeros(D.shape[-1], D.dtype)
        columns = [[i for i in range(self.rows) if self.present[i, k]] for k in range(self.width)]
        return self.by_column(jnp.stack([sum((D[i, k] * y[i] for i in some), none) for k, some in enumerate(columns)]))


class Copies:
    """The elimination of D D^T where some blocks of columns are met by many blocks of rows: on copies of them (stretching.py)."""

    def __init__(self, pattern: BlockPattern, cut: Stretched):
        self.blocks, self.deep = pattern.blocks, pattern.deep
        sizes = [*pattern.sizes.tolist(), *[pattern.width] * cut.welds]
        self.pattern = BlockPattern(sizes, cut.meets, pattern.width, len(cut.original), math.inf)
        self.scale = np.ones((pattern.deep, pattern.blocks))
        for i, met in enumerate(cut.meets[: pattern.blocks]):
            self.scale[: len(met), i] = cut.scale[list(met)]
        self.welds = np.zeros((self.pattern.rows, pattern.width, self.pattern.deep, self.pattern.blocks))
        for k, sign in enumerate((1, -1)):
            self.welds[: pattern.width, :, k, pattern.blocks :] = sign * np.eye(pattern.width)[..., None]

    def gram(self, D: Float[Array, "r c s"]) -> tuple[Array, Array]:
        r, c, _ = D.shape
        scaled = D.reshape(r, c, self.deep, self.blocks) * self.scale
        rows = jnp.asarray(self.welds, D.dtype).at[:r, :, : self.deep, : self.blocks].set(scaled)
        return self.pattern.gram(rows.reshape(*rows.shape[:2], -1))

    def factor(self, diagonal: Array, coupling: Array, drop: Any) -> tuple[Any, Bool[Array, ""]]:
        return self.pattern.levels.factor(diagonal, coupling, drop)

    def solve(self, factors: Any, r: Float[Array, "blocks r"]) -> Float[Array, "blocks r"]:
        welded = jnp.zeros((self.pattern.blocks, self.pattern.rows), r.dtype).at[: self.blocks, : r.shape[1]].set(r)
        return self.pattern.levels.solve(factors, welded)[: self.blocks, : r.shape[1]]


class Parts(NamedTuple):
    """Parts of equal shape: the places of their rows and columns in flat vectors, and of their entries."""

    rows: np.ndarray  # (parts, m)
    columns: np.ndarray  # (parts, n)
    entries: np.ndarray  # (3, .): part, row, column
    places: np.ndarray  # (.,), in D.ravel()

    @staticmethod
    def of(pattern: BlockPattern, rows: np.ndarray, columns: np.ndarray) -> "Parts":
        row_at, column_at = (np.full((2, size), -1) for size in (pattern.rows * pattern.blocks, pattern.width * pattern.count))
        for at, places in ((row_at, rows), (column_at, columns)):
            at[0, places], at[1, places] = np.arange(len(places))[:, None], np.arange(places.shape[1])
        shape = (pattern.rows, pattern.width, pattern.deep * pattern.blocks)
        r, c, s = np.unravel_index(np.arange(int(np.prod(shape))), shape)
        row, column = row_at[:, pattern.rows * (s % pattern.blocks) + r], column_at[:, pattern.width * pattern.columns[s] + c]
        mine = (pattern.columns[s] >= 0) & (row[0] >= 0)
        return Parts(rows, columns, np.stack([row[0], row[1], column[1]])[:, mine], np.flatnonzero(mine))

    def matrices(self, D: Float[Array, "r c s"]) -> Float[Array, "parts m n"]:
        """D of each part, dense."""
        empty = jnp.zeros((len(self.rows), self.rows.shape[1], self.columns.shape[1]), D.dtype)
        return empty.at[tuple(self.entries)].set(take(D.ravel(), self.places))


def by_block(x: Float[Array, "n"], size: int) -> Float[Array, "size count"]:
    """Split a flat vector of blocks of equal size, block by block, into one array a place in the block."""
    return x.reshape(-1, size).T


def flat(x: Float[Array, "size count"]) -> Float[Array, "n"]:
    """Undo `by_block`."""
    return x.T.ravel()
