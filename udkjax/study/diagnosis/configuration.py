"""A closed position of a mechanism, its scaled Jacobian with null spaces, and nearby closed positions.

NumPy computes all of this from the scene's programs, without compilation. Rows and columns are scaled as in determinacy.py. In
large scenes the Jacobian is sparse, and only its small singular values are computed.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.rows.dense_rows import KinematicRows
from udkjax.equations.rows.position_closure import CLOSURE, close_position, is_closed
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.rows.redundancy import kinematic_rows
from udkjax.scene.mechanism import Mechanism

if TYPE_CHECKING:
    from udkjax.pinv.sparse_gram import SmallSingularValues

NEIGHBOUR_STEP = 0.1  # step from one neighbour to the next, relative to the characteristic length, and rad
N_NEIGHBOURS = 12
SMALLEST_MOVE = 0.01  # distance, relative to a step, below which positions are the same


class Configuration:
    """A closed position and its scaled Jacobian J = U S V^T; the factors are computed when they are used.

    Args:
        t: time (s).
        q: coordinates (n,).
        J: scaled Jacobian (m, n).
        rank_tol: singular values up to this fraction of the largest count as zero.
    """

    def __init__(self, t: float, q: np.ndarray, J: np.ndarray, rank_tol: float):
        self.t, self.q, self.J, self._rank_tol = t, q, J, rank_tol

    @cached_property
    def sigma(self) -> np.ndarray:
        """The singular values, without the vectors, whose computation takes several times as long."""
        return singular_values(self.J)

    @cached_property
    def rank(self) -> int:
        """Number of nonzero singular values."""
        return count_rank(self.sigma, self._rank_tol)

    def value(self, number: int) -> float:
        """Return the `number`-th largest singular value, counted from one; `number` must be at least the rank.

        A `LargeConfiguration` only knows the singular values from there on.
        """
        return float(self.sigma[number - 1])

    @property
    def largest(self) -> float:
        """The largest singular value."""
        return float(np.max(self.sigma, initial=0.0))

    @cached_property
    def _vectors(self) -> tuple[np.ndarray, np.ndarray]:
        u, _, vt = np.linalg.svd(self.J) if self.J.size else (np.eye(len(self.J)), None, np.eye(self.J.shape[1]))
        return u, vt

    @property
    def u(self) -> np.ndarray:
        """The left singular vectors, (m, m)."""
        return self._vectors[0]

    @property
    def vt(self) -> np.ndarray:
        """The right singular vectors, (n, n), as rows."""
        return self._vectors[1]

    @property
    def left(self) -> np.ndarray:
        """Basis of the left null space, (m, m - rank): combinations of rows that vanish."""
        return self.u[:, self.rank :]

    @property
    def right(self) -> np.ndarray:
        """Basis of the null space, (n, n - rank): displacements that the constraints allow to first order."""
        return self.vt[self.rank :].T

    def allowed(self, displacement: np.ndarray) -> np.ndarray:
        """Return the part of a displacement (n,) that the constraints allow."""
        return self.right @ (self.right.T @ displacement)

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of J."""
        return self.J.shape[0], self.J.shape[1]

    @property
    def freedom(self) -> int:
        """Number of degrees of freedom, n - rank."""
        return self.shape[1] - self.rank

    @property
    def redundancy(self) -> int:
        """Number of redundant rows."""
        return self.shape[0] - self.rank

    @property
    def smallest(self) -> float:
        """The smallest nonzero singular value, relative to the largest; 1 if the rank is zero."""
        return self.value(self.rank) / self.largest if self.rank else 1.0


