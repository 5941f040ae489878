"""Requirements on arguments (real, finite, shape, sign), with errors that state the argument and its value."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import wraps
from inspect import isclass, signature
from types import MappingProxyType
from typing import Any, Literal, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from udkjax.arrays import is_traced, is_within_jit, without_derivatives
from udkjax.wording import abbreviate, article

GivenArguments = Mapping[str, Any]  # all arguments of a call by name, including defaults
ArgumentCheck = Callable[..., None]  # (name, value, given): an argument, and all arguments of the call
Sign = Literal["any", "positive", "not negative"]
NO_ARGUMENTS: GivenArguments = MappingProxyType({})
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class ArgumentError(ValueError):
    """An argument of a public function has an invalid value; the message states its name, its value and the requirement."""


class ArgumentTypeError(ArgumentError, TypeError):
    """An argument of a public function has the wrong type."""


def describe(value: Any) -> str:
    """Describe an invalid value for the end of a message: 'not the class SVD', 'not "SVD"'."""
    if isclass(value):
        return f"not the class {value.__name__}"
    if isinstance(value, str):
        return f"not {abbreviate(value)}"
    if value is None or isinstance(value, bool | int | float):
        return f"not {value}"
    kind = type(value).__name__
    shape = f" of the shape {np.shape(value)}" if isinstance(value, np.ndarray | jax.Array) else ""
    return f"not {article(kind)} {kind}{shape}"


def array(name: str, value: Any) -> "np.ndarray | Tracer":
    """Return an argument as an array of real numbers without derivatives: of NumPy, or a tracer if numbers are traced.

    Raises:
        ArgumentTypeError: the argument is anything else; the message gives its name.
    """
    if isinstance(value, Tracer):
        numbers: Any = without_derivatives(value)
        numbers = numbers if isinstance(numbers, Tracer) else np.asarray(numbers)  # a Python number under grad
    elif not isinstance(value, np.ndarray | float) and is_traced(value):
        numbers = without_derivatives(jnp.asarray(value))  # a list of traced numbers
    else:
        try:
            numbers = np.asarray(value)
        except ValueError:
            raise ArgumentTypeError(f"{name} must be an array of numbers; its rows have different lengths") from None
        except TypeError:
            raise ArgumentTypeError(f"{name} must be an array of numbers, {describe(value)}") from None
    if numbers.dtype.kind in "fiu":
        return numbers
    if not (jnp.issubdtype(numbers.dtype, jnp.floating) or jnp.issubdtype(numbers.dtype, jnp.integer)):  # bfloat16 and the like
        kind = "complex numbers" if jnp.issubdtype(numbers.dtype, jnp.complexfloating) else None
        raise ArgumentTypeError(f"{name} must be real numbers, {f'not {kind}' if kind else describe(value)}")
    return numbers


def require_number(
    name: str, value: Any, sign: Sign = "any", infinite: bool = False, given: GivenArguments = NO_ARGUMENTS
) -> None:
    """Require one real number of a sign; it must be finite unless `infinite`.

    Of a traced number, only shape and dtype are checked.
    """
    number = array(name, value)
    if number.shape != ():
        cure = "a batch is for jax.vmap, or for udk.sweep"
        raise ArgumentError(f"{name} must be one number, not an array of the shape {number.shape}; {cure}")
    if isinstance(number, Tracer):
        return
    x = float(number)
    is_invalid = np.isnan(x) or (np.isinf(x) and not infinite)
    if is_invalid or (sign == "positive" and not x > 0) or (sign == "not negative" and not x >= 0):
        condition = {"any": "a finite number", "positive": "positive", "not negative": "zero or positive"}[sign]
        raise ArgumentError(f"{name} must be {condition}{' and finite' if sign != 'any' and not infinite else ''}, not {x:g}")


def require_numbers(name: str, value: Any, shape: tuple[int, ...], meaning: str) -> None:
    """Require real numbers of a shape, which may be infinite or NaN; `meaning` describes them in messages."""
    if array(name, value).shape != shape:
        raise ArgumentTypeError(f"{name} must be {meaning}, {describe(value)}")


def require_text(name: str, value: Any, may_be_empty: bool = False) -> None:
    """Require a string; an empty string is allowed only if `may_be_empty`."""
    if not isinstance(value, str):
        raise ArgumentTypeError(f"{name} must be a string, {describe(value)}")
    if not value and not may_be_empty:
        raise ArgumentError(f"{name} must not be empty")


def are_names(value: Any) -> bool:
    """Return True for a list, or any other sequence, of strings; False for a single string."""
    return isinstance(value, Sequence) and not isinstance(value, str) and all(isinstance(name, str) for name in value)


def require_names(name: str, value: Any, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require a list of names."""
    if not are_names(value):
        raise ArgumentTypeError(f"{name} must be a list of names, {describe(value)}")


