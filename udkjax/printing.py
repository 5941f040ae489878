"""Printing of the package's classes: short tables of numbers with their units, as text and, in notebooks, as HTML."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from enum import IntEnum
from html import escape
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

MOST_ROWS = 14  # of a table as text, whose title and remarks fit on a screen beside it: further rows are counted
MOST_HTML_ROWS = 30  # of a table in a notebook, which scrolls
MOST_NUMBERS = 6  # numbers of an array that are written out; of more, their shape and range
MOST_CHARACTERS = 96  # of a cell
MOST_LINE = 400  # characters of what prints as one line
DIGITS = 6  # of a number in a table: enough to compare runs by eye
PRINTED_AS_ZERO = 4096 * np.finfo(float).eps  # of the largest number beside it: rounding of thousands of operations prints as 0

Plain = bool | int | float | complex | np.ndarray | np.generic


class PrintedTable(NamedTuple):
    """A title, and cells row by row below the names of the columns; without these the first column names its row.

    Remarks, a sentence each, follow the rows.
    """

    title: str
    rows: Sequence[Sequence[object]]
    heads: Sequence[str] = ()
    remarks: Sequence[str] = ()


def text_table(table: PrintedTable, most: int = MOST_ROWS) -> str:
    """Return a table as text, its columns below each other; of many rows the first ones, and how many more there are."""
    cells = [[_shorten(str(cell)) for cell in row] for row in table.rows[:most]]
    lines = align_columns([list(table.heads), *cells] if table.heads else cells)
    if len(table.rows) > most:
        lines.append(f"  and {len(table.rows) - most} more")
    return "\n".join([table.title, *lines, *table.remarks])


def align_columns(cells: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table, its columns below each other."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  " + "  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]


def html_table(table: PrintedTable) -> str:
    """Return a table as HTML, whatever stands in its cells escaped; of many rows the first ones, and how many more there are."""
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
    """Return the units of fields by their names."""
    return MappingProxyType(by_field)


def has_numbers(value: object) -> bool:
    """Return whether every number is there to be read: none is traced, or stands for a shape alone."""
    return all(isinstance(leaf, Plain | str) or _is_stored(leaf) for leaf in _leaves(value))


def _leaves(value: object) -> list[Any]:
    return jax.tree.leaves(value, is_leaf=lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))


def _is_stored(leaf: object) -> bool:
    if not isinstance(leaf, jax.Array) or isinstance(leaf, Tracer):
        return False
    return not leaf.is_deleted() and leaf.is_fully_addressable


def format_number(value: Any, unit: str = "", scale: float = 0.0) -> str:
    """Return one number to six digits with its unit; 0 where it is rounding beside `scale`, of the same unit."""
    number = complex(value) if np.iscomplexobj(value) else float(value)
    text = f"{0.0 if abs(number) <= PRINTED_AS_ZERO * scale else number:.{DIGITS}g}"
    return f"{text} {unit}" if unit else text


def format_numbers(value: Any, unit: str = "") -> str:
    """Return a number or an array with its unit as text: few numbers, or the shape and range of many.

    Args:
        value: an array, a number, a truth value, or None. Traced numbers are named as such, with their shape.
        unit: of all its entries; several, such as "m, m, rad", of those along its last axis.
    """
    if value is None:
        return "none"
    if not has_numbers(value):
        return f"{'traced' if isinstance(value, Tracer) else 'array'} {_shape(np.shape(value))}".rstrip()
    found = np.asarray(value)
    if found.dtype == bool:
        return ("no", "yes")[int(found)] if found.ndim == 0 else f"{int(found.sum())} of {found.size}"
    behind = f" {unit}" if unit else ""
    if found.ndim == 0:
        return format_number(found) + behind
    if found.size <= MOST_NUMBERS:
        return _format_few(found, float(np.max(np.abs(found), initial=0.0, where=np.isfinite(found)))) + behind
    if "," in unit or not np.isfinite(found).any() or np.iscomplexobj(found):
        return _shape(found.shape) + behind
    scale = float(np.max(np.abs(found), where=np.isfinite(found), initial=0.0))
    low, high = (format_number(end(found), scale=scale) for end in (np.nanmin, np.nanmax))
    return f"{_shape(found.shape)} {f'from {low} to {high}' if low != high else f'all {low}'}{behind}"


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
    """Return a table of the fields of a record, each with its unit or, where a field holds several by name, one row for each."""
    rows: list[tuple[str, str]] = []
    for name, value in fields_of(record).items():
        words, unit = name.replace("_", " "), units.get(name, "")
        if isinstance(value, Mapping):
            rows += [(f"{words} {key}", format_field(part, unit)) for key, part in value.items()]
        else:
            rows.append((words, format_field(value, unit)))
    return PrintedTable(title or type(record).__name__, rows)


def format_field(value: Any, unit: str = "") -> str:
    """Return the value of a field as text on one line: numbers with their unit, names, or what an object prints."""
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
    """Return a record as it would be written in Python, on one line; long arrays by their shape and range."""
    shown = [f"{name}={_literal(value)}" for name, value in fields_of(record).items() if value is not None]
    text = f"{type(record).__name__}({', '.join(shown)})"
    return text if len(text) <= MOST_LINE else text[: MOST_LINE - 5] + " ...)"


def _literal(value: Any) -> str:
    return repr(value) if isinstance(value, str) else format_field(value) if not isinstance(value, tuple) else str(value)


class PrintsLine(eqx.Module):
    """A module that prints as it would be written in Python, with its numbers."""

    def __repr__(self) -> str:
        return one_line(self)


class PrintsTable(eqx.Module):
    """A module that prints a table: that of `_table`, where all of its numbers can be read; else what shapes they have."""

    _units: ClassVar[Mapping[str, str]] = units()  # of its fields

    def _table(self) -> PrintedTable:
        """Return the table to print. By default a row for each field."""
        return fields_table(self, self._units)

    def _shapes(self) -> PrintedTable:
        """Return the table to print if numbers cannot be read, as while they are traced."""
        return fields_table(self, self._units)

    def __repr__(self) -> str:
        return text_table(_table_of(self))

    def _repr_html_(self) -> str:
        return html_table(_table_of(self))


class PrintsWords(IntEnum):
    """A code that prints as its name in words; in arrays, such as those of a batch, it is its number."""

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
    """Decorator of a named tuple with a method `_table` or with `_units`: what `PrintsTable` is to a module."""
    setattr(cls, "__repr__", lambda self: text_table(_table_of(self)))  # noqa: B010  # no declared attribute of `type`
    setattr(cls, "_repr_html_", lambda self: html_table(_table_of(self)))  # noqa: B010
    return cls


def _table_of(record: Any) -> PrintedTable:
    make = getattr(record, "_table" if has_numbers(record) else "_shapes", None)
    try:
        with jax.ensure_compile_time_eval():  # known numbers are computed, also while something else is traced
            return fields_table(record, getattr(record, "_units", {})) if make is None else make()
    except (ArithmeticError, AttributeError, IndexError, TypeError, ValueError):  # JAX puts marks in the place of numbers
        return fields_table(record, getattr(record, "_units", {}))
