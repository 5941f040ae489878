"""Multipliers with friction that depends on them, by elimination: both sides of the equations contain lambda.

With x = -lambda, the loads G(q, v, x) of friction, C = M^(-1) and J = Psi_q,

    M a = F + J^T x + G(x),        J a = gamma        or        J C (J^T x + G(x)) = b.

G is homogeneous in x, of degree one: G(x) = S x with its slopes S = G_x at x. A step of Newton's method from x is therefore the
solution of a linear system whose matrix has the blocks of J C J^T, because the friction of a joint acts on the bodies of the
joint alone, but is not symmetric:

    J C (J + S^T)^T x_new = b.

After each step a correction follows with the same factors, from the loads at the new x. An error e of the directions of loads,
relative to friction that is a share s of them, becomes s e^2 by a step and s^2 e^3 by both: a round takes one factorization and
is of third order. The first slopes are those at x after a correction without slopes, where e is s^2. Loads with a fixed
direction, such as those of slides, are exact once their signs are.

One round leaves an error of s^8: it suffices if the coefficients are below about a thirtieth of those that jam the mechanism,
as in most machines. Programs that a run evaluates often take one round, and report loads that have not settled; machine code
then takes as many further rounds as are needed (`further`). A round begins where the step of the last one ended if the
correction did not bring the loads much closer to a solution. Where rounds go back and forth between two sets of signs of the
loads, machine code follows the solution from that without friction on, with a growing `friction_share` of G. Programs that are
differentiated begin with the loads that settled in this way. Other programs take `FRICTION_ROUNDS`. If the loads do not settle,
friction admits no motion (the mechanism jams), and the accelerations are NaN.

A load may obey the equations twice: once as it grows out of the motion without friction, and once with another sign, against
which friction drives it further. If joints yield ever so little, the second one runs away, so that it is no motion. There the
matrix has lost its sign: the determinant is positive without friction, and negative at such a load. Several such loads may
restore it, but then there are `negative` pivots. A solution with these counts only if it was followed from that without friction.
"""

from collections.abc import Callable

from udkjax.equations.elimination.block_elimination import BlockElimination
from udkjax.equations.elimination.load_sharing import LoadSharing
from udkjax.equations.elimination.skew_elimination import SkewElimination
from udkjax.equations.terms.element_programs import RubbingPrograms
from udkjax.equations.terms.scene_layout import (
    BODIES,
    BODY_CONSTANTS,
    BODY_COORDINATES,
    RIGHT,
    SHARED,
    SLOPES,
    SOLVES,
    ConstraintGroup,
)
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms, compliance, dot, read_bodies
from udkjax.expressions import Scalar
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, Reset
from udkjax.expressions.scalars.selection import either, floor, greater, where

# Rounds of programs that cannot ask for more. At 0.9 of the coefficients that jam pins, three are needed.
FRICTION_ROUNDS = 4
CORRECTION_SOLVE = SOLVES  # the number of the system of corrections
# Relative change of the loads of friction by another correction. The accelerations have this error times the share of friction,
# which is below the smallest tolerance of runs; one more round would end at rounding errors.
LOAD_CHANGE_TOL = 1e-10
# Share of the rest of the loads of friction after a step. A correction, which has the factors of the loads before, must not
# change it by more: where the direction of a load turns within a step, it undoes what the step has gained, for ever where the
# load is nearly zero and has another sign.
LARGE_CORRECTION = 1 / 8


