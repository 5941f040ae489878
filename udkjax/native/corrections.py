"""Corrections that close a mechanism, with their derivatives: x - M^(-1/2) D^+ r of q by r = Psi, and of v by r = Psi_dot.

Those of small scenes are of least norm, by singular values. With the rows weighted, A = W Psi_q M^(-1/2) and z = A^+ W r, along a
change of the state and of the numbers, where the rank is constant (Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973) 413),

    dz = A^+ (dr - dA z - A g) + g,        g = dA^T y,        y = (A^+)^T z,

and transposed, from a cotangent w of z,

    u = (A^+)^T w,    h = w - A^T u:    u is the cotangent of r, and -u z^T + y h^T that of A.

While loops are open, redundant rows contradict each other: singular values below the rank tolerance are not quite zero. How their
vectors turn is left out, which costs as much of the derivative as their product with the violation: a part in a million at worst.

Those of large scenes are by elimination of all rows, without those that depend on others.
"""

from collections.abc import Iterator

from udkjax.expressions.loop_derivative import COTANGENT, TANGENT, LoopDerivative
from udkjax.expressions.loop_program import LoopProgram, Reset
from udkjax.native.ir import POINTER, Function, Value
from udkjax.native.module import Module
from udkjax.native.program_derivative import ProgramDerivative
from udkjax.native.weighted_rows import WeightedRows


class EliminationCorrection(ProgramDerivative):
    """A correction by elimination."""

    def write_adjoint(self):
        """Nothing: derivatives know all that they need from an evaluation."""

    def prepare_derivative(self, f: Function):
        """Nothing."""

    def find_rank(self, f: Function):
        """Leave the rank of Psi_q in `rank`, after an evaluation."""
        module = self._module
        with f.each(module.code.scratch["factors"]) as i:
            x = f.load(f.given["work"], i + (module.places["correction"] + self.place("factors")))
            f.store(x, f.given["work"], i + module.places["factors"])
        module.invoke(f, "rank")


