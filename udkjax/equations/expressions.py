"""A mechanism's equations as one graph of scalar expressions, built once for each structure.

Numbers are inputs of the graph, so one graph serves all values of masses, lengths and gains. It holds more than any run needs;
the programs taken from it (straightline/emit.py) compute only the outputs that they are asked for.

For a constraint with residual Psi(t, q) the graph gets, all by forward differentiation of the residual alone, along (1, v):

    Psi_dot = Psi_q v + Psi_t        gamma = -(Psi_q v)_q v - 2 Psi_qt v - Psi_tt

(or, where that is shorter, gamma from derivatives of the entries of Psi_q, which often are other entries of it)
and Psi_q one column at a time, each along a unit vector whose zeros the graph folds away: a row is {column: scalar}.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism
from udkjax.straightline import Differential, Graph, Scalar, operations, trace

Row = dict[int, Scalar]


@lru_cache(maxsize=64)
def expressions(tree: Any, shapes: tuple) -> "Expressions":
    """Return the graph of the mechanisms with this tree and with numbers of these shapes and types."""
    return Expressions(jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*s) for s in shapes]))


class Expressions:
    """Psi, Psi_q, Psi_dot, gamma, M, F and the energies of a mechanism, as scalars of one graph."""

    def __init__(self, mechanism: Mechanism):
        self.mechanism = mechanism
        leaves, tree = jax.tree.flatten(mechanism)
        self.graph = Graph(jnp.result_type(float))
        self.parameters = [_inputs(self.graph, f"parameter{k}", "parameter", leaf) for k, leaf in enumerate(leaves)]
        self.scene: Mechanism = jax.tree.unflatten(tree, self.parameters)
        names = mechanism.body_names
        self.t = self.graph.input("t", "time")
        self.q = [self.graph.input(f"q{k}", "position") for k in range(3 * len(names))]
        self.v = [self.graph.input(f"v{k}", "velocity") for k in range(3 * len(names))]
        self.start = {name: 3 * k for k, name in enumerate(names)}

    @property
    def inputs(self) -> list[Scalar]:
        """All numbers of the scene, as they come out of `jax.tree.leaves(mechanism)`."""
        return [s for array in self.parameters for s in array.flat]

    # --- constraints

    @cached_property
    def psi(self) -> list[Scalar]:
        return [s for rows in self._constraints for s in rows[0]]

    @cached_property
    def psi_q(self) -> list[Row]:
        return [row for rows in self._constraints for row in rows[1]]

    @cached_property
    def psi_dot(self) -> list[Scalar]:
        return [s for rows in self._constraints for s in rows[2]]

    @cached_property
    def gamma(self) -> list[Scalar]:
        return [s for rows in self._constraints for s in rows[3]]

    @cached_property
    def row_names(self) -> list[tuple[str, int]]:
        """The constraint that each row of Psi belongs to, and its number within it."""
        names = list(self.mechanism.constraints)
        return [(name, k) for name, rows in zip(names, self._constraints, strict=True) for k in range(len(rows[0]))]

    @cached_property
    def _constraints(self) -> list[tuple[list[Scalar], list[Row], list[Scalar], list[Scalar]]]:
        scene = self.scene.constraints
        return [self._constraint(element, scene[name]) for name, element in self.mechanism.constraints.items()]

    def _constraint(self, element: Any, scalars: Any):
        moving = self._moving(element)
        state = [self.t, [self.q[k] for k in moving], [self.v[k] for k in moving]]
        value, rows, rate, gamma = differentiated(self.graph, self._alike(element), jax.tree.leaves(scalars), *state)
        return value, [{moving[k]: entry for k, entry in row.items()} for row in rows], rate, gamma

    def _alike(self, element: Any) -> "Alike":
        return alike(element, self.mechanism.frames_of(element))

    def _moving(self, element: Any) -> list[int]:
        return [self.start[name] + k for name in self.mechanism.frames_of(element) if name != GROUND for k in range(3)]

    # --- masses and loads

    @cached_property
    def mass(self) -> list[Scalar]:
        """The diagonal of M: m, m, I of each body."""
        return [_scalar(s) for body in self.scene.bodies.values() for s in (body.mass, body.mass, body.inertia)]

    @cached_property
    def applied(self) -> list[Scalar]:
        """F without the weights."""
        total = [self.graph.constant(0.0)] * len(self.q)
        for name, element in self.mechanism.forces.items():
            loads, _ = self._force(element, self.scene.forces[name])
            for k, load in zip(self._moving(element), loads, strict=True):
                total[k] = total[k] + load
        return total

    @cached_property
    def gravity(self) -> list[Scalar]:
        """The acceleration of free fall, coordinate by coordinate."""
        x, y = self.scene.gravity
        return [_scalar(x), _scalar(y), self.graph.constant(0.0)] * len(self.mechanism.body_names)

    @cached_property
    def force(self) -> list[Scalar]:
        return [f + m * g for f, m, g in zip(self.applied, self.mass, self.gravity, strict=True)]

    @cached_property
    def free(self) -> list[Scalar]:
        """a_F = M^-1 F, in which a body's mass cancels from its weight."""
        return [g + f / m for f, m, g in zip(self.applied, self.mass, self.gravity, strict=True)]

    @cached_property
    def kinetic_energy(self) -> Scalar:
        return sum((m * v * v for m, v in zip(self.mass, self.v, strict=True)), self.graph.constant(0.0)) * 0.5

    @cached_property
    def potential_energy(self) -> Scalar:
        weights = (m * g * q for m, g, q in zip(self.mass, self.gravity, self.q, strict=True))
        stored = (self._force(e, self.scene.forces[n])[1] for n, e in self.mechanism.forces.items())
        return sum(stored, self.graph.constant(0.0)) - sum(weights, self.graph.constant(0.0))

    def _force(self, element: Any, scalars: Any) -> tuple[list[Scalar], Scalar]:
        moving = self._moving(element)
        state = [self.t, [self.q[k] for k in moving], [self.v[k] for k in moving]]
        return applied(self.graph, self._alike(element), jax.tree.leaves(scalars), *state)


