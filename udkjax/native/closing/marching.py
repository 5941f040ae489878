"""Machine code that follows the positions of a driven mechanism from value to value: a batch of members in W lanes.

A step predicts by the third-order Taylor polynomial of q(s), from q', q'' and the change of q'', and corrects twice by Newton's
method with elimination. All lanes take the same steps, even if some fail. Reliable positions are counted: up to the first
position that is not closed up to rounding errors, is far from its prediction, has too large a rotation of the tangent, or has a
nearly dependent row. From there the caller continues by singular values.

If the mechanism has as many independent rows as coordinates, each position has a side, the sign of det Psi_q of these rows. The
side changes where branches meet, and differs on another branch nearby.
"""

import numpy as np

from udkjax.equations.position_closure import CLOSURE
from udkjax.equations.run_programs import RunPrograms
from udkjax.native.base.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.base.layout import Lane, Plan
from udkjax.native.base.module import Module
from udkjax.native.base.program import PointerPlace
from udkjax.native.base.tableau import EULER
from udkjax.native.base.weighted_rows import WeightedRows
from udkjax.native.pseudoinverses.lu import LUCode
from udkjax.native.run.manifold import largest_violation
from udkjax.native.run.members import write_begin

CORRECTIONS = 2
STRAIGHT = 0.95  # cosine of the largest rotation of the tangent in a step
SLACK = 0.1  # largest distance of a position from its prediction, as a fraction of the step
_METHOD = LUCode(relative=True)
DISTANT = 1e-2  # smallest distance from dependent rows: below, elimination loses more than half of the digits of q''


