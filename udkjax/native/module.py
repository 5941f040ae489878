"""One module of machine code: its functions, and what the memory of a run has room for."""

from collections.abc import Callable, Sequence
from typing import Any

from udkjax.equations.loop_programs import LoopPrograms
from udkjax.equations.scene_programs import EliminationPrograms, ScenePrograms
from udkjax.expressions import ScalarProgram
from udkjax.native.ir import POINTER, Function, Value
from udkjax.native.layout import LANE_NUMBERS, Lane, Layout, Plan
from udkjax.native.loops import LoopWriter
from udkjax.native.memory import Memory
from udkjax.native.program import Place, consecutive, write
from udkjax.native.steps import POINTS

# Once a run, beside singularities, or where a piece may end.
COLD = (
    "leave",
    "finish_members",
    "begin",
    "finish_by_fallback",
    "close_output",
    "accelerate_by_fallback",
    "equation_terms",
    "psi_dot",
    "newton_v_and_psi",
)


class Module(Memory):
    """The text of one module of machine code: its functions."""

    def __init__(self, plan: Plan):
        self.plan, self.code, self.method = plan, plan.code, plan.method
        code, n, m = plan.code, plan.code.coordinate_count, plan.code.row_count
        self.n, self.m = n, m
        self.constants = len(code.constants)
        if plan.sampled:
            self.inputs = ("samples", *self.inputs)
        p = self.places = Layout(plan.width, plan.vector)
        for name in LANE_NUMBERS:
            p.add(name)
        p.add("constants", self.constants)
        p.add("X t")
        for name in ("X q", "X v", "X dq", "X dv", "O v", "O a", "O dq", "O dv", "C", "scale q", "scale v", "inverse unit"):
            p.add(name, n)
        for k in range(POINTS):
            for x in "qva":
                p.add(f"P{k} {x}", n)
        for i in range(1, plan.method.stages):
            p.add(f"A{i}", n)
        for k in range(3 * POINTS):
            p.add(f"N{k}", n)
        p.add("rows", m)
        p.add("psi", m)
        p.add("R", code.term_count)
        self.pieces = len(code.equations.pieces) if isinstance(code, ScenePrograms) and plan.breaks else 0
        for name in ("G", "G0"):
            p.add(name, self.pieces)
        if plan.sampled:
            p.add("numbers", -(-self.number_count // plan.width))
        if isinstance(code, LoopPrograms):
            for name, count in code.scratch.items():
                p.add(name, count)
            if self.falls_back:
                for name, count in code.with_all_rows.scratch.items():
                    p.add(f"fallback {name}", count)
                for name in ("fallback v", "fallback a"):
                    p.add(name, n)
        self.tangents = self.places  # of one direction of a derivative
        self.functions: list[Function] = []
        self.loops = LoopWriter(plan.width)
        self.stage_accelerations = ["P3 a", *(f"A{i}" for i in range(1, plan.method.stages))]
        self.rowcount = -(-n * plan.width // plan.vector)
        self.drop = code.drop_tol_index

    def module_text(self) -> str:
        functions = [*self.functions, *self.loops.functions]
        declared = sorted(set().union(*(f.declared for f in functions)) | {"declare ptr @malloc(i64)", "declare void @free(ptr)"})
        return "\n".join([*declared, *self.loops.globals, *(f.text() for f in functions)])

    @property
    def number_count(self) -> int:
        """How many numbers the prologue takes."""
        return self.code.prologue_input_count if isinstance(self.code, LoopPrograms) else len(self.code.prologue.inputs)

    @property
    def falls_back(self) -> bool:
        """Whether pivots may be too small to be trusted, and steps are taken again by a rank-revealing method."""
        reports = isinstance(self.code, EliminationPrograms | LoopPrograms) and self.code.policy.reports
        return reports and self.m > 0

    def write_programs(self):
        code, n = self.code, self.n
        if isinstance(code, LoopPrograms):
            self.write_loop_programs(code)
            return
        state, changes, safe = (
            self.state_places(),
            [*self.work_places("X dq", n), *self.work_places("X dv", n)],
            self.work_places("safe", 1),
        )
        outputs = {
            "accelerations": [*consecutive("out", n), *safe],
            "newton_q": [*self.work_places("C", n), *safe],
            "project_and_accelerate": [*self.work_places("O v", n), *self.work_places("O a", n), *safe],
            "end_of_step": [
                *(x for name in ("O v", "O a", "O dq", "O dv") for x in self.work_places(name, n)),
                *self.work_places("distance", 1),
                *safe,
            ],
            "tangent_part": [*self.work_places("O dq", n), *self.work_places("O dv", n), *self.work_places("distance", 1)],
            "project": [*self.work_places("C", n), *self.work_places("O v", n), *self.work_places("psi", self.m)],
            "newton_v_and_psi": [*self.work_places("O v", n), *self.work_places("psi", self.m)],
            "psi": self.work_places("psi", self.m),
            "equation_terms": self.work_places("R", code.term_count),
            "psi_dot": self.work_places("psi", self.m),
            "pieces": self.work_places("G", self.pieces),
        }
        for name, program in self.program_names(code).items():
            inputs = [*state, *changes] if name in ("tangent_part", "end_of_step") else state
            self.write_program(program, name, ("work", "out"), inputs, outputs[name])
        inputs = consecutive("work", len(code.prologue.inputs))
        self.functions.append(write(code.prologue, "prologue", 1, ("work", "out"), inputs, consecutive("out", self.constants)))

    def write_loop_programs(self, code: LoopPrograms):
        found = {"t": "X t", "q": "X q", "v": "X v", "dq": "X dq", "dv": "X dv", "q1": "C", "v1": "O v", "a": "O a"}
        found |= {"dq1": "O dq", "dv1": "O dv", "terms": "R"}
        results = (*found, "constants", "psi", "safe", "distance", "rank")
        at = {x: ("work", self.places[found.get(x, x)]) for x in (*results, *code.scratch)}
        for name, program in self.program_names(code).items():
            self.loops.write(program, name, ("work", "out"), at | ({"a": ("out", 0)} if name == "accelerations" else {}))
        if self.falls_back:
            every = code.with_all_rows
            places = {x: f"fallback {x}" for x in every.scratch}
            places |= {"v1": "fallback v", "a": "fallback a", "safe": "rank", "distance": "rank"}
            fallback = at | {x: ("work", self.places[place]) for x, place in places.items()}
            for name, program in {
                "accelerations": every.accelerations,
                "newton_q": every.newton_q,
                "project_and_accelerate": every.project_and_accelerate,
                "tangent_part": every.tangent_part,
            }.items():
                self.loops.write(program, f"fallback_{name}", ("work", "out"), fallback)
        at = {"numbers": ("work", 0), "constants": ("out", 0)}
        self.loops.write(code.prologue, "prologue", ("work", "out"), at, width=1)

    def program_names(self, code: Any) -> dict[str, Any]:
        """The programs that it calls, by the names of their functions."""
        wanted = {"accelerations": code.accelerations, "equation_terms": code.equation_terms, "psi": code.psi}
        if self.pieces:
            wanted["pieces"] = code.pieces
        if self.plan.projected:
            wanted["newton_q"] = code.newton_q
            if self.method.ends:
                wanted |= {"project_and_accelerate": code.project_and_accelerate, "tangent_part": code.tangent_part}
            else:
                wanted["end_of_step"] = code.end_of_step
            wanted["newton_v_and_psi"] = code.newton_v_and_psi
            if isinstance(code, EliminationPrograms):
                wanted["project"] = code.project
        if self.falls_back and isinstance(code, ScenePrograms):
            wanted["psi_dot"] = code.psi_dot
        return wanted

    def write_program(
        self, program: ScalarProgram, name: str, pointers: Sequence[str], inputs: list[Place], outputs: list[Place]
    ):
        lanes = {x: self.tangents.width for x in ("tangent", "out") if "tangent" in pointers}
        self.functions.append(write(program, name, self.plan.width, pointers, inputs, outputs, name in COLD, lanes))

    def work_places(self, name: str, count: int) -> list[Place]:
        return [("work", self.places[name] + k) for k in range(count)]

    def state_places(self) -> list[Place]:
        """The constants, and t, q and v in X."""
        counts = {"constants": self.constants, "X t": 1, "X q": self.n, "X v": self.n}
        return [place for name, count in counts.items() for place in self.work_places(name, count)]

    def function(self, name: str, arguments: Sequence[tuple[str, str]] = ((POINTER, "work"),)) -> tuple[Function, Lane]:
        f = Function(name, arguments, self.plan.width, cold=name in COLD)
        self.functions.append(f)
        return f, Lane(f, self.places)

    def write_derivatives(self):
        """Its functions."""

    def record_stage(self, f: Function, s: Lane, i: int):
        """What it does with stage i of a step, whose state is in X."""

    def record_step(self, f: Function, s: Lane, accept: Value):
        """What it does with a step once its end is in P3."""

    def record_output(self, f: Function, s: Lane):
        """What it does with a state between steps, in X t, X q and O v, of lanes that are `due`."""

    def begin_member(self, f: Function, lane: Value, member: Value):
        """Hook: called with a member that is taken into a lane; does nothing by default."""

    def begin_row(self, f: Function, lane: Value, member: Value, numbers: Value, constants: Value):
        """Hook: called with the addresses of the numbers and constants that a lane goes on with; does nothing by default."""

    def end_members(self, f: Function, s: Lane):
        """What it does with members that are done, in lanes that are `due`."""

    def goes_on(self, f: Function, s: Lane) -> Value:
        """Whether there is something to do in the lanes."""
        return f.any_of(s.active > 0.5)

    def step_all(self, f: Function, s: Lane, fill: Callable[[], None]):
        """One step of all lanes, and what becomes of those that are done."""
        raise NotImplementedError

    def take_next(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Which members come next, into lanes whose members are done."""
        fill()

    def allocate_memory(self, f: Function, call: Value) -> list[Value]:
        """Further memory of a run, in `work` already: what to free."""
        del f, call
        return []

    def accelerate_stage(self, f: Function, i: int):
        """The accelerations of stage i, of the state in X."""
        self.invoke(f, "accelerations", f"A{i}")
