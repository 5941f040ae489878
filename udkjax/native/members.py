"""Members and lanes: a lane takes a member, steps it to its end, writes what it found, and takes the next one."""

from typing import Any

import numpy as np

from udkjax.native.ir import DOUBLE, INT, POINTER, Function
from udkjax.native.layout import INFO, LANE_NUMBERS, SETTINGS, Lane
from udkjax.native.manifold import largest_violation, project_output
from udkjax.native.module import Module
from udkjax.native.samples import enter_first_row, write_enter
from udkjax.native.steps import DONE, LOOK_AHEAD, NOT_FINITE, POINTS, STEP_LIMIT


def write_begin(t: Module):
    """Take a member into a lane."""
    write_enter(t)
    arguments = [(POINTER, "work"), (POINTER, "call"), (INT, "lane"), (INT, "member")]
    f, _ = t.function("begin", arguments)
    p, width, call, k, member = t.places, t.plan.width, f.given["call"], f.given["lane"], f.given["member"]
    work = f.given["work"]

    def put(name: str, value: Any, i: Any = 0):
        f.store(value, work, f.like(i, INT, 1) * width + p[name] * width + k)

    for name in LANE_NUMBERS:
        if name not in SETTINGS and name not in ("stepping", "call", "tangents"):
            put(name, 0.0)
    given = t.member_address(f, call, "settings", member)
    settings = dict.fromkeys(SETTINGS, f.const(1.0)) | {name: f.load(given, j) for j, name in enumerate(t.settings)}
    for name, value in settings.items():
        put(name, value)
    q, v = t.member_address(f, call, "q", member), t.member_address(f, call, "v", member)
    with f.each(t.n) as i:
        angle = f.arithmetic("sub", i, f.arithmetic("div", i, 3) * 3).is_(2)
        unit = f.select(angle, f.const(1.0), settings["length"])
        put("inverse unit", 1.0 / unit, i)
        put("scale q", settings["atol"] * unit, i)
        put("scale v", settings["atol"] * unit * settings["omega"], i)
        for j in range(POINTS):
            put(f"P{j} q", f.load(q, i), i)
            put(f"P{j} v", f.load(v, i), i)
            put(f"P{j} a", 0.0, i)
    if t.m:
        rows = t.member_address(f, call, "rows", member)
        with f.each(t.m) as i:
            put("rows", f.load(rows, i), i)
    ts = t.member_address(f, call, "ts", member)
    times = f.load(call, t.call_fields.index("times"), base=INT)
    start, end = f.load(ts), f.load(ts, times - 1)
    first = {"start": start, "end": end, "next": f.load(ts, 1), "rate": np.inf, "crossing": np.inf, "passed": -np.inf}
    for name, value in first.items():
        put(name, value)
    for j in range(POINTS):
        put(f"T{j}", start)
    for name in (f"distance{j}" for j in range(POINTS - 1)):
        put(name, np.inf)
    for name in ("tried", "accepted", "steps"):
        put(name, -1.0)
    put("active", 1.0)
    put("tolerance", settings["atol"])
    put("member", f.op(f"sitofp i64 {member.name} to double", DOUBLE))
    if t.plan.breaks:
        enter_first_row(t, f, k, member)
    else:
        f.call("enter", work, call, k)
    t.begin_member(f, k, member)


