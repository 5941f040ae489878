"""Programs of large scenes: loops over elements that are alike, each running a small straight-line program.

A `Kernel` is the program with the addresses of its inputs and outputs, relative to some bases; a `KernelLoop` runs it for every
row of a table of bases, in order. The code grows with the number of kinds of elements, the tables with the number of elements.
"""

from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from udkjax.expressions.graph import Graph, Scalar
from udkjax.expressions.scalar_program import ScalarProgram

AnyArray = TypeVar("AnyArray", jax.Array, np.ndarray)
SET, ADD, MINIMUM = "set", "add", "least"  # an output replaces what is there, is added to it, or the smaller of both stays


class Address(NamedTuple):
    """The address of a number: `offset` places behind a base in an array, a column of the table (None: the array's start)."""

    array: str
    base: int | None
    offset: int = 0
    update: str = SET


class Kernel:
    """A straight-line program of one element among many that are alike."""

    def __init__(self, program: ScalarProgram, inputs: Sequence[Address], outputs: Sequence[Address]):
        self.program, self.inputs, self.outputs = program, list(inputs), list(outputs)
        used = {s.array for x, s in zip(program.inputs, inputs, strict=True) if program.uses(x)}
        self.arrays = sorted(used | {s.array for s in outputs})


class KernelWriter:
    """Writes a kernel: its inputs, the graph that computes its outputs, and the addresses of both."""

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
        """Return the kernel that was written."""
        program = ScalarProgram(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [address for _, address in self._outputs])


class KernelLoop(NamedTuple):
    """A kernel for every row of a table of bases (things, columns)."""

    kernel: Kernel
    table: np.ndarray
    names: Mapping[str, str] = {}  # from the kernel's names of arrays to the program's, where they differ

    def array(self, name: str) -> str:
        """Return the program's name of one of the kernel's arrays."""
        return self.names.get(name, name)


class Reset(NamedTuple):
    """Sets some numbers of an array to a constant."""

    array: str
    start: int
    count: int
    value: float = 0.0


class LoopProgram(NamedTuple):
    """Loops one after another."""

    parts: Sequence[KernelLoop | Reset]

    @property
    def arrays(self) -> set[str]:
        """The names of all arrays that the program reads or writes."""
        found = {part.array for part in self.parts if isinstance(part, Reset)}
        return found.union(*({part.array(x) for x in part.kernel.arrays} for part in self.parts if isinstance(part, KernelLoop)))


def evaluate_loops(program: LoopProgram, arrays: dict[str, AnyArray], xp: ModuleType) -> dict[str, AnyArray]:
    """Return the arrays as a program leaves them, by NumPy or JAX; no row of a loop may read what another writes."""
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
        run: Callable = kernel.program.by_numpy if xp is np or not values else jax.vmap(kernel.program)
        for x, address in zip(run(values), kernel.outputs, strict=True):
            name = part.array(address.array)
            found[name] = _update(found[name], places(address), x, address.update, xp)
    return found


def _update(array: AnyArray, places: np.ndarray, x: AnyArray, update: str, xp: ModuleType) -> AnyArray:
    if not isinstance(array, np.ndarray):
        return array.at[places].add(x) if update == ADD else array.at[places].set(x)
    array = array.copy()
    (np.add.at if update == ADD else np.ndarray.__setitem__)(array, places, x)
    return array
