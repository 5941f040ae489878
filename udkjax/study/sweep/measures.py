"""Measures: the variables stored for each member; nothing else is computed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from inspect import isclass
from typing import Any, NamedTuple, TypeAlias, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike, Numbers
from udkjax.equations.states.quantities import energy, equations_of, violation
from udkjax.equations.states.scene_changes import scene_along
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.solution import Solution
from udkjax.pinv import SVD, Auto, Pseudoinverse
from udkjax.positions.assembling.channel_values import measure as evaluate_channels
from udkjax.positions.assembling.channels import Channel, channel_of
from udkjax.scene.mechanism import Mechanism
from udkjax.study.quantities import StudyModel
from udkjax.study.sweep.dimensions import refuse_untraceable
from udkjax.wording import quote, suggestion

UserMeasure = TypeAliasType(
    "UserMeasure",
    Callable[[Mechanism, Solution], Numbers | Mapping[str, NumberLike]]
    | Callable[[ConstrainedSystem, Solution], Numbers | Mapping[str, NumberLike]],
)
OneMeasure = TypeAliasType("OneMeasure", str | UserMeasure)
MeasureChoice = TypeAliasType("MeasureChoice", OneMeasure | Sequence[OneMeasure] | Mapping[str, OneMeasure])
# Coordinates (T, bodies, 3) to compare runs with, or a function of (mechanism, ts) that returns them.
Reference = TypeAliasType("Reference", Solution | Numbers | Callable[[Any, Array], Numbers] | None)

SECONDS = "seconds"  # name of the measure whose values are written after a chunk has been computed
RANK_NOT_REACHED = -1  # rank at output times that a run did not reach


class MeasuredRun(NamedTuple):
    """The input of a measure: a completed run and its method."""

    mechanism: Any  # a mechanism or a system
    solution: Solution
    method: Pseudoinverse | None
    reference: Reference


Compute: TypeAlias = Callable[[MeasuredRun], dict[str, Array]]


class Label(NamedTuple):
    """The labels of a variable in a dataset."""

    dims: tuple[str, ...]
    units: str
    long_name: str


@dataclass(frozen=True)
class Measure:
    """The part of a run to be stored: `compute(run)` returns arrays, which are stored by the names of `labels`, in this order.

    Without labels, a user-defined `function` names its arrays.
    """

    name: str
    compute: Callable[[MeasuredRun], Mapping[str, Array]]
    labels: Mapping[str, Label] = field(default_factory=dict)
    along: bool = True  # True if all output times are needed, not only the last
    reference: Reference = None
    function: UserMeasure | None = None

    def of(self, mechanism: StudyModel, solution: Solution, method: Pseudoinverse | None) -> dict[str, Array]:
        """Return the stored arrays by name in the dataset."""
        outputs = self.compute(MeasuredRun(mechanism, solution, method, self.reference))
        return {name: jnp.asarray(x) for name, x in zip(self.labels or outputs, outputs.values(), strict=True)}

    def for_model(self, model: StudyModel) -> "Measure":
        """Return the measure with the labels that it has for a model."""
        return self if model.has_bodies else replace(self, labels=_LABELS_OF_COORDINATES.get(self.name, self.labels))

    def renamed(self, key: str) -> "Measure":
        """Return the measure with its variable renamed to `key`, or with `key` as a prefix of several names."""
        if key in ("", self.name):
            return self
        alone = len(self.labels) == 1
        return replace(self, labels={key if alone else f"{key}_{name}": label for name, label in self.labels.items()})


LAMBDA_NAME = "lambda"  # name of an anonymous function


def guess_label(name: str, shape: tuple[int, ...], outputs: int, state_shape: tuple[int, ...], units: str = "") -> Label:
    """Return the label of a variable that a user-defined function returns, with dimensions guessed from its shape.

    `outputs` is the number of output times.
    """
    dims = [f"{name}_{k}" for k in range(len(shape))]
    of_state = ("body", "coordinate")[-len(state_shape) :]
    if shape[-len(state_shape) :] == state_shape and shape != (outputs,):
        dims[-len(of_state) :] = of_state
    if shape and shape[0] == outputs and dims[0] not in of_state:
        dims[0] = "time"
    return Label(tuple(dims), units, "")


def measures_of(given: MeasureChoice, reference: Reference, ts: np.ndarray, mechanism: StudyModel) -> tuple[Measure, ...]:
    """Return the measures for an argument: a name, a function of (mechanism, solution), or a sequence or dict of these.

    Names are those of `MEASURES`, or of channels of the mechanism, such as `pin.C.x` and `driver.motor.load`.

    Raises:
        ValueError: a measure or the reference is invalid.
    """
    if isinstance(given, Mapping):
        items = [(str(key), value) for key, value in given.items()]
    else:
        several = given if isinstance(given, list | tuple) else [cast(OneMeasure, given)]
        items = [("", value) for value in several]
    measures = tuple(_measure(key, value, mechanism).renamed(key) for key, value in items)
    if not any(measure.name == "error" for measure in measures):
        if reference is not None:
            raise ValueError('reference: is used by the measure "error" only, which is not among the measures')
        return measures
    reference = _reference(reference, ts, mechanism)
    return tuple(replace(measure, reference=reference) if measure.name == "error" else measure for measure in measures)


def _measure(key: str, given: OneMeasure, mechanism: StudyModel) -> Measure:
    if isinstance(given, str):
        if given in MEASURES:
            return MEASURES[given].for_model(mechanism)
        if "." not in given and mechanism.has_bodies:
            near = suggestion(given, MEASURES) or f"; use {', '.join(MEASURES)}, or a channel such as pin.A.x"
            raise ValueError(f"measure {quote(given)} does not exist{near}")
        try:
            channel = channel_of(mechanism, given)
        except ValueError as problem:
            raise ValueError(f"measure {quote(given)}: {problem}") from None
        label = Label(("time",), channel.units, channel.name)
        return Measure(channel.name, partial(_evaluate_channel, channel), {channel.name: label})
    if not callable(given) or isclass(given):
        raise ValueError(f"measure {quote(key or str(given))}: must be a name or a function of (mechanism, solution)")
    name = key or getattr(given, "__name__", "measure").strip("<>")
    return Measure(name, partial(_call, given, name), function=given)


def _evaluate_channel(channel: Channel, run: MeasuredRun) -> dict[str, Array]:
    return {channel.name: evaluate_channels(run.mechanism, run.solution, (channel,))[:, 0]}


def _call(function: UserMeasure, name: str, run: MeasuredRun) -> dict[str, Array]:
    """Call a user-defined function; return its arrays by name.

    The measure's name is that of a single array, or a prefix of the names in a mapping, unless the function has no name.
    """
    with refuse_untraceable(f"measure {quote(name)}"):
        outputs = function(run.mechanism, run.solution)
    if isinstance(outputs, Mapping):
        front = "" if name == LAMBDA_NAME else f"{name}_"
        return {f"{front}{key}": jnp.asarray(value) for key, value in outputs.items()}
    return {name: jnp.asarray(outputs)}


def _reference(given: Reference, ts: np.ndarray, mechanism: StudyModel) -> Reference:
    if given is None:
        raise ValueError(
            'measure "error" needs reference=: a Solution, coordinates (T, bodies, 3), or a function (mechanism, ts)'
        )
    if callable(given) and not hasattr(given, "shape"):
        return given
    q = np.asarray(getattr(given, "q", given), float)
    is_state = q.ndim == 3 and q.shape[2] == 3 if mechanism.has_bodies else q.ndim == 2
    if not is_state or q.shape[0] != len(ts):
        shape = "(T, bodies, 3)" if mechanism.has_bodies else "(T, n)"
        raise ValueError(f"reference: must be coordinates at the {len(ts)} output times, {shape}, but is of shape {q.shape}")
    return q


def _largest(x: Array) -> Array:
    """Return the largest absolute value; the NaN after the end of a run is ignored."""
    return jnp.max(jnp.where(jnp.isnan(x), 0.0, jnp.abs(x)), initial=0.0)


# --- measures by name

MEASURES: dict[str, Measure] = {}
_STATE_DIMENSIONS, _TIME_DIMENSIONS = ("body", "coordinate"), ("time", "body", "coordinate")


def _named(name: str, along: bool = True, **labels: Label) -> Callable[[Compute], Compute]:
    """Return a decorator that adds a function to `MEASURES` as the measure with a name.

    `along` is True if the measure needs all output times, and `labels` are those of its variables.
    """

    def add(compute: Compute) -> Compute:
        MEASURES[name] = Measure(name, compute, labels, along)
        return compute

    return add


@_named(
    "final",
    along=False,
    q_end=Label(_STATE_DIMENSIONS, "m, m, rad", "coordinates at the end"),
    v_end=Label(_STATE_DIMENSIONS, "m/s, m/s, rad/s", "velocities at the end"),
)
def _final(run: MeasuredRun) -> dict[str, Array]:
    return {"q_end": run.solution.q[-1], "v_end": run.solution.v[-1]}


@_named(
    "states",
    q=Label(_TIME_DIMENSIONS, "m, m, rad", "coordinates: centre of mass and angle"),
    v=Label(_TIME_DIMENSIONS, "m/s, m/s, rad/s", "velocities"),
)
def _states(run: MeasuredRun) -> dict[str, Array]:
    return {"q": run.solution.q, "v": run.solution.v}


@_named("violation", violation=Label((), "m, rad", "largest constraint violation at an output time"))
def _violation(run: MeasuredRun) -> dict[str, Array]:
    return {"violation": _largest(violation(run.mechanism, run.solution))}


@_named(
    "energy_drift", energy_drift=Label((), "J", "largest change of the total energy, including the work of loads and drivers")
)
def _energy_drift(run: MeasuredRun) -> dict[str, Array]:
    total = energy(run.mechanism, run.solution).total
    return {"energy_drift": _largest(total - total[0])}


@_named(
    "error",
    position_error=Label((), "m", "largest error of a coordinate of a centre of mass"),
    angle_error=Label((), "rad", "largest error of an angle"),
)
def _error(run: MeasuredRun) -> dict[str, Array]:
    with refuse_untraceable("reference"):
        reference = run.reference(run.mechanism, run.solution.ts) if callable(run.reference) else run.reference
    error = run.solution.q - jnp.asarray(getattr(reference, "q", reference))
    if not run.mechanism.has_bodies:
        return {"error": _largest(error)}
    return {"position_error": _largest(error[..., :2]), "angle_error": _largest(error[..., 2])}


@_named(
    "counts",
    along=False,
    accepted=Label((), "1", "accepted steps"),
    rejected=Label((), "1", "rejected steps"),
    right_hand_sides=Label((), "1", "evaluations of the accelerations; -1: unknown"),
    projections=Label((), "1", "projections on the constraint manifold"),
)
def _counts(run: MeasuredRun) -> dict[str, Array]:
    return {name: run.solution.stats[name] for name in MEASURES["counts"].labels}


@_named(SECONDS, along=False, seconds=Label((), "s", "computing time: the member's share, by steps, of that of its chunk"))
def _seconds(run: MeasuredRun) -> dict[str, Array]:
    return {SECONDS: jnp.array(jnp.nan)}  # measured outside the program


@_named("rank", rank=Label(("time",), "1", "rank of D by the method's own rule; -1: not reached"))
def _rank(run: MeasuredRun) -> dict[str, Array]:
    """Return ranks by the method's rule; for `Auto`, by the rule of its rank-revealing fallback."""
    method = Auto() if run.method is None else run.method
    method = method.rank_revealing if isinstance(method, Auto) else method
    if not run.mechanism.has_bodies:
        return {"rank": _ranks_of_rows(run, method)}
    scene, analysis, knowledge = scene_along(run.mechanism, run.solution)[:3]
    equations = equations_of(scene, SVD(), analysis=analysis)
    ts, q = run.solution.ts, run.solution.q.reshape(len(run.solution.ts), -1)
    if method.rank_tol is None:
        method = replace(method, rank_tol=equations.scales.rank_tol)
    reached = jnp.all(jnp.isfinite(q), axis=1)

    def rank(t: Array, q: Array, known: Any) -> Array:
        return method.rank(equations.known(known).weighted_rows(t, q)[0])

    ranks = jax.vmap(rank)(ts, jnp.where(reached[:, None], q, q[0]), knowledge.states(scene))
    return {"rank": jnp.where(reached, ranks, RANK_NOT_REACHED)}


# --- measures of models without bodies, whose states are vectors

_LABELS_OF_COORDINATES = {
    "final": {
        "q_end": Label(("coordinate",), "", "coordinates at the end"),
        "v_end": Label(("coordinate",), "", "velocities at the end"),
    },
    "states": {
        "q": Label(("time", "coordinate"), "", "coordinates"),
        "v": Label(("time", "coordinate"), "", "velocities"),
    },
    "violation": {"violation": Label((), "", "largest residual of Psi or phi at an output time")},
    "error": {"error": Label((), "", "largest error of a coordinate")},
    "energy_drift": {"energy_drift": Label((), "J", "largest change of the total energy, including the work of loads")},
}


def _ranks_of_rows(run: MeasuredRun, method: Pseudoinverse) -> Array:
    solution, reached = run.solution, jnp.all(jnp.isfinite(run.solution.q), axis=1)
    equations: Any = equations_of(run.mechanism.traced(solution.q.shape[1]), method)
    q, v = (jnp.where(reached[:, None], x, x[0]) for x in (solution.q, solution.v))
    ranks = jax.vmap(lambda t, q, v: equations.rank(t, q, v))(solution.ts, q, v)
    return jnp.where(reached, ranks, RANK_NOT_REACHED)
