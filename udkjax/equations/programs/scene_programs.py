"""The programs of a scene: each computes only its results.

Terms come from loops over elements of the same structure (scene_terms.py), linear systems from elimination by blocks
(block_elimination.py, scene_solver.py), and derivatives from loops, too (differentiable_programs.py). The programs of small
scenes are unrolled (unrolled.py).
"""

from collections.abc import Hashable
from functools import cached_property, lru_cache

import jax
import numpy as np

from udkjax.annotations import TreeDef
from udkjax.equations.elimination.scene_solver import SceneSolver, program
from udkjax.equations.programs.differentiable_programs import DifferentiablePrograms
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.terms.rest_program import RestProgram, write_rest_program
from udkjax.equations.terms.scale_program import ROWS, ScaleProgram, write_scales
from udkjax.equations.terms.scene_layout import (
    BODY_COORDINATES,
    DROP_TOL,
    RIGHT,
    ROW,
    SAFE_TOL,
    LoadShares,
    SceneLayout,
    abstract_mechanism,
)
from udkjax.equations.terms.scene_prologue import write_prologue
from udkjax.equations.terms.scene_terms import SceneTerms, compliance
from udkjax.equations.terms.structure import LeafShapes, structure, whole_structure
from udkjax.expressions.loops.loop_program import Kernel, KernelLoop, KernelWriter, LoopProgram, Reset
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism

# Programs are unrolled if the accelerations need at most this many operations. Up to several times this number unrolled programs
# run faster, but tracing and compiling them takes longer the larger the scene is (python -m benchmarks scaling).
UNROLLED_SCENE_OPERATIONS = 2800


