"""The equations of a scene solved by a dense pseudoinverse of all rows, in place of elimination.

With D = W Psi_q M^(-1/2), W the weights of the rows, and a method of pseudoinverses/,

    a = a_F + M^(-1/2) D^+ W b,        q - M^(-1/2) D^+ W Psi,        v - M^(-1/2) D^+ W Psi_dot,

and the part of a small change within the manifold, dq - M^(-1/2) D^+ W Psi_q dq. The functions have the names and results of the
scene's programs by elimination. What belongs to one state is solved by the same factors.
"""

from collections.abc import Callable, Iterator

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Operand, Value
from udkjax.native.module import Module
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices, DenseMethod, MatrixRow
from udkjax.native.weighted_rows import RowEntries

FACTOR, SOLVE = "factor_rows", "solve_rows"


class DenseEquations:
    """The functions of a module whose method is dense."""

    def __init__(self, module: Module, method: DenseMethod):
        self._in, self._method = module, method
        self._layout = DenseLayout(module, method.matrices(module.m, module.n), (module.m, module.n))
        module.places.add("weights", module.m)
        module.places.add("saved", module.n)

    def write(self):
        """Write the functions that the module calls in place of programs."""
        module = self._in
        f, _ = module.function(FACTOR)
        self._method.factor(DenseMatrices(self._layout, f))
        f, _ = module.function(SOLVE)
        self._method.solve(DenseMatrices(self._layout, f))
        for name, write in self._functions.items():
            if name in module.solving:
                f, s = module.function(name, [(POINTER, "work"), (POINTER, "out")])
                s.safe = f.const(1.0, DOUBLE, f.width)
                write(f)

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

    def begin_member(self, f: Function, lane: Value, length: Value):
        """Note the weights of the rows, of the member that is taken into a lane."""
        module, work = self._in, f.given["work"]
        with f.each(module.m) as i:
            scale = f.load(work, (i + module.places["rows"]) * f.width + lane)
            f.store(length / scale, work, (i + module.places["weights"]) * f.width + lane)

    def number_columns(self, f: Function):
        """Store the numbers of columns, once a run."""
        DenseMatrices(self._layout, f).number_columns()

    # --- D x = b

    def _array(self, f: Function, name: str, i: Operand) -> Value:
        """One number of an array, in all lanes."""
        return f.load(f.given["work"], f.like(i, INT, 1) * f.width + self._in.start(name, "work"), f.width)

    def _each_entry(self, f: Function) -> Iterator[tuple[Value, Value, Value]]:
        """The row, the column and the value of each entry of W Psi_q."""
        for row, column, place, factor in RowEntries(self._in).entries(f):
            yield row, column, self._array(f, "psi_q", place) * factor * self._array(f, "weights", row)

    def _factor(self, f: Function):
        """Factorize D, of the entries of Psi_q at hand."""
        d = DenseMatrices(self._layout, f)
        with f.each(d.m) as i:
            d.row("D", i).clear()
        for row, column, value in self._each_entry(f):
            d.row("D", row).put(column, value * self._array(f, "root", column))
        f.call(FACTOR, f.given["work"])

    def _solve(self, f: Function, right: str, start: int = 0) -> MatrixRow:
        """Return D^+ W b, with b in an array."""
        d = DenseMatrices(self._layout, f)
        b = d.row("b")
        b.clear()  # what fills the last register has been multiplied by what was no number, perhaps
        with f.each(d.m) as i:
            b.put(i, self._array(f, right, i + start) * self._array(f, "weights", i))
        f.call(SOLVE, f.given["work"])
        return d.row("x")

    def _solve_rates(self, f: Function, change: str) -> MatrixRow:
        """Return D^+ W Psi_q dq."""
        d = DenseMatrices(self._layout, f)
        b = d.row("b")
        b.clear()
        for row, column, value in self._each_entry(f):
            b.put(row, f.fma(value, self._array(f, change, column), b.entry(row)))
        f.call(SOLVE, f.given["work"])
        return d.row("x")

    def _correct(self, f: Function, x: MatrixRow, start: str, to: str, sign: float = -1.0):
        """Write `start` plus or minus M^(-1/2) x; `to` is an array, or `out`."""
        place = 0 if to == "out" else self._in.start(to, "work")
        with f.each(self._in.n) as i:
            change, old = self._array(f, "root", i) * x.entry(i), self._array(f, start, i)
            pointer = f.given["out" if to == "out" else "work"]
            f.store(old + change if sign > 0 else old - change, pointer, i * f.width + place, f.width)

    # --- the programs

    def _accelerate(self, f: Function):
        self._in.invoke(f, "dense_accelerations")
        self._factor(f)
        self._correct(f, self._solve(f, "terms", self._in.n), "terms", "out", 1.0)

    def _correct_position(self, f: Function):
        self._in.invoke(f, "dense_newton_q")
        self._factor(f)
        self._correct(f, self._solve(f, "psi"), "state q", "corrected q")

    def _factor_and_correct_velocity(self, f: Function):
        self._in.invoke(f, "dense_newton_v")
        self._factor(f)
        self._correct(f, self._solve(f, "psi"), "state v", "result v")

    def _correct_velocity(self, f: Function):
        self._factor_and_correct_velocity(f)
        self._in.invoke(f, "psi")

    def _at(self, f: Function, name: str, other: str, do: Callable[[], None]):
        """Do something with another array in place of one."""
        module = self._in
        module.copy(f, name, "saved")
        module.copy(f, other, name)
        do()
        module.copy(f, "saved", name)

    def _project(self, f: Function):
        module = self._in
        self._correct_position(f)

        def correct_velocity():
            module.invoke(f, "psi_dot")
            self._correct(f, self._solve(f, "psi"), "state v", "result v")
            module.invoke(f, "psi")

        self._at(f, "state q", "corrected q", correct_velocity)

    def _project_and_accelerate(self, f: Function):
        module = self._in
        self._factor_and_correct_velocity(f)
        self._at(f, "state v", "result v", lambda: module.invoke(f, "equation_terms"))
        self._correct(f, self._solve(f, "terms", module.n), "terms", "result a", 1.0)

    def _end_step(self, f: Function):
        self._project_and_accelerate(f)
        self._correct_changes(f)

    def _tangent_part(self, f: Function):
        self._in.invoke(f, "dense_newton_q")
        self._factor(f)
        self._correct_changes(f)

    def _correct_changes(self, f: Function):
        for x in ("dq", "dv"):
            self._correct(f, self._solve_rates(f, f"state {x}"), f"state {x}", f"result {x}")
