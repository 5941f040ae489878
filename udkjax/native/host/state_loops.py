"""Programs of loops at single states by machine code, for questions that Python asks again and again.

A program is one function of two addresses: the constants of a mechanism, and a block of memory with all other arrays. It is
compiled quickly, since a run takes a microsecond.
"""

import ctypes
import re
from collections.abc import Mapping, Sequence
from itertools import accumulate
from threading import Lock

import numpy as np

from udkjax.expressions.loops.compiled_loops import compile_by
from udkjax.expressions.loops.loop_program import LoopProgram
from udkjax.native.code import machine
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import text_of_module

# A product and a sum. The product is rounded first, as by the floats of Python that run the same before it is compiled.
_FUSED = re.compile(r"(%\S+) = call double @llvm\.fmuladd\.f64\(double (\S+), double (\S+), double (\S+)\)")
_ROUNDED = r"\1.product = fmul double \2, \3\n  \1 = fadd double \1.product, \4"


class StateLoops:
    """A program of loops as a function of its constants and of the arrays that describe a state.

    Args:
        program: the program.
        sizes: the lengths of all its arrays except `constants`.
        results: the names of the arrays that are returned.
    """

    def __init__(self, program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]):
        ends = [0, *accumulate(sizes.values())]
        places = dict(zip(sizes, ends, strict=False))
        loops = LoopWriter(1)
        at = {name: ("work", place) for name, place in places.items()} | {"constants": ("constants", 0)}
        loops.write(program, "evaluate", ("constants", "work"), at)
        text = _FUSED.sub(_ROUNDED, text_of_module(loops.functions, loops.globals))
        self._library = machine.library(text, ["evaluate"], machine.QUICK)
        self._run = machine.function(self._library["evaluate"], ctypes.c_void_p, ctypes.c_void_p)
        self._work, self._lock = np.zeros(max(ends[-1], 1)), Lock()
        self._address = self._work.__array_interface__["data"][0]
        self._views = {name: self._work[place : place + sizes[name]] for name, place in places.items()}
        self._results = [(name, self._views[name]) for name in results]

    def __call__(self, constants: int, given: Mapping[str, np.ndarray | float]) -> dict[str, np.ndarray]:
        """Return the results for the address of the constants, in float64, and arrays by name."""
        views = self._views
        with self._lock:
            for name, x in given.items():
                views[name][...] = x
            self._run(constants, self._address)
            return {name: view.copy() for name, view in self._results}


def _compile(program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]) -> StateLoops | None:
    try:
        return StateLoops(program, sizes, results)
    except UnsupportedError:
        return None


def register() -> None:
    """Let programs of loops be compiled that Python runs often at single states."""
    compile_by(_compile)
