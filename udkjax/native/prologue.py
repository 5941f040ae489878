"""Derivatives of the prologue: of what a scene's code computes of its numbers alone, once a run. Of one member,

    prologue_forward(numbers, constants, dnumbers, dconstants)          changes of the constants, from those of the numbers
    prologue_reverse(numbers, constants, constants_bar, numbers_bar)    cotangents of the numbers, from those of the constants

of all numbers, and of the constants that move.
"""

from collections.abc import Sequence

from udkjax.expressions.loop_derivative import COTANGENT, TANGENT, LoopDerivative
from udkjax.expressions.loop_program import LoopProgram, Reset
from udkjax.native.module import Module

FORWARD, REVERSE = "prologue_forward", "prologue_reverse"


def write_prologue_derivative(module: Module, active: Sequence[bool], reverse: bool):
    """Write `prologue_forward` or `prologue_reverse`, along the numbers that are active."""
    name, prefix = (REVERSE, COTANGENT) if reverse else (FORWARD, TANGENT)
    further = ("constants_bar", "numbers_bar") if reverse else ("dnumbers", "dconstants")
    pointers, changes = ("numbers", "constants", *further), ("constants", "numbers") if reverse else ("numbers", "constants")
    at = {x: (x, 0) for x in ("numbers", "constants")}
    at |= {prefix + x: (pointer, 0) for x, pointer in zip(changes, further, strict=True)}
    if module.written_out:
        module.write_scalars(module.written_out.prologue_derivative(active, reverse), name, pointers, at, 1)
        return
    derivative = LoopDerivative(module.code.prologue.parts, ())
    parts = (
        [Reset(f"{COTANGENT}numbers", 0, module.code.number_count), *derivative.reverse.parts]
        if reverse
        else derivative.forward.parts
    )
    module.loops.write(LoopProgram(parts), name, pointers, at, width=1)
