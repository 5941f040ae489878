"""Loop programs as functions of arrays, without machine code: run by NumPy, which compiles nothing, or by JAX."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.expressions.loops.compiled_loops import CompiledAtMany, CompiledLoops, compiled_at_many, compiled_loops
from udkjax.expressions.loops.float_loops import FloatLoops, LaidOutPart, Lists
from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, SET, Address, KernelLoop, LoopProgram, Reset
from udkjax.expressions.scalars.scalar_program import ScalarProgram

_BY_ARRAYS = {ADD: np.add, MAXIMUM: np.maximum, ALL: np.minimum}
_NEUTRAL = {ADD: 0.0, MAXIMUM: -math.inf, ALL: math.inf}
_NOT_USED = np.zeros(1)  # value of an input that a program does not use
WORTH_COMPILING = 100  # runs row by row on Python's floats that take as long as compiling a program quickly
WORTH_COMPILING_AT_MANY = 40  # runs by NumPy at many states that take as long as compiling a program with optimization
MAX_UPDATES = 8  # number of updates of one place that JAX unrolls; more become a loop


class ArrayLoops:
    """A loop program as a function of its arrays, by NumPy or JAX.

    No row of a loop may read a number that another row of the same loop writes.

    The indices of all numbers are computed once, for all calls. By NumPy, arrays may have a second axis of many states, or of
    length one if they are the same for all.

    Args:
        program: the program.
        xp: NumPy or jax.numpy.
        results: the arrays whose numbers are needed after a run, for functions that compute no others; None: all.
    """

    def __init__(self, program: LoopProgram, xp: ModuleType, results: Collection[str] | None = None):
        self._parts, self._xp, self._program, self._results = list(map(_lay_out, program.parts)), xp, program, results
        self._calls, self._runs_at_many = 0, 0
        self.compiled: CompiledLoops | None = None  # machine code of the program at single states
        self._at_many: CompiledAtMany | None = None  # machine code of the program at many states
        self._written = {name for part in self._parts for name, *_ in part.outputs}
        self._read = {name for part in self._parts for name, _ in part.inputs if name}
        self._on_floats = FloatLoops(self._parts) if xp is np and FloatLoops.support(self._parts) else None

    def on_lists(self, lists: Lists) -> bool:
        """Run the program at one state on Python's floats; return False if that is not possible.

        The numbers of each array are changed in place. The run is not possible if the program has too many rows or operations or
        calls JAX, or if a number is not finite; the numbers must not be used then. Here, rows may read numbers that earlier rows
        have written.
        """
        if self._on_floats is None:
            return False
        try:
            self._on_floats(lists)
        except (ArithmeticError, ValueError):
            return False
        return True

    def is_worth_compiling(self, often: bool) -> bool:
        """Count a run at a single state; return True if this is the run at which compiling the program pays off.

        That is the first run if many are expected (`often`). All other calls return False, and so do all calls if Python's floats
        do not suffice for the program.
        """
        if self._calls >= WORTH_COMPILING or self._on_floats is None:
            return False
        self._calls = WORTH_COMPILING if often else self._calls + 1
        return self._calls == WORTH_COMPILING

    def compile(self, sizes: Mapping[str, int]) -> None:
        """Set `compiled`, which stays None if no compiler supports the program.

        `sizes` has the lengths of all its arrays except `constants`.
        """
        self.compiled = compiled_loops(self._program, sizes, tuple(self._results or ()))

    def at_many(self, sizes: Mapping[str, int], given: Mapping[str, int]) -> CompiledAtMany | None:
        """Return machine code of the program for many states; None until enough runs are counted for compiling it to pay off.

        Each call counts as a run. The result is always None if no compiler supports the program.

        Args:
            sizes: the lengths of all its arrays except `constants` and those that describe a state.
            given: the lengths of the arrays that describe a state.
        """
        self._runs_at_many += 1
        if self._runs_at_many == WORTH_COMPILING_AT_MANY:
            self._at_many = compiled_at_many(self._program, sizes, given, tuple(self._results or ()))
        return self._at_many

    def __call__(self, arrays: Mapping[str, Any]) -> dict[str, Any]:
        """Return the arrays after a run of the program; the given arrays do not change."""
        if self._xp is jnp:
            results = dict(arrays)
            for part in self._parts:
                _run_by_jax(part, results)
            return results
        if self._on_floats and all(np.ndim(x) == 1 for x in arrays.values()):
            try:
                return self._run_on_floats(arrays, self._on_floats)
            except (ArithmeticError, ValueError):  # a number is not finite
                pass
        results = {name: np.array(x, float) if name in self._written else x for name, x in arrays.items()}
        for part in self._parts:
            _run_by_numpy(part, results)
        return results

    def _run_on_floats(self, arrays: Mapping[str, Any], run: FloatLoops) -> dict[str, np.ndarray]:
        involved = self._written | self._read
        lists = {name: np.asarray(x, float).tolist() for name, x in arrays.items() if name in involved}
        run(lists)
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


def _run_by_jax(part: LaidOutPart, arrays: dict[str, Array]) -> None:
    """Run a part, with one operation for all reads from an array and one for all writes: compiling each takes milliseconds."""
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
    """Group items by their first `heads` entries; each item in a group comes after its index."""
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
    """Return an array whose numbers at `places`, which may repeat, are updated with the numbers `new`.

    Few updates of each place are made by gathers, since XLA compiles a scatter into a loop.
    """
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
