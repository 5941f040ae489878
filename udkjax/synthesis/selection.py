"""The end of a search: trials within all limits, verified by their motion, of which those are taken that differ.

Where a mechanism comes near to where its branches meet, `kinematics` may refuse to follow it. Such trials go on with more
transmission, step by step, as long as they promise more than what has been verified.
"""

from typing import NamedTuple

import numpy as np

from udkjax.synthesis.design_problem import DesignProblem
from udkjax.synthesis.designs import FoundDesign, verified
from udkjax.synthesis.polish import polish
from udkjax.synthesis.search import KEPT_TO, SearchState, begin, improve, loss_of
from udkjax.synthesis.trials import Trials

POLISHING = 40  # Newton steps, of which some five are usual at each hardness of the limits
ALIKE = 1e-3  # scales: mechanisms whose pins differ by less are one
RETREATS = (0.01, 0.03, 0.1)  # least transmissions (sines) for which refused trials go on, in turn
RETREAT = 40  # steps of each
REFUSALS = 3  # before all go on: following a motion takes longer than improving sixteen trials


class _Candidates(NamedTuple):
    """Trials within all limits, the best first, and their losses."""

    trials: Trials
    loss: np.ndarray


class Selection(NamedTuple):
    """Designs, the losses of all trials within the limits, and why there are no designs where there are none."""

    found: list[FoundDesign]
    losses: np.ndarray
    reason: str


def select(problem: DesignProblem, state: SearchState, results: int, threads: int | None) -> Selection:
    """Return the best designs that differ, of a state in which a search ends."""
    candidates = first = _within_limits(problem, state)
    losses = candidates.loss
    if not len(losses):
        return Selection([], losses, _what_is_exceeded(problem, state))
    found: list[tuple[FoundDesign, np.ndarray]] = []
    for least in (*RETREATS, None):
        open_ones = _verify(problem, candidates, results, found, len(candidates.loss) if least is None else REFUSALS)
        if least is None or not len(open_ones):
            break
        state = begin(problem, candidates.trials.take(open_ones), threads, least)
        candidates = _within_limits(problem, polish(problem, improve(problem, state, RETREAT, threads), POLISHING, threads))
    if found and len(found) < results:  # beside the best one
        rest = np.flatnonzero(losses > found[0][0].loss)
        _verify(problem, _Candidates(first.trials.take(rest), losses[rest]), results, found, REFUSALS)
    reason = "the motions of the trials within the limits, when followed again, leave their branches or come to dead points"
    return Selection([design for design, _ in found], losses, "" if found else f"{reason}: ask for more transmission")


def _within_limits(problem: DesignProblem, state: SearchState) -> _Candidates:
    every, loss = np.arange(len(state.merit)), loss_of(state.found)
    good = state.found.is_there & (state.excess(problem, every) <= 100 * KEPT_TO * problem.scale)
    # A trial that ends beyond a limit was within it somewhere on its way.
    kept = np.isfinite(state.kept_loss) & (~good | (state.kept_loss < loss))
    trials = Trials(*(np.concatenate([a[good], b[kept]]) for a, b in zip(state.trials, state.kept, strict=True)))
    losses = np.concatenate([loss[good], state.kept_loss[kept]])
    order = np.argsort(losses, kind="stable")
    return _Candidates(trials.take(order), losses[order])


def _verify(
    problem: DesignProblem, candidates: _Candidates, results: int, found: list[tuple[FoundDesign, np.ndarray]], most: int
) -> np.ndarray:
    """Add verified designs that differ to those found, and sort; return which candidates promise more than the best of them.

    After so many refusals, at most, no more candidates are looked at.
    """
    refused: list[np.ndarray] = []
    for k, loss in enumerate(candidates.loss):
        if len(refused) == most or (len(found) >= results and loss >= found[results - 1][0].loss):
            break
        x, s, q = (a[k] for a in candidates.trials)
        signature = np.append(problem.signature(x, q[0]), 0.0)
        known = [*refused, *(other for _, other in found)]
        if any(np.max(np.abs(signature - other)) < ALIKE * problem.scale for other in known):
            continue
        one = verified(problem, x, s, q, float(loss))
        if one is None:
            refused.append(signature)
        else:
            found.append((one, signature))
            found.sort(key=lambda pair: pair[0].loss)
    del found[results:]
    best = found[0][0].loss if found else np.inf
    return np.flatnonzero(candidates.loss < best * (1.0 - ALIKE)) if refused else np.zeros(0, int)


def _what_is_exceeded(problem: DesignProblem, state: SearchState) -> str:
    """Return the limit that excludes the trial nearest to all of them."""
    present = np.flatnonzero(state.found.is_there)
    if not len(present):
        return "no trial has all positions of the goal in one motion: widen the bounds, or give more starts"
    nearest = present[np.argmin(state.excess(problem, present))]
    names = problem.lengths.names
    worst = int(np.argmax(state.found.limits[nearest]))
    what = names[worst] if worst < len(names) else "the least transmission"
    return f"no trial comes within all limits; the nearest one exceeds {what}: widen the limits, or give more starts"
