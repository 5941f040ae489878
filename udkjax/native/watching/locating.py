"""Location of zero crossings of conditions, on the polynomial of dense output and by a step that ends at the crossing.

On the polynomial, Newton's method finds the first zero, between bounds: each step goes a little beyond the zero, so that it moves
the other bound, and bisection replaces steps that leave the bounds.
"""

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.steps import NODE_COUNT, ROUNDING_UNIT, Status
from udkjax.native.watching.conditions import FIRST, LAST_CHANGE, LEAST_STEP, MOST_AIMS, MOST_LANDINGS, UNDER_WAY, WANTED
from udkjax.native.watching.watch_memory import WatchMemory


def write_locate(module: WatchMemory):
    """Write `locate(work)`: find the first crossing between the times `low` and `high`, in lanes that seek one.

    These lanes then stop at the crossing, or request a step that ends there (`landing`).
    """
    f, s = module.function("locate")
    work, one, zero = f.given["work"], f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width)

    def crossed() -> Value:
        """Return the index of the first condition that is beyond zero at `look`; -1 if there is none."""
        event_index = f.variable(-1.0)
        with f.each(module.conditions.count) as c:
            beyond = (module.condition(f, "hit", c) * module.condition(f, "g", c) > 0.0) & (event_index.value < 0.0)
            event_index.value = f.select(beyond, f.like(c, DOUBLE, f.width), event_index.value)
        return event_index.value

    def wide() -> Value:
        middle = (s.low + s.high) * 0.5
        s.due = f.select(
            (s.seeks > 0.5) & (s.high - s.low > s.smallest * ROUNDING_UNIT) & (middle > s.low) & (middle < s.high), one, zero
        )
        return f.any_of(s.due > 0.5)

    def zero_ahead() -> Value:
        """Return the earliest zero (s) of the conditions, linearized at `look`; infinite if there is none."""
        first, inf = f.variable(float("inf")), f.const(float("inf"), DOUBLE, f.width)
        with f.each(module.conditions.count) as c:
            rate = module.condition(f, "rate", c)
            crosses = module.condition(f, "hit", c) * rate > 0.0
            root = s.look - module.condition(f, "g", c) / f.select(crosses, rate, one)
            first.value = f.min(first.value, f.select(crosses, root, inf))
        return first.value

    def hit_forces() -> Value:
        """Return the number of watched forces that cross zero in the interval."""
        count = f.variable(0.0)
        with f.each(module.conditions.count, module.conditions.own_count) as c:
            count.value = count.value + f.abs(module.condition(f, "hit", c))
        return count.value

    inf = f.const(float("inf"), DOUBLE, f.width)
    s.where(s.seeks > 0.5, next_look=inf, looks=zero)
    watched = s.holds
    s.holds = f.select(s.seeks > 0.5, hit_forces(), zero)  # the others are not asked for
    with f.while_(wide):
        is_between = (s.next_look > s.low) & (s.next_look < s.high) & (s.looks < float(MOST_AIMS))
        s.look = f.select(is_between, s.next_look, (s.low + s.high) * 0.5)
        f.call("look", work)
        due, is_beyond, root = s.due > 0.5, crossed() >= 0.0, zero_ahead()
        s.where(due & is_beyond, high=s.look)
        s.where(due & ~is_beyond, low=s.look)
        change = s.look - root
        # The error of Newton's step, or the distance of a bound.
        beyond = f.max(change * change * s.omega, s.smallest * (ROUNDING_UNIT * 0.25))
        s.where(due, next_look=f.select(is_beyond, root - beyond, root + beyond), looks=s.looks + 1.0)
    s.look, s.due = s.high, s.seeks
    f.call("look", work)
    s.holds = watched
    event, seeks = crossed(), s.seeks > 0.5
    is_found = seeks & (event >= 0.0)
    # A step to the crossing lies between two breakpoints. Just after the first breakpoint, and if the second has been reached,
    # the crossing is located on the polynomial instead, which is as accurate as the states: the numbers that are sampled are then
    # those after it.
    reached = (s.lands > 0.5) | ((s.last > 0.5) & (s.point3_t < s.end))
    lands = is_found & (s.high - f.max(s.point0_t, s.fresh) > s.smallest * LEAST_STEP) & ~reached
    s.where(seeks, stops=f.select(lands, zero, one), seeks=zero)
    s.where(is_found, event=event, sure_t=s.high, target=s.high)
    s.where(lands, landing=float(WANTED))
    module.copy_state(f, is_found, ("state q", "result v"), "sure")


