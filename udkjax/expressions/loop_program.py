"""Loop programs: loops over elements of one kind, each running a small straight-line program.

A `Kernel` is such a program with the addresses of its inputs and outputs relative to base addresses; a `KernelLoop` runs the
kernel for each row of a table of bases, in order. The code grows with the number of kinds, the tables with the number of
elements.
"""

import math
import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.expressions.graph import Graph, Scalar
from udkjax.expressions.scalar_program import ScalarProgram

# Ways to update a number with an output: replacement, addition, maximum, conjunction.
SET, ADD, MAXIMUM, ALL = "set", "add", "maximum", "all"
_BY_ARRAYS = {ADD: np.add, MAXIMUM: np.maximum, ALL: np.minimum}
_BY_FLOATS = {  # NaN propagates
    ADD: operator.add,
    MAXIMUM: lambda a, b: a if a >= b or a != a else b,
    ALL: lambda a, b: a if a <= b or a != a else b,
}
_NEUTRAL = {ADD: 0.0, MAXIMUM: -math.inf, ALL: math.inf}
FEW_ROWS = 8  # up to this, Python floats (0.05 us per operation and row) are faster than NumPy arrays (0.6 us per operation)
_NOT_USED = np.zeros(1)  # value of an input that a program does not use
MAX_UPDATES = 8  # number of updates of one place that JAX unrolls; more become a loop


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
    """Builds a kernel: its graph, and the addresses of its inputs and outputs."""

    def __init__(self, graph: Graph | None = None):
        self.graph = Graph() if graph is None else graph
        self._inputs: dict[Scalar, Address] = {}
        self._outputs: list[tuple[Scalar, Address]] = []

    def read(self, array: str, base: int | None, offset: int = 0) -> Scalar:
        """Read a number from an array."""
        s = self.graph.input((array, base, offset), array)
        self._inputs[s] = Address(array, base, offset)
        return s

    def bind(self, s: Scalar, array: str, base: int | None, offset: int = 0) -> None:
        """Read an input that is already in the graph."""
        self._inputs[s] = Address(array, base, offset)

    def write(self, s: Scalar, array: str, base: int | None, offset: int = 0, update: str = SET) -> None:
        """Write a number to an array."""
        self._outputs.append((s, Address(array, base, offset, update)))

    def kernel(self) -> Kernel:
        """Return the kernel that was written."""
        program = ScalarProgram(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [address for _, address in self._outputs])


class KernelLoop(NamedTuple):
    """A kernel, run for every row of a table of bases (elements, columns)."""

    kernel: Kernel
    table: np.ndarray
    names: Mapping[str, str] = {}  # names of arrays in the program by their names in the kernel, where they differ
    fixed: Collection[str] = ()  # arrays of the kernel that are constant in its derivative

    def array(self, name: str) -> str:
        """Return the name in the program of an array of the kernel."""
        return self.names.get(name, name)


class Reset(NamedTuple):
    """Sets some numbers of an array to a constant."""

    array: str
    start: int
    count: int
    value: float = 0.0


class LoopProgram(NamedTuple):
    """Loops, run one after another."""

    parts: Sequence[KernelLoop | Reset]

    @property
    def arrays(self) -> set[str]:
        """The names of all arrays that the program reads or writes."""
        names = {part.array for part in self.parts if isinstance(part, Reset)}
        return names.union(*({part.array(x) for x in part.kernel.arrays} for part in self.parts if isinstance(part, KernelLoop)))


class LaidOutPart(NamedTuple):
    """A part of a program with the indices of each of its numbers, one for each row of its table."""

    run: ScalarProgram | float  # a float: the constant that part of an array is set to
    inputs: list[tuple[str, Any]]  # array ("" if unused) and indices of each
    outputs: list[tuple[str, Any, str]]  # array, indices and update of each
    count: int  # number of rows