class ScenePrograms(RunPrograms):
    """The programs of a scene.

    Intermediate results are stored in arrays of the sizes `scratch`; no number is overwritten after it has been read.
    """

    def __init__(
        self,
        tree: TreeDef,
        shapes: LeafShapes,
        redundant_rows: tuple[int, ...] | None,
        baumgarte: bool,
        policy: RankPolicy,
        sharing: LoadShares = LoadShares.NONE,
        every_row: bool = False,
        kernels: dict[Hashable, Kernel] | None = None,
    ):
        self._settings, self._sharing = (tree, shapes, redundant_rows, baumgarte), sharing
        self._kernels = {} if kernels is None else kernels
        self.policy, self.redundant_rows = policy, redundant_rows
        self.weighs_rows, self.shares_by_marks = sharing.weighs, sharing is LoadShares.MARKED
        self._with_shared_rows: dict[tuple[int, ...], ScenePrograms] = {}
        layout = self._layout = SceneLayout(abstract_mechanism(tree, shapes), redundant_rows, baumgarte, every_row, sharing)
        self._terms = SceneTerms(layout, self._kernels)
        self._solver = SceneSolver(self._terms, policy)
        self.scratch, self.row_names, self.has_piecewise_loads = layout.sizes, layout.row_names, layout.has_piecewise_loads
        self.coordinate_count, self.row_count = layout.coordinate_count, layout.row_count
        self.scale_count = ROWS + self.row_count  # the number of values that `scales` returns
        self.rolling_rows = layout.rolling_rows
        self.constants = range(layout.constant_count)
        starts = np.cumsum([0, *(int(np.prod(shape)) for shape, _ in shapes)])
        places = [np.arange(a, b).reshape(s) for a, b, (s, _) in zip(starts, starts[1:], shapes, strict=False)]
        self._number_count = int(starts[-1])
        self._places: Mechanism = jax.tree.unflatten(tree, places)  # the index of each number of the scene

    def with_unit_masses(self, numbers: np.ndarray, length: float) -> np.ndarray:
        """Return the vector of all numbers with bodies of 1 kg and a radius of gyration (m)."""
        numbers = numbers.copy()
        for body in self._places.bodies.values():
            numbers[body.mass], numbers[body.inertia] = 1.0, length**2
        return numbers

    @property
    def stored_sizes(self) -> dict[str, int]:
        """The sizes of all arrays of a state that derivatives may need."""
        n = self.coordinate_count
        return {x: size for x, size in self.scratch.items() if x not in RunPrograms.BEGINS} | {"q1": n, "v1": n}

    @property
    def piece_count(self) -> int:
        """The number of piecewise smooth elements."""
        return self.scratch["pieces"]

    @cached_property
    def is_small(self) -> bool:
        """True if the programs are unrolled because the accelerations take few operations.

        Friction does not count, but the shares of redundant rows in its loads do.
        """
        solver = self._solver
        parts = [*solver.acceleration_system, *solver.factorize, *solver.solve(), self._terms.add("a", start="free", solution=0)]
        if solver.friction is not None:
            parts += [*solver.friction.sharing.find_null_space(), *solver.friction.sharing.find_border()]
        loops = [loop for loop in parts if isinstance(loop, KernelLoop)]
        return sum(len(loop.table) * loop.kernel.operation_count for loop in loops) <= UNROLLED_SCENE_OPERATIONS

    @property
    def drop_tol_index(self) -> int:
        """The index of `drop_tol` among the constants."""
        return DROP_TOL

    @property
    def safe_tol_index(self) -> int:
        """The index of `safe_tol` among the constants."""
        return SAFE_TOL

    @property
    def number_count(self) -> int:
        """The number of inputs of `prologue`: all numbers of the scene, gains, marks or weights of rows, and two thresholds."""
        return self._number_count + self._layout.gains + self._layout.marks + 2

    @property
    def marks_rows(self) -> bool:
        """True if numbers mark redundant rows: one mark for each row of Psi, which is one if the row is independent.

        If redundant rows share the loads of joints with friction, these numbers are the weights of all rows.
        """
        return self._layout.marks > 0

    @cached_property
    def for_derivatives(self) -> "ScenePrograms":
        """The programs that are differentiated: these if the policy drops rows, else those with the policy `FALL_BACK`."""
        if self.policy.drops:
            return self
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, self._sharing, kernels=self._kernels)

    @cached_property
    def with_all_rows(self) -> "ScenePrograms":
        """The same programs and constants with all rows: redundant rows may be independent in singular configurations."""
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, self._sharing, every_row=True, kernels=self._kernels)

    def with_shared_rows(self, rows: tuple[int, ...]) -> "ScenePrograms":
        if rows not in self._with_shared_rows:
            tree, shapes, unknown, baumgarte = self._settings
            left_out, sharing = (rows, LoadShares.SWITCHED) if rows else (unknown, LoadShares.NONE)
            self._with_shared_rows[rows] = _scene_programs(tree, shapes, left_out, baumgarte, self.policy, sharing)
        return self._with_shared_rows[rows]

    # --- programs

    @property
    def rubs(self) -> bool:
        """True if friction depends on the loads of joints: programs may then report that these are `unsettled`."""
        return self._solver.friction is not None

    @cached_property
    def accelerations(self) -> LoopProgram:
        """Compute a; set safe, and unsettled."""
        return self._accelerations(reports=True)

    @cached_property
    def settled_accelerations(self) -> LoopProgram:
        """Compute a; set safe."""
        return self._accelerations(reports=False)

    @cached_property
    def accelerations_further(self) -> LoopProgram:
        """Compute a by another round of Newton's method for the loads of joints with friction; set unsettled."""
        solver, friction = self._solver, self._solver.friction
        assert friction is not None
        solve = [*solver.factorize, *friction.further(0), self._terms.add("a", start="free", solution=0)]
        return program(solver.acceleration_system, solve)

    def _accelerations(self, reports: bool) -> LoopProgram:
        solver = self._solver
        solve = [
            *solver.factorize,
            *solver.accelerating_solve(0, reports=reports),
            self._terms.add("a", start="free", solution=0),
        ]
        return program(solver.acceleration_system, solve, [solver.safe])

    @cached_property
    def accelerations_and_drift(self) -> LoopProgram:
        """Compute a, psi of all rows, and distance; set safe."""
        drift = [*self._terms.row_terms("psi", "psi"), self._solver.elimination.distance()]
        return program(self.accelerations.parts, drift)

    @cached_property
    def drift(self) -> LoopProgram:
        """Compute psi of all rows, and distance."""
        distance = [*self._solver.factorize_dropping, self._solver.elimination.distance()]
        return program(self._solver.position_terms("psi_q"), distance, self._terms.row_terms("psi", "psi"))

    @cached_property
    def multipliers(self) -> LoopProgram:
        """Compute multipliers, the lambda of all rows, and a; set safe."""
        return program(self.settled_accelerations.parts, self._terms.multipliers(0))

    @cached_property
    def multipliers_of_settled(self) -> LoopProgram:
        """Compute the results of `multipliers`; the loads of joints with friction have `settled` before."""
        solver, friction = self._solver, self._solver.friction
        if friction is None:
            return self.multipliers
        solve = [*solver.factorize, *friction.settled(0), self._terms.add("a", start="free", solution=0)]
        return program(solver.acceleration_system, solve, [solver.safe], self._terms.multipliers(0))

    @cached_property
    def accelerations_and_friction(self) -> LoopProgram:
        """Compute a, and friction_power, the power of all friction (W); set safe."""
        return program(self.settled_accelerations.parts, self._terms.friction_power(0))

    @cached_property
    def newton_q(self) -> LoopProgram:
        """Compute q1, q after a Newton step to Psi = 0; set safe."""
        return program(self._solver.newton("psi", "q"), [self._solver.safe])

    @cached_property
    def newton_q_and_distance(self) -> LoopProgram:
        """Compute q1, q after a Newton step to Psi = 0, the psi of all rows at q, and distance."""
        terms, solver = self._terms, self._solver
        return program(solver.newton("psi", "q", dropping=False), [solver.elimination.distance()], terms.row_terms("psi", "psi"))

    @cached_property
    def newton_v_and_psi(self) -> LoopProgram:
        """Compute v1, v after the Newton step to Psi_dot = 0, and psi of all rows."""
        return program(self._solver.newton("psi_dot", "v"), self._terms.row_terms("psi", "psi"))

    @cached_property
    def corrections_and_accelerations(self) -> LoopProgram:
        """Compute q1 and v1, each after a Newton step, and a, all from one factorization."""
        terms, solver, right = self._terms, self._solver, ("b", "psi", "psi_dot")
        system = [terms.sincos(), *terms.free_accelerations("v"), *terms.element_terms(("psi_q", *right))]
        solves = [*solver.accelerating_solve(0, refined_by=3), *(loop for k in (1, 2) for loop in solver.refined_solve(k, 3))]
        corrected = [terms.add(f"{x}1", start=x, solution=k, sign=-1) for k, x in enumerate("qv", 1)]
        return program(system, solver.factorize_dropping, solves, [terms.add("a", start="free", solution=0), *corrected])

    @cached_property
    def project(self) -> LoopProgram:
        """Compute q1 and v1 after Newton steps to Psi = 0 and Psi_dot = 0, both with the factors of Psi_q at q, and psi at q1.

        If the step in q is small, so is the step in v, and the change of Psi_q along the step in q is negligible.
        """
        return program(self._solver.project, self._terms.row_terms("psi", "psi", q="q1", sines="sines1"))

    @cached_property
    def project_and_accelerate(self) -> LoopProgram:
        """Compute v1, and a at v1; set safe."""
        return program(self._solver.project_and_accelerate)

    @cached_property
    def tangent_part(self) -> LoopProgram:
        """Compute dq1 and dv1, the tangent parts of the changes dq and dv, and distance."""
        return program(self._solver.position_terms("psi_q"), self._solver.factorize_dropping, self._solver.tangent_parts(0))

    @cached_property
    def end_of_step(self) -> LoopProgram:
        """Compute the results of `project_and_accelerate` and `tangent_part`, from one factorization."""
        return program(self._solver.project_and_accelerate, self._solver.tangent_parts(2))

    @cached_property
    def psi(self) -> LoopProgram:
        """Compute psi, the Psi of all rows."""
        return program([self._terms.sincos()], self._terms.row_terms("psi", "psi"))

    @cached_property
    def psi_dot(self) -> LoopProgram:
        """Compute Psi_dot of all rows, stored as psi."""
        return program([self._terms.sincos()], self._terms.row_terms("psi_dot", "psi"))

    @cached_property
    def equation_terms(self) -> LoopProgram:
        """Compute terms: a_F, followed by b of all rows."""
        return program([self._terms.sincos(), *self._terms.free_accelerations("v")], self._equation_terms)

    @property
    def _equation_terms(self) -> list[KernelLoop | Reset]:
        """Compute terms from a_F."""
        return [self._terms.add("terms", start="free"), *self._terms.row_terms("b", "terms", self.coordinate_count)]

    @cached_property
    def geometry(self) -> LoopProgram:
        """Compute psi, psi_dot and psi_q of all rows."""
        terms = self._terms
        rows = [*terms.row_terms("psi", "psi"), *terms.row_terms("psi_dot", "psi_dot")]
        return program([terms.sincos(), *terms.every_entry()], rows)

    @cached_property
    def psi_q(self) -> LoopProgram:
        """Compute psi_q of all rows."""
        return program([self._terms.sincos(), *self._terms.every_entry()])

    @property
    def psi_q_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of Psi_q: their rows, columns, indices in the array `psi_q`, and factors."""
        return self._layout.psi_q_entries

    @property
    def constant_entry(self) -> int:
        """The index in `psi_q` of a one, to which constant entries refer."""
        return self._layout.one

    @property
    def eliminated_rows(self) -> dict[int, int]:
        """The index in the linear systems of each retained row of Psi."""
        index = {}
        for group in self._layout.eliminated:
            for start, right in zip(group.table[:, ROW].tolist(), group.table[:, RIGHT].tolist(), strict=True):
                index |= {start + row: right + k for k, row in enumerate(group.rows)}
        return index

    @cached_property
    def rows_and_loads(self) -> LoopProgram:
        """Compute the inputs of rank-revealing methods: psi_q, psi, psi_dot and terms of all rows, and root, M^(-1/2).

        Friction that depends on multipliers is in a_F, by those of elimination.
        """
        psi_dot = self._terms.row_terms("psi_dot", "psi_dot")
        return program(self._solver.free_with_friction, self._equation_terms, self.rows("psi"), psi_dot)

    @cached_property
    def dense_accelerations(self) -> LoopProgram:
        """Compute the inputs of accelerations by a dense pseudoinverse: psi_q of all rows, terms and root."""
        return program(self.equation_terms.parts, self._terms.every_entry(), [self._root])

    @cached_property
    def dense_newton_q(self) -> LoopProgram:
        """Compute the inputs of a Newton step to Psi = 0: psi_q and psi of all rows, and root."""
        return program([self.sincos], self.rows("psi"))

    @cached_property
    def dense_newton_v(self) -> LoopProgram:
        """Compute the inputs of a Newton step to Psi_dot = 0: psi_q of all rows, Psi_dot as psi, and root."""
        return program([self.sincos], self.rows("psi_dot"))

    @property
    def sincos(self) -> KernelLoop:
        """Compute the sines and cosines of the bodies' angles."""
        return self._terms.sincos()

    def rows(self, residual: str) -> list[KernelLoop | Reset]:
        """Compute, after `sincos`, Psi_q of all rows, their Psi or Psi_dot as psi, and root, M^(-1/2)."""
        return [*self._terms.every_entry(), *self._terms.row_terms(residual, "psi"), self._root]

    @property
    def _root(self) -> KernelLoop:
        """Compute root, the diagonal of M^(-1/2)."""

        def write(w: KernelWriter):
            for k in range(3):
                w.write(w.graph.sqrt(compliance(w, k)), "root", BODY_COORDINATES, k)

        return self._terms.over_bodies("root", write)

    @cached_property
    def pieces(self) -> LoopProgram:
        """Compute pieces, the index of the smooth piece of each piecewise smooth element."""
        return program([self._terms.sincos()], self._terms.pieces())

    @cached_property
    def energy(self) -> LoopProgram:
        """Compute energy, the kinetic and potential energy (J); the potential of gravity is zero at the origin."""
        return program([self._terms.sincos()], self._terms.energy())

    @cached_property
    def rank(self) -> LoopProgram:
        """Compute rank, the number of rows that the last factorization retained."""
        return program(self._solver.elimination.rank())

    @cached_property
    def independent_rows(self) -> LoopProgram:
        """Compute independent: one for each row of Psi that elimination retains, zero for dependent rows."""
        solver = self._solver
        return program(solver.position_terms("psi_q"), solver.factorize_dropping, solver.elimination.independent())

    @cached_property
    def value_derivatives(self) -> LoopProgram:
        """Compute dq1 = q' and dv1 = q'', derivatives for a driver's value that replaces time, psi of all rows, and distance.

        They solve Psi_q q' = -Psi_t and Psi_q q'' = gamma, with gamma at the velocities q'.
        """
        terms, solver, solve, count = self._terms, self._solver, self._solver.solve, self.coordinate_count
        at_rest = [Reset("rest", 0, count), *solver.position_terms("psi_q", "psi_dot", v="rest"), *solver.factorize]
        first = [*solve(0), terms.add("dq1", solution=0, sign=-1), *terms.element_terms(("gamma",), "dq1", 1)]
        second = [*solve(1), terms.add("dv1", solution=1), *terms.row_terms("psi", "psi"), solver.elimination.distance()]
        return program(at_rest, first, second)

    @cached_property
    def prologue(self) -> LoopProgram:
        """Compute constants from `numbers`: all numbers of the scene, the gains, the marks of rows, `drop_tol` and `safe_tol`."""
        return write_prologue(self._layout, self._places, self._number_count)

    @cached_property
    def scales(self) -> ScaleProgram:
        """Compute scales, the characteristic scales at the guess, from `numbers`: those of the scene and the two thresholds."""
        return write_scales(self._terms, self._places, self._number_count, self.prologue)

    @cached_property
    def at_rest(self) -> RestProgram:
        """The programs for statics."""
        return write_rest_program(self._terms)

    @cached_property
    def differentiable(self) -> DifferentiablePrograms:
        """The programs that are differentiated."""
        return DifferentiablePrograms(self._solver)


