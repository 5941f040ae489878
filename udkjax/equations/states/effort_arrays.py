"""Efforts of drivers for a prescribed motion at many times, by NumPy on the scene's programs.

The equations are those of study/inverse_dynamics.py.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import ArrayLike

from udkjax.annotations import NumericArray
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.states.state_arrays import StateArrays, by_numpy, state_arrays
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

# Efforts (k, T), rates of their coordinates (k, T), unbalanced parts of the loads (T,).
EffortArrays: TypeAlias = tuple[NumericArray, NumericArray, NumericArray]
Slopes: TypeAlias = Callable[[np.ndarray], np.ndarray]
# Largest |J u| of a motion u that satisfies J u = 0 up to rounding, relative to J.
NULL_MOTION_TOL = 64 * float(np.finfo(float).eps)
# Rank tolerance over the rank tolerance at which rows would count as dependent, for which a bound is known.
REGULARITY_MARGIN = 0.1


@np.errstate(all="ignore")  # states that are not finite have no efforts
def efforts_by_numpy(
    mechanism: Mechanism, slopes: Slopes, analysis: Analysis, weights: ArrayLike, ts: ArrayLike, motion: Sequence[ArrayLike]
) -> EffortArrays | None:
    """Find the efforts along some coordinates that a prescribed motion requires, by NumPy.

    Args:
        mechanism: the mechanism without its drivers.
        slopes: the derivatives C (k, n, T) of the coordinates by q, as a function of q (n, T).
        analysis: the analysis of the mechanism.
        weights: weight of each squared effort.
        ts: times (T,).
        motion: q, v and a, each (T, bodies, 3).

    Returns:
        Efforts (k, T), rates (k, T) of their coordinates, and the parts (T,) of the loads that no efforts balance, relative to
        the largest load; None if numbers are traced.
    """
    if not by_numpy(mechanism, (analysis.scales, weights, ts, motion)):
        return None
    equations, w, times = state_arrays(mechanism), np.asarray(weights, float), np.asarray(ts, float)
    # NumPy sums along the first axis in a fraction of the time that it takes along a short last one.
    states = [np.ascontiguousarray(np.asarray(x, float).reshape(len(times), -1).T) for x in motion]
    pieces = equations.pieces(len(times))
    columns = [_efforts_at(equations, slopes, analysis, w, *[x[..., p] for x in (times, *states)]) for p in pieces]
    efforts, rates, unbalanced = columns[0] if len(columns) == 1 else (np.concatenate(x, -1) for x in zip(*columns, strict=True))
    return efforts, rates, unbalanced


_Found: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]


class _Units(NamedTuple):
    """Weights of rows, units of coordinates and loads, and independent and redundant rows, as NumPy arrays."""

    weights: np.ndarray  # (m,)
    coordinates: np.ndarray  # (n, 1)
    inertial_load: float  # of the characteristic motion (N m)
    independent: np.ndarray | None  # indices of the rows of joints that are not redundant; None if unknown
    redundant: np.ndarray


@cached_by_identity
def _units_of(analysis: Analysis) -> _Units:
    scales = jax.tree.map(np.asarray, analysis.scales)
    load = float(scales.mass * (scales.length * scales.rate) ** 2)
    independent = None if analysis.redundant_rows is None else np.array(analysis.independent_rows, int)
    redundant = np.array(analysis.redundant_rows or (), int)
    weights = scales.length / np.asarray(analysis.row_units)
    return _Units(weights, np.asarray(analysis.coordinate_units)[:, None], load, independent, redundant)


def _efforts_at(
    equations: StateArrays, slopes: Slopes, analysis: Analysis, w: np.ndarray, t: np.ndarray, *motion: np.ndarray
) -> EffortArrays:
    q, v, a = motion
    scale, share, mass = _units_of(analysis), 1 / np.sqrt(w), equations.mass[:, None]
    units, (rows, columns) = scale.coordinates, equations.entries
    entries = equations.jacobian_entries(t, q.T)
    entries *= (scale.weights[rows] * units[columns, 0])[:, None]
    C, (force, sizes) = slopes(q), (x.T for x in equations.force_and_sizes(t, q.T, v.T))
    inertia, pull = mass * units * a, C * (share[:, None, None] * units)
    missing = inertia - units * force
    largest = np.abs(entries).max(0, initial=0.0)
    reached = np.isfinite(largest) & np.isfinite(missing).all(0) & np.isfinite(pull).all((0, 1))
    # Relative to the single terms, since their sum may be a rounding error.
    size = np.maximum((np.abs(inertia) + units * sizes).max(0), scale.inertial_load)
    rates = (C * v).sum(1)
    if not reached.all():
        pull, missing, entries, largest = (np.where(reached, x, 0.0) for x in (pull, missing, entries, largest))
        rates, size = (np.where(reached, x, np.nan) for x in (rates, size))
    f, unbalanced, found = _efforts_along(analysis, equations, entries, largest, pull, missing, v / units)
    if not found.all():
        k = ~found
        given = (np.moveaxis(x[..., k], -1, 0) for x in (pull, missing, v / units))
        fk, unbalanced[k] = _efforts_of_rows(scale, analysis, equations.dense(entries[:, k]), *given)
        f[:, k] = fk.T
        f[:, ~reached] = np.nan
    return share[:, None] * f, rates, unbalanced / np.where(size == 0, 1.0, size)


def _efforts_along(
    analysis: Analysis,
    equations: StateArrays,
    entries: np.ndarray,
    largest: np.ndarray,
    pull: np.ndarray,
    missing: np.ndarray,
    u: np.ndarray,
) -> _Found:
    """Return efforts (k, T), unbalanced loads (T,), and a mask of the times for which the motion determines both.

    With one degree of freedom the direction u of the motion spans the null space of J, if it satisfies J u = 0: the drivers have
    the power that the loads lack. The drivers must be able to move the mechanism. `entries` (entries, T) are those of J, and
    `largest` (T,) are the largest of these in magnitude.
    """
    k, _, T = pull.shape
    speed = np.sqrt((u * u).sum(0))
    if analysis.degrees_of_freedom != 1 or not speed.any():
        return np.zeros((k, T)), np.zeros(T), np.zeros(T, bool)
    u = u / np.where(speed > 0, speed, 1.0)
    rates, power = (pull * u).sum(1), (missing * u).sum(0)
    square = (rates * rates).sum(0)
    found = (speed > 0) & (square > RANK_TOL**2 * (pull * pull).sum((0, 1)))
    if len(entries):
        found &= equations.largest_row(u[equations.entries[1]] * entries) <= NULL_MOTION_TOL * largest
    f = rates * (power / np.where(square > 0, square, 1.0))
    return f, np.abs(u).max(0) * np.abs(power - (rates * f).sum(0)), found


def _efforts_of_rows(
    scale: _Units, analysis: Analysis, J: np.ndarray, pull: np.ndarray, missing: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return efforts (T, k), NaN where they are undetermined, and unbalanced loads (T,), from the rows J (T, m, n) of joints."""
    f, unbalanced, regular = _regular_efforts(scale, J, pull, missing)
    if not regular.all():
        k = ~regular
        found, unbalanced[k], determined = _any_efforts(analysis, J[k], pull[k], missing[k], u[k])
        f[k] = np.where(determined[:, None], found, np.nan)
    return f, unbalanced


