"""Elimination: D^+ from the triangular factors of D D^T. Fast, and as accurate as cond(D)^2 allows.

Rows that depend on those before them show by a pivot of rounding errors and are dropped. With K the rows kept and L the factor,
D = C D_K for C = L L_K^(-1), which holds a unit row for each row kept, so

    D^+ = D_K^+ C^+ = D_K^T (L_K L_K^T)^(-1) (C^T C)^(-1) C^T.

A sparse matrix with independent rows takes straight-line code (sparse.py).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.pinv.rule import Dense, Pseudoinverse, beyond, dot, number
from udkjax.pinv.sparse import Pattern, program


class Factors(NamedTuple):
    """D and S, with D^+ = D^T S."""

    D: Float[Array, "m n"]
    S: Float[Array, "m m"]
    rank: Int[Array, ""]


class Elimination(Dense):
    """Eliminate D D^T by its largest pivots; a pivot whose square root is at most the threshold is dropped.

    Errors grow as eps cond(D)^2. The default threshold is eps^(1/3) of the longest row, as Greville's: what rounding leaves of a
    dependent row stays well below it, and what lies below it has lost most of its digits.
    """

    def factor(self, D: Float[Array, "m n"]) -> Factors:
        gram = dot(D, D.T)
        largest = jnp.max(jnp.diagonal(gram))
        if self.rank_tol is None:
            threshold = float(jnp.finfo(D.dtype).eps) ** (2 / 3) * largest
        else:
            threshold = self.threshold(D, jnp.sqrt(largest)) ** 2
        L, kept, order = _cholesky(gram, threshold)
        L = L[order]
        dropped = jnp.diag((~kept).astype(D.dtype))
        inverse = _inverse(jnp.where(kept[:, None], L, 0.0) + dropped)  # of L_K
        C = dot(L, inverse)
        inner, _, again = _cholesky(dot(C.T, C) + dropped, 0.0)
        inner = _inverse(inner[again])[:, jnp.argsort(again)]
        both = jnp.where(kept[:, None], dot(inverse.T, dot(inverse, dot(inner.T, dot(inner, C.T)))), 0.0)
        back = jnp.argsort(order)
        return Factors(D, both[back][:, back], jnp.sum(kept))

    def apply(self, factors: Factors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.D.T, dot(factors.S, b))

    def apply_transpose(self, factors: Factors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.S.T, dot(factors.D, c))


def _cholesky(gram: Float[Array, "m m"], threshold: Any) -> tuple[Float[Array, "m m"], Bool[Array, "m"], Int[Array, "m"]]:
    """L with L L^T = gram, always by the largest pivot left; which pivots exceed the threshold; and the order of the rows.

    L[order] is a lower triangle. A pivot that does not count leaves a zero column.
    """
    m = len(gram)

    def column(k, carry):
        left, L, kept, order, waiting = carry
        j = jnp.argmax(jnp.where(waiting, jnp.diagonal(left), -jnp.inf))
        keep = beyond(left[j, j], threshold)
        root = jnp.sqrt(jnp.where(keep, left[j, j], 1.0))
        entry = jnp.where(keep & waiting, left[:, j] / root, 0.0)
        left = left - entry[:, None] * entry
        return left, L.at[:, k].set(entry), kept.at[k].set(keep), order.at[k].set(j), waiting.at[j].set(False)

    start = (gram, jnp.zeros_like(gram), jnp.zeros(m, bool), jnp.zeros(m, int), jnp.ones(m, bool))
    return jax.lax.fori_loop(0, m, column, start)[1:4]


def _inverse(T: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """T^(-1) of a lower triangle, by rows."""
    identity = jnp.eye(len(T), dtype=T.dtype)
    return jax.lax.fori_loop(0, len(T), lambda j, X: X.at[j].set((identity[j] - dot(T[j], X)) / T[j, j]), jnp.zeros_like(T))


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
