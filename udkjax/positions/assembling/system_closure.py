"""Closing of a user-defined system: Psi = 0 by damped Gauss-Newton steps, then Psi_dot = 0 and phi = 0.

A closed state is differentiated through a last Newton step, at which all residuals vanish: first derivatives with respect to the
numbers of the system are exact, those with respect to the guess are those of a projection.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from udkjax.annotations import Time, Vector
from udkjax.equations.rows.position_closure import CLOSURE, close_position
from udkjax.equations.states.quantities import equations_of
from udkjax.pinv import SVD
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined
from udkjax.transforms.gradients import stop_gradients


class SystemRows(NamedTuple):
    """The constraints of a user-defined system, in the interface `Rows` with which `close_position` closes them."""

    equations: Any

    @property
    def scales(self) -> Any:
        return self.equations.scales

    def residual(self, t: Time, q: Array) -> Array:
        return self.equations.violation(t, q, jnp.zeros_like(q))[0]

    def correction(self, t: Time, q: Array) -> Array:
        return self.equations.correct_position(t, q) - q


@deferred
@defined
def close_system(system: Any, t: Array, q: Vector, v: Vector) -> tuple[Any, ...]:
    """Return a state of a system with Psi = 0, Psi_dot = 0 and phi = 0, near a given one, with its residuals.

    Args:
        system: The system, of traced functions.
        t: Time (s).
        q: Coordinates (n,) from which to start.
        v: Velocities (n,).

    Returns:
        q and v of the closed state; Psi, and Psi_dot followed by phi, which exceed `CLOSURE.tol` if no closed state is near;
        the rank of (Psi_q; phi_v) M^(-1/2), and the scales.
    """
    equations: Any = equations_of(system, SVD())
    fixed, at, start = stop_gradients((equations, t, q))
    closed = close_position(SystemRows(fixed), at, start) if system.constraint is not None else start
    corrected = equations.correct_position(t, stop_gradients(closed) + q - start)
    closed = stop_gradients(closed) + corrected - stop_gradients(corrected)
    velocity = v
    for _ in range(CLOSURE.velocities + 1):
        velocity = equations.correct_velocity(t, closed, velocity)
    psi, rates = equations.violation(t, closed, velocity)
    rank = stop_gradients(equations.rank(t, closed, velocity))
    return closed, velocity, psi, rates, rank, fixed.scales
