"""Adams methods of variable order and step.

Order and step are chosen as in STEP by Shampine and Gordon: at the start of a run the order rises and the step doubles in every
step. Later the order falls as soon as the estimated error of a lower order is not larger, and rises after k + 1 equal steps, when
the next difference is available.
"""

from collections.abc import Callable
from typing import ClassVar, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from udkjax.annotations import Vector
from udkjax.integrate.solvers.divided_differences import (
    HIGHEST_ORDER,
    DifferenceInterpolation,
    StepCoefficients,
    step_coefficients,
)
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

# Iteration, as in VODE (Brown, Byrne, Hindmarsh, SIAM J. Sci. Stat. Comput. 10 (1989) 1038), with its names.
ITERATIONS = 3  # MAXCOR
ITERATION_SHARE = 0.1  # CORTES: largest remaining error of the iteration, relative to the tolerance
RATE_MEMORY = 0.3  # CRDOWN: largest decrease of the rate of convergence in an iteration, since one fast iteration proves little
# Choice of order and step, as in STEP (Shampine, Gordon 1975, chapter 10): a step at most doubles. Order one has less reliable
# estimates: the order changes from or to one only if this halves the error.
LARGEST_FACTOR = 2.0
HALF = 0.5
# Constants of this package: with these the error of many steps is a small multiple of the tolerance, with no more right-hand
# sides than STEP or VODE (tests/integrate/solvers/test_adams.py).
TARGET_ERROR = 0.25  # target error of the next step, relative to the tolerance; 0.5 in STEP, whose steps only halve or double
FACTORS_PER_DOUBLING = 4.0  # a step changes by powers of 2^(1/4), to be independent of rounding errors of the estimate
SMALLEST_FACTOR = 0.25  # smallest factor of a step; STEP halves once or twice
NEGLIGIBLE = 1e-4  # relative to the tolerance: smaller estimates are rounding errors
EQUAL_STEPS_TOL = 1e-2  # relative: steps that differ by less are equal
SAME_STATE_TOL = 1e-14  # relative: compiled code may compute the same state twice with different rounding
TINY = 1e-300  # replaces an error of zero in a quotient


# --- the choice of order and step

Field = Callable[[Float[Array, ""], Vector], Vector]
Size = Callable[[Float[Array, "rows n"]], Float[Array, "rows"]]


class ErrorEstimates(eqx.Module):
    """Estimated local errors of orders k - 2 to k + 1 with equal steps, relative to the tolerance."""

    k_minus_2: Float[Array, ""]
    k_minus_1: Float[Array, ""]
    k: Float[Array, ""]
    k_plus_1: Float[Array, ""]


class OrderControl(eqx.Module):
    """State of the control of order and step size."""

    order: Int[Array, ""]  # order of the next step
    step: Float[Array, ""]  # the planned next step
    equal_steps: Int[Array, ""]  # number of latest steps with equal size
    starting: Bool[Array, ""]  # whether order and step rise with every step


def first_order_control(h: Float[Array, ""]) -> OrderControl:
    """Return the state at a start: order one, a history of one value, and a first step h."""
    return OrderControl(jnp.array(1), jnp.asarray(h), jnp.array(1), jnp.array(True))


