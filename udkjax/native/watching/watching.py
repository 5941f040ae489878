"""Runs that watch conditions: they end at the first zero crossing, or where a crossing cannot be ruled out.

Conditions g(t, q, v) are programs, like accelerations. They are evaluated with their rates along the motion at nodes within the
accepted steps, two intervals at a time. In an interval a condition is Hermite's cubic up to an error E, the error of the cubic
over both intervals at the middle node; the error in one interval is a sixteenth of it, so E is a safe bound. If the Bernstein
coefficients of the cubic plus and minus E do not change sign, there is no crossing; if they change sign once, there is one
crossing, which is located on the polynomial of dense output. A step is then repeated to end at the crossing, whose
time is corrected by Newton's method; the last correction is a Taylor step. All other intervals are refined by a factor of eight;
conditions that still vary have a jump or a kink. If jumps repeat, or a condition is NaN, the run ends unresolved, and the caller
continues.
"""

from udkjax.native.language.ir import BOOL, DOUBLE, INT, Function, Value
from udkjax.native.language.program import write
from udkjax.native.module.layout import Lane
from udkjax.native.module.steps import NODE_COUNT, Status
from udkjax.native.watching.condition_intervals import write_classification
from udkjax.native.watching.conditions import ACROSS_BREAK, FIRST, FORCE_STEP, LAST_CHANGE, MIDDLE_NODE, SECOND, THIRD, WANTED
from udkjax.native.watching.locating import write_approach, write_land, write_locate
from udkjax.native.watching.sliding import write_slide
from udkjax.native.watching.turning import write_turn
from udkjax.native.watching.watch_memory import WatchMemory
from udkjax.native.watching.watched_forces import write_forces


