"""The differentiable programs of a scene: accelerations, Newton steps and the projection of a state."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from udkjax.equations.elimination.friction_elimination import FrictionElimination
from udkjax.equations.elimination.load_sharing import LoadSharing
from udkjax.equations.elimination.scene_solver import SceneSolver, program
from udkjax.equations.terms.scene_layout import RIGHT, ConstraintGroup
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, dot, read_bodies, rows, write_jt
from udkjax.expressions import Scalar
from udkjax.expressions.loops.loop_derivative import REVERSE, TWICE, LoopDerivative
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, LoopProgram, Reset

# Arrays that are held fixed in derivatives. Kernels that read sines and cosines differentiate them as functions of q.
NOT_DIFFERENTIATED = ("t", "sines", "sines1", "psi_q", "gram", "factors", "nearness", "trusted", "y0", "x0")
NOT_DIFFERENTIATED += ("slopes", "base", "skew", "skew_factors", "misfit", "left", "rubbing", "drag", "new_drag")  # of friction
NOT_DIFFERENTIATED += LoadSharing.FIXED

# The outputs that are x + z or x - z with z = C J^T y, J C J^T y = right: the right-hand side, x, and the sign.
IMPLICIT_OUTPUTS = {"a": ("b", "free", 1), "q1": ("psi", "q", -1), "v1": ("psi_dot", "v", -1)}
# The outputs of the projection of a state on the manifold.
PROJECTION_OUTPUTS = ("q1", "v1 at q1")

# Arrays of the second correction of a solution, whose first-order changes vanish after the first correction.
SECOND_CORRECTION = ("right2", "sum2", "y2", "x2")


class DifferentiableProgram(NamedTuple):
    """A program, and loops that have its derivatives, with respect to all arrays except `NOT_DIFFERENTIATED`.

    No factorization is differentiated. With M^(-1) = C and J = Psi_q, accelerations (and likewise corrections q - C J^T x) are

        a = a_F + z,        z = C J^T x,        J C J^T x = b,

    and along a change of the inputs, with the same factors,

        dz = d(C J^T) x + C J^T dx,        J C J^T dx = db - dJ z - J d(C J^T) x.

    The loops express this in terms of x1, which is zero and changes by dx. A projection is differentiated where all residuals,
    and hence all terms with residuals as factors, vanish.

    `parts` have the first derivatives. Second derivatives, by `second_parts`, are those of x after two corrections with the same
    factors, x + (J C J^T)^(-1) (b - J C J^T x): each correction makes derivatives of the next order exact.
    """

    program: LoopProgram
    parts: Sequence[KernelLoop | Reset]
    second_parts: Sequence[KernelLoop | Reset]

    def derivative(self, fixed: Collection[str] = ()) -> LoopDerivative:
        """Return the derivative of `parts`; the arrays `fixed` are constant, in addition to `NOT_DIFFERENTIATED`."""
        return LoopDerivative(self.parts, {*NOT_DIFFERENTIATED, *fixed})

    def in_mode(self, mode: str, fixed: Collection[str] = ()) -> LoopProgram:
        """Return the program of a mode of differentiation (`FORWARD`, `REVERSE` or `TWICE`); the arrays `fixed` are constant."""
        if mode == TWICE:
            twice = LoopDerivative(self.second_parts, {*NOT_DIFFERENTIATED, *fixed} - {"x0"})
            return twice.second(SECOND_CORRECTION)
        derivative = self.derivative(fixed)
        return derivative.reverse if mode == REVERSE else derivative.forward


class DifferentiablePrograms:
    """The differentiable programs of a scene, by their outputs."""

    def __init__(self, solver: SceneSolver):
        self._solver, self._implicit_terms = solver, ImplicitTerms(solver.terms)
        self._programs: dict[tuple[str, ...], DifferentiableProgram] = {}

    def of(self, *outputs: str) -> DifferentiableProgram:
        """Return the program of one of the outputs `IMPLICIT_OUTPUTS`, or of the `PROJECTION_OUTPUTS` of a state on the manifold.

        The program of the accelerations also sets `safe`, and starts from the loads of joints with friction in `settled`.
        """
        if outputs not in self._programs:
            self._programs[outputs] = self._projection() if outputs == PROJECTION_OUTPUTS else self._implicit(*outputs)
        return self._programs[outputs]

    def _projection(self) -> DifferentiableProgram:
        """Return the program of the projection, q1 and v1, whose derivatives are right to second order.

        Its state is on the manifold: q1 and v1 equal q and v, and only derivatives differ.
        """
        solver, terms = self._solver, self._solver.terms
        copies = [terms.add(f"{x}1", start=x) for x in ("q", "v", "sines")]
        position = [*terms.element_terms(("psi",), "v", 1), *solver.solve(1), self._correction("q", 1)]
        at_q1 = terms.element_terms(("psi_dot",), "v", 2, q="q1", sines="sines1")
        at_rest = [Reset(x, 0, terms.layout.sizes[x]) for x in ("x0", "jt_x0", "z")]  # no correction remains
        second = [*self._corrected("psi"), terms.add("q1", start="q", solution=0, sign=-1)]
        second += [*self._corrected("psi_dot", q="q1", sines="sines1"), terms.add("v1", start="v", solution=0, sign=-1)]
        return DifferentiableProgram(
            program(solver.position_terms("psi_q"), solver.factorize_dropping, copies, at_rest),
            [*position, *at_q1, *solver.solve(2), self._correction("v", 2)],
            second,
        )

    def _correction(self, x: str, solve: int) -> KernelLoop:
        return self._solver.terms.add(f"{x}1", start=x, solution=solve, sign=-1, fixed=("constants",))

    def _corrected(self, right: str, **names: str) -> ProgramParts:
        """Yield loops that compute x0, with its current value and the derivatives of two corrections, and jt_x0.

        `right` is the output that is the right-hand side; `names` are arrays that replace others, such as q="q1".
        """
        terms, implicit, friction = self._solver.terms, self._implicit_terms, self._friction(right)
        substitute = self._solver.elimination.substitute if friction is None else friction.substitute
        yield Reset("x0", 0, terms.layout.sizes["x0"])
        if friction is not None:
            yield from friction.sharing.move_null_space(2)
        for solve in (1, 2):
            yield from implicit.transposed(**names)
            yield from self._rubbing(right)
            yield terms.add("z", solution=0)
            yield from implicit.difference(right, solve, **names)
            yield from substitute(solve)
            yield from implicit.correct_solution(solve)
        yield from implicit.transposed(**names)
        yield from self._rubbing(right)

    def _friction(self, right: str) -> FrictionElimination | None:
        """Return the friction in the equation with the right-hand side `right`; None in corrections, or if there is none."""
        return self._solver.friction if right == "b" else None

    def _rubbing(self, right: str) -> ProgramParts:
        """Yield loops that add the loads of friction to jt_x0, if the equation with this right-hand side has any."""
        friction = self._friction(right)
        if friction is not None:
            yield from friction.sharing.share(0, "moved_null")
            yield from friction.add_loads(0)

    def _implicit(self, target: str) -> DifferentiableProgram:
        """Return the program that computes `target`, a key of `IMPLICIT_OUTPUTS`."""
        solver, terms, (right, x, sign) = self._solver, self._solver.terms, IMPLICIT_OUTPUTS[target]
        loads = [*terms.free_accelerations("v")] if target == "a" else []
        z, result = terms.add("z", solution=0), terms.add(target, start=x, change="z", sign=sign)
        system = [terms.sincos(), *loads, *terms.element_terms(("psi_q", right)), *solver.factorize]
        friction = self._friction(right)
        moved = [] if friction is None else [*friction.sharing.move_null_space(1)]
        residuals = [*self._implicit_terms.residuals(right), *moved, *self._rubbing(right)]
        respond = solver.solve(1) if friction is None else friction.solve(1)
        implicit = [*residuals, z, *terms.rates("z", 1, subtract=True), *respond]
        solve = solver.solve() if friction is None else [*friction.settled(0), *friction.sharing.copy_null_space(0)]
        return DifferentiableProgram(
            program(system, solve, [z, result], [solver.safe] if target == "a" else []),
            [*loads, *implicit, terms.add("z", solution=1, update=ADD, fixed=("constants",)), result],
            [*loads, *self._corrected(right), terms.add(target, start=x, solution=0, sign=sign)],
        )


class ImplicitTerms:
    """Loops for the terms of Psi_q M^(-1) Psi_q^T x = b as functions of the state, at a given solution x0."""

    def __init__(self, terms: SceneTerms):
        self._terms = terms

    def residuals(self, output: str, v: str = "v") -> ProgramParts:
        """Yield loops that compute right1 = b - Psi_q z and jt_x0 = Psi_q^T x0, with z = M^(-1) Psi_q^T x0 and x0 held fixed."""
        yield Reset("jt_x0", 0, self._terms.layout.coordinate_count)
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                outputs, entries, z = group.programs.outputs, _entries(group), read_bodies(w, group, "z")
                for i, row in enumerate(group.rows):
                    w.write(outputs[output][row] - dot(w.graph, entries[i], z), "right1", RIGHT, i)
                write_jt(w, group, entries, [w.read("x0", RIGHT, i) for i in rows(group)], "jt_x0")

            yield self._terms.over_group(("residual", output), group, write, fixed=("x0", "z"), v=v)

    def transposed(self, **names: str) -> ProgramParts:
        """Yield loops that compute jt_x0 = Psi_q^T x0, with Psi_q as a function of the state."""
        yield Reset("jt_x0", 0, self._terms.layout.coordinate_count)
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                write_jt(w, group, _entries(group), [w.read("x0", RIGHT, i) for i in rows(group)], "jt_x0")

            yield self._terms.over_group("transposed", group, write, **names)

    def difference(self, output: str, solve: int, **names: str) -> ProgramParts:
        """Yield loops that set the right-hand side of a system to b - Psi_q z, with Psi_q and b as functions of the state."""
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                z = read_bodies(w, group, "z")
                for i, (row, entries) in enumerate(zip(group.rows, _entries(group), strict=True)):
                    w.write(group.programs.outputs[output][row] - dot(w.graph, entries, z), "right", RIGHT, i)

            yield self._terms.over_group(("difference", output), group, write, right=f"right{solve}", **names)

    def correct_solution(self, solve: int) -> ProgramParts:
        """Yield loops that add the solution x of a linear system to x0."""
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i in rows(group):
                    w.write(w.read("x", RIGHT, i), "x0", RIGHT, i, ADD)

            yield KernelLoop(self._terms.kernel(("correct", len(group.rows)), write), group.table, {"x": f"x{solve}"})


def _entries(group: ConstraintGroup) -> list[list[Scalar]]:
    """Return the entries of the eliminated rows of Psi_q of a group, as functions of the state."""
    n = group.coordinates
    return [group.programs.outputs["psi_q"][row * n : (row + 1) * n] for row in group.rows]
