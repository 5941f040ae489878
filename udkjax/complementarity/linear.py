"""Linear complementarity problems of contacts: 0 <= x, y = W x + b >= 0, x y = 0, for a symmetric W >= 0 of a few rows.

These are the conditions of the minimum of x W x / 2 + b x over x >= 0. Lawson and Hanson's active-set method (Solving Least
Squares Problems, 1974, chapter 23) determines the positive x, the passive set, in few steps, and keeps the rows of this set
independent. x is then the solution of linear equations, and has its derivatives. Arrays are those of JAX or NumPy, with any
leading dimensions.
"""

from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udkjax.transforms.gradients import stop_gradients

# Tolerance on y >= 0, relative to max |b|, for rows of unit size. Rounding errors are some 1e-15, more for nearly dependent rows.
TIGHT = 1e-12
STEPS_PER_ROW = 6  # Lawson and Hanson observed half a step per row; the limit stops cycles caused by rounding


class Complementary(NamedTuple):
    """The solution of a linear complementarity problem."""

    x: Float[Any, "*m E"]
    y: Float[Any, "*m E"]  # W x + b
    passive: Bool[Any, "*m E"]  # where x may be positive


class _ActiveSet(NamedTuple):
    x: Any
    passive: Any
    steps: Any
    done: Any


def solve_complementarity(
    W: Float[Any, "*m E E"],
    b: Float[Any, "*m E"],
    allowed: Bool[Any, "*m E"],
    floor: Float[Any, "*m E"],
    xp: ModuleType = jnp,
) -> Complementary:
    """Solve 0 <= x, W x + b >= 0, x (W x + b) = 0 by Lawson and Hanson's active-set method.

    Args:
        W: symmetric, and positive semidefinite.
        b: y for x = 0.
        allowed: mask of the x that may be positive; all others are zero, whatever y is.
        floor: tolerance on y >= 0.
        xp: jax.numpy, or NumPy.

    Returns:
        x and y, with derivatives for the final passive set.
    """
    size, scaled, rhs = _unit_rows(W, b, allowed, xp)
    given = scaled, rhs, allowed, floor / size
    passive = _passive_set(*(given if xp is np else stop_gradients(given)), xp)
    x = _solve_passive(scaled, rhs, passive, xp) / size
    return Complementary(x, times(W, x) + b, passive)


def solve_rows(W: Float[Any, "*m E E"], b: Float[Any, "*m E"], rows: Bool[Any, "*m E"], xp: ModuleType) -> Float[Any, "*m E"]:
    """Return x with W x + b = 0 in the given independent rows, and x = 0 elsewhere."""
    size, scaled, rhs = _unit_rows(W, b, rows, xp)
    return _solve_passive(scaled, rhs, rows, xp) / size


def _unit_rows(W: Any, b: Any, rows: Any, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Return the sizes of the given rows, and W and b with rows of unit size."""
    size = xp.sqrt(xp.where(rows, diagonal(W, xp), 1.0))
    return size, W / size[..., None, :] / size[..., :, None], b / size


def diagonal(W: Any, xp: ModuleType) -> Any:
    """Return the diagonals of matrices."""
    return xp.diagonal(W, axis1=-2, axis2=-1)


def times(W: Any, x: Any) -> Any:
    """Return W x, with any leading dimensions."""
    return (W @ x[..., None])[..., 0]


def _solve_passive(W: Any, b: Any, passive: Any, xp: ModuleType) -> Any:
    """Return x with (W x + b) = 0 in the passive set, and x = 0 elsewhere."""
    passive_pairs = passive[..., None, :] & passive[..., :, None]
    matrix = xp.where(passive_pairs, W, xp.eye(W.shape[-1]))
    return xp.linalg.solve(matrix, xp.where(passive, -b, 0.0)[..., None])[..., 0]


def _passive_set(W: Any, b: Any, allowed: Any, floor: Any, xp: ModuleType) -> Any:
    largest_b = xp.max(xp.where(allowed, xp.abs(b), 0.0), axis=-1, keepdims=True)
    floor = xp.maximum(floor, TIGHT * largest_b)
    if xp is np and allowed.sum(-1).max(initial=0) <= 1:
        return allowed & (b + floor < 0)

    def step(state: _ActiveSet) -> _ActiveSet:  # changes nothing once done
        z = _solve_passive(W, b, state.passive, xp)
        leaves = state.passive & (z <= 0)
        # Go towards z until the first x becomes zero; these entries leave the passive set.
        decrease = state.x - z
        fraction = xp.where(leaves, xp.where(decrease > 0, state.x / xp.where(decrease > 0, decrease, 1.0), 0.0), xp.inf)
        smallest = xp.min(fraction, axis=-1, keepdims=True)
        partial = state.x + xp.where(xp.isfinite(smallest), smallest, 0.0) * (z - state.x)
        y = xp.where(allowed & ~state.passive, times(W, z) + b + floor, xp.inf)
        enters = np.arange(b.shape[-1]) == xp.argmin(y, axis=-1)[..., None]
        any_leaves, any_enters = xp.any(leaves, -1, keepdims=True), xp.min(y, axis=-1, keepdims=True) < 0
        passive = xp.where(any_leaves, state.passive & ~(leaves & (fraction <= smallest)), state.passive | (enters & any_enters))
        x = xp.where(passive, xp.where(any_leaves, partial, z), 0.0)
        return _ActiveSet(x, passive, state.steps + 1, ~xp.any(any_leaves | any_enters))

    def goes_on(state: _ActiveSet) -> Any:
        return ~state.done & (state.steps < STEPS_PER_ROW * b.shape[-1] + 2)

    state = _ActiveSet(xp.zeros_like(b), xp.zeros_like(allowed), xp.asarray(0), xp.asarray(False))
    if xp is not np:
        return jax.lax.while_loop(goes_on, step, state).passive
    while goes_on(state):
        state = step(state)
    return state.passive
