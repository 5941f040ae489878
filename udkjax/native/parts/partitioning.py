"""Coordinate partitioning (equations/laws/partitioning.py) as machine code: steps in the independent coordinates alone.

A partition is two arrays of zeros and ones, `dependent q` and `dependent v`, which mark the pivot columns of D. That of a step
follows from its first state, that of an output from the interpolated state:

    choose_partition(work)    choose the partition at the state
    close_state(work)         change the dependent coordinates and velocities of the state to satisfy the constraints, in lanes
                              that are `closing`; velocities become NaN where Newton's method fails, and the step is repeated

States are closed at each stage, at the end of a step and at each output.

The accelerations of such a state are those of the Udwadia-Kalaba equation, a_F + M^(-1/2) D^+ b: only the choice of the state
differs. A Nystroem method, which has stages of coordinates from accelerations alone, is the same in the independent coordinates
as if it integrated only these; the dependent ones are the first guess of Newton's method.
"""

import numpy as np

from udkjax.equations.laws.partitioning import PARTITION_NEWTON
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value, Variable
from udkjax.native.module.layout import FORMULATION_SETTINGS, Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import ProjectionPart
from udkjax.native.parts.formulations import FORMULATE, Formulated, FormulatedAccelerations, FormulationCode
from udkjax.native.parts.manifold import iterate_newton, largest_violation, take_newton_step
from udkjax.native.parts.projection import estimate_errors, lost_in
from udkjax.native.pseudoinverses.householder import HouseholderCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows

LAST_CHANGE = PARTITION_NEWTON.last_change(np.float64)


class PartitioningCode(FormulationCode):
    """The formulation that integrates independent coordinates alone (`CoordinatePartitioning`)."""

    closes = True

    def prepare(self, module: Module) -> "PartitionedAccelerations":
        return PartitionedAccelerations(module)


class PartitionedAccelerations(FormulatedAccelerations):
    """The writer of accelerations by a pivoted QR factorization of D, whose pivots also give the dependent coordinates."""

    def __init__(self, module: Module):
        self._in = module
        self.rows = WeightedRows(module, HouseholderCode(relative=True), prefix="partition", tol=FORMULATION_SETTINGS[0])

    def write(self):
        module, rows = self._in, self.rows
        rows.write()
        f, _ = module.function(FORMULATE, [(POINTER, "work"), (POINTER, "out")])
        module.invoke(f, "dense_accelerations")
        rows.factor(f)
        rows.correct(f, rows.solve(f, "terms", module.n), "terms", "out", 1.0)


