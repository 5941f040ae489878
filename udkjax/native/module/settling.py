"""Further rounds of Newton's method for friction that depends on the loads of joints.

The programs `SETTLING_PROGRAMS` take one round. They set `unsettled` to zero if that suffices, otherwise to the sum of one if the
loads are no solution and of two if pivots are negative. The solution of their linear system is `settled`. Two functions then take
the further rounds that unsettled lanes need; other lanes do not change. Lanes that still do not settle, or whose pivots are
negative, begin again with the solution without friction, and follow it as friction grows: to all of it at once, in
`RunPrograms.STAGES` stages, or in shorter stages where one of these fails. At the end of such a stage, a solution with negative
pivots is accepted:

    settle_state(work, out)    at `state v`; the accelerations are at `out`
    settle_end(work, out)      the same at `result v`, the velocities at the end of a step
"""

from collections.abc import Callable, Sequence

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.module.layout import Lane
from udkjax.native.module.memory import Memory
from udkjax.native.module.parts import FrictionPart
from udkjax.native.module.programs import FURTHER_ACCELERATIONS
from udkjax.native.module.steps import SETTLING_ROUNDS, STAGE_ROUNDS

AT_STATE = ("accelerations", "accelerations_and_drift")
AT_END = ("project_and_accelerate", "end_of_step")
SETTLING_PROGRAMS = (*AT_STATE, *AT_END)


class LoadFriction(FrictionPart):
    """Friction that depends on the loads of joints, found by further rounds of Newton's method."""

    settles = True
    programs = (FURTHER_ACCELERATIONS,)
    shared = ("velocities",)
    arrays = RunPrograms.BEGINS

    def __init__(self, module: Memory, at_end: bool):
        """Prepare the rounds of a module; `at_end` tells whether it has programs of the end of a step, which need them, too."""
        self._in, self._at_end = module, at_end

    def reserve(self):
        module, count = self._in, self._in.plan.code.scratch["settled"]
        module.places.add("further a", module.n)
        if module.plan.unrolled:
            module.places.add("settled", count)
        module.places.add("settled before", count if module.plan.width > 1 else 0)
        module.places.add("settled kept", count)

    def write(self):
        module, arguments = self._in, [(POINTER, "work"), (POINTER, "out")]
        write_settle_state(module, *module.function("settle_state", arguments))
        if self._at_end:
            write_settle_end(module, module.function("settle_end", arguments)[0])

    def settle_after(self, f: Function, name: str, out: str | None):
        if name in SETTLING_PROGRAMS:
            with f.if_(f.any_of(Lane(f, self._in.places).unsettled > 0.5)):
                address = self._in.address(f, out or "result a")
                f.call("settle_end" if name in AT_END else "settle_state", f.given["work"], address)

    def settle(self, f: Function, out: str):
        self._in.invoke(f, "accelerations", out)


def friction_of(module: Memory, names: Sequence[str]) -> FrictionPart:
    """Return the part of a module for friction by loads; `names` are the programs of the module."""
    needs = module.plan.code.rubs and any(name in SETTLING_PROGRAMS for name in names)
    return LoadFriction(module, any(name in AT_END for name in names)) if needs else FrictionPart()


def write_settle_state(module: Memory, f: Function, s: Lane):
    """Write `settle_state`: find the loads of joints at `state` by Newton's method or, if that fails, by stages of friction."""
    s.friction_share = f.const(1.0, DOUBLE, f.width)
    _write_rounds(module, f, s, SETTLING_ROUNDS, _may_settle)
    with f.if_(f.any_of(s.unsettled > 0.5)):
        _write_stages(module, f, s)


def _may_settle(unsettled: Value) -> Value:
    return (unsettled > 0.5) & (unsettled < 1.5)


def _fails(unsettled: Value) -> Value:
    return _may_settle(unsettled) | (unsettled > 2.5)


def _write_stages(module: Memory, f: Function, s: Lane):
    """Write the stages of unsettled lanes: follow the solution from that without friction to that with all of it."""
    zero, one = (f.const(x, DOUBLE, f.width) for x in (0.0, 1.0))
    most, least = 1 / RunPrograms.STAGES, 1 / RunPrograms.STAGES**2
    s.staged, s.stage, s.reached = f.select(s.unsettled > 0.5, one, zero), one, f.const(-1.0, DOUBLE, f.width)
    with f.while_(lambda: f.any_of(s.staged > 0.5)):
        is_open = s.staged > 0.5
        s.where(is_open, unsettled=1.0, friction_share=f.min(f.max(s.reached + s.stage, 0.0), 1.0))
        _keep(module, f, "settled", "settled kept", is_open)
        _write_rounds(module, f, s, STAGE_ROUNDS, _fails)
        fails = is_open & (_fails(s.unsettled) | ((s.stage > 1.5 * most) & (s.unsettled > 0.5)))
        _keep(module, f, "settled kept", "settled", fails)
        s.where(is_open & ~fails, reached=s.friction_share)
        s.where(fails, stage=f.min(s.stage * 0.5, most))
        s.where(is_open, unsettled=0.0)
        # It jams with a part of the friction if even short stages do not go on from there.
        goes_on = (s.reached < 1 - least / 2) & (s.stage > 0.75 * least)
        s.staged = f.select(is_open & goes_on, one, zero)


def _keep(module: Memory, f: Function, source: str, to: str, mask: Value):
    with f.each(module.plan.code.scratch["settled"]) as i:
        new, old = (module.entry(f, name, i) for name in (source, to))
        module.put_entry(f, to, i, f.select(mask, new, old))


def _write_rounds(module: Memory, f: Function, s: Lane, most: int, goes_on: Callable[[Value], Value]):
    """Take at most `most` rounds, in lanes as long as `goes_on(unsettled)`; accelerations at `out` are NaN where they fail."""
    k = f.variable(0, INT, 1)
    with f.while_(lambda: f.any_of(goes_on(s.unsettled)) & (k.value < most)):
        before = s.unsettled
        open_ = goes_on(before)
        if f.width > 1:  # a single lane is open here
            _keep(module, f, "settled", "settled before", open_ | ~open_)
        module.invoke(f, FURTHER_ACCELERATIONS, "further a")
        module.copy(f, "further a", "out", open_)
        if f.width > 1:  # other lanes keep theirs: what follows from it must not depend on the lanes beside
            _keep(module, f, "settled before", "settled", ~open_)
        s.unsettled = f.select(open_, s.unsettled, before)
        k.value = k.value + 1


def write_settle_end(module: Memory, f: Function):
    """Write `settle_end`: settle the loads of joints at the end of a step, with its velocities `result v`."""
    module.copy(f, "state v", "saved v")
    module.copy(f, "result v", "state v")
    f.call("settle_state", f.given["work"], f.given["out"])
    module.copy(f, "saved v", "state v")
