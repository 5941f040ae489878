"""The functions of the derivatives of a scene's programs, written out or as loops.

For the accelerations (no suffix) and for the projection of a state on the manifold (`_projection`) there are three,

    evaluation(work, out, stored)   what it returns, and what its derivatives know of the state in X
    forward(work, stored, tangent, out)   the change of what it returns, from those of the constants, of X q and X v of a tangent
    reverse(work, stored, bar)      the cotangents G of the constants, q and v, from those of what it returns

where the projection has no `out` to begin with, leaves its changes in O of a tangent, and finds its cotangents in Y. So have the
corrections that close a mechanism, of its `position` and of its `velocity`, as loops.
"""

from typing import Any, Protocol

from udkjax.equations.implicit_derivative import acceleration_derivative, projection_derivative
from udkjax.equations.loop_programs import DifferentiableProgram, LoopPrograms
from udkjax.expressions.loop_derivative import COTANGENT, TANGENT
from udkjax.expressions.loop_program import LoopProgram, Reset
from udkjax.native.program import Place, consecutive

SUFFIXES = {"accelerations": "", "projection": "_projection", "position": "_position", "velocity": "_velocity"}


class Linearized(Protocol):
    """One of the programs with its derivative, in a trajectory that has `count` constants that move."""

    stored: int  # how many numbers its derivatives know of a state

    def evaluation(self) -> None:
        """Write the function."""
        ...

    def forward(self) -> None:
        """Write the function."""
        ...

    def reverse(self) -> None:
        """Write the function."""
        ...


def linearization(trajectory: Any, name: str) -> Linearized:
    """The one or the other, as the code of a trajectory is."""
    return (ByLoops if isinstance(trajectory.code, LoopPrograms) else StraightLine)(trajectory, name)


class StraightLine:
    """Straight-line code."""

    def __init__(self, trajectory: Any, name: str):
        self._in, self._name, self._suffix = trajectory, name, SUFFIXES[name]
        derivative = acceleration_derivative if name == "accelerations" else projection_derivative
        self._derivative = derivative(trajectory.code, (*trajectory.active, False, True, True))  # the constants, t, q, v
        self.stored = len(self._derivative.stored)

    def evaluation(self):
        t = self._in
        pointers, outputs = ("work", "stored"), consecutive("stored", self.stored)
        if self._name == "accelerations":
            pointers, outputs = ("work", "out", "stored"), [*consecutive("out", t.n), *t.work_places("safe", 1), *outputs]
        t.write_program(self._derivative.evaluation, f"evaluation{self._suffix}", pointers, t.state_places(), outputs)

    def forward(self):
        t, w = self._in, self._in.tangents

        def tangent(name: str, count: int) -> list[Place]:
            return [("tangent", w[name] + k) for k in range(count)]

        tangents = [*tangent("constants", t.count), *tangent("X q", t.n), *tangent("X v", t.n)]
        outputs = consecutive("out", t.n) if self._name == "accelerations" else [*tangent("O q", t.n), *tangent("O v", t.n)]
        inputs = [*t.state_places(), *consecutive("stored", self.stored), *tangents]
        t.write_program(self._derivative.forward, f"forward{self._suffix}", ("work", "stored", "tangent", "out"), inputs, outputs)

    def reverse(self):
        t = self._in
        found = [*t.work_places("G c", t.count), *t.work_places("G q", t.n), *t.work_places("G v", t.n)]
        pointers, bars = ("work", "stored"), [*t.work_places("Y q", t.n), *t.work_places("Y v", t.n)]
        if self._name == "accelerations":
            pointers, bars = ("work", "stored", "bar"), consecutive("bar", t.n)
        inputs = [*t.state_places(), *consecutive("stored", self.stored), *bars]
        t.write_program(self._derivative.reverse, f"reverse{self._suffix}", pointers, inputs, found)


def _differentiable(programs: LoopPrograms, name: str) -> DifferentiableProgram:
    return {
        "accelerations": lambda: programs.differentiable_accelerations,
        "projection": lambda: programs.differentiable_projection,
        "position": lambda: programs.differentiable_newton_q,
        "velocity": lambda: programs.differentiable_newton_v,
    }[name]()


class ByLoops:
    """Loops, which keep all arrays that they leave behind."""

    def __init__(self, trajectory: Any, name: str):
        self._in, self._name, self._suffix = trajectory, name, SUFFIXES[name]
        self._evaluated = _differentiable(trajectory.code, name)
        self._derivative = self._evaluated.derivative([] if trajectory.count else ["constants"])
        used = self._evaluated.program.arrays
        self._sizes = {x: count for x, count in trajectory.code.stored_sizes.items() if x in used}
        self._at: dict[str, Place] = {}
        self.stored, places = 0, trajectory.places
        for x, count in self._sizes.items():
            self._at[x] = ("stored", self.stored)
            self.stored += count
        if "along" not in places.places:  # changes or cotangents of what is stored, of both programs
            places.add("along", sum(trajectory.code.stored_sizes.values()))
        names = {"t": "X t", "q": "X q", "v": "X v", "constants": "constants", "safe": "safe"}
        self._at |= {x: ("work", places[place]) for x, place in names.items()}

    def place(self, name: str) -> int:
        """Where an array begins in what is stored."""
        return self._at[name][1]

    def write_program(self, program: LoopProgram, name: str, pointers: tuple[str, ...], at: dict[str, Place]):
        self._in.loops.write(program, f"{name}{self._suffix}", pointers, at)

    def _along(self, prefix: str) -> dict[str, Place]:
        start = self._in.places["along"]
        return {prefix + x: ("work", start + place) for x, (pointer, place) in self._at.items() if pointer == "stored"}

    def evaluation(self):
        pointers = ("work", "out", "stored") if self._name == "accelerations" else ("work", "stored")
        self.write_program(self._evaluated.program, "evaluation", pointers, self._at | {"a": ("out", 0)})

    def forward(self):
        w = self._in.tangents
        changes = {"constants": "constants", "q": "X q", "v": "X v", "q1": "O q", "v1": "O v"}
        at = self._at | {"a": ("out", 0)} | self._along(TANGENT)
        at |= {TANGENT + x: ("tangent", w[place]) for x, place in changes.items()} | {f"{TANGENT}a": ("out", 0)}
        self.write_program(self._derivative.forward, "forward", ("work", "stored", "tangent", "out"), at)

    def reverse(self):
        t, p = self._in, self._in.places
        found = {"constants": "G c", "q": "G q", "v": "G v", "q1": "Y q", "v1": "Y v"}
        at = self._at | self._along(COTANGENT) | {COTANGENT + x: ("work", p[place]) for x, place in found.items()}
        counts = self._sizes | {"constants": t.count, "q": t.n, "v": t.n}
        cleared = [Reset(COTANGENT + x, 0, count) for x, count in counts.items() if x not in ("q1", "v1")]
        pointers = ("work", "stored")
        if self._name == "accelerations":
            pointers, at = ("work", "stored", "bar"), at | {"a": ("bar", 0), f"{COTANGENT}a": ("bar", 0)}
        self.write_program(LoopProgram([*cleared, *self._derivative.reverse.parts]), "reverse", pointers, at)
