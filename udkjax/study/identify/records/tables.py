"""Tables of measurements from files, pandas, xarray and mappings: columns by their headings, without interpretation.

CSV files are read by the standard library, because messages name the line of each mistake, which pandas does not provide.
"""

import csv
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, cast

import numpy as np

from udkjax.annotations import Numbers
from udkjax.extras import OptionalImport
from udkjax.positions.assembling.channels import RATES
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.study.identify.records.records import ByChannel
from udkjax.wording import abbreviate, quote, suggestion

if TYPE_CHECKING:  # imported only if their tables are given
    import pandas
    import xarray

TableData: TypeAlias = "ByChannel[Numbers] | pandas.DataFrame | xarray.Dataset | str | os.PathLike[str]"
# Headings of times and record names, and the suffix of a channel's noise.
TIME_HEADINGS, RECORD_HEADING, NOISE_SUFFIX = ("time", "t"), "record", ".noise"
_DELIMITERS = (";", "\t", ",")
# Variables in files of runs: efforts, along drivers or in columns `effort.NAME`; and which constraints hold, no measurement.
EFFORTS, HOLDS = "effort", "holds"
# Coordinates in files written by `Solution.to_xarray`, as channels of bodies.
_STATE_CHANNELS = {"q": dict(zip(COORDINATES, COORDINATES, strict=True)), "v": dict(zip(COORDINATES, RATES, strict=True))}


class TableColumn(NamedTuple):
    """The values under one heading, numbers or text, and their units if the heading names them."""

    values: Sequence[str | float | None] | np.ndarray
    units: str | None


class Table(NamedTuple):
    """Columns by name; `source` and `rows` are the names of the table and its rows in messages."""

    source: str
    columns: Mapping[str, TableColumn]
    rows: Sequence[str]
    name: str = ""  # name of the record, if the table contains a single one
    padded: bool = False  # True if empty rows at the ends only pad the record to the length of others


def read_tables(
    data: TableData, bodies: Sequence[str], source: str, problems: list[str], ignore: Sequence[str] = ()
) -> Iterator[Table]:
    """Iterate over the tables of one file or object; mistakes in it are added to `problems`.

    `bodies` are the names of the bodies whose states a dataset may contain, and `source` is the name of an object in messages.
    Variables of a dataset that are in `ignore` are not read.
    """
    if isinstance(data, str | os.PathLike):
        yield from _read_file(Path(data), bodies, problems, ignore)
    elif hasattr(data, "data_vars"):
        variables = cast("xarray.Dataset", data).drop_vars(ignore, errors="ignore")
        yield from _read_dataset(variables, bodies, source, problems)
    elif hasattr(data, "columns") and hasattr(data, "index"):
        yield _table_of_frame(cast("pandas.DataFrame", data), source, problems)
    elif isinstance(data, Mapping):
        columns = cast(Mapping[object, Numbers], data)
        yield _table_of_columns(source, [(str(key), value) for key, value in columns.items()], problems)
    else:
        kinds = "a Record, a mapping, a pandas DataFrame, an xarray Dataset, the path of a .csv or .nc file, or a list of these"
        problems.append(f"{source}: must be {kinds}, not {type(data).__name__}")


def _read_file(path: Path, bodies: Sequence[str], problems: list[str], ignore: Sequence[str]) -> Iterator[Table]:
    try:
        if path.suffix.lower() == ".csv":
            yield from _read_csv(path, problems)
        elif path.suffix.lower() == ".nc":
            with OptionalImport():
                import xarray
            data = xarray.load_dataset(path, decode_times=False)  # without this, xarray converts seconds to durations
            yield from _read_dataset(data.drop_vars(ignore, errors="ignore"), bodies, str(path), problems, path.stem)
        else:
            problems.append(f"{path}: must be a .csv or a .nc file")
    except (OSError, ValueError, csv.Error) as error:
        problems.append(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})")


