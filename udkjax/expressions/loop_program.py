"""Programs of large scenes: loops over elements that are alike, each running a small straight-line program.

A `Kernel` is the program with the addresses of its inputs and outputs, relative to some bases; a `KernelLoop` runs it for every
row of a table of bases, in order. The code grows with the number of kinds of elements, the tables with the number of elements.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from udkjax.expressions.graph import Graph, Scalar
from udkjax.expressions.scalar_program import ScalarProgram

SET, ADD, MINIMUM = "set", "add", "least"  # an output replaces what is there, is added to it, or the smaller of both stays


class Address(NamedTuple):
    """Where a number lies: so many behind a base in an array. `base` is a column of the table, or None: the array's start."""

    array: str
    base: int | None
    offset: int = 0
    update: str = SET


class Kernel:
    """A straight-line program of one thing among many that are alike."""

    def __init__(self, program: ScalarProgram, inputs: Sequence[Address], outputs: Sequence[Address]):
        self.program, self.inputs, self.outputs = program, list(inputs), list(outputs)
        used = {s.array for x, s in zip(program.inputs, inputs, strict=True) if program.uses(x)}
        self.arrays = sorted(used | {s.array for s in outputs})


class KernelWriter:
    """Writes a kernel: what it reads, what it computes in `graph`, and where it writes that to."""

    def __init__(self, graph: Graph | None = None):
        self.graph = Graph() if graph is None else graph
        self._inputs: dict[Scalar, Address] = {}
        self._outputs: list[tuple[Scalar, Address]] = []

    def read(self, array: str, base: int | None, offset: int = 0) -> Scalar:
        """Read a number of an array."""
        s = self.graph.input((array, base, offset), array)
        self._inputs[s] = Address(array, base, offset)
        return s

    def bind(self, s: Scalar, array: str, base: int | None, offset: int = 0) -> None:
        """Read an input that the graph has already."""
        self._inputs[s] = Address(array, base, offset)

    def write(self, s: Scalar, array: str, base: int | None, offset: int = 0, update: str = SET) -> None:
        """Write a number to an array."""
        self._outputs.append((s, Address(array, base, offset, update)))

    def kernel(self) -> Kernel:
        """Return what was written."""
        program = ScalarProgram(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [address for _, address in self._outputs])


class KernelLoop(NamedTuple):
    """A kernel for every row of a table of bases (things, columns)."""

    kernel: Kernel
    table: np.ndarray
    names: Mapping[str, str] = {}  # of the kernel's arrays: which they are here, if another

    def array(self, name: str) -> str:
        """Which array one of the kernel's is."""
        return self.names.get(name, name)


class Reset(NamedTuple):
    """Some numbers of an array become a constant."""

    array: str
    start: int
    count: int
    value: float = 0.0


class LoopProgram(NamedTuple):
    """Loops one after another."""

    parts: Sequence[KernelLoop | Reset]

    @property
    def arrays(self) -> set[str]:
        """All arrays that it reads or writes."""
        found = {part.array for part in self.parts if isinstance(part, Reset)}
        return found.union(*({part.array(x) for x in part.kernel.arrays} for part in self.parts if isinstance(part, KernelLoop)))


def evaluate_loops(program: LoopProgram, arrays: dict[str, Any], xp: Any) -> dict[str, Any]:
    """The arrays as a program leaves them, all rows of a loop at once, by NumPy or JAX: none may take anything from another."""
    found = dict(arrays)
    for part in program.parts:
        if isinstance(part, Reset):
            inside = np.arange(part.start, part.start + part.count)
            found[part.array] = _update(found[part.array], inside, xp.full(part.count, part.value), SET, xp)
            continue
        kernel, table = part.kernel, part.table
        if not kernel.outputs or not len(table):
            continue

        def places(address: Address, table: np.ndarray = table) -> np.ndarray:
            return address.offset + (np.zeros(len(table), int) if address.base is None else table[:, address.base])

        pairs = list(zip(kernel.program.inputs, kernel.inputs, strict=True))
        values = [found[part.array(x.array)][places(x)] if kernel.program.uses(s) else np.zeros(len(table)) for s, x in pairs]
        run = kernel.program.by_numpy if xp is np or not values else jax.vmap(kernel.program)
        for x, address in zip(run(values), kernel.outputs, strict=True):
            name = part.array(address.array)
            found[name] = _update(found[name], places(address), x, address.update, xp)
    return found


def _update(array: Any, places: np.ndarray, x: Any, update: str, xp: Any) -> Any:
    if xp is not np:
        return array.at[places].add(x) if update == ADD else array.at[places].set(x)
    array = array.copy()
    (np.add.at if update == ADD else np.ndarray.__setitem__)(array, places, x)
    return array
