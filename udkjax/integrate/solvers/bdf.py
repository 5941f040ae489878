"""Gear's backward differentiation formulas, of variable order and step."""

from collections.abc import Callable
from typing import ClassVar

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from udkjax.integrate.solvers import newton
from udkjax.integrate.solvers.multistep import (
    LOST_STEP,
    STRICTNESS,
    Flag,
    Multistep,
    Tolerances,
    Unravel,
    check_orders,
    count_called,
    error_scale,
    steer_error,
    tolerances_from_controller,
    vector_field,
)
from udkjax.transforms.gradients import stop_gradients

Terms = PyTree[diffrax.AbstractTerm]

HIGHEST_ORDER = 5  # order six is of little use, and order seven unstable (Hairer, Wanner II, section V.1)
# Constants of VODE (Brown, Byrne, Hindmarsh, SIAM J. Sci. Stat. Comput. 10 (1989) 1038), with its names.
LEAST_GROWTH = 1.5  # THRESH: least growth of a step; while the step is constant, M can be reused and the error estimates are good
LARGEST_FACTOR, SMALLEST_FACTOR = 10.0, 0.2  # ETAMX3, ETAMXF: factors of a step, the defaults of diffrax.PIDController
NO_DIVISION_BY_ZERO = 1e-6  # ADDON
# Ratio of the tolerance to the estimated error of the next step at orders k - 1, k and k + 1 (BIAS1, BIAS2, BIAS3: 6, 6, 10), in
# addition to STRICTNESS; and the fraction of the error that an iteration may leave (CORTES: 0.1). The numbers in brackets
# are those of VODE. With the values below, the error of many steps is a small multiple of the tolerance, and the same error needs
# no more right-hand sides than with VODE (tests/integrate/solvers/test_bdf.py).
LOWER_ORDER_BIAS, SAME_ORDER_BIAS, HIGHER_ORDER_BIAS = 10.0, 10.0, 15.0
NEWTON_SHARE = 0.02
# Constants of this package.
ORDER_CHANGE_GAIN = 1.1  # the order changes only if this allows a step larger by this factor
RETRY_TOL = 1e-3  # relative: a step smaller than planned by more than this was rejected before


class BDFState(eqx.Module):
    """The state of the solver after a step: the history, and the choice of order and step.

    The history is stored as the modified divided differences of the states accepted at times[0], times[1], ..., newest first,

        phi[i] = (times[0] - times[1]) ... (times[0] - times[i]) y[times[0], ..., times[i]],

    which for a constant step are backward differences.
    """

    times: Float[Array, "m"]
    phi: Float[Array, "m n"]
    points: Int[Array, ""]  # number of accepted states in the history
    order: Int[Array, ""]  # order of the next step
    wait: Int[Array, ""]  # steps before another order is considered
    planned: Float[Array, ""]  # the next step
    newton: newton.NewtonState

    @property
    def evaluations(self):
        """Number of calls of the vector field."""
        return self.newton.evaluations

    @property
    def jacobians(self):
        """Number of Jacobians. Each also evaluates the vector field once, and is included in `evaluations`."""
        return self.newton.jacobians

    @property
    def factorizations(self):
        """Number of factorized matrices."""
        return self.newton.factorizations


