"""Programs of loops, run row by row by NumPy: what machine code of them is held against."""

from typing import Any

import numpy as np

from udkjax.expressions.loop_program import ADD, LEAST, Clear, Loop, LoopProgram, Slot


def run(program: LoopProgram, arrays: dict[str, np.ndarray]) -> None:
    """Run a program on some arrays, in place."""
    for part in program.parts:
        if isinstance(part, Clear):
            arrays[part.array][part.start : part.start + part.count] = part.value
            continue
        kernel = part.kernel
        for row in part.table:

            def at(slot: Slot, row: Any = row, part: Loop = part) -> tuple[np.ndarray, int]:
                return arrays[part.array(slot.array)], slot.offset + (0 if slot.base is None else int(row[slot.base]))

            def read(slot: Slot) -> float:
                array, place = at(slot)
                return float(array[place])

            values = [
                read(slot) if kernel.program.uses(s) else 0.0
                for s, slot in zip(kernel.program.inputs, kernel.inputs, strict=True)
            ]
            for value, slot in zip(kernel.program(values), kernel.outputs, strict=True):
                array, place = at(slot)
                how = {ADD: np.add, LEAST: np.fmin}.get(slot.how, lambda old, new: new)
                array[place] = how(array[place], float(value))
