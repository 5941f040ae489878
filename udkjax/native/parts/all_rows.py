"""The methods of the fallback, which use all rows of Psi.

For small scenes the method is the pseudoinverse by singular values, lane by lane. For large scenes it is elimination of all rows
with dependent rows left out, which has about half as many correct digits near singular configurations.
"""

import numpy as np

from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import FallbackPart
from udkjax.native.module.programs import PROGRAMS
from udkjax.native.module.steps import ROUNDING_PIVOT
from udkjax.native.parts.fallback import RankRevealing
from udkjax.native.parts.manifold import is_moving, with_threshold
from udkjax.native.pseudoinverses.dense import MatrixRow
from udkjax.native.pseudoinverses.svd import SVDCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows


def fallback_of(module: Module) -> FallbackPart:
    """Return the fallback of a module, by singular values for small scenes or if redundant rows share loads, else by elimination.

    It is a `FallbackPart`, which takes no steps, if the accelerations do not report small pivots.
    """
    if not (module.code.policy.reports and module.m):
        return FallbackPart()
    return (BySingularValues if module.plan.unrolled or module.code.weighs_rows else ByElimination)(module)


class ByElimination(RankRevealing):
    """The fallback by elimination of all rows; it has its own copy of the constants, with another threshold of pivots."""

    def reserve(self):
        super().reserve()
        code = self._in.code
        for name, count in (code.with_all_rows.scratch | {"constants": len(code.constants)}).items():
            self._in.places.add(f"fallback {name}", count)

    def enter(self, f: Function, lane: Value, numbers: Value):
        module = self._in
        count = len(module.code.constants)
        all_constants, tol = Value(f, f.reserve(DOUBLE, count), POINTER), module.lane_entry(f, "fallback_tol", lane)
        f.call("fallback_prologue", numbers, all_constants)
        f.store(tol * tol, all_constants, module.code.drop_tol_index)
        with f.each(count) as i:
            module.put_lane_entry(f, "fallback constants", lane, f.load(all_constants, i), i)

    def write_evaluations(self):
        module = self._in
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


