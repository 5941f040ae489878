"""Losses of a fit and their minimization: plain or robust least squares, and user-defined losses by their gradients."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from inspect import isclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Protocol, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.argument_types import ArgumentRequirement, of_kind
from udkjax.extras import OptionalImport
from udkjax.study.identify.problem.prediction import TolerancePair
from udkjax.study.identify.problem.residuals import Reduction, Residuals, residual_vector
from udkjax.study.identify.problem.unknowns import INVISIBLE_RATIO, Unknowns
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.identify.search.least_squares import (
    EXACT_STEP,
    FINAL_STEPS,
    FINE_STEP,
    Descent,
    Fit,
    Objective,
    ReportStep,
    minimize_squares,
)

if TYPE_CHECKING:  # imported only when needed, since this takes a second
    import optax

GRADIENT_STEPS = 2000  # maximum number of steps of a first-order optimizer
FAILED_COST = 100.0  # substituted for a cost that cannot be computed, relative to the first cost
TUNING_CONSTANT = 1.345  # in standard deviations; with it, estimates lose 5 % of their efficiency for Gaussian noise

Loss: TypeAlias = Callable[[Residuals], Residuals]  # transforms plain residuals into residuals whose squares are minimized
UserLoss: TypeAlias = Callable[[Array], Array]
LossChoice: TypeAlias = Annotated[
    str | UserLoss,
    ArgumentRequirement(
        "a name or a function",
        of_kind('be a name, such as "huber", or a function', lambda x: isinstance(x, str) or (callable(x) and not isclass(x))),
    ),
]
Optimizer: TypeAlias = Annotated[
    "optax.GradientTransformation | None",
    ArgumentRequirement(
        "an optimizer of optax",
        of_kind("be an optax optimizer, or None", lambda x: hasattr(x, "init") and hasattr(x, "update") and not isclass(x)),
    ),
]


class GradientMethod(NamedTuple):
    """An optax optimizer (None: SciPy's L-BFGS), and the loss rho(r) of the residuals that it minimizes (None: r.r / 2)."""

    optimizer: Optimizer
    loss: UserLoss | None = None


def choose_method(optimizer: Optimizer, loss: str | UserLoss) -> GradientMethod | None:
    """Return the gradient method for an optimizer and a loss; None for least squares.

    Raises:
        IdentificationError: the optimizer has a line search, which would have to call the loss.
    """
    if optimizer is None:
        return GradientMethod(None, loss) if callable(loss) else None
    method = GradientMethod(optimizer, loss if callable(loss) else None)
    try:
        jax.eval_shape(lambda z: _update(optimizer, optimizer.init(z), z, jnp.zeros(()), z), jnp.zeros(1))
    except TypeError as error:
        cure = "use one without a line search, such as optax.lbfgs(linesearch=None), or leave it out"
        raise IdentificationError([f"optimizer: needs more than the value and gradient of the loss ({error}); {cure}"]) from None
    return method


# --- losses


def squares(residuals: Residuals) -> Residuals:
    """Return the residuals unchanged: the loss of least squares."""
    return residuals


def named_loss(name: str, residuals: int) -> Loss:
    """Return the loss with a name, which transforms the first `residuals` residuals only, since priors are not outliers.

    Raises:
        IdentificationError: there is no such loss.
    """
    if name == "least_squares":
        return squares
    if name in ROBUST_LOSSES:
        return partial(robust, rho=ROBUST_LOSSES[name], residuals=residuals)
    raise IdentificationError([f"loss must be 'least_squares', {' or '.join(map(repr, ROBUST_LOSSES))}, not {name!r}"])


def robust(plain: Residuals, rho: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], residuals: int) -> Residuals:
    """Return residuals s = sign(r) sqrt(rho(r)) and their Jacobian ds/dr J: s.s and its gradient equal those of the sum of rho.

    Args:
        plain: the residuals r and their Jacobian.
        rho: function of |r| that returns rho(|r|) and half of its derivative.
        residuals: the number of first residuals of the problem that are transformed.
    """
    residuals = plain.count_before(residuals)
    r = plain.r[:, :residuals]
    size = np.abs(r)
    value, half_slope = rho(size)
    s = np.sqrt(value)
    slope = np.where(s > 0.0, half_slope / np.where(s > 0.0, s, 1.0), 1.0)
    further = plain.r[:, residuals:], plain.J[:, residuals:]
    return Residuals(
        np.concatenate([np.sign(r) * s, further[0]], 1),
        np.concatenate([slope[..., None] * plain.J[:, :residuals], further[1]], 1),
        plain.code,
        plain.rows,
    )


def huber(size: np.ndarray, c: float = TUNING_CONSTANT) -> tuple[np.ndarray, np.ndarray]:
    """Return rho(r) = r^2 up to |r| = c, and 2 c |r| - c^2 beyond; and half of its derivative. `size` is |r|.

    Source: P. J. Huber, Robust estimation of a location parameter, 1964.
    """
    return np.where(size > c, 2.0 * c * size - c**2, size**2), np.minimum(size, c)


def soft_l1(size: np.ndarray, c: float = TUNING_CONSTANT) -> tuple[np.ndarray, np.ndarray]:
    """Return rho(r) = 2 c^2 ((1 + (r / c)^2)^(1/2) - 1), and half of its derivative. `size` is |r|."""
    root = np.sqrt(1.0 + (size / c) ** 2)
    return 2.0 * size**2 / (root + 1.0), size / root