def write_approach(module: WatchMemory):
    """Write `approach(work)`: plan a step to `target` from the last point before it, in lanes that are landing."""
    f, s = module.function("approach")
    wanted, zero = s.landing.is_(float(WANTED)), f.const(0.0, DOUBLE, f.width)
    for k in range(NODE_COUNT):  # the latest point before the target
        is_before = wanted & (s.target - getattr(s, f"point{k}_t") > s.smallest * LEAST_STEP)
        module.copy_point(f, is_before, f"point{k}", "before")
        s.where(is_before, low=getattr(s, f"point{k}_t"))
        module.stiffness.return_to_point(s, is_before, k)
    module.copy_point(f, wanted, "before", f"point{NODE_COUNT - 1}")
    s.where(wanted, point3_t=s.low, landing=float(UNDER_WAY))
    lands, t1 = s.landing > 0.5, s.point3_t + s.h
    t1 = f.select(t1 > s.target - s.smallest * LEAST_STEP, s.target, t1)
    step = f.select(s.stepping > 0.5, t1 - s.point3_t, zero)
    s.where(lands, t1=t1, step=step, begin=module.stiffness.begin_anew(f, s), last=zero, lands=zero)


def write_land(module: WatchMemory):
    """Write `land(work)`: end or correct the landing of lanes whose step has ended at its target.

    If the condition does not reach zero at the end of such a step, even after corrections, its crossing was an error of the
    polynomial, for instance after a fast decay within one implicit step: then the run goes on from there. If another condition
    has crossed zero before, which the polynomial may have missed, its crossing is the event.
    """
    f, s = module.function("land")
    arrived = (s.landing > WANTED + 0.5) & (s.point3_t >= s.target) & s.code.is_(float(Status.RUNNING))
    one, zero = f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width)
    setattr(s, "state t", s.point3_t)
    for source, to in (("point3 q", "state q"), ("point3 v", "result v"), ("point3 a", "node a")):
        module.copy(f, source, to)
    f.call("conditions", f.given["work"])
    s.where(arrived, event=_earliest(module, f, s))
    g, rate, before = f.variable(0.0), f.variable(0.0), f.variable(0.0)
    with f.each(module.conditions.count) as c:
        is_event, size = s.event.is_(f.like(c, DOUBLE, f.width)), f.abs(module.condition(f, "g", c))
        g.where(is_event, module.condition(f, "g", c))
        rate.where(is_event, module.condition(f, "rate", c))
        before.where(is_event & (size > module.condition(f, "floor", c)), module.condition(f, "side", c))
    change = -(g.value / f.select(rate.value.is_(0.0), one, rate.value))
    is_small = f.abs(change) * s.omega <= LAST_CHANGE
    goes_on = arrived & ~is_small & (s.landings < float(MOST_LANDINGS)) & (f.abs(change) < s.target - s.point2_t)
    s.where(goes_on, landing=float(WANTED), target=s.target + change, landings=s.landings + 1.0)
    is_false = arrived & ~goes_on & ~is_small & (g.value * before.value > 0.0)
    module.copy_state(f, is_false, ("point3 q", "point3 v"), "sure")
    s.where(is_false, sure_t=s.point3_t, first_t=s.point3_t, fresh=s.point3_t, node=s.point3_t, which=float(FIRST))
    s.where(is_false, event=-1.0, landing=0.0, landings=0.0)
    is_complete, change = arrived & ~goes_on & ~is_false, f.select(is_small, change, zero)
    change = f.max(change, s.fresh - s.point3_t)  # with a slow condition the corrected time may precede the start
    is_exact = is_complete & is_small
    s.where(is_exact, sure_t=s.point3_t + change)
    module.move_point(f, is_exact, NODE_COUNT - 1, change, ("sure q", "sure v"))
    s.where(is_complete, stops=one)
    module.stop(f, s)


def _earliest(module: WatchMemory, f: Function, s: Lane) -> Value:
    """Return the index of the condition that crosses zero first: that of the event, or another one that is beyond zero.

    The zeros are those of the conditions linearized at the end of the step.
    """
    event, first = f.variable(-1.0), f.variable(float("inf"))
    with f.each(module.conditions.count) as c:
        g, rate, side, on, floor, direction = (
            module.condition(f, name, c) for name in ("g", "rate", "side", "on", "floor", "direction")
        )
        is_beyond = (on > 0.5) & (g * side < -floor) & (rate * side < 0.0) & ~(direction * side > 0.0)
        index = f.like(c, DOUBLE, f.width)
        change = -(g / f.select(rate.is_(0.0), f.const(1.0, DOUBLE, f.width), rate))
        is_first = (s.event.is_(index) | is_beyond) & ((change < first.value) | (event.value < 0.0))
        event.where(is_first, index)
        first.where(is_first, change)
    return event.value
