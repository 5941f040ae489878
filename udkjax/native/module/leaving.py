"""Runs that leave their module for a *later* module, whose further functions few runs need; it is loaded when a run needs them.

In the first module, `run(call)` ends where a run has to leave (`stiff`). It then calls `resume(call, members)` of the later
module with the members in its lanes, and the later module runs these from their beginning, and all members that have not begun.
Both modules take the same steps before, bit for bit. Once the later module is loaded, `run` does nothing but call it.

The first module has two pointers that the host sets: `later`, the address of `resume`, null until the later module is loaded; and
`load_later`, the address of a function of the host that loads it and returns the address, or null if it fails.
"""

from udkjax.native.language.ir import INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.memory import Memory

LATER_POINTER, LOAD_POINTER = POINTERS = "later", "load_later"
RESUME = "resume"
# Functions of which the two modules have different ones; they share the code of most others.
DIFFERENT_FUNCTIONS = frozenset(
    (
        *("prologue", "begin", "enter", "run", RESUME, "attempt", "decide", "approach"),
        *("differences", "tangent_differences", "step_back", "differences_back"),
    )
)
GLOBALS = [f"@{name} = global ptr null" for name in POINTERS]


def no_members(f: Function) -> Value:
    """Return the address of a new array for the index of the member in each lane, filled with -1: all lanes are empty."""
    members = Value(f, f.reserve(INT, f.width), POINTER)
    with f.each(f.width) as k:
        f.store(-1, members, k, base=INT)
    return members


def go_on_if_loaded(f: Function):
    """If the later module is loaded, let it run all members, and return from `run(call)`."""
    later = f.op(f"load atomic ptr, ptr @{LATER_POINTER} acquire, align 8", POINTER)
    with f.if_(~f.is_null(later)):
        f.line(f"call void {later.name}(ptr {f.given['call'].name}, ptr {no_members(f).name})")
        f.leave()


def go_on(module: Memory, f: Function, members: Value):
    """Load the later module, and let it run `members` and all members that have not begun; report no memory if it fails."""
    load = f.op(f"load ptr, ptr @{LOAD_POINTER}, align 8", POINTER)
    later = f.op(f"call ptr {load.name}()", POINTER)
    f.choose(
        f.is_null(later),
        lambda: module.report_no_memory(f),
        lambda: f.line(f"call void {later.name}(ptr {f.given['call'].name}, ptr {members.name})"),
    )


def members_in_lanes(module: Memory, f: Function, s: Lane, present: Value) -> Value:
    """Return the address of a new array with the index of the member in each lane, -1 for lanes that are not `present`."""
    members = no_members(f)
    with module.each_lane(f, present) as k:
        f.store(module.to_int(f, f.lane(s.member, k)), members, k, base=INT)
    return members


def write_run(f: Function):
    """Write the body of the later module's own `run(call)`: it calls `resume` with empty lanes."""
    f.call(RESUME, f.given["call"], no_members(f))
