"""The programs of a user-defined system, with the names and results of those of a scene (scene_programs.py).

They are written as one straight line each: all terms are scalars of one graph (traced_system.py), and so are the linear systems
(system_solver.py). `psi` holds the rows of Psi, followed by zeros for those of phi, which do not restrict positions; corrections
of velocities remove Psi_dot and phi together.
"""

from collections.abc import Sequence
from functools import cached_property, lru_cache

import numpy as np

from udkjax.equations.systems.system_derivatives import ONCE, DifferentiableSystem, SystemEquation, WrittenScalars
from udkjax.equations.systems.system_solver import SystemFactors, mass_operations
from udkjax.equations.systems.system_terms import SystemTerms, less
from udkjax.equations.systems.traced_system import MOST_NUMBERS, SystemFunctions, TracedSystem
from udkjax.expressions import Scalar, tangents
from udkjax.expressions.loops.loop_program import KernelLoop, KernelWriter, LoopProgram
from udkjax.expressions.scalars.selection import absolute, greater, where
from udkjax.pinv.rank_policy import RankPolicy

MOST_OPERATIONS = 8_000  # of the accelerations: compiling takes 10 s for as many, and longer than in proportion for more
LONG_MASS = 2  # beyond this multiple, those of the mass matrix alone are estimated: equal ones, which count once, are fewer


