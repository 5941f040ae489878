"""User-defined pseudoinverses: one method returns D^+ as a matrix."""

from abc import abstractmethod
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from udkjax.pinv.rule import Dense, dot


class MatrixFactors(NamedTuple):
    """D^+ itself, and the rank of D, the trace of the projector D^+ D."""

    plus: Float[Array, "n m"]
    rank: Int[Array, ""]


class MatrixPseudoinverse(Dense):
    """Base of pseudoinverses of your own: override `matrix`, which returns D^+.

    `matrix` is written in jax.numpy, and never differentiated: all pseudoinverses share one rule of derivatives. Arithmetic,
    products, reductions, indexing, linear systems, decompositions (`pinv`, `svd`, `qr`, `eigh`), sorting, loops and branches
    become machine code. With other operations, such as `jax.scipy.linalg.schur`, or with array fields, runs are integrated by
    diffrax, with the equations in plain JAX.
    `self.threshold(D, scale)` is the threshold of the rank, as chosen by `rank_tol` and `relative`.
    """

    @abstractmethod
    def matrix(self, D: Float[Array, "m n"]) -> Float[Array, "n m"]:
        """Return D^+, the Moore-Penrose pseudoinverse.

        Args:
            D: a real matrix (m, n).

        Returns:
            Its pseudoinverse (n, m).
        """

    def factor(self, D: Float[Array, "m n"]) -> MatrixFactors:
        plus = self.matrix(D)
        return MatrixFactors(plus, jnp.round(jnp.sum(plus * D.T)).astype(int))

    def apply(self, factors: MatrixFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return dot(factors.plus, b)

    def apply_transpose(self, factors: MatrixFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return dot(factors.plus.T, c)
