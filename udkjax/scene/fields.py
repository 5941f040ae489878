"""How the classes of a scene declare their fields: converters at the door, and what a value must satisfy.

A class of this folder is its own schema: its fields are the keys of the scene format, the annotation of a number states its
shape, and the metadata below what else must hold. Files and Python are checked by the same declarations (`checks.py`).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

Numbers = ArrayLike | Sequence[Any]  # a number, an array, or nested lists of numbers


def number(value: Numbers) -> Float[Array, "..."]:
    """Make an array leaf of a number: a Python float as a field would be static, and each new value would compile anew."""
    dtype = jnp.result_type(float)
    if all(isinstance(x, float | int | np.number | np.ndarray) for x in jax.tree.leaves(value)):
        value = np.asarray(value, dtype)  # JAX would compile a program to convert it
        found = jnp.asarray(value)
        if not isinstance(found, Tracer):
            return found
        with jax.ensure_compile_time_eval():  # what is known stays known while something else is traced
            return jnp.asarray(value)
    return jnp.asarray(value, dtype=dtype)


def optional(value: Numbers | None) -> Float[Array, "..."] | None:
    """Like `number`; None stays None: an absent number, for which nothing is computed."""
    return None if value is None else number(value)


def names(value: Sequence[str] | str) -> tuple[str, ...]:
    """Make a hashable tuple of names."""
    return (value,) if isinstance(value, str) else tuple(value)


@jax.tree_util.register_static
class Choice:
    """What a field of a user's class holds that is neither an array nor a number: a function, a name. Static by itself.

    It is called, compared, looked up and asked for attributes as the `value` that it stands for.
    """

    def __init__(self, value: Any):
        self.value = value

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.value(*arguments, **named)

    def __getattr__(self, name: str) -> Any:
        if name == "value":  # not yet set, while it is copied
            raise AttributeError(name)
        return getattr(self.value, name)

    def __eq__(self, other: object) -> bool:
        other = other.value if isinstance(other, Choice) else other
        return self.value is other or bool(self.value == other)

    def __hash__(self) -> int:
        return hash(self.value)

    def __repr__(self) -> str:
        return repr(self.value)


class Requirement(NamedTuple):
    """What each entry of a number must satisfy: `holds` maps the array to a boolean array of the same shape."""

    text: str
    holds: Callable[[np.ndarray], np.ndarray]


_POSITIVE = Requirement("must be > 0", lambda v: v > 0)
_NOT_NEGATIVE = Requirement("must be >= 0", lambda v: v >= 0)
_INCREASING = Requirement("must be greater than the entry before", lambda v: np.diff(v, prepend=-np.inf) > 0)
_ONE_TURN = Requirement("must be less than a turn after the first (the profile closes by itself)", lambda v: v - v[0] < 2 * np.pi)

POSITIVE = {"require": (_POSITIVE,)}
NOT_NEGATIVE = {"require": (_NOT_NEGATIVE,)}
KNOTS = {"require": (_INCREASING,), "at_least": 2}
TURN = {"require": (_INCREASING, _ONE_TURN), "at_least": 3}
RADII = {"require": (_POSITIVE,), "at_least": 3}
SOME = {"at_least": 1}
BODY = {"names": "body"}  # the field names one or several bodies
REVOLUTE = {"names": "revolute"}  # the field names a revolute joint
