"""Forward and reverse derivatives of loop programs, kernel by kernel.

Every array x has an array of its tangents (d_x) or cotangents (bar_x). Intermediate results of a program must persist: no number
is overwritten once it has been read.
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial

import numpy as np

from udkjax.expressions.algebra.differential import cotangents, tangents
from udkjax.expressions.loops.loop_program import ADD, SET, Address, Kernel, KernelLoop, LoopProgram, Reset
from udkjax.expressions.scalars.graph import Scalar
from udkjax.expressions.scalars.scalar_program import ScalarProgram

TANGENT, COTANGENT = "d_", "bar_"
OTHER, SECOND = "e_", "de_"  # prefixes of tangents along another direction, and along both
# Modes of differentiation: along a direction, its transpose, and along two directions with the second derivative of both.
FORWARD, REVERSE, TWICE = "forward", "reverse", "twice"
PREFIXES = {FORWARD: (TANGENT,), REVERSE: (COTANGENT,), TWICE: (TANGENT, OTHER, SECOND)}  # for names of arrays


class LoopDerivative:
    """The derivative of loops with respect to all arrays that are not `fixed`."""

    def __init__(self, parts: Sequence[KernelLoop | Reset], fixed: Collection[str]):
        self._parts, self._fixed = list(parts), frozenset(fixed)
        self._kernels: dict[tuple[str, Kernel, frozenset[str], frozenset[str]], Kernel | None] = {}

    @property
    def forward(self) -> LoopProgram:
        """The program that computes the tangents of all arrays from those of the loops' inputs."""
        parts: list[KernelLoop | Reset] = []
        for part in self._parts:
            if isinstance(part, Reset):
                if part.array not in self._fixed:
                    parts.append(Reset(TANGENT + part.array, part.start, part.count))
            else:
                parts += self._differentiate(part, TANGENT, self._push_forward, part.table)
        return LoopProgram(parts)

    @property
    def reverse(self) -> LoopProgram:
        """The program that computes the cotangents of all arrays from those of the loops' results."""
        parts: list[KernelLoop | Reset] = []
        for part in reversed(self._parts):
            if isinstance(part, KernelLoop):
                parts += self._differentiate(part, COTANGENT, self._pull_back, part.table[::-1])
        return LoopProgram(parts)

    def second(self, settled: Collection[str]) -> LoopProgram:
        """Return the program of the tangents of all arrays along two directions and along both: d x, e x, and d(e x).

        Each kernel computes the three for its results at once, so that numbers that have been read can still be added to. The
        arrays named in `settled` have no first-order tangents d x and e x: these are zero.
        """
        parts: list[KernelLoop | Reset] = []
        for part in self._parts:
            if isinstance(part, Reset):
                if part.array not in self._fixed:
                    prefixes = (SECOND,) if part.array in settled else (TANGENT, OTHER, SECOND)
                    parts += [Reset(prefix + part.array, part.start, part.count) for prefix in prefixes]
            else:
                still = frozenset(name for name in part.kernel.arrays if part.array(name) in settled)
                parts += self._differentiate(part, SECOND, partial(_push_twice, still=still), part.table, still)
        return LoopProgram(parts)

    def _differentiate(
        self, part: KernelLoop, prefix: str, write: Callable, table: np.ndarray, still: frozenset[str] = frozenset()
    ) -> list[KernelLoop]:
        named = {x.array for x in (*part.kernel.inputs, *part.kernel.outputs)}
        constant_arrays = frozenset(name for name in named if part.array(name) in self._fixed or name in part.fixed)
        key = prefix, part.kernel, constant_arrays, still
        if key not in self._kernels:
            self._kernels[key] = write(part.kernel, constant_arrays)
        kernel = self._kernels[key]
        prefixes = (TANGENT, OTHER, SECOND) if prefix == SECOND else (prefix,)
        names = {**part.names, **{prefix + x: prefix + y for prefix in prefixes for x, y in part.names.items()}}
        return [] if kernel is None else [KernelLoop(kernel, table, names)]

    def _push_forward(self, kernel: Kernel, constant_arrays: frozenset[str]) -> Kernel | None:
        active, outputs = _active(kernel, constant_arrays)
        graph = kernel.program.graph
        seeds = {s: graph.input((TANGENT, s.index), "tangent") for s, _ in active}
        given = {s.index for s in kernel.program.inputs}
        stored, added = ([x for x in outputs if (x[1].update == SET) == is_stored] for is_stored in (True, False))
        results = [*tangents(graph, [s for s, _ in stored], seeds, given), *tangents(graph, [s for s, _ in added], seeds)]
        places = [address for _, address in (*stored, *added)]
        writes = [(s, address) for s, address in zip(results, places, strict=True) if address.update == SET or not s.is_zero]
        reads = [(seeds[s], address) for s, address in active]
        return _kernel(kernel, _prefixed(reads, TANGENT), _prefixed(writes, TANGENT))

    def _pull_back(self, kernel: Kernel, constant_arrays: frozenset[str]) -> Kernel | None:
        active, outputs = _active(kernel, constant_arrays)
        graph = kernel.program.graph
        seeds = [graph.input((COTANGENT, k), "cotangent") for k in range(len(outputs))]
        given = {s.index for s in kernel.program.inputs}
        results = cotangents(graph, [s for s, _ in outputs], seeds, [s for s, _ in active], given)
        places = [address._replace(update=ADD) for _, address in active]
        writes = [(s, address) for s, address in zip(results, places, strict=True) if not s.is_zero]
        reads = list(zip(seeds, (address for _, address in outputs), strict=True))
        return _kernel(kernel, _prefixed(reads, COTANGENT), _prefixed(writes, COTANGENT))


