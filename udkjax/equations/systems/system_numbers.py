"""The numbers of a user-defined system by name: arrays that are leaves of its functions, and its initial guess.

A number has the name of its field in the equinox module whose methods the functions are, with a dot before each inner field. A
number that several functions share has one name. Where functions of different modules have fields of the same name, the name of
the first function that has it comes before it: `force.stiffness`.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

from udkjax.annotations import Numbers
from udkjax.arrays import number
from udkjax.scene.numbers.number_fields import NumberField, split_index
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion

GUESS_FIELDS = ("q0", "v0")  # fields of a system that are numbers themselves
OWNER_FIELDS = ("__self__", "kinetic", "force")  # fields through which the functions of a system refer to the user's modules


class NumberPlace(NamedTuple):
    """A leaf of a system: its index among all leaves, the function that has it, the owner's class, the name, and the leaf."""

    index: int
    function: str
    owner: str
    name: str
    leaf: Any


def number_fields(system: Any) -> dict[str, NumberField]:
    """Return a record of each number of a system, by name."""
    fields = {}
    for name, places in _places_by_name(system).items():
        value = places[0].leaf
        fields[name] = NumberField("", "", (), value, np.shape(value))
    return fields


def with_numbers(system: Any, values: Mapping[str, Numbers]) -> Any:
    """Return a system with other values of some numbers, in all functions that share them.

    Raises:
        SceneError: a name is unknown, or a value has another shape.
    """
    known, problems = _places_by_name(system), []
    leaves, tree = jax.tree.flatten(system)
    for given, value in values.items():
        name, index = split_index(given, known)
        if name not in known:
            problems.append(f"no parameter {quote(given)}{_advice(system, given, list(known))}")
            continue
        array = number(value)
        shape = np.shape(np.empty(np.shape(known[name][0].leaf))[index])
        if np.shape(array) != shape:
            problems.append(f"{quote(given)} must have the shape {shape}, not {np.shape(array)}")
            continue
        for place in known[name]:
            leaves[place.index] = number(leaves[place.index]).at[index].set(array) if index else array
    if problems:
        raise SceneError(problems)
    return jax.tree.unflatten(tree, leaves)


def _places_by_name(system: Any) -> dict[str, list[NumberPlace]]:
    shared: dict[str, list[list[NumberPlace]]] = {}  # by name, the leaves that are one number each
    for place in _places(system):
        groups = shared.setdefault(place.name, [])
        same = next((group for group in groups if _is_same(place, group[0])), None)
        if same is None:
            groups.append([place])
        else:
            same.append(place)
    return {
        name if len(groups) == 1 else f"{group[0].function}.{name}": group for name, groups in shared.items() for group in groups
    }


def _is_same(one: NumberPlace, other: NumberPlace) -> bool:
    """Return whether two leaves count as one number: owners of one class, equal shapes and, unless traced, equal values."""
    x, y = one.leaf, other.leaf
    if one.owner != other.owner or np.shape(x) != np.shape(y):
        return False
    return x is y or isinstance(x, Tracer) or isinstance(y, Tracer) or bool(np.array_equal(x, y))


def _places(system: Any) -> Iterator[NumberPlace]:
    for index, (path, leaf) in enumerate(jax.tree_util.tree_flatten_with_path(system)[0]):
        if not (isinstance(leaf, Tracer) or eqx.is_inexact_array(leaf)):
            continue
        function, *inner = path
        name = getattr(function, "name", "")
        if name in GUESS_FIELDS:
            yield NumberPlace(index, name, name, name, leaf)
        elif inner:
            owner = getattr(system, name)
            while inner and getattr(inner[0], "name", "") in OWNER_FIELDS and not _is_of_user(owner):
                owner = getattr(owner, inner.pop(0).name)
            yield NumberPlace(index, name, str(type(owner)), _name_of(inner), leaf)


def _is_of_user(owner: Any) -> bool:
    """Return whether an object is a module of the user, neither a bound method nor a function made from a kinetic energy."""
    return isinstance(owner, eqx.Module) and not hasattr(owner, "__self__") and not type(owner).__module__.startswith("udkjax.")


def _name_of(path: list[Any]) -> str:
    parts = [f".{x.name}" if hasattr(x, "name") else f"[{getattr(x, 'idx', None) or getattr(x, 'key', 0)}]" for x in path]
    return "".join(parts).removeprefix(".")


def _advice(system: Any, name: str, known: list[str]) -> str:
    """Return the end of the message about an unknown name, which tells a cure or the known names."""
    ends = [p[-1] for p, x in jax.tree_util.tree_flatten_with_path(system)[0] if isinstance(x, float) and p]
    if any(getattr(end, "name", None) == name for end in ends):
        return ": it is a Python number, and so a part of the program; make it an array, such as jnp.array(2.0)"
    if not known:
        return ": the functions have no arrays as leaves; make them methods of an equinox module whose fields are arrays"
    return suggestion(name, known) or f"; there are {', '.join(map(quote, known))}"
