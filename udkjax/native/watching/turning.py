"""Kinks of forces that a run passes: the sides of their comparisons turn (integrate/events/law/kinks.py)."""

from udkjax.native.language.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.language.program import write
from udkjax.native.module.layout import Lane
from udkjax.native.watching.passed_events import Turning
from udkjax.native.watching.passing import PassingRuns


def write_turn(module: PassingRuns, kinks: Turning):
    """Write `pass_kinks(work, call)`: begin anew the runs that have ended at a kink."""
    p = module.places
    for i, (smooth, given, first) in enumerate(kinks.renewals):
        inputs = [("work", p[name] + k) for name, k in given]
        outputs = [("work", p["renewed sides"] + first + k) for k in range(smooth.count)]
        written = write(smooth.renewal, f"renew_sides{i}", module.plan.width, ("work",), inputs, outputs, cold=True)
        module.functions.append(written)
    f, s = module.function("pass_kinks", [(POINTER, "work"), (POINTER, "call")])
    is_kink = (s.event >= float(kinks.first)) & (s.event < float(module.conditions.own_count))
    passes = module.may_pass(f, s) & is_kink
    with f.if_(f.any_of(passes)):
        module.look_at_event(f, s)
        passes = passes & ~_is_beside_others(module, f, s, turned=False)
        _turn(module, kinks, f, s, passes)
        module.look_at_event(f, s)
        passes = passes & ~_is_beside_others(module, f, s, turned=True)
        with f.each(module.conditions.count) as c:  # the condition of a kink is positive except where its side turns
            here, floor = passes & s.event.is_(f.like(c, DOUBLE, f.width)), module.floor_of(f, s, c)
            for name, new, mask in (("side", f.const(1.0, DOUBLE, f.width), here), ("floor", floor, passes)):
                module.put_entry(f, f"condition {name}", c, f.select(mask, new, module.entry(f, f"condition {name}", c)))
        module.copy(f, "sure v", "after v")
        module.begin_anew(f, s, passes)


def _is_beside_others(module: PassingRuns, f: Function, s: Lane, turned: bool) -> Value:
    """Return the lanes in which a condition does not allow the run to pass the event.

    Before the sides have `turned`, no other condition may be zero. Afterwards no condition may be beyond zero; that of the event
    may be zero, and another one, too, if it moves to its side: a step of a staircase begins where the one before ends.
    """

    def is_near(c: Value, g: Value, side: Value, floor: Value) -> Value:
        rate = module.entry(f, "condition rate", c)
        is_other, is_near = s.event.is_not(f.like(c, DOUBLE, f.width)), ~(f.abs(g) > floor)
        if not turned:
            return is_near & is_other
        is_free = g * side > floor
        return ~(is_free | (is_near & (rate * side > floor * s.omega)) | (is_near & ~is_other))

    return module.any_condition(f, is_near)


def _turn(module: PassingRuns, kinks: Turning, f: Function, s: Lane, passes: Value):
    """Turn the side of the kink at which the run of a lane has ended, in the lanes of `passes`, and renew all sides of kinks."""
    for j, (side, factor, shift) in enumerate(kinks.turns):
        before, here = module.entry(f, "sides", side), passes & s.event.is_(float(kinks.first + j))
        module.put_entry(f, "sides", side, f.select(here, before * factor + shift, before))
    for i in range(len(kinks.renewals)):
        f.call(f"renew_sides{i}", f.given["work"])
    with f.each(kinks.sides.stop, kinks.sides.start) as i:
        before, new = (module.entry(f, name, i) for name in ("sides", "renewed sides"))
        module.put_entry(f, "sides", i, f.select(passes, new, before))
    for place, side in kinks.of_conditions:
        before, new = module.entry(f, "condition numbers", place), module.entry(f, "sides", side)
        module.put_entry(f, "condition numbers", place, f.select(passes, new, before))
