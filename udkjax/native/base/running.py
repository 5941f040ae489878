"""The functions that run the members of a module: `run` for the threads of a processor, `run_member` for a thread of a GPU.

Lanes load members by `begin(work, call, lane, member)`, and `step_all` takes them a step further and finishes them.
"""

from typing import TYPE_CHECKING

from udkjax.native.base.ir import BOOL, DOUBLE, INT, POINTER, Function, Value
from udkjax.native.base.layout import Lane

if TYPE_CHECKING:
    from udkjax.native.base.module import Module


def memory_size(module: "Module") -> int:
    """Return the count of numbers in the memory of a run."""
    return module.places.size * module.plan.width + 2 * module.plan.vector


def _clear_memory(module: "Module", f: Function):
    """Clear the memory at `work`, and store what all members share, and numbers with which lanes that stay empty compute."""
    work, width = f.given["work"], module.plan.width
    s = Lane(f, module.places)
    with f.each(memory_size(module)) as i:
        f.store(0.0, work, i)
    f.store(f.given["call"], work, module.start("call", "work"), base=POINTER)
    module.begin_memory(f)
    for name in ("length", "omega", "rtol", "atol", "smallest"):
        setattr(s, name, f.const(1.0, DOUBLE, width))
    with f.each(-(-module.n // max(module.plan.vector // width, 1)) * max(module.plan.vector // width, 1)) as i:
        for name in ("scale q", "scale v"):
            module.put_entry(f, name, i, 1.0)


def write_run(module: "Module"):
    """Write `run(call)`: run all members."""
    f = Function("run", [(POINTER, "call")], module.plan.width)
    module.functions.append(f)
    call, width = f.given["call"], module.plan.width
    block, work = module.allocate(f, f.const(memory_size(module), INT))
    f.given["work"], s = work, Lane(f, module.places)
    _clear_memory(module, f)
    blocks = [block, *module.allocate_tangents(f, block)]
    members, following = module.field(f, "members"), module.field(f, "next", POINTER)

    def fill():
        with f.each(width) as k, f.if_(f.lane(s.active, k) < 0.5):
            # Threads share the index of the next member.
            member = f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)
            with f.if_(member < members):
                f.call("begin", work, call, k, member)

    fill()
    with f.while_(lambda: module.goes_on(f, s)):
        module.step_all(f, s, fill)
    for block in blocks:
        f.line(f"call void @free(ptr {block.name})")


def write_run_member(module: "Module"):
    """Write `run_member(call, work, member)`: run one member in the memory at `work`.

    It is what a thread of a GPU does, with the other threads of its block: `meet(goes_on)` waits for them before each step, and
    returns whether one of them goes on, so that all run the same instructions at the same time.
    """
    f = Function("run_member", [(POINTER, "call"), (POINTER, "work"), (INT, "member")], module.plan.width)
    module.functions.append(f)
    call, work, member, s = f.given["call"], f.given["work"], f.given["member"], Lane(f, module.places)
    _clear_memory(module, f)
    with f.if_(member < module.field(f, "members")):
        f.call("begin", work, call, f.const(0, INT), member)

    def any_goes_on() -> Value:
        return f.op(f"call i1 @meet(i1 {module.goes_on(f, s).name})", BOOL)

    with f.while_(any_goes_on), f.if_(module.goes_on(f, s)):
        module.step_all(f, s, lambda: None)