class ArrayLoops:
    """A loop program as a function of its arrays, by NumPy or JAX; no row of a loop may read a number that another row writes.

    The indices of all numbers are computed once, for all calls. By NumPy, arrays may have a second axis of many states, or of
    length one if they are the same for all.
    """

    def __init__(self, program: LoopProgram, xp: ModuleType):
        self._parts, self._xp = list(map(_lay_out, program.parts)), xp
        self._written = {name for part in self._parts for name, *_ in part.outputs}
        self._read = {name for part in self._parts for name, _ in part.inputs if name}
        programs = [(part.run, part.count) for part in self._parts if isinstance(part.run, ScalarProgram)]
        is_short = xp is np and all(rows <= FEW_ROWS and run.is_plain for run, rows in programs)
        self._short_parts = list(map(_with_lists, self._parts)) if is_short else None

    def __call__(self, arrays: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arrays after a run of the program; the given arrays do not change."""
        if self._xp is jnp:
            results = dict(arrays)
            for part in self._parts:
                _run_by_jax(part, results)
            return results
        if self._short_parts and all(np.ndim(x) < 2 for x in arrays.values()):
            try:
                return self._run_on_floats(arrays, self._short_parts)
            except (ArithmeticError, ValueError):  # a number is not finite
                pass
        results = {name: np.array(x, float) if name in self._written else x for name, x in arrays.items()}
        for part in self._parts:
            _run_by_numpy(part, results)
        return results

    def _run_on_floats(self, arrays: Mapping[str, Any], parts: Sequence[LaidOutPart]) -> dict[str, np.ndarray]:
        involved = self._written | self._read
        lists = {name: np.asarray(x, float).tolist() for name, x in arrays.items() if name in involved}
        for part in parts:
            _run_on_floats(part, lists)
        return {name: np.array(lists[name], float) if name in self._written else x for name, x in arrays.items()}


def _lay_out(part: KernelLoop | Reset) -> LaidOutPart:
    if isinstance(part, Reset):
        return LaidOutPart(part.value, [], [(part.array, slice(part.start, part.start + part.count), SET)], part.count)
    kernel, table = part.kernel, part.table

    def places(address: Address) -> np.ndarray:
        return address.offset + (np.zeros(len(table), int) if address.base is None else table[:, address.base])

    used = [kernel.program.uses(s) for s in kernel.program.inputs]
    inputs = [(part.array(x.array) if is_used else "", places(x)) for x, is_used in zip(kernel.inputs, used, strict=True)]
    outputs = [(part.array(x.array), places(x), x.update) for x in kernel.outputs] if len(table) else []
    return LaidOutPart(kernel.program, inputs, outputs, len(table))


def _with_lists(part: LaidOutPart) -> LaidOutPart:
    """Return a part with lists instead of arrays."""
    if not isinstance(part.run, ScalarProgram):
        return part
    inputs = [(name, places.tolist()) for name, places in part.inputs]
    return part._replace(inputs=inputs, outputs=[(name, places.tolist(), update) for name, places, update in part.outputs])


def _run_by_numpy(part: LaidOutPart, arrays: dict[str, np.ndarray]) -> None:
    if not part.outputs:
        return
    results: Any = [part.run]
    if isinstance(part.run, ScalarProgram):
        results = part.run.by_numpy([arrays[name][places] if name else _NOT_USED for name, places in part.inputs])
    for x, (name, places, update) in zip(results, part.outputs, strict=True):
        target = arrays[name]
        if update == SET:
            target[places] = x
        elif target.ndim == 1:
            _BY_ARRAYS[update].at(target, places, x)
        else:  # row by row: `at` is slow with a second axis
            for k, row in zip(places, np.broadcast_to(x, (part.count, *np.shape(x)[1:])), strict=True):
                target[k] = _BY_ARRAYS[update](target[k], row)


def _run_on_floats(part: LaidOutPart, arrays: dict[str, list[float]]) -> None:
    if not isinstance(part.run, ScalarProgram):
        for name, places, _ in part.outputs:
            arrays[name][places] = [part.run] * part.count
        return
    if not part.outputs:
        return
    run = part.run.on_floats
    columns = [[arrays[name][k] for k in places] if name else places for name, places in part.inputs]
    rows = [run(row) for row in (zip(*columns, strict=True) if columns else [()] * part.count)]
    for column, (name, places, update) in zip(zip(*rows, strict=True), part.outputs, strict=True):
        target = arrays[name]
        for k, x in zip(places, column, strict=True):
            target[k] = x if update == SET else _BY_FLOATS[update](target[k], x)


def _run_by_jax(part: LaidOutPart, arrays: dict[str, Array]) -> None:
    """Run a part, with one operation for all reads from an array and one for all writes: XLA compiles each for milliseconds."""
    if not isinstance(part.run, ScalarProgram):
        for name, places, _ in part.outputs:
            x = arrays[name]
            arrays[name] = jnp.concatenate([x[: places.start], jnp.full(part.count, part.run), x[places.stop :]])
        return
    if not part.outputs:
        return
    values: list = [np.zeros(part.count)] * len(part.inputs)
    for (name,), group in _group(part.inputs, 1).items():
        if name:
            rows = _take(arrays[name], np.stack([places for _, (_, places) in group]))
            for (k, _), row in zip(group, rows, strict=True):
                values[k] = row
    run: Callable = jax.vmap(part.run) if values else part.run.by_numpy
    results = run(values)
    for (name, update), group in _group([(name, update, places) for name, places, update in part.outputs], 2).items():
        new = jnp.concatenate([jnp.broadcast_to(results[k], part.count) for k, _ in group])
        arrays[name] = _put(arrays[name], np.concatenate([places for _, (*_, places) in group]), new, update)


def _group(items: Sequence[tuple], heads: int) -> dict[tuple, list[tuple[int, tuple]]]:
    """Group items, with their indices, by their first entries."""
    groups: dict[tuple, list[tuple[int, tuple]]] = {}
    for k, item in enumerate(items):
        groups.setdefault(item[:heads], []).append((k, item))
    return groups


def _take(x: jax.Array, places: np.ndarray) -> jax.Array:
    flat = places.ravel()
    if np.array_equal(flat, np.arange(flat[0], flat[0] + flat.size)):
        return x[flat[0] : flat[0] + flat.size].reshape(places.shape)
    return x.at[places].get(mode="promise_in_bounds")


def _put(x: jax.Array, places: np.ndarray, new: jax.Array, update: str) -> jax.Array:
    """Return an array with some places updated: by a gather, since XLA compiles a scatter into a loop."""
    order = np.argsort(places, kind="stable")
    first = np.searchsorted(places[order], places[order])
    earlier = np.empty(len(places), int)
    earlier[order] = np.arange(len(places)) - first  # number of earlier updates of the same place
    if earlier.max() >= MAX_UPDATES:
        selected = x.at[places]
        write = {SET: selected.set, ADD: selected.add, MAXIMUM: selected.max, ALL: selected.min}[update]
        return write(new, mode="promise_in_bounds")
    padded = jnp.append(new, _NEUTRAL.get(update, 0.0))
    for k in range(earlier.max() + 1):
        source = np.full(len(x), len(places))
        source[places[earlier == k]] = np.flatnonzero(earlier == k)
        updates, is_updated = _take(padded, source), source < len(places)
        if update == SET:
            x = updates if is_updated.all() else jnp.where(is_updated, updates, x)
        else:
            x = getattr(jnp, _BY_ARRAYS[update].__name__)(x, updates)
    return x
