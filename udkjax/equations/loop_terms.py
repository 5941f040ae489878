"""Loops over the bodies and the elements of a large scene: the terms of its equations, and products with D and D^T."""

from collections.abc import Callable, Hashable, Iterator

import jax.numpy as jnp
import numpy as np

from udkjax.equations.element_programs import FREE_INPUTS, POSITION_INPUTS, VELOCITY_INPUTS
from udkjax.equations.loop_layout import (
    BODIES,
    BODY_CONSTANTS,
    BODY_COORDINATES,
    COMPLIANCE,
    ENTRIES,
    MASS_OR_INERTIA,
    OWN_CONSTANTS,
    RIGHT,
    ROOT,
    ROW,
    SINE,
    WEIGHT,
    ConstraintGroup,
    ElementGroup,
    LoopLayout,
    arrays_of_solve,
)
from udkjax.expressions import Graph, Scalar, trace
from udkjax.expressions.loop_program import ADD, Kernel, KernelLoop, KernelWriter, Reset

Parts = Iterator[KernelLoop | Reset]
Write = Callable[[KernelWriter], None]


def dot(graph: Graph, a: list[Scalar], b: list[Scalar]) -> Scalar:
    """Return the scalar product of two lists of scalars."""
    return sum((x * y for x, y in zip(a, b, strict=True)), graph.constant(0.0))


