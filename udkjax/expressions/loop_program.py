"""Programs of scenes: loops over elements that are alike, each running a small straight-line program.

A `Kernel` is the program with the addresses of its inputs and outputs, relative to some bases; a `KernelLoop` runs it for every
row of a table of bases, in order. The code grows with the number of kinds of elements, the tables with the number of elements.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.expressions.graph import Graph, Scalar
from udkjax.expressions.scalar_program import ScalarProgram

# Ways to write an output over the number in its place: replace it, add to it, keep the larger one, or whichever is false.
SET, ADD, MAXIMUM, ALL = "set", "add", "maximum", "all"
ADD_ONE_BY_ONE = "add one by one"  # in loops by NumPy
MOST_TURNS = 8  # updates of one place by a loop, in a program of JAX: each is an operation of it, or all are a loop


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
        self.operation_count = len(program.order)


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
    fixed: Collection[str] = ()  # the kernel's names of arrays that its derivative takes as fixed

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


def evaluate_loops(program: LoopProgram, arrays: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
    """Return the arrays as a program leaves them, by JAX; no row of a loop may read what another writes.

    All reads of a loop from an array, and all its writes to one, are one operation each: XLA takes milliseconds to compile any.
    """
    found = dict(arrays)
    for part in program.parts:
        if isinstance(part, Reset):
            x, end = found[part.array], part.start + part.count
            found[part.array] = jnp.concatenate([x[: part.start], jnp.full(part.count, part.value), x[end:]])
            continue
        kernel, table = part.kernel, part.table
        if not kernel.outputs or not len(table):
            continue
        values: list = [np.zeros(len(table))] * len(kernel.inputs)
        pairs = zip(kernel.program.inputs, kernel.inputs, strict=True)
        for name, numbers in _by_array(part, [x if kernel.program.uses(s) else None for s, x in pairs]).items():
            rows = _take(found[name], np.stack([_places(kernel.inputs[k], table) for k in numbers]))
            for k, row in zip(numbers, rows, strict=True):
                values[k] = row
        run: Callable = jax.vmap(kernel.program) if values else kernel.program.by_numpy
        results = run(values)
        for name, numbers in _by_array(part, kernel.outputs).items():
            for update in {kernel.outputs[k].update: None for k in numbers}:
                some = [k for k in numbers if kernel.outputs[k].update == update]
                places = np.concatenate([_places(kernel.outputs[k], table) for k in some])
                new = jnp.concatenate([jnp.broadcast_to(results[k], len(table)) for k in some])
                found[name] = _put(found[name], places, new, update)
    return found


def _by_array(part: KernelLoop, addresses: Sequence[Address | None]) -> dict[str, list[int]]:
    """Return the numbers of the addresses of each array of the program."""
    found: dict[str, list[int]] = {}
    for k, address in enumerate(addresses):
        if address is not None:
            found.setdefault(part.array(address.array), []).append(k)
    return found


def _take(x: jax.Array, places: np.ndarray) -> jax.Array:
    """Return numbers of an array, in the shape of their places."""
    flat = places.ravel()
    if np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
        return x[flat[0] : flat[0] + flat.size].reshape(places.shape)
    return x.at[places].get(mode="promise_in_bounds")


def _put(x: jax.Array, places: np.ndarray, new: jax.Array, update: str) -> jax.Array:
    """Return an array after an update of some places: by taking, as scattering is a loop to compile for XLA."""
    order = np.argsort(places, kind="stable")
    first = np.searchsorted(places[order], places[order])
    turn = np.empty(len(places), int)
    turn[order] = np.arange(len(places)) - first  # earlier updates of the same place
    if turn.max() >= MOST_TURNS:
        at = x.at[places]
        return (at.add if update == ADD else at.set)(new, mode="promise_in_bounds")
    padded = jnp.append(new, 0.0)
    for k in range(turn.max() + 1):
        source = np.full(len(x), len(places))
        source[places[turn == k]] = np.flatnonzero(turn == k)
        taken, known = _take(padded, source), source < len(places)
        x = x + taken if update == ADD else taken if known.all() else jnp.where(known, taken, x)
    return x


class NumpyLoops:
    """A program of loops as a function of its arrays, by NumPy: what `evaluate_loops` does, without compiling anything.

    The indices of all numbers are made once, for as many calls as there are.
    """

    def __init__(self, program: LoopProgram):
        self._parts: list[tuple[ScalarProgram | float, list, list]] = []
        for part in program.parts:
            if isinstance(part, Reset):
                self._parts.append((part.value, [], [(part.array, slice(part.start, part.start + part.count), SET)]))
            elif part.kernel.outputs and len(part.table):
                kernel, unused = part.kernel, ("", np.zeros(len(part.table)))
                inputs = [
                    (part.array(x.array), _places(x, part.table)) if kernel.program.uses(s) else unused
                    for s, x in zip(kernel.program.inputs, kernel.inputs, strict=True)
                ]
                outputs = [self._output(part, address) for address in kernel.outputs]
                self._parts.append((kernel.program, inputs, outputs))
        self._written = {name for *_, outputs in self._parts for name, *_ in outputs}

    @staticmethod
    def _output(part: KernelLoop, address: Address) -> tuple[str, np.ndarray, str]:
        """Return where the results of a loop go, and what they do there: those that share a place are added one by one."""
        places, update = _places(address, part.table), address.update
        return part.array(address.array), places, ADD_ONE_BY_ONE if update == ADD and len(set(places)) < len(places) else update

    def __call__(self, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the arrays as the program leaves them; the given arrays stay as they are."""
        found = {name: np.array(x, float) if name in self._written else x for name, x in arrays.items()}
        for program, inputs, outputs in self._parts:
            if isinstance(program, ScalarProgram):
                results = program.by_numpy([found[name][places] if name else places for name, places in inputs])
            else:
                results = [program]
            for x, (name, places, update) in zip(results, outputs, strict=True):
                if update == ADD:
                    found[name][places] += x
                elif update == ADD_ONE_BY_ONE:
                    np.add.at(found[name], places, x)
                else:
                    found[name][places] = x
        return found


def _places(address: Address, table: np.ndarray) -> np.ndarray:
    """Return the indices of a number in its array, one for each row of a table."""
    return address.offset + (np.zeros(len(table), int) if address.base is None else table[:, address.base])
