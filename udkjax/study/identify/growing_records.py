"""Fits of records that grow, as far as what is known already predicts them.

A long record of an oscillation has a minimum for each number of swings by which a guess can be wrong: over N swings the right one
is some 1 / N wide. The first part of the record has one minimum. So the fit begins there, and goes on to the part of the record
that the unknowns found until then predict: with the covariance C of the unknowns z, and the Jacobian J along the whole record,
the standard deviation of what is predicted is (J C J^T)^(1/2). Where that is small beside what the channel shows, residuals are
still a nearly linear function of z, and phases are right by less than a half swing.

Short parts do not show all unknowns. So each is held to where the fit began, loosely, until the whole record is fitted: with s
the noise that is seen in the record,

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

GUESS_SPREAD = 1.0  # of an unknown: how far it is taken to be from its guess; a positive one by a factor of e
# Of what a channel shows: up to there what is predicted is nearly a linear function of the unknowns. A sine of the wrong phase is
# off by sqrt(2) times the error of the phase: it is 0.2 rad, and five times that still leads to the right minimum.
LINEAR_PART = 0.3
LEAST_GROWTH, MOST_GROWTH = 1.3, 30.0  # from one part to the next: endless fits are not waited for
MOST_PARTS = 30  # even at the least growth they lead to two thousand times the first part
HUBER_LIMIT = 4.0  # standard deviations: on the way larger residuals count as by Huber's loss
LOST_RATIO = 3.0  # times the root mean square of residuals of the part before: the larger part has led to another minimum
SAME_BEGINNING_DISTANCE = 0.02  # of an unknown: fits of first parts this near lead to the same fit of the whole
# Of what a channel shows: less is not used of what is known, so that a model that lacks something still fits.
LEAST_USED_NOISE = 1e-4

Known: TypeAlias = list[tuple[np.ndarray, Fit]]


@dataclass(frozen=True, eq=False)
class HeldProblem:
    """Residuals of a problem over the noise of its records, and what holds the unknowns to a guess.

    Attributes:
        problem: the problem.
        guess: unknowns (K,) that those of the fit are held to.
        noise: standard deviation of the noise of each residual (R,), over what the problem divides it by.
    """

    problem: FitProblem
    guess: Float[np.ndarray, "K"]
    noise: Float[np.ndarray, "R"]

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian: see `Problem.evaluate`. Single wrong numbers count less."""
        return robust(self.plain(z, tol, horizon), partial(huber, c=HUBER_LIMIT), len(self.noise))

    def plain(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Compute the same with all numbers counted alike."""
        found = self.problem.evaluate(z, tol, horizon)
        scale = np.concatenate([1.0 / self.noise, np.ones(found.r.shape[1] - len(self.noise))])
        hold = np.broadcast_to(np.eye(len(self.guess)) / GUESS_SPREAD, (len(z), len(self.guess), len(self.guess)))
        return Residuals(
            np.concatenate([found.r * scale, (z - self.guess) / GUESS_SPREAD], axis=1),
            np.concatenate([found.J * scale[:, None], hold], axis=1),
            found.code,
        )


def fit_growing_records(
    problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, minimizer: Minimizer, known: Known | None = None
) -> Fit:
    """Fit longer and longer parts of the records from a guess, and then the whole records.

    `known` are fits from other guesses, each with where its first part ended: one that begins alike is returned, else this added.
    """
    noise = noise_of_records(problem) / problem.sigma
    held = HeldProblem(problem, z, noise)
    history: CostHistory = []
    times, whole = _times(problem), problem.duration
    first = float(np.sort(times)[min(int(RESIDUALS_PER_UNKNOWN * problem.K), len(times) - 1)])
    at, begun, fitted, size, ahead = z, z, 0.0, np.inf, 0.0
    for _ in range(MOST_PARTS):
        if fitted == 0.0 or ahead == 0.0:
            reach = _predictable_time(held, at, tol, fitted, size)
            ahead = min(max(reach, first, LEAST_GROWTH * fitted), max(first, MOST_GROWTH * fitted))
        if ahead >= whole:
            break
        one = minimizer.with_label(f"{ahead / whole:.0%} of the records")
        fit = one.minimize(held, at, tol, ahead, FEW_STEPS, COARSE_STEP)
        history += fit.history
        own = times <= ahead
        found = np.sqrt(2.0 * fit.cost / max(own.sum(), 1))
        if fitted and not found <= LOST_RATIO * max(size, 1.0) and ahead > LEAST_GROWTH * fitted:
            ahead = np.sqrt(ahead * fitted)  # too far: from the same unknowns again, less far
            continue
        if np.isfinite(fit.cost):
            at = fit.z
        if not fitted:
            begun = at
            for beginning, same in known or ():
                if np.abs(at - beginning).max() <= SAME_BEGINNING_DISTANCE:
                    return same._replace(history=history)
        fitted, size, ahead = ahead, found, 0.0
    fit = minimizer.with_label("whole records").minimize(problem, at, tol, None, STEPS, LOOSE_STEP)
    if known is not None:
        known.append((begun, fit))
    return fit._replace(history=history + fit.history)


def noise_of_records(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the standard deviation of each residual's noise: what was given, or is seen in the differences of neighbours."""
    found = problem.sigma.copy()
    for places in problem.series():
        k, _, c = problem.index[places[0]]
        if not problem.noise_given[places[0]]:
            scale = problem.channel_scale[c]
            noise = noise_of_differences(problem.ts[k, problem.index[places, 1]], problem.y[k, problem.index[places, 1], c])
            found[places] = np.clip(noise, LEAST_USED_NOISE * scale, scale) if np.isfinite(noise) else scale
    return found


def _predictable_time(held: HeldProblem, z: np.ndarray, tol: TolerancePair, fitted: float, size: float) -> float:
    """Return the time since the beginnings of the records up to which they are predicted by a fit of their parts up to another.

    `size` is the root mean square of its residuals.
    """
    problem, times = held.problem, _times(held.problem)
    along = held.plain(z[None], tol)
    J, R = along.J[0], len(times)
    data, usable = J[:R], np.isfinite(along.r[0]) & np.isfinite(J).all(1)  # a run may fail on its way
    own = (times <= fitted) & usable[:R]
    enough = own.sum() >= RESIDUALS_PER_UNKNOWN * problem.K
    square = size**2 if enough and np.isfinite(size) else 1.0
    rest = J[R:][usable[R:]]
    known = np.concatenate([data[own] / np.sqrt(max(square, np.finfo(float).eps)), rest])
    _, s, vt = np.linalg.svd(known, full_matrices=False)  # C = V S^-2 V^T
    with np.errstate(invalid="ignore", over="ignore"):
        deviation = np.linalg.norm(data @ (vt.T / s), axis=1)
    scale = problem.channel_scale[problem.index[:, 2]] / (held.noise * problem.sigma)
    beyond = ~(usable[:R] & (deviation <= LINEAR_PART * scale)) & (times > fitted)
    return float(times[beyond].min()) if beyond.any() else np.inf


def _times(problem: FitProblem) -> Float[np.ndarray, "R"]:
    """Return the time of each residual since its record began."""
    record, time, _ = problem.index.T
    return problem.ts[record, time] - problem.ts[record, 0]
