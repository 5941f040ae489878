"""Further rounds of Newton's method for friction that depends on the loads of joints.

The programs `SETTLING` take one round. They set `unsettled` to one where it does not suffice, and leave the solution of their
linear system as `settled`. Two functions then take as many more rounds as such lanes need, and leave other lanes as they are.
Lanes that still do not settle follow the solution from that without friction on, in `RunPrograms.STAGES` of growing friction:

    settle_state(work, out)    at `state v`; the accelerations are at `out`
    settle_end(work, out)      the same at `result v`, the velocities at the end of a step
"""

from udkjax.equations.run_programs import RunPrograms
from udkjax.native.base.ir import DOUBLE, INT, Function
from udkjax.native.base.layout import Lane
from udkjax.native.base.memory import Memory
from udkjax.native.base.steps import SETTLING_ROUNDS

AT_STATE = ("accelerations", "accelerations_and_drift")
AT_END = ("project_and_accelerate", "end_of_step")
SETTLING = (*AT_STATE, *AT_END)


def write_settle_state(module: Memory, f: Function, s: Lane):
    """Write `settle_state`."""
    s.friction_share = f.const(1.0, DOUBLE, f.width)
    s.staged = f.const(0.0, DOUBLE, f.width)
    _write_rounds(module, f, s)
    with f.if_(f.any_of(s.unsettled > 0.5)):
        s.staged = s.unsettled
        stage = f.variable(0, INT, 1)
        with f.while_(lambda: f.any_of(s.staged > 0.5) & (stage.value <= RunPrograms.STAGES)):
            share = f.like(stage.value, DOUBLE, f.width) * (1 / RunPrograms.STAGES)
            s.where(s.staged > 0.5, unsettled=1.0, friction_share=share)
            _write_rounds(module, f, s)
            s.where(s.unsettled > 0.5, staged=0.0)  # it jams already with a part of the friction
            stage.value = stage.value + 1


def _write_rounds(module: Memory, f: Function, s: Lane):
    """Take rounds until all lanes are settled; those that are not have NaN at `out` after the last one."""
    k = f.variable(0, INT, 1)
    with f.while_(lambda: f.any_of(s.unsettled > 0.5) & (k.value < SETTLING_ROUNDS)):
        open_ = s.unsettled > 0.5
        count = module.plan.code.scratch["settled"] if f.width > 1 else 0  # a single lane is open here
        with f.each(count) as i:
            module.put_entry(f, "settled before", i, module.entry(f, "settled", i))
        module.invoke(f, RunPrograms.FURTHER, "further a")
        module.copy(f, "further a", "out", open_)
        with f.each(count) as i:  # other lanes keep theirs: what follows from it must not depend on the lanes beside
            old, new = (module.entry(f, name, i) for name in ("settled before", "settled"))
            module.put_entry(f, "settled", i, f.select(open_, new, old))
        s.where(~open_, unsettled=0.0)
        k.value = k.value + 1


def write_settle_end(module: Memory, f: Function):
    """Write `settle_end`."""
    module.copy(f, "state v", "saved v")
    module.copy(f, "result v", "state v")
    f.call("settle_state", f.given["work"], f.given["out"])
    module.copy(f, "saved v", "state v")
