"""Events that a run passes: it records them, changes its numbers, and begins anew.

Kinks of forces change neither the state nor the constraints (turning.py). Where a joint with set-valued friction stops or slips,
the modes that are possible are tried in turn (sliding.py). A run that has ended at such an event begins anew from there as at its
start, unless another condition is zero, too, the decision is not clear, or the record is full: then it ends, and the loop of
events in Python (`udkjax.integrate`) takes over.
"""

from typing import Any

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value
from udkjax.native.module.layout import INFO_NAMES, Lane
from udkjax.native.module.samples import enter_first_row
from udkjax.native.module.steps import NODE_COUNT, Status
from udkjax.native.run.trajectory import Trajectory
from udkjax.native.watching.passed_events import Passing

COUNT_NAMES = ("tried", "accepted", "evaluations", "implicit")  # of all stretches of a run
KEPT_FIELDS = ("written", "lost", "worst", "turned")  # of a run that begins anew
CONDITION_ARRAYS = ("sides", "locks", "condition numbers", "condition side", "condition floor", "condition on")  # the same


class PassingRuns(Trajectory):
    """The base of runs that watch conditions: the code that passes events; `passing` is None for runs that pass none."""

    passing: Passing | None
    conditions: Any

    def ask_for_forces(self, f: Function, lane: Value):
        """Set `holds` of a lane to its number of watched forces: unless it is zero, conditions are evaluated with forces."""
        count = f.variable(0.0, width=1)
        with f.each(self.conditions.count, self.conditions.own_count) as c:
            count.value = count.value + self.lane_entry(f, "condition on", lane, c)
        self.put_lane_entry(f, "holds", lane, count.value)

    def lay_out_passing(self):
        """Reserve memory for the numbers and counts of runs that pass events."""
        if self.passing is None:
            return
        for name in ("turned", "room", *(f"past {x}" for x in COUNT_NAMES)):
            self.places.add(name)
        self.places.add("sides", self.passing.sides)
        self.places.add("locks", self.passing.locks)
        self.places.add("after v", self.n)
        for name in CONDITION_ARRAYS:
            self.places.add(f"kept {name}", self.places_of(name))
        if self.passing.kinks:
            self.passing.kinks.lay_out(self.places)
        if self.passing.slides:
            self.passing.slides.lay_out(self.places, self.n)
        if not self.plan.sampled:
            self.places.add("numbers", -(-self.code.number_count // self.plan.width))

    def places_of(self, name: str) -> int:
        """Return the length of the array `name`, one of `CONDITION_ARRAYS`."""
        assert self.passing is not None
        own = {"sides": self.passing.sides, "locks": self.passing.locks, "condition numbers": self.conditions.number_count}
        return own.get(name, self.conditions.count)

    @property
    def _record_length(self) -> int:
        assert self.passing is not None
        return self.passing.record_length(self.n)

    def begin_numbers(self, f: Function, lane: Value, member: Value):
        if self.passing is None:
            return
        given = self.member_address(f, "numbers", member)
        for place, name, i in self.passing.of_scene:
            self.put_lane_entry(f, name, lane, f.load(given, place), i)

    def numbers_in_lane(self, f: Function, lane: Value, numbers: Value) -> Value:
        """Return the address of a copy of a member's numbers with the sides and locks of its lane."""
        if self.passing is None:
            return numbers
        copy = self.address(f, "numbers")
        if not self.plan.sampled:
            with f.each(self.code.number_count) as i:
                f.store(f.load(numbers, i), copy, i)
        for place, name, i in self.passing.of_scene:
            f.store(self.lane_entry(f, name, lane, i), copy, place)
        return copy

    def begin_record(self, f: Function, lane: Value, room: Value):
        """Begin the record of a member with room for `room` events."""
        for name in ("turned", *(f"past {x}" for x in COUNT_NAMES)):
            self.put_lane_entry(f, name, lane, f.const(0.0))
        self.put_lane_entry(f, "room", lane, room)

    def end_record(self, f: Function, k: Value, member: Value):
        """Write the number of events of the member in lane k and its locks to the output "passed".

        The counts in the output "info" are completed by those before the last event.
        """
        assert self.passing is not None
        record = self.result_address(f, "passed", member, self._record_length)
        f.store(self.lane_entry(f, "turned", k), record, 0)
        self.copy_lane(f, record, 1, "kept locks", k, count=self.passing.locks)
        info = self.result_address(f, "info", member, len(INFO_NAMES) + 2 * self.n)
        for name in COUNT_NAMES:
            place = INFO_NAMES.index(name)
            f.store(f.load(info, place) + self.lane_entry(f, f"past {name}", k), info, place)

    def enter_start(self, f: Function, lane: Value, member: Value):
        if self.passing is None or not self.passing.locks:
            super().enter_start(f, lane, member)
            return
        self._copy_in_lane(f, lane, "locks", "kept locks", self.passing.locks)
        self.begin_numbers(f, lane, member)
        self._enter(f, lane, member)

    def _enter(self, f: Function, lane: Value, member: Value):
        """Compute the constants of a lane, with the samples that are valid at its time `start`."""
        if self.plan.breaks:
            enter_first_row(self, f, lane, member)
        else:
            f.call("enter", f.given["work"], f.given["call"], lane)

    def may_pass(self, f: Function, s: Lane) -> Value:
        """Return the lanes that have ended at an event, and have room in their records."""
        return (s.active > 0.5) & s.code.is_(float(Status.CROSSED)) & (s.turned < s.room)

    def look_at_event(self, f: Function, s: Lane, v: str = "sure v", conditions: str = "conditions"):
        """Evaluate conditions at the event: at `sure_t`, `sure q` and the velocities in the array `v`.

        `conditions`: the function of the module that evaluates them.
        """
        setattr(s, "state t", s.sure_t)
        self.copy(f, "sure q", "state q")
        self.copy(f, v, "result v")
        f.call(conditions, f.given["work"])

    def floor_of(self, f: Function, s: Lane, c: Value) -> Value:
        """Return the magnitude below which condition c counts as zero: its `floor` or, if larger, `zero` times its scale.

        The scale is the change of the condition in the scene's unit of time.
        """
        assert self.passing is not None
        rate, floor = (self.entry(f, f"condition {name}", c) for name in ("rate", "floor"))
        return f.max(f.abs(rate) * self.passing.zero / s.omega, floor)

    def any_condition(self, f: Function, wanted: Any) -> Value:
        """Return the lanes in which `wanted(c, g, side, floor)` is true for at least one of the conditions that are watched."""
        s, found = Lane(f, self.places), f.variable(f.const(False, BOOL, f.width), BOOL)
        with f.each(self.conditions.count) as c:
            on, side, g = (self.entry(f, f"condition {x}", c) for x in ("on", "side", "g"))
            found.value = found.value | ((on > 0.5) & wanted(c, g, side, self.floor_of(f, s, c)))
        return found.value

    def begin_anew(self, f: Function, s: Lane, passes: Value):
        """Record the events of the lanes in `passes`, and begin their runs anew there.

        Sides, locks and conditions are those of the lane, velocities are `after v`.
        """
        with self.each_lane(f, passes) as k:
            self._begin_anew(f, k, self._note(f, s, k))

    def _note(self, f: Function, s: Lane, k: Value) -> Value:
        """Append the event of lane k to the record of its member; return the address of its row in the record."""
        assert self.passing is not None
        record = self.result_address(f, "passed", self.to_int(f, f.lane(s.member, k)), self._record_length)
        start = self.to_int(f, f.lane(s.turned, k)) * self.passing.row_length(self.n)
        row = f.at(record, start + (1 + self.passing.locks))
        f.store(f.lane(s.event, k), row, 0)
        f.store(f.lane(s.sure_t, k), row, 1)
        # After its index and its time: q, v before it and v after it, then sides and locks.
        places = dict.fromkeys(("sure q", "sure v", "after v"), self.n)
        places |= {"sides": self.passing.sides, "locks": self.passing.joints}
        start = 2
        for name, count in places.items():
            self.copy_lane(f, row, start, name, k, count=count)
            start += count
        return row

    def _begin_anew(self, f: Function, k: Value, row: Value):
        """Begin the run of lane k anew at the event with this row of its record."""
        n = self.n
        t, member = f.load(row, 1), self.to_int(f, self.lane_entry(f, "member", k))
        written = f.variable(self.lane_entry(f, "written", k), DOUBLE, 1)
        ts = self.member_address(f, "ts", member)  # the last step may have written outputs after the event
        with f.while_(lambda: (written.value > 0.5) & (f.load(ts, self.to_int(f, written.value)) > t)):
            written.value = written.value - 1.0
        kept = {name: self.lane_entry(f, name, k) for name in KEPT_FIELDS}
        kept["written"], kept["turned"] = written.value, kept["turned"] + 1.0
        kept["lost"] = f.select(kept["lost"] > kept["written"], f.const(float("inf")), kept["lost"])
        for name in COUNT_NAMES:
            kept[f"past {name}"] = self.lane_entry(f, f"past {name}", k) + f.max(self.lane_entry(f, name, k), f.const(0.0))
        for name in CONDITION_ARRAYS:
            self._copy_in_lane(f, k, name, f"kept {name}", self.places_of(name))
        f.call("begin", f.given["work"], f.given["call"], k, member)
        for name in CONDITION_ARRAYS:
            self._copy_in_lane(f, k, f"kept {name}", name, self.places_of(name))
        self.ask_for_forces(f, k)
        kept["max_steps"] = self.lane_entry(f, "max_steps", k) - kept["past tried"]
        times = dict.fromkeys(("node", "sure_t", "fresh", "first_t", *(f"point{j}_t" for j in range(NODE_COUNT))), t)
        kept["next"] = f.load(ts, self.to_int(f, kept["written"]) + 1)
        for name, value in (kept | times).items():
            self.put_lane_entry(f, name, k, value)
        with f.each(n) as i:
            for start, x in ((2, "q"), (2 + 2 * n, "v")):  # of the row: q at the event, v after it
                value = f.load(row, i + start)
                for to in ("sure", *(f"point{point}" for point in range(NODE_COUNT))):
                    self.put_lane_entry(f, f"{to} {x}", k, value, i)
        first = self.lane_entry(f, "start", k)
        self.put_lane_entry(f, "start", k, t)
        self._enter(f, k, member)
        self.put_lane_entry(f, "start", k, first)

    def _copy_in_lane(self, f: Function, k: Value, source: str, to: str, count: int):
        with f.each(count) as i:
            self.put_lane_entry(f, to, k, self.lane_entry(f, source, k, i), i)
