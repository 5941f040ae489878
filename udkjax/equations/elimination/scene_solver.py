"""The linear systems of a scene as sequences of loops, which its programs share."""

from collections.abc import Iterable

from udkjax.equations.elimination.block_elimination import BlockElimination
from udkjax.equations.elimination.friction_elimination import FrictionElimination
from udkjax.equations.terms.scene_terms import ProgramParts, SceneTerms
from udkjax.expressions.loops.loop_program import ADD, KernelLoop, LoopProgram, Reset
from udkjax.pinv.rank_policy import RankPolicy

# Number of corrections of a solution by its residual. Each removes the rounding errors of the factors if eps times the square of
# the condition number of the rows is below one.
REFINEMENTS = 2


class SceneSolver:
    """Loops for the linear systems of a scene, J M^(-1) J^T x = right with J = Psi_q, by elimination.

    The systems of each program are numbered from zero. The `policy` for small pivots concerns the accelerations; corrections
    leave out rows whose pivots do not exceed `drop_tol` times their diagonal entries.
    """

    def __init__(self, terms: SceneTerms, policy: RankPolicy):
        self.terms, self.policy = terms, policy
        self.elimination = BlockElimination(terms)
        self.friction = FrictionElimination(terms, self.elimination) if terms.layout.rubbing else None
        self.solve = self.elimination.solve

    @property
    def factorize(self) -> ProgramParts:
        """The loops of the factorization for accelerations, under the policy."""
        return self.elimination.factorize(self.policy.drops)

    def accelerating_solve(self, solve: int, v: str = "v", refined_by: int | None = None, reports: bool = False) -> ProgramParts:
        """Yield loops that solve a system with the right-hand side b for x and jt_x, including friction that depends on x.

        Args:
            solve: Number of the system.
            v: Array of the velocities.
            refined_by: Number of a system that serves for iterative refinement; None: the solution is not refined.
            reports: Whether friction takes one round only, and `unsettled` tells if this suffices.
        """
        yield from self.solve(solve) if refined_by is None else self.refined_solve(solve, refined_by)
        if self.friction is not None:
            yield from self.friction.settle(solve, v, reports)

    @property
    def factorize_dropping(self) -> ProgramParts:
        """The loops of the factorization for corrections, which leaves out rows that depend on others."""
        return self.elimination.factorize(True)

    @property
    def safe(self) -> KernelLoop | Reset:
        """The loop that sets `safe`: one if all pivots exceed `safe_tol`, or if the policy does not check them."""
        return self.elimination.safe() if self.policy.reports else Reset("safe", 0, 1, 1.0)

    def position_terms(self, *outputs: str, v: str = "v") -> list[KernelLoop | Reset]:
        """Return the loops that compute sines and cosines, and outputs that do not depend on forces (see `element_terms`)."""
        return [self.terms.sincos(), *self.terms.element_terms(outputs, v)]

    @property
    def acceleration_system(self) -> list[KernelLoop | Reset]:
        """The loops that compute Psi_q, a_F, and b as the right-hand side of the system 0."""
        return [self.terms.sincos(), *self.terms.free_accelerations("v"), *self.terms.element_terms(("psi_q", "b"))]

    def refined_solve(self, solve: int, correction: int) -> ProgramParts:
        """Yield loops that solve a system with iterative refinement (corrected seminormal equations, Bjorck 1987).

        Only jt_x is refined. `correction` is the number of a system for the corrections, whose right-hand side is the residual.
        """
        yield from self.solve(solve)
        for _ in range(REFINEMENTS):
            yield from self.terms.remainder(solve, correction)
            yield from self.solve(correction)
            yield self.terms.add(f"jt_x{solve}", start=f"jt_x{correction}", update=ADD)


def program(*sequences: Iterable[KernelLoop | Reset]) -> LoopProgram:
    """Return the program of several sequences of loops, one after another."""
    return LoopProgram([loop for loops in sequences for loop in loops])
