"""Search for a fit that explains the records, by strategies of increasing cost.

If the fit of the whole records from the first guess does not explain them, since phases are wrong by too much, growing parts of
the records are fitted: see `growing_records`. If this fails too, the same is done from other guesses, until one of them explains
the records. For records of chaotic motion, where all of these fail, see `shooting`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.study.identify.problem.fit_problem import RESIDUALS_PER_UNKNOWN, FitProblem, Strategy
from udkjax.study.identify.problem.prediction import LOOSE_TOL, MEDIUM_TOL, TolerancePair
from udkjax.study.identify.problem.residuals import reduce_blocks, residual_vector
from udkjax.study.identify.problem.unknowns import sample_guesses
from udkjax.study.identify.search.growing_records import EarlierFits, fit_growing_records
from udkjax.study.identify.search.least_squares import LOOSE_STEP, SOME_STEPS, CostHistory, Fit
from udkjax.study.identify.search.optimizer import Minimizer
from udkjax.study.identify.search.shooting import NoFitInPieces, fit_pieces

N_STARTS = 15  # number of further guesses if the first does not lead to a fit
MOST_GUESSES_IN_PIECES = 4  # number of guesses from which the records are fitted in pieces
SAMPLES_PER_GUESS = 8  # number of sampled guesses for each fitted one; a sample costs one evaluation, a fit about fifty
ENOUGH_AGREEING = 4  # number of guesses with the same best fit from which a better one is unlikely
SHOWN_PART = 0.3  # a fit with residuals below this, relative to the channels' scales, reproduces most of the motion
PART_GROWTH = 2.0  # ratio of successive parts of the records by which guesses are ranked
SHORTEST_PART = 1e-6  # least duration of the first part, relative to the records
CHAOTIC_GROWTH = 100.0  # growth of derivatives from the first half of a record to the second; for t^2 it is 4
EXPLAINED_PART = 1e-3  # residuals up to which records with unknown noise are explained, relative to the channels' scales
LIKELY_SQUARE = 2.0  # mean square of residuals up to which records with known noise are explained
WHITE_CORRELATION = 4.0  # correlation of neighbours, in standard deviations, up to which residuals are noise
# Fits are at the same minimum if their unknowns differ by less than the first number, or predictions by less than the second, in
# standard deviations of the residuals; unknowns at a bound, where z is as good as infinite, do not count.
SAME_MINIMUM_DISTANCE, SAME_PREDICTION = 1e-4, 0.1


class SearchResult(NamedTuple):
    """The best fit of a search.

    Attributes:
        fit: the best fit.
        agreeing: number of first guesses that led to it.
        guesses: number of first guesses.
        ways: the strategies that were tried.
        history: costs and steps of all fits.
        problem: the fitted problem, which may be one in pieces.
    """

    fit: Fit
    agreeing: int
    guesses: int
    ways: tuple[str, ...]
    history: CostHistory
    problem: FitProblem  # the fitted problem


def search(
    problem: FitProblem,
    z: Float[np.ndarray, "B K"],
    tol: TolerancePair,
    minimizer: Minimizer,
    more: int = N_STARTS,
    seed: int = 0,
    strategy: Strategy = "auto",
) -> SearchResult:
    """Find the unknowns that best explain the records.

    If the guesses z do not lead to a fit, `more` others are tried. If these also fail, and do not agree or the motion is chaotic,
    the records are cut into pieces. With the strategy "pieces" they are cut from the start. `tol` are the final tolerances; the
    search uses looser ones.
    """
    loose = max(tol[0], LOOSE_TOL), max(tol[1], LOOSE_TOL)
    if strategy == "pieces":
        grown_first = fit_growing_records(problem, z[0], loose, minimizer)
        if in_pieces := fit_in_pieces(problem, np.array([grown_first.z, *z]), tol, minimizer):
            return in_pieces._replace(history=grown_first.history + in_pieces.history)
    ways, tried = ["whole records"], list(z)
    earlier: EarlierFits = []
    labelled = minimizer.with_label("whole records")
    fits = [labelled.minimize(problem, guess, loose, None, SOME_STEPS, LOOSE_STEP) for guess in z]
    history = list(_best(fits).history)
    if not explains(problem, _best(fits), loose):
        ways.append("growing records")
        grown = [fit_growing_records(problem, guess, loose, minimizer, earlier) for guess in z]
        tried += [grown_fit.z for grown_fit in grown]
        history += [row for grown_fit in grown for row in grown_fit.history]
        fits = [_best(pair) for pair in zip(fits, grown, strict=True)]
    if more and not explains(problem, _best(fits), loose):
        ways.append("more first guesses")
        sampled = sample_guesses(problem.unknowns, z[0], SAMPLES_PER_GUESS * more, seed)
        for guess in rank_guesses(problem, sampled, loose):
            grown_fit = fit_growing_records(problem, guess, loose, minimizer, earlier)
            history += grown_fit.history
            tried.append(grown_fit.z)
            fits.append(grown_fit)
            if (
                explains(problem, _best(fits), loose)
                or len(earlier) >= len(z) + more
                or (count_agreeing(problem, fits, loose) >= ENOUGH_AGREEING and _shows_most(problem, _best(fits)))
            ):
                break
    best, agreeing = _best(fits), count_agreeing(problem, fits, loose)
    if more and not explains(problem, best, loose):
        # If half of the guesses agree, the model itself cannot reproduce the records.
        chaotic = is_chaotic(problem, best.z, loose)
        pieces = MOST_GUESSES_IN_PIECES if chaotic else 2 * agreeing < len(fits)
        in_pieces = fit_in_pieces(problem, np.array(tried), tol, minimizer, pieces)
        if in_pieces:
            return in_pieces._replace(guesses=len(fits), ways=(*ways, *in_pieces.ways), history=history + in_pieces.history)
    return SearchResult(best, agreeing, len(fits), tuple(ways), history, problem)


def _best(fits: Sequence[Fit]) -> Fit:
    return min(fits, key=lambda fit: fit.cost)


def count_agreeing(problem: FitProblem, fits: Sequence[Fit], tol: TolerancePair) -> int:
    """Return the number of fits at the same minimum as the best fit; 0 if no fit has a finite cost."""
    best, count = _best(fits), 0
    if not np.isfinite(best.cost):
        return count
    reduced = reduce_blocks(problem.row_blocks(best.z[None], tol))
    noise = np.sqrt(2.0 * best.cost / max(reduced.count if reduced else 0, 1))
    for fit in fits:
        seen = np.ones(len(best.z), bool)
        for at_bound in (best.stuck, fit.stuck):
            seen &= True if at_bound is None else ~at_bound
        change = np.where(seen, fit.z - best.z, 0.0)
        near = SAME_MINIMUM_DISTANCE * (1.0 + np.abs(best.z[seen]).max(initial=0.0))
        effect = np.linalg.norm(reduced.J @ change) if reduced else np.inf
        alike = np.abs(change).max(initial=0.0) <= near or effect <= SAME_PREDICTION * noise
        count += bool(np.isfinite(fit.cost)) and bool(alike)
    return count


def _shows_most(problem: FitProblem, fit: Fit) -> bool:
    """Return True if a fit reproduces most of the motion, with residuals that are small relative to the channels' scales."""
    scale = problem.channel_scale[problem.index[:, 2]] / problem.sigma
    return bool(2.0 * fit.cost < SHOWN_PART**2 * np.sum(scale**2))


