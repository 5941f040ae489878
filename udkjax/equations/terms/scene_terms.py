"""Loops over the bodies and elements of a scene: the terms of its equations, and products with Psi_q and its transpose."""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence

import jax.numpy as jnp
import numpy as np

from udkjax.equations.terms.element_programs import FREE_INPUTS, POSITION_INPUTS, VELOCITY_INPUTS, ElementPrograms
from udkjax.equations.terms.scene_layout import (
    BODIES,
    BODY_CONSTANTS,
    BODY_COORDINATES,
    ENTRIES,
    MASS_OR_INERTIA,
    OWN_CONSTANTS,
    RIGHT,
    ROW,
    RUBBING_CONSTANTS,
    SHARED,
    SINE,
    ConstraintGroup,
    ElementGroup,
    SceneLayout,
    arrays_of_solve,
)
from udkjax.expressions import Graph, Scalar, trace
from udkjax.expressions.loops.loop_program import ADD, SET, Kernel, KernelLoop, KernelWriter, Reset
from udkjax.expressions.scalars.selection import greater, where
from udkjax.scene.elements.friction import Friction

ProgramParts = Iterator[KernelLoop | Reset]
Write = Callable[[KernelWriter], None]


def dot(graph: Graph, a: list[Scalar], b: list[Scalar]) -> Scalar:
    """Return the scalar product of two lists of scalars."""
    return sum((x * y for x, y in zip(a, b, strict=True)), graph.constant(0.0))


