"""Differentiate a graph: the chain rule gives a sparse Jacobian of expressions.

A differential is a linear combination of the differentials of the inputs, d f = sum (df/dx) dx, stored as a row {x: df/dx}. The
partial derivatives are expressions of the same graph: a cosine that they share with the function is one node, and zeros vanish.
The same partial derivatives serve any number of directions at once and, transposed, reverse mode.

A function of many inputs may take fewer operations than its Jacobian has entries, as the solution of a sparse linear system does
for its right-hand side. Tangents then pass from node to node, and cotangents back (node_derivatives.py).

Results of an opaque node (an array primitive, `call`) count as additional inputs. Their differentials follow from those of its
arguments by JAX's rule for the primitive, forward or transposed.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import jax
import numpy as np

from udkjax.expressions.algebra.node_derivatives import ActiveNodes, choose, is_choice, partial_derivative
from udkjax.expressions.reading.jaxpr_reader import read_jaxpr
from udkjax.expressions.scalars.graph import BoundPrimitive, Graph, Node, Scalar

SparseRow = dict[int, Scalar]  # partial derivatives by the index of the variable's node


class Differential:
    """The differentials of `outputs` with respect to `inputs`.

    Scalars in `fixed` are treated as constants. Nodes from which `inputs` or `fixed` are computed are not differentiated.
    """

    def __init__(self, graph: Graph, outputs: Iterable[Scalar], inputs: Sequence[Scalar], fixed: Iterable[Scalar] = ()):
        self.graph, self.inputs = graph, list(inputs)
        leaves = {s.index for s in (*self.inputs, *fixed)}
        self._rows: dict[int, SparseRow] = {s.index: {s.index: graph.constant(1.0, s.node.dtype)} for s in self.inputs}
        self._calls: dict[int, list[int]] = {}  # opaque nodes that are not constant, and their results
        for index in graph.dependencies((s.index for s in outputs), leaves):
            row = self._differentiate(index)
            if row:
                self._rows[index] = row

    def row(self, output: Scalar) -> SparseRow:
        """Return the partial derivatives of one output with respect to inputs and to results of opaque nodes."""
        row = self._rows.get(output.index, {})
        return row if output.sign > 0 else {k: -p for k, p in row.items()}

    def forward(self, tangents: Mapping[int, Scalar]) -> SparseRow:
        """Return the tangents by which rows are multiplied, by the index of the node: those of inputs and of opaque results.

        `tangents` are those of inputs; inputs without one are constant.
        """
        all_tangents = {k: t for k, t in tangents.items() if not t.is_zero}
        for call, results in self._calls.items():
            arguments = [product(self.row(a), all_tangents, self.graph) for a in self.graph.nodes[call].arguments]
            all_tangents.update(_push_forward(self.graph, call, results, arguments))
        return all_tangents

    def reverse(self, cotangents: SparseRow) -> list[Scalar]:
        """Return the cotangent of each input.

        `cotangents` has, by the index of the node, the sums of rows weighted by the cotangents of outputs: those of inputs and
        of results of opaque nodes. The latter are passed on to the arguments of these nodes.
        """
        all_cotangents = dict(cotangents)
        for call, results in reversed(self._calls.items()):
            seeds = {k: all_cotangents.pop(k) for k in results if k in all_cotangents}
            if seeds:
                arguments = self.graph.nodes[call].arguments
                cotangents_of_arguments = _pull_back(self.graph, call, seeds, [bool(self.row(a)) for a in arguments])
                for argument, cotangent in zip(arguments, cotangents_of_arguments, strict=True):
                    accumulate(all_cotangents, self.row(argument), cotangent)
        return [all_cotangents.get(s.index, self.graph.constant(0.0, s.node.dtype)) for s in self.inputs]

    def _differentiate(self, index: int) -> SparseRow:
        graph, node = self.graph, self.graph.nodes[index]
        if node.kind in ("input", "constant", "call") or not np.issubdtype(node.dtype, np.floating):
            return {}
        if node.kind == "pick":
            (call,) = node.arguments
            if not any(self.row(a) for a in call.node.arguments):
                return {}
            self._calls.setdefault(call.index, []).append(index)
            return {index: graph.constant(1.0, node.dtype)}
        if is_choice(node):
            return self._differentiate_choice(node)
        result: SparseRow = {}
        for k, argument in enumerate(node.arguments):
            row = self.row(argument)
            if row:
                accumulate(result, row, partial_derivative(graph, index, node, k))
        return {k: p for k, p in result.items() if not p.is_zero}

    def _differentiate_choice(self, node: Node) -> SparseRow:
        which, *cases = node.arguments
        rows, zero = [self.row(a) for a in cases], self.graph.constant(0.0, node.dtype)
        parts = {k: [row.get(k, zero) for row in rows] for row in rows for k in row}
        return {k: choose(self.graph, node, which, p) for k, p in parts.items()}


def tangents(
    graph: Graph, outputs: Sequence[Scalar], seeds: Mapping[Scalar, Scalar], given: Collection[int] | None = None
) -> list[Scalar]:
    """Differentiate outputs along tangents of inputs: the directional derivatives sum (df/dx) dx.

    Args:
        graph: The graph of all scalars.
        outputs: The functions f.
        seeds: The tangents dx by input; an input without one is constant.
        given: Indices of nodes that are computed anyway, so that splitting them saves nothing. If not None, a factor that all
            df/dx of one input x share multiplies dx once, instead of being part of each df/dx.

    Returns:
        The tangent of each output.
    """
    nodes = ActiveNodes(graph, outputs, list(seeds))
    if nodes.are_fewer:
        return nodes.push_forward(list(seeds.values()))
    differential = Differential(graph, outputs, list(seeds))
    tangents_of_nodes = differential.forward({s.index: t if s.sign > 0 else -t for s, t in seeds.items()})
    rows, factors = _factored(differential, outputs, given)
    tangents_of_nodes = {k: t * factors[k] if k in factors else t for k, t in tangents_of_nodes.items()}
    return [product(row, tangents_of_nodes, graph) for row in rows]


def cotangents(
    graph: Graph,
    outputs: Sequence[Scalar],
    seeds: Sequence[Scalar],
    inputs: Sequence[Scalar],
    given: Collection[int] | None = None,
) -> list[Scalar]:
    """Differentiate sum(seeds * outputs) with respect to inputs.

    Args:
        graph: The graph of all scalars.
        outputs: The functions.
        seeds: The cotangent of each output.
        inputs: The variables.
        given: Indices of nodes that are computed anyway; see `tangents`.

    Returns:
        The cotangent of each input.
    """
    nodes = ActiveNodes(graph, outputs, inputs)
    if nodes.are_fewer:
        return nodes.pull_back(seeds)
    differential, result = Differential(graph, outputs, inputs), {}
    rows, factors = _factored(differential, outputs, given)
    for row, seed in zip(rows, seeds, strict=True):
        accumulate(result, row, seed)
    result = {k: c * factors[k] if k in factors else c for k, c in result.items()}
    return [c if s.sign > 0 else -c for c, s in zip(differential.reverse(result), inputs, strict=True)]


def _factored(
    differential: Differential, outputs: Sequence[Scalar], given: Collection[int] | None
) -> tuple[list[SparseRow], SparseRow]:
    rows = [differential.row(s) for s in outputs]
    return (rows, {}) if given is None else common_factors(rows, given)


def product(row: SparseRow, vector: Mapping[int, Scalar], graph: Graph) -> Scalar:
    """Return the product of a sparse row and a vector; entries that either of them lacks are zero."""
    return sum((p * vector[k] for k, p in row.items() if k in vector), graph.constant(0.0))


def accumulate(total: SparseRow, row: SparseRow, factor: Scalar) -> None:
    """Add `factor` times `row` to the row `total`, in place."""
    if factor.is_zero:
        return
    for k, p in row.items():
        total[k] = total[k] + p * factor if k in total else p * factor


def common_factors(rows: Sequence[SparseRow], given: Collection[int] = ()) -> tuple[list[SparseRow], SparseRow]:
    """Divide each column of a matrix by a factor that its entries share, if any; return the new rows, and factors by column.

    One product with the tangent of a column replaces a product for each entry. Columns of one entry are left as they are, and
    entries whose nodes are in `given` are not split into factors.
    """
    columns: dict[int, list[Scalar]] = {}
    for row in rows:
        for k, entry in row.items():
            columns.setdefault(k, []).append(entry)
    factors: SparseRow = {}
    for k, entries in columns.items():
        splits = [e.node.kind == "mul" and e.index not in given for e in entries]
        factors_of_entries = [
            {a.index for a in e.node.arguments} if split else set() for e, split in zip(entries, splits, strict=True)
        ]
        common = set.intersection(*factors_of_entries) if len(entries) > 1 else None
        if common:
            factors[k] = Scalar(entries[0].graph, max(common))
    return [{k: _without(e, factors[k]) if k in factors else e for k, e in row.items()} for row in rows], factors


def _without(entry: Scalar, factor: Scalar) -> Scalar:
    first, second = entry.node.arguments
    quotient = second if first.index == factor.index else first
    return quotient if entry.sign > 0 else -quotient


# --- by JAX's rules


def _push_forward(graph: Graph, call: int, results: Sequence[int], tangents: Sequence[Scalar]) -> SparseRow:
    """Return the nonzero tangents of `results` of an opaque node, by index, from the tangents of all its arguments."""
    node = graph.nodes[call]
    arrays, dots = _arrays(node, node.arguments), _arrays(node, tangents)
    active = [k for k, dot in enumerate(dots) if any(not s.is_zero for s in dot.flat)]
    if not active:
        return {}
    wanted = _outputs(graph, results)

    def pushed(arrays, dots):
        return jax.jvp(_restrict(node.detail, arrays, active, wanted), [arrays[k] for k in active], dots)[1]

    jaxpr = jax.make_jaxpr(pushed)(_structs(arrays), _structs([dots[k] for k in active]))
    result = dict(zip(wanted, read_jaxpr(graph, jaxpr, [*arrays, *(dots[k] for k in active)]), strict=True))
    return {k: _pick(graph, k, result) for k in results if not _pick(graph, k, result).is_zero}


def _pull_back(graph: Graph, call: int, seeds: SparseRow, flags: Sequence[bool]) -> list[Scalar]:
    """Return the cotangents of the arguments of an opaque node from the cotangents `seeds` of its results, by index.

    `flags` has True for each argument that depends on the inputs. The cotangents of an array without any such argument are zero.
    """
    node = graph.nodes[call]
    arrays, wanted = _arrays(node, node.arguments), _outputs(graph, list(seeds))
    active = [k for k, flags in enumerate(_arrays(node, flags)) if flags.any()]
    shapes = jax.eval_shape(lambda *a: _restrict(node.detail, a, [], wanted)(), *_structs(arrays))
    cts = [np.full(s.shape, graph.constant(0.0, s.dtype), object) for s in shapes]
    for k, seed in seeds.items():
        output, flat = graph.nodes[k].detail
        cts[wanted.index(output)].reshape(-1)[flat] = seed

    def cotangents_of_arguments(arrays, cts):
        return jax.vjp(_restrict(node.detail, arrays, active, wanted), *(arrays[k] for k in active))[1](cts)

    jaxpr = jax.make_jaxpr(cotangents_of_arguments)(_structs(arrays), list(shapes))
    result = [np.full(a.shape, graph.constant(0.0), object) for a in arrays]
    for k, cotangent in zip(active, read_jaxpr(graph, jaxpr, [*arrays, *cts]), strict=True):
        result[k] = cotangent
    return [s for array in result for s in array.flat]


def _restrict(
    detail: BoundPrimitive, arrays: Sequence[jax.Array], active: Sequence[int], wanted: Sequence[int]
) -> Callable[..., list[jax.Array]]:
    """Return an array primitive as a function of its `active` arguments that returns a list of its `wanted` results.

    Both are positions. The other arguments have the values in `arrays`.
    """

    def function(*active_values):
        values = list(arrays)
        for k, value in zip(active, active_values, strict=True):
            values[k] = value
        results = detail.primitive.bind(*values, **detail.parameters)
        results = results if detail.primitive.multiple_results else [results]
        return [results[k] for k in wanted]

    return function


def _outputs(graph: Graph, results: Sequence[int]) -> list[int]:
    return sorted({graph.nodes[k].detail[0] for k in results})


def _pick(graph: Graph, k: int, outputs: Mapping[int, np.ndarray]) -> Scalar:
    output, flat = graph.nodes[k].detail
    return outputs[output].flat[flat]  # pyright: ignore[reportReturnType]


def _arrays(node: Node, scalars: Sequence[object]) -> list[np.ndarray]:
    arrays, start = [], 0
    for shape in node.detail.shapes:
        size = int(np.prod(shape))
        array = np.empty(size, object)
        array[:] = scalars[start : start + size]
        arrays.append(array.reshape(shape))
        start += size
    return arrays


def _structs(arrays: Sequence[np.ndarray]) -> list[jax.ShapeDtypeStruct]:
    return [jax.ShapeDtypeStruct(a.shape, a.flat[0].node.dtype if a.size else float) for a in arrays]
