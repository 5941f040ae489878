"""Elements of equal structure as one program over scalars, which loops run for all of them (large_code.py)."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from udkjax.equations.elements import applied, differentiated
from udkjax.equations.kinds import Alike, kinds
from udkjax.expressions import Graph, Scalar, frontier
from udkjax.scene.mechanism import Mechanism

POSITIONS, VELOCITIES = ("x", "y", "angle"), ("vx", "vy", "omega")
FREE = ("fx", "fy", "fangle")  # of a_F


class ElementPrograms:
    """The programs of elements that are alike: named lists of scalar outputs."""

    def __init__(self, structure: Alike):
        self.structure = structure
        graph = self.graph = Graph(jnp.result_type(float))
        self.leaves = []
        for k, (shape, dtype) in enumerate(structure.shapes):
            leaf = np.empty(shape, object)
            for place in np.ndindex(*shape):
                leaf[place] = graph.input((k, place), "parameter", dtype)
            self.leaves.append(leaf)
        self.t = graph.input("t", "time")
        self.state: list[tuple[str, int, Scalar]] = []
        self.q = [s for k in range(structure.moving) for s in self._inputs(POSITIONS, k, "position")]
        self.v = [s for k in range(structure.moving) for s in self._inputs(VELOCITIES, k, "velocity")]
        self.outputs: dict[str, list[Scalar]] = {}

    def _inputs(self, names: Sequence[str], body: int, group: str) -> list[Scalar]:
        found = [self.graph.input((name, body), group) for name in names]
        self.state += [(name, body, scalar) for name, scalar in zip(names, found, strict=True)]
        return found

    def finished(self):
        """Find the sines and cosines, which come from the bodies, and what depends on parameters alone, computed once."""
        angles = {s.index: body for name, body, s in self.state if name == "angle"}
        for index, node in enumerate(self.graph.nodes):
            name = node.detail.primitive.name if node.kind == "apply" else ""
            if name in ("sin", "cos") and node.arguments[0].index in angles and node.arguments[0].sign > 0:
                self.state.append((name, angles[node.arguments[0].index], Scalar(self.graph, index)))
        wanted = [s for outputs in self.outputs.values() for s in outputs]
        given = {s.index for _, _, s in self.state}
        constant = [s for s in frontier(self.graph, wanted, lambda node: node.depends <= {"parameter"}) if s.index not in given]
        self.constants = constant


class ConstraintPrograms(ElementPrograms):
    """Outputs by rows: `D`, 3 columns a moving body; `psi`, `psi_dot`, `b`."""

    def __init__(self, structure: Alike, baumgarte: bool, loaded: bool):
        super().__init__(structure)
        graph = self.graph
        value, slopes, rate, gamma = differentiated(graph, structure, self.leaves, self.t, self.q, self.v)
        self.rows = len(value)
        self.roots = [graph.input((name, k), "parameter") for k in range(structure.moving) for name in ("mass", "inertia")]
        root = [self.roots[2 * k + i] for k in range(structure.moving) for i in (0, 0, 1)]  # M^(-1/2)
        # Without force elements every body falls freely.
        self.gravity = [graph.input(name, "parameter") for name in ("gx", "gy")]
        falling = [*self.gravity, graph.constant(0.0)] * structure.moving
        free = [s for k in range(structure.moving) for s in self._inputs(FREE, k, "velocity")] if loaded else falling
        self.gains = [graph.input(name, "parameter") for name in ("alpha", "beta")] if baumgarte else []
        zero = graph.constant(0.0)
        self.outputs = {"psi": value, "psi_dot": rate}
        self.outputs["D"] = [row.get(k, zero) * root[k] for row in slopes for k in range(len(root))]
        self.outputs["b"] = [g - sum((s * free[k] for k, s in row.items()), zero) for g, row in zip(gamma, slopes, strict=True)]
        if self.gains:
            alpha, beta = self.gains
            fed = zip(self.outputs["b"], rate, value, strict=True)
            self.outputs["b"] = [b - alpha * 2.0 * one - beta * beta * two for b, one, two in fed]
        self.finished()


class ForcePrograms(ElementPrograms):
    """Outputs: `loads`, 3 a moving body, and `potential`."""

    def __init__(self, structure: Alike):
        super().__init__(structure)
        loads, stored = applied(self.graph, structure, self.leaves, self.t, self.q, self.v)
        self.outputs = {"loads": loads, "potential": [stored]}
        self.finished()


constraint_programs = lru_cache(maxsize=256)(ConstraintPrograms)
force_programs = lru_cache(maxsize=256)(ForcePrograms)


class Group(NamedTuple):
    """All elements of one kind: their programs, places among the constraints or forces, and the bodies that move in each."""

    programs: Any
    members: np.ndarray  # (elements,)
    bodies: np.ndarray  # (moving, elements)


class Layout:
    """What is known of a scene from its structure: which elements are alike, and which rows of Psi are kept of each."""

    def __init__(self, mechanism: Mechanism, left_out: tuple[int, ...], baumgarte: bool):
        constraints, forces = list(mechanism.constraints.values()), list(mechanism.forces.values())
        self.bodies = len(mechanism.body_names)

        def of_constraints(split: Sequence[Any] | None) -> list[Group]:
            found = kinds(mechanism, constraints, split)
            return [Group(constraint_programs(k.structure, baumgarte, bool(forces)), k.members, k.bodies) for k in found]

        sizes = np.zeros(len(constraints), int)
        for group in of_constraints(None):
            sizes[group.members] = group.programs.rows
        self.starts = np.cumsum([0, *sizes])
        self.count = int(self.starts[-1])
        dropped = np.isin(np.arange(self.count), left_out)
        rows = [tuple(np.flatnonzero(~dropped[i:j]).tolist()) for i, j in zip(self.starts, self.starts[1:], strict=False)]
        self.constraints = of_constraints(rows)
        self.forces = [Group(force_programs(k.structure), k.members, k.bodies) for k in kinds(mechanism, forces)]
        self.kept = [(k, g, rows[g.members[0]]) for k, g in enumerate(self.constraints) if rows[g.members[0]]]
        self.all = [(k, g, tuple(range(g.programs.rows))) for k, g in enumerate(self.constraints) if g.programs.rows]
        if not left_out:
            self.kept = self.all
        names = list(mechanism.constraints)
        self.row_names = [(name, k) for name, size in zip(names, sizes, strict=True) for k in range(size)]
