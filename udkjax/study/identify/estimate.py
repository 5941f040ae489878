"""The result of an identification: values, their uncertainty, what the records do not show, and how it was found."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udkjax.extras import OptionalImport
from udkjax.integrate.solution import scene_text, versions
from udkjax.positions.assembly import State
from udkjax.printing import PrintedTable, html_table, text_table
from udkjax.scene.checks import quote, suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.wording import format_value, join_names, plain, plural
from udkjax.study.identify.fit_problem import FitProblem
from udkjax.study.identify.gradient_check import GradientCheck, compare_gradients
from udkjax.study.identify.optimizer import Loss, squares, weighted_residuals
from udkjax.study.identify.outliers import Outlier, outlier_sentences
from udkjax.study.identify.prediction import TolerancePair
from udkjax.study.identify.profile_likelihood import CONFIDENCE, ProfileLikelihood, profile_likelihood, profiles_dataset
from udkjax.study.identify.records import IdentificationError, dataset_of_fit, label_prefixes
from udkjax.study.identify.uncertainty import Uncertainty
from udkjax.study.identify.unknowns import apply_values
from udkjax.study.noise import Whiteness

if TYPE_CHECKING:
    import xarray

FORMAT = "udkjax identification 1"  # of the dataset


class Row(NamedTuple):
    """A number that was found: a parameter, or by how much an initial state was moved."""

    parameter: str
    value: float
    standard_error: float
    units: str
    first_guess: float
    note: str


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """Values of parameters that were identified, and how well they are known. `print` shows a table.

    Attributes:
        names: of the P parameters; `units` are theirs.
        values: found for them, in these units.
        uncertainty: standard errors, correlations, and what the records do not show.
        at_bounds: parameters that are at one of their bounds.
        initial_state_values: of each unknown of an initial state by how much it was moved, and its standard error.
        predicted, residuals, noise: for each record, by channel, at its times (T,): what the mechanism shows; measured minus
            predicted; and standard deviations, given or estimated.
        outliers: measured values too far from what the mechanism shows to be noise; `noise` is that of the others.
        whiteness: of the residuals of each record's channels, where they are more than rounding.
        converged: whether the fit has settled.
        agreeing: number of first guesses that led here, out of `guesses`.
        ways: ways that were tried to find the fit.
        history: cost and Gauss-Newton step, evaluation by evaluation of the best fit.
        evaluations: of a record, each with its derivatives.
        seconds: time of the identification (s).
        tol: tolerances of the integration.
        z: all K unknowns of the `problem` that was fitted, by the least squares of `loss`.
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
    def mechanism(self) -> Mechanism:
        """The mechanism with the values in."""
        return apply_values(self.problem.mechanism, self.problem.unknowns.targets, jnp.asarray(self.values))

    @property
    def parameters(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def standard_errors(self) -> dict[str, float]:
        """One standard error of each value, by name; inf where the records do not show it."""
        return dict(zip(self.names, self.uncertainty.standard_errors.tolist(), strict=True))

    @cached_property
    def initial_states(self) -> tuple[State, ...]:
        """The states that the records began with, closed."""
        return self.problem.first_states(self.mechanism, self.z)

    @property
    def success(self) -> bool:
        """True if the fit has settled, and the records show every parameter."""
        return self.converged and not self.uncertainty.dead and not self.uncertainty.flat

    @property
    def message(self) -> str:
        """Remarks on the estimate, one sentence a line."""
        prefixes = label_prefixes(self.problem.records)
        lines = [] if self.converged else ["the fit has not settled: these are the best values that were found"]
        lines += self.uncertainty.messages
        lines += [f"{name} is at one of its bounds" for name in self.at_bounds]
        lines += outlier_sentences(self.problem, self.outliers, self.loss is not squares)
        lines += [found.text(prefixes[k] + channel) for (k, channel), found in self.whiteness.items() if not found.white]
        if self.guesses > 1 and self.agreeing == 1 and not all(found.white for found in self.whiteness.values()):
            lines.append(f"only one of {self.guesses} first guesses led here: there may be a better minimum")
        return "\n".join(lines) or "every parameter is known from the records"

    def profile(self, name: str, level: float = CONFIDENCE) -> ProfileLikelihood:
        """Compute the profile likelihood of a parameter: its confidence interval without a linear model.

        Args:
            name: of a parameter, as in `names`. It is fixed at values beside the estimate, and all others are fitted anew.
            level: of confidence.

        Raises:
            IdentificationError: no such parameter was identified.
        """
        if name not in self.names:
            raise IdentificationError([f"{quote(name)} was not identified{suggestion(name, self.names)}"])
        evaluate = weighted_residuals(self.problem, self.tol, self.loss)
        return profile_likelihood(evaluate, self.problem.unknowns, self.z, self.uncertainty, name, level)

    def check_gradients(self) -> GradientCheck:
        """Compare the derivatives at the estimate with differences: see `udkjax.check_gradients`."""
        return compare_gradients(self.problem, self.z, self.tol)

    # --- as a table

    def rows(self) -> list[Row]:
        """Return the estimates of the parameters in their order; then those of initial states."""
        known, guess = self.uncertainty, self.problem.unknowns.guess
        notes = [known.notes(name) + (["at a bound"] if name in self.at_bounds else []) for name in self.names]
        errors = known.standard_errors.tolist()
        columns = self.names, self.values.tolist(), errors, self.units, guess.tolist(), map(", ".join, notes)
        units = dict(zip(self.problem.all_names, self.problem.all_units, strict=True))
        states = [
            Row(name, change, error, units[name], 0.0, "added to the guess of the start")
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
        problem, known = self.problem, self.uncertainty
        ended = f"{'' if self.converged else 'not '}settled after {plural(self.evaluations, 'evaluation')}"
        agreed = f", {self.agreeing} of {self.guesses} first guesses led here" if self.guesses > 1 else ""
        facts = {"fit": f"{ended} in {self.seconds:.1f} s{agreed}"}
        if problem.noise_given.any():
            facts["chi^2"] = f"{known.chi2:.4g} with {known.degrees_of_freedom} degrees of freedom"
        estimated = problem.index[~problem.noise_given]
        channels, first = np.unique(estimated[:, 2], return_index=True)
        found = []
        for channel, record in zip([problem.channels[c] for c in channels], estimated[first, 0], strict=True):
            found.append(f"{channel.name} {np.nanmedian(self.noise[record][channel.name]):.3g} {channel.units}".rstrip())
        if found:
            facts["noise, estimated"] = join_names(found)
        return facts

    def __str__(self) -> str:
        return text_table(table := self._table(), len(table.rows))

    def _repr_html_(self) -> str:
        return html_table(self._table())

    def __repr__(self) -> str:
        return f"Estimate({', '.join(f'{name}: {value:.6g}' for name, value in self.parameters.items())})"

    # --- as data

    def to_xarray(self, profiles: Sequence[ProfileLikelihood] = (), level: float = CONFIDENCE) -> "xarray.Dataset":
        """Return measurements, predictions, and the knowledge of the parameters.

        Args:
            profiles: profile likelihoods that are to be in it.
            level: of confidence, of their intervals.

        Returns:
            A dataset with `measured`, `predicted`, `residual` (the one minus the other) and `noise` along record, sample and
            channel, at `time` (record, sample), s; not a number where nothing was measured. `correlated` is the probability that
            white noise leaves residuals as correlated as these. `cost` and `change` (the largest change of an unknown by the next
            step) are those of each trial. With profiles, `rise` is twice the cost above the least over the noise, at values of
            each, and `interval` is where it is below the `limit` of the confidence level.
        """
        with OptionalImport():
            import xarray
        problem, known, P = self.problem, self.uncertainty, "parameter"
        records, names = problem.records, problem.channel_names
        found = dataset_of_fit(records, names, self.predicted, self.residuals, self.noise)
        white = [[getattr(self.whiteness.get((k, name)), "p", np.nan) for name in names] for k in range(len(records))]
        cost, change = np.array(self.history, float).reshape(-1, 2).T
        data = {
            "correlated": (("record", "channel"), white),
            "first_guess": (P, problem.unknowns.guess),
            "value": (P, self.values),
            "standard_error": (P, known.standard_errors),
            "correlation": ((P, "other_parameter"), known.correlation),
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
            "scene": scene_text(self.mechanism),
        }
        found = found.merge(xarray.Dataset(data, coords)).assign_attrs(attributes)
        return found.merge(profiles_dataset(profiles, self.parameters, known, level)) if profiles else found

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers and texts, as a JSON file has them."""
        known, rows, P = self.uncertainty, self.rows(), len(self.names)
        same = ("success", "converged", "message", "at_bounds", "guesses", "agreeing", "ways", "evaluations", "seconds")
        found = {
            "parameters": {
                r.parameter: {"value": r.value, "standard_error": r.standard_error, "units": r.units} for r in rows[:P]
            },
            "correlation": known.correlation,
            "unknown": {"dead": known.dead, "flat": [direction.text for direction in known.flat]},
            "starts": {r.parameter: {"change": r.value, "standard_error": r.standard_error} for r in rows[P:]},
            "chi2": known.chi2,
            "degrees_of_freedom": known.degrees_of_freedom,
            "noise": [{channel: np.nanmedian(sigma) for channel, sigma in table.items()} for table in self.noise],
            "outliers": self.outliers,
            "whiteness": [{"record": k, "channel": c, "p": w.p} for (k, c), w in self.whiteness.items()],
            "tolerance": self.tol[0],
            "versions": versions(),
        }
        return plain({name: getattr(self, name) for name in same} | found)
