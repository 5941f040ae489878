"""The start of the nine-point homotopy, made from one four-bar by monodromy.

A four-bar and eight turns, all complex, drawn at random, give displacements through which it passes. These go around a
triangle of random displacements and back: the known solutions are followed, and what they come back as are solutions, too.
Loops go on until several in a row bring nothing new. At the end all cognates of all solutions are made: each must solve the
equations, and all six of a class must have one key.
"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from udkjax.synthesis.complete.dyads import DISPLACEMENTS, JOINT_UNKNOWNS
from udkjax.synthesis.complete.nine_points import CLASS_COUNT, CLOSE_PRECISION, class_keys, distinct, tracker, turns_of
from udkjax.synthesis.complete.path_tracking import ACCEPTED


def random_four_bar(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a solution (16, 1) and the displacements (16,) that it solves."""
    joints = complex_numbers(rng, JOINT_UNKNOWNS)
    pairs = [(x, X, x - r, X - R) for x, X, r, R in (joints[:4], joints[4:])]
    d, D, turns = (np.zeros(DISPLACEMENTS, complex) for _ in range(3))
    for j in range(DISPLACEMENTS):
        t = turns[j] = np.exp(complex_numbers(rng, 1)[0])
        first, other = (np.array([X / t - A, t * x - a, x * A * (1 - t) + X * a * (1 - 1 / t)]) for x, X, a, A in pairs)
        p, q, r = first - other  # p d + q D + r = 0, and the first dyad's d D + ... = 0
        d[j] = np.roots([-p / q, first[0] - (r + first[1] * p) / q, first[2] - first[1] * r / q])[rng.integers(2)]
        D[j] = -(p * d[j] + r) / q
    return np.append(joints, turns - 1.0)[:, None], np.append(d, D)


def complex_numbers(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return normal complex numbers of unit variance."""
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2)


def loops(
    rng: np.random.Generator, z: np.ndarray, parameters: np.ndarray, idle: int = 3, most: int = CLASS_COUNT
) -> Iterator[np.ndarray]:
    """Yield the known solutions (16, M) after each loop; end after some in a row without new ones, or with `most` solutions."""
    tired = 0
    while tired < idle and z.shape[1] < most:
        corners, moved = [parameters, *complex_numbers(rng, 2, 2 * DISPLACEMENTS), parameters], z
        for start, end in pairwise(corners):
            ends = tracker()(moved, start, end, CLOSE_PRECISION)
            moved = ends.z[:, ends.status == ACCEPTED]
        known = np.concatenate([z, moved], axis=1)
        known = known[:, distinct(known)]
        tired = tired + 1 if known.shape[1] == z.shape[1] else 0
        z = known
        yield z


def cognates(z: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return Roberts's two further four-bars of each (16, 2 M): with pivots a, c and b, c."""
    found, one, two = [], z[:4], z[4:JOINT_UNKNOWNS]
    for (x, X, r, R), (y, Y, s, S) in ((one, two), (two, one)):
        k, K = x / (x - y), X / (X - Y)
        found.append(np.stack([-r, -R, -x, -X, k * r - r, K * R - R, k * s, K * S]))
    joints = np.concatenate(found, axis=1)
    return np.concatenate([joints, turns_of(joints, parameters)])


def check(z: np.ndarray, parameters: np.ndarray) -> dict[str, float]:
    """Return by how much cognates fail to solve the equations, relative, and by how much keys differ within classes."""
    others = cognates(z, parameters)
    moved, converged = tracker().polish(others, parameters)
    key, same = class_keys(z), class_keys(moved)
    off = np.abs(same - np.concatenate([key, key], axis=1)) / (1 + np.abs(same))
    return {
        "failed": float(np.count_nonzero(~converged)),
        "step": float(np.max(np.abs(moved - others) / (1 + np.abs(moved)))),
        "keys": float(off.max()),
    }
