"""The parts of a module, which the algorithms of a run call. These base classes need no programs or memory.

A part says which programs of the scene it needs, which memory it reserves, and which functions it writes. Modules that run choose
theirs from parts/.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any

import numpy as np

from udkjax.native.language.ir import BOOL, DOUBLE, Function, Value, Variable
from udkjax.native.module.layout import Lane, Plan
from udkjax.native.module.tableau import Method

Shortened = tuple[Value, Value, Value]  # lanes whose attempt is complete, lanes that shorten it, time to a singular configuration

BeginMember = Callable[[Value, Value], None]  # loads a member into a lane: (lane, member)


class Part:
    """Base of the parts of a module."""

    shared: Collection[str] = ()
    """Arrays that it shares with other parts: `couplings`, if M is not diagonal; `rows`, Psi_q and M^(-1/2); `rates`, if rows of
    phi make errors of q errors of v; and `velocities`, a copy of those of the state."""
    programs: Sequence[str] = ()
    """The names of its programs."""
    arrays: Sequence[str] = ()
    """The arrays of programs in its memory."""

    def reserve(self):
        """Reserve the memory of the part."""

    def write(self):
        """Write the functions of the part."""


class AccelerationPart(Part):
    """The accelerations of states and the systems of their projection."""

    has_cold_functions = True  # whether the rarely called functions are compiled as such

    def accelerate(self, f: Function, to: str):
        """Compute the accelerations at `state`."""

    def accelerate_exactly(self, f: Function, to: str):
        """Compute accelerations again that programs of derivatives have computed, if they depend on the method."""

    def accelerate_and_measure(self, f: Function):
        """Compute the accelerations `result a` at the end of a step that is not projected, with its `psi` and `distance`."""

    def accelerate_end(self, f: Function):
        """Complete `result a` of `state q` and `result v`, the end of a step after its projection."""

    def check_pivots(self, f: Function, s: Lane, name: str):
        """If pivots are too small, compute the accelerations `name` by the fallback, or abandon the attempt."""

    def highest_rank(self, s: Lane) -> Value | None:
        """Return the largest rank of the rows in the attempted step; None if the method does not find one."""
        return None

    def nearest(self, f: Function, s: Lane) -> Value:
        """Return the distance from singular configurations below which the method leaves rows out."""
        raise NotImplementedError

    def add_numbers(self, f: Function, total: Variable):
        """Make `total` NaN if the accelerations at `state` are not finite; those by elimination follow from the terms."""

    def accelerate_state(self, f: Function, s: Lane):
        """Compute `result a`."""


class ProjectionPart(Part):
    """The projection of states onto the constraints; a module without it has no steps."""

    @property
    def solving(self) -> list[str]:
        """The names of the functions that solve linear systems: programs by elimination, or dense equations."""
        return []

    @property
    def checks(self) -> list[str]:
        """The names of further programs, which check the projection."""
        return []

    def begin_step(self, f: Function, s: Lane):
        """Prepare a step from point 3."""

    def close_stage(self, f: Function, s: Lane):
        """Close the state of a stage."""

    def end_stage(self, f: Function, i: int):
        """Change the accelerations of a stage to what is integrated."""

    def end_step(self, f: Function, s: Lane):
        """Compute `state q`, `result v` and `result a` at the end of a step, and estimate its errors."""

    def project_output(self, f: Function, s: Lane, mask: Value):
        """Project the state of `due` lanes to `state q` and `result v`; set `violated` to the largest violation of Psi."""

    slips = False  # whether positions are integrated at other rates than v

    def slipped_between(self, f: Function, s: Lane, r: Value) -> Value:
        """Return one register of how far positions are from the integral of v at the time `next`."""
        raise NotImplementedError

    def drift(self, f: Function) -> Value | None:
        """Return the violation of Psi at the end of an attempted step, relative to the rows' scales; None if it is rounding."""
        return None

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        """Set `lost` to the status of lanes whose new point ends their run."""


