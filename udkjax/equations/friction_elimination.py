"""Multipliers with friction that depends on them, by elimination: both sides of the equations contain lambda.

With x = -lambda, the loads G(q, v, x) of friction, C = M^(-1) and J = Psi_q,

    M a = F + J^T x + G(x),        J a = gamma        or        J C (J^T x + G(x)) = b.

G is homogeneous in x, of degree one: G(x) = S x with its slopes S = G_x at x. A step of Newton's method from x is therefore the
solution of a linear system whose matrix has the blocks of J C J^T, because the friction of a joint acts on the bodies of the
joint alone, but is not symmetric:

    J C (J + S^T)^T x_new = b.

The first slopes are those at x without friction. An error e in the direction of a load becomes e^2 times the share of friction,
and loads with a fixed direction, such as those of slides, are exact once their signs are. If the loads do not settle, friction
admits no motion (the mechanism jams), and the accelerations are NaN.
"""

from collections.abc import Callable

from udkjax.equations.block_elimination import BlockElimination
from udkjax.equations.element_programs import RubbingPrograms
from udkjax.equations.scene_layout import BODIES, BODY_CONSTANTS, BODY_COORDINATES, RIGHT, SLOPES, SOLVES, ConstraintGroup
from udkjax.equations.scene_terms import ProgramParts, SceneTerms, compliance, dot, read_bodies
from udkjax.equations.skew_elimination import SkewElimination
from udkjax.expressions import Scalar
from udkjax.expressions.loop_program import ADD, KernelLoop, KernelWriter, Reset
from udkjax.expressions.selection import greater, where

# With a correction before each step, an error c of the directions of loads that are friction by a share of c becomes c^17 / 8 by
# two steps.
NEWTON_STEPS = 3
CORRECTION = SOLVES  # the number of the system of corrections
SETTLED = 1e-10  # change of the loads of friction by the last step, relative to these loads


class FrictionElimination:
    """Loops that solve J C (J^T x + G(x)) = b, in arrays added to the layout after those of `symmetric`; `slopes` holds S."""

    def __init__(self, terms: SceneTerms, symmetric: BlockElimination):
        self.terms, self._symmetric, self._skew = terms, symmetric, SkewElimination(terms, symmetric)
        layout = terms.layout
        layout.sizes |= {"unsettled": 1, "rubbing": 1, "drag": layout.coordinate_count}
        layout.add_solve(CORRECTION)
        self.substitute = self._skew.substitute

    # --- programs

    def settle(self, solve: int, v: str = "v") -> ProgramParts:
        """Replace x of a system, without friction, by x with friction, and jt_x by J^T x + G(x); NaN if x does not settle."""
        yield from self._skew.form_symmetric
        yield from self._correct(solve, v, self._symmetric.substitute, has_slopes=False)
        for k in range(NEWTON_STEPS):
            if k:
                yield from self._correct(solve, v, self._skew.substitute)
            yield from self._slopes(solve, v)
            yield from self._skew.factorize()
            yield from self._skew.substitute(solve)
        yield from self._measure(solve, v)
        yield from self._jt(solve, checked=True)

    def solve(self, solve: int) -> ProgramParts:
        """Compute x = (J C (J + S^T)^T)^(-1) right with the last factors, and jt_x = (J + S^T)^T x."""
        yield from self._skew.substitute(solve)
        yield from self._jt(solve, checked=False)

    def add_loads(self, solution: int, **names: str) -> ProgramParts:
        """Add G(x) of a solution, as a function of the state, to jt_x."""
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for k, s in enumerate(_programs(group).outputs["loads"]):
                    if not s.is_zero:
                        w.write(s, "jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            named = {"x": f"x{solution}", "jt_x": f"jt_x{solution}"}
            yield self.terms.over_rubbing("loads", group, write, **named, **names)

    def _correct(self, solve: int, v: str, substitute: Callable[..., ProgramParts], has_slopes: bool = True) -> ProgramParts:
        """Replace x by the solution with the last factors and the loads G(x) - S x, or G(x) where the factors have no slopes."""
        terms, layout = self.terms, self.terms.layout
        yield Reset("drag", 0, layout.coordinate_count)
        for group in layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                slopes = [group.slopes(w, row) for row in group.rows] if has_slopes else []
                for k, load in enumerate(_programs(group).outputs["loads"]):
                    if not load.is_zero:
                        known = dot(w.graph, _programs(group).x, [row[k] for row in slopes]) if slopes else w.graph.constant(0.0)
                        w.write(load - known, "drag", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            yield terms.over_rubbing(("drag", has_slopes), group, write, x=f"x{solve}", v=v)
        for group in layout.eliminated:

            def rest(w: KernelWriter, group: ConstraintGroup = group):
                drag = read_bodies(w, group, "drag")
                slip = [compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS) * s for k, s in enumerate(drag)]
                for i, row in enumerate(group.rows):
                    w.write(w.read("right", RIGHT, i) - dot(w.graph, group.entries(w, row), slip), "rest", RIGHT, i)

            names = {"right": f"right{solve}", "rest": f"right{CORRECTION}"}
            yield KernelLoop(terms.kernel(("rest of right", group), rest), group.table, names)
        yield from substitute(CORRECTION, x=f"x{solve}")

    def _slopes(self, solve: int, v: str) -> ProgramParts:
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for index, offset in group.slope_index.items():
                    w.write(Scalar(_programs(group).graph, index), "slopes", group.column(SLOPES), offset)

            yield self.terms.over_rubbing("slopes", group, write, x=f"x{solve}", v=v)

    def _measure(self, solve: int, v: str) -> ProgramParts:
        """Compute `unsettled` and `rubbing`, squares of G(x) - S x and of G(x) in the metric of C."""
        yield Reset("unsettled", 0, 1)
        yield Reset("rubbing", 0, 1)
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                slopes = [group.slopes(w, row) for row in group.rows]
                unsettled = size = w.graph.constant(0.0)
                for k, load in enumerate(_programs(group).outputs["loads"]):
                    if load.is_zero:
                        continue
                    change = load - dot(w.graph, _programs(group).x, [row[k] for row in slopes])
                    share = compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS)
                    unsettled, size = unsettled + share * (change * change), size + share * (load * load)
                w.write(unsettled, "unsettled", None, 0, ADD)
                w.write(size, "rubbing", None, 0, ADD)

            yield self.terms.over_rubbing("measure", group, write, x=f"x{solve}", v=v)

    def _jt(self, solve: int, checked: bool) -> ProgramParts:
        """Compute jt_x = (J + S^T)^T x; if `checked`, NaN unless G(x) has settled."""
        yield from self.terms.jt(solve)
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                x = [w.read("x", RIGHT, i) for i in range(len(group.rows))]
                slopes, failed = [group.slopes(w, row) for row in group.rows], None
                if checked:
                    limit = w.read("rubbing", None) * SETTLED**2
                    failed = where(
                        greater(w.read("unsettled", None), limit), w.graph.constant(float("nan")), w.graph.constant(0.0)
                    )
                for k in range(group.coordinates):
                    total = dot(w.graph, [row[k] for row in slopes], x)
                    if not total.is_zero:
                        total = total if failed is None else total + failed
                        w.write(total, "jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            names = {name: f"{name}{solve}" for name in ("x", "jt_x")}
            yield KernelLoop(self.terms.kernel(("jt slopes", checked, group), write), group.table, names)


def _programs(group: ConstraintGroup) -> RubbingPrograms:
    assert group.rubbing is not None
    return group.rubbing
