"""Machine code of the quantities that events need at single states: accelerations, conditions, and directions of impulses.

For a state (t, q, v) it returns, concatenated:

    a                        the accelerations (n,)
    g, g_dot, g_ddot         conditions with first and second rates along the motion (E,) each
    g_t, g_q, g_v            their derivatives (E,), (E, n), (E, n)
    d                        directions of impulses along g_q, of some conditions, (directed, n)
    M^(-1) g_q               the same without constraints, only where M is a function of the state, (directed, n)
    f                        forces of constraints (F,)
    safe                     one, or zero where a pivot is too small for the forces; only with forces, ()

A direction d = P M^(-1) g_q^T is the change of velocity by a unit impulse along g_q, with P the projector on the tangent space,
so that W_ij = g_q,i d_j. For conditions that depend on velocities, g_v takes the place of g_q.
"""

from udkjax.native.language.ir import Function, Value
from udkjax.native.language.program import write
from udkjax.native.module.layout import Lane
from udkjax.native.run.state_functions import StateAccelerations, StateTangentPart
from udkjax.native.watching.conditions import Conditions
from udkjax.native.watching.watched_forces import write_forces


class EventStates(StateTangentPart, StateAccelerations):
    """The text of a module that evaluates conditions and directions of impulses at states.

    The further input `event_numbers` holds the numbers of the conditions, then the inverse mass of each coordinate.
    """

    inputs = ("event_numbers",)
    found = ()
    unrolls = False

    def __init__(
        self, code, conditions: Conditions, directed: tuple[int, ...], pseudoinverse, formulation, width: int, vector: int
    ):
        self.conditions, self.directed = conditions, directed
        super().__init__(code, pseudoinverse, formulation, width, vector)
        self.places.add("event numbers", conditions.number_count)
        self.places.add("event values", len(conditions.at_state.outputs))
        self.places.add("inverse mass", self.n)
        self.places.add("directions", len(directed) * self.n)
        self.places.add("mobilities", len(directed) * self.n if code.has_mobility else 0)
        if conditions.forces is not None:
            self.places.add("multipliers", self.m)
        self.places.add("forces", conditions.force_count)
        self.places.add("safe forces", self._safe_count)

    @property
    def _safe_count(self) -> int:
        return int(self.conditions.forces is not None)

    @property
    def solving(self) -> list[str]:
        of_directions = ["tangent_part", *(["mobility"] if self.plan.code.has_mobility else [])]
        return ["accelerations", *(of_directions if self.directed else [])]

    def program_names(self) -> list[str]:
        return [*super().program_names(), *(["multipliers_of_settled"] if self.conditions.forces else [])]

    @property
    def arrays(self):
        return super().arrays | ({"multipliers": ("work", self.places["multipliers"])} if self.conditions.forces else {})

    def begin_member(self, f: Function, lane: Value, member: Value):
        given = self.member_address(f, "event_numbers", member)
        for name, start, count in (
            ("event numbers", 0, self.conditions.number_count),
            ("inverse mass", self.conditions.number_count, self.n),
        ):
            with f.each(count) as i:
                self.put_lane_entry(f, name, lane, f.load(given, i + start), i)

    def write_programs(self):
        super().write_programs()
        n, p, program = self.n, self.places, self.conditions.at_state
        inputs = [("work", p["state t"])]
        for name in ("state q", "state v", "result a"):
            inputs += [("work", p[name] + i) for i in range(n)]
        inputs += [("work", p["event numbers"] + i) for i in range(self.conditions.number_count)]
        outputs = [("work", p["event values"] + k) for k in range(len(program.outputs))]
        self.functions.append(write(program, "conditions", self.plan.width, ("work",), inputs, outputs))
        if self.conditions.forces is not None:
            self.functions.append(write_forces(self.conditions, self, "event numbers"))

    def _evaluate(self, f: Function, s: Lane):
        StateAccelerations._evaluate(self, f, s)
        f.call("conditions", f.given["work"])
        if self.conditions.forces is not None:
            self.invoke(f, "multipliers_of_settled")
            f.call("own_forces", f.given["work"])
            self.put_entry(f, "safe forces", 0, s.safe)
        count = self.conditions.own_count
        for k, event in enumerate(self.directed):
            start = 4 * count + (event + (count if self.conditions.by_velocity[event] else 0)) * self.n
            with f.each(self.n) as i:
                normal = self.entry(f, "event values", i + start)
                self.put_entry(f, "state dv", i, normal * self.entry(f, "inverse mass", i))
                self.put_entry(f, "state dq", i, 0.0)
            if self.plan.code.has_mobility:
                self.invoke(f, "mobility")
                with f.each(self.n) as i:
                    self.put_entry(f, "state dv", i, self.entry(f, "result dv", i))
                    self.put_entry(f, "mobilities", i + k * self.n, self.entry(f, "result dv", i))
            StateTangentPart._evaluate(self, f, s)
            with f.each(self.n) as i:
                self.put_entry(f, "directions", i + k * self.n, self.entry(f, "result dv", i))

    @property
    def counts(self) -> dict[str, int]:
        return {
            "result a": self.n,
            "event values": len(self.conditions.at_state.outputs),
            "directions": len(self.directed) * self.n,
            "mobilities": len(self.directed) * self.n if self.plan.code.has_mobility else 0,
            "forces": self.conditions.force_count,
            "safe forces": self._safe_count,
        }
