"""The arrays in the memory of a module; layout.py describes them."""

from collections.abc import Mapping

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.native.language.ir import Function, Value
from udkjax.native.language.program import PointerPlace
from udkjax.native.module.layout import LANE_NUMBERS, Layout
from udkjax.native.module.parts import AccelerationPart, FallbackPart, FrictionPart, ProjectionPart
from udkjax.native.module.running import Running
from udkjax.native.module.steps import NODE_COUNT

# Places of constants are a multiple: the later module of a run (leaving.py), with a few more, has equal offsets.
CONSTANTS_MULTIPLE = 16


class RunArrays(Running):
    """A module with the arrays of a run in its memory, and with the arrays of its parts."""

    accelerations, projection, fallback, friction = AccelerationPart(), ProjectionPart(), FallbackPart(), FrictionPart()
    code: RunPrograms
    unrolled: Unrolled | None
    constants: int  # their number
    stages: int
    pieces: int
    edges: int

    @property
    def shared(self) -> set[str]:
        """The groups of arrays that parts of the module share (`Part.shared`), without those that this scene does not need."""
        lacks = {"couplings"} if not self.code.couples else set()
        lacks |= {"rates"} if self.code.position_rows == self.m else set()
        parts = (self.accelerations, self.projection, self.friction, self.fallback)
        return {name for part in parts for name in part.shared} - lacks

    def lay_out(self):
        """Reserve memory for all arrays of the run, which layout.py describes, and for those that parts share."""
        plan, code, n, m = self.plan, self.code, self.n, self.m
        p = self.places = Layout(plan.width, plan.vector)
        for name in (*LANE_NUMBERS, *plan.own_settings):
            p.add(name)
        p.add("constants", -(-self.constants // CONSTANTS_MULTIPLE) * CONSTANTS_MULTIPLE)
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
            "atol q",
            "atol v",
            "inverse unit",
        ):
            p.add(name, n)
        for k in range(NODE_COUNT):
            for x in "qva":
                p.add(f"point{k} {x}", n)
        for i in range(1, self.stages):
            p.add(f"stage{i} a", n)
        for k in range(3 * NODE_COUNT):
            p.add(f"difference{k}", n)
        p.add("rows", m)
        p.add("psi", m)
        p.add("terms", code.term_count)
        for name in ("pieces", "pieces before"):
            p.add(name, self.pieces)
        if self.edges:
            p.add("piece a", n)
            for name in ("edges", "edges before"):
                p.add(name, self.edges)
        if plan.sampled:
            p.add("numbers", -(-code.number_count // plan.width))
        if not self.unrolled:
            self._add_arrays("", code.scratch)
        shared = self.shared
        if "couplings" in shared:
            self._add_arrays("", {"couplings": code.scratch["couplings"], "change": n})
        if "rows" in shared and "root" not in p.places:
            self._add_arrays("", {"root": n} | ({"psi_q": code.scratch["psi_q"]} if self.unrolled else {}))
        if "rates" in shared:
            self._add_arrays("", {"drift": m, "saved state dq": n})
        if "velocities" in shared:
            p.add("saved v", n)
        self.friction.reserve()

    @property
    def drop_tol_place(self) -> int | None:
        """The offset in the memory of the threshold of pivots, which is one of the constants; None if no program uses it."""
        place = (self.unrolled or self.code).drop_tol_index
        return None if place is None else self.places["constants"] + place

    def _add_arrays(self, prefix: str, sizes: Mapping[str, int]):
        for name, count in sizes.items():
            self.places.add(prefix + name, count)

    @property
    def arrays(self) -> dict[str, PointerPlace]:
        """The places in the memory of the arrays of the scene's programs, by the names that these have in the programs."""
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
        named |= {x: x for part in (self.fallback, self.accelerations, self.projection, self.friction) for x in part.arrays}
        named |= {x: x for x in ("drift", "couplings") if x in self.places.places}
        return {x: ("work", self.places[place]) for x, place in named.items()}

    def weigh_rows(self):
        """Reserve memory for the weights of the rows of Psi, which `begin_rows` then sets for each member."""
        if "weights" not in self.places.places:
            self.places.add("weights", self.m)

    def begin_rows(self, f: Function, lane: Value, length: Value):
        """Set the weights of the rows of a new member in a lane, if weights are needed: `length` over the scale of each row."""
        if "weights" in self.places.places:
            with f.each(self.m) as i:
                self.put_lane_entry(f, "weights", lane, length / self.lane_entry(f, "rows", lane, i), i)
