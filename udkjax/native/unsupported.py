"""Operations that machine code cannot compute."""

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.expressions.loops.loop_program import Reset
from udkjax.native.language.ir import Function
from udkjax.native.language.program import UnsupportedError, Writer
from udkjax.native.module.programs import PROGRAMS
from udkjax.programs.identity_cache import cached_by_identity


@cached_by_identity
def unsupported(code: RunPrograms) -> str:
    """Return a message that names an operation of a scene's programs without machine code; "" if all of them have machine code.

    Only operations that are not arithmetic are checked, once for each kernel of the programs.
    """
    names = ("accelerations", "newton_v_and_psi", *(["pieces"] if code.piece_count else []))
    programs = [code.prologue, *(code.of(*PROGRAMS[name].outputs) for name in names)]
    parts = [part for program in programs for part in program.parts if not isinstance(part, Reset)]
    try:
        for program in {id(part.kernel): part.kernel.program for part in parts}.values():
            Writer(Function("check", [], 1), program).check()
    except UnsupportedError as error:
        return str(error)
    return ""
