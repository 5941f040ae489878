"""Derivatives of a graph node by node: each operation passes tangents on, or cotangents back."""

from collections.abc import Iterator, Sequence
from functools import lru_cache

import jax
import numpy as np

from udkjax.expressions.reading.jaxpr_reader import ClosedJaxpr, read_jaxpr
from udkjax.expressions.scalars.graph import BoundPrimitive, Graph, Node, Scalar


class ActiveNodes:
    """The nodes between `inputs` and `outputs` that have derivatives, in order of evaluation."""

    are_fewer: bool
    """True if a pass from node to node takes fewer operations than a product with the Jacobian."""

    def __init__(self, graph: Graph, outputs: Sequence[Scalar], inputs: Sequence[Scalar]):
        self._graph, self._outputs, self._inputs = graph, list(outputs), list(inputs)
        reached = {s.index: 1 << k for k, s in enumerate(inputs)}  # for each node a bit for each input on which it depends
        self._order: list[int] = []
        operations, is_arithmetic = 0, True
        for index in graph.dependencies([s.index for s in outputs], reached):
            node = graph.nodes[index]
            bits = 0
            for a in node.arguments:
                bits |= reached.get(a.index, 0)
            if not bits:
                continue
            is_arithmetic = is_arithmetic and node.kind != "call"
            if not np.issubdtype(node.dtype, np.floating):
                continue
            reached[index] = bits
            self._order.append(index)
            count = sum(a.index in reached for a in node.arguments)
            operations += count - 1 + (0 if node.kind in ("add", "sub") else count)
        entries = [reached.get(s.index, 0).bit_count() for s in outputs]
        self.are_fewer = is_arithmetic and operations < sum(2 * count - 1 for count in entries if count)
        self._active = reached

    def push_forward(self, seeds: Sequence[Scalar]) -> list[Scalar]:
        """Return the tangents of the outputs from those of the inputs."""
        zero = self._graph.constant(0.0)
        found = {s.index: _signed(t, s) for s, t in zip(self._inputs, seeds, strict=True)}
        for index in self._order:
            node = self._graph.nodes[index]
            if is_choice(node):
                which, *cases = node.arguments
                still = self._graph.constant(0.0, node.dtype)
                tangents = [_signed(found.get(a.index, still), a) for a in cases]
                found[index] = choose(self._graph, node, which, tangents)
            else:
                found[index] = sum(
                    (slope * _signed(found[a.index], a) for a, slope in self._slopes(index, node)), self._graph.constant(0.0)
                )
        return [_signed(found.get(s.index, zero), s) for s in self._outputs]

    def pull_back(self, seeds: Sequence[Scalar]) -> list[Scalar]:
        """Return the cotangents of the inputs from those of the outputs."""
        zero = self._graph.constant(0.0)
        found: dict[int, Scalar] = {}

        def add(a: Scalar, cotangent: Scalar):
            if a.index in self._active and not cotangent.is_zero:
                signed = _signed(cotangent, a)
                found[a.index] = found[a.index] + signed if a.index in found else signed

        for s, seed in zip(self._outputs, seeds, strict=True):
            add(s, seed)
        for index in reversed(self._order):
            if index not in found:
                continue
            node, cotangent = self._graph.nodes[index], found.pop(index)
            if is_choice(node):
                which, *cases = node.arguments
                still = self._graph.constant(0.0, node.dtype)
                for k, a in enumerate(cases):
                    if a.index in self._active:
                        parts = [cotangent if i == k else still for i in range(len(cases))]
                        add(a, choose(self._graph, node, which, parts))
            else:
                for a, slope in self._slopes(index, node):
                    add(a, slope * cotangent)
        return [_signed(found.get(s.index, zero), s) for s in self._inputs]

    def _slopes(self, index: int, node: Node) -> Iterator[tuple[Scalar, Scalar]]:
        """Yield each argument of a node that has derivatives, with the partial derivative of the node with respect to it."""
        for k, a in enumerate(node.arguments):
            if a.index in self._active:
                yield a, partial_derivative(self._graph, index, node, k)


def _signed(x: Scalar, a: Scalar) -> Scalar:
    return x if a.sign > 0 else -x


def is_choice(node: Node) -> bool:
    """Return True if a node selects one of several cases: JAX's `select_n`."""
    return node.kind == "apply" and node.detail.primitive.name == "select_n"


def choose(graph: Graph, node: Node, which: Scalar, cases: Sequence[Scalar]) -> Scalar:
    """Return the selection that a node makes (`is_choice`), by the same argument `which`, but among other `cases`."""
    fold = lambda *values: values[1 + int(values[0])]  # noqa: E731
    return graph.apply(node.detail.primitive, node.detail.parameters, (which, *cases), node.dtype, fold)


def partial_derivative(graph: Graph, index: int, node: Node, k: int) -> Scalar:
    """Return the derivative of a node with respect to its k-th argument."""
    one, value = graph.constant(1.0, node.dtype), Scalar(graph, index)
    match node.kind:
        case "add":
            return one
        case "sub":
            return one if k == 0 else -one
        case "mul":
            return node.arguments[1 - k]
        case "div":
            reciprocal = one / node.arguments[1]
            return reciprocal if k == 0 else -(value * reciprocal)
        case "sqrt":
            return graph.constant(0.5, node.dtype) / value
    detail, dtypes = node.detail, tuple(a.node.dtype for a in node.arguments)
    (slope,) = read_jaxpr(graph, _slope(detail, dtypes, k), [np.asarray(a, object) for a in node.arguments])
    return slope.item()


@lru_cache(maxsize=256)
def _slope(detail: BoundPrimitive, dtypes: tuple[np.dtype, ...], k: int) -> ClosedJaxpr:
    """Return the derivative of a primitive on scalars with respect to its k-th argument, as a jaxpr."""

    def slope(*scalars):
        f = lambda x: detail.primitive.bind(*scalars[:k], x, *scalars[k + 1 :], **detail.parameters)  # noqa: E731
        return jax.jvp(f, (scalars[k],), (np.ones((), dtypes[k]),))[1]

    return jax.make_jaxpr(slope)(*(jax.ShapeDtypeStruct((), d) for d in dtypes))
