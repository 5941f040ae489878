"""The least-squares problem: residuals of all records, weighted by their noise, and of priors; and their Jacobian.

With y what is measured, yhat(z) what the mechanism with the unknowns z would show, and sigma the standard deviation of the noise,

    r = (yhat(z) - y) / sigma,        J = dr/dz,

followed by (x - mean) / sigma of each prior. Every number y that is there is one residual; the order is record, time, channel.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.equations.analysis import analyse
from udkjax.integrate.solution import Result
from udkjax.scene.checks import quoted
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import parameters_of, split
from udkjax.study.identify.channels import Channel, Quantity, channel_of
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.program import Members, Program
from udkjax.study.identify.records import Record
from udkjax.study.identify.starts import starts_of
from udkjax.study.identify.unknowns import Unknowns

AFTER = 1e-9  # of the length of a record: the distance of times that stand in for those that are not looked at
SPREAD = 1e-12  # of the largest number in a channel: below it the channel does not move


class Evaluated(NamedTuple):
    """Residuals (B, R), Jacobians (B, R, K), and how the runs ended: the worst code of all records (B,)."""

    r: np.ndarray
    J: np.ndarray
    code: np.ndarray

    @property
    def ok(self) -> np.ndarray:
        """Whether all of it is numbers."""
        return (self.code == Result.successful) & np.isfinite(self.r).all(1) & np.isfinite(self.J).all((1, 2))


class Problem:
    """What is to be minimized, as a function of the unknowns z (K,): those of the parameters, then those of the starts.

    `sigma` (R,) are the standard deviations that residuals are divided by; `known` says which of them were given.
    """

    def __init__(
        self, mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record], settings: Mapping[str, Any] | None = None
    ):
        self.mechanism, self.unknowns, self.records = mechanism, unknowns, tuple(records)
        self.channels = _channels(mechanism, self.records)
        self.names = tuple(channel.name for channel in self.channels)
        self.starts, self.columns = starts_of(mechanism, unknowns, self.records)
        self.K = len(unknowns.names) + sum(len(start.names) for start in self.starts)
        self._numbers()
        self._conditions = _conditions(mechanism, self.records)
        self.program = Program(mechanism, unknowns.targets, self.channels, {"analysis": analyse(mechanism), **(settings or {})})

    @property
    def all_names(self) -> tuple[str, ...]:
        """The names of all unknowns."""
        return (*self.unknowns.names, *(name for start in self.starts for name in start.names))

    @property
    def all_units(self) -> tuple[str, ...]:
        """The units of all unknowns."""
        return (*self.unknowns.units, *(unit for start in self.starts for unit in start.units))

    def _numbers(self) -> None:
        """Tables of all records, of one length: where one is shorter, times follow at which nothing was measured."""
        tables = [_with_start(record) for record in self.records]
        length = max(2, *(len(ts) for ts, _ in tables))
        self.ts = np.stack([_lengthened(ts, length) for ts, _ in tables])
        shape = len(self.records), length, len(self.channels)
        self.y, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
        for r, (record, (ts, first)) in enumerate(zip(self.records, tables, strict=True)):
            for text, values in record.values.items():
                c = self.names.index(_channel(self.mechanism, text).name)
                self.y[r, first : len(ts), c] = values
                noise = record.noise[text]
                sigma[r, first : len(ts), c] = np.nan if noise is None else noise
        self.there = np.isfinite(self.y)
        self.known = np.isfinite(sigma)[self.there]
        self.spread = np.array([_spread(self.y[:, :, c]) for c in range(shape[2])])
        self.sigma = np.where(np.isfinite(sigma), sigma, self.spread)[self.there]
        self.where = np.argwhere(self.there)  # (R, 3): record, time, channel of each residual

    def series(self) -> list[np.ndarray]:
        """Which residuals belong to one channel of one record, in the order of time: for each that has some."""
        record, _, channel = self.where.T
        pairs = ((k, c) for k in range(len(self.records)) for c in range(len(self.channels)))
        return [places for k, c in pairs if len(places := np.flatnonzero((record == k) & (channel == c)))]

    @property
    def priors(self) -> np.ndarray:
        """Which parameters have a prior."""
        return np.flatnonzero(np.isfinite(self.unknowns.sigma))

    @property
    def more(self) -> int:
        """Rows that follow those of what was measured."""
        return len(self.priors)

    @property
    def tied(self) -> int:
        """Unknowns that further rows decide about, and not what was measured."""
        return 0

    def members(self, z: Float[np.ndarray, "B K"], horizon: float | None = None) -> Members:
        """The members of B sets of unknowns: all records of the first, then of the next."""
        sets, P, records = len(z), len(self.unknowns.names), len(self.records)
        x = np.repeat(self.unknowns.values(z[:, :P]), records, axis=0)
        S = max((len(start.names) for start in self.starts), default=0)
        n = 3 * len(self.mechanism.body_names)
        shift, bases = np.zeros((sets, records, S)), np.zeros((records, 2, n, S))
        for r, columns in enumerate(self.columns):
            if columns is not None:
                at, start = columns
                shift[:, r, : len(start.names)] = z[:, at : at + len(start.names)]
                bases[r, :, :, : len(start.names)] = start.basis
        ts = self.ts if horizon is None else np.stack([_until(ts, horizon) for ts in self.ts])
        states = [record.start.state for record in self.records]
        q = v = None
        if any(state is not None for state in states):
            mech = self.mechanism
            q = np.stack([np.asarray(mech.q0 if state is None else state.q) for state in states])
            v = np.stack([np.asarray(mech.v0 if state is None else state.v) for state in states])
        one = ts, q, v, bases, self._conditions
        ts, q, v, bases, conditions = _tiled(one, sets)
        return Members(x, shift.reshape(sets * records, S), ts, q, v, bases, conditions)

    def evaluate(self, z: Float[np.ndarray, "B K"], tol: tuple[float, float], horizon: float | None = None) -> Evaluated:
        """Residuals and Jacobian of sets of unknowns. Beyond the `horizon`, a part of each record, residuals are zero."""
        sets, P, records = len(z), len(self.unknowns.names), len(self.records)
        found = self.program(self.members(z, horizon), tol)
        y = found.y.reshape(sets, records, *found.y.shape[1:])
        slope = found.slope.reshape(sets, records, *found.slope.shape[1:])
        r = (y[:, self.there] - self.y[self.there]) / self.sigma
        J = np.zeros((sets, *r.shape[1:], self.K))
        by = slope[:, self.there] / self.sigma[:, None]
        J[:, :, :P] = by[:, :, :P] * self.unknowns.slopes(z[:, :P])[:, None, :]
        record = self.where[:, 0]
        for k, columns in enumerate(self.columns):
            if columns is not None:
                at, start = columns
                J[:, record == k, at : at + len(start.names)] = by[:, record == k, P : P + len(start.names)]
        if horizon is not None:
            beyond = self.ts[tuple(self.where[:, :2].T)] > _end(self.ts[record], horizon)
            r[:, beyond], J[:, beyond] = 0.0, 0.0
        code = found.code.reshape(sets, records).max(1)
        return Evaluated(*self.with_priors(z, r, J), code)

    def with_priors(self, z: np.ndarray, r: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals and Jacobian, followed by those of the priors. Columns may be more than K: of unknowns that have none."""
        which, P, u = self.priors, len(self.unknowns.names), self.unknowns
        if not len(which):
            return r, J
        x, slope = u.values(z[:, :P])[:, which], u.slopes(z[:, :P])[:, which]
        more = np.zeros((len(z), len(which), J.shape[2]))
        more[:, np.arange(len(which)), which] = slope / u.sigma[which]
        return np.concatenate([r, (x - u.mean[which]) / u.sigma[which]], 1), np.concatenate([J, more], 1)


