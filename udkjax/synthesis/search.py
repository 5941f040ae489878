"""Levenberg-Marquardt searches of many trials in one batch, with limits of increasing weight.

Limits c(x) <= 0 are enforced by an augmented Lagrangian: residuals w max(0, c + u), whose multipliers u become max(0, c + u)
whenever a trial has converged. In narrow curved valleys, steps follow the geodesic: its acceleration is computed from the
second derivative of the residuals along a step v, by one more evaluation (Transtrum and Sethna 2012, arXiv:1201.5885).
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from udkjax.synthesis.design_problem import MARGIN_WEIGHT, DesignProblem
from udkjax.synthesis.steps import StepEquations, in_order
from udkjax.synthesis.trials import TrialResiduals, Trials

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-10, 1e8
DAMPING_DECREASE, DAMPING_INCREASE = 0.2, 4.0  # factors of the damping after an accepted and a rejected step
# Weights w of limits relative to residuals. A search begins with a small weight and raises it each time it has converged;
# the violation decreases with the square of the weight.
FIRST_WEIGHT, WEIGHT_GROWTH, MOST_WEIGHT = 0.5, 6.0, 100.0
WEIGHT_UNIT = 20.0  # unit of weights, relative to the root of the loss over the scale; limits with smaller weights have no effect
# Squared transmissions: the first margin, and the factor by which it shrinks to the requested one whenever a trial has converged.
FIRST_MARGIN, SHRINK_MARGIN = 1e-3, 0.03
LIMIT_TOL = 1e-8  # accepted excess over a limit before the last polish, in scales
LEAST_FALL = 1e-9  # relative decrease of the loss below which a trial has converged
SLOW_DECREASE = 1e-5  # relative decrease of the loss below which exceeded limits get a larger weight
ROUNDING_LOSS = 1e-26  # losses below this, relative to the squared scale, are rounding errors
AHEAD_FRACTION = 0.1  # fraction of a step at which residuals are evaluated for their second derivative along it
MOST_BEND = 0.75  # largest 2 |acceleration| / |step|


@dataclass
class SearchState:
    """M trials of a search.

    Attributes:
        trials: the trials.
        found: their residuals and limits.
        multipliers: the multipliers u of limits (M, K).
        weight: the weight w of limits (M,).
        margin: the least squared transmission for the present (M,).
        least: the least transmission that is requested (M,).
        damping: the damping of steps (M,).
        merit: the loss plus the penalty of limits (M,); infinite for trials without positions.
        settled: whether a trial has converged (M,).
        kept: the best version of each trial that was within all limits.
        kept_loss: the loss of this version (M,); infinite if there was none.
    """

    trials: Trials
    found: TrialResiduals
    multipliers: np.ndarray
    weight: np.ndarray
    margin: np.ndarray
    least: np.ndarray
    damping: np.ndarray
    merit: np.ndarray
    settled: np.ndarray
    kept: Trials
    kept_loss: np.ndarray

    def take(self, which: np.ndarray) -> "SearchState":
        """Return the state of the trials that `which`, a mask or indices, selects."""
        arrays = ((field.name, getattr(self, field.name)) for field in fields(self))
        selected: dict[str, Any] = {name: a[which] if isinstance(a, np.ndarray) else a.take(which) for name, a in arrays}
        return SearchState(**selected)

    def accept(self, problem: DesignProblem, which: np.ndarray, trials: Trials, found: TrialResiduals, merit: np.ndarray):
        """Replace the trials `which` by accepted steps, with their residuals and merits, and call `keep`."""
        for a, b in zip((*self.trials, *self.found), (*trials[:2], found.q, *found), strict=True):
            a[which] = b
        self.merit[which] = merit
        self.keep(problem, which)

    def keep(self, problem: DesignProblem, which: np.ndarray):
        """Store those of the trials `which` in `kept` that are within all limits and better than their stored versions."""
        found = self.found.take(which)
        loss = np.where(found.exists & (self.excess(problem, which) <= 0), loss_of(found), np.inf)
        better = loss < self.kept_loss[which]
        for a, b in zip(self.kept, self.trials, strict=True):
            a[which[better]] = b[which[better]]
        self.kept_loss[which[better]] = loss[better]

    def excess(self, problem: DesignProblem, which: np.ndarray) -> np.ndarray:
        """Return the largest excess of each of the trials `which` over the requested limits (m); negative within them."""
        limits, more = self.found.limits[which], self.margin[which] - self.least[which] ** 2
        limits[:, problem.lengths.count :] -= MARGIN_WEIGHT * problem.scale * more[:, None]
        return np.max(limits, axis=1, initial=-np.inf)


def loss_of(found: TrialResiduals) -> np.ndarray:
    """Return the losses (M,): the sums of the squares of all residuals, plus the parts that are not squares."""
    return np.einsum("mjg,mjg->m", found.r, found.r) + np.einsum("mt,mt->m", found.terms, found.terms) + found.rest


def improve(problem: DesignProblem, state: SearchState, steps: int, threads: int | None = None) -> SearchState:
    """Improve the trials of a state by at most `steps` steps; return the state, which is changed in place."""
    sign = np.sign(state.found.transmission[:, 0])
    for _ in range(steps):
        active = np.flatnonzero(~state.settled)
        if not len(active):
            break
        _step(problem, state, active, sign, threads)
    return state


def begin(problem: DesignProblem, trials: Trials, threads: int | None, least: float = 0.0) -> SearchState:
    """Return the first state of a search from trials, for a transmission of at least `least`."""
    members = len(trials.x)
    leasts = np.full(members, max(problem.least, least))
    margin = np.maximum(leasts**2, FIRST_MARGIN)
    found = problem.evaluate(trials, margin, threads)
    multipliers = np.zeros_like(found.limits)
    weight, damping, merit = np.full(members, FIRST_WEIGHT), np.full(members, FIRST_DAMPING), np.full(members, np.inf)
    stored = Trials(*(a.copy() for a in trials))
    further = (multipliers, weight, margin, leasts, damping, merit, ~found.exists, stored, np.full(members, np.inf))
    state = SearchState(trials, found, *further)
    state.keep(problem, np.arange(members))
    state.merit[found.exists] = merit_of(found, multipliers, weight)[found.exists]
    return state


def merit_of(found: TrialResiduals, multipliers: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the loss plus the penalty of limits (M,)."""
    return loss_of(found) + _pressure(found.limits, multipliers, weight)


