"""What is known of a large scene from its structure: which elements are alike, and how its rows hang together.

All of it is NumPy, done once for a structure; `Layout.numbers` and `Selection.evaluate` are what a program is traced from.
"""

from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.alike import Fields, Group, constraint_kind, force_kind, groups, stack
from udkjax.pinv.blocks import BlockPattern, Sums, by_block
from udkjax.pinv.places import take
from udkjax.scene.mechanism import Mechanism
from udkjax.straightline import Loop
from udkjax.straightline.trigonometry import sincos

Vector = Float[Array, "n"]


class Selection:
    """Some rows of Psi, by blocks: a pattern for elimination, and their places among all rows in the user's order."""

    def __init__(self, parts: Sequence[tuple[Group, Sequence[int]]], starts: np.ndarray, bodies: int):
        self.parts = [(k, group, tuple(rows)) for k, (group, rows) in enumerate(parts) if rows]
        members = [m for _, group, _ in self.parts for m in group.members]
        sizes = [len(rows) for _, group, rows in self.parts for _ in group.members]
        meets = [list(b) for _, group, _ in self.parts for b in group.bodies.T]
        self.height, self.deep, self.blocks = max(sizes, default=0), max(map(len, meets), default=1) or 1, len(members)
        self._sizes, self._meets, self._bodies = sizes, meets, bodies
        rows = [rows for _, group, rows in self.parts for _ in group.members]
        place = np.array([starts[m] + r for m, kept in zip(members, rows, strict=True) for r in kept], int)
        self.order = np.argsort(place)  # of the rows of all blocks: the user's
        self.rows = place[self.order]
        block = np.repeat(np.arange(self.blocks), sizes)
        within = np.arange(len(place)) - np.repeat(np.cumsum([0, *sizes[:-1]]) if sizes else np.zeros(0, int), sizes)
        self.entry = (within[self.order], block[self.order])  # of every row in the user's order

    @cached_property
    def pattern(self) -> BlockPattern:
        present = np.zeros((self.height, 3), bool)
        for _, group, rows in self.parts:
            width, entries = 3 * len(group.bodies), group.kind.outputs["D"]
            for r, row in enumerate(rows):
                for k in range(width):
                    present[r, k % 3] |= not entries[row * width + k].is_zero
        return BlockPattern(self._sizes, self._meets, 3, self._bodies, present=present)

    def evaluate(
        self, names: Sequence[str], numbers: Sequence[Array], t: Any, fields: Fields, loop: Loop | None = None
    ) -> list[Array]:
        """`D` as `BlockPattern` wants it, the others as (rows of a block, blocks)."""
        found = [self._padded(name, []) for name in names] if not self.parts else None
        if found is not None:
            return found
        by_group = [group.run(tuple(names), numbers[k], t, fields, loop) for k, group, _ in self.parts]
        return [self._padded(name, [outputs[i] for outputs in by_group]) for i, name in enumerate(names)]

    def _padded(self, name: str, by_group: list[list[Any]]) -> Array:
        """Put together what the groups say: zeros where a block has fewer rows, or fewer bodies."""
        shape = (self.height, 3, self.deep) if name == "D" else (self.height,)
        parts = []
        for (_, group, rows), outputs in zip(self.parts, by_group, strict=True):
            width, size = 3 * len(group.bodies), len(group.members)
            entries: list[Any] = [0.0] * int(np.prod(shape))
            for r, row in enumerate(rows):
                if name != "D":
                    entries[r] = outputs[row]
                    continue
                for k in range(width):
                    body, c = divmod(k, 3)
                    entries[(3 * r + c) * self.deep + body] = outputs[row * width + k]
            parts.append([jnp.broadcast_to(jnp.asarray(e), (size,)) for e in entries])
        if not parts:
            return jnp.zeros((*shape[:-1], 0))
        columns = [jnp.concatenate(column) for column in zip(*parts, strict=True)]
        whole = jnp.stack(columns).reshape(*shape, self.blocks)
        return whole.reshape(self.height, 3, -1) if name == "D" else whole

    def listed(self, values: Float[Array, "r blocks"]) -> Float[Array, "rows"]:
        """The rows of all blocks in the user's order."""
        return values[self.entry]

    def dense(self, D: Float[Array, "r 3 s"]) -> Float[Array, "rows n"]:
        """D as a matrix, rows in the user's order."""
        row, column, place = self.entries
        return jnp.zeros((len(self.rows), 3 * self._bodies), D.dtype).at[row, column].set(take(D.ravel(), place))

    @cached_property
    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of every entry of D: its row in the user's order, its column, and its place in `D.ravel()`."""
        row_at = np.full((self.height, self.blocks), -1)
        row_at[self.entry] = np.arange(len(self.rows))
        body = np.full((self.deep, self.blocks), -1)
        for i, met in enumerate(self._meets):
            body[: len(met), i] = met
        shape = (self.height, 3, self.deep, self.blocks)
        there = (row_at[:, None, None] >= 0) & (body >= 0) & np.ones((3, 1, 1), bool)
        r, c, k, block = np.nonzero(np.broadcast_to(there, shape))
        place = np.ravel_multi_index((r, c, k, block), shape)
        return row_at[r, block], 3 * body[k, block] + c, place