class FrictionPart(Part):
    """Friction that depends on the loads of joints; this base class needs no further rounds."""

    settles = False

    def settle_after(self, f: Function, name: str, out: str | None):
        """Settle the loads after a call of the program `name`."""

    def settle(self, f: Function, out: str):
        """Settle the loads at `state`, with which programs of derivatives begin; `out` changes."""


class FallbackPart(Part):
    """The steps that elimination cannot take; this base class leaves all steps to the solver."""

    finds_dependent_rows = False  # whether rows that depend on others show by their pivots

    def enter(self, f: Function, lane: Value, numbers: Value):
        """Compute the constants of the fallback in a lane from the numbers of the scene."""

    def choose_lanes(self, f: Function, s: Lane, due: Value, is_due: Value):
        """Choose the lanes of the next attempt: if any are `due` for a fallback, only these."""
        s.stepping = s.active

    def check_pivots(self, f: Function, s: Lane, name: str):
        """Compute the accelerations `name` of a stage again, or abandon the attempt, in lanes whose pivots are too small."""

    def note_unsafe(self, s: Lane, unsafe: Value):
        """Abandon the attempt in lanes whose pivots at the end of a step are too small."""

    def finish_step(self, f: Function, s: Lane):
        """Finish steps by the fallback."""

    def retry(self, f: Function, s: Lane, stepping: Value, failed: Value, tries: Value | None) -> Shortened:
        """Shorten attempts of `stepping` lanes that encountered too small a pivot, or leave them to the fallback."""
        s.fallback_due = f.const(0.0, DOUBLE, f.width)
        return stepping, f.const(False, BOOL, f.width), f.const(np.inf, DOUBLE, f.width)

    def limit_of_error(self, f: Function, s: Lane, time_left: Value) -> Value | float:
        """Return the error, relative to the tolerance, up to which a step is accepted."""
        return 1.0

    def step_around(
        self, f: Function, s: Lane, accept: Value, lanes: Callable[[], Value], time_left: Value, step: Value, otherwise: Value
    ) -> Value:
        """Return the next step, after one that is accepted or repeated: in `lanes` one around a singular configuration."""
        return otherwise

    def close_output(self, f: Function, s: Lane, mask: Value):
        """Close outputs that still violate Psi."""

    def keeping_rows(self, f: Function, do: Callable[[], None]):
        """Run `do`, which projects an output, with rows that a step would leave out."""
        do()

    def with_loads(self, f: Function, do: Callable[[], None], lanes: Value | None = None):
        """Run `do` with the loads that friction has in steps of the fallback; `lanes`: where only some pivots are unsafe."""
        do()

    def evaluate_settled(self, f: Function, s: Lane, settle: Callable[[], None], evaluate: Callable[[], None]):
        """Run `evaluate`; in steps of the fallback, with loads that `settle` finds anew."""
        evaluate()

    def with_lost_loads(self, s: Lane, accept: Value, lost: Value) -> Value:
        """Return the lanes that are `lost`, or whose accepted step left out unbounded loads of joints."""
        return lost

    def if_safe(self, s: Lane, mask: Value) -> Value:
        """Return the lanes of a mask whose latest pivots are safe."""
        return mask

    def accelerate_state(self, f: Function, s: Lane):
        """Compute `result a` again in lanes whose pivots are too small."""

    def find_tangent_part(self, f: Function, s: Lane):
        """Compute the tangent parts `result dq` and `result dv` again near singular configurations."""


