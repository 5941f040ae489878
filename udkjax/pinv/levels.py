"""Elimination by the levels of the elimination tree: a program whose size grows like the logarithm of a chain's length.

S y = r, S = D D^T block-sparse, symmetric and positive definite (the rows of D are independent; a block is a joint, and two
are coupled where they touch the same body). The fronts of one depth of a nested dissection do not touch each other, so they
are eliminated together, as one dense operation on arrays (row, column, front): with S_ee = L diag(p) L^T of a front,

    W = L^-1 S_eb,   S_bb <- S_bb - W^T diag(p)^-1 W,   and S_bb goes to the parent's front

(the multifrontal method: I. S. Duff, J. K. Reid, ACM Trans. Math. Softw. 9, 302 (1983)). L^-1 of these few rows is kept
itself, so that solving needs products only; a triangular inverse, unlike S_ee^-1, loses nothing where S is near singular.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from udkjax.pinv.dissection import dissect
from udkjax.pinv.fronts import Group, Plan, plan

# Up to so many rows are eliminated by code written out, more by a loop: code grows with the square of their number.
UNROLLED = 8


class Factor(NamedTuple):
    """L diag(p) L^T of a group of fronts, and what couples it to their boundaries."""

    lower: Array  # (e, e, fronts): L^-1
    coupling: Array  # (e, b, fronts): diag(p)^-1 W
    inverse_pivots: Array  # (e, fronts)


Factors = tuple[tuple[Factor, ...], ...]


class Levels:
    """The elimination of all matrices of one block structure."""

    def __init__(self, sizes: Sequence[int], pairs: np.ndarray):
        self.sizes, self.width = tuple(sizes), max(sizes, default=0)
        self.plan = plan(sizes, pairs, dissect(sizes, pairs.tolist())) if sizes else Plan([], np.zeros(0, int))

    @staticmethod
    def of(sizes: Sequence[int], pairs: Sequence[tuple[int, int]]) -> "Levels":
        """Analyse a structure: blocks of the given numbers of rows, coupled in pairs. Analysed once, however often it is asked for.

        Raises ValueError where a size is not positive, a block does not exist, or a pair is given twice or couples a block with itself.
        """
        array = np.asarray(pairs, int).reshape(-1, 2)
        if any(size < 1 for size in sizes):
            raise ValueError(f"every block needs a row at least, but the sizes are {[s for s in sizes if s < 1]}")
        if array.size and (array.min() < 0 or array.max() >= len(sizes)):
            raise ValueError(f"pairs couple blocks 0 to {len(sizes) - 1}, but one is {array.min() if array.min() < 0 else array.max()}")
        if (array[:, 0] == array[:, 1]).any() or len(np.unique(np.sort(array), axis=0)) < len(array):
            raise ValueError("a pair couples two different blocks, and each two are coupled by one pair only")
        return _analysed(tuple(int(s) for s in sizes), array.tobytes())

    def factor(self, diagonal: Array, coupling: Array, drop: Array | float) -> tuple[Factors, Array]:
        """Factorize S, and say whether every pivot exceeds `drop` times its row's diagonal entry of S.

        Args:
            diagonal: (blocks, b, b), the diagonal blocks, b the largest size; what lies beyond a block's size is not read.
            coupling: (pairs, b, b), the rows of the first of two coupled blocks, the columns of the second.
            drop: a pivot is what remains of its row's diagonal entry when the rows eliminated before it are taken out, so a
                small one says that the row depends on them. Less than one. The factors of such a matrix are of no use.
        """
        safe = jnp.asarray(True)
        if not self.sizes:
            return (), safe
        entries = jnp.concatenate([diagonal.ravel(), coupling.ravel(), jnp.array([0.0, 1.0], diagonal.dtype)])
        factors, sent = [], None
        for level in self.plan.levels:
            done = [_eliminate(group, entries, sent, drop) for group in level]
            factors.append(tuple(factor for factor, _, _ in done))
            safe = safe & jnp.stack([s for _, _, s in done]).all()
            sent = _flat([update for _, update, _ in done])
        return tuple(factors), safe

    def solve(self, factors: Factors, r: Array) -> Array:
        """Return y (blocks, b) with S y = r (blocks, b); zero beyond a block's size."""
        if not self.sizes:
            return r
        levels, right, sent, reduced = self.plan.levels, r.ravel(), None, []
        for level, group_factors in zip(levels, factors, strict=True):
            done = [_forward(group, factor, right, sent) for group, factor in zip(level, group_factors, strict=True)]
            reduced.append([z for z, _ in done])
            sent = _flat([u for _, u in done])
        found, above = [], None
        for level, group_factors, zs in reversed(list(zip(levels, factors, reduced, strict=True))):
            done = [_backward(*each, above) for each in zip(level, group_factors, zs, strict=True)]
            above = _flat([jnp.concatenate(xs) for xs in done])
            found.append(_flat([x for x, _ in done]))
        y = _take(jnp.concatenate(found[::-1]), self.plan.solution)
        return y if min(self.sizes) == self.width else y * (np.arange(self.width) < np.array(self.sizes)[:, None])