def choose_order(
    control: OrderControl, h: Float[Array, ""], points: Int[Array, ""], errors: ErrorEstimates, least: int, most: int
) -> tuple[OrderControl, Float[Array, ""]]:
    """Choose the next order and step after an accepted step.

    Args:
        control: the state before the step.
        h: the step.
        points: the number of values in the history.
        errors: the estimates of the step.
        least: the lowest order allowed.
        most: the highest order allowed.

    Returns:
        The state after the step, and the growth factor of the step.
    """
    k, e = control.order, errors
    equal_steps = jnp.where(jnp.abs(h - control.step) < EQUAL_STEPS_TOL * h, control.equal_steps + 1, 1)
    falling = jnp.where(k > 2, jnp.maximum(e.k_minus_1, e.k_minus_2) <= e.k, (k == 2) & (e.k_minus_1 <= HALF * e.k))
    falling = falling & (e.k > NEGLIGIBLE)
    # A shorter step was rejected before, except for the first step, which is a guess.
    shrunk = (h < (1 - EQUAL_STEPS_TOL) * control.step) & (points > 2)
    starting = control.starting & ~shrunk & ~falling & (k < most)

    reliable = (equal_steps > k) & (points >= k + 2)
    down = falling | (reliable & (k > 1) & (e.k_minus_1 <= jnp.minimum(e.k, e.k_plus_1)))
    up = reliable & ~down & (e.k_plus_1 < jnp.where(k > 1, 1.0, HALF) * e.k)
    up = (up | starting | (k < least)) & (k < most) & (k < points)
    down = down & ~up & (k > least)
    order = k + up - down
    error = jnp.where(down, e.k_minus_1, jnp.where(up & reliable, e.k_plus_1, e.k))
    growth = jnp.where(starting, LARGEST_FACTOR, jnp.maximum(step_factor(error, order), 1.0))
    return OrderControl(order, h * growth, equal_steps, starting), growth


def step_factor(error: Float[Array, ""], order: Int[Array, ""]) -> Float[Array, ""]:
    """Return the factor for the step after one with this error, relative to the tolerance, by a method of this order."""
    factor = (TARGET_ERROR / jnp.maximum(error, TINY)) ** (1 / (order + 1))
    return 2 ** (
        jnp.floor(FACTORS_PER_DOUBLING * jnp.log2(jnp.clip(factor, SMALLEST_FACTOR, LARGEST_FACTOR))) / FACTORS_PER_DOUBLING
    )


# --- the solver


class History(eqx.Module):
    """State of the solver at t_n: y, the modified divided differences phi of its derivative, and the choice of order and step."""

    ages: Float[Array, "N"]  # t_n - t_{n-j}, j = 0, 1, ...
    phi: Float[Array, "N y"]
    y: Vector  # the state of phi
    exact: Bool[Array, ""]  # whether phi_1 is f(t_n, y), not a value of the corrector
    points: Int[Array, ""]  # number of points, and of valid rows of phi
    control: OrderControl
    rate: Float[Array, ""]  # rate of convergence of the iteration
    evaluations: Int[Array, ""]


