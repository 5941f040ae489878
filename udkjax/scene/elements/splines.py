"""Interpolating cubic splines, natural and periodic, for values that may be traced.

With knots x_k, values y_k and curvatures m_k = S''(x_k), a cubic spline is, on the interval [x_i, x_i+1] of length h_i, with
s = x - x_i,

    S(x) = y_i + ((y_i+1 - y_i) / h_i - h_i (2 m_i + m_i+1) / 6) s + m_i / 2 s^2 + (m_i+1 - m_i) / (6 h_i) s^3,

and S' is continuous where h_i-1 m_i-1 + 2 (h_i-1 + h_i) m_i + h_i m_i+1 = 6 (y_i+1 - y_i) / h_i - 6 (y_i - y_i-1) / h_i-1.
Source: de Boor, A Practical Guide to Splines, chapter 4.

The functions of this module use only arithmetic, selections and loops of fixed length, so that they can become machine code.
"""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import AnyArray, Number


def natural_spline(x: Number, knots: Float[Array, " n"], values: Float[Array, " n"]) -> Array:
    """Evaluate the natural cubic spline (zero curvature at the ends) at a scalar x; beyond the ends it is a straight line."""
    return _evaluate(x, spline_pieces(knots, values, jnp))


def spline_pieces(knots: AnyArray, values: AnyArray, xp: ModuleType) -> AnyArray:
    """Return the pieces of the natural cubic spline, including the straight lines before and after it, by NumPy or JAX.

    Args:
        knots: increasing (n,).
        values: values at the knots (n,).
        xp: NumPy or jax.numpy.

    Returns:
        (n + 1, 5): the start of each piece, and the coefficients of the powers of x - start. Two knots give a single piece.
    """
    steps, slopes = xp.diff(knots), xp.diff(values) / xp.diff(knots)
    if len(knots) == 2:
        return xp.stack([knots[0], values[0], slopes[0], 0 * slopes[0], 0 * slopes[0]])[None]
    system = 2 * (steps[:-1] + steps[1:]), steps[1:-1], 6 * xp.diff(slopes)[:, None]
    inner = (_tridiagonal_by_numpy if xp is np else _tridiagonal)(*system)[:, 0]
    end = xp.zeros(1)
    inside = _cubics(knots, values, xp.concatenate([end, inner, end]), xp)
    first_line = xp.stack([knots[0], values[0], inside[0, 2], end[0], end[0]])
    _, _, slope, half_curvature, _ = inside[-1]
    last_line = xp.stack([knots[-1], values[-1], slope + steps[-1] * half_curvature, end[0], end[0]])
    return xp.concatenate([first_line[None], inside, last_line[None]])


def periodic_spline(x: Number, knots: Float[Array, " n"], values: Float[Array, " n"], period: Number) -> Array:
    """Evaluate the periodic cubic spline through at least three knots at a scalar x; the first knot follows the last."""
    n = knots.size
    all_knots, all_values = jnp.append(knots, knots[0] + period), jnp.append(values, values[0])
    steps, slopes = jnp.diff(all_knots), jnp.diff(all_values) / jnp.diff(all_knots)
    right = 6 * (slopes - jnp.roll(slopes, 1))
    # Without its last row and column, the system is tridiagonal (Schur complement).
    diagonal = 2 * (jnp.roll(steps, 1) + steps)
    corner = jnp.concatenate([steps[-1:], jnp.zeros(n - 3, knots.dtype), steps[-2:-1]])
    particular, response = _tridiagonal(diagonal[:-1], steps[: n - 2], jnp.stack([right[:-1], corner], 1)).T
    last = (right[-1] - jnp.sum(corner * particular)) / (diagonal[-1] - jnp.sum(corner * response))
    curvatures = jnp.append(particular - last * response, last)
    return _evaluate(wrap(x, knots[0], period), _cubics(all_knots, all_values, jnp.append(curvatures, curvatures[0]), jnp))


def wrap(x: Number, start: Number, period: Number) -> Array:
    """Return x shifted by a multiple of the period into [start, start + period)."""
    return x - period * jnp.floor((x - start) / period)


def count_knots(x: Number, knots: Float[Array, " n"]) -> Array:
    """Return the number of knots that are at most x, as a float."""
    return jnp.sum(jnp.where(x >= knots, 1.0, 0.0))


def _cubics(knots: AnyArray, values: AnyArray, curvatures: AnyArray, xp: ModuleType) -> AnyArray:
    """Return the cubics between neighbouring knots as rows (n - 1, 5) of `spline_pieces`."""
    steps, m = xp.diff(knots), curvatures
    slopes = xp.diff(values) / steps - steps * (2 * m[:-1] + m[1:]) / 6
    return xp.stack([knots[:-1], values[:-1], slopes, m[:-1] / 2, xp.diff(m) / (6 * steps)], 1)


def _evaluate(x: Number, pieces: Float[Array, "pieces 5"]) -> Array:
    """Return the value at x of the piece that contains it."""
    starts = pieces[1:, 0]
    inside = jnp.append(True, x >= starts) & jnp.append(x < starts, True)
    start, *c = jnp.sum(jnp.where(inside[:, None], pieces, 0.0), 0)
    s = x - start
    return ((c[3] * s + c[2]) * s + c[1]) * s + c[0]


def _tridiagonal_by_numpy(diagonal: np.ndarray, off_diagonal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve as `_tridiagonal` does, for a single column, by Python floats: nothing has to be compiled for each length."""
    pivots, solution, links = diagonal.tolist(), right[:, 0].tolist(), off_diagonal.tolist()
    for k, link in enumerate(links):
        factor = link / pivots[k]
        pivots[k + 1] -= factor * link
        solution[k + 1] -= factor * solution[k]
    for k in reversed(range(len(solution))):
        coupled = links[k] * solution[k + 1] if k < len(links) else 0.0
        solution[k] = (solution[k] - coupled) / pivots[k]
    return np.array(solution)[:, None]


def _tridiagonal(
    diagonal: Float[Array, " n"], off_diagonal: Float[Array, " n-1"], right: Float[Array, "n k"]
) -> Float[Array, "n k"]:
    """Solve a symmetric, diagonally dominant tridiagonal system for right-hand sides that are columns (n, k)."""

    def eliminate(carry, row):
        pivot, reduced = carry
        diagonal_entry, link, right_entry = row
        factor = link / pivot
        following = diagonal_entry - factor * link, right_entry - factor * reduced
        return following, following

    def substitute(following, row):
        pivot, right, link = row
        solution = (right - link * following) / pivot
        return solution, solution

    if not len(diagonal):
        return right
    zero = jnp.zeros(1, diagonal.dtype)
    start = jnp.ones((), diagonal.dtype), jnp.zeros_like(right[0])
    _, (pivots, rights) = jax.lax.scan(eliminate, start, (diagonal, jnp.append(zero, off_diagonal), right))
    rows = pivots, rights, jnp.append(off_diagonal, zero)
    return jax.lax.scan(substitute, jnp.zeros_like(right[0]), rows, reverse=True)[1]
