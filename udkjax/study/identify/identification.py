"""`identify`: from a mechanism, records and the names of parameters to an estimate."""

import time
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.argument_types import FINITE, NOT_NEGATIVE, NOT_NEGATIVE_COUNT
from udkjax.equations.rows.analysis import Analysis
from udkjax.integrate.solution import CAUSES, Result
from udkjax.progress import ProgressOption, report_progress
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.study.identify.answers.estimate import Estimate
from udkjax.study.identify.answers.uncertainty import UnknownValues, estimate_uncertainty
from udkjax.study.identify.problem.fit_problem import FitProblem, Strategy, build_problem
from udkjax.study.identify.problem.outliers import find_outlier_rows, list_outliers
from udkjax.study.identify.problem.parameters import ParametersLike
from udkjax.study.identify.problem.prediction import LOOSE_TOL, TIGHT_TOL, TolerancePair
from udkjax.study.identify.problem.residuals import Residuals, reduce_groups, residual_vector
from udkjax.study.identify.problem.row_statistics import hat_bands, residuals_of_others
from udkjax.study.identify.records.record_reader import Data
from udkjax.study.identify.records.records import Estimated, IdentificationError, Noise, Start
from udkjax.study.identify.search.least_squares import CostHistory, Fit
from udkjax.study.identify.search.optimizer import (
    Loss,
    LossChoice,
    Minimizer,
    Optimizer,
    choose_method,
    named_loss,
    squares,
    weighted_residuals,
)
from udkjax.study.identify.search.search import N_STARTS, SearchResult, search
from udkjax.study.noise import NOISE_FLOOR, Whiteness, whiteness_of
from udkjax.study.quantities import StudyModel

MOST_REWEIGHTINGS = 2  # number of further fits, each weighted by the residuals of the previous one
SAME_WEIGHT_RATIO = 1.05  # change of relative weights that shifts an estimate by a negligible fraction of its standard error
INTEGRATION_ERROR = 1e-8  # residuals below this, relative to a channel's scale, are integration errors, not noise


@checked
@concrete_only()
def identify(
    mechanism: StudyModel,
    data: Data,
    parameters: ParametersLike,
    *,
    noise: Noise = None,
    initial_state: Start | Estimated | None = None,
    n_starts: int = N_STARTS,
    guesses: Annotated[Numbers, FINITE] | None = None,
    loss: LossChoice = "least_squares",
    optimizer: Optimizer = None,
    strategy: Strategy = "auto",
    tol: Annotated[float, NOT_NEGATIVE] = TIGHT_TOL,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    ignore: Sequence[str] = (),
    progress: ProgressOption = None,
    **settings: Any,
) -> Estimate:
    """Identify parameters of a mechanism from measured motion.

    With y the measured and yhat(z) the predicted values, sum ((yhat(z) - y) / sigma)^2 is minimized by SciPy's `least_squares`,
    with exact forward derivatives through the closure of all loops. If the fit from the first guess does not explain the records,
    for example because a predicted oscillation gets out of phase, growing parts of the records are fitted, each as long as the
    previous fit can predict; then the same is done from other guesses, up to a factor of 2.5 away. If no guess leads to a fit,
    as with chaotic motion, the records are cut into pieces (multiple shooting).

    Args:
        mechanism: the scene, with first guesses; or a `ConstrainedSystem` with q0, whose parameters are fields of its modules.
        data: a `Record`, a mapping of times ("time") and channels, such as "body.crank.angle" or "q[0]" of a system, a pandas
            table, an xarray dataset, the path of a CSV or NetCDF file, or a sequence of these. Each record has its own initial
            state.
        parameters: names of numbers of the scene, `length`s, ties as strings (`body.a.mass = body.b.mass`), or `Parameter`s with
            bounds and priors.
        noise: standard deviation, in SI units, of all channels or of each by channel; by default estimated from the residuals of
            the fit.
        initial_state: the `Start` of every record, or the parts of the initial state to estimate ("position", "velocity",
            "both"); by default that of each record, and for tables that of the scene.
        n_starts: largest number of further first guesses to fit, chosen from eight times as many samples; may be 0.
        guesses: further first guesses (B, P), instead of `n_starts`.
        loss: "least_squares"; "huber" or "soft_l1", which reduce the influence of outliers; or a JAX function of the weighted
            residuals (R,), whose standard errors are those of least squares.
        optimizer: an optax optimizer without a line search; by default SciPy's least squares, or L-BFGS for a function `loss`.
        strategy: "pieces" cuts the records into pieces from the start; "auto" does so only if nothing else leads to a fit.
        tol: tolerance of the final integration, relative and absolute.
        seed: seed of the further first guesses.
        ignore: columns of tables that are not read.
        progress: None or "auto" shows a line after two seconds, True at once, False never; a callable gets each `Progress`.
        settings: further arguments of `simulate`, such as a `max_steps` that bounds runs with numbers far from the fit.

    Returns:
        The estimate. If the records do not determine every parameter, `Estimate.success` is False and `Estimate.message` names
        the undetermined ones.

    Raises:
        IdentificationError: lists every mistake, including parameters that would open a loop with redundant constraints.
    """
    Analysis.require_masses(mechanism, "free motions")
    start, tol = time.perf_counter(), float(tol)
    problem = build_problem(mechanism, data, parameters, settings, noise, ignore, seed, strategy, initial_state, tol)
    first = _first_guesses(problem, n_starts, guesses)
    residual_loss = squares if callable(loss) else named_loss(loss, len(problem.index))
    method = choose_method(optimizer, loss)
    with report_progress(progress, None, "identify") as report:
        minimizer = Minimizer(method, residual_loss, lambda text: report(report.state.done + 1, text))
        result = search(problem, first, (tol, tol), minimizer, 0 if guesses is not None else n_starts, seed, strategy)
        _require_finite(problem, result)
        fit, history = _refit(result, (tol, tol), minimizer)
    return _estimate_of(fit, result, history, (tol, tol), residual_loss, time.perf_counter() - start)


