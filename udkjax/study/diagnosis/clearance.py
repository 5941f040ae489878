"""Distance from a configuration to the next one where the rank of the constraints changes.

The smallest nonzero singular value sigma of the scaled Jacobian J is the distance of J to the nearest matrix of lower rank. With
its singular vectors u and w, and its slope sigma_V = u^T (J_q V) w along the displacements V that the constraints allow, the
distance along the mechanism's motion is sigma / |sigma_V| to first order. A mechanism with one degree of freedom, or a driven
one, is also followed along its path in both directions. Where sigma vanishes, it has a kink; with its sign reversed beyond the
kink, sigma passes through zero as smoothly as the path. The configuration is therefore computed as a root of a polynomial through
closed positions on both sides, not close to the root, where closing is slow.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BarycentricInterpolator
from scipy.optimize import brentq

from udkjax.study.diagnosis.configuration import NEIGHBOUR_STEP, Configuration, RankedPositions

SLOPE_STEP = 1e-5  # step of central differences, about the cube root of rounding; relative to the characteristic length, and rad
WALK_STEPS = 160  # largest number of steps in each direction along the path: about a turn of the mechanism, or more
POINTS_PER_SIDE = 4  # positions on each side of a root that the polynomial interpolates; its error is O(step^8)


class RankChange(NamedTuple):
    """The next configuration on the path where the rank differs."""

    t: float  # s
    q: np.ndarray  # (bodies, 3)
    rank: int
    distance: float  # length of the path to it: norm of displacements in rad, and in characteristic lengths
    forward: bool  # direction along the path, or in time


class Clearance(NamedTuple):
    """The distance to the next rank change: an estimate, and the change found on the mechanism's path, if any."""

    smallest: float  # the smallest nonzero singular value, relative to the largest
    estimate: float  # distance estimated from its slope, as in `RankChange`; infinite if the slope is zero
    nearest: RankChange | None  # the change on the path; None if there is no path, or no change on it
    searched: float  # length of the path that was searched


def clearance(positions: RankedPositions, at: Configuration, rank: int, walk: bool = True) -> Clearance:
    """Return the `Clearance` of a configuration: estimates of the distance to the next one with a lower rank.

    Args:
        positions: closed positions of the mechanism.
        at: the configuration.
        rank: the generic rank. If the rank at the configuration is below, the distance is zero.
        walk: True to follow a mechanism with one degree of freedom, or a driven one, along its path.
    """
    if not rank or at.rank < rank:
        return Clearance(0.0 if rank else 1.0, 0.0 if rank else np.inf, None, 0.0)
    sigma = at.value(rank)
    slope = np.linalg.norm([_slope(positions, at, direction, rank) for direction in at.right.T]) if at.freedom else 0.0
    estimate = float(sigma / slope) if slope > SLOPE_STEP * sigma else np.inf
    driven = at.freedom == 0 and positions.rows.driver_time_step > 0.0
    nearest, searched = (None, 0.0) if not walk or not (at.freedom == 1 or driven) else _search(positions, at, rank)
    return Clearance(sigma / at.largest, estimate, nearest, searched)


def _slope(positions: RankedPositions, at: Configuration, direction: np.ndarray, rank: int) -> float:
    change = positions.change_along(at, SLOPE_STEP * direction)
    return float(at.u[:, rank - 1] @ (change @ at.vt[rank - 1])) / (2 * SLOPE_STEP)


def _search(positions: RankedPositions, start: Configuration, rank: int) -> tuple[RankChange | None, float]:
    """Return the nearest rank change on the path through `start`, and the length of the path searched in the longer direction.

    The rank change is None if none was found.
    """
    onward, around = _walk(positions, start, rank, 1.0)
    back = [] if around else _walk(positions, start, rank, -1.0)[0]
    path = [*reversed(back), start, *onward]
    distances = np.concatenate([[0.0], np.cumsum([positions.distance(a, b) for a, b in pairwise(path)])])
    distances -= distances[len(back)]
    sigma = np.array([c.value(rank) for c in path])
    roots = [
        _root(positions, path, distances, sigma, k, rank)
        for k in range(1, len(path) - 1)
        if sigma[k - 1] >= sigma[k] <= sigma[k + 1]
    ]
    nearest = min((change for change in roots if change is not None), key=lambda change: change.distance, default=None)
    return nearest, float(np.max(np.abs(distances)))


