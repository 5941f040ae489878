"""The Udwadia-Kalaba equation for scenes of hundreds and thousands of bodies.

The same equation as in udwadia_kalaba.py, on arrays over all elements of a kind (alike.py) in place of scalars, so that the
program does not grow with the scene. D is kept in blocks, one for each constraint and body; D D^T is eliminated by the levels of
its elimination tree (pinv/blocks.py). What dense methods need, and singular values, is dense here, too: of (rows, coordinates),
for what that costs.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property, lru_cache, partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations.alike import Fields, Group, constraint_kind, force_kind, groups, stack
from udkjax.equations.code import CONSISTENT, TINY, structure
from udkjax.equations.motion import MechanismMotion, Vector
from udkjax.pinv import Auto, Elimination, Plus, Pseudoinverse
from udkjax.pinv.blocks import BlockElimination, BlockPattern, Sums, by_block, factorized, flat, take
from udkjax.scene.mechanism import Mechanism
from udkjax.straightline.trigonometry import sincos

# The least share of a row's length that closing takes for granted: enough to tell redundant rows from rounding, too little to
# slow down Newton's method where rows are independent.
DAMPING = 1e-10
# Of a row left out, relative to its length: what of a motion that the rows kept allow shows that it is independent of them.
INDEPENDENT = 1e-4
_RESIDUALS = {"rows": "b", "closure": "psi", "rate": "psi_dot"}


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
        return BlockPattern(self._sizes, self._meets, 3, self._bodies)

    def evaluate(self, names: Sequence[str], numbers: Sequence[Array], t: Any, fields: Fields) -> list[Array]:
        """`D` as `BlockPattern` wants it, the others as (rows of a block, blocks)."""
        found = [self._padded(name, []) for name in names] if not self.parts else None
        if found is not None:
            return found
        by_group = [group.run(tuple(names), numbers[k], t, fields) for k, group, _ in self.parts]
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
        """A program of the numbers, t (s) and q: Psi in the user's order, and D as its blocks hold it."""

        def position(numbers, t, q):
            q = jnp.asarray(q)
            D, psi = self.all.evaluate(["D", "psi"], numbers["constraints"], t, fields_of(q, q))
            return self.all.listed(psi), D

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