def require_numbers_by_name(name: str, value: Any, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require a mapping of names to finite numbers."""
    if not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
        raise ArgumentTypeError(f"{name} must map names to numbers, such as {{name: number}}, {describe(value)}")
    for key, number in value.items():
        require_number(f"{name}[{key!r}]", number)


def require_name_or_names(name: str, value: Any, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require a name, or a list of names."""
    if not (isinstance(value, str) or are_names(value)):
        raise ArgumentTypeError(f"{name} must be a name, or a list of names, {describe(value)}")


def require_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """Require a string that is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise ArgumentError(f"{name} must be one of {', '.join(choices)}, {describe(value)}")


def require_function(name: str, value: Any, arguments: str) -> None:
    """Require a function or another callable object, but not a class.

    Args:
        name: the name of the argument, for messages.
        value: the argument.
        arguments: the arguments that the function is called with, such as "(t, q)", or a phrase for a single one.
    """
    if not callable(value) or isclass(value):
        raise ArgumentTypeError(f"{name} must be a function {arguments}, {describe(value)}")
    try:
        own = signature(value)
    except (TypeError, ValueError):  # of some functions written in C
        return
    try:
        own.bind(*arguments.split(","))
    except TypeError:
        raise ArgumentTypeError(f"{name} must be a function {arguments}, not of {own}") from None


@contextmanager
def tracing(where: str) -> Iterator[None]:
    """Note the name and the cure on JAX's error about a traced number, if the user's function `where` raises one within."""
    try:
        yield
    except (jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
        cure = "write it with jax.numpy instead of NumPy, math, int() and float(), and with jax.numpy.where instead of `if`"
        error.add_note(f"{where} is traced by JAX: {cure}")
        raise


def require_count(name: str, value: Any, least: float = 1, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require an integer, at least `least`; of a traced number, only shape and dtype are checked."""
    number = None if isinstance(value, bool | np.bool_) else array(name, value)
    if number is None or number.shape != () or not jnp.issubdtype(number.dtype, jnp.integer):
        raise ArgumentTypeError(f"{name} must be a whole number, {describe(value)}")
    if not isinstance(number, Tracer) and int(number) < least:
        raise ArgumentError(f"{name} must be at least {least:g}, not {int(number)}")


def require_finite(
    name: str, value: Any, place: Callable[..., str] = lambda *index: "", given: GivenArguments = NO_ARGUMENTS
) -> None:
    """Require that numbers are finite; traced numbers are not checked.

    `place` returns a description of the entry with given indices, which follows the entry's value in the message.
    """
    numbers = array(name, value)
    if isinstance(numbers, Tracer) or (finite := np.isfinite(numbers)).all():
        return
    index = tuple(int(k) for k in np.argwhere(~finite)[0])
    where = f"[{', '.join(map(str, index))}]" if index else ""
    raise ArgumentError(f"{name}{where} is {numbers[index]:g}{place(*index)}: it must be finite")


def require_times(name: str, value: Any, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require a vector of finite times; of a traced vector, only the shape is checked."""
    times = array(name, value)
    if times.ndim != 1 or not len(times):
        raise ArgumentError(f"{name} must be a vector of times in s; its shape is {times.shape}")
    require_finite(name, times)


def require_output_times(name: str, value: Any, given: GivenArguments = NO_ARGUMENTS) -> None:
    """Require at least two finite, increasing times; of traced times, only the shape is checked."""
    times = array(name, value)
    if times.ndim != 1 or len(times) < 2:
        expected = "a vector of at least two output times, beginning with the start"
        raise ArgumentError(f"{name} must be {expected}; its shape is {times.shape}")
    require_finite(name, times)
    if not isinstance(times, Tracer) and not np.all(steps := np.diff(times) > 0):
        k = int(np.argmin(steps))
        pair = f"{name}[{k + 1}] = {times[k + 1]:g} s follows {times[k]:g} s"
        raise ArgumentError(f"{name} must increase from each output time to the next: {pair}")


def concrete_only(instead: str = "") -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Return a decorator of functions that compute with NumPy; an argument with a traced number raises `ArgumentTypeError`.

    While another function is traced, a decorated function still computes concrete results from concrete numbers.

    Args:
        instead: names of the functions to use under jit and vmap, for the message; "" if there are none.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        parameters = signature(function)
        called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]  # of a method, or a class
        cure = f"under jit and vmap use {instead}" if instead else "call it outside of jit, vmap and grad"

        @wraps(function)
        def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            for name, value in parameters.bind(*args, **kwargs).arguments.items():
                if _has_traced_numbers(value):
                    subject = f"the {type(value).__name__}" if name == "self" else name
                    problem = f"{subject} must be concrete, not traced: {called} needs concrete numbers"
                    raise ArgumentTypeError(f"{problem}; {cure}")
            with jax.ensure_compile_time_eval() if is_within_jit() else nullcontext():
                return function(*args, **kwargs)

        return call

    return decorate


def _has_traced_numbers(value: Any) -> bool:
    if isinstance(value, Mapping):  # its keys need not be comparable, as they must be in a pytree
        return any(map(_has_traced_numbers, value.values()))
    return not getattr(value, "is_concrete", True) or is_traced(value)
