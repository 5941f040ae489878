"""Derivatives of closing a mechanism: of its steps as they are, forward along directions and backward.

A correction is x = A^+ r, of least norm, with A = Psi_q M^(-1/2) and r = Psi (or Psi_dot), both with their rows weighted. Along a
change of the state and of the numbers, where the rank is constant (Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973) 413),

    dx = A^+ (dr - dA x - A g) + g,        g = dA^T y,        y = (A^+)^T x,

and transposed, from a cotangent w of x,

    u = (A^+)^T w,    h = w - A^T u:    u is the cotangent of r, and -u x^T + y h^T that of A.

The coordinates change by -s M^(-1/2) x; s, where it limits the step, is a function of it, too. Behind the last step there is one
more correction, which changes nothing but the derivative: it returns it to the constraint manifold. dA, dr and d M^(-1/2) are
straight-line programs of the constants, q and v.

While loops are open, redundant rows contradict each other: singular values below the rank tolerance are not quite zero. How their
vectors turn is left out, which costs as much of the derivative as their product with the violation: a part in a million at worst.
"""

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.expressions import ScalarProgram, cotangents, tangents
from udkjax.native.closing import POSITION, VELOCITY
from udkjax.native.closing_modes import ClosingDerivative, ForwardMode, ReverseMode
from udkjax.native.fallback import entries
from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Lane
from udkjax.native.least_norm import LEAST_NORM
from udkjax.native.prologue import write_prologue_forward, write_prologue_reverse


class _StraightLine(ClosingDerivative):
    """What both modes have in common: the change of the rows, and (A^+)^T."""

    def __init__(self, code: ScenePrograms, active: tuple[bool, ...], vector: int):
        super().__init__(code, vector)
        graph, e = code.graph, code.equations
        self.value_count = code.pattern.value_count
        self.changed = [*code.entries, *e.psi, *e.psi_dot, *code.root]
        self.active, self.active_numbers = active, sum(active)
        self.given = [*code.constants, e.t, *e.q, *e.v]
        self.state = [*code.constants, *e.q, *e.v]
        self.graph = graph
        for name, count in (("Y", self.m), ("x", self.n), ("r", self.m), ("g", self.n)):
            self.places.add(name, count)

    def _write_transposed(self):
        """`transposed`: y = (A^+)^T x of what is in x, into Y; A is that of R."""
        n, m = self.n, self.m
        f, s = self.function("transposed", [(POINTER, "work"), (POINTER, "x"), (POINTER, "y")])
        A, b = (Value(f, f.reserve(DOUBLE, max(c, 1)), POINTER) for c in (m * n, n))
        with f.each(m * n) as i:
            f.store(0.0, A, i)
        with f.each(n) as i:
            f.store(f.load(f.given["x"], i), b, i)
        for row, column, slot, sign in entries(self, f):
            f.store(self._entry(f, row, slot, sign), A, column * m + row)
        rank = Value(f, f.reserve(DOUBLE), POINTER)
        f.call(LEAST_NORM, A, b, f.given["y"], f.const(n, INT), f.const(m, INT), s.fallback_tol, rank)

    def _weight(self, f: Function, row: Value) -> Value:
        return Lane(f, self.places).length / self._at(f, "rows", row)

    def _entry(self, f: Function, row: Value, slot: Value, sign: Value) -> Value:
        """An entry of A."""
        return self._at(f, "R", slot) * sign * self._weight(f, row)

    def _root(self, f: Function, i: Value) -> Value:
        return self._at(f, "R", i + (self.value_count + self.m + self.n))

    def _solve_correction(self, f: Function, kind: int):
        """x and y of the correction at the state in X, with A in R."""
        self.invoke(f, "equation_terms")
        self.invoke(f, "psi_dot" if kind == VELOCITY else "psi")
        s = Lane(f, self.places)
        with f.each(self.m) as i:
            self._set(f, "r", i, self._at(f, "psi", i))
        f.call("solve", f.given["work"], f.const(0, INT), self.address(f, "r"), self.address(f, "x"), s.fallback_tol)
        f.call("transposed", f.given["work"], self.address(f, "x"), self.address(f, "Y"))

    def _longest(self, f: Function) -> tuple[Value, Value]:
        """The largest change of a coordinate by the whole correction, in units of the scene, and which it is."""
        longest, which = f.variable(0.0), f.variable(0, INT)
        with f.each(self.n) as i:
            size = f.abs(self._root(f, i) * self._at(f, "x", i)) * self._at(f, "inverse unit", i)
            which.value = f.select(size > longest.value, i, which.value)
            longest.value = f.max(size, longest.value)
        return longest.value, which.value


