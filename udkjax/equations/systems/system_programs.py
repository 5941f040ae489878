"""The programs of a user-defined system, with outputs as those of a scene (scene_programs.py).

They are written as one straight line each: all terms are scalars of one graph (traced_system.py), and so are the linear systems
(system_solver.py). `psi` holds the rows of Psi, followed by zeros for those of phi, which do not restrict positions; corrections
of velocities remove Psi_dot and phi together.
"""

from collections.abc import Callable, Sequence
from functools import cache, cached_property, lru_cache

import numpy as np

from udkjax.equations.systems.system_derivatives import SINGLE_ITERATION, DifferentiableSystem, SystemEquation
from udkjax.equations.systems.system_solver import SystemFactors, mass_operations
from udkjax.equations.systems.system_terms import SystemTerms, less
from udkjax.equations.systems.traced_system import MOST_NUMBERS, SystemFunctions, TracedSystem
from udkjax.expressions import Scalar, tangents
from udkjax.expressions.loops.loop_program import KernelLoop, KernelWriter, LoopProgram
from udkjax.expressions.scalars.selection import absolute, greater, where
from udkjax.pinv.rank_policy import RankPolicy

MOST_OPERATIONS = 60_000  # of the accelerations: a first run takes 16 CPU s for 26,000, in proportion
LONG_MASS = 2  # beyond this multiple, those of the mass matrix alone are estimated: equal ones, which count once, are fewer


