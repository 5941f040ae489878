"""User-defined stabilizations: rates within a step, or a correction at its end.

A `Stabilization` receives a `ConstraintState`: a state within a step, its residuals Psi and (Psi_dot, phi), and the least
changes, in the metric of M, that remove given residuals to first order.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Time, Vector
from udkjax.argument_types import checks_instances, require_thresholds
from udkjax.equations.laws.abstract_system import AbstractSystem, TangentPart
from udkjax.equations.laws.formulations import WrappedSystem
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import SVD
from udkjax.printing import PrintsLine


class ConstraintState(eqx.Module):
    """A state within a step of length h, and the constraints at that state.

    Attributes:
        t: time (s).
        q: coordinates (n,).
        v: velocities (n,).
        h: the length of the step (s).
        equations: the equations of motion, with their constraints.
    """

    t: Float[Array, ""]
    q: Float[Array, "n"]
    v: Float[Array, "n"]
    h: Float[Array, ""]
    equations: AbstractSystem

    @property
    def psi(self) -> Float[Array, "m"]:
        """Psi, the residuals of the constraints on positions."""
        return self.equations.violation(self.t, self.q, self.v)[0]

    @property
    def psi_dot(self) -> Float[Array, "k"]:
        """Psi_dot, and after it phi of a `ConstrainedSystem`: the residuals of the velocities."""
        return self.equations.violation(self.t, self.q, self.v)[1]

    @property
    def accelerations(self) -> Vector:
        """The accelerations a (n,)."""
        return self.equations.accelerations(self.t, self.q, self.v)

    @property
    def mass(self) -> Float[Array, "n n"]:
        """The mass matrix M (n, n)."""
        return self.equations.matrices(self.t, self.q, self.v)[0]

    def moved(self, q: Vector, v: Vector) -> "ConstraintState":
        """Return another state at the same time."""
        return eqx.tree_at(lambda s: (s.q, s.v), self, (q, v))

    def change_of_positions(self, residual: Float[Array, "m"]) -> Vector:
        """Return the least change w (n,) in the metric of M with Psi_q w = residual: M^(-1/2) D^+ residual."""
        return self._least_change(residual, len(self.psi))

    def change_of_velocities(self, residual: Float[Array, "k"]) -> Vector:
        """Return the least change w (n,) in the metric of M with A w = residual, A = Psi_q, and after it phi_v."""
        return self._least_change(residual, None)

    def _least_change(self, residual: Array, count: int | None) -> Vector:
        M, _, A, _ = self.equations.matrices(self.t, self.q, self.v)
        rows = A[:count]
        if not len(rows):
            return jnp.zeros_like(self.q)
        scales = getattr(self.equations.textbook, "scales", None)
        weights = jnp.ones(len(rows)) if scales is None or len(scales.rows) < len(rows) else scales.weights[: len(rows)]
        tol = RANK_TOL if scales is None else scales.rank_tol
        L = jnp.linalg.cholesky(M)
        D = jax.scipy.linalg.solve_triangular(L, rows.T, lower=True).T * weights[:, None]
        return jax.scipy.linalg.solve_triangular(L, SVD(tol).plus(D) @ (weights * residual), lower=True, trans=1)


class Stabilization(PrintsLine):
    """Base of stabilizations of your own, for `simulate(..., stabilization=...)`. Override one method, or both.

    `rates(at, v, a)` returns q' and v' that are integrated instead of v and a; `at.h` is the length of the present step, on which
    gains may depend. `end_of_step(at)` returns the state from which the next step starts. Both receive a `ConstraintState`, and
    are written in jax.numpy, with numbers that are fields. By default neither changes anything. diffrax integrates such runs.
    """

    def rates(self, at: ConstraintState, v: Vector, a: Vector) -> tuple[Vector, Vector]:
        """Return q' and v' at a state within a step.

        Args:
            at: the state, with its constraints.
            v: the velocities (n,).
            a: the accelerations (n,) of the equations of motion.

        Returns:
            The rates of q and v that are integrated.
        """
        del at
        return v, a

    def end_of_step(self, at: ConstraintState) -> tuple[Vector, Vector]:
        """Return q and v after a step.

        Args:
            at: the state at the end of the step, with its constraints.

        Returns:
            The state from which the next step starts.
        """
        return at.q, at.v


checks_instances(Stabilization)(require_thresholds)


class StabilizedEquations(WrappedSystem):
    """Equations whose rates a stabilization changes, in a step of length h."""

    equations: Any
    stabilization: Stabilization
    h: Float[Array, ""]

    def at(self, t: Time, q: Vector, v: Vector) -> ConstraintState:
        """Return a state with its constraints."""
        return ConstraintState(jnp.asarray(t), q, v, self.h, self.equations)

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        return self.equations.accelerations(t, q, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return self.equations.project(t, q, v)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        return self.equations.tangent_part(t, q, v, dq, dv)

    def rates(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return self.stabilization.rates(self.at(t, q, v), *self.equations.rates(t, q, v))