def fit_in_pieces(
    problem: FitProblem, z: Float[np.ndarray, "B K"], tol: TolerancePair, minimizer: Minimizer, most: int = MOST_GUESSES_IN_PIECES
) -> SearchResult | None:
    """Fit the records in pieces, from the `most` best guesses in turn, until one explains the records; None if all fail.

    The result is then a fit of the whole records, unless the motion is too chaotic to integrate these accurately.
    """
    loose = max(tol[0], MEDIUM_TOL), max(tol[1], MEDIUM_TOL)
    for k, guess in enumerate(rank_guesses(problem, z, loose)[:most] if most else ()):
        try:
            pieces, fit = fit_pieces(problem, guess, loose, minimizer)
        except NoFitInPieces:
            continue
        if explains(pieces, fit, loose):
            result = SearchResult(fit, 1, k + 1, ("records in pieces",), fit.history, pieces)
            unknowns = fit.z[: problem.K]
            whole_fit = minimizer.with_label("whole records").minimize(problem, unknowns, tol, None, SOME_STEPS, LOOSE_STEP)
            if explains(problem, whole_fit, tol):
                return result._replace(fit=whole_fit, history=fit.history + whole_fit.history, problem=problem)
            return result
    return None


def is_chaotic(problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair) -> bool:
    """Return True if derivatives grow along a record faster than t^2, the fastest growth for motions that only change phase."""
    record, time, _ = problem.index.T
    late = problem.ts[record, time] > 0.5 * (problem.ts[record, 0] + problem.ts[record, -1])
    largest = np.zeros((2, len(problem.unknowns.names)))  # in the first half, and in the second
    for block in problem.row_blocks(z[None], tol):
        rows = block.row_numbers[: block.count_before(len(late))]
        J = np.abs(block.J[0, : len(rows), : largest.shape[1]])
        for half, own in ((0, ~late[rows]), (1, late[rows])):
            largest[half] = np.maximum(largest[half], J[own].max(0, initial=0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        return bool((largest[1] / largest[0] > CHAOTIC_GROWTH).any())


def rank_guesses(problem: FitProblem, z: Float[np.ndarray, "B K"], tol: TolerancePair) -> Float[np.ndarray, "B K"]:
    """Return guesses, the best first, ranked by residuals of the whole records and of their first parts, with equal weights."""
    record, time, _ = problem.index.T
    since, durations = problem.ts[record, time] - problem.ts[record, 0], horizons(problem)
    sums = np.zeros((len(durations), len(z)))
    for first in range(0, len(z), problem.sets_together):
        some = slice(first, first + problem.sets_together)
        for block in problem.row_blocks(z[some], tol):
            rows = block.row_numbers[: block.count_before(len(record))]
            square = np.square(block.r[:, : len(rows)])
            sums[:, some] += [square[:, since[rows] <= duration].sum(axis=1) for duration in durations]
    with np.errstate(divide="ignore"):
        logs = np.log(sums)
    # A failed run counts as a prediction without any motion.
    worst = np.log(np.sum((problem.channel_scale[problem.index[:, 2]] / problem.sigma) ** 2))
    return z[np.argsort(np.sum(np.nan_to_num(logs, nan=worst), axis=0), kind="stable")]


def horizons(problem: FitProblem) -> list[float]:
    """Return increasing durations (s) of the first parts of the records; the last is that of the whole records."""
    record, time, _ = problem.index.T
    passed = np.sort(problem.ts[record, time] - problem.ts[record, 0])
    enough = min(int(RESIDUALS_PER_UNKNOWN * problem.K), len(passed) - 1)
    begin, length = passed[0], max(passed[-1] - passed[0], SHORTEST_PART * problem.duration)
    first = max(float(passed[enough] - begin), SHORTEST_PART * length)
    count = max(0, int(np.ceil(np.log(length / first) / np.log(PART_GROWTH))))
    return [*(begin + length * PART_GROWTH ** (k - count) for k in range(count)), problem.duration]


def explains(problem: FitProblem, fit: Fit, tol: TolerancePair) -> bool:
    """Return True if the residuals of a fit are only noise: small enough, or uncorrelated in time."""
    if not (np.isfinite(fit.cost) and fit.converged):
        return False
    r, ok = residual_vector(problem.row_blocks(fit.z[None], tol))
    if not ok:
        return False
    r = r[: len(problem.index)]
    size = np.mean(r[problem.noise_given] ** 2) <= LIKELY_SQUARE if problem.noise_given.any() else True
    unknown_noise = r[~problem.noise_given]
    if size and (not unknown_noise.size or np.sqrt(np.mean(unknown_noise**2)) <= EXPLAINED_PART):
        return True
    return all(is_white(r[places]) for places in problem.series())


def is_white(r: np.ndarray) -> bool:
    """Return True if residuals in the order of time are not correlated with their predecessors."""
    power = r @ r
    return len(r) < 3 or power == 0.0 or abs(r[1:] @ r[:-1]) / power <= WHITE_CORRELATION / np.sqrt(len(r))
