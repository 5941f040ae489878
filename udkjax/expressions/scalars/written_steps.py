"""Steps on numbers: run one by one at first, and as one generated Python function once they have run often."""

import operator
import re
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

Operand: TypeAlias = Any  # a number or array of Python, NumPy or JAX, each with its own operators

_SYMBOLS: dict[Callable, str] = {
    operator.add: "+",
    operator.sub: "-",
    operator.mul: "*",
    operator.truediv: "/",
    operator.lt: "<",
    operator.le: "<=",
    operator.gt: ">",
    operator.ge: ">=",
    operator.eq: "==",
    operator.ne: "!=",
}
_NAME = re.compile(r"\bx\d+\b")
# Runs of single steps that take as long as generating a Python function, which is three times as fast.
_WORTH_WRITING = 20


def written_as(text: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function, with the text of an expression of its arguments {0}, {1}, ... attached.

    `PythonFunction.call` writes this expression instead of a call.
    """
    function.text = text  # pyright: ignore[reportFunctionMemberAccess]
    return function


class PythonFunction:
    """The text of a function of one argument that is being written; each value has a name of its own."""

    def __init__(self, argument: str):
        self.lines: list[str] = []
        self._argument, self._known, self._count = argument, dict[str, Any](), 0
        self._names = dict[str, str]()  # by expression

    def new_name(self) -> str:
        """Return a name that no other value has."""
        self._count += 1
        return f"x{self._count}"

    def assign(self, expression: str) -> str:
        """Write the assignment of an expression to a new name, and return the name; the same expression is assigned once."""
        if expression not in self._names:
            self._names[expression] = name = self.new_name()
            self.lines.append(f"{name} = {expression}")
        return self._names[expression]

    def call(self, function: Callable[..., Any], *arguments: str) -> str:
        """Write a call of a function of named values, and return the name of its result."""
        if function in _SYMBOLS:
            return self.assign(f"{arguments[0]} {_SYMBOLS[function]} {arguments[1]}")
        if function is operator.neg:
            return self.assign(f"-{arguments[0]}")
        if (text := getattr(function, "text", None)) is not None:
            return self.assign(text.format(*arguments))
        key = f"f{id(function)}"
        self._known[key] = function
        return self.assign(f"{key}({', '.join(arguments)})")

    def drop_unused(self) -> None:
        """Drop the lines whose values no later line uses."""
        used, lines = set[str](), []
        for line in reversed(self.lines):
            name, is_assigned, expression = line.partition(" = ")
            if not (is_assigned and _NAME.fullmatch(name)) or name in used:
                used.update(_NAME.findall(expression if is_assigned else line), _NAME.findall(name))
                lines.append(line)
        self.lines = lines[::-1]

    def compile(self) -> Callable[[Any], Any]:
        """Return the function that the written lines define."""
        exec("\n ".join([f"def run({self._argument}):", *self.lines]), self._known)
        return self._known.pop("run")


class WrittenSteps:
    """Functions called one after another; the arguments of each are given numbers or earlier results.

    Args:
        input_count: the number of given numbers.
        steps: each function with the indices of its arguments, which count the given numbers first, then the results.
        outputs: the indices of the results that are returned.
    """

    def __init__(self, input_count: int, steps: list[tuple[Callable, list[int]]], outputs: list[int]):
        self._input_count, self._steps, self._outputs = input_count, steps, outputs
        self._runs, self._function = 0, None

    def __call__(self, values: Sequence[Operand]) -> list[Operand]:
        if self._function is None:
            self._runs += 1
            if self._runs <= _WORTH_WRITING:
                results: list[Operand] = [*values]
                for function, places in self._steps:
                    results.append(function(*[results[k] for k in places]))
                return [results[k] for k in self._outputs]
            self._function = self._write()
        return self._function(values)

    def _write(self) -> Callable[[Sequence[Operand]], list[Operand]]:
        """Return the steps as one Python function."""
        text = PythonFunction("values")
        inputs = [text.new_name() for _ in range(self._input_count)]
        if inputs:
            text.lines.append(f"{', '.join(inputs)}, = values")
        text.lines.append(f"return [{', '.join(self.write(text, inputs))}]")
        return text.compile()

    def write(self, text: PythonFunction, inputs: Sequence[str]) -> list[str]:
        """Write the steps into the text of a function, given the names of the inputs, and return the names of the outputs."""
        names = [*inputs]
        for function, places in self._steps:
            names.append(text.call(function, *[names[k] for k in places]))
        return [names[k] for k in self._outputs]
