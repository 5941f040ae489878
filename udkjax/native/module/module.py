"""One module of machine code: its functions, and the arrays in the memory of a run."""

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.programs.unrolled import Unrolled, UnrolledProgram
from udkjax.expressions.loops.loop_derivative import FORWARD
from udkjax.native.language.ir import BOOL, POINTER, Function, Value
from udkjax.native.language.loops import LoopWriter
from udkjax.native.language.program import PointerPlace, consecutive, write
from udkjax.native.module.layout import FORMULATION_SETTINGS, LANE_NUMBERS, Lane, Layout, Plan
from udkjax.native.module.parts import Fallback
from udkjax.native.module.programs import DIFFERENTIATED, FURTHER, OUT, PROGRAMS
from udkjax.native.module.running import Running
from udkjax.native.module.settling import AT_END, SETTLING, write_settle_end, write_settle_state
from udkjax.native.module.steps import AIM_ACROSS, POINTS
from udkjax.native.module.tableau import Method

# Rarely called functions: once per run, near singular configurations, where a piece may end, or once in an implicit step.
COLD = (
    "end_piece",
    "along_motion",
    "jump",
    "finish_members",
    "begin",
    "rows_and_loads",
    "fallback",
    "fallback_tangent_part",
    "finish_by_fallback",
    "close_output",
    "accelerate_by_fallback",
    "equation_terms",
    "newton_v_and_psi",
    "evaluation_slopes",
    "measure_speed",
    FURTHER,
    "settle_state",
    "settle_end",
)


SPARE = 16  # places of constants are a multiple: the later module of a run (leaving.py), with a few more, has equal offsets


