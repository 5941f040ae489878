"""Derivatives of closing a mechanism: of its steps as they are, forward along directions and backward.

The coordinates change by -s times a correction; s, where it limits the step, is a function of it, too. Behind the last step there
is one more correction, which changes nothing but the derivative: it returns it to the constraint manifold. Corrections
are differentiated as corrections.py has it.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from udkjax.equations.differentiable_programs import FORWARD, REVERSE
from udkjax.equations.position_closure import CLOSURE_ITERATIONS, VELOCITIES
from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.closing import CORRECTED, Closing
from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Layout
from udkjax.native.prologue import PROLOGUE, write_prologue_derivative


class ClosingDerivative(Closing):
    """Access to arrays, for both modes."""

    def _at(self, f: Function, name: str, i: Value | int, pointer: str = "work") -> Value:
        places = self.places if pointer == "work" else self.tangents
        return f.load(f.given[pointer], f.like(i, INT, 1) + places[name])

    def _set(self, f: Function, name: str, i: Value | int, x: Value, pointer: str = "work"):
        places = self.places if pointer == "work" else self.tangents
        f.store(x, f.given[pointer], f.like(i, INT, 1) + places[name])

    def _increase(self, f: Function, name: str, i: Value | int, x: Value, pointer: str = "work"):
        self._set(f, name, i, self._at(f, name, i, pointer) + x, pointer)

    def _longest(self, f: Function, x: str) -> tuple[Value, Value]:
        """The largest change of a coordinate by the whole correction, in units of the scene, and which it is."""
        longest, which = f.variable(0.0), f.variable(0, INT)
        with f.each(self.n) as i:
            size = f.abs(self.change(f, x, i)) * self._at(f, "inverse unit", i)
            which.value = f.select(size > longest.value, i, which.value)
            longest.value = f.max(size, longest.value)
        return longest.value, which.value


class ClosingForward(ClosingDerivative):
    """Closing along directions, each with memory of its own: a `tangent`."""

    inputs = ("dnumbers", "dq", "dv")
    outputs = ("dstate",)
    directions_in = 1

    def __init__(self, code: ScenePrograms, vector: int, active: Sequence[bool]):
        super().__init__(code, vector, active)
        self.tangents = w = Layout(1, self.plan.vector)
        w.add("numbers", code.number_count)
        w.add("constants", self.constants)
        for name in ("state q", "state v", "result q", "result v"):
            w.add(name, self.n)

    def write_derivatives(self):
        write_prologue_derivative(self, self.active, FORWARD)
        for x, correction in self.corrections.items():
            correction.write_adjoint()
            correction.forward()
            self._write_push(x)

    def _write_push(self, x: str):
        """Write push_x(work, scale, limited): the change of the state by so much of a correction, which was limited or not."""
        f, _ = self.function(f"push_{x}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        self._evaluate(f, x)
        self.corrections[x].prepare_derivative(f)
        longest, which = self._longest(f, x)
        limits = (f.given["limited"] > 0.5) & (longest > 0.0)
        with self._each_tangent(f):
            f.call(f"forward_newton_{x}", f.given["work"], self.address(f, "correction"), f.given["tangent"], f.given["tangent"])
            change = f.variable(0.0)  # of the longest step, over its length
            with f.each(self.n) as i:
                step = self._at(f, f"result {x}", i, "tangent") - self._at(f, f"state {x}", i, "tangent")
                self._set(f, f"result {x}", i, step, "tangent")
                change.value = f.select(i.is_(which), step / self.change(f, x, i), change.value)
            share = f.select(limits, change.value, 0.0)
            with f.each(self.n) as i:
                step = self._at(f, f"result {x}", i, "tangent") - share * self.change(f, x, i)
                self._increase(f, f"state {x}", i, f.given["scale"] * step, "tangent")

    @contextmanager
    def _each_tangent(self, f: Function) -> Iterator[Value]:
        call = f.load(f.given["work"], self.places["call"], base=POINTER)
        first = f.load(f.given["work"], self.places["tangents"], base=POINTER)
        with f.each(f.load(call, self.call_fields.index("directions"), base=INT)) as p:
            f.given["tangent"] = f.at(first, p * self.tangents.size)
            yield p

    def _record_correction(self, f: Function, x: str, scale: Value, limited: Value):
        f.call(f"push_{x}", f.given["work"], scale, limited)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        call, constants = self.call_record(f), self.address(f, "constants")
        with self._each_tangent(f) as p:
            for name, to, count in (
                ("dnumbers", "numbers", self.code.number_count),
                ("dq", "state q", self.n),
                ("dv", "state v", self.n),
            ):
                start = self.member_address(f, call, name, member)
                with f.each(count) as i:
                    self._set(f, to, i, f.load(start, p * count + i), "tangent")
            dnumbers, dconstants = (f.at(f.given["tangent"], self.tangents[x]) for x in ("numbers", "constants"))
            f.call(PROLOGUE[FORWARD], self.member_address(f, call, "numbers", member), constants, dnumbers, dconstants)

    def _finish_closing(self, f: Function, member: Value):
        call = self.call_record(f)
        directions = f.load(call, self.call_fields.index("directions"), base=INT)
        with self._each_tangent(f) as p:
            to = f.at(f.load(call, self.call_fields.index("dstate"), base=POINTER), (member * directions + p) * (2 * self.n))
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    f.store(self._at(f, f"state {x}", i, "tangent"), to, i + k * self.n)

    def allocate_memory(self, f: Function, call: Value) -> list[Value]:
        size = f.load(call, self.call_fields.index("directions"), base=INT) * self.tangents.size
        block, start = self.allocate(f, size)
        with f.each(size) as i:
            f.store(0.0, start, i)
        f.store(start, f.given["work"], self.places["tangents"], base=POINTER)
        return [block]


class ClosingReverse(ClosingDerivative):
    """Closing, and back: its corrections are recorded and walked back from a cotangent of the state."""

    mode = REVERSE
    inputs = ("statebar",)
    outputs = ("numbersbar", "qbar", "vbar")

    def __init__(self, code: ScenePrograms, vector: int, active: Sequence[bool]):
        super().__init__(code, vector, active)
        n, most, p = self.n, CLOSURE_ITERATIONS + 1 + VELOCITIES, self.places
        self.row = 3 + 2 * n  # of the record: what was corrected, scale, whether it was limited, q and v before
        p.add("record", most * self.row)
        p.add("records")
        for name, count in {
            "total bar constants": self.constants,
            "bar constants": self.constants,
            "numbersbar": code.number_count,
        }.items():
            p.add(name, count)
        for name in ("bar iterate q", "bar iterate v", "bar state q", "bar state v", "bar result q", "bar result v"):
            p.add(name, n)

    def write_derivatives(self):
        write_prologue_derivative(self, self.active, REVERSE)
        for x, correction in self.corrections.items():
            correction.write_adjoint()
            correction.reverse()
            self._write_pull(x)

    def _write_pull(self, x: str):
        """Write pull_x(work, scale, limited): from `bar iterate` behind a correction, made at the state, to that before."""
        f, _ = self.function(f"pull_{x}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        self._evaluate(f, x)
        self.corrections[x].prepare_derivative(f)
        longest, which = self._longest(f, x)
        along = f.variable(0.0)
        with f.each(self.n) as i:
            bar = f.given["scale"] * self._at(f, f"bar iterate {x}", i)
            along.value = f.fma(bar, self.change(f, x, i), along.value)
            self._set(f, f"bar result {x}", i, bar)
        with f.if_((f.given["limited"] > 0.5) & (longest > 0.0)):
            self._increase(f, f"bar result {x}", which, -(along.value / self.change(f, x, which)))
        with f.each(self.n) as i:
            self._increase(f, f"bar iterate {x}", i, -self._at(f, f"bar result {x}", i))
        f.call(f"reverse_newton_{x}", f.given["work"], self.address(f, "correction"), f.given["work"])
        self._accumulate(f)

    def _accumulate(self, f: Function):
        """Add the cotangents that a correction's derivative has left in `bar state`."""
        with f.each(self.constants) as i:
            self._increase(f, "total bar constants", i, self._at(f, "bar constants", i))
        with f.each(self.n) as i:
            for x in "qv":
                self._increase(f, f"bar iterate {x}", i, self._at(f, f"bar state {x}", i))

    def _record_correction(self, f: Function, x: str, scale: Value, limited: Value):
        number = self.to_int(f, self._at(f, "records", 0))
        row = f.at(f.given["work"], number * self.row + self.places["record"])
        for k, value in enumerate((f.const(float(CORRECTED.index(x))), scale, limited)):
            f.store(value, row, k)
        self.copy_lane(f, row, 3, "state q", f.const(0, INT))
        self.copy_lane(f, row, 3 + self.n, "state v", f.const(0, INT))
        self._set(f, "records", 0, self._at(f, "records", 0) + 1.0)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        self._set(f, "records", 0, f.const(0.0))
        with f.each(self.constants) as i:
            self._set(f, "total bar constants", i, f.const(0.0))
        bars = self.member_address(f, self.call_record(f), "statebar", member)
        for k, x in enumerate("qv"):
            with f.each(self.n) as i:
                self._set(f, f"bar iterate {x}", i, f.load(bars, i + k * self.n))

    def _finish_closing(self, f: Function, member: Value):
        call = self.call_record(f)

        def left() -> Value:
            return self._at(f, "records", 0) > 0.5

        with f.while_(left):
            self._set(f, "records", 0, self._at(f, "records", 0) - 1.0)
            row = f.at(f.given["work"], self.to_int(f, self._at(f, "records", 0)) * self.row + self.places["record"])
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    self._set(f, f"state {x}", i, f.load(row, i + (3 + k * self.n)))

            def pull(name: str) -> Callable[[], None]:
                return lambda: f.call(name, f.given["work"], f.load(row, 1), f.load(row, 2))

            f.choose(f.load(row, 0) > 0.5, pull("pull_v"), pull("pull_q"))
        constants, bars, to = (self.address(f, x) for x in ("constants", "total bar constants", "numbersbar"))
        f.call(PROLOGUE[REVERSE], self.member_address(f, call, "numbers", member), constants, bars, to)
        for name, place, count in (
            ("numbersbar", "numbersbar", self.code.number_count),
            ("qbar", "bar iterate q", self.n),
            ("vbar", "bar iterate v", self.n),
        ):
            to = f.at(f.load(call, self.call_fields.index(name), base=POINTER), member * count)
            with f.each(count) as i:
                f.store(self._at(f, place, i), to, i)
