"""Least squares by SciPy's trust-region method, with a convergence test on the Gauss-Newton step.

Within a trust radius around a point z the residuals are approximated by r + J dz. The radius grows if the cost falls as
predicted, and shrinks if it does not, or if a trial cannot be computed. Near a minimum the steps are Gauss-Newton steps.

Source: M. A. Branch, T. F. Coleman & Y. Li, SIAM Journal on Scientific Computing 21 (1999) 1.
"""

from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any, NamedTuple, NoReturn, TypeAlias

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import lstsq

from udkjax.study.identify.problem.residuals import Residuals, reduce_blocks
from udkjax.study.identify.problem.unknowns import FARTHEST_UNKNOWN, INVISIBLE_RATIO

# Gauss-Newton steps (largest change of a dimensionless unknown) at which a fit has converged: for a part of the records; with
# loose integration; with costs exact to the square of the step; and for the final fit, where smaller steps have no visible
# effect.
COARSE_STEP, LOOSE_STEP, FINE_STEP, EXACT_STEP = 1e-3, 1e-5, 1e-6, 1e-10
# Maximum number of steps: for a part of the records, or near a minimum; from a first guess, which is given up if it has not
# converged by then; and for the final fit.
FEW_STEPS, SOME_STEPS, FINAL_STEPS = 15, 30, 60
# Cosine of the angle between the residuals and the range of J at which a fit has converged. Multiplied by the square root of the
# number of residuals, it is the Gauss-Newton step in standard errors, of which a thousandth is negligible.
ORTHOGONAL_COSINE = 1e-5
MOST_REFUSED_STEPS = 8  # number of successive rejected steps after which a fit is given up
ROUNDING = 4 * float(np.finfo(float).eps)  # steps below this, relative to the unknowns, are rounding errors

Objective: TypeAlias = Callable[[np.ndarray], Iterable[Residuals]]  # blocks of residuals at B sets of K unknowns (B, K)
Stuck: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]  # `Unknowns.stuck_at_bounds`
ReportStep: TypeAlias = Callable[[str], None]  # called with a message after each step
CostHistory: TypeAlias = list[tuple[float, float]]  # cost after each step, and largest change of an unknown in the next step


class Fit(NamedTuple):
    """The result of a fit."""

    z: Float[np.ndarray, "K"]  # unknowns
    cost: float  # r.r / 2
    converged: bool
    history: CostHistory
    stuck: Bool[np.ndarray, "K"] | None = None  # unknowns at a bound, whose values mean nothing; None: unknown


def minimize_squares(
    evaluate: Objective,
    z: Float[np.ndarray, "K"],
    steps: int = FINAL_STEPS,
    step_tol: float = EXACT_STEP,
    report: ReportStep = lambda text: None,
    stuck: Stuck | None = None,
) -> Fit:
    """Minimize r.r / 2 from a first guess, until the (dimensionless) Gauss-Newton step is at most `step_tol`.

    Args:
        evaluate: the residuals as a function of the unknowns.
        z: the first guess.
        steps: maximum number of evaluations.
        step_tol: largest change of an unknown in the next step at which the fit has converged.
        report: called with a message after each step.
        stuck: function that finds unknowns at a bound, which keep their values (`Unknowns.stuck_at_bounds`).

    Returns:
        The best point found.
    """
    from scipy.optimize import least_squares

    fit = _TrustRegionFit(evaluate, z, step_tol, report)
    fit.stuck = stuck
    # `Descent` ends a fit by all conditions except the number of steps.
    choices: dict[str, Any] = {"jac": fit.jacobian, "ftol": None, "gtol": None, "xtol": ROUNDING, "max_nfev": steps}
    with suppress(StopIteration):
        least_squares(fit.residuals, np.zeros(len(z)), **choices)
    return fit.end


