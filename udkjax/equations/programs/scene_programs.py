"""The programs of a scene: each computes only the outputs that it is asked for (scene_writer.py).

Terms come from loops over elements of the same structure (scene_terms.py), linear systems from elimination by blocks
(block_elimination.py, scene_solver.py), and derivatives from loops, too (differentiable_programs.py). The programs of small
scenes are unrolled (unrolled.py).
"""

from collections.abc import Hashable
from functools import cached_property, lru_cache

import jax
import numpy as np

from udkjax.annotations import TreeDef
from udkjax.equations.elimination.scene_solver import SceneSolver
from udkjax.equations.programs.differentiable_programs import DifferentiablePrograms
from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.programs.scene_writer import SceneWriter
from udkjax.equations.terms.rest_program import RestProgram, write_rest_program
from udkjax.equations.terms.scale_program import ROWS, ScaleProgram, write_scales
from udkjax.equations.terms.scene_layout import (
    DROP_TOL,
    RIGHT,
    ROW,
    SAFE_TOL,
    LoadShares,
    SceneLayout,
    abstract_mechanism,
)
from udkjax.equations.terms.scene_prologue import write_prologue
from udkjax.equations.terms.scene_terms import SceneTerms
from udkjax.equations.terms.structure import LeafShapes, structure, whole_structure
from udkjax.expressions.loops.loop_program import Kernel, KernelLoop, LoopProgram
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
        self.first_edge = layout.first_edge
        self.coordinate_count, self.row_count = layout.coordinate_count, layout.row_count
        self.scale_count = ROWS + self.row_count  # the number of values that `scales` returns
        self.rolling_rows = layout.rolling_rows
        self.constants = range(layout.constant_count)
        starts = np.cumsum([0, *(int(np.prod(shape)) for shape, _ in shapes)])
        places = [np.arange(a, b).reshape(s) for a, b, (s, _) in zip(starts, starts[1:], shapes, strict=False)]
        self._number_count = int(starts[-1])
        self._places: Mechanism = jax.tree.unflatten(tree, places)  # the index of each number of the scene

    def with_unit_masses(self, numbers: np.ndarray, length: float) -> np.ndarray:
        """Return a copy of the vector of all numbers in which each body has 1 kg and the radius of gyration `length` (m)."""
        numbers = numbers.copy()
        for body in self._places.bodies.values():
            numbers[body.mass], numbers[body.inertia] = 1.0, length**2
        return numbers

    @property
    def stored_sizes(self) -> dict[str, int]:
        """The sizes, by name, of all arrays that an evaluation at a state fills and that derivatives may need."""
        n = self.coordinate_count
        return {x: size for x, size in self.scratch.items() if x not in RunPrograms.BEGINS} | {"q1": n, "v1": n}

    @property
    def piece_count(self) -> int:
        """The number of values of the output "pieces".

        There is one for each piecewise smooth element, the index of the piece in use, and one for each load of a slot or of an
        edge of a guide, whose sign selects the piece.
        """
        return self.scratch["pieces"]

    @cached_property
    def is_small(self) -> bool:
        """True if computing the accelerations takes so few operations that the programs are unrolled.

        Operations for friction are not counted, except those that distribute joint loads among redundant rows (load_sharing.py).
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
        """The number of inputs of `prologue`: the numbers of the scene, gains, marks or weights of rows, and two thresholds."""
        return self._number_count + self._layout.gains + self._layout.marks + 2

    @property
    def marks_rows(self) -> bool:
        """True if numbers mark redundant rows: one mark for each row of Psi, which is one if the row is independent.

        If redundant rows share the loads of joints with friction, these numbers are the weights of all rows.
        """
        return self._layout.marks > 0

    @cached_property
    def for_derivatives(self) -> "ScenePrograms":
        """The programs to differentiate: these if the policy drops rows, else the same with the policy `FALL_BACK`."""
        if self.policy.drops:
            return self
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, self._sharing, kernels=self._kernels)

    @cached_property
    def with_all_rows(self) -> "ScenePrograms":
        """Programs with the same constants that eliminate all rows, also redundant ones, under the policy `FALL_BACK`."""
        return ScenePrograms(*self._settings, RankPolicy.FALL_BACK, self._sharing, every_row=True, kernels=self._kernels)

    def with_shared_rows(self, rows: tuple[int, ...]) -> "ScenePrograms":
        if rows not in self._with_shared_rows:
            tree, shapes, unknown, baumgarte = self._settings
            left_out, sharing = (rows, LoadShares.SWITCHED) if rows else (unknown, LoadShares.NONE)
            self._with_shared_rows[rows] = _scene_programs(tree, shapes, left_out, baumgarte, self.policy, sharing)
        return self._with_shared_rows[rows]

    @property
    def rubs(self) -> bool:
        return self._solver.friction is not None

    def _write(self, outputs: tuple[str, ...]) -> LoopProgram:
        return SceneWriter(self._solver, outputs, self.drops(outputs)).program()

    @property
    def psi_q_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of Psi_q: their rows, columns, indices in the array `psi_q`, and the factors of the numbers there."""
        return self._layout.psi_q_entries

    @property
    def constant_entry(self) -> int:
        """The index in `psi_q` of a one, to which constant entries refer."""
        return self._layout.one

    @property
    def eliminated_rows(self) -> dict[int, int]:
        """The index in the linear systems of each eliminated row of Psi, by the index of the row."""
        index = {}
        for group in self._layout.eliminated:
            for start, right in zip(group.table[:, ROW].tolist(), group.table[:, RIGHT].tolist(), strict=True):
                index |= {start + row: right + k for k, row in enumerate(group.rows)}
        return index

    @cached_property
    def prologue(self) -> LoopProgram:
        """The program that computes `constants` from `numbers`: those of the scene, gains, marks of rows, and two thresholds."""
        return write_prologue(self._layout, self._places, self._number_count)

    @cached_property
    def scales(self) -> ScaleProgram:
        """The program that computes `scales` at the initial guess, from `numbers`: those of the scene and two thresholds."""
        return write_scales(self._terms, self._places, self._number_count, self.prologue)

    @cached_property
    def at_rest(self) -> RestProgram:
        """The programs of the scene at rest, for statics."""
        return write_rest_program(self._terms)

    @cached_property
    def linearization(self) -> LoopProgram:
        """The program of a linearization at rest in one direction, the tangent part of `dq`: see `RestProgram.reduction`."""
        parts = self.of("dq1", "distance", "balance").parts
        return LoopProgram([*parts, *self.at_rest.loads.parts, *self.at_rest.curvature.parts, *self.at_rest.reduction.parts])

    @cached_property
    def differentiable(self) -> DifferentiablePrograms:
        """The programs of accelerations and projections with derivatives, which reuse the factors of the value."""
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
    """Return the programs that `scene_programs` returns for mechanisms of a structure, without the rows `redundant_rows`."""
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
