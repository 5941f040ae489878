"""Derivatives of closing a mechanism, through its steps, in forward mode along directions and in reverse mode.

The coordinates change by -s times a correction; if the step is limited, s depends on the correction as well. After the last
step, one more correction changes only the derivative, which it projects onto the constraint manifold. corrections.py has the
derivatives of corrections. Second derivatives need a further correction, because the first leaves an error of the square of the
tangents.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.expressions.loops.loop_derivative import FORWARD, REVERSE, TWICE
from udkjax.native.closing.closing import CORRECTED_QUANTITIES, Closing
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Layout
from udkjax.native.module.program_derivative import GIVEN_DIRECTIONS, WAYS, ProgramDerivative
from udkjax.native.module.prologue import PROLOGUE_NAMES, write_prologue_derivative


class ClosingDerivative(Closing):
    """Base of the forward and the reverse derivative of closing."""

    def _increase(self, f: Function, name: str, i: Value | int, x: Value, pointer: str = "work"):
        self.put_entry(f, name, i, self.entry(f, name, i, pointer) + x, pointer)

    def _longest(self, f: Function, x: str) -> tuple[Value, Value]:
        """Return the largest change of a coordinate by the unlimited correction, in units of the scene, and its index."""
        longest, which = f.variable(0.0), f.variable(0, INT)
        with f.each(self.n) as i:
            size = f.abs(self.change(f, x, i)) * self.entry(f, "inverse unit", i)
            which.value = f.select(size > longest.value, i, which.value)
            longest.value = f.max(size, longest.value)
        return longest.value, which.value


class ClosingForward(ClosingDerivative):
    """Closing with tangents along directions, which have separate memory."""

    mode = FORWARD
    ways = ("d",)  # prefixes of the inputs of each tangent
    outputs = ("dstate",)
    directions_in = 1

    def __init__(self, code: RunPrograms, vector: int, active: Sequence[bool]):
        super().__init__(code, vector, active)
        self.inputs = tuple(f"{way}{x}" for way in self.ways if way in GIVEN_DIRECTIONS for x in ("numbers", "q", "v"))
        self.tangents = w = Layout(1, self.plan.vector)
        w.add("numbers", code.number_count)
        w.add("constants", self.constants)
        for name in ("state q", "state v", "result q", "result v"):
            w.add(name, self.n)

    def write_derivatives(self):
        write_prologue_derivative(self, self.active, self.mode)
        for x in self.corrections:
            self._write_correction(x)
            self._write_push(x)

    def _write_correction(self, x: str):
        self.corrections[x].write_adjoint()
        self.corrections[x].forward()

    def _linearize(self, f: Function, x: str) -> Value:
        """Evaluate a correction at the state; return the address of the intermediate results for its derivative."""
        self._evaluate(f, x)
        self.corrections[x].prepare_derivative(f)
        return self.address(f, "correction")

    def _write_push(self, x: str):
        """Write `push_<x>(work, scale, limited)`: add `scale` times the tangents of a correction to the tangents of the state.

        If `limited` is one, the factor limits the length of the step, and has tangents itself.
        """
        f, _ = self.function(f"push_{x}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        stored = self._linearize(f, x)
        longest, which = self._longest(f, x)
        limits = (f.given["limited"] > 0.5) & (longest > 0.0)
        with self._each_direction(f):
            f.call(f"{self.mode}_newton_{x}", f.given["work"], stored, f.given["d"], f.given["d"])
            for way in self.ways:
                with f.each(self.n) as i:
                    self._increase(f, f"result {x}", i, -self.entry(f, f"state {x}", i, way), way)
            # Relative change of the longest coordinate, by which the limit changes.
            steps = {way: self.entry(f, f"result {x}", which, way) for way in self.ways}
            shares = {way: f.select(limits, step / self.change(f, x, which), 0.0) for way, step in steps.items()}
            with f.each(self.n) as i:
                steps = {way: self.entry(f, f"result {x}", i, way) for way in self.ways}
                for way, step in self._limited(steps, shares, self.change(f, x, i)).items():
                    self._increase(f, f"state {x}", i, f.given["scale"] * step, way)

    def _limited(self, steps: dict[str, Value], shares: dict[str, Value], step: Value) -> dict[str, Value]:
        """Return the tangents of a coordinate c of a limited step, by way.

        The step is proportional to c / c_j, with c_j the longest coordinate; c_j times its tangents is dc - a c, with the
        `shares` a = dc_j / c_j, which are zero if the step is not limited. `steps` are the dc, and `step` is c.
        """
        return {way: change - shares[way] * step for way, change in steps.items()}

    @contextmanager
    def _each_direction(self, f: Function) -> Iterator[Value]:
        """Run the block for every direction, with its index; `f.given` has the addresses of its tangents, by way."""
        first = self.first_tangent(f)
        with f.each(self.field(f, "directions")) as p:
            for k, way in enumerate(self.ways):
                f.given[way] = f.at(first, p * (len(self.ways) * self.tangents.size) + k * self.tangents.size)
            yield p

    def _record_correction(self, f: Function, x: str, scale: Value, limited: Value):
        f.call(f"push_{x}", f.given["work"], scale, limited)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        constants = self.address(f, "constants")
        with self._each_direction(f) as p:
            for way in self.ways:
                for name, to, count in (
                    ("numbers", "numbers", self.code.number_count),
                    ("q", "state q", self.n),
                    ("v", "state v", self.n),
                ):
                    start = self.member_address(f, f"{way}{name}", member) if way in GIVEN_DIRECTIONS else None
                    with f.each(count) as i:
                        self.put_entry(f, to, i, f.load(start, p * count + i) if start else f.const(0.0), way)
            changes = [f.at(f.given[way], self.tangents[x]) for x in ("numbers", "constants") for way in self.ways]
            f.call(PROLOGUE_NAMES[self.mode], self.member_address(f, "numbers", member), constants, *changes)

    def _finish_closing(self, f: Function, member: Value):
        directions = self.field(f, "directions")
        with self._each_direction(f) as p:
            to = self.result_address(f, "dstate", member * directions + p, 2 * self.n)
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    f.store(self.entry(f, f"state {x}", i, self.ways[-1]), to, i + k * self.n)


class ClosingTwice(ClosingForward):
    """Closing with second derivatives along pairs of directions.

    Corrections are differentiated by elimination, which agrees with the least-norm solution to first order, where rows are
    consistent.
    """

    mode = TWICE
    ways = WAYS
    further = 2

    def __init__(self, code: RunPrograms, vector: int, active: Sequence[bool]):
        super().__init__(code, vector, active)
        self._eliminated = {x: ProgramDerivative(self, f"newton_{x}", "eliminated") for x in self.corrections}
        self.places.add("linearization", max(x.stored_size for x in self._eliminated.values()))

    def _write_correction(self, x: str):
        self._eliminated[x].evaluation()
        self._eliminated[x].forward()

    def _linearize(self, f: Function, x: str) -> Value:
        stored = self.address(f, "linearization")
        f.call(f"eliminated_newton_{x}", f.given["work"], f.given["work"], stored)
        self._evaluate(f, x)
        return stored

    def _limited(self, steps: dict[str, Value], shares: dict[str, Value], step: Value) -> dict[str, Value]:
        (step_d, step_e, _), (a, b, _) = ([values[way] for way in self.ways] for values in (steps, shares))
        first_order = super()._limited(steps, shares, step)
        return first_order | {"de": first_order["de"] - a * step_e - b * step_d + (a * b * 2.0) * step}


class ClosingReverse(ClosingDerivative):
    """Closing with reverse mode: corrections are recorded, and a cotangent of the state is pulled back through them."""

    mode = REVERSE
    inputs = ("statebar",)
    outputs = ("numbersbar", "qbar", "vbar")

    def __init__(self, code: RunPrograms, vector: int, active: Sequence[bool]):
        super().__init__(code, vector, active)
        n, capacity, p = self.n, CLOSURE.steps + 1 + CLOSURE.velocities, self.places
        self.row = 3 + 2 * n  # length of a row of the record: index of the quantity, scale, whether limited, q and v before
        p.add("record", capacity * self.row)
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
        """Write `pull_<x>(work, scale, limited)`, which pulls the cotangent of q or v back through a correction at the state.

        The cotangent is the array `bar iterate q` or `bar iterate v`.

        The arguments are those of `_record_correction`.
        """
        f, _ = self.function(f"pull_{x}", [(POINTER, "work"), (DOUBLE, "scale"), (DOUBLE, "limited")])
        self._evaluate(f, x)
        self.corrections[x].prepare_derivative(f)
        longest, which = self._longest(f, x)
        product = f.variable(0.0)
        with f.each(self.n) as i:
            bar = f.given["scale"] * self.entry(f, f"bar iterate {x}", i)
            product.value = f.fma(bar, self.change(f, x, i), product.value)
            self.put_entry(f, f"bar result {x}", i, bar)
        with f.if_((f.given["limited"] > 0.5) & (longest > 0.0)):
            self._increase(f, f"bar result {x}", which, -(product.value / self.change(f, x, which)))
        with f.each(self.n) as i:
            self._increase(f, f"bar iterate {x}", i, -self.entry(f, f"bar result {x}", i))
        f.call(f"reverse_newton_{x}", f.given["work"], self.address(f, "correction"), f.given["work"])
        self._accumulate(f)

    def _accumulate(self, f: Function):
        """Add the cotangents that a correction has pulled back, `bar state` and `bar constants`, to the sums.

        The sums are `bar iterate` and `total bar constants`.
        """
        with f.each(self.constants) as i:
            self._increase(f, "total bar constants", i, self.entry(f, "bar constants", i))
        with f.each(self.n) as i:
            for x in "qv":
                self._increase(f, f"bar iterate {x}", i, self.entry(f, f"bar state {x}", i))

    def _record_correction(self, f: Function, x: str, scale: Value, limited: Value):
        number = self.to_int(f, self.entry(f, "records", 0))
        row = f.at(f.given["work"], number * self.row + self.places["record"])
        for k, value in enumerate((f.const(float(CORRECTED_QUANTITIES.index(x))), scale, limited)):
            f.store(value, row, k)
        self.copy_lane(f, row, 3, "state q", f.const(0, INT))
        self.copy_lane(f, row, 3 + self.n, "state v", f.const(0, INT))
        self.put_entry(f, "records", 0, self.entry(f, "records", 0) + 1.0)

    def begin_member(self, f: Function, lane: Value, member: Value):
        del lane
        self.put_entry(f, "records", 0, f.const(0.0))
        with f.each(self.constants) as i:
            self.put_entry(f, "total bar constants", i, f.const(0.0))
        bars = self.member_address(f, "statebar", member)
        for k, x in enumerate("qv"):
            with f.each(self.n) as i:
                self.put_entry(f, f"bar iterate {x}", i, f.load(bars, i + k * self.n))

    def _finish_closing(self, f: Function, member: Value):
        def has_records() -> Value:
            return self.entry(f, "records", 0) > 0.5

        with f.while_(has_records):
            self.put_entry(f, "records", 0, self.entry(f, "records", 0) - 1.0)
            row = f.at(f.given["work"], self.to_int(f, self.entry(f, "records", 0)) * self.row + self.places["record"])
            for k, x in enumerate("qv"):
                with f.each(self.n) as i:
                    self.put_entry(f, f"state {x}", i, f.load(row, i + (3 + k * self.n)))

            def pull(name: str) -> Callable[[], None]:
                return lambda: f.call(name, f.given["work"], f.load(row, 1), f.load(row, 2))

            f.choose(f.load(row, 0) > 0.5, pull("pull_v"), pull("pull_q"))
        constants, bars, to = (self.address(f, x) for x in ("constants", "total bar constants", "numbersbar"))
        f.call(PROLOGUE_NAMES[REVERSE], self.member_address(f, "numbers", member), constants, bars, to)
        for name, place, count in (
            ("numbersbar", "numbersbar", self.code.number_count),
            ("qbar", "bar iterate q", self.n),
            ("vbar", "bar iterate v", self.n),
        ):
            to = self.result_address(f, name, member, count)
            with f.each(count) as i:
                f.store(self.entry(f, place, i), to, i)
