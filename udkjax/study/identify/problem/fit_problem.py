"""The least-squares problem: residuals of all records, weighted by their noise, and of priors; and their Jacobian.

With y the measured values, yhat(z) the values predicted with the unknowns z, and sigma the standard deviation of the noise,

    r = (yhat(z) - y) / sigma,        J = dr/dz,

followed by (x - mean) / sigma of each prior. Every measured number is one residual; the order is record, time, channel.

J is computed in blocks, of several records each, or of a part of a long one (a window). The motion of each window is computed
from the beginning of its record, since a motion with events cannot begin anew in between: this takes few steps for the many
samples that make a record long.
"""

import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from udkjax.annotations import NumericArray
from udkjax.equations.rows.analysis import analyse, analysis_of
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Result
from udkjax.positions.assembling.assembly import AssemblyError, State, assemble
from udkjax.positions.assembling.channels import Quantity, channel_of
from udkjax.scene.arguments import argument_problems
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.problem.initial_states import initial_state_unknowns
from udkjax.study.identify.problem.loop_consistency import nearest_closable, require_consistent_loops
from udkjax.study.identify.problem.parameters import ParametersLike, unknowns_of
from udkjax.study.identify.problem.prediction import LOOSE_TOL, TIGHT_TOL, Members, Prediction, Predictor, Runs, TolerancePair
from udkjax.study.identify.problem.residuals import Residuals, join_rows
from udkjax.study.identify.problem.unknowns import Unknowns, conditions_of, guessed_states, with_conditions
from udkjax.study.identify.problem.windows import BLOCK_BYTES, LEAST_WINDOW, WINDOW_BYTES, cut_into_windows, times_until
from udkjax.study.identify.records.record_reader import Data, records_of
from udkjax.study.identify.records.records import Estimated, IdentificationError, Noise, Record, Start, output_times, tabulate
from udkjax.study.quantities import StudyModel
from udkjax.wording import suggestion

# Change of a prediction, relative to its channel's scale, below which it is a rounding error of a change of an unknown by its own
# size. A parameter on which the load of a driver does not depend changes it by 1e-14.
VISIBLE_CHANGE = 1e-12
STILL_DEVIATION = 1e-12  # standard deviation below which a channel is constant, relative to its largest number
RESIDUALS_PER_UNKNOWN = 3.0  # least number in the first fitted part of a record, and in a piece; fewer would fit the noise
# Arguments of `simulate` that `identify` sets itself.
OWN_ARGUMENTS = ("ts", "mechanism", "state", "rtol", "atol", "adjoint", "throw", "progress", "analysis")
Strategy = Literal["auto", "pieces"]


class RunEnds(NamedTuple):
    """States (q, v) at the first and last time of runs, (B, runs, 2 times, 2, n), and derivatives (B, runs, 2, 2, n, P + S)."""

    states: np.ndarray
    slopes: np.ndarray


