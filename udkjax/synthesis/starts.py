"""Starts of searches: random mechanisms, turned once, moved and scaled to the targets, with values of the driver for these.

The curve of the moved, rotated and scaled mechanism follows from the curve of one turn: a place p becomes a p + b, in complex
numbers. The best a and b for an assignment of values to targets solve a linear least-squares problem; the best assignment in
order, for given a and b, is computed by dynamic programming.
"""

from typing import NamedTuple

import numpy as np

from udkjax.synthesis.design_problem import TURN_VALUES, DesignProblem
from udkjax.synthesis.trials import Trials, Turn

FIRST_VALUES = 12  # number of first values tried, evenly over a turn
TURN_SPANS = (1.0, 0.6, 0.3)  # fractions of a turn from the first value to the last, tried for open curves
LEAST_SCALE = 0.03  # smallest factor of scaling, since a curve that fits best as a point does not fit at all
ASSIGNING_ROUNDS = 2  # number of times that curves are moved to the targets and values assigned
LEAST_TRANSMISSION = 0.02  # smallest transmission over the turn; mechanisms closer to a meeting of branches soon reach it


class _Fitted(NamedTuple):
    """Values assigned to targets, by their indices in a turn (M, J), which may exceed it, and remaining sums of squares (M,)."""

    places: np.ndarray
    cost: np.ndarray


def find_starts(problem: DesignProblem, count: int, samples: int, rng: np.random.Generator, threads: int | None = None) -> Trials:
    """Return the `count` best of `samples` random mechanisms as trials; fewer if fewer have all positions."""
    x = np.zeros((samples, problem.unknown_count))
    x[:, : problem.free.count] = rng.uniform(problem.first, problem.last, (samples, problem.free.count))
    turn = problem.turn(x, TURN_VALUES, threads)
    reached = turn.reached.all(1) & (np.abs(turn.transmission).min(1) > LEAST_TRANSMISSION)
    in_order = problem.local or problem.goal.is_combined
    if problem.rotation or in_order:
        x, turn = x[reached], Turn(*(a[reached] for a in turn))
    if not len(x):
        return Trials(x, np.zeros((0, len(problem.data))), np.zeros((0, len(problem.data), problem.coordinate_count)))
    (s, moved), cost = _assign(problem, x, turn) if in_order else _shift(problem, x, turn)
    if problem.goal.is_combined:
        s, moved = _spread(problem, s, moved)
    cost = cost + np.sum(np.maximum(problem.lengths(moved)[0], 0.0) ** 2, axis=1)  # scaling may violate limits of lengths
    q, exists = problem.march(moved, s, threads)
    best = np.argsort(np.where(exists & np.isfinite(cost), cost, np.inf), kind="stable")[:count]
    best = best[exists[best]]
    return Trials(moved[best], s[best], q[best])


# --- unknown values


def _assign(problem: DesignProblem, x: np.ndarray, turn: Turn) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    target = problem.data[:, 0] + 1j * problem.data[:, 1]
    curve = turn.measures[:, :-1, 0] + 1j * turn.measures[:, :-1, 1]
    moves = problem.can_move
    fitted = _best_phase(curve, target, moves, problem.is_closed)
    for _ in range(ASSIGNING_ROUNDS):
        a, b, _ = _move(np.take_along_axis(curve, fitted.places % TURN_VALUES, 1), target, moves)
        fitted = _in_order(a[:, None] * curve + b[:, None], target, fitted.places)
    a, b, cost = _move(np.take_along_axis(curve, fitted.places % TURN_VALUES, 1), target, moves)
    s = turn.s[:, :1] + fitted.places * (problem.period / TURN_VALUES)
    return (s + problem.turned_by(a)[:, None], problem.moved(x, a, b)), cost


