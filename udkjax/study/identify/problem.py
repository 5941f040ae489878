"""The least-squares problem: residuals of all records, weighted by their noise, and of priors; and their Jacobian.

With y what is measured, yhat(z) what the mechanism with the unknowns z would show, and sigma the standard deviation of the noise,

    r = (yhat(z) - y) / sigma,        J = dr/dz,

followed by (x - mean) / sigma of each prior. Every number y that is there is one residual; the order is record, time, channel.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from udkjax.equations.analysis import analyse
from udkjax.integrate.assembly import State
from udkjax.integrate.solution import Result
from udkjax.scene.checks import quoted
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import parameters_of, split
from udkjax.study.channels import Channel, Quantity, channel_of
from udkjax.study.identify.initial_states import initial_state_unknowns
from udkjax.study.identify.messages import IdentificationError
from udkjax.study.identify.parameters import Unknowns
from udkjax.study.identify.prediction import Members, Predictor, Tolerances
from udkjax.study.identify.records import Key, Record

PADDING = 1e-9  # of the length of a record: the distance of the times that pad it; so short a step costs nothing
STILL = 1e-12  # of the largest number in a channel: with a smaller deviation the channel does not move
RESIDUALS_PER_UNKNOWN = 3.0  # in the first part of a record that is fitted, and in a piece: fewer would follow the noise


class Residuals(NamedTuple):
    """Residuals r and Jacobians J = dr/dz at B sets of unknowns; `code` is the worst result of the runs of all records."""

    r: Float[np.ndarray, "B R"]
    J: Float[np.ndarray, "B R K"]
    code: Int[np.ndarray, "B"]

    @property
    def ok(self) -> np.ndarray:
        """Whether all of it is finite, of runs that came to their end (B,)."""
        return (self.code == Result.successful) & np.isfinite(self.r).all(1) & np.isfinite(self.J).all((1, 2))


class Problem:
    """What is to be minimized, as a function of the unknowns z (K,): P of parameters, then those of initial states.

    Attributes:
        y: measured values (records, times, channels), not a number where nothing was measured.
        present: where there is a value; `index` (R, 3) is the record, time and channel of each of these R residuals.
        sigma: standard deviations (R,) that residuals are divided by; `noise_given` (R,) says which of them were given.
        channel_scale: the size of what each channel shows (C,).
        columns: where in z the unknowns of the initial state of each record are (records, S), -1 where it has none; `bases`
            (records, 2, n, S) are the changes of q and v (n,) by each of them.
        priors: which parameters have a prior; their residuals follow the R.
        predictor: computes what the channels show, and counts evaluations.
    """

    extra_rows: int  # residuals that follow those of what was measured
    constrained: int = 0  # unknowns that extra rows determine, and not what was measured

    def __init__(
        self, mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any] | None = None
    ):
        self.mechanism, self.unknowns, self.records = mechanism, unknowns, tuple(records)
        self.channels = _channels(mechanism, self.records)
        self.channel_names = tuple(channel.name for channel in self.channels)
        self.initial_states, self.columns, self.bases = initial_state_unknowns(mechanism, unknowns, self.records)
        self.K = len(unknowns.names) + sum(len(state.names) for state in self.initial_states)
        self._tabulate()
        self._conditions = _conditions(mechanism, self.records)
        self.priors = np.flatnonzero(np.isfinite(unknowns.sigma))
        self.extra_rows = len(self.priors)
        self.predictor = Predictor(
            mechanism, unknowns.targets, self.channels, {"analysis": analyse(mechanism), **(settings or {})}
        )

    @property
    def all_names(self) -> tuple[str, ...]:
        """Names of all K unknowns."""
        return (*self.unknowns.names, *(name for state in self.initial_states for name in state.names))

    @property
    def all_units(self) -> tuple[str, ...]:
        """Units of all K unknowns."""
        return (*self.unknowns.units, *(unit for state in self.initial_states for unit in state.units))

    def _tabulate(self) -> None:
        """Arrange all records in tables of one length; shorter ones are padded with times at which nothing was measured."""
        tables = [_with_start(record) for record in self.records]
        length = max(2, *(len(ts) for ts, _ in tables))
        self.ts = np.stack([_padded(ts, length) for ts, _ in tables])
        shape = len(self.records), length, len(self.channels)
        self.y, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
        for r, (record, (ts, first)) in enumerate(zip(self.records, tables, strict=True)):
            for text, values in record.values.items():
                c = self.channel_names.index(_channel(self.mechanism, text).name)
                self.y[r, first : len(ts), c] = values
                noise = record.noise[text]
                sigma[r, first : len(ts), c] = np.nan if noise is None else noise
        self.present = np.isfinite(self.y)
        self.noise_given = np.isfinite(sigma)[self.present]
        self.channel_scale = np.array([_size_of(self.y[:, :, c]) for c in range(shape[2])])
        self.sigma = np.where(np.isfinite(sigma), sigma, self.channel_scale)[self.present]
        self.index = np.argwhere(self.present)  # (R, 3): record, time, channel of each residual

    def series(self) -> list[np.ndarray]:
        """Return which residuals belong to one channel of one record, in the order of time: for each that has some."""
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
            first = 0 if record.t0 == record.times[0] else 1
            part = full[k, first : first + len(record.times)]
            found.append({name: part[:, c] for c, name in enumerate(self.channel_names) if np.isfinite(part[:, c]).any()})
        return tuple(found)

    def members(self, z: Float[np.ndarray, "B K"], horizon: float | None = None) -> Members:
        """Return the members of B sets of unknowns: all records of the first, then of the next."""
        sets, P, records = len(z), len(self.unknowns.names), len(self.records)
        x = np.repeat(self.unknowns.values(z[:, :P]), records, axis=0)
        shift = np.where(self.columns < 0, 0.0, z[:, self.columns])
        ts = self.ts if horizon is None else np.stack([_until(ts, horizon) for ts in self.ts])
        states = [record.start.state for record in self.records]
        q = v = None
        if any(state is not None for state in states):
            own = State(self.mechanism.q0, self.mechanism.v0)
            q, v = (np.stack([np.asarray(getattr(own if state is None else state, part)) for state in states]) for part in "qv")
        same = ts, q, v, self.bases, self._conditions
        tiled = jax.tree.map(lambda leaf: np.tile(leaf, (sets, *[1] * (np.ndim(leaf) - 1))), same)
        return Members(x, shift.reshape(sets * records, self.columns.shape[1]), *tiled)

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: Tolerances, horizon: float | None = None) -> Residuals:
        """Compute residuals and their Jacobian.

        Args:
            z: B sets of unknowns.
            tol: tolerances of the integration.
            horizon: the part of each record (0 to 1) that counts; residuals beyond it are zero. None: all of it.
        """
        sets, records = len(z), len(self.records)
        found = self.predictor(self.members(z, horizon), tol)
        y = found.y.reshape(sets, records, *found.y.shape[1:])
        dy = found.dy.reshape(sets, records, *found.dy.shape[1:])
        r = (y[:, self.present] - self.y[self.present]) / self.sigma
        record = self.index[:, 0]
        J = self.by_unknowns(dy[:, self.present] / self.sigma[:, None], record, z)
        if horizon is not None:
            beyond = self.ts[tuple(self.index[:, :2].T)] > _end(self.ts[record], horizon)
            r[:, beyond], J[:, beyond] = 0.0, 0.0
        code = found.code.reshape(sets, records).max(1)
        return Residuals(*self.with_priors(z, r, J), code)

    def by_unknowns(self, by: np.ndarray, owner: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return derivatives by x and by the state of each row's owner, (B, R, P + S), as derivatives by z, (B, R, K)."""
        P = len(self.unknowns.names)
        J = np.zeros((*by.shape[:2], self.K + 1))  # the last column takes the derivatives by what is no unknown
        columns = self.columns[owner] % (self.K + 1)
        np.put_along_axis(J, np.broadcast_to(columns, (len(z), *columns.shape)), by[..., P:], 2)
        J[..., :P] = by[..., :P] * self.unknowns.dx_dz(z[:, :P])[:, None]
        return J[..., : self.K]

    def with_priors(self, z: np.ndarray, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Append the residuals and the Jacobian of the priors, (x - mean) / sigma."""
        which, P, u = self.priors, len(self.unknowns.names), self.unknowns
        if not len(which):
            return r, J
        x, dx_dz = u.values(z[:, :P])[:, which], u.dx_dz(z[:, :P])[:, which]
        more = np.zeros((len(z), len(which), J.shape[2]))
        more[:, np.arange(len(which)), which] = dx_dz / u.sigma[which]
        return np.concatenate([r, (x - u.mean[which]) / u.sigma[which]], 1), np.concatenate([J, more], 1)


def _size_of(values: np.ndarray) -> float:
    """Return the size of what a channel shows: the deviation from its mean; of one that stands still, its size; of zeros, 1."""
    found = values[np.isfinite(values)]
    size = np.abs(found).max(initial=0.0)
    deviation = found.std() if found.size else 0.0
    return float(deviation if deviation > STILL * size else size or 1.0)


def _with_start(record: Record) -> tuple[np.ndarray, int]:
    """Return output times from the initial state on, and which of them is the first that was measured."""
    return (record.times, 0) if record.t0 == record.times[0] else (np.concatenate([[record.t0], record.times]), 1)


def _padded(ts: np.ndarray, length: int) -> np.ndarray:
    span = max(ts[-1] - ts[0], PADDING)
    return np.concatenate([ts, ts[-1] + PADDING * span * np.arange(1, length - len(ts) + 1)])


def _end(ts: np.ndarray, horizon: float) -> np.ndarray:
    return ts[..., 0] + horizon * (ts[..., -1] - ts[..., 0])


def _until(ts: np.ndarray, horizon: float) -> np.ndarray:
    """Return the times up to a part of a record, padded to the same length."""
    last = max(1, int(np.searchsorted(ts, _end(ts, horizon), side="right")) - 1)
    return _padded(ts[: last + 1], len(ts))


def _channels(mechanism: Mechanism, records: Sequence[Record]) -> tuple[Channel | Quantity, ...]:
    found: dict[str, Channel | Quantity] = {}
    problems = []
    for record in records:
        own: dict[str, Key] = {}
        for text in record.values:
            try:
                channel = _channel(mechanism, text)
            except ValueError as problem:
                problems.append(f"{record.place}{problem}")
                continue
            name = channel.name
            if name in own:
                problems.append(f"{record.place}{quoted(str(text))} and {quoted(str(own[name]))} are the same channel")
            own[name] = text
            found.setdefault(name, channel)
    if problems:
        raise IdentificationError(problems)
    return tuple(found.values())


def _channel(mechanism: Mechanism, given: Key) -> Channel | Quantity:
    return given if isinstance(given, Quantity) else channel_of(mechanism, given)


def _conditions(mechanism: Mechanism, records: Sequence[Record]) -> dict[str, np.ndarray]:
    """Return values of all records for every parameter that differs between them."""
    known, problems = parameters_of(mechanism), []
    found: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(name for record in records for name in record.conditions):
        owner, index = split(name, known)
        if owner not in known or known[owner].value is None:
            problems.append(f"conditions: no parameter {quoted(name)}")
            continue
        usual = np.asarray(known[owner].value)[index]
        try:
            found[name] = np.stack(
                [np.broadcast_to(np.asarray(r.conditions.get(name, usual), float), usual.shape) for r in records]
            )
        except ValueError:
            problems.append(f"conditions: {quoted(name)} must be of shape {usual.shape} in each record")
    if problems:
        raise IdentificationError(problems)
    return found
