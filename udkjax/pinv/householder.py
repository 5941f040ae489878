"""D^+ b by Householder's QR: a basic solution minus its component in the null space."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.pinv.orthogonal import Orthogonal, OrthogonalFactors, PivotedQR, divide
from udkjax.pinv.rule import dot, exceeds


class Householder(Orthogonal):
    """Least squares by Householder's QR with column pivoting. With E the unit vectors of the r pivot columns,

        D = Q T G,   T = R E (r, r) upper triangular,   G = T^(-1) R, which is [I S] in some order of the columns,

    E T^(-1) Q^T b is one least-squares solution. The columns of I - E G span the null space of D; with V an orthonormal basis of
    them, by QR once more, x = (I - V V^T) E T^(-1) Q^T b is the shortest solution (Golub and Van Loan, Matrix Computations,
    4th ed., section 5.5). The threshold applies to the diagonal of T, relative to the largest column norm.

    The error is of the order of eps cond(D).
    """

    def factor(self, D: Float[Array, "m n"]) -> OrthogonalFactors:
        columns = D.shape[1]
        q, r, order, rank = pivoted_qr(D, self.threshold(D, jnp.linalg.norm(D, axis=0).max()))
        divided = divide(r[:, order], jnp.hstack([r, q.T]), rank)
        g, basic = divided[:, :columns], divided[:, columns:]
        pivots = jax.nn.one_hot(order, columns, dtype=D.dtype, axis=0) * (jnp.arange(len(order)) < rank)  # E
        null = jnp.where(pivots.any(axis=1), 0, jnp.eye(columns, dtype=D.dtype) - dot(pivots, g))
        v = pivoted_qr(null, jnp.zeros((), D.dtype)).q
        return OrthogonalFactors(pivots - dot(v, dot(v.T, pivots)), basic.T, rank)


def pivoted_qr(D: Float[Array, "m n"], threshold: Float[Array, ""]) -> PivotedQR:
    """Return Householder's QR of D: each step uses the column with the longest remainder, until that is at most `threshold`."""
    q, r, order, rank = complete_qr(D, threshold)
    significant = jnp.arange(len(order)) < rank
    return PivotedQR(
        jnp.where(significant, q[:, : len(order)], 0), jnp.where(significant[:, None], r[: len(order)], 0), order, rank
    )


def complete_qr(D: Float[Array, "m n"], threshold: Float[Array, ""]) -> PivotedQR:
    """Return the same QR as `pivoted_qr`, but with the full Q (m, m) and R (m, n).

    From `rank` on, the columns of Q span the complement of D's range.

    Columns are not moved; their order is returned. (The pivoted QR of jax.scipy needs MAGMA on a GPU.)
    """
    rows, columns = D.shape
    steps = min(rows, columns)
    row, column = jnp.arange(rows), jnp.arange(columns)

    def reflect(i, state):
        q, r, order, rank, used = state
        below = jnp.where((row >= i)[:, None], r, 0)
        norms = jnp.linalg.norm(below, axis=0)
        pivot = jnp.argmax(jnp.where(used, -1, norms))
        a, norm = below[:, pivot], norms[pivot]
        goes_on = (rank == i) & exceeds(norm, threshold)

        diagonal = jnp.where(a[i] > 0, -norm, norm)  # away from a[i]: no cancellation
        v = a.at[i].add(-diagonal)
        tau = jnp.where(goes_on, 2 / jnp.where(goes_on, dot(v, v), 1), 0)
        r = r - jnp.outer(tau * v, dot(v, r))
        q = q - jnp.outer(dot(q, v), tau * v)
        exact = jnp.where(row < i, r[:, pivot], jnp.where(row == i, diagonal, 0))
        r = jnp.where((column == pivot) & goes_on, exact[:, None], r)
        return q, r, order.at[i].set(pivot), rank + goes_on, used | (column == pivot)

    start = jnp.eye(rows, dtype=D.dtype), D, jnp.arange(steps), jnp.array(0), jnp.zeros(columns, bool)
    q, r, order, rank, _ = jax.lax.fori_loop(0, steps, reflect, start)
    return PivotedQR(q, r, order, rank)
