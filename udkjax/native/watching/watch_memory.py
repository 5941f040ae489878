"""The memory of runs that watch conditions (watching.py): inputs and outputs, and the length of intervals."""

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.steps import ROUNDING_UNIT, Status
from udkjax.native.watching.conditions import LARGEST_REDUCTION, MIDDLE_NODE, PHASE_INCREMENT, RESOLUTION, SECOND, Conditions
from udkjax.native.watching.passed_events import Passing
from udkjax.native.watching.passing import PassingRuns

LANE_NUMBERS = {
    "node": "time of the next node (s); infinite if there is none",
    "which": "FIRST, SECOND or THIRD: its position in the two intervals",
    "first_t": "time of the first node (s)",
    "middle_t": "time of the middle node (s)",
    "behind_middle": "time of the last node (s)",
    "sure_t": "time up to which conditions are resolved (s)",
    "turn": "phase of the variation of interval lengths",
    "share": "length of the intervals, as a fraction of the unrefined length",
    "jumps": "number of jumps since intervals had the unrefined length",
    "stuck": "number of refinements since an interval was resolved",
    "fresh": "time at which the run began anew (s)",
    "event": "index of the condition that crosses, or -1",
    "slowest": "rate of the scene (1/s)",
    "worst": "largest violation of Psi at a node",
    "look": "time at which conditions are evaluated (s)",
    "low": "lower bound of the time of a crossing (s)",
    "high": "upper bound of the time of a crossing (s)",
    "next_look": "time at which the search for a crossing is to look next (s)",
    "looks": "number of times at which it has looked",
    "holds": "number of forces of interest where conditions are evaluated",
    "seeks": "whether a crossing is being located",
    "landing": "whether a step is to end at a crossing: 0, WANTED or UNDER_WAY",
    "landings": "number of steps that have ended at a crossing",
    "target": "end of the step to a crossing (s)",
    "stops": "whether the run ends at `sure_t`, at a crossing or unresolved",
}


