"""Loop programs at states by machine code, which a folder on a higher floor makes: `native/host/state_loops.py`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from udkjax.expressions.loops.loop_program import LoopProgram


class CompiledLoops(Protocol):
    """A program as a function of the address of its constants, and of the arrays that describe a state, by name."""

    def __call__(self, constants: int, given: Mapping[str, np.ndarray | float], /) -> dict[str, Any]: ...


class CompiledAtMany(Protocol):
    """A program as a function of its constants, and of the arrays that describe states by name, each (n, T) or (n, 1)."""

    def __call__(self, constants: np.ndarray, given: Mapping[str, np.ndarray], /) -> dict[str, Any]: ...


# Compiles a program, given the lengths of its arrays except `constants`, and the names of its results; None if it cannot.
LoopCompiler: TypeAlias = Callable[[LoopProgram, Mapping[str, int], Sequence[str]], CompiledLoops | None]
# Compiles one for many states, given the lengths of its own arrays and of those of a state, and the names of its results.
CompilerAtMany: TypeAlias = Callable[[LoopProgram, Mapping[str, int], Mapping[str, int], Sequence[str]], CompiledAtMany | None]
_COMPILERS: list[tuple[LoopCompiler, CompilerAtMany]] = []


def compile_by(compiler: LoopCompiler, at_many: CompilerAtMany) -> None:
    """Compile programs by these functions from now on."""
    _COMPILERS[:] = [(compiler, at_many)]


def compiled_loops(program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]) -> CompiledLoops | None:
    """Return a program by machine code; None if there is no compiler, or if it cannot hold the program."""
    return _COMPILERS[0][0](program, sizes, results) if _COMPILERS else None


def compiled_at_many(
    program: LoopProgram, sizes: Mapping[str, int], given: Mapping[str, int], results: Sequence[str]
) -> CompiledAtMany | None:
    """Return a program at many states by machine code; None if there is no compiler, or if it cannot hold the program."""
    return _COMPILERS[0][1](program, sizes, given, results) if _COMPILERS else None
