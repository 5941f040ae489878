"""D^+ by two QR factorizations: a complete orthogonal decomposition."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.pinv.householder import pivoted_qr
from udkjax.pinv.orthogonal import Orthogonal, OrthogonalFactors, divide


class Varga(Orthogonal):
    """D = Q R with column pivoting, then R^T = Z U: D = Q U^T Z^T and D^+ = Z U^(-T) Q^T.

    Without pivoting the small entries of R would not be last, and the rank could not be read from it. The threshold is on
    the diagonal of R, its scale the largest column norm.

    Error of the order of eps cond(D): orthogonal transformations only.
    """

    def factor(self, D: Float[Array, "m n"]) -> OrthogonalFactors:
        q, r, _, rank = pivoted_qr(D, self.threshold(D, jnp.linalg.norm(D, axis=0).max()))
        z, u, order, _ = pivoted_qr(r.T, jnp.zeros((), D.dtype))  # the rank is decided: leave out zero rows only
        return OrthogonalFactors(divide(u[:, order], z.T, rank).T, q[:, order], rank)
