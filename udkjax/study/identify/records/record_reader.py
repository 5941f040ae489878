"""Reading of measurements from any kind of table into records; every mistake is reported with its file, row and column."""

import math
import os
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import TypeAlias, TypeVar, cast

import jax
import numpy as np

from udkjax.annotations import Numbers
from udkjax.positions.assembling.channels import Channel, Quantity, channel_of
from udkjax.scene.numbers.quantities import conversion_factor
from udkjax.study.identify.records.records import ByChannel, ChannelKey, IdentificationError, Noise, Record, key_of
from udkjax.study.identify.records.tables import (
    EFFORTS,
    HOLDS,
    NOISE_SUFFIX,
    RECORD_HEADING,
    TIME_HEADINGS,
    Table,
    TableData,
    read_tables,
)
from udkjax.study.quantities import StudyModel
from udkjax.wording import abbreviate, quote, suggestion

Data: TypeAlias = "Record | TableData | Sequence[Record | TableData]"
MOST_SHOWN = 3  # number of listed mistakes of a kind per column; the others are counted
T = TypeVar("T")


def records_of(
    mechanism: StudyModel, data: Data, noise: Noise = None, ignore: Sequence[str] = (), quantities: Sequence[Quantity] = ()
) -> tuple[Record, ...]:
    """Read data into records in SI units, with the canonical names of channels.

    A CSV file has one line of headings, after optional lines that begin with "#". In all tables

    * a heading may name units in brackets, `time [ms]`, `body.crank.angle [deg]` (in xarray: the attribute `units`);
    * an empty cell, or one that is not a number ("nan"), is a gap;
    * `CHANNEL.noise` is the standard deviation of a channel, in the channel's units unless the heading names others;
    * `record` is the name of the record that a row belongs to (in xarray: a dimension);
    * `effort.NAME`, in files of runs, is the channel `driver.NAME.load`.

    Args:
        mechanism: the mechanism with the bodies, joints and drivers that headings name.
        data: a `Record`; a mapping of "time" and channels to numbers (T,); a pandas DataFrame with such columns; an xarray
            Dataset with such variables along "time", or with q, v and effort as written by `Solution.to_xarray`; the path of a
            .csv or .nc file; or a list of these.
        noise: standard deviation, in SI units, of channels without noise in the data: of all channels, or by channel.
        ignore: columns that are not read; any other column that is not a channel is a mistake.
        quantities: user-defined channels that headings may name; in Python they may also be used instead of names.

    Raises:
        IdentificationError: lists every mistake with its file, line and column.
    """
    reader = _DataReader(mechanism, tuple(ignore), _quantities_by_name(quantities))
    found = [reader.with_usual_names(record) for record in reader.read(data, "data")]
    if not found and not reader.problems:
        reader.problems.append("data: contains no records")
    measured = {channel for record in found for channel in record.values}
    given: dict[ChannelKey, Numbers | None] = dict.fromkeys(measured)
    if isinstance(noise, Mapping):
        given = reader.by_channel(noise, "noise")
    elif noise is not None:
        given = dict.fromkeys(measured, noise)
    reader.problems += [f"noise: {quote(str(c))} is not measured in any record" for c in given if c not in measured]
    records = [reader.with_noise(record, given) for record in found]
    if reader.problems:
        raise IdentificationError(reader.problems)
    return tuple(records)


# --- one table


