"""The result of an identification: values, their uncertainty, undetermined parameters, and the history of the fit."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udkjax.extras import OptionalImport
from udkjax.integrate.solution import scene_text, versions
from udkjax.positions.assembling.assembly import State
from udkjax.printing import PrintedTable, html_table, text_table
from udkjax.scene.arguments import checked
from udkjax.study.identify.answers.gradient_agreement import GradientCheck
from udkjax.study.identify.answers.gradient_check import compare_gradients
from udkjax.study.identify.answers.joint_profile import JointProfile, confidence_ellipse, joint_profile, require_two
from udkjax.study.identify.answers.profile_likelihood import CONFIDENCE, ProfileLikelihood, profile_likelihood, profiles_dataset
from udkjax.study.identify.answers.uncertainty import Uncertainty
from udkjax.study.identify.density.laplace import Laplace, approximate
from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.identify.problem.directions import Directions
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.outliers import Outlier, outlier_sentences
from udkjax.study.identify.problem.prediction import LOOSE_TOL, TolerancePair
from udkjax.study.identify.problem.unknowns import apply_values
from udkjax.study.identify.records.records import IdentificationError, dataset_of_fit, label_prefixes
from udkjax.study.identify.search.optimizer import Loss, squares, weighted_residuals
from udkjax.study.noise import Whiteness
from udkjax.study.quantities import StudyModel
from udkjax.study.report import format_value, plain
from udkjax.wording import join_names, plural, quote, suggestion

if TYPE_CHECKING:
    import xarray

FORMAT = "udkjax identification 1"  # format of the dataset
PRINTED_CORRELATION = 0.9  # correlation above which a table names it: the errors of a combination are four times those of another


class Row(NamedTuple):
    """An identified number: a parameter, or the correction of an initial state."""

    parameter: str
    value: float
    standard_error: float
    units: str
    first_guess: float
    note: str


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """Identified values of parameters with their uncertainty. `print` shows a table.

    Attributes:
        names: names of the P parameters; `units` are their units.
        values: identified values, in these units.
        uncertainty: standard errors, correlations, and undetermined directions.
        at_bounds: parameters that are at one of their bounds, or at zero if they cannot be negative; their standard errors are
            for changes away from the bound.
        initial_state_values: correction and standard error of each unknown of an initial state.
        predicted, residuals, noise: for each record, by channel, at its times (T,): predicted values; measured minus predicted;
            and standard deviations, given or estimated.
        outliers: measured values too far from the prediction to be noise; `noise` is that of the other values.
        whiteness: test for white noise of the residuals of each record's channels that exceed integration errors.
        converged: True if the fit converged.
        agreeing: number of first guesses, out of `guesses`, that led to this fit.
        ways: strategies that were tried.
        history: cost and Gauss-Newton step of each evaluation of the best fit.
        evaluations: number of simulated records, each with its derivatives.
        seconds: duration of the identification (s).
        tol: tolerances of the integration.
        z: all K unknowns of the fitted `problem`, which minimize the sum of squares of the residuals transformed by `loss`.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "P"]
    uncertainty: Uncertainty
    at_bounds: tuple[str, ...]
    initial_state_values: Mapping[str, tuple[float, float]]
    predicted: tuple[Mapping[str, np.ndarray], ...]
    residuals: tuple[Mapping[str, np.ndarray], ...]
    noise: tuple[Mapping[str, np.ndarray], ...]
    outliers: tuple[Outlier, ...]
    whiteness: Mapping[tuple[int, str], Whiteness]
    converged: bool
    agreeing: int
    guesses: int
    ways: tuple[str, ...]
    history: tuple[tuple[float, float], ...]
    evaluations: int
    seconds: float
    tol: TolerancePair
    z: Float[np.ndarray, "K"]
    problem: FitProblem
    loss: Loss

    @cached_property
    def _with_values(self) -> StudyModel:
        return apply_values(self.problem.mechanism, self.problem.unknowns.targets, jnp.asarray(self.values))

    @cached_property
    def mechanism(self) -> Any:
        """The mechanism with the identified values; its initial guess is the initial state of the first record."""
        start = self.problem.records[0].start
        if start.estimate == "nothing" and start.state is None:
            return self._with_values
        state = self.initial_states[0]
        return self._with_values.with_guess(np.asarray(state.q), np.asarray(state.v))

    @property
    def parameters(self) -> dict[str, float]:
        """The identified values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors by name; inf for parameters that the records do not determine."""
        return dict(zip(self.names, self.uncertainty.standard_errors.tolist(), strict=True))

    @cached_property
    def initial_states(self) -> tuple[State, ...]:
        """The closed initial states of the records at the estimate."""
        return self.problem.first_states(self._with_values, self.z)

    @property
    def success(self) -> bool:
        """True if the fit converged, and the records determine every parameter."""
        return self.converged and not self.uncertainty.dead and not self.uncertainty.flat

    @property
    def message(self) -> str:
        """Remarks on the estimate, one sentence per line."""
        prefixes = label_prefixes(self.problem.records)
        lines = [] if self.converged else ["the fit has not converged: these are the best values found"]
        lines += self.uncertainty.messages
        lines += [self._bound_sentence(self.names.index(name)) for name in self.at_bounds]
        lines += outlier_sentences(self.problem, self.outliers, self.loss is not squares)
        lines += [found.text(prefixes[k] + channel) for (k, channel), found in self.whiteness.items() if not found.white]
        if self.guesses > 1 and self.agreeing == 1 and not all(found.white for found in self.whiteness.values()):
            lines.append(f"only one of {self.guesses} first guesses led to this fit: there may be a better minimum")
        return "\n".join(lines) or "the records determine every parameter"

    def _bound_sentence(self, k: int) -> str:
        unknowns, error = self.problem.unknowns, self.uncertainty.standard_errors[k]
        low, high = (0.0, np.inf) if unknowns.kinds[k] == "positive" else (unknowns.low[k], unknowns.high[k])
        unit = "" if self.units[k] in ("", "1") else f" {self.units[k]}"
        is_low = self.values[k] - low <= high - self.values[k]
        known = f"; from {'above' if is_low else 'below'} it is known to {error:.2g}{unit}"
        return f"{self.names[k]} is at its bound, {low if is_low else high:g}{known if np.isfinite(error) else ''}"

    def profile(self, name: str, level: float = CONFIDENCE) -> ProfileLikelihood:
        """Compute the profile likelihood of a parameter: its confidence interval without a linear model.

        Args:
            name: a parameter, as in `names`. It is fixed at values around the estimate, and all others are refitted.
            level: confidence level.

        Raises:
            IdentificationError: `name` is not one of `names`.
        """
        if name not in self.names:
            raise IdentificationError([f"{quote(name)} was not identified{suggestion(name, self.names)}"])
        evaluate = weighted_residuals(self.problem, self.tol, self.loss)
        return profile_likelihood(evaluate, self.problem.unknowns, self.z, self.uncertainty, name, level)

    def joint_profile(self, one: str, other: str, level: float = CONFIDENCE) -> JointProfile:
        """Compute the joint confidence region of two parameters by their profile likelihood, without a linear model.

        Args:
            one: a parameter, as in `names`.
            other: another one. Both are fixed at values around the estimate, and all others are refitted.
            level: confidence level.

        Raises:
            IdentificationError: a parameter was not identified, is the same as the other, or is not determined by the records.
        """
        evaluate = weighted_residuals(self.problem, self.tol, self.loss)
        return joint_profile(evaluate, self.problem.unknowns, self.z, self.uncertainty, (one, other), level)

    def ellipse(self, one: str, other: str, level: float = CONFIDENCE) -> Float[np.ndarray, "N 2"]:
        """Return points on the edge of the joint confidence region of two parameters in the linear model.

        Args:
            one: a parameter, as in `names`.
            other: another one.
            level: confidence level. 0.39 is that of the ellipse whose extents are the standard errors.

        Returns:
            Values of the two parameters along an ellipse; NaN if the records do not determine them.

        Raises:
            IdentificationError: a parameter was not identified, or is the same as the other.
        """
        require_two((one, other), self.names)
        return confidence_ellipse(self.uncertainty, (one, other), level)

    @checked
    def check_gradients(self, order: Literal[1, 2] = 1, directions: Directions | None = None) -> GradientCheck:
        """Compare the derivatives at the estimate with finite differences.

        Args:
            order: 1 for first derivatives, 2 for second ones, as of `udkjax.check_gradients`.
            directions: changes of unknowns by name, by the name of the direction, as of `udkjax.check_gradients`.
        """
        return compare_gradients(self.problem, self.z, self.tol, order=order, directions=directions)

    def laplace(self, seed: int = 0, quick: bool = True) -> Laplace:
        """Return the normal approximation of the posterior density near the estimate, and whether it may be trusted.

        Parameters without a prior are uniform, and noise that is not given is one more unknown for each channel: see
        `udkjax.inference`.

        Args:
            seed: seed of the importance weights, which give the verdict.
            quick: compute a quarter of the importance weights, and the others only if these leave the verdict open.

        Raises:
            IdentificationError: the records were fitted with another loss, or in pieces; or something is undetermined.
        """
        x = np.append(self.z, np.zeros(len(self.posterior.names) - len(self.z)))  # the noise is that of the residuals
        return approximate(self.posterior, x, int(seed), quick)

    @cached_property
    def posterior(self) -> InferenceProblem:
        """The posterior density of the parameters, as `udkjax.inference` returns it, with the fit's priors.

        Raises:
            IdentificationError: the records were fitted with another loss, or in pieces.
        """
        if self.loss is not squares or self.problem.constrained:
            what = "the records were fitted in pieces" if self.problem.constrained else "the loss is no log density"
            raise IdentificationError([f"posterior: {what}: give the records and parameters to udkjax.inference"])
        tol = max(self.tol[0], LOOSE_TOL), max(self.tol[1], LOOSE_TOL)
        return InferenceProblem(self.problem, {}, tol, self.z)

    # --- as a table

    def rows(self) -> list[Row]:
        """Return one row per parameter, followed by one row per unknown of an initial state."""
        uncertainty, guess = self.uncertainty, self.problem.unknowns.guess
        notes = [uncertainty.notes(name) + (["at a bound"] if name in self.at_bounds else []) for name in self.names]
        errors = uncertainty.standard_errors.tolist()
        columns = self.names, self.values.tolist(), errors, self.units, guess.tolist(), map(", ".join, notes)
        units = dict(zip(self.problem.all_names, self.problem.all_units, strict=True))
        states = [
            Row(name, change, error, units[name], 0.0, "added to the guess of the initial state")
            for name, (change, error) in self.initial_state_values.items()
        ]
        return [Row(*row) for row in zip(*columns, strict=True)] + states

    def _table(self) -> PrintedTable:
        title, problem = self.mechanism.name or "mechanism", self.problem
        numbers = f"{plural(len(problem.index), 'number')} in {plural(len(problem.records), 'record')}"
        cells = []
        for row in self.rows():
            error = "unknown" if not math.isfinite(row.standard_error) else f"{row.standard_error:.2g}"
            value = format_value(row.value, row.standard_error)
            cells.append((row.parameter, value, error, row.units, f"{row.first_guess:.6g}", row.note))
        remarks = *(f"{name}: {text}" for name, text in self._facts().items()), *self.message.splitlines()
        heads = "parameter", "value", "standard error", "unit", "first guess", ""
        return PrintedTable(f"{title}: {plural(len(self.names), 'parameter')} from {numbers}", cells, heads, remarks)

    def _facts(self) -> dict[str, str]:
        problem, uncertainty = self.problem, self.uncertainty
        ended = f"{'' if self.converged else 'not '}converged after {plural(self.evaluations, 'evaluation')}"
        agreed = f", {self.agreeing} of {self.guesses} first guesses led to it" if self.guesses > 1 else ""
        facts = {"fit": f"{ended} in {self.seconds:.1f} s{agreed}"}
        if problem.noise_given.any():
            facts["chi^2"] = f"{uncertainty.chi2:.4g} with {uncertainty.degrees_of_freedom} degrees of freedom"
        estimated = problem.index[~problem.noise_given]
        channels, first = np.unique(estimated[:, 2], return_index=True)
        found = []
        for channel, record in zip([problem.channels[c] for c in channels], estimated[first, 0], strict=True):
            if math.isfinite(noise := _usual_noise(self.noise[record][channel.name])):
                found.append(f"{channel.name} {noise:.3g} {channel.units}".rstrip())
        if found:
            facts["estimated noise"] = join_names(found)
        if pairs := [f"{a} and {b} {rho:.2f}" for a, b, rho in uncertainty.correlated_beyond(PRINTED_CORRELATION)]:
            facts["correlated errors"] = ", ".join(pairs)
        return facts

    def __str__(self) -> str:
        return text_table(table := self._table(), len(table.rows))

    def _repr_html_(self) -> str:
        return html_table(self._table())

    def __repr__(self) -> str:
        return f"Estimate({', '.join(f'{name}: {value:.6g}' for name, value in self.parameters.items())})"

    # --- as data

    def to_xarray(self, profiles: Sequence[ProfileLikelihood] = (), level: float = CONFIDENCE) -> "xarray.Dataset":
        """Return measurements, predictions, estimates and their uncertainty as a dataset.

        Args:
            profiles: profile likelihoods to include.
            level: confidence level of their intervals.

        Returns:
            A dataset with `measured`, `predicted`, `residual` (measured minus predicted) and `noise` along record, sample and
            channel, at `time` (record, sample), s; NaN where nothing was measured. `correlated` is the probability that
            residuals are at least as correlated if the noise is white. `cost` and `change` (the largest change of an unknown in
            the next step) are those of each trial. With profiles, `rise` is twice the increase of the cost above its minimum,
            relative to the noise, at `profile_value`, and `interval` is the range in which it is below the `limit` of the
            confidence level.
        """
        with OptionalImport():
            import xarray
        problem, uncertainty, P = self.problem, self.uncertainty, "parameter"
        records, names = problem.records, problem.channel_names
        dataset = dataset_of_fit(records, names, self.predicted, self.residuals, self.noise)
        white = [[getattr(self.whiteness.get((k, name)), "p", np.nan) for name in names] for k in range(len(records))]
        cost, change = np.array(self.history, float).reshape(-1, 2).T
        data = {
            "correlated": (("record", "channel"), white),
            "first_guess": (P, problem.unknowns.guess),
            "value": (P, self.values),
            "standard_error": (P, uncertainty.standard_errors),
            "correlation": ((P, "other_parameter"), uncertainty.correlation),
            "cost": ("trial", cost),
            "change": ("trial", change),
        }
        coords = {
            "channel_units": ("channel", [channel.units for channel in problem.channels]),
            P: list(self.names),
            "parameter_units": (P, list(self.units)),
        }
        attributes = {
            "title": self.mechanism.name,
            "format": FORMAT,
            "success": int(self.success),
            "message": self.message,
            "tolerance": self.tol[0],
            **{f"version_{name}": value for name, value in versions().items()},
            **({"scene": scene_text(self.mechanism)} if self.mechanism.has_bodies else {}),
        }
        dataset = dataset.merge(xarray.Dataset(data, coords)).assign_attrs(attributes)
        return dataset.merge(profiles_dataset(profiles, self.parameters, uncertainty, level)) if profiles else dataset

    def to_dict(self) -> dict[str, Any]:
        """Return the results as plain numbers, lists and strings, for JSON."""
        uncertainty, rows, P = self.uncertainty, self.rows(), len(self.names)
        same = ("success", "converged", "message", "at_bounds", "guesses", "agreeing", "ways", "evaluations", "seconds")
        results = {
            "parameters": {
                r.parameter: {"value": r.value, "standard_error": r.standard_error, "units": r.units} for r in rows[:P]
            },
            "correlation": uncertainty.correlation,
            "unknown": {"dead": uncertainty.dead, "flat": [direction.text for direction in uncertainty.flat]},
            "starts": {r.parameter: {"change": r.value, "standard_error": r.standard_error} for r in rows[P:]},
            "chi2": uncertainty.chi2,
            "degrees_of_freedom": uncertainty.degrees_of_freedom,
            "noise": [{channel: _usual_noise(sigma) for channel, sigma in table.items()} for table in self.noise],
            "outliers": self.outliers,
            "whiteness": [{"record": k, "channel": c, "p": w.p} for (k, c), w in self.whiteness.items()],
            "tolerance": self.tol[0],
            "versions": versions(),
        }
        return plain({name: getattr(self, name) for name in same} | results)


def _usual_noise(sigma: Float[np.ndarray, "T"]) -> float:
    """Return the median of the standard deviations of a channel; NaN if the noise is unknown."""
    known = sigma[np.isfinite(sigma)]
    return float(np.median(known)) if known.size else math.nan
