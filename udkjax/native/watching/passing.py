"""Kinks of forces that a run passes by itself: it records them, turns the sides of their comparisons, and begins anew.

At a kink (integrate/events/kinks.py) neither the state nor the constraints change, and no decision is needed. A run that has
ended at one begins anew from there as at its start, unless another condition is zero, too, or the record is full: then it ends,
and the loop of events goes on.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from udkjax.native.base.ir import BOOL, DOUBLE, POINTER, Function, Value
from udkjax.native.base.layout import INFO, Lane
from udkjax.native.base.program import write
from udkjax.native.base.samples import enter_first_row
from udkjax.native.base.steps import POINTS, Status
from udkjax.native.run.trajectory import Trajectory

COUNTS = ("tried", "accepted", "evaluations", "implicit")  # of all stretches of a run
KEPT = ("written", "lost", "worst", "turned")  # of a run that begins anew


class Renewal(NamedTuple):
    """The program of the sides of one force, which may depend on each other and on the state."""

    smooth: Any  # has the program; compared by identity
    inputs: tuple[tuple[str, int], ...]  # of the program: arrays of the module's memory, each with an index
    first: int  # its first side


@dataclass(frozen=True)
class Passing:
    """The kinks that a run passes: those of its conditions from `first` on."""

    first: int
    turns: tuple[tuple[int, float, float], ...]  # of each kink: its side, which becomes `factor` times itself plus `shift`
    of_conditions: tuple[tuple[int, int], ...]  # places of sides among the numbers of conditions, each with its side
    of_scene: tuple[tuple[int, int], ...]  # the same among the numbers of the scene
    renewals: tuple[Renewal, ...]

    most: ClassVar[int] = 16  # kinks that a call has room for: each takes memory in every call, and further kinks a further call

    @property
    def count(self) -> int:
        """The number of sides."""
        return sum(renewal.smooth.count for renewal in self.renewals)

    def row_length(self, n: int, conditions: int) -> int:
        """Return the length of the record of a kink: its condition, its time, q and v, the sides after it, and those of zero."""
        return 2 + 2 * n + self.count + conditions

    def record_length(self, n: int, conditions: int) -> int:
        """Return the length of the record of a run: the number of kinks, and a row for each."""
        return 1 + self.most * self.row_length(n, conditions)


class PassedKinks(NamedTuple):
    """The kinks that runs have passed, K at most."""

    count: np.ndarray  # (b,)
    event: np.ndarray  # (b, K) index of the condition
    t: np.ndarray  # (b, K)
    q: np.ndarray  # (b, K, n)
    v: np.ndarray  # (b, K, n)
    sides: np.ndarray  # (b, K, S) after the kink

    @classmethod
    def of(cls, passing: Passing, record: np.ndarray, n: int) -> "PassedKinks":
        """Return the kinks in the records of runs with n coordinates."""
        count = record[:, 0].astype(int)
        rows = record[:, 1:].reshape(len(record), passing.most, -1)[:, : count.max(initial=0)]
        event, t, q, v, sides, _ = np.split(rows, np.cumsum([1, 1, n, n, passing.count]), axis=2)
        return cls(count, event[..., 0], t[..., 0], q, v, sides)


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
        for i, renewal in enumerate(passing.renewals):
            inputs = [("work", p[name] + k) for name, k in renewal.inputs]
            outputs = [("work", p["renewed sides"] + renewal.first + k) for k in range(renewal.smooth.count)]
            program = renewal.smooth.renewal
            self.functions.append(write(program, f"renew_sides{i}", self.plan.width, ("work",), inputs, outputs, cold=True))
        f, s = self.function("pass_kinks", [(POINTER, "work"), (POINTER, "call")])
        work = f.given["work"]
        setattr(s, "state t", s.sure_t)
        self.copy(f, "sure q", "state q")
        self.copy(f, "sure v", "result v")
        f.call("conditions", work)
        others = f.variable(f.const(False, BOOL, f.width), BOOL)
        with f.each(self.conditions.count) as c:
            on, g, floor = (self.entry(f, f"condition {x}", c) for x in ("on", "g", "floor"))
            is_other = s.event.is_not(f.like(c, DOUBLE, f.width))
            others.value = others.value | (is_other & (on > 0.5) & ~(f.abs(g) > floor))
        is_kink = (s.event >= float(passing.first)) & (s.event < float(self.conditions.own_count))
        passes = (s.active > 0.5) & s.code.is_(float(Status.CROSSED)) & is_kink & (s.turned < s.room) & ~others.value
        with f.if_(f.any_of(passes)):
            self._turn(f, s, passes)
            with self.each_lane(f, passes) as k:
                self._begin_anew(f, k, self._note(f, s, k))

    def _turn(self, f: Function, s: Lane, passes: Value):
        """Turn the sides of the kinks at which lanes are, and the sides of zero of their conditions."""
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
        one = f.const(1.0, DOUBLE, f.width)
        with f.each(self.conditions.count) as c:  # the condition of a kink is positive except where its side turns
            here, before = passes & s.event.is_(f.like(c, DOUBLE, f.width)), self.entry(f, "condition side", c)
            self.put_entry(f, "condition side", c, f.select(here, one, before))

    def _note(self, f: Function, s: Lane, k: Value) -> Value:
        """Note the kink of lane k; return the address of its record."""
        assert self.passing is not None
        record = self.result_address(f, "kinks", self.to_int(f, f.lane(s.member, k)), self._record_length)
        row = f.at(record, self.to_int(f, f.lane(s.turned, k)) * self._row_length + 1)
        f.store(f.lane(s.event, k), row, 0)
        f.store(f.lane(s.sure_t, k), row, 1)
        places = {"sure q": self.n, "sure v": self.n, "kink sides": self.passing.count, "condition side": self.conditions.count}
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
        with f.each(self.conditions.count) as i:
            self.put_lane_entry(f, "condition side", k, f.load(row, i + (start + passing.count)), i)
        if not self.plan.breaks:
            f.call("enter", f.given["work"], f.given["call"], k)
            return
        first = self.lane_entry(f, "start", k)
        self.put_lane_entry(f, "start", k, t)
        enter_first_row(self, f, k, member)
        self.put_lane_entry(f, "start", k, first)
