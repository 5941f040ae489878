"""Machine code that closes a mechanism: the loop of equations/rows/position_closure.py at run time, also for traced numbers.

    q <- q - s C J^T y,      J C J^T y = Psi,      J = Psi_q,      C = M^(-1)

with steps of limited length, which are halved until the residual decreases; then v is projected onto the constraints. The
corrections of corrections.py use all rows.
"""

from collections.abc import Callable, Sequence

import numpy as np

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.closing.corrections import EliminationCorrection, LeastNormCorrection
from udkjax.native.language.ir import INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.module import Module
from udkjax.native.module.tableau import EULER
from udkjax.native.pseudoinverses.svd import SVDCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows
from udkjax.native.run.members import write_begin

CORRECTED_QUANTITIES = "qv"  # corrected quantities, by their index in a record


class Closing(Module):
    """The text of a module whose `run` closes members, from their guesses q and v at the time ts[0]."""

    settings = ("length", "fallback_tol")
    results = ("state", "residuals", "rank")
    further = 1  # further corrections, of the closed state, which only change derivatives

    def __init__(self, code: RunPrograms, vector: int, active: Sequence[bool] = ()):
        plan = Plan(code, EULER, projected=False, breaks=False, width=1, vector=vector, unrolled=False, steps=False)
        super().__init__(plan, active=active)
        self.active, self.count = active, len(self.moving)
        self._rows = WeightedRows(self, SVDCode(relative=True)) if code.is_small else None
        self.corrections = {x: self._correction(f"newton_{x}") for x in CORRECTED_QUANTITIES}
        self.places.add("correction", max(x.stored_size for x in self.corrections.values()))

    def _correction(self, name: str) -> LeastNormCorrection | EliminationCorrection:
        return LeastNormCorrection(self, name, self._rows) if self._rows else EliminationCorrection(self, name)

    def write_functions(self):
        self.write_programs()
        if self._rows:
            self._rows.write()
        for correction in self.corrections.values():
            correction.evaluation()
        self.write_derivatives()
        write_begin(self)
        self._close()

    def program_names(self) -> list[str]:
        return ["psi", "psi_dot"] if self.code.is_small else ["psi", "psi_dot", "rank"]

    def _close(self):
        """Write `close(work, call)`: close the member in the only lane."""
        f, s = self.function("close", [(POINTER, "work"), (POINTER, "call")])
        n, m = self.n, self.m

        def size() -> Value:
            """Return the norm of Psi at the state, each row divided by its scale; NaN if any row is NaN."""
            self.invoke(f, "psi")
            total = f.variable(0.0)
            with f.each(m) as i:
                relative = self.entry(f, "psi", i) / self.entry(f, "rows", i)
                total.value = f.fma(relative, relative, total.value)
            return f.intrinsic("sqrt", total.value)

        def move(scale: Value):
            with f.each(n) as i:
                q = f.fma(scale, self.entry(f, "state dq", i), self.entry(f, "corrected q", i))
                self.put_entry(f, "state q", i, q)

        setattr(s, "state t", s.start)
        with f.each(n) as i:
            for name in "qv":
                self.put_entry(f, f"state {name}", i, self.entry(f, f"point3 {name}", i))
        better, steps = f.variable(1.0), f.variable(0, INT)
        with f.while_(lambda: (better.value > 0.5) & (steps.value < CLOSURE.steps)):
            steps.value = steps.value + 1
            before = size()
            largest, longest = f.variable(1.0), f.variable(0.0)
            with f.each(n) as i:
                q = self.entry(f, "state q", i)
                largest.value = f.max(f.abs(q) * self.entry(f, "inverse unit", i), largest.value)
                self.put_entry(f, "corrected q", i, q)
            better.value = f.select(before > largest.value * (CLOSURE.rounding * np.finfo(float).eps), f.const(1.0), 0.0)
            with f.if_(better.value > 0.5):
                self._correct(f, "q")
                with f.each(n) as i:
                    step = f.abs(self.entry(f, "state dq", i)) * self.entry(f, "inverse unit", i)
                    longest.value = f.max(step, longest.value)
                scale = f.variable(
                    f.select(longest.value > CLOSURE.longest_step, CLOSURE.longest_step / longest.value, f.const(1.0))
                )
                halvings, better.value = f.variable(0, INT), 0.0
                with f.while_(lambda: (better.value < 0.5) & (halvings.value < CLOSURE.halvings)):
                    move(scale.value)
                    better.value = f.select(size() < before, f.const(1.0), 0.0)
                    scale.value = scale.value * 0.5
                    halvings.value = halvings.value + 1
                with f.if_(better.value < 0.5):
                    move(f.const(0.0))
                with f.if_(better.value > 0.5):
                    step_scale = scale.value * 2.0
                    limited = f.select(longest.value > CLOSURE.longest_step, f.const(1.0), 0.0)
                    self._at_previous_state(f, "q", lambda: self._record_correction(f, "q", step_scale, limited))
        for _ in range(self.further):
            self._record_correction(f, "q", f.const(1.0), f.const(0.0))
        for _ in range(CLOSURE.velocities):
            self._record_correction(f, "v", f.const(1.0), f.const(0.0))
            self._correct(f, "v")
            with f.each(n) as i:
                self.put_entry(f, "state v", i, self.entry(f, "state v", i) + self.entry(f, "state dv", i))
        self._write_result(f, s)

    def _write_result(self, f: Function, s: Lane):
        """Write the state, its Psi and Psi_dot, and the rank of D to the outputs."""
        member = self.to_int(f, s.member)
        state, residuals = (self.result_address(f, x, member, 2 * size) for x, size in (("state", self.n), ("residuals", self.m)))
        self.copy_lane(f, state, 0, "state q", f.const(0, INT))
        self.copy_lane(f, state, self.n, "state v", f.const(0, INT))
        for name, offset in (("psi", 0), ("psi_dot", self.m)):
            self.invoke(f, name)
            with f.each(self.m) as i:
                f.store(self.entry(f, "psi", i), residuals, i + offset)
        self.corrections["v"].find_rank(f)
        f.store(s.rank, self.result_address(f, "rank", member, 1))
        self._finish_closing(f, member)

    def _evaluate(self, f: Function, x: str):
        """Evaluate a correction of q or v (`x`) at the state, with the intermediate results that derivatives need."""
        f.call(f"evaluation_newton_{x}", f.given["work"], f.given["work"], self.address(f, "correction"))

    def change(self, f: Function, x: str, i: Value) -> Value:
        """Return coordinate i of the latest correction of q or v (`x`), before its length is limited."""
        place = self.places["correction"] + self.corrections[x].place(f"{x}1")
        return f.load(f.given["work"], i + place) - self.entry(f, f"state {x}", i)

    def _correct(self, f: Function, x: str):
        """Compute the correction of q or v (`x`) at the state as `state dq` or `state dv`, before its length is limited."""
        self._evaluate(f, x)
        with f.each(self.n) as i:
            self.put_entry(f, f"state d{x}", i, self.change(f, x, i))

    # --- hooks for derivatives (closing_derivatives.py)

    def _record_correction(self, f: Function, x: str, scale: Value, limited: Value):
        """Hook: add code at the state before each correction of q or v (`x`). Does nothing by default.

        `scale`: the factor of the correction; `limited`: one if this factor limits the length of the step, else zero.
        """

    def _finish_closing(self, f: Function, member: Value):
        """Hook: add code after a member has been closed and its results have been written. Does nothing by default."""

    def _at_previous_state(self, f: Function, x: str, do: Callable[[], None]):
        """Run `do` at the state before a step, which is in `corrected q`, and return to the state after it."""
        with f.each(self.n) as i:
            current, before = self.entry(f, f"state {x}", i), self.entry(f, "corrected q", i)
            self.put_entry(f, "corrected q", i, current)
            self.put_entry(f, f"state {x}", i, before)
        do()
        with f.each(self.n) as i:
            self.put_entry(f, f"state {x}", i, self.entry(f, "corrected q", i))

    def step_all(self, f: Function, s: Lane, fill):
        f.call("close", f.given["work"], f.given["call"])
        s.active = f.const(0.0)
        fill()
