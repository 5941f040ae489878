"""Classification of the intervals between nodes: no crossing, a crossing, or unresolved (watching.py)."""

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value, Variable
from udkjax.native.module.layout import Lane
from udkjax.native.watching.conditions import (
    LAST_CHANGE,
    MIDDLE_NODE,
    MOST_JUMPS,
    MOST_STUCK,
    RESOLUTION,
    SECOND,
    SHORT_PAIR,
    SHORTEST_SPAN,
    UNDEFINED,
    VARIES_FAST,
)
from udkjax.native.watching.watch_memory import WatchMemory


def write_classification(module: WatchMemory):
    """Write `judge(work)`: classify two intervals when their last node has been evaluated, in lanes where `low` is one.

    The lanes then go on to the next intervals, seek a crossing, refine the intervals, or stop.
    """
    f, s = module.function("judge")
    mask, length = s.low > 0.5, s.look - s.first_t
    unresolved = [f.variable(0.0), f.variable(0.0)]
    hits = [f.variable(0.0), f.variable(0.0)]
    steps = (s.middle_t - s.first_t, s.look - s.middle_t)
    x = steps[0] / length
    # Friction may jam the mechanism in a range that a step across a singular configuration passes: only its ends are states.
    leaps = (s.fallback > 0.5) if module.friction.settles else f.const(False, BOOL, f.width)
    with f.each(module.conditions.count) as c:
        g = [module.condition(f, name, c) for name in ("g0", "g1", "g")]
        rate = [module.condition(f, name, c) for name in ("rate0", "rate1", "rate")]
        side, on, floor = module.condition(f, "side", c), module.condition(f, "on", c) > 0.5, module.condition(f, "floor", c)
        is_finite = f.is_finite(g[1]) & f.is_finite(g[2]) & f.is_finite(g[0])
        is_force = f.like(c >= module.conditions.own_count, BOOL, f.width)
        is_finite = is_finite | (is_force & ~on)  # a force that nothing holds may be anything
        is_smooth = f.is_finite(rate[0]) & f.is_finite(rate[1]) & f.is_finite(rate[2])
        error = _error(f, g, rate, length, x)
        # Where a run begins, a condition that has just had its event may be on the other side by the error of the event's time.
        is_late = s.first_t.is_(s.fresh) & (g[0] * side < 0.0) & (rate[0] * side > 0.0)
        is_late = is_late & (f.abs(g[0]) * s.omega <= f.abs(rate[0]) * LAST_CHANGE)
        g[0] = f.select(is_late, f.const(0.0, DOUBLE, f.width), g[0])
        for k in range(2):
            after = f.select(f.abs(g[k + 1]) <= floor, side, _sign(f, g[k + 1]))
            hit, is_certain = _classify_interval(f, (g[k], rate[k], g[k + 1], rate[k + 1]), steps[k], error, side, after, floor)
            is_unclear = on & ~(is_certain & is_smooth) & ~leaps
            direction = module.condition(f, "direction", c)
            counts = hit & on & (direction.is_(0.0) | direction.is_(after))
            fault = f.select(is_finite, f.select(is_unclear, f.const(VARIES_FAST, DOUBLE, f.width), 0.0), UNDEFINED)
            unresolved[k].value = f.max(fault, unresolved[k].value)
            hits[k].value = f.select(counts, f.const(1.0, DOUBLE, f.width), hits[k].value)
            module.put_condition(f, f"hit{k + 1}", c, f.select(counts, after, f.const(0.0, DOUBLE, f.width)))
            module.put_condition(f, f"side{k + 1}", c, after)
            side = after
    _advance(module, f, s, mask, unresolved, hits)


