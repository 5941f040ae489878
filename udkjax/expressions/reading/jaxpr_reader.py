"""Read a jaxpr into a graph of scalars.

An array is a NumPy array of Scalars: reshaping, slicing and broadcasting vanish, and elementwise primitives become scalar
operations, which the graph can simplify. Any other primitive becomes one opaque node with its arrays: every function that JAX can
trace can be read.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.extend import core
from jax.typing import ArrayLike

from udkjax.expressions.reading.array_rules import RULES, choose, choose_branch, select_rows, select_unknown
from udkjax.expressions.reading.loop_reader import unroll
from udkjax.expressions.reading.matrix_rules import is_small
from udkjax.expressions.scalars.graph import BoundPrimitive, Graph, Scalar
from udkjax.expressions.scalars.selection import fold
from udkjax.programs.numpy_program import expansion_of

ClosedJaxpr: TypeAlias = Any  # JAX exports the class, but not to type checkers
Equation: TypeAlias = Any  # its annotations omit the shapes of its variables
Dimensions = tuple[Sequence[int], Sequence[int]]
DimensionNumbers = tuple[Dimensions, Dimensions]  # parameters of `dot_general`: contracted and batch dimensions of each operand

_INLINED = (
    "jit",
    "pjit",
    "closed_call",
    "core_call",
    "deferred_program",
    "custom_jvp_call",
    "custom_vjp_call",
    "custom_vjp_call_jaxpr",
    "remat",
    "remat2",
    "checkpoint",
)
POWERS_AT_ONCE = 20  # powers of two whose sum is exact, also in single precision
# Positions of the updates and of the indices among the inputs of primitives that put elements into an array.
_REPLACING: dict[str, Callable[[list[np.ndarray]], tuple[np.ndarray, list[np.ndarray]]]] = {
    "scatter": lambda inputs: (inputs[2], [inputs[1]]),
    "dynamic_update_slice": lambda inputs: (inputs[1], inputs[2:]),
}
_ELEMENTWISE = frozenset(
    """abs acos acosh add and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh
    digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt is_finite le lgamma log log1p log2 logistic lt max min mul ne neg
    nextafter not one_minus_square or pow reduce_precision rem round rsqrt select_n shift_left shift_right_arithmetic
    shift_right_logical sign sin sinh sub tan tanh xor stop_gradient""".split()
)  # fmt: skip


def trace(function: Callable, *examples: object) -> Callable[..., list[np.ndarray]]:
    """Trace a function once, to read it into any number of graphs.

    Args:
        function: A function of arrays.
        examples: Its arguments, or their shapes, as for `jax.make_jaxpr`.

    Returns:
        A function of a graph and of arguments, given as arrays of Scalars, that returns the outputs as arrays of Scalars.
    """
    jaxpr = jax.make_jaxpr(function)(*examples)
    return lambda graph, *arguments: read_jaxpr(
        graph, jaxpr, jax.tree.leaves(arguments, is_leaf=lambda x: isinstance(x, np.ndarray))
    )


def read_jaxpr(graph: Graph, closed: ClosedJaxpr, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Read a closed jaxpr into a graph.

    Args:
        graph: The graph.
        closed: The jaxpr, with its constants.
        arguments: Its arguments as arrays of Scalars.

    Returns:
        Its outputs as arrays of Scalars.
    """
    constants = [_constants(graph, c) for c in closed.consts]
    return _read(graph, closed.jaxpr, constants, arguments)


def _constants(graph: Graph, value: ArrayLike) -> np.ndarray:
    value = np.asarray(value)
    array = np.empty(value.shape, object)
    for position in np.ndindex(*value.shape):
        array[position] = graph.constant(value[position], value.dtype)
    return array


