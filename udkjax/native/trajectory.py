"""Whole trajectories as machine code: an explicit Runge-Kutta method for q'' = a(t, q, v), with all that a step takes.

A method's tableau (A, b, c) is diffrax's. Since q' = v, its stages need the accelerations alone (Hairer, Norsett, Wanner, II.14):

    q_i = q + h c_i v + h^2 sum_j (A A)_ij a_j,        v_i = v + h sum_j A_ij a_j,        a_i = a(t + c_i h, q_i, v_i).

Each accepted step is returned to the constraint manifold. Outputs lie on the polynomial that has the positions, velocities and
accelerations of four consecutive accepted states (of degree 11: interpolated states are as exact as the states themselves, and
cost no evaluation), and are returned to the manifold, too. Where the motion is not smooth a step ends, and the run starts anew.

W members run side by side in the lanes of vectors, each with a time, a step and a result of its own. A lane whose member is done
takes the next one. Where elimination meets a pivot that it must not trust, a step is taken a little shorter; where that does not
help it is taken again with care: by a rank-revealing method on all rows (least_norm.py), lane by lane.

The functions of one module, all of them on one piece of memory (`Places`): `run` takes members and calls `attempt` (one step),
`decide` (whether it counts, and the next), `outputs` (states between steps).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from udkjax.equations.loop_programs import LoopPrograms
from udkjax.equations.scalar_programs import EliminationPrograms, ScenePrograms
from udkjax.expressions import Program
from udkjax.native.ir import BOOL, DOUBLE, INT, POINTER, Function, Value
from udkjax.native.least_norm import LEAST_NORM, least_norm
from udkjax.native.loops import LoopWriter
from udkjax.native.power import power
from udkjax.native.program import Place, numbered, write
from udkjax.native.steps import (
    AHEAD,
    AIM_ACROSS,
    AIM_BEFORE,
    AIM_BEYOND,
    BEFORE,
    BEGINS_BEHIND,
    CAUTIOUS,
    CUT,
    DODGE,
    DODGES,
    DONE,
    DOUBTED,
    EDGE,
    ENDS_BEFORE,
    EXACT,
    EXPECTED,
    FAR,
    FORESEEN,
    GAP,
    GROW,
    HALVINGS,
    LONGEST,
    NEAREST,
    NEWTON_STEPS,
    NOT_FINITE,
    NOTHING_LEFT,
    PAST,
    POINTS,
    RUNNING,
    SAFETY,
    SAME,
    SHORTEST,
    SHRINK,
    STEEPEST,
    STEP_LIMIT,
    STEP_TOO_SMALL,
    STRETCH,
    SURE,
    TAKEN_BACK,
    TRIES,
    TURNED,
    USELESS,
)
from udkjax.native.tableau import Method

OUTPUT_STEPS = 7  # of Newton's method to an output: where two branches of the manifold meet, it halves the distance in each

SETTINGS = ("rtol", "atol", "smallest", "first", "length", "omega", "care", "max_steps")
INPUTS = ("numbers", "ts", "q", "v", "settings", "rows", "breaks")
OUTPUTS = ("qs", "vs", "violation", "info")
INFO = ("code", "t", "tried", "accepted", "evaluations", "written")  # then the last q and v


@dataclass(frozen=True)
class Plan:
    """What a trajectory's code depends on."""

    code: Any  # `ScenePrograms` or `LoopPrograms`
    method: Method
    projected: bool
    breaks: bool
    width: int  # lanes
    vector: int  # numbers that a register holds


