"""The record of a trajectory for reverse mode: its accepted states and the steps between them.

A first call of the code integrates, and returns the record of each member among its outputs. A second call reads the record and
the cotangents, and backpropagates; a member whose record was too long for the output is integrated again.
"""

from collections.abc import Callable

from udkjax.native.base.ir import POINTER, Function, Value
from udkjax.native.base.layout import Lane, Plan
from udkjax.native.derivatives.differentiated import Differentiated

FIRST = 32  # initial capacity of a record, in points, while a member runs
STORED = 200  # capacity in points of the record passed to the second call: as much memory as 300 outputs
PER_BREAKPOINT = 3  # additional capacity for each breakpoint: the beginning of a new run, and two steps
TITLE = 3  # numbers of a record before its points: the number of points, how the run ended, the number of outputs written
HEAD = 3  # numbers of a point before its state: its time, the number of outputs before its step, whether a run begins


def record_length(n: int, points: int) -> int:
    """Return the length of a record of `points` points with n coordinates."""
    return TITLE + points * (HEAD + 3 * n)


class Recorded(Differentiated):
    """A trajectory that returns a record, or backpropagates along a given record."""

    lengths = ("given record", "record")

    def __init__(self, plan: Plan, active: tuple[bool, ...]):
        super().__init__(plan, active)
        for name in ("record", "capacity", "points", "at", "ready", "given"):
            self.places.add(name)
        self.row = HEAD + 3 * self.n

    def backpropagates(self, f: Function) -> Value:
        """Return whether there are cotangents."""
        return self.field(f, "directions") > 0

    def _returns_record(self, f: Function) -> Value:
        return self.field(f, "record length") > 0

    def begin_member(self, f: Function, lane: Value, member: Value):
        self.put_lane_entry(f, "given", lane, 0.0)
        with f.if_(self.field(f, "given record length") > 0):
            given = self.member_address(f, "given record", member)
            with f.if_(f.load(given) > 0.0):
                for k, name in enumerate(("points", "code", "written")):
                    self.put_lane_entry(f, name, lane, f.load(given, k))
                self.put_lane_entry(f, "record", lane, f.at(given, TITLE), base=POINTER)
                for name, x in (("active", 0.0), ("ready", 1.0), ("given", 1.0)):
                    self.put_lane_entry(f, name, lane, x)
        with f.if_((self.lane_entry(f, "given", lane) < 0.5) & (self.backpropagates(f) | self._returns_record(f))):
            self._new_record(f, lane)

    def record_step(self, f: Function, s: Lane, accept: Value):
        with f.if_(self.backpropagates(f) | self._returns_record(f)), self.each_lane(f, accept) as k:
            self._store_point(f, s, k)

    def end_members(self, f: Function, s: Lane):
        with f.if_(self.backpropagates(f)):
            s.where(s.due > 0.5, ready=1.0)
        with f.if_(self._returns_record(f)), self.each_lane(f, s.due) as k:
            self._return_record(f, k)

    def _return_record(self, f: Function, k: Value):
        """Write the record of lane k to the output; without points if it is too long."""
        length = self.field(f, "record length")
        to = self.result_address(f, "record", self.to_int(f, self.lane_entry(f, "member", k)), length)
        points, record = self.lane_entry(f, "points", k), self._record(f, k)
        count = self.to_int(f, points) * self.row
        fits = count + TITLE <= length
        for j, x in enumerate((f.select(fits, points, 0.0), self.lane_entry(f, "code", k), self.lane_entry(f, "written", k))):
            f.store(x, to, j)
        with f.if_(fits), f.each(count) as i:
            f.store(f.load(record, i), to, i + TITLE)
        f.line(f"call void @free(ptr {record.name})")

    def free_record(self, f: Function, k: Value):
        """Free the memory of lane k's record."""
        with f.if_(self.lane_entry(f, "given", k) < 0.5):
            f.line(f"call void @free(ptr {self._record(f, k).name})")

    # --- order of members

    def goes_on(self, f: Function, s: Lane) -> Value:
        return f.any_of(s.active > 0.5) | f.any_of(s.ready > 0.5)

    def take_next(self, f: Function, s: Lane, fill: Callable[[], None]):
        with f.if_(~self.backpropagates(f)):
            fill()

    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Backpropagate the members of all lanes together when all are complete, and load the next ones."""
        with f.if_(f.any_of(s.active > 0.5)):
            super().step_all(f, s, fill)
        with f.if_(self.backpropagates(f) & ~f.any_of(s.active > 0.5)):
            f.call("walk", f.given["work"], f.given["call"])
            fill()

    # --- points

    def _new_record(self, f: Function, lane: Value):
        """Begin the record of a lane; without memory the lane stays empty."""
        s = Lane(f, self.places)
        record = f.op(f"call ptr @malloc(i64 {FIRST * self.row * 8})", POINTER)
        missing = f.is_null(record)
        with f.if_(missing):
            self.report_no_memory(f)
            self.put_lane_entry(f, "active", lane, 0.0)
        with f.if_(~missing):
            self.put_lane_entry(f, "record", lane, record, base=POINTER)
            self.put_lane_entry(f, "capacity", lane, float(FIRST))
            self.put_lane_entry(f, "points", lane, 0.0)
            self._store_point(f, s, lane)

    def _record(self, f: Function, k: Value) -> Value:
        """Return the address of the record of lane k."""
        return self.lane_entry(f, "record", k, base=POINTER)

    def _store_point(self, f: Function, s: Lane, k: Value):
        """Append point 3 to the record of lane k; without memory the run ends at its next step."""
        points, capacity = self.lane_entry(f, "points", k), self.lane_entry(f, "capacity", k)
        with f.if_(points >= capacity):
            size = self.to_int(f, capacity * 2.0) * (self.row * 8)
            old = self._record(f, k)
            new = f.op(f"call ptr @realloc(ptr {old.name}, i64 {size.name})", POINTER)
            f.declared.add("declare ptr @realloc(ptr, i64)")
            missing = f.is_null(new)
            with f.if_(missing):  # the old record stays
                self.report_no_memory(f)
                self.put_lane_entry(f, "max_steps", k, 0.0)
            with f.if_(~missing):
                self.put_lane_entry(f, "record", k, new, base=POINTER)
                self.put_lane_entry(f, "capacity", k, capacity * 2.0)
        with f.if_(points < self.lane_entry(f, "capacity", k)):
            row = f.at(self._record(f, k), self.to_int(f, points) * self.row)
            for j, name in enumerate(("point3_t", "written", "begin")):
                f.store(self.lane_entry(f, name, k), row, j)
            for j, x in enumerate("qva"):
                self.copy_lane(f, row, HEAD + j * self.n, f"point3 {x}", k)
            self.put_lane_entry(f, "points", k, points + 1.0)

    def _load_point(self, f: Function, k: Value, number: Value, point: str):
        """Load a point of lane k from its record; negative indices mean the first point."""
        row = f.at(self._record(f, k), self.to_int(f, f.max(number, 0.0)) * self.row)
        self.put_lane_entry(f, f"{point}_t", k, f.load(row, 0))
        for j, x in enumerate("qva"):
            with f.each(self.n) as i:
                self.put_lane_entry(f, f"{point} {x}", k, f.load(row, i + (HEAD + j * self.n)), i)

    def _load_head(self, f: Function, k: Value):
        """Load the head of the current point of lane k: the number of outputs `before` its step, and `begin`."""
        row = f.at(self._record(f, k), self.to_int(f, self.lane_entry(f, "at", k)) * self.row)
        self.put_lane_entry(f, "before", k, f.load(row, 1))
        self.put_lane_entry(f, "begin", k, f.load(row, 2))
