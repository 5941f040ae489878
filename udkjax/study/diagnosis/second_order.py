"""The branches that meet at a singular configuration: directions that the constraints allow to second order.

Along a curve q(s) with q' = V x, V spanning the null space of J, Psi = 0 asks of the second derivative J q'' = -H(V x, V x), which
has a solution if and only if N^T H(V x, V x) = 0: one quadratic form x^T A_i x for each column of N. Its common zeros are the
tangents of the branches. They are found by Gauss-Newton from many directions at once; each is then walked along, a step, to see
that there is a motion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations import constraints
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.configuration import Configuration, Positions

STARTS = 400  # directions to look from
ITERATIONS = 60
ZERO = 1e-10  # of the forms, whose coefficients are at most one
SAME = 1e-4  # rad: directions nearer than that are one
STEP = 0.02  # of the characteristic length, and rad: how far a branch is walked along
ASTRAY = 0.2  # of the step: how far its end may be from the tangent; it bends by the step's square


class Branch(NamedTuple):
    """One of the motions that start from a singular configuration."""

    tangent: np.ndarray  # (bodies, 3): m, m, rad along it, the largest of a body's turn or of its way over L being one
    degrees_of_freedom: int  # on it, next to the configuration
    rank: int
    followed: bool  # whether a closed position was found along it, on both sides


def branches(mechanism: Mechanism, positions: Positions, at: Configuration) -> list[Branch]:
    """Return the branches that meet at a configuration; of one that is not singular, the directions in which it moves."""
    A, N, V = quadratic_forms(mechanism, positions, at), at.left, at.right
    if not V.shape[1]:
        return []
    subspaces = zeros_of(A) if N.shape[1] else [np.eye(V.shape[1])]
    return [_followed(positions, at, V @ space) for space in subspaces]


def quadratic_forms(mechanism: Mechanism, positions: Positions, at: Configuration) -> np.ndarray:
    """The forms A (k, d, d) of the second-order condition: N^T of the second derivative of scaled Psi along V."""
    N, V = at.left, at.right
    if not N.shape[1] or not V.shape[1]:
        return np.zeros((N.shape[1], V.shape[1], V.shape[1]))
    unit, weights = positions.unit[:, None] * V, N / positions.row_unit[:, None]
    return np.asarray(_hessian(mechanism.bare, at.t, at.q, unit, weights))


@jax.jit
def _hessian(mechanism, t, q, unit, weights):
    return jax.hessian(lambda x: weights.T @ constraints.psi(mechanism, t, q + unit @ x))(jnp.zeros(unit.shape[1]))


def zeros_of(A: np.ndarray) -> list[np.ndarray]:
    """The directions x (d, g) where all forms x^T A_i x vanish: lines (g = 1), or linear spaces where many are one motion.

    A zero that is not isolated, and whose neighbours are not a linear space, is returned as the line that was found.
    """
    d = A.shape[1]
    size = np.abs(A).max(initial=0.0)
    if size < ZERO:
        return [np.eye(d)]
    A, random = A / size, np.random.default_rng(0)
    x = random.standard_normal((STARTS, d))
    x = np.concatenate([np.eye(d), x / np.linalg.norm(x, axis=1, keepdims=True)])
    for _ in range(ITERATIONS):
        value = np.einsum("kij,si,sj->sk", A, x, x)
        slope = 2 * np.einsum("kij,sj->ski", A, x)
        residual = np.concatenate([value, np.zeros((len(x), 1))], axis=1)
        matrix = np.concatenate([slope, x[:, None, :]], axis=1)  # and a step across x
        x = x - np.einsum("sij,sj->si", np.linalg.pinv(matrix, rcond=1e-9), residual)
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
    x = x[np.abs(np.einsum("kij,si,sj->sk", A, x, x)).max(axis=1) < ZERO]
    found: list[np.ndarray] = []
    for direction in x:
        if any(np.linalg.norm(direction - space @ (space.T @ direction)) < SAME for space in found):
            continue
        space = _linear(A, direction)
        found = [other for other in found if not _inside(other, space)] + [space]
    return found


def _linear(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The linear space of zeros around a zero x, or x alone: the kernel of all A_i x, if all forms vanish on it."""
    sigma, vt = np.linalg.svd(2 * np.einsum("kij,j->ki", A, x))[1:]
    kernel = vt[int(np.sum(sigma > SAME)) :].T
    flat = np.abs(np.einsum("ia,kij,jb->kab", kernel, A, kernel)).max(initial=0.0) < SAME**2
    return kernel if flat and kernel.shape[1] else x[:, None]


def _inside(one: np.ndarray, two: np.ndarray) -> bool:
    return one.shape[1] < two.shape[1] and bool(np.linalg.norm(one - two @ (two.T @ one)) < SAME)


def _followed(positions: Positions, at: Configuration, tangents: np.ndarray) -> Branch:
    tangent = tangents @ np.ones(tangents.shape[1]) / np.sqrt(tangents.shape[1])
    size = positions.rows.scales.size(positions.unit * tangent, np)
    tangent = tangent / size * np.sign(tangent[np.argmax(np.abs(tangent))])
    ends = [positions.displaced(at, tangent, side * STEP) for side in (1.0, -1.0)]
    reached = [end for end, side in zip(ends, (1.0, -1.0), strict=True) if _reached(positions, at, end, side * STEP * tangent)]
    rank = max((end.rank for end in reached if end is not None), default=at.rank)
    free = len(at.q) - rank
    return Branch((positions.unit * tangent).reshape(-1, 3), free, rank, len(reached) == 2)


def _reached(positions: Positions, at: Configuration, end: Configuration | None, way: np.ndarray) -> bool:
    return end is not None and float(np.linalg.norm((end.q - at.q) / positions.unit - way)) < ASTRAY * float(np.linalg.norm(way))
