"""Requirements on arguments of public functions, written at the parameter: `rtol: Annotated[NumberLike, NOT_NEGATIVE]`.

These checks are not applied to None: udkjax/scene/arguments.py refuses None unless the parameter allows it.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import isclass
from typing import Any, NamedTuple

import equinox as eqx

from udkjax.requirements import (
    ArgumentCheck,
    ArgumentError,
    ArgumentTypeError,
    GivenArguments,
    Sign,
    array,
    describe,
    require_count,
    require_finite,
    require_number,
    require_numbers_by_name,
    require_output_times,
    require_times,
)
from udkjax.wording import quote


class ArgumentRequirement(NamedTuple):
    """A requirement on an argument beyond its type, given as metadata of `Annotated`; `help` displays its `text`."""

    text: str
    check: ArgumentCheck

    def __repr__(self) -> str:
        return self.text


INSTANCE_CHECKS: dict[type, ArgumentCheck] = {}  # a check holds for subclasses, too


def checks_instances(cls: type) -> Callable[[ArgumentCheck], ArgumentCheck]:
    """Return a decorator that registers a function as the check of arguments that are instances of `cls` or of a subclass."""

    def register(check: ArgumentCheck) -> ArgumentCheck:
        INSTANCE_CHECKS[cls] = check
        return check

    return register


def require_thresholds(name: str, value: Any, given: GivenArguments) -> None:
    """Require that numbers in the fields of a dataclass, such as a method or gains, are finite.

    Those of the library's classes must also be single numbers, zero or positive. A user's subclass may add any arrays.
    """
    library = next(cls for cls in type(value).__mro__ if cls.__module__.startswith(f"{__package__}."))
    thresholds = {field.name for field in dataclasses.fields(library)}
    for field in dataclasses.fields(value):
        x = getattr(value, field.name)
        if not (eqx.is_array(x) or isinstance(x, float)):
            continue
        if field.name in thresholds:
            require_number(f"{name}.{field.name}", x, "not negative")
        else:
            require_finite(f"{name}.{field.name}", x)


def of_kind(condition: str, is_valid: Callable[[Any], bool]) -> ArgumentCheck:
    """Return a check that an argument satisfies `is_valid`; `condition` completes the message "NAME must ..."."""

    def check(name: str, value: Any, given: GivenArguments):
        if not is_valid(value):
            raise ArgumentTypeError(f"{name} must {condition}, {describe(value)}")

    return check


_require_mapping = of_kind(
    "map names to numbers, such as {name: number}",
    lambda x: isinstance(x, Mapping) and all(isinstance(name, str) for name in x),
)


def _require_arrays_by_name(name: str, value: Any, given: GivenArguments) -> None:
    _require_mapping(name, value, given)
    for key, numbers in value.items():
        require_finite(f"{name}[{key!r}]", numbers)


def _require_point(name: str, value: Any, given: GivenArguments) -> None:
    if array(name, value).shape != (2,):
        raise ArgumentError(f"{name} must be two numbers, x and y in m, {describe(value)}")
    require_finite(name, value)


def require_coordinates(name: str, value: Any, given: GivenArguments, flat: bool = True) -> None:
    """Require finite coordinates x, y, angle, or their rates, of each body of the mechanism: (bodies, 3), or also (n,) if `flat`.

    A system written by the user, whose number of coordinates is not known, requires a vector (n,).
    """
    names, coordinates = getattr(given["mechanism"], "body_names", ()), array(name, value)
    if not names:  # the number of coordinates of a user-written system is not known
        if coordinates.ndim != 1:
            raise ArgumentError(f"{name} must be a vector (n,), not an array of the shape {coordinates.shape}")
        require_finite(name, value)
        return
    shape = (len(names), 3)
    if coordinates.shape != shape and not (flat and coordinates.shape == (3 * len(names),)):
        order = f": x, y and angle of {', '.join(map(quote, names[:4]))}{', ...' if len(names) > 4 else ''}"
        cure = "; a batch of states is for jax.vmap" if coordinates.ndim > 2 and coordinates.shape[-2:] == shape else ""
        raise ArgumentError(f"{name} must have the shape {shape}{order}; it has the shape {coordinates.shape}{cure}")
    require_finite(name, coordinates, lambda *k: _place(names, k))


def _place(names: Sequence[str], index: tuple[int, ...]) -> str:
    body, coordinate = index if len(index) == 2 else divmod(index[0], 3)
    return f" ({('x', 'y', 'angle')[coordinate]} of {quote(names[body])})"


def require_history(name: str, value: Any, given: GivenArguments) -> None:
    """Require a solution, or any object with times ts (T,) and states q and v (T, bodies, 3) of the mechanism.

    For a system written by the user, q and v are (T, n).
    """
    names = getattr(given["mechanism"], "body_names", ())
    missing = [part for part in ("ts", "q", "v") if not hasattr(value, part)]
    if missing or isclass(value):
        raise ArgumentTypeError(f"{name} must have times and states, ts, q and v, as a Solution: {describe(value)}")
    bodies = getattr(value, "bodies", None)
    if names and isinstance(bodies, tuple) and bodies and bodies != names:
        listed = [", ".join(map(quote, x[:6])) + (", ..." if len(x) > 6 else "") for x in (bodies, names)]
        raise ArgumentError(f"{name} belongs to another mechanism: its bodies are {listed[0]}, not {listed[1]}")
    ts, q, v = (array(f"{name}.{part}", getattr(value, part)) for part in ("ts", "q", "v"))
    expected_shape = (*ts.shape, len(names), 3) if names else q.shape
    if q.ndim == 4:
        first_member, all_of_them = "jax.tree.map(lambda x: x[0], batch)", "jax.vmap(lambda one: function(mechanism, one))(batch)"
        raise ArgumentError(
            f"{name} is a batch of {len(q)} solutions: take one of them, {first_member}, or map over them, {all_of_them}"
        )
    if ts.ndim != 1 or q.shape[:1] != ts.shape or q.shape != expected_shape or v.shape != q.shape:
        expected = f"ts (T,), q and v (T, bodies, 3) of {len(names)} bodies" if names else "ts (T,), q and v (T, n)"
        raise ArgumentError(f"{name} must have {expected}; the shapes are {ts.shape}, {q.shape} and {v.shape}")


def several(count: int, sign: Sign = "any") -> ArgumentRequirement:
    """Return the requirement that an argument consists of `count` finite numbers of the given sign."""

    def check(name: str, value: Any, given: GivenArguments):
        if array(name, value).shape != (count,):
            raise ArgumentTypeError(f"{name} must be {count} numbers, {describe(value)}")
        for k, x in enumerate(value):
            require_number(f"{name}[{k}]", x, sign)

    return ArgumentRequirement(f"{count} {'' if sign == 'any' else sign + ' '}numbers", check)


NOT_NEGATIVE = ArgumentRequirement("zero or positive", partial(require_number, sign="not negative"))
POSITIVE = ArgumentRequirement("positive", partial(require_number, sign="positive"))
POSITIVE_OR_INFINITE = ArgumentRequirement("positive or infinite", partial(require_number, sign="positive", infinite=True))
COUNT = ArgumentRequirement("at least 1", require_count)
NOT_NEGATIVE_COUNT = ArgumentRequirement("at least 0", partial(require_count, least=0))
FINITE = ArgumentRequirement("finite", require_finite)
TIMES = ArgumentRequirement("a vector of finite times", require_times)
OUTPUT_TIMES = ArgumentRequirement("at least two increasing times", require_output_times)
POINT = ArgumentRequirement("x and y (m)", _require_point)
BY_NAME = ArgumentRequirement("by name", _require_mapping)
NUMBERS_BY_NAME = ArgumentRequirement("finite numbers by name", require_numbers_by_name)
ARRAYS_BY_NAME = ArgumentRequirement("finite arrays by name", _require_arrays_by_name)
COORDINATES_OF_BODIES = ArgumentRequirement("x, y and angle of each body, or their rates", require_coordinates)
HISTORY = ArgumentRequirement("times and states of the mechanism", require_history)
