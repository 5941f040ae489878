"""Corrections that close a mechanism, with their derivatives: x - M^(-1/2) D^+ r, for q with r = Psi, and for v with r = Psi_dot.

Small scenes use the correction of least norm, by singular values. With A = W Psi_q M^(-1/2), W the weights of the rows, and
z = A^+ W r, the derivatives along a change of the state and of the numbers, where the rank is constant, are (Golub, Pereyra,
SIAM J. Numer. Anal. 10 (1973) 413)

    dz = A^+ (dr - dA z - A g) + g,        g = dA^T y,        y = (A^+)^T z,

and in reverse mode, from a cotangent w of z,

    u = (A^+)^T w,    h = w - A^T u:    u is the cotangent of r, and -u z^T + y h^T that of A.

While loops are open, redundant rows are inconsistent, and singular values below the rank tolerance are not exactly zero. The
rotation of their singular vectors is neglected. The relative error of the derivative is the product of these singular values and
the violation, at most 1e-6.

Large scenes use elimination of all rows, with dependent rows left out.
"""

from udkjax.expressions.loops.loop_derivative import COTANGENT, TANGENT, LoopDerivative
from udkjax.expressions.loops.loop_program import LoopProgram, Reset
from udkjax.native.language.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.language.program import PointerPlace
from udkjax.native.module.module import Module
from udkjax.native.module.program_derivative import ProgramDerivative
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows


class EliminationCorrection(ProgramDerivative):
    """A correction of q or v by elimination, with its derivatives."""

    def write_adjoint(self):
        """Do nothing: the evaluation already stores all intermediate results."""

    def prepare_derivative(self, f: Function):
        """Do nothing: derivatives by elimination need no preparation."""

    def find_rank(self, f: Function):
        """Set `rank` to the rank of Psi_q, after an evaluation."""
        module = self._module
        with f.each(module.code.scratch["factors"]) as i:
            x = f.load(f.given["work"], i + (module.places["correction"] + self.place("factors")))
            module.put_entry(f, "factors", i, x)
        module.invoke(f, "rank")


