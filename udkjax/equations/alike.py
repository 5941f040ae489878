"""Elements of equal structure, evaluated together: one straight-line program over scalars, mapped over all of them.

However many revolute joints a scene has, their residual is traced once, and the compiled program holds one copy of it. What a
program takes from the bodies (a coordinate, a sine, the root of a mass) is fetched for all elements at once.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.equations.elements import Alike, alike, applied, differentiated
from udkjax.pinv.places import take
from udkjax.scene.mechanism import Mechanism, attached
from udkjax.straightline import Graph, Loop, Program, Scalar, along_elements, frontier

POSITIONS, VELOCITIES = ("x", "y", "angle"), ("vx", "vy", "omega")
FREE = ("fx", "fy", "fangle")  # of a_F
Fields = dict[str, Any]  # of all bodies, by name: arrays (bodies,)


class Kind:
    """The programs of elements that are alike: named lists of scalar outputs, of which a program is made when it is asked for."""

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
        self._programs: dict[tuple[str, ...], tuple[Program, list[tuple[str, int, Scalar]], list[Scalar]]] = {}

    def _inputs(self, names: Sequence[str], body: int, group: str) -> list[Scalar]:
        found = [self.graph.input((name, body), group) for name in names]
        self.state += [(name, body, scalar) for name, scalar in zip(names, found, strict=True)]
        return found

    @property
    def numbers(self) -> list[Scalar]:
        """What depends on parameters alone, as it is given."""
        return [s for leaf in self.leaves for s in leaf.flat]

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
        self.prologue = Program(self.graph, self.numbers, constant)

    def program(self, names: tuple[str, ...]) -> tuple[Program, list[tuple[str, int, Scalar]], list[Scalar]]:
        """The program of some outputs, what it takes from the bodies, and those of the outputs that are not known numbers."""
        if names not in self._programs:
            wanted = [s for name in names for s in self.outputs[name]]
            varying = [Scalar(self.graph, k) for k in dict.fromkeys(s.index for s in wanted if s.constant is None)]
            state = [s for _, _, s in self.state]
            whole = Program(self.graph, [*self.constants, self.t, *state], varying)
            used = [entry for entry in self.state if whole.uses(entry[2])]
            program = Program(self.graph, [*self.constants, self.t, *(s for _, _, s in used)], varying)
            self._programs[names] = program, used, varying
        return self._programs[names]


class ConstraintKind(Kind):
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

    @property
    def numbers(self) -> list[Scalar]:
        return [*super().numbers, *self.roots, *self.gravity, *self.gains]


class ForceKind(Kind):
    """Outputs: `loads`, 3 a moving body, and `potential`."""

    def __init__(self, structure: Alike):
        super().__init__(structure)
        loads, stored = applied(self.graph, structure, self.leaves, self.t, self.q, self.v)
        self.outputs = {"loads": loads, "potential": [stored]}
        self.finished()


constraint_kind = lru_cache(maxsize=256)(ConstraintKind)
force_kind = lru_cache(maxsize=256)(ForceKind)


class Group(NamedTuple):
    """All elements of one kind: their places among the constraints or forces, and the bodies that move in each."""

    kind: Any
    members: np.ndarray  # (elements,)
    bodies: np.ndarray  # (moving, elements)

    def stacked(self, elements: Sequence[Any]) -> list[Any]:
        """The numbers of the elements: for each leaf an array (elements, ...)."""
        leaves = [jax.tree.leaves(elements[i]) for i in self.members]
        return [stack(column) for column in zip(*leaves, strict=True)]

    def constants(self, stacked: Sequence[Array], root: Any, shared: Sequence[Any]) -> Float[Array, "constants elements"]:
        """What the programs need of parameters alone; `root` is M^(-1/2) (bodies, 3), `shared` gravity and gains."""
        values = [leaf[(slice(None), *place)] for leaf in stacked for place in np.ndindex(*leaf.shape[1:])]
        if isinstance(self.kind, ConstraintKind):
            values += [root[bodies, k] for bodies in self.bodies for k in (0, 2)]
            values += list(shared)
        size = len(self.members)
        values = [jnp.broadcast_to(jnp.asarray(v), (size,)) for v in values]
        found = jax.vmap(lambda values: [jnp.asarray(c) for c in self.kind.prologue(values)], axis_size=size)(values)
        return jnp.stack(found) if found else jnp.zeros((0, size))

    def run(self, names: tuple[str, ...], numbers: Array, t: Any, fields: Fields, loop: Loop | None = None) -> list[list[Any]]:
        """Evaluate outputs: for each name a list of arrays (elements,), or of numbers where they are known."""
        program, used, varying = self.kind.program(names)
        size = len(self.members)
        state = [take(fields[name], self.bodies[body]) for name, body, _ in used]
        found = {}
        if varying:
            found = dict(zip((s.index for s in varying), along_elements(program, loop, size, numbers, t, *state), strict=True))

        def value(s: Scalar) -> Any:
            return s.constant if s.constant is not None else found[s.index] if s.sign > 0 else -found[s.index]

        return [[value(s) for s in self.kind.outputs[name]] for name in names]


def stack(values: Sequence[Any]) -> Any:
    """Stack numbers, by NumPy where they are known."""
    if any(isinstance(v, Tracer) for v in values):
        return jnp.stack(values)
    return np.stack([np.asarray(v) for v in values])


def groups(mechanism: Mechanism, elements: Sequence[Any], make: Any, split: Sequence[Any] | None = None) -> list[Group]:
    """Group elements by their structure, and by what `split` says of each of them."""
    place, joints = {name: k for k, name in enumerate(mechanism.body_names)}, mechanism.joints
    found: dict[Any, list[tuple[int, list[int]]]] = {}
    for i, element in enumerate(elements):
        frames = attached(element, joints)  # a method of a large module takes a look at all of its leaves
        key = alike(element, frames), split[i] if split else None
        found.setdefault(key, []).append((i, [place[name] for name in frames if name in place]))
    result = []
    for (structure, _), members in found.items():
        bodies = np.array([b for _, b in members], int).reshape(len(members), -1).T
        result.append(Group(make(structure), np.array([i for i, _ in members]), bodies))
    return result
