"""The positions of a driven mechanism as a curve Psi(s, q) = 0 in scaled coordinates and value: X = (q, s)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.equations.constraints import gamma, psi
from udkjax.equations.position_closure import ROUNDING_UNITS
from udkjax.equations.scales import RANK_TOL
from udkjax.pinv import SVD, Plus
from udkjax.scene.mechanism import Mechanism
from udkjax.study.drive import Driven

NEWTON_STEPS = 8  # corrections; three are usual
_Correction = tuple[Array, Array, Array]  # X, corrections so far, whether it is closed


class Curve(eqx.Module):
    """The positions of a driven mechanism, as a curve in scaled coordinates and value."""

    mechanism: Mechanism
    weights: Float[Array, "m"]
    units: Float[Array, "n+1"]
    rows: Float[Array, "m"]

    @classmethod
    def of(cls, driven: Driven) -> "Curve":
        scales = driven.analysis.scales
        units = jnp.append(scales.coordinates(driven.analysis.coordinates), driven.unit)
        return cls(driven.mechanism, scales.weights, units, scales.rows)

    def residual(self, X: Float[Array, "n+1"]) -> Float[Array, "m"]:
        x = X * self.units
        return self.weights * psi(self.mechanism, x[-1], x[:-1])

    def slopes(self, X: Float[Array, "n+1"]) -> Float[Array, "m n+1"]:
        return jax.jacfwd(self.residual)(X)

    def is_closed(self, X: Float[Array, "n+1"]) -> Bool[Array, ""]:
        """Return True if the residual is what rounding leaves of it."""
        size = jnp.max(jnp.abs(self.residual(X) / (self.weights * self.rows)), initial=0.0)
        return size <= ROUNDING_UNITS * float(jnp.finfo(X.dtype).eps) * jnp.maximum(1.0, jnp.max(jnp.abs(X)))

    def correct(self, X: Float[Array, "n+1"], fixed: Bool[Array, ""] | bool = False) -> tuple[Array, Bool[Array, ""]]:
        """Return the nearest point of the curve; `fixed`: of the same value. And whether there is one."""
        if not len(self.rows):  # nothing binds the coordinates
            return X, jnp.asarray(True)

        def body(state: _Correction) -> _Correction:
            X, k, _ = state
            E = self.slopes(X)
            E = jnp.where(fixed & (jnp.arange(len(X)) == len(X) - 1), 0.0, E)
            return X - plus(E) @ self.residual(X), k + 1, self.is_closed(X)

        def is_unfinished(state: _Correction) -> Bool[Array, ""]:  # the last correction is that of a closed point, to rounding
            _, k, closed = state
            return (k < NEWTON_STEPS) & ~closed

        X, _, closed = jax.lax.while_loop(is_unfinished, body, (X, jnp.asarray(0), jnp.asarray(False)))
        return X, closed

    def clearance(self, X: Float[Array, "n+1"]) -> Float[Array, ""]:
        """Return how far E is from losing rank, as where branches meet: its n-th singular value over the largest."""
        E = self.slopes(X)
        if min(E.shape) < len(X) - 1:
            return jnp.zeros(())
        sigma = jnp.linalg.svd(E, compute_uv=False)
        return sigma[len(X) - 2] / jnp.where(sigma[0] > 0, sigma[0], 1.0)

    def tangent(self, X: Float[Array, "n+1"], before: Float[Array, "n+1"]) -> Float[Array, "n+1"]:
        E = self.slopes(X)
        tau = before - plus(E) @ (E @ before)
        size = jnp.linalg.norm(tau)
        return tau / jnp.where(size > 0, size, 1.0)


def plus(E: Float[Array, "m n"], tol: float = RANK_TOL) -> Plus:
    """Return E^+, truncated where singular values are below `tol` of the largest."""
    return SVD(tol).plus(E)


def derivatives(curve: Curve, s: Float[Array, ""], q: Float[Array, "n"]) -> tuple[Array, Array, Array]:
    """Return q' = dq/ds and q'' (n,) at a closed position, and the rank of Psi_q: Psi_q q' = -Psi_s, Psi_q q'' = gamma."""
    W, w, mechanism = curve.units[:-1], curve.weights, curve.mechanism
    E = w[:, None] * jax.jacfwd(lambda q: psi(mechanism, s, q))(q) * W
    inverse = plus(E)
    rate = jax.jvp(lambda s: psi(mechanism, s, q), (s,), (jnp.ones_like(s),))[1]
    dq = -W * (inverse @ (w * rate))
    return dq, W * (inverse @ (w * gamma(mechanism, s, q, dq))), inverse.rank
