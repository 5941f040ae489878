"""Further rounds of Newton's method for friction that depends on the loads of joints.

The programs `SETTLING` take one round. They set `unsettled` to one where it does not suffice, and leave the solution of their
linear system as `settled`. Two functions then take as many more rounds as such lanes need, and leave other lanes as they are:

    settle_state(work, out)    at `state v`; the accelerations are at `out`
    settle_end(work, out)      the same at `result v`, the velocities at the end of a step
"""

from udkjax.equations.run_programs import RunPrograms
from udkjax.native.base.ir import INT, Function
from udkjax.native.base.layout import Lane
from udkjax.native.base.memory import Memory
from udkjax.native.base.steps import SETTLING_ROUNDS

AT_STATE = ("accelerations", "accelerations_and_drift")
AT_END = ("project_and_accelerate", "end_of_step")
SETTLING = (*AT_STATE, *AT_END)


def write_settle_state(module: Memory, f: Function, s: Lane):
    """Write `settle_state`."""
    k = f.variable(0, INT, 1)
    with f.while_(lambda: f.any_of(s.unsettled > 0.5) & (k.value < SETTLING_ROUNDS)):
        open_ = s.unsettled > 0.5
        module.invoke(f, RunPrograms.FURTHER, "further a")
        module.copy(f, "further a", "out", open_)
        s.where(~open_, unsettled=0.0)
        k.value = k.value + 1


def write_settle_end(module: Memory, f: Function):
    """Write `settle_end`."""
    module.copy(f, "state v", "saved v")
    module.copy(f, "result v", "state v")
    f.call("settle_state", f.given["work"], f.given["out"])
    module.copy(f, "saved v", "state v")
