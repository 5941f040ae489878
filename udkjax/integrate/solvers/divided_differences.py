"""The polynomial through the newest values of f that Adams methods integrate.

The values at the times t_n > t_{n-1} > ... are stored as Krogh's modified divided differences, which are of the size of f:

    phi_i(n) = psi_1(n) ... psi_{i-1}(n) f[t_n, ..., t_{n-i+1}],        psi_i(n) = t_n - t_{n-i}.

For the step from t_n to t_{n+1} = t_n + h, with psi_i(n+1) = h + psi_{i-1}(n), the k newest are interpolated by

    P(t_n + s h) = sum_{i<=k} c_i(s) phi*_i,        c_i(s) = prod_{j<i} (s h + psi_{j-1}(n)) / psi_j(n+1),
    phi*_i = beta_i phi_i(n),                       beta_i = prod_{j<i} psi_j(n+1) / psi_j(n).

c_{k+1} is zero at these k times and one at t_{n+1}: P + c_{k+1} d is the polynomial through one more value, d above P(t_{n+1}).
The differences at t_{n+1}, where f is P(t_{n+1}) + d, are phi_i(n+1) = f - sum_{j<i} phi*_j.

L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations, 1975, chapters 5 and 6.
"""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

HIGHEST_ORDER = 12  # highest order; methods of higher orders are hardly stable
# Gauss points and weights on [0, 1]: they integrate every c_i exactly, and without cancellation, since no c_i is negative.
GAUSS_POINTS, GAUSS_WEIGHTS = (
    0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(HIGHEST_ORDER // 2 + 1), (1.0, 0.0))
)


def _adams_moulton(count: int) -> np.ndarray:
    """Return |gamma*_0|, |gamma*_1|, ... of Adams-Moulton methods with a constant step, in terms of backward differences."""
    gamma = np.zeros(count)
    for i in range(count):
        gamma[i] = (i == 0) - sum(gamma[j] / (i + 1 - j) for j in range(i))
    return np.abs(gamma)


GAMMA = _adams_moulton(HIGHEST_ORDER + 2)


class StepCoefficients(eqx.Module):
    """The coefficients of a step, which depend only on its times. Index 0 is i = 1."""

    h: Float[Array, ""]
    beta: Float[Array, "N"]
    g: Float[Array, "N"]  # integrals of c_i from 0 to 1
    errors: Float[Array, "N"]  # h sigma_j |gamma*_j|: times phi_{j+1}(n+1), the local error of order j for constant steps h

    def gains(self, k: Int[Array, ""]) -> Float[Array, ""]:
        """Return the difference between the results of orders k and k + 1, over d: a positive number."""
        return self.h * jnp.abs(self.g[k - 1] - self.g[k])


def step_coefficients(h: Float[Array, ""], ages: Float[Array, "N"]) -> StepCoefficients:
    """Return the coefficients of a step h, from the ages psi_0(n) = 0, psi_1(n), ... of the values."""
    j = jnp.arange(1, len(ages))
    ahead = h + ages[:-1]
    beta = jnp.concatenate([jnp.ones_like(ages[:1]), jnp.cumprod(ahead / ages[1:])])
    sigma = jnp.concatenate([jnp.ones_like(ages[:1]), jnp.cumprod(j * h / ahead)])
    return StepCoefficients(h, beta, integrate_basis(jnp.ones(()), h, ages), h * sigma * GAMMA[: len(ages)])


def integrate_basis(s: Float[Array, ""], h: Float[Array, ""], ages: Float[Array, "N"]) -> Float[Array, "N"]:
    """Return the integrals of c_1, ..., c_N from 0 to s."""
    at = s * GAUSS_POINTS[:, None]
    factors = (at * h + ages[:-1]) / (h + ages[:-1])
    c = jnp.concatenate([jnp.ones_like(factors[:, :1]), jnp.cumprod(factors, axis=1)], axis=1)
    return s * (GAUSS_WEIGHTS @ c)


class DifferenceInterpolation(diffrax.AbstractLocalInterpolation):
    """The states within an accepted step: y0 plus the integral of the polynomial of f, of the order of the step."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: PyTree[Array]
    ages: Float[Array, "N"]
    terms: Float[Array, "N y"]  # phi*_1, ..., phi*_k, d, 0, ...

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        y0, unravel = ravel_pytree(self.y0)
        h = jnp.where(self.t1 == self.t0, 1.0, self.t1 - self.t0)
        s = jnp.asarray((t0 - self.t0) / h)
        return unravel(y0 + h * (integrate_basis(s, h, self.ages) @ self.terms))