class WatchMemory(PassingRuns):
    """A trajectory with memory for the conditions that it watches."""

    def __init__(self, plan: Plan, conditions: Conditions, passing: Passing | None = None):
        self.conditions, self.passing = conditions, passing
        super().__init__(plan)
        self.outputs = ("crossing", "passed") if passing else ("crossing",)
        self.inputs = (*self.inputs, "watch")
        for name in LANE_NUMBERS:
            assert name not in self.places.places, name  # one place for two numbers
            self.places.add(name)
        self.places.add("condition numbers", conditions.number_count)
        for name in ("side", "on", "floor", "direction", "g", "rate", "g0", "rate0", "g1", "rate1", "side1", "side2", "hit"):
            self.places.add(f"condition {name}", conditions.count)
        for name in ("hit1", "hit2"):
            self.places.add(f"condition {name}", conditions.count)
        if conditions.forces is not None:
            self.places.add("multipliers", self.m)
        self.places.add("forces", conditions.force_count)
        for name in ("force q", "sure q", "sure v", "middle q", "middle v", "node a", "before q", "before v", "before a"):
            self.places.add(name, self.n)
        self.lay_out_passing()

    # --- inputs and outputs

    def begin_member(self, f: Function, lane: Value, member: Value):
        given, start = self.member_address(f, "watch", member), 0
        counts = {"numbers": self.conditions.number_count}
        counts |= dict.fromkeys(("side", "on", "floor", "direction"), self.conditions.count)
        for name, count in counts.items():
            with f.each(count) as i:
                self.put_lane_entry(f, f"condition {name}", lane, f.load(given, i + start), i)
            start += count
        for name in LANE_NUMBERS:
            self.put_lane_entry(f, name, lane, f.const(0.0))
        first = self.lane_entry(f, "start", lane)
        for name in ("node", "sure_t", "fresh", "first_t"):  # after a breakpoint at the start, `record_step` renews `fresh`
            self.put_lane_entry(f, name, lane, first)
        self.put_lane_entry(f, "event", lane, f.const(-1.0))
        self.put_lane_entry(f, "share", lane, f.const(1.0))
        self.put_lane_entry(f, "slowest", lane, f.load(given, start))
        self.ask_for_forces(f, lane)
        if self.passing:
            self.begin_record(f, lane, f.load(given, start + 1))
            if "lock constants" in self.places.places:
                with f.each(self.passing.constants(self.n)) as i:
                    self.put_lane_entry(f, "lock constants", lane, f.load(given, i + (start + 2)), i)
        for x in "qv":
            with f.each(self.n) as i:
                self.put_lane_entry(f, f"sure {x}", lane, self.lane_entry(f, f"point3 {x}", lane, i), i)

    def end_members(self, f: Function, s: Lane):
        with self.each_lane(f, s.due) as k:
            member = self.to_int(f, f.lane(s.member, k))
            to = self.result_address(f, "crossing", member, self.conditions.output_count(self.n))
            for j, x in enumerate((s.event, s.sure_t, s.worst)):
                f.store(f.lane(x, k), to, j)
            self.copy_lane(f, to, Conditions.head, "condition side", k, count=self.conditions.count)
            for j, x in enumerate("qv"):
                self.copy_lane(f, to, Conditions.head + self.conditions.count + j * self.n, f"sure {x}", k)
            if self.passing:
                self.end_record(f, k, member)

    # --- arrays of conditions and states

    def condition(self, f: Function, name: str, c: Value) -> Value:
        return self.entry(f, f"condition {name}", c)

    def put_condition(self, f: Function, name: str, c: Value, x: Value, mask: Value | None = None):
        x = x if mask is None else f.select(mask, x, self.condition(f, name, c))
        self.put_entry(f, f"condition {name}", c, x)

    def move_conditions(self, f: Function, mask: Value, **names: str):
        """Copy arrays of conditions to others, in the lanes of `mask`."""
        with f.each(self.conditions.count) as c:
            for source, to in names.items():
                self.put_condition(f, to, c, self.condition(f, source, c), mask)

    def copy_state(self, f: Function, mask: Value, sources: tuple[str, str], to: str):
        for source, x in zip(sources, "qv", strict=True):
            self.copy(f, source, f"{to} {x}", mask)

    def move_point(self, f: Function, mask: Value, k: int, ahead: Value, to: tuple[str, str] = ("state q", "state v")):
        """Compute the state at a time `ahead` (s) after point k, by a Taylor step; its error is rounding up to `LAST_CHANGE`.

        The state becomes the arrays `to`, in the lanes of `mask`.
        """
        ahead = self.broadcast(f, ahead)
        with f.each(self.rowcount) as r:
            q, v, a = (self.vector(f, f"point{k} {x}", r) for x in "qva")
            moved = f.fma(f.fma(a, ahead * 0.5, v), ahead, q), f.fma(a, ahead, v)
            for name, new in zip(to, moved, strict=True):
                self.put(f, name, r, f.select(mask, new, self.vector(f, name, r)))

    def stop(self, f: Function, s: Lane):
        """End the runs of lanes that are to stop (`stops`): as `CROSSED` if there is an event, else as `UNRESOLVED`."""
        stops = s.stops > 0.5
        s.where(stops, code=f.select(s.event >= 0.0, f.const(float(Status.CROSSED), DOUBLE, f.width), float(Status.UNRESOLVED)))
        s.where(stops, until=f.min(s.until, s.sure_t), stops=0.0, landing=0.0)

    def begin_intervals(self, f: Function, s: Lane, mask: Value):
        """Begin two intervals at the node that was evaluated last, in the lanes of `mask`."""
        self.move_conditions(f, mask, g="g0", rate="rate0")
        fastest = self.largest(f, lambda r: [f.abs(self.vector(f, "result v", r)) * self.vector(f, "inverse unit", r)])
        start, rest = s.look, s.end - s.look
        turn = s.turn + PHASE_INCREMENT
        turn = turn - f.intrinsic("floor", turn)
        span = (
            f.fma(turn, LARGEST_REDUCTION, 1.0 - LARGEST_REDUCTION)
            * (2 / RESOLUTION.per_time)
            * s.share
            / f.max(fastest, s.slowest)
        )
        # A later refinement needs the points on both sides of the first node: intervals are not longer than the next step, and
        # end with the last one if they begin before it, as after the first steps of a run, whose outputs wait for each other.
        span = f.min(span, f.select(start < s.point2_t, s.point3_t - start, s.h))
        span = f.select(span * 2.0 < rest, span, f.select(span < rest, rest * 0.5, rest))
        inf = f.const(float("inf"), DOUBLE, f.width)
        goes_on = rest > s.smallest * (4 * ROUNDING_UNIT)
        middle = f.select(goes_on, f.fma(span, MIDDLE_NODE, start), inf)
        s.where(mask, first_t=start, sure_t=start, turn=turn, which=float(SECOND), node=middle)
        s.where(mask, behind_middle=f.select(span < rest, start + span, s.end))
