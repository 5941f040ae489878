"""Identify: from a mechanism, records and the names of parameters to an estimate."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from udkjax.integrate.solution import CAUSES, Result
from udkjax.progress import ProgressOption, report_progress
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.estimate import Estimate
from udkjax.study.identify.fit_problem import INVISIBLE_RATIO, FitProblem, Residuals, Strategy, build_problem
from udkjax.study.identify.least_squares import CostHistory, Fit
from udkjax.study.identify.optimizer import Loss, Minimizer, Optimizer, UserLoss, choose_method, named_loss, squares
from udkjax.study.identify.outliers import NOISE_FLOOR, find_outlier_rows, list_outliers
from udkjax.study.identify.parameters import ParametersLike
from udkjax.study.identify.prediction import LOOSE_TOL, TIGHT_TOL, TolerancePair
from udkjax.study.identify.record_reader import Data
from udkjax.study.identify.records import Estimated, IdentificationError, Noise, Start
from udkjax.study.identify.search import N_STARTS, SearchResult, search
from udkjax.study.identify.uncertainty import UnknownValues, estimate_uncertainty
from udkjax.study.noise import Whiteness, whiteness_of

MOST_REWEIGHTINGS = 2  # fits, each with the noise that the one before left
SAME_WEIGHT_RATIO = 1.05  # ratio of weights, compared with each other, that moves no estimate by what counts beside its error
INTEGRATION_ERROR = 1e-8  # of what a channel shows: smaller residuals are errors of the integration, which need not be noise


@checked
def identify(
    mechanism: Mechanism,
    data: Data,
    parameters: ParametersLike,
    *,
    noise: Noise = None,
    initial_state: Start | Estimated | None = None,
    n_starts: int = N_STARTS,
    guesses: ArrayLike | None = None,
    loss: str | UserLoss = "least_squares",
    optimizer: Optimizer = None,
    strategy: Strategy = "auto",
    tol: float = TIGHT_TOL,
    seed: int = 0,
    ignore: Sequence[str] = (),
    progress: ProgressOption = None,
    **settings: Any,
) -> Estimate:
    """Find the values of parameters with which a mechanism moves as was measured.

    With y what was measured and yhat(z) what the mechanism shows, sum ((yhat(z) - y) / sigma)^2 is minimized by SciPy's
    `least_squares` with exact forward derivatives, through the closure of all loops. Where the first guess does not lead to a
    fit that explains the records, as it is wrong by a swing somewhere, they are fitted as they grow, each time as far as what is
    known by then predicts them; then from other guesses, up to a factor of 2.5 away. Where none leads to a fit, as along chaotic
    motion, the records are cut into pieces that are held together.

    Args:
        mechanism: the scene, with first guesses.
        data: a `Record`, a mapping of times ("time") and channels, a table of pandas or a dataset of xarray, the path of a CSV or
            NetCDF file, or a sequence of these: records, each with an initial state of its own.
        parameters: names of numbers of the scene, `length`s, ties in text (`body.a.mass = body.b.mass`), or `Parameter`s with
            bounds and priors.
        noise: standard deviation, in SI units, of all channels or of each by channel; where none is given it is estimated from
            the residuals of the fit.
        initial_state: the `Start` of every record, or what of it is to be estimated ("position", "velocity", "both"); by default
            the records' own, and for those of tables the scene's.
        n_starts: most further first guesses to follow, the best of eight times as many; 0: none.
        guesses: first guesses (B, P) to try besides the first, in place of `n_starts`.
        loss: "least_squares"; "huber" or "soft_l1", for which single wrong numbers count less; or a function of the weighted
            residuals (R,) by JAX (standard errors stay those of squares).
        optimizer: of optax, instead of SciPy's least squares (for a loss of your own: of L-BFGS); one without a line search.
        strategy: "pieces" cuts the records into pieces at once; "auto": only where nothing else leads to a fit.
        tol: tolerance of the integration at the end, relative and absolute.
        seed: of further first guesses.
        ignore: columns of tables that are not read.
        progress: None or "auto" shows a line after two seconds, True at once, False none; a callable gets each `Progress`.
        settings: further ones of `simulate`.

    Returns:
        The estimate. What the records do not show is no error: `Estimate.success` is false, and `Estimate.message` names it.

    Raises:
        IdentificationError: with every mistake; also where a parameter would open a loop that has more constraints than it needs.
    """
    start = time.perf_counter()
    problem = build_problem(mechanism, data, parameters, settings, noise, ignore, seed, strategy, initial_state, tol)
    first = _first_guesses(problem, n_starts, guesses)
    residual_loss = squares if callable(loss) else named_loss(loss, len(problem.index))
    method = choose_method(optimizer, loss)
    with report_progress(progress, None, "identify") as report:
        minimizer = Minimizer(method, residual_loss, lambda text: report(report.state.done + 1, text))
        found = search(problem, first, (tol, tol), minimizer, 0 if guesses is not None else n_starts, seed, strategy)
        _require_finite(problem, found)
        fit, history = _refit(found, (tol, tol), minimizer)
    return _estimate_of(fit, found, history, (tol, tol), residual_loss, time.perf_counter() - start)


MOST_STARTS = 10**6  # first guesses: of more, not even their numbers fit into memory at once


def _first_guesses(problem: FitProblem, n_starts: int, guesses: ArrayLike | None) -> Float[np.ndarray, "B K"]:
    """Return first guesses of all unknowns."""
    first, P = np.zeros((1, problem.K)), len(problem.unknowns.names)
    if not 0 <= n_starts <= MOST_STARTS:
        raise IdentificationError([f"n_starts: must be a number of guesses from 0 on, {MOST_STARTS:,} at most, is {n_starts}"])
    if guesses is None:
        return first
    given = np.asarray(guesses, float)
    if given.ndim != 2 or given.shape[1] != P or not np.isfinite(given).all():
        raise IdentificationError(
            [f"guesses: must be of shape (B, {P}), one finite value a parameter; is of shape {given.shape}"]
        )
    z = problem.unknowns.z_of(given)
    if not np.isfinite(z).all():
        wrong = problem.unknowns.names[int(np.argmax(~np.isfinite(z).all(0)))]
        raise IdentificationError([f"guesses: one of {wrong} is not between its bounds, or not positive"])
    return np.concatenate([first, np.concatenate([z, np.zeros((len(z), problem.K - P))], 1)])


def _require_finite(problem: FitProblem, found: SearchResult) -> None:
    if not np.isfinite(found.fit.cost):
        code = problem.evaluate(found.fit.z[None], (LOOSE_TOL, LOOSE_TOL)).code[0]
        raise IdentificationError([f"no first guess could be simulated along the records: {CAUSES[Result(int(code))]}"])


# --- the end of a fit


def _refit(found: SearchResult, tol: TolerancePair, minimizer: Minimizer) -> tuple[Fit, CostHistory]:
    """Fit to the end, each channel weighted by the noise that it has turned out to have."""
    problem = found.problem
    fit = minimizer.minimize(problem, found.fit.z, tol)
    history = [*found.history, *fit.history]
    unknown = np.unique(problem.index[~problem.noise_given, 2])
    robust = minimizer.loss is not squares  # outliers depend on the noise
    for _ in range(MOST_REWEIGHTINGS if len(unknown) + problem.noise_given.any() > 1 or (robust and len(unknown)) else 0):
        if not reweigh(problem, fit.z, tol, minimizer.loss, NOISE_FLOOR):
            break
        fit = minimizer.minimize(problem, fit.z, tol)
        history += fit.history
    return fit, history


def reweigh(problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, loss: Loss, least: float = 0.0) -> bool:
    """Take what a fit leaves of each channel as its noise, where that is not known, and `least` of what the channel shows.

    Returns:
        Whether residuals weigh otherwise now, compared with each other.
    """
    before = problem.sigma.copy()
    rows = len(problem.index)
    r = problem.evaluate(z[None], tol).r[0, :rows]
    left, kept = r * problem.sigma, ~find_outlier_rows(problem, r)
    for c in range(len(problem.channels)):
        own = (problem.index[:, 2] == c) & ~problem.noise_given & kept
        if own.any():
            # Unknowns take their part of each channel's freedom.
            freedom = own.sum() * (1.0 - (problem.K - problem.constrained) / rows)
            size = np.sqrt(left[own] @ left[own] / max(freedom, 1.0))
            every = (problem.index[:, 2] == c) & ~problem.noise_given
            problem.sigma[every] = max(size, max(least, np.finfo(float).tiny ** 0.25) * problem.channel_scale[c])
    ratio = problem.sigma / before
    return bool(ratio.max() > SAME_WEIGHT_RATIO * ratio.min()) or loss is not squares or bool(len(problem.priors))


def _estimate_of(fit: Fit, found: SearchResult, history: CostHistory, tol: TolerancePair, loss: Loss, seconds: float) -> Estimate:
    """Return the estimate of a fit."""
    problem = found.problem
    unknowns, P, z = problem.unknowns, len(problem.unknowns.names), fit.z
    x, states = unknowns.values(z[:P]), problem.state_sizes * z[P:]
    plain, rows = problem.evaluate(z[None], tol), len(problem.index)
    weighted = loss(plain)
    outlying, robust = find_outlier_rows(problem, plain.r[0, :rows]), loss is not squares
    # By a robust loss outliers hardly count, and are left out here; squares count them, and so do standard errors.
    kept = np.concatenate([~outlying | (not robust), np.ones(problem.extra_rows, bool)])
    groups = problem.noise_groups()
    values = UnknownValues(
        problem.all_names,
        problem.all_units,
        np.concatenate([x, states]),
        np.concatenate([unknowns.dx_dz(z[:P]), problem.state_sizes]),
        (*unknowns.kinds, *["free"] * (problem.K - P)),
    )
    J, r = weighted.J[0][kept], weighted.r[0][kept]
    uncertainty = estimate_uncertainty(J, r, values, groups[kept], P, len(problem.priors))
    scale = np.append(uncertainty.noise, 1.0)[groups]
    projection = np.zeros((len(kept), uncertainty.projection.shape[1]))
    projection[kept] = uncertainty.projection
    left = -plain.r[0, :rows] * problem.sigma
    sigma, seen = problem.sigma * scale[:rows], weighted.r[0, :rows]
    if outlying.any():
        others = _residuals_of_others(problem, plain, outlying)
        for g in np.unique(groups[:rows][outlying & (groups[:rows] >= 0)]):
            own = groups[:rows] == g
            sigma[own] = problem.sigma[own] * np.sqrt(np.nanmean(others[own] ** 2) / (1.0 - problem.K / kept.sum()))
        seen = others
    white: dict[tuple[int, str], Whiteness] = {}
    for places in problem.series():
        record, _, channel = problem.index[places[0]]
        if np.abs(left[places]).max() > INTEGRATION_ERROR * problem.channel_scale[channel]:
            times = problem.ts[record, problem.index[places, 1]]
            white[int(record), problem.channel_names[channel]] = whiteness_of(
                times, (seen / scale[:rows])[places], projection[places]
            )
    names = [name for state in problem.initial_states for name in state.names]
    return Estimate(
        names=unknowns.names,
        units=unknowns.units,
        values=x,
        uncertainty=uncertainty,
        at_bounds=unknowns.at_bounds(x),
        initial_state_values=dict(zip(names, zip(states.tolist(), uncertainty.state_errors.tolist(), strict=True), strict=False)),
        predicted=problem.by_record(problem.y[problem.present] - left),
        residuals=problem.by_record(left),
        noise=problem.by_record(sigma),
        outliers=list_outliers(problem, outlying, left, sigma),
        whiteness=white,
        converged=fit.settled,
        agreeing=found.agreeing,
        guesses=found.guesses,
        ways=found.ways,
        history=tuple(history),
        evaluations=problem.predictor.evaluations,
        seconds=seconds,
        tol=tol,
        z=z,
        problem=problem,
        loss=loss,
    )


def _residuals_of_others(problem: FitProblem, found: Residuals, outlying: np.ndarray) -> Float[np.ndarray, "R"]:
    """Return the residuals of a fit without the outliers, to first order; nan in the place of outliers."""
    r, J, kept = found.r[0], found.J[0], np.concatenate([~outlying, np.ones(problem.extra_rows, bool)])
    left = r - J @ np.linalg.lstsq(J[kept], r[kept], rcond=INVISIBLE_RATIO)[0]
    return np.where(outlying, np.nan, left[: len(outlying)])