class Layout:
    """What is known of a scene from its structure: which elements are alike, and how its rows hang together."""

    def __init__(self, mechanism: Mechanism, left_out: tuple[int, ...], baumgarte: bool):
        constraints, forces = list(mechanism.constraints.values()), list(mechanism.forces.values())
        loaded = bool(forces)
        self.baumgarte, self.left_out, self.bodies = baumgarte, left_out, len(mechanism.body_names)
        make = partial(_constraint_kind, baumgarte=baumgarte, loaded=loaded)
        sizes = np.zeros(len(constraints), int)
        for group in groups(mechanism, constraints, make):
            sizes[group.members] = group.kind.rows
        self.starts = np.cumsum([0, *sizes])
        self.count = int(self.starts[-1])
        dropped = np.isin(np.arange(self.count), left_out)
        kept = [tuple(np.flatnonzero(~dropped[i:j]).tolist()) for i, j in zip(self.starts, self.starts[1:], strict=False)]
        self.constraints = groups(mechanism, constraints, make, kept)
        self.forces = groups(mechanism, forces, force_kind)
        self.kept = Selection([(g, kept[g.members[0]]) for g in self.constraints], self.starts, self.bodies)
        self.all = Selection([(g, range(g.kind.rows)) for g in self.constraints], self.starts, self.bodies)
        if not left_out:
            self.kept = self.all
        self.loaded = Sums(np.concatenate([g.bodies.ravel() for g in self.forces]), self.bodies) if forces else None
        names = list(mechanism.constraints)
        self.row_names = [(name, k) for name, size in zip(names, sizes, strict=True) for k in range(size)]

    def numbers(self, mechanism: Mechanism, gains: Sequence[Any]) -> dict[str, Any]:
        """Everything that depends on parameters alone."""
        bodies = list(mechanism.bodies.values())
        constraints, forces = list(mechanism.constraints.values()), list(mechanism.forces.values())
        return self._numbers(
            stack([b.mass for b in bodies]),
            stack([b.inertia for b in bodies]),
            mechanism.gravity,
            list(gains),
            [g.stacked(constraints) for g in self.constraints],
            [g.stacked(forces) for g in self.forces],
        )

    @cached_property
    def position(self) -> Any:
        """A program of the numbers, t (s), q and v: Psi and Psi_dot in the user's order, and D as its blocks hold it."""

        def position(numbers, t, q, v):
            fields = fields_of(jnp.asarray(q), jnp.asarray(v))
            D, psi, rate = self.all.evaluate(["D", "psi", "psi_dot"], numbers["constraints"], t, fields)
            return self.all.listed(psi), self.all.listed(rate), D

        return jax.jit(position)

    @cached_property
    def _numbers(self) -> Any:
        """One program for all of it: what is known is computed at once, without tracing as many arrays as there are elements."""

        def numbers(mass, inertia, gravity, gains, constraints, forces):
            root = jnp.sqrt(1 / jnp.stack([mass, mass, inertia], -1))
            shared = [gravity[0], gravity[1], *gains]
            return {
                "root": root.T,
                "mass": jnp.stack([mass, inertia]),
                "gravity": jnp.append(gravity, 0.0),
                "constraints": [g.constants(s, root, shared) for g, s in zip(self.constraints, constraints, strict=True)],
                "forces": [g.constants(s, root, ()) for g, s in zip(self.forces, forces, strict=True)],
            }

        return jax.jit(numbers)


def _constraint_kind(structure: Any, baumgarte: bool, loaded: bool) -> Any:
    return constraint_kind(structure, baumgarte, loaded)


@lru_cache(maxsize=16)
def layout(tree: Any, shapes: tuple, left_out: tuple[int, ...], baumgarte: bool) -> Layout:
    """Return the layout of the mechanisms with this tree and with numbers of these shapes and types."""
    return Layout(jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*s) for s in shapes]), left_out, baumgarte)


def fields_of(q: Vector, v: Vector) -> Fields:
    """What elements see of the bodies."""
    x, y, angle = by_block(q, 3)
    vx, vy, omega = by_block(v, 3)
    sin, cos = sincos(angle)
    return {"x": x, "y": y, "angle": angle, "sin": sin, "cos": cos, "vx": vx, "vy": vy, "omega": omega}
