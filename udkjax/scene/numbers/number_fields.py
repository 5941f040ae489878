"""Names of all numbers of a mechanism: the path in a scene file, with the element's name instead of its index."""

import re
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import equinox as eqx
from jaxtyping import Array

from udkjax.annotations import Numbers
from udkjax.arrays import make_module, number
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.elements.fields import NOT_NEGATIVE, POSITIVE
from udkjax.scene.elements.held import Held, given_sampled
from udkjax.scene.numbers.named_numbers import NAMED_BY_OWNER
from udkjax.scene.tables.checks import SceneError
from udkjax.scene.tables.schema import keys, numbers_in
from udkjax.wording import abbreviate, quote, suggestion

SECTIONS = {"body": "bodies", "joint": "joints", "driver": "drivers", "force": "forces"}
ElementGroups = dict[str, dict[str, Any]]  # elements by section and name


class ElementsOfDrawing(Protocol):
    """Elements of a drawing, by section (pin, link, motor, ...) and name."""

    @property
    def groups(self) -> Mapping[str, Mapping[str, eqx.Module]]: ...
    def length_texts(self) -> Mapping[str, str]: ...


class Sections(Protocol):
    """The parts of a mechanism that hold numbers: its elements by section and name, and gravity."""

    name: str

    @property
    def gravity(self) -> Array: ...
    @property
    def groups(self) -> Mapping[str, Mapping[str, eqx.Module]]: ...
    @property
    def drawing(self) -> ElementsOfDrawing | None: ...
    @property
    def departs_from_drawing(self) -> bool: ...


class NumberField(NamedTuple):
    """The location of a number in a mechanism, its value and its shape."""

    section: str
    owner: str
    path: tuple[str, ...]  # fields; empty for gravity
    value: Array | None  # None: absent
    shape: tuple[int, ...] | None  # None: absent, any shape

    def holder(self, groups: Mapping[str, Mapping[str, Any]]) -> Any:
        """Return the element that contains the number, or the object within it that does, such as a `Held`."""
        return _at(groups[self.section][self.owner], self.path[:-1])


@cached_by_identity(within_trace=True)  # a loop over values of a number asks for all names each time
def parameters_of(scene: Sections) -> Mapping[str, NumberField]:
    """Return every number of a mechanism by name, including absent ones; numbers of its drawing come first."""
    drawn = {} if scene.drawing is None else parameters_of_drawing(scene.drawing)
    gravity = {"gravity": NumberField("", "", (), scene.gravity, scene.gravity.shape)}
    return MappingProxyType({**gravity, **drawn, **parameters_in(scene.groups)})


@cached_by_identity(within_trace=True)
def parameters_of_drawing(drawing: ElementsOfDrawing) -> Mapping[str, NumberField]:
    """Return every number of a drawing by name, including absent ones."""
    return MappingProxyType(parameters_in(drawing.groups))


def parameters_in(groups: Mapping[str, Mapping[str, eqx.Module]]) -> dict[str, NumberField]:
    """Return all numbers of elements by name; the position of a pin has the pin's name, `pin.A`, a named number `number.r`."""
    fields = {}
    for section, elements in groups.items():
        for owner, element in elements.items():
            for path, value, shape in numbers_in(element):
                name = (section, owner) if (section, path) in NAMED_BY_OWNER else (section, owner, *path)
                fields[".".join(name)] = NumberField(section, owner, path, value, shape)
    return fields


def owner_of(mechanism: Sections, parameter: NumberField) -> eqx.Module:
    """Return the object that holds a number: an element, or a module within it, such as a motion law or a profile."""
    drawing = None if parameter.section in SECTIONS else mechanism.drawing
    elements = (mechanism if drawing is None else drawing).groups[parameter.section]
    return _at(elements[parameter.owner], parameter.path[:-1])


def must_be_positive(mechanism: Any, name: str) -> bool:
    """Return True if a number, or the number of which `name` is an entry, must be positive, or must not be negative."""
    known = mechanism.number_fields()
    field = known[split_index(name, known)[0]]
    if not field.path:
        return False
    metadata = keys(type(owner_of(mechanism, field)))[field.path[-1]].metadata
    bounds = (*POSITIVE.get("require", ()), *NOT_NEGATIVE.get("require", ()))
    return any(rule in metadata.get("require", ()) for rule in bounds)


