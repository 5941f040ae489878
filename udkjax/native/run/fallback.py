"""Fallback steps: if a pivot is too small for elimination, a rank-revealing method on all rows takes the step.

Two functions of `work` evaluate the states of lanes that are `wanted`; their results are in separate arrays:

    fallback                 accelerations a, and q and v after one Newton step
    fallback_tangent_part    the tangent parts of `state dq` and `state dv`

For small scenes the method is the pseudoinverse by singular values, lane by lane. For large scenes it is elimination of all rows
with dependent rows left out, which near singular configurations has about half as many correct digits.
"""

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.programs import PROGRAMS
from udkjax.native.module.steps import ROUNDING_PIVOT
from udkjax.native.pseudoinverses.dense import MatrixRow
from udkjax.native.pseudoinverses.svd import SVDCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows
from udkjax.native.run.manifold import iterate_newton, with_loads_of_fallback, with_threshold


def write_fallback(module: Module):
    """Write the functions of a fallback step: accelerations, the end of a step, and closing of outputs."""
    (_write_elimination if module.eliminates_all_rows else _write_singular_values)(module)

    def invoke(f: Function, s: Lane, mask: Value, name: str = "fallback"):
        s.wanted = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
        module.invoke(f, name)

    def close_position(f: Function, s: Lane, mask: Value):
        def correct(active: Value):
            invoke(f, s, active)
            module.copy(f, "fallback q", "corrected q")

        iterate_newton(module, f, s, mask, correct)

    # Accelerations of lanes whose pivots were not safe.
    f, s = module.function("accelerate_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    mask = (s.stepping > 0.5) & (s.fallback > 0.5) & (s.safe < 0.5)
    invoke(f, s, mask)
    module.copy(f, "fallback a", "out", mask)
    # The end of a fallback step: the tangent part of the errors and, if the pivots are not safe, Newton's method for positions,
    # velocities and accelerations.
    f, s = module.function("finish_by_fallback", [(POINTER, "work"), (POINTER, "out")])
    fallback = (s.stepping > 0.5) & (s.fallback > 0.5)
    unsafe = fallback & (s.ok < 0.5)
    close_position(f, s, unsafe)
    with f.if_(f.any_of(unsafe)):
        invoke(f, s, unsafe)
        for to in ("state v", "result v"):
            module.copy(f, "fallback v", to, unsafe)
        invoke(f, s, unsafe)
        module.copy(f, "fallback a", "result a", unsafe)
    invoke(f, s, fallback, "fallback_tangent_part")
    for x in ("dq", "dv"):
        module.copy(f, f"fallback {x}", f"result {x}", fallback)
    # An output that still violates Psi after projection by elimination.
    f, s = module.function("close_output")
    close_position(f, s, s.open > 0.5)
    invoke(f, s, s.open > 0.5)
    module.copy(f, "fallback v", "result v", s.open > 0.5)
    module.invoke(f, "psi")


def _write_elimination(module: Module):
    """Write `fallback` and `fallback_tangent_part` by elimination, with a copy of the constants for another threshold."""
    all_rows = module.code.with_all_rows
    at = module.arrays | {x: ("work", module.places[f"fallback {x}"]) for x in (*all_rows.scratch, "constants", "a")}
    at |= {f"{x}1": ("work", module.places[f"fallback {x}"]) for x in ("q", "v", "dq", "dv")}
    at |= dict.fromkeys(("safe", "distance"), ("work", module.places["rank"]))
    module.loops.write(all_rows.of("a refined", "q1 refined", "v1 refined"), "fallback", ("work", "out"), at)
    module.loops.write(all_rows.of(*PROGRAMS["tangent_part"].outputs), "tangent_part_of_all_rows", ("work", "out"), at)
    module.write_prologue("fallback_prologue", None)
    f, _ = module.function("fallback_tangent_part", [(POINTER, "work"), (POINTER, "out")])
    place = module.places["fallback constants"] + module.code.drop_tol_index
    threshold = f.const(ROUNDING_PIVOT, DOUBLE, f.width)
    with_threshold(f, place, threshold, lambda: module.invoke(f, "tangent_part_of_all_rows"))


def _write_singular_values(module: Module):
    """Write `fallback` and `fallback_tangent_part` by singular values."""
    rows = WeightedRows(module, SVDCode(relative=True), by_lane=True)
    rows.write()
    of_lane = [(POINTER, "work"), (INT, "lane")]
    couples, splits = module.code.couples, rows.splits
    # For each result: the array to which it is added, its sign, and the right-hand side with the place of its first number.
    solutions = {"a": ("terms", 1.0, "terms", module.n), "v": ("state v", -1.0, "psi_dot", 0), "q": ("state q", -1.0, "psi", 0)}

    def put(f: Function, x: str, change: MatrixRow, start: str, sign: float):
        with f.each(module.n) as i:
            part = rows.array(f, "root", i) * change.entry(i) * sign
            rows.put(f, f"fallback {x}", i, part if couples else rows.array(f, start, i) + part)

    def spread(f: Function, x: str, start: str):
        """Complete a result of all lanes, if M is not diagonal."""
        module.invoke(f, "spread", f"fallback {x}")
        with f.each(module.n) as i:
            module.put_entry(f, f"fallback {x}", i, module.entry(f, start, i) + module.entry(f, f"fallback {x}", i))

    f = module.new_function("fallback_of_lane", of_lane, 1)
    rows.factor(f)
    for x, (start, sign, right, place) in solutions.items():
        if x == "q" and splits:
            rows.factor(f, of_positions=True)
        put(f, x, rows.solve(f, right, place), start, sign)
    f = module.new_function("fallback_tangent_part_of_lane", of_lane, 1)
    rows.factor(f, of_positions=True)
    for x in ("dq", "dv"):
        if x == "dv" and splits:
            rows.factor(f)
        put(f, x, rows.solve_rates(f, f"fallback {x}" if couples else f"state {x}", of_positions=x == "dq"), f"state {x}", -1.0)

    if module.adds_drift_of_rates:
        f = module.new_function("fallback_drift_of_lane", of_lane, 1)
        rows.factor(f)
        change = rows.solve(f, "drift")
        with f.each(module.n) as i:
            part = rows.array(f, "root", i) * change.entry(i)
            rows.put(f, "change" if couples else "fallback dv", i, part if couples else rows.array(f, "fallback dv", i) - part)

    def each_lane(f: Function, s: Lane, name: str):
        with module.each_lane(f, s.wanted) as k:
            f.call(f"{name}_of_lane", f.given["work"], k)

    f, s = module.function("fallback", [(POINTER, "work"), (POINTER, "out")])
    with_loads_of_fallback(module, f, lambda: module.invoke(f, "rows_and_loads"))
    each_lane(f, s, "fallback")
    if couples:
        for x, (start, *_) in solutions.items():
            spread(f, x, start)
    f, s = module.function("fallback_tangent_part", [(POINTER, "work"), (POINTER, "out")])
    with_loads_of_fallback(module, f, lambda: module.invoke(f, "rows_and_loads"))
    if couples:
        for x in ("dq", "dv"):
            module.copy(f, f"state {x}", f"fallback {x}")
            module.invoke(f, "gather", f"fallback {x}")
    threshold = f.const(np.sqrt(ROUNDING_PIVOT), DOUBLE, f.width)
    with_threshold(f, module.places["fallback_tol"], threshold, lambda: each_lane(f, s, "fallback_tangent_part"))
    if couples:
        for x in ("dq", "dv"):
            spread(f, x, f"state {x}")
    if not module.adds_drift_of_rates:
        return
    module.copy(f, "state dq", "saved state dq")
    module.copy(f, "fallback dq", "state dq")
    module.invoke(f, "drift_of_rates")
    module.copy(f, "saved state dq", "state dq")
    with_threshold(f, module.places["fallback_tol"], threshold, lambda: each_lane(f, s, "fallback_drift"))
    if couples:
        module.invoke(f, "spread", "change")
        with f.each(module.n) as i:
            module.put_entry(f, "fallback dv", i, module.entry(f, "fallback dv", i) - module.entry(f, "change", i))
