"""Values of a driver at which an angle or a displacement turns back or is fastest, accurate to rounding."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float

from udkjax.arrays import FULL_TURN
from udkjax.positions.assembling.coordinates import Coordinate, value_of
from udkjax.positions.following.continuation import Reached
from udkjax.positions.following.kinematics import Kinematics, kinematics
from udkjax.positions.following.travel import travel
from udkjax.scene.mechanism import Mechanism

GRID_VALUES = 721  # values of a driver over its range: half a degree apart over a turn
GRID_SHIFT = 0.4142  # of a step: linkages are drawn in dead points, which shall lie within the range
STILL_TOL = 1e-9  # relative to the fastest: slower is rounding
NEWTON_STEPS = 5  # from a secant of the grid to rounding
SECANT_STEPS = 7  # the same without the derivative, by secants that keep the zero between them


Item = TypeVar("Item")


class Combination(NamedTuple):
    """A linear combination of the coordinates of bodies, such as the angle of a body, or its displacement along a line.

    Attributes:
        weights: of the coordinates x, y (m) and angle (rad) of each body, (bodies, 3).
    """

    weights: Float[np.ndarray, "bodies 3"]

    def of(self, coordinates: Float[np.ndarray, "T bodies 3"]) -> Float[np.ndarray, "T"]:
        """Return the combination of coordinates, or of their first or second derivatives."""
        return np.einsum("tbc,bc->t", coordinates, self.weights)

    def height(self, q: Float[np.ndarray, "T bodies 3"]) -> Float[np.ndarray, "T"]:
        """Return the values (T,) of the combination at coordinates."""
        return self.of(q)

    def curves(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the combination (T,) at coordinates q, and its two derivatives, from the derivatives dq and ddq of q."""
        return self.of(q), self.of(dq), self.of(ddq)


