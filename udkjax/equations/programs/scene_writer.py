"""The loops of one program of a scene: those of each output (`run_programs.OUTPUTS`), after the loops that it depends on.

sines, free, system, factors, solution     intermediate results: sines and cosines, a_F, Psi_q of the eliminated rows with the
                                           right-hand sides at the state, the elimination, and x of the accelerations
"""

from collections.abc import Callable, Iterable, Sequence

from udkjax.equations.elimination.scene_solver import SceneSolver
from udkjax.equations.terms.scene_layout import BODY_COORDINATES
from udkjax.equations.terms.scene_terms import ProgramParts, compliance
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, KernelWriter, LoopProgram, Reset

# The right-hand sides at the state of the linear systems of a program, with the results that need them.
RIGHT_SIDES = {
    "b": ("solution", "a", "a further", "a settled", "a refined"),
    "psi": ("q1", "q1 refined"),
    "psi_dot": ("v1", "v1 refined", "dq1 by value"),
}
Requires = tuple[str, ...]
Loops = Callable[[], Iterable[KernelLoop | Reset]]


class SceneWriter:
    """Writer of one program: it writes each output in turn, and each intermediate result once, before its first use.

    Linear systems, J M^(-1) J^T x = right with J = Psi_q, share the factors of one elimination. Their numbers begin with those of
    the right-hand sides at the state, which loops compute together with Psi_q.

    Args:
        solver: The linear systems of the scene.
        outputs: The outputs.
        drops: Whether elimination leaves out rows with small pivots.
    """

    def __init__(self, solver: SceneSolver, outputs: Sequence[str], drops: bool):
        self._solver, self._terms, self._outputs, self._drops = solver, solver.terms, outputs, drops
        has_friction = solver.friction is not None
        with_friction: Requires = ("solution",) if has_friction and "terms with friction" in outputs else ()
        self._rights = [right for right, users in RIGHT_SIDES.items() if not {*outputs, *with_friction}.isdisjoint(users)]
        self._solves = len(self._rights)
        self._table = self._terms_of_equations(with_friction) | self._results_of_elimination()

    def program(self) -> LoopProgram:
        """Return the program of the requested outputs."""
        parts: list[KernelLoop | Reset] = []
        written = set[str]()

        def write(names: Iterable[str]):
            for name in names:
                if name not in written:
                    needs, loops = self._table[name]
                    write(needs)
                    parts.extend(loops())
                    written.add(name)

        write(self._outputs)
        return LoopProgram(parts)

    def _terms_of_equations(self, with_friction: Requires) -> dict[str, tuple[Requires, Loops]]:
        """Return the terms of the equations by name: the results that each term needs first, and a function that makes its loops.

        `with_friction` are the results from which "free with friction" follows; empty: it is the same as "free".
        """
        terms = self._terms
        return {
            "sines": ((), lambda: [terms.sincos()]),
            "sines at q1": (("q1",), lambda: [terms.sincos("q1", "sines1")]),
            "free": (("sines",), lambda: terms.free_accelerations("v")),
            "psi": (("sines",), lambda: terms.row_terms("psi", "psi")),
            "psi at q1": (("sines at q1",), lambda: terms.row_terms("psi", "psi", q="q1", sines="sines1")),
            "psi_dot": (("sines",), lambda: terms.row_terms("psi_dot", "psi_dot")),
            **dict.fromkeys(("psi_q", "psi_q of q"), (("sines",), terms.every_entry)),
            **dict.fromkeys(("root", "root of q"), ((), self._root)),
            "couplings": ((), tuple),
            "free with friction": (with_friction or ("free",), self._add_friction if with_friction else tuple),
            "terms": (("free",), self._equation_terms),
            "terms with friction": (("free with friction",), self._equation_terms),
            "energy": (("sines",), terms.energy),
            "pieces": (("sines",), terms.pieces),
        }

    def _results_of_elimination(self) -> dict[str, tuple[Requires, Loops]]:
        terms, solver, elimination = self._terms, self._solver, self._solver.elimination
        by_value = "dq1 by value" in self._outputs
        of_system = (*(["rest"] if by_value else []), "sines", *(["free"] if "b" in self._rights else []))
        accelerate = (("solution",), lambda: [terms.add("a", start="free", solution=0)])
        return {
            "rest": ((), lambda: [Reset("rest", 0, terms.layout.coordinate_count)]),
            "system": (of_system, lambda: terms.element_terms(("psi_q", *self._rights), "rest" if by_value else "v")),
            "factors": (("system",), lambda: elimination.factorize(self._drops)),
            "safe": (("factors",), lambda: [solver.safe]),
            "distance": (("factors",), lambda: [elimination.distance()]),
            "independent": (("factors",), elimination.independent),
            "rank": ((), elimination.rank),
            "solution": (("factors",), self._solve_accelerations),
            **dict.fromkeys(("a", "a further", "a settled"), accelerate),
            "unsettled": ((), tuple),  # the solution reports it
            "a at v1": (("v1",), self._accelerate_at_v1),
            "multipliers": (("solution",), lambda: terms.multipliers(0)),
            "friction_power": (("solution",), lambda: terms.friction_power(0)),
            "q1": (("factors",), lambda: self._correct("q", self._rights.index("psi"))),
            "v1": (("factors",), lambda: self._correct("v", self._rights.index("psi_dot"))),
            "v1 at q1": (("sines at q1",), self._correct_velocity_at_q1),
            "all refined": (("factors",), self._refine),
            **dict.fromkeys(("a refined", "q1 refined", "v1 refined"), (("all refined",), tuple)),
            "dq1": (("factors",), lambda: self._tangent_part("dq")),
            "dv1": (("factors",), lambda: self._tangent_part("dv")),
            "balance": (("free", "factors"), self._balance),
            "dq1 by value": (("factors",), lambda: [*solver.solve(0), terms.add("dq1", solution=0, sign=-1)]),
            "dv1 by value": (("dq1 by value",), self._second_derivative),
        }

    def _next_solve(self) -> int:
        """Return the number of a linear system that the program does not use yet."""
        self._solves += 1
        return self._solves - 1

    def _equation_terms(self) -> ProgramParts:
        yield self._terms.add("terms", start="free")
        yield from self._terms.row_terms("b", "terms", self._terms.layout.coordinate_count)

    def _root(self) -> ProgramParts:
        """Yield the loop that computes the diagonal of M^(-1/2) in `root`."""

        def write(w: KernelWriter):
            for k in range(3):
                w.write(w.graph.sqrt(compliance(w, k)), "root", BODY_COORDINATES, k)

        yield self._terms.over_bodies("root", write)

    def _add_friction(self) -> ProgramParts:
        """Yield loops that add the friction that depends on x = -lambda to a_F."""
        assert self._solver.friction is not None
        yield Reset("jt_x0", 0, self._terms.layout.coordinate_count)
        yield from self._solver.friction.add_loads(0)
        yield self._terms.add("free", solution=0, update=ADD)

    def _solve_accelerations(self) -> ProgramParts:
        """Return the loops that solve the system of the accelerations for x and jt_x, including friction that depends on x."""
        friction = self._solver.friction
        if friction is not None and "a further" in self._outputs:
            return friction.further(0)
        if friction is not None and "a settled" in self._outputs:
            return friction.settled(0)
        return self._solver.accelerating_solve(0, reports="unsettled" in self._outputs)

    def _accelerate_at_v1(self) -> ProgramParts:
        terms, solve = self._terms, self._next_solve()
        yield from terms.free_accelerations("v1")
        yield from terms.element_terms(("b",), "v1", solve)
        yield from self._solver.accelerating_solve(solve, "v1", reports="unsettled" in self._outputs)
        yield terms.add("a", start="free", solution=solve)

    def _correct(self, x: str, solve: int) -> ProgramParts:
        """Yield loops that compute x - M^(-1) Psi_q^T y, with y the solution of a linear system, in the array "q1" for x = "q".

        `x` is the name of an array: "q" or "v", whose linearized residual then vanishes, or a change of these, "dq" or "dv".
        """
        yield from self._solver.solve(solve)
        yield self._terms.add(f"{x}1", start=x, solution=solve, sign=-1)

    def _correct_velocity_at_q1(self) -> ProgramParts:
        solve = self._next_solve()
        yield from self._terms.element_terms(("psi_dot",), "v", solve, q="q1", sines="sines1")
        yield from self._correct("v", solve)

    def _refine(self) -> ProgramParts:
        """Yield loops that compute a, q1 and v1 by refined solutions of the linear systems 0, 1 and 2."""
        terms, correction = self._terms, self._next_solve()
        yield from self._solver.accelerating_solve(0, refined_by=correction)
        for solve in (1, 2):
            yield from self._solver.refined_solve(solve, correction)
        yield terms.add("a", start="free", solution=0)
        for solve, x in enumerate("qv", 1):
            yield terms.add(f"{x}1", start=x, solution=solve, sign=-1)

    def _tangent_part(self, change: str) -> ProgramParts:
        """Yield loops that compute the tangent part of the change "dq" or "dv" of the state."""
        solve = self._next_solve()
        yield from self._terms.rates(change, solve, of_positions=change == "dq")
        yield from self._correct(change, solve)

    def _balance(self) -> ProgramParts:
        """Yield loops that compute a_F as `dv`, its tangent part, and the multipliers of the rest of the loads."""
        solve = self._next_solve()
        yield self._terms.add("dv", start="free")
        yield from self._terms.rates("dv", solve)
        yield from self._correct("dv", solve)
        yield from self._terms.multipliers(solve)

    def _second_derivative(self) -> ProgramParts:
        solve = self._next_solve()
        yield from self._terms.element_terms(("gamma",), "dq1", solve)
        yield from self._solver.solve(solve)
        yield self._terms.add("dv1", solution=solve)
