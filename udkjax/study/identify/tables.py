"""Tables of measurements as they come: columns under their headings, nothing interpreted."""

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from udkjax.scene.checks import quoted

TIME, RECORD, NOISE = ("time", "t"), "record", ".noise"
_DELIMITERS = (";", "\t", ",")


class Column(NamedTuple):
    """The values under one heading, numbers or text, and the units that they are said to be in."""

    values: Any
    units: str | None


class Table(NamedTuple):
    """Columns by their names; where they come from, and what their rows are called there, both as in messages."""

    source: str
    columns: Mapping[str, Column]
    rows: Sequence[str]
    name: str = ""  # of the record that it is, if it is one
    gaps: bool = False  # whether rows at the ends in which nothing was measured belong to other records


def of_csv(path: Path, problems: list[str]) -> Iterator[Table]:
    """A file with a header, after comments if there are any, and rows of cells."""
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")), None)
    if first is None:
        problems.append(f"{path}: holds no header")
        return
    delimiter = next((d for d in _DELIMITERS if d in lines[first]), ",")
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True)
    header, rows, places = _joined(_trimmed(next(reader)), delimiter), [], []
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        line = f"line {first + reader.line_num}"
        cells = cells[: max(len(header), len(_trimmed(cells)))]
        if len(cells) == len(header):
            rows.append(cells)
            places.append(line)
        else:
            problems.append(f"{path}, {line}: has {len(cells)} cells, the header has {len(header)}")
    columns = list(zip(header, zip(*rows, strict=True) if rows else [()] * len(header), strict=True))
    named = [(name, cells) for name, cells in columns if name.strip() or any(cell.strip() for cell in cells)]
    yield of_columns(str(path), named, problems, places, path.stem)


def _trimmed(cells: list[str]) -> list[str]:
    """Cells without those that are empty at the end: spreadsheets write such."""
    return cells[: max((k + 1 for k, cell in enumerate(cells) if cell.strip()), default=0)]


def _joined(cells: Sequence[str], delimiter: str) -> list[str]:
    """Headings with the commas of points, `body.rod(0.5, 0).x`, that were not put in quotes."""
    found: list[str] = []
    for cell in cells:
        if found and found[-1].count("(") > found[-1].count(")"):
            found[-1] += delimiter + cell
        else:
            found.append(cell)
    return found


def of_frame(data: Any, source: str, problems: list[str]) -> Table:
    """A pandas DataFrame; its index is the time if it is called so."""
    columns = [(str(name), _values(data.iloc[:, k])) for k, name in enumerate(data.columns)]
    if data.index.name is not None and _heading(str(data.index.name))[0] in (*TIME, RECORD):
        columns.insert(0, (str(data.index.name), data.index.to_numpy()))
    return of_columns(source, columns, problems)


def _values(column: Any) -> np.ndarray:
    """The values of a pandas Series; numbers that are missing are not a number."""
    return column.to_numpy(float, na_value=np.nan) if column.dtype.kind in "iuf" else column.to_numpy()


def of_columns(
    source: str, given: Sequence[tuple[str, Any]], problems: list[str], rows: Sequence[str] | None = None, name: str = ""
) -> Table:
    """A table of columns whose headings may tell their units."""
    columns: dict[str, Column] = {}
    for text, values in given:
        heading, units = _heading(text)
        if heading in columns or not heading:
            what = f"there are two columns {quoted(heading)}" if heading else "a column has no heading"
            problems.append(f"{source}: {what}")
        else:
            columns[heading] = Column(np.asarray(values) if hasattr(values, "dtype") else values, units)
    if rows is None:
        sizes = [len(c.values) for c in columns.values() if not _single(c.values)]
        rows = [f"entry {k}" for k in range(max(sizes, default=0))]
    columns = {h: c._replace(values=[c.values] * len(rows)) if _single(c.values) else c for h, c in columns.items()}
    return Table(source, columns, rows, name)


def _single(values: Any) -> bool:
    """Whether it is one value, of all rows."""
    return isinstance(values, str) or not hasattr(values, "__len__") or getattr(values, "shape", None) == ()


def _heading(text: str) -> tuple[str, str | None]:
    """Split `body.link1.angle [deg]` into a name and its units."""
    match = re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", text.strip())
    return (match[1].strip(), match[2].strip() or None) if match else (text.strip(), None)
