"""Access of a run's code to its memory, inputs and outputs."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import NamedTuple

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Operand, Value
from udkjax.native.module.layout import INPUTS, OUTPUTS, SETTINGS, Lane, Layout, Plan


class ThreadCode(NamedTuple):
    """The functions that each thread of a GPU calls to run one member."""

    functions: list[Function]  # `run_member` and what it calls
    shared: list[Function]  # further functions, whose arguments point to any memory
    globals: list[str]
    size: int  # numbers in the memory of a thread


class Memory:
    """The memory of a run, laid out by `places`, and its call record.

    The record has 8-byte fields (`call_fields`): the numbers of members, output times, breakpoints and directions; the addresses
    of the inputs and their strides between members (in numbers); the addresses of the outputs; the lengths per member of some
    inputs and outputs; and the address of two words that threads share, the index of the next member and whether memory was
    refused.
    """

    plan: Plan
    places: Layout
    tangents: Layout  # memory of one direction of a derivative
    unused: tuple[int, int] = (0, 0)  # range of the places of arrays that are not cleared until they are used
    begins: list[Callable[[Function], None]]  # write the numbers that are stored once per run
    n: int  # coordinates
    m: int  # rows of Psi
    rowcount: int  # number of registers of an array of coordinates
    stage_accelerations: list[str]
    stage_slips: Sequence[str] = ()  # rates of q minus v at the stages, if they differ

    settings: tuple[str, ...] = SETTINGS
    inputs: tuple[str, ...] = ()  # in addition to `INPUTS`
    results: tuple[str, ...] = OUTPUTS
    outputs: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()  # inputs and outputs whose length per member is in the call record
    directions_in = 0  # axis of the last input; its length is the number of directions
    written_text = ""  # the text of the module, after `generate`

    @property
    def call_fields(self) -> tuple[str, ...]:
        inputs = (*INPUTS, *self.inputs)
        strides = (f"{x} stride" for x in inputs)
        lengths = (f"{x} length" for x in self.lengths)
        return "members", "times", "knots", "directions", *inputs, *strides, *self.results, *self.outputs, *lengths, "next"

    def text(self) -> str:
        """Write all functions; return LLVM's text of the whole module."""
        raise NotImplementedError

    def thread_code(self) -> "ThreadCode":
        """Write the functions that each thread of a GPU calls, and return them."""
        raise NotImplementedError

    def function(self, name: str, arguments: Sequence[tuple[str, str]] = ((POINTER, "work"),)) -> tuple[Function, Lane]:
        """Add a function of all lanes to the module; return it, and the `Lane` that accesses the numbers of its lanes."""
        raise NotImplementedError

    def layout(self, pointer: str) -> Layout:
        """Return the layout of the memory at a pointer: `work`, the memory of a run, or `tangent`, that of a direction."""
        return self.places if pointer == "work" else self.tangents

    def start(self, name: str, pointer: str) -> int:
        """Return the index of the first number of an array, relative to a pointer."""
        layout = self.layout(pointer)
        return layout[name] * layout.width

    def registers(self, pointer: str) -> int:
        """Return the number of registers that an array of coordinates takes in the memory at a pointer."""
        return -(-self.n * self.layout(pointer).width // self.plan.vector)

    def vector(self, f: Function, name: str, r: Value, pointer: str = "work") -> Value:
        """Return register r of an array of coordinates."""
        return f.load(f.given[pointer], r * self.plan.vector + self.start(name, pointer), self.plan.vector)

    def put(self, f: Function, name: str, r: Value, x: Value, pointer: str = "work"):
        f.store(x, f.given[pointer], r * self.plan.vector + self.start(name, pointer), self.plan.vector)

    def broadcast(self, f: Function, x: Value) -> Value:
        """Return a number of each lane in the width of registers: a single number is repeated for all coordinates."""
        return x if x.width == self.plan.vector else f.repeat(x, self.plan.vector)

    def largest(self, f: Function, values: Callable[[Value], Iterable[Value]]) -> Value:
        """Return the largest of all `values(r)` of all registers r in each lane: at least zero, and NaN is ignored."""
        worst = f.variable(0.0, width=self.plan.vector)
        with f.each(self.rowcount) as r:
            for x in values(r):
                worst.value = f.max(x, worst.value)
        result = worst.value
        return result if self.plan.width > 1 else f.largest_of(result)

    def address(self, f: Function, name: str) -> Value:
        return f.at(f.given["work"], self.places[name] * self.plan.width)

    def invoke(self, f: Function, name: str, out: str | None = None):
        f.call(name, f.given["work"], self.address(f, out) if out else f.given["work"])

    def weighted_sum(
        self, f: Function, row: np.ndarray, r: Value, names: Sequence[str] | None = None, pointer: str = "work"
    ) -> Value | None:
        """Return sum_j row_j a_j for register r of coordinates; None if all coefficients are zero.

        The arrays a_j have the given names; by default they are the accelerations of the stages.
        """
        total = None
        for weight, name in zip(row, names or self.stage_accelerations, strict=False):
            if weight != 0:
                a = self.vector(f, name, r, pointer)
                total = a * float(weight) if total is None else f.fma(a, float(weight), total)
        return total

    def copy(self, f: Function, source: str, to: str, mask: Value | None = None):
        """Copy an array of coordinates to the array `to`, or to the pointer `out`, in all lanes or those of `mask`."""
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

    # --- single numbers of arrays, in all lanes or in one

    def place(self, name: str, i: Operand = 0, pointer: str = "work") -> Operand:
        """Return the index, relative to a pointer, of the i-th number of an array in the first lane."""
        return i * self.layout(pointer).width + self.start(name, pointer)

    def entry(self, f: Function, name: str, i: Operand = 0, pointer: str = "work") -> Value:
        """Return the i-th number of an array in all lanes."""
        return f.load(f.given[pointer], self.place(name, i, pointer), self.layout(pointer).width)

    def put_entry(self, f: Function, name: str, i: Operand, x: Operand, pointer: str = "work"):
        f.store(x, f.given[pointer], self.place(name, i, pointer), self.layout(pointer).width)

    def lane_entry(self, f: Function, name: str, k: Value, i: Operand = 0, pointer: str = "work", base: str = DOUBLE) -> Value:
        """Return the i-th number of an array in lane k."""
        return f.load(f.given[pointer], k + self.place(name, i, pointer), base=base)

    def put_lane_entry(
        self, f: Function, name: str, k: Value, x: Operand, i: Operand = 0, pointer: str = "work", base: str = DOUBLE
    ):
        f.store(x, f.given[pointer], k + self.place(name, i, pointer), base=base)

    @contextmanager
    def each_lane(self, f: Function, mask: Value) -> Iterator[Value]:
        """Run the code of the `with` block for each lane in which `mask` is true (or 1.0); yield the index of the lane."""
        marks = mask if mask.base == DOUBLE else f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
        with f.each(f.width) as k, f.if_(f.lane(marks, k) > 0.5):
            yield k

    def copy_lane(self, f: Function, to: Value, start: int, name: str, k: Value, pointer: str = "work", count: int | None = None):
        """Copy the first `count` numbers (by default n) of an array in lane k to the address `to`, from the index `start` on."""
        with f.each(self.n if count is None else count) as i:
            f.store(self.lane_entry(f, name, k, i, pointer), to, i + start)

    def to_int(self, f: Function, x: Value) -> Value:
        return f.op(f"fptosi double {x.name} to i64", INT)

    # --- the call record

    def call_record(self, f: Function) -> Value:
        """Return the pointer to the call record of `run`."""
        return f.given["call"] if "call" in f.given else f.load(f.given["work"], self.start("call", "work"), base=POINTER)

    def field(self, f: Function, name: str, base: str = INT) -> Value:
        """Return a field of the call record, a count or an address."""
        return f.load(self.call_record(f), self.call_fields.index(name), base=base)

    def input_number(self, f: Function, name: str, member: Value, k: Value) -> Value:
        """Return the k-th number of a member in an input (one lane)."""
        return f.load(self.member_address(f, name, member), k)

    def member_address(self, f: Function, name: str, member: Value) -> Value:
        """Return the address of the numbers of a member in an input (one lane)."""
        number = member if member.base == INT else self.to_int(f, member)
        return f.at(self.field(f, name, POINTER), number * self.field(f, f"{name} stride"))

    def result_address(self, f: Function, name: str, number: Value, length: Operand) -> Value:
        """Return the address of row `number` of an output with rows of `length` numbers."""
        return f.at(self.field(f, name, POINTER), number * length)

    def writing_results(self, f: Function) -> AbstractContextManager[None]:
        """Return a context whose code runs only in calls that ask for the outputs `results`, as by default all calls do."""
        return nullcontext()

    def write_state(self, f: Function, s: Lane, k: Value, number: Value, q: str, v: str):
        """Store the arrays `q` and `v` of lane k as output `number`; note the first output that violates Psi too far."""
        row, violated = self.to_int(f, f.lane(s.member, k)) * self.field(f, "times") + number, f.lane(s.violated, k)
        with self.writing_results(f):
            for name, x in (("qs", q), ("vs", v)):
                self.copy_lane(f, self.result_address(f, name, row, self.n), 0, x, k)
            f.store(violated, self.field(f, "violation", POINTER), row)
        with f.if_(~(violated <= f.lane(s.drift_tol, k))):
            first = f.min(f.lane(s.lost, k), f.op(f"sitofp i64 {number.name} to double", DOUBLE))
            self.put_lane_entry(f, "lost", k, first)

    def allocate(self, f: Function, count: Value, held: Sequence[Value] = ()) -> tuple[Value, Value]:
        """Allocate `count` numbers; return the block to free and the address of the first number, aligned to a register.

        If there is no memory, the function `f` reports it, frees the blocks `held` that it has allocated before, and returns.
        """
        size = count * 8 + 64
        block = f.op(f"call ptr @malloc(i64 {size.name})", POINTER)
        with f.if_(f.is_null(block)):
            self.report_no_memory(f)
            for other in held:
                f.line(f"call void @free(ptr {other.name})")
            f.leave()
        address = f.op(f"ptrtoint ptr {block.name} to i64", INT)
        aligned = f.logic("and", address + 63, -64)
        return block, f.op(f"inttoptr i64 {aligned.name} to ptr", POINTER)

    def report_no_memory(self, f: Function):
        """Tell the caller that memory was refused: all results of the call are invalid."""
        f.store(1, self.field(f, "next", POINTER), 1, base=INT)
