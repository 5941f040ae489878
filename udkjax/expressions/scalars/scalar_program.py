"""Scalar programs: functions that compute outputs of a graph by evaluating only the nodes that these need.

With JAX scalars a program is traced (under vmap each scalar becomes a vector over the batch, the layout that vectorizes); with
Python floats it is evaluated at once, so that a scene is analysed without compiling anything.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.expressions.scalars.graph import BoundPrimitive, Graph, Node, Scalar
from udkjax.expressions.scalars.written_steps import Operand, WrittenSteps, written_as
from udkjax.programs.numpy_rules import RULES, UFUNCS

_SINE_AND_COSINE = ("sin", "cos")
_LIBRARY_FUNCTIONS = (*_SINE_AND_COSINE, "tanh", "exp")  # they have the same names in `math` and NumPy
_COMMON_OPERATORS = ("add", "sub", "mul", "eq", "ne", "lt", "le", "gt", "ge", "and_", "or_")
# Other primitives on Python numbers: calling JAX instead takes about a hundred times as long.
_NUMBER_FUNCTIONS: dict[str, Callable] = {
    **{name.strip("_"): getattr(operator, name) for name in _COMMON_OPERATORS},
    **{name: getattr(math, name) for name in ("asinh", "atan2", "cbrt", "erf", "erfc")},
    "abs": abs,
    "floor": lambda x: float(math.floor(x)),
    "integer_pow": lambda x, y: x**y,
    "max": written_as("{0} if {0} > {1} or {0} != {0} else {1}", lambda a, b: a if a > b or a != a else b),  # NaN of either
    "min": written_as("{0} if {0} < {1} or {0} != {0} else {1}", lambda a, b: a if a < b or a != a else b),
    "neg": operator.neg,
    "rem": math.fmod,
    "select_n": lambda which, *cases: cases[int(which)],
    "sign": lambda x: x if x != x else float((x > 0) - (x < 0)),
    "square": written_as("{0} * {0}", lambda x: x * x),
}
_SELECT_OF_TWO = written_as("{2} if {0} else {1}", lambda which, no, yes: yes if which else no)
# The same on NumPy arrays, element by element.
_ARRAY_FUNCTIONS: dict[str, Callable] = UFUNCS | {
    **{name.strip("_"): getattr(operator, name) for name in (*_COMMON_OPERATORS, "neg")},
    "select_n": lambda which, *cases: (
        np.where(which, cases[1], cases[0]) if len(cases) == 2 else np.choose(np.asarray(which, int), cases)
    ),
}
# Operators on floats, and functions of jax.lax for tracing: an operator on a JAX array takes ten times as long to trace.
_OPERATORS: dict[str, tuple[Callable, Callable]] = {
    "add": (operator.add, jax.lax.add),
    "sub": (operator.sub, jax.lax.sub),
    "mul": (operator.mul, jax.lax.mul),
    "div": (operator.truediv, jax.lax.div),
}


class ScalarProgram:
    """`program(values)` returns a value for each of `outputs`, from one for each of `inputs`."""

    def __init__(self, graph: Graph, inputs: Sequence[Scalar], outputs: Sequence[Scalar]):
        self.graph, self.inputs, self.outputs = graph, list(inputs), list(outputs)
        self.order = _needed(graph, {s.index for s in inputs}, [s.index for s in outputs])
        self.last_use = {a.index: k for k, i in enumerate(self.order) for a in graph.nodes[i].arguments}
        self.last_use.update((s.index, len(self.order)) for s in outputs)
        nodes = [graph.nodes[i] for i in self.order]
        self.angles = list(
            dict.fromkeys(
                n.arguments[0].index for n in nodes if n.kind == "apply" and n.detail.primitive.name in _SINE_AND_COSINE
            )
        )

    def uses(self, scalar: Scalar) -> bool:
        """Return True if an output depends on the input `scalar`."""
        return scalar.index in self.last_use

    def __call__(self, values: Sequence[Operand]) -> list[Operand]:
        if all(isinstance(v, float | int) for v in values):
            try:
                return self.on_floats(values)
            except (ArithmeticError, ValueError):  # 1/0, overflow, sin(inf): not errors in JAX, which returns inf or NaN
                with np.errstate(all="ignore"):
                    return self.on_arrays([np.float64(v) for v in values])
        return self._traced(self._typed(values))

    def by_numpy(self, values: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Evaluate the program on arrays of compatible shapes, element by element, without compiling anything."""
        shapes = {np.shape(x) for x in values} or {(1,)}
        shape = shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)
        with np.errstate(all="ignore"):
            if self._calls_arrays:  # one element after another
                columns = [np.broadcast_to(v, shape).ravel().tolist() for v in values]
                results = [self(row) for row in zip(*columns, strict=True)] if columns else [self([])]
                return [np.array(x, float).reshape(shape) for x in zip(*results, strict=True)]
            results = self.on_arrays(values)
        return [x if np.shape(x) == shape else np.broadcast_to(x, shape) for x in results]

    @cached_property
    def _traced(self) -> Callable[[Sequence[Operand]], list[Operand]]:
        """The program as a function that JAX traces once, for all calls and derivatives: 4 KB that most programs never need."""
        return jax.jit(self._run)

    @cached_property
    def _calls_arrays(self) -> bool:
        return any(self.graph.nodes[i].kind == "call" for i in self.order)

    def _typed(self, values: Sequence[Operand]) -> list[Operand]:
        typed_values = zip(values, (s.node.dtype for s in self.inputs), strict=True)
        return [_array(v, d) for v, d in typed_values]

    def _run(self, values: Sequence[Operand]) -> list[Operand]:
        computed: dict[int, Operand] = {s.index: v for s, v in zip(self.inputs, values, strict=True)}
        for index in self.order:
            node = self.graph.nodes[index]
            computed[index] = _evaluate(node, [_signed(computed, a) for a in node.arguments])
        return [_signed(computed, s) for s in self.outputs]

    @cached_property
    def on_floats(self) -> WrittenSteps:
        """The program on Python floats, which raises errors where a result is not finite."""
        return self._steps(_function_of_floats)

    @cached_property
    def is_plain(self) -> bool:
        """True if Python's float functions suffice, without calls of JAX."""
        nodes = (self.graph.nodes[i] for i in self.order)
        return all(n.kind == "constant" or _plain_function(n, math, _NUMBER_FUNCTIONS) for n in nodes)

    @cached_property
    def on_arrays(self) -> WrittenSteps:
        """The program on NumPy arrays of compatible shapes, or numbers that are the same for all elements."""
        return self._steps(_function_of_arrays)

    def _steps(self, function_of: Callable[[Node], Callable]) -> WrittenSteps:
        places, steps = {(s.index, 1): k for k, s in enumerate(self.inputs)}, []

        def append(key: tuple[int, int], function: Callable, arguments: list[int]) -> None:
            places[key] = len(self.inputs) + len(steps)
            steps.append((function, arguments))

        def find(scalar: Scalar) -> int:
            if (scalar.index, scalar.sign) not in places:
                append((scalar.index, scalar.sign), operator.neg, [places[scalar.index, 1]])
            return places[scalar.index, scalar.sign]

        for index in self.order:
            node = self.graph.nodes[index]
            append((index, 1), function_of(node), [find(a) for a in node.arguments])
        outputs = [find(s) for s in self.outputs]
        return WrittenSteps(len(self.inputs), steps, outputs)

    def count(self) -> dict[str, int]:
        """Return the number of operations of each kind, by its name; the sine and cosine of one angle are one operation."""
        counts: dict[str, int] = {}
        for index in self.order:
            node = self.graph.nodes[index]
            name = str(node.detail) if node.kind in ("apply", "call") else node.kind
            if name not in (*_SINE_AND_COSINE, "constant", "pick", "input"):
                counts[name] = counts.get(name, 0) + 1
        return counts | ({"sincos": len(self.angles)} if self.angles else {})


