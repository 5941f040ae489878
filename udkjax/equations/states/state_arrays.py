"""Quantities of a mechanism with concrete numbers at many states, by NumPy on the scene's programs, without compilation.

A call of a program of loops takes a tenth of a millisecond, as does a singular value decomposition of a small scene; a trace of
the same quantity by JAX takes a thousand times as long, and evaluates more operations. States are taken in pieces, so that the
memory of intermediate results does not grow with their number.
"""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias, TypeGuard

import jax
import numpy as np
from jaxtyping import PyTree

from udkjax.arrays import is_traced, is_within_jit
from udkjax.equations.elimination.dense_pseudoinverse import FEW_ROWS, dense_pseudoinverse, has_independent_rows
from udkjax.equations.laws.abstract_system import HistoryLike, times_of
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.programs.eliminated_steps import LEAST_DISTANCE
from udkjax.equations.programs.scene_arrays import SceneArrays, arrays_in_time
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.terms.loads import mass_of
from udkjax.equations.terms.rest_program import LOADS
from udkjax.equations.terms.structure import rubbing_joints
from udkjax.pinv import SVD, Auto, Pseudoinverse
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism

PIECE_BYTES = 2**24  # bytes of a piece's largest arrays
DENSE_ARRAYS = 8  # of the size of Psi_q, which a state needs at once


def by_numpy(mechanism: Any, numbers: PyTree, method: Pseudoinverse | None = None) -> TypeGuard[Mechanism]:
    """Return whether `StateArrays` can compute quantities of a mechanism.

    All numbers of the mechanism and all `numbers` must be concrete, float64 must be enabled, and no `jit` be active. `method`
    must be `SVD`, or `Auto` or None, which stand for it here. No number of the mechanism may be sampled over time, and its
    friction must neither depend on the loads of joints nor be set-valued.
    """
    config = jax.config
    return (
        isinstance(mechanism, Mechanism)
        and mechanism.is_concrete
        and (method is None or (type(method) in (SVD, Auto) and method.relative and not is_traced(method)))
        and not (is_traced(numbers) or is_within_jit())
        and config.jax_enable_x64
        and not (config.jax_disable_jit or config.jax_debug_nans)
        and _is_supported(mechanism)
    )


@cached_by_identity
def _is_supported(mechanism: Mechanism) -> bool:
    rubs = any(joint is not None for joint in rubbing_joints(mechanism))
    return not (mechanism.samples or rubs or Friction.may_stick(mechanism._forces))


StateArraysOverTime: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]  # times (T,), coordinates and velocities (T, n)


def history_of(solution: HistoryLike) -> StateArraysOverTime:
    """Return the times (T,), coordinates and velocities (T, n) of a solution as NumPy arrays; see `times_of`."""
    ts = np.asarray(times_of(solution), float)
    q, v = (np.asarray(x, float).reshape(len(ts), -1) for x in (solution.q, solution.v))
    return ts, q, v


class Multipliers(NamedTuple):
    """Accelerations, multipliers and Psi_q at T states."""

    a: np.ndarray  # (T, n)
    multipliers: np.ndarray  # (T, m)
    entries: np.ndarray  # (entries of Psi_q, T)


