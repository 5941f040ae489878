"""Linear programs of a few variables: the maximum of c x over G x <= h with h >= 0, from x = 0 on.

The active-set method (Fletcher, Practical Methods of Optimization, 1987, section 8.3): x moves along the part of c that the
active rows leave free, up to the next row, which becomes active; where nothing is left of c, a row with a negative multiplier is
dropped.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

# A row blocks a direction if G x grows along it by more than this, relative to the terms of the sum, which may cancel: near the
# angle at which friction locks a mechanism, half of the digits are left of the difference.
BLOCKING_TOL = 1e-9
# Part of c that no active row holds, relative to c: less is rounding, after a refinement some 1e-15 times the condition.
OPTIMALITY_TOL = 1e-11
STEPS_PER_ROW = 10  # one or two are usual; beyond half of them Bland's rule excludes cycles


class Maximum(NamedTuple):
    """The solution of a linear program."""

    x: Float[Array, "n"]
    y: Float[Array, "rows"]  # multipliers: G^T y = c, y >= 0, zero for rows that are not active
    solved: Bool[Array, ""]
    endless: Bool[Array, ""]  # whether c x is unbounded; x is then the vertex where the endless edge begins


class _Iterate(NamedTuple):
    x: Array
    y: Array
    active: Array
    steps: Array
    solved: Array
    endless: Array


def maximize(c: Float[Array, "n"], G: Float[Array, "rows n"], h: Float[Array, "rows"], terms: Float[Array, "rows n"]) -> Maximum:
    """Maximize c x over G x <= h, where h >= 0.

    Args:
        c: the slope of the objective.
        G: rows of the inequalities.
        h: their right-hand sides; rounding errors below zero count as zero.
        terms: sizes of the terms whose sums are the entries of G: each at least |G|.
    """
    count, most = len(h), STEPS_PER_ROW * sum(G.shape)
    length = jnp.linalg.norm(terms, axis=1)
    length = jnp.where(length > 0, length, 1.0)
    rows, sizes, right = G / length[:, None], terms / length[:, None], jnp.maximum(h, 0.0) / length
    norm = jnp.linalg.norm(c)
    slope = c / jnp.where(norm > 0, norm, 1.0)

    def step(state: _Iterate) -> _Iterate:
        held = jnp.where(state.active[:, None], rows, 0.0)
        gram = held @ held.T + jnp.diag(jnp.where(state.active, 0.0, 1.0))
        y = jnp.linalg.solve(gram, held @ slope)
        y = y + jnp.linalg.solve(gram, held @ (slope - held.T @ y))
        ahead = slope - held.T @ y
        by_bland = state.steps > most // 2  # the first of the candidates enters or leaves, which cannot cycle
        is_held = (jnp.linalg.norm(ahead) <= OPTIMALITY_TOL) | (state.active.sum() >= G.shape[1])
        negative = state.active & (y < -OPTIMALITY_TOL)
        dropped = _first(jnp.where(negative, jnp.where(by_bland, -1.0, y), jnp.inf))
        rates = rows @ ahead
        blocks = ~state.active & (rates > BLOCKING_TOL * (sizes @ jnp.abs(ahead)))
        ways = jnp.where(blocks, jnp.maximum(right - rows @ state.x, 0.0) / jnp.where(blocks, rates, 1.0), jnp.inf)
        way = jnp.min(ways)
        nearest = blocks & (ways <= way)
        added = _first(jnp.where(nearest, jnp.where(by_bland, -1.0, -rates), jnp.inf))
        endless = ~is_held & ~jnp.any(blocks)
        moves = ~is_held & ~endless
        active = (state.active & ~(is_held & jnp.any(negative) & dropped)) | (moves & added)
        x = state.x + jnp.where(moves, way, 0.0) * ahead
        return _Iterate(x, y, active, state.steps + 1, is_held & ~jnp.any(negative), endless)

    def goes_on(state: _Iterate) -> Array:
        return ~(state.solved | state.endless) & (state.steps < most)

    none = jnp.zeros(count, bool)
    start = _Iterate(jnp.zeros_like(c), jnp.zeros_like(h), none, jnp.asarray(0), jnp.asarray(False), jnp.asarray(False))
    found = jax.lax.while_loop(goes_on, step, start)
    y = jnp.where(found.active, found.y, 0.0) * norm / length
    return Maximum(found.x, y, found.solved, found.endless)


def _first(values: Array) -> Array:
    """Return the mask of the first of the smallest values."""
    return np.arange(len(values)) == jnp.argmin(values)
