"""Checks of the arguments of public functions, before anything is computed.

`@checked` reads the annotations of a function's parameters. An argument must be an instance of an annotated class, or a choice of
a `Literal`; further requirements on instances of a class are registered by `checks_instances`. Metadata of `Annotated` state all
other requirements (udkjax/argument_types.py): shapes must fit the mechanism, numbers must be real, finite and of the right sign.
Single numbers, integers and lists of names need no metadata. For traced values only shapes and dtypes are checked;
`concrete_only` (udkjax/requirements.py) refuses them.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial, wraps
from inspect import BoundArguments, Parameter, Signature, isclass, signature
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, ParamSpec, TypeVar, Union, get_args, get_origin

import jax
import numpy as np
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike
from udkjax.argument_types import INSTANCE_CHECKS, ArgumentRequirement, checks_instances
from udkjax.arrays import is_within_jit, without_derivatives
from udkjax.requirements import (
    ArgumentCheck,
    ArgumentError,
    ArgumentTypeError,
    GivenArguments,
    describe,
    require_count,
    require_name_or_names,
    require_names,
    require_number,
)
from udkjax.scene.mechanism import Mechanism, require_valid_numbers
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import article, quote, suggestion

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Example of an argument of each class, for messages.
EXAMPLES = {
    "Mechanism": 'udk.load("scene.toml")',
    "State": "udk.State(q, v)",
    "Analysis": "udk.analyse(mechanism)",
    "Pseudoinverse": "udk.SVD()",
    "Formulation": "udk.Augmented()",
    "Projection": "udk.Projection()",
    "Baumgarte": "udk.Baumgarte(alpha, beta)",
}


def checked(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function that checks its arguments.

    Args:
        function: A function with annotated parameters.

    Returns:
        The function with checks. It raises `TypeError` if an argument has the wrong type, `ValueError` if it has the wrong shape
        or value; the message states the argument, its value and the requirement.
    """
    bind, checks = _binder(function), _checks_of(function)

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        given, bound = bind(args, kwargs)
        for name, check, if_none in checks:
            if name in given and (bound[name] is not None or if_none == "takes"):
                check(name, bound[name], given=bound)
            elif name in given and if_none == "refuses":
                raise ArgumentTypeError(f"{name} must be given, not None")
        try:
            return function(*args, **kwargs)
        except (ArgumentError, SceneError) as error:
            if jax.config.jax_traceback_filtering == "off":  # pyright: ignore[reportAttributeAccessIssue]
                raise
            raise _refusal(error) from None

    return call


def _refusal(error: Result) -> Result:
    """Return an error without its traceback, since its message is sufficient, and without the note that JAX adds to it."""
    if notes := getattr(error, "__notes__", None):
        notes[:] = [note for note in notes if "JAX" not in note]
    return error.with_traceback(None)  # pyright: ignore[reportAttributeAccessIssue]


