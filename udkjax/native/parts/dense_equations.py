"""The equations of a scene solved by a dense pseudoinverse of all rows instead of elimination.

With D = W Psi_q M^(-1/2), W the weights of the rows, and a method of pseudoinverses/,

    a = a_F + M^(-1/2) D^+ W b,        q - M^(-1/2) D^+ W Psi,        v - M^(-1/2) D^+ W Psi_dot,

and the tangent part of a small change, dq - M^(-1/2) D^+ W Psi_q dq. Rows of phi make dq a change of velocities as well,
-M^(-1/2) D^+ W (Psi_dot; phi)_q dq. The functions have the names and results of the scene's programs by elimination. All
systems at one state share a factorization.
"""

from collections.abc import Callable

from udkjax.native.language.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.parts.elimination import ByRows
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows


class DenseEquations(ByRows):
    """The accelerations and the projection of a module by a dense method."""

    shared = ("couplings", "rows", "rates")
    has_cold_functions = False

    def __init__(self, module: Module, method: DenseMethod):
        super().__init__(module)
        self._method = method

    @property
    def programs(self) -> list[str]:
        of_projection = ["dense_newton_q", "dense_newton_v", "psi_dot"]
        return ["dense_accelerations", *(of_projection if self._in.plan.projected else [])]

    def reserve(self):
        self.rows = WeightedRows(self._in, self._method)
        for name in ("state q", "state v"):
            self._in.places.add(f"saved {name}", self._in.n)

    def highest_rank(self, s: Lane) -> Value | None:
        return s.highest_rank

    def write(self):
        """Write the functions that the module calls in place of the scene's programs by elimination."""
        module = self._in
        self.rows.write()
        for name, write in self._functions.items():
            if name in module.solving:
                f, s = module.function(name, [(POINTER, "work"), (POINTER, "out")])
                s.safe = f.const(1.0, DOUBLE, f.width)
                write(f)

    def _factor(self, f: Function, of_positions: bool = False):
        """Factorize D, with `of_positions` only its rows that restrict positions.

        `highest_rank` becomes the largest rank of all factorizations in the attempted step so far.
        """
        s = Lane(f, self._in.places)
        self.rows.factor(f, of_positions)
        s.highest_rank = f.max(s.highest_rank, self.rows.matrices(f).row("rank").entry(0))

    @property
    def _functions(self) -> dict[str, Callable[[Function], None]]:
        return {
            "accelerations": self._accelerate,
            "newton_q": self._correct_position,
            "newton_v_and_psi": self._correct_velocity,
            "project": self._project,
            "project_and_accelerate": self._project_and_accelerate,
            "end_of_step": self._end_step,
            "tangent_part": self._tangent_part,
        }

    # --- the programs

    def _accelerate(self, f: Function):
        self._in.invoke(f, "dense_accelerations")
        self._factor(f)
        self.rows.correct(f, self.rows.solve(f, "terms", self._in.n), "terms", "out", 1.0)

    def _correct_position(self, f: Function):
        self._in.invoke(f, "dense_newton_q")
        self._factor(f, of_positions=True)
        self.rows.correct(f, self.rows.solve(f, "psi"), "state q", "corrected q")

    def _factor_and_correct_velocity(self, f: Function):
        def correct():
            self._in.invoke(f, "dense_newton_v")
            self._factor(f)
            self.rows.correct(f, self.rows.solve(f, "psi"), "state v", "result v")

        correct()
        if not self._in.code.is_linear:  # a second step of Newton's method
            self._at(f, "state v", "result v", correct)

    def _correct_velocity(self, f: Function):
        self._factor_and_correct_velocity(f)
        self._in.invoke(f, "psi")

    def _at(self, f: Function, name: str, other: str, do: Callable[[], None]):
        """Run `do` with the numbers of the array `other` in the array `name`, and restore `name` afterwards."""
        module, saved = self._in, f"saved {name}"
        module.copy(f, name, saved)
        module.copy(f, other, name)
        do()
        module.copy(f, saved, name)

    def _project(self, f: Function):
        module = self._in
        self._correct_position(f)

        def correct_velocity():
            if self.rows.splits:
                self._factor_and_correct_velocity(f)
                module.invoke(f, "psi")
                return
            module.invoke(f, "psi_dot")
            self.rows.correct(f, self.rows.solve(f, "psi"), "state v", "result v")
            module.invoke(f, "psi")

        self._at(f, "state q", "corrected q", correct_velocity)

    def _project_and_accelerate(self, f: Function):
        module = self._in
        self._factor_and_correct_velocity(f)

        def terms():
            module.invoke(f, "equation_terms" if module.code.is_linear else "dense_accelerations")
            if not module.code.is_linear:
                self._factor(f)

        self._at(f, "state v", "result v", terms)
        self.rows.correct(f, self.rows.solve(f, "terms", module.n), "terms", "result a", 1.0)

    def _end_step(self, f: Function):
        self._project_and_accelerate(f)
        self._correct_changes(f)

    def _tangent_part(self, f: Function):
        self._in.invoke(f, "dense_newton_q")
        self._factor(f)
        self._correct_changes(f)

    def _correct_changes(self, f: Function):
        """Compute the tangent parts `result dq` and `result dv` of the changes `state dq` and `state dv`.

        All rows have been factorized before; if there are rows of phi, those of Psi are factorized again, alone, for dq.
        """
        module, rows = self._in, self.rows
        for x in ("dv", "dq") if rows.splits else ("dq", "dv"):
            change = f"state {x}"
            if x == "dq" and rows.splits:
                self._factor(f, of_positions=True)
            if module.code.couples:
                module.copy(f, change, "change")
                module.invoke(f, "gather", "change")
            rates = rows.solve_rates(f, "change" if module.code.couples else change, of_positions=x == "dq")
            rows.correct(f, rates, change, f"result {x}")
        if "rates" in module.shared:
            self._at(f, "state dq", "result dq", lambda: module.invoke(f, "drift_of_rates"))
            self._factor(f)
            rows.correct(f, rows.solve(f, "drift"), "result dv", "result dv")
