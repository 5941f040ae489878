"""The schema of the scene format, derived from the classes: types by name, and each element as a table of its keys.

A table is {key: value}, as in a TOML file, with nested tables for motion laws and profiles. Scenes are read, checked and written
in this form.
"""

import dataclasses
import re
import types
from collections.abc import Iterator, Mapping
from functools import cache
from types import MappingProxyType
from typing import Any, NamedTuple, Union, cast, get_args, get_origin

import equinox as eqx
import jax
import numpy as np

from udkjax.scene.elements import couplings, drivers, forces, friction, joints, rolling
from udkjax.scene.elements.bodies import Body
from udkjax.scene.elements.fields import FieldMetadata
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.profiles import AbstractProfile, LiftProfile, Profile, SwingProfile, profile_class

SECTIONS = ("body", "joint", "driver", "force")


def type_name(cls: type) -> str:
    """Return the name of a class as a `type` in a file: `TorsionSpring` is "torsion_spring"."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


def _by_type(module: types.ModuleType, base: type) -> dict[str, type]:
    """Return the public subclasses of `base` in a module, by their names in a file, in the order of the module."""
    return {
        type_name(cls): cls
        for name, cls in vars(module).items()
        if isinstance(cls, type) and issubclass(cls, base) and cls is not base
        if cls.__module__ == module.__name__ and not name.startswith("_")
    }


CLASSES_BY_TYPE: dict[str, dict[str, type]] = {
    "joint": _by_type(joints, joints.Joint) | _by_type(couplings, joints.Joint) | _by_type(rolling, rolling.RollingJoint),
    "force": _by_type(forces, forces.ForceElement) | _by_type(friction, forces.ForceElement),
    "motion": _by_type(drivers, drivers.Motion),
}
# Classes whose tables have no `type`.
CLASSES_WITHOUT_TYPE: dict[str, type] = {
    "body": Body,
    "driver": drivers.Driver,
    "profile": Profile,
    "lift_profile": LiftProfile,
    "swing_profile": SwingProfile,
    "held": Held,
}


def is_in_format(cls: type) -> bool:
    """Return True if the scene format has a type for the class."""
    return cls in CLASSES_WITHOUT_TYPE.values() or any(cls in known.values() for known in CLASSES_BY_TYPE.values())


class Key(NamedTuple):
    """One key of an element: a field of its class."""

    field: str  # the name of the key, followed by an underscore if it is a keyword of Python
    annotation: Any  # a type, without None; of a number that may be sampled, that of the plain number
    required: bool
    metadata: FieldMetadata
    sampled_class: type | None  # the class of the samples of a number; None if it cannot be sampled


@cache
def keys(cls: type) -> Mapping[str, Key]:
    """Return the keys of a class: the fields that its constructor accepts, in order."""
    keys_by_name = {}
    for field in dataclasses.fields(cls):
        if field.init:
            is_union = get_origin(field.type) in (Union, types.UnionType)
            kinds = [kind for kind in get_args(field.type) if kind not in (type(None), Held)] if is_union else [field.type]
            annotation, sampled_class = (
                kinds[0] if len(kinds) == 1 else field.type,
                Held if Held in get_args(field.type) else None,
            )
            default = field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING
            key, metadata = field.name.removesuffix("_"), cast(FieldMetadata, field.metadata)
            keys_by_name[key] = Key(field.name, annotation, not default, metadata, sampled_class)
    return MappingProxyType(keys_by_name)


def table_of(element: eqx.Module) -> dict[str, object]:
    """Return an element as a table, without keys whose value None means that they are absent; nested modules stay modules."""
    table = {name: getattr(element, key.field) for name, key in keys(type(element)).items()}
    may_be_absent = _optional_keys(type(element))
    return {name: value for name, value in table.items() if value is not None or name not in may_be_absent}


@cache
def _optional_keys(cls: type) -> frozenset[str]:
    """Return the keys whose value None means that they are absent."""
    defaults = {f.name.removesuffix("_"): f.default for f in dataclasses.fields(cls)}
    return frozenset(name for name in keys(cls) if defaults[name] is None or defaults[name] is dataclasses.MISSING)


def build(annotation: Any, value: object) -> Any:
    """Return the element, or nested module, of a class `annotation` from a checked table; return any other value unchanged."""
    if not isinstance(value, dict):
        return (
            str(value) if isinstance(value, np.str_) else value
        )  # NumPy's strings count as arrays, as when one is chosen at random
    annotation = profile_class(value) if annotation is AbstractProfile else annotation
    cls = CLASSES_BY_TYPE["motion"][value["type"]] if "type" in value else annotation
    expected = {name: (keys(cls)[name], item) for name, item in value.items() if name != "type"}
    return cls(**{key.field: build(key.sampled_class or key.annotation, item) for key, item in expected.values()})


def numbers_in(element: eqx.Module) -> Iterator[tuple[tuple[str, ...], jax.Array | None, tuple[int, ...] | None]]:
    """Iterate over paths, values and shapes of an element's numbers.

    The value of an absent number is None, and its shape is the annotation's, or None if the annotation does not determine it.
    """
    for name, key in keys(type(element)).items():
        value = getattr(element, key.field)
        if isinstance(value, eqx.Module):
            yield from (((name, *path), leaf, shape) for path, leaf, shape in numbers_in(value))
        elif eqx.is_array(value):
            yield (name,), value, value.shape
        elif value is None and hasattr(key.annotation, "dim_str"):
            dims = key.annotation.dim_str.split()
            yield (name,), None, tuple(map(int, dims)) if all(dim.isdigit() for dim in dims) else None
