"""The record of a trajectory for reverse mode: its accepted states and the steps between them.

A first call of the code integrates, and writes the record of each member into an output. A second call reads the record and the
cotangents, and backpropagates. Members without a record, because it was too long for the output or because there is no output for
records of many members, are integrated again by the second call: their records take memory only while they run.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from udkjax.native.derivatives.differentiated import Differentiated
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.running import Repeat
from udkjax.native.module.samples import ARGUMENTS
from udkjax.native.run.members import kept_outputs

STORED_POINTS = 200  # capacity in points of the record passed to the second call: as much memory as 300 outputs
PER_BREAKPOINT = 3  # additional capacity for each breakpoint: the beginning of a new run, and two steps
FIRST_POINTS = 2  # points before the first step: the state as given, and projected
# Before the points: their number, and the numbers of outputs that are kept and written.
HEADER_FIELDS = ("points", "kept", "written")
# Numbers of a point before its state: its time, the number of outputs before its step, `begin` of its step (layout.py).
POINT_HEADER_LENGTH = 3
BEGIN_PLACE = 2  # place of the last of them
# For threads of a GPU, whose records are in one buffer: its address, the capacity of each record, and the first of its members.
BUFFER_FIELDS = ("records", "capacity", "first")


def record_length(n: int, points: int) -> int:
    """Return the length of a record of `points` points with n coordinates."""
    return len(HEADER_FIELDS) + points * row_length(n)


def row_length(n: int) -> int:
    """Return the length of one point of a record, with n coordinates."""
    return POINT_HEADER_LENGTH + 3 * n


class Recorded(Differentiated):
    """A trajectory that returns a record, or backpropagates along a record."""

    lengths = ("given record", "record")
    has_buffer = False  # whether records are in a buffer (`BUFFER_FIELDS`), not in memory that members allocate

    def __init__(self, plan: Plan, active: tuple[bool, ...]):
        super().__init__(plan, active)
        for name in ("record", "capacity", "points", "kept", "at", "ready", "given"):
            self.places.add(name)
        self.row = row_length(self.n)

    @property
    def call_fields(self) -> tuple[str, ...]:
        *fields, following = super().call_fields
        return (*fields, *(BUFFER_FIELDS if self.has_buffer else ()), following)

    def backpropagates(self, f: Function) -> Value:
        """Return true if this is the second call, which has cotangents and backpropagates."""
        return self.field(f, "directions") > 0

    def _returns_record(self, f: Function) -> Value:
        return self.field(f, "record length") > 0

    @contextmanager
    def writing_results(self, f: Function) -> Iterator[None]:
        with f.if_(~self.backpropagates(f)):
            yield

    def begin_member(self, f: Function, lane: Value, member: Value):
        self.put_lane_entry(f, "given", lane, 0.0)
        with f.if_(self.field(f, "given record length") > 0):
            given = self.member_address(f, "given record", member)
            with f.if_(f.load(given) > 0.0):
                for k, name in enumerate(HEADER_FIELDS):
                    self.put_lane_entry(f, name, lane, f.load(given, k))
                self.put_lane_entry(f, "record", lane, f.at(given, len(HEADER_FIELDS)), base=POINTER)
                self.stiffness.if_leaving(lambda: self._leave_for_implicit_steps(f, lane))
                for name, x in (("active", 0.0), ("ready", 1.0), ("given", 1.0)):
                    self.put_lane_entry(f, name, lane, x)
        with f.if_((self.lane_entry(f, "given", lane) < 0.5) & (self.backpropagates(f) | self._returns_record(f))):
            self.put_lane_entry(f, "points", lane, 0.0)
            f.choose(
                self.backpropagates(f),
                lambda: self._allocate_record(f, lane, member),
                lambda: self._place_in_output(f, lane, member),
            )
            with f.if_(self.lane_entry(f, "active", lane) > 0.5):
                self._store_point(f, Lane(f, self.places), lane)

    def _leave_for_implicit_steps(self, f: Function, k: Value):
        """Let lane k leave the module if a step of its record is implicit."""
        points = self.to_int(f, self.lane_entry(f, "points", k))
        with f.each(points) as i, f.if_(f.load(self._record(f, k), i * self.row + BEGIN_PLACE) < -0.5):
            self.put_lane_entry(f, "stiff", k, 1.0)

    def record_step(self, f: Function, s: Lane, accept: Value):
        with f.if_(self.backpropagates(f) | self._returns_record(f)), self.each_lane(f, accept) as k:
            self._store_point(f, s, k)

    def end_members(self, f: Function, s: Lane):
        with self.each_lane(f, s.due) as k:
            self.put_lane_entry(f, "kept", k, f.like(kept_outputs(self, f, s, k), DOUBLE, 1))
        with f.if_(self.backpropagates(f)):
            s.where(s.due > 0.5, ready=1.0)
        with f.if_(self._returns_record(f)), self.each_lane(f, s.due) as k:
            f.call("end_record", f.given["work"], self.call_record(f), k)

    # --- memory

    def _place_in_output(self, f: Function, k: Value, member: Value):
        length = self.field(f, "record length")
        self.put_lane_entry(
            f, "record", k, f.at(self.result_address(f, "record", member, length), len(HEADER_FIELDS)), base=POINTER
        )
        self.put_lane_entry(f, "capacity", k, f.like(f.arithmetic("div", length - len(HEADER_FIELDS), self.row), DOUBLE, 1))

    def write_end_record(self):
        """Write `end_record(work, call, lane)`: write the title of a lane's record to the output, and zeros after its points.

        If the points did not fit, the record is written without points. `finish_members` would write the zeros slowly, since it
        is not optimized.
        """
        f, _ = self.function("end_record", ARGUMENTS)
        k = f.given["lane"]
        vector = 1 if self.has_buffer else self.plan.vector  # on a card vectors are aligned, unlike records
        fits = self.lane_entry(f, "capacity", k) > 0.0
        self.put_lane_entry(f, "points", k, f.select(fits, self.lane_entry(f, "points", k), 0.0))
        length = self.field(f, "record length")
        to = self.result_address(f, "record", self.to_int(f, self.lane_entry(f, "member", k)), length)
        for j, name in enumerate(HEADER_FIELDS):
            f.store(self.lane_entry(f, name, k), to, j)
        start = self.to_int(f, self.lane_entry(f, "points", k)) * self.row + len(HEADER_FIELDS)
        registers = f.arithmetic("div", length - start, vector)
        with f.each(registers) as r:
            f.store(0.0, to, r * vector + start, vector)
        with f.each(length, registers * vector + start) as i:
            f.store(0.0, to, i)

    def _allocate_record(self, f: Function, k: Value, member: Value):
        """Allocate the record of lane k, with room for the steps of the first call; without memory the lane stays empty."""
        if self.has_buffer:
            capacity = self.field(f, "capacity")
            number = (member - self.field(f, "first")) * (capacity * self.row)
            self.put_lane_entry(f, "record", k, f.at(self.field(f, "records", POINTER), number), base=POINTER)
            self.put_lane_entry(f, "capacity", k, f.like(capacity, DOUBLE, 1))
            return
        points = self.input_number(f, "given steps", member, f.const(0, INT)) + float(FIRST_POINTS)
        record = f.op(f"call ptr @malloc(i64 {(self.to_int(f, points) * (self.row * 8)).name})", POINTER)
        self.put_lane_entry(f, "record", k, record, base=POINTER)
        self.put_lane_entry(f, "capacity", k, points)
        with f.if_(f.is_null(record)):
            self.report_no_memory(f)
            self.put_lane_entry(f, "active", k, 0.0)

    def _extend_record(self, f: Function, k: Value):
        """Double the room for points of lane k: there are more than in the first call, which may have rounded differently.

        If memory is refused, the run ends at its next step.
        """
        capacity = self.lane_entry(f, "capacity", k)
        if self.has_buffer:
            self.report_no_memory(f)
            self.put_lane_entry(f, "max_steps", k, 0.0)
            return
        size = self.to_int(f, capacity * 2.0) * (self.row * 8)
        new = f.op(f"call ptr @realloc(ptr {self._record(f, k).name}, i64 {size.name})", POINTER)
        f.declared.add("declare ptr @realloc(ptr, i64)")
        missing = f.is_null(new)
        with f.if_(missing):  # the old record stays
            self.report_no_memory(f)
            self.put_lane_entry(f, "max_steps", k, 0.0)
        with f.if_(~missing):
            self.put_lane_entry(f, "record", k, new, base=POINTER)
            self.put_lane_entry(f, "capacity", k, capacity * 2.0)

    def free_record(self, f: Function, k: Value):
        """Free the memory of lane k's record."""
        if self.has_buffer:
            return
        with f.if_(self.lane_entry(f, "given", k) < 0.5):
            f.line(f"call void @free(ptr {self._record(f, k).name})")

    # --- order of members

    def present(self, f: Function, s: Lane) -> Value:
        return (s.active > 0.5) | (s.ready > 0.5)

    def release(self, f: Function, s: Lane):
        with f.if_(self.backpropagates(f)), self.each_lane(f, self.present(f, s)) as k:
            self.free_record(f, k)

    def take_next(self, f: Function, s: Lane, fill: Callable[[], None]):
        with f.if_(~self.backpropagates(f)):
            fill()

    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Backpropagate the members of all lanes together when all are complete, and load the next ones."""
        with f.if_(f.any_of(s.active > 0.5)):
            super().step_all(f, s, fill)
        with f.if_(self.backpropagates(f) & ~f.any_of(s.active > 0.5)):
            self.walk(f, s, partial(_repeat, f))
            fill()

    def member_of(self, f: Function, thread: Value) -> Value:
        return thread + self.field(f, "first") if self.has_buffer else thread

    def write_member(self, f: Function, s: Lane, repeat: Repeat):
        """Integrate all members of a block of threads, then backpropagate all of them."""
        repeat(lambda: f.any_of(s.active > 0.5), lambda: super(Recorded, self).step_all(f, s, lambda: None))
        with f.if_(self.backpropagates(f)):
            self.walk(f, s, repeat)

    @abstractmethod
    def walk(self, f: Function, s: Lane, repeat: Repeat):
        """Backpropagate the members of lanes that are `ready`; `repeat(goes_on, step)` repeats the step back."""

    # --- points

    def _record(self, f: Function, k: Value) -> Value:
        """Return the address of the record of lane k."""
        return self.lane_entry(f, "record", k, base=POINTER)

    def _store_point(self, f: Function, s: Lane, k: Value):
        """Append point 3 to the record of lane k."""
        points = self.lane_entry(f, "points", k)
        with f.if_(points >= self.lane_entry(f, "capacity", k)):
            f.choose(
                self.backpropagates(f),
                lambda: self._extend_record(f, k),
                lambda: self.put_lane_entry(f, "capacity", k, 0.0),
            )
        with f.if_(points < self.lane_entry(f, "capacity", k)):
            row = f.at(self._record(f, k), self.to_int(f, points) * self.row)
            for j, name in enumerate(("point3_t", "written", "begin")):
                f.store(self.lane_entry(f, name, k), row, j)
            for j, x in enumerate("qva"):
                self.copy_lane(f, row, POINT_HEADER_LENGTH + j * self.n, f"point3 {x}", k)
            self.put_lane_entry(f, "points", k, points + 1.0)

    def _load_point(self, f: Function, k: Value, number: Value, point: str):
        """Load point `number` of the record of lane k into the arrays of `point`; negative numbers mean the first point."""
        row = f.at(self._record(f, k), self.to_int(f, f.max(number, 0.0)) * self.row)
        self.put_lane_entry(f, f"{point}_t", k, f.load(row, 0))
        self.put_lane_entry(f, f"{point}_solved", k, f.max(-f.load(row, 2), 0.0))
        for j, x in enumerate("qva"):
            with f.each(self.n) as i:
                self.put_lane_entry(f, f"{point} {x}", k, f.load(row, i + (POINT_HEADER_LENGTH + j * self.n)), i)

    def _load_head(self, f: Function, k: Value):
        """Load the head of the current point of lane k: the number of outputs `before` its step, and `begin`."""
        row = f.at(self._record(f, k), self.to_int(f, self.lane_entry(f, "at", k)) * self.row)
        self.put_lane_entry(f, "before", k, f.load(row, 1))
        self.put_lane_entry(f, "begin", k, f.load(row, 2))


def _repeat(f: Function, goes_on: Callable[[], Value], step: Callable[[], None]):
    with f.while_(goes_on):
        step()
