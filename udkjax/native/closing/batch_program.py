"""Machine code of a straight-line program for batches: W members of arrays (numbers, members) at a time."""

import ctypes

import numpy as np

from udkjax.expressions import ScalarProgram
from udkjax.native.code import machine, processor
from udkjax.native.language.ir import INT, POINTER, Function
from udkjax.native.language.program import Writer, from_memory
from udkjax.native.language.text import text_of_module


class BatchProgram:
    """A program of scalars, compiled, and evaluated for M members on the calling thread.

    Args:
        program: the program. Its first inputs differ between members, its last ones may be shared.
        shared: the number of its last inputs that are the same for all members.
    """

    def __init__(self, program: ScalarProgram, shared: int = 0):
        self.program, self.width = program, processor.lanes()
        self._input_count = len(program.inputs) - shared
        f = self._write()
        self._library = machine.library(text_of_module([f]), (f.name,))
        self._run = machine.function(self._library[f.name], *[ctypes.c_void_p] * 3, ctypes.c_int64)

    def __call__(self, members: np.ndarray, shared: np.ndarray | None = None) -> np.ndarray:
        """Return the outputs (outputs, M) for the inputs of members (inputs, M) and the shared inputs (shared,)."""
        count = members.shape[1]
        padded = -(-count // self.width) * self.width
        inputs = np.empty((self._input_count, padded))
        inputs[:, :count], inputs[:, count:] = members, members[:, -1:]
        shared_inputs = np.ascontiguousarray(np.zeros(1) if shared is None else shared, float)
        outputs = np.empty((len(self.program.outputs), padded))
        self._run(inputs.ctypes.data, shared_inputs.ctypes.data, outputs.ctypes.data, padded)
        return outputs[:, :count]

    def _write(self) -> Function:
        f = Function("run", [(POINTER, "members"), (POINTER, "shared"), (POINTER, "found"), (INT, "count")], self.width)
        count = f.given["count"]
        with f.each(count / self.width) as block:
            first, writer = block * self.width, Writer(f, self.program)
            for k, s in enumerate(self.program.inputs):
                if not self.program.uses(s):
                    continue
                if k < self._input_count:
                    x = f.load(f.given["members"], count * k + first, self.width)
                else:
                    x = f.repeat(f.load(f.given["shared"], k - self._input_count), self.width)
                writer.values[s.index] = from_memory(f, x, s.node.dtype)
            for k, value in enumerate(writer.run()):
                f.store(value, f.given["found"], count * k + first, self.width)
        return f
