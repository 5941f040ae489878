"""Derivatives of a trajectory in forward mode, along directions, computed with each step.

A run is a function of the constants of a scene and of the initial state; step sizes are not differentiated. Along a direction,
the tangents of the stages are the sums

    dq_i = dq + h c_i dv + h^2 sum_j (A A)_ij da_j,        dv_i = dv + h sum_j A_ij da_j,

and the tangents of the accelerations, the end of a step and the projected outputs come from the programs of derivatives
(expressions/algebra/differential.py), which need intermediate results of the evaluation. Interpolation is linear. A stage of an
implicit method is the solution of a_i = a(t_i, Q_i + h^2 g^2 a_i, V_i + h g a_i) (stage_equations.py), where Q_i and V_i
are the state of the stage without its own a_i, so that

    (I - h^2 g^2 a_q - h g a_v) da_i = a_q dQ_i + a_v dV_i + a_p dp.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext

from udkjax.expressions.loops.loop_derivative import FORWARD
from udkjax.native.derivatives.differentiated import Differentiated
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane, Layout, Plan
from udkjax.native.module.program_derivative import GIVEN_DIRECTIONS
from udkjax.native.module.prologue import PROLOGUE_NAMES, write_prologue_derivative
from udkjax.native.module.samples import row_address
from udkjax.native.module.steps import NODE_COUNT
from udkjax.native.module.tableau import Method
from udkjax.native.run.dense_output import write_between, write_differences
from udkjax.native.run.members import kept_outputs


class Forward(Differentiated):
    """A trajectory with its tangents along directions.

    Directions come in groups. Each group has memory, a `tangent`: for one direction of all members or, if there is only one
    member, for as many directions as there are lanes. For second derivatives along pairs of directions, a group has three
    consecutive tangents: one for each direction, and one for both.
    """

    accelerate_stage = Differentiated.evaluate_stage  # intermediate results are needed in each step
    mode = FORWARD
    ways = ("d",)  # prefixes of the inputs of each tangent of a group
    outputs = ("dys", "dend")
    directions_in = 1

    def __init__(self, plan: Plan, active: tuple[bool, ...], lanes: int):
        super().__init__(plan, active)
        input_ways = [way for way in self.ways if way in GIVEN_DIRECTIONS]
        names = [f"{way}samples" for way in input_ways if plan.sampled] + [
            f"{way}{x}" for way in input_ways for x in ("numbers", "q", "v")
        ]
        self.inputs = (*self.inputs, *names)
        self.tangents = w = Layout(lanes, plan.vector)
        self.group = lanes // plan.width  # directions of a tangent
        w.add("constants", self.count)
        for name in ("state q", "state v", "result q", "result v"):
            w.add(name, self.n)
        for k in range(NODE_COUNT):
            for x in "qva":
                w.add(f"point{k} {x}", self.n)
        for i in range(1, self.stages):
            w.add(f"stage{i} a", self.n)
        for k in range(3 * NODE_COUNT):
            w.add(f"difference{k}", self.n)

    def write_derivatives(self):
        for derivative in self._linearizations:
            derivative.forward()
        self.write_prologue_derivative()
        w = self.tangents
        write_differences(self, "tangent_differences", ("tangent", w))
        write_between(self, "tangent_between", ("tangent", w))

    def write_prologue_derivative(self):
        """Write the function that computes the tangents of the constants from those of the numbers, if any constant moves."""
        if self.count:
            write_prologue_derivative(self, self.active, self.mode)

    @contextmanager
    def _each_group(self, f: Function) -> Iterator[Value]:
        """Run the block for every group of directions, with `tangent` set to its memory."""
        with self._each_tangent(f, len(self.ways)) as p:
            yield p

    @contextmanager
    def _each_tangent(self, f: Function, step: int = 1) -> Iterator[Value]:
        """Run the block for every `step`-th tangent of all groups, with `tangent` set to its memory."""
        first = self.first_tangent(f)
        with f.each(self.groups(f) * (len(self.ways) // step)) as p:
            f.given["tangent"] = f.at(first, p * (step * self.tangents.size * self.tangents.width))
            yield p

    @contextmanager
    def _each_direction(self, f: Function, p: Value, lane: Value) -> Iterator[tuple[Value, Value]]:
        """Run the block for every direction of group p, for the member in a lane.

        Yields:
            The index of the direction, and its lane in the tangent.
        """
        with f.each(self.group) as j:
            direction = p * self.group + j
            with f.if_(direction < self.field(f, "directions")):
                yield direction, lane if self.group == 1 else j

    def _way(self, f: Function, way: str) -> Value:
        """Return the address of the tangent `way`, one of `ways`, in the current group."""
        return f.at(f.given["tangent"], self.ways.index(way) * self.tangents.size * self.tangents.width)

    def _call_derivative(self, f: Function, name: str, stored: str, out: Value | None = None):
        tangent = f.given["tangent"]
        f.call(name, f.given["work"], self.address(f, stored), tangent, out or tangent)

    def _project_tangent(self, f: Function):
        """Project the tangents `state q` and `state v` of the current group to `result q` and `result v`, on the manifold."""
        if self.of_projection:
            self._call_derivative(f, f"{self.mode}_projection", "projection linearization")
        else:
            group = f.given["tangent"]
            for way in self.ways:
                f.given["tangent"] = f.at(group, self.ways.index(way) * self.tangents.size * self.tangents.width)
                with f.each(self.registers("tangent")) as r:
                    for x in "qv":
                        self.put(f, f"result {x}", r, self.vector(f, f"state {x}", r, "tangent"), "tangent")
            f.given["tangent"] = group

    def record_stage(self, f: Function, s: Lane, i: int):
        """Compute the tangents of the accelerations of stage i."""
        h = self.broadcast(f, s.step)
        with self._each_tangent(f):
            self._change_stage(f, i, h, "point3")
        with self._each_group(f):
            self._call_derivative(f, self.mode, f"stage{i} linearization", self._tangent_address(f, f"stage{i} a"))

    def record_solved_stage(self, f: Function, s: Lane, i: int):
        """Compute the tangents of the accelerations of solved stage i of an implicit step.

        Second derivatives come last, as they depend on the tangents along either direction.
        """
        name, method, h, mask = f"stage{i} a", self.stiffness.method, self.broadcast(f, s.step), s.stepping > 0.5
        self._evaluate_solved(f, i)
        for ways in ([way for way in self.ways if way in GIVEN_DIRECTIONS], self.ways[-1:]):
            with self._each_group(f):
                for way in ways:  # the tangent of the state must not contain the tangent of this stage
                    with self._in_way(f, way), f.each(self.registers("tangent")) as r:
                        self.put(f, name, r, f.select(mask, 0.0, self.vector(f, name, r, "tangent")), "tangent")
            with self._each_tangent(f):
                self._change_stage(f, i, h, "point3", method)
            with self._each_group(f) as p:
                stored, solved = f"stage{i} linearization", "difference0"
                self._call_derivative(f, self.mode, stored, self._tangent_address(f, solved))
                self._solve(f, p, solved, ways)
                for way in ways:
                    with self._in_way(f, way), f.each(self.registers("tangent")) as r:
                        new, old = (self.vector(f, x, r, "tangent") for x in (solved, name))
                        self.put(f, name, r, f.select(mask, new, old), "tangent")
            if len(self.ways) == 1:
                break

    @contextmanager
    def _in_way(self, f: Function, way: str) -> Iterator[None]:
        """Run the block with `tangent` set to the memory of the tangent `way` of the current group."""
        group = f.given["tangent"]
        f.given["tangent"] = self._way(f, way)
        yield
        f.given["tangent"] = group

    def _solve(self, f: Function, p: Value, name: str, ways: Sequence[str]):
        """Replace b, the array `name`, by the solution x of D x = b, in the tangents `ways` of group p."""
        d = self.stiffness.exact(f)
        b, x = d.row("b"), d.row("x")
        for way in ways:
            with self._in_way(f, way):
                if self.group == 1:
                    with f.each(self.rowcount) as r:
                        b[r] = self.vector(f, name, r, "tangent")
                    f.call("solve_exact", f.given["work"])
                    with f.each(self.rowcount) as r:
                        self.put(f, name, r, x[r], "tangent")
                    continue
                with self._each_direction(f, p, f.const(0, INT)) as (_, lane):  # all have the same matrix
                    with f.each(self.n) as i:
                        b.put(i, self.lane_entry(f, name, lane, i, "tangent"))
                    f.call("solve_exact", f.given["work"])
                    with f.each(self.n) as i:
                        self.put_lane_entry(f, name, lane, x.entry(i), i, "tangent")

    def record_step(self, f: Function, s: Lane, accept: Value):
        with f.if_(f.any_of(accept)):
            self._change_end(f, s, accept)

    def _change_end(self, f: Function, s: Lane, accept: Value):
        """Compute the tangents of point 3 from those of point 2, where the step began."""
        step = f.select(s.begin > 0.5, 0.0, s.t1 - s.point2_t)
        h, begin = self.broadcast(f, step), s.begin > 0.5
        with self._each_tangent(f), f.each(self.registers("tangent")) as r:
            for k in range(NODE_COUNT - 1):
                for x in "qva":
                    old_point, next_point = (self.vector(f, f"point{j} {x}", r, "tangent") for j in (k, k + 1))
                    self.put(f, f"point{k} {x}", r, f.select(accept, next_point, old_point), "tangent")
        setattr(s, "state t", s.point3_t)
        with f.each(self.rowcount) as r:
            for x in "qv":
                self.put(f, f"state {x}", r, self.vector(f, f"point3 {x}", r))
        self._evaluate_end(f)
        for method, mask in self.stiffness.methods(f, s):
            with self._each_tangent(f):
                self._change_stage(f, method.stages, h, "point2", method, mask)
        with self._each_tangent(f), f.each(self.registers("tangent")) as r:
            for x in "qv":
                new = f.select(begin, self.vector(f, f"point2 {x}", r, "tangent"), self.vector(f, f"state {x}", r, "tangent"))
                self.put(f, f"state {x}", r, new, "tangent")
        self._project_end(f, begin)
        # The accelerations at the end of an implicit step are those of its last stage.
        is_new = begin | (s.crosses > 0.5) if self.pieces else begin
        with f.if_(f.any_of(is_new)) if self.method.is_implicit else nullcontext(), self._each_group(f):
            self._call_derivative(f, self.mode, f"stage{self.last} linearization", self._tangent_address(f, "difference0"))
        self._finish_change(f, s, accept)
        with self._each_tangent(f), f.each(self.registers("tangent")) as r:
            for name, x in (("result q", "q"), ("result v", "v"), ("difference0", "a")):
                old, new = self.vector(f, f"point3 {x}", r, "tangent"), self.vector(f, name, r, "tangent")
                if (implicit := self.stiffness.method) and x == "a":
                    of_stage = self.vector(f, f"stage{implicit.stages - 1} a", r, "tangent")
                    new = f.select(s.begin < -0.5, of_stage, new)
                self.put(f, f"point3 {x}", r, f.select(accept, new, old), "tangent")

    def _project_end(self, f: Function, begin: Value):
        """Project the tangents of the state at the end of a step; `begin`: the lanes whose step is the beginning of a run."""
        del begin  # only second derivatives, which project the initial state twice, need it
        with self._each_group(f):
            self._project_tangent(f)
        with self._each_tangent(f), f.each(self.registers("tangent")) as r:
            for x in "qv":
                self.put(f, f"state {x}", r, self.vector(f, f"result {x}", r, "tangent"), "tangent")

    def _finish_change(self, f: Function, s: Lane, accept: Value):
        """Hook: change `result q` and `result v`, the tangents of the state at the end of a step. Does nothing by default.

        Called for accepted steps, in lanes that `accept`, before these tangents are stored as those of point 3.
        """

    def _change_stage(self, f: Function, i: int, h: Value, start: str, method: Method | None = None, mask: Value | None = None):
        """Compute the tangents of the state of stage i, as `state q` and `state v` of the current tangent.

        Args:
            f: The function to which the code is added.
            i: The index of the stage; the number of stages means the end of the step.
            h: The length of the step.
            start: The point from which the step starts.
            method: The method of the step; None: the method of the module.
            mask: The lanes that change; None: all lanes.
        """
        method = method or self.method
        node, names = float(method.nodes[i]), [f"{start} a", *self.stage_accelerations[1:]]
        with f.each(self.registers("tangent")) as r:
            q, v = self.vector(f, f"{start} q", r, "tangent"), self.vector(f, f"{start} v", r, "tangent")
            sum_q, sum_v = (self.weighted_sum(f, row[i], r, names, "tangent") for row in (method.q, method.v))
            slope = v * node if sum_q is None else f.fma(h, sum_q, v * node)
            for x, new in (("q", f.fma(h, slope, q)), ("v", v if sum_v is None else f.fma(h, sum_v, v))):
                new = new if mask is None else f.select(mask, new, self.vector(f, f"state {x}", r, "tangent"))
                self.put(f, f"state {x}", r, new, "tangent")

    def _tangent_address(self, f: Function, name: str) -> Value:
        return f.at(f.given["tangent"], self.start(name, "tangent"))

    def record_output(self, f: Function, s: Lane):
        with f.each(self.rowcount) as r:
            self.put(f, "state v", r, self.vector(f, "result v", r))  # the input of the programs
        self._evaluate_projection(f)
        with self._each_tangent(f):
            f.call("tangent_differences", f.given["work"], f.given["tangent"])
            f.call("tangent_between", f.given["work"], f.given["tangent"])
        with self._each_group(f) as p:
            self._project_tangent(f)
            f.given["tangent"] = self._way(f, self.ways[-1])
            with self.each_lane(f, s.due) as k:
                self._write_change(f, s, k, p, self.to_int(f, f.lane(s.written, k)) + 1, "result q", "result v")

    def _write_change(self, f: Function, s: Lane, k: Value, p: Value, number: Value, q: str, v: str):
        """Write the derivatives of output state `number` of the member in lane k, along the directions of group p.

        They are the arrays `q` and `v` of the current tangent.
        """
        member, times = self.to_int(f, f.lane(s.member, k)), self.field(f, "times")
        with self._each_direction(f, p, k) as (direction, lane):
            row = (member * self.field(f, "directions") + direction) * times + number
            to = self.result_address(f, "dys", row, 2 * self.n)
            self.copy_lane(f, to, 0, q, lane, "tangent")
            self.copy_lane(f, to, self.n, v, lane, "tangent")

    def begin_row(self, f: Function, lane: Value, member: Value, numbers: Value, constants: Value):
        """Compute the tangents of the constants along all directions."""
        if not self.count:
            return
        tangents = [Value(f, f.reserve(DOUBLE, self.count), POINTER) for _ in self.ways]
        zeros = Value(f, f.reserve(DOUBLE, self.code.number_count), POINTER)  # numbers have no second derivatives
        if len(self.ways) > 1:
            with f.each(self.code.number_count) as i:
                f.store(0.0, zeros, i)
        with self._each_group(f) as p, self._each_direction(f, p, lane) as (direction, tangent_lane):
            inputs = [
                self._changes_of_numbers(f, way, member, direction) if way in GIVEN_DIRECTIONS else zeros for way in self.ways
            ]
            f.call(PROLOGUE_NAMES[self.mode], numbers, constants, *inputs, *tangents)
            for way, changes in zip(self.ways, tangents, strict=True):
                with f.each(self.count) as i:
                    f.store(f.load(changes, i), self._way(f, way), tangent_lane + self.place("constants", i, "tangent"))

    def _changes_of_numbers(self, f: Function, way: str, member: Value, direction: Value) -> Value:
        """Return the address of the tangents of a member's numbers along a direction.

        The tangents of sampled numbers are those of the lane's current row of samples.
        """
        count = self.code.number_count
        numbers = f.at(self.member_address(f, f"{way}numbers", member), direction * count)
        places = self.active_samples
        if not places:
            return numbers
        copy = Value(f, f.reserve(DOUBLE, count), POINTER)
        with f.each(count) as i:
            f.store(f.load(numbers, i), copy, i)
        rows, row = self.field(f, "knots") + 1, self.lane_entry(f, "row", f.given["lane"])
        samples = f.at(row_address(self, f, f"{way}samples", member, row), direction * rows * len(self.plan.sampled))
        for k, place in places.items():
            f.store(f.load(samples, k), copy, place)
        return copy

    def begin_member(self, f: Function, lane: Value, member: Value):
        with self._each_group(f) as p, self._each_direction(f, p, lane) as (direction, place):
            for way in self.ways:
                tangent = self._way(f, way)
                self._read_state(f, way, member, direction, tangent, place, [f"point{k}" for k in range(NODE_COUNT)])
                with f.each(self.n) as i:
                    for name in (
                        *(f"point{k} a" for k in range(NODE_COUNT)),
                        *(f"stage{j} a" for j in range(1, self.stages)),
                    ):
                        f.store(0.0, tangent, place + self.place(name, i, "tangent"))

    def _read_state(
        self, f: Function, way: str, member: Value, direction: Value, tangent: Value, place: Value, to: Sequence[str]
    ):
        """Read the tangent of the initial state of a member along a direction into the arrays `to` of a tangent.

        `place` is the lane of the direction in the tangent. Tangents along both of a pair of directions are zero.
        """
        for x in "qv":
            start = self.member_address(f, f"{way}{x}", member) if way in GIVEN_DIRECTIONS else None
            with f.each(self.n) as i:
                change = f.load(start, direction * self.n + i) if start else f.const(0.0)
                for array in to:
                    f.store(change, tangent, place + self.place(f"{array} {x}", i, "tangent"))

    def end_members(self, f: Function, s: Lane):
        """Write the tangents of the initial state, as given, and of the last state; outputs that are not kept get zeros."""
        way, times = self.ways[-1], self.field(f, "times")
        with self._each_group(f) as p, self.each_lane(f, s.due) as k:
            f.given["tangent"], member = self._way(f, way), self.to_int(f, f.lane(s.member, k))
            with self._each_direction(f, p, k) as (direction, lane):
                self._read_state(f, way, member, direction, f.given["tangent"], lane, ["state"])
                to = self.result_address(f, "dend", member * self.field(f, "directions") + direction, 2 * self.n)
                self.copy_lane(f, to, 0, "point3 q", lane, "tangent")
                self.copy_lane(f, to, self.n, "point3 v", lane, "tangent")
            self._write_change(f, s, k, p, f.const(0, INT), "state q", "state v")
            self._write_change(f, s, k, p, times - 1, "point3 q", "point3 v")
            kept = kept_outputs(self, f, s, k)
            with self._each_direction(f, p, k) as (direction, _):
                row = (member * self.field(f, "directions") + direction) * times + kept
                to = self.result_address(f, "dys", row, 2 * self.n)
                with f.each((times - kept) * (2 * self.n)) as i:
                    f.store(0.0, to, i)
