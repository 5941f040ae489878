"""Forward and reverse mode of closing: what they have in common whatever the scene's programs are (closing_derivatives.py)."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from udkjax.equations.position_closure import CLOSURE_ITERATIONS
from udkjax.native.closing import VELOCITIES, VELOCITY, Closing
from udkjax.native.ir import INT, POINTER, Function, Value
from udkjax.native.layout import Layout
from udkjax.native.prologue import FORWARD, REVERSE


class ClosingDerivative(Closing):
    """What derivatives of any closing have in common. `active` says which numbers of the scene move."""

    active_numbers: int

    def _at(self, f: Function, name: str, i: Value | int, pointer: str = "work") -> Value:
        places = self.places if pointer == "work" else self.tangents
        return f.load(f.given[pointer], f.like(i, INT, 1) + places[name])

    def _set(self, f: Function, name: str, i: Value | int, x: Value, pointer: str = "work"):
        places = self.places if pointer == "work" else self.tangents
        f.store(x, f.given[pointer], f.like(i, INT, 1) + places[name])

    def _increase(self, f: Function, name: str, i: Value | int, x: Value, pointer: str = "work"):
        self._set(f, name, i, self._at(f, name, i, pointer) + x, pointer)


class ForwardMode(ClosingDerivative):
    """Closing along directions, each with memory of its own: a `tangent`.

    It calls `push_position` and `push_velocity` (work, scale, limited): the change of the state by a correction of it, so much of
    it in positions, and whether it was limited.
    """

    inputs = ("dnumbers", "dq", "dv")
    outputs = ("dstate",)
    directions_in = 1

    def _add_tangents(self):
        """The memory of a tangent."""
        self.tangents = w = Layout(1, self.plan.vector)
        w.add("numbers", self.active_numbers)
        w.add("constants", self.constants)
        for name in ("X q", "X v", "O q", "O v"):
            w.add(name, self.n)

    @contextmanager
    def _each_tangent(self, f: Function) -> Iterator[Value]:
        call = f.load(f.given["work"], self.places["call"], base=POINTER)
        first = f.load(f.given["work"], self.places["tangents"], base=POINTER)
        with f.each(f.load(call, self.call_fields.index("directions"), base=INT)) as p:
            f.given["tangent"] = f.at(first, p * self.tangents.size)
            yield p

    def _record_correction(self, f: Function, kind: int, scale: Value, limited: Value):
        f.call("push_velocity" if kind == VELOCITY else "push_position", f.given["work"], scale, limited)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        call, constants = self.call_record(f), self.address(f, "constants")
        with self._each_tangent(f) as p:
            for name, to, count in (("dnumbers", "numbers", self.active_numbers), ("dq", "X q", self.n), ("dv", "X v", self.n)):
                start = self.member_address(f, call, name, member)
                with f.each(count) as i:
                    self._set(f, to, i, f.load(start, p * count + i), "tangent")
            dnumbers, dconstants = (f.at(f.given["tangent"], self.tangents[x]) for x in ("numbers", "constants"))
            f.call(FORWARD, self.member_address(f, call, "numbers", member), constants, dnumbers, dconstants)

    def _finish_closing(self, f: Function, member: Value):
        call = self.call_record(f)
        directions = f.load(call, self.call_fields.index("directions"), base=INT)
        with self._each_tangent(f) as p:
            to = f.at(f.load(call, self.call_fields.index("dstate"), base=POINTER), (member * directions + p) * (2 * self.n))
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    f.store(self._at(f, f"X {x}", i, "tangent"), to, i + k * self.n)

    def allocate_memory(self, f: Function, call: Value) -> list[Value]:
        size = f.load(call, self.call_fields.index("directions"), base=INT) * self.tangents.size
        block, start = self.allocate(f, size)
        with f.each(size) as i:
            f.store(0.0, start, i)
        f.store(start, f.given["work"], self.places["tangents"], base=POINTER)
        return [block]


class ReverseMode(ClosingDerivative):
    """Closing, and back: its corrections are recorded and walked back from a cotangent of the state.

    It calls `pull_position` and `pull_velocity` (work, scale, limited): from the cotangent B of the state behind a correction to
    that of the state before it, in X.
    """

    inputs = ("statebar",)
    outputs = ("numbersbar", "qbar", "vbar")

    def _add_record(self, numbers: int):
        n, most, p = self.n, CLOSURE_ITERATIONS + 1 + VELOCITIES, self.places
        self.row = 3 + 2 * n  # of the record: kind, scale, whether it was limited, q and v before
        p.add("record", most * self.row)
        p.add("records")
        for name, count in {"cbar": self.constants, "G c": self.constants, "numbersbar": numbers}.items():
            p.add(name, count)
        for name in ("B q", "B v", "G q", "G v"):
            p.add(name, n)

    def _accumulate(self, f: Function):
        """Add what a correction's derivative has found in G."""
        with f.each(self.constants) as i:
            self._increase(f, "cbar", i, self._at(f, "G c", i))
        with f.each(self.n) as i:
            for x in "qv":
                self._increase(f, f"B {x}", i, self._at(f, f"G {x}", i))

    def _record_correction(self, f: Function, kind: int, scale: Value, limited: Value):
        number = self.to_int(f, self._at(f, "records", 0))
        row = f.at(f.given["work"], number * self.row + self.places["record"])
        for k, x in enumerate((f.const(float(kind)), scale, limited)):
            f.store(x, row, k)
        self.copy_lane(f, row, 3, "X q", f.const(0, INT))
        self.copy_lane(f, row, 3 + self.n, "X v", f.const(0, INT))
        self._set(f, "records", 0, self._at(f, "records", 0) + 1.0)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        self._set(f, "records", 0, f.const(0.0))
        with f.each(self.constants) as i:
            self._set(f, "cbar", i, f.const(0.0))
        bars = self.member_address(f, self.call_record(f), "statebar", member)
        for k, x in enumerate("qv"):
            with f.each(self.n) as i:
                self._set(f, f"B {x}", i, f.load(bars, i + k * self.n))

    def _finish_closing(self, f: Function, member: Value):
        call = self.call_record(f)

        def left() -> Value:
            return self._at(f, "records", 0) > 0.5

        with f.while_(left):
            self._set(f, "records", 0, self._at(f, "records", 0) - 1.0)
            row = f.at(f.given["work"], self.to_int(f, self._at(f, "records", 0)) * self.row + self.places["record"])
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    self._set(f, f"X {x}", i, f.load(row, i + (3 + k * self.n)))

            def pull(name: str) -> Callable[[], None]:
                return lambda: f.call(name, f.given["work"], f.load(row, 1), f.load(row, 2))

            f.choose(f.load(row, 0) > 0.5, pull("pull_velocity"), pull("pull_position"))
        constants, bars, to = (self.address(f, x) for x in ("constants", "cbar", "numbersbar"))
        f.call(REVERSE, self.member_address(f, call, "numbers", member), constants, bars, to)
        for name, place, count in (
            ("numbersbar", "numbersbar", self.active_numbers),
            ("qbar", "B q", self.n),
            ("vbar", "B v", self.n),
        ):
            to = f.at(f.load(call, self.call_fields.index(name), base=POINTER), member * count)
            with f.each(count) as i:
                f.store(self._at(f, place, i), to, i)
