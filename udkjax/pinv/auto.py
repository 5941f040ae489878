"""The default: elimination where it is safe, singular values where it is not."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.pinv.elimination import Elimination
from udkjax.pinv.rule import Dense, number
from udkjax.pinv.svd import SVD, Factors

# A pivot relative to the diagonal entry of its row is the square of a distance from dependence, and elimination loses its digits
# by the reciprocal: 1e-6 leaves ten. Crossing singular configurations goes as well with 1e-5 and with 1e-7; singular values are
# needed the more often, the larger it is.
BRANCH_TOL = 1e-6


class Auto(Dense):
    """`Elimination` while every pivot stays above `branch_tol` times its row's diagonal entry of D D^T, else the truncated `SVD`.

    The branch is a real one in a single solve and under `lax.map`; under `vmap` both sides run.
    """

    branch_tol: Float[Array, ""] | None = eqx.field(converter=number, default=BRANCH_TOL)

    @property
    def exact(self) -> SVD:
        """The method of the careful side."""
        return SVD(self.rank_tol, self.relative)

    def factor(self, D: Float[Array, "m n"]) -> Factors:
        wide = D.shape[0] <= D.shape[1]
        fast = Elimination().factor(D if wide else D.T)
        safe = (fast.rank == min(D.shape)) & (fast.smallest > jnp.asarray(self.branch_tol))

        def eliminated() -> Factors:
            # the same triple product as that of the singular values: D^+ = D^T ((L L^T)^-1), or its transpose
            square = Elimination().apply(fast, jnp.eye(len(fast.D), dtype=D.dtype))
            ones = jnp.ones(min(D.shape), D.dtype)
            identity = jnp.eye(min(D.shape), dtype=D.dtype)
            u, v = (identity, square) if wide else (square, identity)
            return Factors(u, ones, v, fast.rank)

        return jax.lax.cond(safe, eliminated, lambda: self.exact.factor(D))

    def apply(self, factors: Any, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.exact.apply(factors, b)

    def apply_transpose(self, factors: Any, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self.exact.apply_transpose(factors, c)