class BDFInterpolation(diffrax.AbstractLocalInterpolation):
    """The polynomial through the state at the end of a step of order k and the k states before."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    times: Float[Array, "m"]
    phi: PyTree[Array]  # (m, ...)

    def evaluate(self, t0, t1=None, left=True):
        del left
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        weights = _weights(self.times, jnp.asarray(t0))
        return jax.tree.map(lambda phi: jnp.tensordot(weights, phi, 1), self.phi)


class BDF(Multistep):
    """Backward differentiation formulas of orders 1 to 5 with variable step, for stiff equations.

    A step of order k from t - h to t satisfies y' = f(t, y) in the form

        p'(t) + (1 + 1/2 + ... + 1/k) (y - p(t)) / h = f(t, y),

    where p is the polynomial through the last k + 1 states: for a constant step Gear's formula, for a variable one its "fixed
    leading coefficient" form. The equation is solved by Newton's method with a Jacobian from forward-mode differentiation, reused
    as long as it converges. Order and step follow from the estimated errors of orders k - 1, k and k + 1.

    Use it as any diffrax solver, with a `PIDController` of default factors, which has the tolerances; for a given sequence of
    steps, give them as `root_finder=Tolerances(rtol, atol)`. Its solver state counts `evaluations`, `jacobians` and
    `factorizations`. A step whose equation could not be solved is rejected.

    Orders 3 to 5 are unstable for fast, weakly damped oscillations: `max_order=2` takes larger steps for these.

    Source: C. W. Gear, Numerical Initial Value Problems in Ordinary Differential Equations, 1971; formulas and error estimates as
    in K. E. Brenan, S. L. Campbell, L. R. Petzold, Numerical Solution of Initial-Value Problems in Differential-Algebraic
    Equations, 1996, chapter 5; the choice of order and step as in VODE (see `newton`).

    Args:
        max_order: the highest order, up to 5.
        min_order: the lowest order, at least 1.
        root_finder: tolerances for given steps; by default those of the step controller.
        root_find_max_steps: largest number of Newton iterations of a step.
    """

    max_order: int = eqx.field(default=HIGHEST_ORDER, static=True)
    min_order: int = eqx.field(default=1, static=True)
    root_finder: Tolerances = eqx.field(default_factory=tolerances_from_controller)
    root_find_max_steps: int = eqx.field(default=newton.ITERATIONS, static=True, converter=count_called("root_find_max_steps"))

    interpolation_cls: ClassVar = BDFInterpolation

    def __check_init__(self):
        check_orders(self.min_order, self.max_order, HIGHEST_ORDER)

    def order(self, terms):
        return self.max_order

    def init(self, terms, t0, t1, y0, args):
        y = ravel_pytree(y0)[0]
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        return self._begin(newton.initial_state(len(y), y.dtype), vector_field(terms, t0, y0, args), t0, t1, y)

    def _begin(
        self,
        iteration: newton.NewtonState,
        f: Float[Array, "n"],
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y: Float[Array, "n"],
    ) -> BDFState:
        """Return the history at a start: one state y, and states before it extrapolated at the rate f."""
        m, h = self.max_order + 2, t1 - t0
        phi = jnp.zeros((m, len(y)), y.dtype).at[0].set(y).at[1].set(h * f)
        one, iteration = (
            jnp.array(1),
            newton.invalidate(eqx.tree_at(lambda k: k.evaluations, iteration, iteration.evaluations + 1)),
        )
        return BDFState(jnp.asarray(t0 - h * jnp.arange(m)), phi, one, one, one + 1, jnp.asarray(h), iteration)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        unravel = ravel_pytree(y0)[1]
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        tolerances, h = stop_gradients(self.root_finder), t1 - t0
        state = self._history(terms, t0, t1, y0, args, solver_state, made_jump)
        retried = h < (1 - RETRY_TOL) * state.planned
        k = jnp.where(h < LOST_STEP * state.planned, 1, state.order)

        psi = t1 - state.times  # p and its derivative at t1, from the first k + 1 rows
        terms_at_t1 = _weights(state.times, t1)[:, None] * state.phi
        slopes = jnp.concatenate([jnp.zeros(1), jnp.cumsum(1 / psi[:-1])])
        i = jnp.arange(len(psi))
        predicted = jnp.sum(jnp.where((i <= k)[:, None], terms_at_t1, 0.0), axis=0)
        v = jnp.sum(jnp.where((i <= k)[:, None], slopes[:, None] * terms_at_t1, 0.0), axis=0)
        gamma = jnp.cumsum(1 / (1.0 + i))[k - 1]
        error = _error_constant(k, h / psi)

        size = _Size(
            tolerances.norm, unravel, ravel_pytree(error_scale(tolerances, y0, y0))[0], STRICTNESS * error / NEWTON_SHARE
        )
        equation = newton.Implicit(terms, args, unravel, t1, predicted, v, h / gamma)
        e, converged, iteration = newton.solve(equation, stop_gradients(size), state.newton, self.root_find_max_steps)
        e = jnp.where(converged, e, 0.0)

        j = i[:, None]  # new differences phi[j] = y1 - sum of the terms before j, computed from e to avoid cancellation
        signs = jnp.where((j <= i) & (i <= k), 1.0, 0.0) - jnp.where((i > k) & (i < j), 1.0, 0.0)
        phi = signs @ terms_at_t1 + e
        y1 = unravel(phi[0])

        weighed = _Size(tolerances.norm, unravel, ravel_pytree(error_scale(tolerances, y0, y1))[0], STRICTNESS)
        errors = stop_gradients(_errors(k, h / psi, phi, weighed).at[1].set(error * weighed(e)))
        accept = converged & (errors[1] <= 1)
        factor, order, wait = self._choose(k, errors, state.wait, retried)
        shrink = jnp.minimum(_factor(errors[1], k, SAME_ORDER_BIAS), jnp.where(retried, SMALLEST_FACTOR, 1.0))
        points = jnp.minimum(state.points + 1, self.max_order + 1)
        order = jnp.maximum(order, jnp.minimum(self.min_order, points))
        times = jnp.concatenate([t1[None], state.times[:-1]])
        new = BDFState(times, phi, points, order, wait, stop_gradients(h * factor), iteration)
        y_error = steer_error(tolerances, y0, y1, accept, jnp.where(accept, factor, shrink))
        y_error = jax.tree.map(lambda x: jnp.where(converged, x, jnp.inf), y_error)
        through = jnp.where((i <= k)[:, None], phi, 0.0)
        dense = {"times": times, "phi": jax.vmap(unravel)(through)}
        return y1, y_error, dense, new, diffrax.RESULTS.successful

    def _history(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y0: PyTree,
        args: PyTree,
        state: BDFState,
        made_jump: Flag,
    ) -> BDFState:
        """Return the history, shifted to end in y0 if y0 is the projection of the last state; or a new history.

        The differences of a shifted history remain smooth: with only the newest state replaced, a run projected at each step
        needed three times as many steps.
        """
        y = ravel_pytree(y0)[0]
        state = eqx.tree_at(lambda s: s.phi, state, state.phi.at[0].set(y))
        if made_jump is False:
            return state

        def begin():
            new = self._begin(state.newton, vector_field(terms, t0, y0, args), t0, t1, y)
            return jax.tree.map(lambda a, b: jnp.where(made_jump, a, b), new, state)

        return jax.lax.cond(eqxi.unvmap_any(made_jump), begin, lambda: state)

    def _choose(
        self, k: Int[Array, ""], errors: Float[Array, "3"], wait: Int[Array, ""], retried: Bool[Array, ""]
    ) -> tuple[Float[Array, ""], Int[Array, ""], Int[Array, ""]]:
        """Return, after an accepted step, the growth factor and order of the next, and the number of steps before another change.

        A better order is taken even if the step does not grow: since accepted steps do not shrink, the error may be far above
        its target.
        """
        orders = k + jnp.array([-1, 0, 1])
        wait = wait - 1
        due = (wait <= 0) & ~retried
        factors = _factor(errors, orders, jnp.array([LOWER_ORDER_BIAS, SAME_ORDER_BIAS, HIGHER_ORDER_BIAS]))
        may = jnp.array([False, True, False]) | due & (orders >= self.min_order) & (orders <= self.max_order)
        factors = jnp.where(may, factors, 0.0)
        best = jnp.argmax(factors.at[1].multiply(ORDER_CHANGE_GAIN))
        grow = (factors[best] >= LEAST_GROWTH) & ~retried
        order = jnp.where(grow | (factors[best] >= 1), orders[best], k)
        wait = jnp.where(order != k, order + 1, jnp.where(due, 2, jnp.maximum(wait, jnp.where(retried, 2, 0))))
        return jnp.where(grow, jnp.minimum(factors[best], LARGEST_FACTOR), 1.0), order, wait


class _Size(eqx.Module):
    """A function of vectors: the controller's norm of x / scale, times a factor."""

    norm: Callable[[PyTree[Array]], Float[Array, ""]]
    unravel: Unravel = eqx.field(static=True)
    scale: Float[Array, "n"]
    factor: Float[Array, ""] | float

    def __call__(self, x: Float[Array, "n"]) -> Float[Array, ""]:
        return self.factor * self.norm(self.unravel(x / self.scale))


