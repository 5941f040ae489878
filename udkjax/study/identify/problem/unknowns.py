"""The unknowns of a fit: parameters and initial states, as dimensionless numbers z that are zero at the first guess.

A parameter x with first guess x0 is x0 exp(z) if it is positive; low + (high - low) / (1 + (1 / u0 - 1) exp(-z)) if it is
bounded, with u0 = (x0 - low) / (high - low); and x0 + scale z otherwise. An initial state is closed from a guess plus changes of
some coordinates and rates, one coordinate and one rate per degree of freedom.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.special import logit

from udkjax.annotations import NumericArray
from udkjax.arrays import make_module
from udkjax.positions.assembling.assembly import State
from udkjax.scene.elements.held import Held
from udkjax.scene.numbers.number_fields import NumberField, split_index
from udkjax.study.identify.records.records import IdentificationError, Record
from udkjax.study.quantities import Setter, StudyModel, parameter_value
from udkjax.wording import quote

Transform = Literal["positive", "bounded", "free"]
# Largest change of the residuals on the rest of the way to a bound, in standard deviations of their noise, at which a parameter
# is at the bound; and least way of z from the first guess.
BOUND_EFFECT, LEAST_WAY = 1e-2, 1.0
# Singular values below this, relative to the largest of a Jacobian, belong to directions that measurements do not determine. A
# change that does not affect the equations of motion has 1e-16, at any tolerance; derivatives integrated at 1e-7 have errors of
# 1e-8.
INVISIBLE_RATIO = 1e-8
BOUND_DISTANCE = 1e-3  # distance from a bound, relative to the range, at which a value is at the bound
FARTHEST_UNKNOWN = 20.0  # largest |z|; for a positive parameter, about the first guess times 5e8
# Distance of other guesses from the first: a factor for positive parameters, a fraction of the scale for others.
GUESS_FACTOR, GUESS_RADIUS = 2.5, 0.5
BOUND_MARGIN = 0.02  # least distance of a guess from a bound, relative to the range, since z is infinite at a bound
STATE_RADIUS = 0.05  # distance of guesses of initial states from the first, relative to the scene's length and time, and rad


class Target(NamedTuple):
    """The numbers of a scene that a value is assigned to. Targets are hashable, to share compiled programs among values.

    Attributes:
        names: names of the numbers.
        scaled: True if the value is a factor of the scene's own numbers, and not their new value.
        function: (mechanism, value) -> mechanism, which assigns the value; if it is given, names are not used.
    """

    names: tuple[str, ...] = ()
    scaled: bool = False
    function: Setter | None = None


class Unknown(NamedTuple):
    """A parameter: its name, target, transform, first guess, bounds, and prior."""

    name: str
    units: str
    target: Target
    kind: Transform
    at_scene_value: bool  # True if the first guess is the scene's value
    guess: float
    low: float  # NaN if there are no bounds
    high: float  # NaN if there are no bounds
    scale: float  # typical size of a change of a free parameter
    mean: float  # NaN if there is no prior
    sigma: float  # standard deviation of the prior; NaN if there is none


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All P parameters: the fields are those of `Unknown`, for each parameter; arrays are (P,)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    targets: tuple[Target, ...]
    kinds: tuple[Transform, ...]
    at_scene_values: bool  # True if all first guesses are the scene's values
    guess: Float[np.ndarray, "P"]
    low: Float[np.ndarray, "P"]
    high: Float[np.ndarray, "P"]
    scale: Float[np.ndarray, "P"]
    mean: Float[np.ndarray, "P"]
    sigma: Float[np.ndarray, "P"]

    @classmethod
    def of(cls, each: Sequence[Unknown]) -> "Unknowns":
        """Return the `Unknowns` of some parameters, in their order."""
        names, units, targets, kinds, at_scene_value, *numbers = zip(*each, strict=True)
        return cls(names, units, targets, kinds, all(at_scene_value), *np.array(numbers, float))

    def values(self, z: Float[NumericArray, "... P"], xp: Any = np) -> Any:
        """Return the values x of the parameters at the dimensionless unknowns z, by NumPy or, with `xp` `jax.numpy`, by JAX."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._values(z, xp)[0]

    def dx_dz(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return dx/dz, the derivative of each parameter with respect to its own unknown."""
        with np.errstate(over="ignore"):
            return np.exp(self.log_dx_dz(z))

    def d2x_dz2(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return d2x/dz2, the second derivative of each parameter with respect to its own unknown."""
        slope = self.dx_dz(z)
        with np.errstate(over="ignore", invalid="ignore"):
            return self._by_kind(slope, slope * (1.0 - 2.0 * self._values(z, np)[1]), np.zeros_like(slope))

    def log_dx_dz(self, z: Float[NumericArray, "... P"], xp: Any = np) -> Any:
        """Return log(dx/dz), which is finite where dx/dz overflows or is rounded to zero; by NumPy or JAX, as `values`."""
        positive, bounded, own, _, width = self._safe
        u = xp.where(bounded, z, 0.0) + own
        at_bound = np.log(width) - xp.logaddexp(0.0, u) - xp.logaddexp(0.0, -u)
        return xp.where(positive, own + z, xp.where(bounded, at_bound, np.log(self.scale)))

    def _values(self, z: Any, xp: Any) -> tuple[Any, Any]:
        """Return the values x at z, and the fraction of the way from the lower to the upper bound."""
        positive, bounded, own, low, width = self._safe
        factor = xp.exp(xp.where(positive, z, 0.0))
        part = xp.exp(-xp.logaddexp(0.0, -(xp.where(bounded, z, 0.0) + own)))
        return xp.where(positive, self.guess * factor, xp.where(bounded, low + width * part, self.guess + self.scale * z)), part

    @cached_property
    def _safe(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The masks of positive and of bounded parameters, and arrays `own`, `low` and `width` for the transforms.

        `own` is the logarithm (positive) or the logit (bounded) of the first guess, to which z is added; `low` and `width` are
        the lower bound and the width of the range. All numbers are finite for parameters of every kind, since derivatives of JAX
        multiply the terms of the other kinds by zero.
        """
        kinds = np.array(self.kinds)
        positive, bounded = kinds == "positive", kinds == "bounded"
        low, width = np.where(bounded, self.low, 0.0), np.where(bounded, self.high - self.low, 1.0)
        part = np.where(bounded, (self.guess - low) / width, 0.5)
        return positive, bounded, np.where(positive, np.log(np.where(positive, self.guess, 1.0)), logit(part)), low, width

    @np.errstate(divide="ignore", invalid="ignore")
    def z_of(self, x: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return the unknowns z of parameters x; they are not finite for a value outside its bounds, or not positive."""
        width = self.high - self.low
        bounded = logit((x - self.low) / width) - logit((self.guess - self.low) / width)
        return self._by_kind(np.log(x / self.guess), bounded, (x - self.guess) / self.scale)

    def _by_kind(self, positive: np.ndarray, bounded: np.ndarray, free: np.ndarray) -> np.ndarray:
        kinds = np.array(self.kinds)
        return np.select([kinds == "positive", kinds == "bounded"], [positive, bounded], free)

    def stuck_at_bounds(
        self, z: Float[np.ndarray, "K"], r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"], count: int
    ) -> Bool[np.ndarray, "K"]:
        """Return a mask of the unknowns that a fit pushes towards a bound (zero for positive parameters) without visible effect.

        dr/dz vanishes at a bound, where z is infinite. The rest of the way to the bound changes the residuals by about dr/dz: if
        this is at most `BOUND_EFFECT` of the noise, or not visible at all, the parameter is as good as at the bound.

        Args:
            z: the unknowns.
            r: residuals at z, which may be reduced to fewer (`reduce_rows`).
            J: the Jacobian of r.
            count: number of residuals before their reduction.
        """
        P = len(self.names)
        size, slope = np.linalg.norm(J, axis=0), (J.T @ r)[:P]
        kinds, noise = np.array(self.kinds), np.linalg.norm(r) / np.sqrt(max(count, 1))
        outwards = np.select([kinds == "positive", kinds == "bounded"], [-1.0, np.sign(z[:P])], 0.0)
        is_near = (size[:P] <= BOUND_EFFECT * noise) & (slope * outwards < 0.0) | (
            size[:P] <= INVISIBLE_RATIO * size.max(initial=0.0)
        )
        return np.append(is_near & (z[:P] * outwards > LEAST_WAY), np.zeros(len(z) - P, dtype=bool))

    @property
    def range_scale(self) -> Float[np.ndarray, "P"]:
        """The scale of each parameter, also at a bound: its first guess if it is positive, its range if it is bounded."""
        return self._by_kind(self.guess, self.high - self.low, self.scale)

    def at_bounds(self, x: Float[np.ndarray, "P"]) -> tuple[str, ...]:
        """Return the names of the parameters that are at one of their bounds."""
        near = np.minimum(x - self.low, self.high - x) <= BOUND_DISTANCE * (self.high - self.low)
        return tuple(name for name, at, kind in zip(self.names, near, self.kinds, strict=True) if at and kind == "bounded")


def apply_values(mechanism: Any, targets: Sequence[Target], x: Float[Array, "P"] | np.ndarray) -> Any:
    """Return the mechanism with values x (P,), which may be traced, assigned to targets in their order. The function is pure."""
    base, values = mechanism, {}
    for k, target in enumerate(targets):
        if target.function is not None:
            mechanism = target.function(mechanism.with_parameters(values) if values else mechanism, x[k])
            values = {}
        else:
            values |= {name: x[k] * parameter_value(base, name) if target.scaled else x[k] for name in target.names}
    return mechanism.with_parameters(values) if values else mechanism


def sample_guesses(u: Unknowns, z: Float[np.ndarray, "K"], count: int, seed: int) -> Float[np.ndarray, "B K"]:
    """Return `count` guesses sampled around a guess z.

    Positive and bounded parameters change by up to a factor of `GUESS_FACTOR` (of the odds, if bounded), free ones by up to half
    of their scale; in every second guess, bounded parameters are anywhere between their bounds. Unknowns of initial states, which
    follow the parameters, are changed only slightly.
    """
    P = len(u.names)
    unit = _latin_hypercube(count, len(z), seed)
    low, high = np.full(P, -np.log(GUESS_FACTOR)), np.full(P, np.log(GUESS_FACTOR))  # changes of z from the first guess
    free, bounded = (np.array([kind == which for kind in u.kinds], bool) for which in ("free", "bounded"))
    low[free], high[free] = -GUESS_RADIUS, GUESS_RADIUS
    guesses = z[:P] + low + (high - low) * unit[:, :P]
    inside = u.low + (u.high - u.low) * (BOUND_MARGIN + (1.0 - 2.0 * BOUND_MARGIN) * unit[:, :P])
    guesses[::2, bounded] = u.z_of(np.where(bounded, inside, u.values(guesses)))[::2, bounded]
    states = z[P:] + STATE_RADIUS * (2.0 * unit[:, P:] - 1.0)
    return np.concatenate([guesses, states], axis=1)


def _latin_hypercube(count: int, dimensions: int, seed: int) -> Float[np.ndarray, "B K"]:
    """Return `count` points of the unit cube, one in each of `count` parts of every axis; SciPy's function is slow to import."""
    random = np.random.default_rng(int(seed))
    parts = random.permuted(np.tile(np.arange(count), (dimensions, 1)), axis=1).T
    return (parts + random.random((count, dimensions))) / count


# --- differences between records


def with_conditions(mechanism: Any, record: Record) -> Any:
    """Return the mechanism with the conditions of a record."""
    return mechanism.with_parameters(record.conditions) if record.conditions else mechanism


def guessed_states(mechanism: StudyModel, records: Sequence[Record]) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Return guesses q and v (records, bodies, 3) of initial states; (None, None) if all are the scene's guess."""
    states = [record.start.state for record in records]
    if all(state is None for state in states):
        return None, None
    model: Any = mechanism
    default = State(model.q0, model.v0)
    q, v = (np.stack([np.asarray(getattr(state or default, field)) for state in states]) for field in "qv")
    return q, v


def conditions_of(mechanism: StudyModel, records: Sequence[Record]) -> dict[str, np.ndarray | Held]:
    """Return, for each parameter in the conditions of any record, its values in all records, stacked; samples as one `Held`.

    Records without this condition have the scene's value.

    Raises:
        IdentificationError: lists every unknown name, and every value of a wrong shape.
    """
    numbers, problems = mechanism.number_fields(), []
    conditions: dict[str, np.ndarray | Held] = {}
    for name in dict.fromkeys(name for record in records for name in record.conditions):
        owner, index = split_index(name, numbers)
        usual = _held_in_scene(mechanism, numbers.get(f"{name}.values"))
        if usual is None and (owner not in numbers or numbers[owner].value is None):
            problems.append(f"conditions: no parameter {quote(name)}")
            continue
        shape = (numbers[owner].shape or ()) if usual is None else np.shape(usual.values)[1:]
        if usual is None:
            usual = np.asarray(numbers[owner].value)[index]
        values = [record.conditions.get(name, usual) for record in records]
        try:
            is_sampled = any(isinstance(value, Held) for value in values)
            conditions[name] = _held_together(values, shape) if is_sampled else _stacked(values, shape[len(index) :])
        except ValueError as mistake:
            problems.append(f"conditions: {quote(name)} must be {mistake}")
    if problems:
        raise IdentificationError(problems)
    return conditions


def _held_in_scene(mechanism: Any, samples: NumberField | None) -> Held | None:
    """Return the `Held` that contains the samples; None if the samples belong to no `Held` of the scene."""
    holder = samples.holder(mechanism.groups) if samples is not None and mechanism.has_bodies else None
    return holder if isinstance(holder, Held) else None


def _stacked(values: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    try:
        return np.stack([np.broadcast_to(np.asarray(value, float), shape) for value in values])
    except ValueError:
        raise ValueError(f"of shape {shape} in each record") from None


def _held_together(values: Sequence[Any], shape: tuple[int, ...]) -> Held:
    """Return one `Held` with the samples of all records; shorter series and single numbers are continued by their last value."""
    times = {(value.dt, value.t0) for value in values if isinstance(value, Held)}
    if len(times) > 1:
        raise ValueError("held with the same `dt` and `t0` in all records: sample it again at equal times")
    (dt, t0), samples = times.pop(), [np.asarray(x.values if isinstance(x, Held) else np.asarray(x)[None], float) for x in values]
    most = max(map(len, samples))
    if any(x.shape[1:] != shape for x in samples):
        raise ValueError(f"of shape {shape} at each sample")
    stacked = np.stack([np.concatenate([x, np.repeat(x[-1:], most - len(x), 0)]) for x in samples])
    return make_module(Held, values=stacked, dt=dt, t0=t0)
