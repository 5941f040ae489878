"""Residuals of least squares and their Jacobian, in blocks of rows, of which only the present one is in memory.

Ten records of 1e5 samples with 25 channels and 50 unknowns have a Jacobian of 10 GB. Least squares depend on J^T J, J^T r and
r^T r alone, and these are kept by the triangular factor of [J r] = Q R, with as many rows as columns. The rows of each block are
therefore reduced to such a factor, together with that of the blocks before, so that memory does not grow with the records.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.integrate.solution import Result

BLOCK_NUMBERS = 4096  # size of a block of rows, of which BLAS computes products without threads


class Residuals(NamedTuple):
    """Residuals r and Jacobians J = dr/dz at B sets of unknowns, for some rows of a problem.

    `rows` are the indices of these rows, in increasing order; None for all rows of a problem. `code` is the worst result of the
    runs from which the residuals are computed.
    """

    r: Float[np.ndarray, "B R"]
    J: Float[np.ndarray, "B R K"]
    code: Int[np.ndarray, "B"]
    rows: Int[np.ndarray, "R"] | None = None

    @property
    def ok(self) -> np.ndarray:
        """True (B,) where all runs were completed and all values are finite."""
        return (self.code == Result.successful) & np.isfinite(self.r).all(1) & np.isfinite(self.J).all((1, 2))

    def count_before(self, row: int) -> int:
        """Return the number of rows that come before a row of the problem."""
        return int(np.searchsorted(self.row_numbers, row))

    @property
    def row_numbers(self) -> Int[np.ndarray, "R"]:
        """The indices of these rows among those of the problem."""
        return np.arange(self.r.shape[1]) if self.rows is None else self.rows


def join_rows(blocks: Iterable[Residuals], count: int) -> Residuals:
    """Return all blocks joined to one with `count` rows; rows that are in no block are zero."""
    blocks = list(blocks)
    sets, _, K = blocks[0].J.shape
    r, J = np.zeros((sets, count)), np.zeros((sets, count, K))
    for block in blocks:
        r[:, block.row_numbers], J[:, block.row_numbers] = block.r, block.J
    return Residuals(r, J, np.max([block.code for block in blocks], axis=0))


def residual_vector(blocks: Iterable[Residuals]) -> tuple[Float[np.ndarray, "R"], bool]:
    """Return the residuals of the first set of unknowns, and True if all of them and their derivatives can be computed."""
    parts, ok = [], True
    for block in blocks:
        parts.append(block.r[0])
        ok = ok and bool(block.ok[0])
    return np.concatenate(parts), ok


class Reduction:
    """Rows of [J r], reduced to few as they are added: see `reduce_rows`. `count` is the number of rows that were added."""

    def __init__(self, unknown_count: int):
        self.count = 0
        self._table = np.zeros((0, unknown_count + 1))

    def add(self, r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]) -> None:
        """Add R residuals and their Jacobian."""
        if not len(r):
            return
        self.count += len(r)
        few, factor = reduce_rows(r, J)
        table = np.concatenate([self._table, np.column_stack([factor, few])])
        self._table = np.linalg.qr(table, mode="r") if len(self._table) else table

    def scaled(self, factor: Float[np.ndarray, "K"]) -> "Reduction":
        """Return these rows for unknowns z' in other units, dz = factor dz'."""
        other = Reduction(len(factor))
        other.count, other._table = self.count, self._table * np.append(factor, 1.0)
        return other

    @property
    def r(self) -> Float[np.ndarray, "n"]:
        """The reduced residuals, at most K + 1 in number."""
        return self._table[:, -1]

    @property
    def J(self) -> Float[np.ndarray, "n K"]:
        """The Jacobian of the reduced residuals."""
        return self._table[:, :-1]


def reduce_blocks(blocks: Iterable[Residuals]) -> Reduction | None:
    """Return the reduced rows of all blocks for the first set of unknowns; None if a block cannot be computed."""
    reduction = None
    for block in blocks:
        if not block.ok[0]:
            return None
        reduction = reduction or Reduction(block.J.shape[2])
        reduction.add(block.r[0], block.J[0])
    return reduction


class ReducedGroups(NamedTuple):
    """The rows of [J r] of a fit, reduced by groups of residuals with a common unknown noise.

    Attributes:
        groups: the rows of each group, followed by all rows whose noise is known.
        prior_rows: the Jacobian of the residuals of priors, which the last item of `groups` contains, too.
    """

    groups: Sequence[Reduction]
    prior_rows: Float[np.ndarray, "priors K"]

    def scaled(self, factor: Float[np.ndarray, "K"]) -> "ReducedGroups":
        """Return these rows for unknowns z' in other units, dz = factor dz'."""
        return ReducedGroups([group.scaled(factor) for group in self.groups], self.prior_rows * factor)

    @property
    def rows(self) -> int:
        """The number of rows before their reduction."""
        return sum(group.count for group in self.groups)

    @property
    def J(self) -> Float[np.ndarray, "n K"]:
        """The reduced rows of J of all groups."""
        return np.concatenate([group.J for group in self.groups])

    @property
    def r(self) -> Float[np.ndarray, "n"]:
        """The reduced residuals of all groups."""
        return np.concatenate([group.r for group in self.groups])


def reduce_groups(
    blocks: Iterable[Residuals],
    unknown_count: int,
    group: Int[np.ndarray, "R"],
    priors: int = 0,
    used: Bool[np.ndarray, "R"] | None = None,
) -> ReducedGroups:
    """Return the rows of a fit, reduced by groups of common noise.

    Args:
        blocks: the residuals of the fit; the first set of unknowns is used.
        unknown_count: number K of unknowns.
        group: the group (0, 1, ...) of residuals with a common unknown noise; -1 if the noise is known.
        priors: number of residuals of priors, which are the last rows.
        used: mask of the rows that are used; by default all are.
    """
    groups, prior_rows = [Reduction(unknown_count) for _ in range(group.max(initial=-1) + 2)], np.zeros((priors, unknown_count))
    for block in blocks:
        rows, r, J = block.row_numbers, block.r[0], block.J[0]
        of_block = group[rows] if used is None else np.where(used[rows], group[rows], len(groups))
        for number in np.unique(of_block[of_block < len(groups)]).tolist():
            of_group = of_block == number
            groups[number].add(r[of_group], J[of_group])
        is_prior = rows >= len(group) - priors
        prior_rows[rows[is_prior] - (len(group) - priors)] = J[is_prior]
    return ReducedGroups(groups, prior_rows)


def reduce_rows(r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]) -> tuple[np.ndarray, np.ndarray]:
    """Return at most K + 1 residuals and their Jacobian with the same r.r, J^T r and J^T J, all that least squares depend on.

    They are the triangular factor of [J r] = Q R, which loses no accuracy, as J^T J would. It is computed from the factors of
    blocks of rows, since BLAS would start threads for tall matrices, in which they wait for each other most of the time.
    """
    table = np.column_stack([J, r])
    columns = table.shape[1]
    block = max(2 * columns, BLOCK_NUMBERS // columns)
    while len(table) > 2 * block:
        blocks = np.zeros((-(-len(table) // block), block, columns))
        blocks.reshape(-1, columns)[: len(table)] = table
        table = np.linalg.qr(blocks, mode="r").reshape(-1, columns)
    factor = np.linalg.qr(table, mode="r")
    return factor[:, -1], factor[:, :-1]
