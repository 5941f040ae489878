"""Every number of a mechanism under one name: the path in a scene file, with the element's name in place of its index."""

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import equinox as eqx
from jaxtyping import Array

from udkjax.scene.checks import SceneError, abbreviate, quote, suggestion
from udkjax.scene.fields import Numbers, number
from udkjax.scene.schema import numbers_in

_SECTIONS = {"body": "bodies", "joint": "joints", "driver": "drivers", "force": "forces"}


class Sections(Protocol):
    """The parts of a mechanism that hold numbers: its elements by section and name, and gravity."""

    name: str
    gravity: Array

    @property
    def bodies(self) -> Mapping[str, eqx.Module]: ...
    @property
    def joints(self) -> Mapping[str, eqx.Module]: ...
    @property
    def drivers(self) -> Mapping[str, eqx.Module]: ...
    @property
    def forces(self) -> Mapping[str, eqx.Module]: ...


class NumberField(NamedTuple):
    """The place of a number in a mechanism, its value and its shape."""

    section: str
    owner: str
    path: tuple[str, ...]  # of fields; none: gravity
    value: Array | None  # None: absent
    shape: tuple[int, ...] | None  # None: absent, any shape


def parameters_of(mechanism: Sections) -> dict[str, NumberField]:
    """Return every number of a mechanism by name, absent ones too."""
    found = {"gravity": NumberField("", "", (), mechanism.gravity, mechanism.gravity.shape)}
    for section, plural in _SECTIONS.items():
        for owner, element in getattr(mechanism, plural).items():
            for path, value, shape in numbers_in(element):
                found[".".join((section, owner, *path))] = NumberField(section, owner, path, value, shape)
    return found


def owner_of(mechanism: Sections, parameter: NumberField) -> eqx.Module:
    """Return the element that holds a number, or the motion law or profile within the element."""
    element = getattr(mechanism, _SECTIONS[parameter.section])[parameter.owner]
    return _at(element, parameter.path[:-1])


def replace_numbers(mechanism: Sections, values: Mapping[str, Numbers]) -> tuple[dict[str, dict[str, Any]], Array]:
    """Return the elements of a mechanism by section and name, and gravity, with the values in; raise `SceneError`."""
    known, problems = parameters_of(mechanism), []
    groups, gravity = {section: dict(getattr(mechanism, plural)) for section, plural in _SECTIONS.items()}, mechanism.gravity
    # Whole arrays before their entries, whatever the order of the keys: jit sorts them.
    for given in sorted(values, key=lambda name: name not in known and name.count("[")):
        name, index = split_index(given, known)
        if name not in known:
            problems.append(f"no parameter {quote(given)}{suggestion(given, known)}")
            continue
        section, owner, path, _, shape = known[name]
        old = _at(groups[section][owner], path) if path else gravity
        new, problem = _fit(given, values[given], name, index, shape, old)
        if new is None:
            problems.append(problem)
        elif path:
            groups[section][owner] = _set(groups[section][owner], path, new)
        else:
            gravity = new
    if problems:
        raise SceneError(problems, mechanism.name)
    return groups, gravity


def _fit(
    given: str, value: Numbers, name: str, index: tuple[int, ...], shape: tuple[int, ...] | None, old: Array | None
) -> tuple[Array | None, str]:
    """Return the parameter's new value, or None and why the value does not fit."""
    try:
        new = None if isinstance(value, bool) else number(value)
    except (TypeError, ValueError):
        new = None
    if new is None:
        return None, f"{given}: must be a number or an array, is {abbreviate(value)}"
    if old is None and index:
        return None, f"{given}: {name} is absent; set it as a whole"
    if shape is not None and (len(index) > len(shape) or any(i >= n for i, n in zip(index, shape, strict=False))):
        return None, f"{given}: {name} has the shape {shape}"
    if shape is not None and new.shape != shape[len(index) :]:
        return None, f"{given}: must have the shape {shape[len(index) :]}, has {new.shape}"
    return (new if old is None or not index else old.at[index].set(new)), ""


def split_index(given: str, known: Collection[str]) -> tuple[str, tuple[int, ...]]:
    """Split `joint.A.points[1][0]` into the parameter and the index of one of its entries."""
    match = None if given in known else re.fullmatch(r"(.*?)((?:\[\d+\])+)", given)
    return (given, ()) if match is None else (match[1], tuple(int(i) for i in re.findall(r"\d+", match[2])))


def _at(element: eqx.Module, path: Sequence[str]) -> Any:
    for name in path:
        element = getattr(element, name)
    return element


def _set(element: eqx.Module, path: Sequence[str], value: Array) -> eqx.Module:
    return eqx.tree_at(lambda e: _at(e, path), element, value, is_leaf=lambda leaf: leaf is None)
