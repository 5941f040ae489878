"""Name and check the elements given to a mechanism, and complete the numbers that follow from the initial guess."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cache
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import numpy as np

from udkjax.annotations import Numbers
from udkjax.arrays import is_traced, make_module, number
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Body, Frame
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.fields import Requirement, StaticValue, given_number
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import AnyConstraint, Constraint, Joint
from udkjax.scene.tables.checks import SceneEntry, SceneError, check_table, name_mistake, problems_of
from udkjax.scene.tables.schema import table_of, type_name
from udkjax.wording import abbreviate

AnyModule = TypeVar("AnyModule", bound=eqx.Module)
Groups: TypeAlias = Mapping[str, Mapping[str, Any]]  # elements by section and name


def name_elements(elements: Sequence[eqx.Module | str], names: Sequence[str | None] = ()) -> list[str]:
    """Return names for elements (or the names of their types): unnamed ones are numbered by type, TYPE1, TYPE2, ..."""
    numbered, counts = [], {}
    for i, element in enumerate(elements):
        kind = element if isinstance(element, str) else type_name(type(element))
        counts[kind] = counts.get(kind, 0) + 1
        numbered.append((names[i] if names else None) or f"{kind}{counts[kind]}")
    return numbered


def attached_bodies(element: Constraint | ForceElement, joints: Mapping[str, Joint]) -> tuple[str, ...]:
    """Return the names of the bodies whose frames an element needs, in order; `joints` are the joints of its mechanism."""
    if isinstance(element, Friction):
        return joints[element.joint].frame_names
    return element.frame_names if isinstance(element, Constraint) else element.bodies


def check_elements(given: Mapping[str, list], gravity: Numbers, name: str) -> dict[str, list[tuple[str, Any]]]:
    """Return all elements with plain numbers converted to arrays; raise a `SceneError` that lists all mistakes."""
    kinds = {"body": Body, "joint": Joint, "driver": Driver, "force": ForceElement}
    problems, entries, checked = [], [], {section: [] for section in given}
    for section, items in given.items():
        for index, (key, element) in enumerate(items):
            if not isinstance(element, kinds[section]):
                entry = SceneEntry(section, index, key, None, {})
                problem = f"{entry.where}: must be of class {kinds[section].__name__}, not a {type(element).__name__}"
                entries.append(entry._replace(problem=problem))
                continue
            element = jax.tree.map(_as_number, element)
            entries.append(entry := SceneEntry(section, index, key, type(element), table_of(element)))
            element = jax.tree.map(_as_static, element)
            problems.extend(f"{entry.where}{problem}" for problem in _check_hashable(element))
            if section == "force" and not _has_load(type(element)):
                problems.append(f"{entry.where}: {type(element).__name__} must have a method `potential` or `loads`")
            checked[section].append((key, element))
    problems.extend(problems_of(entries, gravity))
    if problems:
        raise SceneError(problems, name)
    return checked


def replaced(before: Groups, after: Groups) -> Groups | None:
    """Return the elements `after`, with missing numbers filled in, if they are valid given that those `before` are.

    Only elements that differ are checked. None means that all elements have to be checked, which finds all mistakes in order.
    """
    if any(before[section].keys() != after[section].keys() for section in ("body", "joint")):
        return None  # names of bodies and joints, to which others refer
    if any(constants_of(type(c)) for section in ("joint", "driver") for c in after[section].values()):
        return None  # they follow from bodies that may differ
    classes = {section: {name: type(x) for name, x in after[section].items()} for section in ("body", "joint")}
    known = {"body": {GROUND: None, **classes["body"]}, "rubbing": classes["joint"]}
    found = {section: dict(elements) for section, elements in after.items()}
    for section, elements in after.items():
        for name, element in elements.items():
            old = before[section].get(name)
            if element is old:
                continue
            if old is None or jax.tree.structure(element) != jax.tree.structure(old):
                if section != "driver" or name_mistake(name) or name in after["joint"] or not _is_plain_driver(element):
                    return None
                found[section][name] = element = complete(element, after["body"])
            if any(check_table(section, type(element), table_of(element), known)):
                return None
    return found


def _is_plain_driver(element: object) -> bool:
    """Return True if all leaves of a driver are arrays."""
    return type(element) is Driver and all(map(eqx.is_array, jax.tree.leaves(element))) and not any(_check_hashable(element))


def _check_hashable(element: eqx.Module) -> Iterator[str]:
    """Iterate over the mistakes in the static fields of a user-written element."""
    try:
        hash(jax.tree.structure(element))
    except TypeError as error:
        yield f": static fields must be hashable ({error}): write a tuple in place of a list"


def _has_load(cls: type) -> bool:
    return cls.potential is not ForceElement.potential or cls.loads is not ForceElement.loads


def as_leaves(element: AnyModule) -> AnyModule:
    """Return an element whose plain numbers, which would be static, are arrays, and whose other leaves are static."""
    return jax.tree.map(lambda leaf: _as_static(_as_number(leaf)), element)


def _as_number(leaf: object) -> object:
    """Return a leaf as an array if it is a plain number, which would be static, as in a user-written element."""
    return given_number(leaf) if isinstance(leaf, int | float | np.ndarray | np.number) and not isinstance(leaf, bool) else leaf


def _as_static(leaf: object) -> object:
    """Return a leaf that is not a number wrapped as a `StaticValue`; return arrays and shapes unchanged."""
    return leaf if eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct) else StaticValue(leaf)


def complete(constraint: AnyConstraint, bodies: Mapping[str, Body]) -> AnyConstraint:
    """Return a constraint with its missing numbers taken from the initial guess of the bodies."""
    method = type(constraint).complete
    number_name = getattr(method, "fills", None)
    if method is Constraint.complete or (number_name and getattr(constraint, number_name) is not None):
        return constraint  # the usual case; the sines and cosines of the bodies are not needed
    places = {name: (bodies[name].position, bodies[name].angle) for name in constraint.frame_names if name != GROUND}
    is_concrete, same = not is_traced((constraint, places)), dict[int, Any]()
    if is_concrete:  # NumPy compiles nothing
        given = constraint
        constraint, places = jax.tree.map(np.asarray, (constraint, places))
        same = {id(x): leaf for x, leaf in zip(jax.tree.leaves(constraint), jax.tree.leaves(given), strict=True)}
    frames = [Frame.at(*places[name]) if name in places else GROUND_FRAME for name in constraint.frame_names]
    eager = jax.ensure_compile_time_eval() if is_concrete else nullcontext()  # concrete even while something else is traced
    with eager, np.errstate(all="ignore"):
        completed = constraint.complete(*frames)
        return jax.tree.map(lambda x: same[id(x)] if id(x) in same else number(x), completed) if is_concrete else completed


@cache
def constants_of(cls: type) -> tuple[str, ...]:
    """Return the names of the numbers of a class of constraints that always follow from the initial guess.

    They are no arguments of the constructor, such as the constant of a gear.
    """
    if cls.complete is Constraint.complete:
        return ()
    names = ((f.name, f.default if f.default_factory is dataclasses.MISSING else f.default_factory()) for f in _made(cls))
    return tuple(name for name, default in names if default is None)


def _made(cls: type) -> Iterator[dataclasses.Field]:
    """Iterate over the fields of a class that are leaves, but not arguments of its constructor."""
    yield from (field for field in dataclasses.fields(cls) if not field.init and not field.metadata.get("static"))


def without_constants(constraint: AnyConstraint) -> AnyConstraint:
    """Return a constraint without the numbers that always follow from the initial guess."""
    names = constants_of(type(constraint))
    return make_module(type(constraint), **vars(constraint) | dict.fromkeys(names)) if names else constraint


def with_constants(constraint: AnyConstraint, bodies: Mapping[str, Body]) -> AnyConstraint:
    """Return a constraint with the numbers that always follow from the initial guess; all others stay the same objects."""
    names = constants_of(type(constraint))
    if not names:
        return constraint
    completed = complete(constraint, bodies)
    return make_module(type(constraint), **vars(constraint) | {name: getattr(completed, name) for name in names})


def completion_mistakes(before: Mapping[str, list[tuple[str, Any]]], after: Mapping[str, list[tuple[str, Any]]]) -> list[str]:
    """Return the mistakes in concrete numbers that constraints took from the initial guess."""
    mistakes = []
    for section, elements in after.items():
        for k, ((name, completed), (_, given)) in enumerate(zip(elements, before[section], strict=True)):
            if completed is not given and not is_traced(completed):
                mistakes.extend(_mistakes_of_guess(f"{section} {abbreviate(name)} ({section}[{k}])", given, completed))
    return mistakes


def _mistakes_of_guess(where: str, before: eqx.Module, after: eqx.Module) -> Iterator[str]:
    """Iterate over the mistakes in the numbers that an element took from the initial guess."""
    for field in dataclasses.fields(after):
        value = getattr(after, field.name)
        if getattr(before, field.name, None) is not None or not isinstance(value, np.ndarray | jax.Array):
            continue
        value = np.asarray(value, float)
        conditions = [Requirement("must be finite", np.isfinite), *field.metadata.get("require", ())]
        unmet = next((c.text for c in conditions if not np.all(c.holds(value))), None)
        if unmet:
            other_numbers = (
                f.name for f in dataclasses.fields(before) if isinstance(getattr(before, f.name), np.ndarray | jax.Array)
            )
            cure = " or ".join(["other positions of the bodies", *(f"other {name}" for name in other_numbers)])
            mistake = f"{where}.{field.name}: {unmet}, and is {abbreviate(value)} in the initial guess, from which it is taken"
            yield f"{mistake}: give it, or {cure}"
