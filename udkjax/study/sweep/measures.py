"""Measures: what is stored of each member, and nothing else is computed."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from typing_extensions import TypeAliasType

from udkjax.annotations import Numbers, Scalar
from udkjax.equations.quantities import energy, violation
from udkjax.equations.scales import rank_tolerance
from udkjax.equations.textbook import prepare
from udkjax.integrate.solution import Solution
from udkjax.pinv import SVD, Auto, Pseudoinverse
from udkjax.scene.checks import quote, suggestion
from udkjax.scene.mechanism import Mechanism
from udkjax.study.channel_values import measure as evaluate_channels
from udkjax.study.channels import Channel, channel_of

UserMeasure = TypeAliasType("UserMeasure", Callable[[Mechanism, Solution], Numbers | Mapping[str, Scalar]])
OneMeasure = TypeAliasType("OneMeasure", str | UserMeasure)
MeasureChoice = TypeAliasType("MeasureChoice", OneMeasure | Sequence[OneMeasure] | Mapping[str, OneMeasure])
# Coordinates (T, bodies, 3) that runs are compared with, or a function (mechanism, ts) of them.
Reference = TypeAliasType("Reference", Solution | Numbers | Callable[[Mechanism, Array], Numbers] | None)

RANK_NOT_REACHED = -1  # the rank at output times that a run has not reached


class MeasuredRun(NamedTuple):
    """A member that has been run, as a measure sees it."""

    mechanism: Mechanism
    solution: Solution
    method: Pseudoinverse | None
    reference: Reference


class Label(NamedTuple):
    """The labels of a variable in a dataset."""

    dims: tuple[str, ...]
    units: str
    long_name: str


@dataclass(frozen=True)
class Measure:
    """The part of a run to be stored: `compute(run)` gives arrays by name."""

    name: str
    along: bool  # whether it needs all output times, not only the end
    compute: Callable[[MeasuredRun], Mapping[str, Array]]
    labels: Mapping[str, Label]  # empty: of a user's function
    reference: Reference = None
    renamed: str = ""  # the key that it was given under

    def of(self, mechanism: Mechanism, solution: Solution, method: Pseudoinverse | None) -> dict[str, Array]:
        """Return the arrays that are stored, under their names in the dataset."""
        found = self.compute(MeasuredRun(mechanism, solution, method, self.reference))
        return {self._key(name): jnp.asarray(value) for name, value in found.items()}

    @property
    def variables(self) -> dict[str, Label]:
        """The labels of its variables, by their names in the dataset; those of a user's function are not known."""
        return {self._key(name): label for name, label in self.labels.items()}

    @property
    def function(self) -> UserMeasure | None:
        """The user's function, if it is one."""
        return self.compute.function if isinstance(self.compute, _UserMeasure) else None

    def _key(self, name: str) -> str:
        if not self.renamed or not self.labels:
            return name
        return self.renamed if len(self.labels) == 1 else f"{self.renamed}_{name}"


def guess_label(name: str, shape: tuple[int, ...], outputs: int, bodies: int) -> Label:
    """Label what a user's function returned, by its shape."""
    dims = [f"{name}_{k}" for k in range(len(shape))]
    if shape[-2:] == (bodies, 3):
        dims[-2:] = "body", "coordinate"
    if shape and shape[0] == outputs and dims[0] != "body":
        dims[0] = "time"
    return Label(tuple(dims), "", "")


def measures_of(given: MeasureChoice, reference: Reference, ts: np.ndarray, mechanism: Mechanism) -> tuple[Measure, ...]:
    """Read `measure`: a name, a function of (mechanism, solution), a sequence of such, or a dict of them. Raises ValueError.

    Names are those of `MEASURES`, or of channels of the mechanism, such as `pin.C.x` and `driver.motor.load`.
    """
    if isinstance(given, Mapping):
        items = [(str(key), value) for key, value in given.items()]
    else:
        several = given if isinstance(given, list | tuple) else [cast(OneMeasure, given)]
        items = [("", value) for value in several]
    found = tuple(_measure(key, value, reference, ts, mechanism) for key, value in items)
    if reference is not None and not any(measure.name == "error" for measure in found):
        raise ValueError('reference: only the measure "error" looks at it, which is not among the measures')
    return found


def _measure(key: str, given: OneMeasure, reference: Reference, ts: np.ndarray, mechanism: Mechanism) -> Measure:
    if isinstance(given, str):
        if given not in MEASURES and "." in given:
            return _channel_measure(key, given, mechanism)
        if given not in MEASURES:
            near = suggestion(given, MEASURES) or f"; known are {', '.join(MEASURES)}, and channels such as pin.A.x"
            raise ValueError(f"measure {quote(given)}: there is none of this name{near}")
        along, compute, labels = MEASURES[given]
        if given == "error":
            reference = _reference(reference, ts)
        return Measure(given, along, compute, labels, reference if given == "error" else None, "" if key == given else key)
    if not callable(given):
        raise ValueError(f"measure {quote(key or str(given))}: must be a name or a function of (mechanism, solution)")
    name = key or getattr(given, "__name__", "measure").strip("<>")
    return Measure(name, True, _UserMeasure(given, name), {})


def _channel_measure(key: str, given: str, mechanism: Mechanism) -> Measure:
    try:
        channel = channel_of(mechanism, given)
    except ValueError as problem:
        raise ValueError(f"measure {quote(given)}: {problem}") from None
    labels = {channel.name: Label(("time",), channel.units, channel.name)}
    return Measure(channel.name, True, _ChannelMeasure(channel), labels, None, "" if key == channel.name else key)


