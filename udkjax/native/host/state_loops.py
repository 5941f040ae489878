"""Loop programs evaluated at states by machine code, for functions that Python calls again and again.

A program is one function of two addresses: the constants of a mechanism, and a block of memory with all other arrays. For single
states it is compiled quickly, since a run takes a microsecond; for many, in lanes and with optimization.
"""

import ctypes
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate, pairwise
from threading import Lock
from typing import Any, TypeVar

import numpy as np

from udkjax.expressions.loops.compiled_loops import compile_by
from udkjax.expressions.loops.loop_program import LoopProgram
from udkjax.native.code import machine, processor
from udkjax.native.language.ir import INT, POINTER, Function
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.program import UnsupportedError
from udkjax.native.language.text import text_of_module

# A product and a sum. The product is rounded first, as by the floats of Python that run the same before it is compiled.
_FUSED_MULTIPLY_ADD = re.compile(r"(%\S+) = call double @llvm\.fmuladd\.f64\(double (\S+), double (\S+), double (\S+)\)")
_ROUNDED_MULTIPLY_ADD = r"\1.product = fmul double \2, \3\n  \1 = fadd double \1.product, \4"


class StateLoops:
    """A loop program as machine code: a function of its constants and of the arrays that describe one state.

    Args:
        program: the program.
        sizes: the lengths of all its arrays except `constants`.
        results: the names of the arrays that are returned.
    """

    def __init__(self, program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]):
        lengths = {**{name: sizes[name] for name in results}, **sizes}  # the results come first, to be copied together
        ends = [0, *accumulate(lengths.values())]
        places = dict(zip(lengths, ends, strict=False))
        loops = LoopWriter(1)
        at = {name: ("work", place) for name, place in places.items()} | {"constants": ("constants", 0)}
        loops.write(program, "evaluate", ("constants", "work"), at)
        text = _FUSED_MULTIPLY_ADD.sub(_ROUNDED_MULTIPLY_ADD, text_of_module(loops.functions, loops.globals))
        self._library = machine.library(text, ["evaluate"], machine.QUICK_LEVEL)
        self._run = machine.function(self._library["evaluate"], ctypes.c_void_p, ctypes.c_void_p)
        self._work, self._lock = np.zeros(max(ends[-1], 1)), Lock()
        self._address = self._work.__array_interface__["data"][0]
        self._views = {name: self._work[place : place + sizes[name]] for name, place in places.items()}
        self._found = self._work[: ends[len(results)]]
        self._results = [(name, slice(*ends[k : k + 2])) for k, name in enumerate(results)]

    def __call__(self, constants: int, given: Mapping[str, np.ndarray | float]) -> dict[str, np.ndarray]:
        """Return the results by name, for the address of float64 constants and for the arrays `given` by name."""
        views = self._views
        with self._lock:
            for name, x in given.items():
                views[name][...] = x
            self._run(constants, self._address)
            found = self._found.copy()
        return {name: found[place] for name, place in self._results}


class LoopsAtMany:
    """A loop program as machine code in lanes: a function of its constants and of the arrays that describe many states.

    Args:
        program: the program.
        sizes: the lengths of all its arrays except `constants` and those of `given`.
        given: the lengths of the arrays that describe a state.
        results: the names of the arrays that are returned.
    """

    def __init__(self, program: LoopProgram, sizes: Mapping[str, int], given: Mapping[str, int], results: Sequence[str]):
        lengths = {**sizes, **given}
        places = dict(zip(lengths, [0, *accumulate(lengths.values())], strict=False))
        self._given, self._results = _rows_of(given), _rows_of({name: lengths[name] for name in results})
        self._width, self._lock = processor.lanes(), Lock()
        loops = LoopWriter(self._width)
        at = {name: ("work", place) for name, place in places.items()} | {"constants": ("constants", 0)}
        loops.write(program, "evaluate", ("constants", "work"), at)
        text = text_of_module([*loops.functions, self._write(places)], loops.globals)
        self._library = machine.library(text, ["evaluate_all"])
        self._run = machine.function(self._library["evaluate_all"], *[ctypes.c_void_p] * 4, ctypes.c_int64)
        self._work = np.zeros(sum(lengths.values()) * self._width)

    def _write(self, places: Mapping[str, int]) -> Function:
        """Write `evaluate_all(constants, work, given, found, blocks)`, whose arrays have a row for each number of a state."""
        width, arguments = self._width, [(POINTER, x) for x in ("constants", "work", "given", "found")]
        f = Function("evaluate_all", [*arguments, (INT, "blocks")], width)
        work, stride = f.given["work"], f.given["blocks"] * width
        with f.each(f.given["blocks"]) as k:
            for name, rows in self._given.items():
                with f.each(rows.stop - rows.start) as i:
                    x = f.load(f.given["given"], (i + rows.start) * stride + k * width, width)
                    f.store(x, work, (i + places[name]) * width, width)
            f.call("evaluate", f.given["constants"], work)
            for name, rows in self._results.items():
                with f.each(rows.stop - rows.start) as i:
                    x = f.load(work, (i + places[name]) * width, width)
                    f.store(x, f.given["found"], (i + rows.start) * stride + k * width, width)
        return f

    def __call__(self, constants: np.ndarray, given: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the results (..., T) by name, for float64 constants and the arrays `given`, (..., T) or (..., 1), by name."""
        count = max(x.shape[1] for x in given.values())
        blocks = -(-count // self._width)
        states, found = (np.empty((_count(rows), blocks * self._width)) for rows in (self._given, self._results))
        for name, rows in self._given.items():
            states[rows, :count], states[rows, count:] = given[name], given[name][:, :1]
        in_lanes = np.repeat(constants, self._width)
        with self._lock:
            self._run(*[x.__array_interface__["data"][0] for x in (in_lanes, self._work, states, found)], blocks)
        return {name: found[rows, :count] for name, rows in self._results.items()}


def _rows_of(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return the range of rows of each array in a matrix in which arrays of these sizes stand below each other."""
    ends = [0, *accumulate(sizes.values())]
    return {name: slice(*rows) for name, rows in zip(sizes, pairwise(ends), strict=True)}


def _count(rows: Mapping[str, slice]) -> int:
    return max((x.stop for x in rows.values()), default=0)


Compiled = TypeVar("Compiled")


def _if_supported(compiler: Callable[..., Compiled]) -> Callable[..., Compiled | None]:
    """Return the compiler changed to return None for a program that machine code does not support."""

    def compiled(*arguments: Any) -> Compiled | None:
        try:
            return compiler(*arguments)
        except UnsupportedError:
            return None

    return compiled


def register() -> None:
    """Register the compilers of loop programs, `StateLoops` and `LoopsAtMany`, for programs that Python runs often."""
    compile_by(_if_supported(StateLoops), _if_supported(LoopsAtMany))
