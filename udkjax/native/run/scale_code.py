"""Machine code of the characteristic scales of a scene (equations/scale_program.py), of the numbers of members alone."""

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.base.ir import INT, POINTER, Function
from udkjax.native.base.layout import Layout
from udkjax.native.base.loops import LoopWriter
from udkjax.native.base.memory import Memory


class ScaleCode(Memory):
    """The text of a module whose `run` finds the scales of members: in loops whatever the size of the scene, once a run.

    They are cold: optimized they take as long, and twice as long to compile.
    """

    settings = ()
    results = ("scales",)

    def __init__(self, code: ScenePrograms):
        self._code, self.places = code, Layout(1, 1)
        for name, size in (code.scratch | code.scales.sizes).items():
            if name in code.scales.program.arrays:
                self.places.add(name, size)

    def text(self) -> str:
        """LLVM's text of the whole module."""
        loops, size = LoopWriter(1, cold=True), self._code.scale_count
        at = {name: ("work", place) for name, place in self.places.places.items()}
        at |= {"numbers": ("numbers", 0), "scales": ("scales", 0)}
        loops.write(self._code.scales.program, "find_scales", ("numbers", "work", "scales"), at)
        f = Function("run", [(POINTER, "call")])
        block, work = self.allocate(f, f.const(self.places.size, INT))
        members, following = self.field(f, "members"), self.field(f, "next", POINTER)

        def take():
            return f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)

        member = f.variable(take(), INT)
        with f.while_(lambda: member.value < members):
            numbers, to = self.member_address(f, "numbers", member.value), self.result_address(f, "scales", member.value, size)
            f.call("find_scales", numbers, work, to)
            member.value = take()
        f.line(f"call void @free(ptr {block.name})")
        functions = [*loops.functions, f]
        declared = sorted(set().union(*(x.declared for x in functions)) | {"declare ptr @malloc(i64)", "declare void @free(ptr)"})
        return "\n".join([*declared, *loops.globals, *(x.text() for x in functions)])
