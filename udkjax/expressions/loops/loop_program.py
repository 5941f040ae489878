"""Loop programs: loops over elements of one kind, each running a small straight-line program.

A `Kernel` is such a program with the addresses of its inputs and outputs relative to base addresses; a `KernelLoop` runs the
kernel for each row of a table of bases, in order. The code grows with the number of kinds, the tables with the number of
elements.
"""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.expressions.scalars.graph import Graph, Scalar
from udkjax.expressions.scalars.scalar_program import ScalarProgram

# Ways to update a number with an output: replacement, addition, maximum, conjunction.
SET, ADD, MAXIMUM, ALL = "set", "add", "maximum", "all"


class Address(NamedTuple):
    """The address of a number in an array: `offset` from a base, which is a column of the table (None: the array's start)."""

    array: str
    base: int | None
    offset: int = 0
    update: str = SET


class Kernel:
    """A straight-line program for one element of a kind."""

    def __init__(self, program: ScalarProgram, inputs: Sequence[Address], outputs: Sequence[Address]):
        self.program, self.inputs, self.outputs = program, list(inputs), list(outputs)
        used = {s.array for x, s in zip(program.inputs, inputs, strict=True) if program.uses(x)}
        self.arrays = sorted(used | {s.array for s in outputs})
        self.operation_count = len(program.order)


class KernelWriter:
    """A kernel under construction: its graph, and the addresses of its inputs and outputs so far."""

    def __init__(self, graph: Graph | None = None):
        self.graph = Graph() if graph is None else graph
        self._inputs: dict[Scalar, Address] = {}
        self._outputs: list[tuple[Scalar, Address]] = []

    def read(self, array: str, base: int | None, offset: int = 0) -> Scalar:
        """Add an input that is read from an address (see `Address`), and return it."""
        s = self.graph.input((array, base, offset), array)
        self._inputs[s] = Address(array, base, offset)
        return s

    def bind(self, s: Scalar, array: str, base: int | None, offset: int = 0) -> None:
        """Add an input that is already in the graph, to be read from an address."""
        self._inputs[s] = Address(array, base, offset)

    def write(self, s: Scalar, array: str, base: int | None, offset: int = 0, update: str = SET) -> None:
        """Add an output `s`, with which the number at an address is updated."""
        self._outputs.append((s, Address(array, base, offset, update)))

    def kernel(self) -> Kernel:
        """Return the kernel that was written."""
        program = ScalarProgram(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [address for _, address in self._outputs])


class KernelLoop(NamedTuple):
    """A kernel that runs for every row of a table of base addresses (elements, bases)."""

    kernel: Kernel
    table: np.ndarray
    names: Mapping[str, str] = {}  # names of arrays in the program by their names in the kernel, where they differ
    fixed: Collection[str] = ()  # arrays of the kernel that are constant in its derivative

    def array(self, name: str) -> str:
        """Return the name that an array has in the program, given its name in the kernel."""
        return self.names.get(name, name)


class Reset(NamedTuple):
    """A part of a program that sets `count` numbers of an array, from index `start` on, to a constant."""

    array: str
    start: int
    count: int
    value: float = 0.0


class LoopProgram(NamedTuple):
    """Loops, run one after another."""

    parts: Sequence[KernelLoop | Reset]

    @property
    def written(self) -> set[str]:
        """The names of all arrays that the program writes."""
        names = {part.array for part in self.parts if isinstance(part, Reset)}
        loops = [part for part in self.parts if isinstance(part, KernelLoop)]
        return names.union(*({part.array(x.array) for x in part.kernel.outputs} for part in loops))

    @property
    def arrays(self) -> set[str]:
        """The names of all arrays that the program reads or writes."""
        names = {part.array for part in self.parts if isinstance(part, Reset)}
        return names.union(*({part.array(x) for x in part.kernel.arrays} for part in self.parts if isinstance(part, KernelLoop)))