class BySingularValues(RankRevealing):
    """The fallback by the pseudoinverse from singular values, lane by lane."""

    programs = ("rows_and_loads",)
    arrays = ("psi_q", "psi_dot", "root")

    def reserve(self):
        super().reserve()
        module = self._in
        entries = {"psi_q": module.code.scratch["psi_q"]} if module.unrolled else {}
        for name, count in (entries | {"psi_dot": module.m, "root": module.n}).items():
            module.places.add(name, count)

    def write_evaluations(self):
        rows = WeightedRows(self._in, SVDCode(relative=True), by_lane=True)
        rows.write()
        self._write_functions_of_lane(rows)
        self._write_functions()

    @property
    def _solutions(self) -> dict[str, tuple[str, float, str, int]]:
        """The linear systems, by the name of the result.

        Each has the array to which the solution is added, the sign of the solution, and the array of the right-hand side with the
        index of its first number there.
        """
        n = self._in.n
        return {"a": ("terms", 1.0, "terms", n), "v": ("state v", -1.0, "psi_dot", 0), "q": ("state q", -1.0, "psi", 0)}

    def _write_functions_of_lane(self, rows: WeightedRows):
        module, of_lane = self._in, [(POINTER, "work"), (INT, "lane")]
        couples, splits = module.code.couples, rows.splits

        def put(f: Function, x: str, change: MatrixRow, start: str, sign: float):
            with f.each(module.n) as i:
                part = rows.array(f, "root", i) * change.entry(i) * sign
                rows.put(f, f"fallback {x}", i, part if couples else rows.array(f, start, i) + part)

        f = module.new_function("fallback_of_lane", of_lane, 1)
        rows.factor(f)
        for x, (start, sign, right, place) in self._solutions.items():
            if x == "q" and splits:
                rows.factor(f, of_positions=True)
            change = rows.solve(f, right, place)
            if x == "a" and module.plan.steps:
                self._hold_left_out(f, rows)
            put(f, x, change, start, sign)
        f = module.new_function("fallback_tangent_part_of_lane", of_lane, 1)
        rows.factor(f, of_positions=True)
        for x in ("dq", "dv"):
            if x == "dv" and splits:
                rows.factor(f)
            rates = rows.solve_rates(f, f"fallback {x}" if couples else f"state {x}", of_positions=x == "dq")
            put(f, x, rates, f"state {x}", -1.0)
        if "rates" not in module.shared:
            return
        f = module.new_function("fallback_drift_of_lane", of_lane, 1)
        rows.factor(f)
        change = rows.solve(f, "drift")
        with f.each(module.n) as i:
            part = rows.array(f, "root", i) * change.entry(i)
            new = part if couples else rows.array(f, "fallback dv", i) - part
            rows.put(f, "change" if couples else "fallback dv", i, new)

    def _hold_left_out(self, f: Function, rows: WeightedRows):
        """Remove the components of the loads along rows that are left out from the solution `x`, if the mechanism moves.

        A moving mechanism passes the singular configuration within so short a time that its velocity should change little. But
        no row opposes loads along the rows that are left out: a load as large as that of a stiff damper would turn the velocity,
        and the motion would change its branch. Components along rows that are dependent everywhere are rounding errors, and stay.
        """
        d, squares, name = rows.matrices(f), rows.matrices(f).row("lengths"), "fallback a" if self._in.code.couples else "terms"

        def along(row: MatrixRow) -> Value:
            total = f.variable(0.0)
            with f.each(self._in.n) as i:
                root = rows.array(f, "root", i)
                load = rows.array(f, name, i) / f.select(root > 0.0, root, 1.0)
                total.value = f.fma(row.entry(i), load, total.value)
            return total.value

        longest = f.variable(0.0)
        with f.each(d.steps) as i:
            longest.value = f.max(d.dot(d.row("D", i), d.row("D", i)), longest.value)
        with f.each(d.steps) as i:
            row = d.row("D", i)
            square = d.dot(row, row)
            is_held = squares.entry(i).is_(0.0) & (square > longest.value * ROUNDING_PIVOT) & (rows.array(f, "moves", 0) > 0.5)
            with f.if_(f.any_of(is_held)):
                d.axpy(-along(row) / square, row, d.row("x"))

    def _write_functions(self):
        """Write `fallback` and `fallback_tangent_part`, which call the functions of one lane for each lane that is `wanted`."""
        module, couples = self._in, self._in.code.couples

        def spread(f: Function, x: str, start: str):
            """Transform the solution `fallback <x>` to the scene's coordinates, and add `start`, if M is not diagonal."""
            module.invoke(f, "spread", f"fallback {x}")
            with f.each(module.n) as i:
                module.put_entry(f, f"fallback {x}", i, module.entry(f, start, i) + module.entry(f, f"fallback {x}", i))

        def each_lane(f: Function, s: Lane, name: str):
            with module.each_lane(f, s.wanted) as k:
                f.call(f"{name}_of_lane", f.given["work"], k)

        f, s = module.function("fallback", [(POINTER, "work"), (POINTER, "out")])
        self.with_loads(f, lambda: module.invoke(f, "rows_and_loads"))
        if module.plan.steps:
            s.moves = f.select(is_moving(module, f, s), f.const(1.0, DOUBLE, f.width), 0.0)
            if couples:
                with f.each(module.n) as i:
                    module.put_entry(f, "fallback a", i, module.entry(f, "terms", i))
                module.invoke(f, "gather", "fallback a")
        each_lane(f, s, "fallback")
        if couples:
            for x, (start, *_) in self._solutions.items():
                spread(f, x, start)
        f, s = module.function("fallback_tangent_part", [(POINTER, "work"), (POINTER, "out")])
        self.with_loads(f, lambda: module.invoke(f, "rows_and_loads"))
        if couples:
            for x in ("dq", "dv"):
                module.copy(f, f"state {x}", f"fallback {x}")
                module.invoke(f, "gather", f"fallback {x}")
        threshold = f.const(np.sqrt(ROUNDING_PIVOT), DOUBLE, f.width)
        with_threshold(f, module.places["fallback_tol"], threshold, lambda: each_lane(f, s, "fallback_tangent_part"))
        if couples:
            for x in ("dq", "dv"):
                spread(f, x, f"state {x}")
        if "rates" not in module.shared:
            return
        module.copy(f, "state dq", "saved state dq")
        module.copy(f, "fallback dq", "state dq")
        module.invoke(f, "drift_of_rates")
        module.copy(f, "saved state dq", "state dq")
        with_threshold(f, module.places["fallback_tol"], threshold, lambda: each_lane(f, s, "fallback_drift"))
        if couples:
            module.invoke(f, "spread", "change")
            with f.each(module.n) as i:
                new = module.entry(f, "fallback dv", i) - module.entry(f, "change", i)
                module.put_entry(f, "fallback dv", i, new)