class FitProblem:
    """The residuals to be minimized, as a function of the unknowns z (K,): P parameters, then the unknowns of initial states.

    Attributes:
        ts: times (records, times) of the records, from their beginning (s).
        y: measured values (records, times, channels), NaN where nothing was measured.
        present: mask of the `measured` values; the R rows of `index` (R, 3) are record, time and channel of each residual.
        sigma: standard deviations (R,) of the residuals; `noise_given` (R,) marks the given ones.
        channel_scale: scale of the values of each channel (C,).
        runs: runs to simulate, one or more windows per record; `run` and `time` (R,) are the indices of run and time of each
            residual.
        state_sizes: change of each initial-state unknown, in its units, per unit of z (K - P,).
        columns: indices in z of the unknowns of each run's initial state (N, S); -1 for unused entries.
        beginnings: the run that each record begins with (records,).
        priors: indices of the parameters with a prior; the residuals of priors follow the R measured ones.
        predictor: computes the values of the channels, and counts evaluations.
    """

    extra_rows: int  # number of residuals after the measured ones
    constrained: int = 0  # number of unknowns that are determined by extra rows, not by measurements

    def __init__(
        self, mechanism: StudyModel, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any] | None = None
    ):
        self.mechanism, self.unknowns, self.records = mechanism, unknowns, tuple(records)
        keys = list(dict.fromkeys(key for record in self.records for key in record.values))
        self.channels = tuple(key if isinstance(key, Quantity) else channel_of(mechanism, key) for key in keys)
        self.channel_names = tuple(channel.name for channel in self.channels)
        self.initial_states, self.columns, bases = initial_state_unknowns(mechanism, unknowns, self.records)
        self.all_names = (*unknowns.names, *(name for state in self.initial_states for name in state.names))
        self.all_units = (*unknowns.units, *(unit for state in self.initial_states for unit in state.units))
        self.state_sizes = np.concatenate([np.zeros(0), *(state.sizes for state in self.initial_states)])
        self.K = len(self.all_names)
        self.ts, self.y, sigma = tabulate(self.records, keys)
        self.present, self.index = np.isfinite(self.y), np.argwhere(np.isfinite(self.y))
        self.measured, self.noise_given = self.y[self.present], np.isfinite(sigma)[self.present]
        self.channel_scale = np.array([_size_of(self.y[:, :, c]) for c in range(len(keys))])
        self.sigma = np.where(np.isfinite(sigma), sigma, self.channel_scale)[self.present]
        runs = Runs(self.ts, *guessed_states(mechanism, self.records), bases, conditions_of(mechanism, self.records))
        length = max(WINDOW_BYTES // self._bytes_per_time, LEAST_WINDOW)
        self.runs, self.beginnings, self.run, self.time = cut_into_windows(runs, self.index, length)
        self.columns = self.columns[np.searchsorted(self.beginnings, np.arange(len(self.runs.ts)), side="right") - 1]
        self.priors = np.flatnonzero(np.isfinite(unknowns.sigma))
        self.extra_rows = len(self.priors)
        self.settings = {"analysis": analysis_of(mechanism), **(settings or {})}
        self.predictor = Predictor(mechanism, unknowns.targets, self.channels, self.settings)

    @property
    def duration(self) -> float:
        """The duration of the longest record, s."""
        return float((self.ts[:, -1] - self.ts[:, 0]).max())

    def series(self) -> list[np.ndarray]:
        """Return the indices of the residuals of each measured channel of each record, in the order of time."""
        record, _, channel = self.index.T
        pairs = ((k, c) for k in range(len(self.records)) for c in range(len(self.channels)))
        return [places for k, c in pairs if len(places := np.flatnonzero((record == k) & (channel == c)))]

    def noise_groups(self) -> Int[np.ndarray, "R"]:
        """Return, for each residual including priors, its group with a common unknown noise; -1 if the noise was given."""
        _, group = np.unique(np.where(self.noise_given, -1, self.index[:, 2]), return_inverse=True)
        group = group - 1 if self.noise_given.any() else group
        return np.concatenate([group, np.full(self.extra_rows, -1)])

    def by_record(self, rows: Float[np.ndarray, "R"]) -> tuple[dict[str, np.ndarray], ...]:
        """Return `rows`, a number for each measured value (R,), as a table for each record.

        A table has an array (times,) for each measured channel of the record, which is NaN where nothing was measured.
        """
        table = np.full(self.y.shape, np.nan)
        table[self.present] = rows
        tables = []
        for k, record in enumerate(self.records):
            ts, first = output_times(record)
            of_record, measured = table[k, first : len(ts)], self.present[k].any(0)
            tables.append({name: of_record[:, c] for c, name in enumerate(self.channel_names) if measured[c]})
        return tuple(tables)

    def members(
        self, z: Float[NumericArray, "B K"], runs: Int[np.ndarray, "N"], horizon: float | None = None, xp: Any = np
    ) -> Members:
        """Return the inputs of predictions of N runs with each of B sets of unknowns z, by NumPy or JAX (`xp` `jax.numpy`).

        The N runs with the first set come first, then those with the next set. Runs end `horizon` seconds after the beginning of
        their record; if it is None, at their last times.
        """
        columns, sets = self.columns[runs], len(z)
        x = xp.repeat(self.unknowns.values(z[:, : len(self.unknowns.names)], xp), len(runs), axis=0)
        shift = xp.where(columns < 0, 0.0, z[:, columns]).reshape(len(x), columns.shape[1])
        members = self.members_of(np.tile(runs, sets), x, shift)
        if horizon is None:
            return members
        ts = np.tile([times_until(ts, horizon) for ts in self.runs.ts[runs]], (sets, 1))
        return members._replace(runs=members.runs._replace(ts=ts))

    def members_of(self, runs: Int[np.ndarray, "M"], x: Float[NumericArray, "M P"], shift: Float[NumericArray, "M S"]) -> Members:
        """Return the inputs of predictions of M runs with parameters x and unknowns `shift` of the initial states."""
        return Members(x, shift, jax.tree.map(lambda leaf: leaf[runs], self.runs))

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Return all residuals and their Jacobian: see `row_blocks`. Residuals later than the horizon are zero."""
        return join_rows(self.row_blocks(z, tol, horizon), len(self.index) + self.extra_rows)

    def row_blocks(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Iterator[Residuals]:
        """Compute residuals and their Jacobian in blocks of rows, each when it is asked for, in the order of rows.

        Args:
            z: B sets of unknowns.
            tol: tolerances of the integration.
            horizon: duration of the part of each record that is used (s); later residuals are left out. None: the whole record.
        """
        code, ends = np.zeros(len(z), int), list[RunEnds]()
        together = max(1, int(BLOCK_BYTES // (len(z) * self._bytes_per_time * self.runs.ts.shape[1])))
        runs = np.arange(len(self.runs.ts))
        if horizon is not None:  # the first window of a record is computed in any case, for its beginning
            later = self.runs.ts[:, 1] - self.runs.ts[:, 0] > horizon
            later[self.beginnings] = False
            runs = runs[~later]
        for first in range(0, len(runs), together):
            yield self._block(z, runs[first : first + together], tol, horizon, code, ends)
        row = len(self.index)
        of_all = RunEnds(*(np.concatenate(parts, axis=1) for parts in zip(*ends, strict=True))) if ends else None
        for r, J in self.further_rows(of_all, z):
            yield Residuals(r, J, code, np.arange(row, row + r.shape[1]))
            row += r.shape[1]

    def _block(
        self,
        z: Float[np.ndarray, "B K"],
        runs: Int[np.ndarray, "N"],
        tol: TolerancePair,
        horizon: float | None,
        code: Int[np.ndarray, "B"],
        ends: list[RunEnds],
    ) -> Residuals:
        """Compute the rows of some runs, and add their results to `code` and `ends`; nothing else of them stays in memory."""
        prediction = self.predictor(self.members(z, runs, horizon), tol)
        prediction = jax.tree.map(lambda part: part.reshape(len(z), -1, *part.shape[1:]), prediction)
        rows = np.arange(*np.searchsorted(self.run, [runs[0], runs[-1] + 1]))
        if horizon is not None:
            record, time, _ = self.index[rows].T
            rows = rows[self.ts[record, time] - self.ts[record, 0] <= horizon]
        np.maximum(code, prediction.code.max(1), out=code)
        if prediction.ends is not None:
            ends.append(RunEnds(np.asarray(prediction.ends), np.asarray(prediction.d_ends)))
        return self._residuals_of(prediction, rows, runs, z)

    def code(self, z: Float[np.ndarray, "K"], tol: TolerancePair) -> int:
        """Return the worst result of the runs of all records at the unknowns z, a number of `Result`."""
        return max(int(block.code[0]) for block in self.row_blocks(z[None], tol))

    def second_derivatives(
        self, z: Float[np.ndarray, "K"], d: Float[np.ndarray, "K"], tol: TolerancePair
    ) -> Float[np.ndarray, "R"]:
        """Return the second derivatives of the R predicted values at z along a direction d, in the units of channels."""
        P, found = len(self.unknowns.names), np.zeros(len(self.index))
        first, second = self.unknowns.dx_dz(z[:P]) * d[:P], self.unknowns.d2x_dz2(z[:P]) * d[:P] ** 2
        for run, columns in enumerate(self.columns):
            along = np.append(first, np.where(columns < 0, 0.0, d[columns]))
            curved = np.append(second, np.zeros(len(columns)))
            y = self.predictor.second_derivatives(self.members(z[None], np.array([run])), tol, along[None], curved[None])[0]
            rows = np.flatnonzero(self.run == run)
            found[rows] = y[self.time[rows], self.index[rows, 2]]
        return found

    @property
    def sets_together(self) -> int:
        """The number of sets of unknowns that may be evaluated together."""
        return max(1, int(BLOCK_BYTES // (self._bytes_per_time * self.runs.ts.size)))

    @property
    def _bytes_per_time(self) -> int:
        """Size of the numbers of a run at one time: states and channels, with their derivatives."""
        states = 2 * math.prod(self.mechanism.state_shape())
        return 8 * (states + len(self.channels)) * (1 + len(self.unknowns.names) + self.columns.shape[1])

    def _residuals_of(self, prediction: Prediction, rows: Int[np.ndarray, "R"], runs: np.ndarray, z: np.ndarray) -> Residuals:
        """Return the residuals of some rows from the prediction of their runs."""
        entries = np.searchsorted(runs, self.run[rows]), self.time[rows], self.index[rows, 2]
        r = weighted(prediction.y[:, *entries], self.measured[rows], self.sigma[rows])
        by = prediction.dy[:, *entries]
        by[np.abs(by) * self._sizes(z)[:, None] <= VISIBLE_CHANGE * self.channel_scale[self.index[rows, 2], None]] = 0.0
        by /= self.sigma[rows, None]
        return Residuals(r, self.by_unknowns(by, self.run[rows], z), prediction.code.max(1), rows)

    def _sizes(self, z: Float[np.ndarray, "B K"]) -> Float[np.ndarray, "B P+S"]:
        """Return the sizes of the parameters, and of the unknowns of a run's initial state, which are dimensionless."""
        by_change = self.unknowns.dx_dz(z[:, : len(self.unknowns.names)])
        sizes = np.clip(by_change, np.abs(self.unknowns.range_scale), np.finfo(float).max)
        return np.concatenate([sizes, np.ones((len(z), self.columns.shape[1]))], axis=1)

    def first_states(self, mechanism: StudyModel, z: Float[np.ndarray, "K"]) -> tuple[State, ...]:
        """Return the closed initial states of the records for a mechanism with the parameters of z."""
        members, states = self.members(z[None], self.beginnings), []
        for k, record in enumerate(self.records):
            guess = self.predictor.guess(members, k)
            states.append(assemble(with_conditions(mechanism, record), record.t0, guess, throw=False))
        return tuple(states)

    def further_rows(self, ends: RunEnds | None, z: Float[np.ndarray, "B K"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Iterate over blocks of residuals after the measured ones, (B, rows), and their Jacobians, (B, rows, K).

        `row_blocks` calls this after all runs, with the ends of the runs if the predictor computes these. Here, the residuals are
        those of priors, (x - mean) / sigma; overrides may yield more, which `extra_rows` has to count.
        """
        which, u = self.priors, self.unknowns
        if not len(which):
            return
        z = z[:, : len(u.names)]
        J = np.zeros((len(z), len(which), self.K))
        J[:, np.arange(len(which)), which] = u.dx_dz(z)[:, which] / u.sigma[which]
        yield weighted(u.values(z)[:, which], u.mean[which], u.sigma[which]), J

    def by_unknowns(self, by: np.ndarray, run: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the derivatives of residuals with respect to the unknowns z, (B, R, K).

        Args:
            by: derivatives with respect to the parameters x and the initial-state unknowns of each row's run, (B, R, P + S); they
                may be overwritten.
            run: the run of each row (R,).
            z: the unknowns (B, K).
        """
        P = len(self.unknowns.names)
        if self.K == P:
            by *= self.unknowns.dx_dz(z)[:, None]
            return by
        J = np.zeros((*by.shape[:2], self.K + 1))  # the last column collects the derivatives for unused entries
        columns = self.columns[run] % (self.K + 1)
        np.put_along_axis(J, np.broadcast_to(columns, (len(z), *columns.shape)), by[..., P:], 2)
        J[..., :P] = by[..., :P] * self.unknowns.dx_dz(z[:, :P])[:, None]
        return J[..., : self.K]


def weighted(predicted: Any, measured: np.ndarray, sigma: Any) -> Any:
    """Return residuals: predicted minus measured values, or parameters minus the means of priors, in standard deviations."""
    return (predicted - measured) / sigma


def _size_of(values: np.ndarray) -> float:
    """Return the scale of a channel: its standard deviation; if it is constant, its absolute value; if it is zero, 1."""
    finite = values[np.isfinite(values)]
    size = np.abs(finite).max(initial=0.0)
    deviation = finite.std() if finite.size else 0.0
    return float(deviation if deviation > STILL_DEVIATION * size else size or 1.0)


# --- from the arguments of `identify`


def build_problem(
    mechanism: StudyModel,
    data: Data,
    parameters: ParametersLike,
    settings: Mapping[str, Any],
    noise: Noise = None,
    ignore: Sequence[str] = (),
    seed: int = 0,
    strategy: Strategy = "auto",
    initial_state: Start | Estimated | None = None,
    tol: float = TIGHT_TOL,
) -> FitProblem:
    """Build the problem from the arguments of `identify`.

    Raises:
        IdentificationError: lists every mistake in the arguments.
        AssemblyError: the mechanism cannot be closed with the first guess or any guess near it.
    """
    if mechanism.q0 is None:
        cure = "the initial guess is a number of the fit, too"
        raise IdentificationError([f"a ConstrainedSystem needs q0 and v0, ConstrainedSystem(..., q0=..., v0=...): {cure}"])
    unknowns, records = _collect(
        lambda: _check_settings(mechanism, settings),
        lambda: unknowns_of(mechanism, parameters),
        lambda: _with_initial_state(records_of(mechanism, data, noise, ignore), initial_state),
    )[1:]
    if not isinstance(mechanism, Mechanism):
        return FitProblem(mechanism, unknowns, records, settings)
    return _closable_problem(mechanism, unknowns, records, settings, seed, tol)


def _collect(*steps: Callable[[], Any]) -> list[Any]:
    """Return the results of steps; if some raise `IdentificationError`, raise a single error with all mistakes."""
    results, problems = [], []
    for step in steps:
        try:
            results.append(step())
        except IdentificationError as error:
            problems += error.problems
    if problems:
        raise IdentificationError(problems)
    return results


def _with_initial_state(records: Sequence[Record], given: Start | Estimated | None) -> Sequence[Record]:
    if given is None:
        return records
    start = given if isinstance(given, Start) else Start(estimate=given)
    return [record.changed(initial_state=start) for record in records]


def _check_settings(mechanism: StudyModel, settings: Mapping[str, Any]) -> None:
    allowed = [name for name in inspect.signature(simulate).parameters if name not in OWN_ARGUMENTS]
    problems = [
        f"{name}: not an argument of simulate that can be given here{suggestion(name, allowed)}"
        for name in settings
        if name not in allowed
    ]
    problems += argument_problems(simulate, {"mechanism": mechanism, **settings})
    if problems:
        raise IdentificationError(problems)


def _closable_problem(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any], seed: int, tol: float
) -> FitProblem:
    """Build the problem at the first guess, or at the nearest guess that can be closed.

    A mechanism without redundant rows is checked by its first run, which the fit needs anyway; a separate check would cost more.
    """
    if unknowns.at_scene_values and analyse(mechanism).redundant_rows == ():
        try:
            problem = FitProblem(mechanism, unknowns, records, settings)
            if problem.code(np.zeros(problem.K), (max(tol, LOOSE_TOL), max(tol, LOOSE_TOL))) != Result.could_not_assemble:
                return problem
        except AssemblyError:
            pass
    analysis, unknowns = nearest_closable(mechanism, unknowns, seed)
    if analysis.redundant_rows:
        require_consistent_loops(mechanism, unknowns)
    return FitProblem(mechanism, unknowns, records, {**settings, "analysis": analysis})
