"""Psi and D of a small mechanism with concrete numbers, by NumPy on the scene's programs, without compilation.

This module is used to close a mechanism and to find its redundant rows (position_rows.py).
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.annotations import Time
from udkjax.arrays import ROUNDING
from udkjax.equations.elimination.dense_pseudoinverse import FactoredPseudoinverse, TruncatedPseudoinverse, dense_pseudoinverse
from udkjax.equations.programs.eliminated_steps import Eliminated
from udkjax.equations.programs.scales import Scales, concrete_scales
from udkjax.equations.programs.scene_arrays import arrays_in_time
from udkjax.equations.programs.scene_programs import scene_programs
from udkjax.equations.rows.balance import balance_of
from udkjax.equations.rows.position_closure import CLOSURE, Assembly, close_position, driver_time_step, is_closed, try_to_close
from udkjax.equations.rows.position_rows import PositionRows
from udkjax.equations.terms.loads import mass_of
from udkjax.equations.terms.rest_program import CURVATURE, DAMPING, LOADS, STIFFNESS
from udkjax.equations.terms.structure import structure
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

# Thresholds for the singular values of D with unit rows at a closed position, relative to the largest. Values up to the first
# threshold count as zero, because rounding errors of redundant rows reach half of the digits. Values above the second are
# nonzero. In between, near a singular configuration, the rank is uncertain.
DEPENDENT_TOL, CLEAR_TOL = float(np.sqrt(np.finfo(float).eps)), 1e-4


def _key(t: Time, q: np.ndarray) -> tuple[bytes, bytes]:
    return np.asarray(t, float).tobytes(), q.tobytes()


class RowTerms:
    """Psi, Psi_dot and the entries of Psi_q of a mechanism with concrete numbers, by NumPy on the scene's programs."""

    def __init__(self, mechanism: Mechanism):
        programs = scene_programs(mechanism)
        self.count, self.size, self.names = programs.row_count, programs.coordinate_count, programs.row_names
        self.entries = tuple(programs.psi_q_entries[:2])  # their rows and columns
        self._arrays_at = arrays_in_time(mechanism)
        self._latest: tuple[Any, bytes, Any] = ((), b"", None)  # the programs' inputs and results at the last state
        self._latest_psi: tuple[Any, Any] = ((), None)  # the last position where Psi alone was needed, and Psi

    def geometry(self, t: Time, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return Psi (m,), Psi_dot (m,) and the entries of Psi_q; the result at the last state is cached."""
        position, velocity = _key(t, q), v.tobytes()
        latest = self._latest
        if latest[:2] != (position, velocity):
            self._latest = latest = position, velocity, self._arrays_at(t).geometry(t, q, v)
        return latest[2]

    def psi(self, t: Time, q: np.ndarray) -> np.ndarray:
        """Return Psi (m,); the result at the last position is cached, as an accepted step of a closure asks for it again."""
        key = _key(t, q)
        if self._latest[0] == key:
            return self._latest[2][0]
        if self._latest_psi[0] != key:
            self._latest_psi = key, self._arrays_at(t).psi(t, q)
        return self._latest_psi[1]


class RestingLoads(NamedTuple):
    """Loads of a mechanism at rest, and their derivatives."""

    force: np.ndarray  # F (n,)
    sizes: np.ndarray  # (n,) the sum of the absolute loads of gravity and of each force element
    stiffness: np.ndarray  # -F_q (n, n)
    damping: np.ndarray  # -F_v (n, n)


class DenseTerms(RowTerms):
    """Psi and its derivatives, and loads at rest, of a mechanism with concrete numbers, as dense matrices."""

    def __init__(self, mechanism: Mechanism):
        super().__init__(mechanism)
        self.mass = np.asarray(mass_of(mechanism, np))  # the diagonal of M
        self._programs, self._has_forces = scene_programs(mechanism), bool(mechanism.force_names)
        self._weight = self.mass * np.tile([*np.asarray(mechanism.gravity, float), 0.0], self.size // 3)
        self._at_rest, self._flat = np.zeros(self.size), dict[str, np.ndarray]()
        self._kind, self._is_sampled = structure(mechanism), bool(mechanism.samples)
        self._latest_loads: tuple[Any, Any] = ((), None)  # the last position and the loads there

    @staticmethod
    @cached_by_identity
    def of(mechanism: Mechanism) -> "DenseTerms":
        """Return the terms of a mechanism, made once for each mechanism."""
        return DenseTerms(mechanism)

    def eliminated(self, redundant_rows: tuple[int, ...], length: float | None) -> Eliminated | None:
        """Return the mechanism's `Eliminated`, which explains the arguments; None if numbers are sampled over time."""
        return None if self._is_sampled else Eliminated(self._kind, self._arrays_at(0.0).numbers, redundant_rows, length)

    def slopes(self, t: Time, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Psi_q (m, n) and Psi_t (m,)."""
        _, rate, entries = self.geometry(t, q, self._at_rest)
        Psi_q = np.zeros((self.count, self.size))
        Psi_q[self.entries] = entries
        return Psi_q, rate

    def gamma(self, t: Time, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return gamma (m,), the right-hand side of Psi_q a = gamma."""
        free, b = self._arrays_at(t).loads(t, q, v)
        return b + self.slopes(t, q)[0] @ free

    def loads_at_rest(self, t: Time, q: np.ndarray) -> RestingLoads:
        """Return the loads at rest in a position, and their derivatives; the result at the last position is cached."""
        key, latest = _key(t, q), self._latest_loads
        if latest[0] != key:
            self._latest_loads = latest = key, self._find_loads(t, q)
        return latest[1]

    def _find_loads(self, t: Time, q: np.ndarray) -> RestingLoads:
        weight = self._weight
        if not self._has_forces:
            return RestingLoads(weight, np.abs(weight), *np.zeros((2, self.size, self.size)))
        entries = self._arrays_at(t).element_loads(t, q, self._at_rest)
        force, sizes = weight, np.abs(weight)
        if LOADS in entries:
            rows, loads = self._programs.at_rest.places[LOADS].rows, entries[LOADS]
            force = force + np.bincount(rows, loads, self.size)
            sizes = sizes + np.bincount(rows, np.abs(loads), self.size)
        stiffness, damping = self._matrix(STIFFNESS, entries.get(STIFFNESS)), self._matrix(DAMPING, entries.get(DAMPING))
        return RestingLoads(force, sizes, stiffness, damping)

    def curvature(self, t: Time, q: np.ndarray, multipliers: np.ndarray) -> np.ndarray:
        """Return (lambda^T Psi)_qq (n, n)."""
        return self._matrix(CURVATURE, self._arrays_at(t).curvature(t, q, multipliers))

    def _matrix(self, name: str, entries: np.ndarray | None) -> np.ndarray:
        if entries is None:
            return np.zeros((self.size, self.size))
        return np.bincount(self._places(name), entries, self.size**2).reshape(self.size, self.size)

    def _places(self, name: str) -> np.ndarray:
        """Return the indices, in the flattened matrix, of the entries that elements write to the matrix `name`."""
        found = self._flat.get(name)
        if found is None:
            place = self._programs.at_rest.places[name]
            self._flat[name] = found = self.size * place.rows + place.columns
        return found


class DenseRows(DenseTerms):
    """The rows of Psi and D of a mechanism with concrete numbers, by NumPy on the scene's programs. The metric is M^(-1/2)."""

    def __init__(self, mechanism: Mechanism, scales: Scales):
        super().__init__(mechanism)
        self.scales = jax.tree.map(np.asarray, scales)
        self.metric, self._tol = 1 / np.sqrt(self.mass), float(scales.rank_tol)
        self.weights = self.scales.weights

    def violation(self, t: Time, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Psi (m,) and Psi_dot (m,)."""
        return self.geometry(t, q, v)[:2]

    def residual(self, t: Time, q: np.ndarray) -> np.ndarray:
        return self.psi(t, q) / self.scales.rows

    def step_size(self, step: np.ndarray) -> float:
        """Return the largest component of a step (n,), in rad or characteristic lengths."""
        return float(self.scales.size(step, np))

    def jacobian(self, t: Time, q: np.ndarray) -> np.ndarray:
        """Return Psi_q (m, n)."""
        return self.slopes(t, q)[0]

    def plus(self, t: Time, q: np.ndarray) -> FactoredPseudoinverse | TruncatedPseudoinverse:
        """Return D^+ of D = diag(weights) Psi_q diag(metric)."""
        return dense_pseudoinverse(self.weights[:, None] * self.jacobian(t, q) * self.metric, self._tol)

    def correction(self, t: Time, q: np.ndarray) -> np.ndarray:
        return -self.metric * (self.plus(t, q) @ (self.weights * self.psi(t, q)))

    def assemble(self, t: Time, q: np.ndarray, v: np.ndarray) -> Assembly[np.ndarray]:
        """Return closed q, v projected onto the constraints, the remaining Psi and Psi_dot, and the rank of D."""
        if not self.count:
            return q, v, *self.violation(t, q, v), 0
        q = close_position(self, t, q, np)
        plus = self.plus(t, q)
        for _ in range(CLOSURE.velocities):
            v = v - self.metric * (plus @ (self.weights * self.geometry(t, q, v)[1]))
        return q, v, *self.violation(t, q, v), plus.rank


class DensePosition(NamedTuple):
    """A closed position with the singular value decomposition of D with unit rows."""

    t: Time
    q: np.ndarray
    u: np.ndarray
    sigma: np.ndarray
    vt: np.ndarray

    @property
    def rank(self) -> int:
        return int(np.sum(self.sigma > DEPENDENT_TOL * self.sigma[0]))

    @property
    def is_clear(self) -> bool:
        """True if the rank is certain: near a singular configuration, small residuals allow large errors of position."""
        return bool(np.all((self.sigma <= DEPENDENT_TOL * self.sigma[0]) | (self.sigma > CLEAR_TOL * self.sigma[0])))

    @property
    def smallest(self) -> float:
        """The smallest nonzero singular value, relative to the largest."""
        return float(self.sigma[self.rank - 1] / self.sigma[0])

    def tangent_part(self, heading: np.ndarray) -> np.ndarray:
        """Return the part of a displacement that the constraints allow."""
        free = self.vt[self.rank :]
        return free.T @ (free @ heading)

    @property
    def null_space(self) -> np.ndarray:
        """An orthonormal basis of the left null space of D, (rows, redundant)."""
        return self.u[:, self.rank :]


class KinematicRows(DenseRows, PositionRows[DensePosition]):
    """The rows of a mechanism with concrete numbers in the metric (A, A, 1) for each body, with A the longest lever arm.

    Where gears make some coordinates move much further than others, metric and rows are balanced (balance.py).
    """

    def __init__(self, mechanism: Mechanism):
        super().__init__(mechanism, concrete_scales(mechanism))
        self.metric = np.tile([float(self.scales.arm), float(self.scales.arm), 1.0], self.size // 3)
        self.balance = balance_of(mechanism)
        if self.balance is not None:
            self.metric, self.weights = self.metric * self.balance.coordinates, self.weights / self.balance.rows
        self.driver_time_step = driver_time_step(self.scales)
        self._eliminated: Eliminated | None = None

    def leave_out(self, redundant_rows: tuple[int, ...]) -> None:
        """Make `correction` leave out redundant rows and use elimination, where all other rows are clearly independent.

        The steps are the same up to rounding. Where rows are balanced, corrections stay as they are.
        """
        if self.balance is None:
            self._eliminated = self.eliminated(redundant_rows, float(self.scales.arm))

    def residual(self, t: Time, q: np.ndarray) -> np.ndarray:
        return super().residual(t, q) if self.balance is None else super().residual(t, q) / self.balance.rows

    def step_size(self, step: np.ndarray) -> float:
        return super().step_size(step if self.balance is None else step / self.balance.coordinates)

    def correction(self, t: Time, q: np.ndarray) -> np.ndarray:
        found = self._eliminated and self._eliminated.newton_step(np.asarray(t, float).item(), q)
        return super().correction(t, q) if not found else found[0] - q

    def at(self, t: Time, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        D = self.jacobian(t, q) * self.metric
        length = np.linalg.norm(D, axis=1)
        length[length <= ROUNDING * np.max(length, initial=0.0)] = 1.0  # rounding errors are not scaled up
        return self.psi(t, q), length, D / length[:, None]

    def dense(self, matrix: np.ndarray) -> np.ndarray:
        return matrix

    def split_rows(self, positions: list[DensePosition]) -> list[tuple[np.ndarray, list[DensePosition]]]:
        return [(np.arange(self.count), positions)]  # a single set of all rows

    def close(self, t: Time, q: np.ndarray, give_up: bool = False) -> DensePosition | None:
        q = try_to_close(self, t, q) if give_up else close_position(self, t, q, np)
        psi, _, D = self.at(t, q)
        at_rest = np.zeros_like(q)
        if not np.all(np.isfinite(D)) or not is_closed(self.scales, q, at_rest, psi, 0 * psi, np):
            return None
        return DensePosition(t, q, *np.linalg.svd(D))