class _TableReader:
    """A reader of the records of one table.

    `channel` finds a channel by its name, or raises ValueError. Mistakes are added to `problems`.
    """

    def __init__(self, table: Table, channel: Callable[[str], Channel | Quantity], ignore: Sequence[str], problems: list[str]):
        self.table, self.channel, self.problems = table, channel, problems
        self.columns = {name: column for name, column in table.columns.items() if name not in ignore}
        self.ignore = ignore

    def records(self) -> Iterator[Record]:
        """Iterate over the records of the table; there are none once a mistake was found."""
        before = len(self.problems)
        time = next((name for name in TIME_HEADINGS if name in self.columns), None)
        if time is None:
            if self.table.columns:
                near = suggestion(TIME_HEADINGS[0], self.columns)
                self.problems.append(f"{self.table.source}: there is no column {quote(TIME_HEADINGS[0])}{near}")
            return
        times = self.numbers(time, "s")
        numbers = len(self.problems) == before
        values, noise = self.channels([name for name in self.columns if name not in (time, RECORD_HEADING)])
        for label, places in self.rows_by_record():
            if numbers:
                self.check_times(time, times, places)
            if len(self.problems) == before:
                yield from self.record(label, places, times, values, noise)

    def channels(self, headings: Sequence[str]) -> tuple[dict[ChannelKey, np.ndarray], dict[ChannelKey, np.ndarray]]:
        """Return the values of each channel, and the standard deviations of channels with a column for these."""
        found: dict[ChannelKey, tuple[str, str]] = {}  # headings and units
        for heading in headings:
            of = heading.removesuffix(NOISE_SUFFIX)
            if of != heading:
                if of not in (*headings, *self.ignore):
                    self.add(heading, f"there is no column {quote(of)}")
                continue
            load = _load_of_effort(heading)
            if load in self.columns or heading.startswith(f"{HOLDS}."):
                continue  # a run's file may have both channel and effort, and constraints that hold
            try:
                channel = self.channel(load or heading)
            except ValueError as error:
                self.add(heading, f"{error} (list columns that are not to be read in `ignore`)")
                continue
            if (key := key_of(channel)) in found:
                self.add(heading, f"is the same channel as {quote(found[key][0])}")
            else:
                found[key] = heading, channel.units
        values = {key: self.numbers(heading, units) for key, (heading, units) in found.items()}
        with_noise = {key: (h, units) for key, (h, units) in found.items() if h + NOISE_SUFFIX in self.columns}
        return values, {
            key: self.numbers(h + NOISE_SUFFIX, units, self.columns[h].units) for key, (h, units) in with_noise.items()
        }

    def numbers(self, heading: str, wanted: str, units: str | None = None) -> np.ndarray:
        """Return the numbers of a column in the units `wanted`; gaps are NaN.

        They are converted from the units in the heading, or else from `units`; without either, they are not converted.
        """
        cells, own = self.columns[heading]
        if _load_of_effort(heading) and own and " or " in own:
            own = None  # the unit of several drivers; each is an SI unit
        scale, count, units = 1.0, len(self.table.rows), own or units
        try:
            scale = conversion_factor(units, wanted) if units else 1.0
        except ValueError as error:
            self.add(heading, str(error))
        kind, shape = (cells.dtype.kind, cells.shape) if isinstance(cells, np.ndarray) else ("O", (len(cells),))
        if kind in "mM" or shape != (count,):
            found = f"type {np.asarray(cells).dtype}" if kind in "mM" else f"shape {shape}"
            self.add(heading, f"must be {count} numbers, but is of {found}")
            return np.full(count, np.nan)
        found = np.asarray(cells, float) if kind in "iuf" else np.array([_number(cell) for cell in cells], float)
        self.add_each(heading, np.flatnonzero(np.isinf(found)), lambda k: f"must be a number, not {abbreviate(cells[k])}")
        return scale * found

    def rows_by_record(self) -> list[tuple[str, np.ndarray]]:
        """Return the names of the records, each with the indices of its rows."""
        if RECORD_HEADING not in self.columns:
            return [(self.table.name, np.arange(len(self.table.rows)))]
        labels = [_label(cell) for cell in self.columns[RECORD_HEADING].values]
        self.add_each(RECORD_HEADING, [k for k, label in enumerate(labels) if not label], lambda k: "is empty")
        return [(label, np.flatnonzero(np.array(labels) == label)) for label in dict.fromkeys(labels)]

    def check_times(self, time: str, times: np.ndarray, places: np.ndarray) -> None:
        """Report times that are missing or do not increase."""
        missing = np.isnan(times[places])
        self.add_each(time, places[missing], lambda k: "is empty")
        present = places[~missing]
        late = np.flatnonzero(np.diff(times[present]) <= 0) + 1
        before = dict(zip(present[1:], times[present[:-1]], strict=True)) if len(present) else {}
        self.add_each(time, present[late], lambda k: f"{times[k]:g} s does not exceed the previous time, {before[k]:g} s")

    def record(
        self,
        label: str,
        places: np.ndarray,
        times: np.ndarray,
        values: dict[ChannelKey, np.ndarray],
        noise: dict[ChannelKey, np.ndarray],
    ) -> Iterator[Record]:
        """Yield the record of the rows `places`, with the channels that were measured in them, if it is valid."""
        measured = [name for name, x in values.items() if not np.isnan(x[places]).all()]
        if self.table.padded and measured:
            # Rows at the ends without any value belong to longer records.
            is_empty = np.isnan(np.stack([values[name][places] for name in measured])).all(0)
            filled = np.flatnonzero(~is_empty)
            places = places[filled[0] : filled[-1] + 1]
        of_rows, sigma = ({name: x[name][places] for name in measured if name in x} for x in (values, noise))
        try:
            yield Record(times[places], of_rows, sigma, name=label)
        except IdentificationError as error:
            self.problems += [f"{self.table.source}: {problem}" for problem in error.problems]

    def add(self, heading: str, problem: str) -> None:
        """Report a mistake in a column."""
        self.problems.append(f"{self.table.source}, column {quote(heading)}: {problem}")

    def add_each(self, heading: str, rows: Sequence[int] | np.ndarray, problem: Callable[[int], str]) -> None:
        """Report the same mistake in several rows: one message for each of the first rows, and one that counts the others."""
        for k in rows[:MOST_SHOWN]:
            self.problems.append(f"{self.table.source}, {self.table.rows[k]}, column {quote(heading)}: {problem(k)}")
        if len(rows) > MOST_SHOWN:
            self.add(heading, f"the same in {len(rows) - MOST_SHOWN} more rows")