def _weights(times: Float[Array, "m"], t: Float[Array, ""]) -> Float[Array, "m"]:
    """Return the weights w of the differences phi at a time t, where the polynomial of the history is sum_i w_i phi_i."""
    return jnp.concatenate([jnp.ones(1, times.dtype), jnp.cumprod((jnp.asarray(t) - times[:-1]) / (times[0] - times[1:]))])


def _error_constant(k: Int[Array, ""], alpha: Float[Array, "m"]) -> Float[Array, ""]:
    """Return the constant of the local error of order k, relative to the correction; alpha[i] = h / (t - times[i])."""
    i = jnp.arange(len(alpha))
    uneven = jnp.sum(jnp.where(i < k, alpha - 1 / (1.0 + i), 0.0))
    return jnp.maximum(alpha[k], jnp.abs(alpha[k] + uneven))


def _errors(k: Int[Array, ""], alpha: Float[Array, "m"], phi: Float[Array, "m n"], size: _Size) -> Float[Array, "3"]:
    """Return the norms of h^(j+1) y^(j+1) / (j + 1), the local errors of orders j = k - 1, k, k + 1 for a constant step."""
    i = jnp.arange(len(alpha))
    constants = jnp.cumprod((1.0 + i) * alpha) / (1.0 + i)
    rows = jnp.minimum(k + jnp.arange(3), len(alpha) - 1)
    return constants[rows - 1] * jax.vmap(size)(phi[rows])


def _factor(error: Float[Array, "*k"], order: Int[Array, "*k"], below: Array | float) -> Float[Array, "*k"]:
    """Return the factor by which a step with this error has to change for an error of the tolerance divided by `below`."""
    size = jnp.power(below * error, 1 / (order + 1))
    return 1 / (size + NO_DIVISION_BY_ZERO)
