"""Machine code that follows the positions of a driven mechanism from value to value: a batch of members in W lanes.

A step predicts by the Taylor polynomial of q(s) to the third order, from q', q'' and the change of q'', and corrects twice by
Newton's method with elimination. All lanes take the same steps: nothing depends on how one of them fares. What is to be relied
on is counted: as long as each position is closed to rounding, lies near its prediction, the tangent has turned little since the
one before, and no row is near dependence. From there on, the caller goes on by singular values.
"""

import numpy as np

from udkjax.equations.position_closure import ROUNDING_UNITS
from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.layout import Lane, Plan
from udkjax.native.members import write_begin, write_run
from udkjax.native.module import Module
from udkjax.native.tableau import EULER

CORRECTIONS = 2
STRAIGHT = 0.95  # cosine of the angle by which the tangent may turn in a step
SLACK = 0.1  # of a step: how far a position may lie from its prediction
DISTANT = 1e-2  # from dependence: nearer, elimination loses more than half of the digits of q''


class Marching(Module):
    """The text of a module whose `run` follows members from their positions q at the value ts[0] over all values ts."""

    settings = ("length", "omega")
    results = ("qs", "dqs", "ddqs", "trusted")

    def __init__(self, code: ScenePrograms, width: int, vector: int):
        plan = Plan(
            code, EULER, projected=False, breaks=False, width=width, vector=vector, written_out=code.is_small, steps=False
        )
        super().__init__(plan)
        for name in ("previous dq", "previous ddq", "third derivative", "prediction"):
            self.places.add(name, self.n)

    def text(self) -> str:
        """LLVM's text of the whole module."""
        self.write_programs()
        write_begin(self)
        self._march()
        write_run(self)
        return self.module_text()

    def program_names(self) -> list[str]:
        return ["newton_q", "value_derivatives"]

    def _march(self):
        """`march(work, call)`: the members in all lanes, over all values."""
        f, s = self.function("march", [(POINTER, "work"), (POINTER, "call")])
        work, call, width = f.given["work"], f.given["call"], self.plan.width
        eps = float(np.finfo(float).eps)

        def get(name: str, i: Value) -> Value:
            return f.load(work, i * width + self.places[name] * width, width)

        def put(name: str, i: Value, x: Value):
            f.store(x, work, i * width + self.places[name] * width, width)

        def wide(x: float) -> Value:
            return f.const(x, DOUBLE, width)

        times = f.load(call, self.call_fields.index("times"), base=INT)
        trusted, good, before = f.variable(0.0), f.variable(1.0), f.variable(s.start)
        with f.each(self.n) as i:
            put("state q", i, get("point3 q", i))
            for name in ("result dq", "result dv", "third derivative"):
                put(name, i, wide(0.0))
        with f.each(times) as k:
            with f.each(width) as lane, f.if_(f.lane(s.active, lane) > 0.5):
                f.store(self.input_number(f, call, "ts", f.lane(s.member, lane), k), work, lane + self.places["state t"] * width)
            now = get("state t", f.const(0, INT))
            h = now - before.value
            with f.each(self.n) as i:
                first, second = get("result dq", i), get("result dv", i)
                bend = f.fma(h * (1 / 6), get("third derivative", i), second * 0.5)
                ahead = f.fma(f.fma(bend, h, first), h, get("state q", i))
                for name, x in (("previous dq", first), ("previous ddq", second), ("state q", ahead), ("prediction", ahead)):
                    put(name, i, x)
            for _ in range(CORRECTIONS):
                self.invoke(f, "newton_q")
                with f.each(self.n) as i:
                    put("state q", i, get("corrected q", i))
            self.invoke(f, "value_derivatives")
            off, largest = f.variable(0.0), f.variable(1.0)
            along, one, other = f.variable(0.0), f.variable(0.0), f.variable(0.0)
            moves_on = h.is_not(0.0)
            per_h = f.select(moves_on, wide(1.0) / f.select(moves_on, h, wide(1.0)), wide(0.0))
            with f.each(self.n) as i:
                unit, q = get("inverse unit", i), get("state q", i)
                largest.value = f.max(f.abs(q) * unit, largest.value)
                off.value = f.max(f.abs(q - get("prediction", i)) * unit, off.value)
                old, new = get("previous dq", i) * unit, get("result dq", i) * unit
                along.value = f.fma(old, new, along.value)
                one.value = f.fma(old, old, one.value)
                other.value = f.fma(new, new, other.value)
                put("third derivative", i, (get("result dv", i) - get("previous ddq", i)) * per_h)
            violated = f.variable(0.0)
            with f.each(self.m) as i:
                x = f.abs(get("psi", i)) / get("rows", i)
                violated.value = f.select((x > violated.value) | x.is_not(x), x, violated.value)
            per_unit = wide(1.0) / (s.omega * s.omega)
            along_s, one_s, other_s = along.value + per_unit, one.value + per_unit, other.value + per_unit
            straight = along_s > f.intrinsic("sqrt", one_s * other_s) * STRAIGHT
            near = off.value < f.abs(h) * f.intrinsic("sqrt", one_s) * SLACK + largest.value * (64 * eps)
            closed = ~(violated.value > largest.value * (ROUNDING_UNITS * eps)) & f.is_finite(violated.value)
            begins = f.compare("lt", k, 1)
            moves = (straight & near) | f.repeat(begins, width) if width > 1 else (straight & near) | begins
            fine = closed & (s.distance > DISTANT) & moves
            good.value = f.select(fine, good.value, wide(0.0))
            trusted.value = trusted.value + good.value
            with f.if_(begins), f.each(self.n) as i:  # there was no step: nothing is known of the third derivative
                put("third derivative", i, wide(0.0))
            before.value = now
            with f.each(width) as lane, f.if_(f.lane(s.active, lane) > 0.5):
                row = self.to_int(f, f.lane(s.member, lane)) * times + k
                for name, x in (("qs", "state q"), ("dqs", "result dq"), ("ddqs", "result dv")):
                    self.copy_lane(f, f.at(f.load(call, self.call_fields.index(name), base=POINTER), row * self.n), 0, x, lane)
        with f.each(width) as lane, f.if_(f.lane(s.active, lane) > 0.5):
            to = f.load(call, self.call_fields.index("trusted"), base=POINTER)
            f.store(f.lane(trusted.value, lane), to, self.to_int(f, f.lane(s.member, lane)))

    def step_all(self, f: Function, s: Lane, fill):
        f.call("march", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, self.plan.width)
        fill()
