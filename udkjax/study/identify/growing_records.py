"""Fits of growing parts of the records, each as long as the previous fit can predict.

A long record of an oscillation has one minimum for each number of periods by which a guess can be wrong: over N periods the right
one is about 1 / N wide. The first part of the record has a single minimum. So the fit begins with it, and continues with the part
that the unknowns found so far predict: with the covariance C of the unknowns z, and the Jacobian J along the whole record, the
standard deviation of a prediction is (J C J^T)^(1/2). Where it is small relative to the channel's scale, residuals are nearly
linear in z, and phases are wrong by less than half a period.

Short parts do not determine all unknowns. So a weak prior at the initial guess is added until the whole record is fitted: with s
the noise of the record,

    min sum (r / s)^2 + |z - z_0|^2 / SPREAD^2,        C = (J^T J / s^2 + 1 / SPREAD^2)^-1.
"""

from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.fit_problem import RESIDUALS_PER_UNKNOWN, FitProblem, Residuals
from udkjax.study.identify.least_squares import COARSE_STEP, FEW_STEPS, LOOSE_STEP, STEPS, CostHistory, Fit
from udkjax.study.identify.optimizer import Minimizer, huber, robust
from udkjax.study.identify.prediction import TolerancePair
from udkjax.study.noise import noise_of_differences

GUESS_SPREAD = 1.0  # standard deviation of an unknown around its guess; for a positive one, a factor of e
# Relative to a channel's scale: smaller deviations of a prediction are nearly linear in the unknowns. A phase error p changes a
# sine by sqrt(2) p of its scale: this is 0.2 rad, and five times as much still leads to the right minimum.
LINEAR_PART = 0.3
LEAST_GROWTH, MOST_GROWTH = 1.3, 30.0  # ratio of successive parts
MOST_PARTS = 30  # even at the least growth they reach two thousand times the first part
HUBER_LIMIT = 4.0  # standard deviations: larger residuals of parts are weighted by Huber's loss
LOST_RATIO = 3.0  # times the root mean square of the previous residuals: the larger part has led to another minimum
SAME_BEGINNING_DISTANCE = 0.02  # change of an unknown: closer fits of the first part lead to the same fit of the whole
LEAST_USED_NOISE = 1e-4  # relative to a channel's scale: least noise assumed, so that an incomplete model still fits

EarlierFits: TypeAlias = list[tuple[np.ndarray, Fit]]  # unknowns at the end of the first part, and the fit of the whole


