"""Loops of few operations on Python's floats, row by row."""

import operator
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, SET
from udkjax.expressions.scalars.scalar_program import ScalarProgram

_UPDATES_OF_FLOATS = {  # NaN propagates
    ADD: operator.add,
    MAXIMUM: lambda a, b: a if a >= b or a != a else b,
    ALL: lambda a, b: a if a <= b or a != a else b,
}
FEW_ROWS = 8  # up to this, Python floats (0.05 us per operation and row) are faster than NumPy arrays (0.6 us per operation)
FEW_OPERATIONS = 2_000  # of all rows, up to which they are faster however many rows a loop has: NumPy takes 20 us for each loop

Lists: TypeAlias = dict[str, list[Any]]  # the numbers of each array


class LaidOutPart(NamedTuple):
    """A part of a program. The indices of each number that it reads or writes are known: one for each row of its table."""

    run: ScalarProgram | float  # a float: the constant that part of an array is set to
    inputs: list[tuple[str, Any]]  # array ("" if unused) and indices of each
    outputs: list[tuple[str, Any, str]]  # array, indices and update of each
    count: int  # number of rows


class FloatLoops:
    """A loop program of few rows or operations as a function of lists with the numbers of each array, which it changes.

    Rows run one after another, so that a row may read numbers that an earlier row has written. A call raises `ArithmeticError` or
    `ValueError` if a number is not finite.
    """

    def __init__(self, parts: Sequence[LaidOutPart]):
        self._parts = [_with_lists(part) for part in parts if part.outputs]

    @staticmethod
    def support(parts: Sequence[LaidOutPart]) -> bool:
        """Return True if the parts have few rows or few operations, and no operation calls JAX."""
        programs = [(part.run, part.count) for part in parts if isinstance(part.run, ScalarProgram)]
        if not all(run.is_plain for run, _ in programs):
            return False
        return _has_few_rows(parts) or sum(rows * len(run.order) for run, rows in programs) <= FEW_OPERATIONS

    def __call__(self, lists: Lists) -> None:
        for part in self._parts:
            _run(part, lists)


def _has_few_rows(parts: Sequence[LaidOutPart]) -> bool:
    return all(part.count <= FEW_ROWS for part in parts if isinstance(part.run, ScalarProgram))


def _with_lists(part: LaidOutPart) -> LaidOutPart:
    """Return a part whose indices are lists instead of arrays."""
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
