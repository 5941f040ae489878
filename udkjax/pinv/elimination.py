"""Elimination: D^+ from the triangular factors of D D^T. Fast, and as accurate as cond(D)^2 allows.

For a matrix whose entries may all be nonzero the factors are those of Courrieu (Neural Information Processing 8 (2005) 25):
D D^T = L L^T with as many columns in L as the rank, from which D^+ = D^T L (L^T L)^-1 (L^T L)^-1 L^T for any rank.
A sparse matrix with independent rows takes straight-line code (sparse.py).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from udkjax.pinv.rule import Dense, Pseudoinverse, beyond, dot, number
from udkjax.pinv.sparse import Pattern, program


class Factors(NamedTuple):
    """L, as Courrieu takes it, and what else D^+ is made of."""

    D: Float[Array, "m n"]
    columns: Float[Array, "m r"]  # L, with a zero column for each dropped pivot
    inverse: Float[Array, "r r"]  # (L^T L)^-1, with a one for each dropped pivot
    rank: Int[Array, ""]
    smallest: Float[Array, ""]  # the smallest pivot that was kept, relative to its diagonal entry


class Elimination(Dense):
    """Eliminate D D^T in the order of its rows; a pivot whose square root is below the threshold is dropped.

    Errors grow as eps cond(D)^2. The default threshold is therefore sqrt(max(m, n) eps): a smaller pivot is rounding error.
    """

    def factor(self, D: Float[Array, "m n"]) -> Factors:
        gram = dot(D, D.T)
        diagonal = jnp.diagonal(gram)
        m = len(gram)
        rows = jnp.arange(m)
        if self.rank_tol is None:
            threshold = max(D.shape) * jnp.finfo(D.dtype).eps * jnp.max(diagonal)
        else:
            threshold = self.threshold(D, jnp.sqrt(jnp.max(diagonal))) ** 2

        def column(j, carry):
            left, L, kept, smallest = carry
            pivot = left[j, j]
            keep = beyond(pivot, threshold)
            root = jnp.sqrt(jnp.where(keep, pivot, 1.0))
            entry = jnp.where(keep & (rows >= j), left[:, j] / root, 0.0)
            ratio = jnp.where(keep, pivot / diagonal[j], smallest)
            return left - entry[:, None] * entry, L.at[:, j].set(entry), kept.at[j].set(keep), jnp.minimum(smallest, ratio)

        start = (gram, jnp.zeros_like(gram), jnp.zeros(m, bool), jnp.ones((), D.dtype))
        _, L, kept, smallest = jax.lax.fori_loop(0, m, column, start)
        inner = dot(L.T, L) + jnp.diag(jnp.where(kept, 0.0, 1.0).astype(D.dtype))
        identity = jnp.eye(m, dtype=D.dtype)
        inverse = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(inner), True), identity)
        return Factors(D, L, inverse, jnp.sum(kept), smallest)

    def apply(self, factors: Factors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.D.T, _square(factors, b))

    def apply_transpose(self, factors: Factors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return _square(factors, dot(factors.D, c))


def _square(factors: Factors, b: Float[Array, "m"]) -> Float[Array, "m"]:
    """(D D^T)^+ b."""
    L, inverse = factors.columns, factors.inverse
    return dot(L, dot(inverse, dot(inverse, dot(L.T, b))))


class SparseFactors(NamedTuple):
    """The triangular factors of D D^T as the straight-line code wants them, and D."""

    values: Float[Array, "s"]
    lower: Float[Array, "l"]
    rank: Int[Array, ""]


class SparseElimination(Pseudoinverse):
    """Elimination of independent rows whose pattern is known: the operator is the vector of the pattern's values.

    `rank_tol` compares lengths, what remains of a row with the row itself. Rows that turn out dependent are dropped: D^+ b then
    solves the rows kept, which is the pseudoinverse of all of them where they are consistent.
    """

    pattern: Pattern = eqx.field(static=True, default=Pattern((0, 0), ()))

    def __init__(self, pattern: Pattern, rank_tol: ArrayLike = 1e-8):  # the root of eps: a smaller remainder of a row is rounding
        self.rank_tol, self.relative, self.pattern = number(rank_tol), True, pattern

    def admit(self, D: Any) -> Any:
        return jnp.asarray(D)

    def shape(self, D: Any) -> tuple[int, int]:
        return self.pattern.shape

    def matvec(self, D, x):
        return self.pattern.matvec(D, x)

    def rmatvec(self, D, y):
        return self.pattern.rmatvec(D, y)

    def factor(self, D: Float[Array, "s"]) -> SparseFactors:
        lower, kept = program(self.pattern).factor(D, self.rank_tol)
        return SparseFactors(D, lower, jnp.sum(kept))

    def apply(self, factors: SparseFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.pattern.rmatvec(factors.values, self._square(factors, b))

    def apply_transpose(self, factors: SparseFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self._square(factors, self.pattern.matvec(factors.values, c))

    def _square(self, factors: SparseFactors, b: Float[Array, "m"]) -> Float[Array, "m"]:
        return program(self.pattern).solve(factors.lower, b)
