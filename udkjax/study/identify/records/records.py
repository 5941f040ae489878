"""Records: times, measured values, and the initial state of the motion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from jaxtyping import Float
from typing_extensions import TypeAliasType

from udkjax.annotations import Numbers
from udkjax.argument_types import ArgumentRequirement
from udkjax.extras import OptionalImport
from udkjax.positions.assembling.assembly import State
from udkjax.positions.assembling.channels import Channel, Quantity
from udkjax.requirements import GivenArguments, array, describe, require_number
from udkjax.scene.elements.held import Held
from udkjax.scene.tables.checks import Mistakes
from udkjax.wording import quote

if TYPE_CHECKING:
    import xarray

# Spacing of times that pad a record, relative to its length; so short that their steps cost almost nothing.
PADDING_FRACTION = 1e-9
PADDING_ROUNDINGS = 1000.0  # least spacing relative to the rounding of late times; runs need a hundred
Estimated = Literal["nothing", "position", "velocity", "both"]
ChannelKey: TypeAlias = str | Quantity  # the name of a channel, or a user-defined quantity
T = TypeVar("T")
ByChannel: TypeAlias = Mapping[str, T] | Mapping[Quantity, T] | Mapping[ChannelKey, T]


def _require_noise(name: str, value: Any, given: GivenArguments) -> None:
    """Require a number or an array for all channels, or a mapping of channels to these; None stands for unknown noise."""
    by_channel = {f"{name}[{str(key)!r}]": x for key, x in value.items()} if isinstance(value, Mapping) else {name: value}
    for place, numbers in by_channel.items():
        if numbers is not None:
            array(place, numbers)


# standard deviations, by channel or one for all
Noise = TypeAliasType(
    "Noise",
    Annotated[
        ByChannel[Numbers] | ByChannel[Numbers | None] | float | None, ArgumentRequirement("standard deviations", _require_noise)
    ],
)


class IdentificationError(Mistakes):
    """Data, parameters or settings are inconsistent with the mechanism or each other.

    Attributes:
        problems: every mistake, each with its place.
        source: the name of the file, if any.
    """

    subject = "identification"


@dataclass(frozen=True, eq=False)
class Start:
    """The initial state of a record: a guess, and the parts of the state to estimate.

    Attributes:
        state: the guess, closed before use; by default that of the scene.
        estimate: "nothing", "position", "velocity" or "both". The unknowns are one coordinate (position) or rate (velocity) for
            each degree of freedom.
        name: starts with the same name are one state, estimated from all records with this start.
    """

    state: State | None = None
    estimate: Estimated = "nothing"
    name: str = ""

    def __post_init__(self):
        if not (self.state is None or (hasattr(self.state, "q") and hasattr(self.state, "v"))):
            raise IdentificationError([f"initial_state: must be a State or a Start, {describe(self.state)}"])
        if not isinstance(self.estimate, str) or self.estimate not in get_args(Estimated):
            raise IdentificationError(
                [f"initial_state: estimate must be one of {', '.join(get_args(Estimated))}, {describe(self.estimate)}"]
            )


class Record:
    """Values measured at some times, and the initial state of the motion.

    Args:
        times: increasing (T,), s.
        values: arrays (T,) by channel, NaN where nothing was measured. Channels are named as in
            `udkjax.positions.assembling.channels` ("body.crank.angle"), or are user-defined `Quantity`s.
        noise: standard deviation of all channels, or a mapping by channel, each a number or (T,); by default estimated from the
            residuals of the fit.
        initial_state: the `State` or `Start` at t0; by default that of the scene.
        t0: start of the motion (s); by default the first time.
        conditions: values of parameters, by name, in this record only, such as a payload or a driver's amplitude; or a `Held`
            with the samples of a measured torque, whose `dt` and `t0` are those of all records.
        name: name in messages.

    Raises:
        IdentificationError: lists every mistake.
    """

    def __init__(
        self,
        times: Numbers | Sequence[float],
        values: ByChannel[Numbers],
        noise: Noise = None,
        initial_state: Start | State | None = None,
        t0: float | None = None,
        conditions: Mapping[str, Numbers | Held] | None = None,
        name: str = "",
    ):
        problems = list(_mistakes_of_kind(values, t0, conditions))
        self.name = name
        if problems:
            raise IdentificationError([self.place + problem for problem in problems])
        self.times: Float[np.ndarray, "T"] = _numbers("time", times, None, problems)
        self._check_times(t0, problems)
        self.values: dict[ChannelKey, np.ndarray] = {
            key_of(c): _numbers(str(c), v, self.times.shape, problems) for c, v in values.items()
        }
        self.t0 = float(self.times[0]) if t0 is None and self.times.size else float(t0 or 0.0)
        self.noise = self._noise(noise, problems)
        self.start = initial_state if isinstance(initial_state, Start) else Start(initial_state)
        self.conditions = {
            name: value if isinstance(value, Held) else np.asarray(value, float) for name, value in (conditions or {}).items()
        }
        if not self.values:
            problems.append("there is no channel: nothing was measured")
        for channel, value in self.values.items():
            if not np.isfinite(value).any() and value.size:
                problems.append(f"{quote(str(channel))}: contains no number; leave the channel out")
            elif np.isinf(value).any():
                problems.append(
                    f"{quote(str(channel))}: entry {int(np.flatnonzero(np.isinf(value))[0])} is infinite; write a gap as nan"
                )
        if problems:
            raise IdentificationError([self.place + problem for problem in problems])

    @property
    def place(self) -> str:
        """The beginning of messages about this record."""
        return f"record {quote(self.name)}: " if self.name else ""

    def changed(self, **changes: Any) -> "Record":
        """Return the same record with other `values`, `noise` or `initial_state`."""
        present = {"values": self.values, "noise": self.noise, "initial_state": self.start, "t0": self.t0}
        return Record(self.times, **present | {"conditions": self.conditions, "name": self.name} | changes)

    def __repr__(self) -> str:
        return f"Record({len(self.times)} times, {', '.join(map(str, self.values))})"

    def _check_times(self, t0: float | None, problems: list[str]) -> None:
        if self.times.ndim != 1 or not self.times.size:
            problems.append(f"time: must be a vector of at least one time, but is of shape {self.times.shape}")
            self.times = np.zeros(0)
        elif not np.isfinite(self.times).all():
            problems.append(f"time: entry {int(np.flatnonzero(~np.isfinite(self.times))[0])} is not a finite number")
        elif not (steps := np.diff(self.times) > 0).all():
            problems.append(f"time: must increase, but entry {int(np.argmin(steps)) + 1} does not exceed the previous one")
        elif t0 is not None and not t0 <= self.times[0]:
            problems.append(f"t0: the motion begins at {t0} s, after the first measurement at {self.times[0]} s")

    def _noise(self, given: Noise, problems: list[str]) -> dict[ChannelKey, Float[np.ndarray, "T"] | None]:
        by_channel = {key_of(c): s for c, s in given.items()} if isinstance(given, Mapping) else dict.fromkeys(self.values, given)
        found: dict[ChannelKey, np.ndarray | None] = dict.fromkeys(self.values)
        for channel, sigma in by_channel.items():
            if channel not in self.values:
                problems.append(f"noise: {quote(str(channel))} is not among the channels")
            elif sigma is not None:
                try:
                    sigma = np.asarray(array(f"noise of {quote(str(channel))}:", sigma), float)
                except ValueError as error:
                    problems.append(str(error))
                    continue
                sigma = sigma if sigma.ndim else np.full(self.times.shape, sigma)
                shapes = self.times.shape, sigma.shape
                used = sigma[np.isfinite(self.values[channel])] if sigma.shape == self.times.shape else sigma
                if sigma.shape != self.times.shape:
                    problems.append(f"noise of {quote(str(channel))}: must be a number or of shape {shapes[0]}, not {shapes[1]}")
                elif not (np.isfinite(used).all() and (used > 0).all()):
                    problems.append(f"noise of {quote(str(channel))}: a standard deviation must be a finite number > 0")
                found[channel] = sigma
        return found


def _mistakes_of_kind(values: object, t0: object, conditions: object) -> Iterator[str]:
    """Iterate over the mistakes in the types of the arguments of a record."""
    if not isinstance(values, Mapping):
        yield f"values: must map channels to numbers, {describe(values)}"
    try:
        if t0 is not None:
            require_number("t0:", t0)
    except ValueError as error:
        yield str(error)
    if conditions is not None and not isinstance(conditions, Mapping):
        yield f"conditions: must map names of parameters to values, {describe(conditions)}"
        return
    for name, value in (conditions or {}).items():
        try:
            if not isinstance(value, Held):
                array(f"conditions: {name}", value)
        except ValueError as error:
            yield str(error)


def labels(records: Sequence[Record]) -> list[str]:
    """Return the names of records, numbered if missing or not unique."""
    names = [record.name for record in records]
    return [name if name and names.count(name) == 1 else f"{name or 'record'} {k + 1}" for k, name in enumerate(names)]


def output_times(record: Record) -> tuple[Float[np.ndarray, "T"], int]:
    """Return the times of a record, beginning with that of its initial state, and the index of the first measurement."""
    return (record.times, 0) if record.t0 == record.times[0] else (np.concatenate([[record.t0], record.times]), 1)


def pad_times(ts: Float[np.ndarray, "T"], length: int) -> Float[np.ndarray, "length"]:
    """Return the times, padded to a length with slightly later times."""
    span = max(ts[-1] - ts[0], PADDING_FRACTION)
    spacing = max(PADDING_FRACTION * span, PADDING_ROUNDINGS * float(np.spacing(abs(ts[-1]))))
    return np.concatenate([ts, ts[-1] + spacing * np.arange(1, length - len(ts) + 1)])


def tabulate(records: Sequence[Record], keys: Sequence[ChannelKey]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return records as tables of equal length: times (records, T), values and noise (records, T, C), NaN where unknown.

    C is the number of `keys`, the channels. Shorter records are padded.
    """
    times = [output_times(record) for record in records]
    length = max(2, *(len(ts) for ts, _ in times))
    y, sigma = np.full((2, len(records), length, len(keys)), np.nan)
    for k, (record, (ts, first)) in enumerate(zip(records, times, strict=True)):
        for key, values in record.values.items():
            entry = k, slice(first, len(ts)), keys.index(key)
            y[entry] = values
            if (noise := record.noise[key]) is not None:
                sigma[entry] = noise
    return np.stack([pad_times(ts, length) for ts, _ in times]), y, sigma


