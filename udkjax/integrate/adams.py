"""Adams methods of variable order and step.

The history of f at the times t_n > t_{n-1} > ... is kept as the modified divided differences of Krogh,

    phi_i(n) = psi_1(n) ... psi_{i-1}(n) f[t_n, ..., t_{n-i+1}],        psi_i(n) = t_n - t_{n-i},

which stay of the size of f. For the step from t_n to t_{n+1} = t_n + h, with psi_i(n+1) = h + psi_{i-1}(n),

    phi*_i = beta_i phi_i(n),       beta_i = prod_{j<i} psi_j(n+1) / psi_j(n),
    f(t_n + s h) ~ P(s) = sum_{i<=k} c_i(s) phi*_i,      c_i(s) = prod_{j<i} (s h + psi_{j-1}(n)) / psi_j(n+1),

P interpolates the k newest values. Its integral predicts p; with f at p one point more is known, and the polynomial of degree k through
it, P(s) + c_{k+1}(s) (f(t_{n+1}, p) - P(1)), is integrated to y_{n+1}. The integrals of c_i are sums over Gauss's points: exact, and of
positive terms. L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations (1975), chapters 5 to 7.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from udkjax.integrate.multistep import Multistep, from_controller, scale, steered

HIGHEST = 12
LOST = 0.05  # a step that so small a part of the one planned has to replace begins again with order one
NODES, WEIGHTS = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(HIGHEST // 2 + 1), (1.0, 0.0)))


def _constant_steps(count: int) -> np.ndarray:
    """|gamma*_i|, i = 0, 1, ...: what the i-th difference adds to a corrected step, all steps being equal."""
    gamma = np.zeros(count)
    for i in range(count):
        gamma[i] = (i == 0) - sum(gamma[j] / (i + 1 - j) for j in range(i))
    return np.abs(gamma)


class History(eqx.Module):
    """The state of the solver at t_n."""

    ages: Float[Array, "N"]  # t_n - t_{n-j}, j = 0, 1, ...
    phi: Float[Array, "N y"]
    y: Float[Array, "y"]  # to which phi belongs
    points: Int[Array, ""]  # that are known: so many rows of phi count
    order: Int[Array, ""]  # of the next step
    planned: Float[Array, ""]  # size of the next step
    even: Int[Array, ""]  # so many steps of equal size have been made
    starting: Bool[Array, ""]  # order and step rise with each step
    exact: Bool[Array, ""]  # whether phi_1 is f(t_n, y), not f at the predicted state
    evaluations: Int[Array, ""]


def _integrals(s: Any, h: Any, ages: Float[Array, "N"]) -> Float[Array, "N"]:
    """The integrals of c_1, ..., c_N from 0 to s."""
    at = s * NODES[:, None]
    factors = (at * h + ages[:-1]) / (h + ages[:-1])
    c = jnp.concatenate([jnp.ones_like(at), jnp.cumprod(factors, axis=1)], axis=1)
    return s * (WEIGHTS @ c)


class AdamsInterpolation(diffrax.AbstractLocalInterpolation):
    """The polynomial that the step itself has integrated."""

    t0: Any
    t1: Any
    y0: Any
    ages: Any
    terms: Any  # phi*_1, ..., phi*_k, f(t1, p) - P(1), 0, ...

    def __init__(self, *, t0, t1, y0, ages, terms):
        self.t0, self.t1, self.y0, self.ages, self.terms = t0, t1, y0, ages, terms

    def evaluate(self, t0, t1=None, left=True):
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        h = self.t1 - self.t0
        y0, unravel = ravel_pytree(self.y0)
        s = (t0 - self.t0) / jnp.where(h == 0, 1.0, h)
        return unravel(y0 + h * _integrals(s, h, self.ages) @ self.terms)


class Adams(Multistep):
    """Adams-Bashforth-Moulton."""

    corrector: str = eqx.field(static=True)
    min_order: int = eqx.field(static=True)
    max_order: int = eqx.field(static=True)
    root_finder: Any
    root_find_max_steps: int = 3
    interpolation_cls: ClassVar[Callable[..., AdamsInterpolation]] = AdamsInterpolation

    def __init__(self, corrector="pece", min_order=1, max_order=HIGHEST, rtol=None, atol=None):
        self.corrector, self.min_order, self.max_order = corrector, min_order, max_order
        self.root_finder, self.root_find_max_steps = from_controller(), 3

    def order(self, terms):
        return self.max_order

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def _field(self, terms, args, unravel):
        def f(t, y):
            one = terms.contr(jnp.zeros_like(t), jnp.ones_like(t))
            return ravel_pytree(terms.vf_prod(t, unravel(y), args, one))[0]

        return f

    def init(self, terms, t0, t1, y0, args):
        y, unravel = ravel_pytree(y0)
        f = self._field(terms, args, unravel)(t0, y)
        return self._new(t1 - t0, y, f, jnp.array(1))

    def _new(self, h, y, f, evaluations):
        N = self.max_order + 2
        ages = jnp.arange(N) * h
        phi = jnp.zeros((N, len(y))).at[0].set(f)
        i = jnp.asarray
        return History(ages, phi, y, i(1), i(1), h, i(0), i(True), i(True), evaluations)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        state = solver_state
        tree0 = y0
        y0, unravel = ravel_pytree(tree0)
        f = self._field(terms, args, unravel)
        h = t1 - t0
        N = self.max_order + 2
        gamma = _constant_steps(N + 1)
        i = jnp.arange(1, N + 1)
        moved = jnp.any(y0 != state.y)
        stale = moved | ~state.exact | made_jump
        f0 = jax.lax.cond(stale, lambda: f(t0, y0), lambda: state.phi[0])
        phi = state.phi + (f0 - state.phi[0])
        cost = state.evaluations + stale
        fresh = self._new(h, y0, f0, state.evaluations)
        restart = made_jump | (h < LOST * state.planned)
        state = jax.tree.map(lambda a, b: jnp.where(restart, a, b), fresh, eqx.tree_at(lambda s: s.phi, state, phi))

        k = state.order
        known = i <= state.points
        grown = h + state.ages
        one = jnp.ones(1)
        beta = jnp.concatenate([one, jnp.cumprod(grown[:-1] / state.ages[1:])])
        sigma = jnp.concatenate([one, jnp.cumprod(i * h / grown)])[:-1]
        star = jnp.where(known, beta, 0.0)[:, None] * state.phi
        g = _integrals(1.0, h, state.ages)
        used = jnp.where((i <= k)[:, None], star, 0.0)
        p = y0 + h * (g @ used)
        p1 = jnp.sum(used, axis=0)
        fp = f(t1, p)
        delta = fp - p1
        y1 = p + h * g[k] * delta

        tol = self.root_finder
        tree1 = unravel(y1)
        size = scale(tol, tree0, tree1)
        held = jax.lax.stop_gradient

        def norm(c, x):
            return held(jnp.abs(c)) * tol.norm(jax.tree.map(lambda a, s: a / s, unravel(held(x)), held(size)))

        at = lambda x, j: x[jnp.clip(j, 0, N - 1)]  # noqa: E731
        erk = norm(h * at(sigma, k) * jnp.asarray(gamma)[k], delta)
        err = norm(h * (g[k - 1] - g[k]), delta)
        erkm1 = norm(h * at(sigma, k - 1) * jnp.asarray(gamma)[k - 1], delta + star[k - 1])
        erkm2 = norm(h * at(sigma, k - 2) * jnp.asarray(gamma)[jnp.maximum(k - 2, 0)], delta + star[k - 1] + at(star, k - 2))
        finite = jnp.isfinite(err) & jnp.all(jnp.isfinite(y1))
        accept = finite & (err <= 1.0)
        lower = jnp.where(k > 2, jnp.maximum(erkm1, erkm2) <= erk, (k == 2) & (erkm1 <= 0.5 * erk))

        again = accept & ~moved
        f1 = jax.lax.cond(again, lambda: f(t1, y1), lambda: fp)
        cost = cost + 1 + again

        points = jnp.minimum(state.points + 1, N)
        sums = jnp.concatenate([jnp.zeros((1, len(y0))), jnp.cumsum(star, axis=0)[:-1]])
        phi1 = jnp.where((i <= points)[:, None], f1 - sums, 0.0)

        same = jnp.abs(h / state.planned - 1) < 1e-2
        even = jnp.where(same & (state.even > 0), state.even + 1, 1)
        erkp1 = norm(h * jnp.asarray(gamma)[k + 1], phi1[k + 1])
        can_raise = (k < self.max_order) & (points > k)
        starting = state.starting & ~lower & (k < self.max_order) & (h >= 0.99 * state.planned)
        judged = (even > k) & (points >= k + 2)
        up = judged & can_raise & jnp.where(k > 1, (erkm1 > jnp.minimum(erk, erkp1)) & (erkp1 < erk), erkp1 < 0.5 * erk)
        down = lower | (judged & (k > 1) & (erkm1 <= jnp.minimum(erk, erkp1)))
        up, down = up & ~down, down & (k > self.min_order)
        up = up | (starting & can_raise) | (can_raise & (k < self.min_order))
        order = jnp.where(up, k + 1, jnp.where(down, k - 1, k))
        e = jnp.where(up, erkp1, jnp.where(down, erkm1, erk))
        double = (starting) | (e * 2.0 ** (order + 1) <= 0.5)
        factor = jnp.where(double, 2.0, 1.0)
        shrink = jnp.clip((0.5 / jnp.maximum(err, 1e-300)) ** (1.0 / (k + 1)), 0.2, 0.9)
        factor = jnp.where(accept, factor, jnp.where(finite, shrink, 0.2))
        y_error = steered(tol, tree0, tree1, accept, factor)
        ages1 = jnp.concatenate([jnp.zeros(1), h + state.ages[:-1]])
        new = History(ages1, phi1, y1, points, order, h * factor, even, starting, again, cost)
        dense = {"y0": tree0, "ages": state.ages, "terms": jnp.where((i == k + 1)[:, None], delta, used)}
        return tree1, y_error, dense, new, diffrax.RESULTS.successful
