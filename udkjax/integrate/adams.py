"""Adams methods of variable order and step."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.adams_order import SMALLEST, TINY, Errors, Pace, after_step, begin, factor
from udkjax.integrate.differences import HIGHEST, DifferenceInterpolation, Formula, formula
from udkjax.integrate.gradients import stop_gradients
from udkjax.integrate.multistep import Multistep, check_orders, field, from_controller, scale, steered

STRICTER = 8.0  # than the tolerance: the errors of its many short steps add up
LOST = 0.05  # a step that so small a part of the one planned has to replace begins again with order one
ROUNDING = 1e-14  # relative: a compiler may compute the same state twice, and not quite the same
ITERATIONS = 3
ITERATION_SHARE = 0.1  # of the tolerance, that may be left to an iteration that stops
RATE_MEMORY = 0.3  # of the rate of convergence: a single fast iteration does not count for all


class History(eqx.Module):
    """The state of the solver at t_n."""

    ages: Float[Array, "N"]  # t_n - t_{n-j}, j = 0, 1, ...
    phi: Float[Array, "N y"]
    y: Float[Array, "y"]  # to which phi belongs
    exact: Bool[Array, ""]  # whether phi_1 is f(t_n, y), not a value that the corrector has used
    points: Int[Array, ""]  # that are known: so many rows of phi count
    pace: Pace
    rate: Float[Array, ""]  # at which the iteration converged
    evaluations: Int[Array, ""]


class Adams(Multistep):
    """Adams-Bashforth-Moulton methods of orders 1 to 12: the order and the step vary.

    The integral of the polynomial through the k newest values of f predicts the next state, that of the polynomial through one
    value more corrects it (so that the result is of order k + 1). With `corrector="pece"` the value is f at the predicted state,
    and f at the corrected state goes into the history: two calls of f a step, one where the error is too large. With
    `corrector="iteration"` f is called again until the state has converged: mostly one or two calls, but at larger steps it is
    less stable. Order and step follow from the estimated errors of orders k - 2 to k + 1.

    Use it as any diffrax solver, with a `PIDController` of default factors, which tells it the tolerances; for a given sequence
    of steps, give them as `root_finder=Tolerances(rtol, atol)`. Its solver state counts `evaluations`.

    Source: L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations, 1975 (the code STEP), with
    formulas for steps that all differ, and a step that follows the error more closely. The iteration is stopped as in VODE.
    """

    corrector: Literal["pece", "iteration"] = eqx.field(default="pece", static=True)
    min_order: int = eqx.field(default=1, static=True)
    max_order: int = eqx.field(default=HIGHEST, static=True)
    root_finder: Any = eqx.field(default_factory=from_controller)
    root_find_max_steps: int = eqx.field(default=ITERATIONS, static=True)

    interpolation_cls: ClassVar[Callable[..., DifferenceInterpolation]] = DifferenceInterpolation

    def __check_init__(self):
        check_orders(self.min_order, self.max_order, HIGHEST)
        if self.corrector not in ("pece", "iteration"):
            raise ValueError(f'corrector is "pece" or "iteration", not {self.corrector!r}')

    def order(self, terms):
        return self.max_order

    def init(self, terms, t0, t1, y0, args):
        y, unravel = ravel_pytree(y0)
        return self._begin(t1 - t0, y, _field(terms, args, unravel)(t0, y), jnp.array(1))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y, unravel = ravel_pytree(y0)
        f, h = _field(terms, args, unravel), t1 - t0
        h = jnp.where(h > 0, h, solver_state.pace.planned)  # of a member of a batch that has come to its end
        state, moved = self._newest(f, t0, h, y, solver_state, made_jump)
        k, rule, row = state.pace.order, formula(h, state.ages), jnp.arange(1, self.max_order + 3)[:, None]
        star = jnp.where(row <= state.points, rule.beta[:, None] * state.phi, 0.0)
        used = jnp.where(row <= k, star, 0.0)
        predicted, slope = y + h * (rule.g @ used), jnp.sum(used, axis=0)

        size = _sizes(self.root_finder, unravel, y0, unravel(predicted))
        d, found, calls, rate = self._correct(lambda y: f(t1, y), predicted, slope, rule, size, state)
        y1 = predicted + h * rule.g[k] * d
        finite = jnp.all(jnp.isfinite(y1))
        y1 = jnp.where(finite, y1, jnp.nan)  # what the controller is prepared for

        size, estimates = _sizes(self.root_finder, unravel, y0, unravel(y1)), stop_gradients(rule)
        below = jnp.stack([d, d + star[k - 1], d + star[k - 1] + star[jnp.maximum(k - 2, 0)]])
        same, lower, lowest = estimates.errors[jnp.maximum(k - jnp.arange(3), 0)] * size(below)
        error = estimates.gains(k) * size(d[None])[0]
        accept = found & finite & (error <= 1)
        again = accept & ~moved & (self.corrector == "pece")
        value = jax.lax.cond(again, lambda: f(t1, y1), lambda: slope + d)

        points = jnp.minimum(state.points + 1, len(row))
        phi = value - jnp.concatenate([jnp.zeros_like(star[:1]), jnp.cumsum(star, axis=0)[:-1]])
        phi = jnp.where(row <= points, phi, 0.0)
        errors = Errors(lowest, lower, same, estimates.errors[k + 1] * size(phi[k + 1][None])[0])
        pace, growth = after_step(state.pace, estimates.h, points, errors, self.min_order, self.max_order)
        shrink = jnp.where(found & finite, factor(error, k), SMALLEST)

        ages = jnp.concatenate([jnp.zeros_like(state.ages[:1]), h + state.ages[:-1]])
        exact = again | (self.corrector == "iteration")
        new = History(ages, phi, y1, exact, points, pace, rate, state.evaluations + calls + again)
        dense = {"y0": y0, "ages": state.ages, "terms": jnp.where(row == k + 1, d, used)}
        y1 = unravel(y1)
        y_error = steered(self.root_finder, y0, y1, accept, jnp.where(accept, growth, shrink))
        return y1, y_error, dense, new, diffrax.RESULTS.successful

    def _begin(self, h: Any, y: Any, f: Any, evaluations: Any) -> History:
        """A history of one value."""
        rows, one = self.max_order + 2, jnp.array(1)
        phi = jnp.zeros((rows, len(y)), y.dtype).at[0].set(f)
        return History(
            h * jnp.arange(rows), phi, y, jnp.array(True), one, begin(stop_gradients(h)), jnp.ones_like(h), evaluations
        )

    def _newest(self, f: Callable, t0: Any, h: Any, y: Any, state: History, made_jump: Any) -> tuple[History, Any]:
        """The history with f(t0, y) as its newest value, or a new one; and whether y is not where the last step ended.

        Where y was moved, it will be again: then f at the end of a step is left for the next step to call.
        """
        moved = jnp.max(jnp.abs(y - state.y), initial=0.0) > ROUNDING * jnp.max(jnp.abs(y), initial=0.0)
        stale = moved | ~state.exact | made_jump
        value = jax.lax.cond(stale, lambda: f(t0, y), lambda: state.phi[0])
        calls = state.evaluations + stale
        kept = eqx.tree_at(lambda s: (s.phi, s.evaluations), state, (state.phi + (value - state.phi[0]), calls))
        lost = made_jump | (h < LOST * state.pace.planned)
        return jax.tree.map(lambda a, b: jnp.where(lost, a, b), self._begin(h, y, value, calls), kept), moved

    def _correct(self, f: Callable, y: Any, slope: Any, rule: Formula, size: Callable, state: History) -> tuple[Any, ...]:
        """d, by which f exceeds its extrapolated value `slope`; whether it was found; calls of f; the rate of convergence."""
        if self.corrector == "pece":
            return f(y) - slope, jnp.array(True), jnp.array(1), state.rate
        k = state.pace.order
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
        (d, _, rate, found, calls), _ = jax.lax.scan(iterate, start, length=self.root_find_max_steps)
        return d, found, calls, rate


def _field(terms: Any, args: Any, unravel: Callable) -> Callable:
    """f as a function of time and of the state as a vector."""

    return lambda t, y: field(terms, t, unravel(y), args)


def _sizes(tolerances: Any, unravel: Callable, y0: Any, y1: Any) -> Callable:
    """The norms of the rows of a matrix, relative to what a step may err."""
    tolerances, y0, y1 = stop_gradients((tolerances, y0, y1))
    allowed = scale(tolerances, y0, y1)
    size = jax.vmap(lambda x: STRICTER * tolerances.norm(jax.tree.map(jnp.divide, unravel(x), allowed)))
    return lambda rows: size(stop_gradients(rows))
