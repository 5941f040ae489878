"""Rules that end runs by diffrax: too much drift, in particular near singular configurations, and ranks that are too large."""

from dataclasses import replace
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from udkjax.equations.laws.abstract_system import AbstractSystem
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.states.textbook import TextbookEquations
from udkjax.integrate.problem import Problem
from udkjax.integrate.projection import violation
from udkjax.integrate.solvers.counting import CountingController
from udkjax.native.module.steps import Status
from udkjax.pinv import SVD
from udkjax.pinv.auto import NEAR_SHARE, NEAREST
from udkjax.transforms.gradients import stop_gradients

# Distance at or below which rows are dependent: eigenvalues are its square, with rounding.
DEPENDENT_DISTANCE = np.finfo(float).eps ** 0.5

STEP_ASIDE = CLOSURE.aside


def distance(equations: AbstractSystem, t: Float[ArrayLike, ""], y: Float[Array, "2n"]) -> Float[Array, ""]:
    """Return the distance of a state y = (q, v) from singular configurations, from 0 to 1.

    It is the smallest nonzero singular value of A M^(-1/2) with rows of length one.
    """
    M, _, A, _ = equations.matrices(t, *jnp.split(y, 2))
    gram = A @ jnp.linalg.solve(M, A.T)
    length = jnp.sqrt(jnp.diagonal(gram))
    unit = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    squares = jnp.linalg.eigvalsh(gram * unit[:, None] * unit)
    return jnp.sqrt(jnp.min(jnp.where(squares > DEPENDENT_DISTANCE**2 * len(A), squares, 1.0), initial=1.0))


def max_rank(problem: Problem, equations: TextbookEquations) -> Float[Array, ""]:
    """Return the largest number of independent rows along a motion; a larger rank of D is due to rounding or violated rows."""
    if equations.redundant is not None:
        return jnp.asarray(float(len(equations.scales.rows) - len(equations.redundant)))
    if problem.marks is not None:
        return jnp.sum(problem.marks > 0).astype(float)
    return _rank_near_start(problem, equations)


def _rank_near_start(problem: Problem, equations: TextbookEquations) -> Float[Array, ""]:
    """Return the larger one of the ranks of D at the start and at a closed position nearby, as in machine code (row_marks.py).

    If no such position is found, return the number of all rows.
    """
    scales, t, q, v = equations.scales, problem.ts[0], problem.q, problem.v
    by_rank = replace(equations, method=SVD(equations.rank_tol))
    random = np.random.default_rng(0).uniform(-1.0, 1.0, len(q)) * scales.coordinates(len(q))
    along = jnp.where(scales.size(v) > STEP_ASIDE.free * problem.rate, v, random)
    step = by_rank.tangent_part(t, q, v, along, jnp.zeros_like(v)).dq
    size = scales.size(step)
    is_free = size > STEP_ASIDE.free * scales.size(along)
    t, moved = (
        t + STEP_ASIDE.length / problem.rate,
        q + jnp.where(is_free, STEP_ASIDE.length / jnp.where(is_free, size, 1.0), 0.0) * step,
    )
    moved = jax.lax.fori_loop(0, STEP_ASIDE.corrections, lambda _, x: by_rank.correct(t, x, jnp.zeros_like(x))[0], moved)
    is_closed = scales.violation(by_rank.violation(t, moved, v)[0]) < CLOSURE.tol
    is_found = is_closed & (~is_free | (scales.size(moved - q) > STEP_ASIDE.stays * STEP_ASIDE.length))
    rank = jnp.maximum(by_rank.rank(problem.ts[0], q), by_rank.rank(t, moved))
    return jnp.where(is_found, rank, len(scales.rows)).astype(float)


class DriftState(NamedTuple):
    """The state of a `DriftController`."""

    inner: PyTree  # state of the wrapped controller
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

        is_small = size <= tol * NEAR_SHARE * NEAREST**2  # at any distance: most steps do not measure it
        near = jax.lax.cond(keep & ~is_small, measured, lambda _: jnp.array(0.0), 0)
        farthest = jnp.where(keep, jnp.maximum(controller_state.farthest, near), controller_state.farthest)
        nearness = jnp.maximum(near, NEAREST) / jnp.maximum(farthest, NEAREST)
        status = jnp.where(size > tol, Status.LOST, Status.SINGULAR)
        is_turned = keep & ~is_small & (size > tol * nearness**2 * jnp.maximum(nearness, NEAR_SHARE))
        status = jnp.where(is_turned, status, controller_state.status)
        result = diffrax.RESULTS.where(is_turned, diffrax.RESULTS.dt_min_reached, result)
        return keep, *times, jumped, DriftState(inner, farthest, status), result
