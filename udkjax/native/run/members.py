"""The beginning and the end of a member: a lane loads it, steps it to its end, and writes the results."""

from typing import Any

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import INFO_NAMES, LANE_NUMBERS, SETTINGS, Lane
from udkjax.native.module.module import Module
from udkjax.native.module.samples import enter_first_row, write_enter
from udkjax.native.module.steps import LOOK_AHEAD, MEASURING_PERIOD, NODE_COUNT, Status
from udkjax.native.parts.manifold import largest_violation


def write_begin(module: Module):
    """Write `begin(work, call, lane, member)`, which loads a member into a lane."""
    write_enter(module)
    arguments = [(POINTER, "work"), (POINTER, "call"), (INT, "lane"), (INT, "member")]
    f, _ = module.function("begin", arguments)
    call, k, member = f.given["call"], f.given["lane"], f.given["member"]
    work = f.given["work"]

    def put(name: str, value: Any, i: Any = 0):
        module.put_lane_entry(f, name, k, value, i)

    for name in LANE_NUMBERS:
        if name not in SETTINGS and name not in ("stepping", "call", "tangents"):
            put(name, 0.0)
    given_settings = module.member_address(f, "settings", member)
    settings = dict.fromkeys(SETTINGS, f.const(1.0)) | {name: f.load(given_settings, j) for j, name in enumerate(module.settings)}
    if "max_rank" in module.settings and module.code.marks_rows and not module.code.weighs_rows:
        settings["max_rank"] = _marked_rank(module, f, member, settings["max_rank"])
    for name, value in settings.items():
        put(name, value)
    q, v = module.member_address(f, "q", member), module.member_address(f, "v", member)
    with f.each(module.n) as i:
        angle = f.arithmetic("sub", i, f.arithmetic("div", i, 3) * 3).is_(2)
        unit = f.select(angle, f.const(1.0), settings["length"])
        put("inverse unit", 1.0 / unit, i)
        put("atol q", settings["atol"] * unit, i)
        put("atol v", settings["atol"] * unit * settings["omega"], i)
        for j in range(NODE_COUNT):
            put(f"point{j} q", f.load(q, i), i)
            put(f"point{j} v", f.load(v, i), i)
            put(f"point{j} a", 0.0, i)
    if module.m:
        rows = module.member_address(f, "rows", member)
        with f.each(module.m) as i:
            put("rows", f.load(rows, i), i)
        module.begin_rows(f, k, settings["length"])
    ts = module.member_address(f, "ts", member)
    times = module.field(f, "times")
    start, end = f.load(ts), f.load(ts, times - 1)
    first = {
        "start": start,
        "end": end,
        "next": f.load(ts, 1),
        "rate": np.inf,
        "crossing": np.inf,
        "passed": -np.inf,
        "lost": np.inf,
    }
    for name, value in first.items():
        put(name, value)
    for j in range(NODE_COUNT):
        put(f"point{j}_t", start)
    for name in (f"distance{j}" for j in range(NODE_COUNT - 1)):
        put(name, np.inf)
    put("stiff", float(module.method.is_implicit))
    for name in ("patience", "watch"):
        put(name, MEASURING_PERIOD)
    for name in ("tried", "accepted", "steps"):
        put(name, -1.0)
    put("active", 1.0)
    put("tolerance", settings["atol"])
    put("member", f.op(f"sitofp i64 {member.name} to double", DOUBLE))
    module.begin_numbers(f, k, member)
    if module.plan.breaks:
        enter_first_row(module, f, k, member)
    else:
        f.call("enter", work, call, k)
    module.begin_member(f, k, member)


def _marked_rank(module: Module, f: Function, member: Value, most: Value) -> Value:
    """Return the largest admissible rank of a member: the number of its rows marked as independent.

    If `most`, the given bound, is infinite, there is no bound, and infinity is returned.
    """
    numbers, marks, count = module.member_address(f, "numbers", member), module.code.marks, f.variable(0.0, width=1)
    with f.each(marks.stop, start=marks.start) as i:
        count.value = count.value + f.select(f.load(numbers, i) > 0.0, f.const(1.0), 0.0)
    return f.select(most < np.inf, count.value, most)


