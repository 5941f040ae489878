"""Machine code that finds independent rows of Psi at run time, for mechanisms with traced numbers.

Rows that depend on others everywhere must be distinguished from rows that do so only at the initial position, if it is singular.
Therefore the mechanism is moved by one step: along its velocity or, at rest, along a random direction that its constraints allow,
with its drivers slightly advanced. It is closed by Newton's method, and the rows that elimination retains are marked, or those
that it retains at the start if there are more: the step may lead to a singular position. If it does not close, or returns to the
start, as it may at rest where two branches of its motion meet, all rows are marked: elimination then encounters small pivots, and
the rank-revealing fallback takes every step. A mark is one for an independent row, and zero for the others.
"""

from collections.abc import Callable

import numpy as np

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.native.language.ir import BOOL, DOUBLE, POINTER, Function, Value
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.module import Module
from udkjax.native.module.tableau import EULER
from udkjax.native.parts.manifold import iterate_newton, largest_violation
from udkjax.native.run.members import write_begin

STEP_ASIDE = CLOSURE.aside


class RowMarks(Module):
    """The text of a module whose `run` marks the independent rows of members, near their positions q at the time ts[0]."""

    settings = ("length", "omega")
    results = ("marks",)

    def __init__(self, code: RunPrograms, width: int, vector: int):
        unrolled = code.is_small and not code.has_loops  # a single call does not pay for compiling unrolled programs
        super().__init__(
            Plan(code, EULER, projected=False, breaks=False, width=width, vector=vector, unrolled=unrolled, steps=False)
        )
        for name in ("independent", "marks"):
            self.places.add(name, self.m)

    def write_functions(self):
        self.write_programs()
        write_begin(self)
        self._find()

    def program_names(self) -> list[str]:
        return ["tangent_part", "newton_q", "psi", "independent_rows"]

    @property
    def arrays(self):
        return super().arrays | {name: ("work", self.places[name]) for name in ("independent", "marks")}

    def _find(self):
        """Write `find(work, call)`: mark the rows of the members in all lanes."""
        f, s = self.function("find", [(POINTER, "work"), (POINTER, "call")])
        setattr(s, "state t", s.start)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, self.entry(f, "point3 q", i))
            self.put_entry(f, "state v", i, self.entry(f, "point3 v", i))
            self.put_entry(f, "state dv", i, f.const(0.0, DOUBLE, self.plan.width))
        count = self._mark_rows(f, None)
        is_free = self._step_aside(f, s)
        is_closed = largest_violation(self, f) < CLOSURE.tol
        is_found = is_closed & ((self._distance(f) > STEP_ASIDE.stays * STEP_ASIDE.length) | ~is_free)
        self._mark_rows(f, lambda found: found > count)
        with f.each(self.m) as i:
            self.put_entry(f, "marks", i, f.select(is_found, self.entry(f, "marks", i), 1.0))
        with self.each_lane(f, s.active) as k:
            to = self.result_address(f, "marks", self.to_int(f, f.lane(s.member, k)), self.m)
            self.copy_lane(f, to, 0, "marks", k, count=self.m)

    def _step_aside(self, f: Function, s: Lane) -> Value:
        """Step along the velocity or along a random direction, close the mechanism there, and compute Psi.

        Returns:
            The mask of the lanes in which the constraints allow a motion.
        """
        width = self.plan.width
        direction = np.random.default_rng(0).uniform(-1.0, 1.0, self.n)
        self.loops.globals.append(
            f"@direction = private constant [{self.n} x double] [{', '.join(f'double {x!r}' for x in direction.tolist())}]"
        )
        with f.each(self.n) as i:
            self.put_entry(f, "state dq", i, self.entry(f, "point3 v", i))
        moves = f.like(self._size(f, "state dq") > s.omega * STEP_ASIDE.free, BOOL, width)
        with f.each(self.n) as i:
            random = f.like(f.load(Value(f, "@direction", POINTER), i), DOUBLE, width) / self.entry(f, "inverse unit", i)
            self.put_entry(f, "state dq", i, f.select(moves, self.entry(f, "state dq", i) / s.omega, random))
        self.invoke(f, "tangent_part")
        size = self._size(f, "result dq")
        is_free = size > STEP_ASIDE.free
        scale = f.like(f.select(is_free, STEP_ASIDE.length / f.select(is_free, size, 1.0), 0.0), DOUBLE, width)
        with f.each(self.n) as i:
            self.put_entry(f, "state q", i, f.fma(self.entry(f, "result dq", i), scale, self.entry(f, "state q", i)))
        setattr(s, "state t", s.start + STEP_ASIDE.length / s.omega)
        iterate_newton(self, f, s, s.active > 0.5, lambda _: self.invoke(f, "newton_q"), STEP_ASIDE.corrections)
        self.invoke(f, "psi")
        return f.like(is_free, BOOL, width)

    def _size(self, f: Function, name: str) -> Value:
        """Return the largest component of the change `name` of the coordinates, in the scene's own units."""
        return self.largest(f, lambda r: [f.abs(self.vector(f, name, r)) * self.vector(f, "inverse unit", r)])

    def _mark_rows(self, f: Function, where: Callable[[Value], Value] | None) -> Value:
        """Find the independent rows at the state, store their marks, and return their number.

        `where`: a function of this number that returns the mask of the lanes in which marks are stored; None: all lanes.
        """
        self.invoke(f, "independent_rows")
        count = f.variable(0.0)
        with f.each(self.m) as i:
            count.value = count.value + self.entry(f, "independent", i)
        with f.each(self.m) as i:
            marks = self.entry(f, "independent", i)
            kept = marks if where is None else f.select(where(count.value), marks, self.entry(f, "marks", i))
            self.put_entry(f, "marks", i, kept)
        return count.value

    def _distance(self, f: Function) -> Value:
        """Return the largest difference of a coordinate from the initial position, in the scene's own units."""

        def of_register(r: Value) -> list[Value]:
            moved = self.vector(f, "state q", r) - self.vector(f, "point3 q", r)
            return [f.abs(moved) * self.vector(f, "inverse unit", r)]

        return self.largest(f, of_register)

    def step_all(self, f: Function, s: Lane, fill):
        """Mark the rows of the members in all lanes, and load the next members."""
        f.call("find", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, f.width)
        fill()
