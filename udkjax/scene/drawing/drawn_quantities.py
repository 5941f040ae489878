"""Numbers with units in tables: strings such as "12 mm", and plain numbers in the units of the file."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple, get_origin

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from udkjax.annotations import TomlTable
from udkjax.arrays import by_numpy
from udkjax.printing import format_number
from udkjax.scene.elements.fields import vector_as_angle
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.profiles import AbstractProfile, profile_class
from udkjax.scene.numbers.formula import Measured, evaluate, in_si, is_computed, name_mistake, names_in
from udkjax.scene.numbers.named_numbers import NamedNumber
from udkjax.scene.numbers.quantities import (
    QUANTITY_KINDS,
    QUANTITY_PATTERN,
    conversion_factor,
    dimension_of,
    read_quantity,
    unit_of,
    unit_sizes,
)
from udkjax.scene.numbers.sources import AbstractDrawing
from udkjax.scene.numbers.units import MOTION_LAW_FIELDS, field_unit
from udkjax.scene.tables.schema import CLASSES_BY_TYPE, keys, table_of, type_name
from udkjax.wording import abbreviate, quote, suggestion

_KIND_OF = {unit: kind for kind, unit in QUANTITY_KINDS.items()}
HELD_TIMES = ("dt", "t0")  # the fields of a `Held` that are times
VECTOR_FIELDS = ("axis", "to_axis", "direction", "face")  # angles that may also be vectors


class Expression(NamedTuple):
    """A number that an expression gives: its path in a drawing, the text, and the SI unit of the number."""

    path: str
    text: str
    unit: str


class Units:
    """The units of plain numbers in a file, and its named numbers, of which other numbers may be expressions.

    A quantity is in SI units unless the file chooses another unit for it. If the file changes only a part of its unit (of a
    stiffness, in a file in millimetres), a plain number is ambiguous and is refused: it needs a unit. Densities are in kg/m^3
    unless the file chooses their unit.
    """

    def __init__(self, chosen: object = None):
        self.problems: list[str] = []
        self.chosen: dict[str, str] = {}
        self.numbers: dict[str, Measured] = {}  # in the units of the file
        self.expressions: list[Expression] = []  # found by `convert`
        if chosen is not None and not isinstance(chosen, Mapping):
            self.problems.append(f'units: must be a table such as {{length = "mm"}}, not {abbreviate(chosen)}')
            return
        for kind, unit in (chosen or {}).items():
            if kind not in QUANTITY_KINDS:
                known = suggestion(kind, QUANTITY_KINDS) or "; there are " + ", ".join(QUANTITY_KINDS)
                self.problems.append(f"units.{kind}: unknown quantity{known}")
            elif not isinstance(unit, str):
                self.problems.append(
                    f"units.{kind}: must be a unit, such as {quote(QUANTITY_KINDS[kind])}, not {abbreviate(unit)}"
                )
            else:
                try:
                    conversion_factor(unit, QUANTITY_KINDS[kind])
                    self.chosen[kind] = unit
                except ValueError as problem:
                    self.problems.append(f"units.{kind}: {problem}")

    def convert(self, path: str, value: object, unit: str, problems: list[str]) -> object:
        """Convert a number, a string with its unit, or nested lists of them, to SI units; None, with a problem, on failure."""
        if isinstance(value, list | tuple):
            converted = [self.convert(f"{path}[{i}]", item, unit, problems) for i, item in enumerate(value)]
            return None if any(x is None for x in converted) else converted
        try:
            if isinstance(value, str):
                return self._read(path, value, unit)
            return self._plain(value, unit)
        except ValueError as problem:
            problems.append(f"{path}: {problem}")
            return None

    @classmethod
    def of(cls, drawing: AbstractDrawing | None) -> "Units":
        """Return the units in which a mechanism was drawn; SI units without a drawing."""
        return cls(None if drawing is None else dict(drawing.units))

    def read_text(self, text: str, unit: str) -> float:
        """Return the number that a text gives, in the SI unit `unit`; a text without a unit is in the unit of the file.

        Raises:
            ValueError: it cannot be read, or its unit is missing, unknown or of another quantity.
        """
        try:
            number = float(text)
        except ValueError:
            return read_quantity(text, unit)
        found = self._plain(number, unit)
        assert isinstance(found, float)
        return found

    def read_numbers(self, table: object, problems: list[str]) -> dict[str, NamedNumber]:
        """Return the named numbers of a table: numbers, strings with a unit, expressions of others, or `NamedNumber`s."""
        if not isinstance(table, Mapping):
            problems.append(f"numbers: must be a table, such as {{r = 40}}, not {abbreviate(table)}")
            return {}
        found: dict[str, NamedNumber] = {}
        waiting = {}
        for name, value in table.items():
            if mistake := name_mistake(name):
                problems.append(f"numbers.{name}: {mistake}")
            else:
                waiting[name] = value
        while ready := [name for name, x in waiting.items() if not self._uses(x) & waiting.keys()]:
            for name in ready:
                value = waiting.pop(name)
                try:
                    found[name], self.numbers[name] = self._named(name, value)
                except ValueError as problem:
                    problems.append(f"numbers.{name}: {problem}")
        problems += [f"numbers.{name}: refers to itself, directly or through other numbers" for name in waiting]
        return {name: found[name] for name in table if name in found}

    @staticmethod
    def _uses(value: object) -> set[str]:
        return set(names_in(value) or ()) if isinstance(value, str) and is_computed(value) else set()

    def _named(self, name: str, value: object) -> tuple[NamedNumber, Measured]:
        """Return a named number, and its value in the units of the file."""
        if isinstance(value, str) and is_computed(value):
            measured = evaluate(value, self.numbers, self.size_of)
            self.expressions.append(Expression(f"numbers.{name}.value", value, ""))
            return NamedNumber(measured.value), measured
        unit = ""
        if isinstance(value, NamedNumber):
            value, unit = value.value, value.unit
        elif isinstance(value, str):
            match = QUANTITY_PATTERN.fullmatch(value)
            if match is None or not match[2]:
                raise ValueError(f"must be a number, a number with its unit or an expression, not {quote(value)}")
            value, unit = float(match[1]), match[2]
        if isinstance(value, bool) or not isinstance(value, int | float | np.number | np.ndarray | jax.Array) or np.ndim(value):
            raise ValueError(f"must be a number, not {abbreviate(value)}")
        if not isinstance(value, Tracer) and not np.isfinite(value):
            raise ValueError(f"must be finite, not {value}")
        named = NamedNumber(value, unit)
        return named, self.measured(named)

    def measured(self, named: NamedNumber) -> Measured:
        """Return a named number in the units of the file, with the SI unit of its quantity: "" for a number without a unit."""
        if not named.unit:
            return Measured(named.value, "")
        unit = unit_of(dimension_of(named.unit))
        if unit not in QUANTITY_KINDS.values():
            raise ValueError(f"{quote(named.unit)} measures no quantity of a drawing: {', '.join(QUANTITY_KINDS)}")
        factor = conversion_factor(named.unit, unit) / self.size_of(unit)
        return Measured(named.value if factor == 1.0 else by_numpy(named.value) * factor, unit)

    def size_of(self, unit: str) -> float:
        """Return the size, in an SI unit, of the unit in which expressions have their values: the file's, by default SI's."""
        return self._factor(unit) or 1.0

    def _read(self, path: str, text: str, unit: str) -> object:
        """Return a number given as a string: a number with its unit, or an expression of named numbers."""
        names = names_in(text) or ()
        if not (names and all(name in self.numbers for name in names)):  # a name has precedence over a unit: "2*h"
            try:
                return read_quantity(text, unit)
            except ValueError:
                if not is_computed(text) or not (self.numbers or len(names) == 0):
                    raise
        found = evaluate(text, self.numbers, self.size_of)
        value = in_si(text, found, unit, self.size_of)
        if not found.unit and self._factor(unit) is None:
            raise ValueError(f"{quote(text)} needs a unit: give one of its numbers with its unit, such as {quote(f'1 {unit}')}")
        self.expressions.append(Expression(path, text, unit))
        return value

    def _plain(self, value: object, unit: str) -> object:
        if isinstance(value, bool) or not isinstance(value, int | float | np.number | np.ndarray | jax.Array) or not unit:
            return value
        factor = self._factor(unit)
        if factor is None and (isinstance(value, Tracer) or np.any(value)):
            kind = _KIND_OF.get(unit)
            chosen = " and ".join(f"{k} is in {u}" for k, u in self._changed(unit).items())
            advice = f", or choose a unit for {kind} under units" if kind else ""
            example = quote(f"{value} {unit}")
            raise ValueError(f"{value} needs a unit, as {chosen} here: write {example}{advice}")
        return value if factor in (None, 1.0) else value * factor

    def _factor(self, unit: str) -> float | None:
        """Return the factor that converts a plain number to this SI unit; None if the unit is ambiguous."""
        kind = _KIND_OF.get(unit, "")
        if kind in self.chosen:
            return conversion_factor(self.chosen[kind], unit)
        return None if kind != "density" and self._changed(unit) else 1.0

    def _changed(self, unit: str) -> dict[str, str]:
        """Return the units of the file, by quantity, that differ from the SI units of which `unit` consists."""
        kinds = [_KIND_OF.get(symbol, "") for symbol in re.findall(r"[A-Za-z]+", unit)]
        return {
            k: self.chosen[k] for k in kinds if k in self.chosen and conversion_factor(self.chosen[k], QUANTITY_KINDS[k]) != 1.0
        }

    @staticmethod
    def sizes(unit: str) -> dict[str, float]:
        """Return the size, in an SI unit, of each single unit with the same dimension, by all its spellings."""
        return unit_sizes(unit)

    def shown(self, unit: str) -> str:
        """Return the unit in which numbers with an SI unit are shown: the file's unit, or a combination of its units."""
        of_parts = {"m/s": f"{self.chosen.get('length', 'm')}/s", "rad/s": "rpm" if self.chosen.get("angle") == "deg" else unit}
        return self.chosen.get(_KIND_OF.get(unit, ""), of_parts.get(unit, unit))

    def size(self, unit: str) -> float:
        """Return the size, in an SI unit, of the unit in which numbers with this SI unit are shown."""
        return conversion_factor(self.shown(unit), unit)

    def text(self, value: float, unit: str) -> str:
        """Return a number in SI units as text, in the unit in which it is shown."""
        return format_number(value / self.size(unit), self.shown(unit))

    def write(self, value: float, unit: str) -> float | str:
        """Return a number in SI units as written to the file; reading it back gives bitwise the same number."""
        factor = self._factor(unit) if unit else 1.0
        if factor == 1.0 or value == 0.0:
            return value
        if factor is not None:
            for digits in range(1, 18):
                written = float(f"{value / factor:.{digits}g}")
                if written * factor == value:
                    return written
        return f"{value!r} {unit}"

    def write_table(self, element: eqx.Module, variant: str = "", law: str = "") -> dict[str, object]:
        """Return an element as a table in the units of the file, from which `convert_table` reads the same numbers."""
        cls, table = type(element), {}
        for name, value in table_of(element).items():
            if isinstance(value, Held):
                table[name] = self._write_samples(value, _unit(cls, name, variant, law))
            elif isinstance(value, eqx.Module):
                kind = {} if isinstance(value, AbstractProfile) else {"type": type_name(type(value))}
                nested = self.write_table(value, law=law)
                table[name] = {**kind, **{key: x for key, x in nested.items() if x is not False}}
            elif not eqx.is_array(value):
                table[name] = value
            elif name == "coefficients":
                table[name] = [self.write(x, _per_power(law, k)) for k, x in enumerate(np.asarray(value).tolist())]
            else:
                table[name] = self._write_numbers(value, _unit(cls, name, variant, law))
        return table

    def _write_numbers(self, values: Any, unit: str) -> Any:
        return jax.tree.map(lambda x: self.write(x, unit), np.asarray(values).tolist())

    def _write_samples(self, held: Held, unit: str) -> dict[str, object]:
        """Return a `Held` as a table, with the samples of a number in the SI unit `unit`."""
        return {name: self._write_numbers(x, "s" if name in HELD_TIMES else unit) for name, x in table_of(held).items()}

    def convert_table(
        self, path: str, cls: type, table: TomlTable, problems: list[str], variant: str = "", law: str = ""
    ) -> dict[str, Any]:
        """Convert the table of an element of a class to SI units; mistakes in numbers are added to the problems.

        The units of its fields are listed under the name `variant`, by default the class. `law` is the unit of a motion law.
        """
        expected, converted = keys(cls), {}
        for name, value in table.items():
            key_path, unit = f"{path}.{name}", _unit(cls, name, variant, law)
            if name not in expected:
                converted[name] = value
                continue
            annotation, sampled_class = expected[name].annotation, expected[name].sampled_class
            if sampled_class and isinstance(value, sampled_class | Mapping):
                converted[name] = self._convert_samples(key_path, value, unit, problems)
                continue
            if not _is_number(annotation):
                converted[name] = self._convert_nested(key_path, annotation, value, problems, law)
                continue
            if isinstance(value, np.ndarray | jax.Array) and value.ndim > 0 and name in (*VECTOR_FIELDS, "coefficients"):
                value = list(value)
            if name in VECTOR_FIELDS and isinstance(value, list | tuple):
                converted[name] = vector_as_angle(value)
                continue
            if name == "coefficients" and isinstance(value, list | tuple):
                coefficients = [self.convert(f"{key_path}[{k}]", x, _per_power(law, k), problems) for k, x in enumerate(value)]
                converted[name] = None if any(x is None for x in coefficients) else coefficients
            else:
                converted[name] = self.convert(key_path, value, unit, problems)
        return converted

    def _convert_samples(self, path: str, held: Held | TomlTable, unit: str, problems: list[str]) -> dict[str, object]:
        """Convert the table of a `Held`, with the samples of a number in the SI unit `unit`, to SI units."""
        table = table_of(held) if isinstance(held, Held) else held
        units = {name: "s" if name in HELD_TIMES else unit for name in keys(Held)}
        return {
            name: self.convert(f"{path}.{name}", x, units[name], problems) if name in units else x for name, x in table.items()
        }

    def _convert_nested(self, path: str, annotation: Any, value: object, problems: list[str], law: str) -> object:
        """Convert the table of a motion law or of a profile to SI units; return anything else unchanged."""
        if not isinstance(value, Mapping) or not (isinstance(annotation, type) and issubclass(annotation, eqx.Module)):
            return value
        cls = profile_class(value) if annotation is AbstractProfile else CLASSES_BY_TYPE["motion"].get(str(value.get("type")))
        return value if cls is None else self.convert_table(path, cls, value, problems, law=law)


def without_failed(mistakes: Iterable[str], failed: Iterable[str]) -> list[str]:
    """Return the mistakes in tables, except those in numbers for which `failed` has a mistake already."""
    fields = {_field(problem) for problem in failed}
    return [problem for problem in mistakes if _field(problem) not in fields]


def _field(problem: str) -> str:
    return re.sub(r"(\[\d+\])+$", "", problem.partition(": ")[0])


def _unit(cls: type, field: str, variant: str, law: str) -> str:
    return law if field in MOTION_LAW_FIELDS else field_unit(variant or cls.__name__, field)


def _per_power(unit: str, power: int) -> str:
    """Return the SI unit of the coefficient of a power in a polynomial with values in `unit`.

    The argument of the polynomial is time, or an angle or a length with the unit after " per ", as in "m per rad".
    """
    value, _, argument = unit.partition(" per ")
    return value + ("" if power == 0 else f"/{argument or 's'}" + ("" if power == 1 else f"{power}"))


def _is_number(annotation: Any) -> bool:
    return hasattr(annotation, "dim_str") and get_origin(annotation) is not Literal
