"""Methods and losses of a fit: least squares, plain or robust, and losses of the user's own by optimizers of scipy or optax."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias, Union, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from udkjax.extras import OptionalImport
from udkjax.study.identify.least_squares import (
    EXACT_STEP,
    FINE_STEP,
    STEPS,
    Fit,
    History,
    Objective,
    Report,
    minimize_squares,
)
from udkjax.study.identify.prediction import Tolerances
from udkjax.study.identify.problem import INVISIBLE, Residuals
from udkjax.study.identify.records import IdentificationError

if TYPE_CHECKING:  # imported where a fit begins: it takes a second
    import optax
    import optimistix

GRADIENT_STEPS = 2000  # at most, of an optimizer that knows no curvature
FAILED_COST = 100.0  # times the first cost: what is taken for the cost where nothing can be computed
TUNING = 1.345  # standard deviations: of noise that is Gaussian after all, estimates lose a twentieth of their precision

Loss: TypeAlias = Callable[[Residuals], Residuals]  # residuals whose squares are minimized, of plain ones
UserLoss: TypeAlias = Callable[[Array], Array]
Optimizer: TypeAlias = Union["optimistix.AbstractLeastSquaresSolver", "optax.GradientTransformation", None]


class GradientMethod(NamedTuple):
    """An optimizer of optax (None: L-BFGS of scipy), and the loss that it minimizes: rho(r) of the residuals (None: r.r / 2)."""

    optimizer: "optax.GradientTransformation | None"
    loss: UserLoss | None = None


Method: TypeAlias = Union["optimistix.AbstractLeastSquaresSolver", GradientMethod, None]


def choose_method(optimizer: Optimizer, loss: str | UserLoss) -> Method:
    """Return the method for an optimizer and a loss; a loss of the user's own is minimized by L-BFGS unless told otherwise.

    Raises:
        IdentificationError: the optimizer cannot minimize such a loss.
    """
    own_loss = loss if callable(loss) else None
    if hasattr(optimizer, "init") and hasattr(optimizer, "update"):
        return GradientMethod(cast("optax.GradientTransformation", optimizer), own_loss)
    if own_loss is None:
        return cast("optimistix.AbstractLeastSquaresSolver | None", optimizer)
    if optimizer is not None:
        raise IdentificationError(["optimizer: a loss of your own is no sum of squares; give an optimizer of optax, or none"])
    return GradientMethod(None, own_loss)


# --- losses


def squares(found: Residuals) -> Residuals:
    """Return plain residuals: the loss of least squares."""
    return found


def named_loss(name: str, residuals: int) -> Loss:
    """Return the loss of a name, for the first `residuals` of a problem: priors are not outliers."""
    if name == "least_squares":
        return squares
    if name in ROBUST:
        return partial(robust, rho=ROBUST[name], residuals=residuals)
    raise IdentificationError([f"loss must be 'least_squares', {' or '.join(map(repr, ROBUST))}, is {name!r}"])


def robust(found: Residuals, rho: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], residuals: int) -> Residuals:
    """Return s = sign(r) sqrt(rho(r)) and its Jacobian ds/dr J: the sum of its squares, and their gradient, are those of rho.

    `rho` returns rho and half of its derivative, of |r|.
    """
    r = found.r[:, :residuals]
    size = np.abs(r)
    value, half_slope = rho(size)
    s = np.sqrt(value)
    slope = np.where(s > 0.0, half_slope / np.where(s > 0.0, s, 1.0), 1.0)
    rest = found.r[:, residuals:], found.J[:, residuals:]
    return Residuals(
        np.concatenate([np.sign(r) * s, rest[0]], 1),
        np.concatenate([slope[..., None] * found.J[:, :residuals], rest[1]], 1),
        found.code,
    )


def huber(size: np.ndarray, c: float = TUNING) -> tuple[np.ndarray, np.ndarray]:
    """Return rho(r) = r^2 up to |r| = c, and 2 c |r| - c^2 beyond; and half of its derivative.

    Source: P. J. Huber, Robust estimation of a location parameter, 1964.
    """
    return np.where(size > c, 2.0 * c * size - c**2, size**2), np.minimum(size, c)


def soft_l1(size: np.ndarray, c: float = TUNING) -> tuple[np.ndarray, np.ndarray]:
    """Return rho(r) = 2 c^2 ((1 + (r / c)^2)^(1/2) - 1), and half of its derivative."""
    root = np.sqrt(1.0 + (size / c) ** 2)
    return 2.0 * size**2 / (root + 1.0), size / root


ROBUST = {"huber": huber, "soft_l1": soft_l1}


# --- fits


class Evaluated(Protocol):
    """What has residuals and a Jacobian: a `Problem`, or what is made of one."""

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: Tolerances, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian: see `Problem.evaluate`."""
        ...