class FrictionElimination:
    """Loops that solve J C (J^T x + G(x)) = b, in arrays added to the layout after those of `symmetric`.

    `slopes` holds S. Arguments `solve` are numbers of linear systems, and `v` is the name of the array of velocities.
    """

    def __init__(self, terms: SceneTerms, symmetric: BlockElimination):
        self.terms, self._symmetric, self._skew = terms, symmetric, SkewElimination(terms, symmetric)
        self.sharing, layout = LoadSharing(terms, symmetric, self._skew), terms.layout
        layout.sizes |= {
            "misfit": 1,
            "rubbing": 1,
            "left": 1,
            "drag": layout.coordinate_count,
            "new_drag": layout.coordinate_count,
        }
        layout.add_solve(CORRECTION_SOLVE)
        layout.sizes["settled"] = layout.sizes[f"x{CORRECTION_SOLVE}"]  # the latest x that has settled
        layout.sizes["friction_share"] = 1

    # --- programs

    def settle(self, solve: int, v: str = "v", reports: bool = False) -> ProgramParts:
        """Yield loops that replace x of a system, without friction, by x with friction, and jt_x by J^T x + G(x).

        Both are NaN if x does not settle. With `reports` there is one round only; `unsettled` then tells whether it suffices (see
        `_unsettled`), and `settled` is x. Without `reports` there are `FRICTION_ROUNDS` rounds.
        """
        yield from self._skew.form_symmetric
        yield from self.sharing.find_null_space()
        yield from self.sharing.share(solve)
        yield from self._correct(solve, v, self._symmetric_substitute, has_slopes=False)
        for _ in range(1 if reports else FRICTION_ROUNDS):
            yield from self._round(solve, v, reports=reports)
        yield from self._finish(solve, v, reports)

    def further(self, solve: int, v: str = "v") -> ProgramParts:
        """Yield loops that take one more round from x = `settled`, with `friction_share` times all friction.

        Results and reports are those of `settle` with `reports`.
        """
        yield from self._begin_at_settled(solve)
        yield from self._round(solve, v, reports=True, in_part=True)
        yield from self._finish(solve, v, reports=True, in_part=True)

    def settled(self, solve: int, v: str = "v") -> ProgramParts:
        """Yield loops that take one round from the solution `settled`, with the factors there; results are as in `settle`."""
        yield from self._begin_at_settled(solve)
        yield from self._round(solve, v)
        yield from self._finish(solve, v, reports=False)

    def _symmetric_substitute(self, solve: int, x: int) -> ProgramParts:
        yield from self._symmetric.substitute(solve, x=f"x{x}")

    def _begin_at_settled(self, solve: int) -> ProgramParts:
        yield from self._skew.form_symmetric
        yield from self.sharing.find_null_space()
        yield from self._copy_solution("settled", f"x{solve}")
        yield from self.sharing.share(solve)

    def _round(self, solve: int, v: str, reports: bool = False, in_part: bool = False) -> ProgramParts:
        yield from self._slopes(solve, v, in_part)
        yield from self._skew.factorize()
        yield from self.sharing.find_border()
        yield from self.substitute(solve)
        yield from self.sharing.share(solve)
        if reports:
            yield from self._copy_solution(f"x{solve}", "settled")
        yield from self._correct(solve, v, self.substitute, in_part=in_part)

    def substitute(self, solve: int, x: int | None = None) -> ProgramParts:
        """Yield loops that solve J C (J + S^T)^T x = right with the last factors, for the right-hand side of the system `solve`.

        The result is the x of this system or, if `x` is given, of the system with the number `x`.
        """
        x = solve if x is None else x
        yield from self._skew.substitute(solve, x=f"x{x}")
        yield from self.sharing.correct(x)

    def _finish(self, solve: int, v: str, reports: bool, in_part: bool = False) -> ProgramParts:
        yield from self._measure(solve, v, in_part)
        if reports:
            yield self.terms.single_iteration("unsettled", lambda w: w.write(_unsettled(w), "unsettled", None))
            yield from self._copy_solution(f"x{solve}", "settled", if_small=True)
        yield from self._jt(solve, checked=True)

    def _copy_solution(self, source: str, to: str, if_small: bool = False) -> ProgramParts:
        """Yield loops that copy the x of all eliminated rows from the array `source` to the array `to`.

        With `if_small` they do so only if the last correction was small: see `LARGE_CORRECTION`.
        """
        for group in self.terms.layout.eliminated:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for i in range(len(group.rows)):
                    new = w.read("from", RIGHT, i)
                    if if_small:
                        is_large = greater(w.read("misfit", None), w.read("left", None) * LARGE_CORRECTION**2)
                        new = where(is_large, w.read("to", RIGHT, i), new)
                    w.write(new, "to", RIGHT, i)

            kernel = self.terms.kernel(("copy solution", len(group.rows), if_small), write)
            yield KernelLoop(kernel, group.table, {"from": source, "to": to})

    def solve(self, solve: int) -> ProgramParts:
        """Yield loops that compute x = (J C (J + S^T)^T)^(-1) right with the last factors, and jt_x = (J + S^T)^T x."""
        yield from self.substitute(solve)
        yield from self.sharing.share(solve)
        yield from self._jt(solve, checked=False)

    def add_loads(self, solution: int, **names: str) -> ProgramParts:
        """Yield loops that add G(x) of a linear system, as a function of the state and of x, to its jt_x."""
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for k, s in enumerate(_programs(group).outputs["loads"]):
                    if not s.is_zero:
                        w.write(s, "jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            named = {"x": self.terms.loads_of(solution), "jt_x": f"jt_x{solution}"}
            yield self.terms.over_rubbing("loads", group, write, **named, **names)

    def _correct(
        self, solve: int, v: str, substitute: Callable[..., ProgramParts], has_slopes: bool = True, in_part: bool = False
    ) -> ProgramParts:
        """Yield loops that replace x by a correction: the solution with the last factors and the loads G(x) - S x held fixed.

        `substitute` solves with these factors. If they contain no slopes (`has_slopes` is False), the fixed loads are G(x).
        """
        terms = self.terms
        yield from self._drag(solve, v, "drag", has_slopes, in_part)
        for group in terms.layout.eliminated:

            def rest(w: KernelWriter, group: ConstraintGroup = group):
                drag = read_bodies(w, group, "drag")
                slip = [compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS) * s for k, s in enumerate(drag)]
                for i, row in enumerate(group.rows):
                    w.write(w.read("right", RIGHT, i) - dot(w.graph, group.entries(w, row), slip), "rest", RIGHT, i)

            names = {"right": f"right{solve}", "rest": f"right{CORRECTION_SOLVE}"}
            yield KernelLoop(terms.kernel(("rest of right", group), rest), group.table, names)
        yield from substitute(CORRECTION_SOLVE, x=solve)
        yield from self.sharing.share(solve)

    def _drag(self, solve: int, v: str, to: str, has_slopes: bool = True, in_part: bool = False) -> ProgramParts:
        """Yield loops that compute the loads of friction on each body, G(x) - S x, in `to`; G(x) without `has_slopes`."""
        yield Reset(to, 0, self.terms.layout.coordinate_count)
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                slopes = [group.slopes(w, row) for row in group.loaded_rows] if has_slopes else []
                for k, whole in enumerate(_programs(group).outputs["loads"]):
                    load = _in_part(w, whole) if in_part else whole
                    if not load.is_zero:
                        known = dot(w.graph, _programs(group).x, [row[k] for row in slopes]) if slopes else w.graph.constant(0.0)
                        w.write(load - known, "drag", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            yield self.terms.over_rubbing(("drag", has_slopes, in_part), group, write, x=self.terms.loads_of(solve), v=v, drag=to)

    def _slopes(self, solve: int, v: str, in_part: bool = False) -> ProgramParts:
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                for index, offset in group.slope_index.items():
                    slope = Scalar(_programs(group).graph, index)
                    w.write(_in_part(w, slope) if in_part else slope, "slopes", group.column(SLOPES), offset)

            yield self.terms.over_rubbing(("slopes", in_part), group, write, x=self.terms.loads_of(solve), v=v)

    def _measure(self, solve: int, v: str, in_part: bool) -> ProgramParts:
        """Yield loops that compute squares of loads in the metric of C.

        `rubbing` is the square of G(x), `left` that of the loads that the last correction held fixed, and `misfit` that of the
        change of these loads by the correction.
        """
        yield Reset("misfit", 0, 1)
        yield Reset("left", 0, 1)
        yield Reset("rubbing", 0, 1)
        yield from self._drag(solve, v, "new_drag", in_part=in_part)
        for group in self.terms.layout.rubbing:

            def measure_size(w: KernelWriter, group: ConstraintGroup = group):
                size = w.graph.constant(0.0)
                for k, load in enumerate(_programs(group).outputs["loads"]):
                    size = size + compliance(w, k % 3, BODIES + 3 * (k // 3) + BODY_CONSTANTS) * (load * load)
                w.write(size, "rubbing", None, 0, ADD)

            yield self.terms.over_rubbing("size", group, measure_size, x=self.terms.loads_of(solve), v=v)

        def measure_change(w: KernelWriter):
            drags = [w.read("drag", BODY_COORDINATES, k) for k in range(3)]
            changes = [w.read("new_drag", BODY_COORDINATES, k) - drag for k, drag in enumerate(drags)]
            for name, loads in (("misfit", changes), ("left", drags)):
                squares = [compliance(w, k) * (load * load) for k, load in enumerate(loads)]
                w.write(sum(squares, w.graph.constant(0.0)), name, None, 0, ADD)

        yield self.terms.over_bodies("misfit", measure_change)

    def _jt(self, solve: int, checked: bool) -> ProgramParts:
        """Yield loops that compute jt_x = (J + S^T)^T x; if `checked`, jt_x = J^T x + G(x), and NaN unless x has settled."""
        yield from self.terms.jt(solve)
        shared = len(self.terms.layout.shared)
        for group in self.terms.layout.rubbing:

            def write(w: KernelWriter, group: ConstraintGroup = group):
                x = [w.read("x", RIGHT, shared + i) for i in range(len(group.rows))]
                x += [w.read("x", group.column(SHARED), i) for i in range(len(group.shared_rows))]
                slopes = [group.slopes(w, row) for row in group.loaded_rows]
                for k in range(group.coordinates):
                    total = dot(w.graph, [row[k] for row in slopes], x)
                    if not total.is_zero:
                        w.write(total, "jt_x", BODIES + 3 * (k // 3) + BODY_COORDINATES, k % 3, ADD)

            names = {"x": self.terms.loads_of(solve), "jt_x": f"jt_x{solve}"}
            yield KernelLoop(self.terms.kernel(("jt slopes", group), write), group.table, names)
        if not checked:
            return

        def complete(w: KernelWriter):
            failed = where(_fails(w), w.graph.constant(float("nan")), w.graph.constant(0.0))
            for k in range(3):
                w.write(w.read("drag", BODY_COORDINATES, k) + failed, "jt_x", BODY_COORDINATES, k, ADD)

        yield self.terms.over_bodies("jt drag", complete, jt_x=f"jt_x{solve}")


def _in_part(w: KernelWriter, x: Scalar) -> Scalar:
    """Return `friction_share` times x; zero if the share is zero, even where x is not finite because loads ran away."""
    share, zero = w.read("friction_share", None), w.graph.constant(0.0)
    return where(greater(share, zero), share * x, zero)


def _fails(w: KernelWriter) -> Scalar:
    """Return a scalar that is true if G(x) has not settled, or the determinant of the last factors is negative."""
    limit, half = w.read("rubbing", None) * LOAD_CHANGE_TOL**2, w.read("negative", None) * 0.5
    is_odd = greater(half - floor(half), w.graph.constant(0.25))
    return either(greater(w.read("misfit", None), limit), is_odd)


def _unsettled(w: KernelWriter) -> Scalar:
    """Return a scalar: one if x is no solution (`_fails`), else zero, plus two if any pivots are negative."""
    zero, one, two = map(w.graph.constant, (0.0, 1.0, 2.0))
    return where(_fails(w), one, zero) + where(greater(w.read("negative", None), zero), two, zero)


def _programs(group: ConstraintGroup) -> RubbingPrograms:
    assert group.rubbing is not None
    return group.rubbing
