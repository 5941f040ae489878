"""The unknowns of a fit: parameters and initial states, as dimensionless numbers z that are zero at the first guess.

A parameter x with first guess x0 is x0 exp(z) if it is positive; low + (high - low) / (1 + (1 / u0 - 1) exp(-z)) if it is
bounded, with u0 = (x0 - low) / (high - low); and x0 + scale z otherwise. An initial state is closed from a guess plus changes of
some coordinates and rates, one coordinate and one rate per degree of freedom.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.linalg import qr
from scipy.special import expit, logit

from udkjax.arrays import make_module
from udkjax.equations.analysis import analyse
from udkjax.equations.dense_rows import KinematicRows
from udkjax.positions.assembly import State, assemble
from udkjax.positions.channels import RATES, UNITS
from udkjax.scene.bodies import COORDINATES
from udkjax.scene.checks import SceneError
from udkjax.scene.held import Held
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.number_fields import parameters_of, split_index
from udkjax.study.identify.records import Estimated, IdentificationError, Record, Start
from udkjax.study.quantities import Setter, parameter_value
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
SMALLEST_READABLE_PART = 1e-3  # least pivot, relative to the largest, of coordinates that are chosen as unknowns
STATE_RADIUS = 0.05  # distance of guesses of initial states from the first, relative to the scene's length and time, and rad


class Target(NamedTuple):
    """The numbers of a scene that a value is assigned to. Targets are hashable, to share compiled programs among values."""

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
    high: float
    scale: float
    mean: float  # NaN if there is no prior
    sigma: float


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All P parameters: see `Unknown`; arrays are (P,)."""

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
        """Combine parameters."""
        names, units, targets, kinds, at_scene_value, *numbers = zip(*each, strict=True)
        return cls(names, units, targets, kinds, all(at_scene_value), *np.array(numbers, float))

    def values(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return x(z)."""
        return self._values_and_slopes(z)[0]

    def dx_dz(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return dx/dz."""
        return self._values_and_slopes(z)[1]

    @np.errstate(over="ignore", invalid="ignore")
    def _values_and_slopes(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        width, x = self.high - self.low, self.guess * np.exp(z)
        part = expit(z + logit((self.guess - self.low) / width))
        values = self._by_kind(x, self.low + width * part, self.guess + self.scale * z)
        return values, self._by_kind(x, width * part * (1.0 - part), self.scale)

    @np.errstate(divide="ignore", invalid="ignore")
    def z_of(self, x: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return z(x); not finite for a value outside its bounds, or not positive."""
        width = self.high - self.low
        bounded = logit((x - self.low) / width) - logit((self.guess - self.low) / width)
        return self._by_kind(np.log(x / self.guess), bounded, (x - self.guess) / self.scale)

    def _by_kind(self, positive: np.ndarray, bounded: np.ndarray, free: np.ndarray) -> np.ndarray:
        kinds = np.array(self.kinds)
        return np.select([kinds == "positive", kinds == "bounded"], [positive, bounded], free)

    def stuck_at_bounds(
        self, z: Float[np.ndarray, "K"], r: Float[np.ndarray, "R"], J: Float[np.ndarray, "R K"]
    ) -> Bool[np.ndarray, "K"]:
        """Return which unknowns a fit pushes towards a bound, zero for positive parameters, without a visible effect.

        dr/dz vanishes at a bound, where z is infinite. The rest of the way to the bound changes the residuals by about dr/dz: if
        this is at most `BOUND_EFFECT` of the noise, or not visible at all, the parameter is as good as at the bound.
        """
        P = len(self.names)
        size, slope = np.linalg.norm(J, axis=0), (J.T @ r)[:P]
        kinds, noise = np.array(self.kinds), np.linalg.norm(r) / np.sqrt(max(len(r), 1))
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


def apply_values(mechanism: Mechanism, targets: Sequence[Target], x: Float[Array, "P"] | np.ndarray) -> Mechanism:
    """Return the mechanism with values x (P,), which may be traced, assigned in the order of the parameters; pure."""
    base, values = mechanism, {}
    for k, target in enumerate(targets):
        if target.function is not None:
            mechanism = target.function(mechanism.with_parameters(values) if values else mechanism, x[k])
            values = {}
        else:
            values |= {name: x[k] * parameter_value(base, name) if target.scaled else x[k] for name in target.names}
    return mechanism.with_parameters(values) if values else mechanism


def sample_guesses(u: Unknowns, z: Float[np.ndarray, "K"], count: int, seed: int) -> Float[np.ndarray, "B K"]:
    """Sample guesses around a first one: within a factor, or half of the scale; every second guess anywhere between bounds.

    Unknowns of initial states, which follow the parameters, are changed only slightly.
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
    """Sample points of the unit cube, one in each of `count` parts of every coordinate; SciPy's function is slow to import."""
    random = np.random.default_rng(seed)
    parts = random.permuted(np.tile(np.arange(count), (dimensions, 1)), axis=1).T
    return (parts + random.random((count, dimensions))) / count


# --- initial states


class InitialStateUnknowns(NamedTuple):
    """The S dimensionless unknowns of one initial state, which tied records share.

    `sizes` (S,) are the changes of the named coordinates and rates per unit of each unknown, in `units`; `basis` has the
    changes of all q and v (n,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    sizes: Float[np.ndarray, "S"]
    basis: Float[np.ndarray, "2 n S"]


def initial_state_unknowns(
    mechanism: Mechanism, unknowns: Unknowns, records: Sequence[Record]
) -> tuple[tuple[InitialStateUnknowns, ...], Int[np.ndarray, "records S"], Float[np.ndarray, "records 2 n S"]]:
    """Return the unknowns of all initial states, their indices in z for each record (-1: unused), and the changes of q and v."""
    by_start: dict[Hashable, tuple[Start, int, InitialStateUnknowns]] = {}  # key: the name of a start, or the index of its record
    index, problems = len(unknowns.names), []
    for k, record in enumerate(records):
        start, key = record.start, record.start.name or k
        if start.estimate == "nothing":
            continue
        if key in by_start:
            if not _same(by_start[key][0], start):
                problems.append(
                    f"{record.place}start {quote(start.name)} differs from that of an earlier record: give the same Start to both"
                )
        else:
            label = start.name or record.name or (f"record {k + 1}" if len(records) > 1 else "start")
            try:
                mech = apply_values(with_conditions(mechanism, record), unknowns.targets, unknowns.guess)
                by_start[key] = start, index, state_unknowns(mech, record.t0, start.state, start.estimate, label)
            except SceneError as problem:
                raise IdentificationError([f"{record.place}{problem}"]) from None
            index += len(by_start[key][2].names)
    if problems:
        raise IdentificationError(problems)
    states = tuple(state for _, _, state in by_start.values())
    S = max((len(state.names) for state in states), default=0)
    columns, bases = np.full((len(records), S), -1), np.zeros((len(records), 2, 3 * len(mechanism.body_names), S))
    for k, record in enumerate(records):
        if record.start.estimate != "nothing":
            _, first, state = by_start[record.start.name or k]
            count = len(state.names)
            columns[k, :count], bases[k, ..., :count] = first + np.arange(count), state.basis
    return states, columns, bases


def _same(first: Start, second: Start) -> bool:
    a, b = first.state, second.state
    equal = a is b or (a is not None and b is not None and np.array_equal(a.q, b.q) and np.array_equal(a.v, b.v))
    return equal and first.estimate == second.estimate


def with_conditions(mechanism: Mechanism, record: Record) -> Mechanism:
    """Return the mechanism with the conditions of a record."""
    return mechanism.with_parameters(record.conditions) if record.conditions else mechanism


def state_unknowns(mech: Mechanism, t0: float, guess: State | None, estimate: Estimated, label: str) -> InitialStateUnknowns:
    """Choose coordinates that parametrize the closed states near a guess (None: the scene's guess), only angles if possible.

    The names of the unknowns begin with `label`.
    """
    rows, q = KinematicRows(mech), np.asarray(assemble(mech, t0, guess).q, float).ravel()
    free = np.eye(len(q))
    if rows.count:
        position = rows.close(t0, q)
        assert position is not None, "an assembled state is closed"
        free = rows.metric[:, None] * position.vt[position.rank :].T
    chosen, scales = _independent_rows(free), analyse(mech).scales
    size = np.where(np.array(chosen) % 3 == 2, 1.0, float(scales.length))  # angles in rad
    rate = float(scales.rate) or 1.0  # 1/s for a scene without motion and loads
    basis = free @ np.linalg.inv(free[chosen]) * size
    names: list[str] = []
    units: list[str] = []
    sizes, parts, nothing = [], [], np.zeros_like(basis)
    kinds = ("position", COORDINATES, 1.0, (basis, nothing)), ("velocity", RATES, rate, (nothing, rate * basis))
    for kind, fields, factor, part in kinds:
        if estimate in (kind, "both"):
            sizes.append(factor * size)
            names += [f"{label}: body.{mech.body_names[k // 3]}.{fields[k % 3]}" for k in chosen]
            units += [UNITS[fields[k % 3]] for k in chosen]
            parts.append(np.stack(part))
    return InitialStateUnknowns(tuple(names), tuple(units), np.concatenate(sizes), np.concatenate(parts, axis=2))


def _independent_rows(free: np.ndarray) -> list[int]:
    """Choose as many well-conditioned rows as there are columns, only rows of angles if possible."""
    count, all_rows = free.shape[1], np.arange(len(free))
    chosen = all_rows[:0]
    for rows in (all_rows[2::3], all_rows):
        factors: Any = qr(free[rows].T / np.linalg.norm(free, 2), mode="r", pivoting=True)
        R, order = factors
        chosen, sizes = rows[order[:count]], np.abs(np.diag(R))
        if len(sizes) == count and sizes.min(initial=1.0) >= SMALLEST_READABLE_PART:
            break
    return sorted(chosen.tolist())


# --- other differences between records


def guessed_states(mechanism: Mechanism, records: Sequence[Record]) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Return guesses q and v (records, bodies, 3) of initial states; None if all are the scene's guess."""
    states = [record.start.state for record in records]
    if all(state is None for state in states):
        return None, None
    default = State(mechanism.q0, mechanism.v0)
    q, v = (np.stack([np.asarray(getattr(state or default, field)) for state in states]) for field in "qv")
    return q, v


def conditions_of(mechanism: Mechanism, records: Sequence[Record]) -> dict[str, np.ndarray | Held]:
    """Return the values in all records of each parameter that differs between records, stacked; samples as one `Held`."""
    numbers, problems = parameters_of(mechanism), []
    conditions: dict[str, np.ndarray | Held] = {}
    for name in dict.fromkeys(name for record in records for name in record.conditions):
        owner, index = split_index(name, numbers)
        if owner not in numbers or numbers[owner].value is None:
            problems.append(f"conditions: no parameter {quote(name)}")
            continue
        field = numbers[owner]
        usual = field.value if isinstance(field.value, Held) else np.asarray(field.value)[index]
        values = [record.conditions.get(name, usual) for record in records]
        try:
            is_sampled = any(isinstance(value, Held) for value in values)
            conditions[name] = _held_together(values, field.shape or ()) if is_sampled else _stacked(values, np.shape(usual))
        except ValueError as mistake:
            problems.append(f"conditions: {quote(name)} must be {mistake}")
    if problems:
        raise IdentificationError(problems)
    return conditions


def _stacked(values: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    try:
        return np.stack([np.broadcast_to(np.asarray(value, float), shape) for value in values])
    except ValueError:
        raise ValueError(f"of shape {shape} in each record") from None


def _held_together(values: Sequence[Any], shape: tuple[int, ...]) -> Held:
    """Return one `Held` with the samples of all records; fewer samples are continued by the last one, as is a number."""
    times = {(value.dt, value.t0) for value in values if isinstance(value, Held)}
    if len(times) > 1:
        raise ValueError("held with the same `dt` and `t0` in all records: sample it again at equal times")
    (dt, t0), samples = times.pop(), [np.asarray(x.values if isinstance(x, Held) else np.asarray(x)[None], float) for x in values]
    most = max(map(len, samples))
    if any(x.shape[1:] != shape for x in samples):
        raise ValueError(f"of shape {shape} at each sample")
    stacked = np.stack([np.concatenate([x, np.repeat(x[-1:], most - len(x), 0)]) for x in samples])
    return make_module(Held, values=stacked, dt=dt, t0=t0)
