"""The programs of a scene: each computes its results, and nothing else.

Terms come from loops over elements of the same structure (scene_terms.py), linear systems from elimination by blocks
(block_elimination.py, scene_solver.py), and derivatives from loops, too (differentiable_programs.py). The programs of small
scenes are unrolled (unrolled.py).
"""

from collections.abc import Hashable
from functools import cached_property, lru_cache

import jax
import numpy as np

from udkjax.annotations import TreeDef
from udkjax.equations.differentiable_programs import DifferentiablePrograms
from udkjax.equations.scale_program import ROWS, ScaleProgram, write_scales
from udkjax.equations.scene_layout import BODY_COORDINATES, DROP_TOL, RIGHT, ROW, SceneLayout, abstract_mechanism
from udkjax.equations.scene_prologue import write_prologue
from udkjax.equations.scene_solver import SceneSolver, program
from udkjax.equations.scene_terms import SceneTerms, compliance
from udkjax.equations.structure import LeafShapes, structure, whole_structure
from udkjax.expressions.loop_program import Kernel, KernelLoop, KernelWriter, LoopProgram, Reset
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism

# Operations of the accelerations up to which programs are unrolled. Unrolled programs evaluate faster up to several times this
# size, but tracing and compiling them takes longer the larger the scene is (python -m benchmarks scaling).
UNROLLED_SCENE_OPERATIONS = 2800

# The arrays that programs return; all others are scratch.
RESULTS = tuple("a q1 v1 dq1 dv1 psi psi_dot terms rank distance safe pieces root energy independent multipliers".split())


