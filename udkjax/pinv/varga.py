"""D^+ by two QR factorizations: a complete orthogonal decomposition."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.pinv.householder import pivoted_qr
from udkjax.pinv.orthogonal import Orthogonal, OrthogonalFactors, divide


class Varga(Orthogonal):
    """D = Q R with column pivoting, then R^T = Z U: D = Q U^T Z^T and D^+ = Z U^(-T) Q^T.

    Without pivoting the small entries of R would not come last, and R would not reveal the rank. The threshold applies to the
    diagonal of R, relative to the largest column norm.

    The error is of the order of eps cond(D): all transformations are orthogonal.
    """

    def factor(self, D: Float[Array, "m n"]) -> OrthogonalFactors:
        q, r, _, rank = pivoted_qr(D, self.threshold(D, jnp.linalg.norm(D, axis=0).max()))
        z, u, order, _ = pivoted_qr(r.T, jnp.zeros((), D.dtype))  # rank already decided: drop only zero rows
        return OrthogonalFactors(divide(u[:, order], z.T, rank).T, q[:, order], rank)
