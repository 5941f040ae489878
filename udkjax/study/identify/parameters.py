"""Parameters to be identified: how they are asked for, and what of a mechanism each of them is."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from udkjax.scene.checks import SceneError, quoted, suggestion
from udkjax.scene.fields import NOT_NEGATIVE, POSITIVE
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import holder_of, parameters_of, split
from udkjax.scene.reshaping import length_of
from udkjax.scene.schema import keys
from udkjax.study.identify.errors import IdentificationError
from udkjax.study.identify.unknowns import Target, Transform, Unknowns, entry_of
from udkjax.study.quantities import Length
from udkjax.study.units import units_of


def length(*bodies: str, as_rod: bool = False) -> Length:
    """Name the length of a link as a parameter, or the common length of several: attachments and centre of mass move together.

    With `as_rod` mass and inertia follow, as those of a rod of the same mass per metre do. See `udkjax.with_length`.
    """
    return Length(bodies, as_rod)


@dataclass(frozen=True)
class Parameter:
    """What is to be identified.

    `of` is the name of a number of the scene (`body.link1.mass`, `joint.A.points[1][0]`), a `length`, several of either that are
    tied, or a pure function (mechanism, value) -> mechanism, which needs a `start`. What is tied has one value, or, with
    `share="scale"`, one factor by which the scene's own values are multiplied. As text, ties are written with equals signs
    (`body.a.mass = body.b.mass`, `length(a) = length(b)`), a shared factor as `scale(body.a.mass, body.b.mass)`.

    `start` is the first guess (default: the scene's value), `bounds` (low, high) is what the value stays between, `prior` (mean,
    standard deviation) what was known of it before. `transform` is "positive", "bounded" or "free"; by default what must not be
    negative stays positive. `scale` is the typical size of a change of a free one (default: its own size, or 1 SI unit).
    """

    of: str | Length | Sequence[str] | Callable[[Mechanism, Any], Mechanism]
    name: str = ""
    start: float | None = None
    bounds: tuple[float, float] | None = None
    prior: tuple[float, float] | None = None
    transform: Transform | None = None
    scale: float | None = None
    share: Literal["value", "scale"] = "value"


def unknowns_of(mechanism: Mechanism, given: Sequence[Any] | str) -> Unknowns:
    """Read parameters: texts, lengths, functions and `Parameter`s. Raises `IdentificationError`, which lists every mistake."""
    items = [given] if isinstance(given, str | Length | Parameter) or callable(given) else list(given)
    problems: list[str] = []
    rows = [row for item in items for row in _rows(mechanism, item, problems)]
    if not items:
        problems.append("parameters: there is none to identify; name some, such as body.link1.mass")
    names = [row["name"] for row in rows]
    for name in dict.fromkeys(names):
        if names.count(name) > 1:
            problems.append(f"{quoted(name)}: is there {names.count(name)} times")
    problems.extend(_twice(rows))
    if problems:
        raise IdentificationError(problems)
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    arrays = {key: np.array(columns[key], float) for key in ("start", "low", "high", "scale", "mean", "sigma")}
    return Unknowns(
        tuple(columns["name"]),
        tuple(columns["units"]),
        tuple(columns["target"]),
        kinds=tuple(columns["kind"]),
        own=all(columns["own"]),
        **arrays,
    )


def _twice(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    owner: dict[str, str] = {}
    found = []
    for row in rows:
        for name in row["target"].names:
            if name in owner and owner[name] != row["name"]:
                found.append(f"{quoted(row['name'])}: {name} is a part of {quoted(owner[name])} already; tie them, or take one")
            owner[name] = row["name"]
    return found


def _rows(mechanism: Mechanism, item: Any, problems: list[str]) -> list[dict[str, Any]]:
    """What there is to know of a parameter; of an array, of each of its entries."""
    p = item if isinstance(item, Parameter) else Parameter(item)
    try:
        targets = _targets(mechanism, p)
    except (SceneError, ValueError) as problem:
        problems.append(str(problem) if not p.name else f"{quoted(p.name)}: {problem}")
        return []
    found = []
    for target, first, same in targets:
        name = p.name + (target.names[0][len(_whole(target.names[0])) :] if p.name and len(targets) > 1 else "")
        name = name or _name(target)
        try:
            found.append(_row(mechanism, p, name, target, first, same))
        except (TypeError, ValueError) as problem:
            problems.append(f"{quoted(name)}: {problem}")
    return found


def _whole(name: str) -> str:
    return re.sub(r"(\[\d+\])+$", "", name)


def _name(target: Target) -> str:
    if target.function is not None:
        return str(target.function) if isinstance(target.function, Length) else getattr(target.function, "__name__", "function")
    return f"scale({', '.join(target.names)})" if target.scaled else " = ".join(target.names)


def _row(mechanism: Mechanism, p: Parameter, name: str, target: Target, first: float | None, same: bool) -> dict[str, Any]:
    start = p.start if p.start is not None else first
    if start is None:
        raise ValueError("needs a first guess: Parameter(..., start=...)")
    start = float(start)
    if not np.isfinite(start):
        raise ValueError(f"the first guess must be a finite number, is {start}")
    kind = p.transform or ("bounded" if p.bounds is not None else "positive" if _positive(mechanism, target, start) else "free")
    if kind not in get_args(Transform):
        raise ValueError(f"transform must be one of {', '.join(get_args(Transform))}, is {kind!r}")
    low, high = p.bounds if p.bounds is not None else (np.nan, np.nan)
    if p.bounds is not None and not np.isfinite(p.bounds).all():
        raise ValueError(f'bounds must be two finite numbers, are ({low}, {high}); what has no upper one can be "positive"')
    if kind == "bounded" and not low < start < high:
        raise ValueError(f"the first guess {start:g} must be between the bounds ({low}, {high}): move the one or the others")
    if kind == "positive" and not start > 0:
        raise ValueError(f'the first guess {start:g} must be > 0; give another start, or transform="free"')
    mean, sigma = p.prior if p.prior is not None else (np.nan, np.nan)
    if p.prior is not None and not (np.isfinite(mean) and np.isfinite(sigma) and sigma > 0):
        raise ValueError("prior must be (mean, standard deviation), with a deviation > 0")
    scale = p.scale if p.scale is not None else abs(start) or 1.0
    if not scale > 0:
        raise ValueError(f"scale must be > 0, is {scale}")
    numbers = {"start": start, "low": low, "high": high, "scale": scale, "mean": mean, "sigma": sigma}
    own = same and start == first
    return {"name": name, "target": target, "kind": kind, "units": _units(mechanism, target), "own": own, **numbers}


def _units(mechanism: Mechanism, target: Target) -> str:
    if isinstance(target.function, Length):
        return "m"
    return "1" if target.scaled else units_of(mechanism, target.names[0]) if target.names else ""


def _positive(mechanism: Mechanism, target: Target, start: float) -> bool:
    """Whether a value must not become negative."""
    if target.function is not None:
        return isinstance(target.function, Length)
    return start > 0 and (target.scaled or all(_required_positive(mechanism, name) for name in target.names))


def _required_positive(mechanism: Mechanism, name: str) -> bool:
    known = parameters_of(mechanism)
    found = known[split(name, known)[0]]
    if not found.path:
        return False
    metadata = keys(type(holder_of(mechanism, found)))[found.path[-1]].metadata
    return any(rule in metadata.get("require", ()) for rule in POSITIVE["require"] + NOT_NEGATIVE["require"])


# --- what a parameter is of


def _targets(mechanism: Mechanism, p: Parameter) -> list[tuple[Target, float | None, bool]]:
    """The targets of a parameter, one of each entry where it is an array; what the scene has there, and whether everywhere."""
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
