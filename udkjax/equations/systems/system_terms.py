"""The scalars of the programs of a user-defined system: its inputs, its terms and their factors."""

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

import numpy as np

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.systems.system_derivatives import SINGLE_ITERATION
from udkjax.equations.systems.system_solver import MassFactors, PivotRule, SystemFactors, factorize_mass, factorize_rows
from udkjax.equations.systems.traced_system import SystemFunctions
from udkjax.expressions import Scalar, ScalarProgram
from udkjax.expressions.algebra.sparse_ldl import SparseLDL
from udkjax.expressions.loops.loop_program import KernelLoop, KernelWriter, LoopProgram
from udkjax.pinv.rank_policy import RankPolicy


class SystemTerms(RunPrograms):
    """Base of the programs of a system: their inputs, and the scalars of terms and factors that they share."""

    is_small, has_loops = True, False
    piece_count = 0
    has_mobility = True
    owner = "a function of the system"

    def __init__(self, functions: SystemFunctions, baumgarte: bool, marks_rows: bool, policy: RankPolicy):
        self._settings = functions, baumgarte, marks_rows
        self.functions, self.policy, self._graph = functions, policy, functions.graph
        self.coordinate_count, self.row_count = functions.n, sum(functions.row_counts)
        self.marks_rows = marks_rows and self.row_count > 0
        first_gain = functions.number_count
        first_mark = first_gain + 2 * baumgarte
        self.number_count = first_mark + self.row_count * self.marks_rows + 2
        self.constants = range(self.number_count)
        graph = self._graph
        constant = lambda k: graph.input(("constants", k), "parameter")  # noqa: E731
        self._inputs: list[tuple[Scalar, str, int]] = [(functions.t, "t", 0)]
        for name, scalars in (("q", functions.q), ("v", functions.v)):
            self._inputs += [(s, name, k) for k, s in enumerate(scalars)]
        listed = [s for x in functions.numbers for s in x.flat]
        self._inputs += [(s, "constants", k) for k, s in enumerate(listed) if s.constant is None]
        further = [constant(k) for k in range(first_gain, self.number_count)]
        self._inputs += [(s, "constants", first_gain + k) for k, s in enumerate(further)]
        self._gains = further[:2] if baumgarte else []
        self._marks = further[2 * baumgarte : -2] if self.marks_rows else None
        self._drop_tol, self._safe_tol = further[-2:]
        self._dq, self._dv = ([graph.input((x, k), x) for k in range(self.coordinate_count)] for x in ("dq", "dv"))
        self._inputs += [(s, x, k) for x, scalars in (("dq", self._dq), ("dv", self._dv)) for k, s in enumerate(scalars)]

    @property
    def row_names(self) -> list[tuple[str, int]]:
        """For each row, the name of its function, and its index among the rows of this function."""
        names = ("constraint", "velocity_constraint")
        return [(name, k) for name, count in zip(names, self.functions.row_counts, strict=True) for k in range(count)]

    @property
    def scratch(self) -> dict[str, int]:
        return {"psi_q": sum(map(len, self._rows.B)), "couplings": len(self._rows.couplings), "pieces": 0}

    @property
    def position_rows(self) -> int:
        return self.functions.row_counts[0]

    @property
    def psi_q_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The entries of B: their rows, columns, indices in the array `psi_q`, and the factors of the numbers there, all one."""
        entries = np.array([(i, k) for i, row in enumerate(self._rows.B) for k in row], int).reshape(-1, 2)
        return entries[:, 0], entries[:, 1], np.arange(len(entries)), np.ones(len(entries))

    @property
    def couples(self) -> bool:
        """True if M is not diagonal."""
        return len(self._rows.couplings) > 0

    @cached_property
    def spread(self) -> LoopProgram:
        """The program that replaces the array `change`, u, by L^(-T) u, with the entries of L in the array `couplings`."""
        return self._of_couplings(lambda mass, u: mass.backward(u))

    @cached_property
    def gather(self) -> LoopProgram:
        """The program that replaces the array `change`, w, by L^T w, with the entries of L in the array `couplings`."""
        return self._of_couplings(lambda mass, u: mass.transposed(u))

    def _of_couplings(self, function: Callable[[SparseLDL, Sequence[Scalar]], list[Scalar]]) -> LoopProgram:
        w, below = KernelWriter(), []
        values = iter([w.read("couplings", None, k) for k in range(len(self._rows.couplings))])
        for column in self._rows.mass.below:
            below.append({i: next(values) for i in column})
        change = [w.read("change", None, k) for k in range(self.coordinate_count)]
        for k, s in enumerate(function(self._rows.mass._replace(below=below), change)):
            w.write(s, "change", None, k)
        return LoopProgram([KernelLoop(w.kernel(), SINGLE_ITERATION)])

    # --- scalars

    @property
    def _A(self) -> list[dict[int, Scalar]]:
        return [*self.functions.psi_q, *self.functions.phi_v]

    @cached_property
    def _rows(self) -> MassFactors:
        return factorize_mass(self._graph, self.functions.mass, self._A)

    def _factorize(self, drops: bool) -> SystemFactors:
        rule = PivotRule(drops, self._drop_tol, self._safe_tol, self._marks)
        return factorize_rows(self._graph, self._rows, self.position_rows, rule)

    @cached_property
    def _factors(self) -> SystemFactors:
        """The factors for accelerations, under the policy."""
        return self._factors_dropping if self.policy.drops else self._factorize(False)

    @cached_property
    def _factors_dropping(self) -> SystemFactors:
        """The factors for corrections, without rows that depend on others."""
        return self._factorize(True)

    @property
    def _psi(self) -> list[Scalar]:
        return [*self.functions.psi, *[self._graph.constant(0.0)] * (self.row_count - self.position_rows)]

    @property
    def _rate(self) -> list[Scalar]:
        """Psi_dot followed by phi, the residuals that corrections of velocities remove."""
        return [*self.functions.psi_dot, *self.functions.phi]

    @cached_property
    def _c(self) -> list[Scalar]:
        """The right-hand side of A a = c, with Baumgarte's terms."""
        c = [*self.functions.gamma, *self.functions.bend]
        if self._gains:
            alpha, beta = self._gains
            rows = zip(c, self._rate, self._psi, strict=True)
            c = [s - alpha * 2.0 * rate - beta * beta * psi for s, rate, psi in rows]
        return c

    @cached_property
    def is_linear(self) -> bool:
        """True if phi is linear in the velocities."""
        return not any("velocity" in s.node.depends for row in self.functions.phi_v for s in row.values())

    def _at(self, outputs: Sequence[Scalar], **states: Sequence[Scalar]) -> list[Scalar]:
        """Return `outputs` as functions of other states: q=..., v=... replace the scalars of q or v."""
        program = ScalarProgram(self._graph, [s for s, _, _ in self._inputs], outputs)
        values = {s.index: states[name][k] if name in states else s for s, name, k in self._inputs}
        return self._graph.copy(program, values)

    def _corrected_velocity(self, factors: SystemFactors, **states: Sequence[Scalar]) -> list[Scalar]:
        """Return v after a Newton step to Psi_dot = 0 and phi = 0; after two, with the same factors, if phi is not linear."""
        v = self.functions.v
        for _ in range(1 if self.is_linear else 2):
            rate = self._at(self._rate, v=v, **states)
            v = less(v, factors.correct(rate))
        return v

    def _accelerations(self, factors: SystemFactors) -> list[Scalar]:
        return factors.respond(self.functions.force, self._c)[0]

    def _accelerations_at(self, factors: SystemFactors, v: Sequence[Scalar]) -> list[Scalar]:
        """Return the accelerations at other velocities, with the factors of the state if these do not depend on them."""
        if not self.is_linear:
            return self._at(self._accelerations(factors), v=v)
        values = self._at([*self.functions.force, *self._c], v=v)
        return factors.respond(values[: self.coordinate_count], values[self.coordinate_count :])[0]

    def _safe(self, factors: SystemFactors) -> list[Scalar]:
        return [factors.trusted if self.policy.reports else self._graph.constant(1.0)]


def less(a: Iterable[Scalar], b: Iterable[Scalar]) -> list[Scalar]:
    """Return the difference of two lists of scalars."""
    return [x - y for x, y in zip(a, b, strict=True)]
