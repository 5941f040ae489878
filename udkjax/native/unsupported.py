"""Operations that machine code cannot compute."""

from collections import defaultdict

from udkjax.equations.run_programs import RunPrograms
from udkjax.native.base.loops import LoopWriter
from udkjax.native.base.program import UnsupportedError
from udkjax.programs.identity_cache import cached_by_identity


@cached_by_identity
def unsupported(code: RunPrograms) -> str:
    """Return the unsupported operations of a scene; empty if there are none.

    For this check each kernel is written once, in loops; the text that is compiled may be unrolled and much longer.
    """
    loops, at = LoopWriter(1), defaultdict(lambda: ("work", 0))
    try:
        for name in ("prologue", "accelerations", "newton_v_and_psi", *(["pieces"] if code.piece_count else [])):
            loops.write(getattr(code, name), name, ("work",), at)
    except UnsupportedError as error:
        return str(error)
    return ""
