"""D^+ b by modified Gram-Schmidt."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.pinv.orthogonal import Orthogonal, OrthogonalFactors, PivotedQR, divide
from udkjax.pinv.rule import dot, exceeds


class GramSchmidt(Orthogonal):
    """D = Q R with column pivoting, then R^T = Z U: D^+ = Z U^(-T) Q^T, both by modified Gram-Schmidt.

    With `twice` each column is orthogonalized again before it is used: the error is then of the order of eps cond(D), as with
    Householder. Without it Q is orthogonal only to eps cond(D), and the error can be of the order of eps cond(D)^2. The threshold
    applies to the diagonal of R, relative to the largest column norm.

    Args:
        twice: whether each column is reorthogonalized.
    """

    twice: bool = eqx.field(static=True, default=True)

    def factor(self, D: Float[Array, "m n"]) -> OrthogonalFactors:
        q, r, _, rank = gram_schmidt(D, self.threshold(D, jnp.linalg.norm(D, axis=0).max()), self.twice)
        z, u, order, _ = gram_schmidt(r.T, jnp.zeros((), D.dtype), self.twice)  # rank already decided: drop only zero rows
        return OrthogonalFactors(divide(u[:, order], z.T, rank).T, q[:, order], rank)


def gram_schmidt(D: Float[Array, "m n"], threshold: Float[Array, ""], twice: bool) -> PivotedQR:
    """Return the QR of D by modified Gram-Schmidt.

    Each step uses the column with the longest remainder, until that is at most `threshold`. With `twice` the column is
    orthogonalized again before it is used.
    """
    rows, columns = D.shape
    steps = min(rows, columns)
    column = jnp.arange(columns)

    def orthogonalize(i, state):
        remainders, q, r, order, rank, used = state
        pivot = jnp.argmax(jnp.where(used, -1, jnp.linalg.norm(remainders, axis=0)))
        a = remainders[:, pivot]
        above = r[:, pivot]
        if twice:
            correction = dot(q.T, a)
            a = a - dot(q, correction)
            above = above + correction
        norm = jnp.linalg.norm(a)
        goes_on = (rank == i) & exceeds(norm, threshold)

        unit = jnp.where(goes_on, a / jnp.where(goes_on, norm, 1), 0)
        used = used | (column == pivot)
        products = jnp.where(used, 0, dot(unit, remainders))
        remainders = remainders - jnp.outer(unit, products)
        r = jnp.where((column == pivot) & goes_on, above.at[i].set(norm)[:, None], r.at[i].set(products))
        return remainders, q.at[:, i].set(unit), r, order.at[i].set(pivot), rank + goes_on, used

    q, r = jnp.zeros((rows, steps), D.dtype), jnp.zeros((steps, columns), D.dtype)
    start = D, q, r, jnp.arange(steps), jnp.array(0), jnp.zeros(columns, bool)
    _, q, r, order, rank, _ = jax.lax.fori_loop(0, steps, orthogonalize, start)
    return PivotedQR(q, r, order, rank)
