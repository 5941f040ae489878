"""The scalar programs of a scene's structure: each computes its outputs, and nothing else."""

from collections.abc import Sequence
from functools import cached_property, lru_cache

from udkjax.equations.scalar_equations import ScalarEquations, scalar_equations
from udkjax.equations.structure import Shapes, TreeDef, structure
from udkjax.expressions import Scalar, ScalarProgram, frontier
from udkjax.expressions.selection import all_of
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.pinv.sparse import Row, SparseFactors, factorize, find_pattern, solve, transpose_times
from udkjax.scene.mechanism import Mechanism


class ScenePrograms:
    """Programs over the graph of a scene that need no elimination.

    Each takes the `constants`, t, q and v as one list of scalars. D is given by the distinct values of its entries; `pattern`
    holds their places.
    """

    def __init__(self, equations: ScalarEquations, baumgarte: bool):
        self.equations = equations
        graph = self.graph = equations.graph
        self.gains = [graph.input(name, "parameter") for name in ("alpha", "beta")] if baumgarte else []
        self.drop_tol = graph.input("drop_tol", "parameter")
        self.safe_tol = graph.input("safe_tol", "parameter")
        self.root = [graph.constant(1.0) / graph.sqrt(m) for m in equations.mass]
        self.coordinate_count, self.row_count = len(equations.q), len(equations.psi)
        self.D: list[Row] = [{k: entry * self.root[k] for k, entry in row.items()} for row in equations.psi_q]
        self.pattern, self.entries = find_pattern(self.D, self.coordinate_count)
        self._outputs: dict[str, list[Scalar]] = {
            "equation_terms": [*self.entries, *(self.b(i) for i in range(self.row_count)), *equations.free, *self.root],
            "closure_terms": [*self.entries, *equations.psi, *self.root],
            "psi": equations.psi,
            "psi_dot": equations.psi_dot,
            "pieces": equations.pieces,
            "energy": [equations.kinetic_energy, equations.potential_energy],
        }

    @cached_property
    def constants(self) -> list[Scalar]:
        """The inputs of the programs that depend on numbers of the scene alone: `prologue` computes them once a run."""
        return self._constants_of(self)

    def _constants_of(self, *programs: "ScenePrograms") -> list[Scalar]:
        wanted = [s for p in programs for outputs in p._outputs.values() for s in outputs]
        return frontier(self.graph, wanted, lambda node: node.depends <= {"parameter"})

    @cached_property
    def prologue(self) -> ScalarProgram:
        """The constants, from all numbers of the scene, the gains, `drop_tol` and `safe_tol` (in every kind of programs)."""
        inputs = [*self.equations.inputs, *self.gains, self.drop_tol, self.safe_tol]
        return ScalarProgram(self.graph, inputs, self.constants)

    @cached_property
    def equation_terms(self) -> ScalarProgram:
        """D, b, a_F and M^(-1/2), of all rows."""
        return self._program("equation_terms")

    @cached_property
    def closure_terms(self) -> ScalarProgram:
        """D, Psi and M^(-1/2), of all rows."""
        return self._program("closure_terms")

    @cached_property
    def psi(self) -> ScalarProgram:
        """Psi of all rows."""
        return self._program("psi")

    @cached_property
    def psi_dot(self) -> ScalarProgram:
        """Psi_dot of all rows."""
        return self._program("psi_dot")

    @cached_property
    def pieces(self) -> ScalarProgram:
        """The number of the smooth piece of each element that has several."""
        return self._program("pieces")

    @cached_property
    def energy(self) -> ScalarProgram:
        """The kinetic and the potential energy."""
        return self._program("energy")

    def _program(self, name: str, more: Sequence[Scalar] = ()) -> ScalarProgram:
        e = self.equations
        return ScalarProgram(self.graph, [*self.constants, e.t, *e.q, *e.v, *more], self._outputs[name])

    @property
    def term_count(self) -> int:
        """The number of values that `equation_terms` returns."""
        return len(self._outputs["equation_terms"])

    @property
    def drop_tol_index(self) -> int | None:
        """The index of `drop_tol` among the constants, or None."""
        return next((k for k, s in enumerate(self.constants) if s.index == self.drop_tol.index), None)

    def b(self, i: int) -> Scalar:
        """gamma - 2 alpha Psi_dot - beta^2 Psi - Psi_q a_F of one row."""
        e = self.equations
        b = e.gamma[i] - sum((entry * e.free[k] for k, entry in e.psi_q[i].items()), self.graph.constant(0.0))
        if self.gains:
            alpha, beta = self.gains
            b = b - alpha * 2.0 * e.psi_dot[i] - beta * beta * e.psi[i]
        return b


