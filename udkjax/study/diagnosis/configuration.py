"""One closed position of a mechanism, its scaled Jacobian and what that leaves free; and closed positions around it.

All of it is NumPy on the scene's programs: nothing is compiled for it. Rows and columns are scaled as in determinacy.py.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np

from udkjax.equations.dense_rows import KinematicRows
from udkjax.equations.position_closure import LONGEST_STEP, close_position, is_closed
from udkjax.equations.redundancy import PositionRows, kinematic_rows
from udkjax.scene.mechanism import Mechanism

NEIGHBOUR_STEP = 0.1  # of the characteristic length, and rad: from one position to the next of a neighbourhood
N_NEIGHBOURS = 12  # of a neighbourhood
SMALLEST_MOVE = 0.01  # of a step: positions nearer than that to each other are the same


class Configuration:
    """A closed position and its scaled Jacobian J = U S V^T, decomposed as far as it is asked for.

    Args:
        t: time (s).
        q: coordinates (n,).
        J: scaled Jacobian (m, n).
        rank_tol: singular values up to so much of the largest count as zero.
    """

    def __init__(self, t: float, q: np.ndarray, J: np.ndarray, rank_tol: float):
        self.t, self.q, self.J, self._rank_tol = t, q, J, rank_tol

    @cached_property
    def sigma(self) -> np.ndarray:
        """The singular values alone, which take a fraction of the time of all."""
        return singular_values(self.J)

    @cached_property
    def rank(self) -> int:
        """The number of singular values that count."""
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
        """The right singular vectors, (n, n), row by row."""
        return self._vectors[1]

    @property
    def left(self) -> np.ndarray:
        """The combinations of rows that vanish, (m, m - rank)."""
        return self.u[:, self.rank :]

    @property
    def right(self) -> np.ndarray:
        """The displacements that the constraints allow to first order, (n, n - rank)."""
        return self.vt[self.rank :].T

    @property
    def redundancy(self) -> int:
        """Number of rows that depend on others."""
        return len(self.J) - self.rank

    @property
    def smallest(self) -> float:
        """The smallest singular value that counts, relative to the largest."""
        return float(self.sigma[self.rank - 1] / self.sigma[0]) if self.rank else 1.0


class RankedPositions:
    """The closed positions of one mechanism of known numbers."""

    def __init__(self, mechanism: Mechanism, rank_tol: float):
        rows = self.rows = KinematicRows(mechanism)
        self.rank_tol, self._mechanism = rank_tol, mechanism
        length = float(rows.scales.length)
        self.unit = np.tile([length, length, 1.0], rows.size // 3)
        self.row_unit = np.asarray(rows.scales.rows, float)

    def at(self, t: float, q: np.ndarray) -> Configuration:
        """Return the configuration of closed coordinates."""
        J = self.rows.jacobian(t, q) * self.unit / self.row_unit[:, None]
        return Configuration(t, q, J, self.rank_tol)

    @cached_property
    def _closing(self) -> PositionRows:
        return kinematic_rows(self._mechanism)  # sparse, of large scenes

    def near(self, t: float, q: np.ndarray) -> Configuration | None:
        """Return the closed position nearest to q, or None."""
        if not self.rows.count:
            return self.at(t, q)
        q = close_position(self._closing, t, q, np)
        psi = self.rows.psi(t, q)
        return self.at(t, q) if is_closed(self.rows.scales, q, 0 * q, psi, 0 * psi, np) else None

    def displace(self, start: Configuration, direction: np.ndarray, step: float, t: float | None = None) -> Configuration | None:
        """Return the closed position nearest to one that is displaced by a step along a direction, in scaled coordinates."""
        return self.near(start.t if t is None else t, start.q + step * self.unit * direction)

    def distance(self, one: Configuration, two: Configuration, turns: bool = True) -> float:
        """Return the distance of two positions: the norm of the scaled displacement; whole turns may not count."""
        way = (two.q - one.q) / self.unit
        if not turns:
            way[2::3] = np.remainder(way[2::3] + np.pi, 2 * np.pi) - np.pi
        return float(np.linalg.norm(way))

    def around(self, start: Configuration) -> list[Configuration]:
        """Return closed positions along a random motion from one, while drivers go on; none where it cannot move."""
        random, found, last = np.random.default_rng(0), [], start
        heading, t = random.standard_normal(len(start.q)), start.t
        for _ in range(N_NEIGHBOURS if self.rows.count else 0):
            heading = heading / np.linalg.norm(heading) + 0.3 * random.standard_normal(len(heading)) / np.sqrt(len(heading))
            allowed = last.right @ (last.right.T @ heading)
            size = np.linalg.norm(allowed)
            t += self.rows.driver_time_step * NEIGHBOUR_STEP / LONGEST_STEP
            direction = allowed / size if size > 0.0 else allowed
            moved = self.displace(last, direction, NEIGHBOUR_STEP, t) or self.displace(last, direction, NEIGHBOUR_STEP, last.t)
            if moved is None or self.distance(moved, last) < SMALLEST_MOVE * NEIGHBOUR_STEP:
                heading = random.standard_normal(len(heading))
                continue
            heading, last = (allowed if size > 0.0 else heading), moved
            found.append(moved)
        return found


class JointForces(NamedTuple):
    """Multipliers of a constraint that equilibrium decides."""

    unique: tuple[bool, ...]  # row by row
    share: tuple[float, ...]  # the length of each row of N: 0 unique, 1 arbitrary
    direction: float | None  # of a joint that holds a point: the only one (rad) in which its force is unique, if there is one


def singular_values(J: np.ndarray) -> np.ndarray:
    """Return the singular values of a matrix, which may have no entries."""
    return np.linalg.svd(J, compute_uv=False) if J.size else np.zeros(0)


def count_rank(sigma: np.ndarray, rank_tol: float) -> int:
    """Return the number of singular values, the largest first, that are above `rank_tol` of the largest."""
    return int(np.sum(sigma > rank_tol * sigma[:1]))