def _load_of_effort(heading: str) -> str:
    """Return the channel that is the effort of a driver, named as in the files of runs ("effort.NAME"); "" for other headings."""
    section, _, driver = heading.partition(".")
    return f"driver.{driver}.load" if section == EFFORTS and driver else ""


def _number(cell: str | float | None) -> float:
    """Return the number in a cell: NaN if it is empty, infinite if it is not a number."""
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return math.nan
    try:
        return math.inf if isinstance(cell, bool | np.bool_) else float(cell)
    except (TypeError, ValueError):
        return math.inf


def _label(cell: str | float | None) -> str:
    """Return the name of a record in a cell; "" if the cell is empty."""
    if isinstance(cell, str):
        return cell.strip()
    return "" if cell is None or cell != cell else f"{cell:g}"


# --- any kind of data


def _quantities_by_name(given: Iterable[Hashable]) -> dict[str, Quantity]:
    """Return the user-defined channels among `given`, by name."""
    return {quantity.name: quantity for quantity in given if isinstance(quantity, Quantity)}


class _DataReader:
    """A reader of any kind of data for a mechanism, which collects every mistake in `problems`."""

    def __init__(self, mechanism: StudyModel, ignore: tuple[str, ...], quantities: dict[str, Quantity]):
        self.mechanism, self.ignore, self.quantities = mechanism, ignore, quantities
        self.problems: list[str] = []

    def read(self, data: Data, source: str) -> Iterator[Record]:
        """Yield the records in any kind of data, nested lists included; `source` names the data in messages."""
        if isinstance(data, Record):
            yield data
        elif isinstance(data, list | tuple):
            for k, item in enumerate(data):
                yield from self.read(item, f"{source}[{k}]")
        else:
            if isinstance(data, Iterable) and not isinstance(data, str | os.PathLike | np.ndarray | jax.Array):
                # Its columns may be quantities.
                self.quantities |= _quantities_by_name(cast("Iterable[Hashable]", data))
            for table in read_tables(cast(TableData, data), self.mechanism.body_names, source, self.problems, self.ignore):
                yield from _TableReader(table, self.channel, self.ignore, self.problems).records()

    def channel(self, given: ChannelKey) -> Channel | Quantity:
        """Return the channel with the name `given`, or `given` itself if it is a user-defined channel.

        Raises:
            ValueError: there is no such channel.
        """
        quantity = given if isinstance(given, Quantity) else self.quantities.get(str(given))
        return channel_of(self.mechanism, str(given)) if quantity is None else quantity

    def by_channel(self, given: ByChannel[T], place: str) -> dict[ChannelKey, T]:
        """Return the values by the canonical names of the channels; user-defined channels are keys themselves.

        Mistakes are reported at `place`.
        """
        found: dict[ChannelKey, T] = {}
        for text, value in given.items():
            try:
                key = key_of(self.channel(text))
            except ValueError as error:
                self.problems.append(f"{place}, {quote(str(text))}: {error}")
                continue
            if key in found:
                self.problems.append(f"{place}, {quote(str(text))}: {quote(str(key))} is given twice")
            found[key] = value
        return found

    def with_usual_names(self, record: Record) -> Record:
        """Return the record with the canonical names of its channels."""
        prefix = f"record {quote(record.name)}" if record.name else "record"
        values = self.by_channel(record.values, prefix)
        if list(values) == list(record.values) or len(values) != len(record.values):
            return record
        noise = dict(zip(values, record.noise.values(), strict=True))
        return record.changed(values=values, noise=noise)

    def with_noise(self, record: Record, given: dict[ChannelKey, Numbers | None]) -> Record:
        """Return the record with the `given` standard deviations for channels that have none."""
        if all(own is not None or given.get(channel) is None for channel, own in record.noise.items()):
            return record
        noise = {channel: given.get(channel) if own is None else own for channel, own in record.noise.items()}
        try:
            return record.changed(noise=noise)
        except IdentificationError as error:
            self.problems += error.problems
            return record
