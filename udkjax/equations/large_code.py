"""The Udwadia-Kalaba equation of a large scene as programs of loops: over elements that are alike, and over blocks of D D^T.

The same programs as in code.py, of the same names, with code that does not grow with the scene. D and the right-hand sides come
from the programs of the elements (element_programs.py). A block of D D^T belongs to a constraint, or to two that hold the same
body; blocks are eliminated in an order of least fill, those that meet later rows in the same way by the same code. In all of the
programs rows whose pivots are too small are dropped.
"""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from udkjax.equations.element_programs import FREE, POSITIONS, VELOCITIES, ConstraintPrograms, Group, Layout
from udkjax.expressions import Graph, Program, Scalar, trace
from udkjax.expressions.loop_derivative import LoopDerivative
from udkjax.expressions.loops import ADD, LEAST, SET, Clear, Kernel, Loop, LoopProgram, Slot, by_arrays
from udkjax.pinv.block_order import Elimination, eliminations
from udkjax.pinv.sparse import absolute, greater, where
from udkjax.scene.mechanism import Mechanism

# Columns of the table of bodies: where its coordinates, its sine and its constants begin.
COORDINATES, SINE, CONSTANTS = 0, 1, 2
# Constants of a body: M^(-1/2), M^-1 and M^(1/2), each of a coordinate and of the angle.
ROOT, COMPLIANCE, WEIGHT, OF_BODY = 0, 2, 4, 6
OF_ANGLE = (0, 0, 1)  # which of the two, of x, y and the angle
# Columns of the table of a group of elements, before three for each of its bodies: where its constants, its entries of D, its
# rows among those kept and among all begin.
OWN, RECORD, RIGHT, ROW, BODIES = 0, 1, 2, 3, 4
DROP, LEAST_PIVOT, GAINS = 0, 1, 2  # constants of all

FIXED = ("t", "gram", "factors", "ratio")  # what no derivative is taken of
SOLVES = 4  # in one program, at most
SOLVED = ("right", "sum", "y", "x", "pull")  # D D^T x = right and pull = D^T x; y = right - sum is that of L y = right

Parts = Iterator[Loop | Clear]


