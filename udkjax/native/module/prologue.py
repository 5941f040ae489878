"""Derivatives of the prologue, which computes the constants of a scene from its numbers once for each run. For one member,

    prologue_forward(numbers, constants, dnumbers, dconstants)          tangents of the constants, from those of the numbers
    prologue_reverse(numbers, constants, constants_bar, numbers_bar)    cotangents of the numbers, from those of the constants
    prologue_twice(numbers, constants, dnumbers, enumbers, denumbers, dconstants, econstants, deconstants)

for all numbers and the moving constants. The last function computes the derivatives along two directions, and the mixed ones.
"""

from collections.abc import Sequence

from udkjax.expressions.loops.loop_derivative import COTANGENT, FORWARD, PREFIXES, REVERSE, TWICE, LoopDerivative
from udkjax.expressions.loops.loop_program import LoopProgram, Reset
from udkjax.native.module.module import Module

PROLOGUE_NAMES = {mode: f"prologue_{mode}" for mode in (FORWARD, REVERSE, TWICE)}


def write_prologue_derivative(module: Module, active: Sequence[bool], mode: str):
    """Write the function `PROLOGUE_NAMES[mode]`, the derivative of the prologue with respect to the active numbers."""
    changes = ("constants", "numbers") if mode == REVERSE else ("numbers", "constants")
    pointers = ("numbers", "constants", *(prefix + x for x in changes for prefix in PREFIXES[mode]))
    at = {x: (x, 0) for x in pointers}
    if module.unrolled:
        module.write_scalars(module.unrolled.prologue_derivative(active, mode), PROLOGUE_NAMES[mode], pointers, at, 1)
        return
    derivative = LoopDerivative(module.code.prologue.parts, ())
    if mode == REVERSE:
        parts = [Reset(f"{COTANGENT}numbers", 0, module.code.number_count), *derivative.reverse.parts]
    else:
        parts = (derivative.forward if mode == FORWARD else derivative.second(())).parts
    module.loops.write(LoopProgram(parts), PROLOGUE_NAMES[mode], pointers, at, width=1)
