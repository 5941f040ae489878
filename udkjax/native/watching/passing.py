"""Kinks of forces that a run passes by itself: it records them, turns the sides of their comparisons, and begins anew.

At a kink (integrate/events/kinks.py) neither the state nor the constraints change, and no decision is needed. A run that has
ended at one begins anew from there as at its start, unless another condition is zero, too, or the record is full: then it ends,
and the loop of events goes on.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

from udkjax.native.base.ir import BOOL, DOUBLE, POINTER, Function, Value
from udkjax.native.base.layout import INFO, Lane
from udkjax.native.base.program import write
from udkjax.native.base.samples import enter_first_row
from udkjax.native.base.steps import POINTS, Status
from udkjax.native.run.trajectory import Trajectory

COUNTS = ("tried", "accepted", "evaluations", "implicit")  # of all stretches of a run
WATCHED = ("side", "floor")  # arrays of conditions that change at a kink
KEPT = ("written", "lost", "worst", "turned")  # of a run that begins anew


@dataclass(frozen=True)
class Passing:
    """The kinks that a run passes: those of its conditions from `first` on."""

    first: int
    turns: tuple[tuple[int, float, float], ...]  # of each kink: its side, which becomes `factor` times itself plus `shift`
    of_conditions: tuple[tuple[int, int], ...]  # places of sides among the numbers of conditions, each with its side
    of_scene: tuple[tuple[int, int], ...]  # the same among the numbers of the scene
    renewals: tuple[tuple[Any, tuple[tuple[str, int], ...], int], ...]
    """For each force the `SmoothLoads` with the program of its sides, which may depend on each other and on the state; the inputs
    of the program, arrays of the module's memory with indices; and the first of its sides."""
    zero: float  # bound below which a condition is zero, relative to its scale

    room: ClassVar[int] = 512  # numbers in a record: each member has one, and further kinks take a further call

    @property
    def count(self) -> int:
        """The number of sides."""
        return sum(smooth.count for smooth, _, _ in self.renewals)

    def row_length(self, n: int, conditions: int) -> int:
        """Return the length of the record of a kink: its condition, its time, q and v, its sides, and the watched conditions."""
        return 2 + 2 * n + self.count + len(WATCHED) * conditions

    def most(self, n: int, conditions: int) -> int:
        """Return the largest number of kinks that a call passes."""
        return max(1, self.room // self.row_length(n, conditions))

    def record_length(self, n: int, conditions: int) -> int:
        """Return the length of the record of a run: the number of kinks, and a row for each."""
        return 1 + self.most(n, conditions) * self.row_length(n, conditions)


class PassingRuns(Trajectory):
    """The part of runs that passes kinks; `passing` is None for runs that pass none."""

    passing: Passing | None
    conditions: Any

    def lay_out_passing(self):
        """Reserve memory for the sides and counts of runs that pass kinks."""
        if self.passing is None:
            return
        for name in ("turned", "room", *(f"past {x}" for x in COUNTS)):
            self.places.add(name)
        self.places.add("kink sides", self.passing.count)
        self.places.add("renewed sides", self.passing.count)
        if not self.plan.sampled:
            self.places.add("numbers", -(-self.code.number_count // self.plan.width))

    @property
    def _row_length(self) -> int:
        assert self.passing is not None
        return self.passing.row_length(self.n, self.conditions.count)

    @property
    def _record_length(self) -> int:
        assert self.passing is not None
        return self.passing.record_length(self.n, self.conditions.count)

    def begin_numbers(self, f: Function, lane: Value, member: Value):
        if self.passing is None:
            return
        given = self.member_address(f, "numbers", member)
        for place, side in self.passing.of_scene:
            self.put_lane_entry(f, "kink sides", lane, f.load(given, place), side)

    def numbers_in_lane(self, f: Function, lane: Value, numbers: Value) -> Value:
        """Return the address of a copy of a member's numbers with the sides of its lane."""
        if self.passing is None:
            return numbers
        copy = self.address(f, "numbers")
        if not self.plan.sampled:
            with f.each(self.code.number_count) as i:
                f.store(f.load(numbers, i), copy, i)
        for place, side in self.passing.of_scene:
            f.store(self.lane_entry(f, "kink sides", lane, side), copy, place)
        return copy

    def begin_record(self, f: Function, lane: Value, room: Value):
        """Begin the record of a member with room for `room` kinks."""
        for name in ("turned", *(f"past {x}" for x in COUNTS)):
            self.put_lane_entry(f, name, lane, f.const(0.0))
        self.put_lane_entry(f, "room", lane, room)

    def end_record(self, f: Function, k: Value, member: Value):
        """Write the number of kinks of the member in lane k, and complete its counts."""
        f.store(self.lane_entry(f, "turned", k), self.result_address(f, "kinks", member, self._record_length), 0)
        info = self.result_address(f, "info", member, len(INFO) + 2 * self.n)
        for name in COUNTS:
            place = INFO.index(name)
            f.store(f.load(info, place) + self.lane_entry(f, f"past {name}", k), info, place)

    def write_pass(self):
        """Write `pass_kinks(work, call)`: begin anew the runs that have ended at a kink."""
        passing, p = self.passing, self.places
        assert passing is not None
        for i, (smooth, given, first) in enumerate(passing.renewals):
            inputs = [("work", p[name] + k) for name, k in given]
            outputs = [("work", p["renewed sides"] + first + k) for k in range(smooth.count)]
            written = write(smooth.renewal, f"renew_sides{i}", self.plan.width, ("work",), inputs, outputs, cold=True)
            self.functions.append(written)
        f, s = self.function("pass_kinks", [(POINTER, "work"), (POINTER, "call")])
        is_kink = (s.event >= float(passing.first)) & (s.event < float(self.conditions.own_count))
        passes = (s.active > 0.5) & s.code.is_(float(Status.CROSSED)) & is_kink & (s.turned < s.room)
        with f.if_(f.any_of(passes)):
            self._look_at_kink(f, s)
            passes = passes & ~self._is_beside_others(f, s, turned=False)
            self._turn(f, s, passes)
            self._look_at_kink(f, s)
            passes = passes & ~self._is_beside_others(f, s, turned=True)
            with f.each(self.conditions.count) as c:  # the condition of a kink is positive except where its side turns
                here, floor = passes & s.event.is_(f.like(c, DOUBLE, f.width)), self._floor(f, s, c)
                for name, new, mask in (("side", f.const(1.0, DOUBLE, f.width), here), ("floor", floor, passes)):
                    self.put_entry(f, f"condition {name}", c, f.select(mask, new, self.entry(f, f"condition {name}", c)))
            with self.each_lane(f, passes) as k:
                self._begin_anew(f, k, self._note(f, s, k))

    def _look_at_kink(self, f: Function, s: Lane):
        """Evaluate the conditions at the kink."""
        setattr(s, "state t", s.sure_t)
        self.copy(f, "sure q", "state q")
        self.copy(f, "sure v", "result v")
        f.call("conditions", f.given["work"])

    def _floor(self, f: Function, s: Lane, c: Value) -> Value:
        """Return below which distance from zero a condition is zero: its scale is no less than its change in a unit of time."""
        assert self.passing is not None
        rate, floor = (self.entry(f, f"condition {name}", c) for name in ("rate", "floor"))
        return f.max(f.abs(rate) * self.passing.zero / s.omega, floor)

    def _is_beside_others(self, f: Function, s: Lane, turned: bool) -> Value:
        """Return the lanes in which another condition is zero, or beyond it.

        Once sides have `turned`, it may be zero if it leaves zero: a step of a staircase begins where the one before ends.
        """
        found = f.variable(f.const(False, BOOL, f.width), BOOL)
        with f.each(self.conditions.count) as c:
            on, side, g, rate = (self.entry(f, f"condition {x}", c) for x in ("on", "side", "g", "rate"))
            is_other, floor = s.event.is_not(f.like(c, DOUBLE, f.width)), self._floor(f, s, c)
            is_free, is_near = g * side > floor, ~(f.abs(g) > floor)
            if turned:
                is_free = is_free | (is_near & (rate * side > floor * s.omega)) | (is_near & ~is_other)
            else:
                is_free = ~is_near | ~is_other
            found.value = found.value | ((on > 0.5) & ~is_free)
        return found.value

    def _turn(self, f: Function, s: Lane, passes: Value):
        """Turn the sides of the kinks at which lanes are."""
        passing = self.passing
        assert passing is not None
        for j, (side, factor, shift) in enumerate(passing.turns):
            before, here = self.entry(f, "kink sides", side), passes & s.event.is_(float(passing.first + j))
            self.put_entry(f, "kink sides", side, f.select(here, before * factor + shift, before))
        for i in range(len(passing.renewals)):
            f.call(f"renew_sides{i}", f.given["work"])
        with f.each(passing.count) as i:
            before, new = (self.entry(f, name, i) for name in ("kink sides", "renewed sides"))
            self.put_entry(f, "kink sides", i, f.select(passes, new, before))
        for place, side in passing.of_conditions:
            before, new = self.entry(f, "condition numbers", place), self.entry(f, "kink sides", side)
            self.put_entry(f, "condition numbers", place, f.select(passes, new, before))

    def _note(self, f: Function, s: Lane, k: Value) -> Value:
        """Note the kink of lane k; return the address of its record."""
        assert self.passing is not None
        record = self.result_address(f, "kinks", self.to_int(f, f.lane(s.member, k)), self._record_length)
        row = f.at(record, self.to_int(f, f.lane(s.turned, k)) * self._row_length + 1)
        f.store(f.lane(s.event, k), row, 0)
        f.store(f.lane(s.sure_t, k), row, 1)
        places = {"sure q": self.n, "sure v": self.n, "kink sides": self.passing.count}
        places |= {f"condition {name}": self.conditions.count for name in WATCHED}
        start = 2
        for name, count in places.items():
            self.copy_lane(f, row, start, name, k, count=count)
            start += count
        return row

    def _begin_anew(self, f: Function, k: Value, row: Value):
        """Begin the member of lane k anew at a kink with this record."""
        passing, n = self.passing, self.n
        assert passing is not None
        t, member = f.load(row, 1), self.to_int(f, self.lane_entry(f, "member", k))
        written = f.variable(self.lane_entry(f, "written", k), DOUBLE, 1)
        ts = self.member_address(f, "ts", member)  # the last step may have written outputs after the kink
        with f.while_(lambda: (written.value > 0.5) & (f.load(ts, self.to_int(f, written.value)) > t)):
            written.value = written.value - 1.0
        kept = {name: self.lane_entry(f, name, k) for name in KEPT}
        kept["written"], kept["turned"] = written.value, kept["turned"] + 1.0
        kept["lost"] = f.select(kept["lost"] > kept["written"], f.const(float("inf")), kept["lost"])
        for name in COUNTS:
            kept[f"past {name}"] = self.lane_entry(f, f"past {name}", k) + f.max(self.lane_entry(f, name, k), f.const(0.0))
        f.call("begin", f.given["work"], f.given["call"], k, member)
        times = dict.fromkeys(("node", "sure_t", "fresh", "first_t", *(f"point{j}_t" for j in range(POINTS))), t)
        kept["next"] = f.load(ts, self.to_int(f, kept["written"]) + 1)
        for name, value in (kept | times).items():
            self.put_lane_entry(f, name, k, value)
        with f.each(n) as i:
            for j, x in enumerate("qv"):
                value = f.load(row, i + (2 + j * n))
                for to in ("sure", *(f"point{point}" for point in range(POINTS))):
                    self.put_lane_entry(f, f"{to} {x}", k, value, i)
        start = 2 + 2 * n
        with f.each(passing.count) as i:
            self.put_lane_entry(f, "kink sides", k, f.load(row, i + start), i)
        for place, side in passing.of_conditions:
            self.put_lane_entry(f, "condition numbers", k, f.load(row, start + side), place)
        start += passing.count
        with f.each(self.conditions.count) as i:
            for j, name in enumerate(WATCHED):
                value = f.load(row, i + (start + j * self.conditions.count))
                self.put_lane_entry(f, f"condition {name}", k, value, i)
        if not self.plan.breaks:
            f.call("enter", f.given["work"], f.given["call"], k)
            return
        first = self.lane_entry(f, "start", k)
        self.put_lane_entry(f, "start", k, t)
        enter_first_row(self, f, k, member)
        self.put_lane_entry(f, "start", k, first)
