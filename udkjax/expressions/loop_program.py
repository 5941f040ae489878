"""Programs of large scenes: loops over what is alike, each a small straight-line program.

A `Kernel` is the program, with where its inputs and outputs lie relative to some bases; a `Loop` runs it for every row of a table
of bases, in order. The code grows with the kinds of things that there are, the tables with their number.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.expressions.emit import Program
from udkjax.expressions.graph import Graph, Scalar

SET, ADD, LEAST = "set", "add", "least"  # an output replaces what is there, is added to it, or the smaller of both stays


class Slot(NamedTuple):
    """Where a number lies: so many behind a base in an array. `base` is a column of the table, or None: the array's start."""

    array: str
    base: int | None
    offset: int = 0
    how: str = SET


class Kernel:
    """A straight-line program of one thing among many that are alike."""

    def __init__(self, program: Program, inputs: Sequence[Slot], outputs: Sequence[Slot]):
        self.program, self.inputs, self.outputs = program, list(inputs), list(outputs)
        used = {s.array for x, s in zip(program.inputs, inputs, strict=True) if program.uses(x)}
        self.arrays = sorted(used | {s.array for s in outputs})


class KernelWriter:
    """Writes a kernel: what it reads, what it computes in `graph`, and where it writes that to."""

    def __init__(self, graph: Graph | None = None):
        self.graph = Graph() if graph is None else graph
        self._inputs: dict[Scalar, Slot] = {}
        self._outputs: list[tuple[Scalar, Slot]] = []

    def read(self, array: str, base: int | None, offset: int = 0) -> Scalar:
        """Read a number of an array."""
        s = self.graph.input((array, base, offset), array)
        self._inputs[s] = Slot(array, base, offset)
        return s

    def bind(self, s: Scalar, array: str, base: int | None, offset: int = 0) -> None:
        """Read an input that the graph has already."""
        self._inputs[s] = Slot(array, base, offset)

    def write(self, s: Scalar, array: str, base: int | None, offset: int = 0, how: str = SET) -> None:
        """Write a number to an array."""
        self._outputs.append((s, Slot(array, base, offset, how)))

    def kernel(self) -> Kernel:
        """Return what was written."""
        program = Program(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [slot for _, slot in self._outputs])


class Loop(NamedTuple):
    """A kernel for every row of a table of bases (things, columns)."""

    kernel: Kernel
    table: np.ndarray
    names: Mapping[str, str] = {}  # of the kernel's arrays: which they are here, if another

    def array(self, name: str) -> str:
        """Which array one of the kernel's is."""
        return self.names.get(name, name)


class Clear(NamedTuple):
    """Some numbers of an array become a constant."""

    array: str
    start: int
    count: int
    value: float = 0.0


class LoopProgram(NamedTuple):
    """Loops one after another."""

    parts: Sequence[Loop | Clear]

    @property
    def arrays(self) -> set[str]:
        """All arrays that it reads or writes."""
        found = {part.array for part in self.parts if isinstance(part, Clear)}
        return found.union(*({part.array(x) for x in part.kernel.arrays} for part in self.parts if isinstance(part, Loop)))


def evaluate_loops(program: LoopProgram, arrays: dict[str, Any], xp: Any) -> dict[str, Any]:
    """The arrays as a program leaves them, all rows of a loop at once, by NumPy or JAX: none may take anything from another."""
    found = dict(arrays)
    for part in program.parts:
        if isinstance(part, Clear):
            inside = np.arange(part.start, part.start + part.count)
            found[part.array] = _placed(found[part.array], inside, xp.full(part.count, part.value), SET, xp)
            continue
        kernel, table = part.kernel, part.table
        if not kernel.outputs or not len(table):
            continue

        def places(slot: Slot, table: np.ndarray = table) -> np.ndarray:
            return slot.offset + (np.zeros(len(table), int) if slot.base is None else table[:, slot.base])

        pairs = list(zip(kernel.program.inputs, kernel.inputs, strict=True))
        values = [found[part.array(x.array)][places(x)] if kernel.program.uses(s) else np.zeros(len(table)) for s, x in pairs]
        run = kernel.program.by_numpy if xp is np or not values else jax.vmap(kernel.program)
        for x, slot in zip(run(values), kernel.outputs, strict=True):
            name = part.array(slot.array)
            found[name] = _placed(found[name], places(slot), x, slot.how, xp)
    return found


def _placed(array: Any, places: np.ndarray, x: Any, how: str, xp: Any) -> Any:
    if xp is not np:
        return array.at[places].add(x) if how == ADD else array.at[places].set(x)
    array = array.copy()
    (np.add.at if how == ADD else np.ndarray.__setitem__)(array, places, x)
    return array