class EliminationPrograms(ScenePrograms):
    """Programs by elimination of D D^T of the independent rows, which treats small pivots by a `RankPolicy`.

    `safe`, their last output, is whether all pivots exceed `safe_tol`; always true where the policy does not report. Each program
    factorizes D D^T itself: to hand the factors from one to the next takes longer, and longer still to compile.
    """

    def __init__(
        self,
        equations: ScalarEquations,
        redundant_rows: tuple[int, ...],
        baumgarte: bool,
        policy: RankPolicy,
        constants_from: "EliminationPrograms | None" = None,
    ):
        super().__init__(equations, baumgarte)
        self.policy, self.redundant_rows = policy, redundant_rows
        self.independent_rows = [i for i in range(self.row_count) if i not in redundant_rows]
        self._eliminate()
        self._constants_from = constants_from
        # Derivatives are those of the rows that are left where dependent ones are dropped. Tangents of the constants are taken
        # once for both: they have the same.
        self.for_derivatives = self
        if policy is RankPolicy.REFUSE:
            self.for_derivatives = EliminationPrograms(equations, redundant_rows, baumgarte, RankPolicy.FALL_BACK, self)

    @cached_property
    def constants(self) -> list[Scalar]:
        if self._constants_from is not None:
            return self._constants_from.constants
        return self._constants_of(*dict.fromkeys((self, self.for_derivatives)))

    def _eliminate(self):
        """The equation for rows that are independent: a = a_F + M^(-1) Psi_q^T y with D D^T y = b."""
        graph, e, n = self.graph, self.equations, self.coordinate_count
        self.compliance = [r * r for r in self.root]
        rows = [self.D[i] for i in self.independent_rows]
        self._factors_dropping = factorize(rows, graph, self.drop_tol)
        self._factors = self._factors_dropping if self.policy.drops else factorize(rows, graph)
        self.y = self.solve_gram([self.b(i) for i in self.independent_rows])
        self.a = [f + s for f, s in zip(e.free, self.minv_jt(self.y), strict=True)]
        safe = self._safe(self._factors)  # looked at when all else is done: nothing waits for it
        self._outputs["accelerations"] = [*self.a, safe]
        psi, psi_dot = ([residual[i] for i in self.independent_rows] for residual in (e.psi, e.psi_dot))
        self._outputs["newton_q"] = [*self._correct(e.q, psi), self._safe(self._factors_dropping)]
        self._outputs["newton_v_and_psi"] = [*self._correct(e.v, psi_dot), *e.psi]
        closed = self._outputs["newton_q"][:n]
        there = graph.substitute([*psi_dot, *e.psi], dict(zip((x.index for x in e.q), closed, strict=True)))
        self._outputs["project"] = [*closed, *self._correct(e.v, there[: len(psi_dot)]), *there[len(psi_dot) :]]
        v = self._correct(e.v, psi_dot, dropping=False)
        projected = dict(zip((x.index for x in e.v), v, strict=True))
        loads = graph.substitute([*e.free, *(self.b(i) for i in self.independent_rows)], projected)
        a = [f + s for f, s in zip(loads[:n], self.minv_jt(self.solve_gram(loads[n:])), strict=True)]
        self._outputs["project_and_accelerate"] = [*v, *a, safe]
        self.changes = [graph.input(f"d{k}", "change") for k in range(2 * n)]
        self._outputs["tangent_part"] = [*self._tangent_part(dropping=True), self._factors_dropping.distance(graph)]
        self._outputs["end_of_step"] = [*v, *a, *self._tangent_part(dropping=False), self._factors.distance(graph), safe]

    # --- programs

    @cached_property
    def accelerations(self) -> ScalarProgram:
        """a; safe."""
        return self._program("accelerations")

    @cached_property
    def newton_q(self) -> ScalarProgram:
        """q after a Newton step to Psi = 0, without dependent rows; safe."""
        return self._program("newton_q")

    @cached_property
    def newton_v_and_psi(self) -> ScalarProgram:
        """v after the Newton step to Psi_dot = 0, without dependent rows; and Psi of all rows."""
        return self._program("newton_v_and_psi")

    @cached_property
    def project(self) -> ScalarProgram:
        """q and v after a Newton step to Psi = 0 and Psi_dot = 0 with the factors of D at the q before it; Psi of all rows there.

        Where the step in q is small, what it turns D by is a small part of the step in v, which is as small.
        """
        return self._program("project")

    @cached_property
    def project_and_accelerate(self) -> ScalarProgram:
        """v after the Newton step to Psi_dot = 0, and a there; safe."""
        return self._program("project_and_accelerate")

    @cached_property
    def tangent_part(self) -> ScalarProgram:
        """The parts of changes of q and v within the manifold (after v), without dependent rows; `SparseFactors.distance`."""
        return self._program("tangent_part", self.changes)

    @cached_property
    def end_of_step(self) -> ScalarProgram:
        """v, a and the tangent part of changes, all by the same factors; their distance; safe."""
        return self._program("end_of_step", self.changes)

    # --- operators, of the independent rows

    def solve_gram(self, b: Sequence[Scalar], dropping: bool = False) -> list[Scalar]:
        """y with D D^T y = b; zero for a row that was dropped, if `dropping` is asked for or the policy drops."""
        return solve(self._factors_dropping if dropping else self._factors, b) if b else []

    def jt(self, y: Sequence[Scalar]) -> list[Scalar]:
        """Psi_q^T y."""
        rows = [self.equations.psi_q[i] for i in self.independent_rows]
        return transpose_times(rows, y, self.coordinate_count, self.graph.constant(0.0))

    def minv_jt(self, y: Sequence[Scalar]) -> list[Scalar]:
        """M^(-1) Psi_q^T y."""
        return [c * s for c, s in zip(self.compliance, self.jt(y), strict=True)]

    def _correct(self, x: Sequence[Scalar], residual: Sequence[Scalar], dropping: bool = True) -> list[Scalar]:
        """x - M^(-1) Psi_q^T (D D^T)^(-1) residual: x corrected so that the residual vanishes."""
        return [c - s for c, s in zip(x, self.minv_jt(self.solve_gram(residual, dropping)), strict=True)]

    def _tangent_part(self, dropping: bool) -> list[Scalar]:
        rows, zero = [self.equations.psi_q[i] for i in self.independent_rows], self.graph.constant(0.0)
        found, n = [], self.coordinate_count
        for change in (self.changes[:n], self.changes[n:]):
            residual = [sum((entry * change[k] for k, entry in row.items()), zero) for row in rows]
            found += self._correct(change, residual, dropping)
        return found

    def _safe(self, factors: SparseFactors) -> Scalar:
        return all_of(factors.exceeding(self.safe_tol) if self.policy.reports else [], self.graph)


