"""Derivatives of a trajectory in reverse mode, by backpropagation through the recorded steps (record.py).

A point is an accepted state (q, v, a) at its time; each step leads from one point to the next. Cotangents of the points are
accumulated from the last point to the first. Cotangents of an output are pulled back through its projection and interpolation to
the four points of its polynomial. Cotangents of a point are pulled back through its accelerations and its projection to the end
of the step before it, and through the sums

    q_i = q + h c_i v + h^2 sum_j (A A)_ij a_j,        v_i = v + h sum_j A_ij a_j

of the stages of this step, the last first, to the previous point. The stages are evaluated again with the intermediate results
that derivatives need; the transposed programs are those of expressions/algebra/differential.py. The stages of an implicit method
are solved again (stage_equations.py); D^(-T) turns the cotangents of their accelerations into those of their equations.

Members in lanes are backpropagated together; the next ones are loaded when all are complete.
"""

from collections.abc import Sequence

from udkjax.expressions.loops.loop_derivative import REVERSE
from udkjax.native.derivatives.record import Recorded
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Operand, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.prologue import PROLOGUE_NAMES, write_prologue_derivative
from udkjax.native.module.running import Repeat
from udkjax.native.module.samples import ARGUMENTS, count_breakpoints, numbers_of_row
from udkjax.native.module.steps import NODE_COUNT
from udkjax.native.module.tableau import Method
from udkjax.native.run.dense_output import write_differences_back
from udkjax.native.run.runge_kutta import stage_state