class ScenePrograms:
    """Programs over arrays of numbers: the results `RESULTS` from constants, t, q, v, dq and dv, as each needs them.

    Intermediate results of a program stay in arrays of its own, of the sizes `scratch`: no number is written again once it has
    been read. `safe` is whether all pivots exceed `safe_tol`, `distance` the root of the smallest pivot relative to its diagonal
    entry: the distance from dependence. The `policy` for small pivots concerns the accelerations; corrections leave
    out the rows whose pivots do not exceed `drop_tol`.
    """

    def __init__(
        self,
        tree: TreeDef,
        shapes: LeafShapes,
        redundant_rows: tuple[int, ...] | None,
        baumgarte: bool,
        policy: RankPolicy,
        every_row: bool = False,
        kernels: dict[Hashable, Kernel] | None = None,
    ):
        self._settings = tree, shapes, redundant_rows, baumgarte
        self._kernels = {} if kernels is None else kernels
        self.policy, self.redundant_rows = policy, redundant_rows
        layout = self._layout = SceneLayout(abstract_mechanism(tree, shapes), redundant_rows, baumgarte, every_row)
        self._terms = SceneTerms(layout, self._kernels)
        self._solver = SceneSolver(self._terms, policy)
        self.scratch, self.row_names = layout.sizes, layout.row_names
        self.coordinate_count, self.row_count = layout.coordinate_count, layout.row_count
        self.constants = range(layout.constant_count)
        starts = np.cumsum([0, *(int(np.prod(shape)) for shape, _ in shapes)])
        places = [np.arange(a, b).reshape(s) for a, b, (s, _) in zip(starts, starts[1:], shapes, strict=False)]
        self._number_count = int(starts[-1])
        self._places: Mechanism = jax.tree.unflatten(tree, places)  # where each number of the scene is among all of them

    @property
    def stored_sizes(self) -> dict[str, int]:
        """The sizes of all arrays that derivatives may need of a state."""
        n = self.coordinate_count
        return self.scratch | {"q1": n, "v1": n}

    @property
    def term_count(self) -> int:
        """The number of values that `equation_terms` returns."""
        return self.coordinate_count + self.row_count

    @property
    def scale_count(self) -> int:
        """The number of values that `scales` returns."""
        return ROWS + self.row_count

    @property
    def piece_count(self) -> int:
        """The number of elements that are smooth in pieces of the state."""
        return self.scratch["pieces"]

    @cached_property
    def is_small(self) -> bool:
        """True if the programs are unrolled because the accelerations take few operations."""
        loops = [part for part in self.accelerations.parts if isinstance(part, KernelLoop)]
        return sum(len(part.table) * part.kernel.operation_count for part in loops) <= UNROLLED_SCENE_OPERATIONS

    @property
    def drop_tol_index(self) -> int:
        """The index of `drop_tol` among the constants."""
        return DROP_TOL

    @property
    def number_count(self) -> int:
        """The number of values that `prologue` takes: all numbers of the scene, gains, marks of rows, `drop_tol`, `safe_tol`."""
        return self._number_count + self._layout.gains + self._layout.marks + 2

    @property
    def marks_rows(self) -> bool:
        """True if numbers mark redundant rows: a mark for each row of Psi, one where it is independent."""
        return self._layout.marks > 0

    @cached_property
    def for_derivatives(self) -> "ScenePrograms":
        """The programs whose derivatives are taken: those of the rows that are left where dependent ones are dropped."""
        if self.policy.drops:
            return self
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, kernels=self._kernels)

    @cached_property
    def with_all_rows(self) -> "ScenePrograms":
        """The same programs, of the same constants, on all rows: redundant ones may be independent in singular configurations."""
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, every_row=True, kernels=self._kernels)

    # --- programs

    @cached_property
    def accelerations(self) -> LoopProgram:
        """a; safe."""
        solver = self._solver
        solve = [*solver.factorize, *solver.solve(), self._terms.add("a", start="free", solution=0), solver.safe]
        return program(solver.acceleration_system, solve)

    @cached_property
    def multipliers(self) -> LoopProgram:
        """lambda as multipliers, of all rows; a; safe."""
        return program(self.accelerations.parts, self._terms.multipliers(0))

    @cached_property
    def newton_q(self) -> LoopProgram:
        """q1, q after a Newton step to Psi = 0; safe."""
        return program(self._solver.newton("psi", "q"), [self._solver.safe])

    @cached_property
    def newton_v_and_psi(self) -> LoopProgram:
        """v1, v after the Newton step to Psi_dot = 0; and psi, of all rows."""
        return program(self._solver.newton("psi_dot", "v"), self._terms.row_terms("psi", "psi"))

    @cached_property
    def corrections_and_accelerations(self) -> LoopProgram:
        """q1 and v1, corrected by a Newton step each, and a: the three of one state, by the same factors."""
        terms, solver, right = self._terms, self._solver, ("b", "psi", "psi_dot")
        system = [terms.sincos(), *terms.free_accelerations("v"), *terms.element_terms(("psi_q", *right))]
        solves = [part for k in range(3) for part in solver.refined_solve(k, 3)]
        corrected = [terms.add(f"{x}1", start=x, solution=k, sign=-1) for k, x in enumerate("qv", 1)]
        return program(system, solver.factorize_dropping, solves, [terms.add("a", start="free", solution=0), *corrected])

    @cached_property
    def project(self) -> LoopProgram:
        """q1 and v1 after a Newton step to Psi = 0 and Psi_dot = 0 with the factors of Psi_q at the q before it; psi at q1.

        Where the step in q is small, what it turns Psi_q by is a small part of the step in v, which is as small.
        """
        return program(self._solver.project, self._terms.row_terms("psi", "psi", q="q1", sines="sines1"))

    @cached_property
    def project_and_accelerate(self) -> LoopProgram:
        """v1, and a there; safe."""
        return program(self._solver.project_and_accelerate)

    @cached_property
    def tangent_part(self) -> LoopProgram:
        """dq1 and dv1: the parts of the changes dq and dv within the manifold; distance."""
        return program(self._solver.position_terms("psi_q"), self._solver.factorize_dropping, self._solver.tangent_parts(0))

    @cached_property
    def end_of_step(self) -> LoopProgram:
        """The results of `project_and_accelerate` and `tangent_part`, by the same factors."""
        return program(self._solver.project_and_accelerate, self._solver.tangent_parts(2))

    @cached_property
    def psi(self) -> LoopProgram:
        """psi: Psi of all rows."""
        return program([self._terms.sincos()], self._terms.row_terms("psi", "psi"))

    @cached_property
    def psi_dot(self) -> LoopProgram:
        """psi: Psi_dot of all rows."""
        return program([self._terms.sincos()], self._terms.row_terms("psi_dot", "psi"))

    @cached_property
    def equation_terms(self) -> LoopProgram:
        """terms: a_F, and b of all rows."""
        terms = self._terms
        free = [terms.sincos(), *terms.free_accelerations("v"), terms.add("terms", start="free")]
        return program(free, terms.row_terms("b", "terms", self.coordinate_count))

    @cached_property
    def geometry(self) -> LoopProgram:
        """psi, psi_dot and psi_q, of all rows."""
        terms = self._terms
        rows = [*terms.row_terms("psi", "psi"), *terms.row_terms("psi_dot", "psi_dot")]
        return program([terms.sincos(), *terms.every_entry()], rows)

    @property
    def psi_q_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of Psi_q: their rows, columns, places in the array `psi_q`, and factors."""
        return self._layout.psi_q_entries

    @property
    def constant_entry(self) -> int:
        """The place in `psi_q` of the one that entries refer to which are constants."""
        return self._layout.one

    @property
    def eliminated_rows(self) -> dict[int, int]:
        """The places of the rows of Psi in the linear systems, of those that are not left out."""
        found = {}
        for group in self._layout.eliminated:
            for start, right in zip(group.table[:, ROW].tolist(), group.table[:, RIGHT].tolist(), strict=True):
                found |= {start + row: right + k for k, row in enumerate(group.rows)}
        return found

    @cached_property
    def rows_and_loads(self) -> LoopProgram:
        """Inputs of rank-revealing methods, of all rows: psi_q, psi, psi_dot, terms; and root, M^(-1/2)."""
        psi_dot = self._terms.row_terms("psi_dot", "psi_dot")
        return program(self.equation_terms.parts, self.rows("psi"), psi_dot)

    @cached_property
    def dense_accelerations(self) -> LoopProgram:
        """The terms of accelerations by a dense pseudoinverse: psi_q of all rows, terms and root."""
        return program(self.equation_terms.parts, self._terms.every_entry(), [self._root])

    @cached_property
    def dense_newton_q(self) -> LoopProgram:
        """The terms of a Newton step to Psi = 0: psi_q and psi of all rows, and root."""
        return program([self.sincos], self.rows("psi"))

    @cached_property
    def dense_newton_v(self) -> LoopProgram:
        """The terms of a Newton step to Psi_dot = 0: psi_q of all rows, Psi_dot as psi, and root."""
        return program([self.sincos], self.rows("psi_dot"))

    @property
    def sincos(self) -> KernelLoop:
        """The sines and cosines of a state."""
        return self._terms.sincos()

    def rows(self, residual: str) -> list[KernelLoop | Reset]:
        """Return Psi_q, Psi or Psi_dot as psi, of all rows, and root, M^(-1/2); of a state whose sines are known."""
        return [*self._terms.every_entry(), *self._terms.row_terms(residual, "psi"), self._root]

    @property
    def _root(self) -> KernelLoop:
        """M^(-1/2)."""

        def write(w: KernelWriter):
            for k in range(3):
                w.write(w.graph.sqrt(compliance(w, k)), "root", BODY_COORDINATES, k)

        return self._terms.over_bodies("root", write)

    @cached_property
    def pieces(self) -> LoopProgram:
        """pieces: the number of the smooth piece of each element that has several."""
        return program([self._terms.sincos()], self._terms.pieces())

    @cached_property
    def energy(self) -> LoopProgram:
        """energy: kinetic and potential energy (J); that of gravity is zero at the origin."""
        return program([self._terms.sincos()], self._terms.energy())

    @cached_property
    def rank(self) -> LoopProgram:
        """rank: how many rows the last factorization did not leave out."""
        return program(self._solver.elimination.rank())

    @cached_property
    def independent_rows(self) -> LoopProgram:
        """independent: one for each row of Psi that elimination does not leave out, zero for those that depend on others."""
        solver = self._solver
        return program(solver.position_terms("psi_q"), solver.factorize_dropping, solver.elimination.independent())

    @cached_property
    def value_derivatives(self) -> LoopProgram:
        """Of a mechanism whose time is a driver's value: q' and q'' as dq1 and dv1; psi of all rows; distance.

        They solve Psi_q q' = -Psi_t and Psi_q q'' = gamma, which is of the velocities q'.
        """
        terms, solver, solve, count = self._terms, self._solver, self._solver.solve, self.coordinate_count
        at_rest = [Reset("rest", 0, count), *solver.position_terms("psi_q", "psi_dot", v="rest"), *solver.factorize]
        first = [*solve(0), terms.add("dq1", solution=0, sign=-1), *terms.element_terms(("gamma",), "dq1", 1)]
        second = [*solve(1), terms.add("dv1", solution=1), *terms.row_terms("psi", "psi"), solver.elimination.distance()]
        return program(at_rest, first, second)

    @cached_property
    def prologue(self) -> LoopProgram:
        """`constants`, from `numbers`: all numbers of the scene, the gains, the marks of rows, `drop_tol` and `safe_tol`."""
        return write_prologue(self._layout, self._places, self._number_count)

    @cached_property
    def scales(self) -> ScaleProgram:
        """scales, from `numbers`, those of the scene and the two thresholds: the characteristic scales of the guess."""
        return write_scales(self._terms, self._places, self._number_count, self.prologue)

    @cached_property
    def differentiable(self) -> DifferentiablePrograms:
        """The programs whose derivatives are taken."""
        return DifferentiablePrograms(self._solver)


@lru_cache(maxsize=16)
def _scene_programs(
    tree: TreeDef, shapes: LeafShapes, redundant_rows: tuple[int, ...] | None, baumgarte: bool, policy: RankPolicy
) -> ScenePrograms:
    return ScenePrograms(tree, shapes, redundant_rows, baumgarte, policy)


def scene_programs(
    mechanism: Mechanism,
    redundant_rows: tuple[int, ...] | None = (),
    baumgarte: bool = False,
    policy: RankPolicy = RankPolicy.DROP,
    in_pieces: bool = True,
) -> ScenePrograms:
    """Return the programs of a mechanism's structure, whatever its numbers are.

    Args:
        mechanism: The scene; its numbers may be traced.
        redundant_rows: Rows of Psi that are left out (`Analysis.redundant_rows`); None: marks among the numbers tell which.
        baumgarte: Whether the gains alpha and beta are fed back.
        policy: Policy for small pivots.
        in_pieces: Whether the numbers are those of `Mechanism.at` a time, or all samples and knots.

    Returns:
        The programs; the same object for the same structure and settings.
    """
    of = structure(mechanism) if in_pieces else whole_structure(mechanism)
    return _scene_programs(*of, redundant_rows, baumgarte, policy)
