"""Fields of the classes of a scene: converters, and the requirements that values must satisfy.

A class of this folder is its own schema: its fields are the keys of the scene format, the annotation of a number states its
shape, and the metadata below state what else must hold. Files and Python are checked by the same declarations (`checks.py`).
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeAlias, TypedDict, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from udkjax.annotations import Number as Number
from udkjax.annotations import Numbers as Numbers

# Of the largest of its kind: bound on a number that is zero in theory, as it is computed: some hundred units of rounding.
ROUNDING = 256 * float(np.finfo(float).eps)

Module = TypeVar("Module")
Table: TypeAlias = Mapping[str, object]  # {key: value} of one element, as in a scene file


def array_namespace(*numbers: ArrayLike | Sequence[ArrayLike]) -> ModuleType:
    """Return NumPy, or JAX's if one of the numbers is an array of JAX."""
    return jnp if any(isinstance(x, jax.Array) for x in jax.tree.leaves(numbers)) else np


def is_traced(tree: Any) -> bool:
    """Return whether any number in a tree is traced."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


def is_within_jit() -> bool:
    """Return whether a program is being traced, whose constants known numbers become."""
    return isinstance(jax.device_put(0.0), Tracer)


def library_for(tree: Any) -> ModuleType:
    """Return NumPy where nothing in a tree is traced: there each operation of JAX would be a program to compile; else JAX's."""
    return jnp if is_traced(tree) else np


def stored(x: Any) -> Any:
    """Return an array of NumPy as one of JAX, which takes no program; any other as it is."""
    return jax.device_put(x) if isinstance(x, np.ndarray | np.generic) else x


_put_together = jax.jit(lambda *arrays: arrays)
_WORTH_A_PROGRAM = 60  # calls: putting arrays one by one takes 0.3 ms longer than by a program, which takes 15 ms to compile
_calls: Counter[tuple[tuple[int, ...], ...]] = Counter()  # by shapes


def put_arrays(arrays: Any) -> Any:
    """Return a tree of arrays of NumPy, and numbers, as those of JAX."""
    leaves, tree = jax.tree.flatten(arrays)
    _calls[shapes := tuple(map(np.shape, leaves))] += 1
    if _calls[shapes] <= _WORTH_A_PROGRAM:
        return jax.device_put(arrays)
    return jax.tree.unflatten(tree, _put_together(*leaves))


def make_module(cls: type[Module], **fields: Any) -> Module:
    """Return an object of a class of data with all its fields, without what its constructor checks and converts."""
    made = object.__new__(cls)
    for name, value in fields.items():
        object.__setattr__(made, name, value)
    return made


def number(value: Numbers) -> Float[Array, "..."]:
    """Make an array leaf of a number: a Python float as a field would be static, and each new value would compile anew."""
    dtype = jnp.result_type(float)
    if all(isinstance(x, float | int | np.number | np.ndarray) for x in jax.tree.leaves(value)):
        value = np.asarray(value, dtype)
        found = jax.device_put(value)  # jnp.asarray would compile a program for each shape
        if not isinstance(found, Tracer):
            return found
        with jax.ensure_compile_time_eval():  # known numbers stay known while something else is traced
            return jax.device_put(value)
    return jnp.asarray(value, dtype=dtype)


def optional_number(value: Numbers | None) -> Float[Array, "..."] | None:
    """Like `number`; None stays None: an absent number, for which nothing is computed."""
    return None if value is None else number(value)


def number_or_guess(value: Numbers | None) -> Float[Array, "..."]:
    """Like `number`; None stands for the value in the initial guess, which the mechanism fills in (`Constraint.complete`)."""
    return None if value is None else number(value)  # pyright: ignore[reportReturnType]


def direction(value: Numbers | None) -> Float[Array, ""]:
    """Like `number`: a direction in the plane as an angle (rad), which may be given as a vector (x, y); None stays None."""
    if value is None:
        return None  # pyright: ignore[reportReturnType]
    found = number(value)
    if found.shape != (2,):
        return found
    xp = np if not isinstance(found, Tracer) else jnp
    x, y = xp.asarray(found)
    return number(xp.arctan2(y, x))


