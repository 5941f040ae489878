"""Loops of derivatives of a linear system by the implicit rule: no factorization is differentiated."""

from udkjax.equations.scene_layout import RIGHT, ConstraintGroup
from udkjax.equations.scene_terms import ProgramParts, SceneTerms, dot, read_bodies, rows, write_jt
from udkjax.expressions import Scalar
from udkjax.expressions.loop_program import ADD, KernelLoop, KernelWriter, Reset


class ImplicitTerms:
    """Terms of Psi_q M^(-1) Psi_q^T x = b as functions of the state, with a solution that is known."""

    def __init__(self, terms: SceneTerms):
        self._terms = terms

    def residuals(self, output: str, v: str = "v") -> ProgramParts:
        """Compute right1 = b - Psi_q z, and jt_x0 = Psi_q^T x0, as functions of all but z = M^(-1) Psi_q^T x0 and x0."""
        yield Reset("jt_x0", 0, self._terms.layout.coordinate_count)
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                outputs, entries, z = group.programs.outputs, _entries(group), read_bodies(w, group, "z")
                for i, row in enumerate(group.rows):
                    w.write(outputs[output][row] - dot(w.graph, entries[i], z), "right1", RIGHT, i)
                write_jt(w, group, entries, [w.read("x0", RIGHT, i) for i in rows(group)], "jt_x0")

            yield self._terms.over_group(("residual", output), group, write, fixed=("x0", "z"), v=v)

    def transposed(self, **names: str) -> ProgramParts:
        """Compute jt_x0 = Psi_q^T x0, with Psi_q as a function of the state."""
        yield Reset("jt_x0", 0, self._terms.layout.coordinate_count)
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                write_jt(w, group, _entries(group), [w.read("x0", RIGHT, i) for i in rows(group)], "jt_x0")

            yield self._terms.over_group("transposed", group, write, **names)

    def difference(self, output: str, solve: int, **names: str) -> ProgramParts:
        """Compute right = b - Psi_q z of a linear system, with Psi_q and b as functions of the state."""
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                z = read_bodies(w, group, "z")
                for i, (row, entries) in enumerate(zip(group.rows, _entries(group), strict=True)):
                    w.write(group.programs.outputs[output][row] - dot(w.graph, entries, z), "right", RIGHT, i)

            yield self._terms.over_group(("difference", output), group, write, right=f"right{solve}", **names)

    def correct_solution(self, solve: int) -> ProgramParts:
        """Compute x0 + x, with x of a linear system, in place of x0."""
        for group in self._terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i in rows(group):
                    w.write(w.read("x", RIGHT, i), "x0", RIGHT, i, ADD)

            yield KernelLoop(self._terms.kernel(("correct", len(group.rows)), write), group.table, {"x": f"x{solve}"})


def _entries(group: ConstraintGroup) -> list[list[Scalar]]:
    """Return the entries of the eliminated rows of Psi_q of a group, as functions of the state."""
    n = group.coordinates
    return [group.programs.outputs["psi_q"][row * n : (row + 1) * n] for row in group.rows]
