"""Machine code of functions of single states, for other integrators, in batches.

StateAccelerations    accelerations of a state, by elimination or a dense method; by the fallback if pivots are too small
StateReactions        multipliers of least norm, and the entries of Psi_q
StateProjection       q and v projected onto the constraint manifold
StateJump             the same after an event, and the largest remaining violation of Psi_dot
StateTangentPart      the tangent part of small changes of q and v
Evaluation            accelerations with multipliers, and energies, for pages
ScaleCode             the characteristic scales (equations/terms/scale_program.py), from the numbers of a scene
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.native.language.ir import DOUBLE, INT, POINTER, Function, Value
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.text import ALLOCATION_DECLARATIONS, text_of_module
from udkjax.native.module.layout import Lane, Layout, Plan
from udkjax.native.module.memory import Memory, ThreadCode
from udkjax.native.module.steps import ROUNDING_PIVOT
from udkjax.native.module.tableau import EULER
from udkjax.native.parts.dense_equations import DenseEquations
from udkjax.native.parts.formulations import FormulationCode
from udkjax.native.parts.manifold import largest_violation, with_threshold
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.run.members import write_begin
from udkjax.native.run.trajectory import Trajectory


class StateFunction(Trajectory):
    """The text of a module whose `run` evaluates members at their states q and v at the time ts[0]."""

    closes = False
    unrolls = True  # whether the programs of small scenes are unrolled: a loop takes longer to run, and less time to compile
    settings = ("length", "fallback_tol", "method")
    results = ("found",)
    found: ClassVar[tuple[str, ...]]  # arrays of coordinates that are returned, concatenated

    def __init__(
        self, code: RunPrograms, pseudoinverse: DenseMethod | None, formulation: FormulationCode | None, width: int, vector: int
    ):
        super().__init__(
            Plan(
                code,
                EULER,
                projected=True,
                breaks=False,
                width=width,
                vector=vector,
                unrolled=code.is_small and (self.unrolls or not code.has_loops),
                pseudoinverse=pseudoinverse,
                formulation=formulation,
            )
        )

    @property
    def counts(self) -> dict[str, int]:
        """The sizes of the arrays that are returned, by name, in the order of the output."""
        return dict.fromkeys(self.found, self.n)

    def write_functions(self):
        self.write_programs()
        self.fallback.write()
        write_begin(self)
        f, s = self.function("evaluate_states", [(POINTER, "work"), (POINTER, "call")])
        with f.each(self.n) as i:
            for x in "qv":
                self.put_entry(f, f"state {x}", i, self.entry(f, f"point3 {x}", i))
        setattr(s, "state t", s.start)
        self._evaluate(f, s)
        self.write_found(f, s)

    def write_found(self, f: Function, s: Lane):
        """Store the arrays named in `counts`, of the members in all lanes, in the output "found"."""
        counts, start = self.counts, 0
        with self.each_lane(f, s.active) as k:
            to = self.result_address(f, "found", self.to_int(f, f.lane(s.member, k)), sum(counts.values()))
            for name, count in counts.items():
                self.copy_lane(f, to, start, name, k, count=count)
                start += count

    @abstractmethod
    def _evaluate(self, f: Function, s: Lane):
        """Hook: add code that computes the arrays named in `counts`, at the state of each lane (`state t`, `q` and `v`)."""

    def step_all(self, f: Function, s: Lane, fill):
        """Evaluate the members in all lanes, and load the next members."""
        f.call("evaluate_states", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, f.width)
        fill()


class StateAccelerations(StateFunction):
    """The evaluation of the accelerations of states, as `result a`."""

    found = ("result a",)

    @property
    def solving(self) -> list[str]:
        return ["accelerations"]

    def _evaluate(self, f: Function, s: Lane):
        self.accelerations.accelerate_state(f, s)


class StateReactions(StateAccelerations):
    """The multipliers lambda = -W (D^+)^T D^+ W b of least norm, by a dense method, in `psi`, and the entries of Psi_q."""

    @property
    def counts(self) -> dict[str, int]:
        return {"psi": self.m, "psi_q": self.code.scratch["psi_q"]}

    def _evaluate(self, f: Function, s: Lane):
        super()._evaluate(f, s)
        assert isinstance(self.accelerations, DenseEquations)
        rows = self.accelerations.rows
        y = rows.solve_transposed(f)
        with f.each(self.m) as i:
            self.put_entry(f, "psi", i, -(y.entry(i) * rows.array(f, "weights", i)))


class StateProjection(StateFunction):
    """The projection of states onto the constraint manifold, as `state q` and `result v`."""

    closes = True
    unrolls = False
    found = ("state q", "result v")

    @property
    def solving(self) -> list[str]:
        return [name for name in super().solving if name in ("newton_q", "newton_v_and_psi", "project")]

    def _evaluate(self, f: Function, s: Lane):
        s.due = s.active
        self.projection.project_output(f, s, s.due > 0.5)


class StateJump(StateProjection):
    """The projection of states that events change, and the largest row of Psi_dot that remains, divided by its scale.

    Psi_dot is linear in the velocities, so that rows remain violated only if they contradict others.
    """

    @property
    def counts(self) -> dict[str, int]:
        return super().counts | {"violated": 1}

    def program_names(self) -> list[str]:
        return [*super().program_names(), "psi_dot"]

    def _evaluate(self, f: Function, s: Lane):
        super()._evaluate(f, s)
        self.copy(f, "result v", "state v")
        self.invoke(f, "psi_dot")
        s.violated = largest_violation(self, f)


class StateTangentPart(StateFunction):
    """The tangent part of small changes of states; the changes are two further inputs, `dq` and `dv`."""

    inputs = ("dq", "dv")
    found = ("result dq", "result dv")

    @property
    def solving(self) -> list[str]:
        return ["tangent_part"]

    def begin_member(self, f: Function, lane: Value, member: Value):
        for x in self.inputs:
            given = self.member_address(f, x, member)
            with f.each(self.n) as i:
                self.put_lane_entry(f, f"state {x}", lane, f.load(given, i), i)

    def _evaluate(self, f: Function, s: Lane):
        threshold = f.const(ROUNDING_PIVOT, DOUBLE, f.width)
        with_threshold(f, self.drop_tol_place, threshold, lambda: self.invoke(f, "tangent_part"))
        self.fallback.find_tangent_part(f, s)


INPUTS = ("t", "q", "v")


class Evaluation:
    """The text of a module that evaluates a scene at single states, by loops for any size of the scene.

    Its functions are called directly, with addresses in one block of memory:

        numbers(parameters, numbers)      store the numbers of the scene that depend on parameters in the vector of all numbers
        prologue(numbers, work)           compute the constants of the scene from its numbers
        accelerations(work, work)         compute "a", the solution "x0" of the linear system, and "friction_power" (W), from "t",
                                          "q" and "v"
        energy(work, work)                compute "energy", kinetic and potential (J), from "q" and "v"

    The names in quotes are arrays in `work`, which begins with the constants; `places` are their offsets, in numbers. The caller
    passes the function `numbers` as one of the `further` functions.
    """

    exports = ("prologue", "accelerations", "energy")

    def __init__(self, code: RunPrograms, further: Sequence[Function] = ()):
        n = code.coordinate_count
        self._code, self._further = code, list(further)
        layout = Layout(1, 1)
        sizes = {"constants": len(code.constants), "t": 1, "q": n, "v": n, "a": n, "safe": 1, "energy": 2, "friction_power": 1}
        for name, count in (sizes | code.scratch).items():
            layout.add(name, count)
        self.places, self.size = layout.places, layout.size

    def text(self) -> str:
        """Return LLVM's text of the whole module."""
        loops = LoopWriter(1)
        at = {name: ("work", place) for name, place in self.places.items()}
        loops.write(self._code.prologue, "prologue", ("numbers", "work"), at | {"numbers": ("numbers", 0)})
        programs = {"accelerations": self._code.of("a", "safe", "friction_power"), "energy": self._code.of("energy")}
        for name, program in programs.items():
            loops.write(program, name, ("work", "out"), at)
        return text_of_module([*self._further, *loops.functions], loops.globals)


