"""A mechanism's equations as one graph of scalar expressions, built once for each structure.

Numbers are inputs of the graph, so one graph serves all values of masses, lengths and gains. It holds more than any run needs;
the programs taken from it (expressions/scalar_program.py) compute only the outputs that they are asked for.
"""

from functools import cached_property, lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.elements import as_scalar, differentiate_constraint, has_pieces, trace_force, trace_piece
from udkjax.equations.structure import Element, ElementStructure, Shapes, TreeDef, element_structure
from udkjax.expressions import Graph, Scalar
from udkjax.expressions.differential import Row
from udkjax.scene.bodies import GROUND
from udkjax.scene.joints import Constraint
from udkjax.scene.mechanism import Mechanism


@lru_cache(maxsize=64)
def scalar_equations(tree: TreeDef, shapes: Shapes) -> "ScalarEquations":
    """Return the graph of the mechanisms with this tree and with numbers of these shapes and types."""
    return ScalarEquations(jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*s) for s in shapes]))


class ScalarEquations:
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

    def _constraint(self, element: Constraint, scalars: Constraint) -> tuple[list[Scalar], list[Row], list[Scalar], list[Scalar]]:
        places = self._coordinates(element)
        state = [self.t, [self.q[k] for k in places], [self.v[k] for k in places]]
        value, rows, rate, gamma = differentiate_constraint(
            self.graph, self._structure(element), jax.tree.leaves(scalars), *state
        )
        return value, [{places[k]: entry for k, entry in row.items()} for row in rows], rate, gamma

    def _structure(self, element: Element) -> ElementStructure:
        return element_structure(element, self.mechanism.frames_of(element))

    def _coordinates(self, element: Element) -> list[int]:
        return [self.start[name] + k for name in self.mechanism.frames_of(element) if name != GROUND for k in range(3)]

    # --- masses and loads

    @cached_property
    def mass(self) -> list[Scalar]:
        """The diagonal of M: m, m, I of each body."""
        return [as_scalar(s) for body in self.scene.bodies.values() for s in (body.mass, body.mass, body.inertia)]

    @cached_property
    def element_loads(self) -> list[Scalar]:
        """F without the weights."""
        total = [self.graph.constant(0.0)] * len(self.q)
        for name, element in self.mechanism.forces.items():
            loads, _ = self._force(element, self.scene.forces[name])
            for k, load in zip(self._coordinates(element), loads, strict=True):
                total[k] = total[k] + load
        return total

    @cached_property
    def gravity(self) -> list[Scalar]:
        """The acceleration of free fall of each coordinate."""
        x, y = self.scene.gravity
        return [as_scalar(x), as_scalar(y), self.graph.constant(0.0)] * len(self.mechanism.body_names)

    @cached_property
    def force(self) -> list[Scalar]:
        return [f + m * g for f, m, g in zip(self.element_loads, self.mass, self.gravity, strict=True)]

    @cached_property
    def free(self) -> list[Scalar]:
        """a_F = M^-1 F, in which a body's mass cancels from its weight."""
        return [g + f / m for f, m, g in zip(self.element_loads, self.mass, self.gravity, strict=True)]

    @cached_property
    def kinetic_energy(self) -> Scalar:
        return sum((m * v * v for m, v in zip(self.mass, self.v, strict=True)), self.graph.constant(0.0)) * 0.5

    @cached_property
    def potential_energy(self) -> Scalar:
        weights = (m * g * q for m, g, q in zip(self.mass, self.gravity, self.q, strict=True))
        stored = (self._force(e, self.scene.forces[n])[1] for n, e in self.mechanism.forces.items())
        return sum(stored, self.graph.constant(0.0)) - sum(weights, self.graph.constant(0.0))

    def _force(self, element: Element, scalars: Element) -> tuple[list[Scalar], Scalar]:
        places = self._coordinates(element)
        state = [self.t, [self.q[k] for k in places], [self.v[k] for k in places]]
        return trace_force(self.graph, self._structure(element), jax.tree.leaves(scalars), *state)

    @cached_property
    def pieces(self) -> list[Scalar]:
        """The number of the smooth piece of each element that has several."""
        m, scene = self.mechanism, self.scene
        pairs = [(e, scene.constraints[name]) for name, e in m.constraints.items()]
        pairs += [(e, scene.forces[name]) for name, e in m.forces.items()]
        found = []
        for element, scalars in pairs:
            if has_pieces(element):
                places = self._coordinates(element)
                state = self.t, [self.q[k] for k in places], [self.v[k] for k in places]
                found.append(trace_piece(self.graph, self._structure(element), jax.tree.leaves(scalars), *state))
        return found


def _inputs(graph: Graph, name: str, group: str, leaf: jax.ShapeDtypeStruct) -> np.ndarray:
    array = np.empty(leaf.shape, object)
    for place in np.ndindex(*leaf.shape):
        array[place] = graph.input((name, place), group, leaf.dtype)
    return array
