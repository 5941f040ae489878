"""The accelerations of single states with their tangents along directions of the scene's numbers and of the state."""

from collections.abc import Sequence

from udkjax.native.derivatives.tangents import Forward
from udkjax.native.language.ir import POINTER, Function
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.run.members import write_begin
from udkjax.native.run.state_functions import StateFunction


class StateTangents(Forward):
    """A module whose `run` evaluates members at their states q and v at the time ts[0], by the programs of a run's tangents."""

    closes = False
    settings = StateFunction.settings
    results = ("found",)
    outputs = ("changes",)

    def __init__(self, plan: Plan, active: Sequence[bool], lanes: int):
        super().__init__(plan, tuple(active), lanes)

    def write_functions(self):
        self.write_programs()
        self.fallback.write()
        for derivative in self._linearizations:
            derivative.forward()
        self.write_prologue_derivative()
        write_begin(self)
        f, s = self.function("evaluate_states", [(POINTER, "work"), (POINTER, "call")])
        with f.each(self.n) as i:
            for x in "qv":
                self.put_entry(f, f"state {x}", i, self.entry(f, f"point3 {x}", i))
        setattr(s, "state t", s.start)
        self.evaluate_settled(f, "result a", "stage1 linearization")
        with self._each_tangent(f), f.each(self.registers("tangent")) as r:
            for x in "qv":
                self.put(f, f"state {x}", r, self.vector(f, f"point3 {x}", r, "tangent"), "tangent")
        with self._each_group(f):
            self._call_derivative(f, self.mode, "stage1 linearization", self._tangent_address(f, "difference0"))
        with self.each_lane(f, s.active) as k:
            member = self.to_int(f, f.lane(s.member, k))
            self.copy_lane(f, self.result_address(f, "found", member, self.n), 0, "result a", k)
            with self._each_group(f) as p, self._each_direction(f, p, k) as (direction, lane):
                row = member * self.field(f, "directions") + direction
                self.copy_lane(f, self.result_address(f, "changes", row, self.n), 0, "difference0", lane, "tangent")

    def step_all(self, f: Function, s: Lane, fill):
        """Evaluate the members in all lanes, and load the next members."""
        f.call("evaluate_states", f.given["work"], f.given["call"])
        s.active = f.const(0.0, width=f.width)
        fill()
