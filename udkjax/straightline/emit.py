"""Emit a graph as a program: a function of scalars that computes the outputs asked for, and nothing else.

On JAX scalars it is traced (under vmap each scalar becomes one vector over the batch, the layout that vectorizes); on Python
floats it is evaluated at once, which is how a scene is analysed without compiling anything.

XLA would fuse each output with a copy of everything before it. `cut_every` places an optimization barrier after that many
operations in a batch, after twice as many outside of one; a barrier stops the duplication and changes no value.
"""

import math
import operator
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.straightline.barrier import cut
from udkjax.straightline.branching import as_one
from udkjax.straightline.fusion import SIMPLE, Loop, together
from udkjax.straightline.graph import Details, Graph, Node, Scalar
from udkjax.straightline.trigonometry import sincos_of_each

# Operations between two optimization barriers. Without any, XLA repeats everything for each output; with too many it cannot fuse.
# What passes a barrier goes through memory, for which a single run waits: with half of them it takes a tenth less. Lanes, whose
# numbers fill vectors, take a little more.
CUT_EVERY = 48

_PAIR = ("sin", "cos")
_FLOATS = (*_PAIR, "tanh", "exp")  # of these names math and NumPy have functions, too
# On floats, and traced: by what jax.lax has, since each operator on a JAX array is a function call, ten times as long to trace.
_ARITHMETIC: dict[str, tuple[Callable, Callable]] = {
    "add": (operator.add, jax.lax.add),
    "sub": (operator.sub, jax.lax.sub),
    "mul": (operator.mul, jax.lax.mul),
    "div": (operator.truediv, jax.lax.div),
}


