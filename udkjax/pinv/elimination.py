"""Elimination: D^+ from the triangular factors of D D^T. Fast, and as accurate as cond(D)^2 allows.

A row that depends on earlier rows has a pivot of rounding size and is dropped. With K the retained rows and L the factor, D = C
D_K for C = L L_K^(-1), which has a unit row for each retained row, so

    D^+ = D_K^+ C^+ = D_K^T (L_K L_K^T)^(-1) (C^T C)^(-1) C^T.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.pinv.rule import Dense, dot, exceeds


def default_rank_tol(dtype: np.dtype) -> float:
    """Return eps^(1/3), the default rank tolerance of elimination.

    The remainder of a row counts as a rounding error if its length is at most this fraction of the length of the row.
    """
    return float(jnp.finfo(dtype).eps) ** (1 / 3)


class EliminationFactors(NamedTuple):
    """D and S, with D^+ = D^T S, and the rank of D."""

    D: Float[Array, "m n"]
    S: Float[Array, "m m"]
    rank: Int[Array, ""]


class Elimination(Dense):
    """D^+ by elimination of D D^T, the largest pivot first. A row whose pivot has a root up to the threshold is dropped.

    With `relative=True` the root is compared with the length of its own row: very different sizes of rows, as with very different
    masses, do no harm. Errors grow as eps cond(D)^2. The default threshold is eps^(1/3): rounding errors of a dependent row are
    well below it, and pivots below it have lost most of their digits.
    """

    def factor(self, D: Float[Array, "m n"]) -> EliminationFactors:
        gram = dot(D, D.T)
        length = jnp.sqrt(jnp.diagonal(gram))
        unit = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
        tol = default_rank_tol(D.dtype) if self.rank_tol is None else self.rank_tol
        threshold = tol if self.relative else tol * unit
        L, independent, order = _cholesky(gram * unit[:, None] * unit, jnp.broadcast_to(threshold**2, unit.shape))
        L = length[:, None] * L
        L = L[order]
        dropped = jnp.diag((~independent).astype(D.dtype))
        inverse = _inverse(jnp.where(independent[:, None], L, 0.0) + dropped)  # L_K^(-1)
        C = dot(L, inverse)
        inner, _, inner_order = _cholesky(dot(C.T, C) + dropped, jnp.zeros(len(gram)))
        inner = _inverse(inner[inner_order])[:, jnp.argsort(inner_order)]
        S = jnp.where(independent[:, None], dot(inverse.T, dot(inverse, dot(inner.T, dot(inner, C.T)))), 0.0)
        original = jnp.argsort(order)
        return EliminationFactors(D, S[original][:, original], jnp.sum(independent))

    def apply(self, factors: EliminationFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        x = dot(factors.D.T, dot(factors.S, b))
        return x + dot(factors.D.T, dot(factors.S, b - dot(factors.D, x)))  # refined once: S was made of explicit inverses

    def apply_transpose(self, factors: EliminationFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        y = dot(factors.S.T, dot(factors.D, c))
        return y + dot(factors.S.T, dot(factors.D, c - dot(factors.D.T, y)))


def _cholesky(
    gram: Float[Array, "m m"], threshold: Float[Array, "m"]
) -> tuple[Float[Array, "m m"], Bool[Array, "m"], Int[Array, "m"]]:
    """Factorize gram = L L^T, with the largest remaining pivot at each step.

    Args:
        gram: a symmetric, positive semidefinite matrix.
        threshold: for each row, the pivot at or below which the row is dropped.

    Returns:
        L, where L[order] is lower triangular and the column of a dropped pivot is zero; a mask of the steps whose pivots exceed
        their thresholds; and `order`, the row that is eliminated at each step.
    """
    m = len(gram)

    def column(k, carry):
        schur, L, independent, order, waiting = carry
        j = jnp.argmax(jnp.where(waiting, jnp.diagonal(schur), -jnp.inf))
        is_independent = exceeds(schur[j, j], threshold[j])
        root = jnp.sqrt(jnp.where(is_independent, schur[j, j], 1.0))
        entry = jnp.where(is_independent & waiting, schur[:, j] / root, 0.0)
        schur = schur - entry[:, None] * entry
        return schur, L.at[:, k].set(entry), independent.at[k].set(is_independent), order.at[k].set(j), waiting.at[j].set(False)

    start = (gram, jnp.zeros_like(gram), jnp.zeros(m, bool), jnp.zeros(m, int), jnp.ones(m, bool))
    return jax.lax.fori_loop(0, m, column, start)[1:4]


def _inverse(T: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return T^(-1) of a lower triangular T, row by row."""
    identity = jnp.eye(len(T), dtype=T.dtype)
    return jax.lax.fori_loop(0, len(T), lambda j, X: X.at[j].set((identity[j] - dot(T[j], X)) / T[j, j]), jnp.zeros_like(T))