class Watching(WatchMemory):
    """A module whose `run` integrates and watches conditions."""

    def write_derivatives(self):
        self._write_conditions()
        self._write_look()
        write_classification(self)
        write_locate(self)
        write_land(self)
        write_approach(self)
        self._write_watch()
        if self.passing and self.passing.kinks:
            write_turn(self, self.passing.kinks)
        if self.passing and self.passing.slides:
            write_slide(self, self.passing.slides, self.passing.zero)

    def before_step(self, f: Function, s: Lane):
        with f.if_(f.any_of(s.landing > 0.5)):
            f.call("approach", f.given["work"])

    def after_step(self, f: Function, s: Lane):
        f.call("watch", f.given["work"])
        with f.if_(f.any_of(s.landing > WANTED + 0.5)):
            f.call("land", f.given["work"])

    def after_outputs(self, f: Function, s: Lane):
        if self.passing:
            with f.if_(f.any_of(self.may_pass(f, s))):
                if self.passing.kinks:
                    f.call("pass_kinks", f.given["work"], f.given["call"])
                if self.passing.slides:
                    f.call("pass_slides", f.given["work"], f.given["call"])

    def interpolates(self, f: Function, s: Lane) -> Value:
        return f.const(True, BOOL, f.width)  # for the conditions within each step

    def record_step(self, f: Function, s: Lane, accept: Value):
        begins = accept & (s.begin > 0.5)
        # Intervals that were cut at a breakpoint continue from the first state after it.
        s.where(begins & (s.t1 - s.first_t <= s.smallest * ACROSS_BREAK), which=float(FIRST), node=s.t1)
        s.where(begins, fresh=s.t1)

    def program_names(self) -> list[str]:
        return [*super().program_names(), *(["multipliers_of_settled"] if self.conditions.forces else [])]

    @property
    def arrays(self):
        return super().arrays | ({"multipliers": ("work", self.places["multipliers"])} if self.conditions.forces else {})

    def _write_conditions(self):
        """Write `conditions(work)`: compute the conditions and their rates at `state t`, `state q`, `result v` and `node a`."""
        n, conditions, p = self.n, self.conditions, self.places
        inputs = [("work", p["state t"])]
        for name in ("state q", "result v", "node a"):
            inputs += [("work", p[name] + i) for i in range(n)]
        inputs += [("work", p["condition numbers"] + i) for i in range(conditions.number_count)]
        outputs = [("work", p[f"condition {name}"] + c) for name in ("g", "rate") for c in range(conditions.own_count)]
        self.functions.append(write(conditions.program, "own_conditions", self.plan.width, ("work",), inputs, outputs))
        if conditions.forces is not None:
            self.functions.append(write_forces(conditions, self))
        f, s = self.function("conditions")
        f.call("own_conditions", f.given["work"])
        if conditions.forces is not None:
            with f.if_(f.any_of(s.holds > 0.5)):
                self._write_forces(f, s)

    def _write_forces(self, f: Function, s: Lane):
        """Compute the watched forces and, by differences, their rates; they are stored after the conditions g.

        Forces are NaN if a pivot is too small.
        """
        self.copy(f, "state q", "force q")
        self.copy(f, "result v", "state v")
        step, before = f.const(FORCE_STEP, DOUBLE, f.width) / s.omega, getattr(s, "state t")
        ahead, nan = self.broadcast(f, step), f.const(float("nan"), DOUBLE, f.width)
        for name in ("g", "rate"):
            self.friction.settle(f, "result a")
            self.invoke(f, "multipliers_of_settled")
            f.call("own_forces", f.given["work"])
            for k in range(self.conditions.force_count):
                place, c = f.like(k, INT, 1) + self.places["forces"], f.like(self.conditions.own_count + k, INT, 1)
                force = f.select(s.safe > 0.5, f.load(f.given["work"], place * f.width, f.width), nan)
                self.put_condition(f, name, c, force if name == "g" else (force - self.condition(f, "g", c)) / step)
            if name == "g":
                setattr(s, "state t", before + step)
                with f.each(self.rowcount) as r:
                    q, v, a = (self.vector(f, x, r) for x in ("state q", "state v", "result a"))
                    self.put(f, "state q", r, f.fma(f.fma(a, ahead * 0.5, v), ahead, q))
                    self.put(f, "state v", r, f.fma(a, ahead, v))
        setattr(s, "state t", before)
        self.copy(f, "force q", "state q")

    def _write_look(self):
        """Write `look(work)`: interpolate the state at the time `look`, and evaluate its conditions.

        The state is projected in lanes that are `due`.
        """
        program = self.conditions.program
        f, s = self.function("look")
        work, following = f.given["work"], s.next
        s.next = s.look
        f.call("between", work)
        accelerates = any(program.uses(x) for x in program.inputs[1 + 2 * self.n : 1 + 3 * self.n])
        if accelerates:
            self._accelerate_between(f, s)
        # At a point the polynomial has nothing but its rounding errors, which are largest at the first one, and a condition may
        # begin at zero there.
        for k in range(NODE_COUNT):
            ahead = s.look - getattr(s, f"point{k}_t")
            is_point = f.abs(ahead) * s.omega <= LAST_CHANGE
            with f.if_(f.any_of(is_point)):
                self.move_point(f, is_point, k, ahead)
                if accelerates:
                    self.copy(f, f"point{k} a", "node a", is_point)
        s.next = following
        self.projection.project_output(f, s, s.due > 0.5)
        f.call("conditions", work)
        s.where((s.due > 0.5) & ~(s.violated <= s.worst), worst=s.violated)

    def _accelerate_between(self, f: Function, s: Lane):
        """Compute `node a`, the second derivative of the polynomial at the time `next`."""
        ahead = [self.broadcast(f, s.next - getattr(s, f"point{NODE_COUNT - 1 - k}_t")) for k in range(NODE_COUNT)]
        with f.each(self.rowcount) as r:
            q, zero = self.vector(f, f"difference{3 * NODE_COUNT - 1}", r), f.const(0.0, DOUBLE, self.plan.vector)
            v = a = zero
            for k in reversed(range(3 * NODE_COUNT - 1)):
                d = ahead[k // 3]
                a = f.fma(a, d, v * 2.0)
                v = f.fma(v, d, q)
                q = f.fma(q, d, self.vector(f, f"difference{k}", r))
            self.put(f, "node a", r, a)

    def _cut_intervals(self, f: Function, s: Lane):
        """Cut two intervals that cross the breakpoint, the end of a piece or the sudden change at which a step has ended.

        They are also cut where steps have become short in comparison: their first node must not precede the first point of the
        polynomial, which the next step drops.
        """
        abrupt = (s.abrupt > 0.5) | (s.first_t < s.point1_t)
        ends, end = abrupt, s.point3_t
        if self.plan.breaks:
            ends, end = abrupt | (s.lands > 0.5), f.select(abrupt, s.point3_t, s.t1)
        if self.pieces:
            across = self.steps_across_next(s)
            ends, end = ends | across, f.select(across, s.point3_t, end)
        cut = ends & (s.until >= end) & (s.behind_middle > end) & s.which.is_not(float(FIRST))
        cut = cut & (end - s.first_t > s.smallest * ACROSS_BREAK)
        node = f.fma(end - s.first_t, MIDDLE_NODE, s.first_t)
        s.where(cut, which=float(SECOND), node=node, behind_middle=end)

    def _write_watch(self):
        """Write `watch(work)`: evaluate conditions at all nodes within accepted steps, and act on crossings."""
        f, s = self.function("watch")
        work, one = f.given["work"], f.const(1.0, DOUBLE, f.width)

        s.where(s.landing > 0.5, until=-float("inf"))

        def due() -> Value:
            self._cut_intervals(f, s)
            goes_on = s.code.is_(float(Status.RUNNING)) | s.code.is_(float(Status.DONE))
            s.due = f.select((s.active > 0.5) & goes_on & (s.node <= s.until), one, 0.0)
            return f.any_of(s.due > 0.5)

        with f.if_(due()):
            f.call("differences", work)
            with f.while_(due):
                s.look = s.node
                f.call("look", work)
                now = s.due > 0.5
                first, middle, last = (now & s.which.is_(float(k)) for k in (FIRST, SECOND, THIRD))
                with f.if_(f.any_of(middle)):
                    self.move_conditions(f, middle, g="g1", rate="rate1")
                    self.copy_state(f, middle, ("state q", "result v"), "middle")
                    s.where(middle, middle_t=s.node, which=float(THIRD), node=s.behind_middle)
                with f.if_(f.any_of(last)):
                    s.low = f.select(last, one, 0.0)
                    f.call("judge", work)
                with f.if_(f.any_of(first)):
                    self.begin_intervals(f, s, first)
                with f.if_(f.any_of(s.seeks > 0.5)):
                    f.call("locate", work)
                self.stop(f, s)
                # Outputs before the crossing use the current polynomial.
                wanted = s.landing.is_(float(WANTED))
                s.where(wanted, until=f.min(s.until, s.sure_t), code=float(Status.RUNNING), node=float("inf"))