class LargeConfiguration(Configuration):
    """A configuration of a large mechanism, whose Jacobian is sparse; a path of many of them takes little memory.

    Args:
        t: time (s).
        q: coordinates (n,).
        J: scaled Jacobian (m, n), in compressed sparse rows.
        small: the small singular values of J.
        rank_tol: singular values up to this fraction of the largest count as zero.
    """

    def __init__(self, t: float, q: np.ndarray, J: Any, small: "SmallSingularValues", rank_tol: float):
        self.t, self.q, self.sparse, self._small, self._rank_tol = t, q, J, small, rank_tol

    @cached_property
    def J(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.sparse.toarray()

    @property
    def shape(self) -> tuple[int, int]:
        return self.sparse.shape

    @cached_property
    def rank(self) -> int:
        return self.shape[0] - self._small.zero_count

    def value(self, number: int) -> float:
        return float(self._small.values[self.shape[0] - number])

    @property
    def largest(self) -> float:
        return self._small.largest

    @property
    def left(self) -> np.ndarray:
        return self._small.left

    def allowed(self, displacement: np.ndarray) -> np.ndarray:
        return self._small.null_space_part(displacement)


class RankedPositions:
    """The closed positions of a mechanism with concrete numbers, each as a `Configuration` with the rank of its scaled Jacobian.

    Attributes:
        rows: the rows of the mechanism.
        rank_tol: singular values up to this fraction of the largest count as zero.
        unit: scale of each coordinate: coordinates are divided by it.
        row_unit: scale of each row of Psi: rows are divided by it.
    """

    def __init__(self, mechanism: Mechanism, rank_tol: float):
        rows = self.rows = KinematicRows(mechanism)
        self.rank_tol, self._mechanism = rank_tol, mechanism
        self._is_large = bool(rows.count) and not scene_programs(mechanism).is_small
        self._vectors: np.ndarray | None = None  # of small singular values at the last position: the next ones are similar
        length = float(rows.scales.length)
        self.unit = np.tile([length, length, 1.0], rows.size // 3)
        self.row_unit = np.asarray(rows.scales.rows, float)
        if rows.balance is not None:
            self.unit, self.row_unit = self.unit * rows.balance.coordinates, self.row_unit * rows.balance.rows

    def at(self, t: float, q: np.ndarray) -> Configuration:
        """Return the configuration at closed coordinates q (n,) and time t (s)."""
        if not self._is_large:
            return Configuration(t, q, self._dense_jacobian(t, q), self.rank_tol)
        from udkjax.pinv.sparse_gram import SmallSingularValues  # imports SciPy, which small scenes do not need

        J = self._sparse_jacobian(t, q)
        small = SmallSingularValues(J, self.rank_tol, self._vectors)
        self._vectors = small.vectors
        return LargeConfiguration(t, q, J, small, self.rank_tol)

    def change_along(self, at: Configuration, displacement: np.ndarray) -> Any:
        """Return the change of J, by central differences, from minus to plus a displacement in scaled coordinates."""
        jacobian = self._sparse_jacobian if self._is_large else self._dense_jacobian
        step = self.unit * displacement
        return jacobian(at.t, at.q + step) - jacobian(at.t, at.q - step)

    def rank_of_rows(self, at: Configuration, rows: Sequence[int]) -> int:
        """Return the rank of some of the rows of J, which are given by their indices."""
        if len(rows) == at.shape[0]:
            return at.rank
        return count_rank(singular_values(at.J[rows]), self.rank_tol)

    def _dense_jacobian(self, t: float, q: np.ndarray) -> np.ndarray:
        return self.rows.jacobian(t, q) * self.unit / self.row_unit[:, None]

    def _sparse_jacobian(self, t: float, q: np.ndarray) -> Any:
        from scipy.sparse import csr_array

        i, k = self.rows.entries
        values = self.rows.geometry(t, q, 0.0 * q)[2] * self.unit[k] / self.row_unit[i]
        return csr_array((values, (i, k)), shape=(self.rows.count, self.rows.size))

    @cached_property
    def _closing(self) -> PositionRows:
        return kinematic_rows(self._mechanism) if self._is_large else self.rows  # sparse in large scenes

    @cached_property
    def _by_elimination(self) -> KinematicRows | None:
        """The rows without the redundant ones that `analyse` finds; None in large scenes, or if `analyse` does not know these."""
        redundant = None if self._is_large else analyse(self._mechanism).redundant_rows
        if redundant is None:
            return None
        rows = KinematicRows(self._mechanism)
        rows.leave_out(redundant)
        return rows

    def near(self, t: float, q: np.ndarray) -> Configuration | None:
        """Return the closed position nearest to coordinates q (n,) at time t (s); None if none is found.

        First the independent rows are closed: then the redundant ones hold, too, unless branches of the motion meet there. If
        they do not hold, all rows are closed together.
        """
        if not self.rows.count:
            return self.at(t, q)
        for closing in filter(None, (self._by_elimination, self._closing)):
            closed = close_position(closing, t, q, np)
            psi = self.rows.psi(t, closed)
            if is_closed(self.rows.scales, closed, 0 * closed, psi, 0 * psi, np):
                return self.at(t, closed)
        return None

    def displace(self, start: Configuration, direction: np.ndarray, step: float, t: float | None = None) -> Configuration | None:
        """Return the closed position nearest to `start` plus a step; None if none is found.

        Args:
            start: the configuration to start from.
            direction: direction of the step in scaled coordinates (n,).
            step: length of the step, relative to the direction's.
            t: time (s) of the closed position; by default that of `start`.
        """
        return self.near(start.t if t is None else t, start.q + step * self.unit * direction)

    def distance(self, first: Configuration, second: Configuration, turns: bool = True) -> float:
        """Return the distance between two positions, the norm of the scaled displacement.

        With `turns`, angles that differ by whole turns are different; without, they are the same.
        """
        displacement = (second.q - first.q) / self.unit
        if not turns:
            displacement[2::3] = np.remainder(displacement[2::3] + np.pi, 2 * np.pi) - np.pi
        return float(np.linalg.norm(displacement))

    def around(self, start: Configuration) -> list[Configuration]:
        """Return closed positions along a random motion from `start`, with moving drivers; empty if the mechanism cannot move."""
        random, neighbours, last = np.random.default_rng(0), [], start
        heading, t = random.standard_normal(len(start.q)), start.t
        for _ in range(N_NEIGHBOURS if self.rows.count else 0):
            heading = heading / np.linalg.norm(heading) + 0.3 * random.standard_normal(len(heading)) / np.sqrt(len(heading))
            allowed = last.allowed(heading)
            size = np.linalg.norm(allowed)
            t += self.rows.driver_time_step * NEIGHBOUR_STEP / CLOSURE.longest_step
            direction = allowed / size if size > 0.0 else allowed
            moved = self.displace(last, direction, NEIGHBOUR_STEP, t) or self.displace(last, direction, NEIGHBOUR_STEP, last.t)
            if moved is None or self.distance(moved, last) < SMALLEST_MOVE * NEIGHBOUR_STEP:
                heading = random.standard_normal(len(heading))
                continue
            heading, last = (allowed if size > 0.0 else heading), moved
            neighbours.append(moved)
        return neighbours


class JointForces(NamedTuple):
    """Uniqueness of the multipliers of a constraint, by its rows of N, an orthonormal basis of the left null space of J."""

    unique: tuple[bool, ...]  # for each row
    share: tuple[float, ...]  # norm of each row of N: from 0 (unique) to 1 (arbitrary)
    direction: float | None  # for a joint at a point: the only direction (rad) in which its force is unique, if any


def singular_values(J: np.ndarray) -> np.ndarray:
    """Return the singular values of a matrix, which may be empty."""
    return np.linalg.svd(J, compute_uv=False) if J.size else np.zeros(0)


def count_rank(sigma: np.ndarray, rank_tol: float) -> int:
    """Return the number of singular values, sorted from the largest, that exceed `rank_tol` times the largest."""
    return int(np.sum(sigma > rank_tol * sigma[:1]))
