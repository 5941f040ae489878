"""A graph of scalar expressions.

Equal expressions are one node, zeros and ones vanish while the graph is built, and a sign costs nothing: a `Scalar` is a
signed reference to a node, so that a - b, b - a and -(a - b) share one subtraction. Nodes that no output needs are
never emitted (scalar_program.py), so a caller may build more nodes than it needs.
"""

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from threading import Lock
from typing import Any, NamedTuple, Protocol

import numpy as np
from jax.extend.core import Primitive
from numpy.typing import DTypeLike


class Node(NamedTuple):
    """One operation, identified by its arguments and `detail`: a name, a value or the parameters of a primitive."""

    kind: (
        str  # input, constant, add, sub, mul, div, sqrt, apply (a JAX primitive on scalars), call (on arrays), pick (from a call)
    )
    arguments: tuple["Scalar", ...]
    detail: Any
    dtype: np.dtype
    depends: frozenset[str]  # the groups of inputs that it depends on


class Scalar:
    """A signed reference to a node, with arithmetic. Only floating-point scalars carry a sign."""

    __slots__ = ("graph", "index", "sign")

    def __init__(self, graph: "Graph", index: int, sign: int = 1):
        self.graph, self.index, self.sign = graph, index, sign

    @property
    def node(self) -> Node:
        return self.graph.nodes[self.index]

    @property
    def constant(self) -> Any:
        """The value of a constant, else None."""
        node = self.node
        if node.kind != "constant":
            return None
        return node.detail if self.sign > 0 else -node.detail

    @property
    def is_zero(self) -> bool:
        return self.constant == 0.0

    def __eq__(self, other):
        return isinstance(other, Scalar) and (self.index, self.sign) == (other.index, other.sign) and self.graph is other.graph

    def __hash__(self):
        return hash((self.index, self.sign))

    def __neg__(self):
        return self.graph.negate(self)

    def __add__(self, other):
        return self.graph.add(self, self.graph.scalar(other))

    def __sub__(self, other):
        return self.graph.add(self, -self.graph.scalar(other))

    def __mul__(self, other):
        return self.graph.multiply(self, self.graph.scalar(other))

    def __truediv__(self, other):
        return self.graph.divide(self, self.graph.scalar(other))

    def __radd__(self, other):
        return self + other

    def __rsub__(self, other):
        return self.graph.scalar(other) - self

    def __rmul__(self, other):
        return self * other

    def __rtruediv__(self, other):
        return self.graph.scalar(other) / self

    def __repr__(self):
        node = self.node
        return f"{'-' if self.sign < 0 else ''}%{self.index}:{node.kind}{'' if node.detail is None else f'[{node.detail}]'}"


_ADDING_LOCK = Lock()  # kernels of cached graphs are written by several threads, such as those of a sweep


