"""All dyads through five poses of a link (Burmester): up to four real ones, and thus up to six four-bars.

For a joint (x, y) of the link, the pivot (a, b) solves four equations, M(x, y, 1) (a, b, 1) = 0. The entries of M are linear; M
has rank two where its four cubic minors vanish. Such cubics have six common zeros (Hilbert and Burch), two of them the isotropic
points at infinity. In coordinates without a zero at infinity the monomials up to second order are a basis of all polynomials
modulo the minors, and the values of these monomials at the zeros are eigenvectors of a 6 x 6 matrix.
"""

from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from udkjax.synthesis.complete.balls import ROUNDING, Ball
from udkjax.synthesis.complete.certificate import Certificate, certify
from udkjax.synthesis.complete.dyads import dyad_system
from udkjax.synthesis.complete.nine_points import SAME_PLACE_TOL, displacements, power_of_two_near

DYAD_COUNT = 4  # number of dyads through generic poses, including complex dyads
NEARLY_REAL, SURELY_REAL = 1e-4, 1e-8
AT_INFINITY = 1e-7  # a joint or pivot at a distance of extent / AT_INFINITY counts as infinite
ISOTROPIC_TOL = 1e-6  # distance from the isotropic points that counts as zero, in homogeneous coordinates of norm one
SMALLEST_CUBIC = 1e-11  # smallest singular value of the minors' cubic terms for which zeros are isolated
QUADRATIC_MONOMIALS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
CUBIC_MONOMIALS = ((3, 0), (2, 1), (1, 2), (0, 3))
SINE_TOL = 8.0 * ROUNDING  # error of a sine in the longest floating-point type


class RealDyads(NamedTuple):
    """Dyads through five poses, in units of `scale` from the first place.

    Attributes:
        boxes: boxes that contain exactly one solution: the joint (two), the crank from the pivot to it (two).
        turns: rotations of the link in each pose, as complex numbers (5,).
        infinite: number of dyads with a joint or pivot at infinity, including complex ones.
        unproven: dyads that appear to be real without a proof: joints and cranks (4, K).
        scale: unit (m), a power of two.
    """

    boxes: Certificate
    turns: np.ndarray
    infinite: int
    unproven: np.ndarray
    scale: float


def require_five_poses(poses: np.ndarray) -> None:
    """Raise `ValueError` unless there are five different poses."""
    if len(poses) != 5:
        raise ValueError(f"goal: finitely many four-bars go through five poses; there are {len(poses)}: use `design`")
    extent = float(np.max(np.ptp(poses[:, :2], axis=0))) or 1.0
    for i, j in combinations(range(5), 2):
        off = poses[i] - poses[j]
        turn = abs((off[2] + np.pi) % (2 * np.pi) - np.pi)
        if np.max(np.abs(off[:2])) <= SAME_PLACE_TOL * extent and turn <= SAME_PLACE_TOL:
            raise ValueError(f"goal: targets {i} and {j} are the same pose: four poses leave infinitely many four-bars")


def find_real_dyads(poses: np.ndarray) -> RealDyads:
    """Return the real dyads through five poses (5, 3); raise `ValueError` if dyads are not isolated."""
    require_five_poses(poses)
    scale = power_of_two_near(poses[:, :2]) if np.ptp(poses[:, :2], axis=0).any() else 1.0
    d = displacements(np.asarray(poses[:, :2], np.longdouble) / scale)
    angle = np.asarray(poses[:, 2], np.longdouble) - np.longdouble(poses[0, 2])
    turn = angle[1:, None]
    rounded = SINE_TOL + ROUNDING * np.abs(turn).astype(float)
    half = np.sin(0.5 * turn)
    d = d._replace(p=Ball.of(-2.0 * half * half, 4.0 * rounded), s=Ball.of(np.sin(turn), rounded))
    joints, pivots = _zeros(*(part.mid[:, 0].astype(float) for part in d))
    points = np.concatenate([joints, pivots])
    is_finite = (np.abs(points[[2, 5]]) > AT_INFINITY * np.max(np.abs(points[[0, 1, 3, 4]]), axis=0)).all(axis=0)
    u = np.concatenate([joints[:2] / joints[2], pivots[:2] / pivots[2]])[:, is_finite]
    reality = np.max(np.abs(np.imag(u)), axis=0) / (1.0 + np.max(np.abs(u), axis=0))
    near = reality < NEARLY_REAL
    boxes = certify(dyad_system(d), np.real(u)[:, near])
    proven = np.flatnonzero(boxes.is_proven & _first_of_each(boxes))
    unproven = np.real(u)[:, near][:, ~boxes.is_proven & (reality[near] < SURELY_REAL)]
    turns = np.exp(1j * angle.astype(float))
    return RealDyads(boxes.take(proven), turns, int(np.count_nonzero(~is_finite)), unproven, scale)


