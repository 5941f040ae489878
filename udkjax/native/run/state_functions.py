"""Machine code of functions of single states, for integrators of others: what a run does at a state, for batches in lanes.

StateAccelerations    a of a state, by elimination or a dense method; by the fallback where pivots are not to be trusted
StateProjection       q and v returned to the constraint manifold
StateTangentPart      the part of small changes of q and v within the manifold
"""

from abc import abstractmethod
from typing import ClassVar

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.base.ir import DOUBLE, POINTER, Function, Value
from udkjax.native.base.layout import Lane, Plan
from udkjax.native.base.steps import NEAREST_STAGE, ROUNDING_PIVOT
from udkjax.native.base.tableau import EULER
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.run.fallback import write_fallback
from udkjax.native.run.formulations import FormulationCode
from udkjax.native.run.manifold import project_output, with_threshold
from udkjax.native.run.members import write_begin, write_run
from udkjax.native.run.trajectory import Trajectory


class StateFunction(Trajectory):
    """The text of a module whose `run` evaluates members at their states q and v at the time ts[0]."""

    settings = ("length", "fallback_tol", "method")
    results = ("found",)
    found: ClassVar[tuple[str, ...]]  # arrays of coordinates that are returned, one behind another

    def __init__(
        self, code: ScenePrograms, pseudoinverse: DenseMethod | None, formulation: FormulationCode | None, width: int, vector: int
    ):
        super().__init__(
            Plan(
                code,
                EULER,
                projected=True,
                breaks=False,
                width=width,
                vector=vector,
                unrolled=code.is_small,
                pseudoinverse=pseudoinverse,
                formulation=formulation,
            )
        )

    def text(self) -> str:
        """LLVM's text of the whole module."""
        self.write_programs()
        if self.falls_back:
            write_fallback(self)
        write_begin(self)
        f, s = self.function("evaluate_states", [(POINTER, "work"), (POINTER, "call")])
        with f.each(self.n) as i:
            for x in "qv":
                self.put_entry(f, f"state {x}", i, self.entry(f, f"point3 {x}", i))
        setattr(s, "state t", s.start)
        self._evaluate(f, s)
        self.write_found(f, s)
        write_run(self)
        return self.module_text()

    def write_found(self, f: Function, s: Lane):
        """Write what was found of the members in all lanes to the output."""
        with self.each_lane(f, s.active) as k:
            to = self.result_address(f, "found", self.to_int(f, f.lane(s.member, k)), self.n * len(self.found))
            for j, name in enumerate(self.found):
                self.copy_lane(f, to, j * self.n, name, k)

    @abstractmethod
    def _evaluate(self, f: Function, s: Lane):
        """Write the arrays `found`, of the state of each lane."""

    def step_all(self, f: Function, s: Lane, fill):
        """Evaluate the members in all lanes, and take the next."""
        f.call("evaluate_states", f.given["work"], f.given["call"])
        s.active = f.const(0.0, DOUBLE, f.width)
        fill()


class StateAccelerations(StateFunction):
    """The accelerations of states."""

    found = ("result a",)

    @property
    def solving(self) -> list[str]:
        return ["accelerations"]

    def _evaluate(self, f: Function, s: Lane):
        self.accelerate(f, "result a")
        if not self.falls_back or self.formulated:
            return
        s.stepping = s.active
        s.fallback = s.active
        with f.if_(f.any_of((s.active > 0.5) & (s.safe < 0.5))):
            self.invoke(f, "accelerate_by_fallback", "result a")


class StateProjection(StateFunction):
    """The projection of states."""

    found = ("state q", "result v")

    @property
    def solving(self) -> list[str]:
        return ["newton_q", "newton_v_and_psi", "project"]

    def _evaluate(self, f: Function, s: Lane):
        s.due = s.active
        project_output(self, f, s, "due")


class StateTangentPart(StateFunction):
    """The part of small changes of states within the manifold, dq and dv as two further inputs."""

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
        if not self.falls_back:
            return
        near = (s.active > 0.5) & ~(s.distance > NEAREST_STAGE)
        with f.if_(f.any_of(near)):
            s.wanted = f.select(near, f.const(1.0, DOUBLE, f.width), 0.0)
            self.invoke(f, "fallback_tangent_part")
            for x in ("dq", "dv"):
                self.copy(f, f"fallback {x}", f"result {x}", near)
