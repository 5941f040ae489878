"""Whole trajectories as machine code: an explicit Runge-Kutta method for q'' = a(t, q, v), with all that a step takes.

A method's tableau (A, b, c) is diffrax's. Since q' = v, its stages need the accelerations alone (Hairer, Norsett, Wanner, II.14):

    q_i = q + h c_i v + h^2 sum_j (A A)_ij a_j,        v_i = v + h sum_j A_ij a_j,        a_i = a(t + c_i h, q_i, v_i).

Each accepted step is returned to the constraint manifold. Outputs lie on the polynomial that has the positions, velocities and
accelerations of four consecutive accepted states (of degree 11: interpolated states are as exact as the states themselves, and
cost no evaluation), and are returned to the manifold, too. Where the motion is not smooth a step ends, and the run starts anew.

W members run side by side in the lanes of vectors, each with a time, a step and a result of its own. A lane whose member is done
takes the next one. Where elimination meets a pivot that it must not trust, a step is taken a little shorter; where that does not
help it is taken again by a fallback: elimination of all rows, without those that depend on others (fallback.py).

The functions of one module, all of them on one piece of memory (`Layout`): `run` takes members and calls `attempt` (one step),
`decide` (whether it counts, and the next), `outputs` (states between steps).
"""

from collections.abc import Callable, Sequence

from udkjax.native.base.ir import DOUBLE, Function
from udkjax.native.base.layout import Lane, Plan
from udkjax.native.base.module import Module
from udkjax.native.base.samples import write_next_breakpoint
from udkjax.native.base.steps import Status
from udkjax.native.run.breakpoints import aim
from udkjax.native.run.controller import write_decide
from udkjax.native.run.dense_equations import DenseEquations
from udkjax.native.run.dense_output import write_between, write_differences, write_outputs
from udkjax.native.run.fallback import write_fallback
from udkjax.native.run.formulations import FORMULATE
from udkjax.native.run.members import write_begin, write_finish, write_run
from udkjax.native.run.pieces import write_leave
from udkjax.native.run.runge_kutta import write_attempt


class Trajectory(Module):
    """The code of whole trajectories."""

    def __init__(self, plan: Plan, differentiated: Sequence[str] = (), active: Sequence[bool] = ()):
        super().__init__(plan, differentiated, active)
        self.dense = DenseEquations(self, plan.pseudoinverse) if self.is_dense else None
        self.formulated = plan.formulation.prepare(self) if self.is_formulated else None

    def write_programs(self):
        super().write_programs()
        if self.dense:
            self.dense.write()
        if self.formulated:
            self.formulated.write()

    def accelerate(self, f: Function, to: str):
        self.invoke(f, FORMULATE if self.formulated else "accelerations", to)

    def accelerate_end(self, f: Function):
        if self.formulated:
            self.copy(f, "state v", "saved v")
            self.copy(f, "result v", "state v")
            self.invoke(f, FORMULATE, "result a")
            self.copy(f, "saved v", "state v")

    def before_step(self, f: Function, s: Lane):
        """Hook: called before each attempt at a step, once it is planned."""

    def after_step(self, f: Function, s: Lane):
        """Hook: called behind each attempt at a step, once it is known up to when outputs are due."""

    def text(self) -> str:
        """LLVM's text of the whole module."""
        self.write_programs()
        write_attempt(self)
        if self.pieces:
            write_leave(self)
        write_decide(self)
        write_differences(self)
        write_between(self)
        write_outputs(self)
        if self.falls_back:
            write_fallback(self)
        if self.plan.breaks:
            write_next_breakpoint(self)
        write_begin(self)
        write_finish(self)
        self.write_derivatives()
        write_run(self)
        return self.module_text()

    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Take one step in all lanes, and finish those that are done."""
        work, call, width = f.given["work"], f.given["call"], self.plan.width
        yes = f.const(1.0, DOUBLE, width)
        due_for_fallback = s.fallback_due > 0.5
        fallback = f.any_of(due_for_fallback)
        if self.falls_back:
            s.fallback = f.select(fallback, f.const(1.0, DOUBLE, width), 0.0)
            s.stepping = f.select(fallback, f.select(due_for_fallback, yes, 0.0), s.active)
        else:
            s.stepping = s.active
        aim(self, f, s)
        self.before_step(f, s)
        f.call("attempt", work)
        f.call("decide", work)
        self.after_step(f, s)
        f.call("outputs", work, call)
        ended = (s.active > 0.5) & s.code.is_not(float(Status.RUNNING))
        with f.if_(f.any_of(ended)):
            s.due = f.select(ended, yes, 0.0)
            f.call("finish_members", work, call)
            s.where(ended, active=0.0, fallback_due=0.0)
            self.take_next(f, s, fill)
