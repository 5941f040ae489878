"""The common part of the methods by QR: D^+ = Z Q^T with Z and Q of static shape, whatever the rank."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udkjax.pinv.rule import Dense, dot


class PivotedQR(NamedTuple):
    """D = Q R with k = min(m, n): R[:, order] is upper triangular, with a diagonal of decreasing magnitude.

    From `rank` on, the columns of Q and the rows of R are zero; in `complete_qr` Q and R are whole.
    """

    q: Float[Array, "m k"]
    r: Float[Array, "k n"]
    order: Int[Array, "k"]
    rank: Int[Array, ""]


class OrthogonalFactors(NamedTuple):
    """The factors Z and Q of D^+ = Z Q^T, and the rank of D."""

    z: Float[Array, "n k"]
    q: Float[Array, "m k"]
    rank: Int[Array, ""]


class Orthogonal(Dense):
    """A method by QR, D^+ = Z Q^T: one of the factors Z and Q already contains the inverse of the triangle."""

    def apply(self, factors: OrthogonalFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.z, dot(factors.q.T, b))

    def apply_transpose(self, factors: OrthogonalFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.q, dot(factors.z.T, c))


def divide(t: Float[Array, "k k"], b: Float[Array, "k s"], rank: Int[Array, ""]) -> Float[Array, "k s"]:
    """Return T^(-1) times the first `rank` rows of b, followed by rows of zeros; T is the leading triangle of t of size `rank`.

    (LAPACK is avoided: two concurrent batched calls deadlock jax 0.10 on a machine with two cores.)
    """
    size = len(t)

    def substitute(step, x):
        i = size - 1 - step
        inside = i < rank
        row = (b[i] - dot(t[i], x)) / jnp.where(inside, t[i, i], 1)  # x is still zero up to row i
        return x.at[i].set(jnp.where(inside, row, 0))

    return jax.lax.fori_loop(0, size, substitute, jnp.zeros_like(b))
