"""Loops of few operations on Python's floats, row by row; for many states at once by a generated function of NumPy's arrays.

In that function each number of an array is a variable, from the row that writes it to those that read it: an array with one
number for each state.
"""

import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, SET
from udkjax.expressions.scalars.scalar_program import ScalarProgram
from udkjax.expressions.scalars.written_steps import PythonFunction

_UPDATES_OF_FLOATS = {  # NaN propagates
    ADD: operator.add,
    MAXIMUM: lambda a, b: a if a >= b or a != a else b,
    ALL: lambda a, b: a if a <= b or a != a else b,
}
_UPDATES_OF_ARRAYS = {ADD: operator.add, MAXIMUM: np.maximum, ALL: np.minimum}
FEW_ROWS = 8  # up to this, Python floats (0.05 us per operation and row) are faster than NumPy arrays (0.6 us per operation)
FEW_OPERATIONS = 2_000  # of all rows, up to which they are faster however many rows a loop has: NumPy takes 20 us for each loop
_WORTH_WRITING = 20  # runs at many states that take as long as generating a function (20 us per operation)

Lists: TypeAlias = dict[str, list[Any]]  # the numbers of each array: floats, or arrays of one number for each state


class LaidOutPart(NamedTuple):
    """A part of a program with the indices of each of its numbers, one for each row of its table."""

    run: ScalarProgram | float  # a float: the constant that part of an array is set to
    inputs: list[tuple[str, Any]]  # array ("" if unused) and indices of each
    outputs: list[tuple[str, Any, str]]  # array, indices and update of each
    count: int  # number of rows


class FloatLoops:
    """The parts of a program whose loops have few rows, as a function of the lists of its numbers, which it changes.

    Rows run one after another, so that a row may read what an earlier one has written.

    It raises `ArithmeticError` or `ValueError` if a number is not finite. Of other arrays than `results`, if given, the lists may
    stay as they are.
    """

    def __init__(self, parts: Sequence[LaidOutPart], results: Collection[str] | None = None):
        self._results = results
        self._parts, self._has_few_rows = [_with_lists(part) for part in parts if part.outputs], _has_few_rows(parts)
        self._runs_of_many, self._function_of_many = 0, None

    @staticmethod
    def support(parts: Sequence[LaidOutPart]) -> bool:
        """Return True if there are few rows, and no calls of JAX."""
        programs = [(part.run, part.count) for part in parts if isinstance(part.run, ScalarProgram)]
        if not all(run.is_plain for run, _ in programs):
            return False
        return _has_few_rows(parts) or sum(rows * len(run.order) for run, rows in programs) <= FEW_OPERATIONS

    def __call__(self, lists: Lists) -> None:
        for part in self._parts:
            _run(part, lists)

    def of_many(self, names: Collection[str]) -> Callable[[Lists], None] | None:
        """Return the function of the lists of these names at many states; None until it has run so often that it is worth it."""
        self._runs_of_many += self._has_few_rows
        if self._runs_of_many == _WORTH_WRITING:
            self._function_of_many = _write(self._parts, names, self._results)
        return self._function_of_many


def _has_few_rows(parts: Sequence[LaidOutPart]) -> bool:
    return all(part.count <= FEW_ROWS for part in parts if isinstance(part.run, ScalarProgram))


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
    for k in range(part.count):
        row = run([lists[name][places[k]] if name else 0.0 for name, places in part.inputs])
        for x, (name, places, update) in zip(row, part.outputs, strict=True):
            target, place = lists[name], places[k]
            target[place] = x if update == SET else _UPDATES_OF_FLOATS[update](target[place], x)


def _write(parts: Sequence[LaidOutPart], names: Collection[str], results: Collection[str] | None) -> Callable[[Lists], None]:
    """Return the parts as one function of the lists of arrays, which have the given names."""
    text = PythonFunction("lists")
    lists = {name: text.assign(f"lists[{name!r}]") for name in names}
    known: dict[tuple[str, int], str] = {}  # the variables of numbers
    written: dict[tuple[str, int], None] = {}

    def read(name: str, place: int) -> str:
        if (name, place) not in known:
            known[name, place] = text.assign(f"{lists[name]}[{place}]")
        return known[name, place]

    for part in parts:
        for k in range(part.count):
            if isinstance(part.run, ScalarProgram):
                row = part.run.on_arrays.write(text, [read(name, places[k]) if name else "0.0" for name, places in part.inputs])
            else:
                row = [text.assign(repr(part.run))]
            for x, (name, places, update) in zip(row, part.outputs, strict=True):
                place = places[k]
                known[name, place] = x if update == SET else text.call(_UPDATES_OF_ARRAYS[update], read(name, place), x)
                written[name, place] = None
    text.lines += [f"{lists[name]}[{k}] = {known[name, k]}" for name, k in written if results is None or name in results]
    text.drop_unused()
    return text.compile()
