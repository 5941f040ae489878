"""Machine code that finds independent rows of Psi at run time, for mechanisms with traced numbers.

Rows that depend on others everywhere must be distinguished from rows that do so only at the initial position, if it is singular.
Therefore the mechanism is moved by one step: along its velocity or, at rest, along a random direction that its constraints allow,
with its drivers slightly advanced. It is closed by Newton's method, and the rows that elimination retains are marked. If it does
not close, or returns to the start, as it may at rest where two branches of its motion meet, all rows are marked: elimination then
encounters small pivots, and the rank-revealing fallback takes every step.
"""

from collections.abc import Callable

import numpy as np

from udkjax.equations.position_closure import CLOSURE
from udkjax.equations.run_programs import RunPrograms
from udkjax.native.base.ir import BOOL, DOUBLE, POINTER, Function, Value
from udkjax.native.base.layout import Lane, Plan
from udkjax.native.base.module import Module
from udkjax.native.base.tableau import EULER
from udkjax.native.run.manifold import iterate_newton, largest_violation
from udkjax.native.run.members import write_begin

# Length of the step in the scene's units. A row that depends on others only at the start of the step has a relative pivot of
# about its square at the end: much more than the threshold of dependence. The step is also short enough for Newton's method.
STEP = 0.03
STAYS = 0.5  # smallest distance from the start, as a fraction of the step: where branches meet, Newton's method may lead back
CORRECTIONS = 6  # Newton steps; four are usual, as convergence is quadratic
FREE = 1e-6  # smallest tangent part of a direction or a velocity, in the scene's units; less is rounding


class RowMarks(Module):
    """The text of a module whose `run` marks the independent rows of members, near their positions q at the time ts[0]."""

    settings = ("length", "omega")
    results = ("marks",)

    def __init__(self, code: RunPrograms, width: int, vector: int):
        unrolled = code.is_small and not code.has_loops  # a single call does not pay for compiling unrolled programs
        super().__init__(
            Plan(code, EULER, projected=False, breaks=False, width=width, vector=vector, unrolled=unrolled, steps=False)
        )
        self.places.add("independent", self.m)

    def write_functions(self):
        self.write_programs()
        write_begin(self)
        self._find()

    def program_names(self) -> list[str]:
        return ["tangent_part", "newton_q", "psi", "independent_rows"]

    @property
    def arrays(self):
        return super().arrays | {"independent": ("work", self.places["independent"])}

    def _find(self):
        """Write `find(work, call)`: mark the rows of the members in all lanes."""
        f, s = self.function("find", [(POINTER, "work"), (POINTER, "call")])
        width = self.plan.width
        direction = np.random.default_rng(0).uniform(-1.0, 1.0, self.n)
        self.loops.globals.append(
            f"@direction = private constant [{self.n} x double] [{', '.join(f'double {x!r}' for x in direction.tolist())}]"
        )

        setattr(s, "state t", s.start)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, self.entry(f, "point3 q", i))
            self.put_entry(f, "state v", i, self.entry(f, "point3 v", i))
            self.put_entry(f, "state dv", i, f.const(0.0, DOUBLE, width))
            self.put_entry(f, "state dq", i, self.entry(f, "point3 v", i))
        rate = self.largest(f, lambda r: [f.abs(self.vector(f, "state dq", r)) * self.vector(f, "inverse unit", r)])
        moves = f.like(rate > s.omega * FREE, BOOL, width)
        with f.each(self.n) as i:
            random = f.like(f.load(Value(f, "@direction", POINTER), i), DOUBLE, width) / self.entry(f, "inverse unit", i)
            self.put_entry(f, "state dq", i, f.select(moves, self.entry(f, "state dq", i) / s.omega, random))
        self.invoke(f, "tangent_part")
        size = self.largest(f, lambda r: [f.abs(self.vector(f, "result dq", r)) * self.vector(f, "inverse unit", r)])
        is_free = size > FREE
        scale = f.select(is_free, STEP / f.select(is_free, size, 1.0), 0.0)
        scale = f.like(scale, DOUBLE, width)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, f.fma(self.entry(f, "result dq", i), scale, self.entry(f, "state q", i)))
        setattr(s, "state t", s.start + STEP / s.omega)
        active = s.active > 0.5
        iterate_newton(self, f, s, active, lambda _: self.invoke(f, "newton_q"), CORRECTIONS)
        self.invoke(f, "psi")
        is_closed = largest_violation(self, f) < CLOSURE.tol
        distance = self.largest(f, self._distance(f))
        is_closed = is_closed & ((distance > STAYS * STEP) | ~f.like(is_free, BOOL, width))
        self.invoke(f, "independent_rows")
        with f.each(self.m) as i:
            self.put_entry(f, "independent", i, f.select(is_closed, self.entry(f, "independent", i), 1.0))
        with self.each_lane(f, s.active) as k:
            to = self.result_address(f, "marks", self.to_int(f, f.lane(s.member, k)), self.m)
            self.copy_lane(f, to, 0, "independent", k, count=self.m)

    def _distance(self, f: Function) -> Callable[[Value], list[Value]]:
        """Return the distance of each coordinate from the initial position, in its unit."""

        def of_register(r: Value) -> list[Value]:
            moved = self.vector(f, "state q", r) - self.vector(f, "point3 q", r)
            return [f.abs(moved) * self.vector(f, "inverse unit", r)]

        return of_register

    def step_all(self, f: Function, s: Lane, fill):
        """Mark the rows of the members in all lanes, and load the next members."""
        f.call("find", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, f.width)
        fill()