def _best_phase(curve: np.ndarray, target: np.ndarray, moves: str, closed: bool) -> _Fitted:
    """Return the best assignment of evenly spaced values to the targets, of several first values, spans and both directions."""
    J, K = len(target), curve.shape[1]
    spans = (1.0,) if closed else TURN_SPANS
    best = _Fitted(np.zeros((len(curve), J), int), np.full(len(curve), np.inf))
    for span in spans:
        for direction in (1, -1):
            even = direction * np.round(span * K * np.arange(J) / max(J - 1, 1)).astype(int)
            for phase in range(0, K, K // FIRST_VALUES):
                places = np.broadcast_to(phase + even, (len(curve), J))
                cost = _move(curve[:, (phase + even) % K], target, moves)[2]
                better = cost < best.cost
                best = _Fitted(np.where(better[:, None], places, best.places), np.where(better, cost, best.cost))
    return best


def _move(z: np.ndarray, target: np.ndarray, moves: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a and b (M,) for which curves a z + b fit the target best, with the allowed `moves`, and remaining sums of squares.

    `moves` is that of `DesignProblem.can_move`.
    """
    ones = np.ones(len(z), complex)
    if moves == "nothing":
        return ones, 0 * ones, np.sum(np.abs(z - target) ** 2, 1)
    middle, centre = z.mean(1), target.mean()
    dz, dt = z - middle[:, None], target - centre
    size = np.maximum(np.sum(np.abs(dz) ** 2, 1), 1e-300)
    a = np.sum(np.conj(dz) * dt, 1) / size
    a = np.where(np.abs(a) ** 2 * size > LEAST_SCALE**2 * np.sum(np.abs(dt) ** 2), a, 1.0)  # do not shrink the curve to a point
    if moves == "no turn":
        a = np.maximum(np.real(a), 1e-3) + 0j
    return a, centre - a * middle, np.sum(np.abs(a[:, None] * dz - dt) ** 2, 1)


def _in_order(curve: np.ndarray, target: np.ndarray, previous: np.ndarray) -> _Fitted:
    """Return the best assignment of values in order to targets, in the direction of `previous` and from about its first value."""
    M, K = curve.shape
    J, rows = len(target), np.arange(M)
    direction = np.where(previous[:, -1] >= previous[:, 0], 1, -1)
    indices = (previous[:, :1] + direction[:, None] * np.arange(-(K // 8), K + K // 8 + 1)) % K
    cost = np.abs(np.take_along_axis(curve, indices, 1)[..., None] - target) ** 2  # (M, L, J)
    L = cost.shape[1]
    total, back = cost[..., 0].copy(), np.zeros((M, J, L), int)
    total[:, K // 4 + 1 :] = np.inf  # the first value changes by a quarter turn at most
    for j in range(1, J):
        cheapest = np.minimum.accumulate(total, 1)
        where = np.maximum.accumulate(np.where(total == cheapest, np.arange(L), 0), 1)
        total = np.full((M, L), np.inf)
        total[:, 1:] = cheapest[:, :-1] + cost[:, 1:, j]
        back[:, j, 1:] = where[:, :-1]
    places = np.zeros((M, J), int)
    places[:, -1] = total.argmin(1)
    for j in range(J - 1, 0, -1):
        places[:, j - 1] = back[rows, j, places[:, j]]
    return _Fitted(previous[:, :1] + direction[:, None] * (places - K // 8), total.min(1))


def _spread(problem: DesignProblem, s: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the driver's values over the part of a turn that assigned values s (M, J) cover, and the unknowns x.

    The unknowns that are the beginning of this part and its fraction of the turn are set.
    """
    x, count = x.copy(), problem.free.count
    x[:, count] = s.min(1)
    low, high = problem.goal.bounds_of_extras
    x[:, count + 1 :] = np.clip(np.ptp(s, axis=1) / problem.period, low, high)[:, None]
    return problem.values_at(x, s), x


# --- given values


def _shift(problem: DesignProblem, x: np.ndarray, turn: Turn) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    goal, moves = problem.goal, problem.can_move
    values = np.asarray(goal.values)
    x, start = x.copy(), turn.s[:, 0]
    step = problem.period / TURN_VALUES
    phases = range(0, TURN_VALUES, max(TURN_VALUES // 36, 1)) if problem.shifted else [None]
    best, chosen = np.full(len(x), np.inf), [np.ones(len(x), complex), np.zeros(len(x), complex), np.zeros(len(x))]
    for phase in phases:
        first = start if phase is not None else start * 0.0
        shift = first + (0.0 if phase is None else phase * step)
        index = (shift[:, None] + values - start[:, None]) / step % TURN_VALUES
        measured = _interpolate(turn.measures, index)
        a, b = np.ones(len(x), complex), np.zeros(len(x), complex)
        if goal.has_place:
            target = problem.data[:, 0] + 1j * problem.data[:, 1]
            a, b, cost = _move(measured[..., 0] + 1j * measured[..., 1], target, moves)
        else:
            difference = measured[..., 0] - problem.data[:, 0]
            offset = difference.mean(1, keepdims=True) if goal.extras else 0.0
            cost = np.sum((difference - offset) ** 2, 1)
        better = cost < best
        best = np.where(better, cost, best)
        chosen = [np.where(better, new, old) for new, old in zip((a, b, shift), chosen, strict=True)]
    a, b, shift = chosen
    moved = problem.moved(x, a, b)
    if problem.shifted:
        moved[:, problem.free.count] = shift + problem.turned_by(a)
    # The first value is at most half a period from the drawn position.
    s = np.broadcast_to(values, (len(x), len(values))).copy()
    if not problem.shifted:
        drawn = problem.value_drawn(moved)
        if problem.driven.is_angle:
            s += problem.period * np.round((drawn - s[:, 0]) / problem.period)[:, None]
    return (s, moved), best


def _interpolate(table: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return rows (M, J, G) of a table (M, K + 1, G), interpolated at fractional indices (M, J)."""
    low = np.clip(np.floor(index).astype(int), 0, table.shape[1] - 2)
    lower, upper = (np.take_along_axis(table, k[..., None], 1) for k in (low, low + 1))
    return lower + (index - low)[..., None] * (upper - lower)
