"""Decompositions of small matrices, and sorting, in plain JAX. They are lowered in place of calls of LAPACK and of sorts.

Jacobi's methods rotate all pairs of rows of a round at once, by products of whole arrays. The pairs follow a round-robin: in the
rounds of a sweep, each row meets each other row once. G. H. Golub & C. F. Van Loan, Matrix Computations, 4th ed., sections 5.2.2,
8.5 and 8.6.3.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

SWEEPS = 30  # more than Jacobi's method ever takes: it converges quadratically, as a rule in six to ten
TINY = np.finfo(float).tiny
ROUNDING = np.finfo(float).eps


def householder_qr(a: Float[Array, "m n"], is_full: bool, pivots: bool = False) -> tuple[Array, Array, Array]:
    """Return Q, R and p of A[:, p] = Q R, with LAPACK's signs; Q is square if it is full.

    With `pivots`, the next column is always the longest of the remaining ones; without, p is 0, 1, ..., n - 1.
    """
    m, n = a.shape
    i, j, steps = jnp.arange(m), jnp.arange(n), min(m, n)

    def reflect(k: Array, found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        q, r, order = found
        if pivots:
            size = jnp.sum(jnp.where(i[:, None] >= k, r, 0.0) ** 2, 0)
            longest = jnp.argmax(jnp.where(j >= k, size, -1.0))
            r, order = _with_exchanged(r, k, longest), _with_exchanged(order, k, longest)
        x, head = r[:, k], r[k, k]
        below = jnp.where(i > k, x, 0.0)
        largest = jnp.maximum(jnp.abs(below).max(), TINY)
        tail = largest * jnp.sqrt(jnp.sum((below / largest) ** 2))
        size = jnp.where(head < 0, -1.0, 1.0) * jnp.hypot(head, tail)
        acts = tail > 0
        v = jnp.where(i == k, 1.0, below / jnp.where(acts, head + size, 1.0))
        tau = jnp.where(acts, (head + size) / jnp.where(acts, size, 1.0), 0.0)
        return q - jnp.outer(q @ (tau * v), v), r - jnp.outer(tau * v, v @ r), order

    q, r, order = jax.lax.fori_loop(0, steps, reflect, (jnp.eye(m), a, j))
    rows = m if is_full else steps
    return q[:, :rows], jnp.where(i[:rows, None] <= j, r[:rows], 0.0), order


def _with_exchanged(x: Array, k: Array, other: Array) -> Array:
    """Return x with columns (or elements) `k` and `other` exchanged; the two indices may differ between lanes."""
    j = np.arange(x.shape[-1])
    of_k, of_other = (jnp.sum(jnp.where(j == c, x, 0), -1, keepdims=True) for c in (k, other))
    return jnp.where(j == k, of_other, jnp.where(j == other, of_k, x))


def _exchanged(first: Array, second: Array) -> Array:
    """Return all rows in the order of the next round, in which row i of the first half meets row i of the second half.

    The arguments are the halves of the present round. The first row stays in its place, and the others move on.
    """
    if len(first) == 1:
        return jnp.concatenate([first, second])
    return jnp.concatenate([first[:1], second[:1], first[1:-1], second[1:], first[-1:]])


def _turned(x: Array, c: Array, s: Array) -> Array:
    """Return the rows after a round: row i of the first half is rotated with row i of the second, then all rows move on."""
    first, second = x[: len(c)], x[len(c) :]
    return _exchanged(c[:, None] * first - s[:, None] * second, s[:, None] * first + c[:, None] * second)


def _angles(first: Array, second: Array, product: Array, turns: Array) -> tuple[Array, Array]:
    """Return the cosines and sines of the rotations of pairs of rows that make their `product` zero.

    `first` and `second` are the squares (or diagonal entries) of the rows. Pairs that are not to be turned have the angle zero.
    """
    ratio = (second - first) / jnp.where(turns, 2.0 * product, 1.0)
    tangent = jnp.where(turns, jnp.where(ratio < 0, -1.0, 1.0) / (jnp.abs(ratio) + jnp.hypot(1.0, ratio)), 0.0)
    cosine = 1.0 / jnp.sqrt(1.0 + tangent**2)
    return cosine, cosine * tangent


def _swept(turn: Callable[[Array], tuple[Array, Array]], start: Array) -> Array:
    """Repeat sweeps of rotations until one turns no pair of rows; return the rows, which are then in their places again.

    `turn` performs one round: it returns the rows, and whether any pair was turned.
    """

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        def one(_: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
            x, turned = turn(state[0])
            return x, state[1] | turned

        x, turned = jax.lax.fori_loop(0, len(start) - 1, one, (state[0], jnp.zeros((), bool)))
        return x, turned, state[2] + 1

    def goes_on(state: tuple[Array, Array, Array]) -> Array:
        return state[1] & (state[2] < SWEEPS)

    return jax.lax.while_loop(goes_on, sweep, (start, jnp.ones((), bool), jnp.zeros((), int)))[0]


def _places(x: Array) -> Array:
    """Return the place of each element of the last axis in ascending order: NaN last, equal elements in their order."""
    n = x.shape[-1]
    one, other = x[..., :, None], x[..., None, :]
    is_less = (other < one) | ((one != one) & (other == other))
    is_equal = (other == one) | ((one != one) & (other != other))
    return jnp.sum(is_less | (is_equal & (np.arange(n) < np.arange(n)[:, None])), -1)


def _moved(x: Array, places: Array) -> Array:
    """Return x with the elements of its last axis moved to the indices `places`."""
    chosen = places[..., None, :] == np.arange(x.shape[-1])[:, None]
    return jnp.sum(jnp.where(chosen, x[..., None, :], jnp.zeros((), x.dtype)), -1).astype(x.dtype)


def sorted_along(arrays: Sequence[Array], axis: int, keys: int) -> list[Array]:
    """Return arrays sorted along an axis by the first `keys` of them, the first one first; equal elements keep their order."""
    moved = [jnp.moveaxis(x, axis, -1) for x in arrays]
    for key in range(keys - 1, -1, -1):
        places = _places(moved[key])
        moved = [_moved(x, places) for x in moved]
    return [jnp.moveaxis(x, -1, axis) for x in moved]


def tiled(x: Array, counts: Sequence[int]) -> Array:
    """Return an array repeated along each of its axes as often as `counts` says."""
    for axis, count in enumerate(counts):
        x = jnp.concatenate([x] * count, axis)
    return x


def symmetric(a: Float[Array, "n n"], is_lower: bool) -> Float[Array, "n n"]:
    """Return the symmetric matrix whose lower triangle is that of `a` if `is_lower`, or else whose upper triangle is."""
    i = np.arange(len(a))
    return jnp.where(i[:, None] >= i if is_lower else i[:, None] <= i, a, a.T)


def jacobi_svd(a: Float[Array, "m n"], is_full: bool) -> tuple[Array, Array, Array]:
    """Return s (descending), U and V^T of A = U diag(s) V^T, by one-sided rotations of the factor R of A or of A^T.

    U and V are square if `is_full`; otherwise they have min(m, n) columns.

    Singular vectors are orthonormal for any rank, and each singular value is as accurate as rounding of A permits.
    """
    m, n = a.shape
    if m < n:
        s, v, ut = jacobi_svd(a.T, is_full)
        return s, ut.T, v.T
    scale = jnp.abs(a).max()
    scale = jnp.where((scale > 0) & (scale < jnp.inf), scale, 1.0)
    q, r, _ = householder_qr(a / scale, True)
    half = (n + 1) // 2

    def turn(x: Array) -> tuple[Array, Array]:
        one, other = x[:half, :n], x[half:, :n]
        first, second, product = jnp.sum(one * one, 1), jnp.sum(other * other, 1), jnp.sum(one * other, 1)
        turns = jnp.abs(product) > n * ROUNDING * jnp.sqrt(first * second)
        return _turned(x, *_angles(first, second, product, turns)), jnp.any(turns)

    # V^T R = W^T with orthogonal rows: A = Q V diag(s) U^T, with s the lengths of these rows and U their directions.
    x = _swept(turn, jnp.zeros((2 * half, 2 * n)).at[:n].set(jnp.concatenate([r[:n], jnp.eye(n)], 1)))[:n].T
    size = jnp.sqrt(jnp.sum(x[:n] ** 2, 0))
    places = _places(-size)
    w, v, s = _moved(x[:n], places), _moved(x[n:], places), _moved(size, places)
    # Directions of columns that are zero follow from those of the others.
    u, signs, _ = householder_qr(w / jnp.where(s > 0, s, 1.0), True)
    u = u * jnp.where(jnp.diagonal(signs) < 0, -1.0, 1.0)
    left = q[:, :n] @ v
    return scale * s, jnp.concatenate([left, q[:, n:]], 1) if is_full else left, u.T


def jacobi_eigh(a: Float[Array, "n n"]) -> tuple[Array, Array]:
    """Return the eigenvectors and the ascending eigenvalues of a symmetric matrix, by two-sided rotations."""
    n, half = len(a), (len(a) + 1) // 2

    def turn(x: Array) -> tuple[Array, Array]:
        w = x[:, : 2 * half]
        diagonal, product = jnp.diagonal(w), jnp.diagonal(w[:half, half:])
        turns = jnp.abs(product) > ROUNDING * jnp.sqrt(jnp.sum(w * w))
        angles = _angles(diagonal[:half], diagonal[half:], product, turns)
        x = _turned(x, *angles)
        w = _turned(x[:, : 2 * half].T, *angles)
        return jnp.concatenate([0.5 * (w + w.T), x[:, 2 * half :]], 1), jnp.any(turns)  # rounding leaves w symmetric

    start = jnp.zeros((2 * half, 4 * half)).at[:n, :n].set(a)
    x = _swept(turn, start.at[:, 2 * half :].set(jnp.eye(2 * half)))
    values, vectors = jnp.diagonal(x[:n, :n]), x[:n, 2 * half : 2 * half + n].T
    places = _places(values)
    return _moved(vectors, places), _moved(values, places)
