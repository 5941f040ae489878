"""Loops of few rows on Python's floats: run row by row at first, and as one generated Python function once they have run often.

In the function each number of an array is a variable, from the row that writes it to those that read it. For many states at once
these variables are NumPy arrays, one number for each state.
"""

import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from udkjax.expressions.loop_program import ADD, ALL, MAXIMUM, SET
from udkjax.expressions.scalar_program import ScalarProgram
from udkjax.expressions.written_steps import PythonFunction

_UPDATES_OF_FLOATS = {  # NaN propagates
    ADD: operator.add,
    MAXIMUM: lambda a, b: a if a >= b or a != a else b,
    ALL: lambda a, b: a if a <= b or a != a else b,
}
_UPDATES_OF_ARRAYS = {ADD: operator.add, MAXIMUM: np.maximum, ALL: np.minimum}
FEW_ROWS = 8  # up to this, Python floats (0.05 us per operation and row) are faster than NumPy arrays (0.6 us per operation)
# Runs row by row that take as long as generating a Python function (20 us per operation); it runs three times as fast.
_WORTH_WRITING = 100
_WORTH_WRITING_FOR_MANY = 20  # the same for runs at many states, each of which takes longer

Lists: TypeAlias = dict[str, list[Any]]  # the numbers of each array: floats, or arrays of one number for each state


class LaidOutPart(NamedTuple):
    """A part of a program with the indices of each of its numbers, one for each row of its table."""

    run: ScalarProgram | float  # a float: the constant that part of an array is set to
    inputs: list[tuple[str, Any]]  # array ("" if unused) and indices of each
    outputs: list[tuple[str, Any, str]]  # array, indices and update of each
    count: int  # number of rows


class FloatLoops:
    """The parts of a program whose loops have few rows, as a function of the lists of its numbers, which it changes.

    It raises `ArithmeticError` or `ValueError` if a number is not finite.
    """

    def __init__(self, parts: Sequence[LaidOutPart]):
        self._parts = [_with_lists(part) for part in parts if part.outputs]
        self._runs, self._function = 0, None
        self._runs_of_many, self._function_of_many = 0, None

    @staticmethod
    def support(parts: Sequence[LaidOutPart]) -> bool:
        """Return True if there are few rows, and no calls of JAX."""
        programs = [(part.run, part.count) for part in parts if isinstance(part.run, ScalarProgram)]
        return all(rows <= FEW_ROWS and run.is_plain for run, rows in programs)

    def __call__(self, lists: Lists) -> None:
        if self._function is not None:
            self._function(lists)
            return
        for part in self._parts:
            _run(part, lists)
        self._runs += 1
        if self._runs == _WORTH_WRITING:
            self._function = _write(self._parts, lists.keys())

    def of_many(self, names: Collection[str]) -> Callable[[Lists], None] | None:
        """Return the function of the lists of these names at many states; None until it has run so often that it is worth it."""
        self._runs_of_many += 1
        if self._runs_of_many == _WORTH_WRITING_FOR_MANY:
            self._function_of_many = _write(self._parts, names, many=True)
        return self._function_of_many


def _with_lists(part: LaidOutPart) -> LaidOutPart:
    """Return a part with lists instead of arrays."""
    if not isinstance(part.run, ScalarProgram):
        return part._replace(outputs=[(name, range(x.start, x.stop), update) for name, x, update in part.outputs])
    inputs = [(name, places.tolist()) for name, places in part.inputs]
    return part._replace(inputs=inputs, outputs=[(name, places.tolist(), update) for name, places, update in part.outputs])


def _run(part: LaidOutPart, lists: Lists) -> None:
    """Run a part row by row."""
    if not isinstance(part.run, ScalarProgram):
        for name, places, _ in part.outputs:
            lists[name][places.start : places.stop] = [part.run] * part.count
        return
    run = part.run.on_floats
    columns = [[lists[name][k] for k in places] if name else places for name, places in part.inputs]
    rows = [run(row) for row in (zip(*columns, strict=True) if columns else [()] * part.count)]
    for column, (name, places, update) in zip(zip(*rows, strict=True), part.outputs, strict=True):
        target = lists[name]
        for k, x in zip(places, column, strict=True):
            target[k] = x if update == SET else _UPDATES_OF_FLOATS[update](target[k], x)


def _write(parts: Sequence[LaidOutPart], names: Collection[str], many: bool = False) -> Callable[[Lists], None]:
    """Return the parts as one function of the lists, which have the given names, of floats or of arrays for many states."""
    updates = _UPDATES_OF_ARRAYS if many else _UPDATES_OF_FLOATS
    text = PythonFunction("lists")
    lists = {name: text.assign(f"lists[{name!r}]") for name in names}
    known: dict[tuple[str, int], str] = {}  # the variables of numbers
    written: dict[tuple[str, int], None] = {}

    def read(name: str, place: int) -> str:
        if (name, place) not in known:
            known[name, place] = text.assign(f"{lists[name]}[{place}]")
        return known[name, place]

    for part in parts:
        if isinstance(part.run, ScalarProgram):
            program = part.run.on_arrays if many else part.run.on_floats
            inputs = [[read(name, k) if name else "0.0" for name, k in row] for row in _rows(part.inputs, part.count)]
            rows = [program.write(text, row) for row in inputs]
        else:
            rows = [[text.assign(repr(part.run))]] * part.count
        for column, (name, places, update) in zip(zip(*rows, strict=True), part.outputs, strict=True):
            for k, x in zip(places, column, strict=True):
                known[name, k] = x if update == SET else text.call(updates[update], read(name, k), x)
                written[name, k] = None
    text.lines += [f"{lists[name]}[{k}] = {known[name, k]}" for name, k in written]
    return text.compile()


def _rows(columns: Sequence[tuple[str, Any]], count: int) -> list[list[tuple[str, int]]]:
    """Return the array and index of each input of each row."""
    return [[(name, places[k]) for name, places in columns] for k in range(count)]
