"""The one door: what public functions are called with is checked before anything is computed.

`@checked` reads the annotations and names of a function's parameters. A parameter annotated with classes takes their instances,
one annotated `Literal` its choices; arrays are told by their names (`CHECKS`): shapes are those of the mechanism, numbers are
real, finite and of the right sign. Of traced values the shapes and dtypes are checked; what they turn out to be is data.
"""

import dataclasses
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from inspect import isclass, signature
from types import UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from udkjax.scene.bodies import COORDINATES
from udkjax.scene.checks import abbreviate, quote, suggestion
from udkjax.scene.mechanism import Mechanism

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
Given = Mapping[str, Any]  # all arguments of a call by name, defaults among them
Check = Callable[[str, Any, Given], None]
Sign = Literal["any", "positive", "not negative"]

# How instances of the classes that arguments may have are made, for messages.
EXAMPLES = {
    "Mechanism": 'udk.load("scene.toml")',
    "State": "udk.State(q, v)",
    "Analysis": "udk.analyse(mechanism)",
    "Pseudoinverse": "udk.SVD()",
    "Formulation": "udk.Augmented()",
    "Projection": "udk.Projection()",
    "Baumgarte": "udk.Baumgarte(alpha, beta)",
}


class ArgumentError(ValueError):
    """An argument of a public function cannot be used; the message names it, what was given and what is meant."""


class ArgumentTypeError(ArgumentError, TypeError):
    """It is of a wrong type."""