def or_as_given(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a converter for fields of a scene's elements: values that cannot be converted stay as they are.

    The mechanism that the element is put into refuses it, and names its place.
    """

    @wraps(convert)
    def converted(value: Any) -> Any:
        try:
            return convert(value)
        except (TypeError, ValueError, OverflowError):
            return value

    return converted


def number_called(name: str, optional: bool = False) -> Callable[[Any], Any]:
    """Return `number` as a converter of a field or an argument that errors call by its name; `optional`: None stays None."""

    def converted(value: Any) -> Any:
        if optional and value is None:
            return None
        try:
            return number(value)
        except (TypeError, ValueError, OverflowError):
            kind = "a text" if isinstance(value, str) else f"an object of type {type(value).__name__}"
            raise TypeError(f"{name} must be a number or an array of numbers, not {kind}") from None

    return converted


def vector_as_angle(value: Any) -> Any:
    """Return the angle (rad) of a vector of two numbers in a table; anything else as it is, for others to refuse."""
    parts = list(value) if isinstance(value, np.ndarray | jax.Array) and value.shape == (2,) else value
    numbers = int | float | np.number | jax.Array
    if not isinstance(parts, list | tuple) or len(parts) != 2 or not all(isinstance(x, numbers) for x in parts):
        return value
    if any(isinstance(x, bool) or np.ndim(x) for x in parts):
        return value
    if is_traced(parts):
        return direction(parts)
    return math.atan2(parts[1], parts[0]) if any(parts) else value


def names(value: Sequence[str] | str) -> tuple[str, ...]:
    """Make a hashable tuple of names; raise TypeError where something is no name."""
    found = (value,) if isinstance(value, str) else tuple(value)
    if not all(isinstance(name, str) for name in found):
        raise TypeError("must be a name, or a list of names")
    return found


given_number, given_or_none, given_or_guess = map(or_as_given, (number, optional_number, number_or_guess))
given_direction, given_names = or_as_given(direction), or_as_given(names)


@jax.tree_util.register_static
class StaticValue:
    """The value of a field of a user's class that is neither an array nor a number, such as a function or a name: a static leaf.

    Calls, comparisons and attributes are those of the `value` that it wraps.
    """

    def __init__(self, value: object):
        self.value = value

    def __call__(self, *arguments: object, **named: object) -> object:
        if not callable(self.value):
            raise TypeError(f"{self.value!r} is not callable")
        return self.value(*arguments, **named)

    def __getattr__(self, name: str) -> object:
        if name == "value":  # not yet set, while it is copied
            raise AttributeError(name)
        return getattr(self.value, name)

    def __eq__(self, other: object) -> bool:
        other = other.value if isinstance(other, StaticValue) else other
        return self.value is other or bool(self.value == other)

    def __hash__(self) -> int:
        return hash(self.value)

    def __repr__(self) -> str:
        return repr(self.value)


class Requirement(NamedTuple):
    """A condition on each entry of a number: `holds` maps the array, of NumPy or of JAX, to a boolean array of the same shape.

    Where it is `strict`, numbers that break it mean nothing, and a run whose traced numbers do ends by `Result.invalid_argument`.
    Where it is not, as of a damping below zero, they still have a meaning, and differences around zero need them.
    """

    text: str
    holds: Callable[[Any], Any]
    strict: bool = True


class FieldMetadata(TypedDict, total=False):
    """Conditions on the value of a field beyond its annotation."""

    require: tuple[Requirement, ...]
    at_least: int  # entries
    called: bool  # the field holds a function of time, of which the element takes nothing but its values
    names: Literal["body", "revolute", "pin", "link", "slide"]  # the field holds names: of bodies, of revolute joints, ...


_POSITIVE = Requirement("must be > 0", lambda v: v > 0)
_NOT_NEGATIVE = Requirement("must be >= 0", lambda v: v >= 0, strict=False)
_INCREASING = Requirement("must be greater than the entry before", lambda v: array_namespace(v).diff(v, prepend=-np.inf) > 0)
_ONE_TURN = Requirement("must be less than a turn after the first (the profile closes by itself)", lambda v: v - v[0] < 2 * np.pi)

POSITIVE: FieldMetadata = {"require": (_POSITIVE,)}
NOT_NEGATIVE: FieldMetadata = {"require": (_NOT_NEGATIVE,)}
KNOTS: FieldMetadata = {"require": (_INCREASING,), "at_least": 2}
PROFILE_ANGLES: FieldMetadata = {"require": (_INCREASING, _ONE_TURN), "at_least": 3}
PROFILE_RADII: FieldMetadata = {"require": (_POSITIVE,), "at_least": 3}
CALLED: FieldMetadata = {"called": True}
NOT_EMPTY: FieldMetadata = {"at_least": 1}
BODY: FieldMetadata = {"names": "body"}  # the field names one or several bodies
REVOLUTE: FieldMetadata = {"names": "revolute"}  # the field names a revolute joint
PIN: FieldMetadata = {"names": "pin"}  # of a drawing: one or several
LINK: FieldMetadata = {"names": "link"}  # of a drawing, or the ground, or a body: one or several
SLIDE: FieldMetadata = {"names": "slide"}  # of a drawing
OUTLINE: FieldMetadata = {"at_least": 3}