class Program:
    """`program(values)` takes one value for each of `inputs` and returns one for each of `outputs`."""

    def __init__(self, graph: Graph, inputs: Sequence[Scalar], outputs: Sequence[Scalar], cut_every: int | None = CUT_EVERY):
        self.graph, self.inputs, self.outputs, self.cut_every = graph, list(inputs), list(outputs), cut_every
        self.order = _needed(graph, {s.index for s in inputs}, [s.index for s in outputs])
        self.last_use = {a.index: k for k, i in enumerate(self.order) for a in graph.nodes[i].arguments}
        self.last_use.update((s.index, len(self.order)) for s in outputs)
        nodes = [graph.nodes[i] for i in self.order]
        self.angles = list(
            dict.fromkeys(n.arguments[0].index for n in nodes if n.kind == "apply" and n.detail.primitive.name in _PAIR)
        )
        self._traced = jax.jit(self._run)  # traced once, wherever and however often it is called and differentiated
        self._fusions: dict[Any, Callable[..., list[Any]]] = {}
        self._divided: dict[tuple[bool, ...], list[tuple[Program, Callable[..., list[Any]]]]] = {}

    def uses(self, scalar: Scalar) -> bool:
        """Whether the program needs this input at all."""
        return scalar.index in self.last_use

    def __call__(self, values: Sequence[Any]) -> list[Any]:
        if all(isinstance(v, float | int) for v in values):
            try:
                return self._run(values)
            except (ArithmeticError, ValueError):  # 1/0, an overflow, sin(inf): in JAX no errors, but values that are not finite
                with np.errstate(all="ignore"):
                    return self._run([np.float64(v) for v in values])
        return self._traced(self._typed(values))

    def by_numpy(self, values: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The same of arrays (rows,), element by element, without compiling anything."""
        rows = len(values[0]) if values else 1
        with np.errstate(all="ignore"), jax.ensure_compile_time_eval():
            if any(self.graph.nodes[i].kind == "call" for i in self.order):  # of an array primitive: one row after the other
                found = [self([float(v[k]) for v in values]) for k in range(rows)]
                return [np.array(x, float) for x in zip(*found, strict=True)]
            return [np.broadcast_to(np.asarray(x), (rows,)) for x in self._run(values)]

    def within(self, loop: Loop, arrays: Sequence[Any]) -> list[Any]:
        """The same of all numbers of some arrays, as one fusion of a loop that XLA compiles into one function."""
        arrays = [jnp.asarray(x) for x in arrays]
        known = tuple((x.shape, x.dtype) for x in arrays)
        if known not in self._fusions:
            examples = [jax.ShapeDtypeStruct((), x.dtype) for x in arrays for _ in range(x.size)]
            jaxpr = jax.make_jaxpr(lambda *values: [jnp.asarray(x) for x in self._run(self._typed(values))])(*examples)
            self._fusions[known] = together(jaxpr, [x.shape for x in arrays])
        return self._fusions[known](loop, *arrays)

    def early(self, values: Sequence[Any], moving: Sequence[bool]) -> list[Any]:
        """The same, once for many calls of others: what is computed of `moving` values by one function.

        All else is left to XLA, which may know it.
        """
        moves = tuple(moving)
        if not any(moves) or not self._is_simple:
            return self(values)
        if moves not in self._divided:
            self._divided[moves] = self._by_what_moves(moves)
        given = {s.index: v for s, v in zip(self.inputs, values, strict=True)}
        found: dict[Scalar, Any] = {}
        for part, run in self._divided[moves]:
            found |= zip(part.outputs, run([given[s.index] for s in part.inputs]), strict=True)
        return [found[s] for s in self.outputs]

    @property
    def _is_simple(self) -> bool:
        """Whether it is arithmetic on numbers."""
        nodes = [self.graph.nodes[i] for i in self.order]
        return all(n.detail.primitive.name in SIMPLE if n.kind == "apply" else n.kind not in ("call", "pick") for n in nodes)

    def _by_what_moves(self, moves: Sequence[bool]) -> "list[tuple[Program, Callable[..., list[Any]]]]":
        """The program of what is not computed of some inputs, and that of what is, with how to run each."""
        inputs = {s.index for s, m in zip(self.inputs, moves, strict=True) if m}
        moving = {*inputs}
        for index in self.order:
            if any(a.index in moving for a in self.graph.nodes[index].arguments):
                moving.add(index)

        def part(wanted: Callable[[Scalar], bool]) -> Program:
            outputs = [s for s in self.outputs if wanted(s)]
            whole = Program(self.graph, self.inputs, outputs)
            return Program(self.graph, [s for s in self.inputs if whole.uses(s)], outputs)

        computed = moving - inputs
        still, late = part(lambda s: s.index not in computed), part(lambda s: s.index in computed)
        run = as_one(late._run)
        return [(still, still), (late, lambda values: run(late._typed(values)) if late.outputs else [])]

    def _typed(self, values: Sequence[Any]) -> list[Any]:
        given = zip(values, (s.node.dtype for s in self.inputs), strict=True)
        return [v if isinstance(v, jax.Array) and v.dtype == d else jnp.asarray(v, d) for v, d in given]

    def _run(self, values: Sequence[Any]) -> list[Any]:
        known: dict[int, Any] = {s.index: v for s, v in zip(self.inputs, values, strict=True)}
        pairs: dict[int, tuple[Any, Any]] = {}
        recent: list[int] = []
        for k, index in enumerate(self.order):
            node = self.graph.nodes[index]
            known[index] = _evaluate(node, known, pairs, self.angles)
            if node.kind not in ("constant", "call"):
                recent.append(index)
                if self.cut_every and len(recent) % self.cut_every == 0:
                    halfway = len(recent) == self.cut_every
                    self._cut(known, [i for i in recent if self.last_use[i] > k], only_batches=halfway)
                    recent = recent if halfway else []
        return [_signed(known, s) for s in self.outputs]

    def _cut(self, known: dict[int, Any], live: list[int], only_batches: bool):
        traced = [i for i in live if isinstance(known[i], jax.Array)]
        if traced:
            known.update(zip(traced, cut([known[i] for i in traced], only_batches), strict=True))

    def count(self) -> dict[str, int]:
        """How many operations of each kind the program holds; the sine and cosine of one angle are one."""
        counts: dict[str, int] = {}
        for index in self.order:
            node = self.graph.nodes[index]
            name = str(node.detail) if node.kind in ("apply", "call") else node.kind
            if name not in (*_PAIR, "constant", "pick", "input"):
                counts[name] = counts.get(name, 0) + 1
        return counts | ({"sincos": len(self.angles)} if self.angles else {})


def along_elements(program: Program, loop: Loop | None, size: int, *arrays: Any) -> list[Any]:
    """A program of all numbers of some arrays for each of `size` elements, which come last; of numbers, which are those of all.

    In a loop, as one fusion.
    """
    given = [x for x in map(jnp.asarray, arrays) if x.size]
    axes = [-1 if x.ndim else None for x in given]

    def element(*arrays: Any) -> list[Any]:
        if loop is not None:
            return program.within(loop.along_elements, arrays)
        return [jnp.asarray(x) for x in program([x for array in arrays for x in (array if array.ndim else [array])])]

    return jax.vmap(element, in_axes=axes, axis_size=size)(*given) if program.outputs else []


def frontier(graph: Graph, outputs: Sequence[Scalar], early: Callable[[Node], bool]) -> list[Scalar]:
    """Return what an early program must hand to a later one: the early nodes that the outputs or later nodes use.

    Where early is what depends on parameters alone, that program runs once, the later one whenever the state changes.
    """
    order = _needed(graph, {i for i, n in enumerate(graph.nodes) if n.kind == "input"}, [s.index for s in outputs])
    used = {s.index for s in outputs}
    used.update(a.index for i in order if not early(graph.nodes[i]) for a in graph.nodes[i].arguments)
    used = {i for i in used if early(graph.nodes[i]) and graph.nodes[i].kind not in ("constant", "call")}
    return [Scalar(graph, i) for i in sorted(used)]


def operations(graph: Graph, given: Sequence[Scalar], outputs: Sequence[Scalar]) -> int:
    """How many nodes outputs take, once `given` and whatever that is made of are known."""
    return len({*graph.needed(s.index for s in outputs)}.difference(graph.needed(s.index for s in given)))


def _needed(graph: Graph, given: set[int], wanted: Sequence[int]) -> list[int]:
    needed = graph.needed(wanted, given)
    missing = [graph.nodes[i].detail for i in needed if graph.nodes[i].kind == "input"]
    if missing:
        raise ValueError(f"the outputs need inputs that are not given: {missing}")
    return needed


def _signed(known: dict[int, Any], scalar: Scalar) -> Any:
    value = known[scalar.index]
    return value if scalar.sign > 0 else _negative(value)


def _negative(value: Any) -> Any:
    return jax.lax.neg(value) if isinstance(value, jax.Array) else -value


def _evaluate(node: Node, known: dict[int, Any], pairs: dict[int, tuple[Any, Any]], angles: Collection[int]) -> Any:
    if node.kind == "constant":
        return node.detail
    if node.kind == "pick":
        output, flat = node.detail
        array = known[node.arguments[0].index][output]
        return array.reshape(-1)[flat]
    if node.kind == "apply" and node.detail.primitive.name in _PAIR and isinstance(known[node.arguments[0].index], jax.Array):
        return _one_of_pair(node, known, pairs, angles)
    values = [_signed(known, a) for a in node.arguments]
    match node.kind:
        case "add" | "sub" | "mul" | "div":
            on_floats, traced = _ARITHMETIC[node.kind]
            if not any(isinstance(v, jax.Array) for v in values):
                return on_floats(*values)
            return traced(*(v if isinstance(v, jax.Array) else node.dtype.type(v) for v in values))
        case "sqrt":
            x = values[0]
            return jax.lax.sqrt(x) if isinstance(x, jax.Array) else _library(x).sqrt(x)
        case "apply":
            return _apply(node, values)
        case "call":
            return _call(node.detail, node.arguments, values)
    raise AssertionError(node.kind)


def _one_of_pair(node: Node, known: dict[int, Any], pairs: dict[int, tuple[Any, Any]], angles: Collection[int]) -> Any:
    """The sine or cosine of an angle. Both are evaluated when the first is needed, and those of other angles known by then."""
    (angle,), name = node.arguments, node.detail.primitive.name
    if angle.index not in pairs:
        like = known[angle.index].dtype
        ready = [i for i in angles if i in known and i not in pairs and getattr(known[i], "dtype", None) == like]
        pairs.update(zip(ready, sincos_of_each([known[i] for i in ready]), strict=True))
    value = pairs[angle.index][_PAIR.index(name)]
    return _negative(value) if name == "sin" and angle.sign < 0 else value


def _library(x: Any) -> Any:
    return np if isinstance(x, np.floating | np.ndarray) else math


def _apply(node: Node, values: list[Any]) -> Any:
    name = node.detail.primitive.name
    if name in _FLOATS and isinstance(values[0], float | np.ndarray):
        return getattr(_library(values[0]), name)(values[0])
    floats = all(isinstance(v, float | int | bool | np.generic) for v in values)
    primitive, parameters = node.detail.primitive, node.detail.parameters
    if not floats:
        values = list(jnp.broadcast_arrays(*values)) if len({np.shape(v) for v in values}) > 1 else values
        return primitive.bind(*(jnp.asarray(v, a.node.dtype) for v, a in zip(values, node.arguments, strict=True)), **parameters)
    with jax.ensure_compile_time_eval():
        known = [jnp.asarray(v, a.node.dtype) for v, a in zip(values, node.arguments, strict=True)]
        return np.asarray(primitive.bind(*known, **parameters)).item()


def _call(details: Details, arguments: Sequence[Scalar], values: list[Any]) -> list[Any]:
    primitive, parameters = details.primitive, details.parameters
    if not all(isinstance(v, float | int | bool | np.generic) for v in values):
        result = primitive.bind(*_arrays(details, arguments, values), **parameters)
        return list(result) if primitive.multiple_results else [result]
    with jax.ensure_compile_time_eval():
        result = primitive.bind(*_arrays(details, arguments, values), **parameters)
        return [np.asarray(r) for r in (result if primitive.multiple_results else [result])]


def _arrays(details: Details, arguments: Sequence[Scalar], values: list[Any]) -> list[Any]:
    arrays, start = [], 0
    for shape in details.shapes:
        size = int(np.prod(shape))
        part = [
            jnp.asarray(v, a.node.dtype)
            for v, a in zip(values[start : start + size], arguments[start : start + size], strict=True)
        ]
        arrays.append(jnp.stack(part).reshape(shape) if part else jnp.zeros(shape))
        start += size
    return arrays