def require_values(values: object, name: str) -> None:
    """Raise a `SceneError` unless `values` maps names to numbers; `name` is the scene's."""
    if not isinstance(values, Mapping) or not all(isinstance(key, str) for key in values):
        raise SceneError([f"values must map names of parameters to numbers, not {abbreviate(values)}"], name)


def replace_numbers(
    groups: Mapping[str, Mapping[str, Any]],
    gravity: Array,
    values: Mapping[str, Any],
    known: Mapping[str, NumberField],
    name: str,
) -> tuple[ElementGroups, Array]:
    """Return elements by section and name, and gravity, with some values replaced.

    Args:
        groups: The elements.
        gravity: The acceleration of gravity (m/s^2).
        values: Numbers by their names, or by the names of their entries.
        known: All numbers of the mechanism, from `parameters_of`.
        name: Name of the scene, for the message of an error.

    Returns:
        The elements and gravity.

    Raises:
        SceneError: A name is unknown, or a value does not fit.
    """
    groups, problems, scene = {section: dict(elements) for section, elements in groups.items()}, [], name
    sampled = {held_name: _field_of_held(known[f"{held_name}.values"]) for held_name in held_names(known)}
    # Arrays are replaced before single entries. The order of `values` is ignored, because jit sorts the keys.
    for given in sorted(values, key=lambda name: name not in known and name.count("[")):
        name, index = split_index(given, known)
        if name in sampled or isinstance(values[given], Held):  # replaces a plain number by a sampled one, or the reverse
            field = sampled.get(name) or known.get(name)
            if field is not None and field.path:
                element = groups[field.section][field.owner]
                groups[field.section][field.owner] = _set(element, field.path, given_sampled(values[given]))
                continue
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
        raise SceneError(problems, scene)
    return groups, gravity


def held_names(known: Collection[str]) -> list[str]:
    """Return the names of sampled numbers of forces, such as "force.motor.value", from all known names of numbers."""
    return [name.removesuffix(".values") for name in known if name.endswith(".values") and name.startswith("force.")]


def _field_of_held(values: NumberField) -> NumberField:
    return values._replace(path=values.path[:-1], shape=None)


def _fit(
    given: str, value: Numbers, name: str, index: tuple[int, ...], shape: tuple[int, ...] | None, old: Array | None
) -> tuple[Array | None, str]:
    """Return the new value of a parameter and "", or None and a message about the value that does not fit."""
    try:
        new = None if value is None or isinstance(value, bool) else number(value)
    except (TypeError, ValueError, OverflowError):
        new = None
    if new is None:
        return None, f"{given}: must be a number or an array, not {abbreviate(value)}"
    if old is None and index:
        return None, f"{given}: {name} is absent; set it as a whole"
    if shape is not None and (len(index) > len(shape) or any(i >= n for i, n in zip(index, shape, strict=False))):
        return None, f"{given}: {name} has the shape {shape}"
    if shape is not None and new.shape != shape[len(index) :]:
        return None, f"{given}: must have the shape {shape[len(index) :]}, not {new.shape}"
    return (new if old is None or not index else old.at[index].set(new)), ""


def split_index(given: str, known: Collection[str]) -> tuple[str, tuple[int, ...]]:
    """Split the name of an entry, `joint.A.points[1][0]`, into the name of the parameter and the index; () for a parameter."""
    match = None if given in known else re.fullmatch(r"(.*?)((?:\[\d+\])+)", given)
    return (given, ()) if match is None else (match[1], tuple(int(i) for i in re.findall(r"\d+", match[2])))


def _at(element: eqx.Module, path: Sequence[str]) -> Any:
    for name in path:
        element = getattr(element, name)
    return element


def _set(element: eqx.Module, path: Sequence[str], value: Array) -> eqx.Module:
    name, *inner = path
    new = _set(getattr(element, name), inner, value) if inner else value
    return make_module(type(element), **vars(element) | {name: new})