def _regular_efforts(scale: _Units, J: np.ndarray, pull: np.ndarray, missing: np.ndarray) -> _Found:
    """Return efforts (T, k), unbalanced loads (T,), and a mask of the times for which both are right.

    Where the independent rows of joints and the drivers' rows are as many as the coordinates, and clearly independent,
    A^T (mu, f) = M a - F has one solution. The rank of J is then that of the independent rows: with A (P N) = 1, the columns of N
    span their null space, on which the redundant rows vanish.
    """
    T, k = pull.shape[:2]
    if scale.independent is None or len(scale.independent) + k != J.shape[2]:
        return np.zeros((T, k)), np.zeros(T), np.zeros(T, bool)
    A = np.concatenate([J[:, scale.independent], pull], axis=1)
    joints, drivers = _length(J), _length(pull)
    factor = np.where(joints * drivers > 0, joints, 1.0) / np.where(joints * drivers > 0, drivers, 1.0)  # makes both comparable
    A[:, len(scale.independent) :] *= factor[:, None, None]
    try:
        inverse = np.linalg.inv(A)
    except np.linalg.LinAlgError:  # at some time
        inverse = np.linalg.inv(np.where((np.linalg.slogdet(A)[0] == 0)[:, None, None], np.eye(A.shape[1]), A))
    regular = (_length(A) * _length(inverse) * RANK_TOL < REGULARITY_MARGIN) & (drivers > 0)
    if len(scale.redundant):
        null_space = inverse[:, :, len(scale.independent) :]
        off = _length(J[:, scale.redundant] @ null_space) * _length(A)
        regular &= off < REGULARITY_MARGIN * RANK_TOL * joints
    z = (missing[:, None] @ inverse)[:, 0]
    unbalanced = np.abs(missing - (z[:, None] @ A)[:, 0]).max(1)
    return factor[:, None] * z[:, len(scale.independent) :], unbalanced, regular


