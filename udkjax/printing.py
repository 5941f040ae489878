"""Printing of the package's classes: short tables of numbers with units, as text or, in notebooks, HTML."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import IntEnum
from html import escape
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import QuickMethods

MOST_ROWS = 14  # rows of a table as text, which fit on a screen with title and remarks; further rows are only counted
MOST_HTML_ROWS = 30  # rows of a table in a notebook, which can be scrolled
MOST_NUMBERS = 6  # entries of an array that are printed; larger arrays print their shape and range
MOST_CHARACTERS = 96  # of a cell
MOST_LINE = 400  # characters of an object that prints on one line
SIGNIFICANT_DIGITS = 6  # significant digits in tables, enough to compare runs by eye
PRINTED_AS_ZERO = 4096 * np.finfo(float).eps  # relative to the largest nearby number: accumulated rounding errors print as 0

Plain = bool | int | float | complex | np.ndarray | np.generic


class PrintedTable(NamedTuple):
    """A table to print: a title, the names of the columns (`heads`), and rows of cells.

    Without names of columns, the first cell of each row is its name. Remarks, one sentence each, follow the rows.
    """

    title: str
    rows: Sequence[Sequence[object]]
    heads: Sequence[str] = ()
    remarks: Sequence[str] = ()


def text_table(table: PrintedTable, most: int = MOST_ROWS) -> str:
    """Return a table as text with aligned columns: the first `most` rows, and the number of further rows."""
    cells = [[_shorten(str(cell)) for cell in row] for row in table.rows[:most]]
    lines = align_columns([list(table.heads), *cells] if table.heads else cells)
    if len(table.rows) > most:
        lines.append(f"  and {len(table.rows) - most} more")
    return "\n".join([table.title, *lines, *table.remarks])


def align_columns(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  " + "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]


def html_table(table: PrintedTable) -> str:
    """Return a table as HTML, with escaped cells: the first rows, and the number of further rows."""
    heads, rows = table.heads, table.rows
    head = "".join(f"<th>{escape(name)}</th>" for name in heads)
    body = "".join(
        f"<tr>{''.join(_cell(cell, not heads and k == 0) for k, cell in enumerate(row))}</tr>" for row in rows[:MOST_HTML_ROWS]
    )
    if len(rows) > MOST_HTML_ROWS:
        body += f'<tr><td colspan="{len(heads) or len(rows[0])}">and {len(rows) - MOST_HTML_ROWS} more</td></tr>'
    top = f"<thead><tr>{head}</tr></thead>" if heads else ""
    remarks = f"<p>{'<br>'.join(map(escape, table.remarks))}</p>" if table.remarks else ""
    return f"<table><caption>{escape(table.title)}</caption>{top}<tbody>{body}</tbody></table>{remarks}"


def _cell(value: object, is_head: bool) -> str:
    text = escape(str(value))
    return f'<th style="text-align: left">{text}</th>' if is_head else f'<td style="text-align: left">{text}</td>'


def _shorten(text: str) -> str:
    return text if len(text) <= MOST_CHARACTERS else text[: MOST_CHARACTERS - 4] + " ..."


# --- numbers


def units(**by_field: str) -> Mapping[str, str]:
    """Return the given units by the name of the field, as a mapping that cannot be changed."""
    return MappingProxyType(by_field)


def has_numbers(value: object) -> bool:
    """Return True if all leaves of an object are strings or numbers whose values can be read.

    Traced numbers, mere shapes, deleted arrays, and arrays of other processes have no such values.
    """
    return all(isinstance(leaf, Plain | str) or _is_stored(leaf) for leaf in _leaves(value))


def _leaves(value: object) -> list[Any]:
    return jax.tree.leaves(value, is_leaf=lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))


def _is_stored(leaf: object) -> bool:
    if not isinstance(leaf, jax.Array) or isinstance(leaf, Tracer):
        return False
    return not leaf.is_deleted() and leaf.is_fully_addressable


def format_number(value: Any, unit: str = "", scale: float = 0.0) -> str:
    """Return one number with six digits and its unit; a number that is a rounding error relative to `scale` becomes 0."""
    number = complex(value) if np.iscomplexobj(value) else float(value)
    text = f"{0.0 if abs(number) <= PRINTED_AS_ZERO * scale else number:.{SIGNIFICANT_DIGITS}g}"
    return f"{text} {unit}" if unit else text


def format_numbers(value: Any, unit: str = "") -> str:
    """Return a number or an array with its unit as text: the entries if they are few, else the shape and the range.

    Args:
        value: an array, a number, a boolean, or None. Traced numbers are marked as such, with their shape.
        unit: unit of all entries, or units of the entries along the last axis, such as "m, m, rad".
    """
    if value is None:
        return "none"
    if not has_numbers(value):
        return f"{'traced' if isinstance(value, Tracer) else 'array'} {_shape(np.shape(value))}".rstrip()
    array = np.asarray(value)
    if array.dtype == bool:
        return ("no", "yes")[int(array)] if array.ndim == 0 else f"{int(array.sum())} of {array.size}"
    suffix = f" {unit}" if unit else ""
    if array.ndim == 0:
        return format_number(array) + suffix
    if array.size <= MOST_NUMBERS:
        return _format_few(array, float(np.max(np.abs(array), initial=0.0, where=np.isfinite(array)))) + suffix
    if "," in unit or not np.isfinite(array).any() or np.iscomplexobj(array):
        return _shape(array.shape) + suffix
    scale = float(np.max(np.abs(array), where=np.isfinite(array), initial=0.0))
    low, high = (format_number(end(array), scale=scale) for end in (np.nanmin, np.nanmax))
    return f"{_shape(array.shape)} {f'from {low} to {high}' if low != high else f'all {low}'}{suffix}"


def _format_few(values: np.ndarray, scale: float) -> str:
    if values.ndim == 0:
        return format_number(values, scale=scale)
    return f"[{', '.join(_format_few(part, scale) for part in values)}]"


def _shape(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, shape))}) numbers" if len(shape) > 1 else f"{shape[0]} numbers" if shape else ""


# --- classes


def fields_of(record: Any) -> dict[str, Any]:
    """Return the fields of a module, a dataclass or a named tuple by name, without those that begin with an underscore."""
    named = record._asdict() if hasattr(record, "_asdict") else {f.name: getattr(record, f.name, None) for f in fields(record)}
    return {name: value for name, value in named.items() if not name.startswith("_")}


def fields_table(record: Any, units: Mapping[str, str], title: str = "") -> PrintedTable:
    """Return a table of the fields of a record with their units; a field that maps names to values has a row for each name."""
    rows: list[tuple[str, str]] = []
    for name, value in fields_of(record).items():
        words, unit = name.replace("_", " "), units.get(name, "")
        if isinstance(value, Mapping):
            rows += [(f"{words} {key}", format_field(part, unit)) for key, part in value.items()]
        else:
            rows.append((words, format_field(value, unit)))
    return PrintedTable(title or type(record).__name__, rows)


def format_field(value: Any, unit: str = "") -> str:
    """Return the value of a field as text on one line: numbers with their unit, names, or the text of an object."""
    if value is None or isinstance(value, Plain) or isinstance(getattr(value, "shape", None), tuple):
        return format_numbers(value, unit)
    if isinstance(value, str):
        return value
    if isinstance(value, tuple | list) and all(isinstance(part, str) for part in value):
        return ", ".join(value) or "none"
    if callable(value) and hasattr(value, "__qualname__"):
        return value.__qualname__
    return _shorten(" ".join(repr(value).split()))


def one_line(record: Any) -> str:
    """Return a record on one line, in the form of a Python expression; a long array is represented by its shape and range.

    Fields with the value None are left out.
    """
    shown = [f"{name}={_literal(value)}" for name, value in fields_of(record).items() if value is not None]
    text = f"{type(record).__name__}({', '.join(shown)})"
    return text if len(text) <= MOST_LINE else text[: MOST_LINE - 5] + " ...)"


def _literal(value: Any) -> str:
    return repr(value) if isinstance(value, str) else format_field(value) if not isinstance(value, tuple) else str(value)


class PrintsLine(QuickMethods):
    """A module that prints as a Python expression on one line."""

    def __repr__(self) -> str:
        return one_line(self)


class PrintsTable(QuickMethods):
    """A module that prints as a table: `_table()` if all of its numbers have values, else `_shapes()`."""

    _units: ClassVar[Mapping[str, str]] = units()  # unit of each field

    def _table(self) -> PrintedTable:
        """Return the table to print, by default with a row for each field."""
        return fields_table(self, self._units)

    def _shapes(self) -> PrintedTable:
        """Return the table to print if numbers have no values, as while they are traced."""
        return fields_table(self, self._units)

    def __repr__(self) -> str:
        return text_table(_table_of(self))

    def _repr_html_(self) -> str:
        return html_table(_table_of(self))


class PrintsWords(IntEnum):
    """A code that prints as its name in words; in arrays, as for a batch, it is a number."""

    @property
    def label(self) -> str:
        """The name in words."""
        return self.name.replace("_", " ")

    def __str__(self) -> str:
        return self.label

    def __repr__(self) -> str:
        return str(self)

    def __format__(self, spec: str) -> str:
        return format(str(self), spec)


Class = TypeVar("Class", bound=type)


def prints_table(cls: Class) -> Class:
    """Make the instances of a named tuple print as a `PrintsTable` does, and return the class; a decorator.

    The class has a method `_table`, or the units of its fields, `_units`.
    """
    setattr(cls, "__repr__", lambda self: text_table(_table_of(self)))  # noqa: B010  # no declared attribute of `type`
    setattr(cls, "_repr_html_", lambda self: html_table(_table_of(self)))  # noqa: B010
    return cls


def _table_of(record: Any) -> PrintedTable:
    make_table = getattr(record, "_table" if has_numbers(record) else "_shapes", None)
    try:
        with jax.ensure_compile_time_eval():  # concrete numbers stay concrete even while something else is traced
            return fields_table(record, getattr(record, "_units", {})) if make_table is None else make_table()
    except (ArithmeticError, AttributeError, IndexError, TypeError, ValueError):  # JAX has replaced numbers by other objects
        return fields_table(record, getattr(record, "_units", {}))
