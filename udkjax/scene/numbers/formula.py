"""Expressions of named numbers, such as "2*r + 5": read, checked in their units, and evaluated."""

import ast
import math
import re
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from udkjax.arrays import array_namespace, by_numpy
from udkjax.wording import quote, suggestion

LONGEST_TEXT = 500  # characters of an expression
_DEEP_NESTING = re.compile(r"[-+(]{50}")  # so many signs and brackets in a row are no expression that one would write
CONSTANTS = {"pi": math.pi}
FUNCTIONS = {"sqrt": 1, "abs": 1, "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "atan2": 2, "hypot": 2}
_ANGLE_FUNCTIONS = ("asin", "acos", "atan", "atan2")  # functions that return angles
_NUMPY_NAMES = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"}
_SYNTAX = "write numbers and names with + - * / **, ( ), and " + ", ".join(FUNCTIONS)


class Measured(NamedTuple):
    """A value in the units of a drawing.

    Attributes:
        value: the number, which may be traced.
        unit: the SI unit of its quantity, such as "m" for any length; "" for a plain number, and None where it is not known.
    """

    value: Any
    unit: str | None


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

    Args:
        text: the expression.
        numbers: the named numbers.
        sizes: function that returns the size of the drawing's unit in a given SI unit; sin, cos, tan and their inverses use the
            drawing's unit of angle.

    Raises:
        ValueError: it cannot be read, uses an unknown name, or adds quantities of different kinds.
    """
    tree = parse(text)
    if tree is None:
        raise ValueError(f"{quote(text)} cannot be read: {_SYNTAX}")
    with np.errstate(all="ignore"):
        return _value(tree, numbers, sizes("rad"))


def _value(node: ast.expr, numbers: Mapping[str, Measured], angle: float) -> Measured:
    match node:
        case ast.Constant(value=value):
            return Measured(np.float64(value), "")  # pyright: ignore[reportArgumentType]
        case ast.Name(id=name):
            if name in numbers:
                return Measured(by_numpy(numbers[name].value), numbers[name].unit)
            if name in CONSTANTS:
                return Measured(np.float64(CONSTANTS[name]), "")
            raise ValueError(f"there is no number named {quote(name)}{suggestion(name, numbers)}")
        case ast.UnaryOp(op=op, operand=operand):
            value, unit = _value(operand, numbers, angle)
            return Measured(-value if isinstance(op, ast.USub) else value, unit)
        case ast.BinOp(left=left, op=op, right=right):
            return _combined(op, _value(left, numbers, angle), _value(right, numbers, angle))
        case ast.Call(func=ast.Name(id=name)):
            return _called(name, [_value(x, numbers, angle) for x in node.args], angle)
    raise AssertionError(node)


def _combined(op: ast.operator, first: Measured, second: Measured) -> Measured:
    (x, unit), (y, other) = first, second
    match op:
        case ast.Add() | ast.Sub():
            return Measured(x + y if isinstance(op, ast.Add) else x - y, _common(unit, other))
        case ast.Mult():
            return Measured(x * y, unit if other == "" else other if unit == "" else None)
        case ast.Div():
            return Measured(x / y, unit if other == "" else "" if unit == other else None)
    return Measured(x**y, "" if unit == other == "" else None)


def _common(unit: str | None, other: str | None) -> str | None:
    """Return the unit of a sum of quantities with two units: a plain number ("") takes the unit of the other one."""
    if unit and other and unit != other:
        raise ValueError(f"it adds a quantity in {unit} and one in {other}")
    return unit if other == "" else other if unit == "" else unit if unit == other else None


def _called(name: str, given: list[Measured], angle: float) -> Measured:
    values, units = [x.value for x in given], [x.unit for x in given]
    function = getattr(array_namespace(*values), _NUMPY_NAMES.get(name, name))
    if name in ("sin", "cos", "tan"):
        if units[0] not in ("", "rad", None):
            raise ValueError(f"{name} needs an angle, not a quantity in {units[0]}")
        return Measured(function(values[0] * angle), "")
    if name in _ANGLE_FUNCTIONS:
        return Measured(function(*values) / angle, "rad")
    unit = units[0] if name == "abs" else _common(*units) if name == "hypot" else "" if units[0] == "" else None
    return Measured(function(*values), unit)