class Adams(Multistep):
    """Adams-Bashforth-Moulton methods of orders 1 to 12 with variable order and step.

    The integral of the polynomial through the k newest values of f predicts the next state; that of the polynomial through one
    more value corrects it (the result has order k + 1). With `corrector="pece"` that value is f at the predicted state, and f at
    the corrected state enters the history: two calls of f per accepted step, one per rejected step. With `corrector="iteration"`
    f is called until the state converges: mostly one or two calls, but less stable at larger steps. Order and step follow from
    the estimated errors of orders k - 2 to k + 1.

    Use it as any diffrax solver, with a `PIDController` of default factors, which has the tolerances; for a given sequence of
    steps, give them as `root_finder=Tolerances(rtol, atol)`. Its solver state counts `evaluations`.

    Source: L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations, 1975 (the code STEP), with
    formulas for unequal steps, and a step that follows the error more closely. The iteration stops as in VODE.

    Args:
        corrector: "pece" or "iteration".
        min_order: the lowest order, at least 1.
        max_order: the highest order, up to 12.
        root_finder: tolerances for given steps; by default those of the step controller.
        root_find_max_steps: largest number of iterations of the corrector.
    """

    corrector: Literal["pece", "iteration"] = eqx.field(default="pece", static=True)
    min_order: int = eqx.field(default=1, static=True)
    max_order: int = eqx.field(default=HIGHEST_ORDER, static=True)
    root_finder: Tolerances = eqx.field(default_factory=tolerances_from_controller)
    root_find_max_steps: int = eqx.field(default=ITERATIONS, static=True, converter=count_called("root_find_max_steps"))

    interpolation_cls: ClassVar[Callable[..., DifferenceInterpolation]] = DifferenceInterpolation

    def __check_init__(self):
        check_orders(self.min_order, self.max_order, HIGHEST_ORDER)
        if self.corrector not in ("pece", "iteration"):
            raise ValueError(f'corrector must be "pece" or "iteration", not {self.corrector!r}')

    def order(self, terms):
        return self.max_order

    def init(self, terms, t0, t1, y0, args):
        y, unravel = ravel_pytree(y0)
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        return self._begin(t1 - t0, y, _field(terms, args, unravel)(t0, y), jnp.array(1))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y, unravel = ravel_pytree(y0)
        t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
        f, h = _field(terms, args, unravel), t1 - t0
        h = jnp.where(h > 0, h, solver_state.control.step)  # for finished members of a batch
        state, displaced = self._update_newest(f, t0, h, y, solver_state, made_jump)
        k, rule, row = state.control.order, step_coefficients(h, state.ages), jnp.arange(1, self.max_order + 3)[:, None]
        star = jnp.where(row <= state.points, rule.beta[:, None] * state.phi, 0.0)
        used = jnp.where(row <= k, star, 0.0)
        predicted, slope = y + h * (rule.g @ used), jnp.sum(used, axis=0)

        size = _sizes(self.root_finder, unravel, y0, unravel(predicted))
        d, found, calls, rate = self._correct(lambda y: f(t1, y), predicted, slope, rule, size, state)
        y1 = predicted + h * rule.g[k] * d
        finite = jnp.all(jnp.isfinite(y1))
        y1 = jnp.where(finite, y1, jnp.nan)  # a value that the controller rejects

        size, estimates = _sizes(self.root_finder, unravel, y0, unravel(y1)), stop_gradients(rule)
        below = jnp.stack([d, d + star[k - 1], d + star[k - 1] + star[jnp.maximum(k - 2, 0)]])
        same, lower, lowest = estimates.errors[jnp.maximum(k - jnp.arange(3), 0)] * size(below)
        error = estimates.gains(k) * size(d[None])[0]
        accept = found & finite & (error <= 1)
        repeats = accept & ~displaced & (self.corrector == "pece")
        value = jax.lax.cond(repeats, lambda: f(t1, y1), lambda: slope + d)

        points = jnp.minimum(state.points + 1, len(row))
        phi = value - jnp.concatenate([jnp.zeros_like(star[:1]), jnp.cumsum(star, axis=0)[:-1]])
        phi = jnp.where(row <= points, phi, 0.0)
        errors = ErrorEstimates(lowest, lower, same, estimates.errors[k + 1] * size(phi[k + 1][None])[0])
        control, growth = choose_order(state.control, estimates.h, points, errors, self.min_order, self.max_order)
        shrink = jnp.where(found & finite, step_factor(error, k), SMALLEST_FACTOR)

        ages = jnp.concatenate([jnp.zeros_like(state.ages[:1]), h + state.ages[:-1]])
        exact = repeats | (self.corrector == "iteration")
        new = History(ages, phi, y1, exact, points, control, rate, state.evaluations + calls + repeats)
        dense = {"y0": y0, "ages": state.ages, "terms": jnp.where(row == k + 1, d, used)}
        y1 = unravel(y1)
        y_error = steer_error(self.root_finder, y0, y1, accept, jnp.where(accept, growth, shrink))
        return y1, y_error, dense, new, diffrax.RESULTS.successful

    def _begin(self, h: Float[Array, ""], y: Vector, f: Vector, evaluations: Int[Array, ""]) -> History:
        """Return the history at a start, whose only value is f, the derivative at y; h is the first step."""
        rows, one_point = self.max_order + 2, jnp.array(1)
        phi = jnp.zeros((rows, len(y)), y.dtype).at[0].set(f)
        return History(
            h * jnp.arange(rows),
            phi,
            y,
            jnp.array(True),
            one_point,
            first_order_control(stop_gradients(h)),
            jnp.ones_like(h),
            evaluations,
        )

    def _update_newest(
        self, f: Field, t0: Float[Array, ""], h: Float[Array, ""], y: Vector, state: History, made_jump: Flag
    ) -> tuple[History, Bool[Array, ""]]:
        """Return the history with f(t0, y) as its newest value, or a new history, and whether y was displaced.

        A displaced y, as after a projection, is not the end of the last step. It will be displaced again after this step, so that
        evaluating f at its end is left to the next step.
        """
        displaced = jnp.max(jnp.abs(y - state.y), initial=0.0) > SAME_STATE_TOL * jnp.max(jnp.abs(y), initial=0.0)
        stale = displaced | ~state.exact | made_jump
        value = jax.lax.cond(stale, lambda: f(t0, y), lambda: state.phi[0])
        calls = state.evaluations + stale
        updated = eqx.tree_at(lambda s: (s.phi, s.evaluations), state, (state.phi + (value - state.phi[0]), calls))
        lost = (h < LOST_STEP * state.control.step) | made_jump
        return jax.tree.map(lambda a, b: jnp.where(lost, a, b), self._begin(h, y, value, calls), updated), displaced

    def _correct(
        self, f: Callable[[Vector], Vector], y: Vector, slope: Vector, rule: StepCoefficients, size: Size, state: History
    ) -> tuple[Vector, Bool[Array, ""], Int[Array, ""], Float[Array, ""]]:
        """Return the excess d of f over its extrapolated value `slope`, with the result of the iteration.

        The result is: whether d converged, the number of calls of f, and the rate of convergence.
        """
        if self.corrector == "pece":
            return f(y) - slope, jnp.array(True), jnp.array(1), state.rate
        k = state.control.order
        c, weight = rule.h * rule.g[k], stop_gradients(rule).gains(k)

        def iterate(carry, _):
            d, change, rate, done, calls = carry
            now = jax.lax.cond(done, lambda: d, lambda: f(y + c * d) - slope)
            changed = weight * size((now - d)[None])[0]
            measured = jnp.where(calls == 0, rate, jnp.maximum(RATE_MEMORY * rate, changed / jnp.maximum(change, TINY)))
            rate, calls = jnp.where(done, rate, measured), calls + ~done
            done = done | (changed * jnp.minimum(rate, 1.0) <= ITERATION_SHARE)
            return (now, changed, rate, done, calls), None

        expected = stop_gradients(state.rate * rule.h / state.ages[1])  # the rate is proportional to the step
        start = (jnp.zeros_like(y), jnp.zeros_like(weight), expected, jnp.array(False), jnp.array(0))
        (d, _, rate, converged, calls), _ = jax.lax.scan(iterate, start, length=self.root_find_max_steps)
        return d, converged, calls, rate


def _field(terms: PyTree[diffrax.AbstractTerm], args: PyTree, unravel: Unravel) -> Field:
    """Return the right-hand side f of y' = f(t, y), as a function of time and the state vector y."""
    return lambda t, y: vector_field(terms, t, unravel(y), args)


def _sizes(tolerances: Tolerances, unravel: Unravel, y0: PyTree, y1: PyTree) -> Size:
    """Return a function that computes the norms of the rows of a matrix, relative to the tolerance of a step."""
    tolerances, y0, y1 = stop_gradients((tolerances, y0, y1))
    allowed = error_scale(tolerances, y0, y1)
    size = jax.vmap(lambda x: STRICTNESS * tolerances.norm(jax.tree.map(jnp.divide, unravel(x), allowed)))
    return lambda rows: size(stop_gradients(rows))
