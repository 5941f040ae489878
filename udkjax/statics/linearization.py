"""Linearization about a position of rest, in the directions that constraints leave free: mass, damping, stiffness.

At rest F = Psi_q^T lambda. Nearby, with q = q0 + N eta and Psi_q N = 0, the loads and the constraint forces, which turn with the
bodies, give

    N^T M N eta'' + N^T C N eta' + N^T K N eta = 0,      C = -F_v,      K = -F_q + (lambda^T Psi)_qq.

The second term of K, the constraints' curvature under load, turns a pendulum's weight into a stiffness. Among redundant
constraints lambda has the least norm; N^T K N does not depend on that choice.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from udkjax.equations import constraints, loads
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.elimination.dense_pseudoinverse import dense_pseudoinverse
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.rows.dense_rows import DenseTerms
from udkjax.pinv import SVD
from udkjax.programs.control_flow import BY_JAX, ControlFlow
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism
from udkjax.statics.load_scale import LoadScale, load_scale, scale_of

CLEARLY_ALONG = 0.1  # least part of a unit vector along the constraints that determines their direction, but for one digit


class Linearization(NamedTuple):
    """The equations of small motions at a position at rest, in the free directions N, and its loads."""

    directions: Float[Array, "n f"]  # N, orthonormal in the metric of M
    mass: Float[Array, "f f"]  # the unit matrix; its derivatives vanish only to first order
    damping: Float[Array, "f f"]
    stiffness: Float[Array, "f f"]
    force: Float[Array, "f"]  # N^T F: zero at rest
    loads: Float[Array, "n"]  # F at rest
    multipliers: Float[Array, "m"]  # lambda (N, N m)


def linearize(mechanism: Mechanism, analysis: Analysis, free: int, t: ArrayLike, q: Float[Array, "n"]) -> Linearization:
    """Return the linearization at rest, in a closed position q at time t (s), with `free` degrees of freedom.

    N = M^(-1/2) (I - D^+ D) V with V a basis of the null space of D at q: N also spans the null space of D nearby, so that
    derivatives of results independent of the basis are exact.
    """
    w, root, still = analysis.scales.weights, uk.inverse_sqrt_mass(mechanism), jnp.zeros_like(q)
    F = lambda q, v: loads.force(mechanism, t, q, v)  # noqa: E731
    force = F(q, still)
    if mechanism.constraints:
        D = uk.D(mechanism, t, q, w)
        V, plus = _null_space(D, free), SVD(analysis.scales.rank_tol).plus(D)
        N = root[:, None] * (V - plus @ (D @ V))
        multipliers = w * (plus.T @ (root * force))
    else:
        N, multipliers = jnp.diag(root), jnp.zeros(0)

    def residual_force(q: Float[Array, "n"]) -> Float[Array, "n"]:
        pull = jax.grad(lambda q: jnp.sum(multipliers * constraints.psi(mechanism, t, q)))(q)
        return pull - F(q, still)

    K = jax.jacfwd(residual_force)(q)
    C = -jax.jacfwd(lambda v: F(q, v))(still)
    M = loads.mass(mechanism)
    return Linearization(N, N.T @ (M[:, None] * N), N.T @ C @ N, N.T @ K @ N, N.T @ force, force, multipliers)


def _null_space(J: Float[Array, "m n"], free: int) -> Float[Array, "n free"]:
    """Return an orthonormal basis N of `free` directions with J N = 0: right singular vectors of the smallest singular values.

    The basis has no derivatives; the projection by I - J^+ J supplies them.
    """
    J = jax.lax.stop_gradient(J)
    n = J.shape[1]
    return jnp.linalg.svd(J, full_matrices=True)[2][n - free :].T if len(J) else jnp.eye(n)


class NumpyLinearizer:
    """`linearize` and `load_scale` of a mechanism with concrete numbers, by NumPy, without traces and compilation."""

    def __init__(self, mechanism: Mechanism, analysis: Analysis, free: int):
        self._terms, self._free = DenseTerms.of(mechanism), free
        scales = jax.tree.map(np.asarray, analysis.scales)
        self._weights, self._tol = scales.weights, float(scales.rank_tol)
        self._units = np.asarray(scales.coordinates(self._terms.size))
        self._root = 1 / np.sqrt(self._terms.mass)
        self._factors = self._weights[:, None] * self._root
        self._latest: tuple[Any, Any] = None, None  # the last state and its linearization
        # In one direction, by elimination, with a vector whose tangent part that is.
        has_one = free == 1 and self._terms.count > 0 and analysis.redundant_rows == ()
        self._eliminated, self._direction = self._terms.eliminated((), None) if has_one else None, None

    def linearize(self, t: Any, q: Any) -> Any:
        """Return the linearization at rest in a closed position q at time t (s); the last one is cached."""
        key, latest = (float(t), q.tobytes()), self._latest
        if latest[0] != key:
            self._latest = latest = key, self._linearize(t, q)
        return latest[1]

    def _linearize(self, t: Any, q: Any) -> Linearization:
        if (eliminated := self._eliminate(t, q)) is not None:
            return eliminated
        terms, root, w = self._terms, self._root, self._weights
        at_rest = terms.loads_at_rest(t, q)
        if terms.count:
            D = terms.slopes(t, q)[0] * self._factors
            plus = dense_pseudoinverse(D, self._tol, self._free)
            V = plus.null_space(self._free)
            N = root[:, None] * (V - plus @ (D @ V))  # also rounding errors of V matter where masses and inertias differ by far
            multipliers = w * plus.transposed_times(root * at_rest.force)
            K = at_rest.stiffness + terms.curvature(t, q, multipliers)
        else:
            N, multipliers, K = np.diag(root), np.zeros(0), at_rest.stiffness
        NT = N.T
        reduced = NT @ (terms.mass[:, None] * N), NT @ at_rest.damping @ N, NT @ K @ N, NT @ at_rest.force
        found: tuple[Any, ...] = N, *reduced, at_rest.force, multipliers
        if self._eliminated is not None and self._direction is None:
            self._direction = N[:, 0]
        return Linearization._make(found)

    def _eliminate(self, t: Any, q: Any) -> Linearization | None:
        """Return the linearization of a mechanism with one free direction, by elimination; None if it needs singular values."""
        if self._eliminated is None or self._direction is None:
            return None
        found = self._eliminated.linearization(float(t), q, self._direction)
        if found is None or not found.square > CLEARLY_ALONG**2:
            return None
        N, force = found.u / math.sqrt(found.square), self._terms.mass * found.free
        damping, stiffness = (np.array([[x / found.square]]) for x in (found.damping, found.stiffness))
        together: tuple[Any, ...] = (
            N[:, None],
            np.ones((1, 1)),
            damping,
            stiffness,
            np.array([N @ force]),
            force,
            found.multipliers,
        )
        return Linearization._make(together)

    def scale(self, t: Any, q: Any) -> LoadScale:
        """Return the scales of forces and stiffnesses at rest in a position q at time t (s)."""
        at_rest = self._terms.loads_at_rest(t, q)
        return scale_of(at_rest.sizes, at_rest.stiffness, self._terms.mass, self._units, np)


class TracedLinearizer(NamedTuple):
    """`linearize` and `load_scale` of a mechanism whose numbers may be traced."""

    mechanism: Mechanism
    analysis: Analysis
    free: int

    def linearize(self, t: ArrayLike, q: Float[Array, "n"]) -> Linearization:
        """Return the linearization at rest in a closed position q at time t (s)."""
        return linearize(self.mechanism, self.analysis, self.free, t, q)

    def scale(self, t: ArrayLike, q: Float[Array, "n"]) -> LoadScale:
        """Return the scales of forces and stiffnesses at rest in a position q at time t (s)."""
        return load_scale(self.mechanism, self.analysis.scales, t, q)


Linearizer = NumpyLinearizer | TracedLinearizer


def linearizer(mechanism: Mechanism, analysis: Analysis, free: int, by: ControlFlow) -> Linearizer:
    """Return the linearizer of a mechanism with `free` degrees of freedom; that of concrete numbers is cached."""
    return (TracedLinearizer if by is BY_JAX else _linearizer_of_concrete)(mechanism, analysis, free)


@cached_by_identity
def _linearizer_of_concrete(mechanism: Mechanism, analysis: Analysis, free: int) -> NumpyLinearizer:
    return NumpyLinearizer(mechanism, analysis, free)


def with_unit_mass(at: Linearization, by: ControlFlow) -> tuple[Array, Array]:
    """Return damping and stiffness in directions N L^(-T) in which the mass matrix L L^T is the unit matrix."""
    if not len(at.mass):
        return at.damping, at.stiffness
    if len(at.mass) == 1:
        return at.damping / at.mass, at.stiffness / at.mass
    solve = solver_of_mass(at, by)
    damping, stiffness = (solve(solve(A).T).T for A in (at.damping, at.stiffness))
    return damping, stiffness


def solver_of_mass(at: Linearization, by: ControlFlow) -> Callable[[Any], Any]:
    """Return the function A -> L^(-1) A, with the Cholesky factor L of the mass matrix L L^T."""
    L = by.xp.linalg.cholesky(at.mass)
    return partial(jax.scipy.linalg.solve_triangular, L, lower=True) if by is BY_JAX else partial(np.linalg.solve, L)