@lru_cache(maxsize=64)
def _scene_programs(tree: TreeDef, shapes: Shapes) -> ScenePrograms:
    return ScenePrograms(scalar_equations(tree, shapes), baumgarte=False)


@lru_cache(maxsize=64)
def _elimination_programs(
    tree: TreeDef, shapes: Shapes, redundant_rows: tuple[int, ...], baumgarte: bool, policy: RankPolicy
) -> EliminationPrograms:
    return EliminationPrograms(scalar_equations(tree, shapes), redundant_rows, baumgarte, policy)


def scene_programs(mechanism: Mechanism) -> ScenePrograms:
    """Return the programs without elimination of a mechanism's structure, whatever its numbers are."""
    return _scene_programs(*structure(mechanism))


def elimination_programs(
    mechanism: Mechanism, redundant_rows: tuple[int, ...], baumgarte: bool, policy: RankPolicy
) -> EliminationPrograms:
    """Return the programs by elimination of a mechanism's structure, whatever its numbers are.

    Args:
        mechanism: The scene; its numbers may be traced.
        redundant_rows: Rows of Psi that are left out (`Analysis.redundant_rows`).
        baumgarte: Whether the gains alpha and beta are fed back.
        policy: What is done with a small pivot.

    Returns:
        The programs; the same object for the same structure and settings.
    """
    return _elimination_programs(*structure(mechanism), redundant_rows, baumgarte, policy)