def _walk(positions: RankedPositions, start: Configuration, rank: int, side: float) -> tuple[list[Configuration], bool]:
    """Return closed positions along the path, up to just after the first minimum of sigma, and True if they return to the start.

    `side` is 1 or -1, the direction along the path.
    """
    path, more = [start], WALK_STEPS
    heading = side * start.right[:, 0] if start.freedom else np.zeros(len(start.q))
    while more:
        last, more = path[-1], more - 1
        tried = (_step(positions, last, heading, fraction * NEIGHBOUR_STEP, side) for fraction in (1.0, 0.7))
        moved = next(filter(None, tried), None)
        if moved is None or moved.rank > rank or (heading.any() and positions.distance(last, moved) < NEIGHBOUR_STEP / 4):
            break
        path.append(moved)
        if heading.any():
            heading = _onward([c.q / positions.unit for c in path[-3:]])
        if len(path) > 3 and positions.distance(start, moved, turns=False) < NEIGHBOUR_STEP:
            return path[1:], True
        if len(path) > 2 and more > POINTS_PER_SIDE and _has_kink([c.value(rank) for c in path[-3:]]):
            more = POINTS_PER_SIDE
    return path[1:], False


def _onward(places: list[np.ndarray]) -> np.ndarray:
    """Return the direction of a path at the last of two or three points; with three points, the direction of their parabola."""
    *before, last = np.diff(places, axis=0)
    onward = 2 * last - before[0] * np.linalg.norm(last) / np.linalg.norm(before[0]) if before else last
    return onward / np.linalg.norm(onward)


def _has_kink(sigma: list[float]) -> bool:
    """Return True if three successive values have a minimum that may be zero: at most as large as the rise to a neighbour."""
    return sigma[1] <= min(sigma[0], sigma[2]) and sigma[1] <= max(sigma[0], sigma[2]) - sigma[1]


def _step(positions: RankedPositions, at: Configuration, heading: np.ndarray, step: float, side: float) -> Configuration | None:
    t = at.t if heading.any() else at.t + side * positions.rows.driver_time_step * step
    return positions.displace(at, heading, step, t)


def _root(
    positions: RankedPositions, path: list, distances: np.ndarray, sigma: np.ndarray, k: int, rank: int
) -> RankChange | None:
    """Return the rank change near the k-th position of a path, if sigma vanishes there; otherwise None.

    `distances` are the lengths along the path, and `sigma` the values of the `rank`-th singular value, at its positions.
    """
    if not _has_kink(sigma[k - 1 : k + 2].tolist()):
        return None
    near = slice(max(0, k - POINTS_PER_SIDE), k + POINTS_PER_SIDE + 1)
    for turned in (k, k + 1):  # index of the first position beyond the root, from which sigma is negated
        signed = np.where(np.arange(len(sigma)) < turned, sigma, -sigma)
        smooth = BarycentricInterpolator(distances[near], signed[near])
        low, high = (distances[k - 1], distances[k]) if turned == k else (distances[k], distances[k + 1])
        root = float(np.asarray(brentq(lambda s: float(smooth(s)), low, high, xtol=1e-14)))  # noqa: B023
        q = BarycentricInterpolator(distances[near], np.array([c.q for c in path[near]]))(root)
        t = float(BarycentricInterpolator(distances[near], np.array([c.t for c in path[near]]))(root))
        position = positions.at(t, np.asarray(q))
        if position.rank < rank and np.max(np.abs(positions.rows.residual(t, position.q))) < positions.rank_tol:
            return RankChange(t, position.q.reshape(-1, 3), position.rank, abs(root), root > 0)
    return None
