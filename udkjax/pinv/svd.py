"""D^+ by the truncated singular value decomposition."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udkjax.pinv.rule import Dense, dot, exceeds


class SVDFactors(NamedTuple):
    """The factors of D^+ = V S^+ U^T, and the rank of D."""

    u: Float[Array, "m k"]
    inverse: Float[Array, "k"]  # 1/sigma, zero where truncated
    v: Float[Array, "n k"]
    rank: Int[Array, ""]


class SVD(Dense):
    """D = U S V^T, D^+ = V S^+ U^T: the reference, and the only method whose threshold applies to the singular values themselves.

    The error is of the order of eps cond(D), with cond(D) of the retained singular values.
    """

    def factor(self, D: Float[Array, "m n"]) -> SVDFactors:
        u, sigma, vt = jnp.linalg.svd(D, full_matrices=False)
        significant = exceeds(sigma, self.threshold(D, sigma[0]))
        return SVDFactors(u, jnp.where(significant, 1 / jnp.where(significant, sigma, 1), 0), vt.T, significant.sum())

    def apply(self, factors: SVDFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.v, factors.inverse * dot(factors.u.T, b))

    def apply_transpose(self, factors: SVDFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.u, factors.inverse * dot(factors.v.T, c))