def _read(graph: Graph, jaxpr: core.Jaxpr, constants: Sequence[np.ndarray], arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
    known: dict[core.Var, np.ndarray] = {}
    for variables, values in ((jaxpr.constvars, constants), (jaxpr.invars, arguments)):
        known.update(zip(variables, (np.asarray(v, object) for v in values), strict=True))

    def value(atom):
        return _constants(graph, atom.val) if isinstance(atom, core.Literal) else known[atom]

    effects: list[tuple[Equation, list[np.ndarray]]] = []
    for equation in jaxpr.eqns:
        inputs = [value(a) for a in equation.invars]
        if equation.outvars:
            known.update(zip(equation.outvars, _equation(graph, equation, inputs), strict=True))
        else:  # such as `jax.debug.print`
            effects.append((equation, inputs))
    outputs = [value(a) for a in jaxpr.outvars]
    for equation, inputs in effects if outputs else []:
        outputs[0] = _after(graph, equation, inputs, outputs[0])
    return outputs


class _Inline:
    """A stand-in for a primitive that evaluates a closed jaxpr.

    JAX's own primitives for calls are not used, since their parameters differ between its releases.
    """

    name, multiple_results = "closed_call", True

    def bind(self, *arrays: ArrayLike, call_jaxpr: ClosedJaxpr) -> list[jax.Array]:
        return core.jaxpr_as_fun(call_jaxpr)(*arrays)


_INLINE: Any = _Inline()


def _after(graph: Graph, equation: Equation, inputs: list[np.ndarray], output: np.ndarray) -> np.ndarray:
    """Return `output` as the result of an opaque node that also executes an equation without outputs, for its effect.

    The effect, such as printing, takes place only if this output is needed.
    """

    def function(output: jax.Array, *inputs: jax.Array) -> jax.Array:
        equation.primitive.bind(*inputs, **equation.params)
        return output

    arrays = [output, *inputs]
    dtypes = [np.result_type(float, *(s.node.dtype for s in output.flat)), *(v.aval.dtype for v in equation.invars)]
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(a.shape, d) for a, d in zip(arrays, dtypes, strict=True)))
    details = BoundPrimitive(_INLINE, {"call_jaxpr": closed}, tuple(a.shape for a in arrays), equation.primitive.name)
    return graph.call(details, tuple(s for a in arrays for s in a.flat), [(output.shape, dtypes[0])])[0]


