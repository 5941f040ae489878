"""Derivatives of the prologue: of what a scene's code computes of its numbers alone, once a run. Of one member,

    prologue_forward(numbers, constants, dnumbers, dconstants)          changes of the constants, from those of the numbers
    prologue_reverse(numbers, constants, constants_bar, numbers_bar)    cotangents of the numbers, from those of the constants

of the numbers and constants that move.
"""

from collections.abc import Sequence

from udkjax.equations.loop_programs import LoopPrograms
from udkjax.expressions import ScalarProgram, cotangents, tangents
from udkjax.expressions.loop_derivative import COTANGENT, TANGENT, LoopDerivative
from udkjax.expressions.loop_program import LoopProgram, Reset
from udkjax.native.module import Module
from udkjax.native.program import consecutive, write

FORWARD, REVERSE = "prologue_forward", "prologue_reverse"


def active_constants(code: Module, active: Sequence[bool]) -> tuple[bool, ...]:
    """Which constants depend on numbers that move. Loops do not tell them apart."""
    if isinstance(code.code, LoopPrograms):
        return (any(active),) * code.constants
    return code.code.prologue.depends_on(active)


def write_prologue_forward(t: Module, active: Sequence[bool], constants: Sequence[bool]):
    """Write `prologue_forward`, of the numbers and the constants that are marked."""
    pointers = ("numbers", "constants", "dnumbers", "dconstants")
    if isinstance(t.code, LoopPrograms):
        at = {"numbers": ("numbers", 0), "constants": ("constants", 0)}
        at |= {f"{TANGENT}numbers": ("dnumbers", 0), f"{TANGENT}constants": ("dconstants", 0)}
        t.loops.write(LoopDerivative(t.code.prologue.parts, ()).forward, FORWARD, pointers, at, width=1)
        return
    graph, inputs = t.code.graph, t.code.prologue.inputs
    seeds = {s: graph.input(("number", s.index), "tangent") for s, m in zip(inputs, active, strict=True) if m}
    wanted = [s for s, m in zip(t.code.constants, constants, strict=True) if m]
    program = ScalarProgram(graph, [*inputs, *seeds.values()], tangents(graph, wanted, seeds))
    places = [*consecutive("numbers", len(inputs)), *consecutive("dnumbers", len(seeds))]
    t.functions.append(write(program, FORWARD, 1, pointers, places, consecutive("dconstants", len(wanted))))


def write_prologue_reverse(t: Module, active: Sequence[bool], constants: Sequence[bool]):
    """Write `prologue_reverse`, of the numbers and the constants that are marked."""
    pointers = ("numbers", "constants", "constants_bar", "numbers_bar")
    if isinstance(t.code, LoopPrograms):
        at = {"numbers": ("numbers", 0), "constants": ("constants", 0)}
        at |= {f"{COTANGENT}numbers": ("numbers_bar", 0), f"{COTANGENT}constants": ("constants_bar", 0)}
        reverse = LoopDerivative(t.code.prologue.parts, ()).reverse.parts
        program = LoopProgram([Reset(f"{COTANGENT}numbers", 0, t.code.prologue_input_count), *reverse])
        t.loops.write(program, REVERSE, pointers, at, width=1)
        return
    graph, inputs = t.code.graph, t.code.prologue.inputs
    numbers = [s for s, m in zip(inputs, active, strict=True) if m]
    given = [s for s, m in zip(t.code.constants, constants, strict=True) if m]
    bars = [graph.input(("constant", k), "cotangent") for k in range(len(given))]
    program = ScalarProgram(graph, [*inputs, *bars], cotangents(graph, given, bars, numbers))
    places = [*consecutive("numbers", len(inputs)), *consecutive("constants_bar", len(bars))]
    t.functions.append(write(program, REVERSE, 1, pointers, places, consecutive("numbers_bar", len(numbers))))
