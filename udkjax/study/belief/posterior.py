"""Draws from a posterior density: by name, as a table, and as data for ArviZ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.extras import OptionalImport
from udkjax.printing import PrintedTable, html_table, text_table
from udkjax.study.belief.chains import ChainCoordinates, DrawChunk
from udkjax.study.identify.density.log_density import InferenceProblem
from udkjax.study.report import format_value
from udkjax.wording import join_names, plural

INTERVAL_QUANTILES = 0.03, 0.97  # quantiles at the ends of an interval
MOST_RHAT = 1.01  # largest R-hat of chains that agree
LEAST_EFFECTIVE = 100  # least number of effective draws of a chain, for which R-hat and quantiles are reliable
PREDICTION_DRAWS = 400  # number of draws that show the range of predictions: its ends have errors of a tenth of the noise
EFFECTIVE_SIZES: tuple[dict[str, Any], ...] = {"method": "bulk"}, {"method": "tail", "prob": (0.05, 0.95)}
MOST_BAD = 0.01  # share of divergent or failed proposals above which it is reported
# R-hat and effective numbers: A. Vehtari et al., Rank-normalization, folding, and localization: an improved R-hat, Bayesian
# Analysis 16 (2021) 667.


class PosteriorRow(NamedTuple):
    """The posterior of an unknown: mean, standard deviation, ends of the 94 % interval, R-hat, and effective numbers of draws.

    `bulk` is the effective number for the mean, `tail` that for the 5 % and 95 % quantiles.
    """

    parameter: str
    mean: float
    deviation: float
    low: float
    high: float
    rhat: float
    bulk: float
    tail: float
    units: str


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws of C chains from a posterior density.

    Attributes:
        problem: the density.
        x: unconstrained vectors (C, draws, K).
        log_density: logarithms of the density (C, draws).
        acceptance: probability with which each proposal was accepted (C, draws).
        divergent: True for proposals with an energy error above 1000 (C, draws).
        failed: True for rejected proposals of zero density, as where a run fails (C, draws).
        steps: number of gradients that each draw took, the same for all chains (draws,).
        requested: number of draws of a chain that were asked for; fewer were drawn before an interruption.
        step: size of the steps, for unit covariance.
    """

    problem: InferenceProblem
    x: Float[np.ndarray, "C draws K"]
    log_density: Float[np.ndarray, "C draws"]
    acceptance: Float[np.ndarray, "C draws"]
    divergent: Bool[np.ndarray, "C draws"]
    failed: Bool[np.ndarray, "C draws"]
    steps: Int[np.ndarray, "draws"]
    requested: int
    step: float

    @classmethod
    def of(
        cls, problem: InferenceProblem, coordinates: ChainCoordinates, chunks: Sequence[DrawChunk], draws: int, step: float
    ) -> "Posterior":
        """Return the posterior with the first `draws` draws of each chain, from chunks of draws.

        Args:
            problem: the density.
            coordinates: the coordinates in which the chains moved.
            chunks: arrays by name, as the function of `compile_draws` returns them, and the numbers of steps.
            draws: number of draws of a chain that were asked for.
            step: size of the steps, for unit covariance.
        """
        joined = {name: np.concatenate([chunk[name] for chunk in chunks])[:draws] for name in ("position", "steps", *PER_DRAW)}
        x = coordinates.x(np.swapaxes(joined["position"], 0, 1))
        of_chains = {name: np.swapaxes(joined[name], 0, 1) for name in PER_DRAW}
        return cls(problem, x, **of_chains, steps=joined["steps"], requested=draws, step=step)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the K unknowns."""
        return self.problem.names

    @cached_property
    def draws(self) -> dict[str, Float[np.ndarray, "C draws"]]:
        """Draws of each unknown by name, in the units of the parameters."""
        values = self.problem.unknowns.values(self.x)
        return {name: values[..., k] for k, name in enumerate(self.names)}

    @cached_property
    def rows(self) -> tuple[PosteriorRow, ...]:
        """The rows of the summary, one per unknown."""
        with OptionalImport():
            import arviz
        rows = []
        for k, name in enumerate(self.names):
            values, x = self.draws[name], np.ascontiguousarray(self.x[..., k])
            moves = bool(np.all(np.ptp(x, axis=1) > 0.0)) and x.shape[1] >= 4
            rhat = float(arviz.rhat(x)) if moves and len(x) > 1 else np.nan
            bulk, tail = (float(arviz.ess(x, **of)) if moves else np.nan for of in EFFECTIVE_SIZES)
            low, high = np.quantile(values, INTERVAL_QUANTILES).tolist()
            unit = self.problem.units[k]
            rows.append(PosteriorRow(name, float(values.mean()), float(values.std()), low, high, rhat, bulk, tail, unit))
        return tuple(rows)

    def summary(self) -> dict[str, PosteriorRow]:
        """Return the mean, standard deviation, 94 % interval, R-hat and effective numbers of draws of each unknown, by name."""
        return {row.parameter: row for row in self.rows}

    @property
    def converged(self) -> bool:
        """True if all chains agree: each R-hat is at most 1.01, with at least 100 effective draws for each chain."""
        least = LEAST_EFFECTIVE * len(self.x)
        return all(row.rhat <= MOST_RHAT and min(row.bulk, row.tail) >= least for row in self.rows)

    @property
    def message(self) -> str:
        """Remarks on the draws, one sentence per line."""
        lines, drawn = [], self.x.shape[1]
        if drawn < self.requested:
            lines.append(f"interrupted after {drawn} of {self.requested} draws of each chain")
        if not self.acceptance.any():
            lines.append("no proposal was accepted: start nearer to the mode, or give priors that exclude failing runs")
        if differing := [row.parameter for row in self.rows if not row.rhat <= MOST_RHAT]:
            lines.append(f"the chains disagree on {join_names(differing)}: draw more, or give priors that exclude other modes")
        elif not self.converged:
            lines.append(f"fewer than {LEAST_EFFECTIVE} effective draws for each chain: draw more")
        for mask, what in ((self.divergent, "diverged"), (self.failed, "have no density, as where runs fail")):
            if mask.mean() > MOST_BAD:
                lines.append(
                    f"{mask.mean():.0%} of the proposals {what}: draws near there may be too few, unless a prior excludes them"
                )
        return "\n".join(lines) or "the chains agree"

    def to_arviz(self, pointwise: bool = True) -> Any:
        """Return the draws for ArviZ, as its InferenceData or, from version 1 on, a DataTree of xarray.

        The groups are `posterior`, `sample_stats` and `observed_data`.

        Args:
            pointwise: also add the groups `log_likelihood` and `posterior_predictive`, of each measured value, for which all
                draws are simulated again.
        """
        with OptionalImport():
            import arviz
            import xarray
        dims = "chain", "draw"

        def dataset(values: dict[str, Any], last: tuple[str, ...] = ()) -> Any:
            return xarray.Dataset({name: ((*dims, *last), x) for name, x in values.items()}, self._coordinates)

        stats = {name: getattr(self, field) for field, name in PER_DRAW.items()}
        stats["n_steps"] = np.broadcast_to(self.steps, self.log_density.shape)
        posterior = dataset(self.draws)
        for name, unit in zip(self.names, self.problem.units, strict=True):
            posterior[name].attrs["units"] = unit
        groups = {"posterior": posterior, "sample_stats": dataset(stats)}
        groups["observed_data"] = xarray.Dataset({"y": ("measurement", self.problem.fit_problem.measured)})
        if pointwise:
            likelihoods, predicted = self._pointwise()
            groups["log_likelihood"] = dataset({"y": likelihoods}, ("measurement",))
            noise = np.random.default_rng(0).standard_normal(predicted.shape) * self._sigma()
            groups["posterior_predictive"] = dataset({"y": predicted + noise}, ("measurement",))
        older: Any = arviz
        return older.InferenceData(**groups) if arviz.__version__.startswith("0.") else xarray.DataTree.from_dict(groups)

    def prediction_intervals(
        self, draws: int = PREDICTION_DRAWS, seed: int = 0
    ) -> tuple[dict[str, Float[np.ndarray, "3 T"]], ...]:
        """Return, for each record, the range that contains 94 % of repeated measurements of each channel.

        Args:
            draws: largest number of draws that are simulated again, each with noise of its own.
            seed: seed of the noise.

        Returns:
            For each record, a table by channel: lower end, median and upper end of the range at its times, (3, T).
        """
        fewer = self._thinned(draws)
        predicted = fewer._pointwise()[1]
        noise = np.random.default_rng(int(seed)).standard_normal(predicted.shape) * fewer._sigma()
        ends = np.quantile(predicted + noise, (INTERVAL_QUANTILES[0], 0.5, INTERVAL_QUANTILES[1]), axis=(0, 1))
        records = zip(*(self.problem.fit_problem.by_record(rows) for rows in ends), strict=True)
        return tuple({name: np.stack([table[name] for table in tables]) for name in tables[0]} for tables in records)

    def _thinned(self, draws: int) -> "Posterior":
        """Return a posterior with at most about `draws` of the draws, equally many from each chain."""
        every = max(1, -(-self.x.shape[0] * self.x.shape[1] // draws))
        fields = {name: getattr(self, name)[:, ::every] for name in ("x", *PER_DRAW)}
        return replace(self, **fields, steps=self.steps[::every])

    def _pointwise(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the log likelihoods and the predictions of the R measured values at each draw, both (C, draws, R)."""
        both = lambda problem, x: (problem.log_likelihoods(x), problem.predicted(x))  # noqa: E731
        one = self.problem.compiled("pointwise", lambda problem, x: jax.vmap(partial(both, problem))(x))
        parts = [jax.tree.map(np.asarray, one(x)) for x in self.x]
        likelihoods, predicted = zip(*parts, strict=True)
        return np.stack(likelihoods), np.stack(predicted)

    def _sigma(self) -> Float[np.ndarray, "C draws R"]:
        """Return the standard deviation of the noise of each measured value at each draw."""
        problem = self.problem
        noise = np.exp(np.concatenate([self.x[..., problem.fit_problem.K :], np.zeros((*self.x.shape[:2], 1))], axis=-1))
        return problem.sigma * noise[..., problem.groups]

    @property
    def _coordinates(self) -> dict[str, Any]:
        return {"chain": np.arange(self.x.shape[0]), "draw": np.arange(self.x.shape[1])}

    def _table(self) -> PrintedTable:
        cells = [
            (
                row.parameter,
                format_value(row.mean, row.deviation),
                f"{row.deviation:.2g}",
                f"{format_value(row.low, row.deviation)} to {format_value(row.high, row.deviation)}",
                row.units,
                f"{row.rhat:.3f}",
                f"{row.bulk:.0f}",
                f"{row.tail:.0f}",
            )
            for row in self.rows
        ]
        heads = "parameter", "mean", "sd", "94 % interval", "unit", "R-hat", "ESS bulk", "ESS tail"
        title = f"posterior: {plural(self.x.shape[0], 'chain')} of {plural(self.x.shape[1], 'draw')}"
        return PrintedTable(title, cells, heads, self.message.splitlines())

    def __str__(self) -> str:
        return text_table(table := self._table(), len(table.rows))

    def _repr_html_(self) -> str:
        return html_table(self._table())

    def __repr__(self) -> str:
        numbers = ", ".join(f"{row.parameter}: {row.mean:.6g} +- {row.deviation:.2g}" for row in self.rows)
        return f"Posterior({numbers}; {self.message})"


# Arrays of each draw, with their names in ArviZ.
PER_DRAW = {"log_density": "lp", "acceptance": "acceptance_rate", "divergent": "diverging", "failed": "failed"}
