"""The functions of a `ConstrainedSystem`, traced: expressions of the state and of numbers, which are kept apart.

The numbers are the float arrays among the leaves of the system, and those that its functions hold in their closures, concrete or
traced. The functions are read into a graph of scalars, with the terms of the equations,

    Psi, Psi_q, Psi_dot, gamma          of `constraint`, as for the joints of a mechanism (elements.py)
    phi, phi_v, -(phi_q v + phi_t)      of `velocity_constraint`
    M, F

Two systems whose graphs are equal share their programs, whatever their numbers are.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import Time, Vector
from udkjax.equations.terms.elements import choose_shorter, gamma_by_entries
from udkjax.expressions import Differential, Graph, Scalar, ScalarProgram, may_have_kinks, trace
from udkjax.expressions.algebra.differential import SparseRow
from udkjax.programs.identity_cache import cached_by_identity, is_concrete
from udkjax.requirements import ArgumentError, describe, tracing
from udkjax.scene.model import RunModel

FUNCTION_ARGUMENTS = {
    "mass": "q",
    "force": "tqv",
    "constraint": "tq",
    "velocity_constraint": "tqv",
    "potential": "tq",
}  # by name, with the names of the arguments
# Largest difference of M_ij and M_ji, relative to the largest entry: far above rounding errors, below any entry that matters.
SYMMETRY_TOL = 1e-8
MOST_NUMBERS = 20_000  # more, as of a table, would be copied to the memory of every lane


def load(system: Any, t: Time, q: Vector, v: Vector) -> Vector:
    """Return F: the force of a system, if it has one, minus the slope of its potential."""
    total = jnp.zeros_like(q) if system.force is None else jnp.asarray(system.force(t, q, v))
    return total if system.potential is None else total - jax.grad(system.potential, 1)(t, q)


class SystemFunctions:
    """The functions of a system on arrays and on scalars; two of them are equal if their graphs are.

    Attributes:
        n: The number of coordinates.
        graph: The graph of all scalars; its inputs are of the groups parameter, time, position and velocity.
        numbers: The scalars of each array of numbers.
        mass: M by rows, without zeros.
        force: F.
        psi, psi_q, psi_dot, gamma: the rows of `constraint`.
        phi, phi_v, bend: the rows of `velocity_constraint`; phi_v a = bend.
    """

    def __init__(self, functions: dict[str, Any], numbers: Sequence[Any], is_fixed: Sequence[bool], n: int):
        self._functions, self.n = functions, n
        self.number_count = sum(int(np.size(x)) for x in numbers)
        self.shapes = tuple((np.shape(x), np.dtype(x.dtype)) for x in numbers)
        graph = self.graph = Graph(np.float64)
        self.numbers = [self._inputs(k, x, fixed) for k, (x, fixed) in enumerate(zip(numbers, is_fixed, strict=True))]
        self.t = graph.input("t", "time")
        self.q = [graph.input(("q", i), "position") for i in range(n)]
        self.v = [graph.input(("v", i), "velocity") for i in range(n)]
        shapes = {"t": (), "q": (n,), "v": (n,), "dt": (), "dq": (n,)}
        self._examples = {name: jax.ShapeDtypeStruct(shape, np.float64) for name, shape in shapes.items()}
        self._read_terms()
        wanted = [*self.force, *self.psi, *self.psi_dot, *self.gamma, *self.phi, *self.bend]
        wanted += [s for rows in (self.mass, self.psi_q, self.phi_v) for row in rows for s in row.values()]
        places = tuple((tuple(row), len(row)) for rows in (self.mass, self.psi_q, self.phi_v) for row in rows)
        self._key = n, len(self.psi), len(self.phi), places, tuple((s.index, s.sign) for s in wanted), graph.key, self.shapes
        self._hash = hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SystemFunctions) and (self is other or self._key == other._key)

    def __hash__(self) -> int:
        return self._hash

    @property
    def row_counts(self) -> tuple[int, int]:
        """The numbers of rows of Psi and of phi."""
        return len(self.psi), len(self.phi)

    @property
    def text(self) -> str:
        """The functions as text, without their numbers."""
        parts = [f"{name} {constants} {closed.jaxpr}" for name, (closed, constants, _) in self._functions.items()]
        return "\n".join(parts)

    def has(self, name: str) -> bool:
        """Return whether the system has the function `name`, one of `FUNCTION_ARGUMENTS`."""
        return name in self._functions

    def require_symmetric_mass(self, numbers: Sequence[Any]):
        """Raise `ArgumentError` if M with these concrete numbers is not symmetric at a random position; entries may be NaN."""
        pairs = [(i, j) for i, row in enumerate(self.mass) for j in row if i < j or i not in self.mass[j]]
        zero = self.graph.constant(0.0)
        entries = [(self.mass[i].get(j, zero), self.mass[j].get(i, zero)) for i, j in pairs]
        if all(a == b for a, b in entries):
            return
        inputs = [s for x in self.numbers for s in x.flat]
        values = [float(x) for array in numbers for x in np.ravel(array)]
        known = [k for k, s in enumerate(inputs) if s.constant is None]
        program = ScalarProgram(self.graph, [*(inputs[k] for k in known), *self.q], [s for pair in entries for s in pair])
        somewhere = np.random.default_rng(0).normal(size=self.n)  # M is symmetric everywhere or nowhere
        found = np.reshape(program([*(values[k] for k in known), *somewhere.tolist()]), (-1, 2))
        differences = np.abs(found[:, 0] - found[:, 1])
        worst = int(np.argmax(np.nan_to_num(differences)))
        if differences[worst] > SYMMETRY_TOL * np.abs(found).max(initial=0.0, where=np.isfinite(found)):
            (i, j), (a, b) = pairs[worst], found[worst]
            raise ArgumentError(
                f"mass must return a symmetric matrix; at q = {somewhere.round(3).tolist()} entry [{i}, {j}] is {a:.6g}, and "
                f"[{j}, {i}] is {b:.6g}"
            )

    @property
    def other_terms(self) -> dict[str, list[Scalar]]:
        """The scalars of all terms except the load F, by the name of the function from which they come."""
        rows = {"mass": self.mass, "constraint": self.psi_q, "velocity_constraint": self.phi_v}
        further = {"mass": [], "constraint": [*self.psi, *self.psi_dot, *self.gamma], "velocity_constraint": self.phi + self.bend}
        return {name: [*further[name], *(s for row in parts for s in row.values())] for name, parts in rows.items()}

    @cached_property
    def may_have_kinks(self) -> bool:
        """True if a function contains an operation that may have jumps or kinks."""
        return may_have_kinks(self.graph, [*self.force, *(s for terms in self.other_terms.values() for s in terms)])

    @staticmethod
    def moving(breaks: bool) -> tuple[str, ...]:
        """Return the groups of inputs that change along a motion.

        With `breaks`, breakpoints list all times at which functions are not smooth, so that time is left out.
        """
        return ("position", "velocity") if breaks else ("position", "velocity", "time")

    def with_force(self, force: Callable[..., Array], count: int) -> "SystemFunctions":
        """Return the functions with `force(numbers, t, q, v)` as the whole load; `count` further numbers are the last array."""
        known = [np.array([s.constant is None for s in x.flat], dtype).reshape(shape) for x, (shape, dtype) in self._arrays]
        known.append(np.ones(count))
        structs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in known]
        state = [self._examples[x] for x in FUNCTION_ARGUMENTS["force"]]
        closed = jax.make_jaxpr(lambda *given: force(given[: len(known)], *given[len(known) :]))(*structs, *state)
        constants = [(None, x) for x in closed.consts]
        others = {name: x for name, x in self._functions.items() if name not in ("force", "potential")}
        whole = closed.replace(consts=[None] * len(constants)), constants, list(range(len(known)))
        return SystemFunctions(others | {"force": whole}, known, [True] * len(known), self.n)

    @property
    def _arrays(self) -> list[tuple[np.ndarray, tuple[Any, Any]]]:
        return list(zip(self.numbers, self.shapes, strict=True))

    def call(self, name: str, numbers: Sequence[Any], *arguments: Any) -> Array:
        """Return the value of the function `name` for arrays of numbers and for its arguments, such as t and q."""
        closed, constants, leaves = self._functions[name]
        program = closed.replace(consts=[x if k is None else numbers[k] for k, x in constants])
        return jax.extend.core.jaxpr_as_fun(program)(*(numbers[k] for k in leaves), *arguments)[0]

    def _inputs(self, k: int, x: Any, fixed: bool) -> np.ndarray:
        """Return the scalars of the array x of numbers, number k; if it is `fixed`, its zeros are zeros by structure."""
        scalars, values = np.empty(np.shape(x), object), np.asarray(x) if fixed else None
        for index in np.ndindex(*np.shape(x)):
            zero = values is not None and values[index] == 0
            scalars[index] = self.graph.constant(0.0) if zero else self.graph.input((k, index), "parameter", x.dtype)
        return scalars

    def _read(self, function: Callable, *arguments: str, **given: Any) -> list[np.ndarray]:
        """Return the results of a function of the numbers and of t, q, v, dt or dq, as scalars of the graph."""
        structs = [jax.ShapeDtypeStruct(*x) for x in self.shapes]
        state = {"t": self.t, "q": self.q, "v": self.v, **given}
        scalars = [np.asarray(state[x], object) for x in arguments]
        return trace(function, structs, *(self._examples[x] for x in arguments))(self.graph, self.numbers, *scalars)

    def _read_terms(self):
        graph, n, zero = self.graph, self.n, self.graph.constant(0.0)
        one, dq = graph.constant(1.0), [graph.input(("dq", i), "direction") for i in range(n)]
        (mass,) = self._read(partial(self.call, "mass"), "q")
        self.mass = [{i: s for i, s in enumerate(row) if not s.is_zero} for row in mass]
        (force,) = self._read(lambda numbers, *state: load(TracedSystem(numbers, self), *state), "t", "q", "v")
        self.force = list(force.flat)
        self.psi, self.psi_dot, self.gamma, self.phi, self.bend = [], [], [], [], []
        self.psi_q, self.phi_v = [], []
        if self.has("constraint"):
            along = lambda numbers, t, q, dt, dq: jax.jvp(  # noqa: E731
                lambda t, q: self.call("constraint", numbers, t, q), (t, q), (dt, dq)
            )
            twice = lambda numbers, t, q, dt, dq: jax.jvp(  # noqa: E731
                lambda t, q: along(numbers, t, q, dt, dq)[1], (t, q), (dt, dq)
            )[1]
            names = "t", "q", "dt", "dq"
            value, rate = self._read(along, *names, dt=one, dq=self.v)
            _, change = self._read(along, *names, dt=zero, dq=dq)
            (acceleration,) = self._read(twice, *names, dt=one, dq=self.v)
            self.psi, self.psi_dot, self.psi_q = list(value.flat), list(rate.flat), self._rows(change, dq)
            bend = list(acceleration.flat)
            if not any("time" in s.node.depends for s in self.psi):
                bend = choose_shorter(graph, self.psi_q, bend, gamma_by_entries(graph, self.psi_q, self.q, self.v))
            self.gamma = [-s for s in bend]
        if self.has("velocity_constraint"):
            function = partial(self.call, "velocity_constraint")
            by_v = lambda numbers, t, q, v, dq: jax.jvp(lambda v: function(numbers, t, q, v), (v,), (dq,))  # noqa: E731
            by_state = lambda numbers, t, q, v: jax.jvp(  # noqa: E731
                lambda t, q: function(numbers, t, q, v), (t, q), (jnp.ones_like(t), v)
            )[1]
            value, change = self._read(by_v, "t", "q", "v", "dq", dq=dq)
            (bend,) = self._read(by_state, "t", "q", "v")
            self.phi, self.phi_v, self.bend = list(value.flat), self._rows(change, dq), [-s for s in bend.flat]

    def _rows(self, change: np.ndarray, dq: list[Scalar]) -> list[SparseRow]:
        """Return the coefficients by which changes are linear in dq, one sparse row for each change."""
        column = {s.index: i for i, s in enumerate(dq)}
        differential = Differential(self.graph, change.flat, dq)
        rows = [{column[k]: s for k, s in differential.row(x).items() if k in column} for x in change.flat]
        return [dict(sorted(row.items())) for row in rows]


class TracedSystem(RunModel):
    """A `ConstrainedSystem` whose functions are traced: `numbers` are the leaves on which all functions depend.

    As a `RunModel` it answers the questions of runs. None of its numbers is sampled over time.
    """

    numbers: list[Array]
    functions: SystemFunctions = eqx.field(static=True)
    row_labels: tuple[str, ...] = eqx.field(static=True, default=())  # of Psi, then of phi
    breakpoints: Float[Array, "k"] | None = None
    samples: dict[Any, Any] = eqx.field(static=True, default_factory=dict)

    def mass(self, q: Vector) -> Float[Array, "n n"]:
        return self.functions.call("mass", self.numbers, q)

    @property
    def force(self) -> Callable[[Time, Vector, Vector], Array] | None:
        return self._function("force")

    @property
    def constraint(self) -> Callable[[Time, Vector], Array] | None:
        return self._function("constraint")

    @property
    def velocity_constraint(self) -> Callable[[Time, Vector, Vector], Array] | None:
        return self._function("velocity_constraint")

    @property
    def potential(self) -> Callable[[Time, Vector], Array] | None:
        return self._function("potential")

    def _function(self, name: str) -> Callable[..., Array] | None:
        return partial(self.functions.call, name, self.numbers) if self.functions.has(name) else None

    def with_functions(self, functions: SystemFunctions, more: Array) -> "TracedSystem":
        """Return the system with other functions, which depend on its numbers and on the further array `more`."""
        return TracedSystem([*self.numbers, more], functions, self.row_labels, self.breakpoints)

    @property
    def coordinate_count(self) -> int:
        return self.functions.n

    @property
    def may_have_kinks(self) -> bool:
        return self.functions.may_have_kinks

    @property
    def is_concrete(self) -> bool:
        """True if no number is traced."""
        return is_concrete(self)


@cached_by_identity
def trace_system(system: Any, n: int) -> TracedSystem:
    """Return a `ConstrainedSystem` of n coordinates with traced functions; the result is cached.

    Raises:
        ArgumentError: a function returns an array of another shape than `ConstrainedSystem` says, or M is not symmetric.
    """
    given = {name: getattr(system, name) for name in FUNCTION_ARGUMENTS if getattr(system, name) is not None}
    leaves, others = eqx.partition(given, eqx.is_inexact_array)
    listed, tree = jax.tree.flatten(leaves)
    numbers: list[Any] = []
    indices: dict[int, int] = {}  # of each array among the numbers, by its identity

    def place(x: Any) -> int:
        if id(x) not in indices:
            indices[id(x)] = len(numbers)
            numbers.append(x)
        return indices[id(x)]

    of_leaves = [place(x) for x in listed]
    count, functions, labels = len(numbers), {}, {}
    examples = {x: jax.ShapeDtypeStruct(() if x == "t" else (n,), float) for x in "tqv"}
    for name in given:

        def function(*arrays: Any, name: str = name) -> Array:
            own: Any = eqx.combine(jax.tree.unflatten(tree, arrays[: len(listed)]), others)
            with tracing(f"{name} of a ConstrainedSystem"):
                value = own[name](*arrays[len(listed) :])
            labels[name] = labels_of_rows(name, value)
            return _checked(name, value, n)

        closed = jax.make_jaxpr(function)(*listed, *(examples[x] for x in FUNCTION_ARGUMENTS[name]))
        is_number = [isinstance(x, Tracer) or eqx.is_inexact_array_like(x) for x in closed.consts]
        constants = [(place(x), None) if yes else (None, x) for x, yes in zip(closed.consts, is_number, strict=True)]
        functions[name] = closed.replace(consts=[None] * len(constants)), constants, of_leaves
    is_fixed = [k >= count and not isinstance(x, Tracer) for k, x in enumerate(numbers)]
    of_rows = tuple(label for name in ("constraint", "velocity_constraint") for label in labels.get(name, ()))
    traced = TracedSystem(numbers, SystemFunctions(functions, numbers, is_fixed, n), of_rows, system.breakpoints)
    if is_concrete(numbers):
        traced.functions.require_symmetric_mass(numbers)
    return traced


def joined_rows(value: Any) -> Any:
    """Return the rows of a constraint as one vector if they are given by name, else unchanged."""
    if not isinstance(value, Mapping):
        return value
    return jnp.concatenate([jnp.ravel(jnp.asarray(x, float)) for x in value.values()])


def labels_of_rows(name: str, value: Any) -> list[str]:
    """Return the labels of the rows of a constraint: the names of rows or, without these, its own name with an index."""
    if not isinstance(value, Mapping):
        return [f"{name}[{k}]" for k in range(np.size(value))]
    parts = [(label, np.size(x)) for label, x in value.items()]
    return [str(label) if count == 1 else f"{label}[{k}]" for label, count in parts for k in range(count)]


def _checked(name: str, value: Any, n: int) -> Array:
    """Return the value of the function `name` as an array, with a single row as a vector.

    Raises `ArgumentError` if it is anything else than numbers, or has another shape than a system of n coordinates needs.
    """
    wanted = {"mass": (n, n), "force": (n,), "potential": ()}.get(name)
    shape = "a vector" if wanted is None else f"the shape {wanted}" if wanted else "a number"
    try:
        numbers = jnp.asarray(joined_rows(value), float)
    except (TypeError, ValueError):
        found = describe(next((x for x in value.values() if x is None), value) if isinstance(value, Mapping) else value)
        raise ArgumentError(f"{name} must return {shape} for {n} coordinates, {found}") from None
    numbers = jnp.atleast_1d(numbers) if wanted is None else numbers
    if (wanted is not None and numbers.shape != wanted) or (wanted is None and numbers.ndim > 1):
        raise ArgumentError(f"{name} must return {shape} for {n} coordinates, not an array of shape {numbers.shape}")
    return numbers
