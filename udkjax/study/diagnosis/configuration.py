"""A closed position of a mechanism, its scaled Jacobian with null spaces, and nearby closed positions.

All of this is NumPy on the scene's programs, without compilation. Rows and columns are scaled as in determinacy.py.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from udkjax.equations.dense_rows import KinematicRows
from udkjax.equations.position_closure import CLOSURE, close_position, is_closed
from udkjax.equations.position_rows import PositionRows
from udkjax.equations.redundancy import kinematic_rows
from udkjax.scene.mechanism import Mechanism

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

    @property
    def redundancy(self) -> int:
        """Number of redundant rows."""
        return len(self.J) - self.rank

    @property
    def smallest(self) -> float:
        """The smallest nonzero singular value, relative to the largest."""
        return float(self.sigma[self.rank - 1] / self.sigma[0]) if self.rank else 1.0


class RankedPositions:
    """Closed positions of a mechanism with concrete numbers."""

    def __init__(self, mechanism: Mechanism, rank_tol: float):
        rows = self.rows = KinematicRows(mechanism)
        self.rank_tol, self._mechanism = rank_tol, mechanism
        length = float(rows.scales.length)
        self.unit = np.tile([length, length, 1.0], rows.size // 3)
        self.row_unit = np.asarray(rows.scales.rows, float)

    def at(self, t: float, q: np.ndarray) -> Configuration:
        """Return the configuration at closed coordinates."""
        J = self.rows.jacobian(t, q) * self.unit / self.row_unit[:, None]
        return Configuration(t, q, J, self.rank_tol)

    @cached_property
    def _closing(self) -> PositionRows:
        return kinematic_rows(self._mechanism)  # sparse in large scenes

    def near(self, t: float, q: np.ndarray) -> Configuration | None:
        """Return the closed position nearest to q, or None."""
        if not self.rows.count:
            return self.at(t, q)
        q = close_position(self._closing, t, q, np)
        psi = self.rows.psi(t, q)
        return self.at(t, q) if is_closed(self.rows.scales, q, 0 * q, psi, 0 * psi, np) else None

    def displace(self, start: Configuration, direction: np.ndarray, step: float, t: float | None = None) -> Configuration | None:
        """Displace `start` by a step along a direction in scaled coordinates; return the nearest closed position, or None."""
        return self.near(start.t if t is None else t, start.q + step * self.unit * direction)

    def distance(self, first: Configuration, second: Configuration, turns: bool = True) -> float:
        """Return the distance of two positions: the norm of the scaled displacement; whole turns count only with `turns`."""
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
            allowed = last.right @ (last.right.T @ heading)
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
    """Uniqueness of the multipliers of a constraint."""

    unique: tuple[bool, ...]  # for each row
    share: tuple[float, ...]  # norm of each row of N: from 0 (unique) to 1 (arbitrary)
    direction: float | None  # for a joint at a point: the only direction (rad) in which its force is unique, if any


def singular_values(J: np.ndarray) -> np.ndarray:
    """Return the singular values of a matrix, which may be empty."""
    return np.linalg.svd(J, compute_uv=False) if J.size else np.zeros(0)


def count_rank(sigma: np.ndarray, rank_tol: float) -> int:
    """Return the number of singular values, sorted from the largest, that exceed `rank_tol` times the largest."""
    return int(np.sum(sigma > rank_tol * sigma[:1]))
