"""Parameters to be identified: their names, and the numbers of the mechanism that they set."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import isclass
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from typing_extensions import TypeAliasType

from udkjax.argument_types import ArgumentRequirement, of_kind
from udkjax.requirements import ArgumentTypeError, describe, require_choice, require_numbers, require_text
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.reshaping import length_of
from udkjax.scene.tables.checks import SceneError
from udkjax.study.identify.problem.unknowns import Target, Transform, Unknown, Unknowns
from udkjax.study.identify.records.records import IdentificationError
from udkjax.study.quantities import Length, Setter, StudyModel, parameter_value
from udkjax.wording import quote, suggestion


def length(*bodies: str, as_rod: bool = False) -> Length:
    """Return the length of a link, or the common length of several, as a parameter; it moves attachments and centre of mass.

    Args:
        *bodies: the names of the links.
        as_rod: whether mass and inertia change with the length as for a uniform rod; see `udkjax.with_length`.

    Returns:
        A `Length`, to be given to `identify` as a parameter.
    """
    return Length(bodies, as_rod)


@dataclass(frozen=True)
class Parameter:
    """A parameter to be identified.

    Attributes:
        of: the name of a number of the scene (`body.link1.mass`, `joint.A.points[1][0]`), a `length`, several tied names or
            lengths, or a pure function (mechanism, value) -> mechanism. In strings, ties are written with equals signs
            (`body.a.mass = body.b.mass`, `length(a) = length(b)`), and a shared factor as `scale(body.a.mass, body.b.mass)`.
        name: name of the parameter; by default its text.
        guess: the first guess, in SI units; by default the scene's value. A function needs a guess.
        bounds: (low, high), the range of the value.
        prior: (mean, standard deviation) of the prior knowledge.
        transform: "positive", "bounded" or "free"; by default "bounded" with bounds, and "positive" for numbers that must be
            positive.
        scale: typical size of a change of a free parameter; by default its absolute value, or 1 SI unit.
        share: "value": tied parameters have the same value; "scale": the scene's values are multiplied by the same factor.
    """

    of: str | Length | Sequence[str] | Setter
    name: str = ""
    guess: float | None = None
    bounds: tuple[float, float] | None = None
    prior: tuple[float, float] | None = None
    transform: Transform | None = None
    scale: float | None = None
    share: Literal["value", "scale"] = "value"

    def __post_init__(self):
        is_list = isinstance(self.of, Sequence) and all(isinstance(name, str) for name in self.of)
        if not (is_list or isinstance(self.of, Length) or (callable(self.of) and not isclass(self.of))):
            kinds = "a name, a list of names, a length or a function of (mechanism, value)"
            raise ArgumentTypeError(f"of must be {kinds}, {describe(self.of)}")
        require_text("name", self.name, may_be_empty=True)
        pair, one = ((2,), "two numbers"), ((), "one number")
        for name, kind in (("guess", one), ("bounds", pair), ("prior", pair), ("scale", one)):
            if getattr(self, name) is not None:
                require_numbers(name, getattr(self, name), *kind)
        if self.transform is not None:
            require_choice("transform", self.transform, get_args(Transform))
        require_choice("share", self.share, ("value", "scale"))


ParameterLike = TypeAliasType("ParameterLike", str | Length | Parameter | Setter)


def _is_parameter(x: Any) -> bool:
    """Return True for the name of a parameter, a `Parameter`, or names of tied parameters."""
    is_tie = isinstance(x, list | tuple) and all(isinstance(name, str) for name in x)
    return isinstance(x, str) or is_tie or callable(x) or hasattr(x, "of")


PARAMETERS = ArgumentRequirement(
    "parameters",
    of_kind(
        "be the name of a parameter, a Parameter, or a list of these",
        lambda x: all(map(_is_parameter, x)) if isinstance(x, list | tuple) else _is_parameter(x),
    ),
)
ParametersLike = TypeAliasType("ParametersLike", Annotated[ParameterLike | Sequence[ParameterLike], PARAMETERS])


class _Part(NamedTuple):
    """The target of one unknown, and its value in the scene."""

    target: Target
    value: float | None  # None for a function
    same: bool  # True if all tied numbers have this value


def unknowns_of(mechanism: StudyModel, given: ParametersLike) -> Unknowns:
    """Return the unknowns for parameters that are given as strings, lengths, functions or `Parameter`s.

    Raises:
        IdentificationError: lists every mistake.
    """
    items = [given] if isinstance(given, str | Length | Parameter) or callable(given) else list(given)
    problems: list[str] = []
    unknowns = [unknown for item in items for unknown in _entries(mechanism, item, problems)]
    if not items:
        problems.append("parameters: the list is empty; name at least one, such as body.link1.mass")
    names = [unknown.name for unknown in unknowns]
    problems += [f"{quote(n)}: is given {names.count(n)} times" for n in dict.fromkeys(names) if names.count(n) > 1]
    owner: dict[str, str] = {}  # name of the parameter that sets each number of the scene
    for unknown in unknowns:
        for number in unknown.target.names:
            earlier = owner.setdefault(number, unknown.name)
            if earlier != unknown.name:
                problems.append(f"{quote(unknown.name)}: {number} is also part of {quote(earlier)}; tie them, or give only one")
    if problems:
        raise IdentificationError(problems)
    return Unknowns.of(unknowns)


def _entries(mechanism: StudyModel, item: ParameterLike, problems: list[str]) -> list[Unknown]:
    """Return the unknowns of a parameter, one for each entry of an array; mistakes are added to `problems`."""
    p = item if isinstance(item, Parameter) else Parameter(item)
    try:
        parts = _parts(mechanism, p)
    except (SceneError, ValueError) as problem:
        problems.append(f"parameters: {f'{quote(p.name)}: ' * bool(p.name)}{problem}")
        return []
    unknowns = []
    for part in parts:
        name = p.name or _name(part.target)
        if p.name and len(parts) > 1:
            name += "".join(re.findall(r"\[\d+\]", part.target.names[0].rpartition(".")[2]))
        try:
            unknowns.append(_unknown(mechanism, p, name, part))
        except (TypeError, ValueError) as problem:
            problems.append(f"parameters: {quote(name)}: {problem}")
    return unknowns


def _name(target: Target) -> str:
    if target.function is not None:
        return str(target.function) if isinstance(target.function, Length) else getattr(target.function, "__name__", "function")
    return f"scale({', '.join(target.names)})" if target.scaled else " = ".join(target.names)


def _unknown(mechanism: StudyModel, p: Parameter, name: str, part: _Part) -> Unknown:
    """Return the unknown for one number that a parameter refers to.

    Raises:
        ValueError: its first guess, bounds, prior, transform or scale is invalid.
    """
    target, given = part.target, part.value if p.guess is None else p.guess
    if given is None:
        raise ValueError("needs a first guess: Parameter(..., guess=...)")
    guess = float(given)
    if not np.isfinite(guess):
        raise ValueError(f"the first guess must be a finite number, not {guess}")
    usual = "bounded" if p.bounds is not None else "positive" if _is_positive(mechanism, target, guess) else "free"
    kind = p.transform or usual
    low, high = p.bounds if p.bounds is not None else (np.nan, np.nan)
    if p.bounds is not None and not np.isfinite(p.bounds).all():
        raise ValueError(f'bounds must be two finite numbers, not ({low}, {high}); without an upper bound, use "positive"')
    if low >= high:
        raise ValueError(f"bounds must be (low, high), the lower one first, not ({low}, {high})")
    if kind == "bounded" and not low < guess < high:
        raise ValueError(f"the first guess {guess:g} must be between the bounds ({low}, {high}): change the guess or the bounds")
    if kind == "positive" and not guess > 0:
        raise ValueError(f'the first guess {guess:g} must be > 0; give another one, or transform="free"')
    mean, sigma = p.prior if p.prior is not None else (np.nan, np.nan)
    if p.prior is not None and not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
        raise ValueError("prior must be (mean, standard deviation), with a deviation > 0")
    scale = p.scale if p.scale is not None else abs(guess) or 1.0
    if not scale > 0:
        raise ValueError(f"scale must be > 0, not {scale}")
    at_scene_value = part.same and guess == part.value
    return Unknown(name, _units(mechanism, target), target, kind, at_scene_value, guess, low, high, scale, mean, sigma)


def _units(mechanism: StudyModel, target: Target) -> str:
    if isinstance(target.function, Length):
        return "m"
    return "1" if target.scaled else mechanism.unit_of(target.names[0]) if target.names else ""


def _is_positive(mechanism: StudyModel, target: Target, guess: float) -> bool:
    """Return True if the value assigned to a target must stay positive."""
    if target.function is not None:
        return isinstance(target.function, Length)
    return guess > 0 and (target.scaled or all(mechanism.must_be_positive(name) for name in target.names))


# --- numbers that a parameter refers to


def _parts(mechanism: StudyModel, p: Parameter) -> list[_Part]:
    """Return the numbers that a parameter refers to; an array has one for each entry."""
    of, scaled = p.of, p.share == "scale"
    if isinstance(of, str):
        of, scaled = _read(mechanism, of, scaled)
    if isinstance(of, Length):
        scene: Any = mechanism
        scene.require_bodies("a ConstrainedSystem has no bodies, and thus no lengths: name a number of the system")
        lengths = [float(length_of(scene, body)) for body in of.bodies or ("",)]
        return [_Part(Target(function=of), lengths[0], len(set(lengths)) == 1)]
    if callable(of):
        return [_Part(Target(function=of), None, False)]
    numbers = mechanism.number_fields()
    names = tuple(of)
    problems = []
    for name in names:
        owner, _ = split_index(name, numbers)
        if owner not in numbers:
            problems.append(f"no parameter {quote(name)}{suggestion(name, numbers)}")
        elif numbers[owner].value is None:
            problems.append(f"{quote(name)} is absent from the scene: set it there first")
    if problems or not names:
        raise ValueError("; ".join(problems) or "contains no name")
    values = [np.asarray(parameter_value(mechanism, name)) for name in names]
    if len({v.shape for v in values}) > 1:
        raise ValueError(f"cannot be tied: their shapes are {', '.join(str(v.shape) for v in values)}")
    if scaled:
        return [_Part(Target(names, True), 1.0, True)]
    return [
        _Part(
            Target(tuple(name + "".join(f"[{i}]" for i in index) for name in names)),
            float(values[0][index]),
            all(v[index] == values[0][index] for v in values),
        )
        for index in np.ndindex(values[0].shape)
    ]


def _read(mechanism: StudyModel, text: str, scaled: bool) -> tuple[Length | tuple[str, ...], bool]:
    """Parse the text of a parameter: names or lengths separated by equals signs, or names with a common scale.

    Returns:
        The `Length`, or the names of numbers, and whether these have a common scale.
    """
    text = text.strip()
    if text.startswith("scale(") and text.endswith(")"):
        return tuple(part.strip() for part in text[6:-1].split(",") if part.strip()), True
    parts = [part.strip() for part in text.split("=")]
    bodies = [_length(mechanism, part) for part in parts]
    if all(bodies):
        return Length(tuple(body for group in bodies for body in group)), False
    if any(bodies):
        raise ValueError(f"{quote(text)}: a length cannot be tied to another kind of number")
    return tuple(parts), scaled


def _length(mechanism: StudyModel, text: str) -> tuple[str, ...]:
    """Return the bodies of `length(a, b)` or `a.length`; empty if the text is not a length."""
    if text.startswith("length(") and text.endswith(")"):
        return tuple(body.strip().strip("\"'") for body in text[7:-1].split(","))
    owner, dot, field = text.rpartition(".")
    return (owner,) if dot and field == "length" and owner in mechanism.body_names else ()
