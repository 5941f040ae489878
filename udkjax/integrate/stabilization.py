"""User-defined stabilizations: rates within a step, or a correction at its end.

A `Stabilization` receives a `ConstraintState`: a state within a step, its residuals Psi and (Psi_dot, phi), and the least
changes, in the metric of M, that remove given residuals to first order.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Time, Vector
from udkjax.argument_types import checks_instances, require_thresholds
from udkjax.equations.laws.abstract_system import TangentPart
from udkjax.equations.laws.formulations import WrappedSystem
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
    equations: Any

    @property
    def psi(self) -> Float[Array, "m"]:
        """Psi, the residuals of the constraints on positions."""
        return self.equations.violation(self.t, self.q, self.v)[0]

    @property
    def psi_dot(self) -> Float[Array, "k"]:
        """Psi_dot, followed by phi of a `ConstrainedSystem`: the residuals of the constraints on velocities."""
        return self.equations.violation(self.t, self.q, self.v)[1]

    @property
    def accelerations(self) -> Vector:
        """The accelerations a (n,)."""
        return self.equations.accelerations(self.t, self.q, self.v)

    @property
    def mass(self) -> Float[Array, "n n"]:
        """The mass matrix M (n, n)."""
        return self.equations.mass(self.t, self.q, self.v)

    def moved(self, q: Vector, v: Vector) -> "ConstraintState":
        """Return the same step with another state, (q, v)."""
        return eqx.tree_at(lambda s: (s.q, s.v), self, (q, v))

    def change_of_positions(self, residual: Float[Array, "m"]) -> Vector:
        """Return the least change w (n,) in the metric of M with Psi_q w = residual: M^(-1/2) D^+ residual."""
        return self.equations.least_change(self.t, self.q, self.v, residual, len(self.psi))

    def change_of_velocities(self, residual: Float[Array, "k"]) -> Vector:
        """Return the least change w (n,) in the metric of M with A w = residual; A has the rows of Psi_q, then those of phi_v."""
        return self.equations.least_change(self.t, self.q, self.v, residual, len(self.psi_dot))


class Stabilization(PrintsLine):
    """Base of stabilizations of your own, for `simulate(..., stabilization=...)`. Override one method, or both.

    `rates(at, v, a)` returns q' and v' that are integrated instead of v and a; `at.h` is the length of the present step, on which
    gains may depend. `end_of_step(at)` returns the state from which the next step starts. Both receive a `ConstraintState`, and
    are written in jax.numpy, with numbers that are fields. By default neither changes anything. With explicit solvers machine
    code runs them, if it has all of their operations; diffrax has the derivatives.
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


def rates(stabilization: Stabilization, t: Any, q: Any, v: Any, h: Any, a: Any, equations: Any) -> tuple[Vector, Vector]:
    """Return q' and v' by a stabilization, at a state of `equations` with accelerations a, within a step of length h."""
    return stabilization.rates(ConstraintState(t, q, v, h, equations), v, a)


def end_of_step(stabilization: Stabilization, t: Any, q: Any, v: Any, h: Any, a: Any, equations: Any) -> tuple[Vector, Vector]:
    """Return q and v by a stabilization, after a step of length h has led to a state of `equations`; `a` is not used."""
    del a
    return stabilization.end_of_step(ConstraintState(t, q, v, h, equations))


def overridden(stabilization: Stabilization) -> dict[str, Callable[..., tuple[Vector, Vector]]]:
    """Return the methods that a stabilization overrides, by name, as the functions `rates` and `end_of_step` of this module."""
    methods = {"rates": rates, "end_of_step": end_of_step}
    return {x: f for x, f in methods.items() if getattr(type(stabilization), x) is not getattr(Stabilization, x)}


class StabilizedEquations(WrappedSystem):
    """Equations of motion within a step of length h, with the rates that a stabilization returns."""

    equations: Any
    stabilization: Stabilization
    h: Float[Array, ""]

    def at(self, t: Time, q: Vector, v: Vector) -> ConstraintState:
        """Return a state within the step as a `ConstraintState`."""
        return ConstraintState(jnp.asarray(t), q, v, self.h, self.equations)

    def accelerations(self, t: Time, q: Vector, v: Vector) -> Vector:
        return self.equations.accelerations(t, q, v)

    def project(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return self.equations.project(t, q, v)

    def tangent_part(self, t: Time, q: Vector, v: Vector, dq: Vector, dv: Vector) -> TangentPart:
        return self.equations.tangent_part(t, q, v, dq, dv)

    def rates(self, t: Time, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        return self.stabilization.rates(self.at(t, q, v), *self.equations.rates(t, q, v))
