"""Efforts of drivers for a prescribed motion, as inverse_dynamics.py derives them: by JAX, or by NumPy for concrete numbers."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumericArray
from udkjax.equations import constraints, loads
from udkjax.equations.analysis import Analysis
from udkjax.equations.scale_program import RANK_TOL
from udkjax.equations.state_arrays import StateArrays, by_numpy, state_arrays
from udkjax.pinv import SVD
from udkjax.positions.coordinates import Coordinate, choose_name, constant_motion, named_element, value_of
from udkjax.positions.drive import with_drivers
from udkjax.programs.deferred import deferred
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.load_scale import load_sizes

States: TypeAlias = Float[Array, "T bodies 3"]
# Efforts (T, k), rates of their coordinates (T, k), unbalanced parts of the loads (T,).
EffortArrays: TypeAlias = tuple[NumericArray, NumericArray, NumericArray]


def driver_efforts(
    mechanism: Mechanism,
    joints: Mechanism,
    analysis: Analysis,
    drivers: Sequence[str | Coordinate],
    values: Sequence[Coordinate],
    weights: Float[Array, "k"],
    ts: Float[Array, "T"],
    motion: tuple[States, States, States],
) -> EffortArrays:
    """Return the efforts of drivers of least weighted norm, the rates of their coordinates, and the unbalanced part of the loads.

    Args:
        mechanism: the mechanism, to whose drivers and elements names refer.
        joints: the mechanism without its drivers.
        analysis: the analysis of `joints`.
        drivers: the drivers and coordinates that exert efforts, as given.
        values: their coordinates.
        weights: weight of each squared effort.
        ts: times (s).
        motion: q, v and a.

    Returns:
        Efforts (N m, N), rates (rad/s, m/s), and the part of M a - F that nothing exerts, relative to M a and the loads.
    """
    if by_numpy(joints, (analysis, values, weights, ts, motion)):
        equations = _with_rows(mechanism, *drivers)
        states = (np.asarray(x, float).reshape(len(ts), -1) for x in motion)
        return _by_numpy(equations, analysis, np.asarray(weights, float), np.asarray(ts, float), *states)
    return _by_jax(joints.without_origin, analysis, values, jnp.asarray(weights), ts, *map(jnp.asarray, motion))


@deferred
def _by_jax(
    mechanism: Mechanism, analysis: Analysis, values: Sequence[Coordinate], w: Array, ts: Array, q: States, v: States, a: States
) -> EffortArrays:
    scales = analysis.scales
    units, share = scales.coordinates(analysis.coordinates), 1 / jnp.sqrt(w)
    coordinates = [value_of(mechanism, element) for element in values]

    def at(t: Array, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        q, v, a = q.ravel(), v.ravel(), a.ravel()
        C = jax.jacfwd(lambda q: jnp.stack([c(q.reshape(-1, 3)) for c in coordinates]))(q)
        J = scales.weights[:, None] * constraints.psi_q(mechanism, t, q) * units
        free, determined = _free_part(J), jnp.asarray(True)
        missing = units * (loads.mass(mechanism) * a - loads.force(mechanism, t, q, v))
        if analysis.rank is not None:  # otherwise the number of degrees of freedom is unknown
            deficient = SVD(RANK_TOL).plus(J).rank < analysis.rank if len(J) else jnp.asarray(False)
            u = v / units
            speed = jnp.linalg.norm(jnp.where(deficient, u, 1.0))
            u = u / jnp.where(speed > 0, speed, 1.0)
            everywhere, determined = free, ~deficient | ((analysis.degrees_of_freedom == 1) & (speed > 0))
            free = lambda x: jnp.where(deficient, jnp.tensordot(u, u @ x, 0), everywhere(x))  # noqa: E731
        required, A = free(missing), free((C * units).T * share)
        f = share * (SVD(RANK_TOL).plus(A) @ required)
        # Relative to the single terms, since their sum may be a rounding error.
        parts = units * (loads.mass(mechanism) * jnp.abs(a) + load_sizes(mechanism, t, q, v))
        size = jnp.maximum(jnp.max(parts), scales.mass * (scales.length * scales.rate) ** 2)
        residual = jnp.max(jnp.abs(required - free((C * units).T @ f))) / jnp.where(size > 0, size, 1.0)
        return jnp.where(determined, f, jnp.nan), C @ v, residual

    return jax.vmap(at)(ts, q, v, a)


def _free_part(J: Float[Array, "m n"]) -> Callable[[Array], Array]:
    """Return x -> (I - J^+ J) x for vectors (n,) or columns (n, k): the projection onto J's null space; differentiable."""
    if not len(J):
        return lambda x: x
    plus = SVD(RANK_TOL).plus(J)
    return lambda x: x - plus @ (J @ x)