def frontier(graph: Graph, outputs: Sequence[Scalar], early: Callable[[Node], bool]) -> list[Scalar]:
    """Return the nodes that an early program must pass to a later one: the early nodes that outputs or later nodes use.

    If the early nodes depend on parameters alone, the early program runs once, and the later one whenever the state changes.

    Args:
        graph: The graph.
        outputs: The outputs of the later program.
        early: Function that returns True for a node of the early program.

    Returns:
        The nodes, in the order of the graph.
    """
    order = _needed(graph, {i for i, n in enumerate(graph.nodes) if n.kind == "input"}, [s.index for s in outputs])
    used = {s.index for s in outputs}
    used.update(a.index for i in order if not early(graph.nodes[i]) for a in graph.nodes[i].arguments)
    used = {i for i in used if early(graph.nodes[i]) and graph.nodes[i].kind not in ("constant", "call")}
    return [Scalar(graph, i) for i in sorted(used)]


def operations(graph: Graph, given: Sequence[Scalar], outputs: Sequence[Scalar]) -> int:
    """Return the number of nodes that must be evaluated for the outputs once `given` and its dependencies are computed.

    Args:
        graph: The graph.
        given: Scalars already computed.
        outputs: Scalars to compute.

    Returns:
        The number of nodes.
    """
    return len({*graph.dependencies(s.index for s in outputs)}.difference(graph.dependencies(s.index for s in given)))


def _needed(graph: Graph, given: set[int], wanted: Sequence[int]) -> list[int]:
    needed = graph.dependencies(wanted, given)
    missing = [graph.nodes[i].detail for i in needed if graph.nodes[i].kind == "input"]
    if missing:
        raise ValueError(f"the outputs need inputs that are not given: {missing}")
    return needed


def _signed(values: dict[int, Operand], scalar: Scalar) -> Operand:
    value = values[scalar.index]
    return value if scalar.sign > 0 else _negative(value)


def _negative(value: Operand) -> Operand:
    return jax.lax.neg(value) if isinstance(value, jax.Array) else -value