def checked(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function that checks its arguments.

    Args:
        function: Its parameters are checked by their annotations and names, as the module says.

    Returns:
        The same function. Raises `TypeError` where an argument is of a wrong type, `ValueError` where it is of a wrong shape or
        value; the message names the argument, what was given and what is meant.
    """
    parameters, checks = signature(function), _checks_of(function)

    @wraps(function)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        bound = parameters.bind(*args, **kwargs)
        bound.apply_defaults()
        for name, check in checks:
            check(name, bound.arguments[name], bound.arguments)
        return function(*args, **kwargs)

    return call


def argument_problems(function: Callable[..., object], given: Given) -> list[str]:
    """Return what is wrong with some of the arguments that a function is to be called with, the mechanism among them."""
    problems: list[str] = []
    for name, check in _checks_of(function):
        try:
            if name in given:
                check(name, given[name], given)
        except (TypeError, ValueError) as error:
            problems.append(str(error))
    return problems


def _checks_of(function: Callable[..., object]) -> list[tuple[str, Check]]:
    found: list[tuple[str, Check]] = []
    for name, parameter in signature(function).parameters.items():
        annotation = parameter.annotation
        if get_origin(annotation) is Literal:
            found.append((name, _choice(get_args(annotation))))
        elif classes := _classes(annotation):
            found.append((name, _instance(classes)))
        if name in ("solution", "motion") and parameter.default is parameter.empty:
            found.append((name, require_history))
        elif name in CHECKS:
            may_be_none = parameter.default is None or type(None) in get_args(annotation)
            found.append((name, CHECKS[name] if may_be_none else _given(CHECKS[name])))
    return found


def _classes(annotation: Any) -> tuple[type, ...]:
    """Return the classes that an annotation allows; none where it is not made of classes alone."""
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    plain = [x for x in parts if isclass(x) and (x in (bool, type(None), str) or _is_ours(x))]
    return tuple(plain) if len(plain) == len(parts) and any(x is not type(None) for x in plain) else ()


def _is_ours(x: type) -> bool:
    return x.__module__.startswith("udkjax.") and not getattr(x, "_is_protocol", False)


def _instance(classes: tuple[type, ...]) -> Check:
    kinds = (*classes, np.bool_) if bool in classes else classes
    meant = " or ".join(_meant(x) for x in classes).removesuffix(",")

    def check(name: str, value: Any, given: Given):
        if not isinstance(value, kinds):
            raise ArgumentTypeError(f"{name} must be {meant}, {describe(value)}{_remedy(name, value, classes)}")

    return check


def _meant(cls: type) -> str:
    if cls is type(None):
        return "None"
    if cls in (bool, str):
        return {bool: "True or False", str: "a text"}[cls]
    example = EXAMPLES.get(cls.__name__)
    return f"{_article(cls.__name__)} {cls.__name__}" + (f", such as {example}," if example else "")


def _article(noun: str) -> str:
    return "an" if noun[0].lower() in "aeiou" else "a"


def _remedy(name: str, value: Any, classes: Sequence[type]) -> str:
    """Return how to mend what is one step from right: a class in place of its instance, or its name as a text."""
    called = value if isinstance(value, str) else value.__name__ if isclass(value) else ""
    found = {x.__name__.lower(): x.__name__ for x in _family(classes)}.get(called.strip("() ").lower())
    return f"; give an instance: {name}=udk.{found}()" if found and found not in ("Mechanism", "State", "Analysis") else ""


def _family(classes: Sequence[type]) -> Iterator[type]:
    """Iterate over classes and all that inherit from them."""
    for cls in classes:
        yield cls
        if cls not in (bool, str, type(None)):
            yield from _family(cls.__subclasses__())


def describe(value: Any) -> str:
    """Return what a value is, for the end of a message: 'not the class SVD', 'not "SVD", a text'."""
    if isclass(value):
        return f"not the class {value.__name__}"
    if isinstance(value, str):
        return f"not the text {abbreviate(value)}"
    if value is None or isinstance(value, bool | int | float):
        return f"not {value}"
    kind = type(value).__name__
    shape = f" of the shape {np.shape(value)}" if isinstance(value, np.ndarray | jax.Array) else ""
    return f"not {_article(kind)} {kind}{shape}"


def _choice(known: tuple[Any, ...]) -> Check:
    texts = [x for x in known if isinstance(x, str)]

    def check(name: str, value: Any, given: Given):
        if not isinstance(value, str | bool | int | None) or value not in known:
            listed = ", ".join(quote(x) if isinstance(x, str) else str(x) for x in known)
            raise ArgumentError(f"{name} must be one of {listed}, {describe(value)}{suggestion(value, texts)}")

    return check


def require_mechanism(value: Any) -> Mechanism:
    """Return a mechanism; raise TypeError where it is none."""
    _instance((Mechanism,))("mechanism", value, {})
    return value


def array(name: str, value: Any) -> "np.ndarray | Tracer":
    """Return real numbers as an array; a traced one as it is. Raises TypeError where they are none, and names the argument."""
    if isinstance(value, Tracer):
        found: Any = value
    elif any(isinstance(x, Tracer) for x in jax.tree.leaves(value)):
        found = jnp.asarray(value)  # a list of traced numbers
    else:
        try:
            found = np.asarray(value)
        except ValueError:
            raise ArgumentTypeError(f"{name} must be an array of numbers; its rows have different lengths") from None
        except TypeError:
            raise ArgumentTypeError(f"{name} must be an array of numbers, {describe(value)}") from None
    if not (jnp.issubdtype(found.dtype, jnp.floating) or jnp.issubdtype(found.dtype, jnp.integer)):
        kind = "complex numbers" if jnp.issubdtype(found.dtype, jnp.complexfloating) else None
        raise ArgumentTypeError(f"{name} must be real numbers, {f'not {kind}' if kind else describe(value)}")
    return found


def require_number(name: str, value: Any, sign: Sign = "any", infinite: bool = False) -> None:
    """Require one real number, finite unless said otherwise, of a sign; of a traced one, the shape and the dtype alone."""
    found = array(name, value)
    if found.shape != ():
        cure = "a batch is for jax.vmap, or for udk.sweep"
        raise ArgumentError(f"{name} must be one number, not an array of the shape {found.shape}; {cure}")
    if isinstance(found, Tracer):
        return
    x = float(found)
    bad = np.isnan(x) or (np.isinf(x) and not infinite)
    if bad or (sign == "positive" and not x > 0) or (sign == "not negative" and not x >= 0):
        meant = {"any": "a finite number", "positive": "positive", "not negative": "zero or positive"}[sign]
        raise ArgumentError(f"{name} must be {meant}{' and finite' if sign != 'any' and not infinite else ''}, not {x:g}")


def require_count(name: str, value: Any, least: int = 1) -> None:
    """Require a whole number that is not below `least`; of a traced one, the shape and the dtype alone."""
    found = None if isinstance(value, bool | np.bool_) else array(name, value)
    if found is None or found.shape != () or not jnp.issubdtype(found.dtype, jnp.integer):
        raise ArgumentTypeError(f"{name} must be a whole number, {describe(value)}")
    if not isinstance(found, Tracer) and int(found) < least:
        raise ArgumentError(f"{name} must be at least {least}, not {int(found)}")


def require_finite(name: str, value: Any, place: Callable[..., str] = lambda *index: "") -> None:
    """Require finite numbers where they are known; `place` says in words which entry it is."""
    found = array(name, value)
    if isinstance(found, Tracer) or (finite := np.isfinite(found)).all():
        return
    index = tuple(int(k) for k in np.argwhere(~finite)[0])
    where = f"[{', '.join(map(str, index))}]" if index else ""
    raise ArgumentError(f"{name}{where} is {found[index]:g}{place(*index)}: it must be finite")


def require_coordinates(name: str, value: Any, given: Given, flat: bool = True) -> None:
    """Require x, y and angle of each body of the mechanism, or their rates, (bodies, 3); or (n,), if `flat`."""
    mechanism, found = given["mechanism"], array(name, value)
    if not isinstance(mechanism, Mechanism):  # a system of the user's own has coordinates as many as he gives
        if found.ndim != 1:
            raise ArgumentError(f"{name} must be a vector (n,), not an array of the shape {found.shape}")
        require_finite(name, value)
        return
    names = mechanism.body_names
    right = (len(names), 3)
    if found.shape != right and not (flat and found.shape == (3 * len(names),)):
        rest = f": x, y and angle of {', '.join(map(quote, names[:4]))}{', ...' if len(names) > 4 else ''}"
        cure = "; a batch of states is for jax.vmap" if found.ndim > 2 and found.shape[-2:] == right else ""
        raise ArgumentError(f"{name} must have the shape {right}{rest}; it has the shape {found.shape}{cure}")
    require_finite(name, found, lambda *k: _place(names, k))


def _place(names: Sequence[str], index: tuple[int, ...]) -> str:
    body, coordinate = index if len(index) == 2 else divmod(index[0], 3)
    return f" ({COORDINATES[coordinate]} of {quote(names[body])})"


def require_times(name: str, value: Any) -> None:
    """Require a vector of finite times; of a traced one, the shape alone."""
    found = array(name, value)
    if found.ndim != 1 or not len(found):
        raise ArgumentError(f"{name} must be a vector of times in s; its shape is {found.shape}")
    require_finite(name, found)


def require_output_times(name: str, value: Any) -> None:
    """Require at least two finite times, each after the one before; of traced ones, the shape alone."""
    found = array(name, value)
    if found.ndim != 1 or len(found) < 2:
        what = "a vector of at least two output times, from the start on"
        raise ArgumentError(f"{name} must be {what}; its shape is {found.shape}")
    require_finite(name, found)
    if not isinstance(found, Tracer) and not np.all(steps := np.diff(found) > 0):
        k = int(np.argmin(steps))
        after = f"{name}[{k + 1}] = {found[k + 1]:g} s follows {found[k]:g} s"
        raise ArgumentError(f"{name} must increase from each output time to the next: {after}")


def _check_state(name: str, value: Any, given: Given) -> None:
    if value is not None:
        value = getattr(value, "state", value)  # a closure has one
        for part in ("q", "v"):
            require_coordinates(f"{name}.{part}", getattr(value, part), given, flat=False)
        shapes = np.shape(value.q), np.shape(value.v)
        if shapes[0] != shapes[1]:
            raise ArgumentError(f"{name}.v must have the shape of {name}.q, {shapes[0]}; it has the shape {shapes[1]}")


def _check_mechanism(name: str, value: Any, given: Given) -> None:
    if isinstance(value, Mechanism) and (shape := np.shape(value.gravity)) != (2,):
        cure = "map over it: jax.vmap(lambda one: ...)(mechanisms)"
        raise ArgumentError(f"{name} is a batch of mechanisms, whose gravity has the shape {shape}, not (2,): {cure}")


def _check_thresholds(name: str, value: Any, given: Given) -> None:
    """The thresholds of a pseudoinverse, or the gains of a stabilization."""
    for field in dataclasses.fields(value) if isinstance(value, eqx.Module) else ():
        x = getattr(value, field.name)
        if eqx.is_array(x) or isinstance(x, float):
            require_number(f"{name}.{field.name}", x, "not negative")


def require_history(name: str, value: Any, given: Given) -> None:
    """Require a solution, or whatever has times ts (T,) and states q and v (T, bodies, 3) of the mechanism."""
    mechanism = given["mechanism"]
    missing = [part for part in ("ts", "q", "v") if not hasattr(value, part)]
    if missing or isclass(value):
        raise ArgumentTypeError(f"{name} must have times and states, ts, q and v, as a Solution: {describe(value)}")
    bodies = getattr(value, "bodies", None)
    if isinstance(mechanism, Mechanism) and isinstance(bodies, tuple) and bodies and bodies != mechanism.body_names:
        listed = [", ".join(map(quote, x[:6])) + (", ..." if len(x) > 6 else "") for x in (bodies, mechanism.body_names)]
        raise ArgumentError(f"{name} is of another mechanism: its bodies are {listed[0]}, those of the mechanism {listed[1]}")
    ts, q, v = (array(f"{name}.{part}", getattr(value, part)) for part in ("ts", "q", "v"))
    right = (*ts.shape, len(mechanism.body_names), 3) if isinstance(mechanism, Mechanism) else q.shape
    if q.ndim == 4:
        one, all_of_them = "jax.tree.map(lambda x: x[0], batch)", "jax.vmap(lambda one: function(mechanism, one))(batch)"
        raise ArgumentError(f"{name} is a batch of {len(q)} solutions: take one of them, {one}, or map over them, {all_of_them}")
    if ts.ndim != 1 or q.shape[:1] != ts.shape or q.shape != right or v.shape != q.shape:
        meant = "ts (T,), q and v (T, bodies, 3)" if isinstance(mechanism, Mechanism) else "ts (T,), q and v (T, n)"
        is_of = f" of {len(mechanism.body_names)} bodies" if isinstance(mechanism, Mechanism) else ""
        raise ArgumentError(f"{name} must have {meant}{is_of}; the shapes are {ts.shape}, {q.shape} and {v.shape}")


def _optional_history(name: str, value: Any, given: Given) -> None:
    if value is not None:
        require_history(name, value, given)


def _check_analysis(name: str, value: Any, given: Given) -> None:
    mechanism = given.get("mechanism")
    if value is None or not isinstance(mechanism, Mechanism):
        return
    owners = list(dict.fromkeys(owner for owner, _ in value.row_names))
    if value.coordinates != 3 * len(mechanism.body_names) or owners != list(mechanism.constraints):
        raise ArgumentError(f"{name} is that of another mechanism: give udk.analyse(mechanism), or leave it out")


def _of_diffrax(kind: str, example: str) -> Check:
    def check(name: str, value: Any, given: Given):
        diffrax = sys.modules.get("diffrax")  # who has an instance of its classes has imported it
        if value is not None and not (diffrax and isinstance(value, getattr(diffrax, kind))):
            meant = f"an instance of diffrax's, such as {name}={example}, or None"
            raise ArgumentTypeError(f"{name} must be {meant}, {describe(value)}")

    return check


def _given(check: Check) -> Check:
    """Return the check of an argument that must not be None, by one that lets None pass."""

    def applied(name: str, value: Any, given: Given):
        if value is None:
            raise ArgumentTypeError(f"{name} must be given, {describe(value)}")
        check(name, value, given)

    return applied


def _optional(check: Callable[..., None], **choices: Any) -> Check:
    """Return the check of an argument that may be None."""

    def applied(name: str, value: Any, given: Given):
        if value is not None:
            check(name, value, **choices)

    return applied


def _require_array(name: str, value: Any, given: Given) -> None:
    require_finite(name, value)


def _require_mapping(name: str, value: Any, given: Given) -> None:
    if value is not None and not isinstance(value, Mapping):
        raise ArgumentTypeError(f"{name} must map names to numbers, such as {{name: number}}, {describe(value)}")


def _require_point(name: str, value: Any, given: Given) -> None:
    if "of" in given and (value is None or np.shape(value) != (2,)):
        return  # `path` knows the points of pins, and says what a shape should be
    if array(name, value).shape != (2,):
        raise ArgumentError(f"{name} must be two numbers, x and y in m, {describe(value)}")
    require_finite(name, value)


def _require_names(name: str, value: Any, given: Given) -> None:
    if not isinstance(value, str) and not (isinstance(value, list | tuple) and all(isinstance(x, str) for x in value)):
        raise ArgumentTypeError(f"{name} must be the name of a body, or a list of names, {describe(value)}")


def _require_drivers(name: str, value: Any, given: Given) -> None:
    """Names of drivers with their values, or, where they have none here, names alone."""
    if isinstance(value, Mapping):
        for driver, values in value.items():
            require_finite(f"{name}[{driver!r}]", values)
    elif "body" in given or isinstance(value, str | np.ndarray) or not isinstance(value, Sequence | None):
        meant = "map two drivers to their values" if "body" in given else "be a list of names"
        raise ArgumentTypeError(f"{name} must {meant}, {describe(value)}")


def _require_path(name: str, value: Any, given: Given) -> None:
    if value is not None and not isinstance(value, str | os.PathLike):
        raise ArgumentTypeError(f"{name} must be a path, or None, {describe(value)}")


def _require_client(name: str, value: Any, given: Given) -> None:
    if value is not None and (isclass(value) or not hasattr(value, "submit")):
        raise ArgumentTypeError(f"{name} must be a dask.distributed.Client, or None, {describe(value)}")


def _require_optimizer(name: str, value: Any, given: Given) -> None:
    if value is not None and not isinstance(value, str) and (isclass(value) or not hasattr(value, "init")):
        raise ArgumentTypeError(f"{name} must be an optimizer of optax's, a solver of optimistix's, or None, {describe(value)}")


def _require_parameters(name: str, value: Any, given: Given) -> None:
    """What is to be identified: a name, an object that stands for one, or a list of these."""
    if not isinstance(value, str | list | tuple) and not callable(value) and not dataclasses.is_dataclass(value):
        raise ArgumentTypeError(f"{name} must be the name of a parameter, a Parameter, or a list of these, {describe(value)}")


def _require_texts(name: str, value: Any, given: Given) -> None:
    if isinstance(value, str) or not isinstance(value, Sequence) or not all(isinstance(x, str) for x in value):
        raise ArgumentTypeError(f"{name} must be a list of names, {describe(value)}")


CHECKS: dict[str, Check] = {
    "out": _require_path,
    "memory": _optional(require_count),
    "drivers": _require_drivers,
    "parameters": _require_parameters,
    "ignore": _require_texts,
    "client": _require_client,
    "optimizer": _require_optimizer,
    "mechanism": _check_mechanism,
    "method": _check_thresholds,
    "stabilization": _check_thresholds,
    "t": _optional(require_number),
    "ts": _optional(require_times),
    "q": require_coordinates,
    "v": require_coordinates,
    "state": _check_state,
    "solution": _optional_history,
    "motion": _optional_history,
    "analysis": _check_analysis,
    "rtol": _optional(require_number, sign="not negative"),
    "atol": _optional(require_number, sign="not negative"),
    "drift_tol": _optional(require_number, sign="positive", infinite=True),
    "rank_tol": _optional(require_number, sign="not negative"),
    "time_tol": _optional(require_number, sign="positive"),
    "dt0": _optional(require_number, sign="positive"),
    "max_steps": _optional(require_count),
    "max_events": _optional(require_count),
    "starts": _optional(require_count),
    "seed": _optional(require_count, least=0),
    "values": _require_array,
    "axes": _require_mapping,
    "rate": _require_array,
    "acceleration": _require_array,
    "value": _optional(require_number),
    "length": _optional(require_number, sign="positive"),
    "angle": _optional(require_number),
    "angular_velocity": _optional(require_number),
    "held": _require_mapping,
    "weights": _require_mapping,
    "compliances": _require_mapping,
    "point": _require_point,
    "bodies": _require_names,
    "solver": _of_diffrax("AbstractSolver", "diffrax.Tsit5()"),
    "adjoint": _of_diffrax("AbstractAdjoint", "diffrax.ForwardMode()"),
}
