"""The end of the next step: the end of the run, a breakpoint, or the end chosen by the controller."""

import numpy as np

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.steps import AIM_ACROSS, BEGINS_BEHIND, ENDS_BEFORE, NODE_COUNT, SHORTEST_LAST


def aim(module: Module, f: Function, s: Lane):
    """Set `t1`, `step`, `begin`, `last` and `lands` of each lane: the end and the kind of its next step."""
    where, yes = f.select, f.const(1.0, DOUBLE, f.width)
    begin = (s.steps if module.plan.breaks else s.tried) < 0.0
    start, end, stop = s.point3_t, s.end, s.end
    crossing = s.crossing if module.pieces else f.const(np.inf, DOUBLE, f.width)
    if module.plan.breaks:
        s.t1, s.past_breaks = f.const(np.inf, DOUBLE, f.width), start
        next_breakpoint(module, f, s, start)
        end = s.t1
        stop = f.min(end, crossing)
    t1 = start + module.stiffness.plan_length(f, s, begin, start, stop)
    last = (t1 >= s.end - s.smallest) & ~begin
    if not module.plan.breaks:
        t1 = where(last, s.end, halve(f, s, t1, s.end, begin | last))
        s.lands = f.const(0.0, DOUBLE, f.width)
    else:
        rest = f.min(stop, s.end) - start
        parts = f.max(float(NODE_COUNT - 1) - s.steps, 1.0)
        split = start + rest / parts
        splits = (s.steps < float(NODE_COUNT - 2)) & (t1 > split) & (rest > s.smallest * (2.0 * NODE_COUNT)) & ~begin
        splits = splits & (s.next < stop - s.smallest)  # only if outputs are due in between
        splits = module.stiffness.splits(s, splits)
        if module.pieces:
            splits = splits & s.aim.is_not(float(AIM_ACROSS))
        is_output = module.stiffness.ends_at_output(f, s, begin, start, t1, stop)
        if is_output is not None:
            t1 = where(is_output, s.next, t1)
            splits = splits & ~is_output
        reached = t1 >= stop - s.smallest * 2.0
        halved = t1 if module.pieces else halve(f, s, t1, f.min(stop, s.end), begin | last | splits | reached)
        if is_output is not None:
            halved = where(is_output, t1, halved)
        t1 = where(splits, split, halved)
        reaches = (t1 >= stop - s.smallest * 2.0) & (stop < s.end - s.smallest) & ~begin
        last = last & ~reaches & ~splits
        if is_output is not None:
            last = last & ~is_output
        final = s.end - f.max(s.end - end, 0.0)
        t1 = where(reaches, stop, where(last, final, t1))
        t1 = where(begin, s.past_breaks, t1)
        s.lands = where(reaches & (end <= crossing), yes, 0.0)
    t1 = where(begin, s.past_breaks if module.plan.breaks else s.point3_t, t1)
    s.t1 = t1
    s.step = where((s.stepping > 0.5) & ~begin, t1 - s.point3_t, 0.0)
    s.begin = where(begin, yes, module.stiffness.next_begin(f, s))
    s.last = where(last, yes, 0.0)


def halve(f: Function, s: Lane, t1: Value, stop: Value, otherwise: Value) -> Value:
    """Return the end of a step: `t1`, or the middle between the latest point and `stop` if `t1` is just before `stop`.

    Lanes of the mask `otherwise` keep `t1`.
    """
    short = (stop - t1 < s.h * SHORTEST_LAST) & ~otherwise
    return f.select(short, s.point3_t + (stop - s.point3_t) * 0.5, t1)


def next_breakpoint(module: Module, f: Function, s: Lane, now: Value):
    """Set `t1` just before the next breakpoint, and `past_breaks` just after all breakpoints at the time `now`."""
    work, call = f.given["work"], f.given["call"]
    f.call("next_breakpoint", work, call)
    with f.while_(lambda: f.any_of(s.due <= now + s.smallest)):
        is_passed = s.due <= now + s.smallest
        s.where(is_passed, knot=s.knot + 1.0, passed=s.due)
        f.call("next_breakpoint", work, call)
    s.t1 = s.due - s.smallest * ENDS_BEFORE
    s.past_breaks = f.max(s.passed + s.smallest * BEGINS_BEHIND, now)
    if module.plan.sampled:
        with f.each(f.width) as k:
            stale = (s.active > 0.5) & s.row.is_not(s.knot)
            with f.if_(f.lane(f.select(stale, f.const(1.0, DOUBLE, f.width), 0.0), k) > 0.5):
                f.call("enter", work, call, k)
