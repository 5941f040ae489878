"""The plan of a module, the arguments of a run, and the layout of its memory.

Arrays of coordinates in the memory of a run; q, v, a are positions, velocities and accelerations, dq and dv tangents:

    state q ...          the state at which programs are evaluated
    result v, a ...      results of programs; `corrected q` is q after a Newton step
    point0 q ...         accepted states, from the oldest to the latest, point3, at the times point0_t ...
    stage1 a ...         accelerations of the stages of a step
    difference0 ...      divided differences: the coefficients of the interpolating polynomial
    fallback a ...       results of fallback steps
    atol q, v            absolute tolerances; `inverse unit` is one over the scene's unit of each coordinate
    bar state q ...      cotangents of these arrays

`constants` and the arrays of the scene's programs have the names of the programs; "stage1 linearization" etc. hold the
intermediate results that derivatives need. `bar constants` are the cotangents of one program, `total bar constants` their sums
over a run. A tangent, the memory of one direction, has arrays of the same names, with the derivatives of their values along this
direction.
"""

from dataclasses import dataclass, field
from typing import Any

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.native.language.ir import DOUBLE, Function, Value
from udkjax.native.module.steps import NODE_COUNT
from udkjax.native.module.tableau import Method

FORMULATION_SETTINGS = (
    "formulation_tol",
    "mass",
)  # further settings of formulations: the rank tolerance, the characteristic mass (kg)
SETTINGS = (
    "rtol",
    "atol",
    "smallest",
    "first",
    "length",
    "omega",
    "fallback_tol",
    "max_steps",
    "method",
    "drift_tol",
    "max_rank",
    "open_tol",
)
INPUTS = ("numbers", "ts", "q", "v", "settings", "rows", "breaks")
OUTPUTS = ("qs", "vs", "violation", "info")
# Minimum number of members of a thread: waking a thread takes 50 us, the shortest runs take 1 or 2 us each.
MEMBERS_PER_THREAD = 32
INFO_NAMES = ("code", "t", "tried", "accepted", "evaluations", "written", "lost", "implicit")  # then the last q and v


@dataclass(frozen=True)
class Plan:
    """All choices that the code of a module depends on."""

    code: RunPrograms
    method: Method
    projected: bool
    breaks: bool
    width: int  # lanes
    vector: int  # float64 numbers in a register
    unrolled: bool  # programs are unrolled instead of loops
    steps: bool = True  # whether the module integrates
    sampled: tuple[int, ...] = ()  # indices of the numbers of the scene that have samples
    pseudoinverse: Any = None  # the `DenseMethod` that solves; None: elimination
    formulation: Any = None  # the `FormulationCode` of accelerations; None: the Udwadia-Kalaba equation
    stiff: Method | None = None  # the implicit method to which an explicit run changes where it is stiff
    leaves: bool = False  # whether a run leaves the module where it may be stiff, for one that has the implicit method
    stabilization: Any = None  # the `StabilizationCode` of a user; None: projection, or nothing

    @property
    def own_settings(self) -> tuple[str, ...]:
        """The names of the further settings that the formulation and the stabilization need."""
        return tuple(name for part in (self.formulation, self.stabilization) if part is not None for name in part.settings)