def _scalar(array: Any) -> Scalar:
    return np.asarray(array, object).item()


def _scalars(outputs: list[np.ndarray]) -> list[list[Scalar]]:
    """Split the outputs of a traced function, given as one array each of the same length."""
    return [list(o) for o in outputs]


def _inputs(graph: Graph, name: str, group: str, leaf: Any) -> np.ndarray:
    array = np.empty(leaf.shape, object)
    for place in np.ndindex(*leaf.shape):
        array[place] = graph.input((name, place), group, leaf.dtype)
    return array


def _frames(ground: tuple[bool, ...], q: Any, v: Any = None) -> list[Frame]:
    """Make the frames that an element sees; the sine and cosine of a body are the same expressions for every element."""
    frames, k = [], 0
    for fixed in ground:
        if fixed:
            frames.append(Frame(0.0, 0.0, 0.0, 1.0, 0.0, *(() if v is None else (0.0, 0.0, 0.0))))
        else:
            x, y, angle = q[k : k + 3]
            frames.append(Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *(() if v is None else v[k : k + 3])))
            k += 3
    return frames


class Alike(NamedTuple):
    """What elements have in common that are traced once: all but the names of their bodies and the values of their numbers."""

    tree: Any
    shapes: tuple
    ground: tuple[bool, ...]  # which of its frames are the ground's

    @property
    def moving(self) -> int:
        """How many bodies move in it."""
        return len(self.ground) - sum(self.ground)


def alike(element: Any, frames: Sequence[str]) -> Alike:
    """Return an element's structure; `frames` are the names of the bodies that it sees."""
    numbers = {name: GROUND if name == GROUND else str(k) for k, name in enumerate(frames)}
    nameless = object.__new__(type(element))
    for name, value in vars(element).items():
        object.__setattr__(nameless, name, value)
    for field in dataclasses.fields(element):
        if field.name == "bodies" or "names" in field.metadata:
            value = getattr(element, field.name)
            renamed = numbers.get(value, "") if isinstance(value, str) else tuple(numbers.get(name, "") for name in value)
            object.__setattr__(nameless, field.name, renamed)
    leaves, tree = jax.tree.flatten(nameless)
    return Alike(tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves), tuple(name == GROUND for name in frames))


def differentiated(graph: Graph, kind: Alike, leaves: list[np.ndarray], t: Scalar, q: list[Scalar], v: list[Scalar]):
    """Psi, the rows of Psi_q over the columns of q, Psi_dot and gamma of a constraint on scalars."""
    along, bend = _traced(*kind)
    one, zero = graph.constant(1.0), graph.constant(0.0)

    def derivative(program, dt, dq) -> list[list[Scalar]]:
        return _scalars(program(graph, leaves, [np.asarray(s, object) for s in (t, *q, dt, *dq)]))

    value, rate = derivative(along, one, v)
    (acceleration,) = derivative(bend, one, v)
    rows: list[Row] = [{} for _ in value]
    for k in range(len(q)):
        unit = [one if i == k else zero for i in range(len(q))]
        for row, entry in zip(rows, derivative(along, zero, unit)[1], strict=True):
            if not entry.is_zero:
                row[k] = entry
    if not any("time" in s.node.depends for s in value):
        acceleration = _shorter(graph, rows, acceleration, _quadratic(graph, rows, q, v))
    return value, rows, rate, [-s for s in acceleration]


