"""Reads measurements into records, whatever they come as: every mistake is named with its file, row and column."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from udkjax.scene.checks import abbreviate, quote, suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.units import conversion_factor
from udkjax.study.channels import Channel, Quantity, channel_of
from udkjax.study.identify.records import ByChannel, IdentificationError, Key, Noise, Record, key_of
from udkjax.study.identify.tables import NOISE, RECORD, TIME, Column, Table, TableData, quantities_by_name, read_tables

Data: TypeAlias = "Record | TableData | Sequence[Record | TableData]"
MOST_SHOWN = 3  # mistakes of one kind in a column; the others are counted
T = TypeVar("T")


def records_of(
    mechanism: Mechanism, data: Data, noise: Noise = None, ignore: Sequence[str] = (), quantities: Sequence[Quantity] = ()
) -> tuple[Record, ...]:
    """Read data into records, in SI units, their channels named as `channel_of` names them.

    A CSV file has one line of headings, after lines that begin with "#" if there are any. Everywhere

    * a heading may name units in brackets, `time [ms]`, `body.crank.angle [deg]` (in xarray: the attribute `units`);
    * an empty cell, or one that is not a number ("nan"), is a gap;
    * `CHANNEL.noise` holds the standard deviation of a channel, in the channel's units if it names none;
    * `record` says which record a row belongs to (in xarray: a dimension).

    Args:
        mechanism: the mechanism whose bodies, joints and drivers headings name.
        data: a `Record`; a mapping of "time" and channels to numbers (T,); a pandas DataFrame with such columns; an xarray
            Dataset with such variables along "time", or with q and v as `Solution.to_xarray` has them; the path of a .csv or a
            .nc file; or a list of such.
        noise: standard deviation, in SI units, of what has none in the data: of all channels, or by channel.
        ignore: columns that are not read; any other that is no channel is a mistake.
        quantities: the user's own channels that headings may name; in Python they may themselves stand in place of names.

    Raises:
        IdentificationError: with every mistake, each with its file, line and column.
    """
    reader = _DataReader(mechanism, tuple(ignore), quantities_by_name(quantities))
    found = [reader.with_usual_names(record) for record in reader.read(data, "data")]
    if not found and not reader.problems:
        reader.problems.append("data: there are no records")
    measured = {channel for record in found for channel in record.values}
    given: dict[Key, ArrayLike | None] = dict.fromkeys(measured)
    if isinstance(noise, Mapping):
        given = reader.by_channel(noise, "noise")
    elif noise is not None:
        given = dict.fromkeys(measured, noise)
    reader.problems += [f"noise: {quote(str(c))} is measured in no record" for c in given if c not in measured]
    records = [reader.with_noise(record, given) for record in found]
    if reader.problems:
        raise IdentificationError(reader.problems)
    return tuple(records)


# --- one table


class _ChannelColumns(NamedTuple):
    """A channel, and the columns of its values and of their standard deviation."""

    heading: str
    channel: Channel | Quantity
    values: Column
    noise: Column | None


class _TableReader:
    """Reads the records of one table. `channel` finds channels by name, or raises ValueError; mistakes go to `problems`."""

    def __init__(self, table: Table, channel: Callable[[str], Channel | Quantity], ignore: Sequence[str], problems: list[str]):
        self.table, self.channel, self.problems = table, channel, problems
        self.columns = {name: column for name, column in table.columns.items() if name not in ignore}
        self.ignore = tuple(ignore)

    def records(self) -> Iterator[Record]:
        """Iterate over the records."""
        before = len(self.problems)
        time = next((name for name in TIME if name in self.columns), None)
        if time is None:
            if self.table.columns:
                near = suggestion(TIME[0], self.columns)
                self.problems.append(f"{self.table.source}: there is no column {quote(TIME[0])}{near}")
            return
        times = self.numbers(time, self.columns[time], "s")
        numbers = len(self.problems) == before
        found = self.channels([name for name in self.columns if name not in (time, RECORD)])
        values = {key_of(m.channel): self.numbers(m.heading, m.values, m.channel.units) for m in found}
        noise = {key_of(m.channel): self.numbers(m.heading + NOISE, m.noise, m.channel.units) for m in found if m.noise}
        for label, places in self.rows_by_record():
            if numbers:
                self.check_times(time, times, places)
            if len(self.problems) == before:
                yield from self.record(label, places, times, values, noise)

    def channels(self, headings: Sequence[str]) -> list[_ChannelColumns]:
        """Return the channels, with their columns."""
        found: dict[str, _ChannelColumns] = {}
        for heading in headings:
            of = heading.removesuffix(NOISE)
            if of != heading:
                if of not in (*headings, *self.ignore):
                    self.add(heading, f"there is no column {quote(of)}")
                continue
            try:
                channel = self.channel(heading)
            except ValueError as error:
                self.add(heading, f"{error} (what is not to be read must be listed in `ignore`)")
                continue
            if channel.name in found:
                self.add(heading, f"is the same channel as {quote(found[channel.name].heading)}")
            values, noise = self.columns[heading], self.columns.get(heading + NOISE)
            if noise is not None and noise.units is None:
                noise = noise._replace(units=values.units)
            found[channel.name] = _ChannelColumns(heading, channel, values, noise)
        return list(found.values())

    def numbers(self, heading: str, column: Column, wanted: str) -> np.ndarray:
        """Return the numbers of a column in SI units; gaps are not a number."""
        scale, cells, count = 1.0, column.values, len(self.table.rows)
        try:
            scale = conversion_factor(column.units, wanted) if column.units else 1.0
        except ValueError as error:
            self.add(heading, str(error))
        kind, shape = (cells.dtype.kind, cells.shape) if isinstance(cells, np.ndarray) else ("O", (len(cells),))
        if kind in "mM" or shape != (count,):
            self.add(
                heading,
                f"must be {count} numbers, is of {f'type {np.asarray(cells).dtype}' if kind in 'mM' else f'shape {shape}'}",
            )
            return np.full(count, np.nan)
        found = np.asarray(cells, float) if kind in "iuf" else np.array([_number(cell) for cell in cells], float)
        wrong = np.flatnonzero(np.isinf(found))
        self.add_each(heading, wrong, lambda k: f"must be a number, is {abbreviate(cells[k])}")
        return scale * found

    def rows_by_record(self) -> list[tuple[str, np.ndarray]]:
        """Return the records by name, and which rows they have."""
        if RECORD not in self.columns:
            return [(self.table.name, np.arange(len(self.table.rows)))]
        labels = [_label(cell) for cell in self.columns[RECORD].values]
        self.add_each(RECORD, [k for k, label in enumerate(labels) if not label], lambda k: "is empty")
        return [(label, np.flatnonzero(np.array(labels) == label)) for label in dict.fromkeys(labels)]

    def check_times(self, time: str, times: np.ndarray, places: np.ndarray) -> None:
        """Note times that are missing or do not increase."""
        own = times[places]
        missing = np.isnan(own)
        self.add_each(time, places[missing], lambda k: "is empty")
        there, own = places[~missing], own[~missing]
        late = np.flatnonzero(np.diff(own) <= 0) + 1
        before = dict(zip(there[1:], own[:-1], strict=True)) if len(there) else {}
        self.add_each(time, there[late], lambda k: f"{times[k]:g} s does not exceed the one before, {before[k]:g} s")

    def record(
        self, label: str, places: np.ndarray, times: np.ndarray, values: dict[Key, np.ndarray], noise: dict[Key, np.ndarray]
    ) -> Iterator[Record]:
        """Make a record of some rows, of those channels that were measured in it."""
        own = {name: x[places] for name, x in values.items()}
        own = {name: x for name, x in own.items() if not np.isnan(x).all()}
        if self.table.padded and own:
            some = np.flatnonzero(~np.isnan(np.stack(list(own.values()))).all(0))
            inside = slice(some[0], some[-1] + 1)
            own, places = {name: x[inside] for name, x in own.items()}, places[inside]
        sigma = {name: noise[name][places] for name in own if name in noise}
        try:
            yield Record(times[places], own, sigma, name=label)
        except IdentificationError as error:
            self.problems += [f"{self.table.source}: {problem}" for problem in error.problems]

    def add(self, heading: str, problem: str) -> None:
        """Note a mistake of a column."""
        self.problems.append(f"{self.table.source}, column {quote(heading)}: {problem}")

    def add_each(self, heading: str, rows: Sequence[int] | np.ndarray, problem: Callable[[int], str]) -> None:
        """Note the same mistake in some rows: the first few, and how many more."""
        for k in rows[:MOST_SHOWN]:
            self.problems.append(f"{self.table.source}, {self.table.rows[k]}, column {quote(heading)}: {problem(k)}")
        if len(rows) > MOST_SHOWN:
            self.add(heading, f"and so in {len(rows) - MOST_SHOWN} more rows")


def _number(cell: str | float | None) -> float:
    """Return a cell as a number: infinite where it is none."""
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return math.nan
    try:
        return math.inf if isinstance(cell, bool | np.bool_) else float(cell)
    except (TypeError, ValueError):
        return math.inf


def _label(cell: str | float | None) -> str:
    """Return a cell as the name of a record: empty where it is none."""
    if isinstance(cell, str):
        return cell.strip()
    return "" if cell is None or cell != cell else f"{cell:g}"


# --- anything that holds tables


class _DataReader:
    """Reads data for a mechanism, and gathers every mistake in `problems`."""

    def __init__(self, mechanism: Mechanism, ignore: tuple[str, ...], quantities: dict[str, Quantity]):
        self.mechanism, self.ignore, self.quantities = mechanism, ignore, quantities
        self.problems: list[str] = []

    def read(self, data: Data, source: str) -> Iterator[Record]:
        """Iterate over the records in anything that holds some."""
        if isinstance(data, Record):
            yield data
        elif isinstance(data, list | tuple):
            for k, item in enumerate(data):
                yield from self.read(item, f"{source}[{k}]")
        else:
            for table in read_tables(cast(TableData, data), self.mechanism.body_names, source, self.problems):
                self.quantities |= table.quantities
                yield from _TableReader(table, self.channel, self.ignore, self.problems).records()

    def channel(self, given: Key) -> Channel | Quantity:
        """Return the channel of a name, or the user's own. Raises ValueError."""
        own = given if isinstance(given, Quantity) else self.quantities.get(str(given))
        return channel_of(self.mechanism, str(given)) if own is None else own

    def by_channel(self, given: ByChannel[T], place: str) -> dict[Key, T]:
        """Return the same values under the usual names of the channels; those of the user go by themselves."""
        found: dict[Key, T] = {}
        for text, value in given.items():
            try:
                key = key_of(self.channel(text))
            except ValueError as error:
                self.problems.append(f"{place}, {quote(str(text))}: {error}")
                continue
            if key in found:
                self.problems.append(f"{place}, {quote(str(text))}: {quote(str(key))} is there twice")
            found[key] = value
        return found

    def with_usual_names(self, record: Record) -> Record:
        """Return the record with the usual names of its channels."""
        place = f"record {quote(record.name)}" if record.name else "record"
        values = self.by_channel(record.values, place)
        if list(values) == list(record.values) or len(values) != len(record.values):
            return record
        noise = dict(zip(values, record.noise.values(), strict=True))
        return record.with_channels(values, noise)

    def with_noise(self, record: Record, given: dict[Key, ArrayLike | None]) -> Record:
        """Return the record with the `given` standard deviation for those channels that have none of their own."""
        if all(own is not None or given.get(channel) is None for channel, own in record.noise.items()):
            return record
        noise = {channel: given.get(channel) if own is None else own for channel, own in record.noise.items()}
        try:
            return record.with_channels(record.values, noise)
        except IdentificationError as error:
            self.problems += error.problems
            return record
