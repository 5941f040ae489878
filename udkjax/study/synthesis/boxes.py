"""Boxes of the pins of four-bars and of their cognates, from those that hold exact solutions."""

from itertools import permutations
from typing import NamedTuple

import numpy as np

from udkjax.study.synthesis.balls import Ball, ComplexBall
from udkjax.study.synthesis.certificate import Certificate
from udkjax.study.synthesis.four_bars import FourBars


class FourBarBoxes(NamedTuple):
    """Fixed joints O, C and moving joints A, B of four-bars (M,) in the first position, from the first place."""

    O: ComplexBall  # noqa: E741  # as it is drawn
    C: ComplexBall
    A: ComplexBall
    B: ComplexBall


def cognate_joints(boxes: Certificate) -> tuple[FourBarBoxes, FourBarBoxes, FourBarBoxes]:
    """Return the joints of all three cognates, as `FourBars.cognates` has them."""
    u = boxes.balls
    x, r, y, s = (ComplexBall(u.part(k), u.part(k + 1)) for k in (0, 2, 4, 6))
    a, b = x - r, y - s
    return FourBarBoxes(a, b, x, y), _other(a, b, x, y), _other(b, a, y, x)


def _other(a: ComplexBall, b: ComplexBall, x: ComplexBall, y: ComplexBall) -> FourBarBoxes:
    k = x / (x - y)
    joint = a - x
    return FourBarBoxes(a, a + k * (b - a), joint, joint + k * (x - a))


def radius_of(boxes: FourBarBoxes, bars: FourBars, origin: complex, scale: float) -> np.ndarray:
    """Return how far the pins of four-bars, as floating-point numbers, may be from the exact ones (M,), at most (m)."""
    start = ComplexBall(Ball.of(np.real(origin)), Ball.of(np.imag(origin)))
    size = ComplexBall(Ball.of(scale), Ball.of(0.0))
    pins = (bars.O, bars.C, bars.A[:, 0], bars.B[:, 0])
    return np.max([(start + size * box).distance(pin) for box, pin in zip(boxes, pins, strict=True)], axis=0, initial=0.0)


def certainly_different(boxes: Certificate) -> np.ndarray:
    """Return the places of boxes that hold different classes: their three pivots are proven to be others, in whatever order."""
    first, second, _ = cognate_joints(boxes)
    pivots, count = (first.O, first.C, second.C), boxes.middle.shape[1]
    rows, columns = np.arange(count)[:, None], np.arange(count)[None, :]
    meet = np.array([[p.part(rows).overlaps(q.part(columns)) for q in pivots] for p in pivots])
    same = np.any([meet[0, i] & meet[1, j] & meet[2, k] for i, j, k in permutations(range(3))], axis=0)
    return np.flatnonzero(~np.tril(same, -1).any(axis=1))
