"""Reads measurements into records, whatever they come as: every mistake is told, with its place."""

import csv
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from udkjax.scene.checks import quoted
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.channels import Channel, Quantity, channel_of
from udkjax.study.identify.columns import Columns, key_of
from udkjax.study.identify.datasets import of_dataset
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.records import Record
from udkjax.study.identify.tables import Table, of_columns, of_csv, of_frame


def records_of(
    mechanism: Mechanism,
    data: Any,
    noise: Mapping[Any, Any] | float | None = None,
    ignore: Sequence[str] = (),
    quantities: Sequence[Quantity] = (),
) -> tuple[Record, ...]:
    """Return the records that `data` holds, in SI units, their channels named as `channel_of` names them.

    `data` is a `Record`; a mapping of "time" and channels to numbers (T,); a pandas DataFrame with such columns; an xarray
    Dataset with such variables along "time", or with q and v as `Solution.to_xarray` has them; the path of a .csv or a .nc file;
    or a list of such. A CSV file has one line of headings, after lines that begin with "#" if there are any. Everywhere

    * a heading may tell units in brackets, `time [ms]`, `body.crank.angle [deg]` (in xarray: the attribute `units`);
    * an empty cell, or one that is not a number ("nan"), is a gap;
    * `CHANNEL.noise` holds the standard deviation of a channel, in the channel's units if it tells none;
    * `record` says which record a row belongs to (in xarray: a dimension).

    `noise` is the standard deviation, in SI units, of what has none in the data: of all channels, or by channel. Columns in
    `ignore` are left out; any other that is no channel is a mistake. `quantities` are the user's own that headings may name;
    in Python they may themselves stand in place of names.

    Raises `IdentificationError`, which lists every mistake.
    """
    reader = _Reader(mechanism, tuple(ignore), _quantities(quantities))
    found = [reader.named(record) for record in reader.read(data, "data")]
    if not found and not reader.problems:
        reader.problems.append("data: there are no records")
    given = reader.by_channel(noise, "noise") if isinstance(noise, Mapping) else noise
    if isinstance(given, Mapping):
        measured = {channel for record in found for channel in record.values}
        reader.problems += [
            f"noise: {quoted(str(channel))} is measured in no record" for channel in given if channel not in measured
        ]
    records = [reader.with_noise(record, given) for record in found]
    if reader.problems:
        raise IdentificationError(reader.problems)
    return tuple(records)


class _Reader:
    """Reads data for a mechanism. What is not as it should be becomes one of `problems`."""

    def __init__(self, mechanism: Mechanism, ignore: tuple[str, ...], quantities: dict[str, Quantity]):
        self.mechanism, self.ignore, self.quantities = mechanism, ignore, quantities
        self.problems: list[str] = []

    def read(self, data: Any, source: str) -> Iterator[Record]:
        """Iterate over the records in anything that holds some."""
        if isinstance(data, Record):
            yield data
        elif isinstance(data, list | tuple):
            for k, item in enumerate(data):
                yield from self.read(item, f"{source}[{k}]")
        else:
            for table in self.tables(data, source):
                yield from Columns(table, self.channel, self.ignore, self.problems).records()

    def tables(self, data: Any, source: str) -> Iterator[Table]:
        """Iterate over the tables of one file or object."""
        bodies = self.mechanism.body_names
        if isinstance(data, str | os.PathLike):
            yield from self.file(Path(data))
        elif hasattr(data, "data_vars"):
            yield from of_dataset(data, bodies, source, self.problems)
        elif hasattr(data, "columns") and hasattr(data, "index"):
            self.quantities |= _quantities(data.columns)
            yield of_frame(data, source, self.problems)
        elif isinstance(data, Mapping):
            self.quantities |= _quantities(data)
            yield of_columns(source, [(str(key), value) for key, value in data.items()], self.problems)
        else:
            what = "a Record, a mapping, a pandas DataFrame, an xarray Dataset, the path of a .csv or .nc file, or a list of such"
            self.problems.append(f"{source}: must be {what}, is {type(data).__name__}")

    def file(self, path: Path) -> Iterator[Table]:
        """Iterate over the tables of a file."""
        try:
            if path.suffix.lower() == ".csv":
                yield from of_csv(path, self.problems)
            elif path.suffix.lower() == ".nc":
                import xarray

                data = xarray.load_dataset(path, decode_times=False)  # else xarray makes durations of seconds
                yield from of_dataset(data, self.mechanism.body_names, str(path), self.problems, path.stem)
            else:
                self.problems.append(f"{path}: must be a .csv or a .nc file")
        except (OSError, ValueError, csv.Error) as error:
            self.problems.append(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})")

    def channel(self, given: Any) -> Channel | Quantity:
        """The channel of a name, or the user's own. Raises ValueError."""
        own = given if isinstance(given, Quantity) else self.quantities.get(str(given))
        return channel_of(self.mechanism, str(given)) if own is None else own

    def by_channel(self, given: Mapping[Any, Any], place: str) -> dict[Any, Any]:
        """The same under the usual names of the channels; those of the user go by themselves."""
        found: dict[Any, Any] = {}
        for text, value in given.items():
            try:
                key = key_of(self.channel(text))
            except ValueError as error:
                self.problems.append(f"{place}, {quoted(str(text))}: {error}")
                continue
            if key in found:
                self.problems.append(f"{place}, {quoted(str(text))}: {quoted(str(key))} is there twice")
            found[key] = value
        return found

    def named(self, record: Record) -> Record:
        """A record with the usual names of its channels."""
        place = f"record {quoted(record.name)}" if record.name else "record"
        values = self.by_channel(record.values, place)
        if list(values) == list(record.values) or len(values) != len(record.values):
            return record
        noise = dict(zip(values, record.noise.values(), strict=True))
        return Record(record.times, values, noise, record.start, record.t0, record.conditions, record.name)

    def with_noise(self, record: Record, given: Mapping[Any, Any] | float | None) -> Record:
        """A record with a standard deviation, where one is given, of those channels whose own is not known."""
        of = given if isinstance(given, Mapping) else dict.fromkeys(record.values, given)
        if all(own is not None or of.get(channel) is None for channel, own in record.noise.items()):
            return record
        noise = {channel: of.get(channel) if own is None else own for channel, own in record.noise.items()}
        try:
            return Record(record.times, record.values, noise, record.start, record.t0, record.conditions, record.name)
        except IdentificationError as error:
            self.problems += error.problems
            return record


def _quantities(given: Iterable[Any]) -> dict[str, Quantity]:
    return {quantity.name: quantity for quantity in given if isinstance(quantity, Quantity)}
