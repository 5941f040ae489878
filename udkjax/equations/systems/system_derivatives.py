"""The differentiable programs of a user-defined system: accelerations, and the projection of a state.

No factorization is differentiated. With the load F and the right-hand side c of the rows A, a solution (w, x) of

    r_w = F + A^T x - M w = 0,        r_x = c - A w = 0

changes by K (dr_w, dr_x), where r is differentiated at fixed (w, x), and K solves with the factors of the state. Second
derivatives are those of two such corrections (differentiable_programs.py). A correction of q or v has no load, and a residual for
c.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from udkjax.equations.programs.differentiable_programs import PROJECTION_OUTPUTS, DifferentiableProgram
from udkjax.equations.systems.system_solver import SystemFactors
from udkjax.expressions import Graph, Scalar
from udkjax.expressions.algebra.differential import SparseRow
from udkjax.expressions.loops.loop_program import ADD, SET, KernelLoop, KernelWriter, LoopProgram, Reset

SINGLE_ITERATION = np.zeros((1, 1), int)  # the table of a loop of one iteration
WrittenScalars = Mapping[str, Sequence[Scalar]]  # the scalars of each array
Inputs = Sequence[tuple[Scalar, str, int]]  # with their arrays and indices
RIGHT, SOLUTION, FACTORS = "right", "x0", "factors"  # arrays; `right1` and `right2` are those of the two corrections


class SystemEquation:
    """An equation M w = F + A^T x, A w = c: mass matrix, load F, and the first `count` of the rows A and right-hand sides c."""

    def __init__(
        self, mass: Sequence[SparseRow], load: Sequence[Scalar], A: Sequence[SparseRow], c: Sequence[Scalar], count: int
    ):
        self.mass, self.load, self.A, self.c, self.count = mass, load, A[:count], c[:count], count

    def residual(self, w: Sequence[Scalar], x: Sequence[Scalar]) -> list[Scalar]:
        """Return r_w, followed by r_x."""
        zero = w[0].graph.constant(0.0)
        moved = [s - sum((m * w[k] for k, m in row.items()), zero) for s, row in zip(self.load, self.mass, strict=True)]
        for row, s in zip(self.A, x, strict=False):
            for k, entry in row.items():
                moved[k] = moved[k] + entry * s
        rates = [sum((s * w[k] for k, s in row.items()), zero) for row in self.A]
        return [*moved, *(c - rate for c, rate in zip(self.c, rates, strict=True))]


class DifferentiableSystem:
    """The differentiable programs of a system, by their outputs.

    Args:
        graph: The graph of the terms.
        inputs: The numbers and the state.
        of_accelerations: The equation of the accelerations, with its factors and the outputs that report on them.
        of_positions: The equation of a correction of positions, with the factors of corrections.
        of_velocities: The equation of a correction of velocities.
    """

    def __init__(
        self,
        graph: Graph,
        inputs: Inputs,
        of_accelerations: tuple[SystemEquation, SystemFactors, WrittenScalars],
        of_positions: tuple[SystemEquation, SystemFactors],
        of_velocities: SystemEquation,
    ):
        self._graph, self._inputs = graph, inputs
        self._of_accelerations, self._of_positions, self._of_velocities = of_accelerations, of_positions, of_velocities
        self._n = len(of_velocities.mass)

    def of(self, *outputs: str) -> DifferentiableProgram:
        """Return the program of "a", which sets `safe`, or of the `PROJECTION_OUTPUTS` of a state on the manifold."""
        if outputs == PROJECTION_OUTPUTS:
            return self._projection
        assert outputs == ("a",)
        return self._accelerations

    @cached_property
    def _accelerations(self) -> DifferentiableProgram:
        """The program that computes a and `safe`, with the loops of its derivatives."""
        equation, factors, reports = self._of_accelerations
        a, x = factors.respond(equation.load, equation.c)
        evaluation = self._loop({"a": a, SOLUTION: [*a, *x], FACTORS: factors.numbers}, reports)
        response = [self._residual(equation, 1), self._solve(factors, equation, 1, "a", SET)]
        return DifferentiableProgram(
            LoopProgram([evaluation]), response, [*self._corrected(factors, equation), self._copy("a", None)]
        )

    @cached_property
    def _projection(self) -> DifferentiableProgram:
        """The program that computes q1 and v1 of a state on the manifold, where they equal q and v."""
        position, factors = self._of_positions
        velocity, rest = self._of_velocities, Reset(SOLUTION, 0, self._n + len(self._of_velocities.c))
        state = {f"{x}1": [s for s, name, _ in self._inputs if name == x] for x in "qv"}
        evaluation = self._loop(state, {FACTORS: factors.numbers})
        parts = [
            self._residual(position, 1, only_rows=True),
            self._solve(factors, position, 1, "q", SET, only_rows=True),
            self._residual(velocity, 2, only_rows=True, q="q1"),
            self._solve(factors, velocity, 2, "v", SET, only_rows=True),
        ]
        second = [*self._corrected(factors, position), self._copy("q1", "q")]
        second += [*self._corrected(factors, velocity, q="q1"), self._copy("v1", "v")]
        return DifferentiableProgram(LoopProgram([evaluation, rest]), parts, second)

    def _corrected(self, factors: SystemFactors, equation: SystemEquation, **names: str) -> list[KernelLoop | Reset]:
        """Return the loops that compute the solution, with its current value and the derivatives of two corrections."""
        parts: list[KernelLoop | Reset] = [Reset(SOLUTION, 0, self._n + len(factors.gram.order))]
        for k in (1, 2):
            parts += [self._residual(equation, k, False, **names), self._solve(factors, equation, k, SOLUTION, ADD)]
        return parts

    def _loop(self, *outputs: WrittenScalars, **names: str) -> KernelLoop:
        w = KernelWriter(self._graph)
        for s, name, k in self._inputs:
            w.bind(s, names.get(name, name), None, k)
        for arrays in outputs:
            for name, scalars in arrays.items():
                for k, s in enumerate(scalars):
                    w.write(s, name, None, k)
        return KernelLoop(w.kernel(), SINGLE_ITERATION)

    def _residual(self, equation: SystemEquation, k: int, only_rows: bool = False, **names: str) -> KernelLoop:
        """Return the loop that computes the residual of an equation at the solution `x0`, in the array of the correction k.

        With `only_rows` this is the right-hand side c alone, the residual r_x of a zero solution. `names` are arrays that replace
        others, such as q="q1".
        """
        w = KernelWriter(self._graph)
        for s, name, place in self._inputs:
            w.bind(s, names.get(name, name), None, place)
        n = self._n
        if only_rows:
            residual = equation.c
        else:
            solution = [w.read(SOLUTION, None, i) for i in range(n + equation.count)]
            residual = equation.residual(solution[:n], solution[n:])
        for i, s in enumerate(residual):
            w.write(s, f"{RIGHT}{k}", None, i)
        return KernelLoop(w.kernel(), SINGLE_ITERATION)

    def _solve(
        self, factors: SystemFactors, equation: SystemEquation, k: int, to: str, update: str, only_rows: bool = False
    ) -> KernelLoop:
        """Return the loop that computes the change (w, x) of a solution that removes the residual of the correction k.

        With `only_rows` it writes the array `to` minus w in the array with the name `to` followed by 1. Otherwise, with
        `update=ADD`, it adds the change to the array `to`, or else writes the changed w to it.
        """
        w, n, count = KernelWriter(), self._n, equation.count
        zero, rows = w.graph.constant(0.0), len(factors.gram.order)
        stored = [
            w.graph.constant(s.constant) if s.constant is not None else w.read(FACTORS, None, i)
            for i, s in enumerate(factors.numbers)
        ]
        fixed = factors.with_numbers(stored)
        given = [w.read(f"{RIGHT}{k}", None, i) for i in range(count if only_rows else n + count)]
        padding = [zero] * (rows - count)
        if only_rows:
            for i, change in enumerate(fixed.correct([*given, *padding], count)):
                w.write(w.read(to, None, i) - change, f"{to}1", None, i)
            return KernelLoop(w.kernel(), SINGLE_ITERATION)
        change, x = fixed.respond(given[:n], [*given[n:], *padding], count)
        if update == ADD:
            for i, s in enumerate([*change, *x[:count]]):
                w.write(s, to, None, i, ADD)
        else:
            for i, s in enumerate(change):
                w.write(w.read(SOLUTION, None, i) + s, to, None, i)
        return KernelLoop(w.kernel(), SINGLE_ITERATION)

    def _copy(self, to: str, start: str | None) -> KernelLoop:
        """Return the loop that writes the solution w, or the array `start` minus w, to the array `to`."""
        w = KernelWriter()
        for i in range(self._n):
            s = w.read(SOLUTION, None, i)
            w.write(s if start is None else w.read(start, None, i) - s, to, None, i)
        return KernelLoop(w.kernel(), SINGLE_ITERATION)