@dataclass
class Places:
    """Where everything lies in the memory of a run, in numbers of W lanes each; arrays of coordinates fill whole registers."""

    width: int
    vector: int
    places: dict[str, int] = field(default_factory=dict)
    size: int = 0

    def add(self, name: str, count: int = 1) -> int:
        """A new array, from a register's boundary on."""
        step = max(self.vector // self.width, 1)
        self.places[name] = self.size
        self.size += -(-count // step) * step
        return self.places[name]

    def __getitem__(self, name: str) -> int:
        return self.places[name]


# Once a run, beside singularities, or where a piece may end.
RARE = ("leave", "solve", "finish_members", "begin", "arrive_carefully", "accelerate_carefully", "rows", "psi_dot")
_LANE = (  # numbers of each lane; `call` and `ways` are addresses
    *("call", "ways"),
    *(
        "t1",
        "step",
        "error",
        "distance",
        "last",
        "lands",
        "h",
        "rate",
        "code",
        "doubt",
        "dodged",
        "tried",
        "accepted",
        "evaluations",
    ),
    *("written", "steps", "member", "active", "judged", "begin", "careful", "ok", "until", "due", "next", "tolerance", "moving"),
    *(f"T{k}" for k in range(POINTS)),
    *(f"distance{k}" for k in range(POINTS - 1)),
    *SETTINGS,
    *("start", "end", "safe", "behind", "violated", "rank"),
    *("crossing", "aim", "tries", "share", "low", "again"),
)


class Lane:
    """The numbers of each lane, as attributes: read, and written for all lanes (or by `where` for some)."""

    def __init__(self, f: Function, places: Places):
        self.__dict__.update(_f=f, _places=places)

    def __getattr__(self, name: str) -> Value:
        f: Any = self.__dict__["_f"]
        return f.load(f.given["work"], self.__dict__["_places"][name] * f.width, f.width)

    def __setattr__(self, name: str, value: Any):
        f: Any = self.__dict__["_f"]
        f.store(value, f.given["work"], self.__dict__["_places"][name] * f.width, f.width)

    def where(self, mask: Value, **named: Any):
        f: Any = self.__dict__["_f"]
        for name, value in named.items():
            setattr(self, name, f.select(mask, f.like(value, DOUBLE, f.width), getattr(self, name)))


class Trajectory:
    """The text of one module.

    `run` is told, 8 bytes each (`call`): how many members, output times, breakpoints and directions there are; the addresses of
    inputs, their strides from member to member (numbers), the addresses of outputs, and that of the number of the next member,
    which threads share.
    """

    inputs: tuple[str, ...] = ()  # besides those of every run
    results: tuple[str, ...] = OUTPUTS
    outputs: tuple[str, ...] = ()
    directions_in = 0  # which dimension of the last input says how many directions there are
    module = ""  # the text, once it is written

    @property
    def call(self) -> tuple[str, ...]:
        inputs = (*INPUTS, *self.inputs)
        strides = (f"{x} stride" for x in inputs)
        return "members", "times", "knots", "directions", *inputs, *strides, *self.results, *self.outputs, "next"

    def __init__(self, plan: Plan):
        self.plan, self.code, self.method = plan, plan.code, plan.method
        code, n, m = plan.code, plan.code.coordinate_count, plan.code.row_count
        self.n, self.m = n, m
        self.constants = len(code.constants)
        p = self.places = Places(plan.width, plan.vector)
        for name in _LANE:
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
        if isinstance(code, LoopPrograms):
            for name, count in code.scratch.items():
                p.add(name, count)
            if self.cares:
                for name, count in code.with_all_rows.scratch.items():
                    p.add(f"careful {name}", count)
                for name in ("careful v", "careful a"):
                    p.add(name, n)
        self.ways = self.places  # of one direction of a derivative
        self.functions: list[Function] = []
        self.loops = LoopWriter(plan.width)
        self.stage_accelerations = ["P3 a", *(f"A{i}" for i in range(1, plan.method.stages))]
        self.rowcount = -(-n * plan.width // plan.vector)
        self.drop = code.drop_tol_index

    def text(self) -> str:
        """LLVM's text of the whole module."""
        self._programs()
        self._attempt()
        if self.pieces:
            self._leave()
        self._decide()
        self._differences()
        self._between()
        self._outputs()
        if self.cares:
            if isinstance(self.code, LoopPrograms):
                self._care_by_loops()
            else:
                self.functions.append(least_norm())
                self._solve()
                self._care()
        self._begin()
        self._finish()
        self._derivatives()
        self._run()
        return self._joined()

    def _joined(self) -> str:
        functions = [*self.functions, *self.loops.functions]
        declared = sorted(set().union(*(f.declared for f in functions)) | {"declare ptr @malloc(i64)", "declare void @free(ptr)"})
        return "\n".join([*declared, *self.loops.globals, *(f.text() for f in functions)])

    # What a trajectory with derivatives does besides (tangents.py, walk.py).

    def _derivatives(self):
        """Its functions."""

    def _accepted(self, f: Function, s: Lane, accept: Value):
        """What it does with a step once its end is in P3."""

    def _interpolated(self, f: Function, s: Lane):
        """What it does with a state between steps, in X t, X q and O v, of lanes that are `due`."""

    def _begun(self, f: Function, lane: Value, member: Value):
        """What it does with a member that is taken into a lane."""

    def _ended(self, f: Function, s: Lane):
        """What it does with members that are done, in lanes that are `due`."""

    def _next(self, f: Function, s: Lane, fill: Callable[[], None]):
        """Which members come next, into lanes whose members are done."""
        fill()

    def _stage(self, f: Function, i: int):
        """The accelerations of stage i, of the state in X."""
        self._call(f, "accelerations", f"A{i}")

    @property
    def doubts(self) -> bool:
        """Whether pivots may be too small to be trusted."""
        return isinstance(self.code, EliminationPrograms | LoopPrograms) and self.code.policy.reports

    @property
    def cares(self) -> bool:
        """Whether steps may be taken again with care."""
        return self.doubts and self.m > 0

    # --- the scene's programs

    def _programs(self):
        code, n = self.code, self.n
        if isinstance(code, LoopPrograms):
            self._loop_programs(code)
            return
        state, changes, safe = self._state(), [*self._work("X dq", n), *self._work("X dv", n)], self._work("safe", 1)
        outputs = {
            "accelerations": [*numbered("out", n), *safe],
            "newton_q": [*self._work("C", n), *safe],
            "project_and_accelerate": [*self._work("O v", n), *self._work("O a", n), *safe],
            "end_of_step": [
                *(x for name in ("O v", "O a", "O dq", "O dv") for x in self._work(name, n)),
                *self._work("distance", 1),
                *safe,
            ],
            "tangent_part": [*self._work("O dq", n), *self._work("O dv", n), *self._work("distance", 1)],
            "newton_v_and_psi": [*self._work("O v", n), *self._work("psi", self.m)],
            "psi": self._work("psi", self.m),
            "equation_terms": self._work("R", code.term_count),
            "psi_dot": self._work("psi", self.m),
            "pieces": self._work("G", self.pieces),
        }
        for name, program in self._wanted(code).items():
            inputs = [*state, *changes] if name in ("tangent_part", "end_of_step") else state
            self._write(program, name, ("work", "out"), inputs, outputs[name])
        inputs = numbered("work", len(code.prologue.inputs))
        self.functions.append(write(code.prologue, "prologue", 1, ("work", "out"), inputs, numbered("out", self.constants)))

    def _loop_programs(self, code: LoopPrograms):
        found = {"t": "X t", "q": "X q", "v": "X v", "dq": "X dq", "dv": "X dv", "q1": "C", "v1": "O v", "a": "O a"}
        found |= {"dq1": "O dq", "dv1": "O dv", "terms": "R"}
        results = (*found, "constants", "psi", "safe", "distance", "rank")
        at = {x: ("work", self.places[found.get(x, x)]) for x in (*results, *code.scratch)}
        for name, program in self._wanted(code).items():
            self.loops.write(program, name, ("work", "out"), at | ({"a": ("out", 0)} if name == "accelerations" else {}))
        if self.cares:
            every = code.with_all_rows
            places = {x: f"careful {x}" for x in every.scratch}
            places |= {"v1": "careful v", "a": "careful a", "safe": "rank", "distance": "rank"}
            careful = at | {x: ("work", self.places[place]) for x, place in places.items()}
            for name, program in {
                "accelerations": every.accelerations,
                "newton_q": every.newton_q,
                "project_and_accelerate": every.project_and_accelerate,
                "tangent_part": every.tangent_part,
            }.items():
                self.loops.write(program, f"careful_{name}", ("work", "out"), careful)
        at = {"numbers": ("work", 0), "constants": ("out", 0)}
        self.loops.write(code.prologue, "prologue", ("work", "out"), at, width=1)

    def _wanted(self, code: Any) -> dict[str, Any]:
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
        if self.cares and isinstance(code, ScenePrograms):
            wanted["psi_dot"] = code.psi_dot
        return wanted

    def _write(self, program: Program, name: str, pointers: Sequence[str], inputs: list[Place], outputs: list[Place]):
        self.functions.append(write(program, name, self.plan.width, pointers, inputs, outputs, name in RARE))

    def _work(self, name: str, count: int) -> list[Place]:
        return [("work", self.places[name] + k) for k in range(count)]

    def _state(self) -> list[Place]:
        """The constants, and t, q and v in X."""
        counts = {"constants": self.constants, "X t": 1, "X q": self.n, "X v": self.n}
        return [place for name, count in counts.items() for place in self._work(name, count)]

    # --- helpers to write functions with

    def _function(self, name: str, arguments: Sequence[tuple[str, str]] = ((POINTER, "work"),)) -> tuple[Function, Lane]:
        f = Function(name, arguments, self.plan.width, rare=name in RARE)
        self.functions.append(f)
        return f, Lane(f, self.places)

    def _start(self, name: str, pointer: str) -> int:
        """Where an array is, in numbers from a pointer."""
        return (self.places if pointer == "work" else self.ways)[name] * self.plan.width

    def _vector(self, f: Function, name: str, r: Value, pointer: str = "work") -> Value:
        """One register of an array of coordinates."""
        return f.load(f.given[pointer], r * self.plan.vector + self._start(name, pointer), self.plan.vector)

    def _put(self, f: Function, name: str, r: Value, x: Value, pointer: str = "work"):
        f.store(x, f.given[pointer], r * self.plan.vector + self._start(name, pointer), self.plan.vector)

    def _over(self, f: Function, x: Value) -> Value:
        """A number of each lane, to go with registers of coordinates."""
        return x if x.width == self.plan.vector else f.repeat(x, self.plan.vector)

    def _largest(self, f: Function, values: Any) -> Value:
        """The largest, in each lane, of `values(r)` of each register; without what is not a number."""
        worst = f.variable(0.0, width=self.plan.vector)
        with f.each(self.rowcount) as r:
            for x in values(r):
                worst.value = f.max(x, worst.value)
        found = worst.value
        return found if self.plan.width > 1 else f.reduced("fmax", found)

    def _address(self, f: Function, name: str) -> Value:
        return f.at(f.given["work"], self.places[name] * self.plan.width)

    def _call(self, f: Function, name: str, out: str | None = None):
        f.call(name, f.given["work"], self._address(f, out) if out else f.given["work"])

    def _weighted(
        self, f: Function, row: np.ndarray, r: Value, names: Sequence[str] | None = None, pointer: str = "work"
    ) -> Value | None:
        """sum_j row_j a_j of one register of coordinates; None where all are zero."""
        total = None
        for weight, name in zip(row, names or self.stage_accelerations, strict=False):
            if weight != 0:
                a = self._vector(f, name, r, pointer)
                total = a * float(weight) if total is None else f.fma(a, float(weight), total)
        return total

    # --- one step

    def _attempt(self):
        """From P3 by `step` to `t1`: the state there in X q, O v, O a; its `error` and `distance`, of lanes that are `judged`."""
        f, s = self._function("attempt")
        method, stages = self.method, self.method.stages
        one = lambda: f.const(1.0, DOUBLE, f.width)  # noqa: E731
        s.ok = one()
        s.distance = f.const(np.inf, DOUBLE, f.width)
        begins = f.all_of((s.begin > 0.5) | (s.judged < 0.5))

        def take_stages():
            for i in range(1, stages):
                self._stage_state(f, s, i)
                self._stage(f, i)
                self._checked(f, s, f"A{i}")

        def clear_stages():
            # They may hold what is no number, of a member that failed: no time at all would still multiply that.
            with f.each(self.rowcount) as r:
                for i in range(1, stages):
                    self._put(f, f"A{i}", r, f.const(0.0, DOUBLE, self.plan.vector))

        f.choose(begins, clear_stages, take_stages)
        self._stage_state(f, s, stages)
        setattr(s, "X t", s.t1)
        if not self.plan.projected:
            self._call(f, "accelerations", "O a")
            self._checked(f, s, "O a")
            with f.each(self.rowcount) as r:
                self._put(f, "O v", r, self._vector(f, "X v", r))
            self._errors(f, s, "O a", "O dq", "O dv")
            with f.each(self.rowcount) as r:
                for d in ("dq", "dv"):
                    self._put(f, f"X {d}", r, self._vector(f, f"O {d}", r))
        else:
            if not method.ends:
                self._errors(f, s, None, "X dq", "X dv")
            self._newton(f, s, NEWTON_STEPS)
            self._call(f, "project_and_accelerate" if method.ends else "end_of_step")
            unsafe = (s.judged > 0.5) & (s.safe < 0.5)
            if self.cares:
                s.where(unsafe, ok=0.0)
            if method.ends:
                self._errors(f, s, "O a", "X dq", "X dv")
                self._dropping(f, s, f.const(NOTHING_LEFT, DOUBLE, f.width), lambda: self._call(f, "tangent_part"))
            if self.cares:
                again = (s.judged > 0.5) & (s.careful > 0.5)
                with f.if_(f.any_of(again)):
                    self._call(f, "arrive_carefully")
                    s.where(again, ok=1.0)
        q0, v0, q1, v1 = "P3 q", "P3 v", "X q", "O v"
        rtol = self._over(f, s.rtol)
        taken = TAKEN_BACK if self.plan.projected else 0.0

        def relative(r: Value) -> list[Value]:
            found = []
            for d, scale, y0, y1 in (("dq", "scale q", q0, q1), ("dv", "scale v", v0, v1)):
                left = self._vector(f, f"O {d}", r)
                if taken:
                    left = f.fma(self._vector(f, f"X {d}", r) - left, taken, left)
                size = f.max(f.abs(self._vector(f, y0, r)), f.abs(self._vector(f, y1, r)))
                found.append(f.abs(left) / f.fma(rtol, size, self._vector(f, scale, r)))
            return found

        # A number that is not finite is the largest of no comparison: zero times it is looked for instead.
        check = f.variable(0.0, width=self.plan.vector)
        with f.each(self.rowcount) as r:
            for x in (*relative(r), self._vector(f, "O a", r)):
                check.value = f.fma(x, 0.0, check.value)
        total = check.value if self.plan.width > 1 else self._summed(f, check.value)
        s.error = self._largest(f, relative)
        s.where((s.ok < 0.5) | total.is_not(0.0), error=np.nan)
        s.where(~(s.distance >= 0.0), distance=0.0)

    def _summed(self, f: Function, x: Value) -> Value:
        name = f"llvm.vector.reduce.fadd.v{x.width}f64"
        f.declared.add(f"declare double @{name}(double, {x.type})")
        return f.op(f"call double @{name}(double {f.const(0.0).name}, {x.type} {x.name})", DOUBLE)

    def _stage_state(self, f: Function, s: Lane, i: int, start: str = "P3", step: Value | None = None):
        """t, q and v of stage i in X, of the step from a point."""
        step = s.step if step is None else step
        method, h, names = self.method, self._over(f, step), [f"{start} a", *self.stage_accelerations[1:]]
        setattr(s, "X t", f.fma(step, float(method.nodes[i]), getattr(s, f"T{start[1:]}")))
        with f.each(self.rowcount) as r:
            q, v = self._vector(f, f"{start} q", r), self._vector(f, f"{start} v", r)
            sum_q, sum_v = self._weighted(f, method.q[i], r, names), self._weighted(f, method.v[i], r, names)
            slope = v * float(method.nodes[i]) if sum_q is None else f.fma(h, sum_q, v * float(method.nodes[i]))
            self._put(f, "X q", r, f.fma(h, slope, q))
            self._put(f, "X v", r, v if sum_v is None else f.fma(h, sum_v, v))

    def _checked(self, f: Function, s: Lane, name: str):
        """What becomes of accelerations whose pivots are too small to be trusted."""
        if not self.cares:
            return
        unsafe = (s.judged > 0.5) & (s.safe < 0.5)
        with f.if_(f.any_of(unsafe)):
            f.choose(
                f.any_of(unsafe & (s.careful > 0.5)),
                lambda: self._call(f, "accelerate_carefully", name),
                lambda: s.where(unsafe, ok=0.0),
            )

    def _errors(self, f: Function, s: Lane, end: str | None, to_q: str, to_v: str):
        """Of q and v, from the accelerations of all stages; `end`: those at the end, where they are the last stage's."""
        h = self._over(f, s.step)
        names = list(self.stage_accelerations)
        if self.method.ends and end:
            names[-1] = end
        kept, self.stage_accelerations = self.stage_accelerations, names
        with f.each(self.rowcount) as r:
            error_q, error_v = self._weighted(f, self.method.error_q, r), self._weighted(f, self.method.error_v, r)
            zero = f.const(0.0, DOUBLE, self.plan.vector)
            self._put(f, to_q, r, zero if error_q is None else h * (h * error_q))
            self._put(f, to_v, r, zero if error_v is None else h * error_v)
        self.stage_accelerations = kept

    def _newton(self, f: Function, s: Lane, steps: int, which: str = "judged"):
        """Newton's method to Psi = 0 of lanes that are `judged`, until it moves nothing but rounding errors."""

        def closer(moving: Value):
            self._call(f, "newton_q")
            s.where(moving & (s.safe < 0.5), ok=0.0)

        self._to_manifold(f, s, getattr(s, which) > 0.5, closer, steps)

    def _to_manifold(self, f: Function, s: Lane, mask: Value, closer: Callable[[Value], None], steps: int = NEWTON_STEPS):
        """Newton's method of some lanes: `closer` leaves X q nearer to the manifold in C."""
        s.moving = f.select(mask, f.const(1.0, DOUBLE, f.width), 0.0)
        k = f.variable(0, INT, 1)
        with f.while_(lambda: f.any_of(s.moving > 0.5) & (k.value < steps)):
            moving = s.moving > 0.5
            closer(moving)
            change = self._moved(f, moving)
            s.moving = f.select(moving & ~(change <= FAR), f.const(1.0, DOUBLE, f.width), 0.0)
            k.value = k.value + 1

    def _moved(self, f: Function, moving: Value) -> Value:
        """Take X q from C in lanes that move; return the largest change, in the scene's own units."""

        def change(r: Value) -> list[Value]:
            old, new = self._vector(f, "X q", r), self._vector(f, "C", r)
            self._put(f, "X q", r, f.select(moving, new, old))
            return [f.abs(new - old) * self._vector(f, "inverse unit", r)]

        return self._largest(f, change)

    def _dropping(self, f: Function, s: Lane, threshold: Value, do: Any):
        """What is done with another threshold of pivots."""
        if self.drop is None:
            do()
            return
        place = (self.places["constants"] + self.drop) * f.width
        before = f.load(f.given["work"], place, f.width)
        f.store(threshold, f.given["work"], place, f.width)
        do()
        f.store(before, f.given["work"], place, f.width)

    # --- whether it counts

    def _decide(self):
        """Accept or reject the step of lanes that are `judged`, and choose the next one; `until`: outputs up to there are due."""
        f, s = self._function("decide")
        where, yes = f.select, f.const(1.0, DOUBLE, f.width)
        inf = f.const(np.inf, DOUBLE, f.width)
        judged, careful, error = s.judged > 0.5, s.careful > 0.5, s.error
        begin = s.begin > 0.5
        bad = judged & ~(error < np.inf)
        # --- doubt, and steps a little shorter instead
        if self.doubts:
            doubt = bad & ~careful
            far_from_here = self._far(f, s, s.distance2)
            beside = judged & ~careful & (error < 1.0) & ~self._far(f, s, s.distance) & (s.last < 0.5)
            left = self._ahead(f, s)
            past = (left > 0.0) & (left < s.h * SURE) & (s.distance * left > s.distance2 * EXPECTED * (s.h - left))
            beside = beside & ~(past & self._far(f, s, s.distance, PAST))
            dodge = (doubt | beside) & far_from_here & (s.dodged < float(DODGES)) & ~begin
            s.where(judged, dodged=where(dodge, s.dodged + 1.0, 0.0))
            doubt = doubt & ~dodge
            s.doubt = where(doubt, yes, 0.0)
            judged = judged & ~doubt
        else:
            s.doubt = f.const(0.0, DOUBLE, f.width)
            dodge = f.const(False, BOOL, f.width)
        tried = where(judged, s.tried + 1.0, s.tried)
        again = f.const(False, BOOL, f.width)
        if self.pieces:
            s.again = where(judged, yes, 0.0)
            f.call("leave", f.given["work"])
            again = s.again > 0.5
        accept = judged & (error < 1.0) & ~dodge & ~again
        stepped, begun = ~begin, judged & begin
        # --- the next step
        order, step = self.method.order, s.t1 - s.T3
        size = where(f.is_finite(error), f.max(error, 1e-30), 1e30)
        rate = size / power(f, step, float(int(order)), whole=True)
        foreseen = size * f.min(rate / s.rate, STEEPEST)
        steep = accept & (foreseen > 1.0)
        aim = where(steep, foreseen * (SAFETY**order / FORESEEN), size)
        factor = power(f, aim, -1.0 / order) * SAFETY
        factor = f.max(factor, where(accept & ~steep, yes, SHRINK))
        factor = f.min(factor, where(accept, f.const(GROW, DOUBLE, f.width), SAFETY))
        h = where(judged, step * where(dodge, f.const(DODGE, DOUBLE, f.width), factor), s.h)
        h = where(again, s.h, h)
        failed = judged & ~accept & stepped & ~again
        if self.doubts:
            h = where(failed, self._around(f, s, left, step, h), h)
        s.behind = h
        with f.if_(f.any_of(begun)):
            s.behind = where(begun, self._first_step(f, s), s.behind)
        h = s.behind
        code = where(judged & (h < s.smallest), f.const(STEP_TOO_SMALL, DOUBLE, f.width), s.code)
        code = where(code.is_(float(RUNNING)) & judged & (tried >= s.max_steps), STEP_LIMIT, code)
        code = where(judged & bad & begin & ~accept, where(code.is_(float(RUNNING)), STEP_TOO_SMALL, code), code)
        code = where(accept & (s.last > 0.5), DONE, code)
        # --- where it stands
        with f.if_(f.any_of(accept)):
            for k in range(POINTS - 1):
                self._moved_point(f, accept, f"P{k + 1}", f"P{k}")
                s.where(accept, **{f"T{k}": getattr(s, f"T{k + 1}")})
            self._moved_point(f, accept, ("X q", "O v", "O a"), f"P{POINTS - 1}")
            s.where(accept, T3=s.t1)
            s.where(accept, distance0=s.distance1)
            s.where(accept, distance1=s.distance2)
            s.where(accept, distance2=s.distance)
            if self.m:
                s.where(accept, tolerance=self._tolerance(f, s, "P3 v"))
            self._accepted(f, s, accept)
        s.where(accept & stepped, rate=rate)
        first = s.tried < 0.0
        if self.plan.breaks:
            h = where(accept & stepped & (step < s.h * CUT), f.max(h, s.h), h)
            h = where(begun & (tried > 0.0), s.h * CAUTIOUS, h)
            s.where(begun, rate=inf, distance0=inf, distance1=inf)
            s.where(judged, steps=where(begin, s.steps + where(begun & accept, yes, 0.0), s.steps + where(accept, yes, 0.0)))
            s.where(accept & (s.lands > 0.5), steps=-1.0)
        del first
        cost = where(begin, f.const(1.0, DOUBLE, f.width), float(self.method.stages))
        cost = where(careful, cost * 2.0 + where(begin, f.const(0.0, DOUBLE, f.width), 1.0), cost)
        s.where(judged, evaluations=s.evaluations + cost, tried=tried, h=h, code=code)
        # --- outputs
        ready = accept & ((s.accepted > 0.0) | (stepped & (s.last > 0.5)))
        until = where(ready, s.t1, -np.inf)
        if self.plan.breaks:
            enough = ~begun & ((s.steps >= float(POINTS - 1)) | (s.lands > 0.5) | (s.last > 0.5) | (s.steps < 0.0))
            until = where(enough, until + where(s.lands > 0.5, s.smallest * GAP, 0.0), -np.inf)
        s.until = until
        s.where(accept, accepted=s.accepted + 1.0)

    def _leave(self):
        """What becomes of a step that ends in another piece of the motion, of lanes in `again`: whether it lands there, or not.

        Else it is taken `again`, to end just before the piece does. The next step is a tiny one across,
        behind which the run starts anew: so also what is known of accelerations at the ends of steps belongs to one piece.
        """
        f, s = self._function("leave")
        where, yes, inf = f.select, f.const(1.0, DOUBLE, f.width), f.const(np.inf, DOUBLE, f.width)

        def pieces(t: Value, state: Callable[[Value], tuple[Value, Value]]):
            setattr(s, "X t", t)
            with f.each(self.rowcount) as r:
                for x, value in zip("qv", state(r), strict=True):
                    self._put(f, f"X {x}", r, value)
            self._call(f, "pieces")

        def moved() -> Value:
            found = f.variable(f.const(False, BOOL, f.width), BOOL)
            with f.each(self.pieces) as k:
                one, other = (f.load(f.given["work"], k * f.width + self._start(x, "work"), f.width) for x in ("G", "G0"))
                found.value = found.value | one.is_not(other)
            return found.value

        with f.each(self.rowcount) as r:
            self._put(f, "C", r, self._vector(f, "X q", r))
        pieces(s.T3, lambda r: (self._vector(f, "P3 q", r), self._vector(f, "P3 v", r)))
        with f.each(self.pieces) as k:
            f.store(
                f.load(f.given["work"], k * f.width + self._start("G", "work"), f.width),
                f.given["work"],
                k * f.width + self._start("G0", "work"),
                f.width,
            )
        pieces(s.t1, lambda r: (self._vector(f, "C", r), self._vector(f, "O v", r)))
        judged, step = s.again > 0.5, s.t1 - s.T3
        leaves = judged & (s.begin < 0.5) & moved() & f.is_finite(s.error)
        s.share, s.low = yes, f.const(0.0, DOUBLE, f.width)
        with f.if_(f.any_of(leaves)), f.each(HALVINGS):
            middle = (s.low + s.share) * 0.5
            s.behind = middle
            pieces(f.fma(middle, step, s.T3), lambda r: self._on_the_way(f, s.behind, step, r))
            other = moved()
            s.where(leaves & other, share=s.behind)
            s.where(leaves & ~other, low=s.behind)
        setattr(s, "X t", s.t1)
        with f.each(self.rowcount) as r:
            self._put(f, "X q", r, self._vector(f, "C", r))
            self._put(f, "X v", r, self._vector(f, "O v", r))
        share, aim, good = s.share, s.aim, s.error < 1.0
        again = leaves & aim.is_not(float(AIM_ACROSS)) & (s.tries < float(TRIES))
        exact = f.min(share, yes - share) <= EXACT
        s.where(leaves & ~again, lands=1.0)
        short = (s.t1 < s.crossing - s.smallest) & (s.lands < 0.5)
        reached = judged & good & ~leaves & ~short & aim.is_(float(AIM_BEFORE))
        across = reached | (again & (share <= EDGE))
        before, beyond = (f.const(float(x), DOUBLE, f.width) for x in (AIM_BEFORE, AIM_BEYOND))
        aim = where(again, where(exact, before, beyond), where(short, aim, beyond))
        expected = f.fma(where(exact, share - EDGE / 2, share + EXACT / 2), step, s.T3)
        crossing = where(again, expected, where(short, s.crossing, inf))
        crossing = where(across, f.fma(s.h, EDGE, where(reached, s.t1, s.T3)), crossing)
        tries = where(again, s.tries + 1.0, where(good, 0.0, s.tries))
        s.where(judged, crossing=crossing, aim=where(across, f.const(float(AIM_ACROSS), DOUBLE, f.width), aim), tries=tries)
        s.again = where(again, yes, 0.0)

    def _on_the_way(self, f: Function, share: Value, step: Value, r: Value) -> tuple[Value, Value]:
        """q and v a share of the step ahead, on the polynomial through its two ends (one register)."""
        x, h = self._over(f, share), self._over(f, step)

        def along(*coefficients: float) -> Value:
            total = f.const(coefficients[-1], DOUBLE, self.plan.vector)
            for c in reversed(coefficients[:-1]):
                total = f.fma(total, x, c)
            return total

        ends = [self._vector(f, name, r) for name in ("P3 q", "C", "P3 v", "O v", "P3 a", "O a")]
        weights = [
            (1.0, 0.0, 0.0, -10.0, 15.0, -6.0),
            (0.0, 0.0, 0.0, 10.0, -15.0, 6.0),
            (0.0, 1.0, 0.0, -6.0, 8.0, -3.0),
            (0.0, 0.0, 0.0, -4.0, 7.0, -3.0),
            (0.0, 0.0, 0.5, -1.5, 1.5, -0.5),
            (0.0, 0.0, 0.0, 0.5, -1.0, 0.5),
        ]
        scales = (None, None, h, h, h * h, h * h)
        q = v = f.const(0.0, DOUBLE, self.plan.vector)
        for end, c, scale in zip(ends, weights, scales, strict=True):
            scaled = end if scale is None else end * scale
            q = f.fma(along(*c), scaled, q)
            v = f.fma(along(*(k * c[k] for k in range(1, 6))), scaled, v)
        return q, v / h

    def _moved_point(self, f: Function, mask: Value, source: Any, to: str):
        sources = source if isinstance(source, tuple) else [f"{source} {x}" for x in "qva"]
        with f.each(self.rowcount) as r:
            for name, x in zip(sources, "qva", strict=True):
                self._put(f, f"{to} {x}", r, f.select(mask, self._vector(f, name, r), self._vector(f, f"{to} {x}", r)))

    def _tolerance(self, f: Function, s: Lane, name: str) -> Value:
        """What the fastest velocity may err, in its unit."""
        fastest = self._largest(f, lambda r: [f.abs(self._vector(f, name, r)) * self._vector(f, "inverse unit", r)])
        return f.fma(s.rtol, fastest / s.omega, s.atol)

    def _far(self, f: Function, s: Lane, distance: Value, rounding: float = BEFORE) -> Value:
        """Whether a step as long as the one that is tried may begin so far away from singular configurations."""
        return (distance > NEAREST) & (distance * distance * distance * s.tolerance > s.h * s.omega * rounding)

    def _ahead(self, f: Function, s: Lane) -> Value:
        """The time that is left until a singular configuration: a root of the parabola through three distances."""
        t2, t1, t0, d2, d1, d0 = s.T1, s.T2, s.T3, s.distance0, s.distance1, s.distance2
        slope, before = (d0 - d1) / (t0 - t1), (d1 - d2) / (t1 - t2)
        curve = (slope - before) / (t0 - t2)
        slope = slope + curve * (t0 - t1)
        return -d0 / (slope - curve * (d0 / slope))

    def _around(self, f: Function, s: Lane, left: Value, step: Value, otherwise: Value) -> Value:
        """In place of a step that failed, one with its nodes far from the singular configuration ahead."""
        low, high = (float(x) for x in self.method.clearings)
        share = left / step
        across = left / f.select(share < low, f.const(low, DOUBLE, f.width), high)
        clear = self._far(f, s, s.distance2 * low * step / left)
        up_to = f.select((share < 1.0 + low) & clear, left - step * low, step)
        found = f.select(share < high, across, up_to)
        return f.select((found > step * SHORTEST) & (found < step * LONGEST), found, otherwise)

    def _first_step(self, f: Function, s: Lane) -> Value:
        """As given, or one over which the state changes by a small part of itself (first_step.py)."""
        rtol = self._over(f, s.rtol)

        def relative(of_q: str, of_v: str) -> Any:
            def both(r: Value) -> list[Value]:
                return [
                    f.abs(self._vector(f, name, r)) / f.fma(rtol, f.abs(self._vector(f, y, r)), self._vector(f, scale, r))
                    for name, y, scale in ((of_q, "X q", "scale q"), (of_v, "O v", "scale v"))
                ]

            return both

        size, rate = self._largest(f, relative("X q", "O v")), self._largest(f, relative("O v", "O a"))
        span = s.end - s.start
        ordinary = f.is_finite(rate) & (rate > 0.0) & (size > 0.0)
        chosen = f.select(ordinary, f.min(size / f.select(ordinary, rate, 1.0) * 0.01, span), span * 1e-4)
        return f.select(s.first > 0.0, f.min(s.first, span), chosen)

    # --- where the next step ends

    def _aim(self, f: Function, s: Lane):
        """`t1`, `step`, `begin`, `last` and `lands` of the next step of each lane (breakpoints.py)."""
        where, yes = f.select, f.const(1.0, DOUBLE, f.width)
        begin = (s.steps if self.plan.breaks else s.tried) < 0.0
        t1 = s.T3 + s.h
        last = (t1 >= s.end - s.smallest) & ~begin
        if not self.plan.breaks:
            t1 = where(last, s.end, t1)
            s.lands = f.const(0.0, DOUBLE, f.width)
        else:
            here = s.T3
            s.t1, s.behind = f.const(np.inf, DOUBLE, f.width), here
            self._each_break(f, s, here)
            end = s.t1
            crossing = s.crossing if self.pieces else f.const(np.inf, DOUBLE, f.width)
            stop = f.min(end, crossing)
            rest = f.min(stop, s.end) - here
            parts = f.max(float(POINTS - 1) - s.steps, 1.0)
            share = here + rest / parts
            several = (s.steps < float(POINTS - 2)) & (t1 > share) & (rest > s.smallest * (2.0 * POINTS)) & ~begin
            if self.pieces:
                several = several & s.aim.is_not(float(AIM_ACROSS))
            t1 = where(several, share, t1)
            reaches = (t1 >= stop - s.smallest * 2.0) & (stop < s.end - s.smallest) & ~begin
            last = last & ~reaches & ~several
            final = s.end - f.max(s.end - end, 0.0)
            t1 = where(reaches, stop, where(last, final, t1))
            t1 = where(begin, s.behind, t1)
            s.lands = where(reaches & (end <= crossing), yes, 0.0)
        t1 = where(begin, s.behind if self.plan.breaks else s.T3, t1)
        s.t1 = t1
        s.step = where((s.judged > 0.5) & ~begin, t1 - s.T3, 0.0)
        s.begin = where(begin, yes, 0.0)
        s.last = where(last, yes, 0.0)

    def _each_break(self, f: Function, s: Lane, here: Value):
        """t1: just before the next breakpoint; behind: just behind all of those that are here."""
        call = f.given["call"]
        knots, width = f.load(call, self.call.index("knots"), base=INT), f.width
        with f.each(knots) as k:
            if width == 1:
                at = self._input(f, call, "breaks", s.member, k)
            else:
                f.call("gather", f.given["work"], call, k)
                at = s.due
            ahead = at > here + s.smallest
            s.t1 = f.select(ahead, f.min(at - s.smallest * ENDS_BEFORE, s.t1), s.t1)
            passed = at <= here + s.smallest * SAME
            s.behind = f.select(passed, f.max(at + s.smallest * BEGINS_BEHIND, s.behind), s.behind)

    def _input(self, f: Function, call: Value, name: str, member: Value, k: Value) -> Value:
        """The k-th number of an input of a member (one lane)."""
        return f.load(self._of_member(f, call, name, member), k)

    def _of_member(self, f: Function, call: Value, name: str, member: Value) -> Value:
        """The address of what an input holds of a member (one lane)."""
        number = member if member.base == INT else self._whole(f, member)
        stride = f.load(call, self.call.index(f"{name} stride"), base=INT)
        pointer = f.load(call, self.call.index(name), base=POINTER)
        return f.at(pointer, number * stride)

    # --- states between steps

    def _differences(self, name: str = "differences", to: tuple[str, Places] | None = None):
        """Newton's divided differences of the last points, the latest first: of their states, or of changes of these."""
        pointer = to[0] if to else "work"
        f, s = self._function(name, [(POINTER, x) for x in ("work", *([pointer] if to else []))])
        times = [getattr(s, f"T{POINTS - 1 - k}") for k in range(POINTS)]
        step = times[0] - times[1]
        inverse: dict[tuple[int, int], Value] = {}
        for i in range(POINTS):
            for j in range(i + 1, POINTS):
                d = times[j] - times[i]
                inverse[i, j] = self._over(f, 1.0 / f.select(d.is_(0.0), 1.0, d))
        used: list[Value | None] = [None, None]
        sofar: Value | None = None
        for k in range(1, POINTS - 1):
            near = (times[k] - times[k + 1]) * STRETCH >= step
            sofar = near if sofar is None else sofar & near
            used.append(sofar)
        with f.each(self.rowcount) as r:
            known = {x: [self._vector(f, f"P{POINTS - 1 - k} {x}", r, pointer) for k in range(POINTS)] for x in "qva"}
            column = [x for x in known["q"] for _ in range(3)]
            given = {1: known["v"], 2: [a * 0.5 for a in known["a"]]}
            self._put(f, "N0", r, column[0], pointer)
            for degree in range(1, 3 * POINTS):
                following = []
                for i in range(3 * POINTS - degree):
                    one, two = i // 3, (i + degree) // 3
                    following.append(given[degree][one] if one == two else (column[i + 1] - column[i]) * inverse[one, two])
                column = following
                mask = used[degree // 3]
                self._put(f, f"N{degree}", r, column[0] if mask is None else f.select(mask, column[0], 0.0), pointer)

    def _between(self, name: str = "between", to: tuple[str, Places] | None = None):
        """The polynomial at the time `next`."""
        pointer = to[0] if to else "work"
        f, s = self._function(name, [(POINTER, x) for x in ("work", *([pointer] if to else []))])
        ahead = [self._over(f, s.next - getattr(s, f"T{POINTS - 1 - k}")) for k in range(POINTS)]
        if not to:
            setattr(s, "X t", s.next)
        with f.each(self.rowcount) as r:
            q, v = self._vector(f, f"N{3 * POINTS - 1}", r, pointer), f.const(0.0, DOUBLE, self.plan.vector)
            for k in reversed(range(3 * POINTS - 1)):
                d = ahead[k // 3]
                v = f.fma(v, d, q)
                q = f.fma(q, d, self._vector(f, f"N{k}", r, pointer))
            self._put(f, "X q", r, q, pointer)
            self._put(f, "X v", r, v, pointer)

    def _outputs(self):
        """Write the states at output times up to `until`."""
        f, s = self._function("outputs", [(POINTER, "work"), (POINTER, "call")])
        call = f.given["call"]
        inner = f.load(call, self.call.index("times"), base=INT) - 1

        def due() -> Value:
            s.due = f.select((s.next <= s.until) & (s.written + 1.0 < inner), f.const(1.0, DOUBLE, f.width), 0.0)
            return f.any_of(s.due > 0.5)

        with f.if_(due()):
            f.call("differences", f.given["work"])
            with f.while_(due):
                f.call("between", f.given["work"])
                self._settle(f, s, "due")
                self._interpolated(f, s)
                with f.each(f.width) as k, f.if_(f.lane(s.due, k) > 0.5):
                    number = self._whole(f, f.lane(s.written, k)) + 1
                    self._write_state(f, s, call, k, number, "X q", "O v")
                    f.store(
                        self._input(f, call, "ts", f.lane(s.member, k), number + 1),
                        f.given["work"],
                        k + self.places["next"] * f.width,
                    )
                s.where(s.due > 0.5, written=s.written + 1.0)

    def _settle(self, f: Function, s: Lane, which: str):
        """Return X q and X v to the manifold, as X q and O v; `violated` is how far they are from it."""
        if self.plan.projected:
            tolerance = self._tolerance(f, s, "X v")
            threshold = f.min(f.max(TURNED / tolerance, NOTHING_LEFT), USELESS)
            if not self.doubts:
                threshold = None

            def close():
                self._newton(f, s, OUTPUT_STEPS, which)
                self._call(f, "newton_v_and_psi")

            close() if threshold is None else self._dropping(f, s, threshold, close)
        else:
            self._call(f, "psi")
            with f.each(self.rowcount) as r:
                self._put(f, "O v", r, self._vector(f, "X v", r))
        worst = f.variable(0.0)
        if self.m:
            with f.each(self.m) as i:
                place = i * f.width + self.places["psi"] * f.width
                psi = f.load(f.given["work"], place, f.width)
                scale = f.load(f.given["work"], i * f.width + self.places["rows"] * f.width, f.width)
                x = f.abs(psi) / scale
                worst.value = f.select((x > worst.value) | x.is_not(x), x, worst.value)  # what is none stays
        s.violated = worst.value

    def _write_state(self, f: Function, s: Lane, call: Value, k: Value, number: Value, q: str, v: str):
        """State number `number` of lane k into the outputs."""
        member = self._whole(f, f.lane(s.member, k))
        times = f.load(call, self.call.index("times"), base=INT)
        row = member * times + number
        for name, x in (("qs", q), ("vs", v)):
            self._copied(f, f.at(f.load(call, self.call.index(name), base=POINTER), row * self.n), 0, x, k)
        f.store(f.lane(s.violated, k), f.load(call, self.call.index("violation"), base=POINTER), row)

    def _copied(self, f: Function, to: Value, start: int, name: str, k: Value, pointer: str = "work"):
        """The coordinates of lane k to an address."""
        with f.each(self.n) as i:
            f.store(f.load(f.given[pointer], i * f.width + k + self._start(name, pointer)), to, i + start)

    def _whole(self, f: Function, x: Value) -> Value:
        return f.op(f"fptosi double {x.name} to i64", INT)

    def _call_of(self, f: Function) -> Value:
        """What `run` was told."""
        return f.load(f.given["work"], self.places["call"] * f.width, base=POINTER)

    # --- with care

    def _number(self, f: Function, name: str, k: Value, i: Any) -> Value:
        """The i-th number of an array, of lane k."""
        return f.load(f.given["work"], f.like(i, INT, 1) * f.width + self.places[name] * f.width + k)

    def _entries(self, f: Function) -> Any:
        """What is done for every entry of D: its row, column, place among the values, and sign."""
        table = Value(f, "@entries", POINTER)
        with f.each(len(self.code.pattern.entries)) as e:
            yield tuple(f.load(table, e * 4 + j, base=INT) for j in range(4))

    def _solve(self):
        """`solve`: x = D^+ right of one lane, with the rows weighted; D is that of R."""
        n, m = self.n, self.m
        table = [x for e in self.code.pattern.entries for x in (e.row, e.column, e.slot, e.sign)]
        self.loops.globals.append(f"@entries = private constant [{len(table)} x i64] [{', '.join(f'i64 {x}' for x in table)}]")
        arguments = [(POINTER, "work"), (INT, "lane"), (POINTER, "right"), (POINTER, "x"), (DOUBLE, "tol")]
        f, s = self._function("solve", arguments)
        k, right = f.given["lane"], f.given["right"]
        D, b = (Value(f, f.reserve(DOUBLE, max(c, 1)), POINTER) for c in (m * n, m))
        with f.each(m * n) as i:
            f.store(0.0, D, i)
        length = f.lane(s.length, k)
        with f.each(m) as i:
            f.store(f.load(right, i) * length / self._number(f, "rows", k, i), b, i)
        for row, column, slot, sign in self._entries(f):
            weight = length / self._number(f, "rows", k, row)
            f.store(self._number(f, "R", k, slot) * weight * sign, D, row * n + column)
        rank = f.at(f.given["work"], k + self.places["rank"] * f.width)
        f.call(LEAST_NORM, D, b, f.given["x"], *(f.const(c, INT) for c in (m, n)), f.given["tol"], rank)

    def _care(self):
        """What a rank-revealing method on all rows finds, of lanes that want care, one after the other."""
        code, p, n, m, width = self.code, self.places, self.n, self.m, self.plan.width
        slots, number, one = code.pattern.slots, self._number, lambda f: f.const(1.0, DOUBLE, width)

        def put(f: Function, name: str, k: Value, i: Value, x: Value):
            f.store(x, f.given["work"], (i + p[name]) * width + k)

        def each_lane(f: Function, mask: Value) -> Any:
            marked = f.select(mask, one(f), 0.0)
            right, x = (Value(f, f.reserve(DOUBLE, c), POINTER) for c in (m, n))
            with f.each(width) as k, f.if_(f.lane(marked, k) > 0.5):
                yield k, right, x

        def solved(f: Function, k: Value, right: Value, x: Value, name: str, start: int = 0):
            """`x` of a lane, with D and what else is in R of the state in X."""
            with f.each(m) as i:
                f.store(number(f, name, k, i + start), right, i)
            f.call("solve", f.given["work"], k, right, x, number(f, "care", k, 0))

        def root(f: Function, k: Value, i: Value) -> Value:
            return number(f, "R", k, i + (slots + m + n))

        # The accelerations of lanes whose pivots were not safe.
        f, s = self._function("accelerate_carefully", [(POINTER, "work"), (POINTER, "out")])
        self._call(f, "equation_terms")
        for k, right, x in each_lane(f, (s.judged > 0.5) & (s.careful > 0.5) & (s.safe < 0.5)):
            solved(f, k, right, x, "R", slots)
            with f.each(n) as i:
                a = f.fma(root(f, k, i), f.load(x, i), number(f, "R", k, i + (slots + m)))
                f.store(a, f.given["out"], i * width + k)
        # The end of a step taken with care: Newton's method in position, velocities and accelerations there where the pivots are
        # not safe; and, whether they are or not, what projection leaves of the errors.
        f, s = self._function("arrive_carefully", [(POINTER, "work"), (POINTER, "out")])
        careful = (s.judged > 0.5) & (s.careful > 0.5)

        def closer(moving: Value):
            self._call(f, "equation_terms")
            self._call(f, "psi")
            with f.each(self.rowcount) as r:
                self._put(f, "C", r, self._vector(f, "X q", r))
            for k, right, x in each_lane(f, moving):
                solved(f, k, right, x, "psi")
                with f.each(n) as i:
                    put(f, "C", k, i, number(f, "X q", k, i) - root(f, k, i) * f.load(x, i))

        self._to_manifold(f, s, careful & (s.ok < 0.5), closer)
        self._call(f, "equation_terms")
        doubtful = careful & (s.ok < 0.5)
        with f.if_(f.any_of(doubtful)):
            self._call(f, "psi_dot")
            for k, right, x in each_lane(f, doubtful):
                solved(f, k, right, x, "psi")
                with f.each(n) as i:
                    put(f, "O v", k, i, number(f, "X v", k, i) - root(f, k, i) * f.load(x, i))
            with f.each(self.rowcount) as r:
                self._put(f, "X v", r, f.select(doubtful, self._vector(f, "O v", r), self._vector(f, "X v", r)))
            self._call(f, "accelerations", "C")
            with f.each(self.rowcount) as r:
                self._put(f, "O a", r, f.select(doubtful, self._vector(f, "C", r), self._vector(f, "O a", r)))
            with f.if_(f.any_of(doubtful & (s.safe < 0.5))):
                f.call("accelerate_carefully", f.given["work"], self._address(f, "O a"))
        for k, right, x in each_lane(f, careful):
            for d in ("dq", "dv"):
                with f.each(m) as i:
                    f.store(0.0, right, i)
                for row, column, slot, sign in self._entries(f):
                    part = number(f, "R", k, slot) * sign * number(f, f"X {d}", k, column) / root(f, k, column)
                    f.store(f.load(right, row) + part, right, row)
                f.call("solve", f.given["work"], k, right, x, f.const(np.sqrt(NOTHING_LEFT)))
                with f.each(n) as i:
                    put(f, f"O {d}", k, i, number(f, f"X {d}", k, i) - root(f, k, i) * f.load(x, i))

    def _care_by_loops(self):
        """As `_care`, of a large scene: by elimination of all rows, without those whose pivots are small."""
        f, s = self._function("accelerate_carefully", [(POINTER, "work"), (POINTER, "out")])
        self._call(f, "careful_accelerations")
        self._take(f, (s.judged > 0.5) & (s.careful > 0.5) & (s.safe < 0.5), "careful a", "out")
        f, s = self._function("arrive_carefully", [(POINTER, "work"), (POINTER, "out")])
        careful, doubtful = (s.judged > 0.5) & (s.careful > 0.5), s.ok < 0.5
        self._to_manifold(f, s, careful & doubtful, lambda moving: self._call(f, "careful_newton_q"))
        with f.if_(f.any_of(careful & doubtful)):
            self._call(f, "careful_project_and_accelerate")
            for x in "va":
                self._take(f, careful & doubtful, f"careful {x}", f"O {x}")
        self._dropping(f, s, f.const(NOTHING_LEFT, DOUBLE, f.width), lambda: self._call(f, "careful_tangent_part"))

    def _take(self, f: Function, mask: Value, source: str, to: str):
        """An array of coordinates from another, in some lanes."""
        start = 0 if to == "out" else self.places[to] * f.width
        pointer = f.given["out" if to == "out" else "work"]
        with f.each(self.rowcount) as r:
            place = r * self.plan.vector + start
            old = f.load(pointer, place, self.plan.vector)
            f.store(f.select(mask, self._vector(f, source, r), old), pointer, place, self.plan.vector)

    # --- members

    def _begin(self):
        """Take a member into a lane."""
        arguments = [(POINTER, "work"), (POINTER, "call"), (INT, "lane"), (INT, "member")]
        f, _ = self._function("begin", arguments)
        p, width, call, k, member = self.places, self.plan.width, f.given["call"], f.given["lane"], f.given["member"]
        work = f.given["work"]

        def put(name: str, value: Any, i: Any = 0):
            f.store(value, work, f.like(i, INT, 1) * width + p[name] * width + k)

        for name in _LANE:
            if name not in SETTINGS and name not in ("judged", "call", "ways"):
                put(name, 0.0)
        given = self._of_member(f, call, "settings", member)
        settings = {name: f.load(given, j) for j, name in enumerate(SETTINGS)}
        for name, value in settings.items():
            put(name, value)
        constants = Value(f, f.reserve(DOUBLE, max(self.constants, 1)), POINTER)
        f.call("prologue", self._of_member(f, call, "numbers", member), constants)
        with f.each(self.constants) as i:
            put("constants", f.load(constants, i), i)
        q, v = self._of_member(f, call, "q", member), self._of_member(f, call, "v", member)
        with f.each(self.n) as i:
            angle = f.arithmetic("sub", i, f.arithmetic("div", i, 3) * 3).is_(2)
            unit = f.select(angle, f.const(1.0), settings["length"])
            put("inverse unit", 1.0 / unit, i)
            put("scale q", settings["atol"] * unit, i)
            put("scale v", settings["atol"] * unit * settings["omega"], i)
            for j in range(POINTS):
                put(f"P{j} q", f.load(q, i), i)
                put(f"P{j} v", f.load(v, i), i)
                put(f"P{j} a", 0.0, i)
        if self.m:
            rows = self._of_member(f, call, "rows", member)
            with f.each(self.m) as i:
                put("rows", f.load(rows, i), i)
        ts = self._of_member(f, call, "ts", member)
        times = f.load(call, self.call.index("times"), base=INT)
        start, end = f.load(ts), f.load(ts, times - 1)
        for name, value in (("start", start), ("end", end), ("next", f.load(ts, 1)), ("rate", np.inf), ("crossing", np.inf)):
            put(name, value)
        for j in range(POINTS):
            put(f"T{j}", start)
        for name in (f"distance{j}" for j in range(POINTS - 1)):
            put(name, np.inf)
        for name in ("tried", "accepted", "steps"):
            put(name, -1.0)
        put("active", 1.0)
        put("tolerance", settings["atol"])
        put("member", f.op(f"sitofp i64 {member.name} to double", DOUBLE))
        self._begun(f, k, member)

    def _finish(self):
        """Write what is left of the members whose lanes are marked in `due`: their first and last states, and how they ended."""
        f, s = self._function("finish_members", [(POINTER, "work"), (POINTER, "call")])
        p, width, call, work = self.places, self.plan.width, f.given["call"], f.given["work"]
        times = f.load(call, self.call.index("times"), base=INT)
        # Why the step size fell to nothing: a number that is not finite, at the end or right ahead, or something else.
        stopped = s.due.is_(1.0) & s.code.is_not(float(DONE)) & s.code.is_not(float(STEP_LIMIT))
        with f.if_(f.any_of(stopped)):
            for share in (0.0, AHEAD):
                later = (s.end - s.start) * share
                setattr(s, "X t", s.T3 + later)
                with f.each(self.rowcount) as r:
                    v = self._vector(f, "P3 v", r)
                    self._put(f, "X q", r, f.fma(self._over(f, later), v, self._vector(f, "P3 q", r)))
                    self._put(f, "X v", r, v)
                self._call(f, "equation_terms")
                total = f.variable(0.0)
                with f.each(self.code.term_count) as i:
                    x = f.load(work, i * width + p["R"] * width, width)
                    total.value = f.fma(x, 0.0, total.value)
                s.where(stopped & total.value.is_not(0.0), code=NOT_FINITE)
        # The last state, once more to the manifold; and then the first, which is taken as it is.
        with f.each(self.rowcount) as r:
            for x in "qv":
                self._put(f, f"X {x}", r, self._vector(f, f"P3 {x}", r))
        setattr(s, "X t", s.T3)
        self._settle(f, s, "due")
        with f.each(width) as k, f.if_(f.lane(s.due, k) > 0.5):
            member = self._whole(f, f.lane(s.member, k))
            with f.if_(f.lane(s.code, k).is_(float(DONE))):
                self._write_state(f, s, call, k, times - 1, "X q", "O v")
            info = f.at(f.load(call, self.call.index("info"), base=POINTER), member * (len(INFO) + 2 * self.n))
            values = {"t": s.T3}
            for j, name in enumerate(INFO):
                f.store(f.lane(values.get(name, getattr(s, name) if name != "t" else s.T3), k), info, j)
            self._copied(f, info, len(INFO), "P3 q", k)
            self._copied(f, info, len(INFO) + self.n, "P3 v", k)
            q, v = self._of_member(f, call, "q", member), self._of_member(f, call, "v", member)
            with f.each(self.n) as i:
                f.store(f.load(q, i), work, (i + p["X q"]) * width + k)
                f.store(f.load(v, i), work, (i + p["O v"]) * width + k)
        setattr(s, "X t", s.start)
        with f.each(self.rowcount) as r:
            self._put(f, "X v", r, self._vector(f, "O v", r))
        self._call(f, "psi")
        worst = f.variable(0.0)
        if self.m:
            with f.each(self.m) as i:
                psi = f.load(work, (i + p["psi"]) * width, width)
                x = f.abs(psi) / f.load(work, (i + p["rows"]) * width, width)
                worst.value = f.select((x > worst.value) | x.is_not(x), x, worst.value)
        s.violated = worst.value
        with f.each(width) as k, f.if_(f.lane(s.due, k) > 0.5):
            self._write_state(f, s, call, k, f.const(0, INT), "X q", "O v")
        self._ended(f, s)

    def _run(self):
        """`run(call)`: members one after another, until there are none left."""
        if self.plan.breaks and self.plan.width > 1:
            f, s = self._function("gather", [(POINTER, "work"), (POINTER, "call"), (INT, "which")])
            with f.each(f.width) as k:
                at = self._input(f, f.given["call"], "breaks", f.lane(s.member, k), f.given["which"])
                f.store(at, f.given["work"], k + self.places["due"] * f.width)
        f = Function("run", [(POINTER, "call")], self.plan.width)
        self.functions.append(f)
        call, width = f.given["call"], self.plan.width
        size = self.places.size * width + 2 * self.plan.vector
        block, work = self._allocated(f, f.const(size, INT))
        f.given["work"], s = work, Lane(f, self.places)
        with f.each(size) as i:
            f.store(0.0, work, i)
        f.store(call, work, self.places["call"] * width, base=POINTER)
        blocks = [block, *self._memory(f, call)]
        for name in ("length", "omega", "rtol", "atol", "smallest"):  # of lanes that stay empty
            setattr(s, name, f.const(1.0, DOUBLE, width))
        with f.each(-(-self.n // max(self.plan.vector // width, 1)) * max(self.plan.vector // width, 1)) as i:
            for name in ("scale q", "scale v"):
                f.store(f.const(1.0, DOUBLE, width), work, (i + self.places[name]) * width, width)
        members = f.load(call, self.call.index("members"), base=INT)
        following = f.load(call, self.call.index("next"), base=POINTER)

        def fill():
            with f.each(width) as k, f.if_(f.lane(s.active, k) < 0.5):
                # Members are taken in order, by whoever comes first: threads share the count.
                member = f.op(f"atomicrmw add ptr {following.name}, i64 1 seq_cst", INT)
                with f.if_(member < members):
                    f.call("begin", work, call, k, member)

        fill()
        with f.while_(lambda: f.any_of(s.active > 0.5)):
            self._round(f, s, fill)
        for block in blocks:
            f.line(f"call void @free(ptr {block.name})")

    def _round(self, f: Function, s: Lane, fill: Callable[[], None]):
        """One step of all lanes, and what becomes of those that are done."""
        work, call, width = f.given["work"], f.given["call"], self.plan.width
        yes = f.const(1.0, DOUBLE, width)
        doubtful = s.doubt > 0.5
        careful = f.any_of(doubtful)
        if self.cares:
            s.careful = f.select(careful, f.const(1.0, DOUBLE, width), 0.0)
            s.judged = f.select(careful, f.select(doubtful, yes, 0.0), s.active)
        else:
            s.judged = s.active
        self._aim(f, s)
        f.call("attempt", work)
        f.call("decide", work)
        if not self.cares and self.doubts:
            s.where(s.doubt > 0.5, code=DOUBTED)
        f.call("outputs", work, call)
        ended = (s.active > 0.5) & s.code.is_not(float(RUNNING))
        with f.if_(f.any_of(ended)):
            s.due = f.select(ended, yes, 0.0)
            f.call("finish_members", work, call)
            s.where(ended, active=0.0, doubt=0.0)
            self._next(f, s, fill)

    def _allocated(self, f: Function, count: Value) -> tuple[Value, Value]:
        """So many numbers: what to free, and where they begin, at a register's boundary."""
        size = count * 8 + 64
        block = f.op(f"call ptr @malloc(i64 {size.name})", POINTER)
        address = f.op(f"ptrtoint ptr {block.name} to i64", INT)
        aligned = f.logic("and", address + 63, -64)
        return block, f.op(f"inttoptr i64 {aligned.name} to ptr", POINTER)

    def _memory(self, f: Function, call: Value) -> list[Value]:
        """Further memory of a run, in `work` already: what to free."""
        del f, call
        return []