class Descent:
    """A fit in progress, whose best point is `end`. StopIteration, which `record` and `stop` raise, ends the fit."""

    def __init__(self, evaluate: Objective, guess: Float[np.ndarray, "K"], step_tol: float, report: ReportStep):
        self.evaluate, self.guess, self.step_tol, self.report = evaluate, guess, step_tol, report
        self.end, self.size = Fit(guess, np.inf, False, []), np.inf

    def record(self, size: float) -> None:
        """Record the length of the next step from the best point; end the fit if it is short enough."""
        self.size = size
        self.end.history.append((self.end.cost, size))
        self.report(f"step {len(self.end.history)}, cost {self.end.cost:.4g}")
        if size <= self.step_tol:
            self.stop(True)

    def stop(self, converged: bool) -> NoReturn:
        """End the fit by StopIteration, after setting `end.converged`."""
        self.end = self.end._replace(converged=converged)
        raise StopIteration


class _TrustRegionFit(Descent):
    """Residuals and Jacobians at changes of a guess, as callbacks of SciPy.

    K further residuals, which are zero, hold the unknowns that are stuck at a bound: SciPy would lengthen its steps if columns
    of the Jacobian were zero.
    """

    stuck: Stuck | None = None
    count = 0  # number of residuals before they are reduced
    refused = 0  # number of trials since the last improvement

    def residuals(self, change: Float[np.ndarray, "K"]) -> Float[np.ndarray, "2K+1"]:
        """Return the residuals, reduced to K + 1, then K zeros; the residuals are infinite if they cannot be computed."""
        z = self.guess + change
        reduced = reduce_blocks(self.evaluate(z[None])) if np.abs(z).max(initial=0.0) < FARTHEST_UNKNOWN else None
        self.r, self.J = np.full(len(z) + 1, np.inf if reduced is None else 0.0), np.zeros((len(z) + 1, len(z)))
        if reduced is not None:
            self.count, size = reduced.count, len(reduced.r)
            self.r[:size], self.J[:size] = reduced.r, reduced.J
        cost = float(0.5 * self.r @ self.r)
        if cost < self.end.cost:
            self.end, self.refused = self.end._replace(z=z, cost=cost), 0
            return np.append(self.r, np.zeros(len(z)))
        self.refused += 1
        is_finest = self.size <= FINE_STEP and self.refused >= 2  # further improvements are rounding errors
        if not self.end.history or is_finest or self.refused >= MOST_REFUSED_STEPS:
            self.stop(is_finest)
        return np.append(self.r, np.zeros(len(z)))

    def jacobian(self, change: Float[np.ndarray, "K"]) -> Float[np.ndarray, "2K+1 K"]:
        """Return the Jacobian of the latest residuals."""
        J, held = self.J, np.zeros(len(change))
        if self.stuck is not None:
            stuck = self.stuck(self.guess + change, self.r, J, self.count)
            self.end = self.end._replace(stuck=stuck)
        if self.end.stuck is not None and self.end.stuck.any():
            stuck = self.end.stuck
            J, held = np.where(stuck, 0.0, J), np.where(stuck, np.linalg.norm(J, axis=0).max() or 1.0, 0.0)
        size, cosine = gauss_newton(self.r, J)
        self.record(size)
        if cosine <= ORTHOGONAL_COSINE:
            self.stop(True)
        return np.concatenate([J, np.diag(held)])


def gauss_newton(r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]) -> tuple[float, float]:
    """Return the largest entry of the Gauss-Newton step in determined directions, and the cosine between r and the range of J.

    Both are zero if J is zero, since all unknowns are then at a bound.
    """
    if not J.any():
        return 0.0, 0.0  # every unknown is at a bound
    step, _, rank, _ = lstsq(J, r, cond=INVISIBLE_RATIO, lapack_driver="gelsy")
    if not rank:
        return np.inf, np.inf
    size = np.linalg.norm(r)
    return float(np.abs(step).max()), float(np.linalg.norm(J @ step) / size) if size else 0.0