def _eliminate(group: Group, entries: Array, sent: Array | None, drop: Array | float) -> tuple[Factor, Array, Array]:
    """Return the factor of a group, its updates (b, b, fronts), and whether its pivots are safe."""
    e, b = group.eliminated, group.boundary
    own = _take(entries, group.entries)
    diagonal = own[np.arange(e), np.arange(e)]
    front = jnp.concatenate([_sum(sent, group.pivot, own[:, :e]), _sum(sent, group.side, own[:, e:])], axis=1)
    rows = lax.optimization_barrier((_rows if e <= UNROLLED else _rows_by_loop)(front))
    pivots = rows[np.arange(e), np.arange(e)]
    inverse = 1 / pivots
    lower = jnp.where(np.tri(e, k=-1, dtype=bool)[..., None], rows[:, :e], np.eye(e)[..., None])
    coupling = rows[:, e:] * inverse[:, None]
    lower, coupling, inverse = lax.optimization_barrier((lower, coupling, inverse))
    corner = _sum(sent, group.corner, jnp.zeros((b, b, group.fronts), entries.dtype))
    update = corner - _products("jaf,jbf->abf", rows[:, e:], coupling)
    return Factor(lower, coupling, inverse), update, (pivots > drop * diagonal).all()


def _rows(front: Array) -> Array:
    """Eliminate the rows (e, e + b, fronts) one after another: left of the diagonal L^-1, from there on diag(p) L^T and W.

    A row keeps L^-1 where the elimination has left zeros; the pivot's own column takes the multiplier.
    """
    done: list[Array] = []
    for i, row in enumerate(front):
        for j, before in enumerate(done):
            multiplier = row[j] / before[j]
            row = jnp.where((np.arange(len(row)) == j)[:, None], -multiplier, row - multiplier * before)
        done.append(lax.optimization_barrier(row))
    return jnp.stack(done) if done else front


def _rows_by_loop(front: Array) -> Array:
    """`_rows`, with the same operations in a loop over the pivots."""

    def eliminate(j: Array, front: Array) -> Array:
        row = lax.dynamic_index_in_dim(front, j, 0, keepdims=False)
        multiplier = lax.dynamic_index_in_dim(front, j, 1, keepdims=False) / lax.dynamic_index_in_dim(row, j, 0, keepdims=False)
        own = (np.arange(front.shape[1]) == j)[:, None]
        later = (np.arange(front.shape[0]) > j)[:, None, None]
        return jnp.where(later, jnp.where(own, -multiplier[:, None], front - multiplier[:, None] * row), front)

    return lax.fori_loop(0, front.shape[0], eliminate, front)


def _forward(group: Group, factor: Factor, right: Array, sent: Array | None) -> tuple[Array, Array]:
    """Return L^-1 r of a group's rows, divided by the pivots, and what it sends up, W^T diag(p)^-1 L^-1 r taken out."""
    r = _sum(sent, group.carried, _take(right, group.rows))
    z = _products("ijf,jf->if", factor.lower, r)
    passed = _sum(sent, group.passed, jnp.zeros((group.boundary, group.fronts), r.dtype))
    return z * factor.inverse_pivots, passed - _products("jbf,jf->bf", factor.coupling, z)


def _backward(group: Group, factor: Factor, z: Array, above: Array | None) -> tuple[Array, Array]:
    """Return the solution at a group's rows, and at its boundary, where the level above knows it."""
    x = jnp.zeros((group.boundary, group.fronts), z.dtype) if above is None else _take(above, group.above)
    return _products("jif,jf->if", factor.lower, z - _products("jbf,bf->jf", factor.coupling, x)), x


def _products(subscripts: str, a: Array, b: Array) -> Array:
    """A product of matrices for every front: written out where the sum is short, since XLA makes one loop of that."""
    inputs, output = subscripts.split("->")
    summed = next(s for s in inputs.split(",")[1] if s not in output)
    one, two = inputs.split(",")
    terms = a.shape[one.index(summed)]
    if not 0 < terms <= UNROLLED:
        return jnp.einsum(subscripts, a, b)
    result = None
    for k in range(terms):
        x, y = lax.index_in_dim(a, k, one.index(summed), False), lax.index_in_dim(b, k, two.index(summed), False)
        term = jnp.einsum(f"{one.replace(summed, '')},{two.replace(summed, '')}->{output}", x, y)
        result = term if result is None else result + term
    return result


def _take(values: Array, places: np.ndarray) -> Array:
    return values.at[places].get(mode="promise_in_bounds")


def _sum(values: Array | None, places: np.ndarray, start: Array) -> Array:
    return start if values is None else sum((_take(values, p) for p in places), start)


def _flat(arrays: Sequence[Array]) -> Array:
    return jnp.concatenate([a.ravel() for a in arrays])


@lru_cache(maxsize=64)
def _analysed(sizes: tuple[int, ...], pairs: bytes) -> Levels:
    return Levels(sizes, np.frombuffer(pairs, int).reshape(-1, 2))