def _advance(module: WatchMemory, f: Function, s: Lane, mask: Value, unresolved: list[Variable], hits: list[Variable]):
    """Go on after resolved intervals, seek crossings in them, and refine or stop at unresolved ones.

    Args:
        module: The module.
        f: The function to which the code is added.
        s: The numbers of its lanes.
        mask: The lanes whose intervals have been classified.
        unresolved: The fault of each interval: `VARIES_FAST`, `UNDEFINED`, or zero if it is resolved.
        hits: One for each interval in which a condition crosses zero, else zero.
    """
    one, zero = f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width)
    is_after_break = s.fresh > s.first_t  # the polynomial belongs to another piece of the motion
    span = s.look - s.first_t
    length, jumps = span * s.omega, f.variable(0.0)
    may_jump = (length <= SHORT_PAIR) & (s.jumps < float(MOST_JUMPS)) & (s.stuck < float(MOST_STUCK))
    is_finest = (length <= RESOLUTION.finest) | (span <= s.smallest * SHORTEST_SPAN)
    s.stops, s.seeks = zero, zero
    s.low, s.high = s.first_t, s.middle_t
    for k, states in enumerate((("middle q", "middle v"), ("state q", "result v"))):
        fault = unresolved[k].value
        is_jump = mask & fault.is_(VARIES_FAST) & may_jump
        jumps.value = f.select(is_jump, one, jumps.value)
        unclear = mask & (fault > 0.0) & ~is_jump
        finer = unclear & ~(is_finest | (fault.is_(VARIES_FAST) & (length <= SHORT_PAIR)))
        is_hit = mask & (hits[k].value > 0.5) & ~unclear
        stops = (unclear & ~finer) | (is_hit & is_after_break)
        seeks = is_hit & ~stops
        s.where(stops, stops=one)
        s.where(seeks, seeks=one)
        module.move_conditions(f, seeks, **{f"hit{k + 1}": "hit"})
        _refine(module, f, s, finer, span, k)
        mask = mask & ~stops & ~seeks & ~finer
        s.where(mask & ~is_jump, stuck=0.0)
        module.copy_state(f, mask, states, "sure")
        module.move_conditions(f, mask, **{f"side{k + 1}": "side"})
        if k == 0:
            s.where(mask, sure_t=s.middle_t, low=s.middle_t, high=s.look)
    s.where(mask, jumps=f.select(jumps.value > 0.5, s.jumps + 1.0, f.select(s.share >= 1.0, zero, s.jumps)))
    s.where(mask, share=f.min(s.share * 2.0, one))
    with f.if_(f.any_of(mask)):
        module.begin_intervals(f, s, mask)


def _refine(module: WatchMemory, f: Function, s: Lane, mask: Value, span: Value, k: int):
    """Repeat two intervals with closer nodes in the lanes of `mask`, from their first node on (k = 0) or their middle node (1).

    `span`: the length of both intervals (s).
    """
    with f.if_(f.any_of(mask)):
        if k == 1:
            module.move_conditions(f, mask, g1="g0", rate1="rate0")
            s.where(mask, first_t=s.middle_t)
        span = span * (1 / RESOLUTION.finer)
        s.where(mask, share=s.share * (1 / RESOLUTION.finer), which=float(SECOND), stuck=s.stuck + 1.0)
        s.where(mask, node=f.fma(span, MIDDLE_NODE, s.first_t), behind_middle=s.first_t + span)


def _sign(f: Function, x: Value) -> Value:
    one, zero = f.const(1.0, DOUBLE, f.width), f.const(0.0, DOUBLE, f.width)
    return f.select(x > 0.0, one, f.select(x < 0.0, -one, zero))


def _error(f: Function, g: list[Value], rate: list[Value], length: Value, x: Value) -> Value:
    """Return the error of Hermite's cubic over two intervals at the middle node, of the condition or, weighted, of its rate.

    `g` and `rate`: the condition and its rate at the three nodes; `length`: the length of both intervals (s); `x`: the position
    of the middle node, as a fraction.
    """
    a, da, b, db = g[0], rate[0] * length, g[2], rate[2] * length
    square, cube = (b - a) * 3.0 - da * 2.0 - db, (a - b) * 2.0 + da + db
    value = a + x * (da + x * (square + x * cube))
    slope = da + x * (square * 2.0 + x * cube * 3.0)
    error_of_value, error_of_rate = f.abs(g[1] - value), f.abs(rate[1] * length - slope) * RESOLUTION.miss
    return f.select(error_of_value > error_of_rate, error_of_value, error_of_rate)


def _classify_interval(
    f: Function,
    ends: tuple[Value, Value, Value, Value],
    step: Value,
    error: Value,
    before: Value,
    after: Value,
    floor: Value,
) -> tuple[Value, Value]:
    """Return the mask of lanes in which a condition changes sign in an interval, and the mask of those where this is certain.

    `ends`: value and rate at the first node, then at the second; `before` and `after`: the sides there.
    """
    hit = after * before < 0.0
    side = f.select(before.is_(0.0), after, before)
    single, away = RESOLUTION.classify_interval(f, ends, step, error, side, floor)
    return hit, (hit & single) | (~hit & away)