def _read_csv(path: Path, problems: list[str]) -> Iterator[Table]:
    """Iterate over the only table of a CSV file: optional comment lines, a header, and rows of cells."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if first is None:
        problems.append(f"{path}: has no header")
        return
    delimiter = next((d for d in _DELIMITERS if d in lines[first]), ",")
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True)
    header, rows = _join_points(_cut_empty_end(next(reader)), delimiter), {}
    for cells in reader:
        if any(cell.strip() for cell in cells):
            cells = cells[: max(len(header), len(_cut_empty_end(cells)))]
            if len(cells) == len(header):
                rows[f"line {first + reader.line_num}"] = cells
            else:
                where = f"{path}, line {first + reader.line_num}"
                problems.append(f"{where}: has {len(cells)} cells, the header has {len(header)}")
    columns = zip(header, zip(*rows.values(), strict=True) if rows else [()] * len(header), strict=True)
    named = [(name, cells) for name, cells in columns if name.strip() or any(cell.strip() for cell in cells)]
    yield _table_of_columns(str(path), named, problems, list(rows), path.stem)


def _cut_empty_end(cells: list[str]) -> list[str]:
    """Return a row without the empty cells at its end, which spreadsheets write."""
    return cells[: max((k + 1 for k, cell in enumerate(cells) if cell.strip()), default=0)]


def _join_points(cells: Sequence[str], delimiter: str) -> list[str]:
    """Return headings, with those joined that were split at the comma of a point, as in `body.rod(0.5, 0).x` without quotes."""
    found: list[str] = []
    for cell in cells:
        if found and found[-1].count("(") > found[-1].count(")"):
            found[-1] += delimiter + cell
        else:
            found.append(cell)
    return found


def _table_of_frame(data: "pandas.DataFrame", source: str, problems: list[str]) -> Table:
    """Return the table of a pandas DataFrame; the index is a column if its name is that of a time or a record."""
    indexed = data.index.name is not None and _heading(str(data.index.name))[0] in (*TIME_HEADINGS, RECORD_HEADING)
    columns = [data.index.to_series()] if indexed else []
    columns += [data.iloc[:, k] for k in range(data.shape[1])]
    values = [x.to_numpy(float, na_value=np.nan) if x.dtype.kind in "iuf" else x.to_numpy() for x in columns]
    return _table_of_columns(source, [(str(x.name), v) for x, v in zip(columns, values, strict=True)], problems)


def _table_of_columns(
    source: str, given: Sequence[tuple[str, Numbers]], problems: list[str], rows: Sequence[str] | None = None, name: str = ""
) -> Table:
    """Return a table from columns whose headings may name units; a single value applies to all rows."""
    columns: dict[str, TableColumn] = {}
    for text, values in given:
        heading, units = _heading(text)
        if heading in columns or not heading:
            problem = f"there are two columns {quote(heading)}" if heading else "a column has no heading"
            problems.append(f"{source}: {problem}")
        else:
            cells = np.asarray(values) if hasattr(values, "dtype") else cast("Sequence[str | float | None]", values)
            columns[heading] = TableColumn(cells, units)
    alone = {h for h, c in columns.items() if isinstance(c.values, str) or np.ndim(cast(Numbers, c.values)) == 0}
    if rows is None:
        rows = [f"entry {k}" for k in range(max((len(c.values) for h, c in columns.items() if h not in alone), default=0))]
    columns = {h: c._replace(values=[c.values] * len(rows)) if h in alone else c for h, c in columns.items()}
    return Table(source, columns, rows, name)


def _heading(text: str) -> tuple[str, str | None]:
    """Return the name and the units of a heading such as `body.link1.angle [deg]`; the units are None if it has none."""
    is_plain = re.fullmatch(r"[qv]\[\d+\]", text.strip())  # a coordinate of a system
    match = None if is_plain else re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", text.strip())
    return (match[1].strip(), match[2].strip() or None) if match else (text.strip(), None)


# --- xarray


def _read_dataset(
    data: "xarray.Dataset", bodies: Sequence[str], source: str, problems: list[str], name: str = ""
) -> Iterator[Table]:
    """Iterate over the tables of an xarray Dataset, one per record."""
    if RECORD_HEADING not in data.dims:
        yield _read_record(data, bodies, source, problems, name)
        return
    for k in range(data.sizes[RECORD_HEADING]):
        label = str(data[RECORD_HEADING].values[k]) if RECORD_HEADING in data.coords else str(k)
        found: list[str] = []
        record = data.isel({RECORD_HEADING: k}).drop_vars(RECORD_HEADING, errors="ignore")
        yield _read_record(record, bodies, source, found, label)._replace(padded=True)
        problems += [problem for problem in found if problem not in problems]


def _read_record(data: "xarray.Dataset", bodies: Sequence[str], source: str, problems: list[str], name: str) -> Table:
    time = next((t for t in TIME_HEADINGS if t in data.variables and data[t].ndim == 1), None)
    if time is None:
        problems.append(f"{source}: there is no coordinate {quote(TIME_HEADINGS[0])}")
        return Table(source, {}, [], name)
    dims, count = data[time].dims, data[time].size
    columns = {time: TableColumn(data[time].values, data[time].attrs.get("units"))}
    for key, variable in data.data_vars.items():
        if key in _STATE_CHANNELS and set(variable.dims) == {*dims, "body", "coordinate"}:
            columns |= _state_columns(str(key), variable.transpose(*dims, "body", "coordinate"), bodies, source, problems)
        elif key == HOLDS and set(variable.dims) == {*dims, "constraint"}:
            continue
        elif key == EFFORTS and set(variable.dims) == {*dims, "driver"}:
            of_drivers = variable.transpose(*dims, "driver")
            names = map(str, of_drivers["driver"].values)
            columns |= {f"{EFFORTS}.{name}": TableColumn(of_drivers.values[:, k], None) for k, name in enumerate(names)}
        elif variable.dims in ((), dims):
            columns[str(key)] = TableColumn(np.broadcast_to(variable.values, count), variable.attrs.get("units"))
        else:
            problems.append(
                f"{source}, {quote(str(key))}: must be along {quote(time)}, not along {abbreviate(list(variable.dims))}"
            )
    return Table(source, columns, [f"entry {k}" for k in range(count)], name)


def _state_columns(
    key: str, values: "xarray.DataArray", bodies: Sequence[str], source: str, problems: list[str]
) -> dict[str, TableColumn]:
    """Return the coordinates ("q") or velocities ("v") of bodies as columns, by the names of channels."""
    columns = {}
    for i, body in enumerate(map(str, values["body"].values)):
        if body not in bodies:
            problems.append(f"{source}, {quote(key)}: no body named {quote(body)}{suggestion(body, bodies)}")
            continue
        for k, coordinate in enumerate(map(str, values["coordinate"].values)):
            columns[f"body.{body}.{_STATE_CHANNELS[key].get(coordinate, coordinate)}"] = TableColumn(values.values[:, i, k], None)
    return columns
