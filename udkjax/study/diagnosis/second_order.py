"""The branches that meet at a singular configuration, as directions that the constraints allow to second order.

Let V span the null space of the Jacobian J of Psi, let N span that of J^T, and let H be the second derivative of Psi. Along a
curve q(s) with q' = V x, Psi = 0 requires J q'' = -H(V x, V x). This has a solution if and only if N^T H(V x, V x) = 0: one
quadratic form x^T A_i x for each column of N. The common zeros of the forms are the tangents of the branches, computed by the
Gauss-Newton method from many directions at once. A step along each tangent verifies a motion.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations import constraints
from udkjax.programs.deferred import deferred
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.configuration import Configuration, RankedPositions

N_DIRECTIONS = 400  # number of initial directions
GAUSS_NEWTON_STEPS = 60  # at double zeros each step halves the error, down to 1e-18
ZERO_FORM = 1e-10  # tolerance on the forms, whose coefficients are at most one
DOUBLE_ZERO = 1e-7  # tolerance on a tangent: a double zero is accurate to the square root of rounding
SAME_DIRECTION = 1e-4  # directions that differ by less (rad) are the same
SEARCH_ANGLE = 0.1  # distance from a zero at which others are searched for (rad)
STEP_LENGTH = 0.02  # step along a branch, relative to the characteristic length, and rad
TANGENT_TOL = 0.2  # largest distance of a step's end from the tangent, relative to the step; it grows as the step squared


class Branch(NamedTuple):
    """One of the motions that start from a singular configuration."""

    tangent: np.ndarray  # (bodies, 3): m, m, rad; scaled so that the largest rotation, or displacement over L, of a body is one
    degrees_of_freedom: int  # dimension of this branch
    rank: int  # rank on the branch, next to the configuration
    followed: bool  # True if closed positions were found along it on both sides


def branches(mechanism: Mechanism, positions: RankedPositions, at: Configuration) -> list[Branch]:
    """Return the branches that meet at a configuration; if it is not singular, the directions of its motion."""
    if not at.freedom:
        return []
    A, V = quadratic_forms(mechanism, positions, at), at.right
    found = zeros_of(A) if at.redundancy else [Zeros(np.eye(V.shape[1]), V.shape[1])]
    return [_follow(positions, at, V @ zeros.space, zeros.dimension) for zeros in found]


def quadratic_forms(mechanism: Mechanism, positions: RankedPositions, at: Configuration) -> np.ndarray:
    """Return the forms A (k, d, d) of the second-order condition: N^T times the second derivative of scaled Psi along V."""
    if not at.redundancy or not at.freedom:
        return np.zeros((at.redundancy, at.freedom, at.freedom))
    N, V = at.left, at.right
    unit, weights = positions.unit[:, None] * V, N / positions.row_unit[:, None]
    return np.asarray(_hessian(mechanism.without_origin, np.asarray(at.t), at.q, unit, weights))


@deferred
def _hessian(mechanism, t, q, unit, weights):
    return jax.hessian(lambda x: weights.T @ constraints.psi(mechanism, t, q + unit @ x))(jnp.zeros(unit.shape[1]))


class Zeros(NamedTuple):
    """Directions in which all forms vanish: a linear space, or a line of a nonlinear cone."""

    space: np.ndarray  # (d, g), orthonormal
    dimension: int  # dimension of the space, or of the cone

    @property
    def is_cone(self) -> bool:
        return self.space.shape[1] < self.dimension


def zeros_of(A: np.ndarray) -> list[Zeros]:
    """Return the directions x where all forms x^T A_i x vanish: isolated lines, linear spaces, and a line of each cone."""
    d, size = A.shape[1], np.abs(A).max(initial=0.0)
    if size < ZERO_FORM:
        return [Zeros(np.eye(d), d)]
    A, random = A / size, np.random.default_rng(0)
    x = _solve(A, np.concatenate([np.eye(d), random.standard_normal((N_DIRECTIONS, d))]))
    all_zeros: list[Zeros] = []
    for direction in x:
        if any(np.linalg.norm(direction - z.space @ (z.space.T @ direction)) < SAME_DIRECTION for z in all_zeros):
            continue
        zeros = _zeros_around(A, direction)
        if zeros.is_cone and any(
            z.is_cone and z.dimension == zeros.dimension for z in all_zeros
        ):  # one line of each cone is enough
            continue
        all_zeros = [z for z in all_zeros if not _inside(z.space, zeros.space)] + [zeros]
    return all_zeros


def _solve(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return common zeros of the forms on the unit sphere, found by Gauss-Newton from many directions x (s, d)."""
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    for _ in range(GAUSS_NEWTON_STEPS):
        residual = np.einsum("kij,si,sj->sk", A, x, x)
        matrix = np.concatenate([2 * np.einsum("kij,sj->ski", A, x), x[:, None, :]], axis=1)  # last row: normal to x
        x = x - np.einsum("sij,sj->si", np.linalg.pinv(matrix, rcond=1e-9), np.pad(residual, ((0, 0), (0, 1))))
        x = x / np.linalg.norm(x, axis=1, keepdims=True)
    return x[np.abs(np.einsum("kij,si,sj->sk", A, x, x)).max(axis=1) < ZERO_FORM]