class SystemPrograms(SystemTerms):
    """The programs of a user-defined system: each computes the outputs that it is asked for."""

    @cached_property
    def for_derivatives(self) -> "SystemPrograms":
        """The programs to differentiate: these if the policy drops rows, else the same with the policy `FALL_BACK`."""
        return self if self.policy.drops else _system_programs(*self._settings, RankPolicy.FALL_BACK)

    @cached_property
    def with_all_rows(self) -> "SystemPrograms":
        """Programs that eliminate all rows, without gains and marks among their numbers."""
        return _system_programs(self.functions, False, False, RankPolicy.FALL_BACK)

    @cached_property
    def excess(self) -> str:
        """The reason why the programs are too long for machine code, for messages; "" if they are not."""
        of_mass = mass_operations(self.functions.mass)
        if of_mass > LONG_MASS * MOST_OPERATIONS:  # writing them, only to count, would take seconds
            return f"the elimination of its mass matrix takes {of_mass:,} operations, more than {MOST_OPERATIONS:,}"
        count = sum(len(part.kernel.program.order) for part in self.of("a", "safe").parts if isinstance(part, KernelLoop))
        many = f"its accelerations take {count:,} operations, more than {MOST_OPERATIONS:,}" if count > MOST_OPERATIONS else ""
        numbers = self.functions.number_count
        return f"its functions use {numbers:,} numbers, more than {MOST_NUMBERS:,}" if numbers > MOST_NUMBERS else many

    @cached_property
    def prologue(self) -> LoopProgram:
        """The program that copies the numbers to the constants: they are the same."""
        w = KernelWriter()
        w.write(w.read("numbers", 0), "constants", 0)
        return LoopProgram([KernelLoop(w.kernel(), np.arange(self.number_count)[:, None])])

    def _write(self, outputs: tuple[str, ...]) -> LoopProgram:
        table = self._scalars(self._factors_dropping if self.drops(outputs) else self._factors)
        w = KernelWriter(self._graph)
        for s, name, k in self._inputs:
            w.bind(s, name, None, k)
        for output in outputs:
            for k, s in enumerate(table[output]()):
                w.write(s, output.partition(" ")[0], None, k)
        return LoopProgram([KernelLoop(w.kernel(), SINGLE_ITERATION)])

    def _scalars(self, factors: SystemFactors) -> dict[str, Callable[[], Sequence[Scalar]]]:
        """Return, for each output by name, a function that returns its scalars, with the given factors of linear systems."""
        rows, graph, functions = self._rows, self._graph, self.functions
        q1 = cache(lambda: less(functions.q, factors.correct(self._psi, self.position_rows)))
        v1 = cache(lambda: self._corrected_velocity(factors))
        dq1 = cache(lambda: factors.tangent_part(self._dq, self.position_rows))
        return {
            "psi": lambda: self._psi,
            "psi_dot": lambda: self._rate,
            "psi_q": lambda: [s for row in rows.B for s in row.values()],
            "root": lambda: [graph.sqrt(c) for c in rows.compliance],
            "couplings": lambda: rows.couplings,
            "psi_q of q": self._entries_of_coordinates,
            "root of q": self._root_of_coordinates,
            **dict.fromkeys(("terms", "terms with friction"), self._terms),
            "a": lambda: self._accelerations(factors),
            "unsettled": lambda: (),
            "q1": q1,
            "v1": v1,
            "dq1": dq1,
            "dv1": lambda: factors.tangent_part(self._dv, drift=self._drift_of_rates(dq1())),
            "safe": lambda: self._safe(factors),
            "distance": lambda: [graph.constant(1.0) / graph.sqrt(factors.nearness)],
            "independent": self._independent,
            "v1 at q1": lambda: self._corrected_velocity(factors, q=q1()),
            "psi at q1": lambda: self._at(self._psi, q=q1()),
            "a at v1": lambda: self._accelerations_at(factors, v1()),
            "drift": lambda: self._drift_of_rates(self._dq) or (),
            "dv1 without rows": self._mobility,
        }

    def _drift_of_rates(self, dq: Sequence[Scalar]) -> list[Scalar] | None:
        """Return the change of Psi_dot and phi by dq, which a projection takes into account in velocities; None without phi.

        A row such as lag v + q = u(t) makes an error of q one of v that is 1 / lag times as large. Rows of Psi alone make it one
        of the size of dv: their slopes change by a rate of the motion.
        """
        if self.position_rows == self.row_count:
            return None
        return tangents(self._graph, self._rate, dict(zip(self.functions.q, dq, strict=True)))

    def _mobility(self) -> list[Scalar]:
        mass = self._rows.mass
        return mass.backward([s * c for s, c in zip(mass.forward(self._dv), self._rows.compliance, strict=True)])

    def _terms(self) -> list[Scalar]:
        u = [s * c for s, c in zip(self._rows.mass.forward(self.functions.force), self._rows.compliance, strict=True)]
        b = less(self._c, self._rows.rates(u))
        return [*self._rows.mass.backward(u), *b]

    def _entries_of_coordinates(self) -> list[Scalar]:
        zero = self._graph.constant(0.0)
        return [row.get(k, zero) for row, B in zip(self._A, self._rows.B, strict=True) for k in B]

    def _root_of_coordinates(self) -> list[Scalar]:
        one, nan = self._graph.constant(1.0), self._graph.constant(np.nan)
        return [one / self._graph.sqrt(row.get(k, nan)) for k, row in enumerate(self.functions.mass)]

    def _independent(self) -> list[Scalar]:
        zero, one = self._graph.constant(0.0), self._graph.constant(1.0)
        return [where(greater(absolute(s), zero), one, zero) for s in self._factors_dropping.gram.inverse]

    @cached_property
    def differentiable(self) -> DifferentiableSystem:
        """The programs of accelerations and projections with derivatives."""
        mass, rest = self.functions.mass, [self._graph.constant(0.0)] * self.coordinate_count
        equation = SystemEquation(mass, self.functions.force, self._A, self._c, self.row_count)
        position = SystemEquation(mass, rest, self._A, self._psi, self.position_rows)
        velocity = SystemEquation(mass, rest, self._A, self._rate, self.row_count)
        of_accelerations = equation, self._factors, {"safe": self._safe(self._factors)}
        return DifferentiableSystem(self._graph, self._inputs, of_accelerations, (position, self._factors_dropping), velocity)


@lru_cache(maxsize=32)
def _system_programs(functions: SystemFunctions, baumgarte: bool, marks_rows: bool, policy: RankPolicy) -> SystemPrograms:
    return SystemPrograms(functions, baumgarte, marks_rows, policy)


def system_programs(
    system: TracedSystem, marks_rows: bool, baumgarte: bool = False, policy: RankPolicy = RankPolicy.DROP
) -> SystemPrograms:
    """Return the programs of a system, for any numbers.

    Args:
        system: The system; its numbers may be traced.
        marks_rows: Whether numbers mark the independent rows; otherwise all rows are eliminated.
        baumgarte: Whether Baumgarte stabilization is included.
        policy: Policy for small pivots.
    """
    return _system_programs(system.functions, baumgarte, marks_rows, policy)
