"""Control of step and order, and counting, which the multistep methods of variable order share.

A method of variable order chooses its next order and step together. diffrax leaves the step to its controller, which sees an
error estimate of one fixed order. So the methods here say what they want in the language of that controller: `steer_error` gives
it an error from which `PIDController` draws the very factor that the method has chosen.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

Flag = Bool[ArrayLike, ""]
Unravel = Callable[[Float[Array, "n"]], PyTree[Array]]

SAFETY = 0.9  # of diffrax.PIDController, by default
STRICTER = 8.0  # than the tolerance: the errors of many short steps add up
LOST_STEP = 0.05  # a step that is cut to a smaller part than this starts again at order one: there was a jump
ERROR_ORDER = 2  # given to the controller: the order of the error of the first step, which is of order one


class Tolerances(eqx.Module):
    """The error that a step may make, and its norm.

    As `root_finder` of a method it stands where diffrax, looking for a root finder, puts its controller's tolerances.
    """

    rtol: Float[ArrayLike, ""]
    atol: PyTree[ArrayLike]
    norm: Callable[[PyTree[Array]], Float[Array, ""]] = optx.rms_norm


def tolerances_from_controller() -> Tolerances:
    """Return tolerances that `diffeqsolve` replaces by those of its step size controller."""
    make: Any = diffrax.with_stepsize_controller_tols
    return make(Tolerances)()


def error_scale(tolerances: Tolerances, y0: PyTree[Array], y1: PyTree[Array]) -> PyTree[Array]:
    """Return atol + rtol max(|y0|, |y1|), as the controller has it."""
    return jax.tree.map(lambda a, b: tolerances.atol + tolerances.rtol * jnp.maximum(jnp.abs(a), jnp.abs(b)), y0, y1)


def steer_error(
    tolerances: Tolerances, y0: PyTree[Array], y1: PyTree[Array], accept: Bool[Array, ""], factor: Float[Array, ""]
) -> PyTree[Array]:
    """Return an error estimate from which the controller accepts the step or not, and multiplies its size by `factor`.

    The controller takes SAFETY / norm(error / scale)^(1 / ERROR_ORDER); it never shrinks a step after one that it accepted.
    """
    factor = jnp.where(accept, jnp.maximum(factor, 1.0), jnp.minimum(factor, SAFETY * (1 - 1e-3)))
    size = (SAFETY / jax.lax.stop_gradient(factor)) ** ERROR_ORDER
    ones = jax.tree.map(jnp.ones_like, y0)
    return jax.tree.map(lambda s: size / tolerances.norm(ones) * s, error_scale(tolerances, y0, y1))


def vector_field(terms: PyTree[diffrax.AbstractTerm], t: Float[Array, ""], y: PyTree[Array], args: PyTree) -> Float[Array, "n"]:
    """Return the derivative of y, as a vector."""
    unit = terms.contr(jnp.zeros_like(t), jnp.ones_like(t))  # of the time that a step would take
    return ravel_pytree(terms.vf_prod(t, y, args, unit))[0]


def check_orders(least: int, most: int, highest: int) -> None:
    """Refuse orders that a family of methods does not have."""
    if not 1 <= least <= most <= highest:
        raise ValueError(f"1 <= min_order <= max_order <= {highest}; they are {least} and {most}")


class Multistep(diffrax.AbstractImplicitSolver, diffrax.AbstractAdaptiveSolver):
    """A multistep method of variable order and step.

    Its solver state has a field `evaluations`: the calls of the vector field in `init` and in the steps that were accepted. A
    state y0 that is not the last y1 (it was projected) replaces the newest point of the history, or moves all of it there;
    `made_jump` begins a new history.
    """

    root_finder: eqx.AbstractVar[Tolerances]
    term_structure: ClassVar = diffrax.AbstractTerm

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def error_order(self, terms):
        return ERROR_ORDER
