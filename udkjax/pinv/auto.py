"""The default: elimination where it is safe, singular values where it is not."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from udkjax.pinv.rule import Dense, Plus, dot, number
from udkjax.pinv.svd import SVD, SVDFactors

# Pivot relative to the diagonal entry of its row: the square of a distance from dependence. Elimination amplifies rounding errors
# by its reciprocal: with 1e-6, ten digits remain. Singular configurations are crossed equally well with 1e-5 and with 1e-7; the
# larger the value, the more often singular values are needed.
BRANCH_TOL = 1e-6
NEAREST = BRANCH_TOL**0.5  # the distance from dependence below which elimination is not used


class Auto(Dense):
    """Elimination where the rows are known to be independent, else the truncated `SVD`.

    Machine code eliminates the rows of a mechanism that `analyse` found independent, until a pivot falls to `branch_tol` times
    its row's diagonal entry of D D^T: near singular configurations a step uses all rows and drops the dependent ones. For a
    general matrix, of whose rows nothing is known, the method is the `SVD`.

    Args:
        branch_tol: the pivot, relative to its row's diagonal entry of D D^T, at or below which singular values are used.
    """

    branch_tol: Float[Array, ""] | None = eqx.field(converter=number, default=BRANCH_TOL)

    @property
    def rank_revealing(self) -> SVD:
        """The method used near singular configurations."""
        return SVD(self.rank_tol, self.relative)

    def factor(self, D: Float[Array, "m n"]) -> SVDFactors:
        return self.rank_revealing.factor(D)

    def apply(self, factors: SVDFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.rank_revealing.apply(factors, b)

    def apply_transpose(self, factors: SVDFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self.rank_revealing.apply_transpose(factors, c)


class RowFactors(NamedTuple):
    """D^+ = U^T (L L^T)^(-1) W, with unit rows U = W D; or `plus`, where rows are too close to dependence."""

    rows: Float[Array, "m n"]  # of D, those that are used
    used: Bool[Array, "m"]
    unit: Float[Array, "m"]  # the diagonal of W
    L: Float[Array, "m m"]
    safe: Bool[Array, ""]  # whether these factors are accurate
    plus: Float[Array, "n m"]
    rank: Int[Array, ""]


class Pending(NamedTuple):
    """The state of a loop that is run once or not at all, as a `cond` of a batch is not.

    XLA moves what does not change in a loop out of it, where it would always be computed: so the matrix changes.
    """

    factors: RowFactors
    matrix: Float[Array, "m n"]
    done: Bool[Array, ""]


class AutoOfRows(Auto):
    """`Auto` in JAX, for matrices of which some rows are known to depend on the others wherever these are independent.

    D D^T without these rows is factorized by Cholesky. If one of its pivots is at most `branch_tol` times its row's diagonal
    entry, the singular values of all rows are used. In a batch they are computed only when a member needs them.

    Args:
        dispensable: indices of the rows that depend on the others.
    """

    dispensable: tuple[int, ...] = eqx.field(static=True, default=())

    def plus(self, D: Float[Array, "m n"]) -> Plus:
        """Return D^+ as an operator; derivatives are those of the rows that are used."""
        plus = super().plus(D)
        return Plus(plus.method, plus.factors, plus.matrix * plus.factors.used[:, None])  # pyright: ignore

    def factor(self, D: Float[Array, "m n"]) -> RowFactors:
        kept = np.ones(len(D), bool)
        kept[list(self.dispensable)] = False
        rows = jnp.where(kept[:, None], D, 0.0)
        length = jnp.linalg.norm(rows, axis=1)
        unit = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
        scaled = unit[:, None] * rows
        L = jnp.linalg.cholesky(dot(scaled, scaled.T) + jnp.diag(jnp.asarray(~kept, D.dtype)))
        # With a smaller pivot, a solution would have less than half of the digits.
        least = jnp.maximum(jnp.asarray(self.branch_tol, D.dtype), float(jnp.finfo(D.dtype).eps) ** 0.5)
        safe = jnp.all(jnp.diagonal(L) ** 2 > least)  # not if NaN
        start = RowFactors(rows, jnp.asarray(kept), unit, L, safe, jnp.zeros(D.T.shape, D.dtype), jnp.sum(kept))

        def by_singular_values(state: Pending) -> Pending:
            svd = self.rank_revealing.factor(state.matrix)
            plus, used = dot(svd.v * svd.inverse, svd.u.T), jnp.ones_like(state.factors.used)
            factors = state.factors._replace(rows=state.matrix, used=used, plus=plus, rank=svd.rank)
            return Pending(factors, jnp.zeros_like(D), jnp.array(True))

        return jax.lax.while_loop(lambda state: ~state.done, by_singular_values, Pending(start, D, safe)).factors

    def apply(self, factors: RowFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return _refined(lambda b: self._plus(factors, b), lambda x: dot(factors.rows, x), b)

    def apply_transpose(self, factors: RowFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return _refined(lambda c: self._plus_transpose(factors, c), lambda y: dot(factors.rows.T, y), c)

    def _plus(self, factors: RowFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        x = dot(factors.rows.T, factors.unit * _solve(factors.L, factors.unit * b))
        return jnp.where(factors.safe, x, dot(factors.plus, b))

    def _plus_transpose(self, factors: RowFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        y = factors.unit * _solve(factors.L, factors.unit * dot(factors.rows, c))
        return jnp.where(factors.safe, y, dot(factors.plus.T, c))


def _solve(L: Float[Array, "m m"], b: Float[Array, "m"]) -> Float[Array, "m"]:
    return jax.scipy.linalg.cho_solve((L, True), b)


def _refined(inverse: Callable[[Array], Array], product: Callable[[Array], Array], b: Array) -> Array:
    """Return the solution x of D x = b with its residual's added: the condition of D D^T is the square of that of D."""
    x = inverse(b)
    return x + inverse(b - product(x))
