"""Steps on numbers: run one by one at first, and as one generated Python function once they have run often."""

import operator
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

Operand: TypeAlias = Any  # a number or array of Python, NumPy or JAX, each with its own operators

_SYMBOLS: dict[Callable, str] = {operator.add: "+", operator.sub: "-", operator.mul: "*", operator.truediv: "/"}
# Runs of single steps that take as long as generating a Python function, which is three times as fast.
_WORTH_WRITING = 20


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
        lines = ["def run(values):"]
        if self._input_count:
            lines.append(f" {''.join(f'x{k}, ' for k in range(self._input_count))} = values")
        functions: dict[str, Any] = {}
        for k, (function, places) in enumerate(self._steps, self._input_count):
            arguments = [f"x{p}" for p in places]
            if function in _SYMBOLS:
                expression = f"{arguments[0]} {_SYMBOLS[function]} {arguments[1]}"
            elif function is operator.neg:
                expression = f"-{arguments[0]}"
            else:
                functions[f"f{k}"] = function
                expression = f"f{k}({', '.join(arguments)})"
            lines.append(f" x{k} = {expression}")
        lines.append(f" return [{', '.join(f'x{k}' for k in self._outputs)}]")
        exec("\n".join(lines), functions)
        return functions["run"]
