"""The solution that a simulation returns."""

import json
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from udkjax.annotations import Numbers
from udkjax.arrays import number
from udkjax.equations.states.quantities import efforts
from udkjax.equations.states.scene_changes import SceneChanges
from udkjax.extras import OptionalImport
from udkjax.printing import PrintedTable, PrintsTable, PrintsWords, units
from udkjax.requirements import concrete_only
from udkjax.scene.elements.bodies import COORDINATES, Frame, frame_over_time
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.description import format_pose, size_of

if TYPE_CHECKING:
    from udkjax.integrate.events.law.event import Events


class Result(PrintsWords):
    """The ways in which a simulation ends."""

    successful = 0
    step_limit = 1
    step_too_small = 2
    not_finite = 3
    drift = 4
    could_not_assemble = 5
    event_stop = 6
    at_rest = 7
    event_limit = 8
    beyond_contact = 9
    event_impossible = 10
    invalid_argument = 11
    initial_state_open = 12
    undefined_condition = 13
    singular = 14
    spurious_rank = 15
    missing_rank = 16
    painleve_paradox = 17
    interrupted = 18

    @property
    def is_success(self) -> bool:
        """True if the run reached its last time, or an event that ends it."""
        return self in SUCCESSES

    def __str__(self) -> str:
        return self.label if self is Result.successful else f"{self.label}: {CAUSES[self]}"


SUCCESSES = (Result.successful, Result.event_stop, Result.at_rest)

# The cause of each result, common to all runs. `Solution.cause` is more specific for a single run, if possible.
CAUSES = {
    Result.successful: "the end time was reached",
    Result.step_limit: "the limit on steps was reached; raise `max_steps`, loosen the tolerances, or look for what is stiff",
    Result.step_too_small: "the step fell to the rounding of time: the right-hand side jumps or grows without bound here, a "
    "driver is at the end of its reach, or the tolerance is below what its rounding errors allow",
    Result.not_finite: "a number that is not finite appeared; look at the initial state, and at the loads and motions of the "
    "scene at this time (and, with `Augmented()`, at its redundant joints: plain LU cannot handle them)",
    Result.drift: "the constraints are violated by more than `drift_tol`: drivers ask for what the joints do not allow, or no "
    "`Projection()` stabilizes the run, or rows that its analysis found redundant are independent with the present numbers",
    Result.could_not_assemble: "the initial state cannot be closed; call `assemble` for what stays open",
    Result.initial_state_open: "the initial state that was given violates the constraints by more than `drift_tol`",
    Result.event_stop: "an event stopped the run",
    Result.at_rest: 'a contact whose impacts have at_rest="stop" came to rest',
    Result.event_limit: "there were more events than `max_events`: raise it, or look for what makes them follow so closely",
    Result.beyond_contact: "the run starts beyond a contact or limit, where its condition is negative already",
    Result.event_impossible: "an event asks for what the constraints do not allow: an impact in a direction in which they leave "
    "no motion, or in which friction would have to stop a driver, a joint attached where it is open or would have to stop a "
    "driver, or joints that neither stick nor slide, as their friction jams them",
    Result.invalid_argument: "an argument of this run cannot be used: output times that do not increase, a state that is not "
    "finite, a tolerance or first step that is not positive, or a number of the scene or of an event that cannot be: one that is "
    "not finite, a mass that is not positive, knots that do not increase, a lower limit above the upper one; or "
    "the drawing cannot be drawn with its numbers",
    Result.singular: "the run, which is not projected, met a singular configuration with its constraints too far open: it may "
    "have lost its energy, or gone on along another branch; use `Projection()`",
    Result.spurious_rank: "rows that depend on others along the whole motion counted as independent, and hold back what is free "
    "to move: the method's `rank_tol` is below rounding errors or, without `Projection()`, below the violation of the rows; "
    "raise it or use `Auto()`",
    Result.missing_rank: "rows that are independent counted as dependent near a singular configuration, and the motion violates "
    "them: the method's `rank_tol` is too large; lower it or use `Auto()`",
    Result.painleve_paradox: "friction leaves a contact no force (Painleve's paradox): the harder it presses, the more its "
    "friction turns it into its line, and without a force it would be penetrated; rigid bodies with Coulomb's friction have no "
    "accelerations here: make the coefficient smaller, or the contact compliant (a spring)",
    Result.interrupted: "Ctrl-C ended the run",
    Result.undefined_condition: "the condition of an event is not a number: look at what it divides by, or takes the root of",
}


_COUNT_ORDER = (
    "steps rejected implicit right_hand_sides projections events kinks"  # order of counts in texts, since jit sorts the names
)