# --- the same by NumPy, at all times at once


@cached_by_identity
def _with_rows(mechanism: Mechanism, *drivers: str | Coordinate) -> StateArrays:
    """Return the equations of a mechanism whose last rows of Psi are the coordinates of these drivers, in this order."""
    names, rows = dict[str, None](), {}
    for driver in drivers:
        name, element = named_element(mechanism, driver)
        name = choose_name(name, names)
        names[name] = None
        rows[name] = element.driver(constant_motion(0.0))
    with jax.ensure_compile_time_eval():
        return state_arrays(with_drivers(mechanism.without_origin, rows).without_origin)


@np.errstate(all="ignore")  # states that are not finite have no efforts
def _by_numpy(
    equations: StateArrays, analysis: Analysis, w: np.ndarray, ts: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> EffortArrays:
    columns = (_efforts_at(equations, analysis, w, *(x[p] for x in (ts, q, v, a))) for p in equations.pieces(len(ts)))
    efforts, rates, unbalanced = (np.concatenate(x) for x in zip(*columns, strict=True))
    return efforts, rates, unbalanced


def _efforts_at(equations: StateArrays, analysis: Analysis, w: np.ndarray, t: np.ndarray, *motion: np.ndarray) -> EffortArrays:
    q, v, a = motion
    scales, joints = jax.tree.map(np.asarray, analysis.scales), len(analysis.row_names)
    units, share = np.asarray(scales.coordinates(equations.size)), 1 / np.sqrt(w)
    rows = equations.jacobian(t, q)
    C, J = rows[:, joints:], scales.weights[:, None] * rows[:, :joints] * units
    missing = units * (equations.mass * a - equations.force(t, q, v))
    reached = np.isfinite(rows).all((1, 2)) & np.isfinite(missing).all(1)
    C, J, missing = (np.where(reached.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0) for x in (C, J, missing))
    held, rank = _row_space(J)
    determined = reached
    if analysis.rank is not None:  # otherwise the number of degrees of freedom is unknown
        deficient = rank < analysis.rank
        u = v / units
        speed = np.linalg.norm(u, axis=1)
        determined = reached & (~deficient | ((analysis.degrees_of_freedom == 1) & (speed > 0)))

    def free(x: np.ndarray) -> np.ndarray:
        """Return the part of columns (T, n, k) that the joints do not hold: in deficient positions, along the motion."""
        result = x - held.transpose(0, 2, 1) @ (held @ x)
        if analysis.rank is not None and deficient.any():
            along = np.where(speed > 0, u.T / speed, 0.0).T[deficient, :, None]
            result[deficient] = along @ (along.transpose(0, 2, 1) @ x[deficient])
        return result

    pull = (C * units).transpose(0, 2, 1)
    required = free(missing[:, :, None])
    A = free(pull * share)
    V, U, inverse = _decompose(A)
    f = share[:, None] * (V.transpose(0, 2, 1) @ (inverse[:, :, None] * (U.transpose(0, 2, 1) @ required)))
    # Relative to the single terms, since their sum may be a rounding error.
    parts = units * (equations.mass * np.abs(a) + equations.load_sizes(t, q, v))
    size = np.maximum(parts.max(1), scales.mass * (scales.length * scales.rate) ** 2)
    residual = np.abs(required - free(pull @ f)).max((1, 2)) / np.where(size > 0, size, 1.0)
    rates = np.einsum("tkn,tn->tk", C, v)
    efforts = np.where(determined[:, None], f[:, :, 0], np.nan)
    return efforts, np.where(reached[:, None], rates, np.nan), np.where(reached, residual, np.nan)


def _row_space(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal rows (T, k, n) that span those of matrices (T, m, n), zero beyond the rank, and the rank (T,)."""
    if not J.shape[1]:
        return np.zeros((len(J), 0, J.shape[2])), np.zeros(len(J), int)
    vt, _, inverse = _decompose(J)
    return np.where(inverse[:, :, None] > 0, vt, 0.0), np.count_nonzero(inverse, axis=1)


def _decompose(A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V^T, U and 1/sigma of matrices (T, m, n), zero where sigma is zero up to rounding."""
    u, sigma, vt = np.linalg.svd(A, full_matrices=False)
    counts = sigma > RANK_TOL * sigma[:, :1]
    return vt, u, np.where(counts, 1 / np.where(counts, sigma, 1.0), 0.0)
