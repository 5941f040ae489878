"""One element, a constraint or a force, as scalars of a graph; the trace serves all elements of the same structure.

A rolling joint gives A v in place of Psi_dot, A in place of Psi_q, and Psi = 0: its rows restrict no positions. For any other
constraint with residual Psi(t, q), forward differentiation of the residual along (1, v) gives

    Psi_dot = Psi_q v + Psi_t        gamma = -(Psi_q v)_q v - 2 Psi_qt v - Psi_tt

If it needs fewer operations, gamma is computed from derivatives of the entries of Psi_q, which often are other entries of Psi_q.
Differentiation along unit vectors, whose zeros the graph removes, gives the columns of Psi_q; a row is stored as {column:
scalar}.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.annotations import NumericArray, TreeDef
from udkjax.equations.terms.structure import Element, ElementStructure, LeafShapes, RubbingJoint, element_structure
from udkjax.expressions import Differential, Graph, Scalar, operations, trace
from udkjax.expressions.algebra.differential import SparseRow
from udkjax.scene.elements.bodies import GROUND_FRAME, GROUND_FRAME_AT_REST, Frame
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.joints import Constraint
from udkjax.scene.elements.rolling import RollingJoint

TraceFunction = Callable[..., list[np.ndarray]]  # evaluates a traced function in a graph (`trace`)


def as_scalar(array: NumericArray) -> Scalar:
    """Return the scalar that an array of shape () holds."""
    return np.asarray(array, object).item()


def _frames(ground: tuple[bool, ...], q: Sequence[Array], v: Sequence[Array] | None = None) -> list[Frame]:
    """Return the frames of an element from the coordinates q of its bodies, and their velocities v unless v is None.

    `ground` marks the frames that are the ground. The sine and cosine of each angle are computed here, once for the element.
    """
    frames, k = [], 0
    for fixed in ground:
        if fixed:
            frames.append(GROUND_FRAME if v is None else GROUND_FRAME_AT_REST)
        else:
            x, y, angle = q[k : k + 3]
            frames.append(Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *(() if v is None else v[k : k + 3])))
            k += 3
    return frames


def differentiate_constraint(
    graph: Graph, kind: ElementStructure, leaves: list[np.ndarray], t: Scalar, q: list[Scalar], v: list[Scalar]
) -> tuple[list[Scalar], list[SparseRow], list[Scalar], list[Scalar]]:
    """Return Psi, the rows of Psi_q over the columns of q, Psi_dot and gamma of a constraint on scalars."""
    first_derivative, second_derivative = _trace_residual(*kind)
    one, zero = graph.constant(1.0), graph.constant(0.0)

    def derivative(program: TraceFunction, dt: Scalar, dq: list[Scalar]) -> list[list[Scalar]]:
        return [list(array) for array in program(graph, leaves, [np.asarray(s, object) for s in (t, *q, dt, *dq)])]

    value, rate = derivative(first_derivative, one, v)
    (acceleration,) = derivative(second_derivative, one, v)
    rows: list[SparseRow] = [{} for _ in value]
    for k in range(len(q)):
        unit = [one if i == k else zero for i in range(len(q))]
        for row, entry in zip(rows, derivative(first_derivative, zero, unit)[1], strict=True):
            if not entry.is_zero:
                row[k] = entry
    if not any("time" in s.node.depends for s in value):
        acceleration = choose_shorter(graph, rows, acceleration, gamma_by_entries(graph, rows, q, v))
    return value, rows, rate, [-s for s in acceleration]


def gamma_by_entries(graph: Graph, rows: list[SparseRow], q: list[Scalar], v: list[Scalar]) -> list[Scalar] | None:
    """Return (Psi_q v)_q v as the sum of (dPsi_q[k]/dq[j]) v[j] v[k]; None if an entry contains an opaque expression."""
    entries = Differential(graph, [entry for row in rows for entry in row.values()], q)
    column = {s.index: j for j, s in enumerate(q)}
    total = []
    for row in rows:
        terms: dict[tuple[int, int], Scalar] = {}
        for k, entry in row.items():
            for variable, slope in entries.row(entry).items():
                if variable not in column:
                    return None
                pair = min(k, column[variable]), max(k, column[variable])
                terms[pair] = terms[pair] + slope if pair in terms else slope
        total.append(sum((slope * (v[j] * v[k]) for (j, k), slope in terms.items()), graph.constant(0.0)))
    return total


def choose_shorter(graph: Graph, rows: list[SparseRow], first: list[Scalar], second: list[Scalar] | None) -> list[Scalar]:
    """Return the one of two equal lists of expressions that needs fewer operations once the entries of the rows are computed.

    If `second` is None, the result is `first`.
    """
    if second is None:
        return first
    entries = [entry for row in rows for entry in row.values()]
    return second if operations(graph, entries, second) < operations(graph, entries, first) else first


def trace_force(
    graph: Graph, kind: ElementStructure, leaves: list[np.ndarray], t: Scalar, q: list[Scalar], v: list[Scalar]
) -> tuple[list[Scalar], Scalar]:
    """Return the generalized loads of a force element over the columns of q, and its potential, on scalars."""
    loads, energy = _trace_loads(*kind)
    numbers = [np.asarray(s, object) for s in (t, *q, *v)]
    (stored,) = energy(graph, leaves, numbers)
    return [as_scalar(s) for s in loads(graph, leaves, numbers)], as_scalar(stored)


def trace_rubbing(
    graph: Graph,
    kind: ElementStructure,
    leaves: list[np.ndarray],
    t: Scalar,
    q: list[Scalar],
    v: list[Scalar],
    multipliers: list[Scalar],
) -> tuple[list[Scalar], list[list[Scalar]]]:
    """Return the generalized loads of a `RubbingJoint` over the columns of q, and their derivatives by each multiplier."""
    program = _trace_rubbing(*kind, len(multipliers))
    one, zero = graph.constant(1.0), graph.constant(0.0)

    def derivative(seeds: list[Scalar]) -> list[list[Scalar]]:
        numbers = [np.asarray(s, object) for s in (t, *q, *v, *multipliers, *seeds)]
        return [list(array) for array in program(graph, leaves, numbers)]

    count = len(multipliers)
    slopes = [derivative([one if i == k else zero for i in range(count)])[1] for k in range(count)]
    return derivative([zero] * count)[0], slopes


@lru_cache(maxsize=256)
def _trace_rubbing(tree: TreeDef, shapes: LeafShapes, ground: tuple[bool, ...], rows: int) -> TraceFunction:
    """Trace the generalized loads of a `RubbingJoint`, and their derivative along a change of the multipliers."""
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def loads(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        frames = _frames(ground, numbers[1 : 1 + n], numbers[1 + n : 1 + 2 * n])

        def of(multipliers):
            found = element.loads(multipliers, numbers[0], *frames)
            return jnp.stack([jnp.asarray(c) for load, fixed in zip(found, ground, strict=True) if not fixed for c in load])

        multipliers, changes = numbers[1 + 2 * n : 1 + 2 * n + rows], numbers[1 + 2 * n + rows :]
        return jax.jvp(of, (multipliers,), (changes,))

    return trace(loads, leaves, [number] * (1 + 2 * n + 2 * rows))


class TracedLoads:
    """The loads of all force elements of one structure, as scalars of a graph; compared by identity.

    Attributes:
        kind: the structure.
        graph: the graph.
        inputs: the numbers of the element, t, q and v of its bodies; groups "number", "time", "q" and "v".
        velocities: v.
        loads: the generalized loads, including those of the potential.
    """

    def __init__(self, kind: ElementStructure):
        self.kind, self.graph = kind, Graph()
        leaves = []
        for k, (shape, dtype) in enumerate(kind.shapes):
            array = np.empty(shape, object)
            for place in np.ndindex(*shape):
                array[place] = self.graph.input((k, place), "number", dtype)
            leaves.append(array)
        t = self.graph.input("t", "time")
        q, self.velocities = ([self.graph.input(k, group) for k in range(3 * kind.body_count)] for group in "qv")
        self.inputs = [*(s for array in leaves for s in array.flat), t, *q, *self.velocities]
        self.loads, _ = trace_force(self.graph, kind, leaves, t, q, self.velocities)


_traced_loads = lru_cache(maxsize=256)(TracedLoads)


def traced_loads(element: ForceElement, frames: Sequence[str]) -> TracedLoads:
    """Return the loads of a force element attached to `frames`, names of bodies or the ground, traced once for its structure."""
    return _traced_loads(element_structure(element, frames))


def trace_edge_loads(graph: Graph, kind: ElementStructure, leaves: list[np.ndarray], multipliers: list[Scalar]) -> list[Scalar]:
    """Return the loads of a `RubbingJoint` whose magnitudes determine its friction (`Friction.edge_loads`), if any."""
    found = _trace_edge_loads(kind.tree, kind.shapes, len(multipliers))
    return [] if found is None else [as_scalar(s) for s in found(graph, leaves, [np.asarray(s, object) for s in multipliers])[0]]


@lru_cache(maxsize=256)
def _trace_edge_loads(tree: TreeDef, shapes: LeafShapes, rows: int) -> TraceFunction | None:
    arguments = [jax.ShapeDtypeStruct(*s) for s in shapes], [jax.ShapeDtypeStruct((), jnp.result_type(float))] * rows

    def edge_loads(leaves, multipliers):
        element = jax.tree.unflatten(tree, leaves)
        return element.friction.edge_loads(element.joint, multipliers)

    if not jax.eval_shape(edge_loads, *arguments):
        return None
    return trace(lambda *given: (jnp.stack(edge_loads(*given)),), *arguments)


def has_pieces(element: Element) -> bool:
    """Return whether an element is piecewise smooth, that is, overrides the method `piece`."""
    if isinstance(element, RubbingJoint):
        return False
    return type(element).piece not in (Constraint.piece, ForceElement.piece)


def trace_piece(
    graph: Graph, kind: ElementStructure, leaves: list[np.ndarray], t: Scalar, q: list[Scalar], v: list[Scalar]
) -> Scalar:
    """Return the index of the smooth piece that contains the state of an element, on scalars."""
    (piece,) = _trace_piece_number(*kind)(graph, leaves, [np.asarray(s, object) for s in (t, *q, *v)])
    return as_scalar(piece)


@lru_cache(maxsize=256)
def _trace_piece_number(tree: TreeDef, shapes: LeafShapes, ground: tuple[bool, ...]) -> TraceFunction:
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def piece(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        v = numbers[1 + n :] if isinstance(element, ForceElement) else None
        return jnp.asarray(element.piece(numbers[0], *_frames(ground, numbers[1 : 1 + n], v)), number.dtype)

    return trace(piece, leaves, [number] * (1 + 2 * n))


def _residual(element: Constraint, ground: tuple[bool, ...], t: Array, q: Sequence[Array]) -> Array:
    return _as_rows(element.residual(t, *_frames(ground, q)))


def _as_rows(rows: Any) -> Array:
    """Return the rows of a joint, given as a list of numbers, an array or a number, as one vector."""
    rows = rows if isinstance(rows, list | tuple) else list(jnp.atleast_1d(jnp.asarray(rows)))
    return jnp.stack([jnp.asarray(r, jnp.result_type(float)) for r in rows])


@lru_cache(maxsize=256)
def _trace_residual(tree: TreeDef, shapes: LeafShapes, ground: tuple[bool, ...]) -> tuple[TraceFunction, TraceFunction]:
    """Trace functions of (t, q, dt, dq): a residual with its derivative along (dt, dq), and its second derivative along it."""
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def first_derivative(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        t, q, dt, dq = numbers[0], numbers[1 : 1 + n], numbers[1 + n], numbers[2 + n :]
        value, rate = jax.jvp(lambda t, q: _residual(element, ground, t, q), (t, q), (dt, dq))
        if isinstance(element, RollingJoint):  # rates that are those of no residual
            rate = _as_rows(element.rates(t, *_frames(ground, q, dq)))
        return value, rate

    def second_derivative(leaves, numbers):
        t, q, dt, dq = numbers[0], numbers[1 : 1 + n], numbers[1 + n], numbers[2 + n :]
        rate = lambda t, q: first_derivative(leaves, [t, *q, dt, *dq])[1]  # noqa: E731
        return jax.jvp(rate, (t, q), (dt, dq))[1]

    numbers = [number] * (2 + 2 * n)
    return trace(first_derivative, leaves, numbers), trace(second_derivative, leaves, numbers)


@lru_cache(maxsize=256)
def _trace_loads(tree: TreeDef, shapes: LeafShapes, ground: tuple[bool, ...]) -> tuple[TraceFunction, TraceFunction]:
    """Trace a force element's generalized loads, -dV/dq plus the result of its method `loads`, and its potential V."""
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def potential(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        value = element.potential(numbers[0], *_frames(ground, numbers[1 : 1 + n], numbers[1 + n :]))
        return jnp.zeros(()) if value is None else jnp.asarray(value, number.dtype)

    def loads(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        forces = element.loads(numbers[0], *_frames(ground, numbers[1 : 1 + n], numbers[1 + n :]))
        forces = [(0.0, 0.0, 0.0)] * len(ground) if forces is None else forces
        components = [c for load, fixed in zip(forces, ground, strict=True) if not fixed for c in load]
        slope = jax.grad(lambda q: potential(leaves, [numbers[0], *q, *numbers[1 + n :]]))(numbers[1 : 1 + n])
        return [jnp.asarray(c, number.dtype) - s for c, s in zip(components, slope, strict=True)]

    numbers = [number] * (1 + 2 * n)
    return trace(loads, leaves, numbers), trace(potential, leaves, numbers)
