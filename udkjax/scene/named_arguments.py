"""Requirements on arguments by their names, which are the same in every public function, whatever the annotations.

None is not checked here: it is accepted where a parameter may be None, and refused elsewhere (arguments.py).
"""

import dataclasses
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import isclass
from typing import Any

import equinox as eqx
import numpy as np

from udkjax.requirements import (
    ArgumentCheck,
    ArgumentError,
    ArgumentTypeError,
    GivenArguments,
    are_names,
    array,
    describe,
    require_count,
    require_finite,
    require_names,
    require_number,
    require_numbers_by_name,
    require_times,
)
from udkjax.scene.elements.bodies import COORDINATES
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote


def require_coordinates(name: str, value: Any, given: GivenArguments, flat: bool = True) -> None:
    """Require x, y and angle of each body of the mechanism, or their rates: (bodies, 3), or (n,) if `flat`."""
    mechanism, coordinates = given["mechanism"], array(name, value)
    if not isinstance(mechanism, Mechanism):  # the number of coordinates of a user-written system is not known
        if coordinates.ndim != 1:
            raise ArgumentError(f"{name} must be a vector (n,), not an array of the shape {coordinates.shape}")
        require_finite(name, value)
        return
    names = mechanism.body_names
    shape = (len(names), 3)
    if coordinates.shape != shape and not (flat and coordinates.shape == (3 * len(names),)):
        order = f": x, y and angle of {', '.join(map(quote, names[:4]))}{', ...' if len(names) > 4 else ''}"
        cure = "; a batch of states is for jax.vmap" if coordinates.ndim > 2 and coordinates.shape[-2:] == shape else ""
        raise ArgumentError(f"{name} must have the shape {shape}{order}; it has the shape {coordinates.shape}{cure}")
    require_finite(name, coordinates, lambda *k: _place(names, k))


def _place(names: Sequence[str], index: tuple[int, ...]) -> str:
    body, coordinate = index if len(index) == 2 else divmod(index[0], 3)
    return f" ({COORDINATES[coordinate]} of {quote(names[body])})"


def require_history(name: str, value: Any, given: GivenArguments) -> None:
    """Require a solution, or any object with times ts (T,) and states q and v (T, bodies, 3) of the mechanism."""
    mechanism = given["mechanism"]
    missing = [part for part in ("ts", "q", "v") if not hasattr(value, part)]
    if missing or isclass(value):
        raise ArgumentTypeError(f"{name} must have times and states, ts, q and v, as a Solution: {describe(value)}")
    bodies = getattr(value, "bodies", None)
    if isinstance(mechanism, Mechanism) and isinstance(bodies, tuple) and bodies and bodies != mechanism.body_names:
        listed = [", ".join(map(quote, x[:6])) + (", ..." if len(x) > 6 else "") for x in (bodies, mechanism.body_names)]
        raise ArgumentError(f"{name} belongs to another mechanism: its bodies are {listed[0]}, not {listed[1]}")
    ts, q, v = (array(f"{name}.{part}", getattr(value, part)) for part in ("ts", "q", "v"))
    expected_shape = (*ts.shape, len(mechanism.body_names), 3) if isinstance(mechanism, Mechanism) else q.shape
    if q.ndim == 4:
        first_member, all_of_them = "jax.tree.map(lambda x: x[0], batch)", "jax.vmap(lambda one: function(mechanism, one))(batch)"
        raise ArgumentError(
            f"{name} is a batch of {len(q)} solutions: take one of them, {first_member}, or map over them, {all_of_them}"
        )
    if ts.ndim != 1 or q.shape[:1] != ts.shape or q.shape != expected_shape or v.shape != q.shape:
        expected = "ts (T,), q and v (T, bodies, 3)" if isinstance(mechanism, Mechanism) else "ts (T,), q and v (T, n)"
        is_of = f" of {len(mechanism.body_names)} bodies" if isinstance(mechanism, Mechanism) else ""
        raise ArgumentError(f"{name} must have {expected}{is_of}; the shapes are {ts.shape}, {q.shape} and {v.shape}")


def _check_state(name: str, value: Any, given: GivenArguments) -> None:
    value = getattr(value, "state", value)  # the state of a `Closure`
    for part in ("q", "v"):
        require_coordinates(f"{name}.{part}", getattr(value, part), given, flat=False)
    shapes = np.shape(value.q), np.shape(value.v)
    if shapes[0] != shapes[1]:
        raise ArgumentError(f"{name}.v must have the shape of {name}.q, {shapes[0]}; it has the shape {shapes[1]}")


def _check_thresholds(name: str, value: Any, given: GivenArguments) -> None:
    for field in dataclasses.fields(value) if isinstance(value, eqx.Module) else ():
        x = getattr(value, field.name)
        if eqx.is_array(x) or isinstance(x, float):
            require_number(f"{name}.{field.name}", x, "not negative")


