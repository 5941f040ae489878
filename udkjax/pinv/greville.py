"""D^+ by Greville's recursion, one row at a time."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udkjax.pinv.elimination import default_rank_tol
from udkjax.pinv.rule import Dense, dot, exceeds


class GrevilleFactors(NamedTuple):
    """D^+ itself, and the rank of D."""

    plus: Float[Array, "n m"]
    rank: Int[Array, ""]


class Greville(Dense):
    """D^+ by Greville's recursion.

    With P = D_k^+ of the first k rows D_k, the pseudoinverse of these and the next row a^T is [P - p d^T, p], where d^T = a^T P,
    c^T = a^T - d^T D_k and

        p = c / (c^T c)            if c is not zero: a is independent of the rows before it,
        p = P d / (1 + d^T d)      if c is zero.

    (T. N. E. Greville, SIAM Review 2 (1960) 15, for columns.) The threshold applies to |c|, relative to the largest row norm.

    The error is of the order of eps cond(D)^2, because the error of P, eps cond(D) |P|, enters c. The remainder of a dependent
    row is of this order too, while that of an independent row may be as small as 1/cond(D). Hence the default `rank_tol`
    eps^(1/3), where the two are equal; beyond cond(D) = eps^(-1/3) no threshold is right. A dependent row mistaken for
    independent can make the result wrong by any factor. Rows are taken in their order: cond(D) here is the largest condition
    number of the first k rows for any k. It is large also if the first rows are nearly dependent and later ones restore the rank.
    """

    def factor(self, D: Float[Array, "m n"]) -> GrevilleFactors:
        rows, columns = D.shape
        threshold = self.threshold(D, jnp.linalg.norm(D, axis=1).max(), default=default_rank_tol(D.dtype))

        def append(state, row):
            plus, rank = state
            a, e = row  # the row of D, and its unit vector
            d = dot(a, plus)
            c = a - dot(d, D)  # d is zero from this row on, as are the columns of plus
            independent = exceeds(jnp.linalg.norm(c), threshold)
            cc = jnp.where(independent, dot(c, c), 1)
            p = jnp.where(independent, c / cc, dot(plus, d) / (1 + dot(d, d)))
            return (plus + jnp.outer(p, e - d), rank + independent), None

        start = jnp.zeros((columns, rows), D.dtype), jnp.array(0)
        (plus, rank), _ = jax.lax.scan(append, start, (D, jnp.eye(rows, dtype=D.dtype)))
        return GrevilleFactors(plus, rank)

    def apply(self, factors: GrevilleFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.plus, b)

    def apply_transpose(self, factors: GrevilleFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.plus.T, c)
