"""Linear complementarity problems of contacts: 0 <= x, y = W x + b >= 0, x y = 0, for a symmetric W >= 0 of a few rows.

These are the conditions of the minimum of x W x / 2 + b x over x >= 0. The symmetric principal pivoting method (Cottle, Pang and
Stone, The Linear Complementarity Problem, 1992, section 4.3) determines the positive x, the passive set, in few steps, and keeps
the rows of this set independent. x is then the solution of linear equations, and has its derivatives. Arrays are those of JAX or
NumPy, with any leading dimensions.
"""

from collections.abc import Callable
from functools import partial, wraps
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udkjax.transforms.gradients import stop_gradients

# Tolerance on y >= 0, relative to max |b|, for rows of unit size. Rounding errors are some 1e-15, more for nearly dependent rows.
FEASIBILITY_TOL = 1e-12
LEMKE_STEPS = 10  # for each row; Lemke's method takes about as many steps as rows
# Bound on the variable x0, relative to max |q|, where Lemke's method ends on a ray: in degenerate problems, a smaller one is a
# rounding error, and the problem is solved.
RAY_TOL = 1e-9
STEPS_PER_ROW = 6  # one step per positive x is usual; the limit stops cycles caused by rounding


def traced_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a version of a function of arrays that JAX traces once for each combination of shapes.

    The result takes the module of the arrays, jax.numpy or NumPy, as its last argument, `xp`. However often a program calls it,
    its machine code is a single function. For NumPy it is the original function.
    """
    traced = jax.jit(partial(function, xp=jnp))

    @wraps(function)
    def call(*arrays: Any, xp: ModuleType = jnp) -> Any:
        if arrays and isinstance(arrays[-1], ModuleType):
            arrays, xp = arrays[:-1], arrays[-1]
        return traced(*arrays) if xp is not np else function(*arrays, xp=xp)

    return call


class Complementary(NamedTuple):
    """The solution of a linear complementarity problem."""

    x: Float[Any, "*m E"]
    y: Float[Any, "*m E"]  # W x + b
    passive: Bool[Any, "*m E"]  # where x may be positive


class _Pivoting(NamedTuple):
    x: Any
    passive: Any
    driving: Any  # mask of the x that is raised until its y is zero
    steps: Any
    done: Any


@traced_once
def solve_complementarity(
    W: Float[Any, "*m E E"],
    b: Float[Any, "*m E"],
    allowed: Bool[Any, "*m E"],
    floor: Float[Any, "*m E"],
    equalities: Bool[Any, "*m E"] | None = None,
    xp: ModuleType = jnp,
) -> Complementary:
    """Solve 0 <= x, W x + b >= 0, x (W x + b) = 0 by principal pivoting.

    Args:
        W: symmetric, and positive semidefinite.
        b: y for x = 0.
        allowed: mask of the x that may be positive; all others are zero, whatever y is.
        floor: tolerance on y >= 0.
        equalities: mask of independent rows with y = 0, whose x have either sign; None: there are none.
        xp: jax.numpy, or NumPy.

    Returns:
        x, y and the passive set; x and y have derivatives, with this set held fixed.
    """
    equalities = allowed & False if equalities is None else equalities
    size, scaled, rhs = _unit_rows(W, b, allowed | equalities, xp)
    given = scaled, rhs, allowed, floor / size, equalities
    passive = _passive_set(*(given if xp is np else stop_gradients(given)), xp)
    x = _solve_passive(scaled, rhs, passive, xp) / size
    return Complementary(x, times(W, x) + b, passive)


def general_complementary_set(
    M: Float[Any, "n n"], q: Float[Any, "n"], takes_part: Bool[Any, "n"], xp: ModuleType = jnp
) -> tuple[Bool[Any, "n"], Bool[Any, ""]]:
    """Solve 0 <= x, y = M x + q >= 0, x y = 0 by Lemke's method, for an M that need not be symmetric.

    Lemke's method finds a solution for copositive M (Cottle, Pang and Stone 1992).

    Args:
        M: the matrix.
        q: y for x = 0.
        takes_part: mask of the x that may be positive; all others are zero, whatever y is.
        xp: jax.numpy, or NumPy.

    Returns:
        A mask of the x that may be positive in the solution, without derivatives; and True if a solution was found.
    """
    reduced, right = xp.where(takes_part & takes_part[:, None], M, np.eye(len(q))), xp.where(takes_part, q, 1.0)
    return _lemke(*((reduced, right) if xp is np else stop_gradients((reduced, right))), xp)


class _Tableau(NamedTuple):
    """The equations y - M x - x0 = q, solved for the basic variables. The variables are numbered in the order y, x, x0."""

    table: Any  # (n, 2 n + 2), the last column is the right-hand side
    basic: Any  # (n,)
    enters: Any
    steps: Any
    done: Any
    fails: Any


def _lemke(M: Float[Any, "n n"], q: Float[Any, "n"], xp: ModuleType) -> tuple[Bool[Any, "n"], Bool[Any, ""]]:
    n = len(q)

    def pivot(state: _Tableau, row: Any) -> _Tableau:
        is_row = np.arange(n) == row
        new = state.table[row] / state.table[row, state.enters]
        table = xp.where(is_row[:, None], new, state.table - state.table[:, state.enters][:, None] * new)
        leaves = state.basic[row]
        return _Tableau(
            table=table,
            basic=xp.where(is_row, state.enters, state.basic),
            enters=xp.where(leaves < n, leaves + n, leaves - n),
            steps=state.steps + 1,
            done=leaves == 2 * n,
            fails=state.fails,
        )

    def step(state: _Tableau) -> _Tableau:
        column = state.table[:, state.enters]
        candidates = column > FEASIBILITY_TOL * xp.max(xp.abs(column))
        fails = ~xp.any(candidates)
        divisor = xp.where(candidates, column, 1.0)
        # The smallest ratio; of equal ones that of x0, else the first in lexicographic order, which excludes cycles.
        for values in (state.table[:, -1], xp.where(state.basic == 2 * n, -1.0, 0.0) * divisor, *state.table[:, :n].T):
            ratio = xp.where(candidates, values / divisor, xp.inf)
            least = xp.min(ratio)
            candidates = candidates & (ratio <= least + FEASIBILITY_TOL * xp.maximum(1.0, xp.abs(least)))
        failed = state._replace(fails=fails)
        if xp is np:
            return failed if fails else pivot(state, np.argmax(candidates))
        return jax.tree.map(lambda x, y: xp.where(fails, x, y), failed, pivot(state, xp.argmax(candidates)))

    def goes_on(state: _Tableau) -> Any:
        return ~(state.done | state.fails) & (state.steps < LEMKE_STEPS * n)

    right = q / xp.maximum(xp.max(xp.abs(q)), np.finfo(float).tiny)
    table = xp.concatenate([np.eye(n) + 0 * M, -M, xp.zeros_like(q)[:, None] - 1, right[:, None]], axis=1)
    state = _Tableau(table, np.arange(n) + 0, xp.asarray(2 * n), xp.asarray(0), xp.all(right >= 0), xp.asarray(False))
    # The last of equal rows is the first in lexicographic order.
    leads = n - 1 - xp.argmax((right <= xp.min(right) + FEASIBILITY_TOL)[::-1])
    if xp is np:
        if not state.done:
            state = pivot(state, leads)
        while goes_on(state):
            state = step(state)
    else:
        state = state._replace(basic=jnp.asarray(state.basic))
        first = pivot(state, leads)
        state = jax.tree.map(lambda x, y: xp.where(state.done, x, y), state, first)
        state = jax.lax.while_loop(goes_on, step, state)
    passive = xp.any(state.basic[:, None] == n + np.arange(n), axis=0)
    x0 = xp.sum(xp.where(state.basic == 2 * n, state.table[:, -1], 0.0))
    solved = state.done | (state.fails & (x0 <= RAY_TOL))
    return passive & solved, solved


@traced_once
def eliminate(
    W: Float[Any, "*m E E"], rows: Bool[Any, "*m E"], least: Float[Any, "*m E"], xp: ModuleType = jnp
) -> tuple[Float[Any, "*m E E"], Bool[Any, "*m E"]]:
    """Eliminate rows of W that are independent of each other.

    Args:
        W: symmetric, and positive semidefinite.
        rows: mask of the rows to eliminate, in their order; a row that depends on earlier ones is passed over.
        least: for each row, the diagonal entry of the remainder above which the row is independent of those before.
        xp: jax.numpy, or NumPy.

    Returns:
        The remainder of W, its Schur complement, and a mask of the eliminated rows.
    """
    taken, E = rows & False, W.shape[-1]
    for i in range(E) if xp is not np else np.flatnonzero(rows.reshape(-1, E).any(axis=0)):
        takes = rows[..., i] & (W[..., i, i] > least[..., i])
        column = W[..., :, i]
        part = column[..., :, None] * column[..., None, :] / xp.where(takes, W[..., i, i], 1.0)[..., None, None]
        W = xp.where(takes[..., None, None], W - part, W)
        taken = taken | (takes[..., None] & (np.arange(E) == i))
    return W, taken


def _unit_rows(W: Any, b: Any, rows: Any, xp: ModuleType) -> tuple[Any, Any, Any]:
    """Return the sizes of the masked rows, roots of their diagonal entries (one elsewhere), and W and b in these units."""
    size = xp.sqrt(xp.where(rows, diagonal(W, xp), 1.0))
    return size, W / size[..., None, :] / size[..., :, None], b / size


def diagonal(W: Any, xp: ModuleType) -> Any:
    """Return the diagonals of matrices."""
    return xp.diagonal(W, axis1=-2, axis2=-1)


def times(W: Any, x: Any) -> Any:
    """Return the products of matrices and vectors, W x, with any leading dimensions."""
    return (W @ x[..., None])[..., 0]


def _solve_passive(W: Any, b: Any, passive: Any, xp: ModuleType) -> Any:
    """Return x with (W x + b) = 0 in the passive set, and x = 0 elsewhere."""
    passive_pairs = passive[..., None, :] & passive[..., :, None]
    matrix = xp.where(passive_pairs, W, xp.eye(W.shape[-1]))
    return solve(matrix, xp.where(passive, -b, 0.0), xp)


def solve(A: Float[Any, "*m n n"], b: Float[Any, "*m n"], xp: ModuleType) -> Float[Any, "*m n"]:
    """Return the solution of A x = b; NaN or infinity if A is singular."""
    try:
        return xp.linalg.solve(A, b[..., None])[..., 0]
    except np.linalg.LinAlgError:
        if b.ndim == 1:
            return np.full(b.shape, np.nan)
        return np.stack([solve(*member, xp) for member in zip(A, b, strict=True)])


def _passive_set(W: Any, b: Any, allowed: Any, floor: Any, equalities: Any, xp: ModuleType) -> Any:
    rows = allowed | equalities
    largest_b = xp.max(xp.where(rows, xp.abs(b), 0.0), axis=-1, keepdims=True)
    floor = xp.maximum(floor, FEASIBILITY_TOL * largest_b)
    if b.shape[-1] == 1 or (xp is np and not equalities.any() and allowed.sum(-1).max(initial=0) <= 1):
        return equalities | (allowed & (b + floor < 0))

    def step(state: _Pivoting) -> _Pivoting:  # changes nothing once done
        y = times(W, state.x) + b
        excess = xp.where(allowed & ~state.passive, y + floor, xp.inf)
        lowest = np.arange(b.shape[-1]) == xp.argmin(excess, axis=-1)[..., None]
        enters = lowest & (xp.min(excess, axis=-1, keepdims=True) < 0)
        driving = xp.where(xp.any(state.driving, -1, keepdims=True), state.driving, enters)
        # Raise this x, and move all positive ones so that their y stay zero, until its y is zero or one of them is.
        way = xp.where(driving, 1.0, _solve_passive(W, times(W, driving * 1.0), state.passive, xp))
        slope, rest = (xp.sum(xp.where(driving, x, 0.0), -1, keepdims=True) for x in (times(W, way), -y))
        is_rising = slope > FEASIBILITY_TOL  # y of a dependent row does not change
        full = xp.where(is_rising, rest / xp.where(is_rising, slope, 1.0), xp.inf)
        falls = state.passive & ~equalities & (way < 0)
        fraction = xp.where(falls, xp.maximum(state.x, 0.0) / xp.where(falls, -way, 1.0), xp.inf)
        smallest = xp.min(fraction, axis=-1, keepdims=True)
        length = xp.minimum(full, smallest)
        goes = xp.any(driving, -1, keepdims=True) & (length < xp.inf)  # else it is solved, or has no solution
        leaves, ends = goes & falls & (fraction <= length) & (smallest < full), full <= smallest
        x = xp.where(goes, state.x + xp.where(goes, length, 0.0) * way, state.x)
        passive = (state.passive & ~leaves) | (goes & ends & driving)
        return _Pivoting(xp.where(leaves, 0.0, x), passive, driving & goes & ~ends, state.steps + 1, ~xp.any(goes))

    def goes_on(state: _Pivoting) -> Any:
        return ~state.done & (state.steps < STEPS_PER_ROW * b.shape[-1] + 2)

    start = (
        xp.where(equalities, _solve_passive(W, b, equalities, xp), 0.0) if xp is not np or equalities.any() else xp.zeros_like(b)
    )
    state = _Pivoting(start, equalities, equalities & False, xp.asarray(0), xp.asarray(False))
    if xp is not np:
        return jax.lax.while_loop(goes_on, step, state).passive
    while goes_on(state):
        state = step(state)
    return state.passive
