"""The functions of the derivatives of a scene's programs, unrolled or as loops.

For the accelerations (no suffix), for the projection of a state on the manifold ("_projection") and for the corrections that
close a mechanism ("_newton_q", "_newton_v") the functions are

    evaluation(work, out, stored)   the results, and the intermediate results that derivatives need
    forward(work, stored, tangent, out)   the tangents of the results, from those of the constants and the state in `tangent`
    twice(work, stored, tangent, out)     the same along two directions and along both, in three consecutive tangents
    reverse(work, stored, bar)      `bar constants` and `bar state`, from the cotangents of the results

The slopes of the accelerations ("_slopes") are their derivatives by the state alone, for implicit methods, in any module.

All programs except the accelerations write tangents to `result` of a tangent, and read cotangents from `bar result`.
"""

from collections.abc import Sequence

from udkjax.equations.programs.differentiable_programs import DifferentiableProgram
from udkjax.expressions.loops.loop_derivative import COTANGENT, FORWARD, PREFIXES, TWICE
from udkjax.expressions.loops.loop_program import LoopProgram, Reset
from udkjax.native.language.program import PointerPlace
from udkjax.native.module.layout import Layout
from udkjax.native.module.module import Module
from udkjax.native.module.programs import DIFFERENTIATED_OUTPUTS

SLOPES_SUFFIX = "slopes"  # suffix of the functions of the slopes of the accelerations
WAYS = ("d", "e", "de")  # derivatives along two directions and along both, one in each of three tangents
GIVEN_DIRECTIONS = ("d", "e")  # directions of numbers and of initial states, whose second derivatives are zero


class ProgramDerivative:
    """The writer of one of the scene's differentiable programs, and of its derivative, as functions of a module."""

    stored_size: int
    """The number of intermediate results that its derivatives need."""

    def __init__(self, module: Module, name: str, evaluation: str = "evaluation", slopes: Layout | None = None):
        """Prepare the program, and reserve the memory that its derivative needs.

        Args:
            module: The module.
            name: The program, of `DIFFERENTIATED_OUTPUTS`.
            evaluation: The name of the function that evaluates it, without its suffix.
            slopes: The layout of the tangent, for the derivatives by the state alone; None: the mode and layout of the module.
        """
        self._module, self._name = module, name if slopes is None else SLOPES_SUFFIX
        self._suffix = "" if self._name == "accelerations" else f"_{self._name}"
        self._evaluation = evaluation + self._suffix
        self._mode, self._tangent = (module.mode, None) if slopes is None else (FORWARD, slopes)
        code = module.code if slopes is None else module.code.for_derivatives
        self._evaluated: DifferentiableProgram = code.differentiable.of(*DIFFERENTIATED_OUTPUTS[name])
        self._fixed = [] if module.moving and slopes is None else ["constants"]
        self._stored: dict[str, int] = {}  # offsets of the arrays of loops
        self.stored_size = 0
        if module.unrolled:
            self._unrolled = (
                module.unrolled.derivative(*DIFFERENTIATED_OUTPUTS[name]) if slopes is None else module.unrolled.slopes
            )
            self.stored_size = sum(x == "stored" for x, _ in self._unrolled.evaluation.outputs)
            return
        parts = self._evaluated.second_parts if self._mode == TWICE else self._evaluated.parts
        used = self._evaluated.program.arrays | LoopProgram(parts).arrays
        for x, count in module.code.stored_sizes.items():
            if x in used:
                self._stored[x] = self.stored_size
                self.stored_size += count
        if "along" not in module.places.places:  # tangents or cotangents of stored values, shared by all such programs
            module.places.add("along", len(PREFIXES[module.mode]) * sum(module.code.stored_sizes.values()))

    def place(self, name: str) -> int:
        """Return the offset of an array of intermediate results at the pointer `stored`, for programs as loops."""
        return self._stored[name]

    @property
    def _at(self) -> dict[str, PointerPlace]:
        stored_arrays = {x: ("stored", place) for x, place in self._stored.items()}
        return self._module.arrays | stored_arrays | {"stored": ("stored", 0)}

    def _along(self, prefixes: Sequence[str]) -> dict[str, PointerPlace]:
        if self._module.unrolled:
            return {}
        start, size = self._module.places["along"], sum(self._module.code.stored_sizes.values())
        return {
            prefix + x: ("work", start + k * size + place)
            for k, prefix in enumerate(prefixes)
            for x, place in self._stored.items()
        }

    def evaluation(self):
        at = self._at | {"a": ("out", 0)}
        pointers, name = ("work", "out", "stored"), self._evaluation
        if self._module.unrolled:
            self._module.write_scalars(self._unrolled.evaluation, name, pointers, at)
        else:
            self._module.loops.write(self._evaluated.program, name, pointers, at)

    def forward(self):
        """Write the function `forward` or `twice`, after the mode of the module; for slopes, always `forward`."""
        w = self._tangent or self._module.tangents
        changes = {"constants": "constants", "q": "state q", "v": "state v", "q1": "result q", "v1": "result v"}
        prefixes, program = PREFIXES[self._mode], self._evaluated.in_mode(self._mode, self._fixed)
        at = self._at | self._along(prefixes)
        for k, prefix in enumerate(prefixes):
            at |= {prefix + x: ("tangent", w[place] + k * w.size) for x, place in changes.items() if place in w.places}
            at[f"{prefix}a"] = ("out", k * w.size)
        self._write(program, f"{self._mode}{self._suffix}", ("work", "stored", "tangent", "out"), at)

    def reverse(self):
        module, p = self._module, self._module.places
        bars = {"constants": "bar constants", "q": "bar state q", "v": "bar state v", "q1": "bar result q", "v1": "bar result v"}
        prefixes, program = PREFIXES[module.mode], self._evaluated.in_mode(module.mode, self._fixed)
        at = self._at | self._along(prefixes) | {COTANGENT + x: ("work", p[place]) for x, place in bars.items()}
        counts = {x: module.code.stored_sizes[x] for x in self._stored} | {
            "constants": len(module.moving),
            "q": module.n,
            "v": module.n,
        }
        cleared = [Reset(COTANGENT + x, 0, count) for x, count in counts.items() if x not in ("q1", "v1")]
        program = LoopProgram([*cleared, *program.parts])
        self._write(program, f"reverse{self._suffix}", ("work", "stored", "bar"), at | {f"{COTANGENT}a": ("bar", 0)})

    def _write(self, program: LoopProgram, name: str, pointers: tuple[str, ...], at: dict[str, PointerPlace]):
        if self._module.unrolled:
            self._module.write_scalars(self._unrolled.derivative, name, pointers, at, tangent=self._tangent)
        else:
            self._module.loops.write(program, name, pointers, at)