def _tiled(tree: Any, times: int) -> Any:
    import jax

    return jax.tree.map(lambda leaf: np.tile(leaf, (times, *[1] * (np.ndim(leaf) - 1))), tree)


def _spread(values: np.ndarray) -> float:
    """The size of what a channel shows: the deviation from its mean; of one that stands still, its size; of zeros, 1."""
    found = values[np.isfinite(values)]
    size = np.abs(found).max(initial=0.0)
    deviation = found.std() if found.size else 0.0
    return float(deviation if deviation > SPREAD * size else size or 1.0)


def _with_start(record: Record) -> tuple[np.ndarray, int]:
    """Output times from the start on, and which of them is the first that was measured."""
    return (record.times, 0) if record.t0 == record.times[0] else (np.concatenate([[record.t0], record.times]), 1)


def _lengthened(ts: np.ndarray, length: int) -> np.ndarray:
    span = max(ts[-1] - ts[0], AFTER)
    return np.concatenate([ts, ts[-1] + AFTER * span * np.arange(1, length - len(ts) + 1)])


def _end(ts: np.ndarray, horizon: float) -> np.ndarray:
    return ts[..., 0] + horizon * (ts[..., -1] - ts[..., 0])


def _until(ts: np.ndarray, horizon: float) -> np.ndarray:
    """Times up to a part of a record; those after it follow so closely that they cost nothing."""
    last = max(1, int(np.searchsorted(ts, _end(ts, horizon), side="right")) - 1)
    return _lengthened(ts[: last + 1], len(ts))


def _channels(mechanism: Mechanism, records: Sequence[Record]) -> tuple[Channel | Quantity, ...]:
    found: dict[str, Any] = {}
    problems = []
    for record in records:
        mine: dict[str, Any] = {}
        for text in record.values:
            try:
                channel = _channel(mechanism, text)
            except ValueError as problem:
                problems.append(f"{record.where}{problem}")
                continue
            name = channel.name
            if name in mine:
                problems.append(f"{record.where}{quoted(str(text))} and {quoted(str(mine[name]))} are the same channel")
            mine[name] = text
            found.setdefault(name, channel)
    if problems:
        raise IdentificationError(problems)
    return tuple(found.values())


def _channel(mechanism: Mechanism, given: Any) -> Channel | Quantity:
    return given if isinstance(given, Quantity) else channel_of(mechanism, given)


def _conditions(mechanism: Mechanism, records: Sequence[Record]) -> dict[str, np.ndarray]:
    """Values of all records for everything that differs between them."""
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
