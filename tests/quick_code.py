"""Machine code that LLVM does not optimize, in a quarter of the time: it rounds alike, and few tests are about its speed."""

from udkjax.native import loaded_code
from udkjax.native.code import machine

_PASSES, _TARGET_MACHINE = machine.PASSES, machine._target_machine


def optimize(yes: bool) -> None:
    """Compile as for users from now on, or quickly; the passes are part of the keys by which code is stored."""
    machine.PASSES = _PASSES if yes else ()
    machine._target_machine = _TARGET_MACHINE if yes else lambda _: _TARGET_MACHINE(machine.QUICK_LEVEL)
    loaded_code.machine_code.cache_clear()