class ScaleCode(Memory):
    """The text of a module whose `run` computes the scales of members, by loops for any size of the scene.

    Its functions are marked as cold: optimization would double the time of compiling without making them faster.
    """

    settings = ()
    results = ("scales",)

    def __init__(self, code: RunPrograms):
        self._code, self.places = code, Layout(1, 1)
        for name, size in (code.scratch | code.scales.sizes).items():
            if name in code.scales.program.arrays:
                self.places.add(name, size)

    def text(self) -> str:
        """Return LLVM's text of the whole module."""
        loops = self._write_loops()
        f = Function("run", [(POINTER, "call")])
        block, work = self.allocate(f, f.const(self.places.size, INT))
        members, following = self.field(f, "members"), self.field(f, "next", POINTER)

        def take():
            return f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)

        member = f.variable(take(), INT)
        with f.while_(lambda: member.value < members):
            self._find_scales(f, work, member.value)
            member.value = take()
        f.line(f"call void @free(ptr {block.name})")
        return text_of_module([*loops.functions, f], loops.globals, ALLOCATION_DECLARATIONS)

    def thread_code(self) -> ThreadCode:
        loops = self._write_loops()
        f = Function("run_member", [(POINTER, "call"), (POINTER, "work"), (INT, "member")])
        with f.if_(f.given["member"] < self.field(f, "members")):
            self._find_scales(f, f.given["work"], f.given["member"])
        programs, kernels = loops.parts
        return ThreadCode([f, *programs], kernels, loops.globals, self.places.size)

    def _write_loops(self) -> LoopWriter:
        """Write `find_scales(numbers, work, scales)`: compute the characteristic scales of a member from its numbers."""
        loops = LoopWriter(1, cold=True)
        at = {name: ("work", place) for name, place in self.places.places.items()}
        at |= {"numbers": ("numbers", 0), "scales": ("scales", 0)}
        loops.write(self._code.scales.program, "find_scales", ("numbers", "work", "scales"), at)
        return loops

    def _find_scales(self, f: Function, work: Value, member: Value):
        numbers, to = self.member_address(f, "numbers", member), self.result_address(f, "scales", member, self._code.scale_count)
        f.call("find_scales", numbers, work, to)