class SceneTerms:
    """Loops that read and write the arrays of a `SceneLayout`.

    Arguments such as `v`, `q` or `sines` are names of arrays; `solve` and `solution` are numbers of linear systems. Kernels are
    made once for each key and shared.
    """

    def __init__(self, layout: SceneLayout, kernels: dict[Hashable, Kernel]):
        self.layout, self.kernels = layout, kernels

    # --- kinds of loops

    def kernel(self, key: Hashable, write: Write, graph: Graph | None = None) -> Kernel:
        """Return the kernel with this key; on first use it is made by `write`, in the graph `graph` or a new one."""
        if key not in self.kernels:
            writer = KernelWriter(graph)
            write(writer)
            self.kernels[key] = writer.kernel()
        return self.kernels[key]

    def single_iteration(self, key: Hashable, write: Write, **names: str) -> KernelLoop:
        """Return a loop of one iteration."""
        return KernelLoop(self.kernel(key, write), np.zeros((1, 1), int), names)

    def over_bodies(self, key: Hashable, write: Write, fixed: Collection[str] = (), **names: str) -> KernelLoop:
        """Return a loop over all bodies.

        `names` map arrays of the kernel to arrays of the program with other names; `fixed` arrays are constant in derivatives.
        """
        return KernelLoop(self.kernel(key, write), self.layout.body_table, names, fixed)

    def over_group(
        self, key: Hashable, group: ElementGroup, write: Write, fixed: Collection[str] = (), **names: str
    ) -> KernelLoop:
        """Return a loop over the elements of a group, with the inputs of their programs bound to the arrays of the scene."""
        return self.over_elements((key, group), group, group.programs, OWN_CONSTANTS, write, fixed, **names)

    def over_rubbing(self, key: Hashable, group: ConstraintGroup, write: Write, **names: str) -> KernelLoop:
        """Return a loop over the joints of a group with friction, with the inputs of their friction bound to the scene's arrays.

        The inputs x = -lambda of its rows are bound to the array `x`, for which `names` must give the result of `loads_of`.
        """
        rubbing, shared = group.rubbing, len(self.layout.shared)
        assert rubbing is not None

        def bind_solution(w: KernelWriter):
            for i, s in enumerate(rubbing.x):
                if i < len(group.rows):
                    w.bind(s, "x", RIGHT, shared + i)
                else:
                    w.bind(s, "x", group.column(SHARED), i - len(group.rows))
            write(w)

        return self.over_elements(
            (key, group, "rubbing"), group, rubbing, group.column(RUBBING_CONSTANTS), bind_solution, **names
        )

    def over_elements(
        self,
        key: Hashable,
        group: ElementGroup,
        programs: ElementPrograms,
        constants: int,
        write: Write,
        fixed: Collection[str] = (),
        **names: str,
    ) -> KernelLoop:
        """Return a loop over the elements of a group, with the inputs of `programs` bound to the arrays of the scene.

        `constants` is the column of the table with the start indices of the constants of `programs`.
        """

        def bind_inputs(w: KernelWriter):
            arrays = dict.fromkeys(POSITION_INPUTS, ("q", BODY_COORDINATES, 0)) | dict.fromkeys(
                VELOCITY_INPUTS, ("v", BODY_COORDINATES, 0)
            )
            arrays |= dict.fromkeys(FREE_INPUTS, ("free", BODY_COORDINATES, 0)) | dict.fromkeys(
                ("sin", "cos"), ("sines", SINE, 0)
            )
            order = [*POSITION_INPUTS, *VELOCITY_INPUTS, *FREE_INPUTS, "sin", "cos"]
            for k, s in enumerate(programs.constants):
                w.bind(s, "constants", constants, k)
            w.bind(programs.t, "t", None, 0)
            for name, body, s in programs.state:
                array, column, start = arrays[name]
                w.bind(s, array, BODIES + 3 * body + column, start + order.index(name) % 3 if name != "cos" else start + 1)
            write(w)

        return KernelLoop(self.kernel(key, bind_inputs, programs.graph), group.table, names, fixed)

    # --- terms of the equations

    def sincos(self, q: str = "q", sines: str = "sines") -> KernelLoop:
        """Return the loop that computes the sine and the cosine of each body's angle, from the array `q` to the array `sines`."""

        def write(w: KernelWriter):
            angle = np.asarray(w.read("q", BODY_COORDINATES, 2), object)
            sine_and_cosine = trace(lambda x: [jnp.sin(x), jnp.cos(x)], np.zeros(()))(w.graph, angle)
            for k, s in enumerate(sine_and_cosine):
                w.write(s.item(), "sines", SINE, k)

        return self.over_bodies("sincos", write, q=q, sines=sines)

    def free_accelerations(self, v: str) -> ProgramParts:
        """Yield loops that compute a_F in `free`, at the velocities `v`; none without force elements: a_F is then gravity."""
        if not self.layout.forces:
            return
        yield Reset("load", 0, self.layout.coordinate_count)
        for group in self.layout.forces:

            def write_loads(w: KernelWriter, group: ElementGroup = group):
                for k, s in enumerate(group.programs.outputs["loads"]):
                    w.write(s, "load", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            yield self.over_group("loads", group, write_loads, v=v)

        def write(w: KernelWriter):
            for k in range(3):
                load = w.read("load", BODY_COORDINATES, k)
                w.write(self._gravity(w, k) + compliance(w, k) * load, "free", BODY_COORDINATES, k)

        yield self.over_bodies("free", write)

    def _gravity(self, w: KernelWriter, k: int) -> Scalar:
        return w.read("constants", None, self.layout.gravity + k) if k < 2 else w.graph.constant(0.0)

    def read_free(self, w: KernelWriter, k: int) -> Scalar:
        """Return component k of a_F of a body, read from `free`, or gravity without force elements."""
        return w.read("free", BODY_COORDINATES, k) if self.layout.forces else self._gravity(w, k)

    def element_terms(
        self,
        outputs: tuple[str, ...],
        v: str = "v",
        solve: int = 0,
        groups: Sequence[ConstraintGroup] | None = None,
        **names: str,
    ) -> ProgramParts:
        """Yield loops that compute outputs of `ConstraintPrograms` for all elements of some groups.

        Args:
            outputs: "psi_q" is written to the array of this name; each other output, in order and for the eliminated rows, to the
                right-hand side of a linear system: the first to that of `solve`, the next to that of `solve` + 1.
            v: Array of the velocities.
            solve: Number of the first linear system.
            groups: The groups; None: all groups with eliminated rows.
            names: Arrays that replace others, such as q="q1".
        """
        rights = [name for name in outputs if name != "psi_q"]
        for group in self.layout.eliminated if groups is None else groups:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                if "psi_q" in outputs:
                    for index, offset in group.entry_index.items():
                        w.write(Scalar(group.programs.graph, index), "psi_q", ENTRIES, offset)
                for k, name in enumerate(rights):
                    for i, row in enumerate(group.rows):
                        w.write(group.programs.outputs[name][row], f"right{k}", RIGHT, i)

            named = {f"right{k}": f"right{solve + k}" for k in range(len(rights))}
            yield self.over_group(outputs, group, write, v=v, **named, **names)

    def every_entry(self) -> ProgramParts:
        """Yield loops that compute `psi_q` with the entries of all rows, and the one to which constant entries refer."""
        yield Reset("psi_q", self.layout.one, 1, 1.0)
        yield from self.element_terms(("psi_q",), groups=self.layout.constraints)

    def row_terms(self, name: str, array: str, start: int = 0, **names: str) -> ProgramParts:
        """Yield loops that write Psi, Psi_dot or b (`name`) of all rows, in their order, to an array, from index `start` on."""
        for group in self.layout.constraints:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i, s in enumerate(group.programs.outputs[name]):
                    w.write(s, "to", ROW, start + i)

            yield self.over_group((name, start), group, write, to=array, **names)

    def energy(self) -> ProgramParts:
        """Yield loops that compute `energy`: v^T M v / 2, and the potential energy of gravity and of the force elements."""
        yield Reset("energy", 0, 2)

        def write(w: KernelWriter):
            kinetic = potential = w.graph.constant(0.0)
            for k in range(3):
                v, mass = w.read("v", BODY_COORDINATES, k), 1.0 / compliance(w, k)
                kinetic = kinetic + mass * (v * v) * 0.5
                potential = potential - mass * self._gravity(w, k) * w.read("q", BODY_COORDINATES, k)
            for index, x in enumerate((kinetic, potential)):
                w.write(x, "energy", None, index, ADD)

        yield self.over_bodies("energy", write)
        for group in self.layout.forces:

            def write_potential(w: KernelWriter, group: ElementGroup = group):
                w.write(group.programs.outputs["potential"][0], "energy", None, 1, ADD)

            yield self.over_group("potential", group, write_potential)

    def friction_power(self, solution: int) -> ProgramParts:
        """Yield loops that compute `friction_power` (W), the power of all friction, for the solution x of a linear system."""
        yield Reset("friction_power", 0, 1)

        def writer(programs: ElementPrograms) -> Write:
            def write(w: KernelWriter):
                speeds = [s for name, _, s in programs.state if name in VELOCITY_INPUTS]
                w.write(dot(w.graph, programs.outputs["loads"], speeds), "friction_power", None, 0, ADD)

            return write

        for group in self.layout.forces:
            if isinstance(group.programs.element, Friction):
                yield self.over_group("power", group, writer(group.programs))
        for group in self.layout.rubbing:
            assert group.rubbing is not None
            yield self.over_rubbing("power", group, writer(group.rubbing), x=self.loads_of(solution))

    def pieces(self) -> ProgramParts:
        """Yield loops that compute `pieces`: the index of the smooth piece of each piecewise smooth element, and loads of edges.

        An edge (`RubbingPrograms`) has two pieces, by the sign of its load. The load is written as the acceleration (m/s^2) that
        it gives the lightest body of the joint. Loads are computed from x in the array `settled`.
        """
        for group, places in self.layout.pieces:
            base = group.table.shape[1]

            def write(w: KernelWriter, group: ElementGroup = group, base: int = base):
                w.write(group.programs.outputs["piece"][0], "pieces", base)

            loop = self.over_group("piece", group, write)
            yield loop._replace(table=np.concatenate([group.table, places[:, None]], 1))
        for group, places in self.layout.edges:
            base = group.table.shape[1]

            def write_edges(w: KernelWriter, group: ConstraintGroup = group, base: int = base):
                assert group.rubbing is not None
                lightest = w.graph.constant(0.0)
                for b in range(len(group.bodies)):
                    mobility = compliance(w, 0, BODIES + 3 * b + BODY_CONSTANTS)
                    lightest = where(greater(mobility, lightest), mobility, lightest)
                for k, edge in enumerate(group.rubbing.outputs["edges"]):
                    w.write(edge * lightest, "pieces", base, k)

            loop = self.over_rubbing("edges", group, write_edges, x="settled")
            yield loop._replace(table=np.concatenate([group.table, places[:, None]], 1))

    # --- products with the eliminated rows of Psi_q and their transpose

    def rates(self, change: str, solve: int, subtract: bool = False, of_positions: bool = False) -> ProgramParts:
        """Yield loops that set the right-hand side of a linear system to Psi_q times the array `change`.

        With `subtract` the product is subtracted from the right-hand side instead. With `of_positions` the product is zero in
        rows that restrict velocities alone, whose Psi is zero: they allow any change of positions.
        """
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                dq = read_bodies(w, group, "change")
                for i, row in enumerate(group.rows):
                    is_free = of_positions and group.programs.outputs["psi"][row].is_zero
                    rate = w.graph.constant(0.0) if is_free else dot(w.graph, group.entries(w, row), dq)
                    w.write(-rate if subtract else rate, "right", RIGHT, i, ADD if subtract else SET)

            names = {"change": change, "right": f"right{solve}"}
            yield KernelLoop(self.kernel(("rates", group, subtract, of_positions), write), group.table, names)

    def jt(self, solve: int) -> ProgramParts:
        """Yield loops that compute jt_x = Psi_q^T x of the linear system `solve`."""
        names = arrays_of_solve(solve)
        yield Reset(names["jt_x"], 0, self.layout.coordinate_count)
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                write_jt(w, group, [group.entries(w, row) for row in group.rows], [w.read("x", RIGHT, i) for i in rows(group)])

            yield KernelLoop(self.kernel(("jt", group), write), group.table, names)

    def remainder(self, solve: int, target: int) -> ProgramParts:
        """Yield loops that set the right-hand side of `target` to right - Psi_q M^(-1) Psi_q^T x of the system `solve`."""
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                jt_x = read_bodies(w, group, "jt_x")
                z = [compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS) * s for k, s in enumerate(jt_x)]
                for i, row in enumerate(group.rows):
                    w.write(w.read("right", RIGHT, i) - dot(w.graph, group.entries(w, row), z), "remainder", RIGHT, i)

            names = {"jt_x": f"jt_x{solve}", "right": f"right{solve}", "remainder": f"right{target}"}
            yield KernelLoop(self.kernel(("remainder", group), write), group.table, names)

    def add(
        self,
        to: str,
        start: str | None = None,
        change: str | None = None,
        solution: int | None = None,
        sign: int = 1,
        update: str = SET,
        fixed: Collection[str] = (),
    ) -> KernelLoop:
        """Return the loop that sets the array `to`, for each body, to start + sign * change; without an argument each is zero.

        `start` is the name of an array, or "free" for a_F. The change is the array `change` or, for a linear system `solution`,
        M^(-1) times its jt_x. With `update=ADD` the result is added to `to`. `fixed` arrays are constant in derivatives.
        """
        base, size = (SINE, 2) if start == "sines" else (BODY_COORDINATES, 3)

        def write(w: KernelWriter):
            for k in range(size):
                difference = total = w.graph.constant(0.0)
                if solution is not None:
                    difference = compliance(w, k) * w.read("change", base, k)
                elif change is not None:
                    difference = w.read("change", base, k)
                if start is not None:
                    total = self.read_free(w, k) if start == "free" else w.read("start", base, k)
                total = total + difference if sign > 0 else total - difference
                w.write(total, "to", base, k, update)

        key = "add", size, start if start in (None, "free") else "array", change is None, solution is None, sign, update
        added = change if solution is None else f"jt_x{solution}"
        return self.over_bodies(
            key, write, fixed, to=to, **{"start": start} if start else {}, **{"change": added} if added else {}
        )

    def loads_of(self, solution: int) -> str:
        """Return the name of the array of the x that determine the loads of joints, after the solution of a linear system.

        It is the solution itself or, if redundant rows share the loads, "loads" with the number of the system.
        """
        return f"loads{solution}" if self.layout.shared else f"x{solution}"

    def multipliers(self, solution: int) -> ProgramParts:
        """Yield loops that compute `multipliers`, lambda = -x of a linear system, in the order of Psi; zero for rows left out."""
        yield Reset("multipliers", 0, self.layout.row_count)
        shared, names = len(self.layout.shared), {"x": self.loads_of(solution)}
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i, row in enumerate(group.rows):
                    w.write(-w.read("x", RIGHT, shared + i), "multipliers", ROW, row)

            yield KernelLoop(self.kernel(("multipliers", group.rows, shared), write), group.table, names)
        if shared:

            def write_shared(w: KernelWriter):
                w.write(-w.read("x", 0), "multipliers", 1)

            table = np.array(list(enumerate(self.layout.shared)))
            yield KernelLoop(self.kernel("shared multipliers", write_shared), table, names)


def read_bodies(w: KernelWriter, group: ElementGroup, array: str) -> list[Scalar]:
    """Return the numbers of an array of coordinates that belong to the bodies of an element."""
    return [w.read(array, BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3) for k in range(group.coordinates)]


def rows(group: ConstraintGroup) -> range:
    """Return the indices of the eliminated rows of each element of a group, from zero."""
    return range(len(group.rows))


def compliance(w: KernelWriter, k: int, base: int = BODY_CONSTANTS) -> Scalar:
    """Return the diagonal entry of M^(-1) for coordinate k of a body; `base` is the table's column of the body's constants."""
    return w.read("constants", base, MASS_OR_INERTIA[k])


def write_jt(w: KernelWriter, group: ConstraintGroup, entries: list[list[Scalar]], x: list[Scalar], to: str = "jt_x") -> None:
    """Write code that adds Psi_q^T x of a group's constraint to the array `to`, which has an entry for each coordinate.

    Args:
        w: the writer.
        group: the group.
        entries: the entries of Psi_q in the constraint's rows.
        x: the entries of x for these rows.
        to: the array.
    """
    for k in range(group.coordinates):
        total = dot(w.graph, [row[k] for row in entries], x)
        if not total.is_zero:
            w.write(total, to, BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)
