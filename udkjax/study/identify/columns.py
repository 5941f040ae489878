"""Columns of a table, as channels of records in SI units: every mistake is told, with its column and row."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from udkjax.scene.checks import quoted, shown, suggestion
from udkjax.study.identify.channels import Channel, Quantity
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.records import Record
from udkjax.study.identify.tables import NOISE, RECORD, TIME, Column, Table
from udkjax.study.identify.units import factor

SHOWN = 3  # mistakes of one kind in a column; the others are counted


class Measured(NamedTuple):
    """A channel, and the columns of its values and of their standard deviation."""

    heading: str
    channel: Channel | Quantity
    values: Column
    noise: Column | None


class Columns:
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
                self.problems.append(f"{self.table.source}: there is no column {quoted(TIME[0])}{near}")
            return
        times = self.numbers(time, self.columns[time], "s")
        numbers = len(self.problems) == before
        found = self.measured([name for name in self.columns if name not in (time, RECORD)])
        values = {key_of(m.channel): self.numbers(m.heading, m.values, m.channel.units) for m in found}
        noise = {key_of(m.channel): self.numbers(m.heading + NOISE, m.noise, m.channel.units) for m in found if m.noise}
        for label, places in self.labelled():
            if numbers:
                self.check_times(time, times, places)
            if len(self.problems) == before:
                yield from self.record(label, places, times, values, noise)

    def measured(self, headings: Sequence[str]) -> list[Measured]:
        """The channels, with their columns."""
        found: dict[str, Measured] = {}
        for heading in headings:
            of = heading.removesuffix(NOISE)
            if of != heading:
                if of not in (*headings, *self.ignore):
                    self.wrong(heading, f"there is no column {quoted(of)}")
                continue
            try:
                channel = self.channel(heading)
            except ValueError as error:
                self.wrong(heading, f"{error} (what is not to be read must be listed in `ignore`)")
                continue
            if channel.name in found:
                self.wrong(heading, f"is the same channel as {quoted(found[channel.name].heading)}")
            values, noise = self.columns[heading], self.columns.get(heading + NOISE)
            if noise is not None and noise.units is None:
                noise = noise._replace(units=values.units)
            found[channel.name] = Measured(heading, channel, values, noise)
        return list(found.values())

    def numbers(self, heading: str, column: Column, wanted: str) -> np.ndarray:
        """The numbers of a column in SI units; gaps are not a number."""
        scale, cells, count = 1.0, column.values, len(self.table.rows)
        try:
            scale = factor(column.units, wanted) if column.units else 1.0
        except ValueError as error:
            self.wrong(heading, str(error))
        kind, shape = (cells.dtype.kind, cells.shape) if isinstance(cells, np.ndarray) else ("O", (len(cells),))
        if kind in "mM" or shape != (count,):
            self.wrong(heading, f"must be {count} numbers, is of {f'type {cells.dtype}' if kind in 'mM' else f'shape {shape}'}")
            return np.full(count, np.nan)
        found = np.asarray(cells, float) if kind in "iuf" else np.array([_number(cell) for cell in cells], float)
        wrong = np.flatnonzero(np.isinf(found))
        self.several(heading, wrong, lambda k: f"must be a number, is {shown(cells[k])}")
        return scale * found

    def labelled(self) -> list[tuple[str, np.ndarray]]:
        """The records by name, and which rows they have."""
        if RECORD not in self.columns:
            return [(self.table.name, np.arange(len(self.table.rows)))]
        labels = [_label(cell) for cell in self.columns[RECORD].values]
        self.several(RECORD, [k for k, label in enumerate(labels) if not label], lambda k: "is empty")
        return [(label, np.flatnonzero(np.array(labels) == label)) for label in dict.fromkeys(labels)]

    def check_times(self, time: str, times: np.ndarray, places: np.ndarray) -> None:
        """Note times that are missing or do not increase."""
        mine = times[places]
        missing = np.isnan(mine)
        self.several(time, places[missing], lambda k: "is empty")
        there, mine = places[~missing], mine[~missing]
        late = np.flatnonzero(np.diff(mine) <= 0) + 1
        before = dict(zip(there[1:], mine[:-1], strict=True)) if len(there) else {}
        self.several(time, there[late], lambda k: f"{times[k]:g} s does not exceed the one before, {before[k]:g} s")

    def record(self, label, places, times, values, noise) -> Iterator[Record]:
        """The record that some rows make, of those channels that were measured in it."""
        mine = {name: x[places] for name, x in values.items()}
        mine = {name: x for name, x in mine.items() if not np.isnan(x).all()}
        if self.table.gaps and mine:
            some = np.flatnonzero(~np.isnan(np.stack(list(mine.values()))).all(0))
            inside = slice(some[0], some[-1] + 1)
            mine, places = {name: x[inside] for name, x in mine.items()}, places[inside]
        sigma = {name: noise[name][places] for name in mine if name in noise}
        try:
            yield Record(times[places], mine, sigma, name=label)
        except IdentificationError as error:
            self.problems += [f"{self.table.source}: {problem}" for problem in error.problems]

    def wrong(self, heading: str, problem: str) -> None:
        self.problems.append(f"{self.table.source}, column {quoted(heading)}: {problem}")

    def several(self, heading: str, rows: Sequence[Any] | np.ndarray, problem: Callable[[Any], str]) -> None:
        """Note the same mistake in some rows: the first few, and how many more."""
        for k in rows[:SHOWN]:
            self.problems.append(f"{self.table.source}, {self.table.rows[k]}, column {quoted(heading)}: {problem(k)}")
        if len(rows) > SHOWN:
            self.wrong(heading, f"and so in {len(rows) - SHOWN} more rows")


def key_of(channel: Channel | Quantity) -> Any:
    """What a channel goes by in a record: its name, or itself if it is the user's own."""
    return channel if isinstance(channel, Quantity) else channel.name


def _number(cell: Any) -> float:
    """A cell as a number: infinite where it is none."""
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return math.nan
    try:
        return math.inf if isinstance(cell, bool | np.bool_) else float(cell)
    except (TypeError, ValueError):
        return math.inf


def _label(cell: Any) -> str:
    """A cell as the name of a record: empty where it is none."""
    if isinstance(cell, str):
        return cell.strip()
    return "" if cell is None or cell != cell else f"{cell:g}"
