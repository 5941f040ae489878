"""Levenberg-Marquardt steps of many linkages at once, towards a small Chamfer distance of their curves from a target.

The gradient of `comparison` is exact; nearest places and weights are held within a step. Violations of limits are least squares.
"""

import time
from typing import NamedTuple

import numpy as np

from udkjax.arrays import FULL_TURN
from udkjax.synthesis.curves.comparison import compare
from udkjax.synthesis.curves.dyad_forms import RAIL, SLIDE
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    HEAD_NUMBERS,
    SECOND_ANGLE,
    SPAN_INDEX,
    DyadPositions,
    Topology,
    gradients,
    number_count,
    positions,
)
from udkjax.synthesis.curves.targets import CurveTarget

LONGEST_MOVE = 0.5  # largest change of a number in one step (RMS radii of the target, rad)
LEAST_SPAN = 0.7  # smallest part of a turn that may draw the curve (rad)
LARGEST_COORDINATE = 50.0  # largest coordinate of a place on its link; joints are limited by their distance from the target


class LinkageLimits(NamedTuple):
    """Limits of linkages; lengths in RMS radii of the target.

    Attributes:
        cosine: largest cosine of an angle between the links of a dyad.
        size: largest distance of joints from the middle of the target.
        shortest: smallest distance of the joints of a dyad's link.
        weight: weight of violations.
    """

    cosine: float
    size: float
    shortest: float
    weight: float = 1.0

    def bounds(self, topology: Topology, is_whole: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds (K, numbers) of the numbers of linkages."""
        high = np.full((len(topology.form), number_count(topology.dyads)), LARGEST_COORDINATE)
        low = -high
        low[:, SECOND_ANGLE], high[:, SECOND_ANGLE] = -np.inf, np.inf
        low[:, SPAN_INDEX], high[:, SPAN_INDEX] = FULL_TURN if is_whole else LEAST_SPAN, FULL_TURN
        for d in range(topology.dyads):
            k, form = HEAD_NUMBERS + DYAD_NUMBERS * d + 4, topology.form[:, d]
            low[:, k] = np.where(form == SLIDE, -LARGEST_COORDINATE, self.shortest)
            low[:, k + 1] = np.where(form == RAIL, -np.inf, self.shortest)
            high[form == RAIL, k + 1] = np.inf
        return low, high


class Sampling(NamedTuple):
    """T angles of the crank: share span + rest (2 pi - span), with the part of the turn `span` that draws the curve.

    Attributes:
        share: fractions of this part (T,).
        rest: fractions of the rest of the turn (T,).
        drawing: the number of angles, the first ones, at which the curve is drawn.
        is_whole: whether the whole turn draws the curve.
    """

    share: np.ndarray
    rest: np.ndarray
    drawing: int
    is_whole: bool

    def angles(self, x: np.ndarray) -> np.ndarray:
        """Return the angles (K, T) of linkages with the numbers x (K, numbers)."""
        span = x[:, SPAN_INDEX, None]
        return span * self.share + (FULL_TURN - span) * self.rest


def sampling(drawing: int, resting: int, is_whole: bool) -> Sampling:
    """Return angles over the part of the turn that draws the curve, both ends included, and over the rest of the turn."""
    if is_whole:
        count = drawing + resting
        return Sampling(np.arange(count) / count, np.zeros(count), count, True)
    share = np.concatenate([np.linspace(0.0, 1.0, drawing), np.ones(resting)])
    return Sampling(share, np.concatenate([np.zeros(drawing), np.arange(1, resting + 1) / (resting + 1)]), drawing, False)


class Task(NamedTuple):
    """The task of a descent: the target, the angles at which linkages are compared with it, and the limits."""

    target: CurveTarget
    sample: Sampling
    limits: LinkageLimits

    def weighed(self, weight: float) -> "Task":
        """Return the task with another weight of violations."""
        return self._replace(limits=self.limits._replace(weight=weight))


class Descended(NamedTuple):
    """Results of a descent of K linkages: numbers, losses, Chamfer distances and largest violations."""

    x: np.ndarray
    loss: np.ndarray
    chamfer: np.ndarray
    excess: np.ndarray


class _Violation(NamedTuple):
    cosines: np.ndarray  # excess of cosines (D, K, T)
    far: np.ndarray  # excess of squared distances of P, Q and R (3, D, K, T)

    def total(self, weight: float) -> np.ndarray:
        """Return the penalty of the violations, summed over all dyads (K, T)."""
        return weight * (self.cosines.sum(0) + self.far.sum((0, 1)))


def _joints(at: DyadPositions) -> np.ndarray:
    """Return the joints P, Q and R of all dyads, complex (3, D, K, T)."""
    return np.stack([at.origins[BASE_LINKS::2], at.origins[BASE_LINKS + 1 :: 2], at.ends])


def _violation(at: DyadPositions, limits: LinkageLimits) -> _Violation:
    joints = _joints(at)
    square = (np.real(joints) ** 2 + np.imag(joints) ** 2) / limits.size**2
    return _Violation(np.maximum(np.abs(at.cosines) - limits.cosine, 0.0), np.maximum(square - 1.0, 0.0))


def evaluate(x: np.ndarray, topology: Topology, task: Task, blur: float) -> tuple[np.ndarray, ...]:
    """Return losses, Chamfer distances and largest violations (K,) of linkages, and A and b of the equations A dx = -b."""
    sample, limits = task.sample, task.limits
    at = positions(x, topology, sample.angles(x))
    violation = _violation(at, limits)
    excess = violation.total(limits.weight)
    N = sample.drawing
    curve = compare(at.pin[:, :N], task.target, sample.is_whole, blur)
    pushes = (2.0 * limits.weight / limits.size**2) * (violation.far > 0.0) * _joints(at)
    squeeze = limits.weight * (violation.cosines > 0.0) * np.sign(at.cosines)
    J = gradients(x, topology, at, sample.share - sample.rest, pushes[:2], pushes[2], squeeze)
    x_by, y_by = J[:, :, 0, :N], J[:, :, 1, :N]
    xx, xy, yy = (moment[:, None] for moment in curve.moments)
    by_points = np.concatenate([x_by, y_by], 2)
    A = by_points @ np.concatenate([xx * x_by + xy * y_by, xy * x_by + yy * y_by], 2).transpose(0, 2, 1)
    b = (by_points @ np.concatenate([np.real(curve.pull), np.imag(curve.pull)], 1)[..., None])[..., 0]
    active = excess.any(1)
    if active.any():
        beyond = J[active, :, 2]
        A[active] += beyond @ beyond.transpose(0, 2, 1)
        b[active] += (beyond @ excess[active][..., None])[..., 0]
    return curve.distance + 0.5 * (excess**2).sum(1), curve.distance, excess.max(1) / limits.weight, A, b


def descend(x: np.ndarray, topology: Topology, task: Task, blur: float, steps: int, until: float = np.inf) -> Descended:
    """Return linkages (K, numbers), each improved independently by a number of steps, with their losses.

    Args:
        x: the numbers of the linkages.
        topology: their structures.
        task: the target, the angles of the crank, and the limits.
        blur: distance (RMS radii) below which squares are minimized.
        steps: number of steps.
        until: CPU time (`time.process_time`) after which it ends early.
    """
    low, high = task.limits.bounds(topology, task.sample.is_whole)
    x = np.clip(x, low, high)
    now = list(evaluate(x, topology, task, blur))
    damping, places = np.full(len(x), 1e-2), np.arange(x.shape[1])
    for _ in range(steps):
        if time.process_time() > until:
            break
        A, b = now[3].copy(), now[4]
        size = A[:, places, places]
        largest = size.max(1, keepdims=True)
        A[:, places, places] += damping[:, None] * (size + 1e-6 * largest) + 1e-10 * largest + 1e-30
        dx = -np.linalg.solve(A, b[..., None])[..., 0]
        dx *= np.minimum(1.0, LONGEST_MOVE / np.maximum(np.abs(dx).max(1, keepdims=True), 1e-300))
        tried = np.clip(x + dx, low, high)
        new = evaluate(tried, topology, task, blur)
        better = new[0] < now[0]
        damping = np.where(better, np.maximum(0.3 * damping, 1e-7), np.minimum(5.0 * damping, 1e6))
        x[better] = tried[better]
        for old, value in zip(now, new, strict=True):
            old[better] = value[better]
    return Descended(x, *now[:3])
