"""The rank of the constraints along a trajectory: singular values at the output times, and rank changes between them.

A singular value that vanishes at t* is proportional to |t - t*| nearby: its samples have a minimum with a kink, which can be
located to machine precision. Between output times the trajectory is integrated again from the previous one, and interpolated by
a quintic through q, v and a; a run with events, which could not be repeated without them, by a cubic through q and v.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int
from scipy.interpolate import BPoly

from udkjax.equations import determinacy
from udkjax.equations.rows.analysis import Analysis, analysis_of
from udkjax.equations.states.quantities import equations_of
from udkjax.integrate import simulate
from udkjax.integrate.solution import Solution
from udkjax.pinv import SVD
from udkjax.positions.assembling.assembly import State
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.following.kinematics import Kinematics
from udkjax.programs.deferred import deferred
from udkjax.requirements import ArgumentError
from udkjax.study.quantities import StudyModel
from udkjax.wording import quote

SAMPLES_PER_OUTPUT = 4  # samples per output interval, to look for minima
PARTS_OF_INTERVAL = 8  # number of parts of an interval that is integrated again
PARTS_OF_BRACKET = 16  # number of parts of a bracket; two of them are the next bracket
KINK_RATIO = 2.0  # a minimum may be zero if its value is at most this many times the rise to its neighbours
RENEWED_TOL = 1e-12  # rtol and atol of an interval that is integrated again


class TimedRankChange(NamedTuple):
    """An instant at which the rank is lower than before and after it."""

    time: float  # s
    earliest: float  # start of the bracket (s)
    latest: float  # end of the bracket (s)
    rank: int  # rank at `time`
    smallest: float  # singular value that vanishes: its value at `time`, relative to the largest


class Timeline(NamedTuple):
    """Singular values and rank of the scaled Jacobian at the output times of a trajectory, and rank changes between them."""

    ts: Float[np.ndarray, "T"]
    singular_values: Float[np.ndarray, "T k"]
    rank: Int[np.ndarray, "T"]
    changes: tuple[TimedRankChange, ...]
    closest: tuple[float, float]  # time (s) and value of the minimum of `smallest` over all samples
    unit: str = "s"  # unit of `ts`; of the values of a driver if the trajectory is a `Kinematics` over these

    @property
    def smallest(self) -> Float[np.ndarray, "T"]:
        """The smallest singular value among those that are nonzero at the generic rank, relative to the largest."""
        return self.singular_values[:, max(int(self.rank.max()) - 1, 0)] / self.singular_values[:, 0]


def timeline(mechanism: StudyModel, solution: StateHistory, rank_tol: float, tol: float | None = None) -> Timeline:
    """Follow the rank along a trajectory.

    Args:
        mechanism: the mechanism or the system.
        solution: ts (T,), q and v (T, bodies, 3); if it is a `Solution`, intervals with a rank change are integrated again.
        rank_tol: singular values up to this fraction of the largest count as zero.
        tol: half-width of the brackets around rank changes (s); by default 1e-9 of the scene's characteristic time.

    Raises:
        ArgumentError: events have released constraints of the mechanism during the run.

    Returns:
        The `Timeline` of the mechanism's own constraints. Brackets of rank changes do not account for errors of the trajectory.
    """
    changes = getattr(solution, "scene_changes", None)
    if changes is not None and np.any(changes.are_released):
        names = ", ".join(quote(name) for name in changes.names[: changes.scene_constraint_count])
        raise ArgumentError(f"solution: its events release {names}: give a run that ends before, or leave it out")
    solution = solution.in_order() if isinstance(solution, Kinematics) else solution
    analysis, unit = analysis_of(mechanism), getattr(solution, "unit", "s") or "s"
    ts, q, v = (np.asarray(x, float) for x in (solution.ts, solution.q, getattr(solution, "slopes", solution.v)))
    alive = np.isfinite(q).reshape(len(ts), -1).all(1)
    ts, q, v = ts[alive], q[alive].reshape(alive.sum(), -1), v[alive].reshape(alive.sum(), -1)
    tol = _tolerance(analysis, ts) if tol is None else tol
    path = _Path(
        mechanism, analysis, ts, q, v, getattr(solution, "events", None) is None and getattr(solution, "values_of", None) is None
    )
    fine = np.unique(np.concatenate([np.linspace(a, b, SAMPLES_PER_OUTPUT + 1) for a, b in pairwise(ts)] or [ts]))
    sampled = path.singular_values(fine)
    output_indices = np.searchsorted(fine, ts)
    rank = np.sum(sampled > rank_tol * sampled[:, :1], axis=1)
    generic_rank = int(rank.max(initial=0))
    if not generic_rank:
        return Timeline(ts, sampled[output_indices], rank[output_indices], (), (float(ts[0]), 1.0), unit)
    sigma = sampled[:, generic_rank - 1] / sampled[:, 0]
    changes = []
    for k in _kinks(sigma):
        low, high = fine[max(k - 1, 0)], fine[min(k + 1, len(fine) - 1)]
        change = _locate(_renew(mechanism, analysis, solution, ts, low, high) or path, low, high, generic_rank, rank_tol, tol)
        changes += [] if change is None else [change]
    k = int(np.argmin(sigma))
    least, when = min([(float(sigma[k]), float(fine[k])), *((c.smallest, c.time) for c in changes)])
    return Timeline(ts, sampled[output_indices], rank[output_indices], tuple(changes), (when, least), unit)


def _tolerance(analysis: Analysis | None, ts: np.ndarray) -> float:
    time = np.inf if analysis is None else float(analysis.time)
    return 1e-9 * (time if np.isfinite(time) else float(ts[-1] - ts[0]))


def _kinks(sigma: np.ndarray) -> list[int]:
    """Return indices of samples at which a singular value has a minimum that may be zero."""
    before, after = np.append(np.inf, sigma[:-1]), np.append(sigma[1:], np.inf)
    rise = np.where(np.isfinite(before), before - sigma, 0.0) + np.where(np.isfinite(after), after - sigma, 0.0)
    return np.flatnonzero((sigma < before) & (sigma <= after) & (sigma <= KINK_RATIO * rise)).tolist()


def _locate(path: "_Path", low: float, high: float, rank: int, rank_tol: float, tol: float) -> TimedRankChange | None:
    """Return the rank change between the times `low` and `high`; None if the rank does not change there.

    The time of the change is that at which the singular value number `rank`, the generic rank, is least.
    """
    start, end, at, values = low, high, low, np.zeros(0)
    while True:
        grid = np.linspace(low, high, PARTS_OF_BRACKET + 1)
        values = path.singular_values(grid)
        k = int(np.argmin(values[:, rank - 1]))
        at, values = grid[k], values[k]
        if high - low <= 2 * tol or np.max(np.diff(grid)) <= 4 * np.spacing(abs(at)):
            break
        low, high = grid[max(k - 1, 0)], grid[min(k + 1, PARTS_OF_BRACKET)]
    found = int(np.sum(values > rank_tol * values[0]))
    if found >= rank:
        return None
    return TimedRankChange(
        float(at), float(max(start, at - tol)), float(min(end, at + tol)), found, float(values[rank - 1] / values[0])
    )


def _renew(
    mechanism: StudyModel, analysis: Analysis | None, solution: StateHistory, ts: np.ndarray, low: float, high: float
) -> "_Path | None":
    """Integrate the trajectory between two times again, starting from the output time before `low`.

    Return None if the trajectory is not a run without events, since a new run would have no events; or if the new run fails.
    """
    if not isinstance(solution, Solution) or solution.events is not None:
        return None
    first = int(np.searchsorted(ts, low, side="right")) - 1
    later = np.linspace(low, high, 2 * PARTS_OF_INTERVAL + 1)
    times = np.unique(np.append(ts[first], later))
    state = State(solution.q[first], solution.v[first])
    renewed = simulate(mechanism, times, state, rtol=RENEWED_TOL, atol=RENEWED_TOL, throw=False)
    q, v = (np.asarray(x).reshape(len(times), -1) for x in (renewed.q, renewed.v))
    return _Path(mechanism, analysis, times, q, v) if np.all(np.isfinite(q)) else None


class _Path:
    """A trajectory at any time, with its singular values: quintics through q, v and a of states, or cubics through q and v."""

    def __init__(
        self, mechanism: StudyModel, analysis: Analysis | None, ts: np.ndarray, q: np.ndarray, v: np.ndarray, by_a: bool = True
    ):
        self.mechanism, self.analysis = mechanism.without_origin.traced(q.shape[1]), analysis
        a = [np.asarray(_accelerations(self.mechanism, analysis, ts, q, v))] if by_a else []
        if len(ts) > 1:
            self.q = BPoly.from_derivatives(ts, np.stack([q, v, *a], 1))
            self.v = self.q.derivative()
        else:
            self.q, self.v = (lambda times, x=x: np.tile(x, (len(times), 1)) for x in (q, v))

    def singular_values(self, times: np.ndarray) -> np.ndarray:
        """Return the singular values of the scaled Jacobian (times, k)."""
        return np.asarray(_singular_values(self.mechanism, self.analysis, times, self.q(times), self.v(times)))


@deferred
def _singular_values(mechanism: Any, analysis: Analysis | None, ts: ArrayLike, q: ArrayLike, v: ArrayLike) -> Array:
    if not mechanism.has_bodies:
        equations: Any = equations_of(mechanism, SVD())
        jacobian = jax.vmap(equations.jacobian)(jnp.asarray(ts), jnp.asarray(q), jnp.asarray(v))
        return jnp.linalg.svd(jacobian, compute_uv=False)
    return jax.vmap(lambda t, q: determinacy.singular_values(mechanism, t, q, analysis))(jnp.asarray(ts), jnp.asarray(q))


@deferred
def _accelerations(mechanism: Any, analysis: Analysis | None, ts: ArrayLike, q: ArrayLike, v: ArrayLike) -> Array:
    equations = equations_of(mechanism, SVD(), analysis=analysis)
    return jax.vmap(equations.accelerations)(jnp.asarray(ts), jnp.asarray(q), jnp.asarray(v))
