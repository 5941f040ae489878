"""Machine code that follows the positions of a driven mechanism from value to value: a batch of members in W lanes.

A step predicts by the third-order Taylor polynomial of q(s), from q', q'' and the change of q'', and corrects once or twice by
Newton's method with elimination. A position is sound if it is closed up to rounding errors, is near its prediction, has a small
rotation of the tangent, and is so far from dependent rows that enough digits of q'' are correct. Values that are far apart are
reached in several steps: each lane halves a step that does not lead to a sound position, and lengthens the steps after one that
does. A lane stops where even the shortest step fails, at its last sound position; from there the caller continues by singular
values.

If the mechanism has as many independent rows as coordinates, each position has a side, the sign of det Psi_q of these rows. The
side changes where branches meet, and differs on another branch nearby. If it changes more than once on the way to a value, the
side of that value is zero. A step that is short beside the distance from dependent rows keeps its side: the determinant, which
takes as long as all other parts of a step, is then not computed.
"""

import numpy as np

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.program import PointerPlace
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.module import Module
from udkjax.native.module.tableau import EULER
from udkjax.native.parts.manifold import largest_violation
from udkjax.native.pseudoinverses.lu import LUCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows
from udkjax.native.run.members import write_begin

CORRECTIONS = 2
# Arc of a step, over the square of the distance from dependent rows, up to which all rows stay independent. Over an arc, a row
# turns by about as much, and the span of the others by up to the arc over their distance.
KEEPS_SIDE = 0.25
STRAIGHT_COSINE = 0.95  # cosine of the largest rotation of the tangent in a step
PREDICTION_SLACK = 0.1  # largest distance of a position from its prediction, as a fraction of the step
_METHOD = LUCode(relative=True)
# Steps along the arc, in characteristic lengths or radians: the longest one, and one that is not halved any more.
LONGEST_STEP, SHORTEST_STEP = 1.0, 1e-3
MAX_STEPS = 2000  # in addition to four for each value: enough for some hundred turns
STEP_GROWTH = 1.5  # below 2, so that a step which had to be halved is not tried again at once


class _Going:
    """The variables of the lanes in the function `march`, one number for each lane except in `begins`."""

    def __init__(self, f: Function, s: Lane):
        self.good = f.variable(s.active)  # whether all positions so far are sound
        self.value = f.variable(s.start)  # value of the last sound position
        self.longest = f.variable(np.inf)  # longest step that is tried next
        self.side = f.variable(0.0)  # side of the last sound position
        self.turns = f.variable(0.0)  # changes of the side since the last value asked for
        self.count = f.variable(0.0)  # steps tried
        self.begins = f.variable(0.0, width=1)  # whether no step has been tried

    def tries(self, target: Value) -> Value:
        """Return the lanes that have not reached the target value, and whose positions so far are sound."""
        return (self.good.value > 0.5) & (self.value.value.is_not(target) | (self.begins.value > 0.5))


