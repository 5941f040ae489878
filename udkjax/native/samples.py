"""Numbers of a scene that have samples: between breakpoints they are constants, as all others are.

A row of samples holds from one breakpoint to the next. Where a run begins anew behind a breakpoint, the constants of its lane are
computed again, of the numbers with the row in: no step and no evaluation takes longer, however many samples there are.
"""

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module import Module

ARGUMENTS = ((POINTER, "work"), (POINTER, "call"), (INT, "lane"))


def count_breakpoints(module: Module, f: Function, member: Value, time: Value) -> Value:
    """Count the breakpoints of a member before a time, by bisection."""
    call = f.given["call"]
    breaks = module.member_address(f, call, "breaks", member)
    low, high = f.variable(0, INT, 1), f.variable(f.load(call, module.call_fields.index("knots"), base=INT), INT, 1)
    with f.while_(lambda: low.value < high.value):
        middle = f.arithmetic("div", low.value + high.value, 2)
        before = f.load(breaks, middle) < time
        low.value, high.value = f.select(before, middle + 1, low.value), f.select(before, high.value, middle)
    return low.value


def enter_first_row(module: Module, f: Function, lane: Value, member: Value):
    """Give a lane the constants with which its member begins."""
    work, call = f.given["work"], f.given["call"]
    start, smallest = (f.load(work, lane + module.places[name] * f.width) for name in ("start", "smallest"))
    f.store(count_breakpoints(module, f, member, start - smallest), work, lane + module.places["knot"] * f.width)
    f.call("enter", work, call, lane)


def write_next_breakpoint(module: Module):
    """`next_breakpoint(work, call)`: `due` is the first breakpoint that a lane has not passed; infinite where there is none."""
    f, s = module.function("next_breakpoint", ARGUMENTS[:2])
    call = f.given["call"]
    knots = f.load(call, module.call_fields.index("knots"), base=INT)
    with f.each(f.width) as k:
        knot, at = module.to_int(f, f.lane(s.knot, k)), f.variable(float("inf"), width=1)
        with f.if_(knot < knots):
            at.value = module.input_number(f, call, "breaks", f.lane(s.member, k), knot)
        f.store(at.value, f.given["work"], k + module.places["due"] * f.width)


def write_enter(module: Module):
    """`enter(work, call, lane)`: the constants of a lane, of the samples that hold behind the breakpoints that it has passed."""
    f, _ = module.function("enter", ARGUMENTS)
    work, call, lane = (f.given[name] for _, name in ARGUMENTS)

    def place(name: str) -> Value:
        return lane + module.places[name] * f.width

    knot, member = f.load(work, place("knot")), module.to_int(f, f.load(work, place("member")))
    f.store(knot, work, place("row"))
    numbers = (
        numbers_of_row(module, f, member, knot) if module.plan.sampled else module.member_address(f, call, "numbers", member)
    )
    constants = Value(f, f.reserve(DOUBLE, max(module.constants, 1)), POINTER)
    f.call("prologue", numbers, constants)
    with f.each(module.constants) as i:
        f.store(f.load(constants, i), work, i * f.width + place("constants"))
    if module.falls_back and not module.written_out:
        count = len(module.code.constants)
        all_constants, tol = Value(f, f.reserve(DOUBLE, count), POINTER), f.load(work, place("fallback_tol"))
        f.call("fallback_prologue", numbers, all_constants)
        f.store(tol * tol, all_constants, module.code.drop_tol_index)
        with f.each(count) as i:
            f.store(f.load(all_constants, i), work, i * f.width + place("fallback constants"))
    module.begin_row(f, lane, member, numbers, constants)


def numbers_of_row(module: Module, f: Function, member: Value, row: Value) -> Value:
    """The address of a copy of a member's numbers, with a row of samples in."""
    given = module.member_address(f, f.given["call"], "numbers", member)
    copy = f.at(f.given["work"], module.places["numbers"] * f.width)
    with f.each(module.code.number_count) as i:
        f.store(f.load(given, i), copy, i)
    samples = row_address(module, f, "samples", member, row)
    for k, place in enumerate(module.plan.sampled):
        f.store(f.load(samples, k), copy, place)
    return copy


def row_address(module: Module, f: Function, name: str, member: Value, row: Value) -> Value:
    """The address of a row of the samples of a member."""
    start = module.member_address(f, f.given["call"], name, member)
    return f.at(start, module.to_int(f, row) * len(module.plan.sampled))