def _zeros_around(A: np.ndarray, x: np.ndarray) -> Zeros:
    """Return the zeros around a zero x of all forms.

    These are the common null space of all A_i x if the forms vanish on it; a line of a cone if other zeros are near; or x alone.
    """
    sigma, vt = np.linalg.svd(2 * np.einsum("kij,j->ki", A, x))[1:]
    kernel = vt[int(np.sum(sigma > SAME_DIRECTION)) :].T
    if kernel.shape[1] > 1:
        if np.abs(np.einsum("ia,kij,jb->kab", kernel, A, kernel)).max(initial=0.0) < SAME_DIRECTION**2:
            return Zeros(kernel, kernel.shape[1])
        near = _solve(A, x + SEARCH_ANGLE * kernel.T)
        if np.any(np.linalg.norm(near - (near @ x)[:, None] * x, axis=1) > SEARCH_ANGLE / 2):
            return Zeros(x[:, None], kernel.shape[1])
    return Zeros(x[:, None], 1)


def _inside(line: np.ndarray, space: np.ndarray) -> bool:
    return line.shape[1] < space.shape[1] and bool(np.linalg.norm(line - space @ (space.T @ line)) < SAME_DIRECTION)


def _follow(positions: RankedPositions, at: Configuration, tangents: np.ndarray, dimension: int) -> Branch:
    tangent = tangents @ np.ones(tangents.shape[1]) / np.sqrt(tangents.shape[1])
    size = positions.rows.step_size(positions.unit * tangent)
    tangent = tangent / size * np.sign(tangent[np.argmax(np.abs(tangent))])
    tangent[np.abs(tangent) < DOUBLE_ZERO] = 0.0
    ends = [positions.displace(at, tangent, side * STEP_LENGTH) for side in (1.0, -1.0)]
    reached = [
        end for end, side in zip(ends, (1.0, -1.0), strict=True) if _reaches(positions, at, end, side * STEP_LENGTH * tangent)
    ]
    rank = max((end.rank for end in reached if end is not None), default=at.rank)
    displacement = positions.unit * tangent
    displacement = displacement / positions.rows.scales.size(displacement, np)
    return Branch(displacement.reshape(-1, 3), dimension, rank, len(reached) == 2)


def _reaches(positions: RankedPositions, at: Configuration, end: Configuration | None, tangent: np.ndarray) -> bool:
    return end is not None and bool(
        np.linalg.norm((end.q - at.q) / positions.unit - tangent) < TANGENT_TOL * np.linalg.norm(tangent)
    )