def _evaluate(node: Node, values: list[Operand]) -> Operand:
    match node.kind:
        case "constant":
            return node.detail
        case "pick":
            output, flat = node.detail
            return values[0][output].reshape(-1)[flat]
        case "add" | "sub" | "mul" | "div":
            on_floats, traced = _OPERATORS[node.kind]
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


def _function_of_floats(node: Node) -> Callable:
    """Return the function that computes a node on Python floats; chosen once, because many programs run thousands of times."""
    if node.kind == "constant":
        constant = node.detail
        is_number = type(constant) in (float, int, bool) and math.isfinite(constant)
        return written_as(repr(constant), lambda: constant) if is_number else lambda: constant
    if node.kind == "apply" and node.detail.primitive.name == "select_n" and len(node.arguments) == 3:
        return _SELECT_OF_TWO
    return _plain_function(node, math, _NUMBER_FUNCTIONS) or (lambda *values: _evaluate(node, list(values)))


def _function_of_arrays(node: Node) -> Callable:
    """Return the function that computes a node on NumPy arrays or float constants."""
    if node.kind == "constant":
        return lambda: np.float64(node.detail) if isinstance(node.detail, float) else node.detail
    plain = _plain_function(node, np, _ARRAY_FUNCTIONS)
    rule = RULES.get(node.detail.primitive.name) if plain is None and node.kind == "apply" else None
    if rule is not None:
        return partial(rule, **node.detail.parameters)
    return plain or (lambda *values: _evaluate_by_jax(node, values))


def _plain_function(node: Node, library: ModuleType, others: Mapping[str, Callable]) -> Callable | None:
    """Return the operator, the function of `library` or the entry of `others` that computes a node; None if JAX must do so."""
    if node.kind in _OPERATORS:
        return _OPERATORS[node.kind][0]
    if node.kind == "sqrt":
        return library.sqrt
    name = node.detail.primitive.name if node.kind == "apply" else ""
    if name == "integer_pow":
        exponent = node.detail.parameters["y"]
        return written_as(f"{{0}}**{exponent}", lambda x: x**exponent)
    return getattr(library, name) if name in _LIBRARY_FUNCTIONS else others.get(name)


def _evaluate_by_jax(node: Node, values: Sequence[np.ndarray]) -> np.ndarray | list[np.ndarray]:
    with jax.ensure_compile_time_eval():
        result = _evaluate(node, list(values))
        return result if isinstance(result, list) else np.asarray(result)[()]


def _library(x: Operand) -> ModuleType:
    return np if isinstance(x, np.floating | np.ndarray) else math


def _apply(node: Node, values: list[Operand]) -> Operand:
    name = node.detail.primitive.name
    if name in _LIBRARY_FUNCTIONS and isinstance(values[0], float | np.ndarray):
        return getattr(_library(values[0]), name)(values[0])
    if name in _NUMBER_FUNCTIONS and all(type(v) in (float, int, bool) for v in values):
        exponent = [node.detail.parameters["y"]] if name == "integer_pow" else []
        return _NUMBER_FUNCTIONS[name](*values, *exponent)
    floats = all(isinstance(v, float | int | bool | np.generic) for v in values)
    primitive, parameters = node.detail.primitive, node.detail.parameters
    if not floats:
        values = list(jnp.broadcast_arrays(*values)) if len({np.shape(v) for v in values}) > 1 else values
        return primitive.bind(*(_array(v, a.node.dtype) for v, a in zip(values, node.arguments, strict=True)), **parameters)
    with jax.ensure_compile_time_eval():
        arrays = [_array(v, a.node.dtype) for v, a in zip(values, node.arguments, strict=True)]
        result = np.asarray(primitive.bind(*arrays, **parameters))
        return result[()] if any(isinstance(v, np.generic) for v in values) else result.item()  # Python floats raise on 1/0


def _array(value: Any, dtype: Any) -> jax.Array:
    """Return a value as a JAX array of a type; in single precision if JAX does not support double precision (x64 is off)."""
    dtype = jax.dtypes.canonicalize_dtype(dtype)
    return value if isinstance(value, jax.Array) and value.dtype == dtype else jnp.asarray(value, dtype)


def _call(details: BoundPrimitive, arguments: Sequence[Scalar], values: list[Operand]) -> list[Operand]:
    primitive, parameters = details.primitive, details.parameters
    if not all(isinstance(v, float | int | bool | np.generic) for v in values):
        result = primitive.bind(*_arrays(details, arguments, values), **parameters)
        return list(result) if primitive.multiple_results else [result]
    with jax.ensure_compile_time_eval():
        result = primitive.bind(*_arrays(details, arguments, values), **parameters)
        return [np.asarray(r) for r in (result if primitive.multiple_results else [result])]


def _arrays(details: BoundPrimitive, arguments: Sequence[Scalar], values: list[Operand]) -> list[Operand]:
    arrays, start = [], 0
    for shape in details.shapes:
        size = int(np.prod(shape))
        given = zip(values[start : start + size], arguments[start : start + size], strict=True)
        part = [_array(v, a.node.dtype) for v, a in given]
        arrays.append(jnp.stack(part).reshape(shape) if part else jnp.zeros(shape))
        start += size
    return arrays