def _first_of_each(first: Certificate) -> np.ndarray:
    """Return a mask of the boxes that overlap no earlier box of the mask."""
    keep = np.ones(len(first.is_proven), bool)
    for j, i in combinations(range(len(keep)), 2):
        keep[i] &= not (keep[j] and first.balls.part(np.s_[:, i]).overlaps(first.balls.part(np.s_[:, j])).all())
    return keep


def _zeros(dx: np.ndarray, dy: np.ndarray, p: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return homogeneous joints (3, 4) and pivots (3, 4) of all dyads, complex, from displacements and turns (4,) of poses."""
    half = 0.5 * (dx**2 + dy**2)
    # L[j, k]: coefficients by (x, y, 1) of entry k of row j. Joints are in units of `size`, which is large if the link turns
    # little.
    by_x, by_y, constant = [-p, -s, dx * (1 + p) + dy * s], [s, -p, dy * (1 + p) - dx * s], [-dx, -dy, half]
    displacement, turned = np.linalg.norm(constant[:2]), np.linalg.norm([by_x[:2], by_y[:2]])
    size = displacement / turned if displacement > 0 and turned > 0 else 1.0
    scales = np.array([size, size, 1.0])
    L = np.transpose([by_x, by_y, constant], (2, 1, 0)) * scales / np.array([1.0, 1.0, size])[:, None]
    # A random rotation moves no zero to infinity, with probability one.
    Q = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    L = L @ Q
    minors = [_determinant(L[list(rows)]) for rows in combinations(range(4), 3)]
    table = np.array([[minor.get(m, 0.0) for m in (*CUBIC_MONOMIALS, *QUADRATIC_MONOMIALS)] for minor in minors])
    table /= np.linalg.norm(table, axis=1, keepdims=True) + (np.linalg.norm(table, axis=1, keepdims=True) == 0)
    if np.linalg.svd(table[:, :4], compute_uv=False)[-1] < SMALLEST_CUBIC:
        raise ValueError("dyads through these poses are not isolated: change a pose that others repeat, mirror or translate")
    reduced = -np.linalg.solve(table[:, :4], table[:, 4:])
    steps = []
    for move in ((1, 0), (0, 1)):
        rows = []
        for m in QUADRATIC_MONOMIALS:
            product = (m[0] + move[0], m[1] + move[1])
            rows.append(
                np.eye(6)[QUADRATIC_MONOMIALS.index(product)]
                if product in QUADRATIC_MONOMIALS
                else reduced[CUBIC_MONOMIALS.index(product)]
            )
        steps.append(np.array(rows))
    _, vectors = np.linalg.eig(0.6 * steps[0] + 0.8 * steps[1])
    joints = Q @ np.stack([vectors[1], vectors[2], vectors[0]])
    joints = joints / np.linalg.norm(joints, axis=0)
    off = [np.abs(joints[2]) + np.abs(joints[0] + sign * 1j * joints[1]) for sign in (1, -1)]
    order = np.argsort(np.minimum(*off))
    joints = joints[:, np.sort(order[2:])]
    rows = np.einsum("jkx,xm->mjk", L @ Q.T, joints)
    pivots = np.linalg.svd(rows)[2][:, -1].conj().T
    return joints * scales[:, None], pivots / np.array([1.0, 1.0, size])[:, None]


def _determinant(A: np.ndarray) -> dict[tuple[int, int], float]:
    """Return the determinant of a matrix (3, 3) of linear forms (3,), by monomials of two variables; the third one equals one."""
    found: dict[tuple[int, int], float] = {}
    for columns in permutations(range(3)):
        sign = np.linalg.det(np.eye(3)[list(columns)])
        for p, q, r in np.ndindex(3, 3, 3):
            m = ((p, q, r).count(0), (p, q, r).count(1))
            i, j, k = columns
            found[m] = found.get(m, 0.0) + sign * A[0, i, p] * A[1, j, q] * A[2, k, r]
    return found