def _check_analysis(name: str, value: Any, given: GivenArguments) -> None:
    mechanism = given.get("mechanism")
    if not isinstance(mechanism, Mechanism):
        return
    owners = list(dict.fromkeys(owner for owner, _ in value.row_names))
    if value.coordinates != 3 * len(mechanism.body_names) or owners != list(mechanism.constraints):
        raise ArgumentError(f"{name} belongs to another mechanism: give udk.analyse(mechanism), or leave it out")


def _of_diffrax(kind: str, example: str) -> ArgumentCheck:
    def check(name: str, value: Any, given: GivenArguments):
        diffrax = sys.modules.get("diffrax")  # no instance of its classes exists before it is imported
        if not (diffrax and isinstance(value, getattr(diffrax, kind))):
            expected = f"an instance of a diffrax class, such as {name}={example}, or None"
            raise ArgumentTypeError(f"{name} must be {expected}, {describe(value)}")

    return check


def _check_solver(name: str, value: Any, given: GivenArguments) -> None:
    """Require a solver that estimates its errors, since these decide the steps."""
    _of_diffrax("AbstractSolver", "diffrax.Tsit5()")(name, value, given)
    diffrax, controller = sys.modules["diffrax"], given.get("stepsize_controller")
    is_adaptive = controller is None or isinstance(controller, diffrax.AbstractAdaptiveStepSizeController)
    if is_adaptive and not isinstance(value, diffrax.AbstractAdaptiveSolver):
        kind = type(value).__name__
        estimated = f"give a solver such as diffrax.Tsit5(), or diffrax.HalfSolver(diffrax.{kind}()), which estimates them"
        cure = f"{estimated}, or constant steps, stepsize_controller=diffrax.ConstantStepSize() with dt0"
        raise ArgumentError(
            f"{name}: steps follow from estimated errors, even with dt0, and {kind} does not estimate any; {cure}"
        )


def _check_controller(name: str, value: Any, given: GivenArguments) -> None:
    """Require a step size controller, and a first step for constant ones."""
    _of_diffrax("AbstractStepSizeController", "diffrax.ConstantStepSize()")(name, value, given)
    if isinstance(value, sys.modules["diffrax"].ConstantStepSize) and given.get("dt0") is None:
        raise ArgumentError(f"{name}: constant steps need their length: dt0=1e-3")


def _of_kind(condition: str, is_valid: Callable[[Any], bool]) -> ArgumentCheck:
    """Return a check that an argument satisfies `is_valid`; `condition` describes valid arguments in messages."""

    def check(name: str, value: Any, given: GivenArguments):
        if not is_valid(value):
            raise ArgumentTypeError(f"{name} must {condition}, {describe(value)}")

    return check


def _has(method: str) -> Callable[[Any], bool]:
    return lambda x: hasattr(x, method) and not isclass(x)


require_name_or_names = _of_kind("be a name, or a list of names", lambda x: isinstance(x, str) or are_names(x))
_require_mapping = _of_kind(
    "map names to numbers, such as {name: number}",
    lambda x: isinstance(x, Mapping) and all(isinstance(name, str) for name in x),
)


def _require_arrays_by_name(name: str, value: Any, given: GivenArguments) -> None:
    _require_mapping(name, value, given)
    for key, numbers in value.items():
        require_finite(f"{name}[{key!r}]", numbers)


def _require_noise(name: str, value: Any, given: GivenArguments) -> None:
    """Require numbers for all channels, or by channel, where None leaves a channel out."""
    by_channel = {f"{name}[{str(key)!r}]": x for key, x in value.items()} if isinstance(value, Mapping) else {name: value}
    for place, numbers in by_channel.items():
        if numbers is not None:
            array(place, numbers)


def _require_directions(name: str, value: Any, given: GivenArguments) -> None:
    if not isinstance(value, Mapping) or not all(isinstance(x, str) and isinstance(y, Mapping) for x, y in value.items()):
        example = '{"both": {"body.a.mass": 1.0, "body.b.mass": -1.0}}'
        raise ArgumentTypeError(f"{name} must map names to changes of unknowns, such as {example}, {describe(value)}")
    for direction, changes in value.items():
        for unknown, change in changes.items():
            require_number(f"{name}[{direction!r}][{unknown!r}]", change, infinite=True)


_require_units = _of_kind(
    'map names to units, such as {name: "m"}',
    lambda x: isinstance(x, Mapping) and all(isinstance(text, str) for pair in x.items() for text in pair),
)


def _are_channels(x: Any) -> bool:
    """Return True for a list of names of channels, and of user-defined quantities."""
    is_list = isinstance(x, Sequence) and not isinstance(x, str) and len(x) > 0
    return is_list and all(isinstance(channel, str) or hasattr(channel, "name") for channel in x)