class StiffnessPart(Part):
    """The implicit steps of stiff motions; this base class has none, and its runs never leave the module."""

    method: Method | None = None
    """The implicit method."""
    pointers: Sequence[str] = ()
    """The global pointers of the module."""
    entry = "run", ("call",)
    """The function that runs members, with its arguments."""

    def __init__(self, plan: Plan):
        self._plan = plan

    def exact(self, f: Function) -> Any:
        """Return the matrix at a solved stage, for derivatives."""
        raise NotImplementedError

    def write_measurement(self):
        """Write the measurement of the rate of the equations."""

    def write_stages(self, start: str):
        """Write the stages of an implicit step from a point."""

    # --- a step

    def methods(self, f: Function, s: Lane) -> Iterator[tuple[Method, Value | None]]:
        """Run the block for each method of the module, with the mask of the lanes whose attempt it makes; None: all lanes."""
        yield self._plan.method, None

    def take_stages(self, f: Function, s: Lane, implicit: Value, explicit: Callable[[], None]):
        """Take the stages of a step: by `explicit`, or in lanes with an `implicit` attempt by the implicit method."""
        explicit()

    def smooth_error(self, f: Function, s: Lane):
        """Damp fast motions in the errors of trials of implicit steps."""

    def end_step(self, f: Function, s: Lane, implicit: Value):
        """Set `result a` at the end of implicit steps."""

    def repeat_diverged(self, f: Function, s: Lane, implicit: Value):
        """Set the `error` of implicit steps that have to be repeated."""

    # --- the decision on the next step

    def trials(self, s: Lane, stepping: Value) -> Value | None:
        """Return the lanes whose attempt is a trial of an implicit step."""
        return None

    def cost(self, f: Function, s: Lane, implicit: Value, explicit: Value) -> Value:
        """Return the evaluations of an attempt."""
        return explicit

    def shift_points(self, f: Function, s: Lane, accept: Value):
        """Store whether the steps to the accepted states were implicit."""

    def choose_next(self, f: Function, s: Lane, stepping: Value, accept: Value, implicit: Value, tries: Value | None):
        """Choose the method of the next step; `tries`: lanes whose attempt was a trial."""

    # --- the end of the next step

    def plan_length(self, f: Function, s: Lane, begin: Value, start: Value, stop: Value) -> Value:
        """Return the length of the next step from the time `start`, before it is shortened to end by `stop`."""
        return s.h

    def splits(self, s: Lane, splits: Value) -> Value:
        """Return the lanes of a mask whose steps have to be as short as interpolation needs them."""
        return splits

    def ends_at_output(self, f: Function, s: Lane, begin: Value, start: Value, t1: Value, stop: Value) -> Value | None:
        """Return the lanes whose step from the time `start` ends at an output, instead of `t1`."""
        return None

    def next_begin(self, f: Function, s: Lane) -> Value:
        """Return `begin` of steps that do not begin a run."""
        return -s.stiff

    # --- points

    def between_explicit(self, s: Lane, near: Value, k: int) -> Value:
        """Return the lanes of a mask in which the steps to point k and to that before were explicit."""
        return near

    def return_to_point(self, s: Lane, mask: Value, k: int):
        """Restore the state of point k in the masked lanes, before the run continues from there."""

    def begin_anew(self, f: Function, s: Lane) -> Value:
        """Return the `begin` with which steps start anew after an event."""
        return f.const(0.0, DOUBLE, f.width)

    # --- the run of all members (leaving.py)

    def begin_run(self, f: Function):
        """Begin `run(call)`."""

    def begin_members(self, f: Function, take: Callable[[], Value], begin: BeginMember, fill: Callable[[], None]):
        """Load the first members into the lanes."""
        fill()

    def stays(self, f: Function, s: Lane, goes_on: Value, present: Callable[[], Value]) -> Value:
        """Return whether the run goes on in this module."""
        return goes_on

    def end_run(self, f: Function, s: Lane, free: Callable[[], None]):
        """End `run(call)`."""
        free()

    def write_entries(self) -> list[Function]:
        """Return further functions that run members."""
        return []

    def if_leaving(self, do: Callable[[], None]):
        """Run `do` if members may leave the module."""

    def mark(self, text: str) -> str:
        """Return the text of the module, with the names of functions that are compiled apart."""
        return text
