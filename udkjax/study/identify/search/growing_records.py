"""Fits of growing parts of the records, each as long as the previous fit can predict.

The cost of a long record of an oscillation has a minimum for each number of periods by which a guess can be wrong; over N periods
the global minimum is about 1 / N wide. The cost of the first part of the record has a single minimum. The fit therefore begins
with this part, and continues with the part that the present unknowns predict: with their covariance C, and the Jacobian J along
the whole record, the standard deviation of a prediction is (J C J^T)^(1/2). Where it is small relative to the channel's scale,
residuals are nearly linear in z, and phases are wrong by less than half a period.

Short parts do not determine all unknowns. A weak prior at the initial guess is therefore added until the whole record is fitted:
with s the noise of the record,

    min sum (r / s)^2 + |z - z_0|^2 / SPREAD^2,        C = (J^T J / s^2 + 1 / SPREAD^2)^-1.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.problem.fit_problem import RESIDUALS_PER_UNKNOWN, FitProblem
from udkjax.study.identify.problem.prediction import TolerancePair
from udkjax.study.identify.problem.residuals import Reduction, Residuals
from udkjax.study.identify.problem.unknowns import Unknowns
from udkjax.study.identify.search.least_squares import COARSE_STEP, FEW_STEPS, FINAL_STEPS, LOOSE_STEP, CostHistory, Fit
from udkjax.study.identify.search.optimizer import Minimizer, huber, robust
from udkjax.study.noise import noise_of_differences

GUESS_SPREAD = 1.0  # standard deviation of an unknown around its guess; a factor of e for positive parameters
# Deviations of a prediction below this, relative to the channel's scale, are nearly linear in the unknowns. A phase error p
# changes a sine by sqrt(2) p of its scale; this limit is 0.2 rad, and five times as much still leads to the global minimum.
LINEAR_PART = 0.3
LEAST_GROWTH, MOST_GROWTH = 1.3, 30.0  # ratio of successive parts
MOST_PARTS = 30  # at the least growth, these reach two thousand times the first part
HUBER_LIMIT = 4.0  # residuals of parts above this, in standard deviations, are weighted by Huber's loss
LOST_RATIO = 3.0  # if the root mean square of residuals grows by more, a larger part has led to another minimum
SAME_BEGINNING_DISTANCE = 0.02  # fits of the first part whose unknowns differ by less lead to the same fit of the whole
LEAST_USED_NOISE = 1e-4  # least noise, relative to a channel's scale; otherwise an incomplete model would not fit

EarlierFits: TypeAlias = list[tuple[np.ndarray, Fit]]  # unknowns at the end of the first part, and the fit of the whole


@dataclass(frozen=True, eq=False)
class RegularizedProblem:
    """Residuals of a problem in units of the noise of its records, with a weak prior of the unknowns at a guess.

    Attributes:
        problem: the problem.
        guess: mean (K,) of the prior.
        noise: standard deviation of the noise of each residual (R,), relative to the problem's `sigma`.
    """

    problem: FitProblem
    guess: Float[np.ndarray, "K"]
    noise: Float[np.ndarray, "R"]

    @property
    def unknowns(self) -> Unknowns:
        """The parameters."""
        return self.problem.unknowns

    def row_blocks(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Iterator[Residuals]:
        """Compute residuals and their Jacobian, as `FitProblem.row_blocks` does, with outliers weighted by Huber's loss."""
        for block in self.plain(z, tol, horizon):
            yield robust(block, partial(huber, c=HUBER_LIMIT), len(self.noise))

    def plain(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Iterator[Residuals]:
        """Compute residuals and Jacobian as `row_blocks`, without Huber's loss."""
        scale, K = np.append(1.0 / self.noise, np.ones(self.problem.extra_rows)), len(self.guess)
        for block in self.problem.row_blocks(z, tol, horizon):
            of_block = scale[block.row_numbers]
            yield block._replace(r=block.r * of_block, J=block.J * of_block[:, None])
        prior = np.broadcast_to(np.eye(K) / GUESS_SPREAD, (len(z), K, K))
        yield Residuals((z - self.guess) / GUESS_SPREAD, prior, np.zeros(len(z), int), len(scale) + np.arange(K))


def fit_growing_records(
    problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, minimizer: Minimizer, earlier: EarlierFits | None = None
) -> Fit:
    """Fit longer and longer parts of the records from a guess, and then the whole records.

    If the fit of the first part ends where that of an `earlier` fit from another guess ended, the earlier fit is returned;
    otherwise this fit is added to `earlier`.
    """
    noise = noise_of_records(problem) / problem.sigma
    regularized = RegularizedProblem(problem, z, noise)
    history: CostHistory = []
    times, duration = _times(problem), problem.duration
    first = float(np.sort(times)[min(int(RESIDUALS_PER_UNKNOWN * problem.K), len(times) - 1)])
    unknowns, begun, fitted, size, ahead = z, z, 0.0, np.inf, 0.0
    for _ in range(MOST_PARTS):
        if fitted == 0.0 or ahead == 0.0:
            reach = _predictable_time(regularized, unknowns, tol, fitted, size)
            ahead = min(max(reach, first, LEAST_GROWTH * fitted), max(first, MOST_GROWTH * fitted))
        if ahead >= duration:
            break
        labelled = minimizer.with_label(f"{ahead / duration:.0%} of the records")
        fit = labelled.minimize(regularized, unknowns, tol, ahead, FEW_STEPS, COARSE_STEP)
        history += fit.history
        in_part = times <= ahead
        rms = np.sqrt(2.0 * fit.cost / max(in_part.sum(), 1))
        if fitted and not rms <= LOST_RATIO * max(size, 1.0) and ahead > LEAST_GROWTH * fitted:
            ahead = np.sqrt(ahead * fitted)  # the part was too long: try a shorter one from the same unknowns
            continue
        if np.isfinite(fit.cost):
            unknowns = fit.z
        if not fitted:
            begun = unknowns
            for beginning, same in earlier or ():
                if np.abs(unknowns - beginning).max() <= SAME_BEGINNING_DISTANCE:
                    return same._replace(history=history)
        fitted, size, ahead = ahead, rms, 0.0
    fit = minimizer.with_label("whole records").minimize(problem, unknowns, tol, None, FINAL_STEPS, LOOSE_STEP)
    if earlier is not None:
        earlier.append((begun, fit))
    return fit._replace(history=history + fit.history)


def noise_of_records(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the standard deviation of each residual's noise, given or estimated from differences of neighbouring values."""
    deviations = problem.sigma.copy()
    for places in problem.series():
        k, _, c = problem.index[places[0]]
        if not problem.noise_given[places[0]]:
            scale = problem.channel_scale[c]
            noise = noise_of_differences(problem.ts[k, problem.index[places, 1]], problem.y[k, problem.index[places, 1], c])
            deviations[places] = np.clip(noise, LEAST_USED_NOISE * scale, scale) if np.isfinite(noise) else scale
    return deviations


def _predictable_time(regularized: RegularizedProblem, z: np.ndarray, tol: TolerancePair, fitted: float, size: float) -> float:
    """Return the time since the beginning of the records up to which a fit of the first `fitted` seconds predicts them.

    It is infinite if the fit predicts the whole records. `size` is the root mean square of the residuals of this fit.
    """
    problem, times = regularized.problem, _times(regularized.problem)
    R, K = len(times), problem.K
    usable, data, priors = np.zeros(R, bool), Reduction(K), Reduction(K)
    for block in regularized.plain(z[None], tol):
        fine = np.isfinite(block.r[0]) & np.isfinite(block.J[0]).all(1)  # a run may fail before its end
        count = block.count_before(R)
        rows, measured = block.row_numbers[:count], np.arange(len(fine)) < count
        usable[rows] = fine[:count]
        fitted_rows = np.append(times[rows] <= fitted, np.zeros(len(fine) - count, bool)) & fine
        for reduction, own in ((data, fitted_rows), (priors, fine & ~measured)):
            reduction.add(block.r[0, own], block.J[0, own])
    enough = data.count >= RESIDUALS_PER_UNKNOWN * K
    square = size**2 if enough and np.isfinite(size) else 1.0
    root = np.concatenate([data.J / np.sqrt(max(square, np.finfo(float).eps)), priors.J])  # C^-1 = root^T root
    _, s, vt = np.linalg.svd(root, full_matrices=False)  # C = V S^-2 V^T
    scale = problem.channel_scale[problem.index[:, 2]] / (regularized.noise * problem.sigma)
    beyond = ~usable & (times > fitted)
    for block in regularized.plain(z[None], tol):
        rows = block.row_numbers[: block.count_before(R)]
        with np.errstate(invalid="ignore", over="ignore"):
            deviation = np.linalg.norm(block.J[0, : len(rows)] @ (vt.T / s), axis=1)
        beyond[rows] |= ~(deviation <= LINEAR_PART * scale[rows]) & (times[rows] > fitted)
    return float(times[beyond].min()) if beyond.any() else np.inf


def _times(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the time of each residual since its record began."""
    record, time, _ = problem.index.T
    return problem.ts[record, time] - problem.ts[record, 0]