ROBUST_LOSSES = {"huber": huber, "soft_l1": soft_l1}


# --- fits


class Evaluated(Protocol):
    """An object with residuals and a Jacobian: a `FitProblem`, or a wrapper of one."""

    @property
    def unknowns(self) -> Unknowns:
        """The parameters, which are the first of the unknowns z."""
        ...

    def row_blocks(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Iterable[Residuals]:
        """Compute residuals and their Jacobian: see `FitProblem.row_blocks`."""
        ...


def weighted_residuals(problem: Evaluated, tol: TolerancePair, loss: Loss, horizon: float | None = None) -> Objective:
    """Return the residuals whose squares are minimized, for the first `horizon` seconds of each record (None: all of it)."""
    return lambda z: map(loss, problem.row_blocks(z, tol, horizon))


@dataclass(frozen=True)
class Minimizer:
    """The method of all fits of an identification.

    Attributes:
        method: None for least squares, or a gradient method.
        loss: transforms residuals so that the sum of squares is the loss.
        report: called with a message after each step.
    """

    method: GradientMethod | None = None
    loss: Loss = squares
    report: ReportStep = lambda text: None

    def minimize(
        self,
        problem: Evaluated,
        z: Float[np.ndarray, "K"],
        tol: TolerancePair,
        horizon: float | None = None,
        steps: int = FINAL_STEPS,
        step_tol: float = EXACT_STEP,
    ) -> Fit:
        """Fit the first `horizon` seconds of each record (None: the whole record) from a first guess: see `minimize_squares`."""
        evaluate = weighted_residuals(problem, tol, self.loss, horizon)
        if self.method is not None:
            return minimize_by_gradient(self.method, evaluate, z, step_tol=step_tol, report=self.report)
        return minimize_squares(evaluate, z, steps, step_tol, self.report, problem.unknowns.stuck_at_bounds)

    def with_label(self, label: str) -> "Minimizer":
        """Return the same minimizer with reports that begin with a label."""
        return replace(self, report=lambda text: self.report(f"{label}: {text}"))


def minimize_by_gradient(
    method: GradientMethod,
    evaluate: Objective,
    z: Float[np.ndarray, "K"],
    steps: int = GRADIENT_STEPS,
    step_tol: float = FINE_STEP,
    report: ReportStep = lambda text: None,
) -> Fit:
    """Minimize a loss rho(r) by its gradient J^T d rho / dr, from a first guess.

    A fit has converged if (J^T J)^-1 J^T d rho / dr is at most `step_tol`, which is raised to what first-order methods can reach.
    Derivatives are in forward mode here too: with 20 unknowns, reverse mode takes a fifth of the time for a gradient, but 20 to
    40 s to compile.
    """
    descent = _LossDescent(method.loss or _half_square, evaluate, z, max(step_tol, FINE_STEP), report)
    with suppress(StopIteration):
        _descend(method.optimizer, descent, steps)
    return descent.end


def _descend(optimizer: Optimizer, descent: "_LossDescent", steps: int) -> None:
    if optimizer is None:
        import scipy.optimize

        options = {"maxiter": steps, "maxfun": 20 * steps, "ftol": 0.0, "gtol": 0.0}
        scipy.optimize.minimize(descent, descent.guess, jac=True, method="L-BFGS-B", options=options)
        return
    unknowns = jnp.asarray(descent.guess)
    state, update = optimizer.init(unknowns), jax.jit(partial(_update, optimizer))
    for _ in range(steps):
        unknowns, state = update(state, unknowns, *descent(np.asarray(unknowns)))


def _update(optimizer: "optax.GradientTransformation", state, at, value, gradient):
    """Return the next unknowns and state of an optax optimizer."""
    with OptionalImport():
        import optax
    change, state = optax.with_extra_args_support(optimizer).update(gradient, state, at, value=value, grad=gradient)
    return optax.apply_updates(at, change), state


class _LossDescent(Descent):
    """A fit in progress, as a callback of optimizers that returns the loss rho and its gradient."""

    def __init__(self, rho: UserLoss, *fit: Any):
        super().__init__(*fit)
        self.value_and_slope, self.failed_cost = jax.value_and_grad(rho), np.inf

    def __call__(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the value of the loss, and its gradient (K,)."""
        (r, ok), size = residual_vector(self.evaluate(z[None])), self.size
        if not ok:
            if not self.end.history:
                self.stop(False)
            return self.failed_cost, np.zeros(len(z))
        value, slope = self.value_and_slope(jnp.asarray(r))
        value, slope, gradient = float(value), np.asarray(slope), np.zeros(len(z))
        reduction = Reduction(len(z))
        for block in self.evaluate(z[None]):
            gradient += block.J[0].T @ slope[reduction.count : reduction.count + block.r.shape[1]]
            reduction.add(block.r[0], block.J[0])
        if not self.end.history:
            self.failed_cost = FAILED_COST * (abs(value) + 1.0)
        if value < self.end.cost:
            _, s, vt = np.linalg.svd(reduction.J, full_matrices=False)
            shows = s > INVISIBLE_RATIO * s.max(initial=0.0)
            size = float(np.abs(vt[shows].T @ (vt[shows] @ gradient / s[shows] ** 2)).max(initial=0.0))
            self.end = self.end._replace(z=z.copy(), cost=value)
        self.record(size)
        return value, gradient


def _half_square(r: Array) -> Array:
    return 0.5 * jnp.sum(r**2)