Addressed = list[tuple[Scalar, Address]]


def _active(kernel: Kernel, constant_arrays: frozenset[str]) -> tuple[Addressed, Addressed]:
    """Return the inputs and the outputs of a kernel that have derivatives: those in other arrays than `constant_arrays`.

    An input in one of these that is computed from other inputs, such as the sine of an angle, is differentiated with respect to
    the other inputs.
    """
    inputs, outputs = (
        zip(kernel.program.inputs, kernel.inputs, strict=True),
        zip(kernel.program.outputs, kernel.outputs, strict=True),
    )
    return [x for x in inputs if x[1].array not in constant_arrays], [x for x in outputs if x[1].array not in constant_arrays]


def _push_twice(kernel: Kernel, constant_arrays: frozenset[str], still: frozenset[str]) -> Kernel | None:
    active, outputs = _active(kernel, constant_arrays)
    graph, results = kernel.program.graph, [s for s, _ in outputs]
    moving = {prefix: [x for x in active if x[1].array not in still] for prefix in (TANGENT, OTHER)} | {SECOND: active}
    seeds = {prefix: {s: graph.input((prefix, s.index), "tangent") for s, _ in addressed} for prefix, addressed in moving.items()}
    first_tangents, second_tangents = (tangents(graph, results, seeds[prefix]) for prefix in (TANGENT, OTHER))
    first = seeds[OTHER] | {d: seeds[SECOND][s] for s, d in seeds[TANGENT].items()}
    settled = {s: d for s, d in seeds[SECOND].items() if s not in seeds[TANGENT]}
    mixed = [a + b for a, b in zip(tangents(graph, first_tangents, first), tangents(graph, results, settled), strict=True)]
    reads, writes = [], []
    for prefix, changes in {TANGENT: first_tangents, OTHER: second_tangents, SECOND: mixed}.items():
        reads += _prefixed([(seeds[prefix][s], address) for s, address in moving[prefix]], prefix)
        written = [(s, x) for s, (_, x) in zip(changes, outputs, strict=True) if prefix == SECOND or x.array not in still]
        writes += _prefixed([(s, x) for s, x in written if x.update == SET or not s.is_zero], prefix)
    return _kernel(kernel, reads, writes)


def _prefixed(addressed: Addressed, prefix: str) -> Addressed:
    """Return scalars and addresses, with a prefix to the name of each address's array."""
    return [(s, address._replace(array=prefix + address.array)) for s, address in addressed]


def _kernel(kernel: Kernel, seeds: Addressed, outputs: Addressed) -> Kernel | None:
    """Return a kernel with `seeds` as additional inputs and `outputs` in place of its outputs; None if there are no outputs."""
    if not outputs:
        return None
    inputs = list(zip(kernel.program.inputs, kernel.inputs, strict=True))
    inputs += [(s, address._replace(update=SET)) for s, address in seeds]
    program = ScalarProgram(kernel.program.graph, [s for s, _ in inputs], [s for s, _ in outputs])
    return Kernel(program, [address for _, address in inputs], [address for _, address in outputs])