class StateArrays:
    """Quantities of a mechanism with concrete numbers, as functions of T states: t (T,), q and v (T, n)."""

    def __init__(self, mechanism: Mechanism):
        self._at: SceneArrays[np.ndarray] = arrays_in_time(mechanism)(0.0)
        programs = self._at.programs
        self.count, self.size = programs.row_count, programs.coordinate_count
        self.entries = tuple(programs.psi_q_entries[:2])  # their rows and columns
        self._in_rows = np.argsort(self.entries[0], kind="stable")
        ends = np.append(np.flatnonzero(np.diff(self.entries[0][self._in_rows], prepend=-1)), len(self._in_rows))
        self._rows = [slice(*ends) for ends in pairwise(ends.tolist())]
        self.mass = np.asarray(mass_of(mechanism, np))
        self.root = 1 / np.sqrt(self.mass)
        self._weight = self.mass * np.tile([*np.asarray(mechanism.gravity, float), 0.0], self.size // 3)

    def pieces(self, count: int, dense: bool = True) -> Iterator[slice]:
        """Iterate over slices of `count` states that need little memory at once; `dense` if Psi_q is stored as a dense matrix."""
        numbers = DENSE_ARRAYS * max(self.count * self.size, 1) if dense else 64 * (self.size + self.count)
        step = max(1, PIECE_BYTES // (8 * numbers))
        return (slice(k, k + step) for k in range(0, max(count, 1), step))

    def _evaluate(self, quantity: Callable[..., Any], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> Any:
        """Return a quantity of `SceneArrays` at states, (..., T); a single state is passed as vectors, which is faster."""
        if len(t) == 1:
            return jax.tree.map(lambda x: x[:, None], quantity(t[0], q[0], v[0]))
        return quantity(t, q.T, v.T)

    def psi(self, t: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return Psi (T, m)."""
        return self._along(lambda t, q, v: self._at.psi(t, q), t, q, q)

    def psi_dot(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return Psi_dot (T, m)."""
        return self._along(lambda t, q, v: self._at.geometry(t, q, v)[1], t, q, v)

    def force(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return F (T, n)."""
        return self.mass * self._along(lambda t, q, v: self._at.loads(t, q, v)[0], t, q, v)

    def force_and_sizes(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return F (T, n), and the sums of the absolute loads of gravity and of each force element (T, n)."""
        force, sizes = (np.broadcast_to(x, (len(t), self.size)) for x in (self._weight, np.abs(self._weight)))
        rows = self._at.programs.at_rest.places[LOADS].rows
        if len(rows):
            loads = self._along(lambda t, q, v: self._at.element_loads(t, q, v)[LOADS], t, q, v)
            force, sizes = force.copy(), sizes.copy()
            np.add.at(force.T, rows, loads.T)
            np.add.at(sizes.T, rows, np.abs(loads).T)
        return force, sizes

    def energy(self, t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the kinetic and the potential energy (T, 2)."""
        return self._along(self._at.energy, t, q, v)

    def jacobian(self, t: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return Psi_q (T, m, n)."""
        return self.dense(self.jacobian_entries(t, q))

    def jacobian_entries(self, t: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the entries (entries, T) of Psi_q, at the rows and columns `entries`."""
        return self._evaluate(lambda t, q, v: self._at.jacobian(t, q), t, q, q)

    def largest_row(self, entries: np.ndarray) -> np.ndarray:
        """Return the largest absolute value (T,) of the sums of `entries` (entries, T) over each row of Psi_q."""
        ordered = entries[self._in_rows]
        return np.abs([ordered[row].sum(0) for row in self._rows]).max(0)

    def dense(self, entries: np.ndarray) -> np.ndarray:
        """Return matrices (T, m, n) from their entries (entries, T)."""
        matrix = np.zeros((entries.shape[1], self.count, self.size))
        matrix[:, self.entries[0], self.entries[1]] = entries.T
        return matrix

    def scaled_jacobian(self, t: np.ndarray, q: np.ndarray, analysis: Analysis) -> np.ndarray:
        """Return J = diag(1 / rows) Psi_q diag(L, L, 1, ...) (T, m, n), zero where q is not finite."""
        J = self.jacobian(t, q) * np.asarray(analysis.coordinate_units) / np.asarray(analysis.row_units)[:, None]
        return np.where(np.isfinite(J).all((1, 2), keepdims=True), J, 0.0)

    def left_null_space(self, t: np.ndarray, q: np.ndarray, analysis: Analysis, rank_tol: float) -> tuple[np.ndarray, np.ndarray]:
        """Return N (T, m, m) of the scaled Jacobian, as `determinacy.left_null_space`, and the rank (T,)."""
        J = self.scaled_jacobian(t, q, analysis)
        _, rows, columns = J.shape
        if not J[0].size:
            return np.tile(np.eye(rows), (len(t), 1, 1)), np.zeros(len(t), int)
        if all(has_independent_rows(x, rank_tol) for x in J):
            return np.zeros((len(t), rows, rows)), np.full(len(t), rows)
        u, sigma, _ = np.linalg.svd(np.pad(J, ((0, 0), (0, 0), (0, max(0, rows - columns)))), full_matrices=False)
        zero = (sigma <= rank_tol * sigma[:, :1]) & np.isfinite(q).all(1, keepdims=True)
        return np.where(zero[:, None, :], u, 0.0), rows - zero.sum(1)

    def singular_values(self, t: np.ndarray, q: np.ndarray, analysis: Analysis) -> np.ndarray:
        """Return the singular values of the scaled Jacobian (T, k), NaN where q is not finite."""
        J = self.scaled_jacobian(t, q, analysis)
        values = np.linalg.svd(J, compute_uv=False) if J[0].size else np.zeros((len(t), 0))
        return np.where(np.isfinite(q).all(1, keepdims=True), values, np.nan)

    def solve(
        self,
        t: np.ndarray,
        q: np.ndarray,
        v: np.ndarray,
        analysis: Analysis,
        method: Pseudoinverse | None = None,
        baumgarte: Baumgarte | None = None,
    ) -> Multipliers:
        """Return a = a_F + M^(-1/2) D^+ b and lambda = -w (D^+)^T D^+ b of one piece of states, NaN where these are NaN."""
        by_default = baumgarte is None and (method is None or method.rank_tol is None)
        are_independent = self.count > 0 and analysis.redundant_rows == ()
        found = self._at.accelerations(t, q.T, v.T) if by_default and are_independent else None
        if found is not None and found.distance.min() > LEAST_DISTANCE:
            return Multipliers(found.a.T, found.multipliers.T, found.entries)
        psi, rate, entries = self._evaluate(self._at.geometry, t, q, v)
        free, b = self._evaluate(self._at.loads, t, q, v)
        if baumgarte is not None:
            b = b - 2 * float(baumgarte.alpha) * rate - float(baumgarte.beta) ** 2 * psi
        if not self.count:
            return Multipliers(free.T, np.zeros((len(t), 0)), entries)
        w = np.asarray(analysis.scales.weights, float)
        tol = float(analysis.scales.rank_tol if method is None or method.rank_tol is None else method.rank_tol)
        D = w[:, None] * self.dense(entries) * self.root
        reached = np.isfinite(D).all((1, 2)) & np.isfinite(b).all(0)
        x, z = _least_norm(np.where(reached[:, None, None], D, 0.0), b.T * w, tol)
        a, multipliers, lost = free.T + self.root * x, -w * z, ~reached[:, None]
        return Multipliers(np.where(lost, np.nan, a), np.where(lost, np.nan, multipliers), entries)

    def _along(self, quantity: Callable[..., np.ndarray], t: np.ndarray, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.concatenate([self._evaluate(quantity, t[p], q[p], v[p]).T for p in self.pieces(len(t), dense=False)])


def _least_norm(D: np.ndarray, b: np.ndarray, tol: float) -> tuple[np.ndarray, np.ndarray]:
    """Return x = D^+ b (T, n) and (D^+)^T x (T, m) of matrices (T, m, n)."""
    if min(D.shape[1:]) > FEW_ROWS:  # one by one, since each takes memory
        x, z = np.empty((len(D), D.shape[2])), np.empty(b.shape)
        for k, A in enumerate(D):
            plus = dense_pseudoinverse(A, tol)
            x[k] = plus @ b[k]
            z[k] = plus.transposed_times(x[k])
        return x, z
    u, sigma, vt = np.linalg.svd(D, full_matrices=False)
    counts = sigma > tol * sigma[:, :1]
    inverse = np.where(counts, 1 / np.where(counts, sigma, 1.0), 0.0)
    y = inverse * np.einsum("tmk,tm->tk", u, b)
    return np.einsum("tkn,tk->tn", vt, y), np.einsum("tmk,tk->tm", u, inverse * y)


@cached_by_identity
def state_arrays(mechanism: Mechanism) -> StateArrays:
    """Return the `StateArrays` of a mechanism, made once for each mechanism.

    Args:
        mechanism: The scene; its numbers are concrete.

    Returns:
        Functions of states (T, n).
    """
    return StateArrays(mechanism)