def _equation(graph: Graph, equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    name, parameters = equation.primitive.name, equation.params
    if name in _INLINED:
        inner = next(parameters[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in parameters)
        return _read_inner(graph, inner, inputs)
    if name in _SHAPE_OPERATIONS:
        return [np.asarray(_SHAPE_OPERATIONS[name](*inputs, **parameters), object)]
    if name in ("scan", "while"):
        unrolled = unroll(partial(_read_inner, graph), equation, inputs)
        if unrolled is not None:
            return unrolled
    shape, dtype = equation.outvars[0].aval.shape, np.dtype(equation.outvars[0].aval.dtype)
    if name in _ARITHMETIC and np.issubdtype(dtype, np.floating):
        return [_elementwise(partial(_ARITHMETIC[name], **parameters), shape, inputs)]
    if name == "convert_element_type" and all(s.node.dtype == dtype for s in inputs[0].flat):
        return inputs
    if name in _ELEMENTWISE and np.broadcast_shapes(*(i.shape for i in inputs)) == shape:  # JAX repeats axes of length one
        return [_elementwise(partial(_apply, graph, equation, dtype), shape, inputs)]
    if name == "reduce_sum" and np.issubdtype(dtype, np.floating):
        zero: Any = graph.constant(0.0, dtype)
        return [np.asarray(np.sum(inputs[0], axis=parameters["axes"], initial=zero), object)]
    if name == "dot_general" and np.issubdtype(dtype, np.floating):
        return [_dot(graph, inputs[0], inputs[1], parameters["dimension_numbers"], shape)]
    if name in ("dynamic_slice", "gather"):
        elements = _select(equation, inputs)
        if elements is not None:
            return [elements]
    if name in _REPLACING and all(s.constant is not None for i in _REPLACING[name](inputs)[1] for s in i.flat):
        return [np.asarray(_replace(equation, inputs), object)]
    if name in ("pad", "tile"):  # JAX moves the indices of the elements; the index of the padding follows them
        places, size = np.arange(inputs[0].size).reshape(inputs[0].shape), inputs[0].size
        positions = fold(equation.primitive, parameters, [places, *(np.asarray(size) for _ in inputs[1:])])
        return [np.concatenate([i.reshape(-1) for i in inputs])[np.asarray(positions)]]
    if name == "scatter-add" and all(s.constant is not None for s in inputs[1].flat):
        return [_add_at(equation, *inputs)]
    if name == "unstack":
        return [np.asarray(x, object) for x in np.moveaxis(inputs[0], parameters["axis"], 0)]
    if name == "split":
        return np.split(inputs[0], np.cumsum(parameters["sizes"])[:-1], parameters["axis"])
    if all(s.constant is not None for i in inputs for s in i.flat) and not equation.effects:
        return _evaluate_constants(graph, equation, inputs)
    written = _write_out(graph, equation, inputs)
    if written is not None:
        return written
    details = BoundPrimitive(equation.primitive, parameters, tuple(i.shape for i in inputs))
    scalars = tuple(s for i in inputs for s in i.flat)
    return graph.call(details, scalars, [(v.aval.shape, v.aval.dtype) for v in equation.outvars])


def _write_out(graph: Graph, equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray] | None:
    """Return the outputs of a primitive of whole arrays as operations on elements; None if no rule applies to it."""
    name = equation.primitive.name
    if name == "cond":
        branches = [partial(_read_inner, graph, branch, inputs[1:]) for branch in equation.params["branches"]]
        return choose_branch(graph, inputs[0].item(), branches)
    if name == "custom_linear_solve" and is_small(*inputs):
        counts, programs = equation.params["const_lengths"], equation.params["jaxprs"]
        first, right = counts.matvec + counts.vecmat, counts.matvec + counts.vecmat + counts.solve + counts.transpose_solve
        return _read_inner(graph, programs.solve, [*inputs[first : first + counts.solve], *inputs[right:]])
    if (expansion := expansion_of(equation.primitive, equation.params)) is not None:  # such as that of `searchsorted`
        return read_jaxpr(graph, jax.make_jaxpr(expansion)(*(v.aval for v in equation.invars)), inputs)
    return RULES[name](graph, inputs, equation) if name in RULES else None


def _read_inner(graph: Graph, jaxpr: core.Jaxpr | ClosedJaxpr, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    return read_jaxpr(graph, jaxpr, inputs) if hasattr(jaxpr, "consts") else _read(graph, jaxpr, [], inputs)


def _elementwise(operation: Callable[..., Scalar], shape: tuple[int, ...], inputs: list[np.ndarray]) -> np.ndarray:
    result = np.empty(shape, object)
    inputs = [np.broadcast_to(i, shape) for i in inputs]
    for position in np.ndindex(*shape):
        result[position] = operation(*(i[position] for i in inputs))
    return result


def _apply(graph: Graph, equation: Equation, dtype: np.dtype, *scalars: Scalar) -> Scalar:
    primitive, parameters = equation.primitive, equation.params
    if primitive.name == "select_n" and scalars[0].constant is not None:
        return scalars[1 + int(scalars[0].constant)]
    if primitive.name == "select_n" and scalars[0].node.dtype != bool:
        return choose(scalars[0], scalars[1:])
    if primitive.name in ("stop_gradient",):
        return scalars[0]
    return graph.apply(primitive, parameters, scalars, dtype, lambda *values: fold(primitive, parameters, values))


def _evaluate_constants(graph: Graph, equation: Equation, inputs: list[np.ndarray]) -> list[np.ndarray]:
    values = [_values(i).astype(v.aval.dtype) for i, v in zip(inputs, equation.invars, strict=True)]  # an empty array has no type
    if not equation.primitive.multiple_results:
        return [_constants(graph, fold(equation.primitive, equation.params, values).astype(equation.outvars[0].aval.dtype))]
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*map(jax.numpy.asarray, values), **equation.params)
    return [_constants(graph, r) for r in results]


def _values(array: np.ndarray) -> np.ndarray:
    dtype = array.flat[0].node.dtype if array.size else float
    return np.array([s.constant for s in array.flat], dtype).reshape(array.shape)


def _replace(equation: Equation, inputs: list[np.ndarray]) -> np.ndarray:
    """Put elements of one array into another at constant indices, by letting JAX put their positions, with the same dtype."""
    updates, indices = _REPLACING[equation.primitive.name](inputs)
    elements = np.concatenate([inputs[0].ravel(), updates.ravel()])
    places = np.arange(elements.size, dtype=equation.outvars[0].aval.dtype)
    numbered = iter(np.split(places, [inputs[0].size]))
    values = [_values(i) if any(i is x for x in indices) else next(numbered).reshape(i.shape) for i in inputs]
    positions = fold(equation.primitive, equation.params, values)
    return elements[np.asarray(positions, int)]


def _add_at(equation: Equation, array: np.ndarray, indices: np.ndarray, updates: np.ndarray) -> np.ndarray:
    """Add the elements of one array to another at constant indices: JAX adds powers of two, whose sums identify the elements."""
    result, dtype = array.copy(), equation.outvars[0].aval.dtype
    for first in range(0, updates.size, POWERS_AT_ONCE):
        powers = np.zeros(updates.size, dtype)
        powers[first : first + POWERS_AT_ONCE] = 2.0 ** np.arange(min(POWERS_AT_ONCE, updates.size - first))
        zeros, places = np.zeros(array.shape, dtype), _values(indices)
        sums = np.asarray(fold(equation.primitive, equation.params, [zeros, places, powers.reshape(updates.shape)]), np.int64)
        for k in range(first, min(first + POWERS_AT_ONCE, updates.size)):
            result[sums >> (k - first) & 1 == 1] += updates.flat[k]
    return result


def _select(equation: Equation, inputs: list[np.ndarray]) -> np.ndarray | None:
    """Select elements by indices, by letting JAX select from an array of their positions; None if too much is unknown."""
    array, *indices = inputs
    if equation.primitive.name == "gather" and any(s.constant is None for s in indices[0].flat):
        offset = equation.params["dimension_numbers"].offset_dims
        return select_rows(lambda known: _select_known(equation, array, known), array, indices[0], offset)
    return select_unknown(lambda known: _select_known(equation, array, known), array, indices)


def _select_known(equation: Equation, array: np.ndarray, indices: list[np.ndarray]) -> np.ndarray:
    places, outside = np.arange(array.size).reshape(array.shape), array.size  # the position of indices out of bounds
    parameters = {**equation.params, "fill_value": outside} if "fill_value" in equation.params else equation.params
    positions = fold(equation.primitive, parameters, [places, *(_values(i) for i in indices)])
    if not np.any(positions == outside):
        return array.reshape(-1)[positions]
    graph, fill = array.flat[0].graph, equation.params["fill_value"]
    return np.append(array.reshape(-1), graph.constant(np.nan if fill is None else fill, array.flat[0].node.dtype))[positions]


def _integer_power(x: Scalar, y: int) -> Scalar:
    if y < 0:
        return x.graph.constant(1.0, x.node.dtype) / _integer_power(x, -y)
    result = x.graph.constant(1.0, x.node.dtype)
    while y:
        result, x, y = result * x if y & 1 else result, x * x if y > 1 else x, y >> 1
    return result


def _dot(graph: Graph, a: np.ndarray, b: np.ndarray, numbers: DimensionNumbers, shape: tuple[int, ...]) -> np.ndarray:
    (contract_a, contract_b), (batch_a, batch_b) = numbers
    free_a = [k for k in range(a.ndim) if k not in (*contract_a, *batch_a)]
    free_b = [k for k in range(b.ndim) if k not in (*contract_b, *batch_b)]
    batch, inner = [a.shape[k] for k in batch_a], [a.shape[k] for k in contract_a]
    a = a.transpose(*batch_a, *free_a, *contract_a).reshape(int(np.prod(batch)), -1, int(np.prod(inner)))
    b = b.transpose(*batch_b, *free_b, *contract_b).reshape(int(np.prod(batch)), -1, int(np.prod(inner)))
    result = np.empty((len(a), a.shape[1], b.shape[1]), object)
    for n, i, j in np.ndindex(*result.shape):
        result[n, i, j] = sum((x * y for x, y in zip(a[n, i], b[n, j], strict=True)), graph.constant(0.0))
    return result.reshape(shape)


def _slice(a, start_indices, limit_indices, strides):
    strides = strides or [1] * a.ndim
    return a[tuple(slice(*s) for s in zip(start_indices, limit_indices, strides, strict=True))]


def _broadcast(a, shape, broadcast_dimensions, **_):
    source = [1] * len(shape)
    for k, d in enumerate(broadcast_dimensions):
        source[d] = a.shape[k]
    return np.broadcast_to(a.reshape(source), shape)


_ARITHMETIC: dict[str, Callable[..., Scalar]] = {
    "add": lambda a, b, **_: a + b,
    "add_any": lambda a, b, **_: a + b,
    "sub": lambda a, b, **_: a - b,
    "mul": lambda a, b, **_: a * b,
    "div": lambda a, b, **_: a / b,
    "neg": lambda a, **_: -a,
    "square": lambda a, **_: a * a,
    "sqrt": lambda a, **_: a.graph.sqrt(a),
    "integer_pow": lambda a, y, **_: _integer_power(a, y),
}
_SHAPE_OPERATIONS: dict[str, Callable[..., np.ndarray]] = {
    "reshape": lambda a, new_sizes, **_: a.reshape(new_sizes),
    "squeeze": lambda a, dimensions: np.squeeze(a, tuple(dimensions)),
    "expand_dims": lambda a, dimensions: np.expand_dims(a, dimensions),
    "transpose": lambda a, permutation: np.transpose(a, permutation),
    "rev": lambda a, dimensions: np.flip(a, dimensions),
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "concatenate": lambda *a, dimension: np.concatenate(a, dimension),
    "stack": lambda *a, axis=0, **_: np.stack(a, axis),
    "copy": lambda a, **_: a,
}
