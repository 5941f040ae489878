"""Access of a run's code to its memory, its inputs and its outputs."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from udkjax.native.ir import INT, POINTER, Function, Operand, Value
from udkjax.native.layout import INPUTS, OUTPUTS, SETTINGS, Lane, Layout, Plan


class Memory:
    """The memory of a run, laid out by `places`, and what `run` is called with.

    That is a record of 8-byte fields (`call_fields`): how many members, output times, breakpoints and directions there are; the
    addresses of inputs, their strides from member to member (numbers), the addresses of outputs, how many numbers some of them
    have of each member, and the address of the number of the next member, which threads share.
    """

    plan: Plan
    places: Layout
    tangents: Layout  # of one direction of a derivative
    begins: list[Callable[[Function], None]]  # write what is stored once a run
    n: int  # coordinates
    m: int  # rows of Psi
    rowcount: int  # registers that they take
    stage_accelerations: list[str]

    settings: tuple[str, ...] = SETTINGS  # settings that it takes
    inputs: tuple[str, ...] = ()  # besides those of every run
    results: tuple[str, ...] = OUTPUTS
    outputs: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()  # inputs and outputs of which it must know how many numbers they have of each member
    directions_in = 0  # the dimension of the last input that counts the directions
    written_text = ""  # the whole module, once it is written

    @property
    def call_fields(self) -> tuple[str, ...]:
        inputs = (*INPUTS, *self.inputs)
        strides = (f"{x} stride" for x in inputs)
        lengths = (f"{x} length" for x in self.lengths)
        return "members", "times", "knots", "directions", *inputs, *strides, *self.results, *self.outputs, *lengths, "next"

    def layout(self, pointer: str) -> Layout:
        """Return the layout of the memory at a pointer."""
        return self.places if pointer == "work" else self.tangents

    def start(self, name: str, pointer: str) -> int:
        """Return the place of an array, in numbers from a pointer."""
        layout = self.layout(pointer)
        return layout[name] * layout.width

    def registers(self, pointer: str) -> int:
        """Count the registers that the coordinates take."""
        return -(-self.n * self.layout(pointer).width // self.plan.vector)

    def vector(self, f: Function, name: str, r: Value, pointer: str = "work") -> Value:
        """One register of an array of coordinates."""
        return f.load(f.given[pointer], r * self.plan.vector + self.start(name, pointer), self.plan.vector)

    def put(self, f: Function, name: str, r: Value, x: Value, pointer: str = "work"):
        f.store(x, f.given[pointer], r * self.plan.vector + self.start(name, pointer), self.plan.vector)

    def broadcast(self, f: Function, x: Value) -> Value:
        """A number of each lane, to go with registers of coordinates."""
        return x if x.width == self.plan.vector else f.repeat(x, self.plan.vector)

    def largest(self, f: Function, values: Callable[[Value], Iterable[Value]]) -> Value:
        """The largest, in each lane, of `values(r)` of each register; without what is not a number."""
        worst = f.variable(0.0, width=self.plan.vector)
        with f.each(self.rowcount) as r:
            for x in values(r):
                worst.value = f.max(x, worst.value)
        found = worst.value
        return found if self.plan.width > 1 else f.largest_of(found)

    def address(self, f: Function, name: str) -> Value:
        return f.at(f.given["work"], self.places[name] * self.plan.width)

    def invoke(self, f: Function, name: str, out: str | None = None):
        f.call(name, f.given["work"], self.address(f, out) if out else f.given["work"])

    def weighted_sum(
        self, f: Function, row: np.ndarray, r: Value, names: Sequence[str] | None = None, pointer: str = "work"
    ) -> Value | None:
        """sum_j row_j a_j of one register of coordinates; None where all are zero."""
        total = None
        for weight, name in zip(row, names or self.stage_accelerations, strict=False):
            if weight != 0:
                a = self.vector(f, name, r, pointer)
                total = a * float(weight) if total is None else f.fma(a, float(weight), total)
        return total

    def copy(self, f: Function, source: str, to: str, mask: Value | None = None):
        """An array of coordinates, or that of some lanes, in another one, or at the pointer `out`."""
        pointer, start = f.given["out" if to == "out" else "work"], 0 if to == "out" else self.start(to, "work")
        with f.each(self.rowcount) as r:
            place, new = r * self.plan.vector + start, self.vector(f, source, r)
            old = f.load(pointer, place, self.plan.vector)
            f.store(new if mask is None else f.select(mask, new, old), pointer, place, self.plan.vector)

    def copy_point(self, f: Function, mask: Value, source: str | tuple[str, ...], to: str):
        sources = source if isinstance(source, tuple) else [f"{source} {x}" for x in "qva"]
        with f.each(self.rowcount) as r:
            for name, x in zip(sources, "qva", strict=True):
                self.put(f, f"{to} {x}", r, f.select(mask, self.vector(f, name, r), self.vector(f, f"{to} {x}", r)))

    def copy_lane(self, f: Function, to: Value, start: int, name: str, k: Value, pointer: str = "work", count: int | None = None):
        """The coordinates of lane k to an address, or the first numbers of another array."""
        with f.each(self.n if count is None else count) as i:
            place = i * self.layout(pointer).width + k + self.start(name, pointer)
            f.store(f.load(f.given[pointer], place), to, i + start)

    def lane_number(self, f: Function, name: str, k: Value, i: Operand) -> Value:
        """The i-th number of an array, of lane k."""
        return f.load(f.given["work"], f.like(i, INT, 1) * f.width + self.places[name] * f.width + k)

    def to_int(self, f: Function, x: Value) -> Value:
        return f.op(f"fptosi double {x.name} to i64", INT)

    def call_record(self, f: Function) -> Value:
        """Return the pointer to the call record of `run`."""
        return f.load(f.given["work"], self.places["call"] * f.width, base=POINTER)

    def input_number(self, f: Function, call: Value, name: str, member: Value, k: Value) -> Value:
        """The k-th number of an input of a member (one lane)."""
        return f.load(self.member_address(f, call, name, member), k)

    def member_address(self, f: Function, call: Value, name: str, member: Value) -> Value:
        """The address of what an input holds of a member (one lane)."""
        number = member if member.base == INT else self.to_int(f, member)
        stride = f.load(call, self.call_fields.index(f"{name} stride"), base=INT)
        pointer = f.load(call, self.call_fields.index(name), base=POINTER)
        return f.at(pointer, number * stride)

    def write_state(self, f: Function, s: Lane, call: Value, k: Value, number: Value, q: str, v: str):
        """State number `number` of lane k into the outputs."""
        member = self.to_int(f, f.lane(s.member, k))
        times = f.load(call, self.call_fields.index("times"), base=INT)
        row = member * times + number
        for name, x in (("qs", q), ("vs", v)):
            self.copy_lane(f, f.at(f.load(call, self.call_fields.index(name), base=POINTER), row * self.n), 0, x, k)
        f.store(f.lane(s.violated, k), f.load(call, self.call_fields.index("violation"), base=POINTER), row)

    def allocate(self, f: Function, count: Value) -> tuple[Value, Value]:
        """So many numbers: what to free, and where they begin, at a register's boundary."""
        size = count * 8 + 64
        block = f.op(f"call ptr @malloc(i64 {size.name})", POINTER)
        address = f.op(f"ptrtoint ptr {block.name} to i64", INT)
        aligned = f.logic("and", address + 63, -64)
        return block, f.op(f"inttoptr i64 {aligned.name} to ptr", POINTER)