def weighted_residuals(problem: Evaluated, tol: Tolerances, loss: Loss, horizon: float | None = None) -> Objective:
    """Return the residuals whose squares are minimized, of the first `horizon` seconds of each record (None: all of it)."""
    return lambda z: loss(problem.evaluate(z, tol, horizon))


@dataclass(frozen=True)
class Minimizer:
    """How all fits of an identification are made: by Levenberg-Marquardt (None), or another `method`."""

    method: Method = None
    loss: Loss = squares
    report: Report = lambda text: None

    def minimize(
        self,
        problem: Evaluated,
        z: Float[np.ndarray, "B K"],
        tol: Tolerances,
        horizon: float | None = None,
        steps: int = STEPS,
        settled: float = EXACT_STEP,
        undamped: bool = False,
    ) -> Fit:
        """Fit the first `horizon` seconds of each record (None: all of it) from several first guesses: see `minimize_squares`."""
        evaluate = weighted_residuals(problem, tol, self.loss, horizon)
        if isinstance(self.method, GradientMethod):
            return minimize_by_gradient(self.method, evaluate, z, settled=settled, report=self.report)
        return minimize_squares(evaluate, z, steps, settled, undamped, self.method, self.report)

    def with_label(self, what: str) -> "Minimizer":
        """Return the same one, with reports that begin with what is fitted."""
        return replace(self, report=lambda text: self.report(f"{what}: {text}"))


# --- gradients


class _LossPoint(NamedTuple):
    """Value and gradient (K,) of a loss, and the largest entry of the Gauss-Newton step."""

    value: float
    gradient: np.ndarray
    step: float


def minimize_by_gradient(
    method: GradientMethod,
    evaluate: Objective,
    z: Float[np.ndarray, "B K"],
    steps: int = GRADIENT_STEPS,
    settled: float = FINE_STEP,
    report: Report = lambda text: None,
) -> Fit:
    """Minimize a loss rho(r) by an optimizer that knows its gradient J^T d rho / dr, from guesses one after another.

    A fit has settled where (J^T J)^-1 J^T d rho / dr is small, but no smaller than first-order methods come. Derivatives are
    taken forward here too: in reverse mode a gradient costs a fifth of it with 20 unknowns, but takes 20 to 40 s to compile.
    """
    settled = max(settled, FINE_STEP)
    walks = [_LossAlongWalk(evaluate, method.loss or _half_square, settled, report) for _ in z]
    step_on = _walk_by_scipy if method.optimizer is None else partial(_walk_by_optax, method.optimizer)
    for first, walk in zip(z, walks, strict=True):
        step_on(walk, first, steps)
    best = min(walks, key=lambda walk: walk.best.value)
    return Fit(
        np.array([walk.best_z for walk in walks]),
        np.array([walk.best.value for walk in walks]),
        np.array([walk.best.step <= settled for walk in walks]),
        best.history,
    )


