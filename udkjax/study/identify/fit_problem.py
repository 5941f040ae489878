"""The least-squares problem: residuals of all records, weighted by their noise, and of priors; and their Jacobian.

With y what is measured, yhat(z) what the mechanism with the unknowns z would show, and sigma the standard deviation of the noise,

    r = (yhat(z) - y) / sigma,        J = dr/dz,

followed by (x - mean) / sigma of each prior. Every number y that is there is one residual; the order is record, time, channel.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from udkjax.equations.analysis import analyse
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Result
from udkjax.positions.assembly import AssemblyError, State, assemble
from udkjax.positions.channels import Quantity, channel_of
from udkjax.scene.arguments import argument_problems
from udkjax.scene.checks import suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.loop_consistency import nearest_closable, require_consistent_loops
from udkjax.study.identify.parameters import ParametersLike, unknowns_of
from udkjax.study.identify.prediction import LOOSE_TOL, TIGHT_TOL, Members, Prediction, Predictor, Runs, TolerancePair
from udkjax.study.identify.record_reader import Data, records_of
from udkjax.study.identify.records import Estimated, IdentificationError, Noise, Record, Start, output_times, pad_times, tabulate
from udkjax.study.identify.unknowns import Unknowns, conditions_of, guessed_states, initial_state_unknowns, with_conditions

STILL_DEVIATION = 1e-12  # of the largest number in a channel: with a smaller deviation the channel does not move
# Of the largest singular value of a Jacobian: directions below it do not show in what was measured. A change that leaves the
# equations of motion as they are has 1e-16, whatever the tolerance; derivatives integrated at 1e-7 have errors of 1e-8.
INVISIBLE_RATIO = 1e-8
RESIDUALS_PER_UNKNOWN = 3.0  # in the first part of a record that is fitted, and in a piece: fewer would follow the noise
# Arguments of `simulate` that an identification decides about.
DECIDED = ("ts", "mechanism", "state", "rtol", "atol", "adjoint", "throw", "progress", "analysis")
Strategy = Literal["auto", "pieces"]


class Residuals(NamedTuple):
    """Residuals r and Jacobians J = dr/dz at B sets of unknowns; `code` is the worst result of the runs of all records."""

    r: Float[np.ndarray, "B R"]
    J: Float[np.ndarray, "B R K"]
    code: Int[np.ndarray, "B"]

    @property
    def ok(self) -> np.ndarray:
        """True (B,) where all of it is finite, of runs that came to their end."""
        return (self.code == Result.successful) & np.isfinite(self.r).all(1) & np.isfinite(self.J).all((1, 2))


class FitProblem:
    """The residuals to be minimized, as a function of the unknowns z (K,): P of parameters, then those of initial states.

    Attributes:
        ts: times (records, times) of the records, from their beginning on (s).
        y: measured values (records, times, channels), not a number where nothing was measured.
        present: mask of the values that there are; `index` (R, 3) is the record, time and channel of each of these R residuals.
        sigma: standard deviations (R,) that residuals are divided by; `noise_given` (R,) says which of them were given.
        channel_scale: the size of what each channel shows (C,).
        runs: runs to simulate; `run` and `time` (R,) are the run and the place in its times that each residual is of.
        state_sizes: changes of the unknowns of initial states, in their units, by one of each z (K - P,).
        columns: places in z of the unknowns of each run's initial state (N, S), -1 where it has none.
        beginnings: the run that each record begins with (records,).
        priors: indices of the parameters that have a prior; their residuals follow the R.
        predictor: computes what the channels show, and counts evaluations.
    """

    extra_rows: int  # residuals that follow those of what was measured
    constrained: int = 0  # unknowns that extra rows determine, and not what was measured

    def __init__(
        self, mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any] | None = None
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
        self.noise_given = np.isfinite(sigma)[self.present]
        self.channel_scale = np.array([_size_of(self.y[:, :, c]) for c in range(len(keys))])
        self.sigma = np.where(np.isfinite(sigma), sigma, self.channel_scale)[self.present]
        self.run, self.time, _ = self.index.T
        self.runs = Runs(self.ts, *guessed_states(mechanism, self.records), bases, conditions_of(mechanism, self.records))
        self.beginnings = np.arange(len(self.records))
        self.priors = np.flatnonzero(np.isfinite(unknowns.sigma))
        self.extra_rows = len(self.priors)
        self.settings = {"analysis": analyse(mechanism), **(settings or {})}
        self.predictor = Predictor(mechanism, unknowns.targets, self.channels, self.settings)

    @property
    def duration(self) -> float:
        """The duration of the longest record, s."""
        return float((self.ts[:, -1] - self.ts[:, 0]).max())

    def series(self) -> list[np.ndarray]:
        """Return the indices of the residuals of each channel of each record that has some, in the order of time."""
        record, _, channel = self.index.T
        pairs = ((k, c) for k in range(len(self.records)) for c in range(len(self.channels)))
        return [places for k, c in pairs if len(places := np.flatnonzero((record == k) & (channel == c)))]

    def noise_groups(self) -> Int[np.ndarray, "R"]:
        """Return for each residual, those of priors too, which noise it shares that is to be estimated; -1 where it is known."""
        _, group = np.unique(np.where(self.noise_given, -1, self.index[:, 2]), return_inverse=True)
        group = group - 1 if self.noise_given.any() else group
        return np.concatenate([group, np.full(self.extra_rows, -1)])

    def by_record(self, rows: Float[np.ndarray, "R"]) -> tuple[dict[str, np.ndarray], ...]:
        """Return numbers of all residuals as tables: of each record, its channels at its times; nan where there is none."""
        full = np.full(self.y.shape, np.nan)
        full[self.present] = rows
        found = []
        for k, record in enumerate(self.records):
            ts, first = output_times(record)
            part = full[k, first : len(ts)]
            found.append({name: part[:, c] for c, name in enumerate(self.channel_names) if np.isfinite(part[:, c]).any()})
        return tuple(found)

    def members(self, z: Float[np.ndarray, "B K"], horizon: float | None = None) -> Members:
        """Return the members of B sets of unknowns: all runs of the first, then of the next."""
        sets, (N, S) = len(z), self.columns.shape
        x = np.repeat(self.unknowns.values(z[:, : len(self.unknowns.names)]), N, axis=0)
        shift = np.where(self.columns < 0, 0.0, z[:, self.columns]).reshape(sets * N, S)
        found = self.members_of(np.tile(np.arange(N), sets), x, shift)
        if horizon is None:
            return found
        ts = np.tile([_times_until(ts, horizon) for ts in self.runs.ts], (sets, 1))
        return found._replace(runs=found.runs._replace(ts=ts))

    def members_of(self, runs: Int[np.ndarray, "M"], x: Float[np.ndarray, "M P"], shift: Float[np.ndarray, "M S"]) -> Members:
        """Return the members of some runs, with these parameters and unknowns of their initial states."""
        return Members(x, shift, jax.tree.map(lambda leaf: leaf[runs], self.runs))

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: TolerancePair, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian.

        Args:
            z: B sets of unknowns.
            tol: tolerances of the integration.
            horizon: part of each record that counts, s since it began; residuals beyond are zero. None: all of it.
        """
        found = self.predictor(self.members(z, horizon), tol)
        found = jax.tree.map(lambda part: part.reshape(len(z), -1, *part.shape[1:]), found)
        at = self.run, self.time, self.index[:, 2]
        r = (found.y[:, *at] - self.y[self.present]) / self.sigma
        J = self.by_unknowns(found.dy[:, *at] / self.sigma[:, None], self.run, z)
        if horizon is not None:
            record, time, _ = self.index.T
            beyond = self.ts[record, time] - self.ts[record, 0] > horizon
            r[:, beyond], J[:, beyond] = 0.0, 0.0
        for more_r, more_J in self.further_rows(found, z):
            r, J = np.concatenate([r, more_r], axis=1), np.concatenate([J, more_J], axis=1)
        return Residuals(r, J, found.code.max(1))

    def first_states(self, mechanism: Mechanism, z: Float[np.ndarray, "K"]) -> tuple[State, ...]:
        """Return the states that the records begin with, closed, of a mechanism that has the parameters of z."""
        members, found = self.members(z[None]), []
        for record, run in zip(self.records, self.beginnings, strict=True):
            guess = self.predictor.guess(members, int(run))
            found.append(assemble(with_conditions(mechanism, record), record.t0, guess, throw=False))
        return tuple(found)

    def further_rows(self, found: Prediction, z: Float[np.ndarray, "B K"]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Iterate over residuals, with Jacobians, that follow those of what was measured: of priors, (x - mean) / sigma."""
        which, u = self.priors, self.unknowns
        if not len(which):
            return
        z = z[:, : len(u.names)]
        J = np.zeros((len(z), len(which), self.K))
        J[:, np.arange(len(which)), which] = u.dx_dz(z)[:, which] / u.sigma[which]
        yield (u.values(z)[:, which] - u.mean[which]) / u.sigma[which], J

    def by_unknowns(self, by: np.ndarray, run: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return derivatives by x and by the state of each row's run, (B, R, P + S), as derivatives by z, (B, R, K)."""
        P = len(self.unknowns.names)
        J = np.zeros((*by.shape[:2], self.K + 1))  # the last column takes the derivatives by what is no unknown
        columns = self.columns[run] % (self.K + 1)
        np.put_along_axis(J, np.broadcast_to(columns, (len(z), *columns.shape)), by[..., P:], 2)
        J[..., :P] = by[..., :P] * self.unknowns.dx_dz(z[:, :P])[:, None]
        return J[..., : self.K]


def _size_of(values: np.ndarray) -> float:
    """Return the size of what a channel shows: the deviation from its mean; of one that stands still, its size; of zeros, 1."""
    found = values[np.isfinite(values)]
    size = np.abs(found).max(initial=0.0)
    deviation = found.std() if found.size else 0.0
    return float(deviation if deviation > STILL_DEVIATION * size else size or 1.0)


def _times_until(ts: np.ndarray, horizon: float) -> np.ndarray:
    """Return the times of a record until so long after it began, padded to the same length."""
    last = max(1, int(np.searchsorted(ts - ts[0], horizon, side="right")) - 1)
    return pad_times(ts[: last + 1], len(ts))


# --- from what users give


def build_problem(
    mechanism: Mechanism,
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
    """Build the problem that arguments of `identify` pose.

    Raises:
        IdentificationError: with every mistake in them.
        AssemblyError: the mechanism cannot be closed with the first guess, nor with any near it.
    """
    unknowns, records = _collect(
        lambda: _check_settings(mechanism, settings),
        lambda: unknowns_of(mechanism, parameters),
        lambda: _with_initial_state(records_of(mechanism, data, noise, ignore), initial_state),
    )[1:]
    return _closable_problem(mechanism, unknowns, records, settings, seed, tol)


def _collect(*steps: Callable[[], Any]) -> list[Any]:
    """Return the results of some steps; if any of them raises `IdentificationError`, raise one with the mistakes of all."""
    found, problems = [], []
    for step in steps:
        try:
            found.append(step())
        except IdentificationError as error:
            problems += error.problems
    if problems:
        raise IdentificationError(problems)
    return found


def _with_initial_state(records: Sequence[Record], given: Start | Estimated | None) -> Sequence[Record]:
    if given is None:
        return records
    start = given if isinstance(given, Start) else Start(estimate=given)
    return [record.changed(initial_state=start) for record in records]


def _check_settings(mechanism: Mechanism, settings: Mapping[str, Any]) -> None:
    known = [name for name in inspect.signature(simulate).parameters if name not in DECIDED]
    problems = [
        f"{name}: no setting of simulate that can be given here{suggestion(name, known)}"
        for name in settings
        if name not in known
    ]
    problems += argument_problems(simulate, {"mechanism": mechanism, **settings})
    if problems:
        raise IdentificationError(problems)


def _closable_problem(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any], seed: int, tol: float
) -> FitProblem:
    """Build the problem at the first guess; where that cannot be closed, at the nearest that can.

    Whether a mechanism without redundant rows closes is seen by the first run, which the fit begins with: to look before would
    cost more than the run.
    """
    if unknowns.at_scene_values and analyse(mechanism).redundant_rows == ():
        try:
            problem = FitProblem(mechanism, unknowns, records, settings)
            first = problem.evaluate(np.zeros((1, problem.K)), (max(tol, LOOSE_TOL), max(tol, LOOSE_TOL)))
            if first.code[0] != Result.could_not_assemble:
                return problem
        except AssemblyError:
            pass
    analysis, unknowns = nearest_closable(mechanism, unknowns, seed)
    if analysis.redundant_rows:
        require_consistent_loops(mechanism, unknowns)
    return FitProblem(mechanism, unknowns, records, {**settings, "analysis": analysis})
