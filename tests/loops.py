"""Programs of loops, run row by row by NumPy: what machine code of them is held against."""

from typing import Any

import numpy as np

from udkjax.expressions.loops.loop_program import ADD, ALL, MAXIMUM, Address, KernelLoop, LoopProgram, Reset


def run(program: LoopProgram, arrays: dict[str, np.ndarray]) -> None:
    """Run a program on some arrays, in place."""
    for part in program.parts:
        if isinstance(part, Reset):
            arrays[part.array][part.start : part.start + part.count] = part.value
            continue
        kernel = part.kernel
        for row in part.table:

            def at(slot: Address, row: Any = row, part: KernelLoop = part) -> tuple[np.ndarray, int]:
                return arrays[part.array(slot.array)], slot.offset + (0 if slot.base is None else int(row[slot.base]))

            def read(slot: Address) -> float:
                array, place = at(slot)
                return float(array[place])

            values = [
                read(slot) if kernel.program.uses(s) else 0.0
                for s, slot in zip(kernel.program.inputs, kernel.inputs, strict=True)
            ]
            for value, slot in zip(kernel.program(values), kernel.outputs, strict=True):
                array, place = at(slot)
                how = {ADD: np.add, MAXIMUM: np.fmax, ALL: np.fmin}.get(slot.update, lambda old, new: new)
                array[place] = how(array[place], float(value))