@lru_cache(maxsize=16)
def _scene_programs(
    tree: TreeDef,
    shapes: LeafShapes,
    redundant_rows: tuple[int, ...] | None,
    baumgarte: bool,
    policy: RankPolicy,
    sharing: LoadShares,
) -> ScenePrograms:
    return ScenePrograms(tree, shapes, redundant_rows, baumgarte, policy, sharing)


def programs_of_structure(tree: TreeDef, shapes: LeafShapes, redundant_rows: tuple[int, ...]) -> ScenePrograms:
    """Return the programs of a structure, as `scene_programs` does."""
    return _scene_programs(tree, shapes, redundant_rows, False, RankPolicy.DROP, LoadShares.NONE)


def scene_programs(
    mechanism: Mechanism,
    redundant_rows: tuple[int, ...] | None = (),
    baumgarte: bool = False,
    policy: RankPolicy = RankPolicy.DROP,
    in_pieces: bool = True,
    sharing: LoadShares = LoadShares.NONE,
) -> ScenePrograms:
    """Return the programs of a mechanism's structure, for any numbers.

    Args:
        mechanism: The scene; its numbers may be traced.
        redundant_rows: Rows of Psi that are left out (`Analysis.redundant_rows`); None: chosen by marks among the numbers.
        baumgarte: Whether Baumgarte stabilization is included.
        policy: Policy for small pivots.
        in_pieces: Whether `Mechanism.at` passes sampled numbers for each time; otherwise all samples and knots are passed.
        sharing: Whether redundant rows share the loads of joints with friction.

    Returns:
        The programs; the same object for the same structure and settings.
    """
    tree_and_shapes = structure(mechanism) if in_pieces else whole_structure(mechanism)
    return _scene_programs(*tree_and_shapes, redundant_rows, baumgarte, policy, sharing)
