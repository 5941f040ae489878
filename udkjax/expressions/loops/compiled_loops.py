"""Loop programs at single states by machine code, which a folder on a higher floor makes: `native/host/state_loops.py`."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np

from udkjax.expressions.loops.loop_program import LoopProgram


class CompiledLoops(Protocol):
    """A program as a function of the address of its constants, and of the arrays that describe a state, by name."""

    def __call__(self, constants: int, given: Mapping[str, np.ndarray | float], /) -> dict[str, Any]: ...


# Compiles a program, given the lengths of its arrays except `constants`, and the names of its results; None if it cannot.
LoopCompiler: TypeAlias = Callable[[LoopProgram, Mapping[str, int], Sequence[str]], CompiledLoops | None]
_COMPILERS: list[LoopCompiler] = []


def compile_by(compiler: LoopCompiler) -> None:
    """Compile programs by a function from now on."""
    _COMPILERS[:] = [compiler]


def compiled_loops(program: LoopProgram, sizes: Mapping[str, int], results: Sequence[str]) -> CompiledLoops | None:
    """Return a program by machine code; None if there is no compiler, or if it cannot hold the program."""
    return _COMPILERS[0](program, sizes, results) if _COMPILERS else None
