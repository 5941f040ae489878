"""The programs of a large scene as loops: the same as scene_programs.py has, with code that does not grow with the scene.

Terms come from loops over elements of the same structure (loop_terms.py), linear systems from elimination by blocks
(loop_elimination.py), and derivatives from loops, too (`DifferentiableProgram`).
"""

from collections.abc import Callable, Collection, Hashable, Iterable, Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from udkjax.equations.loop_elimination import BlockElimination
from udkjax.equations.loop_layout import BODY_COORDINATES, DROP_TOL, LoopLayout, abstract_mechanism
from udkjax.equations.loop_prologue import write_prologue
from udkjax.equations.loop_terms import LoopTerms, Parts
from udkjax.equations.structure import AnyArray, ArrayLibrary, Shapes, Time, TreeDef, structure
from udkjax.expressions.loop_derivative import LoopDerivative
from udkjax.expressions.loop_program import Kernel, KernelLoop, KernelWriter, LoopProgram, NumpyLoops, Reset, evaluate_loops
from udkjax.pinv.rank_policy import RankPolicy
from udkjax.scene.mechanism import Mechanism

Result = TypeVar("Result")
StateFunction = Callable[[Time, AnyArray, AnyArray], Result]  # of t, q and v

NOT_DIFFERENTIATED = ("t", "gram", "factors", "ratio")  # arrays


class DifferentiableProgram(NamedTuple):
    """A program, and the part of it that is differentiated, with respect to all arrays but those that are `fixed`.

    No factorization is differentiated. Accelerations and single corrections, such as q - M^(-1/2) D^T x with D D^T x = Psi, are
    refined once,

        D D^T x = b,      D D^T x1 = b - D D^T x,      a = a_F + M^(-1/2) D^T (x + x1),

    with x1 of nothing but rounding errors: with x and the factors fixed, the derivative of that is the one of a. A projection is
    differentiated where all residuals vanish, and with them whatever they multiply: D is fixed, too.
    """

    program: LoopProgram
    parts: Sequence[KernelLoop | Reset]
    fixed: Collection[str]

    def derivative(self, fixed: Collection[str] = ()) -> LoopDerivative:
        """Return the derivative, with further arrays fixed."""
        return LoopDerivative(self.parts, {*self.fixed, *fixed})