class LeastNormCorrection:
    """A correction by singular values, of one lane. What is stored: x corrected, z, y."""

    def __init__(self, module: Module, name: str):
        self._module, self._name, self._x = module, name, name[-1]
        self._rows = WeightedRows(module)
        self.stored = 2 * module.n + module.m
        self._parts = module.code.rows("psi" if self._x == "q" else "psi_dot")
        fixed = {"t", "sines"} if module.moving else {"t", "sines", "constants"}
        self._derivative = LoopDerivative(self._parts, fixed)
        if "root" not in module.places.places:
            sizes = {"psi_q": module.code.scratch["psi_q"], "psi": module.m, "root": module.n}
            module.places.add("root", module.n)
            module.places.add("A", module.m * module.n)
            module.places.add("right", module.n)
            for name, size in sizes.items():
                module.places.add(f"change {name}", size)

    def place(self, name: str) -> int:
        """Return the place at which an array begins in `stored`."""
        return {f"{self._x}1": 0, "z": self._module.n, "y": 2 * self._module.n}[name]

    def find_rank(self, f: Function):
        """Nothing: an evaluation leaves the rank of Psi_q in `rank`."""

    def _changes(self, prefix: str) -> dict[str, tuple[str, int]]:
        return {prefix + x: ("work", self._module.places[f"change {x}"]) for x in ("psi_q", "psi", "root")}

    def _at(self, f: Function, name: str, i: Value) -> Value:
        return f.load(f.given["work"], i + self._module.places[name])

    def _put(self, f: Function, name: str, i: Value, x: Value):
        f.store(x, f.given["work"], i + self._module.places[name])

    def _stored(self, f: Function, name: str, i: Value) -> Value:
        return f.load(f.given["stored"], i + self.place(name))

    def _solve(self, f: Function, right: str, x: Value, transposed: bool = False):
        """x = A^+ b, or (A^+)^T b, of an array in `work`, with A in an array of its own."""
        n, m = self._module.n, self._module.m
        rows, columns = (n, m) if transposed else (m, n)
        A, b = self._rows.reserve(f, m * n, rows)
        with f.each(m) as i, f.each(n) as k:
            f.store(self._at(f, "A", i * n + k), A, k * m + i if transposed else i * n + k)
        with f.each(rows) as i:
            f.store(self._at(f, right, i), b, i)
        self._rows.solve(f, A, b, x, (rows, columns, 1))

    def _load_rows(self, f: Function):
        """Compute A, and W r in `psi`, of the state."""
        module = self._module
        module.invoke(f, f"rows_{self._x}")
        self._rows.write(f, module.address(f, "A"))
        with f.each(module.m) as i:
            self._put(f, "psi", i, self._at(f, "psi", i) * self._rows.weight(f, i))

    def evaluation(self):
        module = self._module
        at = module.arrays | {"root": ("work", module.places["root"])}
        module.loops.write(LoopProgram([module.code.sincos, *self._parts]), f"rows_{self._x}", ("work", "out"), at)
        f, _ = module.function(f"evaluation_{self._name}", [(POINTER, "work"), (POINTER, "out"), (POINTER, "stored")])
        self._load_rows(f)
        z = f.at(f.given["stored"], self.place("z"))
        self._solve(f, "psi", z)
        with f.each(module.n) as i:
            f.store(self._at(f, f"state {self._x}", i) - self._at(f, "root", i) * self._stored(f, "z", i), f.given["stored"], i)

    def write_adjoint(self):
        """`adjoint_...(work, stored)`: y, which derivatives need besides."""
        module = self._module
        f, _ = module.function(f"adjoint_{self._name}", [(POINTER, "work"), (POINTER, "stored")])
        with f.each(module.n) as i:
            self._put(f, "right", i, self._stored(f, "z", i))
        self._solve(f, "right", f.at(f.given["stored"], self.place("y")), transposed=True)

    def prepare_derivative(self, f: Function):
        """Compute what derivatives need besides, behind an evaluation."""
        f.call(f"adjoint_{self._name}", f.given["work"], self._module.address(f, "correction"))

    def forward(self):
        module, w = self._module, self._module.tangents
        at = module.arrays | {"root": ("work", module.places["root"])} | self._changes(TANGENT)
        places = {"constants": "constants", "q": "state q", "v": "state v"}
        at |= {TANGENT + x: ("tangent", w[place]) for x, place in places.items()}
        name = f"row_changes_{self._x}"
        module.loops.write(self._derivative.forward, name, ("work", "tangent"), at)
        arguments = [(POINTER, "work"), (POINTER, "stored"), (POINTER, "tangent"), (POINTER, "out")]
        f, _ = module.function(f"forward_{self._name}", arguments)
        f.call(name, f.given["work"], f.given["tangent"])
        g, dz = self._rows.reserve(f, module.n, module.n)
        with f.each(module.n) as i:
            f.store(0.0, g, i)
        with f.each(module.m) as i:
            self._put(f, "change psi", i, self._at(f, "change psi", i) * self._rows.weight(f, i))

        def entries() -> Iterator[tuple[Value, Value, Value]]:
            """The row, the column and the change of each entry of A."""
            for row, column, place, factor in self._rows.entries(f):
                change = self._at(f, "change psi_q", place) * self._at(f, "root", column)
                change = change + self._at(f, "psi_q", place) * self._at(f, "change root", column)
                yield row, column, change * (factor * self._rows.weight(f, row))

        for row, column, dA in entries():
            f.store(f.load(g, column) + dA * self._stored(f, "y", row), g, column)
            self._put(f, "change psi", row, self._at(f, "change psi", row) - dA * self._stored(f, "z", column))
        with f.each(module.m) as i, f.each(module.n) as k:
            self._put(f, "change psi", i, self._at(f, "change psi", i) - self._at(f, "A", i * module.n + k) * f.load(g, k))
        self._solve(f, "change psi", dz)
        with f.each(module.n) as i:
            change = self._at(f, "root", i) * (f.load(dz, i) + f.load(g, i))
            change = change + self._at(f, "change root", i) * self._stored(f, "z", i)
            before = f.load(f.given["tangent"], i + w[f"state {self._x}"])
            f.store(before - change, f.given["tangent"], i + w[f"result {self._x}"])

    def reverse(self):
        module, p = self._module, self._module.places
        found = {"constants": "bar constants", "q": "bar state q", "v": "bar state v"}
        at = module.arrays | {"root": ("work", p["root"])} | self._changes(COTANGENT)
        at |= {COTANGENT + x: ("work", p[place]) for x, place in found.items()}
        counts = {"constants": len(module.moving), "q": module.n, "v": module.n}
        cleared = [Reset(COTANGENT + x, 0, count) for x, count in counts.items()]
        name = f"row_cotangents_{self._x}"
        module.loops.write(LoopProgram([*cleared, *self._derivative.reverse.parts]), name, ("work",), at)
        f, _ = module.function(f"reverse_{self._name}", [(POINTER, "work"), (POINTER, "stored"), (POINTER, "bar")])
        u, h = self._rows.reserve(f, module.m, module.n)
        with f.each(module.n) as i:
            bar = self._at(f, f"bar result {self._x}", i)
            self._put(f, "right", i, -(self._at(f, "root", i) * bar))
            self._put(f, "change root", i, -(self._stored(f, "z", i) * bar))
        self._solve(f, "right", u, transposed=True)
        with f.each(module.n) as k:
            f.store(self._at(f, "right", k), h, k)
            with f.each(module.m) as i:
                f.store(f.load(h, k) - self._at(f, "A", i * module.n + k) * f.load(u, i), h, k)
        with f.each(module.code.scratch["psi_q"]) as i:
            self._put(f, "change psi_q", i, f.const(0.0))
        with f.each(module.m) as i:
            self._put(f, "change psi", i, f.load(u, i) * self._rows.weight(f, i))
        for row, column, place, factor in self._rows.entries(f):
            factor = factor * self._rows.weight(f, row)
            of_A = self._stored(f, "y", row) * f.load(h, column) - f.load(u, row) * self._stored(f, "z", column)
            moved = self._at(f, "change psi_q", place) + of_A * factor * self._at(f, "root", column)
            self._put(f, "change psi_q", place, moved)
            moved = self._at(f, "change root", column) + of_A * factor * self._at(f, "psi_q", place)
            self._put(f, "change root", column, moved)
        f.call(name, f.given["work"])
        with f.each(module.n) as i:
            bar = f"bar state {self._x}"
            self._put(f, bar, i, self._at(f, bar, i) + self._at(f, f"bar result {self._x}", i))
