"""What the methods by QR share: D^+ = Z T^(-1) Q^T with a triangle T of static shape, whatever the rank."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from udkjax.pinv.rule import Dense, dot


class PivotedQR(NamedTuple):
    """D = Q R with k = min(m, n): R[:, order] is upper triangular with a falling diagonal. From `rank` on, Q and R are zero."""

    q: Float[Array, "m k"]
    r: Float[Array, "k n"]
    order: Int[Array, "k"]
    rank: Int[Array, ""]


class Factors(eqx.Module):
    """D^+ = Z T^(-1) Q^T. Z and Q are zero from column `rank` on, T is the unit matrix there."""

    z: Float[Array, "n k"]
    t: Float[Array, "k k"]
    q: Float[Array, "m k"]
    rank: Int[Array, ""]
    lower: bool = eqx.field(static=True)


class Triangular(Dense):
    """A method whose factors are Z, T and Q."""

    def apply(self, factors: Factors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.z, solve_triangular(factors.t, dot(factors.q.T, b), lower=factors.lower))

    def apply_transpose(self, factors: Factors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.q, solve_triangular(factors.t, dot(factors.z.T, c), lower=factors.lower, trans=1))


def leading(t: Float[Array, "k k"], rank: Int[Array, ""]) -> Float[Array, "k k"]:
    """The leading triangle of size `rank`, continued by the unit matrix: always invertible, and no shape depends on the rank."""
    inside = jnp.arange(len(t)) < rank
    return jnp.where(inside[:, None] & inside[None, :], t, jnp.eye(len(t), dtype=t.dtype))