def label_prefixes(records: Sequence[Record]) -> list[str]:
    """Return, for each record, the prefix of channel names in messages: its name if there are several records."""
    return [f"{label}, " for label in labels(records)] if len(records) > 1 else [""]


def dataset_of_fit(
    records: Sequence[Record],
    channels: Sequence[str],
    predicted: Sequence[Mapping[str, np.ndarray]],
    residuals: Sequence[Mapping[str, np.ndarray]],
    noise: Sequence[Mapping[str, np.ndarray]],
) -> "xarray.Dataset":
    """Return measurements and predictions of a fit along record, sample and channel; NaN where nothing was measured."""
    with OptionalImport():
        import xarray
    shape = len(records), max(len(record.times) for record in records), len(channels)
    time, tables = np.full(shape[:2], np.nan), np.full((4, *shape), np.nan)
    for k, record in enumerate(records):
        count = len(record.times)
        time[k, :count] = record.times
        for channel, shown in predicted[k].items():
            residual = residuals[k][channel]
            tables[:, k, :count, channels.index(channel)] = shown + residual, shown, residual, noise[k][channel]
    dims = "record", "sample", "channel"
    data = {name: (dims, table) for name, table in zip(("measured", "predicted", "residual", "noise"), tables, strict=True)}
    return xarray.Dataset(data, {"record": labels(records), "time": (dims[:2], time, {"units": "s"}), "channel": list(channels)})


def key_of(channel: ChannelKey | Channel) -> ChannelKey:
    """Return the key of a channel in a record: its name, or the user-defined quantity itself."""
    return channel if isinstance(channel, Quantity) else str(getattr(channel, "name", channel))


def _numbers(name: str, given: Numbers | Sequence[float], shape: tuple[int, ...] | None, problems: list[str]) -> np.ndarray:
    try:
        array = np.asarray(given, float)
    except (TypeError, ValueError):
        problems.append(f"{quote(name)}: must be numbers, not {given!r:.40}")
        return np.zeros(shape or 0)
    if shape is not None and array.shape != shape:
        problems.append(f"{quote(name)}: must have a value for each of the {shape[0]} times, but is of shape {array.shape}")
        return np.zeros(shape)
    return array
