"""Fields of the classes of a scene: converters, and requirements on values.

Each class of a scene is its own schema: its fields are the keys of the scene format, annotations state the shapes of numbers, and
the metadata below state all other requirements. Files and Python are checked by the same declarations (`checks.py`).
"""

import math
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Literal, NamedTuple, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import Numbers
from udkjax.arrays import array_namespace, is_traced, number, optional_number


def number_or_guess(value: Numbers | None) -> Float[Array, "..."]:
    """Convert a number as `number` does; None stays None until the mechanism fills in the value in the initial guess.

    The value is computed by `Constraint.complete`.
    """
    return None if value is None else number(value)  # pyright: ignore[reportReturnType]


def direction(value: Numbers | None) -> Float[Array, ""]:
    """Convert a direction in the plane, an angle (rad) or a vector (x, y), to an angle; None stays None."""
    if value is None:
        return None  # pyright: ignore[reportReturnType]
    array = number(value)
    if array.shape != (2,):
        return array
    xp = np if not isinstance(array, Tracer) else jnp
    x, y = xp.asarray(array)
    if not isinstance(array, Tracer) and not np.isfinite(x + y):
        return number(x + y)  # refused as an angle that is not finite
    return number(xp.arctan2(y, x))


def or_as_given(convert: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a converter for fields of elements that leaves values as they are if they cannot be converted.

    The mechanism then refuses the element, with the path of the value.
    """

    @wraps(convert)
    def converted(value: Any) -> Any:
        try:
            return convert(value)
        except (TypeError, ValueError, OverflowError):
            return value

    return converted


def vector_as_angle(value: Any) -> Any:
    """Return the angle (rad) of a vector of two numbers in a table; return anything else unchanged, to be refused later.

    Of a vector with numbers that are not finite, one of these is returned.
    """
    components = list(value) if isinstance(value, np.ndarray | jax.Array) and value.shape == (2,) else value
    numbers = int | float | np.number | jax.Array
    if not isinstance(components, list | tuple) or len(components) != 2 or not all(isinstance(x, numbers) for x in components):
        return value
    if any(isinstance(x, bool) or np.ndim(x) for x in components):
        return value
    if is_traced(components):
        return direction(components)
    try:
        x, y = map(float, components)
    except OverflowError:  # an integer beyond the range of floats
        return value
    if infinite := [c for c in (x, y) if not math.isfinite(c)]:
        return infinite[0]  # refused as an angle that is not finite
    return math.atan2(y, x) if x or y else value


def names(value: Sequence[str] | str) -> tuple[str, ...]:
    """Convert a name or a list of names to a tuple; raise a `TypeError` if an entry is not a string."""
    entries = (value,) if isinstance(value, str) else tuple(value)
    if not all(isinstance(name, str) for name in entries):
        raise TypeError("must be a name, or a list of names")
    return entries


given_number, given_or_none, given_or_guess = map(or_as_given, (number, optional_number, number_or_guess))
given_direction, given_names = or_as_given(direction), or_as_given(names)


@jax.tree_util.register_static
class StaticValue:
    """A static leaf: a value in a user's class that is neither an array nor a number, such as a function or a name.

    Calls, comparisons and attributes are passed on to the wrapped `value`.
    """

    def __init__(self, value: object):
        self.value = value

    def __call__(self, *arguments: object, **named: object) -> object:
        if not callable(self.value):
            raise TypeError(f"{self.value!r} is not callable")
        return self.value(*arguments, **named)

    def __getattr__(self, name: str) -> object:
        if name == "value":  # not yet set during a copy
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
    """A condition on each entry of a number: `holds` maps a NumPy or JAX array to a boolean array of the same shape.

    Numbers that violate a `strict` requirement are meaningless; if traced numbers violate it, the run ends with
    `Result.invalid_argument`. Other numbers, such as a negative damping, are valid: finite differences around zero need them.
    `shown_sum` returns the sum of all entries as text, if the requirement is one on their sum; None for one on each entry.
    """

    text: str
    holds: Callable[[Any], Any]
    strict: bool = True
    shown_sum: Callable[[float], str] | None = None


class FieldMetadata(TypedDict, total=False):
    """Conditions on the value of a field beyond its annotation."""

    require: tuple[Requirement, ...]
    at_least: int  # number of entries
    called: bool  # the field holds a function of time, used only by calling it
    names: Literal["body", "rubbing", "pin", "link", "slide", "slot"]  # kind of the names that the field holds


def _shown_angle(angle: float) -> str:
    return f"{math.degrees(angle):.12g} deg ({angle:.12g} rad)"


def _shown_length(length: float) -> str:
    return f"{length:.12g} m"


CLOSING_TOL = 1e-9  # relative to the sum of the sizes: numbers of a file have more digits

_POSITIVE = Requirement("must be > 0", lambda v: v > 0)
_NOT_NEGATIVE = Requirement("must be >= 0", lambda v: v >= 0, strict=False)
_INCREASING = Requirement("must be greater than the entry before", lambda v: array_namespace(v).diff(v, prepend=-np.inf) > 0)
_ONE_TURN = Requirement("must be less than a turn after the first (the profile closes by itself)", lambda v: v - v[0] < 2 * np.pi)
_WHOLE_TURN = Requirement(
    "the angles must add up to a whole turn",
    lambda v: abs(v.sum() - 2 * np.pi) * array_namespace(v).ones_like(v) <= CLOSING_TOL * 2 * np.pi,
    shown_sum=_shown_angle,
)
_LIFTS_RETURN, _SWINGS_RETURN = (
    Requirement(
        f"the {steps} must add up to zero",
        lambda v: abs(v.sum()) * array_namespace(v).ones_like(v) <= CLOSING_TOL * abs(v).sum(),
        shown_sum=shown_sum,
    )
    for steps, shown_sum in (("lifts", _shown_length), ("swings", _shown_angle))
)

POSITIVE: FieldMetadata = {"require": (_POSITIVE,)}
NOT_NEGATIVE: FieldMetadata = {"require": (_NOT_NEGATIVE,)}
KNOTS: FieldMetadata = {"require": (_INCREASING,), "at_least": 2}
PROFILE_ANGLES: FieldMetadata = {"require": (_INCREASING, _ONE_TURN), "at_least": 3}
LAW_ANGLES: FieldMetadata = {"require": (_POSITIVE, _WHOLE_TURN), "at_least": 1}
LIFTS: FieldMetadata = {"require": (_LIFTS_RETURN,), "at_least": 1}
SWINGS: FieldMetadata = {"require": (_SWINGS_RETURN,), "at_least": 1}
PROFILE_RADII: FieldMetadata = {"require": (_POSITIVE,), "at_least": 3}
CALLED: FieldMetadata = {"called": True}
NOT_EMPTY: FieldMetadata = {"at_least": 1}
BODY: FieldMetadata = {"names": "body"}  # the field names one or several bodies
RUBBING: FieldMetadata = {"names": "rubbing"}  # the field names a joint whose surfaces rub
PIN: FieldMetadata = {"names": "pin"}  # one or several pins of a drawing
LINK: FieldMetadata = {"names": "link"}  # one or several links of a drawing, bodies or the ground
SLIDE: FieldMetadata = {"names": "slide"}  # a slide of a drawing
SLOT: FieldMetadata = {"names": "slot"}  # a slot of a drawing
OUTLINE: FieldMetadata = {"at_least": 3}