class Marching(Module):
    """The text of a module whose `run` follows members from their positions q at the value ts[0] over all values ts."""

    settings = ("length", "omega")
    results = ("qs", "dqs", "ddqs", "sides", "trusted")

    def __init__(self, code: RunPrograms, width: int, vector: int):
        plan = Plan(code, EULER, projected=False, breaks=False, width=width, vector=vector, unrolled=code.is_small, steps=False)
        super().__init__(plan)
        for name in ("previous dq", "previous ddq", "third derivative", "prediction"):
            self.places.add(name, self.n)
        self._rows = None
        if self._has_sides:
            for name, count in (("psi_q", code.scratch["psi_q"]), ("root", self.n)):
                if name not in self.places.places:
                    self.places.add(name, count)
            self._rows = WeightedRows(self, _METHOD, chosen=sorted(code.eliminated_rows))

    def write_functions(self):
        self.write_programs()
        write_begin(self)
        if self._rows:
            self._rows.write()
        self._march()

    @property
    def _has_sides(self) -> bool:
        return len(self.code.eliminated_rows) == self.n and not self.code.marks_rows

    def program_names(self) -> list[str]:
        return ["newton_q", "value_derivatives", *(["dense_newton_q"] if self._has_sides else [])]

    @property
    def arrays(self) -> dict[str, PointerPlace]:
        named = ("psi_q", "root") if self._rows else ()
        return super().arrays | {name: ("work", self.places[name]) for name in named}

    def _march(self):
        """Write `march(work, call)`: follow the members in all lanes over all values."""
        f, s = self.function("march", [(POINTER, "work"), (POINTER, "call")])
        zero, times = f.const(0.0, DOUBLE, f.width), self.field(f, "times")
        trusted, good, before = f.variable(0.0), f.variable(1.0), f.variable(s.start)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, self.entry(f, "point3 q", i))
            for name in ("result dq", "result dv", "third derivative"):
                self.put_entry(f, name, i, zero)
        with f.each(times) as k:
            with self.each_lane(f, s.active) as lane:
                self.put_lane_entry(f, "state t", lane, self.input_number(f, "ts", f.lane(s.member, lane), k))
            now = self.entry(f, "state t")
            h, begins = now - before.value, f.compare("lt", k, 1)
            self._step_on(f, h)
            good.value = f.select(self._is_sound(f, s, h, begins), good.value, zero)
            trusted.value = trusted.value + good.value
            with f.if_(begins), f.each(self.n) as i:  # the first step has no third derivative
                self.put_entry(f, "third derivative", i, zero)
            before.value, side = now, self._side(f)
            with self.each_lane(f, s.active) as lane:
                row = self.to_int(f, f.lane(s.member, lane)) * times + k
                f.store(f.lane(side, lane), self.field(f, "sides", POINTER), row)
                for name, x in (("qs", "state q"), ("dqs", "result dq"), ("ddqs", "result dv")):
                    self.copy_lane(f, self.result_address(f, name, row, self.n), 0, x, lane)
        with self.each_lane(f, s.active) as lane:
            member = self.to_int(f, f.lane(s.member, lane))
            f.store(f.lane(trusted.value, lane), self.field(f, "trusted", POINTER), member)

    def _step_on(self, f: Function, h: Value):
        """Predict the next positions, correct them, and compute their q' and q''."""
        with f.each(self.n) as i:
            first, second = self.entry(f, "result dq", i), self.entry(f, "result dv", i)
            curvature = f.fma(h * (1 / 6), self.entry(f, "third derivative", i), second * 0.5)
            predicted = f.fma(f.fma(curvature, h, first), h, self.entry(f, "state q", i))
            for name, x in (("previous dq", first), ("previous ddq", second), ("state q", predicted), ("prediction", predicted)):
                self.put_entry(f, name, i, x)
        for _ in range(CORRECTIONS):
            self.invoke(f, "newton_q")
            with f.each(self.n) as i:
                self.put_entry(f, "state q", i, self.entry(f, "corrected q", i))
        self.invoke(f, "value_derivatives")

    def _side(self, f: Function) -> Value:
        """Return the sign of det Psi_q at `state q`; 1 if Psi_q is not square."""
        if not self._rows:
            return f.const(1.0, DOUBLE, f.width)
        self.invoke(f, "dense_newton_q")
        self._rows.factor(f)
        return _METHOD.sign(self._rows.matrices(f))

    def _is_sound(self, f: Function, s: Lane, h: Value, begins: Value) -> Value:
        """Return whether positions are closed, near their prediction, and with little rotation; estimate the third derivative."""
        one, zero, eps = f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width), float(np.finfo(float).eps)
        deviation, largest = f.variable(0.0), f.variable(1.0)
        product, old_square, new_square = f.variable(0.0), f.variable(0.0), f.variable(0.0)
        has_step = h.is_not(0.0)
        per_h = f.select(has_step, one / f.select(has_step, h, one), zero)
        with f.each(self.n) as i:
            unit, q = self.entry(f, "inverse unit", i), self.entry(f, "state q", i)
            largest.value = f.max(f.abs(q) * unit, largest.value)
            deviation.value = f.max(f.abs(q - self.entry(f, "prediction", i)) * unit, deviation.value)
            old, new = self.entry(f, "previous dq", i) * unit, self.entry(f, "result dq", i) * unit
            product.value = f.fma(old, new, product.value)
            old_square.value = f.fma(old, old, old_square.value)
            new_square.value = f.fma(new, new, new_square.value)
            change = self.entry(f, "result dv", i) - self.entry(f, "previous ddq", i)
            self.put_entry(f, "third derivative", i, change * per_h)
        violated, per_unit = largest_violation(self, f), one / (s.omega * s.omega)
        old_length2, new_length2 = old_square.value + per_unit, new_square.value + per_unit
        is_straight = product.value + per_unit > f.intrinsic("sqrt", old_length2 * new_length2) * STRAIGHT
        is_near = deviation.value < f.abs(h) * f.intrinsic("sqrt", old_length2) * SLACK + largest.value * (64 * eps)
        is_closed = ~(violated > largest.value * (CLOSURE.rounding * eps)) & f.is_finite(violated)
        is_smooth = (is_straight & is_near) | (f.repeat(begins, f.width) if f.width > 1 else begins)
        return is_closed & (s.distance > DISTANT) & is_smooth

    def step_all(self, f: Function, s: Lane, fill):
        f.call("march", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, self.plan.width)
        fill()
