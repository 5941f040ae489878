"""The plan of a module, the arguments of a run, and the layout of its memory.

Arrays of coordinates in the memory of a run, with q, v, a for positions, velocities and accelerations, d for changes:

    state q ...          the state at which programs evaluate
    result v, a ...      what they return; `corrected q` is q after a Newton step
    point0 q ...         accepted states, from the oldest to the latest, point3, at the times point0_t ...
    stage1 a ...         accelerations of the stages of a step
    difference0 ...      divided differences: the coefficients of the interpolating polynomial
    fallback a ...       results of fallback steps
    scale q, v           absolute tolerances; `inverse unit` is one over the scene's unit of each coordinate
    bar state q ...      cotangents of all these

`constants` and what the scene's programs name are arrays of their own; "stage1 linearization" and the like hold what derivatives
need to know of a state. `bar constants` are cotangents that one program leaves, `total bar constants` their sums over a run. A
tangent, the memory of one direction, has arrays of the same names for the changes of what they hold.
"""

from dataclasses import dataclass, field
from typing import Any

from udkjax.equations.scene_programs import ScenePrograms
from udkjax.native.base.ir import DOUBLE, Function, Value
from udkjax.native.base.steps import POINTS
from udkjax.native.base.tableau import Method

FORMULATION_SETTINGS = (
    "formulation_tol",
    "mass",
)  # besides, for formulations: the threshold of the rank, the scale of masses (kg)
SETTINGS = ("rtol", "atol", "smallest", "first", "length", "omega", "fallback_tol", "max_steps", "method", "drift_tol")
INPUTS = ("numbers", "ts", "q", "v", "settings", "rows", "breaks")
OUTPUTS = ("qs", "vs", "violation", "info")
SHARE = 32  # members of a thread, at least: to wake it takes some 50 us, and the shortest runs take one or two each
INFO = ("code", "t", "tried", "accepted", "evaluations", "written", "lost")  # then the last q and v


@dataclass(frozen=True)
class Plan:
    """All that a module's code depends on."""

    code: ScenePrograms
    method: Method
    projected: bool
    breaks: bool
    width: int  # lanes
    vector: int  # numbers that a register holds
    unrolled: bool  # programs are unrolled instead of loops
    steps: bool = True  # it integrates
    sampled: tuple[int, ...] = ()  # places of the numbers of the scene that have samples
    pseudoinverse: Any = None  # the `DenseMethod` that solves; None: elimination
    formulation: Any = None  # the `FormulationCode` of accelerations; None: the Udwadia-Kalaba equation


@dataclass
class Layout:
    """The places of arrays in the memory of a run, in numbers of W lanes each; arrays of coordinates fill whole registers."""

    width: int
    vector: int
    places: dict[str, int] = field(default_factory=dict)
    size: int = 0

    def add(self, name: str, count: int = 1) -> int:
        """Add an array, from a register's boundary on."""
        step = max(self.vector // self.width, 1)
        self.places[name] = self.size
        self.size += -(-count // step) * step
        return self.places[name]

    def __getitem__(self, name: str) -> int:
        return self.places[name]


LANE_NUMBERS = {  # numbers of each lane, and what they are
    "call": "address of the record that `run` is called with",
    "tangents": "address of the memory of directions",
    "member": "number of the member in the lane",
    "active": "whether there is one",
    "stepping": "whether it takes part in this attempt at a step",
    "code": "how it ended, or that it runs",
    **dict.fromkeys(SETTINGS, "settings of the member"),
    "start": "first time (s)",
    "end": "last time (s)",
    **{f"point{k}_t": "time of an accepted state (s), the last is the latest" for k in range(POINTS)},
    "h": "step that the controller wants (s)",
    "t1": "end of this attempt (s)",
    "step": "its length (s); 0 where a run begins",
    "begin": "whether a run begins here: at the start, or behind a breakpoint",
    "last": "whether the attempt ends at the end of the run",
    "lands": "whether it ends at a breakpoint",
    "behind": "time behind the breakpoints at the current time (s)",
    "knot": "number of breakpoints that have been passed",
    "passed": "the last of them (s)",
    "row": "of the samples, from which the constants are",
    "steps": "accepted steps since the run began anew",
    "error": "of the attempt, relative to the tolerance",
    "rate": "error of the step before over its length to the power of the order",
    "ok": "whether all pivots of the attempt were safe",
    "safe": "whether those of the latest program were",
    "fallback": "whether the attempt is by the fallback",
    "fallback_due": "whether the next one must be",
    "retries": "attempts that were shortened for the sake of a pivot, in a row",
    "distance": "from singular configurations: the smallest pivot relative to its diagonal, as a root",
    **{f"distance{k}": "the same of the accepted states before" for k in range(POINTS - 1)},
    "tolerance": "what the fastest velocity may err, in its unit",
    "rank": "of D, as the fallback found it",
    "wanted": "whether a rank-revealing method is asked for",
    "iterating": "whether Newton's method goes on",
    "violated": "the largest violation of Psi at an output, over the row's scale",
    "open": "whether the output is open after its projection",
    "next": "next output time (s)",
    "until": "outputs up to here are due (s)",
    "due": "lanes that are concerned, of what is called",
    "tried": "attempts so far",
    "accepted": "accepted steps so far",
    "evaluations": "accelerations so far",
    "written": "outputs so far",
    "lost": "number of the first output at which Psi is violated by more than `drift_tol`; infinite: none",
    "crossing": "where a piece of the state is expected to end (s)",
    "aim": "where the attempt is to end: before that, beyond it, or across",
    "tries": "attempts to end there, in a row",
    "share": "of the attempt: upper bound of where the piece ends",
    "low": "lower bound of that",
    "again": "whether the attempt is taken again, to end there",
}


class Lane:
    """The numbers of each lane, as attributes: read, and written for all lanes (or by `where` for some)."""

    def __init__(self, f: Function, layout: Layout):
        self.__dict__.update(_f=f, _layout=layout)

    def __getattr__(self, name: str) -> Value:
        f: Any = self.__dict__["_f"]
        return f.load(f.given["work"], self.__dict__["_layout"][name] * f.width, f.width)

    def __setattr__(self, name: str, value: Any):
        f: Any = self.__dict__["_f"]
        f.store(value, f.given["work"], self.__dict__["_layout"][name] * f.width, f.width)

    def where(self, mask: Value, **named: Any):
        f: Any = self.__dict__["_f"]
        for name, value in named.items():
            setattr(self, name, f.select(mask, f.like(value, DOUBLE, f.width), getattr(self, name)))
