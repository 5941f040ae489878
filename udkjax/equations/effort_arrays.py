"""Efforts of drivers for a prescribed motion at many times, by NumPy on the scene's programs.

The equations are those of study/inverse_dynamics.py.
"""

from collections.abc import Sequence
from typing import TypeAlias

import jax
import numpy as np
from jaxtyping import ArrayLike

from udkjax.annotations import NumericArray
from udkjax.equations.analysis import Analysis
from udkjax.equations.scale_program import RANK_TOL
from udkjax.equations.state_arrays import StateArrays, by_numpy, state_arrays
from udkjax.scene.mechanism import Mechanism

# Efforts (T, k), rates of their coordinates (T, k), unbalanced parts of the loads (T,).
EffortArrays: TypeAlias = tuple[NumericArray, NumericArray, NumericArray]


@np.errstate(all="ignore")  # states that are not finite have no efforts
def efforts_by_numpy(
    mechanism: Mechanism, analysis: Analysis, weights: ArrayLike, ts: ArrayLike, motion: Sequence[ArrayLike]
) -> EffortArrays | None:
    """Return efforts along coordinates, the rates of these, and the unbalanced part of the loads; None if numbers are traced.

    Args:
        mechanism: a mechanism whose last rows of Psi are the coordinates.
        analysis: the analysis of the mechanism without these rows.
        weights: weight of each squared effort.
        ts: times (T,).
        motion: q, v and a, each (T, bodies, 3).

    Returns:
        Efforts (T, k), rates (T, k) and unbalanced parts (T,).
    """
    if not by_numpy(mechanism, (analysis, weights, ts, motion)):
        return None
    equations, w, times = state_arrays(mechanism), np.asarray(weights, float), np.asarray(ts, float)
    states = [np.asarray(x, float).reshape(len(times), -1) for x in motion]
    columns = (_efforts_at(equations, analysis, w, *(x[p] for x in (times, *states))) for p in equations.pieces(len(times)))
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
    determined, known_rank = reached, analysis.rank
    if known_rank is not None:  # otherwise the number of degrees of freedom is unknown
        deficient = rank < known_rank
        u = v / units
        speed = np.linalg.norm(u, axis=1)
        determined = reached & (~deficient | ((analysis.degrees_of_freedom == 1) & (speed > 0)))

    def free(x: np.ndarray) -> np.ndarray:
        """Return the part of columns (T, n, k) that the joints do not hold: in deficient positions, along the motion."""
        result = x - held.transpose(0, 2, 1) @ (held @ x)
        if known_rank is not None and deficient.any():
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