@dataclass
class Layout:
    """The offsets of arrays in the memory of a run, in units of W numbers; arrays of coordinates fill whole registers."""

    width: int
    vector: int
    places: dict[str, int] = field(default_factory=dict)
    size: int = 0

    def add(self, name: str, count: int = 1) -> int:
        """Reserve memory for an array of `count` numbers in each lane, aligned to a register; return its offset."""
        step = max(self.vector // self.width, 1)
        self.places[name] = self.size
        self.size += -(-count // step) * step
        return self.places[name]

    def __getitem__(self, name: str) -> int:
        return self.places[name]


LANE_NUMBERS = {  # numbers of each lane, and their meaning
    "call": "address of the call record of `run`",
    "tangents": "address of the memory of directions",
    "member": "index of the member in the lane",
    "active": "whether the lane has a member",
    "stepping": "whether the lane takes part in this attempt at a step",
    "code": "state of the run: RUNNING, or how it ended",
    **dict.fromkeys(SETTINGS, "settings of the member"),
    "start": "first time (s)",
    "end": "last time (s)",
    **{f"point{k}_t": "time of an accepted state (s); point3 is the latest" for k in range(NODE_COUNT)},
    "h": "step length chosen by the controller (s)",
    "t1": "end of the attempted step (s)",
    "step": "length of the attempted step (s); 0 at the beginning of a run",
    "begin": "1 if the run begins at point 3, at the start or anew after a breakpoint; -1 if the attempt is implicit, else 0",
    "last": "whether the attempted step ends at the end of the run",
    "lands": "whether the attempted step ends at a breakpoint",
    "past_breaks": "time just after the breakpoints at the current time (s)",
    "knot": "number of breakpoints that have been passed",
    "passed": "time of the last of these breakpoints (s)",
    "row": "index of the row of samples in the constants",
    "steps": "accepted steps since the run began anew",
    "error": "error of the attempted step, relative to the tolerance",
    "rate": "error of the previous step, divided by (length of the step)^order",
    "ok": "whether all pivots of the attempted step were safe",
    "safe": "whether all pivots of the latest program were safe",
    "unsettled": "whether the loads of joints with friction need further rounds of Newton's method",
    "friction_share": "share of the friction that counts in further rounds",
    "staged": "whether the loads are followed from those without friction on",
    "stage": "share of the friction by which it grows next",
    "reached": "share of the friction with which the loads are known; negative before those without friction",
    "fallback": "whether this attempt is made by the fallback",
    "fallback_due": "whether the next attempt must be made by the fallback",
    "retries": "number of successive attempts that were shortened because of a pivot",
    "distance": "distance from singular configurations: root of the smallest pivot relative to its diagonal entry",
    **{f"distance{k}": "distance of the previous accepted states; distance2 is the latest" for k in range(NODE_COUNT - 1)},
    "farthest": "largest distance of an accepted state of a run that is not projected",
    "tolerance": "tolerance of the fastest velocity, in its unit",
    "rank": "rank of D found by the fallback",
    "highest_rank": "largest rank that a dense method has found in the attempted step",
    "moves": "whether the state moves so fast that it passes singular configurations unturned",
    "wanted": "whether a rank-revealing method is requested",
    "iterating": "whether Newton's method continues",
    "violated": "largest violation of Psi at an output, over the row's scale",
    "open": "whether the output violates Psi after its projection",
    "stiff": "whether the next step is taken by an implicit method, or the run leaves the module for one that has it",
    "speed": "length of an explicit step times the largest rate of the equations",
    "growth": "largest magnitude of an eigenvalue of I - D (stage_equations.py)",
    "watch": "number of attempts after which the rate is measured",
    "patience": "attempts between two measurements of the rate",
    "trial": "length of the implicit step that is tried next, or now (s); 0: none",
    "unpaid": "consecutive implicit steps that do not pay",
    **{f"point{k}_solved": "whether the step to an accepted state was implicit" for k in range(NODE_COUNT)},
    "implicit": "accepted implicit steps so far",
    "contraction": "rate of convergence of the stages of an implicit step",
    "size": "size of the last correction of a stage, relative to the tolerance",
    "renew": "whether the matrix of the stages is computed anew",
    "renewals": "how often it was in this stage",
    "eager": "number of steps in which each stage begins with a new matrix",
    "iterations": "corrections of all stages of an implicit step",
    "diverged": "whether a stage of the attempted step did not converge",
    "next": "next output time (s)",
    "until": "time up to which outputs are due (s)",
    "abrupt": "whether the next attempt is so short that all outputs before it are due",
    "due": "whether the called function applies to the lane",
    "tried": "attempts so far",
    "accepted": "accepted steps so far",
    "evaluations": "evaluations of accelerations so far",
    "written": "outputs so far",
    "lost": "index of the first output at which Psi is violated by more than `drift_tol`; infinite if none",
    "crossing": "time at which a piece of the state is expected to end (s)",
    "aim": "where the attempt ends relative to the crossing: before, beyond, or across it",
    "crosses": "what the attempt leads across: nothing, ACROSS_PIECE, ACROSS_EDGE",
    "tries": "number of successive attempts to end at the crossing",
    "again": "whether the step is repeated to end at the crossing",
}


class Lane:
    """The `LANE_NUMBERS` as attributes: reading loads and assigning stores a number of all lanes; `where` stores it in some."""

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
