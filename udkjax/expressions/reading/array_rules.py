"""Primitives of whole arrays, expanded into operations on their elements: reductions, sorting, branches, unknown indices.

A rule gets the graph, the inputs as arrays of Scalars and the equation, and returns the outputs, or None where it does not apply:
the primitive then stays one opaque node. Elements are chosen by comparisons, and ties and NaN are treated as JAX treats them.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np
from jax import lax

from udkjax.expressions.reading.matrix_rules import decompose, solve_triangular
from udkjax.expressions.scalars.graph import Graph, Scalar
from udkjax.expressions.scalars.selection import apply, both, either, where

ScalarArrays = list[Any]  # arrays of Scalars, which type checkers know as arrays of arrays
ArrayRule = Callable[[Graph, ScalarArrays, Any], list[np.ndarray] | None]
MOST_SORTED = 32  # elements of a sorted row; beyond, comparisons of all pairs are too many
MOST_PLACES = 256  # places among which an unknown index may choose
# Reductions by the binary operation of two elements.
_REDUCTIONS = {
    "reduce_max": lax.max_p,
    "reduce_min": lax.min_p,
    "reduce_prod": lax.mul_p,
    "reduce_sum": lax.add_p,
    "reduce_and": lax.and_p,
    "reduce_or": lax.or_p,
    "reduce_xor": lax.xor_p,
}
_CUMULATIVE = {"cumsum": lax.add_p, "cumprod": lax.mul_p, "cummax": lax.max_p, "cummin": lax.min_p}


def join(primitive: Any, a: Scalar, b: Scalar) -> Scalar:
    """Return a binary primitive of two scalars; sums and products of floats become operations of the graph."""
    if np.issubdtype(a.node.dtype, np.floating):
        if primitive is lax.add_p:
            return a + b
        if primitive is lax.mul_p:
            return a * b
    return apply(primitive, a.node.dtype, a, b)


def _rows(array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Return an array with some axes moved to the end and merged into one."""
    kept = [k for k in range(array.ndim) if k not in axes]
    return array.transpose(*kept, *axes).reshape(*(array.shape[k] for k in kept), -1)