@dataclass(frozen=True)
class _ChannelMeasure:
    """A channel over time."""

    channel: Channel

    def __call__(self, run: MeasuredRun) -> dict[str, Array]:
        return {self.channel.name: evaluate_channels(run.mechanism, run.solution, (self.channel,))[:, 0]}


@dataclass(frozen=True)
class _UserMeasure:
    """A user's function, whose single array has the measure's name."""

    function: UserMeasure
    name: str

    def __call__(self, run: MeasuredRun) -> dict[str, Array]:
        found = self.function(run.mechanism, run.solution)
        if isinstance(found, Mapping):
            return {f"{self.name}_{key}": jnp.asarray(value) for key, value in found.items()}
        return {self.name: jnp.asarray(found)}


def _reference(given: Reference, ts: np.ndarray) -> Reference:
    if given is None:
        raise ValueError(
            'measure "error" needs reference=: a Solution, coordinates (T, bodies, 3), or a function (mechanism, ts)'
        )
    if callable(given) and not hasattr(given, "shape"):
        return given
    q = np.asarray(getattr(given, "q", given), float)
    if q.ndim != 3 or q.shape[0] != len(ts) or q.shape[2] != 3:
        raise ValueError(f"reference: must be coordinates at the {len(ts)} output times, (T, bodies, 3), is of shape {q.shape}")
    return q


def _largest(x: Array) -> Array:
    """Return the largest absolute value; nan, at output times after the end of a run, does not count."""
    return jnp.max(jnp.where(jnp.isnan(x), 0.0, jnp.abs(x)), initial=0.0)


def _final(run: MeasuredRun) -> dict[str, Array]:
    return {"q_end": run.solution.q[-1], "v_end": run.solution.v[-1]}


def _states(run: MeasuredRun) -> dict[str, Array]:
    return {"q": run.solution.q, "v": run.solution.v}


def _violation(run: MeasuredRun) -> dict[str, Array]:
    return {"violation": _largest(violation(run.mechanism, run.solution))}


def _energy_drift(run: MeasuredRun) -> dict[str, Array]:
    total = energy(run.mechanism, run.solution).total
    return {"energy_drift": _largest(total - total[0])}


def _error(run: MeasuredRun) -> dict[str, Array]:
    reference = run.reference(run.mechanism, run.solution.ts) if callable(run.reference) else run.reference
    error = run.solution.q - jnp.asarray(getattr(reference, "q", reference))
    return {"position_error": _largest(error[..., :2]), "angle_error": _largest(error[..., 2])}


def _counts(run: MeasuredRun) -> dict[str, Array]:
    return {name: count for name, count in run.solution.stats.items() if name != "steps"}


def _rank(run: MeasuredRun) -> dict[str, Array]:
    """Compute ranks by the method's own rule; that of `Auto` is the rule of the singular values that it falls back to."""
    method = Auto() if run.method is None else run.method
    method = method.rank_revealing if isinstance(method, Auto) else method
    if method.rank_tol is None:
        method = replace(method, rank_tol=rank_tolerance(run.mechanism))
    equations, (ts, q) = prepare(run.mechanism, SVD()), (run.solution.ts, run.solution.q.reshape(len(run.solution.ts), -1))
    reached = jnp.all(jnp.isfinite(q), axis=1)
    ranks = jax.vmap(lambda t, q: method.rank(equations.weighted_rows(t, q)[0]))(ts, jnp.where(reached[:, None], q, q[0]))
    return {"rank": jnp.where(reached, ranks, RANK_NOT_REACHED)}


_STATE, _OVER_TIME = ("body", "coordinate"), ("time", "body", "coordinate")
# Whether all output times are needed, the function, and its variables.
MEASURES: dict[str, tuple[bool, Callable[[MeasuredRun], dict[str, Array]], dict[str, Label]]] = {
    "final": (
        False,
        _final,
        {
            "q_end": Label(_STATE, "m, m, rad", "coordinates at the end"),
            "v_end": Label(_STATE, "m/s, m/s, rad/s", "velocities at the end"),
        },
    ),
    "states": (
        True,
        _states,
        {
            "q": Label(_OVER_TIME, "m, m, rad", "coordinates: centre of mass and angle"),
            "v": Label(_OVER_TIME, "m/s, m/s, rad/s", "velocities"),
        },
    ),
    "violation": (True, _violation, {"violation": Label((), "m, rad", "largest constraint violation at an output time")}),
    "energy_drift": (
        True,
        _energy_drift,
        {"energy_drift": Label((), "J", "largest change of the total energy, by whatever does work, too")},
    ),
    "error": (
        True,
        _error,
        {
            "position_error": Label((), "m", "largest error of a coordinate of a centre of mass"),
            "angle_error": Label((), "rad", "largest error of an angle"),
        },
    ),
    "counts": (
        False,
        _counts,
        {
            "accepted": Label((), "1", "steps accepted"),
            "rejected": Label((), "1", "steps rejected"),
            "right_hand_sides": Label((), "1", "evaluations of the accelerations; -1: not known"),
            "projections": Label((), "1", "returns to the constraint manifold"),
        },
    ),
    "rank": (True, _rank, {"rank": Label(("time",), "1", "rank of D by the method's own rule; -1: not reached")}),
}