class LeastNormCorrection:
    """A correction of x = q or v by singular values, for one lane, with its derivatives.

    An evaluation stores the corrected x, z and y. Derivatives at the same state use the factors of A from the evaluation.
    """

    def __init__(self, module: Module, name: str, rows: WeightedRows):
        self._module, self._name, self._x, self._rows = module, name, name[-1], rows
        self.stored_size = 2 * module.n + module.m
        self._residual = "psi" if self._x == "q" else "psi_dot"
        self._program = module.code.of("psi_q", self._residual, "root")
        fixed = {"t", "sines"} if module.moving else {"t", "sines", "constants"}
        self._derivative = LoopDerivative(self._program.parts, fixed)
        if "root" not in module.places.places:
            module.places.add("root", module.n)
            for name, size in {"psi_q": module.code.scratch["psi_q"], "psi": module.m, "root": module.n}.items():
                module.places.add(f"change {name}", size)

    def place(self, name: str) -> int:
        """Return the offset of an array in `stored`, in numbers: "q1" or "v1" (the corrected x), "z" or "y"."""
        return {f"{self._x}1": 0, "z": self._module.n, "y": 2 * self._module.n}[name]

    def find_rank(self, f: Function):
        """Do nothing: an evaluation sets `rank`."""

    def _changes(self, prefix: str) -> dict[str, tuple[str, int]]:
        arrays = {"psi_q": "psi_q", self._residual: "psi", "root": "root"}
        return {prefix + x: ("work", self._module.places[f"change {to}"]) for x, to in arrays.items()}

    @property
    def _arrays(self) -> dict[str, PointerPlace]:
        places = self._module.places
        return self._module.arrays | {"root": ("work", places["root"]), self._residual: ("work", places["psi"])}

    def _at(self, f: Function, name: str, i: Value) -> Value:
        return self._rows.array(f, name, i)

    def _put(self, f: Function, name: str, i: Value, x: Value):
        self._rows.put(f, name, i, x)

    def _stored(self, f: Function, name: str, i: Value) -> Value:
        return f.load(f.given["stored"], i + self.place(name))

    def _weight(self, f: Function, i: Value) -> Value:
        return self._rows.array(f, "weights", i)

    def evaluation(self):
        """Write `evaluation_<name>(work, out, stored)`: compute the corrected x and z at `stored`, and set `rank`."""
        module = self._module
        module.loops.write(self._program, f"rows_{self._x}", ("work", "out"), self._arrays)
        f, s = module.function(f"evaluation_{self._name}", [(POINTER, "work"), (POINTER, "out"), (POINTER, "stored")])
        module.invoke(f, f"rows_{self._x}")
        self._rows.factor(f)
        s.rank = self._rows.matrices(f).row("rank").entry(0)
        z = self._rows.solve(f, "psi")
        with f.each(module.n) as i:
            f.store(z.entry(i), f.given["stored"], i + self.place("z"))
            f.store(self._at(f, f"state {self._x}", i) - self._at(f, "root", i) * z.entry(i), f.given["stored"], i)

    def write_adjoint(self):
        """Write `adjoint_<name>(work, stored)`: compute y, which only derivatives need."""
        f, _ = self._module.function(f"adjoint_{self._name}", [(POINTER, "work"), (POINTER, "stored")])
        x = self._rows.matrices(f).row("x")
        x.clear()
        with f.each(self._module.n) as i:
            x.put(i, self._stored(f, "z", i))
        y = self._rows.solve_transposed(f)
        with f.each(self._module.m) as i:
            f.store(y.entry(i), f.given["stored"], i + self.place("y"))

    def prepare_derivative(self, f: Function):
        """Compute the additional results that derivatives need, after an evaluation."""
        f.call(f"adjoint_{self._name}", f.given["work"], self._module.address(f, "correction"))

    def forward(self):
        """Write `forward_<name>(work, stored, tangent, out)`: compute the tangent of the corrected x along one direction."""
        module, w = self._module, self._module.tangents
        at = self._arrays | self._changes(TANGENT)
        places = {"constants": "constants", "q": "state q", "v": "state v"}
        at |= {TANGENT + x: ("tangent", w[place]) for x, place in places.items()}
        name = f"row_changes_{self._x}"
        module.loops.write(self._derivative.forward, name, ("work", "tangent"), at)
        arguments = [(POINTER, "work"), (POINTER, "stored"), (POINTER, "tangent"), (POINTER, "out")]
        f, _ = module.function(f"forward_{self._name}", arguments)
        f.call(name, f.given["work"], f.given["tangent"])
        d = self._rows.matrices(f)
        g, right = Value(f, f.reserve(DOUBLE, module.n), POINTER), d.row("b")
        with f.each(module.n) as i:
            f.store(0.0, g, i)
        right.clear()
        with f.each(module.m) as i:
            right.put(i, self._at(f, "change psi", i) * self._weight(f, i))
        for row, column, place, factor in self._rows.entries(f):
            change = self._at(f, "change psi_q", place) * self._at(f, "root", column)
            change = change + self._at(f, "psi_q", place) * self._at(f, "change root", column)
            dA = change * (factor * self._weight(f, row))
            f.store(f.load(g, column) + dA * self._stored(f, "y", row), g, column)
            right.put(row, right.entry(row) - dA * self._stored(f, "z", column))
        for row, column, value in self._rows.weighted_entries(f):
            right.put(row, right.entry(row) - value * self._at(f, "root", column) * f.load(g, column))
        dz = self._rows.solve_right(f)
        with f.each(module.n) as i:
            change = self._at(f, "root", i) * (dz.entry(i) + f.load(g, i))
            change = change + self._at(f, "change root", i) * self._stored(f, "z", i)
            before = f.load(f.given["tangent"], i + w[f"state {self._x}"])
            f.store(before - change, f.given["tangent"], i + w[f"result {self._x}"])

    def reverse(self):
        """Write `reverse_<name>(work, stored, bar)`: pull cotangents of the corrected x back to the state and the constants."""
        module, p = self._module, self._module.places
        bars = {"constants": "bar constants", "q": "bar state q", "v": "bar state v"}
        at = self._arrays | self._changes(COTANGENT)
        at |= {COTANGENT + x: ("work", p[place]) for x, place in bars.items()}
        counts = {"constants": len(module.moving), "q": module.n, "v": module.n}
        cleared = [Reset(COTANGENT + x, 0, count) for x, count in counts.items()]
        name = f"row_cotangents_{self._x}"
        module.loops.write(LoopProgram([*cleared, *self._derivative.reverse.parts]), name, ("work",), at)
        f, _ = module.function(f"reverse_{self._name}", [(POINTER, "work"), (POINTER, "stored"), (POINTER, "bar")])
        h, x = Value(f, f.reserve(DOUBLE, module.n), POINTER), self._rows.matrices(f).row("x")
        x.clear()
        with f.each(module.n) as i:
            bar = self._at(f, f"bar result {self._x}", i)
            right = -(self._at(f, "root", i) * bar)
            x.put(i, right)
            f.store(right, h, i)
            self._put(f, "change root", i, -(self._stored(f, "z", i) * bar))
        u = self._rows.solve_transposed(f)
        for row, column, value in self._rows.weighted_entries(f):
            f.store(f.load(h, column) - value * self._at(f, "root", column) * u.entry(row), h, column)
        with f.each(module.code.scratch["psi_q"]) as i:
            self._put(f, "change psi_q", i, f.const(0.0))
        with f.each(module.m) as i:
            self._put(f, "change psi", i, u.entry(i) * self._weight(f, i))
        for row, column, place, factor in self._rows.entries(f):
            factor = factor * self._weight(f, row)
            bar_A = self._stored(f, "y", row) * f.load(h, column) - u.entry(row) * self._stored(f, "z", column)
            new = self._at(f, "change psi_q", place) + bar_A * factor * self._at(f, "root", column)
            self._put(f, "change psi_q", place, new)
            new = self._at(f, "change root", column) + bar_A * factor * self._at(f, "psi_q", place)
            self._put(f, "change root", column, new)
        f.call(name, f.given["work"])
        with f.each(module.n) as i:
            bar = f"bar state {self._x}"
            self._put(f, bar, i, self._at(f, bar, i) + self._at(f, f"bar result {self._x}", i))
