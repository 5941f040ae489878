"""The default pseudoinverse: elimination where rows are clearly independent, singular values where they are not."""

import equinox as eqx
from jaxtyping import Array, Float

from udkjax.pinv.rule import Dense, number
from udkjax.pinv.svd import SVD, SVDFactors

# Pivot relative to the diagonal entry of its row: the square of a distance from dependence. Elimination amplifies rounding errors
# by its reciprocal: with 1e-6, ten digits remain. Singular configurations are crossed equally well with 1e-5 and with 1e-7; the
# larger the value, the more often singular values are needed.
BRANCH_TOL = 1e-6
NEAREST = BRANCH_TOL**0.5  # the distance from dependence below which elimination is not used
# Near singular configurations a run that is not projected may violate Psi by this part of `drift_tol` times the square of the
# distance (native/parts/projection.py). Of 1,008 runs of a kite, a crank slider and a parallelogram with equal lengths, by three
# methods and seven gains, ten took the wrong branch if they may violate Psi by the whole of it, and none by the half.
NEAR_SHARE = 0.25


class Auto(Dense):
    """Elimination where the rows are known to be independent, else the truncated `SVD`.

    Machine code eliminates the rows of a mechanism that `analyse` found independent, until a pivot falls to `branch_tol` times
    its row's diagonal entry of D D^T: near singular configurations a step uses all rows and drops the dependent ones. For a
    general matrix, and with diffrax, the method is the `SVD`.

    Args:
        branch_tol: the pivot, relative to its row's diagonal entry of D D^T, at or below which singular values are used.
    """

    branch_tol: Float[Array, ""] | None = eqx.field(converter=number, default=BRANCH_TOL)

    @property
    def rank_revealing(self) -> SVD:
        """The pseudoinverse used near singular configurations: the `SVD` with the same threshold."""
        return SVD(self.rank_tol, self.relative)

    def factor(self, D: Float[Array, "m n"]) -> SVDFactors:
        return self.rank_revealing.factor(D)

    def apply(self, factors: SVDFactors, b: Float[Array, "m"]) -> Float[Array, "n"]:
        return self.rank_revealing.apply(factors, b)

    def apply_transpose(self, factors: SVDFactors, c: Float[Array, "n"]) -> Float[Array, "m"]:
        return self.rank_revealing.apply_transpose(factors, c)