MOST_STARTS = 10**6  # largest number of first guesses; more would not fit into memory


def _first_guesses(problem: FitProblem, n_starts: int, guesses: Numbers | None) -> Float[np.ndarray, "B K"]:
    """Return the first guesses z of all unknowns: zero, then the given `guesses` of parameters with initial states of zero.

    Raises:
        IdentificationError: `n_starts` is out of range, or `guesses` are not values of the parameters.
    """
    first, P = np.zeros((1, problem.K)), len(problem.unknowns.names)
    if not 0 <= n_starts <= MOST_STARTS:
        raise IdentificationError([f"n_starts: must be a number of guesses between 0 and {MOST_STARTS:,}, not {n_starts}"])
    if guesses is None:
        return first
    given = np.asarray(guesses, float)
    if given.ndim != 2 or given.shape[1] != P or not np.isfinite(given).all():
        raise IdentificationError(
            [f"guesses: must be of shape (B, {P}), one finite value per parameter; is of shape {given.shape}"]
        )
    z = problem.unknowns.z_of(given)
    if not np.isfinite(z).all():
        wrong = problem.unknowns.names[int(np.argmax(~np.isfinite(z).all(0)))]
        raise IdentificationError([f"guesses: one of {wrong} is not between its bounds, or not positive"])
    return np.concatenate([first, np.concatenate([z, np.zeros((len(z), problem.K - P))], 1)])


def _require_finite(problem: FitProblem, result: SearchResult) -> None:
    if not np.isfinite(result.fit.cost):
        code = problem.code(result.fit.z, (LOOSE_TOL, LOOSE_TOL))
        raise IdentificationError([f"the records cannot be simulated with any first guess: {CAUSES[Result(code)]}"])


# --- the end of a fit


def _refit(result: SearchResult, tol: TolerancePair, minimizer: Minimizer) -> tuple[Fit, CostHistory]:
    """Fit to the final tolerance, each channel weighted by the noise estimated from its residuals.

    Return the fit, and the cost history of the search and of all fits here.
    """
    problem = result.problem
    fit = minimizer.minimize(problem, result.fit.z, tol)
    history = [*result.history, *fit.history]
    unknown = np.unique(problem.index[~problem.noise_given, 2])
    robust = minimizer.loss is not squares  # outliers depend on the noise
    for _ in range(MOST_REWEIGHTINGS if len(unknown) + problem.noise_given.any() > 1 or (robust and len(unknown)) else 0):
        if not reweigh(problem, fit.z, tol, minimizer.loss, NOISE_FLOOR):
            break
        fit = minimizer.minimize(problem, fit.z, tol)
        history += fit.history
    return fit, history


def reweigh(problem: FitProblem, z: Float[np.ndarray, "K"], tol: TolerancePair, loss: Loss, least: float = 0.0) -> bool:
    """Set the noise of channels without given noise from their residuals, but to at least `least` times the channel's scale.

    Returns:
        True if another fit is needed: the relative weights of residuals changed, the loss is robust, or there are priors.
    """
    old_sigma = problem.sigma.copy()
    rows = len(problem.index)
    r = residual_vector(problem.row_blocks(z[None], tol))[0][:rows]
    residuals, inliers = r * problem.sigma, ~find_outlier_rows(problem, r)
    for c in range(len(problem.channels)):
        measured_inliers = (problem.index[:, 2] == c) & ~problem.noise_given & inliers
        if measured_inliers.any():
            # Each channel loses a share of the degrees of freedom to the unknowns.
            freedom = measured_inliers.sum() * (1.0 - (problem.K - problem.constrained) / rows)
            size = np.sqrt(residuals[measured_inliers] @ residuals[measured_inliers] / max(freedom, 1.0))
            measured = (problem.index[:, 2] == c) & ~problem.noise_given
            problem.sigma[measured] = max(size, max(least, np.finfo(float).tiny ** 0.25) * problem.channel_scale[c])
    ratio = problem.sigma / old_sigma
    return bool(ratio.max() > SAME_WEIGHT_RATIO * ratio.min()) or loss is not squares or bool(len(problem.priors))


