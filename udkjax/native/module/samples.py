"""Sampled numbers of a scene, which are constant between breakpoints.

A row of samples is valid from one breakpoint to the next. When a run begins anew after a breakpoint, the constants of its lane
are computed again from the numbers with the new row, so the time of a step does not depend on the number of samples.
"""

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.module import Module

ARGUMENTS = ((POINTER, "work"), (POINTER, "call"), (INT, "lane"))


def count_breakpoints(module: Module, f: Function, member: Value, time: Value) -> Value:
    """Return the number of breakpoints of a member before a time, found by bisection."""
    breaks = module.member_address(f, "breaks", member)
    low, high = f.variable(0, INT, 1), f.variable(module.field(f, "knots"), INT, 1)
    with f.while_(lambda: low.value < high.value):
        middle = f.arithmetic("div", low.value + high.value, 2)
        before = f.load(breaks, middle) < time
        low.value, high.value = f.select(before, middle + 1, low.value), f.select(before, high.value, middle)
    return low.value


def enter_first_row(module: Module, f: Function, lane: Value, member: Value):
    """Set the constants of a lane to those at the start of its member."""
    start, smallest = (module.lane_entry(f, name, lane) for name in ("start", "smallest"))
    module.put_lane_entry(f, "knot", lane, count_breakpoints(module, f, member, start - smallest))
    f.call("enter", f.given["work"], f.given["call"], lane)


def write_next_breakpoint(module: Module):
    """Write `next_breakpoint(work, call)`: set `due` to the first breakpoint (s) that a lane has not passed, or to infinity."""
    f, s = module.function("next_breakpoint", ARGUMENTS[:2])
    knots = module.field(f, "knots")
    with f.each(f.width) as k:
        knot, time = module.to_int(f, f.lane(s.knot, k)), f.variable(float("inf"), width=1)
        with f.if_(knot < knots):
            time.value = module.input_number(f, "breaks", f.lane(s.member, k), knot)
        module.put_lane_entry(f, "due", k, time.value)


def write_enter(module: Module):
    """Write `enter(work, call, lane)`: compute the constants of a lane from the samples after the breakpoints it has passed."""
    f, _ = module.function("enter", ARGUMENTS)
    lane = f.given["lane"]
    knot, member = module.lane_entry(f, "knot", lane), module.to_int(f, module.lane_entry(f, "member", lane))
    module.put_lane_entry(f, "row", lane, knot)
    numbers = numbers_of_row(module, f, member, knot) if module.plan.sampled else module.member_address(f, "numbers", member)
    numbers = module.numbers_in_lane(f, lane, numbers)
    constants = Value(f, f.reserve(DOUBLE, max(module.constants, 1)), POINTER)
    f.call("prologue", numbers, constants)
    with f.each(module.constants) as i:
        module.put_lane_entry(f, "constants", lane, f.load(constants, i), i)
        if module.shares_constants:  # all threads write the same
            f.store(f.load(constants, i), f.given["block_memory"], i)
    module.fallback.enter(f, lane, numbers)
    module.begin_row(f, lane, member, numbers, constants)


def numbers_of_row(module: Module, f: Function, member: Value, row: Value) -> Value:
    """Return the address of a copy of a member's numbers, in which sampled numbers have the values of a row of samples."""
    given = module.member_address(f, "numbers", member)
    copy = module.address(f, "numbers")
    with f.each(module.code.number_count) as i:
        f.store(f.load(given, i), copy, i)
    samples = row_address(module, f, "samples", member, row)
    for k, place in enumerate(module.plan.sampled):
        f.store(f.load(samples, k), copy, place)
    return copy


def row_address(module: Module, f: Function, name: str, member: Value, row: Value) -> Value:
    """Return the address of a row of the samples of a member."""
    start = module.member_address(f, name, member)
    return f.at(start, module.to_int(f, row) * len(module.plan.sampled))
