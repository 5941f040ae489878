"""Machine code that evaluates a scene at single states: accelerations with the forces of its rows, energies, and its own numbers.

Its functions are called one by one, of addresses in one piece of memory:

    numbers(parameters, numbers)      numbers of the scene that depend on parameters, into the vector of all numbers
    prologue(numbers, work)           the constants of the scene, of its numbers
    accelerations(work, work)         "a", and the solution "x0" of the linear system, of "t", "q" and "v"
    energy(work, work)                "energy", kinetic and potential (J), of "q" and "v"

`places` says where in `work` the arrays of these names are, in numbers; `work` begins with the constants.
"""

from collections.abc import Sequence

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.base.ir import Function
from udkjax.native.base.layout import Layout
from udkjax.native.base.loops import LoopWriter

INPUTS = ("t", "q", "v")


class Evaluation:
    """The text of a module of such functions, of loops whatever the size of the scene: each state is evaluated once."""

    exports = ("prologue", "accelerations", "energy")

    def __init__(self, code: ScenePrograms, further: Sequence[Function] = ()):
        n = code.coordinate_count
        self._code, self._further = code, list(further)
        layout = Layout(1, 1)
        sizes = {"constants": len(code.constants), "t": 1, "q": n, "v": n, "a": n, "safe": 1, "energy": 2}
        for name, count in (sizes | code.scratch).items():
            layout.add(name, count)
        self.places, self.size = layout.places, layout.size

    def text(self) -> str:
        """LLVM's text of the whole module."""
        loops = LoopWriter(1)
        at = {name: ("work", place) for name, place in self.places.items()}
        loops.write(self._code.prologue, "prologue", ("numbers", "work"), at | {"numbers": ("numbers", 0)})
        for name in ("accelerations", "energy"):
            loops.write(getattr(self._code, name), name, ("work", "out"), at)
        functions = [*self._further, *loops.functions]
        declared = sorted(set().union(*(f.declared for f in functions)))
        return "\n".join([*declared, *loops.globals, *(f.text() for f in functions)])
