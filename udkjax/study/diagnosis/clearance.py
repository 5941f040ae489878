"""How far a configuration is from the next one where the rank of the constraints changes.

The smallest singular value that counts, sigma, is the distance of J to the nearest matrix of lower rank. Within the mechanism's own
motion its slope along the displacements V that the constraints allow says how far that is, to first order: sigma / |sigma_V|,
where sigma_V = u^T (J_q V) w. A mechanism of one degree of freedom, or one that is driven, is led along its path as well, both
ways, and the rank change is located as the minimum of sigma, which has a kink there.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from udkjax.study.diagnosis.configuration import STEP, Configuration, Positions

SLOPE_STEP = 1e-5  # of the characteristic length, and rad: the third root of rounding, for central differences
WALK = 160  # steps along the path in each direction: more than two turns
GOLDEN = (np.sqrt(5) - 1) / 2
SHRINKS = 60  # of a bracket by the golden section: to rounding


class RankChange(NamedTuple):
    """The next configuration on the path where the rank is another one."""

    t: float  # s
    q: np.ndarray  # (bodies, 3)
    rank: int
    distance: float  # along the path: the norm of the displacement, lengths over L and angles in rad
    forward: bool  # in which direction of the path, or of time


class Clearance(NamedTuple):
    """How far the next rank change is."""

    smallest: float  # the smallest singular value that counts, relative to the largest
    estimate: float  # the distance by its slope, as in `RankChange`; infinite where it does not change
    nearest: RankChange | None  # what was found on the path, which only a single degree of freedom has
    searched: float  # how far along the path


def clearance(positions: Positions, at: Configuration, rank: int, walk: bool = True) -> Clearance:
    """Look for the next configuration where the rank is below `rank`, which it has in general."""
    if not rank or at.rank < rank:
        return Clearance(0.0 if rank else 1.0, 0.0 if rank else np.inf, None, 0.0)
    sigma = at.sigma[rank - 1]
    slope = np.linalg.norm([_slope(positions, at, direction, rank) for direction in at.right.T]) if at.right.size else 0.0
    estimate = float(sigma / slope) if slope > SLOPE_STEP * sigma else np.inf
    found, searched = [], 0.0
    driven = at.right.shape[1] == 0 and positions.rows.tick > 0.0
    if walk and (at.right.shape[1] == 1 or driven):
        for side in (1.0, -1.0):
            change, way = _along(positions, at, rank, side)
            found += [change] if change is not None else []
            searched = max(searched, way)
    nearest = min(found, key=lambda change: change.distance, default=None)
    return Clearance(float(sigma / at.sigma[0]), estimate, nearest, searched)


def _slope(positions: Positions, at: Configuration, direction: np.ndarray, rank: int) -> float:
    step = SLOPE_STEP * positions.unit * direction
    change = positions.at(at.t, at.q + step).J - positions.at(at.t, at.q - step).J
    return float(at.u[:, rank - 1] @ change @ at.vt[rank - 1]) / (2 * SLOPE_STEP)


def _along(positions: Positions, start: Configuration, rank: int, side: float) -> tuple[RankChange | None, float]:
    """Walk along the path until sigma has a minimum of zero; also, how far it went."""
    path, way = [start], [0.0]
    heading = side * start.right[:, 0] if start.right.shape[1] else np.zeros(len(start.q))
    for _ in range(WALK):
        last = path[-1]
        moved = _step(positions, last, heading, STEP, side)
        gone = 0.0 if moved is None else positions.distance(last, moved)
        if moved is None or (gone < STEP / 4 and heading.any()) or moved.rank > rank:
            break
        path.append(moved)
        way.append(way[-1] + gone)
        if len(path) > 2 and _sigma(path[-2], rank) <= min(_sigma(path[-3], rank), _sigma(path[-1], rank)):
            lowest, shift = _lowest(lambda s: _step(positions, path[-2], heading, s, side), rank)  # noqa: B023
            if lowest is not None and lowest.rank < rank:
                distance = way[-2] + np.copysign(positions.distance(path[-2], lowest), shift)
                return RankChange(lowest.t, lowest.q.reshape(-1, 3), lowest.rank, float(distance), side > 0), way[-1]
        if moved.right.shape[1]:
            onward = moved.right @ (moved.right.T @ heading)
            heading = onward / np.linalg.norm(onward)
        if len(path) > 3 and positions.distance(start, moved) < STEP / 2:  # all around
            break
    return None, way[-1]


def _step(positions: Positions, at: Configuration, heading: np.ndarray, step: float, side: float) -> Configuration | None:
    t = at.t if heading.any() else at.t + side * positions.rows.tick * step
    return positions.displaced(at, heading, step, t)


def _sigma(at: Configuration, rank: int) -> float:
    return float(at.sigma[rank - 1])


def _lowest(path: Callable[[float], Configuration | None], rank: int) -> tuple[Configuration | None, float]:
    """The configuration of the smallest sigma between steps of -STEP and STEP, by the golden section."""
    low, high = -STEP, STEP
    best: tuple[float, Configuration | None, float] = np.inf, None, 0.0

    def value(s: float) -> float:
        nonlocal best
        found = path(s)
        size = np.inf if found is None else _sigma(found, rank)
        if size < best[0]:
            best = size, found, s
        return size

    one, two = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_one, at_two = value(one), value(two)
    for _ in range(SHRINKS):
        if at_one < at_two:
            high, two, at_two = two, one, at_one
            one = high - GOLDEN * (high - low)
            at_one = value(one)
        else:
            low, one, at_one = one, two, at_two
            two = low + GOLDEN * (high - low)
            at_two = value(two)
    return best[1], best[2]