def _quadratic(graph: Graph, rows: list[Row], q: list[Scalar], v: list[Scalar]) -> list[Scalar] | None:
    """(Psi_q v)_q v as the sum of (dPsi_q[k]/dq[j]) v[j] v[k]; None where an opaque expression is in the way."""
    entries = Differential(graph, [entry for row in rows for entry in row.values()], q)
    column = {s.index: j for j, s in enumerate(q)}
    total = []
    for row in rows:
        terms: dict[tuple[int, int], Scalar] = {}
        for k, entry in row.items():
            for place, slope in entries.row(entry).items():
                if place not in column:
                    return None
                pair = min(k, column[place]), max(k, column[place])
                terms[pair] = terms[pair] + slope if pair in terms else slope
        total.append(sum((slope * (v[j] * v[k]) for (j, k), slope in terms.items()), graph.constant(0.0)))
    return total


def _shorter(graph: Graph, known: list[Row], one: list[Scalar], other: list[Scalar] | None) -> list[Scalar]:
    """The one of two ways to write the same that takes fewer operations, with the entries of the rows known."""
    if other is None:
        return one
    given = [entry for row in known for entry in row.values()]
    return other if operations(graph, given, other) < operations(graph, given, one) else one


def applied(graph: Graph, kind: Alike, leaves: list[np.ndarray], t: Scalar, q: list[Scalar], v: list[Scalar]):
    """The generalized loads of a force element over the columns of q, and its potential, on scalars."""
    loads, energy = _traced_force(*kind)
    numbers = [np.asarray(s, object) for s in (t, *q, *v)]
    (stored,) = energy(graph, leaves, numbers)
    return [_scalar(s) for s in loads(graph, leaves, numbers)], _scalar(stored)


def _residual(element: Any, ground: tuple[bool, ...], t: Any, q: Any) -> jax.Array:
    rows = element.residual(t, *_frames(ground, q))
    rows = rows if isinstance(rows, list | tuple) else list(jnp.atleast_1d(rows))
    return jnp.stack([jnp.asarray(r, jnp.result_type(float)) for r in rows])


@lru_cache(maxsize=256)
def _traced(tree: Any, shapes: tuple, ground: tuple[bool, ...]) -> tuple[Any, Any]:
    """Trace a residual's first and second derivative along (dt, dq)."""
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def along(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        t, q, dt, dq = numbers[0], numbers[1 : 1 + n], numbers[1 + n], numbers[2 + n :]
        return jax.jvp(lambda t, q: _residual(element, ground, t, q), (t, q), (dt, dq))

    def bend(leaves, numbers):
        t, q, dt, dq = numbers[0], numbers[1 : 1 + n], numbers[1 + n], numbers[2 + n :]
        rate = lambda t, q: along(leaves, [t, *q, dt, *dq])[1]  # noqa: E731
        return jax.jvp(rate, (t, q), (dt, dq))[1]

    numbers = [number] * (2 + 2 * n)
    return trace(along, leaves, numbers), trace(bend, leaves, numbers)


@lru_cache(maxsize=256)
def _traced_force(tree: Any, shapes: tuple, ground: tuple[bool, ...]) -> tuple[Any, Any]:
    """Trace a force element's generalized loads, -dV/dq of its potential plus what it states itself, and its potential."""
    n = 3 * (len(ground) - sum(ground))
    leaves = [jax.ShapeDtypeStruct(*s) for s in shapes]
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))

    def potential(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        value = element.potential(numbers[0], *_frames(ground, numbers[1 : 1 + n], numbers[1 + n :]))
        return jnp.zeros(()) if value is None else jnp.asarray(value, number.dtype)

    def loads(leaves, numbers):
        element = jax.tree.unflatten(tree, leaves)
        own = element.loads(numbers[0], *_frames(ground, numbers[1 : 1 + n], numbers[1 + n :]))
        own = [(0.0, 0.0, 0.0)] * len(ground) if own is None else own
        moving = [c for load, fixed in zip(own, ground, strict=True) if not fixed for c in load]
        slope = jax.grad(lambda q: potential(leaves, [numbers[0], *q, *numbers[1 + n :]]))(numbers[1 : 1 + n])
        return [jnp.asarray(c, number.dtype) - s for c, s in zip(moving, slope, strict=True)]

    numbers = [number] * (1 + 2 * n)
    return trace(loads, leaves, numbers), trace(potential, leaves, numbers)
