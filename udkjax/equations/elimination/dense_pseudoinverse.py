"""D^+ of dense matrices by NumPy: of large ones by QR where the rank is clear, otherwise by singular values.

Let the r columns of Q_1 be an orthonormal basis of the rows of D, by QR of D^T; its other columns span the null space. Then
D = W S Q_1^T with D Q_1 = W S, also by QR unless all rows are independent, so that D Q_1 = R^T is triangular, and

    D^+ = Q_1 S^(-1) W^T.

This takes a quarter of the time of a singular value decomposition. All of it is by NumPy: the threads of SciPy's library of
linear algebra wait for work by spinning, as do those of NumPy's, and would take the cores from each other.
"""

import math
from typing import NamedTuple

import numpy as np

from udkjax.arrays import ROUNDING


class TruncatedPseudoinverse(NamedTuple):
    """D^+ = V S^+ U^T by NumPy, the counterpart of `pinv.SVD`."""

    u: np.ndarray
    inverse: np.ndarray
    vt: np.ndarray
    rank: int

    @classmethod
    def of(cls, D: np.ndarray, tol: float, full: bool = False) -> "TruncatedPseudoinverse":
        """Return the pseudoinverse of a matrix; NaN if the matrix is not finite.

        Singular values up to `tol` times the largest count as zero. If `full`, `vt` contains all n right singular vectors.
        """
        if D.shape == (1, 1) and math.isfinite(D[0, 0]) and D[0, 0]:  # of one degree of freedom
            return cls(np.sign(D), 1 / np.abs(D[0]), np.ones((1, 1)), 1)
        if not np.isfinite(D).all():  # for which NumPy raises an error
            D, tol = np.zeros_like(D), np.nan
        u, sigma, vt = np.linalg.svd(D, full_matrices=full)
        if sigma[-1] > tol * sigma[0]:
            return cls(u[:, : len(sigma)], 1 / sigma, vt, len(sigma))
        counts = ~(sigma <= tol * sigma[0])
        inverse = np.where(counts, 1 / np.where(sigma > 0, sigma, 1.0), 0.0) + 0.0 * tol
        return cls(u[:, : len(sigma)], inverse, vt, int(counts.sum()))

    def __matmul__(self, b: np.ndarray) -> np.ndarray:
        if b.ndim == 1:
            return (self.inverse * (b @ self.u)) @ self.vt[: len(self.inverse)]
        return self.vt[: len(self.inverse)].T @ ((self.u.T @ b).T * self.inverse).T

    def transposed_times(self, b: np.ndarray) -> np.ndarray:
        """Return (D^+)^T b of a vector."""
        return self.u @ (self.inverse * (self.vt[: len(self.inverse)] @ b))

    def null_space(self, free: int) -> np.ndarray:
        """Return the right singular vectors (n, free) of the smallest singular values; the decomposition must be `full`."""
        return self.vt[len(self.vt) - free :].T


FEW_ROWS = 24  # up to which singular values take less time, as functions of NumPy are called less often


class FactoredPseudoinverse(NamedTuple):
    """D^+ = Q_1 A with A = S^(-1) W^T."""

    Q: np.ndarray  # (n, n), or its first columns (n, r or more)
    A: np.ndarray  # (r, m)

    @classmethod
    def of(cls, D: np.ndarray, tol: float, with_null_space: bool = False) -> "FactoredPseudoinverse | None":
        """Return D^+ by QR; None if the rank is not clear.

        It is clear if D is finite, the dependent rows are combinations of the others up to rounding, and all other singular
        values are certain to exceed `tol` times the largest.
        """
        mode = "complete" if with_null_space else "reduced"
        if not D.size or not np.isfinite(D).all():
            return None
        Q, R = np.linalg.qr(D.T, mode=mode)
        zero = ROUNDING * math.sqrt(D.size) * np.abs(D).max()
        independent = np.zeros(len(D), bool)  # of the rows before
        independent[: len(R)] = np.abs(R.diagonal()) > zero
        r = int(independent.sum())
        if r == len(D):
            A = np.linalg.inv(R[:r]).T
        else:
            Q = np.linalg.qr(D[independent].T, mode=mode)[0]
            rows = D @ Q[:, :r]
            if not r or np.abs(D - rows @ Q[:, :r].T).max() > zero:
                return None
            W, S = np.linalg.qr(rows)
            A = np.linalg.inv(S) @ W.T
        if not _bound(D) * _bound(A) * tol < 1.0:  # the largest over the smallest singular value that counts, or more
            return None
        return cls(Q, A)

    @property
    def rank(self) -> int:
        """The number of independent rows."""
        return len(self.A)

    def __matmul__(self, b: np.ndarray) -> np.ndarray:
        """Return D^+ b of a vector (m,), or of columns (m, k)."""
        return self.Q[:, : self.rank] @ (self.A @ b)

    def transposed_times(self, b: np.ndarray) -> np.ndarray:
        """Return (D^+)^T b of a vector."""
        return (b @ self.Q[:, : self.rank]) @ self.A

    def null_space(self, free: int) -> np.ndarray:
        """Return orthonormal columns (n, free) that span the null space of D, for free = n - r and `with_null_space`."""
        return self.Q[:, len(self.Q) - free :]


def _bound(A: np.ndarray) -> float:
    """Return an upper bound of the largest singular value: the Frobenius norm, or one from the sums of rows and columns."""
    sizes = np.abs(A)
    return math.sqrt(min(float(np.vdot(A, A)), float(sizes.sum(0).max() * sizes.sum(1).max())))


def dense_pseudoinverse(
    D: np.ndarray, tol: float, free: int | None = None, with_values: bool = False
) -> FactoredPseudoinverse | TruncatedPseudoinverse:
    """Return D^+ with singular values up to `tol` times the largest counted as zero.

    Args:
        D: a matrix (m, n), in units in which its rows are comparable.
        tol: the rank tolerance.
        free: number of columns of `null_space` that will be asked for; None: `null_space` is not needed.
        with_values: whether `inverse`, the reciprocals of the singular values, is needed: a `TruncatedPseudoinverse` has it.
    """
    found = FactoredPseudoinverse.of(D, tol, free is not None) if min(D.shape) > FEW_ROWS and not with_values else None
    if found is not None and free in (None, D.shape[1] - found.rank):
        return found
    return TruncatedPseudoinverse.of(D, tol, full=free is not None)


def has_independent_rows(D: np.ndarray, tol: float) -> bool:
    """Return True if the rows of a large matrix are known to be independent; those of a small one are not examined."""
    found = FactoredPseudoinverse.of(D, tol) if min(D.shape) > FEW_ROWS else None
    return found is not None and found.rank == len(D)