class LoopPrograms:
    """Programs over arrays of numbers. Each takes the arrays `constants`, t, q and, where it needs them, v, dq and dv.

    The results are the arrays a, q1, v1, dq1, dv1, psi, terms, rank, distance, and safe: whether all pivots exceed `safe_tol`.
    What a program computes on the way stays in arrays of its own, of the sizes `scratch`: no number is written again once it has
    been read. Rows with small pivots are dropped, whatever the policy is.
    """

    def __init__(
        self,
        tree: TreeDef,
        shapes: Shapes,
        redundant_rows: tuple[int, ...],
        baumgarte: bool,
        policy: RankPolicy,
        every_row: bool = False,
        kernels: dict[Hashable, Kernel] | None = None,
    ):
        self._settings = tree, shapes, redundant_rows, baumgarte, policy
        self._kernels = {} if kernels is None else kernels
        self.policy, self.redundant_rows = policy, redundant_rows
        layout = self._layout = LoopLayout(abstract_mechanism(tree, shapes), redundant_rows, baumgarte, every_row)
        self._terms = LoopTerms(layout, self._kernels)
        self._elimination = BlockElimination(self._terms)
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
        return self.scratch | {"sines1": 2 * (n // 3), "q1": n, "v1": n}

    @property
    def term_count(self) -> int:
        """The number of values that `equation_terms` returns."""
        return self.coordinate_count + self.row_count

    @property
    def drop_tol_index(self) -> int:
        """The index of `drop_tol` among the constants."""
        return DROP_TOL

    @property
    def prologue_input_count(self) -> int:
        """The number of values that `prologue` takes."""
        return self._number_count + self._layout.gains + 2

    @property
    def for_derivatives(self) -> "LoopPrograms":
        """The programs whose derivatives are taken."""
        return self

    @cached_property
    def with_all_rows(self) -> "LoopPrograms":
        """The same programs, of the same constants, on all rows: redundant ones may be independent in singular configurations."""
        return LoopPrograms(*self._settings, every_row=True, kernels=self._kernels)

    # --- programs

    @cached_property
    def accelerations(self) -> LoopProgram:
        """a; safe."""
        return _program(
            self._acceleration_system, self._factorize, self._elimination.solve(), [self._a(0)], [self._elimination.safe()]
        )

    @cached_property
    def newton_q(self) -> LoopProgram:
        """q1, q after a Newton step to Psi = 0; safe."""
        terms = self._terms
        position = [terms.sincos(), *terms.element_terms(("D", "psi"))]
        step = [*self._factorize, *self._elimination.solve(), terms.subtract_solutions("q", "q1", 0)]
        return _program(position, step, [self._elimination.safe()])

    @cached_property
    def newton_v_and_psi(self) -> LoopProgram:
        """v1, v after the Newton step to Psi_dot = 0; and psi, of all rows."""
        return _program(self._newton_v, self._terms.row_terms("psi", "psi"))

    @cached_property
    def project_and_accelerate(self) -> LoopProgram:
        """v1, and a there; safe."""
        return _program(self._project_and_accelerate)

    @cached_property
    def tangent_part(self) -> LoopProgram:
        """dq1 and dv1: the parts of the changes dq and dv within the manifold; distance."""
        return _program([self._terms.sincos(), *self._terms.element_terms(("D",))], self._factorize, self._tangent_parts(0))

    @cached_property
    def end_of_step(self) -> LoopProgram:
        """The results of `project_and_accelerate` and `tangent_part`, by the same factors."""
        return _program(self._project_and_accelerate, self._tangent_parts(2))

    @cached_property
    def psi(self) -> LoopProgram:
        """psi: Psi of all rows."""
        return _program([self._terms.sincos()], self._terms.row_terms("psi", "psi"))

    @cached_property
    def psi_dot(self) -> LoopProgram:
        """psi: Psi_dot of all rows."""
        return _program([self._terms.sincos()], self._terms.row_terms("psi_dot", "psi"))

    @cached_property
    def equation_terms(self) -> LoopProgram:
        """terms: a_F (zero where it is gravity), and b of all rows."""
        terms = self._terms

        def write(w: KernelWriter):
            for k in range(3):
                free = w.read("free", BODY_COORDINATES, k) if self._layout.forces else w.graph.constant(0.0)
                w.write(free, "terms", BODY_COORDINATES, k)

        free = [terms.sincos(), *terms.free_accelerations("v"), terms.over_bodies("copy free", write)]
        return _program(free, terms.row_terms("b", "terms", self.coordinate_count))

    @cached_property
    def rank(self) -> LoopProgram:
        """rank: how many rows the last factorization did not drop."""
        return _program(self._elimination.rank())

    @cached_property
    def prologue(self) -> LoopProgram:
        """`constants`, from `numbers`: all numbers of the scene, the gains, `drop_tol` and `safe_tol`."""
        return write_prologue(self._layout, self._places, self._number_count)

    # --- parts of programs

    @property
    def _factorize(self) -> Parts:
        return self._elimination.factorize()

    @property
    def _acceleration_system(self) -> list[KernelLoop | Reset]:
        """D D^T, and b as the right-hand side."""
        terms = self._terms
        return [terms.sincos(), *terms.free_accelerations("v"), *terms.element_terms(("D", "b"))]

    def _a(self, *solves: int) -> KernelLoop:
        return self._terms.constrained_accelerations(*solves)

    @property
    def _newton_v(self) -> list[KernelLoop | Reset]:
        terms = self._terms
        rates = [terms.sincos(), *terms.element_terms(("D", "psi_dot"))]
        return [*rates, *self._factorize, *self._elimination.solve(), terms.subtract_solutions("v", "v1", 0)]

    @property
    def _project_and_accelerate(self) -> list[KernelLoop | Reset]:
        terms = self._terms
        system = [*terms.free_accelerations("v1"), *terms.element_terms(("b",), "v1", 1)]
        return [*self._newton_v, *system, *self._elimination.solve(1), self._a(1), self._elimination.safe()]

    def _tangent_parts(self, solve: int) -> Parts:
        for k, change in enumerate(("dq", "dv"), solve):
            yield from self._terms.rates(change, k)
            yield from self._elimination.solve(k)
            yield self._terms.subtract_solutions(change, f"{change}1", k)
        yield self._elimination.distance()

    # --- derivatives

    @cached_property
    def differentiable_accelerations(self) -> DifferentiableProgram:
        """a; safe."""
        return self._refine(self._acceleration_system[1:], self._a(0, 1), self._elimination.safe())

    @cached_property
    def differentiable_newton_q(self) -> DifferentiableProgram:
        """q1."""
        return self._refine(list(self._terms.element_terms(("D", "psi"))), self._terms.subtract_solutions("q", "q1", 0, 1))

    @cached_property
    def differentiable_newton_v(self) -> DifferentiableProgram:
        """v1."""
        return self._refine(list(self._terms.element_terms(("D", "psi_dot"))), self._terms.subtract_solutions("v", "v1", 0, 1))

    @cached_property
    def differentiable_projection(self) -> DifferentiableProgram:
        """q1 and v1."""
        terms, solve = self._terms, self._elimination.solve
        position = [terms.sincos(), *terms.element_terms(("psi",)), *solve(0), terms.subtract_solutions("q", "q1", 0)]
        at_q1 = terms.element_terms(("psi_dot",), "v", 1, q="q1", sines="sines1")
        velocity = [terms.sincos("q1", "sines1"), *at_q1, *solve(1), terms.subtract_solutions("v", "v1", 1)]
        program = _program([terms.sincos(), *terms.element_terms(("D",))], self._factorize, position[1:], velocity)
        return DifferentiableProgram(program, [*position, *velocity], {*NOT_DIFFERENTIATED, "D"})

    def _refine(self, system: Sequence[KernelLoop | Reset], result: KernelLoop, *rest: KernelLoop) -> DifferentiableProgram:
        terms, elimination = self._terms, self._elimination
        before = [terms.sincos(), *system]
        after = [*terms.jt(0), *terms.residual_of_solve(0, 1), *elimination.solve(1), result]
        program = _program(before, self._factorize, elimination.substitute(0), after, rest)
        return DifferentiableProgram(program, [*before, *after], {*NOT_DIFFERENTIATED, "sum0", "y0", "x0"})

    # --- by arrays: without machine code

    @property
    def d_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of D: their rows, columns, places in the array `D` (with a one behind it), and factors."""
        return self._layout.d_entries

    def constants_of(self, numbers: AnyArray, xp: ArrayLibrary) -> AnyArray:
        """Return the constants as a function of the numbers of the scene and the gains."""
        arrays = {"numbers": xp.concatenate([numbers, xp.zeros(2)]), "constants": xp.zeros(len(self.constants))}
        return _by_arrays(self.prologue, xp)(arrays)["constants"]

    def geometry(self, numbers: AnyArray, xp: ArrayLibrary) -> StateFunction[AnyArray, tuple[AnyArray, AnyArray, AnyArray]]:
        """Return a function of t, q and v, of the numbers of the scene: Psi, Psi_dot and the entries of D at `d_entries`."""
        run = self._run_by_arrays(self._geometry, numbers, xp)
        _, _, places, factors = self.d_entries

        def evaluate(t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
            found = run(t, q, v)
            return found["psi"], found["psi_dot"], xp.append(found["D"], 1.0)[places] * factors

        return evaluate

    def psi_by_numpy(self, numbers: np.ndarray) -> Callable[[Time, np.ndarray], np.ndarray]:
        """Return a function of t and q, of the numbers of the scene: Psi."""
        run = self._run_by_arrays(self.psi, numbers, np)
        return lambda t, q: run(t, q, q)["psi"]

    def loads(self, numbers: AnyArray, xp: ArrayLibrary) -> StateFunction[AnyArray, tuple[AnyArray, AnyArray]]:
        """Return a function of t, q and v, of the numbers of the scene: a_F, and b of all rows."""
        run, n = self._run_by_arrays(self.equation_terms, numbers, xp), self.coordinate_count
        gravity: AnyArray = xp.tile(xp.append(numbers[np.ravel(self._places.gravity)], 0.0), n // 3)

        def evaluate(t: Time, q: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
            terms = run(t, q, v)["terms"]
            return terms[:n] if self._layout.forces else gravity, terms[n:]

        return evaluate

    @cached_property
    def _geometry(self) -> LoopProgram:
        terms = self._terms
        rows = [*terms.row_terms("psi", "psi"), *terms.row_terms("psi_dot", "psi_dot")]
        return _program([terms.sincos(), *terms.element_terms(("D",))], rows)

    def _run_by_arrays(
        self, program: LoopProgram, numbers: AnyArray, xp: ArrayLibrary
    ) -> StateFunction[AnyArray, dict[str, AnyArray]]:
        """Run a program in which no round of a loop takes anything from another, by NumPy or JAX."""
        constants = self.constants_of(numbers, xp)
        sizes = self.scratch | {"psi": self.row_count, "psi_dot": self.row_count, "terms": self.term_count}
        results, evaluate = {"psi", "psi_dot", "terms", "D"}, _by_arrays(program, xp)
        blank = {x: xp.zeros(size) for x, size in sizes.items() if x in program.arrays | results}

        def run(t: Time, q: AnyArray, v: AnyArray) -> dict[str, AnyArray]:
            given = {"constants": constants, "t": xp.reshape(xp.asarray(t, float), (1,)), "q": q, "v": v}
            return evaluate(blank | given)

        return run


def _by_arrays(program: LoopProgram, xp: ArrayLibrary) -> Callable[[dict[str, AnyArray]], dict[str, AnyArray]]:
    run: Any = NumpyLoops(program) if xp is np else partial(evaluate_loops, program)
    return run


def _program(*parts: Iterable[KernelLoop | Reset]) -> LoopProgram:
    return LoopProgram([part for some in parts for part in some])


@lru_cache(maxsize=16)
def _loop_programs(
    tree: TreeDef, shapes: Shapes, redundant_rows: tuple[int, ...], baumgarte: bool, policy: RankPolicy
) -> LoopPrograms:
    return LoopPrograms(tree, shapes, redundant_rows, baumgarte, policy)


def loop_programs(
    mechanism: Mechanism,
    redundant_rows: tuple[int, ...] = (),
    baumgarte: bool = False,
    policy: RankPolicy = RankPolicy.DROP,
) -> LoopPrograms:
    """Return the programs of a mechanism's structure as loops; the arguments are those of `elimination_programs`."""
    return _loop_programs(*structure(mechanism), redundant_rows, baumgarte, policy)