class SimulationError(RuntimeError):
    """The error of a simulation that did not reach its end.

    Attributes:
        message: the cause, and the cure.
        solution: the `Solution` up to the failure.
    """

    def __init__(self, message: str, solution: "Solution"):
        super().__init__(message)
        self.solution = solution


class Solution(PrintsTable):
    """The states of a mechanism at the output times, the way in which the run ended, and its cost.

    `q` and `v` are (T, bodies, 3): x, y (m) and angle (rad) and their rates; NaN after a failure. `code` is a
    `Result`, `time` the time (s) that was reached, or of the first output with too much drift.

    Attributes:
        ts: output times (s).
        q: x, y (m) and angle (rad) of each body.
        v: their rates (m/s, rad/s).
        code: the number of a `Result`; `result` is the member.
        time: time that was reached (s).
        rtol: relative tolerance of the run.
        atol: absolute tolerance of the run.
        bodies: the names of the bodies, in the order of q and v.
        unlocated: time (s) from which jumps and kinks of forces are not located, so that derivatives do not pass through them;
            infinite if all are located, None if there are none.
        sticking: by joint with set-valued friction, a mask of the output times at which the joint sticks, or drivers hold it at
            rest; None if there is no such joint.
        scene_changes: the constraints that events release, add or hold, at the output times; None if no event changes any.
            Functions of a solution, such as `reactions` and `accelerations`, use the constraints that hold at each time.
    """

    ts: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]
    code: Int[Array, ""]
    time: Float[Array, ""]
    stats: dict[str, Int[Array, ""]]  # steps, accepted, rejected, implicit, right_hand_sides, projections
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    bodies: tuple[str, ...] = eqx.field(static=True)
    choices: tuple[tuple[str, str], ...] = eqx.field(static=True)  # `settings`, hashable
    events: "Events | None" = None  # `Events` of a run with events
    unlocated: Float[Array, ""] | None = None
    sticking: dict[str, Bool[Array, "T"]] | None = None
    scene_changes: SceneChanges | None = None
    found_cause: Any = eqx.field(static=True, default=None, repr=False)  # `FoundCause` of a single run that failed

    @property
    def settings(self) -> dict[str, str]:
        """The choices of the run, by name: the method, the solver, the engine and the reason for it, ..."""
        return dict(self.choices)

    @property
    def holds(self) -> dict[str, Bool[Array, "T"]]:
        """Masks of the output times at which constraints hold, by name: those that events release or add, and contacts.

        The contact of an event "floor" has the name "floor.contact", and holds while it rests.
        An output at the time of an event is after the event.
        """
        return {} if self.scene_changes is None else self.scene_changes.by_name

    @property
    def result(self) -> Any:
        """The `Result`; in a batch, or while traced, the array of codes."""
        if isinstance(self.code, Tracer) or np.ndim(self.code):
            return self.code
        return Result(int(self.code))

    @property
    def cause(self) -> str:
        """The end of the run, in words. The first access searches for the cause of a failure, for up to a second."""
        text = self.found_cause and self.found_cause.text(int(self.code), float(self.time))
        if self.events is not None and (names := self.events.undefined_names):
            text = f"the condition of {names} is not a number; look at what it divides by, or takes the root of"
        return f"{self.result.label} at t = {float(self.time):.6g} s: {text or CAUSES[self.result]}"

    _units = units(ts="s", q="m, m, rad", v="m/s, m/s, rad/s", time="s")

    def _table(self) -> PrintedTable:
        codes, counts = np.unique(np.asarray(self.code), return_counts=True)
        ended = ", ".join(f"{n} {Result(int(code)).label}" for code, n in zip(codes, counts, strict=True))
        ts, several = np.asarray(self.ts), np.ndim(self.code) > 0
        rows = {
            "result": ended if several else self.cause,
            "times": f"{ts.shape[-1]}, from {ts.min():g} to {ts.max():g} s",
            "work": format_work({name: np.sum(value) for name, value in self.stats.items()}),
            "rtol, atol": f"{np.max(np.asarray(self.rtol)):g}, {np.max(np.asarray(self.atol)):g}",
            **{name.replace("_", " "): value for name, value in self.choices if name in ("method", "solver", "engine")},
        }
        if several:
            rows["bodies"] = ", ".join(self.bodies)
            return PrintedTable(f"simulation of {np.size(self.code)} members", list(rows.items()))
        counts = {joint: int(np.sum(np.asarray(sticks))) for joint, sticks in (self.sticking or {}).items()}
        if counts:
            rows["sticking"] = ", ".join(f"{joint} at {count} of {len(ts)} times" for joint, count in counts.items())
        q = np.asarray(self.q).reshape(len(ts), -1, np.shape(self.q)[-1])
        for k, body in enumerate(self.bodies):
            rows[body] = f"from {format_pose(q[0, k], size_of(q))} to {format_pose(q[-1, k], size_of(q))}"
        return PrintedTable("simulation", list(rows.items()))

    def frame(self, body: str) -> Frame:
        """Return the frame of a body over time: each of its numbers is an array (T,)."""
        return frame_over_time(self.bodies, self.q, self.v, body)

    def path(self, body: str, point: Numbers = (0.0, 0.0)) -> Float[Array, "T 2"]:
        """Return the path (m) of a point given in the body's own frame (m). `udkjax.path` also supports pins and velocities."""
        return jnp.stack(self.frame(body).point(number(point)), -1)

    @concrete_only()
    def to_xarray(self, mechanism: Mechanism | None = None) -> Any:
        """Return an xarray Dataset: q and v over time, body and coordinate, units, versions, settings, result and statistics.

        The q and v of a `ConstrainedSystem` are over time and coordinate, without units. `holds`, over time and constraint, tells
        which of the constraints that events change hold at the output times.

        If `mechanism` is given, the dataset also has its numbers (the attribute `parameters`, as JSON), its text (`scene`, as
        TOML) and the efforts of its drivers (`effort` over time and driver): torques (N m) and forces (N), by `udkjax.efforts`.
        """
        with OptionalImport():
            import xarray

        mechanism = mechanism if mechanism is not None and mechanism.has_bodies else None  # else without the text of a scene
        if self.bodies:
            dims, coords = ("time", "body", "coordinate"), {"body": list(self.bodies), "coordinate": list(COORDINATES)}
        else:
            dims, coords = ("time", "coordinate"), {"coordinate": np.arange(np.shape(self.q)[-1])}
        data = xarray.Dataset(
            {"q": (dims, np.asarray(self.q)), "v": (dims, np.asarray(self.v))}, {"time": np.asarray(self.ts), **coords}
        )
        data["time"].attrs = {"units": "s"}
        data["q"].attrs, data["v"].attrs = {"long_name": "coordinates"}, {"long_name": "velocities"}
        if self.bodies:
            data["q"].attrs = {"long_name": "coordinates: centre of mass and angle", "units": "m, m, rad"}
            data["v"].attrs |= {"units": "m/s, m/s, rad/s"}
        data.attrs = {
            "title": mechanism.name if mechanism is not None else "",
            "result": self.result.name,
            "cause": self.cause,
            "end_time": float(self.time),
            **{f"stats_{k}": int(v) for k, v in self.stats.items()},
            "setting_rtol": float(self.rtol),
            "setting_atol": float(self.atol),
            **{f"setting_{k}": v for k, v in self.choices},
            **{f"version_{k}": v for k, v in versions().items()},
        }
        SceneChanges.write(self.scene_changes, data)
        if mechanism is not None:
            data.attrs["parameters"] = json.dumps({k: np.asarray(v).tolist() for k, v in mechanism.parameters().items()})
            data.attrs["scene"] = scene_text(mechanism)
            if not mechanism.massless and (dataset := efforts(mechanism, self)):
                data = data.assign_coords(driver=list(dataset))
                data["effort"] = ("time", "driver"), np.stack([np.asarray(x) for x in dataset.values()], 1)
                units = sorted({mechanism.drivers[name].effort_unit for name in dataset}, reverse=True)
                data["effort"].attrs = {"long_name": "what drivers exert along their coordinates", "units": " or ".join(units)}
        return data