class ClosingForward(_StraightLine, ForwardMode):
    """Closing along directions, with its programs written out."""

    def __init__(self, code: ScenePrograms, active: tuple[bool, ...], vector: int):
        super().__init__(code, active, vector)
        self._add_tangents()
        w = self.tangents
        for name in ("g", "dx"):
            w.add(name, self.n)
        w.add("changes", len(self.changed))
        w.add("right", self.m)

    def text(self) -> str:
        """LLVM's text of the whole module."""
        graph = self.graph
        seeds = {s: graph.input(("closing", s.index), "tangent") for s in self.state}
        changes = tangents(graph, self.changed, seeds)
        w = self.tangents
        inputs = [*self.state_places(), *(("tangent", w["constants"] + k) for k in range(self.constants))]
        inputs += [("tangent", w[f"X {x}"] + k) for x in "qv" for k in range(self.n)]
        program = ScalarProgram(graph, [*self.given, *seeds.values()], changes)
        places = [("tangent", w["changes"] + k) for k in range(len(changes))]
        self.write_program(program, "changes", ("work", "tangent"), inputs, places)
        write_prologue_forward(self, self.active, [True] * self.constants)
        self._write_transposed()
        for name, kind in (("push_position", POSITION), ("push_velocity", VELOCITY)):
            self._push(name, kind)
        return super().text()

    def _push(self, name: str, kind: int):
        f, s = self.function(name, [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        self._solve_correction(f, kind)
        longest, which = self._longest(f)
        residual, root = self.value_count + (self.m if kind == VELOCITY else 0), self.value_count + 2 * self.m
        scale = f.given["scale"]
        with self._each_tangent(f):
            f.call("changes", f.given["work"], f.given["tangent"])
            with f.each(self.n) as i:
                self._set(f, "g", i, f.const(0.0), "tangent")
            with f.each(self.m) as i:
                self._set(f, "right", i, self._at(f, "changes", i + residual, "tangent"), "tangent")
            for row, column, slot, sign in entries(self, f):
                change = self._at(f, "changes", slot, "tangent") * sign
                self._increase(f, "g", column, change * self._weight(f, row) * self._at(f, "Y", row), "tangent")
                self._increase(f, "right", row, -(change * self._at(f, "x", column)), "tangent")
            for row, column, slot, sign in entries(self, f):
                self._increase(f, "right", row, -(self._at(f, "R", slot) * sign * self._at(f, "g", column, "tangent")), "tangent")
            right, dx = (f.at(f.given["tangent"], self.tangents[x]) for x in ("right", "dx"))
            f.call("solve", f.given["work"], f.const(0, INT), right, dx, s.fallback_tol)
            change = f.variable(0.0)  # of the longest step, over its length
            with f.each(self.n) as i:
                x, root_i = self._at(f, "x", i), self._root(f, i)
                step = f.fma(root_i, self._at(f, "dx", i, "tangent") + self._at(f, "g", i, "tangent"), 0.0)
                step = f.fma(self._at(f, "changes", i + root, "tangent"), x, step)
                self._set(f, "dx", i, step, "tangent")
                change.value = f.select(i.is_(which), step / (root_i * x), change.value)
            change.value = f.select((f.given["limited"] > 0.5) & (longest > 0.0), change.value, 0.0)
            to = "X v" if kind == VELOCITY else "X q"
            with f.each(self.n) as i:
                step, whole = self._at(f, "dx", i, "tangent"), self._root(f, i) * self._at(f, "x", i)
                self._increase(f, to, i, -(scale * (step - change.value * whole)), "tangent")


class ClosingReverse(_StraightLine, ReverseMode):
    """Closing and back, with its programs written out."""

    def __init__(self, code: ScenePrograms, active: tuple[bool, ...], vector: int):
        super().__init__(code, active, vector)
        self._add_record(self.active_numbers)
        for name, count in {"bars": len(self.changed), "w": self.n, "u": self.m}.items():
            self.places.add(name, count)

    def text(self) -> str:
        """LLVM's text of the whole module."""
        graph, n = self.graph, self.n
        seeds = [graph.input(("closing", k), "cotangent") for k in range(len(self.changed))]
        program = ScalarProgram(graph, [*self.given, *seeds], cotangents(graph, self.changed, seeds, self.state))
        inputs = [*self.state_places(), *self.work_places("bars", len(seeds))]
        found = [*self.work_places("G c", self.constants), *self.work_places("G q", n), *self.work_places("G v", n)]
        self.write_program(program, "pull_rows", ("work",), inputs, found)
        write_prologue_reverse(self, self.active, [True] * self.constants)
        self._write_transposed()
        for name, kind in (("pull_position", POSITION), ("pull_velocity", VELOCITY)):
            self._pull(name, kind)
        return super().text()

    def _pull(self, name: str, kind: int):
        f, _ = self.function(name, [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        self._solve_correction(f, kind)
        longest, which = self._longest(f)
        residual, root = self.value_count + (self.m if kind == VELOCITY else 0), self.value_count + 2 * self.m
        to = "B v" if kind == VELOCITY else "B q"
        with f.each(len(self.changed)) as i:
            self._set(f, "bars", i, f.const(0.0))
        along = f.variable(0.0)
        with f.each(self.n) as i:
            bar = -(f.given["scale"] * self._at(f, to, i))
            along.value = f.fma(bar, self._root(f, i) * self._at(f, "x", i), along.value)
            self._set(f, "w", i, bar)
        limits = (f.given["limited"] > 0.5) & (longest > 0.0)
        with f.if_(limits):
            length = self._root(f, which) * self._at(f, "x", which)
            self._increase(f, "w", which, -(along.value / length))
        with f.each(self.n) as i:
            bar = self._at(f, "w", i)
            self._set(f, "bars", i + root, bar * self._at(f, "x", i))
            self._set(f, "w", i, bar * self._root(f, i))
            self._set(f, "g", i, bar * self._root(f, i))
        f.call("transposed", f.given["work"], self.address(f, "w"), self.address(f, "u"))
        for row, column, slot, sign in entries(self, f):
            self._increase(f, "g", column, -(self._entry(f, row, slot, sign) * self._at(f, "u", row)))
        for row, column, slot, sign in entries(self, f):
            bar = f.fma(self._at(f, "Y", row), self._at(f, "g", column), -(self._at(f, "u", row) * self._at(f, "x", column)))
            self._increase(f, "bars", slot, bar * sign * self._weight(f, row))
        with f.each(self.m) as i:
            self._set(f, "bars", i + residual, self._weight(f, i) * self._at(f, "u", i))
        f.call("pull_rows", f.given["work"])
        self._accumulate(f)
