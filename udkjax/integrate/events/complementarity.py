"""Linear complementarity problems of contacts: 0 <= x, y = W x + b >= 0, x y = 0, of a symmetric W >= 0 of a few rows.

These are the conditions of the least of x W x / 2 + b x over x >= 0. Lawson and Hanson's active-set method (Solving Least Squares
Problems, 1974, chapter 23) finds which x are positive, the passive set, in few steps, and never takes rows into it that depend on
one another; then x is the solution of linear equations, which is what derivatives are those of.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.gradients import stop_gradients

# Of the largest |b|, rows of unit size: a y above minus that is not negative. Rounding errors are some 1e-15 of it, more where
# rows nearly depend on one another.
TIGHT = 1e-12
STEPS_PER_ROW = 6  # Lawson and Hanson found half a step for each row; rounding could make the method go round in circles


class Complementary(NamedTuple):
    """The solution of a linear complementarity problem."""

    x: Float[Array, "E"]
    y: Float[Array, "E"]  # W x + b
    passive: Bool[Array, "E"]  # where x may be positive


class _ActiveSet(NamedTuple):
    x: Float[Array, "E"]
    passive: Bool[Array, "E"]
    steps: Int[Array, ""]
    done: Bool[Array, ""]


def solve_complementarity(
    W: Float[Array, "E E"], b: Float[Array, "E"], allowed: Bool[Array, "E"], floor: Float[Array, "E"]
) -> Complementary:
    """Solve 0 <= x, W x + b >= 0, x (W x + b) = 0 by Lawson and Hanson's active-set method.

    Args:
        W: symmetric, and positive semidefinite.
        b: y where x is zero.
        allowed: mask of the x that may be positive at all; the others are zero, whatever their y.
        floor: a y above minus that is not negative.

    Returns:
        x and y, with derivatives at the passive set that it has.
    """
    size = jnp.sqrt(jnp.where(allowed, jnp.diagonal(W), 1.0))
    unit, known = W / size / size[:, None], b / size
    passive = _passive_set(*stop_gradients((unit, known, allowed, floor / size)))
    x = _solve_passive(unit, known, passive) / size
    return Complementary(x, W @ x + b, passive)


def _solve_passive(W: Float[Array, "E E"], b: Float[Array, "E"], passive: Bool[Array, "E"]) -> Float[Array, "E"]:
    """Return x with (W x + b) = 0 in the passive set, and x = 0 elsewhere."""
    both = passive & passive[:, None]
    return jnp.linalg.solve(jnp.where(both, W, jnp.eye(len(b))), jnp.where(passive, -b, 0.0))


def _passive_set(
    W: Float[Array, "E E"], b: Float[Array, "E"], allowed: Bool[Array, "E"], floor: Float[Array, "E"]
) -> Bool[Array, "E"]:
    floor = jnp.maximum(floor, TIGHT * jnp.max(jnp.where(allowed, jnp.abs(b), 0.0)))

    def step(at: _ActiveSet) -> _ActiveSet:
        z = _solve_passive(W, b, at.passive)
        leaves = at.passive & (z <= 0)
        # Go towards z as far as all x stay positive; entries that are zero there leave the passive set.
        way = at.x - z
        part = jnp.where(leaves, jnp.where(way > 0, at.x / jnp.where(way > 0, way, 1.0), 0.0), jnp.inf)
        least = jnp.min(part)
        partial = at.x + jnp.where(jnp.isfinite(least), least, 0.0) * (z - at.x)
        y = jnp.where(allowed & ~at.passive, W @ z + b + floor, jnp.inf)
        enters = jnp.arange(len(b)) == jnp.argmin(y)
        any_leaves, any_enters = jnp.any(leaves), jnp.min(y) < 0
        passive = jnp.where(any_leaves, at.passive & ~(leaves & (part <= least)), at.passive | (enters & any_enters))
        x = jnp.where(passive, jnp.where(any_leaves, partial, z), 0.0)
        return _ActiveSet(x, passive, at.steps + 1, ~any_leaves & ~any_enters)

    first = _ActiveSet(jnp.zeros_like(b), jnp.zeros_like(allowed), jnp.array(0), jnp.array(False))
    goes_on = lambda at: ~at.done & (at.steps < STEPS_PER_ROW * len(b) + 2)  # noqa: E731
    return jax.lax.while_loop(goes_on, step, first).passive