class PointAlong(NamedTuple):
    """The displacement of a point of a body along a line of the ground.

    Attributes:
        body: the index of the body.
        point: the point in its frame (m).
        axis: the angle of the line (rad).
    """

    body: int
    point: Float[np.ndarray, "2"]
    axis: float

    def height(self, q: Float[np.ndarray, "T bodies 3"]) -> Float[np.ndarray, "T"]:
        """Return the displacements (T,) at coordinates (m)."""
        return self.curves(q, q, q)[0]

    def curves(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the displacement (T,) at coordinates q, and its two derivatives, from the derivatives dq and ddq of q."""
        along = np.array([np.cos(self.axis), np.sin(self.axis)])
        (place, speed, change), angle = (x[:, self.body, :2] for x in (q, dq, ddq)), q[:, self.body, 2]
        omega, alpha = dq[:, self.body, 2], ddq[:, self.body, 2]
        c, s, (px, py) = np.cos(angle), np.sin(angle), self.point
        arm = np.stack([c * px - s * py, s * px + c * py], -1)
        on_arm, across = arm @ along, arm[:, 0] * along[1] - arm[:, 1] * along[0]
        return place @ along + on_arm, speed @ along + omega * across, change @ along + alpha * across - omega**2 * on_arm


Measured = Combination | PointAlong


class TurningPoint(NamedTuple):
    """A point at which a measured quantity turns back.

    Attributes:
        value: the value of the driver (rad, m).
        height: the measured quantity at this value.
        dwells: whether the quantity stands still around the value.
    """

    value: float
    height: float
    dwells: bool


class Cycle:
    """The positions of a mechanism over the whole range of its driver, and their derivatives by the driver's value.

    Args:
        mechanism: a mechanism with concrete numbers.
        driver: its driver or coordinate.

    Attributes:
        turns: whether the range is a whole turn, without limits.
        is_known: whether the range is a whole turn or has a toggle at both ends; otherwise the arrays below are empty.
        values: the values (T,) in rad or m.
        q, dq, ddq: the coordinates (T, bodies, 3) and their derivatives.
        ends: the value of the driver and the coordinates (bodies, 3) at each of its toggles.
    """

    def __init__(self, mechanism: Mechanism, driver: str | Coordinate):
        self._given = mechanism, driver
        limits = travel(mechanism, driver)
        lower, upper = float(limits.lower), float(limits.upper)
        start = float(value_of(mechanism, driver)(mechanism.q0))
        self.turns = limits.unit == "rad" and not np.isfinite([lower, upper]).any()
        self.ends = [(v, np.asarray(q)) for v, q in ((lower, limits.lower_q), (upper, limits.upper_q)) if np.isfinite(v)]
        self.is_known = self.turns or len(self.ends) == 2
        if self.turns:
            values = start + GRID_SHIFT * FULL_TURN / (GRID_VALUES - 1) + np.linspace(0.0, FULL_TURN, GRID_VALUES)
        else:  # closer towards the toggles, where positions change with the root of the distance
            shares = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, GRID_VALUES) / GRID_VALUES)
            values = lower + (upper - lower) * shares
        self.values, self.q, self.dq, self.ddq = self._parts(self.at(values)) if self.is_known else (np.zeros(0),) * 4

    def at(self, values: np.ndarray) -> Kinematics:
        """Return the kinematics at increasing values of the driver, with a rate of one."""
        return kinematics(*self._given, values)

    @staticmethod
    def _parts(motion: Kinematics) -> tuple[np.ndarray, ...]:
        good = np.isin(np.asarray(motion.status), [Reached.closed])
        return tuple(np.asarray(x)[good] for x in (motion.values, motion.q, motion.v, motion.a))

    def turning_points(self, measured: Sequence[Measured]) -> list[list[TurningPoint]]:
        """Return the turning points of each measured quantity, in the order of the driver's values."""
        found = [(k, i) for k, one in enumerate(measured) for i in _sign_changes(self._curves(one)[1])]
        if not found:
            return [[] for _ in measured]
        which, index = np.array(found).T
        slopes = np.stack([self._curves(one)[1] for one in measured])
        low, high = self.values[index], self.values[index + 1]
        first, last = slopes[which, index], slopes[which, index + 1]
        value = low - first * (high - low) / (last - first)
        height, dwells = np.zeros(len(value)), np.zeros(len(value), bool)
        largest = STILL_TOL * np.max(np.abs(slopes), axis=1)[which]
        for _ in range(NEWTON_STEPS):
            order = np.argsort(value)
            motion = self.at(value[order])
            parts = [np.empty((len(value), *np.shape(motion.q)[1:])) for _ in range(3)]
            for part, x in zip(parts, (motion.q, motion.v, motion.a), strict=True):
                part[order] = np.asarray(x)
            rows = [np.ravel(measured[k].curves(*(x[i : i + 1] for x in parts))) for i, k in enumerate(which)]
            height, slope, curvature = np.array(rows).T
            dwells = (np.abs(slope) <= largest) & (np.abs(curvature) <= largest)
            steps = np.divide(slope, curvature, out=np.zeros_like(slope), where=~dwells)
            value = np.clip(value - steps, low, high)
        points = [TurningPoint(float(v), float(h), bool(d)) for v, h, d in zip(value, height, dwells, strict=True)]
        return _by_number(zip(which, points, strict=True), len(measured))

    def speed_extremes(self, measured: Sequence[Measured]) -> list[list[tuple[float, float]]]:
        """Return for each measured quantity the values of the driver at which its first derivative is extreme, with the latter.

        There the second derivative is zero, or jumps through zero. The values are found by the Illinois method (regula falsi),
        and are in increasing order. A quantity that moves in proportion to the driver has none.
        """
        curves = [self._curves(one)[2] for one in measured]
        sizes = [np.max(np.abs(self._curves(one)[1]), initial=0.0) for one in measured]
        found = [(k, i) for k, (x, size) in enumerate(zip(curves, sizes, strict=True)) for i in _sign_changes(x, size)]
        if not found:
            return [[] for _ in measured]
        which, index = np.array(found).T
        ends, heights = self.values[np.stack([index, index + 1])], np.stack(curves)[which, np.stack([index, index + 1])]
        value, rate, kept = ends[0], np.zeros(len(found)), np.full(len(found), -1)
        for _ in range(SECANT_STEPS):
            value = ends[0] - heights[0] * (ends[1] - ends[0]) / (heights[1] - heights[0])
            order = np.argsort(value)
            motion, back = self.at(value[order]), np.argsort(order)
            parts = [np.asarray(x) for x in (motion.q, motion.v, motion.a)]
            rows = [measured[k].curves(*(x[i : i + 1] for x in parts))[1:] for i, k in zip(back, which, strict=True)]
            rate, height = np.reshape(rows, (-1, 2)).T
            side = np.where(height * heights[0] > 0, 0, 1)  # the end that the new place replaces
            everyone = np.arange(len(found))
            heights[1 - side, everyone] *= np.where(side == kept, 0.5, 1.0)
            ends[side, everyone], heights[side, everyone], kept = value, height, side
            if np.all(heights[0] == heights[1]):
                break
        pairs = zip(which, value.tolist(), rate.tolist(), strict=True)
        return _by_number(((k, (v, r)) for k, v, r in pairs), len(measured))

    def rates(self, one: Measured) -> np.ndarray:
        """Return the first derivative of a measured quantity by the driver's value, at all `values` of the cycle."""
        return self._curves(one)[1]

    def _curves(self, one: Measured) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return one.curves(self.q, self.dq, self.ddq)

    def heights(self, one: Measured, turning: Sequence[TurningPoint]) -> np.ndarray:
        """Return values of a measured quantity that include its least and its largest value over the range.

        `turning` has the quantity's turning points.
        """
        at_ends = [one.height(q[None])[0] for _, q in self.ends]
        inner = [] if turning else one.height(self.q[[0, -1]]).tolist()
        return np.array([point.height for point in turning] + at_ends + inner)


def _by_number(pairs: Iterable[tuple[int, Item]], count: int) -> list[list[Item]]:
    lists: list[list[Item]] = [[] for _ in range(count)]
    for k, item in pairs:
        lists[k].append(item)
    return lists


def _sign_changes(slopes: np.ndarray, size: float = 0.0) -> list[int]:
    """Return each index k for which the sign of slope k + 1 differs from that of slope k.

    Slopes that are rounding errors, relative to the largest slope or to `size`, have the sign of the slope before: a dwell has at
    most one change.
    """
    signs = np.sign(slopes)
    signs[np.abs(slopes) <= STILL_TOL * max(size, np.max(np.abs(slopes), initial=0.0))] = 0.0
    last = np.maximum.accumulate(np.where(signs != 0.0, np.arange(len(signs)), 0))
    signs = signs[last]
    return np.flatnonzero(signs[:-1] * signs[1:] < 0.0).tolist()