class ByPartition(ProjectionPart):
    """The projection that changes only dependent coordinates and velocities, also at the stages of a step."""

    programs = ("rows_of_positions", "rows_of_velocities")

    def __init__(self, module: Module, accelerations: Formulated):
        self._in, self._accelerations = module, accelerations

    @property
    def _rows(self) -> WeightedRows:
        formulation = self._accelerations.formulation
        assert isinstance(formulation, PartitionedAccelerations)  # the only formulation that closes states
        return formulation.rows

    def reserve(self):
        places = self._in.places
        places.add("closing")
        for name in ("dependent q", "dependent v", "predicted q"):
            places.add(name, self._in.n)

    def write(self):
        self._write_choice()
        self._write_closure()

    def begin_step(self, f: Function, s: Lane):
        """Choose the partition of a step, at point 3."""
        module = self._in
        setattr(s, "state t", s.point3_t)
        with f.each(module.rowcount) as r:
            for x in "qv":
                module.put(f, f"state {x}", r, module.vector(f, f"point3 {x}", r))
        f.call("choose_partition", f.given["work"])

    def close_stage(self, f: Function, s: Lane):
        s.closing = f.select(s.stepping > 0.5, f.const(1.0, DOUBLE, f.width), 0.0)
        f.call("close_state", f.given["work"])

    def end_step(self, f: Function, s: Lane):
        """Close the state at the end of a step, compute its accelerations, and estimate errors.

        Dependent coordinates, which are not integrated, have no errors.
        """
        module = self._in
        self.close_stage(f, s)
        module.copy(f, "state v", "result v")
        module.invoke(f, FORMULATE, "result a")
        estimate_errors(module, f, s, "result a" if module.method.ends else None, "state dq", "state dv")
        with f.each(module.rowcount) as r:
            for x in "qv":
                error = module.vector(f, f"state d{x}", r) * (1.0 - module.vector(f, f"dependent {x}", r))
                for name in ("state", "result"):
                    module.put(f, f"{name} d{x}", r, error)

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        lost.value = lost_in(self._in, f, s, accept)

    def project_output(self, f: Function, s: Lane, mask: Value):
        module = self._in
        f.call("choose_partition", f.given["work"])
        s.closing = s.due
        f.call("close_state", f.given["work"])
        module.copy(f, "state v", "result v", mask)
        module.invoke(f, "psi")
        s.violated = largest_violation(module, f)

    def _write_choice(self):
        """Write `choose_partition(work)`: mark the dependent coordinates and velocities, by pivots at the state."""
        module, rows = self._in, self._rows
        f, _ = module.function("choose_partition")

        def choose(of: str):
            free = rows.matrices(f).row("unused")
            with f.each(module.n) as i:
                module.put_entry(f, f"dependent {of}", i, 1.0 - free.entry(i))

        module.invoke(f, "rows_of_positions")
        rows.factor(f, of_positions=True)
        choose("q")
        if rows.splits:
            module.invoke(f, "rows_of_velocities")
            rows.factor(f)
        choose("v")

    def _write_closure(self):
        """Write `close_state(work)`: solve Psi and Psi_dot for the dependent coordinates and velocities."""
        module, steps = self._in, PARTITION_NEWTON.most_steps
        f, s = module.function("close_state")
        closing = s.closing > 0.5
        module.copy(f, "state q", "predicted q")
        s.iterating = f.const(0.0, DOUBLE, f.width)
        if module.code.position_rows:
            iterate_newton(module, f, s, closing, lambda _: self._newton(f, "q", "corrected q"), steps, LAST_CHANGE)
        # A solution farther from the predicted state might be another assembly mode.
        moved = module.largest(
            f,
            lambda r: [
                f.abs(module.vector(f, "state q", r) - module.vector(f, "predicted q", r)) * module.vector(f, "inverse unit", r)
            ],
        )
        lost = (s.iterating > 0.5) | ~(moved <= CLOSURE.longest_step)
        s.iterating = f.select(closing & ~lost, f.const(1.0, DOUBLE, f.width), 0.0)
        k = f.variable(0, INT, 1)
        steps_of_velocities = 1 if module.code.is_linear else steps
        with f.while_(lambda: f.any_of(s.iterating > 0.5) & (k.value < steps_of_velocities)):
            active = s.iterating > 0.5
            self._newton(f, "v", "result v")
            change = take_newton_step(module, f, active, "state v", "result v")
            if not module.code.is_linear:
                s.iterating = f.select(active & ~(change <= LAST_CHANGE), f.const(1.0, DOUBLE, f.width), 0.0)
            k.value = k.value + 1
        if not module.code.is_linear:
            lost = lost | (s.iterating > 0.5)
        with f.each(module.rowcount) as r:
            module.put(f, "state v", r, f.select(closing & lost, np.nan, module.vector(f, "state v", r)))

    def _newton(self, f: Function, x: str, to: str):
        """Store the state after a Newton step in its dependent coordinates (x = "q") or velocities ("v") in the array `to`."""
        module, rows, columns = self._in, self._rows, f"dependent {x}"
        module.invoke(f, "rows_of_positions" if x == "q" else "rows_of_velocities")
        rows.factor(f, of_positions=x == "q", columns=columns)
        change = rows.solve(f, "psi")
        with f.each(module.n) as i:
            step = module.entry(f, "root", i) * module.entry(f, columns, i) * change.entry(i)
            module.put_entry(f, to, i, module.entry(f, f"state {x}", i) - step)