def _binder(function: Callable[..., Any]) -> Callable[[tuple[Any, ...], dict[str, Any]], tuple[GivenArguments, GivenArguments]]:
    """Return a function that maps the arguments of a call to two dicts by name: without and with the defaults."""
    parameters = signature(function)
    defaults = {name: p.default for name, p in parameters.parameters.items() if p.default is not p.empty}
    kinds = {p.kind for p in parameters.parameters.values()}
    names = [name for name, p in parameters.parameters.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    required, is_fixed = (
        parameters.parameters.keys() - defaults.keys(),
        kinds <= {Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY},
    )

    def bind(args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[GivenArguments, GivenArguments]:
        given = dict(zip(names, args, strict=False)) | kwargs
        bound = defaults | given
        is_valid = len(given) == len(args) + len(kwargs) and required <= given.keys() and len(bound) == len(parameters.parameters)
        if not (is_fixed and is_valid):  # raises the error, or collects variadic arguments
            given = bind_arguments(function.__name__, parameters, args, kwargs).arguments
            bound = defaults | given
        return given, bound

    return bind


def bind_arguments(name: str, parameters: Signature, args: Sequence[Any], kwargs: Mapping[str, Any]) -> BoundArguments:
    """Return the arguments of a function by name; raise a `TypeError` that names the function."""
    try:
        return parameters.bind(*args, **kwargs)
    except TypeError as error:
        unknown = next((key for key in kwargs if key not in parameters.parameters), None)
        raise TypeError(f"{name}(): {error}{suggestion(unknown, parameters.parameters)}") from None


def argument_problems(function: Callable[..., object], given: GivenArguments) -> list[str]:
    """Return messages about all mistakes that checks find in arguments, `given` by name, without calling the function.

    Arguments may be left out, except the mechanism, to which others must fit.
    """
    problems: list[str] = []
    for name, check, if_none in _checks_of(function):
        try:
            if name in given and (given[name] is not None or if_none == "takes"):
                check(name, given[name], given=given)
        except (TypeError, ValueError) as error:
            problems.append(str(error))
    return problems


class ParameterCheck(NamedTuple):
    """A check of a parameter. If the argument is None, it is checked ("takes"), accepted ("passes") or refused ("refuses")."""

    name: str
    check: ArgumentCheck
    if_none: Literal["takes", "passes", "refuses"] = "takes"


def _checks_of(function: Callable[..., object]) -> list[ParameterCheck]:
    parameter_checks: list[ParameterCheck] = []
    for name, parameter in signature(function).parameters.items():
        types, checks = _unfold(parameter.annotation)
        may_be_none = parameter.default is None or type(None) in types
        if by_type := _check_of_type(types):
            parameter_checks.append(ParameterCheck(name, by_type))
        for check in checks or _checks_of_kind(types):
            parameter_checks.append(ParameterCheck(name, check, "passes" if may_be_none else "refuses"))
    return parameter_checks


def _unfold(annotation: Any) -> tuple[tuple[Any, ...], tuple[ArgumentCheck, ...]]:
    """Return the types that an annotation allows, and the checks of its metadata."""
    if isinstance(annotation, TypeAliasType) and annotation is not NumberLike:
        return _unfold(annotation.__value__)
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        types, checks = _unfold(inner)
        return types, (*checks, *(x.check for x in metadata if isinstance(x, ArgumentRequirement)))
    if get_origin(annotation) not in (Union, UnionType):
        return (annotation,), ()
    unfolded = [_unfold(x) for x in get_args(annotation)]
    return tuple(x for types, _ in unfolded for x in types), tuple(x for _, checks in unfolded for x in checks)


def _check_of_type(types: tuple[Any, ...]) -> ArgumentCheck | None:
    """Return the check of an annotation that consists of this package's classes, bool, str and choices; None for any other."""
    choices = [choice for x in types if get_origin(x) is Literal for choice in get_args(x)]
    classes = tuple(x for x in types if get_origin(x) is not Literal)
    if not _are_ours(classes):
        return None
    if not choices:
        return _instance(classes) if any(x is not type(None) for x in classes) else None
    if not classes:
        return _choice(tuple(choices))
    is_instance, is_choice = _instance(classes), _choice(tuple(choices))

    def check(name: str, value: Any, given: GivenArguments):
        (is_choice if isinstance(value, str) else is_instance)(name, value, given=given)

    return check


def _checks_of_kind(types: tuple[Any, ...]) -> tuple[ArgumentCheck, ...]:
    """Return the check of an integer, a number or names, as a tuple; () for any other types."""
    kinds = {x for x in types if x is not type(None)}
    if kinds == {int}:
        return (partial(require_count, least=-math.inf),)
    if kinds in ({float}, {NumberLike}):
        return (require_number,)
    if kinds == {str, Sequence[str]}:
        return (require_name_or_names,)
    return (require_names,) if kinds == {Sequence[str]} else ()


def _are_ours(classes: Sequence[Any]) -> bool:
    return all(isclass(x) and (x in (bool, type(None), str) or _is_ours(x)) for x in classes)


def _is_ours(x: type) -> bool:
    return x.__module__.startswith("udkjax.") and not getattr(x, "_is_protocol", False)


def _instance(classes: tuple[type, ...]) -> ArgumentCheck:
    accepted = (*classes, np.bool_) if bool in classes else classes
    expected = " or ".join(_describe_class(x) for x in classes).removesuffix(",")

    def check(name: str, value: Any, given: GivenArguments):
        if not isinstance(value, accepted):
            cure = getattr(value, "cure", "")
            raise ArgumentTypeError(f"{name} must be {expected}, {describe(value)}{_remedy(name, value, classes)}{cure}")
        for cls in type(value).__mro__:
            if cls in INSTANCE_CHECKS:
                INSTANCE_CHECKS[cls](name, value, given=given)
                break

    return check


def _describe_class(cls: type) -> str:
    if cls is type(None):
        return "None"
    if cls in (bool, str):
        return {bool: "True or False", str: "a string"}[cls]
    example = EXAMPLES.get(cls.__name__)
    return f"{article(cls.__name__)} {cls.__name__}" + (f", such as {example}," if example else "")


def _remedy(name: str, value: Any, classes: Sequence[type]) -> str:
    """Return the advice, for a message, to give an instance of a class or the state of a result; "" if neither applies."""
    if (state := getattr(value, "state", None)) is not None and isinstance(state, tuple(classes)):
        return f"; give its state: {name}=x.state"
    if any(x.__name__ == "State" for x in classes) and np.ndim(getattr(value, "q", None)) == 3 and hasattr(value, "v"):
        return f"; give the state at one of its times: {name}=udk.State(x.q[k], x.v[k])"
    wanted = value if isinstance(value, str) else value.__name__ if isclass(value) else ""
    class_name = {x.__name__.lower(): x.__name__ for x in _with_subclasses(classes)}.get(wanted.strip("() ").lower())
    return (
        f"; give an instance: {name}=udk.{class_name}()"
        if class_name and class_name not in ("Mechanism", "State", "Analysis")
        else ""
    )


def _with_subclasses(classes: Sequence[type]) -> Iterator[type]:
    for cls in classes:
        yield cls
        if cls not in (bool, str, type(None)):
            yield from _with_subclasses(cls.__subclasses__())


def _choice(known: tuple[Any, ...]) -> ArgumentCheck:
    texts = [x for x in known if isinstance(x, str)]

    def check(name: str, value: Any, given: GivenArguments):
        if not isinstance(value, str | bool | int | None) or value not in known:
            listed = ", ".join(quote(x) if isinstance(x, str) else str(x) for x in known)
            raise ArgumentError(f"{name} must be one of {listed}, {describe(value)}{suggestion(value, texts)}")

    return check


@checks_instances(Mechanism)
def _require_usable(name: str, value: Mechanism, given: GivenArguments) -> None:
    """Raise an error if a mechanism is a batch of mechanisms, or has numbers without a meaning, such as a negative mass."""
    if (shape := np.shape(value._source.gravity)) != (2,):
        cure = "map over it: jax.vmap(lambda one: ...)(mechanisms)"
        raise ArgumentError(f"{name} is a batch of mechanisms, whose gravity has the shape {shape}, not (2,): {cure}")
    require_valid_numbers(value if value.is_concrete or is_within_jit() else without_derivatives(value))


def require_mechanism(value: Any) -> Mechanism:
    """Return the value; raise a `TypeError` unless it is a mechanism."""
    _instance((Mechanism,))("mechanism", value, given={})
    return value
