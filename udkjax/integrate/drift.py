"""Drift of runs that are not projected, relative to the distance from singular configurations, for integrators of diffrax."""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from udkjax.equations.abstract_system import AbstractSystem
from udkjax.integrate.projection import violation
from udkjax.integrate.solvers.counting import CountingController
from udkjax.native.base.steps import Status
from udkjax.pinv.auto import NEAREST
from udkjax.transforms.gradients import stop_gradients

DEPENDENT = np.finfo(float).eps ** 0.5  # distance at or below which rows are dependent: eigenvalues are its square, with rounding


def distance(equations: AbstractSystem, t: Float[ArrayLike, ""], y: Float[Array, "2n"]) -> Float[Array, ""]:
    """Return the smallest nonzero singular value of A M^(-1/2), with rows of length one, at a state y."""
    M, _, A, _ = equations.matrices(t, *jnp.split(y, 2))
    gram = A @ jnp.linalg.solve(M, A.T)
    length = jnp.sqrt(jnp.diagonal(gram))
    unit = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    squares = jnp.linalg.eigvalsh(gram * unit[:, None] * unit)
    return jnp.sqrt(jnp.min(jnp.where(squares > DEPENDENT**2 * len(A), squares, 1.0), initial=1.0))


class DriftState(NamedTuple):
    """The state of a `DriftController`."""

    inner: PyTree
    farthest: Float[Array, ""]  # largest distance from singular configurations so far
    status: Int[Array, ""]  # RUNNING, LOST or SINGULAR


class DriftController(diffrax.AbstractAdaptiveStepSizeController):
    """A step size controller that ends a run whose accepted state has drifted too far, by the rule of machine code
    (controller.py)."""

    controller: CountingController
    drift_tol: Float[Array, ""]

    def __init__(self, controller: CountingController, drift_tol: Float[Array, ""]):
        self.controller, self.drift_tol = controller, drift_tol

    @property
    def rtol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self):  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.norm

    def wrap(self, direction):
        return DriftController(self.controller.wrap(direction), self.drift_tol)

    def init(self, *args, **kwargs):
        tnext, state = self.controller.init(*args, **kwargs)
        return tnext, DriftState(state, jnp.array(0.0), jnp.array(Status.RUNNING))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        keep, *times, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state.inner
        )
        equations, before, t, y, tol = stop_gradients((args, (t0, y0), t1, y1_candidate, self.drift_tol))
        size = violation(equations, t, y)

        def measured(_: Array) -> Array:
            return jnp.maximum(distance(equations, t, y), distance(equations, *before))

        is_small = size <= tol * NEAREST**2  # at any distance: most steps do not measure it
        near = jax.lax.cond(keep & ~is_small, measured, lambda _: jnp.array(0.0), 0)
        farthest = jnp.where(keep, jnp.maximum(controller_state.farthest, near), controller_state.farthest)
        nearness = jnp.maximum(near, NEAREST) / jnp.maximum(farthest, NEAREST)
        status = jnp.where(size > tol, Status.LOST, Status.SINGULAR)
        is_turned = keep & ~is_small & (size > tol * nearness**2)
        status = jnp.where(is_turned, status, controller_state.status)
        result = diffrax.RESULTS.where(is_turned, diffrax.RESULTS.dt_min_reached, result)
        return keep, *times, jumped, DriftState(inner, farthest, status), result