def _length(A: np.ndarray) -> np.ndarray:
    """Return the Frobenius norms of matrices (T, m, n)."""
    entries = A.reshape(len(A), 1, A.shape[1] * A.shape[2])
    return np.sqrt((entries @ entries.transpose(0, 2, 1))[:, 0, 0])


def _any_efforts(analysis: Analysis, J: np.ndarray, pull: np.ndarray, missing: np.ndarray, u: np.ndarray) -> _Found:
    """Return efforts (T, k), unbalanced loads (T,), and a mask of determined efforts, for any number of rows and any rank."""
    held, rank = _row_space(J)
    determined, known_rank = np.ones(len(J), bool), analysis.rank
    if known_rank is not None:  # otherwise the number of degrees of freedom is unknown
        deficient = rank < known_rank
        speed = np.linalg.norm(u, axis=1)
        determined = ~deficient | ((analysis.degrees_of_freedom == 1) & (speed > 0))

    def free(x: np.ndarray) -> np.ndarray:
        """Return the part of columns (T, n, k) that joints do not hold; if the rank is deficient, the part along the motion."""
        result = x - held.transpose(0, 2, 1) @ (held @ x)
        if known_rank is not None and deficient.any():
            along = np.where(speed > 0, u.T / speed, 0.0).T[deficient, :, None]
            result[deficient] = along @ (along.transpose(0, 2, 1) @ x[deficient])
        return result

    columns = pull.transpose(0, 2, 1)
    required = free(missing[:, :, None])
    V, U, inverse = _decompose(free(columns))
    f = V.transpose(0, 2, 1) @ (inverse[:, :, None] * (U.transpose(0, 2, 1) @ required))
    return f[:, :, 0], np.abs(required - free(columns @ f)).max((1, 2)), determined


def _row_space(J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal bases (T, k, n) of the row spaces of matrices (T, m, n), zero beyond the rank, and the ranks (T,)."""
    if not J.shape[1]:
        return np.zeros((len(J), 0, J.shape[2])), np.zeros(len(J), int)
    vt, _, inverse = _decompose(J)
    return np.where(inverse[:, :, None] > 0, vt, 0.0), np.count_nonzero(inverse, axis=1)


def _decompose(A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return V^T, U and 1 / sigma of matrices (T, m, n); 1 / sigma is zero where sigma is negligible (`RANK_TOL`)."""
    u, sigma, vt = np.linalg.svd(A, full_matrices=False)
    counts = sigma > RANK_TOL * sigma[:, :1]
    return vt, u, np.where(counts, 1 / np.where(counts, sigma, 1.0), 0.0)
