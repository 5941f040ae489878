"""The parts of a module, which the algorithms of a run call. The base classes here need no programs and no memory.

A part says which programs of the scene it needs, which memory it reserves, and which functions it writes. Modules that run choose
theirs from parts/. Most methods write code into a function `f`; those of the base classes write none unless they say otherwise.
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
    """Base class of the parts of a module, with the programs and the memory that a part needs, and the code that it writes."""

    shared: Collection[str] = ()
    """Arrays that it shares with other parts: `couplings`, if M is not diagonal; `rows`, Psi_q and M^(-1/2); `rates`, if rows of
    phi make errors of q errors of v; and `velocities`, a copy of those of the state."""
    programs: Sequence[str] = ()
    """The names of its programs."""
    arrays: Sequence[str] = ()
    """The arrays of programs in its memory."""

    def reserve(self):
        """Reserve the memory of the part; by default it needs none."""

    def write(self):
        """Write the functions of the part; by default there are none."""


class AccelerationPart(Part):
    """The computation of accelerations, and of the linear systems by which states are projected."""

    has_cold_functions = True  # whether the rarely called functions are compiled as such

    def accelerate(self, f: Function, to: str):
        """Compute the accelerations at `state` (time, positions and velocities); store them in the array `to`."""

    def accelerate_exactly(self, f: Function, to: str):
        """Replace the accelerations `to`, which a program of derivatives has computed by elimination, if the method differs."""

    def accelerate_and_measure(self, f: Function):
        """Compute the accelerations `result a` at the end of a step that is not projected, with its `psi` and `distance`."""

    def accelerate_end(self, f: Function):
        """Compute `result a` at the projected end of a step (`state q`, `result v`), unless programs of the step have done so."""

    def check_pivots(self, f: Function, s: Lane, name: str):
        """In lanes whose pivots are too small for the accelerations `name`, use the fallback or abandon the attempt."""

    def highest_rank(self, s: Lane) -> Value | None:
        """Return the largest rank of the rows in the attempted step; None if the method does not find one."""
        return None

    def nearest(self, f: Function, s: Lane) -> Value:
        """Return the distance from singular configurations below which the method leaves rows out."""
        raise NotImplementedError

    def add_numbers(self, f: Function, total: Variable):
        """Make `total` NaN if the accelerations at `state` are not finite.

        By default do nothing: accelerations by elimination are finite if the terms are, which the caller has added.
        """

    def accelerate_state(self, f: Function, s: Lane):
        """Compute `result a`, the accelerations of a single state outside of a run."""


class ProjectionPart(Part):
    """The projection of states onto the constraints, at ends of steps and at outputs. Modules without steps need none."""

    @property
    def solving(self) -> list[str]:
        """The names of the functions that solve linear systems; they are programs by elimination or dense equations."""
        return []

    @property
    def checks(self) -> list[str]:
        """The names of further programs, which check the projection."""
        return []

    def begin_step(self, f: Function, s: Lane):
        """Write code that prepares a step from point 3."""

    def close_stage(self, f: Function, s: Lane):
        """Change the state of a stage, before its accelerations are computed, so that it satisfies the constraints."""

    def end_stage(self, f: Function, i: int):
        """Replace the accelerations of stage i by the rates that are to be integrated."""

    def end_step(self, f: Function, s: Lane):
        """Compute `state q`, `result v` and `result a` at the end of a step, and estimate its errors."""

    def project_output(self, f: Function, s: Lane, mask: Value):
        """Project the state of `due` lanes to `state q` and `result v`; set `violated` to the largest violation of Psi."""

    slips = False  # whether positions are integrated at other rates than v

    def slipped_between(self, f: Function, s: Lane, r: Value) -> Value:
        """Return register r of the positions minus the integral of v, interpolated at the time `next`; needed only if `slips`."""
        raise NotImplementedError

    def drift(self, f: Function) -> Value | None:
        """Return the largest row of Psi over its scale, at the end of an attempted step; None if steps are projected."""
        return None

    def judge(self, f: Function, s: Lane, accept: Value, lost: Variable):
        """Set `lost` to the `Status` with which runs end at their new point, in lanes of `accept`; it stays zero in others."""


class FrictionPart(Part):
    """Friction that depends on the loads of joints; this base class is for scenes without such friction."""

    settles = False

    def settle_after(self, f: Function, name: str, out: str | None):
        """After a call of the program `name`, find the loads of joints by further rounds if they are `unsettled`."""

    def settle(self, f: Function, out: str):
        """Find the loads of joints at `state`, which programs of derivatives need; the array `out` is overwritten."""


class FallbackPart(Part):
    """The steps that elimination cannot take; this base class leaves all steps to the solver."""

    finds_dependent_rows = False  # whether rows that depend on others show by their pivots

    def enter(self, f: Function, lane: Value, numbers: Value):
        """Compute the constants of the fallback in a lane from the numbers of the scene, given by their address."""

    def choose_lanes(self, f: Function, s: Lane, due: Value, is_due: Value):
        """Set the lanes that are `stepping` in the next attempt: if the fallback `is_due` in any, only those that are `due`."""
        s.stepping = s.active

    def check_pivots(self, f: Function, s: Lane, name: str):
        """Compute the accelerations `name` of a stage again, or abandon the attempt, in lanes whose pivots are too small."""

    def note_unsafe(self, s: Lane, unsafe: Value):
        """Abandon the attempt in lanes whose pivots at the end of a step are too small."""

    def finish_step(self, f: Function, s: Lane):
        """Complete the end of the steps that the fallback takes."""

    def retry(self, f: Function, s: Lane, stepping: Value, failed: Value, tries: Value | None) -> Shortened:
        """Shorten attempts of `stepping` lanes that encountered too small a pivot, or leave them to the fallback.

        `failed` are lanes without a finite error, `tries` those whose attempt was a trial of an implicit step. By default all
        attempts are complete.
        """
        s.fallback_due = f.const(0.0, DOUBLE, f.width)
        return stepping, f.const(False, BOOL, f.width), f.const(np.inf, DOUBLE, f.width)

    def limit_of_error(self, f: Function, s: Lane, time_left: Value) -> Value | float:
        """Return the error, relative to the tolerance, up to which a step is accepted.

        `time_left` is the time (s) from the start of this step to a singular configuration.
        """
        return 1.0

    def step_around(
        self, f: Function, s: Lane, accept: Value, lanes: Callable[[], Value], time_left: Value, step: Value, otherwise: Value
    ) -> Value:
        """Return the length of the next step: in some lanes it is planned so that no node is close to a singular configuration.

        Args:
            f: The function.
            s: Its lanes.
            accept: The lanes whose step was accepted; others repeat it.
            lanes: Returns the lanes in which steps may be planned.
            time_left: The time (s) from the start of the attempted step to the singular configuration.
            step: The length (s) of the attempted step.
            otherwise: The length (s) of the next step without a plan.
        """
        return otherwise

    def close_output(self, f: Function, s: Lane, mask: Value):
        """Project outputs, in the lanes of `mask`, that still violate Psi, on all rows."""

    def keeping_rows(self, f: Function, do: Callable[[], None]):
        """Run the code of `do()`, which projects an output, with rows that a step would leave out because of small pivots."""
        do()

    def with_loads(self, f: Function, do: Callable[[], None], lanes: Value | None = None):
        """Run the code of `do()` with the loads that friction has in steps of the fallback, in `lanes` or in all."""
        do()

    def evaluate_settled(self, f: Function, s: Lane, settle: Callable[[], None], evaluate: Callable[[], None]):
        """Run the code of `evaluate()`; if pivots are unsafe, with loads of the fallback, which the code of `settle()` finds."""
        evaluate()

    def with_lost_loads(self, s: Lane, accept: Value, lost: Value) -> Value:
        """Return the lanes of `lost`, and those whose accepted step left out loads of joints that may grow without bounds."""
        return lost

    def if_safe(self, s: Lane, mask: Value) -> Value:
        """Return the lanes of a mask whose latest pivots are safe; by default the whole mask."""
        return mask

    def accelerate_state(self, f: Function, s: Lane):
        """Compute `result a` again in lanes whose pivots are too small."""

    def find_tangent_part(self, f: Function, s: Lane):
        """Compute `result dq` and `result dv`, the tangent parts of changes, again in lanes near singular configurations."""


class StiffnessPart(Part):
    """The implicit steps of stiff motions.

    With this base class all steps are explicit, and no run continues in another module (leaving.py).
    """

    method: Method | None = None
    """The implicit method."""
    pointers: Sequence[str] = ()
    """The global pointers of the module."""
    entry = "run", ("call",)
    """The function that runs members, with its arguments."""

    def __init__(self, plan: Plan):
        self._plan = plan

    def exact(self, f: Function) -> Any:
        """Return the matrix D (`DenseMatrices`) of the stage equations at a solved stage, which derivatives need."""
        raise NotImplementedError

    def write_measurement(self):
        """Write the function that measures the largest rate of the equations (run/stiffness.py)."""

    def write_stages(self, start: str):
        """Write the function that computes the stages of an implicit step from the point `start`, for example "point3"."""

    # --- a step

    def methods(self, f: Function, s: Lane) -> Iterator[tuple[Method, Value | None]]:
        """Yield each method of the module, and the mask of the lanes whose attempt it makes (None: all lanes)."""
        yield self._plan.method, None

    def take_stages(self, f: Function, s: Lane, implicit: Value, explicit: Callable[[], None]):
        """Take the stages of a step: by the code of `explicit()` or, in the lanes of `implicit`, by the implicit method."""
        explicit()

    def smooth_error(self, f: Function, s: Lane):
        """Damp the part of fast motions in the estimated errors of implicit steps that are trials."""

    def end_step(self, f: Function, s: Lane, implicit: Value):
        """Set `result a` at the end of a step in the lanes of `implicit`."""

    def repeat_diverged(self, f: Function, s: Lane, implicit: Value):
        """Set the `error` of implicit steps that have to be repeated, as a stage did not converge: a shorter step follows."""

    # --- the decision on the next step

    def trials(self, s: Lane, stepping: Value) -> Value | None:
        """Return the `stepping` lanes whose attempt is a trial of an implicit step; None if the module makes no trials."""
        return None

    def cost(self, f: Function, s: Lane, implicit: Value, explicit: Value) -> Value:
        """Return the number of evaluations that an attempt counts for; `explicit` is that of an explicit step."""
        return explicit

    def shift_points(self, f: Function, s: Lane, accept: Value):
        """Move the marks of points whose steps were implicit, in lanes whose step is accepted and becomes the latest."""

    def choose_next(self, f: Function, s: Lane, stepping: Value, accept: Value, implicit: Value, tries: Value | None):
        """Choose the method of the next step after an attempt.

        Args:
            stepping: mask of the lanes that made an attempt.
            accept: mask of the lanes whose step was accepted.
            implicit: mask of the lanes whose attempt was implicit.
            tries: mask of the lanes whose attempt was a trial of an implicit step; None: the module makes no trials.
        """

    # --- the end of the next step

    def plan_length(self, f: Function, s: Lane, begin: Value, start: Value, stop: Value) -> Value:
        """Return the length (s) of the next step from the time `start`, which is later shortened if it would end after `stop`."""
        return s.h

    def splits(self, s: Lane, splits: Value) -> Value:
        """Return the lanes of a mask whose steps after a breakpoint have to be short, as outputs need several points."""
        return splits

    def ends_at_output(self, f: Function, s: Lane, begin: Value, start: Value, t1: Value, stop: Value) -> Value | None:
        """Return the lanes whose step from the time `start` must end at an output instead of at `t1`; None if there are none."""
        return None

    def next_begin(self, f: Function, s: Lane) -> Value:
        """Return the number `begin` of next steps that do not begin a run: -1 for implicit ones, else zero."""
        return -s.stiff

    # --- points

    def between_explicit(self, s: Lane, near: Value, k: int) -> Value:
        """Return the lanes of the mask `near` in which the steps to the points k and k - 1 were explicit."""
        return near

    def return_to_point(self, s: Lane, mask: Value, k: int):
        """Restore the mark of point k, if its step was implicit, in masked lanes whose runs continue from there."""

    def begin_anew(self, f: Function, s: Lane) -> Value:
        """Return the number `begin` with which steps continue after an event: -1 for implicit ones, else zero."""
        return f.const(0.0, DOUBLE, f.width)

    # --- the run of all members (leaving.py)

    def begin_run(self, f: Function):
        """Write code for the beginning of `run(call)`."""

    def begin_members(self, f: Function, take: Callable[[], Value], begin: BeginMember, fill: Callable[[], None]):
        """Load the first members into the lanes.

        Args:
            f: The function that runs members.
            take: Returns the index of the next member that has not begun.
            begin: Loads a member into a lane.
            fill: Loads the next members into all empty lanes.
        """
        fill()

    def stays(self, f: Function, s: Lane, goes_on: Value, present: Callable[[], Value]) -> Value:
        """Return whether to take another step in this module: `goes_on`, unless one of the `present()` lanes has to leave."""
        return goes_on

    def end_run(self, f: Function, s: Lane, free: Callable[[], None]):
        """End `run(call)`; `free()` writes code that frees its memory."""
        free()

    def write_entries(self) -> list[Function]:
        """Return further functions by which others call the module."""
        return []

    def if_leaving(self, do: Callable[[], None]):
        """Call `do()`, which writes code, if members may leave the module; otherwise do nothing."""

    def mark(self, text: str) -> str:
        """Return the text of the module, with a comment that names functions to compile apart if there are any (text.py)."""
        return text
