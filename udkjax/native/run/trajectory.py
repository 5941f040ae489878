"""Trajectories as machine code: a Runge-Kutta method for q'' = a(t, q, v) with step control and projection.

A method's tableau (A, b, c) is diffrax's. Since q' = v, its stages only need accelerations (Hairer, Norsett, Wanner, II.14):

    q_i = q + h c_i v + h^2 sum_j (A A)_ij a_j,        v_i = v + h sum_j A_ij a_j,        a_i = a(t + c_i h, q_i, v_i).

The stages of an implicit method are solved one after another (stage_equations.py). A run by the default method, which is
explicit, goes on with an implicit one where long implicit steps turn out to be accurate, and returns where they do not pay
(controller.py). Runs begin in a module without the implicit method, and leave it for one that has both when they first need it
(module/leaving.py); there each lane chooses for its next step.
Each accepted step is projected onto the constraint manifold. Outputs lie on the polynomial of degree 11 through the positions,
velocities and accelerations of four consecutive accepted states, which is as accurate as the states and costs no evaluation, and
are projected as well. Where the motion is not smooth, a step ends and the run begins anew.

W members run in the lanes of vectors, each with its own time, step and result. A lane with a completed member loads the next one.
If elimination encounters a pivot that is too small, the step is shortened slightly; if that does not help, it is repeated by a
rank-revealing fallback (parts/fallback.py).

All functions of a module work on one block of memory (`Layout`): `run` loads members and calls `attempt` (one step), `decide`
(acceptance and the next step) and `outputs` (states between steps).
"""

from collections.abc import Callable, Sequence

from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.module import Module
from udkjax.native.module.samples import enter_first_row, write_next_breakpoint
from udkjax.native.module.steps import Status
from udkjax.native.parts.all_rows import fallback_of
from udkjax.native.parts.dense_equations import DenseEquations
from udkjax.native.parts.elimination import EliminatedAccelerations
from udkjax.native.parts.formulations import Formulated
from udkjax.native.parts.partitioning import ByPartition
from udkjax.native.parts.projection import Projected, Unprojected
from udkjax.native.parts.stabilized import Stabilized
from udkjax.native.run.breakpoints import aim
from udkjax.native.run.controller import write_decide
from udkjax.native.run.dense_output import write_between, write_differences, write_outputs
from udkjax.native.run.members import write_begin, write_finish
from udkjax.native.run.pieces import write_end_piece
from udkjax.native.run.runge_kutta import write_attempt
from udkjax.native.run.stiffness import stiffness_of


class Trajectory(Module):
    """A module whose `run` integrates members from their first to their last time, and stores states at all output times."""

    closes = True

    def __init__(self, plan: Plan, differentiated: Sequence[str] = (), active: Sequence[bool] = ()):
        self._is_differentiated = bool(differentiated)
        super().__init__(plan, differentiated, active)

    def choose_parts(self):
        plan = self.plan
        self.stiffness = stiffness_of(self, self._is_differentiated)
        formulation, method = (plan.formulation, plan.pseudoinverse) if self.m else (None, None)
        if formulation and formulation.closes and self.closes:
            self.accelerations = Formulated(self, EliminatedAccelerations(self), formulation)
            self.projection = ByPartition(self, self.accelerations)
            return
        solver = DenseEquations(self, method) if method else EliminatedAccelerations(self)
        self.accelerations = Formulated(self, solver, formulation) if formulation else solver
        if plan.stabilization is not None:
            self.projection = Stabilized(self, self.accelerations, plan.stabilization)
        else:
            self.projection = Projected(self) if plan.projected else Unprojected(self, self.accelerations)
        self.fallback = fallback_of(self)

    def write_programs(self):
        super().write_programs()
        self.accelerations.write()
        self.projection.write()

    def enter_start(self, f: Function, lane: Value, member: Value):
        if self.plan.sampled:
            enter_first_row(self, f, lane, member)

    def before_step(self, f: Function, s: Lane):
        """Hook: add code before each attempt at a step, after `t1` has been set. Does nothing by default."""

    def after_step(self, f: Function, s: Lane):
        """Hook: add code after each attempt at a step, when `decide` has set `until`. Does nothing by default."""

    def after_outputs(self, f: Function, s: Lane):
        """Hook: add code after the outputs of a step, before completed members end. Does nothing by default."""

    def write_functions(self):
        self.write_programs()
        self.fallback.write()
        self.stiffness.write()
        write_attempt(self)
        if self.pieces:
            write_end_piece(self)
        write_decide(self)
        write_differences(self)
        write_between(self)
        write_outputs(self)
        if self.plan.breaks:
            write_next_breakpoint(self)
        write_begin(self)
        write_finish(self)
        self.write_derivatives()

    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Take one step in all lanes, finish completed members, and load the next ones by `fill`."""
        work, call, width = f.given["work"], f.given["call"], self.plan.width
        yes = f.const(1.0, DOUBLE, width)
        due_for_fallback = s.fallback_due > 0.5
        fallback = f.any_of(due_for_fallback)
        self.fallback.choose_lanes(f, s, due_for_fallback, fallback)
        aim(self, f, s)
        self.before_step(f, s)
        f.call("attempt", work)
        f.call("decide", work)
        self.after_step(f, s)
        f.call("outputs", work, call)
        self.after_outputs(f, s)
        ended = (s.active > 0.5) & s.code.is_not(float(Status.RUNNING))
        with f.if_(f.any_of(ended)):
            s.due = f.select(ended, yes, 0.0)
            f.call("finish_members", work, call)
            s.where(ended, active=0.0, fallback_due=0.0)
            self.take_next(f, s, fill)