def write_finish(module: Module):
    """Write `finish_members(work, call)`: store the outputs of completed members, in lanes that are `due`.

    These are the first and the last state, and the output "info" (`INFO_NAMES`); outputs that the run has not reached become NaN.
    """
    f, s = module.function("finish_members", [(POINTER, "work"), (POINTER, "call")])
    times = module.field(f, "times")
    _find_cause(module, f, s)
    # The last state is projected once more; the first is returned as given.
    with f.each(module.rowcount) as r:
        for x in "qv":
            module.put(f, f"state {x}", r, module.vector(f, f"point3 {x}", r))
    setattr(s, "state t", s.point3_t)
    module.projection.project_output(f, s, s.due > 0.5)
    with module.each_lane(f, s.due) as k:
        member = module.to_int(f, f.lane(s.member, k))
        with f.if_(f.lane(s.code, k).is_(float(Status.DONE))):
            module.write_state(f, s, k, times - 1, "state q", "result v")
        q, v = module.member_address(f, "q", member), module.member_address(f, "v", member)
        with f.each(module.n) as i:
            for name, x in (("state q", q), ("result v", v)):
                module.put_lane_entry(f, name, k, f.load(x, i), i)
        module.enter_start(f, k, member)
    setattr(s, "state t", s.start)
    with f.each(module.rowcount) as r:
        module.put(f, "state v", r, module.vector(f, "result v", r))
    module.invoke(f, "psi")
    s.violated = largest_violation(module, f)
    with module.each_lane(f, s.due) as k:
        module.write_state(f, s, k, f.const(0, INT), "state q", "result v")
        with module.writing_results(f):
            _write_info(module, f, s, k)
            _clear_outputs(module, f, s, k)
    module.end_members(f, s)


def _write_info(module: Module, f: Function, s: Lane, k: Value):
    info = module.result_address(f, "info", module.to_int(f, f.lane(s.member, k)), len(INFO_NAMES) + 2 * module.n)
    ends = {"t": s.point3_t, "accepted": f.max(s.accepted, 0.0)}  # -1 if the initial state was not accepted
    for j, name in enumerate(INFO_NAMES):
        f.store(f.lane(ends[name] if name in ends else getattr(s, name), k), info, j)
    module.copy_lane(f, info, len(INFO_NAMES), "point3 q", k)
    module.copy_lane(f, info, len(INFO_NAMES) + module.n, "point3 v", k)


def _find_cause(module: Module, f: Function, s: Lane):
    """Set the status of stopped runs to `NOT_FINITE` if the equations are not finite where they stopped, or just ahead."""
    stopped = (
        s.due.is_(1.0)
        & s.code.is_not(float(Status.DONE))
        & s.code.is_not(float(Status.STEP_LIMIT))
        & (s.code < float(Status.CROSSED))
    )
    with f.if_(f.any_of(stopped)):
        for share in (0.0, LOOK_AHEAD):
            later = (s.end - s.start) * share
            setattr(s, "state t", s.point3_t + later)
            with f.each(module.rowcount) as r:
                v = module.vector(f, "point3 v", r)
                module.put(f, "state q", r, f.fma(module.broadcast(f, later), v, module.vector(f, "point3 q", r)))
                module.put(f, "state v", r, v)
            module.invoke(f, "equation_terms")
            total = f.variable(0.0)
            with f.each(module.code.term_count) as i:
                total.value = f.fma(module.entry(f, "terms", i), 0.0, total.value)
            module.accelerations.add_numbers(f, total)
            s.where(stopped & total.value.is_not(0.0), code=Status.NOT_FINITE)


def kept_outputs(module: Module, f: Function, s: Lane, k: Value) -> Value:
    """Return the number of outputs of lane k that are kept: those that its run has reached, up to the first one that is lost."""
    times = module.field(f, "times")
    is_done = f.lane(s.code, k).is_(float(Status.DONE))
    reached = f.select(is_done, f.op(f"sitofp i64 {times.name} to double", DOUBLE), f.lane(s.written, k) + 1.0)
    return module.to_int(f, f.min(f.lane(s.lost, k) + 1.0, reached))


def _clear_outputs(module: Module, f: Function, s: Lane, k: Value):
    """Set to NaN the outputs of lane k that are not kept."""
    times, nan, kept = module.field(f, "times"), f.const(np.nan), kept_outputs(module, f, s, k)
    row = module.to_int(f, f.lane(s.member, k)) * times + kept
    to = [module.result_address(f, name, row, module.n) for name in ("qs", "vs")]
    with f.each((times - kept) * module.n) as i:
        for address in to:
            f.store(nan, address, i)
