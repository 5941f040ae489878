"""Certificates of real solutions: floating-point proofs that a system has one solution close to an approximation.

Krawczyk's theorem: F has continuous derivatives, m is a point, U the box of all u with |u - m| <= r, Y any matrix. If

    |Y F(m)| + |1 - Y F'(U)| r < r      in every component,

F has exactly one zero in U, and F' is regular on U. Both terms are bounded from above, rounding errors included (balls.py).

Source: R. Krawczyk, Newton-Algorithmen zur Bestimmung von Nullstellen mit Fehlerschranken, Computing 4 (1969); R. E. Moore, A
test for existence of solutions to nonlinear systems, SIAM J. Numer. Anal. 14 (1977).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from udkjax.synthesis.complete.balls import INFLATION, LONG_DOUBLE, ROUNDING, UNDERFLOW_BOUND, Ball

BOX_WIDTHS = (2.0, 16.0)  # half-widths of the boxes tried in turn, relative to the Newton step
LEAST_SHARE = 1e-3  # smallest width of a box in a component, relative to its largest width
NEWTON_STEPS, EXACT_STEPS = 10, 4  # largest numbers of steps; each step doubles the number of correct digits
DIVERGED_SIZE = 1e8  # Newton's method has diverged beyond this size of the unknowns
EXACT_TRIAL_STEP = 1e-3  # largest relative Newton step, including rounding, for which exact arithmetic is tried
EPS = float(np.finfo(float).eps)

BallFunction = Callable[[Ball], tuple[Ball, Ball]]


class Certificate(NamedTuple):
    """Boxes around M approximate solutions of N equations.

    Attributes:
        middle: centres (N, M), improved by Newton's method, in the longest floating-point type.
        radius: radii of the boxes (N, M).
        is_proven: whether each box is proven to contain exactly one solution (M,).
    """

    middle: np.ndarray
    radius: np.ndarray
    is_proven: np.ndarray

    def take(self, which: np.ndarray) -> "Certificate":
        """Return the boxes that `which`, a mask or indices, selects."""
        return Certificate(*(a[..., which] for a in self))

    @property
    def balls(self) -> Ball:
        """The boxes as balls (N, M), one for each unknown."""
        return Ball(self.middle, self.radius)


def certify(system: BallFunction, u: np.ndarray, exact: BallFunction | None = None) -> Certificate:
    """Return approximate solutions, improved, with boxes that are proven, if possible, to contain one exact solution each.

    Args:
        system: maps unknowns (N, M) to F (N, M) and F' (N, N, M), as balls.
        u: approximate solutions (N, M).
        exact: the same system for fractions, used for solutions that need more digits.

    Returns:
        Boxes around the solutions; those at which F' is singular to within rounding remain unproven.
    """
    m, inverse = _improved(system, np.asarray(u, LONG_DOUBLE))
    F, _ = system(Ball.of(m))
    result = _prove(system, m, inverse, F)
    step = np.max(_product(inverse, F) / np.maximum(np.abs(m).astype(float), 1.0), axis=0)
    uncertain = np.flatnonzero(~result.is_proven & (step < EXACT_TRIAL_STEP) & (np.max(np.abs(m), axis=0) < DIVERGED_SIZE))
    if exact is None or not len(uncertain):
        return result
    m, inverse = m[:, uncertain], inverse[uncertain]
    for _ in range(EXACT_STEPS):
        m = m - np.einsum("mij,jm->im", inverse, _evaluate(exact, m).mid)
    second = _prove(system, m, inverse, _evaluate(exact, m))
    for old, new in zip(result, second, strict=True):
        old[..., uncertain] = new
    return result


def _evaluate(exact: BallFunction, m: np.ndarray) -> Ball:
    """Return the values F of the equations at points m, computed in fractions and rounded."""
    F = exact(Ball.fractions(m))[0].mid.astype(float)
    return Ball.of(F, EPS * np.abs(F) + UNDERFLOW_BOUND)


def _prove(system: BallFunction, m: np.ndarray, inverse: np.ndarray, F: Ball) -> Certificate:
    """Return boxes around points m, at which the equations have the values F; those with Krawczyk's condition are proven.

    `inverse` has approximate inverses of F' (M, N, N).
    """
    proven, radius = np.zeros(m.shape[1], bool), np.full(m.shape, np.inf)
    step = _product(inverse, F)
    size = np.maximum(np.abs(m).astype(float), 1.0)
    for width in BOX_WIDTHS:
        r = width * np.maximum(step, LEAST_SHARE * size * np.max(step / size, axis=0))
        _, slopes = system(Ball.of(m, r))
        with np.errstate(invalid="ignore", over="ignore"):
            reach = (step + _contraction(inverse, slopes, r)) * INFLATION
            now = np.all(reach < r, axis=0) & ~proven
        radius[:, now], proven = r[:, now], proven | now
    return Certificate(m, radius, proven)


def _improved(system: BallFunction, m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points improved by Newton's method, with F in the longest type, and the inverses of F' (M, N, N)."""
    for k in range(NEWTON_STEPS + 1):
        F, slopes = system(Ball.of(m))
        inverse = _inverses(np.moveaxis(slopes.mid, -1, 0).astype(float))
        if k == NEWTON_STEPS:
            break
        step = (inverse @ F.mid.T[..., None].astype(float))[..., 0].T
        m = m - np.where(np.isfinite(step), step, 0.0)
    return m, inverse


def _inverses(A: np.ndarray) -> np.ndarray:
    """Return the inverses of matrices (M, N, N); NaN for singular ones."""
    with np.errstate(all="ignore"):
        rows = np.max(np.abs(A), axis=2, keepdims=True)
        rows = np.where((rows > 0) & np.isfinite(rows), rows, 1.0)
        A = np.where(np.isfinite(A), A / rows, 0.0)
        columns = np.maximum(np.max(np.abs(A), axis=1, keepdims=True), 1e-300)
        A = A / columns
        singular = np.linalg.slogdet(A)[0] == 0
        A = np.where(singular[:, None, None], np.eye(A.shape[1]), A)
        inverses = np.linalg.inv(A) / np.moveaxis(columns, 1, 2) / np.moveaxis(rows, 1, 2)
    return np.where(singular[:, None, None], np.nan, inverses)


def _product(Y: np.ndarray, F: Ball) -> np.ndarray:
    """Return bounds (N, M) of |Y F|."""
    n = len(F.mid)
    mid = np.abs(np.einsum("mij,jm->im", Y.astype(LONG_DOUBLE), F.mid)).astype(float)
    with np.errstate(invalid="ignore"):
        rounded = np.einsum("mij,jm->im", np.abs(Y), F.rad + (n + 2) * ROUNDING * np.abs(F.mid).astype(float))
        return (mid + rounded) * INFLATION


def _contraction(Y: np.ndarray, slopes: Ball, r: np.ndarray) -> np.ndarray:
    """Return bounds (N, M) of |1 - Y F'(U)| r."""
    n = len(r)
    A = np.moveaxis(slopes.mid, -1, 0).astype(float)
    rad = np.moveaxis(slopes.rad, -1, 0) + EPS * np.abs(A)  # for the rounding to float64 above
    difference = np.abs(np.eye(n) - Y @ A) * (1.0 + EPS)
    difference = difference + np.abs(Y) @ (rad + (n + 2) * EPS * np.abs(A)) * INFLATION + EPS
    return (difference @ r.T[..., None])[..., 0].T * INFLATION