class LargeCode:
    """Programs over arrays of numbers, by name. Each takes the constants, t, q and, where it needs them, v, dq and dv.

    `accelerations` (a, safe), `closer` (q1, safe), `output` (v1, psi), `arrival` (v1, a, safe), `tangential` (dq1, dv1,
    distance), `finish` (what the last two have), `psi` and `psi_dot` (psi), and `rows` (made_of: numbers that are finite where
    all is). What they are says `Code`. `prologue` makes the constants of the numbers of the scene, the gains and two thresholds:
    `drop`, below which a row is dropped, and `least`, below which a result is not `safe`. What a program computes on the way
    stays in arrays of its own (`scratch`): no number is written again once it has been read.
    """

    def __init__(
        self, tree: Any, shapes: tuple, left_out: tuple[int, ...], baumgarte: bool, elimination: str, every: bool = False
    ):
        self.layout = found = Layout(jax.tree.unflatten(tree, [jax.ShapeDtypeStruct(*s) for s in shapes]), left_out, baumgarte)
        self._made_for = tree, shapes, left_out, baumgarte, elimination
        self.elimination, self.left_out = elimination, left_out
        starts = np.cumsum([0, *(int(np.prod(shape)) for shape, _ in shapes)])
        ids = [np.arange(a, b).reshape(s) for a, b, (s, _) in zip(starts, starts[1:], shapes, strict=False)]
        self.scene: Mechanism = jax.tree.unflatten(tree, ids)  # of every number, which it is
        self.numbers = int(starts[-1])
        self.bodies, self.n, self.m = found.bodies, 3 * found.bodies, found.count
        self.gains = 2 if baumgarte else 0
        self.gravity = GAINS + self.gains
        self.of_bodies = self.gravity + 2
        self._constants = self.of_bodies + OF_BODY * self.bodies
        self._parts = found.all if every else found.kept
        # What the programs leave for themselves: how many numbers of each name.
        self.scratch = {"sines": 2 * self.bodies, "free": self.n, "load": self.n, "ratio": 1, "D": 0, "gram": 0}
        rows = {k: rows for k, _, rows in self._parts}
        self._tables: dict[int, np.ndarray] = {}
        self._records: dict[int, dict[int, int]] = {}
        self._constant_start: dict[int, int] = {}
        rights = 0
        for k, group in enumerate(found.constraints):
            self._tables[id(group)] = self._table(group, rows.get(k, ()), rights)
            rights += len(rows.get(k, ())) * len(group.members)
        for group in found.forces:
            self._tables[id(group)] = self._table(group, (), 0)
        self._body_table = np.array([[3 * b, 2 * b, self._of_body(b)] for b in range(self.bodies)]).reshape(-1, 3)
        self._kernels: dict[Hashable, Kernel] = {}
        self._programs: dict[str, LoopProgram] = {}
        self._order()
        self.scratch["factors"] = self.scratch["gram"]
        for k in range(SOLVES):
            self.scratch |= {f"{name}{k}": self.n if name == "pull" else rights for name in SOLVED}
        self.kept = self.scratch | {"sines1": 2 * self.bodies, "q1": self.n, "v1": self.n}  # what derivatives know of a state

    def _table(self, group: Group, kept: Sequence[int], right: int) -> np.ndarray:
        """Where what belongs to each element of a group begins."""
        size, constants = len(group.members), len(group.programs.constants)
        own = self._constants + constants * np.arange(size)
        self._constants += constants * size
        record, place = 0, {}
        if isinstance(group.programs, ConstraintPrograms):
            for s in group.programs.outputs["D"]:
                if s.constant is None:
                    place.setdefault(s.index, len(place))
            record = self._reserve("D", len(place) * size)
            rows = self.layout.starts[group.members]
        else:
            rows = np.zeros(size, int)
        self._records[id(group)] = place
        columns = [own, record + len(place) * np.arange(size), right + len(kept) * np.arange(size), rows]
        for b in group.bodies:
            columns += [3 * b, 2 * b, self._of_body(b)]
        return np.stack([np.broadcast_to(c, (size,)) for c in columns], 1)

    def _of_body(self, body: Any) -> Any:
        return self.of_bodies + OF_BODY * body

    def _reserve(self, name: str, count: int) -> int:
        self.scratch[name] += count
        return self.scratch[name] - count

    # --- what trajectories ask

    @property
    def constants(self) -> range:
        return range(self._constants)

    @property
    def drop_place(self) -> int:
        return DROP

    @property
    def given(self) -> int:
        """How many numbers the prologue takes."""
        return self.numbers + self.gains + 2

    @property
    def made_of(self) -> int:
        return self.n + self.m

    @property
    def watching(self) -> "LargeCode":
        return self

    @cached_property
    def careful(self) -> "LargeCode":
        """The same with all rows, of the same constants: those left out may be independent in singular configurations."""
        code = LargeCode(*self._made_for, every=True)
        code._kernels = self._kernels
        return code

    def program(self, name: str) -> LoopProgram:
        """One of the programs."""
        if name not in self._programs:
            self._programs[name] = LoopProgram(list(getattr(self, f"_{name}")()))
        return self._programs[name]

    # --- programs

    def _accelerations(self) -> Parts:
        yield self._sincos()
        yield from self._loads("v")
        yield from self._elements(("D", "b"), "v")
        yield from self._factorized()
        yield from self._solved()
        yield self._fallen(0)
        yield self._safe()

    def _closer(self) -> Parts:
        yield self._sincos()
        yield from self._elements(("D", "psi"), "v")
        yield from self._factorized()
        yield from self._solved()
        yield self._without("q", "q1", 0)
        yield self._safe()

    def _output(self) -> Parts:
        yield from self._to_velocities()
        yield from self._residuals("psi", "psi")

    def _to_velocities(self) -> Parts:
        yield self._sincos()
        yield from self._elements(("D", "psi_dot"), "v")
        yield from self._factorized()
        yield from self._solved()
        yield self._without("v", "v1", 0)

    def _arrival(self) -> Parts:
        yield from self._to_velocities()
        yield from self._loads("v1")
        yield from self._elements(("b",), "v1", 1)
        yield from self._solved(1)
        yield self._fallen(1)
        yield self._safe()

    def _tangential(self) -> Parts:
        yield self._sincos()
        yield from self._elements(("D",), "v")
        yield from self._factorized()
        yield from self._left_of_changes(0)

    def _left_of_changes(self, solve: int) -> Parts:
        for k, change in enumerate(("dq", "dv"), solve):
            yield from self._rates(change, k)
            yield from self._solved(k)
            yield self._without(change, f"{change}1", k)
        yield self._distance()

    def _finish(self) -> Parts:
        yield from self._arrival()
        yield from self._left_of_changes(2)

    def _psi(self) -> Parts:
        yield self._sincos()
        yield from self._residuals("psi", "psi")

    def _psi_dot(self) -> Parts:
        yield self._sincos()
        yield from self._residuals("psi_dot", "psi")

    def _rank(self) -> Parts:
        """How many rows the last factorization has kept."""
        yield Clear("rank", 0, 1)
        for p in sorted(set(self._sizes)):

            def count(w: _Writing, p: int = p):
                zero, one = w.graph.constant(0.0), w.graph.constant(1.0)
                for j in range(p):
                    inverse = w.read("factors", 0, p + _triangle(j, j))
                    w.write(where(greater(absolute(inverse), zero), one, zero), "rank", None, 0, ADD)

            blocks = [start for start, size in zip(self._diagonals, self._sizes, strict=True) if size == p]
            yield Loop(self._kernel(("rank", p), count), np.array(blocks)[:, None])

    def _rows(self) -> Parts:
        yield self._sincos()
        yield from self._loads("v")

        def falling(w: _Writing):
            for k in range(3):
                free = w.read("free", COORDINATES, k) if self.layout.forces else w.graph.constant(0.0)
                w.write(free, "made_of", COORDINATES, k)

        yield self._of_bodies("falling", falling)
        yield from self._residuals("b", "made_of", self.n)

    # --- derivatives

    @cached_property
    def evaluated(self) -> "dict[str, Evaluated]":
        """Programs as their derivatives are taken: no factorization is differentiated.

        Accelerations, and corrections of a `position` and a `velocity`, q - M^(-1/2) D^T x with D D^T x = Psi, are refined once,

            D D^T x = b,      D D^T x1 = b - D D^T x,      a = a_F + M^(-1/2) D^T (x + x1),

        with x1 of nothing but rounding errors: with x and the factors fixed, the derivative of that is the one of a. The
        `projection` of a state on the manifold is differentiated where all residuals vanish, and with them whatever they
        multiply: D is fixed, too.
        """
        position = [self._sincos(), *self._elements(("psi",)), *self._solved(0), self._without("q", "q1", 0)]
        velocity = [
            self._sincos("q1", "sines1"),
            *self._elements(("psi_dot",), "v", 1, q="q1", sines="sines1"),
            *self._solved(1),
            self._without("v", "v1", 1),
        ]
        projection = Evaluated(
            LoopProgram([self._sincos(), *self._elements(("D",)), *self._factorized(), *position[1:], *velocity]),
            [*position, *velocity],
            {*FIXED, "D"},
        )
        return {
            "accelerations": self._refined([*self._loads("v"), *self._elements(("D", "b"))], self._fallen(0, 1), self._safe()),
            "projection": projection,
            "position": self._refined([*self._elements(("D", "psi"))], self._without("q", "q1", 0, 1)),
            "velocity": self._refined([*self._elements(("D", "psi_dot"))], self._without("v", "v1", 0, 1)),
        }

    def _refined(self, elements: Sequence[Loop | Clear], result: Loop, *rest: Loop) -> "Evaluated":
        before = [self._sincos(), *elements]
        after = [*self._pull(0), *self._left(0, 1), *self._solved(1), result]
        program = LoopProgram([*before, *self._factorized(), *self._substituted(0), *after, *rest])
        return Evaluated(program, [*before, *after], {*FIXED, "sum0", "y0", "x0"})

    def constants_of(self, given: Array) -> Array:
        """The constants as a function of the numbers of the scene and the gains."""
        numbers = jnp.concatenate([given, jnp.zeros(2)])
        return self._constants_by(numbers, jnp)

    def _constants_by(self, numbers: Any, xp: Any) -> Any:
        return by_arrays(self.prologue, {"numbers": numbers, "constants": xp.zeros(len(self.constants))}, xp)["constants"]

    def geometry(self, numbers: Any, xp: Any) -> "Callable[[Any, Any, Any], tuple[Any, Any, Any]]":
        """A function of t, q and v: Psi, Psi_dot and the entries of D at `entries`, of the numbers of the scene."""
        run = self._by_arrays("geometry", numbers, xp)
        _, _, places, signs = self.entries

        def evaluate(t: Any, q: Any, v: Any) -> tuple[Any, Any, Any]:
            found = run(t, q, v)
            return found["psi"], found["rate"], xp.append(found["D"], 1.0)[places] * signs

        return evaluate

    def loaded(self, numbers: Any, xp: Any) -> "Callable[[Any, Any, Any], tuple[Any, Any]]":
        """A function of t, q and v: a_F, and b of all rows."""
        run = self._by_arrays("rows", numbers, xp)
        falling = xp.tile(xp.append(numbers[np.ravel(self.scene.gravity)], 0.0), self.bodies)

        def evaluate(t: Any, q: Any, v: Any) -> tuple[Any, Any]:
            found = run(t, q, v)["made_of"]
            return found[: self.n] if self.layout.forces else falling, found[self.n :]

        return evaluate

    def _by_arrays(self, name: str, numbers: Any, xp: Any) -> "Callable[[Any, Any, Any], dict[str, Any]]":
        """One of the programs in which no row of a loop takes anything from another, by NumPy or JAX."""
        constants = self._constants_by(xp.concatenate([numbers, xp.zeros(2)]), xp)
        program, sizes = self.program(name), self.scratch | {"psi": self.m, "rate": self.m, "made_of": self.made_of}
        wanted = program.arrays | {"psi", "rate", "made_of", "D"}
        blank = {x: xp.zeros(size) for x, size in sizes.items() if x in wanted}

        def run(t: Any, q: Any, v: Any) -> dict[str, Any]:
            given = {"constants": constants, "t": xp.reshape(xp.asarray(t, float), (1,)), "q": q, "v": v}
            return by_arrays(program, blank | given, xp)

        return run

    def _geometry(self) -> Parts:
        yield self._sincos()
        yield from self._elements(("D",))
        yield from self._residuals("psi", "psi")
        yield from self._residuals("psi_dot", "rate")

    @cached_property
    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of the entries of D: row, column, place among those left in `D` (behind them a one), and what that is multiplied by."""
        found = [np.zeros((4, 0))]
        for group in self.layout.constraints:
            table, width = self._tables[id(group)], 3 * len(group.bodies)
            for place, s in enumerate(group.programs.outputs["D"]):
                if s.is_zero:
                    continue
                row, k = divmod(place, width)
                own = s.constant is None
                where = table[:, RECORD] + self._records[id(group)][s.index] if own else np.full(len(table), self.scratch["D"])
                factor = np.full(len(table), s.sign if own else s.constant)
                found.append(np.stack([table[:, ROW] + row, table[:, BODIES + 3 * (k // 3)] + k % 3, where, factor]))
        row, column, place, factor = np.concatenate(found, 1)
        return row.astype(int), column.astype(int), place.astype(int), factor

    def _left(self, solve: int, to: int) -> Parts:
        """What is left of the right-hand side of a solve: right - D pull, to be that of another."""
        for _, group, rows in self._parts:

            def write(w: _Writing, group: Group = group, rows: Sequence[int] = rows):
                for i, row in enumerate(rows):
                    entries = [self._entry(w, group, row, k, RECORD) for k in range(3 * len(group.bodies))]
                    pull = [w.read("pull", BODIES + 3 * (k // 3) + COORDINATES, k % 3) for k in range(len(entries))]
                    w.write(w.read("right", RIGHT, i) - _dot(w.graph, entries, pull), "left", RIGHT, i)

            names = {"pull": f"pull{solve}", "right": f"right{solve}", "left": f"right{to}"}
            yield Loop(self._kernel(("left", id(group), rows), write), self._tables[id(group)], names)

    @cached_property
    def prologue(self) -> LoopProgram:
        """From `numbers` to `constants`."""
        first = _Writing()
        for k in range(self.gains):
            first.write(first.read("numbers", None, self.numbers + k), "constants", None, GAINS + k)
        for k in (DROP, LEAST_PIVOT):
            first.write(first.read("numbers", None, self.numbers + self.gains + k), "constants", None, k)
        for k, number in enumerate(np.ravel(self.scene.gravity)):
            first.write(first.read("numbers", None, int(number)), "constants", None, self.gravity + k)
        body = _Writing()
        for k in range(2):
            mass = body.read("numbers", k)
            root = body.graph.sqrt(body.graph.constant(1.0) / mass)
            for name, value in ((ROOT, root), (COMPLIANCE, root * root), (WEIGHT, body.graph.constant(1.0) / root)):
                body.write(value, "constants", 2, name + k)
        bodies = [[int(b.mass), int(b.inertia), self._of_body(k)] for k, b in enumerate(self.scene.bodies.values())]
        parts = [Loop(first.kernel(), np.zeros((1, 1), int)), Loop(body.kernel(), np.array(bodies).reshape(-1, 3))]
        for groups, elements in (
            (self.layout.constraints, list(self.scene.constraints.values())),
            (self.layout.forces, list(self.scene.forces.values())),
        ):
            parts += [self._prologue_of(g, [elements[i] for i in g.members]) for g in groups]
        return LoopProgram(parts)

    def _prologue_of(self, group: Group, elements: Sequence[Any]) -> Loop:
        kind, table = group.programs, self._tables[id(group)]
        leaves = np.array([[np.ravel(x)[0] if np.size(x) else 0 for x in jax.tree.leaves(e)] for e in elements], int)
        leaves = leaves.reshape(len(elements), -1)
        w, columns = _Writing(kind.graph), table.shape[1]
        for k, leaf in enumerate(kind.leaves):
            for place, s in enumerate(leaf.flat):
                w.bind(s, "numbers", columns + k, place)
        if isinstance(kind, ConstraintPrograms):
            for k, s in enumerate(kind.roots):
                w.bind(s, "constants", BODIES + 3 * (k // 2) + CONSTANTS, ROOT + k % 2)
            for k, s in enumerate([*kind.gains, *kind.gravity]):
                w.bind(s, "constants", None, (GAINS if self.gains else self.gravity) + k)
        for k, s in enumerate(kind.constants):
            w.write(s, "constants", OWN, k)
        return Loop(w.kernel(), np.concatenate([table, leaves], 1))

    # --- kernels

    def _kernel(self, key: Hashable, write: "Callable[[_Writing], None]", graph: Graph | None = None) -> Kernel:
        if key not in self._kernels:
            writing = _Writing(graph)
            write(writing)
            self._kernels[key] = writing.kernel()
        return self._kernels[key]

    def _of_bodies(self, key: Hashable, write: "Callable[[_Writing], None]", **names: str) -> Loop:
        return Loop(self._kernel(key, write), self._body_table, names)

    def _once(self, key: Hashable, write: "Callable[[_Writing], None]") -> Loop:
        return Loop(self._kernel(key, write), np.zeros((1, 1), int))

    def _sincos(self, q: str = "q", sines: str = "sines") -> Loop:
        def pair(w: _Writing):
            angle = np.asarray(w.read("q", COORDINATES, 2), object)
            found = trace(lambda x: [jnp.sin(x), jnp.cos(x)], np.zeros(()))(w.graph, angle)
            for k, s in enumerate(found):
                w.write(s.item(), "sines", SINE, k)

        return self._of_bodies("sincos", pair, q=q, sines=sines)

    def _loads(self, v: str) -> Parts:
        """a_F, where there are forces: without them it is that of gravity."""
        if not self.layout.forces:
            return
        yield Clear("load", 0, self.n)
        for group in self.layout.forces:

            def loads(w: _Writing, group: Group = group):
                for k, s in enumerate(group.programs.outputs["loads"]):
                    w.write(s, "load", BODIES + 3 * (k // 3) + COORDINATES, k % 3, ADD)

            yield self._of_group("loads", group, loads, v=v)

        def free(w: _Writing):
            for k, i in enumerate(OF_ANGLE):
                load, mass = w.read("load", COORDINATES, k), w.read("constants", CONSTANTS, COMPLIANCE + i)
                w.write(self._falling(w, k) + mass * load, "free", COORDINATES, k)

        yield self._of_bodies("free", free)

    def _falling(self, w: "_Writing", k: int) -> Scalar:
        return w.read("constants", None, self.gravity + k) if k < 2 else w.graph.constant(0.0)

    def _of_group(self, key: Hashable, group: Group, write: "Callable[[_Writing], None]", **names: str) -> Loop:
        """A loop over the elements of a group, whose kind's inputs lie where they do in this scene."""
        kind = group.programs

        def bound(w: _Writing):
            arrays = dict.fromkeys(POSITIONS, ("q", COORDINATES, 0)) | dict.fromkeys(VELOCITIES, ("v", COORDINATES, 0))
            arrays |= dict.fromkeys(FREE, ("free", COORDINATES, 0)) | dict.fromkeys(("sin", "cos"), ("sines", SINE, 0))
            order = [*POSITIONS, *VELOCITIES, *FREE, "sin", "cos"]
            for k, s in enumerate(kind.constants):
                w.bind(s, "constants", OWN, k)
            w.bind(kind.t, "t", None, 0)
            for name, body, s in kind.state:
                array, column, start = arrays[name]
                w.bind(s, array, BODIES + 3 * body + column, start + order.index(name) % 3 if name != "cos" else start + 1)
            write(w)

        kernel = self._kernel((key, id(group)), bound, kind.graph)
        return Loop(kernel, self._tables[id(group)], names)

    def _elements(self, names: tuple[str, ...], v: str = "v", solve: int = 0, **where: str) -> Parts:
        """D, and a right-hand side."""
        for _, group, rows in self._parts:

            def write(w: _Writing, group: Group = group, rows: Sequence[int] = rows):
                outputs = group.programs.outputs
                if "D" in names:
                    for index, place in self._records[id(group)].items():
                        w.write(Scalar(group.programs.graph, index), "D", RECORD, place)
                for name in names:
                    if name != "D":
                        for i, row in enumerate(rows):
                            w.write(outputs[name][row], "right", RIGHT, i)

            yield self._of_group((names, rows), group, write, v=v, right=f"right{solve}", **where)

    def _residuals(self, name: str, array: str, start: int = 0) -> Parts:
        """Psi, Psi_dot or b of all rows in their order, into an array."""
        for group in self.layout.constraints:

            def write(w: _Writing, group: Group = group):
                for i, s in enumerate(group.programs.outputs[name]):
                    w.write(s, array, ROW, start + i)

            yield self._of_group((name, array), group, write)

    def _entry(self, w: "_Writing", group: Group, row: int, k: int, record: int) -> Scalar:
        """An entry of D as it was left."""
        s = group.programs.outputs["D"][row * 3 * len(group.bodies) + k]
        if s.constant is not None:
            return w.graph.constant(s.constant)
        found = w.read("D", record, self._records[id(group)][s.index])
        return found if s.sign > 0 else -found

    def _rates(self, change: str, solve: int) -> Parts:
        """Psi_q dx, of the rows kept."""
        for _, group, rows in self._parts:

            def write(w: _Writing, group: Group = group, rows: Sequence[int] = rows):
                for i, row in enumerate(rows):
                    total = w.graph.constant(0.0)
                    for k in range(3 * len(group.bodies)):
                        base = BODIES + 3 * (k // 3)
                        weight = w.read("constants", base + CONSTANTS, WEIGHT + OF_ANGLE[k % 3])
                        dx = w.read("dx", base + COORDINATES, k % 3)
                        total = total + self._entry(w, group, row, k, RECORD) * (weight * dx)
                    w.write(total, "right", RIGHT, i)

            names = {"dx": change, "right": f"right{solve}"}
            yield Loop(self._kernel(("rates", id(group), rows), write), self._tables[id(group)], names)

    def _solved(self, solve: int = 0) -> Parts:
        """D^T (D D^T)^-1 of what is on the right, into `pull`."""
        yield from self._substituted(solve)
        yield from self._pull(solve)

    def _pull(self, solve: int) -> Parts:
        """D^T x."""
        names = _of_solve(solve)
        yield Clear(names["pull"], 0, self.n)
        for _, group, rows in self._parts:

            def write(w: _Writing, group: Group = group, rows: Sequence[int] = rows):
                y = [w.read("x", RIGHT, i) for i in range(len(rows))]
                for k in range(3 * len(group.bodies)):
                    total = sum(
                        (self._entry(w, group, row, k, RECORD) * s for row, s in zip(rows, y, strict=True)), w.graph.constant(0.0)
                    )
                    if not total.is_zero:
                        w.write(total, "pull", BODIES + 3 * (k // 3) + COORDINATES, k % 3, ADD)

            yield Loop(self._kernel(("pull", id(group), rows), write), self._tables[id(group)], names)

    def _pulled(self, w: "_Writing", k: int, name: str = "pull") -> Scalar:
        """M^(-1/2) of what is in `pull`."""
        return w.read("constants", CONSTANTS, ROOT + OF_ANGLE[k]) * w.read(name, COORDINATES, k)

    def _fallen(self, *solves: int) -> Loop:
        names = ["pull", "more"][: len(solves)]

        def write(w: _Writing):
            for k in range(3):
                free = w.read("free", COORDINATES, k) if self.layout.forces else self._falling(w, k)
                w.write(sum((self._pulled(w, k, name) for name in names), free), "a", COORDINATES, k)

        where = {name: f"pull{solve}" for name, solve in zip(names, solves, strict=True)}
        return self._of_bodies(("fallen", len(solves)), write, **where)

    def _without(self, x: str, to: str, *solves: int) -> Loop:
        names = ["pull", "more"][: len(solves)]

        def write(w: _Writing):
            for k in range(3):
                w.write(w.read("from", COORDINATES, k) - sum(self._pulled(w, k, name) for name in names), "to", COORDINATES, k)

        where = {name: f"pull{solve}" for name, solve in zip(names, solves, strict=True)}
        return self._of_bodies(("without", len(solves)), write, **{"from": x, "to": to}, **where)

    def _safe(self) -> Loop:
        def write(w: _Writing):
            w.write(greater(w.read("ratio", None), w.read("constants", None, LEAST_PIVOT)), "safe", None)

        return self._once("safe", write)

    def _distance(self) -> Loop:
        def write(w: _Writing):
            w.write(w.graph.sqrt(w.read("ratio", None)), "distance", None)

        return self._once("distance", write)

    # --- D D^T

    def _order(self):
        """In which order blocks are eliminated, and where they are kept."""
        elements = [(g, rows, i) for _, g, rows in self._parts for i in range(len(g.members))]
        bodies = [set(g.bodies[:, i].tolist()) for g, _, i in elements]
        sizes = [len(rows) for _, rows, _ in elements]
        self.eliminations: list[Elimination] = eliminations(sizes, bodies)
        self._elements_of_blocks, self._sizes = elements, sizes
        self._diagonals = [self._reserve("gram", p + p * (p + 1) // 2) for p in sizes]  # also as it was before any elimination
        place = {k: j for j, k in enumerate(k for e in self.eliminations for k in e.blocks)}
        self._places = place
        self._off_start, self._off = self.scratch["gram"], {}
        for e in self.eliminations:
            for k, later in zip(e.blocks, e.later, strict=True):
                for a in later:
                    self._off[a, k] = self._reserve("gram", sizes[a] * sizes[k])
        self._off_size = self.scratch["gram"] - self._off_start

    def _right(self, block: int) -> int:
        group, _, i = self._elements_of_blocks[block]
        return int(self._tables[id(group)][i, RIGHT])

    def _record(self, block: int) -> int:
        group, _, i = self._elements_of_blocks[block]
        return int(self._tables[id(group)][i, RECORD])

    @cached_property
    def _gram(self) -> list[Loop | Clear]:
        """D D^T, block by block."""
        found: list[Loop | Clear] = [Clear("gram", self._off_start, self._off_size)] if self._off_size else []
        start = 0
        for _, group, rows in self._parts:
            p, table = len(rows), self._tables[id(group)]
            diagonals = np.array(self._diagonals[start : start + len(group.members)])[:, None]
            start += len(group.members)

            def write(w: _Writing, group: Group = group, rows: Sequence[int] = rows, p: int = p, base: int = table.shape[1]):
                entries = [[self._entry(w, group, row, k, RECORD) for k in range(3 * len(group.bodies))] for row in rows]
                for i in range(p):
                    for j in range(i + 1):
                        s = _dot(w.graph, entries[i], entries[j])
                        w.write(s, "gram", base, p + _triangle(i, j))
                        if i == j:
                            w.write(s, "gram", base, i)

            found.append(Loop(self._kernel(("diagonal", id(group), rows), write), np.concatenate([table, diagonals], 1)))
        holders: dict[int, list[tuple[int, int]]] = {}
        for block, (group, _, i) in enumerate(self._elements_of_blocks):
            for slot, body in enumerate(group.bodies[:, i].tolist()):
                holders.setdefault(body, []).append((block, slot))
        pairs: dict[Hashable, list[list[int]]] = {}
        kinds: dict[Hashable, Any] = {}
        for met in holders.values():
            met.sort(key=lambda x: self._places[x[0]])
            for j, (early, s) in enumerate(met):
                for late, r in met[j + 1 :]:
                    if early == late:
                        continue
                    (g, rows, _), (h, columns, _) = self._elements_of_blocks[late], self._elements_of_blocks[early]
                    key = "pair", id(g), rows, r, id(h), columns, s
                    kinds[key] = g, rows, r, h, columns, s
                    pairs.setdefault(key, []).append([self._record(late), self._record(early), self._off[late, early]])
        for key, table in pairs.items():
            g, rows, r, h, columns, s = kinds[key]

            def product(w: _Writing, g=g, rows=rows, r=r, h=h, columns=columns, s=s):
                one = [[self._entry(w, g, row, 3 * r + k, 0) for k in range(3)] for row in rows]
                two = [[self._entry(w, h, row, 3 * s + k, 1) for k in range(3)] for row in columns]
                for i, x in enumerate(one):
                    for j, y in enumerate(two):
                        w.write(_dot(w.graph, x, y), "gram", 2, i * len(two) + j, ADD)

            found.append(Loop(self._kernel(key, product), np.array(table)))
        return found

    def _factorized(self) -> Parts:
        yield from self._gram
        yield Clear("ratio", 0, 1, np.inf)
        for e in self.eliminations:
            p, later = e.size, e.sizes

            def write(w: _Writing, p: int = p, later: tuple[int, ...] = later):
                drop = w.read("constants", None, DROP)
                self._eliminate(w, p, later, drop)

            yield Loop(self._kernel(("eliminate", p, later), write), self._block_table(e))

    def _block_table(self, e: Elimination) -> np.ndarray:
        """Of each block: where its factors and its right-hand side begin; of each that it meets, the block in common and the
        right-hand side; and the blocks that these have in common."""
        table = []
        for k, later in zip(e.blocks, e.later, strict=True):
            row = [self._diagonals[k], self._right(k)]
            for a in later:
                row += [self._off[a, k], self._right(a)]
            for i, a in enumerate(later):
                row += [self._off[a, b] for b in later[:i]] + [self._diagonals[a]]
            table.append(row)
        return np.array(table)

    def _eliminate(self, w: "_Writing", p: int, later: tuple[int, ...], drop: Scalar):
        graph, zero, one = w.graph, w.graph.constant(0.0), w.graph.constant(1.0)
        S = [[w.read("gram", 0, p + _triangle(i, j)) for j in range(i + 1)] for i in range(p)]
        below = [[[w.read("gram", 2 + 2 * a, i * p + j) for j in range(p)] for i in range(size)] for a, size in enumerate(later)]
        rows = [row for block in below for row in block]
        ratio = []
        for j in range(p):
            pivot, diagonal = S[j][j], w.read("gram", 0, j)
            inverse = where(greater(pivot, diagonal * drop), one / pivot, zero)
            ratio.append(absolute(pivot * (one / diagonal)))
            for i in range(j + 1, p):
                lower = S[i][j] * inverse
                for k in range(j + 1, i + 1):
                    S[i][k] = S[i][k] - lower * S[k][j]
                for row in rows:
                    row[i] = row[i] - lower * row[j]
                w.write(lower, "factors", 0, p + _triangle(i, j))
            w.write(inverse, "factors", 0, p + _triangle(j, j))
            S[j][j] = inverse
        for x in ratio:
            w.write(x, "ratio", None, 0, LEAST)
        scaled = [[[s * S[j][j] for j, s in enumerate(row)] for row in block] for block in below]
        for a, block in enumerate(scaled):
            for i, row in enumerate(block):
                for j, s in enumerate(row):
                    w.write(s, "factors", 2 + 2 * a, i * p + j)
        base = 2 + 2 * len(later)
        for a, block in enumerate(scaled):
            for b in range(a + 1):
                for i, row in enumerate(block):
                    for j, other in enumerate(below[b]):
                        if a > b or j <= i:
                            place = i * later[b] + j if a > b else later[a] + _triangle(i, j)
                            w.write(-_dot(graph, row, other), "gram", base, place, ADD)
                base += 1

    def _substituted(self, solve: int) -> Parts:
        """x = (D D^T)^-1 of what is on the right."""
        names = _of_solve(solve)
        yield Clear(names["sum"], 0, self.scratch[names["sum"]])
        for e in self.eliminations:
            p, later = e.size, e.sizes

            def forward(w: _Writing, p: int = p, later: tuple[int, ...] = later):
                y = [w.read("right", 1, i) - w.read("sum", 1, i) for i in range(p)]
                for i in range(p):
                    for j in range(i):
                        y[i] = y[i] - w.read("factors", 0, p + _triangle(i, j)) * y[j]
                    w.write(y[i], "y", 1, i)
                for a, size in enumerate(later):
                    for i in range(size):
                        row = [w.read("factors", 2 + 2 * a, i * p + j) for j in range(p)]
                        w.write(_dot(w.graph, row, y), "sum", 3 + 2 * a, i, ADD)

            yield Loop(self._kernel(("forward", p, later), forward), self._block_table(e), names)
        for e in reversed(self.eliminations):
            p, later = e.size, e.sizes

            def backward(w: _Writing, p: int = p, later: tuple[int, ...] = later):
                x = [w.read("y", 1, i) * w.read("factors", 0, p + _triangle(i, i)) for i in range(p)]
                for a, size in enumerate(later):
                    for i in range(size):
                        s = w.read("x", 3 + 2 * a, i)
                        for j in range(p):
                            x[j] = x[j] - w.read("factors", 2 + 2 * a, i * p + j) * s
                for j in reversed(range(p)):
                    for i in range(j + 1, p):
                        x[j] = x[j] - w.read("factors", 0, p + _triangle(i, j)) * x[i]
                    w.write(x[j], "x", 1, j)

            yield Loop(self._kernel(("backward", p, later), backward), self._block_table(e)[::-1], names)


class Evaluated(NamedTuple):
    """A program, and what of it derivatives are taken of: with respect to all arrays but those that are `fixed`."""

    program: LoopProgram
    parts: Sequence[Loop | Clear]
    fixed: set[str]

    def derivative(self, fixed: Collection[str] = ()) -> LoopDerivative:
        return LoopDerivative(self.parts, {*self.fixed, *fixed})


class _Writing:
    """A kernel as it is written: what it reads and where it writes to."""

    def __init__(self, graph: Graph | None = None):
        self.graph = Graph() if graph is None else graph
        self._inputs: dict[Scalar, Slot] = {}
        self._outputs: list[tuple[Scalar, Slot]] = []

    def read(self, array: str, base: int | None, offset: int = 0) -> Scalar:
        s = self.graph.input((array, base, offset), array)
        self._inputs[s] = Slot(array, base, offset)
        return s

    def bind(self, s: Scalar, array: str, base: int | None, offset: int = 0):
        """A scalar of the graph is found there."""
        self._inputs[s] = Slot(array, base, offset)

    def write(self, s: Scalar, array: str, base: int | None, offset: int = 0, how: str = SET):
        self._outputs.append((s, Slot(array, base, offset, how)))

    def kernel(self) -> Kernel:
        program = Program(self.graph, list(self._inputs), [s for s, _ in self._outputs])
        return Kernel(program, list(self._inputs.values()), [slot for _, slot in self._outputs])


def _of_solve(solve: int) -> dict[str, str]:
    return {name: f"{name}{solve}" for name in SOLVED}


def _triangle(i: int, j: int) -> int:
    """The place of an entry in a lower triangle, row by row."""
    return i * (i + 1) // 2 + j


def _dot(graph: Graph, a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    return sum((x * y for x, y in zip(a, b, strict=True)), graph.constant(0.0))


@lru_cache(maxsize=16)
def large_code(tree: Any, shapes: tuple, left_out: tuple[int, ...], baumgarte: bool, elimination: str) -> LargeCode:
    """Return the code for a structure; `elimination` is "drop", or "watch": it says where pivots are small, too."""
    return LargeCode(tree, shapes, left_out, baumgarte, elimination)
