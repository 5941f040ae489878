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
from udkjax.pinv.places import take
from udkjax.straightline import barrier

# Up to so many rows are eliminated by code written out, more by a loop: code grows with the square of their number.
UNROLLED = 8


class Factor(NamedTuple):
    """L diag(p) L^T of a group of fronts, and what couples it to their boundaries."""

    rows: Array  # (e, e + b, fronts): left of the diagonal L^-1, from there on diag(p) L^T and W
    inverse_pivots: Array  # (e, fronts)


Factors = tuple[tuple[Factor, ...], ...]


def cut(x: Array) -> Array:
    """Between steps that XLA would otherwise repeat for every use."""
    return barrier.cut([x])[0]


class Levels:
    """The elimination of all matrices of one block structure."""

    def __init__(self, sizes: Sequence[int], pairs: np.ndarray):
        self.sizes, self.width = tuple(sizes), max(sizes, default=0)
        self.plan = plan(sizes, pairs, dissect(sizes, pairs.tolist())) if sizes else Plan([], np.zeros(0, int))

    @staticmethod
    def of(sizes: Sequence[int], pairs: Sequence[tuple[int, int]]) -> "Levels":
        """Analyse a structure, once however often it is asked for: blocks of the given numbers of rows, coupled in pairs.

        Raises:
            ValueError: if a size is not positive, a block does not exist, a pair is given twice, or couples a block with itself.
        """
        array = np.asarray(pairs, int).reshape(-1, 2)
        if any(size < 1 for size in sizes):
            raise ValueError(f"every block needs a row at least, but the sizes are {[s for s in sizes if s < 1]}")
        if array.size and (array.min() < 0 or array.max() >= len(sizes)):
            raise ValueError(
                f"pairs couple blocks 0 to {len(sizes) - 1}, but one is {array.min() if array.min() < 0 else array.max()}"
            )
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
        if not self.sizes:
            return (), jnp.asarray(True)
        entries = jnp.concatenate([diagonal.ravel(), coupling.ravel(), jnp.array([0.0, 1.0], diagonal.dtype)])
        factors, safe, sent = [], [], None
        for level in self.plan.levels:
            done = [_eliminate(group, entries, sent, drop) for group in level]
            factors.append(tuple(factor for factor, _, _ in done))
            safe += [s for _, _, s in done]
            sent = _flat([update for _, update, _ in done])
        return tuple(factors), jnp.concatenate(safe).all()

    def solve(self, factors: Factors, r: Array) -> Array:
        """Return y (blocks, b) with S y = r (blocks, b); zero beyond a block's size."""
        if not self.sizes:
            return r
        levels = list(zip(self.plan.levels, factors, strict=True))
        right, sent, reduced = r.ravel(), None, []
        for groups, group_factors in levels:
            done = [_forward(group, factor, right, sent) for group, factor in zip(groups, group_factors, strict=True)]
            reduced.append([z for z, _ in done])
            sent = _flat([u for _, u in done])
        found = jnp.zeros(0, r.dtype)
        for (groups, group_factors), zs in reversed(list(zip(levels, reduced, strict=True))):
            found = cut(_flat([found, *(_backward(*each, found) for each in zip(groups, group_factors, zs, strict=True))]))
        y = take(found, self.plan.solution)
        return y if min(self.sizes) == self.width else y * (np.arange(self.width) < np.array(self.sizes)[:, None])


def _eliminate(group: Group, entries: Array, sent: Array | None, drop: Array | float) -> tuple[Factor, Array, Array]:
    """Return the factor of a group, its updates (b, b, fronts), and whether its pivots are safe."""
    e, b = group.eliminated, group.boundary
    own = take(entries, group.entries)
    rows = cut(jnp.concatenate([_sum(sent, group.pivot, own[:, :e]), _sum(sent, group.side, own[:, e:])], axis=1))
    if e <= UNROLLED:
        for j in range(e - 1):
            rows = cut(_pivot(j, rows))
    else:
        rows = lax.fori_loop(0, e - 1, _pivot, rows)
    pivots = _diagonal(rows)
    inverse = cut(1 / pivots)
    safe = (pivots > drop * _diagonal(own)).all(0)
    corner = _sum(sent, group.corner, jnp.zeros((b, b, group.fronts), entries.dtype))
    update = corner - _products(rows[:, e:, None], rows[:, None, e:] * inverse[:, None, None])
    return Factor(rows, inverse), cut(update), safe


def _pivot(j: int | Array, rows: Array) -> Array:
    """Take row j out of those after it; where that leaves zeros, keep L^-1 instead."""
    row = lax.dynamic_index_in_dim(rows, j, 0, keepdims=False)
    multiplier = lax.dynamic_index_in_dim(rows, j, 1, keepdims=False) * cut(
        1 / lax.dynamic_index_in_dim(row, j, 0, keepdims=False)
    )
    later, own = (np.arange(rows.shape[0]) > j)[:, None, None], (np.arange(rows.shape[1]) == j)[:, None]
    return jnp.where(later, jnp.where(own, 0, rows) - multiplier[:, None] * jnp.where(own, 1, row), rows)


def _forward(group: Group, factor: Factor, right: Array, sent: Array | None) -> tuple[Array, Array]:
    """Return diag(p)^-1 L^-1 r of a group's rows, and what it sends up: W^T diag(p)^-1 L^-1 r, taken out."""
    e, b = group.eliminated, group.boundary
    r = cut(_sum(sent, group.carried, take(right, group.rows)))
    z = cut(_products(_lower(factor).swapaxes(0, 1), r[:, None]) * factor.inverse_pivots)
    passed = _sum(sent, group.passed, jnp.zeros((b, group.fronts), r.dtype))
    return z, cut(passed - _products(factor.rows[:, e:], z[:, None]))


def _backward(group: Group, factor: Factor, z: Array, found: Array) -> Array:
    """Return the solution at a group's rows, when it has been found at their boundaries."""
    x = cut(take(found, group.above))
    t = z - _products(factor.rows[:, group.eliminated :].swapaxes(0, 1), x[:, None]) * factor.inverse_pivots
    return cut(_products(_lower(factor), cut(t)[:, None]))


def _diagonal(rows: Array) -> Array:
    return jnp.stack([rows[i, i] for i in range(len(rows))]) if len(rows) else rows[:, 0]


def _lower(factor: Factor) -> Array:
    """L^-1 (e, e, fronts)."""
    e = len(factor.rows)
    return jnp.where(np.tri(e, k=-1, dtype=bool)[..., None], factor.rows[:, :e], np.eye(e)[..., None])


def _products(a: Array, b: Array) -> Array:
    """Sum a b over their first axes: written out where that is short, since XLA makes one loop along the fronts of it."""
    if not 0 < len(a) <= UNROLLED:
        return (a * b).sum(0)
    return sum((a[k] * b[k] for k in range(1, len(a))), a[0] * b[0])


def _sum(values: Array | None, places: np.ndarray, start: Array) -> Array:
    return start if values is None else sum((take(values, p) for p in places), start)


def _flat(arrays: Sequence[Array]) -> Array:
    return jnp.concatenate([a.ravel() for a in arrays])


@lru_cache(maxsize=64)
def _analysed(sizes: tuple[int, ...], pairs: bytes) -> Levels:
    return Levels(sizes, np.frombuffer(pairs, int).reshape(-1, 2))