class Reverse(Recorded):
    """A module that integrates and returns a record or, in a call with cotangents, backpropagates along records."""

    inputs = ("given steps", "given record", "given qs", "given vs", "ysbar", "endbar")
    outputs = ("numbersbar", "qbar", "vbar", "record")
    mode = REVERSE

    def __init__(self, plan: Plan, active: tuple[bool, ...]):
        super().__init__(plan, active)
        if plan.sampled:
            self.outputs = (*self.outputs[:-1], "samplesbar", self.outputs[-1])
        p, n = self.places, self.n
        for name in ("before", "any"):
            p.add(name)
        p.add("total bar constants", self.count)
        p.add("bar constants", self.count)
        for name in ("bar state q", "bar state v", "bar result q", "bar result v"):
            p.add(name, n)
        for k in range(NODE_COUNT):
            for x in "qva":
                p.add(f"bar point{k} {x}", n)
        for j in range(self.stages):
            p.add(f"bar stage{j} a", n)
        for k in range(3 * NODE_COUNT):
            p.add(f"bar difference{k}", n)

    def write_derivatives(self):
        for derivative in self._linearizations:
            derivative.reverse()
        if self.count:
            write_prologue_derivative(self, self.active, REVERSE)
        write_differences_back(self)
        self.stiffness.write_stages("point2")
        self._write_step_back()
        self._write_leave_row()
        if self.plan.sampled:
            self._write_find_rows()
        self.write_end_record()
        self._write_walk()

    # --- backpropagation

    def _accumulate_constants(self, f: Function, mask: Value):
        """Add the cotangents of the constants from one program to the sums, in the lanes of `mask`."""
        with f.each(self.count) as i:
            total, change = (self.entry(f, name, i) for name in ("total bar constants", "bar constants"))
            self.put_entry(f, "total bar constants", i, f.select(mask, total + change, total))

    def _pull_projection(self, f: Function, mask: Value):
        """Pull `bar result` back through the projection of the state, which has been evaluated before, to `bar state`."""
        if self.of_projection:
            f.call("reverse_projection", f.given["work"], self.address(f, "projection linearization"), f.given["work"])
            self._accumulate_constants(f, mask)
        else:
            with f.each(self.rowcount) as r:
                for x in "qv":
                    self.put(f, f"bar state {x}", r, self.vector(f, f"bar result {x}", r))

    def _pull_accelerations(self, f: Function, stored: str, bar: str, mask: Value):
        """Pull the cotangents of accelerations in the array `bar` back through the equations at the state, to `bar state`.

        `stored`: the array of the intermediate results of their evaluation.
        """
        f.call("reverse", f.given["work"], self.address(f, stored), self.address(f, bar))
        self._accumulate_constants(f, mask)

    def _write_step_back(self):
        """Write `step_back(work)`: pull the cotangents of point 3 back through the step from point 2, to those of point 2.

        Lanes that have reached their first point (`at` is zero) stay as they are.
        """
        f, s = self.function("step_back")
        active, implicit = s.at > 0.5, self.stiffness.method
        step = f.select((s.begin > 0.5) | ~active, 0.0, s.point3_t - s.point2_t)
        h, last = self.broadcast(f, step), self.last
        explicit, solved = active & (s.begin > -0.5) & (s.begin < 0.5), active & (s.begin < -0.5)
        if not self.method.is_implicit:
            with f.if_(f.any_of(explicit)):  # the beginning of a run has no stages
                for i in range(1, last):
                    stage_state(self, f, s, i, "point2", step)
                    self.evaluate_stage(f, i)
        if implicit:
            with f.if_(f.any_of(solved)):
                s.step, s.stepping = step, f.select(solved, f.const(1.0, DOUBLE, f.width), 0.0)
                f.call("take_stages_from_point2", f.given["work"])
        setattr(s, "state t", s.point3_t)
        with f.each(self.rowcount) as r:
            for x in "qv":
                self.put(f, f"state {x}", r, self.vector(f, f"point3 {x}", r))
        self._evaluate_end(f)
        bar_of_end = "bar point3 a"
        if implicit:  # the accelerations at the end of an implicit step are those of its last stage
            bar_of_end = "residual a"
            with f.each(self.rowcount) as r:
                self.put(f, bar_of_end, r, f.select(solved, 0.0, self.vector(f, "bar point3 a", r)))
        self._pull_accelerations(f, f"stage{last} linearization", bar_of_end, active)
        with f.each(self.rowcount) as r:
            for x in "qv":
                self.put(f, f"bar result {x}", r, self.vector(f, f"bar point3 {x}", r) + self.vector(f, f"bar state {x}", r))
        self._pull_projection(f, active)
        if implicit:
            count = implicit.stages
            self._accumulate_stage(f, h, implicit, count, range(count), solved, first=True)
        if not self.method.is_implicit:
            self._accumulate_stage(f, h, self.method, last, range(last), active & ~solved, first=True)
            with f.if_(f.any_of(explicit)):
                for i in reversed(range(1, last)):
                    stage_state(self, f, s, i, "point2", step)
                    self._pull_accelerations(f, f"stage{i} linearization", f"bar stage{i} a", explicit)
                    self._accumulate_stage(f, h, self.method, i, range(i), explicit)
        if implicit:
            with f.if_(f.any_of(solved)):
                self._pull_solved_stages(f, s, h, implicit, solved, step)
        with f.each(self.rowcount) as r:
            old = self.vector(f, "bar point2 a", r)
            self.put(f, "bar point2 a", r, f.select(active, old + self.vector(f, "bar stage0 a", r), old))

    def _pull_solved_stages(self, f: Function, s: Lane, h: Value, method: Method, solved: Value, step: Value):
        """Pull the cotangents of the stages of an implicit step back to point 2, in the lanes of `solved`."""
        last = method.stages
        with f.each(self.rowcount) as r:
            old, bar = (self.vector(f, name, r) for name in (f"bar stage{last - 1} a", "bar point3 a"))
            self.put(f, f"bar stage{last - 1} a", r, f.select(solved, old + bar, old))
        for i in reversed(range(1, last)):
            stage_state(self, f, s, i, "point2", step, method)
            self._evaluate_solved(f, i)
            self._solve_transposed(f, f"bar stage{i} a")
            self._pull_accelerations(f, f"stage{i} linearization", f"bar stage{i} a", solved)
            self._accumulate_stage(f, h, method, i, range(i), solved)

    def _accumulate_stage(
        self, f: Function, h: Value, method: Method, i: int, stages: Sequence[int], active: Value, first: bool = False
    ):
        """Pull `bar state`, the cotangents of the state of stage i, back to point 2 and to the accelerations of other stages.

        Args:
            f: The function to which the code is added.
            h: The length of the step.
            method: The method of the step.
            i: The index of the stage; the number of stages means the end of the step.
            stages: The indices of the stages on which the state of stage i depends.
            active: The lanes that change.
            first: True to set the cotangents of these accelerations, instead of adding to them.
        """
        zero = f.const(0.0, DOUBLE, self.plan.vector)
        with f.each(self.rowcount) as r:
            of_q, of_v = (self.vector(f, f"bar state {x}", r) for x in "qv")
            hq = h * of_q
            for x, change in (("q", of_q), ("v", f.fma(hq, float(method.nodes[i]), of_v))):
                old = self.vector(f, f"bar point2 {x}", r)
                self.put(f, f"bar point2 {x}", r, f.select(active, old + change, old))
            hhq, hv = h * hq, h * of_v
            for j in stages:
                a2, a = float(method.q[i][j]), float(method.v[i][j])
                total = zero if first else self.vector(f, f"bar stage{j} a", r)
                total = f.fma(hhq, a2, total) if a2 else total
                total = f.fma(hv, a, total) if a else total
                if first or a2 or a:
                    self.put(f, f"bar stage{j} a", r, f.select(active, total, self.vector(f, f"bar stage{j} a", r)))

    def walk(self, f: Function, s: Lane, repeat: Repeat):
        arguments = f.given["work"], f.given["call"]
        f.call("begin_walk", *arguments)
        repeat(lambda: f.any_of(s.at > 0.5), lambda: f.call("walk", *arguments))
        f.call("end_walk", *arguments)

    def _write_walk(self):
        """Write `begin_walk`, `walk` and `end_walk`, functions of (work, call): backpropagation of members that are `ready`.

        `walk` goes one step back. At the end, the cotangents of the first output, which is the given initial state, are added to
        those of this state.
        """
        f, s = self.function("begin_walk", ARGUMENTS[:2])
        self._begin_backpropagation(f, s)

        f, s = self.function("walk", ARGUMENTS[:2])
        yes = f.const(1.0, DOUBLE, f.width)

        def due() -> Value:
            s.due = f.select((s.at > 0.5) & (s.written > s.before), yes, 0.0)
            return f.any_of(s.due > 0.5)

        if self.plan.sampled:
            f.call("find_rows", f.given["work"], f.given["call"])
        s.any = f.const(0.0, DOUBLE, f.width)
        with f.while_(due):
            s.any = yes
            self._pull_output(f, s)
        with f.if_(f.any_of(s.any > 0.5)):
            f.call("differences_back", f.given["work"])
        f.call("step_back", f.given["work"])
        self._move_back(f, s)

        f, s = self.function("end_walk", ARGUMENTS[:2])
        with self.each_lane(f, s.ready > 0.5) as k:
            self._add_output(f, k, f.const(0, INT), "bar point3")
            for x in "qv":
                self.copy_lane(f, self._result(f, f"{x}bar", k, self.n), 0, f"bar point3 {x}", k)
            if self.count:
                f.call("leave_row", f.given["work"], f.given["call"], k)
            self.free_record(f, k)
        s.ready = f.const(0.0, DOUBLE, f.width)

    def _add_state(self, f: Function, k: Value, bars: Value, to: str):
        """Add cotangents of a state at an address to arrays of lane k."""
        for x, offset in (("q", 0), ("v", self.n)):
            with f.each(self.n) as i:
                self.put_lane_entry(f, f"{to} {x}", k, self.lane_entry(f, f"{to} {x}", k, i) + f.load(bars, i + offset), i)

    def _add_output(self, f: Function, k: Value, number: Value, to: str):
        """Add the cotangents of an output of the member in lane k to arrays of that lane."""
        start = self.member_address(f, "ysbar", self.lane_entry(f, "member", k))
        self._add_state(f, k, f.at(start, number * (2 * self.n)), to)

    def _begin_backpropagation(self, f: Function, s: Lane):
        """Clear all cotangents, and load the last points of the members that are `ready`, with the cotangents of their ends."""
        n, times = self.n, self.field(f, "times")
        s.at = f.select(s.ready > 0.5, s.points - 1.0, 0.0)
        zeros = [f"bar point{k} {x}" for k in range(NODE_COUNT) for x in "qva"] + [
            f"bar difference{k}" for k in range(3 * NODE_COUNT)
        ]
        for names, length in ((zeros, n), (["total bar constants"], self.count)):
            with f.each(length) as i:
                for name in names:
                    self.put_entry(f, name, i, 0.0)
        with self.each_lane(f, s.ready > 0.5) as k:
            self._add_state(f, k, self.member_address(f, "endbar", self.lane_entry(f, "member", k)), "bar point3")
            with f.if_(self.to_int(f, self.lane_entry(f, "kept", k)) >= times):
                self._add_output(f, k, times - 1, "bar point3")
            for j in range(NODE_COUNT):
                self._load_point(f, k, self.lane_entry(f, "at", k) - float(NODE_COUNT - 1 - j), f"point{j}")
            self._load_head(f, k)
        cleared = [("numbersbar", f.const(self.code.number_count, INT))]
        if self.plan.sampled:
            cleared.append(("samplesbar", (self.field(f, "knots") + 1) * len(self.plan.sampled)))
        with self.each_lane(f, s.ready > 0.5) as k:
            for name, length in cleared:
                to = self._result(f, name, k, length)
                with f.each(length) as i:
                    f.store(0.0, to, i)

    def _pull_output(self, f: Function, s: Lane):
        """Pull the cotangents of the outputs that are `due` back through projection and interpolation, to `bar difference`.

        q = sum_k N_k pi_k and v = sum_k N_k pi_k', with divided differences N_k and products pi_k of differences of times.
        """
        n, mask = self.n, s.due > 0.5
        with f.each(n) as i:
            for x in "qv":
                self.put_entry(f, f"bar result {x}", i, 0.0)
        with self.each_lane(f, mask) as k:
            number, member = self.to_int(f, self.lane_entry(f, "written", k)), self.lane_entry(f, "member", k)
            self.put_lane_entry(f, "next", k, self.input_number(f, "ts", member, number))
            is_kept = self.lane_entry(f, "written", k) < self.lane_entry(f, "kept", k)
            with f.if_(is_kept):
                self._add_output(f, k, number, "bar result")
            of_state = f.select(is_kept, number, f.const(0, INT))  # the state of an output that is not kept is NaN
            for x in "qv":
                state = f.at(self.member_address(f, f"given {x}s", member), of_state * n)
                with f.each(n) as i:
                    self.put_lane_entry(f, f"state {x}", k, f.load(state, i), i)
        setattr(s, "state t", s.next)
        self._evaluate_projection(f)
        self._pull_projection(f, mask)
        ahead = [self.broadcast(f, s.next - getattr(s, f"point{NODE_COUNT - 1 - k}_t")) for k in range(NODE_COUNT)]
        with f.each(self.rowcount) as r:
            of_q, of_v = (self.vector(f, f"bar state {x}", r) for x in "qv")
            product, slope = f.const(1.0, DOUBLE, self.plan.vector), f.const(0.0, DOUBLE, self.plan.vector)
            for k in range(3 * NODE_COUNT):
                old = self.vector(f, f"bar difference{k}", r)
                new = f.fma(product, of_q, f.fma(slope, of_v, old))
                self.put(f, f"bar difference{k}", r, f.select(mask, new, old))
                slope = f.fma(slope, ahead[k // 3], product)
                product = product * ahead[k // 3]
        s.where(mask, written=s.written - 1.0)

    def _move_back(self, f: Function, s: Lane):
        """Shift points and their cotangents by one, and load the next earlier point."""
        active, zero = s.at > 0.5, f.const(0.0, DOUBLE, self.plan.vector)
        with f.each(self.rowcount) as r:
            for name in ("bar point", "point"):
                for k in reversed(range(0 if name == "bar point" else 1, NODE_COUNT)):
                    for x in "qva":
                        new = self.vector(f, f"{name}{k - 1} {x}", r) if k else zero
                        self.put(f, f"{name}{k} {x}", r, f.select(active, new, self.vector(f, f"{name}{k} {x}", r)))
        for k in reversed(range(1, NODE_COUNT)):
            for x in ("t", "solved"):
                s.where(active, **{f"point{k}_{x}": getattr(s, f"point{k - 1}_{x}")})
        s.where(active, at=s.at - 1.0)
        with self.each_lane(f, active) as k:
            self._load_point(f, k, self.lane_entry(f, "at", k) - float(NODE_COUNT - 1), "point0")
            self._load_head(f, k)

    def _write_find_rows(self):
        """Write `find_rows(work, call)`: load the rows of samples at the lanes' times, with their constants."""
        f, s = self.function("find_rows", ARGUMENTS[:2])
        work, call = f.given["work"], f.given["call"]
        with self.each_lane(f, s.at > 0.5) as k:
            knot = count_breakpoints(self, f, self.to_int(f, self.lane_entry(f, "member", k)), self.lane_entry(f, "point3_t", k))
            self.put_lane_entry(f, "knot", k, knot)
            with f.if_(self.lane_entry(f, "knot", k).is_not(self.lane_entry(f, "row", k))):
                if self.count:
                    f.call("leave_row", work, call, k)
                f.call("enter", work, call, k)

    def _write_leave_row(self):
        """Write `leave_row(work, call, lane)`: pull the cotangents of a lane's constants back to the numbers and samples."""
        if not self.count:
            return
        f, _ = self.function("leave_row", ARGUMENTS)
        k, count = f.given["lane"], self.code.number_count
        constants, bars, number_bars = (
            Value(f, f.reserve(DOUBLE, c), POINTER) for c in (max(self.constants, 1), self.count, count)
        )
        self.copy_lane(f, constants, 0, "constants", k, count=self.constants)
        self.copy_lane(f, bars, 0, "total bar constants", k, count=self.count)
        member, row = self.to_int(f, self.lane_entry(f, "member", k)), self.lane_entry(f, "row", k)
        sampled = self.plan.sampled
        numbers = numbers_of_row(self, f, member, row) if sampled else self.member_address(f, "numbers", member)
        f.call(PROLOGUE_NAMES[REVERSE], numbers, constants, bars, number_bars)
        if sampled:
            rows = (self.field(f, "knots") + 1) * len(sampled)
            output = f.at(self._result(f, "samplesbar", k, rows), self.to_int(f, row) * len(sampled))
            for column, place in self.active_samples.items():
                f.store(f.load(output, column) + f.load(number_bars, place), output, column)
        output = self._result(f, "numbersbar", k, count)
        with f.each(count) as i:
            f.store(f.load(output, i) + f.load(number_bars, i), output, i)
        with f.each(self.count) as i:
            self.put_lane_entry(f, "total bar constants", k, 0.0, i)

    def _result(self, f: Function, name: str, k: Value, length: Operand) -> Value:
        """Return the address of the output `name` of the member in lane k; the output has `length` numbers for each member."""
        return self.result_address(f, name, self.to_int(f, self.lane_entry(f, "member", k)), length)