class Marching(Module):
    """The text of a module whose `run` follows members from their positions q at the value ts[0] over all values ts."""

    settings = ("length", "omega")
    results = ("qs", "dqs", "ddqs", "sides", "trusted", "reached")

    def __init__(self, code: RunPrograms, width: int, vector: int):
        plan = Plan(code, EULER, projected=False, breaks=False, width=width, vector=vector, unrolled=code.is_small, steps=False)
        super().__init__(plan)
        for name in ("previous q", "previous dq", "previous ddq", "third derivative", "prediction"):
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
        trusted, going = f.variable(0.0), _Going(f, s)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, self.entry(f, "point3 q", i))
            for name in ("result dq", "result dv", "third derivative"):
                self.put_entry(f, name, i, zero)
        with f.each(times) as k:
            with self.each_lane(f, s.active) as lane:
                self.put_lane_entry(f, "next", lane, self.input_number(f, "ts", f.lane(s.member, lane), k))
            going.begins.value = f.select(f.compare("lt", k, 1), f.const(1.0), 0.0)
            going.turns.value = 0.0
            with f.while_(lambda: f.any_of(going.tries(s.next))):
                self._try_step(f, s, going)
            trusted.value = trusted.value + going.good.value
            shown = f.select(going.turns.value > 1.5, zero, going.side.value)
            with self.each_lane(f, s.active) as lane:
                row = self.to_int(f, f.lane(s.member, lane)) * times + k
                f.store(f.lane(shown, lane), self.field(f, "sides", POINTER), row)
                for name, x in (("qs", "state q"), ("dqs", "result dq"), ("ddqs", "result dv")):
                    self.copy_lane(f, self.result_address(f, name, row, self.n), 0, x, lane)
        with self.each_lane(f, s.active) as lane:
            member = self.to_int(f, f.lane(s.member, lane))
            for name, x in (("trusted", trusted), ("reached", going.value)):
                f.store(f.lane(x.value, lane), self.field(f, name, POINTER), member)

    def _try_step(self, f: Function, s: Lane, going: _Going):
        """Try one step towards the value `next` in the lanes that have not reached it."""
        one, zero, tries = f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width), going.tries(s.next)
        begins = going.begins.value > 0.5
        begins = f.repeat(begins, f.width)
        rest = f.select(tries, s.next - going.value.value, zero)
        parts = f.max(f.intrinsic("ceil", f.abs(rest) / going.longest.value), one)
        h = rest / parts
        now = f.select(tries & (parts < 1.5), s.next, going.value.value + h)
        setattr(s, "state t", now)
        self._step_on(f, h)
        is_sound, old_rate, new_rate = self._is_sound(f, s, h, begins)
        accepted, refused = tries & is_sound, tries & ~is_sound
        per_h = f.select(begins, zero, one / f.select(begins, one, h))  # the first step has no third derivative
        with f.each(self.n) as i:
            third = (self.entry(f, "result dv", i) - self.entry(f, "previous ddq", i)) * per_h
            self.put_entry(f, "third derivative", i, f.select(accepted, third, self.entry(f, "third derivative", i)))
            for name, before in (("state q", "previous q"), ("result dq", "previous dq"), ("result dv", "previous ddq")):
                self.put_entry(f, name, i, f.select(accepted, self.entry(f, name, i), self.entry(f, before, i)))
        keeps = f.abs(h) * new_rate < s.distance * s.distance * KEEPS_SIDE
        may_turn = accepted & (begins | ~keeps)
        with f.if_(f.any_of(may_turn)):
            side = self._side(f)
            going.turns.where(may_turn & side.is_not(going.side.value), going.turns.value + 1.0)
            going.side.where(may_turn, side)
        going.value.where(accepted, now)
        going.count.where(tries, going.count.value + 1.0)
        ends = refused & ~(f.abs(h) * old_rate > SHORTEST_STEP) | (going.count.value > self.field(f, "times") * 4 + MAX_STEPS)
        going.good.where(tries & ends, 0.0)
        longer = f.min(f.max(going.longest.value, f.abs(h) * STEP_GROWTH), f.const(LONGEST_STEP) / new_rate)
        going.longest.value = f.select(accepted, longer, f.select(refused, f.abs(h) * 0.5, going.longest.value))
        going.begins.value = 0.0

    def _step_on(self, f: Function, h: Value):
        """Predict the positions after a step `h` of the value, correct them at `state t`, and compute their q' and q''."""
        with f.each(self.n) as i:
            first, second = self.entry(f, "result dq", i), self.entry(f, "result dv", i)
            curvature = f.fma(h * (1 / 6), self.entry(f, "third derivative", i), second * 0.5)
            q = self.entry(f, "state q", i)
            predicted = f.fma(f.fma(curvature, h, first), h, q)
            for name, x in (("previous q", q), ("previous dq", first), ("previous ddq", second)):
                self.put_entry(f, name, i, x)
            for name in ("state q", "prediction"):
                self.put_entry(f, name, i, predicted)
        length, steps = f.variable(np.inf), f.variable(0, INT, 1)
        is_long = lambda: ~(length.value < CLOSURE.last)  # noqa: E731
        with f.while_(lambda: (steps.value < CORRECTIONS) & f.any_of(is_long())):
            self.invoke(f, "newton_q")
            corrects, longest = is_long(), f.variable(0.0)
            with f.each(self.n) as i:
                before, after = self.entry(f, "state q", i), self.entry(f, "corrected q", i)
                longest.value = f.max(f.abs(after - before) * self.entry(f, "inverse unit", i), longest.value)
                self.put_entry(f, "state q", i, f.select(corrects, after, before))
            length.where(corrects, longest.value)
            steps.value = steps.value + 1
        self.invoke(f, "value_derivatives")

    def _side(self, f: Function) -> Value:
        """Return the sign of det Psi_q at `state q`; 1 if the rows are not as many as the coordinates."""
        if not self._rows:
            return f.const(1.0, DOUBLE, f.width)
        self.invoke(f, "dense_newton_q")
        self._rows.factor(f)
        return _METHOD.sign(self._rows.matrices(f))

    def _is_sound(self, f: Function, s: Lane, h: Value, begins: Value) -> tuple[Value, Value, Value]:
        """Return the lanes whose new positions are sound, and the lengths of arc per unit of the value before and after the step.

        `h`: the step of the value; `begins`: the lanes at their first position, which has no prediction.
        """
        one, eps = f.const(1.0, DOUBLE, f.width), float(np.finfo(float).eps)
        deviation, largest = f.variable(0.0), f.variable(1.0)
        product, old_square, new_square = f.variable(0.0), f.variable(0.0), f.variable(0.0)
        with f.each(self.n) as i:
            unit, q = self.entry(f, "inverse unit", i), self.entry(f, "state q", i)
            largest.value = f.max(f.abs(q) * unit, largest.value)
            deviation.value = f.max(f.abs(q - self.entry(f, "prediction", i)) * unit, deviation.value)
            old, new = self.entry(f, "previous dq", i) * unit, self.entry(f, "result dq", i) * unit
            product.value = f.fma(old, new, product.value)
            old_square.value = f.fma(old, old, old_square.value)
            new_square.value = f.fma(new, new, new_square.value)
        violated, per_unit = largest_violation(self, f), one / (s.omega * s.omega)
        old_rate, new_rate = (f.intrinsic("sqrt", x.value + per_unit) for x in (old_square, new_square))
        is_straight = product.value + per_unit > old_rate * new_rate * STRAIGHT_COSINE
        is_near = deviation.value < f.abs(h) * old_rate * PREDICTION_SLACK + largest.value * (64 * eps)
        is_closed = ~(violated > largest.value * (CLOSURE.rounding * eps)) & f.is_finite(violated)
        is_smooth = (is_straight & is_near) | begins
        return is_closed & self._has_digits(f, s, new_rate) & is_smooth, old_rate, new_rate

    def _has_digits(self, f: Function, s: Lane, arc_rate: Value) -> Value:
        """Return the lanes in which enough digits of q'' are correct.

        Near dependent rows, the distances from these here and a little farther on decide. `arc_rate`: the length of arc per unit
        of the value.
        """
        rule, here, now = CLOSURE.digits, s.distance, getattr(s, "state t")
        is_clear, result = here > rule.clear, f.variable(0.0)
        result.where(is_clear, 1.0)
        with f.if_(f.any_of((here > rule.least) & ~is_clear)):
            h = f.const(rule.arc) / arc_rate
            with f.each(self.n) as i:
                q = self.entry(f, "state q", i)
                self.put_entry(f, "prediction", i, q)
                self.put_entry(f, "state q", i, f.fma(h, self.entry(f, "result dq", i), q))
            setattr(s, "state t", now + h)
            self.invoke(f, "value_derivatives")
            holds = rule.hold(here, f.abs(s.distance - here) * (1.0 / rule.arc))
            with f.each(self.n) as i:
                self.put_entry(f, "state q", i, self.entry(f, "prediction", i))
            setattr(s, "state t", now)
            self.invoke(f, "value_derivatives")
            result.where(holds, 1.0)
        return result.value > 0.5

    def step_all(self, f: Function, s: Lane, fill):
        f.call("march", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, self.plan.width)
        fill()
