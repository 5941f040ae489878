"""The end of a search: the best different trials within all limits, verified by their motion.

`kinematics` may not be able to follow a mechanism close to a meeting of its branches. Such trials are refused, and improved
further with higher and higher limits of transmission while their loss is less than that of the best verified design.
"""

from typing import NamedTuple

import numpy as np

from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.designs import FoundDesign, verified
from udkjax.synthesis.polish import polish
from udkjax.synthesis.search import LIMIT_TOL, SearchState, begin, improve, loss_of
from udkjax.synthesis.trials import Trials

POLISH_STEPS = 40  # largest number of Newton steps; about five are usual at each weight of the limits
SAME_MECHANISM_TOL = 1e-3  # mechanisms whose pins differ by less, in scales, are the same
STRICTER_MARGINS = (0.01, 0.03, 0.1)  # limits of transmission (sines) with which refused trials are improved again, in turn
MARGIN_STEPS = 40  # steps with each of these limits
MOST_REFUSALS = 3  # refusals before all are improved again; to verify a motion takes longer than to improve sixteen trials


class _Candidates(NamedTuple):
    """Trials within all limits, the best first, and their losses."""

    trials: Trials
    loss: np.ndarray


class Selection(NamedTuple):
    """Designs, the losses of all trials within the limits, and the reason if there is no design."""

    found: list[FoundDesign]
    losses: np.ndarray
    reason: str


def select(problem: DesignProblem, state: SearchState, results: int, threads: int | None) -> Selection:
    """Return up to `results` of the best different designs, verified, from the final state of a search."""
    candidates = first = _within_limits(problem, state)
    losses = candidates.loss
    if not len(losses):
        return Selection([], losses, _exceeded_limit(problem, state))
    found: list[tuple[FoundDesign, np.ndarray]] = []
    for least in (*STRICTER_MARGINS, None):
        open_ones = _verify(problem, candidates, results, found, len(candidates.loss) if least is None else MOST_REFUSALS)
        if least is None or not len(open_ones):
            break
        state = begin(problem, candidates.trials.take(open_ones), threads, least)
        candidates = _within_limits(
            problem, polish(problem, improve(problem, state, MARGIN_STEPS, threads), POLISH_STEPS, threads)
        )
    if found and len(found) < results:  # add worse designs
        worse = np.flatnonzero(losses > found[0][0].loss)
        _verify(problem, _Candidates(first.trials.take(worse), losses[worse]), results, found, MOST_REFUSALS)
    reason = "the motions of all trials within the limits leave their branches or reach dead points"
    return Selection([design for design, _ in found], losses, "" if found else f"{reason}: raise `transmission`")


def _within_limits(problem: DesignProblem, state: SearchState) -> _Candidates:
    all_trials, loss = np.arange(len(state.merit)), loss_of(state.found)
    good = state.found.exists & (state.excess(problem, all_trials) <= 100 * LIMIT_TOL * problem.scale)
    # A trial that ends beyond a limit may have been within it earlier.
    from_stored = np.isfinite(state.kept_loss) & (~good | (state.kept_loss < loss))
    trials = Trials(*(np.concatenate([a[good], b[from_stored]]) for a, b in zip(state.trials, state.kept, strict=True)))
    losses = np.concatenate([loss[good], state.kept_loss[from_stored]])
    order = np.argsort(losses, kind="stable")
    return _Candidates(trials.take(order), losses[order])


def _verify(
    problem: DesignProblem, candidates: _Candidates, results: int, found: list[tuple[FoundDesign, np.ndarray]], most: int
) -> np.ndarray:
    """Add verified designs that differ to `found`, sorted by loss; return the indices of candidates better than the best design.

    If none was refused, no index is returned. Verification stops after `most` refusals.
    """
    refused: list[np.ndarray] = []
    for k, loss in enumerate(candidates.loss):
        if len(refused) == most or (len(found) >= results and loss >= found[results - 1][0].loss):
            break
        x, s, q = (a[k] for a in candidates.trials)
        signature = np.append(problem.signature(x, q[0]), 0.0)
        known = [*refused, *(earlier for _, earlier in found)]
        if any(np.max(np.abs(signature - earlier)) < SAME_MECHANISM_TOL * problem.scale for earlier in known):
            continue
        design = verified(problem, x, s, q, float(loss))
        if design is None:
            refused.append(signature)
        else:
            found.append((design, signature))
            found.sort(key=lambda pair: pair[0].loss)
    del found[results:]
    best = found[0][0].loss if found else np.inf
    return np.flatnonzero(candidates.loss < best * (1.0 - SAME_MECHANISM_TOL)) if refused else np.zeros(0, int)


def _exceeded_limit(problem: DesignProblem, state: SearchState) -> str:
    """Return a message with the limit that the trial closest to all limits exceeds most."""
    present = np.flatnonzero(state.found.exists)
    if not len(present):
        return "no trial passes all positions of the goal in one motion: widen the bounds, or raise starts"
    nearest = present[np.argmin(state.excess(problem, present))]
    names = problem.lengths.names
    worst = int(np.argmax(state.found.limits[nearest]))
    what = names[worst] if worst < len(names) else "the least transmission"
    return f"no trial is within all limits; the closest one exceeds {what}: widen the limits, or raise starts"
