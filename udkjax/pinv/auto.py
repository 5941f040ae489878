"""The default: elimination where it is safe, singular values where it is not."""

import equinox as eqx
from jaxtyping import Array, Float

from udkjax.pinv.rule import Dense, number
from udkjax.pinv.svd import SVD, SVDFactors

# A pivot relative to the diagonal entry of its row is the square of a distance from dependence, and elimination loses its digits
# by the reciprocal: 1e-6 leaves ten. Crossing singular configurations goes as well with 1e-5 and with 1e-7; singular values are
# needed the more often, the larger it is.
BRANCH_TOL = 1e-6


class Auto(Dense):
    """Elimination where the rows are known to be independent, else the truncated `SVD`.

    Machine code eliminates the rows of a mechanism that `analyse` found independent, until one of the pivots falls to
    `branch_tol` times its row's diagonal entry of D D^T: steps beside singular configurations are taken with all rows, of which
    those are dropped that depend on others. For a matrix of which nothing is known, and with diffrax, it is the `SVD`.

    Args:
        branch_tol: the pivot, relative to its row's diagonal entry of D D^T, at which it turns to singular values.
    """

    branch_tol: Float[Array, ""] | None = eqx.field(converter=number, default=BRANCH_TOL)

    @property
    def rank_revealing(self) -> SVD:
        """The method that it turns to."""
        return SVD(self.rank_tol, self.relative)

    def factor(self, D: Float[Array, "m n"]) -> SVDFactors:
        return self.rank_revealing.factor(D)

    def apply(self, factors: SVDFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.rank_revealing.apply(factors, b)

    def apply_transpose(self, factors: SVDFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self.rank_revealing.apply_transpose(factors, c)
