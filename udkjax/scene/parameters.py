"""Every number of a mechanism under one name: the path in a scene file, with the element's name in place of its index."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array

from udkjax.scene.checks import SceneError, quoted, shown, suggestion
from udkjax.scene.fields import number
from udkjax.scene.schema import numbers_in

_SECTIONS = {"body": "bodies", "joint": "joints", "driver": "drivers", "force": "forces"}


class Parameter(NamedTuple):
    """Where a number is, and what it is."""

    section: str
    owner: str
    path: tuple[str, ...]  # of fields; none: gravity
    value: Array | None  # None: absent
    shape: tuple[int, ...] | None  # None: absent, any shape


def parameters_of(mechanism: Any) -> dict[str, Parameter]:
    """Return every number of a mechanism by name, absent ones too."""
    found = {"gravity": Parameter("", "", (), mechanism.gravity, mechanism.gravity.shape)}
    for section, plural in _SECTIONS.items():
        for owner, element in getattr(mechanism, plural).items():
            for path, value, shape in numbers_in(element):
                found[".".join((section, owner, *path))] = Parameter(section, owner, path, value, shape)
    return found


def holder_of(mechanism: Any, parameter: Parameter) -> Any:
    """The element, or the motion law or profile in it, whose field the parameter is."""
    element = getattr(mechanism, _SECTIONS[parameter.section])[parameter.owner]
    return _at(element, parameter.path[:-1])


def replaced(mechanism: Any, values: Mapping[str, Any]) -> tuple[dict[str, dict[str, Any]], Any]:
    """Return the elements of a mechanism by section and name, and gravity, with the values in; raise `SceneError`."""
    known, problems = parameters_of(mechanism), []
    groups, gravity = {section: dict(getattr(mechanism, plural)) for section, plural in _SECTIONS.items()}, mechanism.gravity
    # Whole arrays before their entries, whatever the order of the keys: jit sorts them.
    for given in sorted(values, key=lambda name: name not in known and name.count("[")):
        name, index = split(given, known)
        if name not in known:
            problems.append(f"no parameter {quoted(given)}{suggestion(given, known)}")
            continue
        section, owner, path, _, shape = known[name]
        old = _at(groups[section][owner], path) if path else gravity
        new, problem = _fitting(given, values[given], name, index, shape, old)
        if new is None:
            problems.append(problem)
        elif path:
            groups[section][owner] = _set(groups[section][owner], path, new)
        else:
            gravity = new
    if problems:
        raise SceneError(problems, mechanism.name)
    return groups, gravity


def _fitting(given: str, value: Any, name: str, index: tuple[int, ...], shape: tuple[int, ...] | None, old: Array | None):
    """Return the parameter's new value, or None and why the value does not fit."""
    try:
        new = None if isinstance(value, bool) else number(value)
    except (TypeError, ValueError):
        new = None
    if new is None:
        return None, f"{given}: must be a number or an array, is {shown(value)}"
    if old is None and index:
        return None, f"{given}: {name} is absent; set it as a whole"
    if shape is not None and (len(index) > len(shape) or any(i >= n for i, n in zip(index, shape, strict=False))):
        return None, f"{given}: {name} has the shape {shape}"
    if shape is not None and new.shape != shape[len(index) :]:
        return None, f"{given}: must have the shape {shape[len(index) :]}, has {new.shape}"
    return (new if old is None or not index else old.at[index].set(new)), ""


def split(given: str, known: Mapping[str, Any]) -> tuple[str, tuple[int, ...]]:
    """Split `joint.A.points[1][0]` into the parameter and the index of one of its entries."""
    match = None if given in known else re.fullmatch(r"(.*?)((?:\[\d+\])+)", given)
    return (given, ()) if match is None else (match[1], tuple(int(i) for i in re.findall(r"\d+", match[2])))


def _at(element: Any, path: Sequence[str]) -> Any:
    for name in path:
        element = getattr(element, name)
    return element


def _set(element: Any, path: Sequence[str], value: Array) -> Any:
    return eqx.tree_at(lambda e: _at(e, path), element, value, is_leaf=lambda leaf: leaf is None)
