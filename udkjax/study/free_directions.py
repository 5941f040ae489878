"""The directions in which joints let a mechanism move: the null space of their Jacobian."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.equations.scales import RANK_TOL
from udkjax.pinv import SVD


def free_part(J: Float[Array, "m n"]) -> Callable[[Array], Array]:
    """Return x -> (I - J^+ J) x for vectors (n,) or columns (n, k): what no row of J sees; differentiable."""
    if not len(J):
        return lambda x: x
    plus = SVD(RANK_TOL).plus(J)
    return lambda x: x - plus @ (J @ x)


def null_space(J: Float[Array, "m n"], free: int) -> Float[Array, "n free"]:
    """Return an orthonormal basis N of `free` directions with J N = 0: right singular vectors of the smallest singular values.

    Without derivatives: those of what is made with it follow where it is projected by `free_part`.
    """
    J = jax.lax.stop_gradient(J)
    n = J.shape[1]
    if not len(J):
        return jnp.eye(n)
    return jnp.linalg.svd(J, full_matrices=True)[2][n - free :].T


def symmetric(A: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Return (A + A^T) / 2."""
    return 0.5 * (A + A.T)
