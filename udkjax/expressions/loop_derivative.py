"""Derivatives of programs of loops, forward and reverse: kernel by kernel.

Every array x has another one for its changes, `d_x`, or for its cotangents, `bar_x`. What a program has computed on the way must
still be there: no number is written again once it has been read.
"""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from udkjax.expressions.differential import cotangents, tangents
from udkjax.expressions.emit import Program
from udkjax.expressions.graph import Scalar
from udkjax.expressions.loop_program import ADD, SET, Clear, Kernel, Loop, LoopProgram, Slot

TANGENT, COTANGENT = "d_", "bar_"


class LoopDerivative:
    """The derivative of some loops with respect to all arrays but those that are `fixed`."""

    def __init__(self, parts: Sequence[Loop | Clear], fixed: Collection[str]):
        self._parts, self._fixed = list(parts), frozenset(fixed)
        self._kernels: dict[tuple[str, Kernel, frozenset[str]], Kernel | None] = {}

    @property
    def forward(self) -> LoopProgram:
        """The changes of all arrays, from those of what the program does not compute."""
        parts: list[Loop | Clear] = []
        for part in self._parts:
            if isinstance(part, Clear):
                if part.array not in self._fixed:
                    parts.append(Clear(TANGENT + part.array, part.start, part.count))
            else:
                parts += self._differentiated(part, TANGENT, self._pushed, part.table)
        return LoopProgram(parts)

    @property
    def reverse(self) -> LoopProgram:
        """The cotangents of all arrays, added to those of what the program returns."""
        parts: list[Loop | Clear] = []
        for part in reversed(self._parts):
            if isinstance(part, Loop):
                parts += self._differentiated(part, COTANGENT, self._pulled, part.table[::-1])
        return LoopProgram(parts)

    def _differentiated(self, part: Loop, prefix: str, write: Callable, table: np.ndarray) -> list[Loop]:
        still = frozenset(name for name in part.kernel.arrays if part.array(name) in self._fixed)
        key = prefix, part.kernel, still
        if key not in self._kernels:
            self._kernels[key] = write(part.kernel, still)
        kernel = self._kernels[key]
        names = {**part.names, **{prefix + x: prefix + y for x, y in part.names.items()}}
        return [] if kernel is None else [Loop(kernel, table, names)]

    def _pushed(self, kernel: Kernel, still: frozenset[str]) -> Kernel | None:
        moving, outputs = _moving(kernel, still)
        graph = kernel.program.graph
        seeds = {s: graph.input((TANGENT, s.index), "tangent") for s, _ in moving}
        found = tangents(graph, [s for s, _ in outputs], seeds)
        places = [slot for _, slot in outputs]
        written = [(s, slot) for s, slot in zip(found, places, strict=True) if slot.how == SET or not s.is_zero]
        seeded = [(seeds[s], slot) for s, slot in moving]
        return _kernel(kernel, seeded, written, TANGENT)

    def _pulled(self, kernel: Kernel, still: frozenset[str]) -> Kernel | None:
        moving, outputs = _moving(kernel, still)
        graph = kernel.program.graph
        seeds = [graph.input((COTANGENT, k), "cotangent") for k in range(len(outputs))]
        found = cotangents(graph, [s for s, _ in outputs], seeds, [s for s, _ in moving])
        places = [slot._replace(how=ADD) for _, slot in moving]
        written = [(s, slot) for s, slot in zip(found, places, strict=True) if not s.is_zero]
        return _kernel(kernel, list(zip(seeds, (slot for _, slot in outputs), strict=True)), written, COTANGENT)


Placed = list[tuple[Scalar, Slot]]


def _moving(kernel: Kernel, still: frozenset[str]) -> tuple[Placed, Placed]:
    """Of inputs that are used, and of outputs: those that have derivatives."""
    program = kernel.program
    inputs = [(s, slot) for s, slot in zip(program.inputs, kernel.inputs, strict=True) if program.uses(s)]
    outputs = zip(program.outputs, kernel.outputs, strict=True)
    return [x for x in inputs if x[1].array not in still], [x for x in outputs if x[1].array not in still]


def _kernel(kernel: Kernel, seeds: Placed, outputs: Placed, prefix: str) -> Kernel | None:
    """A kernel that also takes `seeds`, with what it returns in arrays with a prefix."""
    if not outputs:
        return None
    inputs = list(zip(kernel.program.inputs, kernel.inputs, strict=True))
    inputs += [(s, slot._replace(array=prefix + slot.array, how=SET)) for s, slot in seeds]
    places = [slot._replace(array=prefix + slot.array) for _, slot in outputs]
    program = Program(kernel.program.graph, [s for s, _ in inputs], [s for s, _ in outputs])
    return Kernel(program, [slot for _, slot in inputs], places)
