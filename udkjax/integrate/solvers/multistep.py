"""Control of step and order, common to the multistep methods of variable order.

A method of variable order chooses its next order and step together. diffrax leaves the step to its controller, which expects an
error estimate of fixed order. `steer_error` therefore returns an error from which `PIDController` computes exactly the factor
that the method has chosen.
"""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from udkjax.requirements import require_count

Flag = Bool[ArrayLike, ""]
Unravel = Callable[[Float[Array, "n"]], PyTree[Array]]

SAFETY = 0.9  # default of diffrax.PIDController
STRICTNESS = 8.0  # ratio of the tolerance to the target error of a step, since the errors of many short steps add up
LOST_STEP = 0.05  # a step cut to a smaller fraction restarts at order one: there was a jump
ERROR_ORDER = 2  # for the controller: the order of the error of the first step, which has order one


class Tolerances(eqx.Module):
    """The tolerances of a step, and the norm of its error.

    As `root_finder` of a method they receive the controller's tolerances from diffrax.
    """

    rtol: Float[ArrayLike, ""]
    atol: PyTree[ArrayLike]
    norm: Callable[[PyTree[Array]], Float[Array, ""]] = optx.rms_norm


def tolerances_from_controller() -> Tolerances:
    """Return placeholders that `diffeqsolve` replaces by the tolerances of its step size controller."""
    make: Any = diffrax.with_stepsize_controller_tols
    return make(Tolerances)()


def error_scale(tolerances: Tolerances, y0: PyTree[Array], y1: PyTree[Array]) -> PyTree[Array]:
    """Return atol + rtol max(|y0|, |y1|), as in the controller."""
    return jax.tree.map(lambda a, b: tolerances.atol + tolerances.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)), y0, y1)


def steer_error(
    tolerances: Tolerances, y0: PyTree[Array], y1: PyTree[Array], accept: Bool[Array, ""], factor: Float[Array, ""]
) -> PyTree[Array]:
    """Return an error estimate that makes the controller accept or reject the step, and multiply it by `factor`.

    The controller's factor is SAFETY / norm(error / scale)^(1 / ERROR_ORDER); it never shrinks a step after an accepted one.
    """
    factor = jnp.where(accept, jnp.maximum(factor, 1.0), jnp.minimum(factor, SAFETY * (1 - 1e-3)))
    size = (SAFETY / jax.lax.stop_gradient(factor)) ** ERROR_ORDER
    ones = jax.tree.map(jnp.ones_like, y0)
    return jax.tree.map(lambda s: size / tolerances.norm(ones) * s, error_scale(tolerances, y0, y1))


def vector_field(terms: PyTree[diffrax.AbstractTerm], t: Float[Array, ""], y: PyTree[Array], args: PyTree) -> Float[Array, "n"]:
    """Return the derivative of y by the terms of a diffrax problem, as a vector."""
    unit = terms.contr(jnp.zeros_like(t), jnp.ones_like(t))  # unit control of the term
    return ravel_pytree(terms.vf_prod(t, y, args, unit))[0]


def count_called(name: str) -> Callable[[Any], int]:
    """Return a converter of the argument `name` to an int of at least 1, for static fields, which cannot be arrays."""

    def convert(value: Any) -> int:
        require_count(name, value)
        return int(value)

    return convert


def check_orders(least: int, most: int, highest: int) -> None:
    """Raise `ValueError` unless the orders `least` and `most` of a method satisfy 1 <= least <= most <= highest."""
    for name, order in (("min_order", least), ("max_order", most)):
        require_count(name, order, least=-math.inf)
    if not 1 <= least <= most <= highest:
        raise ValueError(f"orders must satisfy 1 <= min_order <= max_order <= {highest}, not min_order={least}, max_order={most}")


class Multistep(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
    """A multistep method of variable order and step.

    Its solver state has a field `evaluations`: the calls of the vector field in `init` and in accepted steps. A state y0 that
    differs from the last y1, as after a projection, replaces the newest point of the history, or shifts the whole history;
    `made_jump` starts a new history.
    """

    root_finder: eqx.AbstractVar[Tolerances]
    term_structure: ClassVar = diffrax.AbstractTerm

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def error_order(self, terms):
        return ERROR_ORDER
