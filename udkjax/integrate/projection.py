"""Projection: return states to the constraint manifold."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from udkjax.argument_types import checks_instances, require_thresholds
from udkjax.equations.laws.abstract_system import AbstractSystem, TangentPart
from udkjax.native.module.steps import NORMAL_ERROR_WEIGHT
from udkjax.printing import PrintsLine
from udkjax.transforms.gradients import stop_gradients

STATES_AT_ONCE = 64  # evaluated together at outputs: the memory that they take is limited, and there are few loops


class Projection(PrintsLine):
    """Project positions and velocities after each step, by the smallest change in the mass metric (the default stabilization)."""


checks_instances(Projection)(require_thresholds)


def project(equations: AbstractSystem, t: Float[ArrayLike, ""], y: Float[Array, "2n"]) -> Float[Array, "2n"]:
    """Return the state y = (q, v), projected to the constraint manifold."""
    q, v = jnp.split(y, 2)
    return jnp.concatenate(equations.project(t, q, v))


def error_after_projection(
    equations: AbstractSystem, t: Float[ArrayLike, ""], q: Array, v: Array, dq: Array, dv: Array
) -> TangentPart:
    """Return the errors dq and dv of a step, with the part that projection removes multiplied by `NORMAL_ERROR_WEIGHT`.

    The state (q, v) is that at the end of the step, after projection.
    """
    equations, t, q, v, dq, dv = stop_gradients((equations, t, q, v, dq, dv))
    tangent = equations.tangent_part(t, q, v, dq, dv)
    return TangentPart(tangent.dq + NORMAL_ERROR_WEIGHT * (dq - tangent.dq), tangent.dv + NORMAL_ERROR_WEIGHT * (dv - tangent.dv))


def violation(equations: AbstractSystem, t: Float[ArrayLike, ""], y: Float[Array, "2n"]) -> Float[Array, ""]:
    """Return the largest |Psi_i| over its scale, among all rows, including those left out as redundant."""
    if not equations.constrained:
        return jnp.zeros(())
    equations, t, y = stop_gradients((equations, t, y))
    return equations.violation_size(equations.violation(t, *jnp.split(y, 2))[0])


def project_all(equations: AbstractSystem, ts: Float[Array, "T"], ys: Float[Array, "T 2n"]) -> Float[Array, "T 2n"]:
    """Return states at many times, each projected onto the manifold.

    Interpolated states are farther from the manifold than the ends of steps, so they are projected twice.
    """
    return jax.lax.map(lambda at: project(equations, at[0], project(equations, *at)), (ts, ys), batch_size=STATES_AT_ONCE)
