"""Minimization by an optimizer of optax, for losses that are no sums of squares.

With r the weighted residuals, J their Jacobian and rho(r) the loss (by default r.r / 2), an optimizer gets the value rho and the
gradient J^T d rho / dr, both of one call of the compiled program; so does a line search at each point that it tries. A fit has
settled, as in `descend`, where the step (J^T J)^-1 J^T d rho / dr is small: that of Gauss and Newton.

Derivatives are taken forward here too. One gradient in reverse mode costs less (chains of 4 and 10 rods with 8 and 20 unknowns,
2 s: 1.5 and 5.8 ms of CPU against 3.3 and 24 ms), but its program takes 17 and 37 s more to compile: thousands of steps.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.fitting import FLAT, Fit, LeastSquares
from udkjax.study.identify.problem import Evaluated

STEPS = 2000  # of an optimizer that knows no curvature
SETTLED = 1e-6  # of an unknown: the step below which a fit has settled; first-order methods come no nearer in a reasonable time
WORSE = 100.0  # times the first cost: what is taken for the cost where nothing can be computed


class ByGradient(NamedTuple):
    """An optimizer of optax as a method of `descend`, which takes more steps and settles less far than least squares do."""

    optimizer: Any
    loss: Callable[[Any], Any] | None = None

    def descend(self, problem: LeastSquares, z: Any, tol: Any, horizon: Any, settled: float, transform: Any, tell: Any) -> Fit:
        """Minimize as `descend_by` does."""
        settled = max(settled, SETTLED)
        return descend_by(self.optimizer, problem, z, tol, horizon, STEPS, settled, self.loss, transform, tell)


def method_of(optimizer: Any, loss: Any) -> Any:
    """The method for an optimizer of optimistix, or of optax, and for a loss; one of the user's own is minimized by L-BFGS."""
    if not callable(loss) and not (hasattr(optimizer, "init") and hasattr(optimizer, "update")):
        return optimizer
    import optax

    if optimizer is None:
        optimizer = optax.lbfgs()
    if not isinstance(optimizer, optax.GradientTransformation):
        raise IdentificationError(["optimizer: a loss of your own is no sum of squares; give an optimizer of optax, or none"])
    return ByGradient(optimizer, loss if callable(loss) else None)


class Point(NamedTuple):
    """Value and gradient (K,) of a loss, and the largest entry of the Gauss-Newton step."""

    value: float
    gradient: np.ndarray
    step: float


def descend_by(
    optimizer: Any,
    problem: LeastSquares,
    z: Float[np.ndarray, "B K"],
    tol: tuple[float, float],
    horizon: float | None = None,
    steps: int = STEPS,
    settled: float = SETTLED,
    loss: Callable[[Any], Any] | None = None,
    transform: Callable[[Evaluated], Evaluated] | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Fit:
    """Minimize a loss, a function of the residuals (R,) by JAX, from guesses one after another, by an optimizer of optax.

    `transform` is what makes the residuals of a robust loss from plain ones. The best point of each is what counts.
    """
    import optax

    method, rho = optax.with_extra_args_support(optimizer), _half_square if loss is None else loss
    ends, values, done = z.copy(), np.full(len(z), np.inf), np.zeros(len(z), bool)
    histories: list[list[tuple[float, ...]]] = [[] for _ in z]
    for k, first in enumerate(z):
        look = _Looks(problem, tol, horizon, rho, transform)
        at, state = jnp.asarray(first), method.init(jnp.asarray(first))
        for count in range(steps):
            point = look(np.asarray(at))
            if point.value < values[k]:
                ends[k], values[k] = np.asarray(at), point.value
                done[k] = point.step <= settled
            histories[k].append((point.value, point.step))
            tell(f"step {count + 1}, cost {values[k]:.4g}")
            if done[k] or not np.isfinite(values[k]):
                break
            known = {"value": jnp.asarray(point.value), "grad": jnp.asarray(point.gradient), "value_fn": look.differentiable}
            with jax.disable_jit():  # a line search then asks for numbers, not for a program that could be compiled
                change, state = method.update(known["grad"], state, at, **known)
            at = optax.apply_updates(at, change)
    return Fit(ends, values, done, problem.program.calls, histories[int(np.argmin(values))])


class _Looks:
    """Points of a problem, of which the last few are kept: a line search and the step after it ask for the same."""

    def __init__(self, problem: LeastSquares, tol: Any, horizon: float | None, rho: Callable, transform: Callable | None):
        self.problem, self.tol, self.horizon, self.transform = problem, tol, horizon, transform
        self.slope = jax.value_and_grad(rho)
        self.worst = np.inf
        self._at = lru_cache(maxsize=8)(self._computed)

        @jax.custom_vjp
        def differentiable(z):
            return jnp.asarray(self(np.asarray(z)).value)

        def forward(z):
            point = self(np.asarray(z))
            return jnp.asarray(point.value), jnp.asarray(point.gradient)

        differentiable.defvjp(forward, lambda gradient, bar: (bar * gradient,))
        self.differentiable = differentiable

    def __call__(self, z: np.ndarray) -> Point:
        return self._at(tuple(z.tolist()))

    @jax.disable_jit(False)
    def _computed(self, z: tuple[float, ...]) -> Point:
        found = self.problem.evaluate(np.array([z]), self.tol, self.horizon)
        found = found if self.transform is None else self.transform(found)
        if not found.ok[0]:
            return Point(self.worst, np.zeros(len(z)), np.inf)
        value, slope = self.slope(jnp.asarray(found.r[0]))
        if not np.isfinite(self.worst):
            self.worst = WORSE * (abs(float(value)) + 1.0)
        gradient = found.J[0].T @ np.asarray(slope)
        _, s, vt = np.linalg.svd(found.J[0], full_matrices=False)
        known = s > FLAT * s.max(initial=0.0)
        step = vt[known].T @ (vt[known] @ gradient / s[known] ** 2)
        return Point(float(value), gradient, float(np.abs(step).max(initial=0.0)))


def _half_square(r: Any) -> Any:
    return 0.5 * jnp.sum(r**2)