def _walk_by_scipy(walk: "_LossAlongWalk", first: np.ndarray, steps: int) -> None:
    import scipy.optimize

    def after_step(_) -> None:
        if walk.after_step():
            raise StopIteration

    if np.isfinite(walk(first).value):
        options = {"maxiter": steps, "maxfun": 20 * steps, "ftol": 0.0, "gtol": 0.0}
        scipy.optimize.minimize(lambda z: walk(z)[:2], first, jac=True, method="L-BFGS-B", callback=after_step, options=options)


def _walk_by_optax(given: "optax.GradientTransformation", walk: "_LossAlongWalk", first: np.ndarray, steps: int) -> None:
    with OptionalImport():
        import optax
    optimizer = optax.with_extra_args_support(given)
    at, state = jnp.asarray(first), optimizer.init(jnp.asarray(first))

    def step(at: Array, state: PyTree, value: Array, gradient: Array, **more: Callable[[Array], Array]) -> tuple[Array, PyTree]:
        change, state = optimizer.update(gradient, state, at, value=value, grad=gradient, **more)
        return cast(Array, optax.apply_updates(at, change)), state

    try:
        jax.eval_shape(step, at, state, jnp.zeros(()), at)
        compiled = jax.jit(step)
    except TypeError:  # a line search asks for the function itself: of numbers, not compiled
        compiled = jax.disable_jit()(partial(step, value_fn=walk.differentiable))
    for _ in range(steps):
        point = walk(np.asarray(at))
        if walk.after_step():
            return
        at, state = compiled(at, state, jnp.asarray(point.value), jnp.asarray(point.gradient))


class _LossAlongWalk:
    """A loss and its gradient at the points of one walk: it stores the best, and the last few, for line searches that repeat."""

    def __init__(self, evaluate: Objective, rho: UserLoss, settled: float, report: Report):
        self.evaluate, self.settled, self.report = evaluate, settled, report
        self.value_and_slope = jax.value_and_grad(rho)
        self.worst = np.inf
        self.best, self.best_z = _LossPoint(np.inf, np.zeros(0), np.inf), np.zeros(0)
        self.history: History = []
        self._at = lru_cache(maxsize=8)(self._compute)

        @jax.custom_vjp
        def differentiable(z):
            return jnp.asarray(self(np.asarray(z)).value)

        def forward(z):
            point = self(np.asarray(z))
            return jnp.asarray(point.value), jnp.asarray(point.gradient)

        differentiable.defvjp(forward, lambda gradient, bar: (bar * gradient,))
        self.differentiable = differentiable

    def __call__(self, z: np.ndarray) -> _LossPoint:
        point = self._at(tuple(z.tolist()))
        if point.value < self.best.value or not self.best_z.size:
            self.best, self.best_z = point, np.array(z)
        return point

    def after_step(self) -> bool:
        """Note how far the walk is; return whether it has ended."""
        self.history.append((self.best.value, self.best.step))
        self.report(f"step {len(self.history)}, cost {self.best.value:.4g}")
        return self.best.step <= self.settled or not np.isfinite(self.best.value)

    @jax.disable_jit(False)
    def _compute(self, z: tuple[float, ...]) -> _LossPoint:
        found = self.evaluate(np.array([z]))
        if not found.ok[0]:
            return _LossPoint(self.worst, np.zeros(len(z)), np.inf)
        value, slope = self.value_and_slope(jnp.asarray(found.r[0]))
        if not np.isfinite(self.worst):
            self.worst = FAILED_COST * (abs(float(value)) + 1.0)
        gradient = found.J[0].T @ np.asarray(slope)
        _, s, vt = np.linalg.svd(found.J[0], full_matrices=False)
        shows = s > INVISIBLE * s.max(initial=0.0)
        step = vt[shows].T @ (vt[shows] @ gradient / s[shows] ** 2)
        return _LossPoint(float(value), gradient, float(np.abs(step).max(initial=0.0)))


def _half_square(r: Array) -> Array:
    return 0.5 * jnp.sum(r**2)