def write_finish(t: Module):
    """Write what is left of the members whose lanes are marked in `due`: their first and last states, and how they ended."""
    f, s = t.function("finish_members", [(POINTER, "work"), (POINTER, "call")])
    p, width, call, work = t.places, t.plan.width, f.given["call"], f.given["work"]
    times = f.load(call, t.call_fields.index("times"), base=INT)
    # Why the step size fell to nothing: a number that is not finite, at the end or right ahead, or something else.
    stopped = s.due.is_(1.0) & s.code.is_not(float(DONE)) & s.code.is_not(float(STEP_LIMIT))
    with f.if_(f.any_of(stopped)):
        for share in (0.0, LOOK_AHEAD):
            later = (s.end - s.start) * share
            setattr(s, "X t", s.T3 + later)
            with f.each(t.rowcount) as r:
                v = t.vector(f, "P3 v", r)
                t.put(f, "X q", r, f.fma(t.broadcast(f, later), v, t.vector(f, "P3 q", r)))
                t.put(f, "X v", r, v)
            t.invoke(f, "equation_terms")
            total = f.variable(0.0)
            with f.each(t.code.term_count) as i:
                x = f.load(work, i * width + p["terms"] * width, width)
                total.value = f.fma(x, 0.0, total.value)
            s.where(stopped & total.value.is_not(0.0), code=NOT_FINITE)
    # The last state, once more to the manifold; and then the first, which is taken as it is.
    with f.each(t.rowcount) as r:
        for x in "qv":
            t.put(f, f"X {x}", r, t.vector(f, f"P3 {x}", r))
    setattr(s, "X t", s.T3)
    project_output(t, f, s, "due")
    with f.each(width) as k, f.if_(f.lane(s.due, k) > 0.5):
        member = t.to_int(f, f.lane(s.member, k))
        with f.if_(f.lane(s.code, k).is_(float(DONE))):
            t.write_state(f, s, call, k, times - 1, "X q", "O v")
        info = f.at(f.load(call, t.call_fields.index("info"), base=POINTER), member * (len(INFO) + 2 * t.n))
        values = {"t": s.T3}
        for j, name in enumerate(INFO):
            f.store(f.lane(values.get(name, getattr(s, name) if name != "t" else s.T3), k), info, j)
        t.copy_lane(f, info, len(INFO), "P3 q", k)
        t.copy_lane(f, info, len(INFO) + t.n, "P3 v", k)
        q, v = t.member_address(f, call, "q", member), t.member_address(f, call, "v", member)
        with f.each(t.n) as i:
            f.store(f.load(q, i), work, (i + p["X q"]) * width + k)
            f.store(f.load(v, i), work, (i + p["O v"]) * width + k)
        if t.plan.sampled:
            enter_first_row(t, f, k, member)
    setattr(s, "X t", s.start)
    with f.each(t.rowcount) as r:
        t.put(f, "X v", r, t.vector(f, "O v", r))
    t.invoke(f, "psi")
    s.violated = largest_violation(t, f)
    with f.each(width) as k, f.if_(f.lane(s.due, k) > 0.5):
        t.write_state(f, s, call, k, f.const(0, INT), "X q", "O v")
    t.end_members(f, s)


def write_run(t: Module):
    """`run(call)`: members one after another, until there are none left."""
    f = Function("run", [(POINTER, "call")], t.plan.width)
    t.functions.append(f)
    call, width = f.given["call"], t.plan.width
    size = t.places.size * width + 2 * t.plan.vector
    block, work = t.allocate(f, f.const(size, INT))
    f.given["work"], s = work, Lane(f, t.places)
    with f.each(size) as i:
        f.store(0.0, work, i)
    f.store(call, work, t.places["call"] * width, base=POINTER)
    blocks = [block, *t.allocate_memory(f, call)]
    for name in ("length", "omega", "rtol", "atol", "smallest"):  # of lanes that stay empty
        setattr(s, name, f.const(1.0, DOUBLE, width))
    with f.each(-(-t.n // max(t.plan.vector // width, 1)) * max(t.plan.vector // width, 1)) as i:
        for name in ("scale q", "scale v"):
            f.store(f.const(1.0, DOUBLE, width), work, (i + t.places[name]) * width, width)
    members = f.load(call, t.call_fields.index("members"), base=INT)
    following = f.load(call, t.call_fields.index("next"), base=POINTER)

    def fill():
        with f.each(width) as k, f.if_(f.lane(s.active, k) < 0.5):
            # Members are taken in order, by whoever comes first: threads share the count.
            member = f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)
            with f.if_(member < members):
                f.call("begin", work, call, k, member)

    fill()
    with f.while_(lambda: t.goes_on(f, s)):
        t.step_all(f, s, fill)
    for block in blocks:
        f.line(f"call void @free(ptr {block.name})")