def _estimate_of(
    fit: Fit, search_result: SearchResult, history: CostHistory, tol: TolerancePair, loss: Loss, seconds: float
) -> Estimate:
    """Return the estimate of a fit."""
    problem = search_result.problem
    unknowns, P, z = problem.unknowns, len(problem.unknowns.names), fit.z
    x, states = unknowns.values(z[:P]), problem.state_sizes * z[P:]
    plain, rows = residual_vector(problem.row_blocks(z[None], tol))[0], len(problem.index)
    outlying, robust = find_outlier_rows(problem, plain[:rows]), loss is not squares
    # Outliers hardly affect a robust loss and are left out here; in least squares they count, also for standard errors.
    inliers = np.concatenate([~outlying | (not robust), np.ones(problem.extra_rows, bool)])
    groups = problem.noise_groups()
    values = UnknownValues(
        problem.all_names,
        problem.all_units,
        np.concatenate([x, states]),
        np.concatenate([unknowns.dx_dz(z[:P]), problem.state_sizes]),
        (*unknowns.kinds, *["free"] * (problem.K - P)),
    )
    blocks = weighted_residuals(problem, tol, loss)
    reduced = reduce_groups(blocks(z[None]), problem.K, groups, len(problem.priors), inliers)
    stuck, factor = unknowns.stuck_at_bounds(z, reduced.r, reduced.J, reduced.rows), np.ones(problem.K)
    if stuck.any():
        # dr/dz vanishes at a bound; dr/dx, from within, does not.
        scale = np.append(unknowns.range_scale, problem.state_sizes)
        factor = np.where(stuck, scale / values.dx_dz, 1.0)
        values = values._replace(dx_dz=np.where(stuck, scale, values.dx_dz))
    uncertainty = estimate_uncertainty(reduced.scaled(factor), values, P)
    scale = np.append(uncertainty.noise, 1.0)[groups]
    residual = -plain[:rows] * problem.sigma
    sigma, whitened = problem.sigma * scale[:rows], loss(_without_slopes(plain)).r[0, :rows]
    if outlying.any():
        inlier_residuals = residuals_of_others(problem, z, tol, outlying)
        for g in np.unique(groups[:rows][outlying & (groups[:rows] >= 0)]):
            in_group = groups[:rows] == g
            sigma[in_group] = problem.sigma[in_group] * np.sqrt(
                np.nanmean(inlier_residuals[in_group] ** 2) / (1.0 - problem.K / inliers.sum())
            )
        whitened = inlier_residuals
    by = scale[:rows] if np.isfinite(uncertainty.noise).all() else np.ones(rows)
    hat = hat_bands(problem, blocks(z[None]), factor[:, None] * uncertainty.projector, by, ~outlying)
    white: dict[tuple[int, str], Whiteness] = {}
    for places in problem.series():
        record, _, channel = problem.index[places[0]]
        if np.abs(residual[places]).max() > INTEGRATION_ERROR * problem.channel_scale[channel]:
            times = problem.ts[record, problem.index[places, 1]]
            white[int(record), problem.channel_names[channel]] = whiteness_of(
                times, (whitened / scale[:rows])[places], hat[int(record), int(channel)]
            )
    names = [name for state in problem.initial_states for name in state.names]
    return Estimate(
        names=unknowns.names,
        units=unknowns.units,
        values=x,
        uncertainty=uncertainty,
        at_bounds=tuple(name for k, name in enumerate(unknowns.names) if stuck[k] or name in unknowns.at_bounds(x)),
        initial_state_values=dict(zip(names, zip(states.tolist(), uncertainty.state_errors.tolist(), strict=True), strict=False)),
        predicted=problem.by_record(problem.measured - residual),
        residuals=problem.by_record(residual),
        noise=problem.by_record(sigma),
        outliers=list_outliers(problem, outlying, residual, sigma),
        whiteness=white,
        converged=fit.converged,
        agreeing=search_result.agreeing,
        guesses=search_result.guesses,
        ways=search_result.ways,
        history=tuple(history),
        evaluations=problem.predictor.evaluations,
        seconds=seconds,
        tol=tol,
        z=z,
        problem=problem,
        loss=loss,
    )


def _without_slopes(r: Float[np.ndarray, "R"]) -> Residuals:
    """Return residuals of a single set of unknowns whose Jacobian has no columns."""
    return Residuals(r[None], np.zeros((1, len(r), 0)), np.zeros(1, int))