def _is_coordinate(x: Any) -> bool:
    """Return True for the name of a driver or a coordinate, or a `Coordinate`."""
    return bool(x) if isinstance(x, str) else hasattr(x, "bodies")


def _is_parameter(x: Any) -> bool:
    """Return True for the name of a parameter, a `Parameter`, or names of tied parameters."""
    is_tie = isinstance(x, list | tuple) and all(isinstance(name, str) for name in x)
    return isinstance(x, str) or is_tie or callable(x) or hasattr(x, "of")


def _require_point(name: str, value: Any, given: GivenArguments) -> None:
    if "of" in given and np.shape(value) != (2,):
        return  # `path` resolves pins and checks the shape
    if array(name, value).shape != (2,):
        raise ArgumentError(f"{name} must be two numbers, x and y in m, {describe(value)}")
    require_finite(name, value)


def _require_rate(name: str, value: Any, given: GivenArguments) -> None:
    """Require finite numbers; where a course asks `at` a value, a text with a unit is read there."""
    if not (isinstance(value, str) and "at" in given):
        require_finite(name, value)


def _require_drivers(name: str, value: Any, given: GivenArguments) -> None:
    """Check a mapping of drivers to values, or a list of names of drivers where they have no values."""
    if isinstance(value, Mapping) and all(map(_is_coordinate, value)):
        for driver, values in value.items():
            require_finite(f"{name}[{driver!r}]", values)
    elif (
        "body" in given
        or isinstance(value, str | np.ndarray)
        or not isinstance(value, Sequence)
        or not all(map(_is_coordinate, value))
    ):
        condition = "map two drivers to their values" if "body" in given else "be a list of names"
        raise ArgumentTypeError(f"{name} must {condition}, {describe(value)}")


CHECKS: dict[str, ArgumentCheck] = {
    "out": _of_kind("be a path, or None", lambda x: isinstance(x, str | os.PathLike)),
    "memory": require_count,
    "drivers": _require_drivers,
    "parameters": _of_kind(
        "be the name of a parameter, a Parameter, or a list of these",
        lambda x: all(map(_is_parameter, x)) if isinstance(x, list | tuple) else _is_parameter(x),
    ),
    "ignore": require_names,
    "directions": _require_directions,
    "noise": _require_noise,
    "candidates": _of_kind("be a list of candidates", lambda x: isinstance(x, Sequence) and not isinstance(x, str)),
    "channels": _of_kind("be a list of channels, by name or as a Quantity", _are_channels),
    "output": _of_kind("be the name of a coordinate, such as body.crank.angle, or a Coordinate", _is_coordinate),
    "guesses": require_finite,
    "tol": partial(require_number, sign="not negative"),
    "loss": _of_kind(
        'be a name, such as "huber", or a function', lambda x: isinstance(x, str) or (callable(x) and not isclass(x))
    ),
    "client": _of_kind("be a dask.distributed.Client, or None", _has("submit")),
    "optimizer": _of_kind("be an optax optimizer, or None", lambda x: _has("init")(x) and _has("update")(x)),
    "method": _check_thresholds,
    "stabilization": _check_thresholds,
    "t": require_number,
    "ts": require_times,
    "q": require_coordinates,
    "v": require_coordinates,
    "state": _check_state,
    "solution": require_history,
    "motion": require_history,
    "analysis": _check_analysis,
    "rtol": partial(require_number, sign="not negative"),
    "atol": partial(require_number, sign="not negative"),
    "drift_tol": partial(require_number, sign="positive", infinite=True),
    "rank_tol": partial(require_number, sign="not negative"),
    "time_tol": partial(require_number, sign="positive"),
    "dt": partial(require_number, sign="positive"),
    "dt0": partial(require_number, sign="positive"),
    "max_steps": require_count,
    "max_events": require_count,
    "starts": require_count,
    "seed": partial(require_count, least=0),
    "values": require_finite,
    "axes": _require_mapping,
    "units": _require_units,
    "rate": _require_rate,
    "acceleration": _require_rate,
    "value": require_number,
    "length": partial(require_number, sign="positive"),
    "angle": require_number,
    "angular_velocity": require_number,
    "held": require_numbers_by_name,
    "inputs": _require_mapping,
    "weights": require_numbers_by_name,
    "compliances": _require_arrays_by_name,
    "point": _require_point,
    "bodies": _of_kind("be the name of a body, or a list of names", lambda x: isinstance(x, str) or are_names(x)),
    "solver": _check_solver,
    "stepsize_controller": _check_controller,
    "adjoint": _of_diffrax("AbstractAdjoint", "diffrax.ForwardMode()"),
}
