"""Computations with sparse matrices A by a factorization of A A^T: corrections, the null space, and the smallest singular values.

All singular values of a dense (m, n) matrix cost O(m n min(m, n)). The Jacobian of a large mechanism is sparse, and only its
smallest singular values are of interest: block inverse iteration takes a few solves with a sparse factorization. Each value is
then computed as |A^T u|, so that squaring A does not lose digits.
"""

from typing import Any, TypeAlias

import numpy as np
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import eigsh, splu

SparseMatrix: TypeAlias = Any  # SciPy's type stubs lack the shape

_SYMMETRIC: dict[str, Any] = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}, "diag_pivot_thresh": 0.0}
SPARE_VECTORS = 3  # vectors of a block beyond those wanted, which speed up convergence
MOST_ITERATIONS = 100  # of a block; five are usual
VALUE_TOL = 8 * float(np.finfo(float).eps)  # change of a value, relative to the largest, that is rounding
LARGEST_TOL = 1e-6  # of the vector of the largest singular value: the error of the value is the square


def factor_gram(A: SparseMatrix, damping: float = 0.0) -> Any:
    """Return a factorization of A A^T + damping I, whose method `solve` takes a vector, or a matrix of right-hand sides."""
    gram = A @ A.T
    return splu(csc_array(gram + damping * eye_array(A.shape[0]) if damping else gram), **_SYMMETRIC)


class SmallSingularValues:
    """The smallest singular values of a sparse matrix: all that count as zero, and at least one that does not.

    Args:
        A: matrix (m, n), in compressed sparse rows.
        tol: values up to this fraction of the largest count as zero.
        start: left singular vectors of a similar matrix, (m, k), from which fewer iterations are needed.

    Attributes:
        values: the singular values (k,), in ascending order.
        vectors: their left singular vectors (m, k).
        zero_count: the number of values that count as zero.
    """

    def __init__(self, A: SparseMatrix, tol: float, start: np.ndarray | None = None):
        self._A, self._tol = A, tol
        self._rows = A.shape[0]
        squares, *sums = (np.asarray(x) for x in (A.multiply(A).sum(axis=1), abs(A).sum(axis=0), abs(A).sum(axis=1)))
        lengths, (across, down) = np.sqrt(squares), (float(x.max(initial=0.0)) for x in sums)
        self._bounds = float(lengths.max(initial=0.0)), float(np.sqrt(across * down))  # of the largest singular value
        self._damping = (tol * self._bounds[1]) ** 2
        self._largest: float | None = None
        self.values, self.vectors = self._iterate(start)
        self.zero_count = self._count_zeros(self.values)

    @property
    def largest(self) -> float:
        """The largest singular value."""
        if self._largest is None:
            A = self._A
            tol: Any = LARGEST_TOL  # an int according to SciPy's type stubs
            square = eigsh(A @ A.T, k=1, v0=np.ones(self._rows), tol=tol, return_eigenvectors=False)
            self._largest = float(np.sqrt(square[0]))
        return self._largest

    @property
    def left(self) -> np.ndarray:
        """An orthonormal basis of the left null space (m, zeros): combinations of rows that vanish."""
        return self.vectors[:, : self.zero_count]

    def null_space_part(self, x: np.ndarray) -> np.ndarray:
        """Return the part of a vector in the null space of A."""
        factor = factor_gram(self._A, self._damping)  # not stored: there may be hundreds of matrices
        for _ in range(2):
            x = x - self._A.T @ factor.solve(self._A @ x)
        return x

    def _count_zeros(self, values: np.ndarray) -> int:
        low, high = self._tol * self._bounds[0], self._tol * self._bounds[1]
        zero = self._tol * self.largest if np.any((values > low) & (values <= high)) else low
        return int(np.sum(values <= zero))

    def _iterate(self, start: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the smallest values in ascending order, at least one of them nonzero, and their left singular vectors (m, k)."""
        random, rows, factor = np.random.default_rng(0), self._rows, factor_gram(self._A, self._damping)
        X = random.standard_normal((rows, min(rows, 1 + SPARE_VECTORS))) if start is None else start
        while True:
            values, X, converged = self._iterate_block(factor, X)
            wanted = self._count_zeros(values) + 1
            if 2 * wanted > rows or not converged:  # many: the dense factorization is as fast
                u, values, _ = np.linalg.svd(self._A.toarray())
                return np.pad(values, (0, rows - len(values)))[::-1], u[:, ::-1]
            if wanted + SPARE_VECTORS <= X.shape[1]:
                return values, X
            X = np.concatenate([X, random.standard_normal((rows, min(rows, 2 * wanted + SPARE_VECTORS) - X.shape[1]))], axis=1)

    def _iterate_block(self, factor: Any, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        values = np.full(X.shape[1], np.inf)
        for _ in range(MOST_ITERATIONS):
            X, before = np.linalg.qr(factor.solve(X))[0], values
            image = (self._A.T @ X).T
            turn, values, _ = np.linalg.svd(image, full_matrices=image.shape[0] > image.shape[1])
            X, values = X @ turn[:, ::-1], np.pad(values, (0, len(turn) - len(values)))[::-1]
            wanted = self._count_zeros(values) + 1
            if np.all(np.abs(values - before)[:wanted] <= VALUE_TOL * self._bounds[1]):
                return values, X, True
        return values, X, False
