"""Closing a large mechanism, and its derivatives: with the corrections of its programs of loops.

A correction q - M^(-1/2) D^T x, D D^T x = Psi, is by elimination of all rows, without those that depend on others. Its derivative
is that of equations/loop_programs.py; the length of a step that is limited is a function of it, too.
"""

from typing import Any

from udkjax.equations.loop_programs import LoopPrograms
from udkjax.native.closing import POSITION, VELOCITY, Closing
from udkjax.native.closing_modes import ForwardMode, ReverseMode
from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Lane
from udkjax.native.linearization import ByLoops
from udkjax.native.prologue import write_prologue_forward, write_prologue_reverse

KINDS = {"position": (POSITION, "q"), "velocity": (VELOCITY, "v")}


class ClosingByLoops(Closing):
    """The text of a module that closes members, of `LoopPrograms` of all rows."""

    def __init__(self, code: Any, vector: int):
        super().__init__(code, vector)
        self.count = len(code.constants)
        self.corrections = {name: ByLoops(self, name) for name in KINDS}
        self.places.add("K", max(x.stored for x in self.corrections.values()))

    def program_names(self, code: LoopPrograms) -> dict[str, Any]:
        return {"psi": code.psi, "psi_dot": code.psi_dot, "rank": code.rank}

    def _write_solver(self):
        for correction in self.corrections.values():
            correction.evaluation()

    def _evaluate(self, f: Function, name: str):
        """The corrected state, in `K`."""
        f.call(f"evaluation_{name}", f.given["work"], self.address(f, "K"))

    def _change(self, f: Function, name: str, i: Value) -> Value:
        """A coordinate of the whole correction."""
        x = KINDS[name][1]
        place = self.places["K"] + self.corrections[name].place(f"{x}1")
        return f.load(f.given["work"], i + place) - f.load(f.given["work"], i + self.places[f"X {x}"])

    def _correction(self, f: Function, s: Lane, kind: int, to: str):
        del s
        name = "velocity" if kind == VELOCITY else "position"
        self._evaluate(f, name)
        with f.each(self.n) as i:
            f.store(self._change(f, name, i), f.given["work"], i + self.places[to])

    def _set_rank(self, f: Function):
        self._evaluate(f, "position")
        with f.each(self.code.scratch["factors"]) as i:
            x = f.load(f.given["work"], i + (self.places["K"] + self.corrections["position"].place("factors")))
            f.store(x, f.given["work"], i + self.places["factors"])
        self.invoke(f, "rank")

    def _longest(self, f: Function, name: str) -> tuple[Value, Value]:
        """The largest change of a coordinate by the whole correction, in units of the scene, and which it is."""
        longest, which = f.variable(0.0), f.variable(0, INT)
        with f.each(self.n) as i:
            unit = f.load(f.given["work"], i + self.places["inverse unit"])
            size = f.abs(self._change(f, name, i)) * unit
            which.value = f.select(size > longest.value, i, which.value)
            longest.value = f.max(size, longest.value)
        return longest.value, which.value


class ForwardByLoops(ClosingByLoops, ForwardMode):
    """Closing along directions."""

    def __init__(self, code: Any, active: tuple[bool, ...], vector: int):
        super().__init__(code, vector)
        self.active_numbers = sum(active)
        self._add_tangents()

    def text(self) -> str:
        """LLVM's text of the whole module."""
        everything = [True] * self.active_numbers
        write_prologue_forward(self, everything, everything)
        for name, correction in self.corrections.items():
            correction.forward()
            self._push(name)
        return super().text()

    def _push(self, name: str):
        f, _ = self.function(f"push_{name}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        x = KINDS[name][1]
        self._evaluate(f, name)
        longest, which = self._longest(f, name)
        limits = (f.given["limited"] > 0.5) & (longest > 0.0)
        with self._each_tangent(f):
            f.call(f"forward_{name}", f.given["work"], self.address(f, "K"), f.given["tangent"], f.given["tangent"])
            change = f.variable(0.0)  # of the longest step, over its length
            with f.each(self.n) as i:
                step = self._at(f, f"O {x}", i, "tangent") - self._at(f, f"X {x}", i, "tangent")
                self._set(f, f"O {x}", i, step, "tangent")
                change.value = f.select(i.is_(which), step / self._change(f, name, i), change.value)
            share = f.select(limits, change.value, 0.0)
            with f.each(self.n) as i:
                step = self._at(f, f"O {x}", i, "tangent") - share * self._change(f, name, i)
                self._increase(f, f"X {x}", i, f.given["scale"] * step, "tangent")


class ReverseByLoops(ClosingByLoops, ReverseMode):
    """Closing and back."""

    def __init__(self, code: Any, active: tuple[bool, ...], vector: int):
        super().__init__(code, vector)
        self.active_numbers = sum(active)
        self._add_record(code.prologue_input_count)
        for name in ("Y q", "Y v"):
            self.places.add(name, self.n)

    def text(self) -> str:
        """LLVM's text of the whole module."""
        everything = [True] * self.active_numbers
        write_prologue_reverse(self, everything, everything)
        for name, correction in self.corrections.items():
            correction.reverse()
            self._pull(name)
        return super().text()

    def _pull(self, name: str):
        f, _ = self.function(f"pull_{name}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        x = KINDS[name][1]
        self._evaluate(f, name)
        longest, which = self._longest(f, name)
        along = f.variable(0.0)
        with f.each(self.n) as i:
            bar = f.given["scale"] * self._at(f, f"B {x}", i)
            along.value = f.fma(bar, self._change(f, name, i), along.value)
            self._set(f, f"Y {x}", i, bar)
        with f.if_((f.given["limited"] > 0.5) & (longest > 0.0)):
            self._increase(f, f"Y {x}", which, -(along.value / self._change(f, name, which)))
        with f.each(self.n) as i:
            self._increase(f, f"B {x}", i, -self._at(f, f"Y {x}", i))
        f.call(f"reverse_{name}", f.given["work"], self.address(f, "K"))
        self._accumulate(f)
