"""Parameters to be identified: how they are asked for, what of a mechanism they change, and the values that they may take.

An unknown z is dimensionless, zero at the first guess x0, and may be any number: a positive parameter is x = x0 exp(z), one
between bounds is x = low + (high - low) / (1 + (1 / u0 - 1) exp(-z)) with u0 the place of x0 between them, and any other one is
x = x0 + scale z.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.deprecation import renamed_arguments
from udkjax.scene.checks import SceneError, quoted, suggestion
from udkjax.scene.fields import NOT_NEGATIVE, POSITIVE
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import holder_of, parameters_of, split
from udkjax.scene.reshaping import length_of
from udkjax.scene.schema import keys
from udkjax.study.identify.messages import IdentificationError
from udkjax.study.quantities import Length
from udkjax.study.units import units_of

Transform = Literal["positive", "bounded", "free"]
Setter: TypeAlias = Callable[[Mechanism, Any], Mechanism]  # (mechanism, value) -> mechanism
Row: TypeAlias = dict[str, Any]  # what `Unknowns` holds of one parameter, by the names of its fields
AT_BOUND = 1e-3  # of the distance between the bounds: a value as near to one of them is said to be at it
FAR = 20.0  # of an unknown: a positive parameter a hundred million times too large is not looked at


class Target(NamedTuple):
    """What a value is assigned to: hashable, so that what is compiled for it serves all values."""

    names: tuple[str, ...] = ()
    scaled: bool = False
    function: Setter | None = None


@dataclass(frozen=True, eq=False)
class Unknowns:
    """All parameters: their names and targets, first guesses, transforms, and priors (nan: none); arrays are (P,)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    targets: tuple[Target, ...]
    guess: Float[np.ndarray, "P"]
    kinds: tuple[Transform, ...]
    low: Float[np.ndarray, "P"]
    high: Float[np.ndarray, "P"]
    scale: Float[np.ndarray, "P"]
    mean: Float[np.ndarray, "P"]
    sigma: Float[np.ndarray, "P"]
    at_scene_values: bool = False  # whether all first guesses are

    def values(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return x(z)."""
        return self._values_and_slopes(z)[0]

    def dx_dz(self, z: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return dx/dz."""
        return self._values_and_slopes(z)[1]

    @np.errstate(over="ignore", invalid="ignore")
    def _values_and_slopes(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, slope = np.empty_like(z), np.empty_like(z)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.guess[k], self.low[k], self.high[k]
            if kind == "positive":
                x[..., k] = slope[..., k] = x0 * np.exp(z[..., k])
            elif kind == "bounded":
                part = 1.0 / (1.0 + ((high - x0) / (x0 - low)) * np.exp(-z[..., k]))
                x[..., k], slope[..., k] = low + (high - low) * part, (high - low) * part * (1.0 - part)
            else:
                x[..., k], slope[..., k] = x0 + self.scale[k] * z[..., k], self.scale[k]
        return x, slope

    def z_of(self, x: Float[np.ndarray, "... P"]) -> Float[np.ndarray, "... P"]:
        """Return z(x)."""
        z = np.empty_like(x)
        for k, kind in enumerate(self.kinds):
            x0, low, high = self.guess[k], self.low[k], self.high[k]
            if kind == "positive":
                z[..., k] = np.log(x[..., k] / x0)
            elif kind == "bounded":
                z[..., k] = np.log((x[..., k] - low) / (high - x[..., k]) * ((high - x0) / (x0 - low)))
            else:
                z[..., k] = (x[..., k] - x0) / self.scale[k]
        return z

    def at_bounds(self, x: Float[np.ndarray, "P"]) -> tuple[str, ...]:
        """Return the names of those that are at one of their bounds."""
        near = np.minimum(x - self.low, self.high - x) <= AT_BOUND * (self.high - self.low)
        return tuple(name for name, at, kind in zip(self.names, near, self.kinds, strict=True) if at and kind == "bounded")


def apply_values(mechanism: Mechanism, targets: Sequence[Target], x: Float[Array, "P"] | np.ndarray) -> Mechanism:
    """Return the mechanism with the values x (P,) assigned, in the order of the parameters. Pure; x may be traced."""
    base, values = parameters_of(mechanism), {}
    for k, target in enumerate(targets):
        if target.function is not None:
            mechanism = target.function(mechanism.with_parameters(values) if values else mechanism, x[k])
            values = {}
        else:
            values |= {name: x[k] * entry_of(base, name) if target.scaled else x[k] for name in target.names}
    return mechanism.with_parameters(values) if values else mechanism


def entry_of(known: Mapping[str, Any], name: str) -> Array:
    """Return a parameter, or one entry of it, among those of a mechanism."""
    owner, index = split(name, known)
    return jnp.asarray(known[owner].value)[index]


# --- what is asked for


def length(*bodies: str, as_rod: bool = False) -> Length:
    """Name the length of a link as a parameter, or the common length of several: attachments and centre of mass move together.

    With `as_rod` mass and inertia follow, as those of a rod of the same mass per metre do. See `udkjax.with_length`.
    """
    return Length(bodies, as_rod)


@renamed_arguments(start="guess")
@dataclass(frozen=True)
class Parameter:
    """What is to be identified.

    Attributes:
        of: the name of a number of the scene (`body.link1.mass`, `joint.A.points[1][0]`), a `length`, several of either that are
            tied, or a pure function (mechanism, value) -> mechanism. As text, ties are written with equals signs
            (`body.a.mass = body.b.mass`, `length(a) = length(b)`), a shared factor as `scale(body.a.mass, body.b.mass)`.
        name: what it is called; by default the text.
        guess: the first guess, in SI units; by default the scene's value. A function needs one.
        bounds: (low, high), between which the value stays.
        prior: (mean, standard deviation), what was known of it before.
        transform: "positive", "bounded" or "free"; by default what must not be negative stays positive.
        scale: the typical size of a change of a free one; by default its own size, or 1 SI unit.
        share: "value": what is tied has one value; "scale": it has one factor by which the scene's values are multiplied.
    """

    of: str | Length | Sequence[str] | Setter
    name: str = ""
    guess: float | None = None
    bounds: tuple[float, float] | None = None
    prior: tuple[float, float] | None = None
    transform: Transform | None = None
    scale: float | None = None
    share: Literal["value", "scale"] = "value"


OneAsked: TypeAlias = str | Length | Parameter | Setter
Asked: TypeAlias = OneAsked | Sequence[OneAsked]


def unknowns_of(mechanism: Mechanism, given: Asked) -> Unknowns:
    """Read parameters: texts, lengths, functions and `Parameter`s.

    Raises:
        IdentificationError: with every mistake.
    """
    items = [given] if isinstance(given, str | Length | Parameter) or callable(given) else list(given)
    problems: list[str] = []
    rows = [row for item in items for row in _rows(mechanism, item, problems)]
    if not items:
        problems.append("parameters: there is none to identify; name some, such as body.link1.mass")
    names = [row["name"] for row in rows]
    for name in dict.fromkeys(names):
        if names.count(name) > 1:
            problems.append(f"{quoted(name)}: is there {names.count(name)} times")
    problems.extend(_shared_numbers(rows))
    if problems:
        raise IdentificationError(problems)
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    arrays = {key: np.array(columns[key], float) for key in ("guess", "low", "high", "scale", "mean", "sigma")}
    return Unknowns(
        tuple(columns["name"]),
        tuple(columns["units"]),
        tuple(columns["target"]),
        kinds=tuple(columns["kind"]),
        at_scene_values=all(columns["at_scene_value"]),
        **arrays,
    )


def _shared_numbers(rows: Sequence[Row]) -> list[str]:
    """Return what is wrong where two parameters contain the same number of the scene."""
    owner: dict[str, str] = {}
    found = []
    for row in rows:
        for name in row["target"].names:
            if name in owner and owner[name] != row["name"]:
                found.append(f"{quoted(row['name'])}: {name} is a part of {quoted(owner[name])} already; tie them, or take one")
            owner[name] = row["name"]
    return found


def _rows(mechanism: Mechanism, item: OneAsked, problems: list[str]) -> list[Row]:
    """Return what `Unknowns` holds of a parameter; of an array, for each of its entries."""
    p = item if isinstance(item, Parameter) else Parameter(item)
    try:
        targets = _targets(mechanism, p)
    except (SceneError, ValueError) as problem:
        problems.append(str(problem) if not p.name else f"{quoted(p.name)}: {problem}")
        return []
    found = []
    for target, first, same in targets:
        name = p.name + (target.names[0][len(_owner_name(target.names[0])) :] if p.name and len(targets) > 1 else "")
        name = name or _name(target)
        try:
            found.append(_row(mechanism, p, name, target, first, same))
        except (TypeError, ValueError) as problem:
            problems.append(f"{quoted(name)}: {problem}")
    return found


def _owner_name(name: str) -> str:
    return re.sub(r"(\[\d+\])+$", "", name)


def _name(target: Target) -> str:
    if target.function is not None:
        return str(target.function) if isinstance(target.function, Length) else getattr(target.function, "__name__", "function")
    return f"scale({', '.join(target.names)})" if target.scaled else " = ".join(target.names)


def _row(mechanism: Mechanism, p: Parameter, name: str, target: Target, first: float | None, same: bool) -> Row:
    guess = p.guess if p.guess is not None else first
    if guess is None:
        raise ValueError("needs a first guess: Parameter(..., guess=...)")
    guess = float(guess)
    if not np.isfinite(guess):
        raise ValueError(f"the first guess must be a finite number, is {guess}")
    kind = p.transform or (
        "bounded" if p.bounds is not None else "positive" if _is_positive(mechanism, target, guess) else "free"
    )
    if kind not in get_args(Transform):
        raise ValueError(f"transform must be one of {', '.join(get_args(Transform))}, is {kind!r}")
    low, high = p.bounds if p.bounds is not None else (np.nan, np.nan)
    if p.bounds is not None and not np.isfinite(p.bounds).all():
        raise ValueError(f'bounds must be two finite numbers, are ({low}, {high}); what has no upper one can be "positive"')
    if kind == "bounded" and not low < guess < high:
        raise ValueError(f"the first guess {guess:g} must be between the bounds ({low}, {high}): move the one or the others")
    if kind == "positive" and not guess > 0:
        raise ValueError(f'the first guess {guess:g} must be > 0; give another one, or transform="free"')
    mean, sigma = p.prior if p.prior is not None else (np.nan, np.nan)
    if p.prior is not None and not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
        raise ValueError("prior must be (mean, standard deviation), with a deviation > 0")
    scale = p.scale if p.scale is not None else abs(guess) or 1.0
    if not scale > 0:
        raise ValueError(f"scale must be > 0, is {scale}")
    numbers = {"guess": guess, "low": low, "high": high, "scale": scale, "mean": mean, "sigma": sigma}
    at_scene = same and guess == first
    return {
        "name": name,
        "target": target,
        "kind": kind,
        "units": _units(mechanism, target),
        "at_scene_value": at_scene,
        **numbers,
    }


def _units(mechanism: Mechanism, target: Target) -> str:
    if isinstance(target.function, Length):
        return "m"
    return "1" if target.scaled else units_of(mechanism, target.names[0]) if target.names else ""


def _is_positive(mechanism: Mechanism, target: Target, guess: float) -> bool:
    """Whether a value must not become negative."""
    if target.function is not None:
        return isinstance(target.function, Length)
    return guess > 0 and (target.scaled or all(_must_be_positive(mechanism, name) for name in target.names))


def _must_be_positive(mechanism: Mechanism, name: str) -> bool:
    known = parameters_of(mechanism)
    found = known[split(name, known)[0]]
    if not found.path:
        return False
    metadata = keys(type(holder_of(mechanism, found)))[found.path[-1]].metadata
    return any(rule in metadata.get("require", ()) for rule in POSITIVE["require"] + NOT_NEGATIVE["require"])


# --- what a parameter refers to


def _targets(mechanism: Mechanism, p: Parameter) -> list[tuple[Target, float | None, bool]]:
    """Return targets, one for each entry of an array; the scene's value there; and whether all that is tied has that value."""
    of, scaled = p.of, p.share == "scale"
    if p.share not in ("value", "scale"):
        raise ValueError(f'share must be "value" or "scale", is {p.share!r}')
    if isinstance(of, str):
        of, scaled = _read(mechanism, of, scaled)
    if isinstance(of, Length):
        lengths = [float(length_of(mechanism, body)) for body in of.bodies or ("",)]
        return [(Target(function=of), lengths[0], len(set(lengths)) == 1)]
    if callable(of):
        return [(Target(function=of), None, False)]
    known = parameters_of(mechanism)
    names = tuple(of)
    problems = []
    for name in names:
        owner, _ = split(name, known)
        if owner not in known:
            problems.append(f"no parameter {quoted(name)}{suggestion(name, known)}")
        elif known[owner].value is None:
            problems.append(f"{quoted(name)} is absent from the scene: set it there first")
    if problems or not names:
        raise ValueError("; ".join(problems) or "names nothing")
    values = [np.asarray(entry_of(known, name)) for name in names]
    if len({v.shape for v in values}) > 1:
        raise ValueError(f"cannot be tied: their shapes are {', '.join(str(v.shape) for v in values)}")
    if scaled:
        return [(Target(names, True), 1.0, True)]
    return [
        (
            Target(tuple(name + "".join(f"[{i}]" for i in at) for name in names)),
            float(values[0][at]),
            all(v[at] == values[0][at] for v in values),
        )
        for at in np.ndindex(values[0].shape)
    ]


def _read(mechanism: Mechanism, text: str, scaled: bool) -> tuple[Length | tuple[str, ...], bool]:
    """Read the text of a parameter: names or lengths with equals signs between them, or a shared scale of names."""
    text = text.strip()
    if text.startswith("scale(") and text.endswith(")"):
        return tuple(part.strip() for part in text[6:-1].split(",") if part.strip()), True
    parts = [part.strip() for part in text.split("=")]
    bodies = [_length(mechanism, part) for part in parts]
    if all(bodies):
        return Length(tuple(body for group in bodies for body in group)), False
    if any(bodies):
        raise ValueError(f"{quoted(text)}: a length cannot be tied to another kind of number")
    return tuple(parts), scaled


def _length(mechanism: Mechanism, text: str) -> tuple[str, ...]:
    """The bodies of `length(a, b)` or `a.length`."""
    if text.startswith("length(") and text.endswith(")"):
        return tuple(body.strip().strip("\"'") for body in text[7:-1].split(","))
    owner, dot, field = text.rpartition(".")
    return (owner,) if dot and field == "length" and owner in mechanism.body_names else ()
