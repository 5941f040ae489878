"""Newton's method for loops that have no solution in closed form, from an estimate as one reads it off a sketch."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.study.worked.loops import LoopVector, VectorLoop

ESTIMATE_GRAIN = np.pi / 18  # rad: angles of the estimate are multiples of it, and lengths of this fraction of the longest vector
HALVINGS = 8  # of this grain, until the estimate leads to the position
MOST_STEPS = 20
CLOSED_TOL = 1e-14  # relative to the longest vector: residuals of closed loops
SAME_POSITION_TOL = 1e-9  # rad, or relative to the longest vector: differences of the same position


class PositionMotion(NamedTuple):
    """The motion of one position: angles, and lengths along lines, each with its first and second derivative in time."""

    angles: dict[str, tuple[float, float, float]]  # rad, rad/s, rad/s^2
    slides: dict[str, tuple[float, float, float]]  # m, m/s, m/s^2


class NewtonStep(NamedTuple):
    """The unknowns before a step (rad, m), and the largest residual of the closures with them (m)."""

    unknowns: list[float]
    residual: float


def newton_steps(loops: Sequence[VectorLoop], motion: PositionMotion) -> list[NewtonStep]:
    """Return the steps of Newton's method, J d = -f for the changes d of the unknowns, to the position of `motion`.

    f are the components x and y of the closures, and J is the matrix of the velocities. The first step begins at a coarse
    estimate of the position, of which only the angles and lengths are used. If no estimate leads to it, there are no steps.
    """
    names = [("angle", body) for loop in loops for body in loop.angles] + [("slide", s) for loop in loops for s in loop.slides]
    goal = np.array([(motion.angles if kind == "angle" else motion.slides)[name][0] for kind, name in names])
    longest = max(abs(x.size) for loop in loops for x in loop.vectors)
    units = np.array([1.0 if kind == "angle" else longest for kind, _ in names])
    for halvings in range(HALVINGS):
        grain = ESTIMATE_GRAIN * units / 2**halvings
        x, steps = np.round(goal / grain) * grain, []
        for _ in range(MOST_STEPS):
            f, J = _closures(loops, motion, dict(zip(names, x, strict=True)))
            steps.append(NewtonStep(x.tolist(), float(np.max(np.abs(f)))))
            if np.max(np.abs(f)) <= CLOSED_TOL * longest or np.linalg.matrix_rank(J) < len(x):
                break
            x = x - np.linalg.solve(J, f)
        if np.all(np.abs(x - goal) <= SAME_POSITION_TOL * units):
            return steps
    return []


def _closures(
    loops: Sequence[VectorLoop], motion: PositionMotion, unknowns: dict[tuple[str, str], float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the components of the closures of loops (m), and their derivatives with respect to the unknowns."""

    def vector(x: LoopVector) -> tuple[float, float]:
        angle = 0.0 if x.body == GROUND else unknowns.get(("angle", x.body), motion.angles[x.body][0])
        return angle + x.turn, unknowns.get(("slide", x.slide), x.size)

    f, J = np.zeros(2 * len(loops)), np.zeros((2 * len(loops), len(unknowns)))
    columns = {name: k for k, name in enumerate(unknowns)}
    for k, loop in enumerate(loops):
        for x in loop.vectors:
            way, size = vector(x)
            along, across = x.sign * np.array([np.cos(way), np.sin(way)]), x.sign * np.array([-np.sin(way), np.cos(way)])
            rows = slice(2 * k, 2 * k + 2)
            f[rows] += size * along
            for name, part in ((("angle", x.body), size * across), (("slide", x.slide), along)):
                if name in columns:
                    J[rows, columns[name]] += part
    return f, J