def _reduce(primitive: Any, graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray] | None:
    rows = _rows(inputs[0], equation.params["axes"])
    if rows.shape[-1] == 0:
        return None
    result = np.empty(rows.shape[:-1], object)
    for place in np.ndindex(*result.shape):
        elements = list(rows[place])
        while len(elements) > 1:  # a balanced tree, for short chains of dependent operations
            pairs = [join(primitive, a, b) for a, b in zip(elements[::2], elements[1::2], strict=False)]
            elements = [*pairs, *elements[len(elements) // 2 * 2 :]]
        result[place] = elements[0]
    return [result]


def _accumulate(primitive: Any, graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray]:
    axis, is_reverse = equation.params["axis"], equation.params["reverse"]
    rows = np.moveaxis(inputs[0], axis, 0)
    rows = rows[::-1] if is_reverse else rows
    result = np.empty(rows.shape, object)
    for k in range(len(rows)):
        for place in np.ndindex(*rows.shape[1:]):
            result[(k, *place)] = join(primitive, result[(k - 1, *place)], rows[(k, *place)]) if k else rows[(0, *place)]
    return [np.moveaxis(result[::-1] if is_reverse else result, 0, axis)]


def _first_extreme(compare: Any, graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray]:
    rows, dtype = _rows(inputs[0], equation.params["axes"]), np.dtype(equation.params["index_dtype"])
    result = np.empty(rows.shape[:-1], object)
    for place in np.ndindex(*result.shape):
        best, index = rows[place][0], graph.constant(0, dtype)
        for k, x in enumerate(rows[place][1:], 1):
            is_better = _extreme(compare, x, best)
            best, index = where(is_better, x, best), where(is_better, graph.constant(k, dtype), index)
        result[place] = index
    return [result]


def _extreme(compare: Any, x: Scalar, best: Scalar) -> Scalar:
    """Return the condition that x beats `best`, the best element before it, by `compare`; the first NaN beats all numbers."""
    if x.node.dtype == bool:
        x, best = (where(s, s.graph.constant(1, int), s.graph.constant(0, int)) for s in (x, best))
    beats = apply(compare, bool, x, best)
    if not np.issubdtype(x.node.dtype, np.floating):
        return beats
    return either(beats, both(_is_nan(x), apply(lax.eq_p, bool, best, best)))


def _is_nan(x: Scalar) -> Scalar:
    return apply(lax.ne_p, bool, x, x)


def _precedes(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Return the condition that the keys `a` sort strictly before the keys `b`, the first key first; NaN sorts last."""
    x, y = a[0], b[0]
    less = apply(lax.lt_p, bool, x, y)
    if np.issubdtype(x.node.dtype, np.floating):
        less = either(less, both(apply(lax.eq_p, bool, x, x), _is_nan(y)))
    if len(a) == 1:
        return less
    same = apply(lax.eq_p, bool, x, y)
    if np.issubdtype(x.node.dtype, np.floating):
        same = either(same, both(_is_nan(x), _is_nan(y)))
    return either(less, both(same, _precedes(a[1:], b[1:])))


def _sort(graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray] | None:
    axis, keys = equation.params["dimension"], equation.params["num_keys"]
    columns = [np.moveaxis(x, axis, 0).copy() for x in inputs]
    n = len(columns[0])
    if n > MOST_SORTED:
        return None
    for place in np.ndindex(*columns[0].shape[1:]):
        rows = [tuple(c[(k, *place)] for c in columns) for k in range(n)]
        for turn in range(n):  # neighbours are exchanged, even pairs and odd pairs in turn: equal keys keep their order
            for k in range(turn % 2, n - 1, 2):
                swap = _precedes(rows[k + 1][:keys], rows[k][:keys])
                pairs = list(zip(rows[k], rows[k + 1], strict=True))
                rows[k] = tuple(where(swap, b, a) for a, b in pairs)
                rows[k + 1] = tuple(where(swap, a, b) for a, b in pairs)
        for k, row in enumerate(rows):
            for column, s in zip(columns, row, strict=True):
                column[(k, *place)] = s
    return [np.moveaxis(c, 0, axis) for c in columns]


def _compare_totally(is_strict: bool, graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray]:
    """Return x < y (if `is_strict`) or x <= y of elements, in the order of sorting, in which NaN comes last."""
    arrays: ScalarArrays = list(np.broadcast_arrays(*inputs))
    a, b = arrays
    result = np.empty(a.shape, object)
    for place in np.ndindex(*result.shape):
        x, y = [a[place]], [b[place]]
        result[place] = _precedes(x, y) if is_strict else apply(lax.not_p, bool, _precedes(y, x))
    return [result]


def choose(index: Scalar, cases: Sequence[Scalar]) -> Scalar:
    """Return cases[index] for an index that is known only at run time; an index beyond the first or last case selects that."""
    if index.node.dtype == bool:
        return where(index, cases[1], cases[0])
    result = cases[-1]
    for k in reversed(range(len(cases) - 1)):
        result = where(apply(lax.le_p, bool, index, index.graph.constant(k, index.node.dtype)), cases[k], result)
    return result


def choose_branch(graph: Graph, index: Scalar, branches: Sequence[Callable[[], list[np.ndarray]]]) -> list[np.ndarray] | None:
    """Return the results of the branch that an index known only at run time selects, computed from those of all branches.

    None if a branch contains an opaque node, which would always run.
    """
    before = len(graph.nodes)
    results = [branch() for branch in branches]
    if any(node.kind == "call" for node in graph.nodes[before:]):
        return None
    chosen = []
    for arrays in zip(*results, strict=True):
        output = np.empty(arrays[0].shape, object)
        for place in np.ndindex(*output.shape):
            output[place] = choose(index, [a[place] for a in arrays])
        chosen.append(output)
    return chosen


def _polynomial(graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray]:
    arrays = np.broadcast_arrays(*inputs)
    result = np.empty(arrays[0].shape, object)
    for place in np.ndindex(*result.shape):
        x, *coefficients = (a[place] for a in arrays)
        result[place] = reduce(lambda total, c, x=x: total * x + c, reversed(coefficients))
    return [result]


def _host_platform(graph: Graph, inputs: ScalarArrays, equation: Any) -> list[np.ndarray]:
    """Return the index of the branch for the CPU, or of the one for all platforms."""
    platforms = equation.params["platforms"]
    index = next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
    return [np.array(graph.constant(index, np.int32), object)]


def select_rows(
    select: Callable[[ScalarArrays], np.ndarray], array: np.ndarray, indices: np.ndarray, offset: Sequence[int]
) -> np.ndarray | None:
    """Return the elements that a `gather` takes from an array by rows of indices, some of which are known only at run time.

    Each element depends on one row of indices only, so that the number of cases does not grow with the number of rows.

    Args:
        select: Function from indices, an array of constants, to the elements.
        array: The array.
        indices: The rows of indices (..., k), as Scalars.
        offset: The axes of the result along the slices that are taken; the other axes number the rows of indices.

    Returns:
        The elements; None if there are too many places to choose from.
    """
    dtype, graph = indices.flat[0].node.dtype, indices.flat[0].graph
    first = 0 if dtype.kind == "u" else -1
    places = range(first, max(array.shape, default=0) + 1)  # with one beyond either end: indices may be out of bounds
    columns = indices.shape[-1]
    if len(places) ** columns > MOST_PLACES:
        return None
    numbers = [graph.constant(k, dtype) for k in places]
    cases = np.empty([len(places)] * columns, object)
    for chosen in np.ndindex(*cases.shape):
        row = np.array([numbers[k] for k in chosen], object)
        cases[chosen] = select([np.broadcast_to(row, indices.shape)])
    some = cases.flat[0]
    kept = [axis for axis in range(some.ndim) if axis not in offset]
    result = np.empty(some.shape, object)
    for spot in np.ndindex(*result.shape):
        row = indices[tuple(spot[axis] for axis in kept)]

        def choose_from(known: tuple[int, ...], row: Any = row, spot: tuple[int, ...] = spot) -> Scalar:
            if len(known) == columns:
                return cases[known][spot]
            index = row[len(known)]
            options = [choose_from((*known, k)) for k in range(len(places))]
            number = index if first == 0 else apply(lax.add_p, dtype, index, graph.constant(1, dtype))
            return choose(number, options)

        result[spot] = choose_from(())
    return result


def select_unknown(select: Callable[[ScalarArrays], np.ndarray], array: np.ndarray, indices: ScalarArrays) -> np.ndarray | None:
    """Return the elements of an array at indices some of which are known only at run time: choices among known cases.

    Args:
        select: Function from indices, as arrays of constants, to the elements.
        array: The array.
        indices: The indices, as arrays of Scalars.

    Returns:
        The elements; None if there are too many places to choose from.
    """
    unknown = [(k, place) for k, a in enumerate(indices) for place in np.ndindex(*a.shape) if a[place].constant is None]
    if not unknown:
        return np.asarray(select(indices), object)
    k, place = unknown[0]
    index, dtype = indices[k][place], indices[k][place].node.dtype
    first = 0 if dtype.kind == "u" else -1
    places = range(first, max(array.shape, default=0) + 1)  # with one beyond either end: indices may be out of bounds
    if len(places) ** len(unknown) > MOST_PLACES:
        return None
    cases = []
    for value in places:
        known = [a.copy() for a in indices]
        known[k][place] = index.graph.constant(value, dtype)
        cases.append(select_unknown(select, array, known))
    number = index if first == 0 else apply(lax.add_p, dtype, index, index.graph.constant(1, dtype))
    result = np.empty(cases[0].shape, object)
    for spot in np.ndindex(*result.shape):
        result[spot] = choose(number, [case[spot] for case in cases])
    return result


RULES: dict[str, ArrayRule] = {
    **{name: partial(_reduce, p) for name, p in _REDUCTIONS.items()},
    **{name: partial(_accumulate, p) for name, p in _CUMULATIVE.items()},
    "argmax": partial(_first_extreme, lax.gt_p),
    "argmin": partial(_first_extreme, lax.lt_p),
    "sort": _sort,
    "lt_to": partial(_compare_totally, True),
    "le_to": partial(_compare_totally, False),
    "polynomial": _polynomial,
    "platform_index": _host_platform,
    "lu": decompose,
    "triangular_solve": solve_triangular,
}
