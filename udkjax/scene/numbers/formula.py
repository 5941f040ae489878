"""Expressions of named numbers, such as "2*r + 5": read, checked in their units, and evaluated."""

import ast
import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from udkjax.arrays import array_namespace, by_numpy
from udkjax.scene.numbers.quantities import dimension_of, unit_of
from udkjax.wording import quote, suggestion

LONGEST_TEXT = 500  # characters of an expression
_DEEP_NESTING = re.compile(r"[-+(]{50}")  # so many signs and brackets in a row are no expression that one would write
CONSTANTS = {"pi": math.pi}
FUNCTIONS = {"sqrt": 1, "abs": 1, "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "atan2": 2, "hypot": 2}
_NUMPY_NAMES = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"}
_SYNTAX = "write numbers and names with + - * / **, ( ), and " + ", ".join(FUNCTIONS)


class Measured(NamedTuple):
    """A value in the units of a drawing.

    Attributes:
        value: the number, which may be traced.
        unit: the SI unit of its quantity, such as "m" for any length; "" for a plain number, which takes the unit of its place.
    """

    value: Any
    unit: str


@lru_cache(1024)
def parse(text: str) -> ast.expr | None:
    """Return the syntax tree of an expression of numbers, names, operations and functions; None for any other text."""
    if len(text) > LONGEST_TEXT or _DEEP_NESTING.search(text.replace(" ", "")):
        return None
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return None
    return tree if all(map(_is_allowed, _parts(tree))) else None


def _parts(node: ast.expr) -> Iterator[ast.expr]:
    """Iterate over an expression, its operands, and the operands of these; names of functions are no operands."""
    yield node
    inner: list[ast.expr] = []
    match node:
        case ast.BinOp():
            inner = [node.left, node.right]
        case ast.UnaryOp():
            inner = [node.operand]
        case ast.Call():
            inner = list(node.args)
    for part in inner:
        yield from _parts(part)


def _is_allowed(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.BinOp(op=op):
            return isinstance(op, ast.Add | ast.Sub | ast.Mult | ast.Div | ast.Pow)
        case ast.UnaryOp(op=op):
            return isinstance(op, ast.UAdd | ast.USub)
        case ast.Call(func=ast.Name(id=name), keywords=[]):
            return FUNCTIONS.get(name) == len(node.args)
    return isinstance(node, ast.Name)


def names_in(text: str) -> tuple[str, ...] | None:
    """Return the names of numbers in an expression, each once, in order of appearance; None if the text is no expression."""
    tree = parse(text)
    if tree is None:
        return None
    names = [node.id for node in _parts(tree) if isinstance(node, ast.Name)]
    return tuple(dict.fromkeys(name for name in names if name not in CONSTANTS))


def is_computed(text: str) -> bool:
    """Return True for an expression with an operation, a function or a name: not for a single number."""
    tree = parse(text)
    while isinstance(tree, ast.UnaryOp):
        tree = tree.operand
    return tree is not None and not isinstance(tree, ast.Constant)


def name_mistake(name: object) -> str:
    """Return the reason for which expressions cannot use a name; "" if they can."""
    if not isinstance(name, str) or not isinstance(parse(name), ast.Name) or name.strip() != name:
        return "the name of a number has letters, digits and _, so that expressions can use it"
    if name in FUNCTIONS or name in CONSTANTS:
        return f"{quote(name)} has a meaning in expressions already: choose another name"
    return ""


def evaluate(text: str, numbers: Mapping[str, Measured], sizes: Callable[[str], float]) -> Measured:
    """Return the value of an expression.

    A product of quantities is the quantity of its dimension: "k*x", in N/m and m, is a force.

    Args:
        text: the expression.
        numbers: the named numbers.
        sizes: function that returns the size of the drawing's unit in a given SI unit; sin, cos, tan and their inverses use the
            drawing's unit of angle.

    Raises:
        ValueError: it cannot be read, uses an unknown name, or adds quantities of different dimensions.
    """
    tree = parse(text)
    if tree is None:
        raise ValueError(f"{quote(text)} cannot be read: {_SYNTAX}")
    with np.errstate(all="ignore"):
        return _Evaluation(numbers, sizes).value(tree)


def in_si(text: str, found: Measured, unit: str, sizes: Callable[[str], float]) -> Any:
    """Return the value that an expression gives to a number, in the SI unit of the number.

    Args:
        text: the expression.
        found: its value; one without a unit is in the drawing's unit of the number.
        unit: the SI unit of the number; "" for a number without a unit.
        sizes: function that returns the size of the drawing's unit in a given SI unit.

    Raises:
        ValueError: the expression measures another quantity.
    """
    if found.unit and not _is_same_quantity(found.unit, unit):
        raise ValueError(f"{quote(text)} is measured in {found.unit}; {unit or 'a number without a unit'} is needed here")
    factor = sizes(found.unit or unit)
    return found.value if factor == 1.0 else found.value * factor


def _is_same_quantity(unit: str, other: str) -> bool:
    """Return True if two SI units differ at most by radians, as those of w*r and v do; an angle is no plain number."""
    (*dimension, angle), (*other_dimension, other_angle) = dimension_of(unit), dimension_of(other or "1")
    return dimension == other_dimension and (any(dimension) or angle == other_angle)


class _Evaluation:
    """The evaluation of expressions with the same named numbers and sizes of units; see `evaluate`."""

    def __init__(self, numbers: Mapping[str, Measured], sizes: Callable[[str], float]):
        self._numbers, self._sizes = numbers, sizes

    def value(self, node: ast.expr) -> Measured:
        match node:
            case ast.Constant(value=value):
                return Measured(np.float64(value), "")  # pyright: ignore[reportArgumentType]
            case ast.Name(id=name):
                if name in self._numbers:
                    return Measured(by_numpy(self._numbers[name].value), self._numbers[name].unit)
                if name in CONSTANTS:
                    return Measured(np.float64(CONSTANTS[name]), "")
                raise ValueError(f"there is no number named {quote(name)}{suggestion(name, self._numbers)}")
            case ast.UnaryOp(op=op, operand=operand):
                value, unit = self.value(operand)
                return Measured(-value if isinstance(op, ast.USub) else value, unit)
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                (x, y), unit = self._alike("it adds", self.value(left), self.value(right))
                return Measured(x + y if isinstance(op, ast.Add) else x - y, unit)
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                return self._product(self.value(left), self.value(right), 1)
            case ast.BinOp(left=left, op=ast.Div(), right=right):
                return self._product(self.value(left), self.value(right), -1)
            case ast.BinOp(left=left, right=right):
                return self._power(self.value(left), right)
            case ast.Call(func=ast.Name(id=name)):
                return self._called(name, [self.value(x) for x in node.args])
        raise AssertionError(node)

    def _si(self, x: Measured) -> Any:
        size = self._sizes(x.unit)
        return x.value if size == 1.0 else x.value * size

    def _measured(self, si: Any, unit: str) -> Measured:
        """Return a value, given in SI units, in the units of the drawing."""
        size = self._sizes(unit)
        return Measured(si if size == 1.0 else si / size, unit)

    def _alike(self, operation: str, *given: Measured) -> tuple[list[Any], str]:
        """Return the values of quantities of one dimension in the same unit, and this unit; plain numbers take it as well."""
        units = list(dict.fromkeys(x.unit for x in given if x.unit))
        for other in units[1:]:
            if not _is_same_quantity(units[0], other):
                raise ValueError(f"{operation} a quantity in {units[0]} and one in {other}")
        if len(units) < 2:
            return [x.value for x in given], "".join(units)
        unit = min(units, key=lambda unit: abs(dimension_of(unit)[-1]))  # with the fewest radians
        return [x.value if x.unit in ("", unit) else self._measured(self._si(x), unit).value for x in given], unit

    def _product(self, first: Measured, second: Measured, power: int) -> Measured:
        """Return the product of a value and another one to the power 1 or -1."""
        (x, unit), (y, other) = first, second
        if other == "" or (unit == "" and power == 1) or (unit == other and power == -1):
            return Measured(x * y if power == 1 else x / y, "" if unit == other else unit or other)
        x, y = self._si(first), self._si(second)
        pairs = zip(dimension_of(unit or "1"), dimension_of(other), strict=True)
        return self._measured(x * y if power == 1 else x / y, unit_of(tuple(a + power * b for a, b in pairs)))

    def _power(self, base: Measured, exponent: ast.expr) -> Measured:
        value, unit = self.value(exponent)
        if unit:
            raise ValueError(f"an exponent must be a plain number, not a quantity in {unit}")
        if not base.unit:
            return Measured(base.value**value, "")
        if any(isinstance(node, ast.Name) and node.id not in CONSTANTS for node in _parts(exponent)):
            raise ValueError(f"the power of a quantity in {base.unit} needs an exponent without named numbers")
        dimension = [float(value) * power for power in dimension_of(base.unit)]
        if any(power != round(power) for power in dimension):
            raise ValueError(f"a quantity in {base.unit} to the power {float(value):g} has no unit")
        return self._measured(self._si(base) ** value, unit_of(tuple(round(power) for power in dimension)))

    def _called(self, name: str, given: list[Measured]) -> Measured:
        values, units, angle = [x.value for x in given], [x.unit for x in given], self._sizes("rad")
        function = getattr(array_namespace(*values), _NUMPY_NAMES.get(name, name))
        if name in ("sin", "cos", "tan"):
            if units[0] not in ("", "rad"):
                raise ValueError(f"{name} needs an angle, not a quantity in {units[0]}")
            return Measured(function(values[0] * angle), "")
        if name in ("atan2", "hypot"):
            values, unit = self._alike(f"{name} of", *given)
            return Measured(function(*values), unit) if name == "hypot" else Measured(function(*values) / angle, "rad")
        if name in ("asin", "acos", "atan"):
            if units[0]:
                raise ValueError(f"{name} needs a plain number, such as a ratio, not a quantity in {units[0]}")
            return Measured(function(*values) / angle, "rad")
        if name == "sqrt" and units[0]:
            return self._power(given[0], ast.Constant(0.5))
        return Measured(function(*values), units[0])
