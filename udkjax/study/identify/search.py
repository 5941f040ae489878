"""Which first guesses a fit sets out from, and along which parts of the records: no more than a fit needs.

A long record has many minima: one for each number of swings by which a guess can be wrong. So a fit that does not explain the
whole record from its first guess begins with the first few samples, which have one minimum, and takes more and more of the
record, each time from where it was; and where that fails too, from other guesses beside the first. What is left are records
of chaotic motion: see `shooting`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.least_squares import COARSE_STEP, FEW_STEPS, LOOSE_STEP, SOME_STEPS, STEPS, Fit, History
from udkjax.study.identify.optimizer import Minimizer
from udkjax.study.identify.prediction import LOOSE, MEDIUM, Tolerances
from udkjax.study.identify.problem import RESIDUALS_PER_UNKNOWN, Problem, Strategy
from udkjax.study.identify.shooting import PieceFailed, fit_pieces
from udkjax.study.identify.unknowns import sample_guesses

N_STARTS = 15  # guesses besides the first, where it does not lead to a fit
MOST_PIECEWISE = 4  # guesses from which the records are fitted in pieces
PART_GROWTH = 2.0  # from one part of the records that is fitted to the next
SHORTEST_PART = 1e-6  # of the records: the first that is fitted, where all was measured when they began
CHAOTIC_GROWTH = 100.0  # of derivatives, from the first halves of records to the second: t^2 makes 4 of it
EXPLAINED_PART = 1e-3  # of what the channels show: smaller residuals are taken for a fit, where their noise is not known
LIKELY_SQUARE = 2.0  # mean square of residuals whose noise is known, up to which they are taken for a fit
WHITE_CORRELATION = 4.0  # standard deviations of the correlation of neighbours, up to which residuals are taken for noise
SAME_MINIMUM = 1e-4  # of an unknown: fits this near are at one minimum


class SearchResult(NamedTuple):
    """The best fit, how many of how many first guesses led there, and what was tried, in words."""

    fit: Fit
    agreeing: int
    guesses: int
    ways: tuple[str, ...]
    history: History
    problem: Problem  # that the unknowns of the fit are of


def search(
    problem: Problem,
    z: Float[np.ndarray, "B K"],
    tol: Tolerances,
    minimizer: Minimizer,
    more: int = N_STARTS,
    seed: int = 0,
    strategy: Strategy = "auto",
) -> SearchResult:
    """Find the unknowns that explain the records best.

    Where the guesses z do not lead to a fit, `more` are tried beside the first. Where none does, and they do not agree or the
    motion is chaotic, the records are cut into pieces; with the strategy "pieces" at once. The tolerances `tol` are those at the
    end: on the way they are looser.
    """
    loose = max(tol[0], LOOSE), max(tol[1], LOOSE)
    if strategy == "pieces":
        along = fit_growing_parts(problem, z, loose, minimizer)
        if found := fit_in_pieces(problem, np.concatenate([along.z, z]), tol, minimizer):
            return found._replace(history=along.history + found.history)
    ways, tried = ["whole records"], [z]
    fit = minimizer.with_label("whole records").minimize(problem, z, loose, None, SOME_STEPS, LOOSE_STEP)
    history = list(fit.history)
    if not explains(problem, fit, loose):
        ways.append("growing records")
        other = fit_growing_parts(problem, z, loose, minimizer)
        history += other.history
        tried = [other.z, z]
        fit = fit.join(other).take(np.arange(len(z)) + np.where(other.cost < fit.cost, len(z), 0))
    if more and not explains(problem, fit, loose):
        ways.append(f"{more} more first guesses")
        guesses = sample_guesses(problem.unknowns, z[0], more, seed)
        other = fit_growing_parts(problem, guesses, loose, minimizer)
        history += other.history
        z = np.concatenate([z, guesses])
        tried.append(other.z)
        fit = fit.join(other)
    best = int(np.argmin(fit.cost))
    there = np.abs(fit.z - fit.z[best]).max(1) <= SAME_MINIMUM * (1.0 + np.abs(fit.z[best]).max())
    agreeing = int((there & np.isfinite(fit.cost)).sum())
    only = fit.take(np.array([best]))
    lost = 2 * agreeing < len(z) or is_chaotic(problem, only.z, loose)  # else the mechanism does not move like that
    if more and lost and not explains(problem, only, loose):
        found = fit_in_pieces(problem, np.concatenate(tried), tol, minimizer)
        if found:
            return found._replace(guesses=len(z), ways=(*ways, *found.ways), history=history + found.history)
    return SearchResult(only, agreeing, len(z), tuple(ways), history, problem)


def fit_in_pieces(problem: Problem, z: Float[np.ndarray, "B K"], tol: Tolerances, minimizer: Minimizer) -> SearchResult | None:
    """Fit the records in pieces, from the most promising guesses until one explains them; None: none does.

    Where the motion is not so chaotic that whole records are beyond the errors of their integration, the fit is of these.
    """
    loose = max(tol[0], MEDIUM), max(tol[1], MEDIUM)
    for k, guess in enumerate(rank_guesses(problem, z, loose)[:MOST_PIECEWISE]):
        try:
            pieces, fit = fit_pieces(problem, guess, loose, minimizer)
        except PieceFailed:
            continue
        if explains(pieces, fit, loose):
            found = SearchResult(fit, 1, k + 1, ("records in pieces",), fit.history, pieces)
            along = fit.z[:, : problem.K]
            whole = minimizer.with_label("whole records").minimize(problem, along, tol, None, SOME_STEPS, LOOSE_STEP, True)
            if explains(problem, whole, tol):
                return found._replace(fit=whole, history=fit.history + whole.history, problem=problem)
            return found
    return None


def is_chaotic(problem: Problem, z: Float[np.ndarray, "1 K"], tol: Tolerances) -> bool:
    """Return whether derivatives grow along a record faster than where motions only fall out of step: like t or t^2."""
    record, time, _ = problem.index.T
    late = problem.ts[record, time] > 0.5 * (problem.ts[record, 0] + problem.ts[record, -1])
    J = np.abs(problem.evaluate(z, tol).J[0, : len(problem.index), : len(problem.unknowns.names)])
    with np.errstate(invalid="ignore", divide="ignore"):
        return bool((J[late].max(0, initial=0.0) / J[~late].max(0, initial=0.0) > CHAOTIC_GROWTH).any())


def rank_guesses(problem: Problem, z: Float[np.ndarray, "B K"], tol: Tolerances) -> Float[np.ndarray, "B K"]:
    """Return guesses, the best first: those that leave least of the records and of their first parts, which all count alike."""
    with np.errstate(divide="ignore"):
        logs = [np.log(np.sum(np.square(problem.evaluate(z, tol, part).r), axis=1)) for part in horizons(problem)]
    return z[np.argsort(np.nan_to_num(np.sum(logs, axis=0), nan=np.inf), kind="stable")]


def fit_growing_parts(problem: Problem, z: Float[np.ndarray, "B K"], tol: Tolerances, minimizer: Minimizer) -> Fit:
    """Fit more and more of the records, each time from where the fits of the part before have ended."""
    history: History = []
    for part in horizons(problem)[:-1]:
        one = minimizer.with_label(f"{part:.0%} of the records")
        fit = one.minimize(problem, z, tol, part, FEW_STEPS, COARSE_STEP)
        z = np.where(np.isfinite(fit.cost)[:, None], fit.z, z)
        history += fit.history
    fit = minimizer.with_label("whole records").minimize(problem, z, tol, None, STEPS, LOOSE_STEP)
    return fit._replace(history=history + fit.history)


def horizons(problem: Problem) -> list[float]:
    """Return parts of the records to fit, one after another: the last is all of them."""
    record, time, _ = problem.index.T
    ts = problem.ts
    passed = np.sort((ts[record, time] - ts[record, 0]) / (ts[record, -1] - ts[record, 0]))
    enough = min(int(RESIDUALS_PER_UNKNOWN * problem.K), len(passed) - 1)
    first = max(float(passed[enough]), SHORTEST_PART)
    count = max(0, int(np.ceil(np.log(1.0 / first) / np.log(PART_GROWTH))))
    return [PART_GROWTH ** (k - count) for k in range(count)] + [1.0]


def explains(problem: Problem, fit: Fit, tol: Tolerances) -> bool:
    """Return whether the best of some fits leaves nothing but noise."""
    best = int(np.argmin(fit.cost))
    if not (np.isfinite(fit.cost[best]) and fit.settled[best]):
        return False
    found = problem.evaluate(fit.z[best : best + 1], tol)
    if not found.ok[0]:
        return False
    r = found.r[0, : len(problem.index)]
    size = np.mean(r[problem.noise_given] ** 2) <= LIKELY_SQUARE if problem.noise_given.any() else True
    rest = r[~problem.noise_given]
    if size and (not rest.size or np.sqrt(np.mean(rest**2)) <= EXPLAINED_PART):
        return True
    return all(is_white(r[places]) for places in problem.series())


def is_white(r: np.ndarray) -> bool:
    """Return whether residuals in the order of time are not correlated with those before them."""
    power = r @ r
    return len(r) < 3 or power == 0.0 or abs(r[1:] @ r[:-1]) / power <= WHITE_CORRELATION / np.sqrt(len(r))
