"""Machine code that runs loop programs at given states, made by compilers that `native/host/state_loops.py` registers here.

That folder is on a higher floor, so that it cannot be imported here.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from udkjax.expressions.loops.loop_program import LoopProgram


class CompiledLoops(Protocol):
    """Machine code of a program at one state, which returns the resulting arrays by name.

    Its arguments are the address in memory of the array `constants`, and the arrays that describe the state, by name.
    """

    def __call__(self, constants: int, given: Mapping[str, np.ndarray | float], /) -> dict[str, Any]: ...


class CompiledAtMany(Protocol):
    """Machine code of a program at T states, which returns the resulting arrays (n, T) by name.

    Its arguments are the array `constants`, and the arrays that describe the states, by name, each (n, T) or (n, 1).
    """

    def __call__(self, constants: np.ndarray, given: Mapping[str, np.ndarray], /) -> dict[str, Any]: ...


# Compiles a program, given the lengths of its arrays except `constants`, and the names of its results; None if it cannot.
LoopCompiler: TypeAlias = Callable[[LoopProgram, Mapping[str, int], Sequence[str]], CompiledLoops | None]
# Compiles one for many states, given the lengths of its own arrays and of those of a state, and the names of its results.
CompilerAtMany: TypeAlias = Callable[[LoopProgram, Mapping[str, int], Mapping[str, int], Sequence[str]], CompiledAtMany | None]
_COMPILERS: list[tuple[LoopCompiler, CompilerAtMany]] = []


def compile_by(compiler: LoopCompiler, at_many: CompilerAtMany) -> None:
    """Register the functions that compile programs for one state and for many, in place of earlier ones."""
    _COMPILERS[:] = [(compiler, at_many)]


def compiled_loops(program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]) -> CompiledLoops | None:
    """Return machine code of a program for one state; None if there is no compiler, or if it does not support the program."""
    return _COMPILERS[0][0](program, sizes, results) if _COMPILERS else None


def compiled_at_many(
    program: LoopProgram, sizes: Mapping[str, int], given: Mapping[str, int], results: Sequence[str]
) -> CompiledAtMany | None:
    """Return machine code of a program for many states; None if there is no compiler, or if it does not support the program."""
    return _COMPILERS[0][1](program, sizes, given, results) if _COMPILERS else None
