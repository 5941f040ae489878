"""Dependent rows of a large scene, by sparse elimination instead of the singular values of dense_rows.py.

D has unit rows here, and D D^T is eliminated in an order of least fill. A pivot is the square of the distance of its row from the
span of the rows before it. A row with zero pivot depends on those before it, is left out of the elimination, and yields one
vector of the left null space: the row minus the combination of others that equals it. These vectors are sparse. Rows connected by
them form sets, of a few dozen rows in most scenes; each set is decided separately, by singular values.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from udkjax.annotations import Time
from udkjax.arrays import ROUNDING
from udkjax.equations.programs.scales import concrete_scales
from udkjax.equations.rows.balance import balance_of
from udkjax.equations.rows.dense_rows import CLEAR_TOL, RowTerms
from udkjax.equations.rows.position_closure import CLOSURE, Assembly, close_position, driver_time_step, is_closed, try_to_close
from udkjax.equations.rows.position_rows import NEGLIGIBLE_SHARE, PositionRows
from udkjax.equations.terms.loads import mass_of
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv.elimination import default_rank_tol
from udkjax.pinv.elimination_order import minimum_degree
from udkjax.pinv.sparse_gram import SparseMatrix, factor_gram
from udkjax.scene.mechanism import Mechanism

# Largest pivot of a unit row, the square of a length, that counts as zero.
DEPENDENT_PIVOT = default_rank_tol(np.dtype(float)) ** 2
DAMPING = RANK_TOL**2  # added to D D^T in closing; counterpart of the truncation at `RANK_TOL` for small scenes
NULL_SPACE_BATCH = 64  # number of columns of a null space solved for at a time, to limit the memory of the dense columns


class SparsePosition(NamedTuple):
    """A closed position with D, whose rows have unit length, and the pivots of the rows in the elimination of D D^T."""

    t: Time
    q: np.ndarray
    D: SparseMatrix
    pivots: np.ndarray  # of all rows, in the order of Psi
    independent: np.ndarray  # rows with a pivot
    dependent: np.ndarray  # rows without a pivot

    @property
    def rank(self) -> int:
        return len(self.independent)

    @property
    def is_clear(self) -> bool:
        """True if the rank is certain."""
        return bool(np.all(self.pivots[self.independent] > CLEAR_TOL**2))

    @property
    def smallest(self) -> float:
        """The smallest distance of an independent row from the span of the rows before it."""
        return float(np.sqrt(self.pivots[self.independent].min(initial=1.0)))

    def tangent_part(self, heading: np.ndarray) -> np.ndarray:
        """Return the part of a displacement that the constraints allow."""
        solve = factor_gram(self.D, DAMPING).solve
        for _ in range(2):
            heading = heading - self.D.T @ solve(self.D @ heading)
        return heading

    @property
    def null_space(self) -> SparseMatrix:
        """A basis of the left null space of D, (rows, redundant)."""
        rows, count = self.D.shape[0], len(self.dependent)
        if not count:
            return csc_array((rows, 0))
        independent = self.D[self.independent]
        solve = factor_gram(independent).solve
        blocks = []
        for start in range(0, count, NULL_SPACE_BATCH):
            dependent = self.dependent[start : start + NULL_SPACE_BATCH]
            right = (independent @ self.D[dependent].T).toarray()
            basis = np.zeros((rows, len(dependent)))
            basis[self.independent] = -solve(right)
            basis[dependent, np.arange(len(dependent))] = 1.0
            basis[np.abs(basis) < NEGLIGIBLE_SHARE] = 0.0
            blocks.append(coo_array(basis))
        return csc_array(_stack_columns(blocks, rows))


def _stack_columns(blocks: list[SparseMatrix], rows: int) -> SparseMatrix:
    shift = np.cumsum([0, *(p.shape[1] for p in blocks)])
    indices = (
        np.concatenate([p.row for p in blocks]),
        np.concatenate([p.col + s for p, s in zip(blocks, shift, strict=False)]),
    )
    return coo_array((np.concatenate([p.data for p in blocks]), indices), shape=(rows, shift[-1]))


class SparseRows(RowTerms, PositionRows[SparsePosition]):
    """Psi and sparse D of a mechanism with concrete numbers, in the metric M^(-1/2), or (A, A, 1) to find redundant rows.

    Like `DenseRows`, it can assemble a mechanism (`assemble`).
    """

    def __init__(self, mechanism: Mechanism, kinematic: bool = False):
        super().__init__(mechanism)
        self.scales = jax.tree.map(np.asarray, concrete_scales(mechanism))
        arm = float(self.scales.arm)
        self.metric = np.tile([arm, arm, 1.0], self.size // 3) if kinematic else 1 / np.sqrt(mass_of(mechanism, np))
        self.balance = balance_of(mechanism) if kinematic else None
        if self.balance is not None:
            self.metric = self.metric * self.balance.coordinates
        self.driver_time_step = driver_time_step(self.scales)

    @cached_property
    def _order(self) -> list[int]:
        rows: list[set[int]] = [set() for _ in range(self.count)]
        for i, k in zip(*self.entries, strict=True):
            rows[i].add(k // 3)
        return minimum_degree(rows)

    def at(self, t: Time, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, SparseMatrix]:
        psi, _, values = self.geometry(t, q, q)
        D, row_lengths = self._normalize_rows(values)
        return psi, row_lengths, D

    def dense(self, matrix: SparseMatrix) -> np.ndarray:
        return matrix.toarray()

    def _normalize_rows(self, values: np.ndarray) -> tuple[SparseMatrix, np.ndarray]:
        rows, columns = self.entries
        values = values * self.metric[columns]
        length = np.sqrt(np.bincount(rows, values**2, self.count))
        length[length <= ROUNDING * np.max(length, initial=0.0)] = 1.0  # rounding errors are not scaled up
        return csr_array((values / length[rows], self.entries), shape=(self.count, self.size)), length

    def step_size(self, step: np.ndarray) -> float:
        return float(self.scales.size(step if self.balance is None else step / self.balance.coordinates, np))

    def residual(self, t: Time, q: np.ndarray) -> np.ndarray:
        residual = self.psi(t, q) / self.scales.rows
        return residual if self.balance is None else residual / self.balance.rows

    def correction(self, t: Time, q: np.ndarray) -> np.ndarray:
        psi, row_lengths, D = self.at(t, q)
        return self._correction_for(D, psi / row_lengths)

    def _correction_for(self, D: SparseMatrix, residual: np.ndarray) -> np.ndarray:
        """Return -W D^T (D D^T + damping)^(-1) residual."""
        if not np.all(np.isfinite(D.data)):
            return np.full(self.size, np.nan)
        return -self.metric * (D.T @ factor_gram(D, DAMPING).solve(residual))

    def close(self, t: Time, q: np.ndarray, give_up: bool = False) -> SparsePosition | None:
        q = try_to_close(self, t, q) if give_up else close_position(self, t, q, np)
        psi, _, D = self.at(t, q)
        if not np.all(np.isfinite(D.data)) or not is_closed(self.scales, q, 0 * q, psi, 0 * psi, np):
            return None
        return self._position(t, q, D)

    def assemble(self, t: Time, q: np.ndarray, v: np.ndarray) -> Assembly[np.ndarray]:
        """Return closed q, v projected onto the constraints, the remaining Psi and Psi_dot, and the rank of D."""
        if not self.count:
            return q, v, np.zeros(0), np.zeros(0), 0
        q = close_position(self, t, q, np)
        psi, row_lengths, D = self.at(t, q)
        if not np.all(np.isfinite(D.data)):
            return q, v, psi, psi, 0
        rank = self._position(t, q, D).rank
        for _ in range(CLOSURE.velocities + 1):  # the damped first correction is not exact
            _, psi_dot, _ = self.geometry(t, q, v)
            v = v + self._correction_for(D, psi_dot / row_lengths)
        _, psi_dot, _ = self.geometry(t, q, v)
        return q, v, psi, psi_dot, rank

    def split_rows(self, positions: list[SparsePosition]) -> Sequence[tuple[np.ndarray, Sequence["RowSubset"]]]:
        return split_dependent_rows(positions)

    def _position(self, t: Time, q: np.ndarray, D: SparseMatrix) -> SparsePosition:
        pivots = find_pivots(csr_array(D @ D.T), self._order)
        has_pivot = pivots > DEPENDENT_PIVOT
        return SparsePosition(t, q, D, pivots, np.flatnonzero(has_pivot), np.flatnonzero(~has_pivot))


def find_pivots(gram: SparseMatrix, order: list[int]) -> np.ndarray:
    """Return the pivot of each row, by elimination of D D^T in a given order, for unit rows; dependent rows are skipped."""
    position = np.empty(len(order), int)
    position[order] = np.arange(len(order))
    column: list[dict[int, float]] = [{} for _ in order]
    entries = coo_array(gram)
    for i, j, value in zip(position[entries.row].tolist(), position[entries.col].tolist(), entries.data.tolist(), strict=True):
        if i >= j:
            column[j][i] = value
    pivots = np.zeros(len(order))
    for j, below in enumerate(column):
        pivot = below.pop(j, 0.0)
        pivots[order[j]] = pivot
        if pivot <= DEPENDENT_PIVOT:
            continue
        rows = sorted(below)
        for n, k in enumerate(rows):
            multiplier, target = below[k] / pivot, column[k]
            for i in rows[n:]:
                target[i] = target.get(i, 0.0) - multiplier * below[i]
        below.clear()
    return pivots


class RowSubset(NamedTuple):
    """A set of rows at one position, with an orthonormal basis of its left null space."""

    smallest: Time  # smallest nonzero singular value, relative to the largest
    null_space: np.ndarray


def split_dependent_rows(positions: list[SparsePosition]) -> list[tuple[np.ndarray, list[RowSubset]]]:
    """Return the sets of rows that depend on each other, as indices, each with its null space at each position."""
    null_vectors = _stack_columns([coo_array(p.null_space) for p in positions], len(positions[0].pivots))
    rows, columns = null_vectors.shape
    links = coo_array(
        (np.ones(null_vectors.nnz), (null_vectors.row, rows + null_vectors.col)), shape=(rows + columns, rows + columns)
    )
    involved = np.unique(null_vectors.row)
    _, label = np.unique(connected_components(links, directed=False)[1][involved], return_inverse=True)
    sets = [involved[label == k] for k in range(label.max(initial=-1) + 1)]
    return [(members, [_row_subset(p, members) for p in positions]) for members in sets]


def _row_subset(position: SparsePosition, members: np.ndarray) -> RowSubset:
    D = position.D[members]
    u, sigma, _ = np.linalg.svd(D[:, np.unique(D.indices)].toarray())
    rank = len(members) - int(np.isin(members, position.dependent).sum())
    return RowSubset(float(sigma[rank - 1] / sigma[0]) if rank else 1.0, u[:, rank:])