def format_work(stats: Mapping[str, ArrayLike]) -> str:
    """Return the counts of a run (`Solution.stats`) as text, without those that are -1, unknown."""
    words = {name: name.replace("_", " ") for name in stats} | {"right_hand_sides": "right-hand sides"}
    counts = {name: int(np.asarray(count)) for name, count in stats.items() if name != "accepted"}
    if not counts.get("implicit", 1):
        del counts["implicit"]
    return ", ".join(f"{counts[name]:,} {words[name]}" for name in sorted(counts, key=_COUNT_ORDER.find) if counts[name] >= 0)


def scene_text(mechanism: Any) -> str:
    """Return a mechanism as the text of a scene file; if this is impossible, a comment with the reason."""
    from udkjax.scene.files import dumps
    from udkjax.scene.tables.checks import SceneError

    try:
        return dumps(mechanism)
    except SceneError as error:  # user-defined classes cannot be written
        return f"# {error}"


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages on which results depend, by name."""
    from importlib.metadata import PackageNotFoundError, version

    result = {"python": sys.version.split()[0]}
    for package in ("udkjax", "jax", "jaxlib", "diffrax", "equinox", "llvmlite", "numpy"):
        try:
            result[package] = version(package)
        except PackageNotFoundError:
            result[package] = "unknown"
    return result