class Module(Running):
    """The text of one module of machine code: its functions.

    Args:
        plan: Choices that the code depends on.
        differentiated: Names of the scene's programs that the module differentiates.
        active: For each number of the scene, whether derivatives with respect to it are needed.
    """

    fallback: Fallback = Fallback()
    mode = FORWARD  # mode of differentiation
    closes = False  # whether the module returns states to the constraints, by the formulation if that does so
    shares_constants = False  # whether the members of a block of threads have the same constants, in its shared memory

    def __init__(self, plan: Plan, differentiated: Sequence[str] = (), active: Sequence[bool] = ()):
        self.plan, self.code, self.method, self.implicit = plan, plan.code, plan.method, plan.implicit
        self.stages = max(plan.method.stages, plan.implicit.stages if plan.implicit else 0)
        code, n, m = plan.code, plan.code.coordinate_count, plan.code.row_count
        self.n, self.m = n, m
        if plan.sampled:
            self.inputs = ("samples", *self.inputs)
        if plan.formulation is not None:
            self.settings = (*self.settings, *FORMULATION_SETTINGS)
        self.partitions = self.closes and plan.formulation is not None and plan.formulation.closes and m > 0
        self.is_dense = plan.pseudoinverse is not None and m > 0 and not self.partitions
        self.is_formulated = plan.formulation is not None and m > 0
        self.takes_dense_rows = self.is_dense or self.is_formulated
        self.measures_drift = plan.steps and m > 0 and not plan.projected
        self.drops_rows = plan.steps and m > 0 and plan.projected and not code.policy.reports and not self.partitions
        self.pieces = code.piece_count if plan.breaks else 0
        self.finds_edges = self.pieces > 0 and code.first_edge < self.pieces
        self.choose_parts()
        names = self.program_names()
        self.settles = code.rubs and any(name in SETTLING for name in names)  # friction may need further rounds
        self.programs = {name: PROGRAMS[name] for name in (*names, *((FURTHER,) if self.settles else ()))}
        self.unrolled = self._unroll(differentiated, active) if plan.unrolled else None
        self.constants = len(self.unrolled.constants if self.unrolled else code.constants)
        self.moving = range(self.constants if any(active) else 0) if self.unrolled is None else self.unrolled.moving
        """Indices, in the layout of the scene, of the constants that depend on active numbers."""
        self._lay_out()
        self.tangents = self.places  # memory of one direction of a derivative
        self.functions: list[Function] = []
        self.apart: set[str] = set()
        self.begins = []
        self.loops = LoopWriter(plan.width, cold=plan.unrolled)
        self.stage_accelerations = ["point3 a", *(f"stage{i} a" for i in range(1, self.stages))]
        self.rowcount = -(-n * plan.width // plan.vector)

    def choose_parts(self):
        """Hook: chooses the parts of the module."""

    @cached_property
    def shared(self) -> set[str]:
        """The arrays that parts share: of M if it is not diagonal, and of rows of phi, which make errors of q errors of v."""
        takes = {*self.fallback.shared, *(("couplings", "rates") if self.is_dense else ())}
        takes |= {"couplings"} if self.is_formulated else set()
        has = {"couplings": self.code.couples, "rates": self.code.position_rows < self.m}
        return {name for name in takes if has[name]}

    def _unroll(self, differentiated: Sequence[str], active: Sequence[bool]) -> Unrolled:
        asked = [program.outputs for program in self.programs.values()]
        of = [DIFFERENTIATED[name] for name in differentiated]
        return Unrolled(self.code, asked, of, active, self.mode, self.implicit is not None)

    def _lay_out(self):
        """Reserve memory for all arrays; layout.py describes them."""
        plan, code, n, m = self.plan, self.code, self.n, self.m
        p = self.places = Layout(plan.width, plan.vector)
        for name in (*LANE_NUMBERS, *(FORMULATION_SETTINGS if plan.formulation else ())):
            p.add(name)
        p.add("constants", -(-self.constants // SPARE) * SPARE)
        p.add("state t")
        for name in (
            "state q",
            "state v",
            "state dq",
            "state dv",
            "result v",
            "result a",
            "result dq",
            "result dv",
            "corrected q",
            "scale q",
            "scale v",
            "inverse unit",
        ):
            p.add(name, n)
        for k in range(POINTS):
            for x in "qva":
                p.add(f"point{k} {x}", n)
        for i in range(1, self.stages):
            p.add(f"stage{i} a", n)
        for k in range(3 * POINTS):
            p.add(f"difference{k}", n)
        p.add("rows", m)
        p.add("psi", m)
        p.add("terms", code.term_count)
        for name in ("pieces", "pieces before"):
            p.add(name, self.pieces)
        if self.finds_edges:
            p.add("piece a", n)
            for name in ("edges", "edges before"):
                p.add(name, self.pieces - code.first_edge)
        if plan.sampled:
            p.add("numbers", -(-code.number_count // plan.width))
        if not self.unrolled:
            self._add_arrays("", code.scratch)
        if "couplings" in self.shared:
            self._add_arrays("", {"couplings": code.scratch["couplings"], "change": n})
        if self.takes_dense_rows and "root" not in p.places:
            self._add_arrays("", {"root": n} | ({"psi_q": code.scratch["psi_q"]} if self.unrolled else {}))
        if "rates" in self.shared:
            self._add_arrays("", {"drift": m, "saved state dq": n})
        if self.is_formulated or self.settles or self.drops_rows:
            p.add("saved v", n)
        if self.settles:
            self._add_arrays("", {"further a": n} | ({"settled": code.scratch["settled"]} if self.unrolled else {}))
            p.add("settled before", code.scratch["settled"] if plan.width > 1 else 0)
            p.add("settled kept", code.scratch["settled"])
        self.fallback.reserve()

    @property
    def drop_tol_place(self) -> int | None:
        """The offset of the threshold of pivots; None if it is not used."""
        place = (self.unrolled or self.code).drop_tol_index
        return None if place is None else self.places["constants"] + place

    def _add_arrays(self, prefix: str, sizes: Mapping[str, int]):
        for name, count in sizes.items():
            self.places.add(prefix + name, count)

    # --- programs

    @property
    def solving(self) -> list[str]:
        """The names of the functions that solve linear systems: programs by elimination, or dense equations."""
        if not self.plan.projected:
            return ["accelerations"]
        of_step = ["project_and_accelerate", "tangent_part"] if self.method.ends else ["end_of_step"]
        return ["accelerations", "newton_q", *of_step, "newton_v_and_psi", "project"]

    def program_names(self) -> list[str]:
        """Return the names of the scene's programs that the module calls."""
        names = ["equation_terms", "psi"]
        if self.pieces:
            names.append("pieces")
        if self.is_dense:
            names += ["dense_accelerations", *(["dense_newton_q", "dense_newton_v", "psi_dot"] if self.plan.projected else [])]
        else:
            names += [*self.solving, *(["psi_dot"] if self.drops_rows else [])]
        if self.is_formulated and not self.is_dense:
            names.append("dense_accelerations")
        if self.measures_drift:
            names.append("drift" if self.takes_dense_rows else "accelerations_and_drift")
        names += self.fallback.programs
        if "rates" in self.shared:
            names.append("drift_of_rates")
        return names

    @property
    def arrays(self) -> dict[str, PointerPlace]:
        """The places of the arrays of the scene's programs."""
        named = {
            "t": "state t",
            "q": "state q",
            "v": "state v",
            "dq": "state dq",
            "dv": "state dv",
            "q1": "corrected q",
            "v1": "result v",
            "a": "result a",
        }
        named |= {"dq1": "result dq", "dv1": "result dv"} | {
            x: x for x in ("constants", "psi", "terms", "pieces", "safe", "distance", "rank", "unsettled")
        }
        if not self.unrolled:
            named |= {x: x for x in self.code.scratch}
        named |= {x: x for x in self.fallback.arrays}
        if self.takes_dense_rows:
            named |= {x: x for x in ("psi_q", "root")}
        if self.settles:
            named |= {x: x for x in RunPrograms.BEGINS}
        named |= {x: x for x in ("drift", "couplings") if x in self.places.places}
        return {x: ("work", self.places[place]) for x, place in named.items()}

    def write_programs(self):
        for name, program in self.programs.items():
            stored = {x: (OUT, 0) if to == OUT else self.arrays[to] for x, to in program.stored.items()}
            self.write_program(name, self.arrays | stored)
        self.write_prologue("prologue", self.unrolled)
        if self.settles:
            arguments = [(POINTER, "work"), (POINTER, "out")]
            write_settle_state(self, *self.function("settle_state", arguments))
            if any(name in AT_END for name in self.programs):
                write_settle_end(self, self.function("settle_end", arguments)[0])
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
        """Write an unrolled program; `tangent` is the layout at its pointer `tangent`, by default that of the module."""

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
                name in COLD and not self.is_dense,
                lanes,
            )
        )

    def write_prologue(self, name: str, unrolled: Unrolled | None):
        """Write `name(numbers, constants)` for one member."""
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
        """Add a function of `width` lanes."""
        f = Function(name, arguments, width, cold=name in COLD and not self.is_dense)
        self.functions.append(f)
        return f

    def write_derivatives(self):
        """Hook: writes the functions of derivatives; does nothing by default."""

    def record_stage(self, f: Function, s: Lane, i: int):
        """Hook: called at the state of stage i of a step, after its accelerations have been computed."""

    def record_solved_stage(self, f: Function, s: Lane, i: int):
        """Hook: called at the state of stage i of an implicit step, after it has been solved in lanes that are `stepping`."""

    def methods(self, f: Function, s: Lane) -> Iterator[tuple[Method, Value | None]]:
        """Run the block for each method of the module, with the mask of the lanes whose attempt it makes; None: all lanes."""
        yield self.method, None
        if self.plan.stiff:
            mask = s.begin < -0.5
            with f.if_(f.any_of(mask)):
                yield self.plan.stiff, mask

    def record_step(self, f: Function, s: Lane, accept: Value):
        """Hook: called after a step, when its end has become point 3 in lanes that `accept`."""

    def record_output(self, f: Function, s: Lane):
        """Hook: called at an output (`state t`, `state q`, `result v`) of lanes that are `due`."""

    def weigh_rows(self):
        """Reserve memory for weights of rows, which are set for the member in each lane."""
        if "weights" not in self.places.places:
            self.places.add("weights", self.m)

    def begin_rows(self, f: Function, lane: Value, length: Value):
        """Compute the weights of rows of a member from the scales in its lane."""
        if "weights" in self.places.places:
            with f.each(self.m) as i:
                self.put_lane_entry(f, "weights", lane, length / self.lane_entry(f, "rows", lane, i), i)

    def begin_member(self, f: Function, lane: Value, member: Value):
        """Hook: called when a member is loaded into a lane; does nothing by default."""

    def begin_numbers(self, f: Function, lane: Value, member: Value):
        """Hook: called before the constants of a member are computed for the first time."""

    def numbers_in_lane(self, f: Function, lane: Value, numbers: Value) -> Value:
        """Return the address of the numbers with which the constants of a lane are computed; by default those given."""
        return numbers

    def enter_start(self, f: Function, lane: Value, member: Value):
        """Set the constants of a lane again as they were at the start of its member; by default they are so yet."""

    def begin_row(self, f: Function, lane: Value, member: Value, numbers: Value, constants: Value):
        """Hook: called with the addresses of the numbers and constants of a lane when they have changed."""

    def end_members(self, f: Function, s: Lane):
        """Hook: called for completed members, in lanes that are `due`."""

    def interpolates(self, f: Function, s: Lane) -> Value:
        """Return whether states between steps may still be asked for, so that the points before the latest are needed."""
        if self.pieces:
            return f.const(True, BOOL, f.width)
        return s.written + 1.0 < self.field(f, "times") - 1

    def steps_across_next(self, s: Lane) -> Value:
        """Return the lanes that have ended a step just before the end of a piece, and go on with a tiny step across it."""
        return s.aim.is_(float(AIM_ACROSS))

    def invoke(self, f: Function, name: str, out: str | None = None):
        super().invoke(f, name, out)
        if name in SETTLING and self.settles:
            with f.if_(f.any_of(Lane(f, self.places).unsettled > 0.5)):
                f.call("settle_end" if name in AT_END else "settle_state", f.given["work"], self.address(f, out or "result a"))

    def settle(self, f: Function, out: str):
        """Settle the loads of joints with friction at `state`, with which programs of derivatives begin; `out` changes."""
        if self.settles:
            self.invoke(f, "accelerations", out)

    def accelerate_stage(self, f: Function, i: int):
        """Compute the accelerations of stage i at `state`."""
        self.accelerate(f, f"stage{i} a")

    def accelerate(self, f: Function, to: str):
        """Compute the accelerations at `state`."""
        self.invoke(f, "accelerations", to)

    def accelerate_and_measure(self, f: Function):
        """Compute the accelerations at the end of a step that is not projected, `result a`."""
        self.accelerate(f, "result a")

    def highest_rank(self, s: Lane) -> Value | None:
        """Return the largest rank of the rows in the attempted step; None if the method does not find one."""
        return None

    def accelerate_end(self, f: Function):
        """Hook: called with `state q`, `result v` and their accelerations `result a` at the end of a step."""