class Graph:
    """Nodes in an order in which every argument comes before its use."""

    def __init__(self, dtype: DTypeLike = np.float64):
        self.dtype = np.dtype(dtype)
        self.nodes: list[Node] = []
        self._known: dict[Hashable, int] = {}

    @property
    def key(self) -> tuple[Hashable, ...]:
        """All nodes, in order, as a tuple that is equal for equal graphs."""
        return tuple(self._known)

    # --- leaves

    def input(self, name: Hashable, group: str, dtype: DTypeLike | None = None) -> Scalar:
        """Return an input, identified by its group and its name, which is added unless the graph has it.

        The group is the kind of quantity, so that a program can be split by the groups that its nodes depend on.
        """
        return Scalar(self, self._node("input", (), (group, name), np.dtype(dtype or self.dtype), frozenset([group])))

    def constant(self, value: Any, dtype: DTypeLike | None = None) -> Scalar:
        """Return a constant; equal constants of one type are one node."""
        dtype = np.dtype(dtype or self.dtype)
        value = dtype.type(value).item()
        if dtype.kind == "f" and math.copysign(1.0, value) < 0:
            return Scalar(self, self._node("constant", (), -value, dtype, frozenset()), -1 if value != 0 else 1)
        return Scalar(self, self._node("constant", (), value, dtype, frozenset()))

    def scalar(self, value: "Scalar | float") -> Scalar:
        """Return `value` as a scalar of this graph."""
        return value if isinstance(value, Scalar) else self.constant(value)

    # --- arithmetic

    def negate(self, a: Scalar) -> Scalar:
        """Return -a."""
        return a if a.is_zero else Scalar(self, a.index, -a.sign)

    def add(self, a: Scalar, b: Scalar) -> Scalar:
        """Return a + b."""
        x, y = a.constant, b.constant
        if x == 0.0:
            return b
        if y == 0.0:
            return a
        if x is not None and y is not None:
            return self.constant(x + y, a.node.dtype)
        if a.index == b.index:
            return self.constant(0.0, a.node.dtype) if a.sign != b.sign else a * self.constant(2.0, a.node.dtype)
        if b.index < a.index:
            a, b = b, a
        kind = "add" if a.sign == b.sign else "sub"
        return Scalar(self, self._operation(kind, (Scalar(self, a.index), Scalar(self, b.index))), a.sign)

    def multiply(self, a: Scalar, b: Scalar) -> Scalar:
        """Return a * b."""
        x, y = a.constant, b.constant
        if x is not None and y is not None:
            return self.constant(x * y, a.node.dtype)
        for x_side, other, factor in ((a, b, x), (b, a, y)):
            if factor == 0.0:
                return x_side
            if factor in (1.0, -1.0):
                return other if factor > 0 else -other
        if b.index < a.index:
            a, b = b, a
        return Scalar(self, self._operation("mul", (Scalar(self, a.index), Scalar(self, b.index))), a.sign * b.sign)

    def divide(self, a: Scalar, b: Scalar) -> Scalar:
        """Return a / b."""
        if a.is_zero:
            return a
        if b.constant in (1.0, -1.0):
            return a if b.constant > 0 else -a
        if a.constant is not None and b.constant not in (None, 0.0):
            return self.constant(a.constant / b.constant, a.node.dtype)
        if a.index == b.index:
            return self.constant(float(a.sign * b.sign), a.node.dtype)
        return Scalar(self, self._operation("div", (Scalar(self, a.index), Scalar(self, b.index))), a.sign * b.sign)

    def sqrt(self, a: Scalar) -> Scalar:
        """Return the square root."""
        if a.constant is not None:
            return self.constant(math.sqrt(a.constant), a.node.dtype)
        return Scalar(self, self._operation("sqrt", (a,)))

    # --- everything else

    def apply(
        self, primitive: Primitive, parameters: dict, arguments: tuple[Scalar, ...], dtype: DTypeLike, fold: Callable
    ) -> Scalar:
        """Apply a JAX primitive to scalars.

        Args:
            primitive: The primitive.
            parameters: Its parameters, as in a jaxpr.
            arguments: The scalars.
            dtype: The type of the result.
            fold: A function of arrays that computes the result if all arguments are constants.

        Returns:
            The result; a constant if all arguments are.
        """
        if all(a.constant is not None for a in arguments):
            return self.constant(np.asarray(fold(*(np.asarray(a.constant, a.node.dtype) for a in arguments))).item(), dtype)
        detail = BoundPrimitive(primitive, parameters)
        return Scalar(self, self._operation("apply", tuple(arguments), detail, np.dtype(dtype)))

    def call(
        self, detail: "BoundPrimitive", arguments: tuple[Scalar, ...], outputs: list[tuple[tuple[int, ...], DTypeLike]]
    ) -> list[np.ndarray]:
        """Apply a JAX primitive to whole arrays, as one opaque node and a `pick` for each element of its results.

        Args:
            detail: The primitive, with the shapes of its arguments.
            arguments: The elements of all arguments, array by array.
            outputs: The shape and the type of each result.

        Returns:
            The results as arrays of Scalars.
        """
        index = self._operation("call", arguments, detail, np.dtype(object))
        arrays = []
        for k, (shape, dtype) in enumerate(outputs):
            array = np.empty(shape, object)
            for position in np.ndindex(*shape):
                flat = int(np.ravel_multi_index(position, shape)) if shape else 0
                array[position] = Scalar(self, self._operation("pick", (Scalar(self, index),), (k, flat), np.dtype(dtype)))
            arrays.append(array)
        return arrays

    def dependencies(self, wanted: Iterable[int], given: Collection[int] = (), group: str | None = None) -> list[int]:
        """Return the nodes from which the `wanted` nodes are computed, and these themselves, in order of evaluation.

        The `given` nodes are left out, with all nodes that only they need. With a `group` of inputs, nodes that do not depend on
        this group are left out, too. All nodes are given by index.
        """
        nodes, visited, stack = self.nodes, set(), list(wanted)
        while stack:
            index = stack.pop()
            if index not in visited and index not in given and (group is None or group in nodes[index].depends):
                visited.add(index)
                stack += [a.index for a in nodes[index].arguments]
        return sorted(visited)

    def copy(self, program: "Expressions", inputs: Mapping[int, Scalar]) -> list[Scalar]:
        """Copy a program of another graph into this one and return its outputs.

        `inputs` has the scalars of this graph that replace the inputs of the program, by the index of the input's node.
        """
        copies = dict(inputs)

        def copied(a: Scalar) -> Scalar:
            new = copies[a.index]
            return new if a.sign > 0 else -new

        for index in program.order:
            node = program.graph.nodes[index]
            copies[index] = self.again(node, [copied(a) for a in node.arguments])
        return [copied(s) for s in program.outputs]

    def again(self, node: Node, arguments: Sequence[Scalar]) -> Scalar:
        """Return the result of a node's operation on other arguments."""
        match node.kind:
            case "constant":
                return self.constant(node.detail, node.dtype)
            case "add":
                return self.add(*arguments)
            case "sub":
                return arguments[0] - arguments[1]
            case "mul":
                return self.multiply(*arguments)
            case "div":
                return self.divide(*arguments)
            case "sqrt":
                return self.sqrt(*arguments)
        return Scalar(self, self._operation(node.kind, tuple(arguments), node.detail, node.dtype))

    def _operation(self, kind, arguments, detail=None, dtype=None) -> int:
        depends: frozenset[str] = frozenset()
        for a in arguments:
            more = self.nodes[a.index].depends
            if more is not depends and not more <= depends:  # most are, and need no new set
                depends = more if depends <= more else depends | more
        return self._node(kind, arguments, detail, dtype or arguments[0].node.dtype, depends)

    def _node(self, kind, arguments, detail, dtype, depends) -> int:
        key = (kind, tuple([(a.index, a.sign) for a in arguments]), detail, dtype)
        index = self._known.get(key)
        if index is None:
            with _ADDING_LOCK:
                index = self._known.get(key)
                if index is None:
                    index = len(self.nodes)
                    self.nodes.append(Node(kind, arguments, detail, dtype, depends))
                    self._known[key] = index  # last, since other threads look here without the lock
        return index


class Expressions(Protocol):
    """Nodes of a graph in order of evaluation, and the outputs among them."""

    graph: Graph
    order: list[int]
    outputs: list[Scalar]


class BoundPrimitive:
    """A primitive with its parameters and, for arrays, the shapes of its arguments; equal if the computations are equal."""

    def __init__(self, primitive: Primitive, parameters: dict, shapes: tuple = (), name: str = ""):
        self.primitive, self.parameters, self.shapes = primitive, parameters, shapes
        self._name = name or primitive.name
        self._key = (primitive.name, shapes, tuple(sorted((k, str(v)) for k, v in parameters.items())))

    def __eq__(self, other):
        return isinstance(other, BoundPrimitive) and self._key == other._key

    def __hash__(self):
        return hash(self._key)

    def __repr__(self):
        return self._name