def _pressure(limits: np.ndarray, multipliers: np.ndarray, weight: np.ndarray) -> np.ndarray:
    excess = weight[:, None] * np.maximum(limits + multipliers, 0.0)
    return np.einsum("mk,mk->m", excess, excess)


def _step(problem: DesignProblem, state: SearchState, active: np.ndarray, sign: np.ndarray, threads: int | None):
    trials, found = state.trials.take(active), state.found.take(active)
    equations = StepEquations(problem, trials, found, state.multipliers[active], state.weight[active], state.damping[active])
    new = _stepped(problem, trials, *_bent_step(problem, equations, threads))
    old_merit, u, weight = state.merit[active], state.multipliers[active], state.weight[active]

    def worth(loss: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        return loss + _pressure(lengths, u[:, : lengths.shape[1]], weight) < old_merit

    trial = problem.evaluate(new, state.margin[active], threads, worth)
    exists = trial.exists & np.all(np.sign(trial.transmission) == sign[active][:, None], axis=1)
    merits = np.where(exists, merit_of(trial, u, weight), np.inf)
    better, fall = merits < old_merit, old_merit - merits
    accepted, rejected = active[better], active[~better]
    state.accept(problem, accepted, new.take(better), trial.take(better), merits[better])
    slow = fall[better] < SLOW_DECREASE * old_merit[better]
    settled = fall[better] < LEAST_FALL * old_merit[better]
    settled[slow] |= must_continue(problem, state, accepted[slow])
    state.damping[accepted] = np.maximum(DAMPING_DECREASE * state.damping[accepted], LEAST_DAMPING)
    state.damping[rejected] *= DAMPING_INCREASE
    done = np.concatenate(
        [
            accepted[settled | (merits[better] < ROUNDING_LOSS * problem.scale**2)],
            rejected[state.damping[rejected] > MOST_DAMPING],
        ]
    )
    _settle(problem, state, done)


def _stepped(problem: DesignProblem, trials: Trials, dx: np.ndarray, ds: np.ndarray) -> Trials:
    x = np.clip(trials.x + dx, problem.low, problem.high)
    return Trials(x, problem.values_at(x, trials.s + in_order(problem, ds, trials.s)), trials.q)


def _bent_step(problem: DesignProblem, equations: StepEquations, threads: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return steps dx and ds, to which half of their acceleration is added unless it is long relative to the step."""
    dx, ds = equations.find()
    if problem.goal.is_combined:  # its residuals are those of a quadratic model
        return dx, ds
    ds = in_order(problem, ds, equations.trials.s)
    trials, found = equations.trials, equations.found
    r, limits, exists = problem.residuals_at(
        Trials(trials.x + AHEAD_FRACTION * dx, trials.s + AHEAD_FRACTION * ds, trials.q), threads
    )
    first_order = np.einsum("mjgp,mp->mjg", found.by_unknowns, dx) + found.by_value * ds[..., None]
    bend_of_r = ((r - found.r) / AHEAD_FRACTION - first_order) / AHEAD_FRACTION
    bend_of_limits, count = np.zeros_like(found.limits), limits.shape[1]
    slopes = found.limits_by_unknowns[:, :count]
    bend_of_limits[:, :count] = (
        (limits - found.limits[:, :count]) / AHEAD_FRACTION - (slopes @ dx[..., None])[..., 0]
    ) / AHEAD_FRACTION
    bend_of_r[~exists] = 0.0
    ddx, dds = equations.correct(bend_of_r, bend_of_limits)
    ratio = 2.0 * equations.length(ddx) / np.maximum(equations.length(dx), 1e-300)
    share = np.where(exists & (ratio <= MOST_BEND), 1.0, 0.0)[:, None]
    return dx + np.where(share > 0, ddx, 0.0), ds + np.where(share > 0, dds, 0.0)


def _settle(problem: DesignProblem, state: SearchState, done: np.ndarray):
    """Mark the trials `done` as settled, except those that must continue: `harden` changes their limits, and damping falls."""
    restarted = done[must_continue(problem, state, done)]
    state.settled[done] = True
    harden(problem, state, restarted)
    state.damping[restarted] = np.minimum(state.damping[restarted], FIRST_DAMPING)


def must_continue(problem: DesignProblem, state: SearchState, which: np.ndarray) -> np.ndarray:
    """Return a mask of the converged trials `which` that must continue: limits are exceeded, or the margin is still too large."""
    limits, u = state.found.limits[which], state.multipliers[which]
    wrong = np.max(np.abs(np.maximum(limits, -u)), axis=1, initial=0.0) > LIMIT_TOL * problem.scale
    rows = slice(problem.lengths.count, None)  # limits of transmission
    return wrong | (state.margin[which] > state.least[which] ** 2) & np.any(limits[:, rows] + u[:, rows] > 0, axis=1)


def harden(problem: DesignProblem, state: SearchState, which: np.ndarray):
    """Update the multipliers of some trials, raise their weights, and shrink their margins to the requested ones."""
    largest = MOST_WEIGHT * _height(problem, state, which)
    limits, u, weight = state.found.limits[which], state.multipliers[which], state.weight[which]
    state.multipliers[which], state.settled[which] = np.maximum(0.0, limits + u), False
    margin = np.maximum(SHRINK_MARGIN * state.margin[which], state.least[which] ** 2)
    unit = MARGIN_WEIGHT * problem.scale
    state.found.limits[which, problem.lengths.count :] += unit * (margin - state.margin[which])[:, None]
    state.margin[which] = margin
    _reweigh(problem, state, which, np.maximum(weight, np.minimum(WEIGHT_GROWTH * weight, largest)))


def raise_weights(problem: DesignProblem, state: SearchState):
    """Raise the weights of the limits of all trials where they are too small for the remaining losses."""
    all_trials = np.arange(len(state.merit))
    _reweigh(problem, state, all_trials, np.maximum(state.weight, FIRST_WEIGHT * _height(problem, state, all_trials)))


def _height(problem: DesignProblem, state: SearchState, which: np.ndarray) -> np.ndarray:
    """Return the unit of the weights of the trials `which`, at least 1 and proportional to the root of large losses."""
    return np.maximum(1.0, WEIGHT_UNIT / problem.scale * np.sqrt(loss_of(state.found.take(which))))


def _reweigh(problem: DesignProblem, state: SearchState, which: np.ndarray, weight: np.ndarray):
    """Change the weights of some trials, and the multipliers such that the forces of the limits remain the same."""
    state.multipliers[which] *= (state.weight[which] / weight)[:, None] ** 2
    state.weight[which] = weight
    merit = merit_of(state.found.take(which), state.multipliers[which], weight)
    state.merit[which] = np.where(np.isfinite(state.merit[which]), merit, np.inf)
