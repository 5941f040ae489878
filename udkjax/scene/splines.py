"""Interpolating cubic splines, natural and periodic, written for values that may be traced.

With knots x_k, values y_k and curvatures m_k = S''(x_k), a cubic spline is, on the interval [x_i, x_i+1] of length h, with
A = (x_i+1 - x) / h and B = (x - x_i) / h,

    S(x) = A y_i + B y_i+1 + ((A^3 - A) m_i + (B^3 - B) m_i+1) h^2 / 6,

and S' is continuous where h_i-1 m_i-1 + 2 (h_i-1 + h_i) m_i + h_i m_i+1 = 6 (y_i+1 - y_i) / h_i - 6 (y_i - y_i-1) / h_i-1.
Source: de Boor, A Practical Guide to Splines, chapter 4.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float


def natural(x: Any, knots: Float[Array, " n"], values: Float[Array, " n"]) -> Any:
    """Evaluate the natural cubic spline (no curvature at the ends) at a scalar x; beyond the ends it is a straight line."""
    steps, slopes = jnp.diff(knots), jnp.diff(values) / jnp.diff(knots)
    inner = jnp.zeros(knots.size - 2, knots.dtype)
    if inner.size:
        system = jnp.diag(2 * (steps[:-1] + steps[1:])) + jnp.diag(steps[1:-1], 1) + jnp.diag(steps[1:-1], -1)
        inner = jnp.linalg.solve(system, 6 * jnp.diff(slopes))
    curvatures = jnp.pad(inner, 1)
    within = jnp.clip(x, knots[0], knots[-1])
    value, slope = _cubic(within, knots, values, curvatures)
    return value + slope * (x - within)


def periodic(x: Any, knots: Float[Array, " n"], values: Float[Array, " n"], period: Any) -> Any:
    """Evaluate the periodic cubic spline at a scalar x; the knot after the last is the first, one period on."""
    n = knots.size
    closed, around = jnp.append(knots, knots[0] + period), jnp.append(values, values[0])
    steps, slopes = jnp.diff(closed), jnp.diff(around) / jnp.diff(closed)
    before, k = jnp.roll(steps, 1), jnp.arange(n)  # row k: steps before and after knot k
    system = jnp.zeros((n, n), knots.dtype).at[k, k].add(2 * (before + steps))
    system = system.at[k, (k + 1) % n].add(steps).at[k, (k - 1) % n].add(before)
    curvatures = jnp.linalg.solve(system, 6 * (slopes - jnp.roll(slopes, 1)))
    within = knots[0] + jnp.mod(x - knots[0], period)
    return _cubic(within, closed, around, jnp.append(curvatures, curvatures[0]))[0]


def _cubic(x, knots, values, curvatures):
    """Return the spline's value and slope at x within the knots."""
    i = jnp.sum(x >= knots[1:-1])  # the interval
    h, y0, y1, m0, m1 = knots[i + 1] - knots[i], values[i], values[i + 1], curvatures[i], curvatures[i + 1]
    a, b = (knots[i + 1] - x) / h, (x - knots[i]) / h
    value = a * y0 + b * y1 + ((a**3 - a) * m0 + (b**3 - b) * m1) * h**2 / 6
    slope = (y1 - y0) / h + ((3 * b**2 - 1) * m1 - (3 * a**2 - 1) * m0) * h / 6
    return value, slope
