"""One module of machine code: its programs and its functions."""

from collections.abc import Mapping, Sequence

from udkjax.equations.programs.unrolled import Unrolled, UnrolledProgram
from udkjax.expressions.loops.loop_derivative import FORWARD
from udkjax.native.language.ir import BOOL, POINTER, Function, Value
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.program import PointerPlace, consecutive, write
from udkjax.native.module.arrays import RunArrays
from udkjax.native.module.layout import Lane, Layout, Plan
from udkjax.native.module.parts import StiffnessPart
from udkjax.native.module.programs import COLD_FUNCTIONS, DIFFERENTIATED_OUTPUTS, OUT_POINTER, PROGRAMS
from udkjax.native.module.settling import friction_of
from udkjax.native.module.steps import AIM_ACROSS


class Module(RunArrays):
    """One module of machine code: the writer of its functions and of its text.

    Args:
        plan: Choices that the code depends on.
        differentiated: Names of the scene's programs that the module differentiates.
        active: For each number of the scene, whether derivatives with respect to it are needed.
    """

    mode = FORWARD  # mode of differentiation
    closes = False  # whether the module returns states to the constraints, by the formulation if that does so
    shares_constants = False  # whether the members of a block of threads have the same constants, in its shared memory

    def __init__(self, plan: Plan, differentiated: Sequence[str] = (), active: Sequence[bool] = ()):
        self.plan, self.code, self.method = plan, plan.code, plan.method
        code, n, m = plan.code, plan.code.coordinate_count, plan.code.row_count
        self.n, self.m = n, m
        if plan.sampled:
            self.inputs = ("samples", *self.inputs)
        self.settings = (*self.settings, *plan.own_settings)
        self.pieces = code.piece_count if plan.breaks else 0
        self.edges = max(self.pieces - code.first_edge, 0) if self.pieces else 0  # pieces that end where a load changes its sign
        self.stiffness = StiffnessPart(plan)
        self.choose_parts()
        implicit = self.stiffness.method
        self.stages = max(plan.method.stages, implicit.stages if implicit else 0)
        names = self.program_names()
        self.friction = friction_of(self, names)
        self.programs = {name: PROGRAMS[name] for name in (*names, *self.friction.programs)}
        self.unrolled = self._unroll(differentiated, active) if plan.unrolled else None
        self.constants = len(self.unrolled.constants if self.unrolled else code.constants)
        self.moving = range(self.constants if any(active) else 0) if self.unrolled is None else self.unrolled.moving
        """Indices, in the layout of the scene, of the constants that depend on active numbers."""
        self.lay_out()
        self.tangents = self.places  # memory of one direction of a derivative
        self.functions: list[Function] = []
        self.begins = []
        self.loops = LoopWriter(plan.width, cold=plan.unrolled)
        self.stage_accelerations = ["point3 a", *(f"stage{i} a" for i in range(1, self.stages))]
        self.rowcount = -(-n * plan.width // plan.vector)
        for part in (self.fallback, self.accelerations, self.projection):
            part.reserve()

    def choose_parts(self):
        """Hook: replace the default parts of the module (parts.py); called before memory is reserved."""

    @property
    def solving(self) -> list[str]:
        """The names of the functions that solve linear systems: programs by elimination, or dense equations."""
        return self.projection.solving

    def _unroll(self, differentiated: Sequence[str], active: Sequence[bool]) -> Unrolled:
        asked = [program.outputs for program in self.programs.values()]
        of = [DIFFERENTIATED_OUTPUTS[name] for name in differentiated]
        return Unrolled(self.code, asked, of, active, self.mode, self.stiffness.method is not None)

    # --- programs

    def program_names(self) -> list[str]:
        """Return the names of the scene's programs that the module calls, except those of friction."""
        pieces, rates = ["pieces"] if self.pieces else [], ["drift_of_rates"] if "rates" in self.shared else []
        parts = (self.accelerations, self.projection, self.fallback)
        return ["equation_terms", "psi", *pieces, *(name for part in parts for name in part.programs), *rates]

    def write_programs(self):
        for name, program in self.programs.items():
            stored = {x: (OUT_POINTER, 0) if to == OUT_POINTER else self.arrays[to] for x, to in program.stored.items()}
            self.write_program(name, self.arrays | stored)
        self.write_prologue("prologue", self.unrolled)
        self.friction.write()
        if "couplings" in self.places.places:
            at = {"couplings": ("work", self.places["couplings"]), "change": ("out", 0)}
            self.loops.write(self.code.spread, "spread", ("work", "out"), at)
            self.loops.write(self.code.gather, "gather", ("work", "out"), at)

    def write_program(self, name: str, at: Mapping[str, PointerPlace]):
        """Write one of the scene's programs as a function of `work` and `out`, with its arrays at the places `at`."""
        if self.unrolled:
            self.write_scalars(self.unrolled.program(*self.programs[name].outputs), name, ("work", "out"), at)
        else:
            self.loops.write(self.code.of(*self.programs[name].outputs), name, ("work", "out"), at)

    def write_scalars(
        self,
        program: UnrolledProgram,
        name: str,
        pointers: Sequence[str],
        at: Mapping[str, PointerPlace],
        width: int | None = None,
        tangent: Layout | None = None,
    ):
        """Write an unrolled program as a function of some pointers.

        Args:
            program: The program.
            name: The name of the function.
            pointers: The names of the function's arguments.
            at: The places of the program's arrays. Inputs and outputs in other arrays are not used.
            width: The number of lanes; by default that of the module.
            tangent: The layout at the pointer `tangent`; by default that of the module.
        """

        def find(places: Sequence[PointerPlace]) -> list[PointerPlace]:
            return [place(x, k) if x in at else (pointers[0], 0) for x, k in places]

        def place(x: str, k: int) -> PointerPlace:
            pointer, index = at[x][0], at[x][1] + k
            is_shared = self.shares_constants and (x, pointer) == ("constants", "work")
            is_shared = is_shared and index != self.drop_tol_place  # a run changes this threshold
            return ("block_memory", k) if is_shared else (pointer, index)

        lanes = {x: (tangent or self.tangents).width for x in ("tangent", "out") if "tangent" in pointers} | {"block_memory": 1}
        inputs, outputs = find(program.inputs), find(program.outputs)
        self.functions.append(
            write(
                program.program,
                name,
                width or self.plan.width,
                pointers,
                inputs,
                outputs,
                name in COLD_FUNCTIONS and self.accelerations.has_cold_functions,
                lanes,
            )
        )

    def write_prologue(self, name: str, unrolled: Unrolled | None):
        """Write `name(numbers, constants)`: compute the constants of one member, by an unrolled program or else by loops."""
        if unrolled:
            inputs, outputs = consecutive("numbers", self.code.number_count), consecutive("constants", self.constants)
            self.functions.append(write(unrolled.prologue, name, 1, ("numbers", "constants"), inputs, outputs))
        else:
            at = {"numbers": ("numbers", 0), "constants": ("constants", 0)}
            self.loops.write(self.code.prologue, name, ("numbers", "constants"), at, width=1)

    def function(self, name: str, arguments: Sequence[tuple[str, str]] = ((POINTER, "work"),)) -> tuple[Function, Lane]:
        f = self.new_function(name, arguments, self.plan.width)
        return f, Lane(f, self.places)

    def new_function(self, name: str, arguments: Sequence[tuple[str, str]], width: int) -> Function:
        """Add a function of `width` lanes to the module; return it."""
        f = Function(name, arguments, width, cold=name in COLD_FUNCTIONS and self.accelerations.has_cold_functions)
        self.functions.append(f)
        return f

    def write_derivatives(self):
        """Hook: write the functions of derivatives; by default there are none."""

    def record_stage(self, f: Function, s: Lane, i: int):
        """Hook: write code that runs after the accelerations of stage i of an explicit step, at the state of the stage."""

    def record_solved_stage(self, f: Function, s: Lane, i: int):
        """Hook: write code that runs after stage i of an implicit step has been solved in `stepping` lanes, at its state."""

    def record_step(self, f: Function, s: Lane, accept: Value):
        """Hook: write code that runs after a step, when its end has become point 3 in the lanes of `accept`."""

    def record_output(self, f: Function, s: Lane):
        """Hook: write code that runs at each output (`state t`, `state q`, `result v`), in lanes that are `due`."""

    def begin_member(self, f: Function, lane: Value, member: Value):
        """Hook: write code that runs when a member has been loaded into a lane, with its state, settings and constants."""

    def begin_numbers(self, f: Function, lane: Value, member: Value):
        """Hook: write code that runs before the constants of a new member in a lane are computed for the first time."""

    def numbers_in_lane(self, f: Function, lane: Value, numbers: Value) -> Value:
        """Return the address of the numbers from which the constants of a lane are computed; by default `numbers`, as given."""
        return numbers

    def enter_start(self, f: Function, lane: Value, member: Value):
        """Reset the constants of a lane to those at the start of its member; does nothing by default, where they never change."""

    def begin_row(self, f: Function, lane: Value, member: Value, numbers: Value, constants: Value):
        """Hook: write code that runs after the constants of a lane have been computed; arguments are the addresses of both."""

    def end_members(self, f: Function, s: Lane):
        """Hook: write code that runs when members are complete, in lanes that are `due`, after their results are written."""

    def interpolates(self, f: Function, s: Lane) -> Value:
        """Return the lanes that may still evaluate states between steps, for which the points before the latest must be kept."""
        if self.pieces:
            return f.const(True, BOOL, f.width)
        return s.written + 1.0 < self.field(f, "times") - 1

    def steps_across_next(self, s: Lane) -> Value:
        """Return the lanes whose step has ended just before the end of a piece, and whose next, tiny step crosses it."""
        return s.aim.is_(float(AIM_ACROSS))

    def invoke(self, f: Function, name: str, out: str | None = None):
        super().invoke(f, name, out)
        self.friction.settle_after(f, name, out)

    def accelerate_stage(self, f: Function, i: int):
        """Compute the accelerations of stage i of an explicit step, at `state`; derivatives override this."""
        self.accelerations.accelerate(f, f"stage{i} a")
