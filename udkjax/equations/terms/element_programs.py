"""Programs over scalars, shared by all elements of the same structure: loops run them for each element (scene_programs.py)."""

from collections.abc import Sequence
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.terms.elements import (
    differentiate_constraint,
    has_pieces,
    trace_edge_loads,
    trace_force,
    trace_piece,
    trace_rubbing,
)
from udkjax.equations.terms.structure import Element, ElementStructure, element_kinds
from udkjax.expressions import Graph, Scalar, frontier
from udkjax.scene.mechanism import Mechanism

POSITION_INPUTS, VELOCITY_INPUTS = ("x", "y", "angle"), ("vx", "vy", "omega")
FREE_INPUTS = ("fx", "fy", "fangle")  # components of a_F


class ElementPrograms:
    """The expressions that all elements of one structure compute: lists of scalars of one graph, `outputs`, by name."""

    def __init__(self, structure: ElementStructure):
        self.structure = structure
        graph = self.graph = Graph(jnp.result_type(float))
        self.leaves = []
        for k, (shape, dtype) in enumerate(structure.shapes):
            leaf = np.empty(shape, object)
            for index in np.ndindex(*shape):
                leaf[index] = graph.input((k, index), "parameter", dtype)
            self.leaves.append(leaf)
        self.t = graph.input("t", "time")
        self.state: list[tuple[str, int, Scalar]] = []
        self.q = [s for k in range(structure.body_count) for s in self._inputs(POSITION_INPUTS, k, "position")]
        self.v = [s for k in range(structure.body_count) for s in self._inputs(VELOCITY_INPUTS, k, "velocity")]
        self.outputs: dict[str, list[Scalar]] = {}

    def _inputs(self, names: Sequence[str], body: int, group: str) -> list[Scalar]:
        scalars = [self.graph.input((name, body), group) for name in names]
        self.state += [(name, body, scalar) for name, scalar in zip(names, scalars, strict=True)]
        return scalars

    @property
    def element(self) -> Element:
        """An element of this structure, with scalars of the graph in place of its numbers."""
        return jax.tree.unflatten(self.structure.tree, self.leaves)

    def _find_constants(self):
        """Set `constants`, the expressions that depend on parameters alone and that the outputs use.

        The sines and cosines of the bodies' angles become inputs, in `state`. Elements that are piecewise smooth also get the
        output "piece".
        """
        if has_pieces(self.element):
            self.outputs["piece"] = [trace_piece(self.graph, self.structure, self.leaves, self.t, self.q, self.v)]
        angles = {s.index: body for name, body, s in self.state if name == "angle"}
        for index, node in enumerate(self.graph.nodes):
            name = node.detail.primitive.name if node.kind == "apply" else ""
            if name in ("sin", "cos") and node.arguments[0].index in angles and node.arguments[0].sign > 0:
                self.state.append((name, angles[node.arguments[0].index], Scalar(self.graph, index)))
        wanted = [s for outputs in self.outputs.values() for s in outputs]
        state_nodes = {s.index for _, _, s in self.state}
        constant = [
            s for s in frontier(self.graph, wanted, lambda node: node.depends <= {"parameter"}) if s.index not in state_nodes
        ]
        self.constants = constant


class ConstraintPrograms(ElementPrograms):
    """The expressions of a constraint.

    Outputs: `psi`, `psi_dot`, `gamma` and `b`, one scalar for each row, and `psi_q`, row by row, with 3 columns for each body.
    """

    def __init__(self, structure: ElementStructure, baumgarte: bool, loaded: bool):
        super().__init__(structure)
        graph = self.graph
        value, slopes, rate, gamma = differentiate_constraint(graph, structure, self.leaves, self.t, self.q, self.v)
        self.row_count = len(value)
        # Without force elements a_F is gravity.
        self.gravity = [graph.input(name, "parameter") for name in ("gx", "gy")]
        falling = [*self.gravity, graph.constant(0.0)] * structure.body_count
        free = [s for k in range(structure.body_count) for s in self._inputs(FREE_INPUTS, k, "velocity")] if loaded else falling
        self.gains = [graph.input(name, "parameter") for name in ("alpha", "beta")] if baumgarte else []
        zero = graph.constant(0.0)
        self.outputs = {"psi": value, "psi_dot": rate, "gamma": gamma}
        self.outputs["psi_q"] = [row.get(k, zero) for row in slopes for k in range(len(self.q))]
        self.outputs["b"] = [g - sum((s * free[k] for k, s in row.items()), zero) for g, row in zip(gamma, slopes, strict=True)]
        if self.gains:
            alpha, beta = self.gains
            rows = zip(self.outputs["b"], rate, value, strict=True)
            self.outputs["b"] = [b - alpha * 2.0 * psi_dot - beta * beta * psi for b, psi_dot, psi in rows]
        self._find_constants()


class ForcePrograms(ElementPrograms):
    """The expressions of a force element. Outputs: `loads`, 3 for each body, and `potential`, a single scalar."""

    def __init__(self, structure: ElementStructure):
        super().__init__(structure)
        loads, stored = trace_force(self.graph, structure, self.leaves, self.t, self.q, self.v)
        self.outputs = {"loads": loads, "potential": [stored]}
        self._find_constants()


class RubbingPrograms(ElementPrograms):
    """The friction of a joint that depends on its load, with x = -lambda of its eliminated rows among the inputs.

    Outputs: `loads`, 3 for each body, and `slopes`, their derivatives by each x, row by row. The loads are homogeneous in x, of
    degree one: they are the sum of x times the slopes. `edges` are the loads of a slot, or of both edges of a guide, whose
    magnitudes determine the friction: where one of them passes through zero, the friction has a kink.
    """

    def __init__(self, structure: ElementStructure, row_count: int, rows: tuple[int, ...]):
        super().__init__(structure)
        zero = self.graph.constant(0.0)
        self.x = [self.graph.input(("x of row", row), "position") for row in rows]  # differs from all names of coordinates
        x = dict(zip(rows, self.x, strict=True))
        multipliers = [-x[row] if row in x else zero for row in range(row_count)]
        loads, slopes = trace_rubbing(self.graph, structure, self.leaves, self.t, self.q, self.v, multipliers)
        edges = trace_edge_loads(self.graph, structure, self.leaves, multipliers)
        self.outputs = {"loads": loads, "slopes": [-s for row in rows for s in slopes[row]], "edges": edges}
        self._find_constants()


constraint_programs = lru_cache(maxsize=256)(ConstraintPrograms)
force_programs = lru_cache(maxsize=256)(ForcePrograms)
rubbing_programs = lru_cache(maxsize=256)(RubbingPrograms)


def has_rheonomic_joints(mechanism: Mechanism) -> bool:
    """Return whether a joint depends on time, as drivers do."""
    kinds, loaded = element_kinds(mechanism, list(mechanism.joints.values())), bool(mechanism.forces)
    residuals = (constraint_programs(kind.structure, False, loaded).outputs["psi"] for kind in kinds)
    return any("time" in s.node.depends for rows in residuals for s in rows)
