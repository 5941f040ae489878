"""Least squares: the trust-region method of SciPy, ended by steps that are known to be small enough.

Within a radius around a point z the residuals are taken to be linear, r + J dz. Where the cost falls as that promises, the radius
grows, and it shrinks where it does not, or where a trial cannot be computed. Near a minimum steps are those of Gauss and Newton.

Source: M. A. Branch, T. F. Coleman & Y. Li, SIAM Journal on Scientific Computing 21 (1999) 1.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, NoReturn, TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.linalg import lstsq

from udkjax.study.identify.fit_problem import INVISIBLE_RATIO, Residuals
from udkjax.study.identify.unknowns import FARTHEST_UNKNOWN

# Gauss-Newton steps, the largest change of a dimensionless unknown, at which a fit has settled: on the way; where the integration
# is loose too; where costs have to be exact to the square of it; and at the end, where smaller steps change nothing that shows.
COARSE_STEP, LOOSE_STEP, FINE_STEP, EXACT_STEP = 1e-3, 1e-5, 1e-6, 1e-10
# Steps at most: on the way or beside a minimum; from a first guess, which if it has not settled then is on its way to nowhere;
# and to the end.
FEW_STEPS, SOME_STEPS, STEPS = 15, 30, 60
# Cosine of the angle between residuals and what the unknowns can change of them, at which a fit has settled: times the root of
# their number it is a Gauss-Newton step in standard errors, of which a thousandth changes nothing either.
ORTHOGONAL_COSINE = 1e-5
MOST_REFUSED_STEPS = 8  # steps one after another, before a fit is given up
ROUNDING = 4 * float(np.finfo(float).eps)  # of the unknowns: shorter steps change nothing

Objective: TypeAlias = Callable[[np.ndarray], Residuals]  # residuals and their Jacobian at B sets of K unknowns (B, K)
ReportStep: TypeAlias = Callable[[str], None]  # is called with a text after each step
CostHistory: TypeAlias = list[tuple[float, float]]  # cost, and largest change of an unknown by the next step: after each step


class Fit(NamedTuple):
    """The end of a fit: unknowns, cost r.r / 2, whether it settled, and how it went."""

    z: Float[np.ndarray, "K"]
    cost: float
    settled: bool
    history: CostHistory


def minimize_squares(
    evaluate: Objective,
    z: Float[np.ndarray, "K"],
    steps: int = STEPS,
    settled: float = EXACT_STEP,
    report: ReportStep = lambda text: None,
) -> Fit:
    """Minimize r.r / 2 from a first guess. A fit has settled where its Gauss-Newton step is below `settled` (dimensionless)."""
    from scipy.optimize import least_squares

    fit = _TrustRegionFit(evaluate, z, settled, report)
    # `Descent` says when a fit ends, but for its steps.
    choices: dict[str, Any] = {"jac": fit.jacobian, "ftol": None, "gtol": None, "xtol": ROUNDING, "max_nfev": steps}
    with suppress(StopIteration):
        least_squares(fit.residuals, np.zeros(len(z)), **choices)
    return fit.end


class Descent:
    """One fit, whose best point is `end`; StopIteration ends it."""

    def __init__(self, evaluate: Objective, guess: Float[np.ndarray, "K"], settled: float, report: ReportStep):
        self.evaluate, self.guess, self.settled, self.report = evaluate, guess, settled, report
        self.end, self.size = Fit(guess, np.inf, False, []), np.inf

    def note(self, size: float) -> None:
        """Note the length of the step that the best point asks for; end where that is short enough."""
        self.size = size
        self.end.history.append((self.end.cost, size))
        self.report(f"step {len(self.end.history)}, cost {self.end.cost:.4g}")
        if size <= self.settled:
            self.stop(True)

    def stop(self, settled: bool) -> NoReturn:
        """End the fit."""
        self.end = self.end._replace(settled=settled)
        raise StopIteration


class _TrustRegionFit(Descent):
    """Residuals and Jacobians at changes of a guess, as SciPy asks for them."""

    refused = 0  # trials since the last better one

    def residuals(self, change: Float[np.ndarray, "K"]) -> Float[np.ndarray, "R"]:
        """Return the residuals; infinite ones where they cannot be computed."""
        z = self.guess + change
        self.found = self.evaluate(z[None])
        r, ok = self.found.r[0], self.found.ok[0] and np.abs(z).max(initial=0.0) < FARTHEST_UNKNOWN
        cost = float(0.5 * r @ r) if ok else np.inf
        if cost < self.end.cost:
            self.end, self.refused = self.end._replace(z=z, cost=cost), 0
            return r
        self.refused += 1
        is_finest = self.size <= FINE_STEP and self.refused >= 2  # better by rounding alone
        if not self.end.history or is_finest or self.refused >= MOST_REFUSED_STEPS:
            self.stop(is_finest)
        return r if ok else np.full_like(r, np.inf)

    def jacobian(self, change: Float[np.ndarray, "K"]) -> Float[np.ndarray, "R K"]:
        """Return the Jacobian of the residuals that were asked for last."""
        J = self.found.J[0]
        size, cosine = gauss_newton(self.found.r[0], J)
        self.note(size)
        if cosine <= ORTHOGONAL_COSINE:
            self.stop(True)
        return J


def gauss_newton(r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]) -> tuple[float, float]:
    """Return the largest entry of the Gauss-Newton step in directions that show, and the cosine of the angle of r to J."""
    step, _, rank, _ = lstsq(J, r, cond=INVISIBLE_RATIO, lapack_driver="gelsy")
    if not rank:
        return np.inf, np.inf
    size = np.linalg.norm(r)
    return float(np.abs(step).max()), float(np.linalg.norm(J @ step) / size) if size else 0.0