class LargeEquations(MechanismMotion):
    """The equations of motion of a large mechanism by one method.

    `Auto` eliminates the rows kept. Where a pivot is too small it takes singular values of all rows, of a dense matrix: one of
    thousands of rows takes minutes for that, and each of its singular configurations does it a few times. `Elimination` turns to
    dense elimination, which drops what depends. Where it is not known which rows are redundant both are dense throughout.
    """

    numbers: dict[str, Any]
    method: Pseudoinverse
    layout: Layout = eqx.field(static=True)
    dense: bool = eqx.field(static=True, default=False)  # whether the method is applied to D of all rows as a matrix

    def accelerations(self, t: Any, q: Vector, v: Vector, watch: bool = False) -> Vector:
        """a = a_F + M^(-1/2) D^+ b. With `watch`, `Auto` also looks at the rows left out."""
        return _compiled(_accelerations if self.by_levels else _plainly, self, t, q, v, watch)

    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda = -(D^+)^T D^+ b of all rows: by elimination where none is left out, else by singular values."""
        return _compiled(LargeEquations._multipliers, self, t, q, v)

    def _multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        if not self.layout.count:
            return jnp.zeros(0)
        if not self.by_levels or self.left_out:
            equations = self.exact() if self.by_levels else self
            plus, b, _ = equations.linearized("rows", t, q, v)
            return -(plus.T @ (plus @ b))

        def solve(plus: Plus, rows: Selection) -> Vector:
            free = self._free(t, q, v)
            b = self._arrays(rows, ["b"], t, q, v, free)[0]
            if isinstance(plus.method, BlockElimination):
                return rows.listed(by_block(-(plus.T @ (plus @ flat(b))), rows.height))
            return -(plus.T @ (plus @ rows.listed(b)))

        return _by_method(self, solve, t, q, v)

    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v to Psi = 0 and Psi_dot = 0 by the smallest change in the mass metric."""
        return _compiled(_project, self, t, q, v)

    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Psi and Psi_dot, of all rows: also of those that the method leaves out."""
        return _compiled(_violation, self, t, q, v)

    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether everything that the equation is made of is a number."""
        free = self._free(t, q, v)
        made_of = [*self._arrays(self.layout.all, ["D", "b"], t, q, v, free), free]
        return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in made_of]))

    def matrices(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """M, F, Psi_q and gamma - 2 alpha Psi_dot - beta^2 Psi, of all rows, dense."""
        free = self._free(t, q, v)
        D, b = self._arrays(self.layout.all, ["D", "b"], t, q, v, free)
        root, free = flat(self.numbers["root"]), flat(free)
        M, A = 1 / root**2, self.layout.all.dense(D) / root
        return jnp.diag(M), M * free, A, self.layout.all.listed(b) + A @ free

    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows, dense."""
        D, _, root = self.weighted(t, q)
        return D / root

    def weighted(self, t: Any, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """D, Psi and M^(-1/2) of all rows, dense."""
        D, psi = self._arrays(self.layout.all, ["D", "psi"], t, q, q)
        return self.layout.all.dense(D), self.layout.all.listed(psi), flat(self.numbers["root"])

    def energy(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Kinetic and potential energy (J)."""
        x, y, _ = by_block(q, 3)
        vx, vy, omega = by_block(v, 3)
        mass, inertia = self.numbers["mass"]
        g = self.numbers["gravity"]
        kinetic = 0.5 * jnp.sum(mass * (vx * vx + vy * vy) + inertia * omega * omega)
        potential = -jnp.sum(mass * (g[0] * x + g[1] * y))
        fields = self._fields(q, v)
        for group, numbers in zip(self.layout.forces, self.numbers["forces"], strict=True):
            (stored,) = group.run(("potential",), numbers, t, fields)[0]
            potential = potential + jnp.sum(jnp.broadcast_to(jnp.asarray(stored), (len(group.members),)))
        return kinetic, potential

    def linearized(self, name: str, t: Any, q: Any, v: Any) -> tuple[Plus, Array, Vector]:
        """D^+ by the method, dense and of all rows or by blocks of those kept; the residual `name` of these; and M^(-1/2)."""
        root, name = flat(self.numbers["root"]), _RESIDUALS[name]
        free = self._free(t, q, v) if name == "b" else None
        rows = self.layout.kept if self.by_levels else self.layout.all
        D, residual = self._arrays(rows, ["D", name], t, q, v, free)
        if self.by_levels:
            return self._elimination.plus(D), flat(residual), root
        if isinstance(self.method, BlockElimination):
            plus = self.method.plus(D)
            return eqx.tree_at(lambda p: p.factors.rank, plus, self._rank(D, t, q)), flat(residual), root
        return self.method.plus(rows.dense(D)), rows.listed(residual), root

    @property
    def row_names(self) -> list[tuple[str, int]]:
        return self.layout.row_names

    @property
    def left_out(self) -> tuple[int, ...]:
        return self.layout.left_out

    @property
    def constrained(self) -> bool:
        return self.layout.count > 0

    @property
    def stabilized(self) -> bool:
        return self.layout.baumgarte

    @property
    def by_levels(self) -> bool:
        return isinstance(self.method, Auto | Elimination) and not self.dense

    @property
    def branches(self) -> bool:
        """An evaluation is long beside the branch in it: there is no reason to do without it first."""
        return False

    @property
    def quick(self) -> "LargeEquations":
        return self

    def exact(self) -> "LargeEquations":
        """The same on all rows as a matrix: what to turn to where rows are not independent."""
        method = self.method.exact if isinstance(self.method, Auto) else self.method
        return dataclasses.replace(self, method=method, dense=True)

    # --- pieces

    @property
    def drop(self) -> Any:
        """What a pivot must exceed, relative to its row's diagonal entry of D D^T."""
        return self.method.branch_tol if isinstance(self.method, Auto) else jnp.asarray(self.method.rank_tol) ** 2

    @property
    def _elimination(self) -> BlockElimination:
        return BlockElimination(self.layout.kept.pattern, jnp.sqrt(jnp.asarray(self.drop)))

    def _rank(self, D: Float[Array, "r 3 s"], t: Any, q: Vector) -> Array:
        """The rank of all rows: those kept, and those left out that some motion which these allow does not satisfy."""
        every, kept = self.layout.all, self.layout.kept
        if not self.left_out:
            return jnp.asarray(self.layout.count)
        plus = self._elimination.plus(self._arrays(kept, ["D"], t, q, q)[0])
        motion = jnp.asarray(np.random.default_rng(0).standard_normal(3 * self.layout.bodies))
        motion = motion - plus @ plus.method.matvec(plus.matrix, motion)
        missed = every.listed(every.pattern.matvec(D, by_block(motion, 3)))
        length = jnp.sqrt(every.listed(every.pattern.matvec(D * D, jnp.ones((3, self.layout.bodies)))))
        typical = jnp.sqrt(jnp.mean(motion**2))
        missed = jnp.abs(missed[np.array(self.left_out)]) > INDEPENDENT * typical * length[np.array(self.left_out)]
        return len(kept.rows) + jnp.sum(missed)

    def _fields(self, q: Vector, v: Vector, free: Any = None) -> Fields:
        fields = fields_of(q, v)
        return fields if free is None else fields | dict(zip(("fx", "fy", "fangle"), free, strict=True))

    def _arrays(self, rows: Selection, names: Sequence[str], t: Any, q: Vector, v: Vector, free: Any = None) -> list[Array]:
        return rows.evaluate(names, self.numbers["constraints"], t, self._fields(q, v, free))

    def _free(self, t: Any, q: Vector, v: Vector) -> Float[Array, "3 bodies"]:
        """a_F = M^-1 F."""
        fall = jnp.broadcast_to(self.numbers["gravity"][:, None], (3, self.layout.bodies))
        if self.layout.loaded is None:
            return fall
        fields, parts = self._fields(q, v), []
        for group, numbers in zip(self.layout.forces, self.numbers["forces"], strict=True):
            (loads,) = group.run(("loads",), numbers, t, fields)
            size = len(group.members)
            loads = jnp.stack([jnp.broadcast_to(jnp.asarray(x), (size,)) for x in loads]) if loads else jnp.zeros((0, size))
            parts.append(loads.reshape(-1, 3, size).swapaxes(0, 1).reshape(3, -1))
        return fall + self.numbers["root"] ** 2 * self.layout.loaded(jnp.concatenate(parts, -1))


def prepare_large(mechanism: Mechanism, method: Pseudoinverse, gains: Sequence[Any]) -> LargeEquations:
    """As `prepare`, with the method's thresholds decided."""
    found = layout(*structure(mechanism), mechanism.left_out or (), bool(gains))
    return LargeEquations(found.numbers(mechanism, gains), method, found, dense=mechanism.left_out is None)


def prepare_closing(mechanism: Mechanism) -> LargeEquations:
    """Prepare a mechanism to be closed: with D^+ of all rows by elimination, which `DAMPING` keeps from dividing by nothing."""
    found = layout(*structure(mechanism), mechanism.left_out or (), False)
    return LargeEquations(found.numbers(mechanism, ()), BlockElimination(found.all.pattern, 0.0, DAMPING), found)


def _violation(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
    rows = equations.layout.all
    psi, rate = equations._arrays(rows, ["psi", "psi_dot"], t, q, v)
    return rows.listed(psi), rows.listed(rate)


def _compiled(function: Any, equations: LargeEquations, t: Any, q: Vector, v: Vector, *choices: bool) -> Any:
    """As one program, also where it is not part of a larger one: else each of its operations would be compiled by itself."""
    return _called(function, equations, jnp.asarray(t, jnp.result_type(float)), q, v, *choices)


@eqx.filter_jit
def _called(function: Any, *arguments: Any) -> Any:
    return function(*arguments)


# --- plain


def plain_accelerations(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> Vector:
    """a = a_F + M^(-1/2) D^+ b."""
    free, root = equations._free(t, q, v), flat(equations.numbers["root"])

    def solve(plus: Any, rows: Selection) -> Vector:
        b = equations._arrays(rows, ["b"], t, q, v, free)[0]
        return flat(free) + root * (plus @ _right(plus, rows, b))

    return _by_method(equations, solve, t, q, v)


def plain_project(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """Two Newton steps in position and one in velocity."""
    root = flat(equations.numbers["root"])

    def step(name: str, q: Vector) -> Vector:
        def solve(plus: Any, rows: Selection) -> Vector:
            return -root * (plus @ _right(plus, rows, equations._arrays(rows, [name], t, q, v)[0]))

        return _by_method(equations, solve, t, q, v)

    q = q + step("psi", q)
    q = q + step("psi", q)
    return q, v + step("psi_dot", q)


def _plain_correction(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """One Newton step in position and one in velocity, with one D^+: of a projected state it changes the tangents alone."""
    root = flat(equations.numbers["root"])

    def step(plus: Any, rows: Selection) -> tuple[Vector, Vector]:
        psi = equations._arrays(rows, ["psi"], t, q, v)[0]
        closed = q - root * (plus @ _right(plus, rows, psi))
        rate = equations._arrays(rows, ["psi_dot"], t, closed, v)[0]
        return closed, v - root * (plus @ _right(plus, rows, rate))

    return _by_method(equations, step, t, q, v)


def _by_method(equations: LargeEquations, use: Any, t: Any, q: Vector, v: Vector) -> Any:
    """Call `use` with D^+ by the equations' method, and the rows that it is of."""
    layout = equations.layout
    if not len(layout.kept.rows):
        return use(_Unconstrained(), layout.kept)
    if not equations.by_levels:
        D = equations._arrays(layout.all, ["D"], t, q, v)[0]
        return use(equations.method.plus(layout.all.dense(D)), layout.all)
    plus = equations._elimination.plus(equations._arrays(layout.kept, ["D"], t, q, v)[0])
    return _branch(plus.rank > 0, lambda: use(plus, layout.kept), lambda: _by_method(equations.exact(), use, t, q, v))


def _right(plus: Any, rows: Selection, values: Float[Array, "r blocks"]) -> Array:
    """A right-hand side as `plus` wants it."""
    return rows.listed(values) if not isinstance(getattr(plus, "method", None), BlockElimination) else flat(values)


class _Unconstrained:
    """D^+ of no rows at all."""

    def __matmul__(self, b: Any) -> float:
        return 0.0


def _plainly(equations: LargeEquations, t: Any, q: Vector, v: Vector, _: bool) -> Vector:
    return plain_accelerations(equations, t, q, v)


# --- fast


@partial(jax.custom_jvp, nondiff_argnums=(4,))
def _accelerations(equations: LargeEquations, t: Any, q: Vector, v: Vector, watch: bool) -> Vector:
    layout, root = equations.layout, equations.numbers["root"]
    free = equations._free(t, q, v)
    if not len(layout.kept.rows):
        return flat(free)
    D, b = equations._arrays(layout.kept, ["D", "b"], t, q, v, free)
    pattern = layout.kept.pattern
    factors, safe = factorized(pattern, D, equations.drop)
    x = pattern.rmatvec(D, pattern.levels.solve(factors, b.T).T)
    a = flat(free + root * x)
    if watch and layout.left_out:
        safe = safe & _satisfied(equations, t, q, v, free, x)
    return _checked(equations, safe, a, plain_accelerations, t, q, v)


def _satisfied(equations: LargeEquations, t: Any, q: Vector, v: Vector, free: Array, x: Array) -> Bool[Array, ""]:
    """Whether the accelerations satisfy the rows left out, too: D x = b, relative to the size of its terms."""
    rows = equations.layout.all
    D, b = equations._arrays(rows, ["D", "b"], t, q, v, free)
    sum_of = rows.pattern.matvec
    return jnp.all(jnp.abs(sum_of(D, x) - b) <= CONSISTENT * (sum_of(jnp.abs(D), jnp.abs(x)) + jnp.abs(b)) + TINY)


@jax.custom_jvp
def _project(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    return _fast_project(equations, t, q, v) if equations.by_levels else plain_project(equations, t, q, v)


@_project.defjvp
def _(primals, tangents):
    """Where the residuals vanish the tangents of one Newton step are those of the projection."""
    equations, t, q, v = primals
    q, v = _project(equations, t, q, v)
    return (q, v), jax.jvp(_plain_correction, (equations, t, q, v), tangents)[1]


def _fast_project(equations: LargeEquations, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
    """As the plain form, but with the factors of the first position kept: they differ by the residual, and so does the result."""
    rows, root = equations.layout.kept, equations.numbers["root"]
    if not len(rows.rows):
        return q, v
    D, psi = equations._arrays(rows, ["D", "psi"], t, q, v)
    factors, safe = factorized(rows.pattern, D, equations.drop)

    def without(x: Vector, residual: Array) -> Vector:
        return x - flat(root * rows.pattern.rmatvec(D, rows.pattern.levels.solve(factors, residual.T).T))

    q1 = without(q, psi)
    q2 = without(q1, equations._arrays(rows, ["psi"], t, q1, v)[0])
    result = q2, without(v, equations._arrays(rows, ["psi_dot"], t, q2, v)[0])
    return _checked(equations, safe, result, plain_project, t, q, v)


_accelerations.defjvp(lambda watch, primals, tangents: jax.jvp(plain_accelerations, primals, tangents))


def _checked(equations: LargeEquations, safe: Bool[Array, ""], fast: Any, plain: Any, *state: Any) -> Any:
    """Take what elimination gave where its pivots are safe; else turn to the dense method."""
    return _branch(safe, lambda: fast, lambda: plain(equations.exact(), *state))


def _branch(safe: Bool[Array, ""], fast: Any, careful: Any) -> Any:
    """One of two results; under vmap, `careful` is taken for all as soon as one is in need of it."""
    where = lambda a, b: jnp.where(safe, a, b)  # noqa: E731
    return jax.lax.cond(eqxi.unvmap_all(safe), fast, lambda: jax.tree.map(where, fast(), careful()))