class SystemPrograms(SystemTerms):
    """The programs of a system."""

    @cached_property
    def for_derivatives(self) -> "SystemPrograms":
        """The programs that are differentiated: these if the policy drops rows, else those with the policy `FALL_BACK`."""
        return self if self.policy.drops else _system_programs(*self._settings, RankPolicy.FALL_BACK)

    @cached_property
    def with_all_rows(self) -> "SystemPrograms":
        """Programs that eliminate all rows, without gains and marks among their numbers."""
        return _system_programs(self.functions, False, False, RankPolicy.FALL_BACK)

    @cached_property
    def excess(self) -> str:
        """The reason why the programs are too long for machine code; empty if they are not."""
        of_mass = mass_operations(self.functions.mass)
        if of_mass > LONG_MASS * MOST_OPERATIONS:  # writing them, only to count, would take seconds
            return f"the elimination of its mass matrix takes {of_mass:,} operations, more than {MOST_OPERATIONS:,}"
        count = sum(len(part.kernel.program.order) for part in self.accelerations.parts if isinstance(part, KernelLoop))
        many = f"its accelerations take {count:,} operations, more than {MOST_OPERATIONS:,}" if count > MOST_OPERATIONS else ""
        numbers = self.functions.number_count
        return f"its functions use {numbers:,} numbers, more than {MOST_NUMBERS:,}" if numbers > MOST_NUMBERS else many

    def _program(self, *outputs: WrittenScalars) -> LoopProgram:
        w = KernelWriter(self._graph)
        for s, name, k in self._inputs:
            w.bind(s, name, None, k)
        for arrays in outputs:
            for name, scalars in arrays.items():
                for k, s in enumerate(scalars):
                    w.write(s, name, None, k)
        return LoopProgram([KernelLoop(w.kernel(), ONCE)])

    @cached_property
    def prologue(self) -> LoopProgram:
        """Compute constants, which are the numbers."""
        w = KernelWriter()
        w.write(w.read("numbers", 0), "constants", 0)
        return LoopProgram([KernelLoop(w.kernel(), np.arange(self.number_count)[:, None])])

    @cached_property
    def accelerations(self) -> LoopProgram:
        """Compute a; set safe."""
        return self._program({"a": self._accelerations(self._factors)}, self._safe(self._factors))

    @cached_property
    def accelerations_and_drift(self) -> LoopProgram:
        """Compute a, psi, and distance; set safe."""
        factors = self._factors
        a = {"a": self._accelerations(factors), "psi": self._psi}
        return self._program(a, self._safe(factors), self._distance(factors))

    @cached_property
    def drift(self) -> LoopProgram:
        """Compute psi, and distance."""
        return self._program({"psi": self._psi}, self._distance(self._factors_dropping))

    @cached_property
    def newton_q(self) -> LoopProgram:
        """Compute q1, q after a Newton step to Psi = 0; set safe."""
        factors = self._factors_dropping
        return self._program({"q1": self._corrected_position(factors)}, self._safe(factors))

    def _corrected_position(self, factors: SystemFactors) -> list[Scalar]:
        return less(self.functions.q, factors.correct(self._psi, self.position_rows))

    @cached_property
    def newton_v_and_psi(self) -> LoopProgram:
        """Compute v1, v after a Newton step to Psi_dot = 0 and phi = 0, and psi."""
        return self._program({"v1": self._corrected_velocity(self._factors_dropping), "psi": self._psi})

    @cached_property
    def project(self) -> LoopProgram:
        """Compute q1 and v1 after Newton steps, both with the factors at q, and psi at q1."""
        factors = self._factors_dropping
        q1 = self._corrected_position(factors)
        v1 = self._corrected_velocity(factors, q=q1)
        return self._program({"q1": q1, "v1": v1, "psi": self._at(self._psi, q=q1)})

    @cached_property
    def project_and_accelerate(self) -> LoopProgram:
        """Compute v1, and a at v1; set safe."""
        return self._program(*self._end_of_step)

    @property
    def _end_of_step(self) -> list[WrittenScalars]:
        v1 = self._corrected_velocity(self._factors)
        return [{"v1": v1, "a": self._accelerations_at(self._factors, v1)}, self._safe(self._factors)]

    def _tangent_parts(self, factors: SystemFactors) -> list[WrittenScalars]:
        dq1 = factors.tangent_part(self._dq, self.position_rows)
        return [{"dq1": dq1, "dv1": factors.tangent_part(self._dv, drift=self._drift_of_rates(dq1))}, self._distance(factors)]

    def _drift_of_rates(self, dq: Sequence[Scalar]) -> list[Scalar] | None:
        """Return the change of Psi_dot and phi by dq, for which a projection changes the velocities; None without phi.

        A row such as lag v + q = u(t) makes an error of q one of v that is 1 / lag times as large. Rows of Psi alone make it one
        of the size of dv: their slopes change by a rate of the motion.
        """
        if self.position_rows == self.row_count:
            return None
        return tangents(self._graph, self._rate, dict(zip(self.functions.q, dq, strict=True)))

    @cached_property
    def drift_of_rates(self) -> LoopProgram:
        """Compute drift, the change of Psi_dot and phi by dq, of a system with phi."""
        return self._program({"drift": self._drift_of_rates(self._dq) or []})

    @cached_property
    def tangent_part(self) -> LoopProgram:
        """Compute dq1 and dv1, the tangent parts of the changes dq and dv, and distance."""
        return self._program(*self._tangent_parts(self._factors_dropping))

    @cached_property
    def mobility(self) -> LoopProgram:
        """Compute dv1, M^(-1) dv."""
        mass = self._rows.mass
        scaled = [s * c for s, c in zip(mass.forward(self._dv), self._rows.compliance, strict=True)]
        return self._program({"dv1": mass.backward(scaled)})

    @cached_property
    def end_of_step(self) -> LoopProgram:
        """Compute the results of `project_and_accelerate` and `tangent_part`, from one factorization."""
        return self._program(*self._end_of_step, *self._tangent_parts(self._factors))

    @cached_property
    def psi(self) -> LoopProgram:
        """Compute psi."""
        return self._program({"psi": self._psi})

    @cached_property
    def psi_dot(self) -> LoopProgram:
        """Compute Psi_dot and phi, stored as psi."""
        return self._program({"psi": self._rate})

    @property
    def _terms(self) -> WrittenScalars:
        u = [s * c for s, c in zip(self._rows.mass.forward(self.functions.force), self._rows.compliance, strict=True)]
        b = less(self._c, self._rows.rates(u))
        return {"terms": [*self._rows.mass.backward(u), *b]}

    @property
    def _dense_rows(self) -> WrittenScalars:
        entries = [s for row in self._rows.B for s in row.values()]
        root = [self._graph.sqrt(c) for c in self._rows.compliance]
        return {"psi_q": entries, "root": root, "couplings": self._rows.couplings}

    @cached_property
    def equation_terms(self) -> LoopProgram:
        """Compute terms: a_F, followed by b of all rows."""
        return self._program(self._terms)

    @cached_property
    def rows_and_loads(self) -> LoopProgram:
        """Compute the inputs of rank-revealing methods."""
        return self._program(self._terms, self._dense_rows, {"psi": self._psi, "psi_dot": self._rate})

    @cached_property
    def dense_accelerations(self) -> LoopProgram:
        """Compute the inputs of accelerations by a dense pseudoinverse."""
        return self._program(self._terms, self._dense_rows)

    @cached_property
    def dense_newton_q(self) -> LoopProgram:
        """Compute the inputs of a Newton step to Psi = 0."""
        return self._program(self._dense_rows, {"psi": self._psi})

    @cached_property
    def dense_newton_v(self) -> LoopProgram:
        """Compute the inputs of a Newton step to Psi_dot = 0 and phi = 0, whose residuals are stored as psi."""
        return self._program(self._dense_rows, {"psi": self._rate})

    @property
    def _rows_of_coordinates(self) -> WrittenScalars:
        zero, one, nan = map(self._graph.constant, (0.0, 1.0, np.nan))
        entries = [row.get(k, zero) for row, B in zip(self._A, self._rows.B, strict=True) for k in B]
        return {"psi_q": entries, "root": [one / self._graph.sqrt(row.get(k, nan)) for k, row in enumerate(self.functions.mass)]}

    @cached_property
    def rows_of_positions(self) -> LoopProgram:
        return self._program(self._rows_of_coordinates, {"psi": self._psi})

    @cached_property
    def rows_of_velocities(self) -> LoopProgram:
        return self._program(self._rows_of_coordinates, {"psi": self._rate})

    @cached_property
    def independent_rows(self) -> LoopProgram:
        """Compute independent: one for each row that elimination retains, zero for dependent rows."""
        zero, one = self._graph.constant(0.0), self._graph.constant(1.0)
        inverse = self._factors_dropping.gram.inverse
        return self._program({"independent": [where(greater(absolute(s), zero), one, zero) for s in inverse]})

    @cached_property
    def differentiable(self) -> DifferentiableSystem:
        """The programs that are differentiated."""
        mass, rest = self.functions.mass, [self._graph.constant(0.0)] * self.coordinate_count
        equation = SystemEquation(mass, self.functions.force, self._A, self._c, self.row_count)
        position = SystemEquation(mass, rest, self._A, self._psi, self.position_rows)
        velocity = SystemEquation(mass, rest, self._A, self._rate, self.row_count)
        of_accelerations = equation, self._factors, self._safe(self._factors)
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