class LoopTerms:
    """Loops that read and write the arrays of a `LoopLayout`. Their kernels are made once, and shared."""

    def __init__(self, layout: LoopLayout, kernels: dict[Hashable, Kernel]):
        self.layout, self.kernels = layout, kernels

    # --- kinds of loops

    def kernel(self, key: Hashable, write: Write, graph: Graph | None = None) -> Kernel:
        """Return the kernel of this key, made by `write` where there is none yet."""
        if key not in self.kernels:
            writer = KernelWriter(graph)
            write(writer)
            self.kernels[key] = writer.kernel()
        return self.kernels[key]

    def single_round(self, key: Hashable, write: Write) -> KernelLoop:
        """A loop of one round."""
        return KernelLoop(self.kernel(key, write), np.zeros((1, 1), int))

    def over_bodies(self, key: Hashable, write: Write, **names: str) -> KernelLoop:
        """A loop over all bodies; `names` are those of its arrays in the program, where they differ from the kernel's."""
        return KernelLoop(self.kernel(key, write), self.layout.body_table, names)

    def over_group(self, key: Hashable, group: ElementGroup, write: Write, **names: str) -> KernelLoop:
        """A loop over the elements of a group, in whose graph the inputs of their programs are bound to the scene's arrays."""
        programs = group.programs

        def bind_inputs(w: KernelWriter):
            arrays = dict.fromkeys(POSITION_INPUTS, ("q", BODY_COORDINATES, 0)) | dict.fromkeys(
                VELOCITY_INPUTS, ("v", BODY_COORDINATES, 0)
            )
            arrays |= dict.fromkeys(FREE_INPUTS, ("free", BODY_COORDINATES, 0)) | dict.fromkeys(
                ("sin", "cos"), ("sines", SINE, 0)
            )
            order = [*POSITION_INPUTS, *VELOCITY_INPUTS, *FREE_INPUTS, "sin", "cos"]
            for k, s in enumerate(programs.constants):
                w.bind(s, "constants", OWN_CONSTANTS, k)
            w.bind(programs.t, "t", None, 0)
            for name, body, s in programs.state:
                array, column, start = arrays[name]
                w.bind(s, array, BODIES + 3 * body + column, start + order.index(name) % 3 if name != "cos" else start + 1)
            write(w)

        return KernelLoop(self.kernel((key, group), bind_inputs, programs.graph), group.table, names)

    # --- terms of the equations

    def sincos(self, q: str = "q", sines: str = "sines") -> KernelLoop:
        """The sine and the cosine of the angle of each body."""

        def write(w: KernelWriter):
            angle = np.asarray(w.read("q", BODY_COORDINATES, 2), object)
            found = trace(lambda x: [jnp.sin(x), jnp.cos(x)], np.zeros(()))(w.graph, angle)
            for k, s in enumerate(found):
                w.write(s.item(), "sines", SINE, k)

        return self.over_bodies("sincos", write, q=q, sines=sines)

    def free_accelerations(self, v: str) -> Parts:
        """a_F, where there are force elements: without them it is gravity."""
        if not self.layout.forces:
            return
        yield Reset("load", 0, self.layout.coordinate_count)
        for group in self.layout.forces:

            def write_loads(w: KernelWriter, group: ElementGroup = group):
                for k, s in enumerate(group.programs.outputs["loads"]):
                    w.write(s, "load", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            yield self.over_group("loads", group, write_loads, v=v)

        def write(w: KernelWriter):
            for k, i in enumerate(MASS_OR_INERTIA):
                load, inverse_mass = w.read("load", BODY_COORDINATES, k), w.read("constants", BODY_CONSTANTS, COMPLIANCE + i)
                w.write(self._gravity(w, k) + inverse_mass * load, "free", BODY_COORDINATES, k)

        yield self.over_bodies("free", write)

    def _gravity(self, w: KernelWriter, k: int) -> Scalar:
        return w.read("constants", None, self.layout.gravity + k) if k < 2 else w.graph.constant(0.0)

    def read_free(self, w: KernelWriter, k: int) -> Scalar:
        """Read a coordinate of a_F of a body."""
        return w.read("free", BODY_COORDINATES, k) if self.layout.forces else self._gravity(w, k)

    def element_terms(self, outputs: tuple[str, ...], v: str = "v", solve: int = 0, **names: str) -> Parts:
        """D, where `outputs` has it, and another output as the right-hand side of a linear system, of the eliminated rows."""
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                if "D" in outputs:
                    for index, place in group.entry_index.items():
                        w.write(Scalar(group.programs.graph, index), "D", ENTRIES, place)
                for name in outputs:
                    if name != "D":
                        for i, row in enumerate(group.rows):
                            w.write(group.programs.outputs[name][row], "right", RIGHT, i)

            yield self.over_group(outputs, group, write, v=v, right=f"right{solve}", **names)

    def row_terms(self, name: str, array: str, start: int = 0) -> Parts:
        """Psi, Psi_dot or b of all rows in their order, into an array."""
        for group in self.layout.constraints:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i, s in enumerate(group.programs.outputs[name]):
                    w.write(s, array, ROW, start + i)

            yield self.over_group((name, array), group, write)

    # --- products with D and D^T, of the eliminated rows

    def rates(self, name: str, solve: int) -> Parts:
        """Psi_q times a change of coordinates, as the right-hand side of a linear system."""
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i, row in enumerate(group.rows):
                    total = w.graph.constant(0.0)
                    for k in range(group.coordinates):
                        base = BODIES + 3 * (k // 3)
                        weight = w.read("constants", base + BODY_CONSTANTS, WEIGHT + MASS_OR_INERTIA[k % 3])
                        change = w.read("change", base + BODY_COORDINATES, k % 3)
                        total = total + group.entry(w, row, k) * (weight * change)
                    w.write(total, "right", RIGHT, i)

            names = {"change": name, "right": f"right{solve}"}
            yield KernelLoop(self.kernel(("rates", group), write), group.table, names)

    def jt(self, solve: int) -> Parts:
        """jt_x = D^T x of a linear system."""
        names = arrays_of_solve(solve)
        yield Reset(names["jt_x"], 0, self.layout.coordinate_count)
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                x = [w.read("x", RIGHT, i) for i in range(len(group.rows))]
                for k in range(group.coordinates):
                    total = dot(w.graph, [group.entry(w, row, k) for row in group.rows], x)
                    if not total.is_zero:
                        w.write(total, "jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            yield KernelLoop(self.kernel(("jt", group), write), group.table, names)

    def residual_of_solve(self, solve: int, to: int) -> Parts:
        """The remainder right - D jt_x of a linear system, as the right-hand side of another one."""
        for group in self.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i, row in enumerate(group.rows):
                    entries = group.entries(w, row)
                    jt_x = [w.read("jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3) for k in range(len(entries))]
                    w.write(w.read("right", RIGHT, i) - dot(w.graph, entries, jt_x), "remainder", RIGHT, i)

            names = {"jt_x": f"jt_x{solve}", "right": f"right{solve}", "remainder": f"right{to}"}
            yield KernelLoop(self.kernel(("remainder", group), write), group.table, names)

    def constrained_accelerations(self, *solves: int) -> KernelLoop:
        """a = a_F + M^(-1/2) D^T x, with the sum of some solutions as x."""
        return self._add_solutions("a_F", solves, lambda w, k, parts: sum(parts, self.read_free(w, k)), to="a")

    def subtract_solutions(self, x: str, to: str, *solves: int) -> KernelLoop:
        """x - M^(-1/2) D^T y, with the sum of some solutions as y."""
        names = {"from": x, "to": to}
        return self._add_solutions("from", solves, lambda w, k, parts: w.read("from", BODY_COORDINATES, k) - sum(parts), **names)

    def _add_solutions(self, key: str, solves: tuple[int, ...], add: Callable[..., Scalar], **names: str) -> KernelLoop:
        arrays = ["jt_x", "refinement"][: len(solves)]

        def write(w: KernelWriter):
            for k in range(3):
                root = ROOT + MASS_OR_INERTIA[k]
                parts = (w.read("constants", BODY_CONSTANTS, root) * w.read(name, BODY_COORDINATES, k) for name in arrays)
                w.write(add(w, k, parts), "to", BODY_COORDINATES, k)

        names |= {name: f"jt_x{solve}" for name, solve in zip(arrays, solves, strict=True)}
        return self.over_bodies(("solutions", key, len(solves)), write, **names)