@dataclass(frozen=True, eq=False)
class RegularizedProblem:
    """Residuals of a problem in units of the noise of its records, with a weak prior of the unknowns at a guess.

    Attributes:
        problem: the problem.
        guess: mean (K,) of the prior.
        noise: standard deviation of the noise of each residual (R,), relative to that used in the problem.
    """

    problem: FitProblem
    guess: Float[np.ndarray, "K"]
    noise: Float[np.ndarray, "R"]

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian, as `FitProblem.evaluate` does, with outliers weighted by Huber's loss."""
        return robust(self.plain(z, tol, horizon), partial(huber, c=HUBER_LIMIT), len(self.noise))

    def plain(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Compute the same without Huber's loss."""
        found = self.problem.evaluate(z, tol, horizon)
        scale = np.concatenate([1.0 / self.noise, np.ones(found.r.shape[1] - len(self.noise))])
        prior = np.broadcast_to(np.eye(len(self.guess)) / GUESS_SPREAD, (len(z), len(self.guess), len(self.guess)))
        return Residuals(
            np.concatenate([found.r * scale, (z - self.guess) / GUESS_SPREAD], axis=1),
            np.concatenate([found.J * scale[:, None], prior], axis=1),
            found.code,
        )


def fit_growing_records(
    problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, minimizer: Minimizer, earlier: EarlierFits | None = None
) -> Fit:
    """Fit longer and longer parts of the records from a guess, and then the whole records.

    If one of the `earlier` fits from other guesses has the same first part, it is returned; otherwise this fit is added to them.
    """
    noise = noise_of_records(problem) / problem.sigma
    regularized = RegularizedProblem(problem, z, noise)
    history: CostHistory = []
    times, whole = _times(problem), problem.duration
    first = float(np.sort(times)[min(int(RESIDUALS_PER_UNKNOWN * problem.K), len(times) - 1)])
    at, begun, fitted, size, ahead = z, z, 0.0, np.inf, 0.0
    for _ in range(MOST_PARTS):
        if fitted == 0.0 or ahead == 0.0:
            reach = _predictable_time(regularized, at, tol, fitted, size)
            ahead = min(max(reach, first, LEAST_GROWTH * fitted), max(first, MOST_GROWTH * fitted))
        if ahead >= whole:
            break
        one = minimizer.with_label(f"{ahead / whole:.0%} of the records")
        fit = one.minimize(regularized, at, tol, ahead, FEW_STEPS, COARSE_STEP)
        history += fit.history
        own = times <= ahead
        found = np.sqrt(2.0 * fit.cost / max(own.sum(), 1))
        if fitted and not found <= LOST_RATIO * max(size, 1.0) and ahead > LEAST_GROWTH * fitted:
            ahead = np.sqrt(ahead * fitted)  # too long: try a shorter part from the same unknowns
            continue
        if np.isfinite(fit.cost):
            at = fit.z
        if not fitted:
            begun = at
            for beginning, same in earlier or ():
                if np.abs(at - beginning).max() <= SAME_BEGINNING_DISTANCE:
                    return same._replace(history=history)
        fitted, size, ahead = ahead, found, 0.0
    fit = minimizer.with_label("whole records").minimize(problem, at, tol, None, STEPS, LOOSE_STEP)
    if earlier is not None:
        earlier.append((begun, fit))
    return fit._replace(history=history + fit.history)


def noise_of_records(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the standard deviation of each residual's noise, given or estimated from differences of neighbouring values."""
    found = problem.sigma.copy()
    for places in problem.series():
        k, _, c = problem.index[places[0]]
        if not problem.noise_given[places[0]]:
            scale = problem.channel_scale[c]
            noise = noise_of_differences(problem.ts[k, problem.index[places, 1]], problem.y[k, problem.index[places, 1], c])
            found[places] = np.clip(noise, LEAST_USED_NOISE * scale, scale) if np.isfinite(noise) else scale
    return found


def _predictable_time(regularized: RegularizedProblem, z: np.ndarray, tol: TolerancePair, fitted: float, size: float) -> float:
    """Return the time since the beginning of the records up to which a fit of their parts up to `fitted` predicts them.

    `size` is the root mean square of the residuals of that fit.
    """
    problem, times = regularized.problem, _times(regularized.problem)
    along = regularized.plain(z[None], tol)
    J, R = along.J[0], len(times)
    data, usable = J[:R], np.isfinite(along.r[0]) & np.isfinite(J).all(1)  # a run may fail before its end
    own = (times <= fitted) & usable[:R]
    enough = own.sum() >= RESIDUALS_PER_UNKNOWN * problem.K
    square = size**2 if enough and np.isfinite(size) else 1.0
    rest = J[R:][usable[R:]]
    root = np.concatenate([data[own] / np.sqrt(max(square, np.finfo(float).eps)), rest])  # C^-1 = root^T root
    _, s, vt = np.linalg.svd(root, full_matrices=False)  # C = V S^-2 V^T
    with np.errstate(invalid="ignore", over="ignore"):
        deviation = np.linalg.norm(data @ (vt.T / s), axis=1)
    scale = problem.channel_scale[problem.index[:, 2]] / (regularized.noise * problem.sigma)
    beyond = ~(usable[:R] & (deviation <= LINEAR_PART * scale)) & (times > fitted)
    return float(times[beyond].min()) if beyond.any() else np.inf


def _times(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the time of each residual since its record began."""
    record, time, _ = problem.index.T
    return problem.ts[record, time] - problem.ts[record, 0]
