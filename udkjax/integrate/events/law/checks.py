"""Checks of the arguments of events: each error names the event, the argument, the given value and the allowed ones."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from udkjax.arrays import number
from udkjax.requirements import ArgumentTypeError, array, describe, require_finite, require_number
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Joint


def number_if_any(value: Any) -> Any:
    """Convert a number to an array leaf; return anything else unchanged, so that checks can report it."""
    try:
        return None if value is None else number(value)
    except (TypeError, ValueError):
        return value


def require_vector(name: str, value: Any) -> None:
    """Raise an error unless a point or a normal is two numbers, which are traced or finite."""
    found = array(name, value)
    if found.shape != (2,):
        raise ValueError(f"{name} must be two numbers, x and y, not an array of the shape {found.shape}")
    require_finite(name, found)


def require_normal(name: str, value: Any) -> None:
    """Raise an error unless a normal is two finite numbers, not both zero; values of traced numbers are not checked."""
    require_vector(name, value)
    if not isinstance(value, Tracer) and not np.any(np.asarray(value)):
        raise ValueError(f"{name} must not be zero: it points to the side that is allowed")


def require_restitution(name: str, value: Any) -> None:
    """Raise an error unless a restitution is one number, traced or from 0 to 1."""
    require_number(name, value)
    if not isinstance(value, Tracer) and not 0 <= float(value) <= 1:
        raise ValueError(f"{name} must be from 0 to 1, not {float(value):g}")


def require_friction(where: str, coefficient: Any, static_coefficient: Any, at_rest: str) -> None:
    """Raise `ValueError` if coefficients of friction are negative or contradict each other, or `at_rest` is not "hold"."""
    for name, value in (("coefficient", coefficient), ("static_coefficient", static_coefficient)):
        if value is None:
            continue
        require_number(f"{where}: {name}", value)
        if not isinstance(value, Tracer) and float(value) < 0:
            raise ValueError(f"{where}: {name} must not be negative, not {float(value):g}")
    for mistake in Friction.mistakes_of_coefficients(coefficient, static_coefficient):
        raise ValueError(f"{where}: {mistake}")
    if at_rest != "hold":
        raise ValueError(f'{where}: a contact with a coefficient of friction rests: at_rest="hold"')


def require_limits(where: str, lower: Any, upper: Any) -> None:
    """Raise an error if both limits of a joint's travel are missing, or they are not finite numbers in order, unless traced."""
    for name, limit in (("lower", lower), ("upper", upper)):
        if limit is not None:
            require_number(f"{where}: {name}", limit)
    if lower is None and upper is None:
        raise ValueError(f"{where}: give `lower` or `upper`, or both")
    if lower is None or upper is None or isinstance(lower, Tracer) or isinstance(upper, Tracer):
        return
    if float(lower) > float(upper):
        raise ValueError(f"{where}: lower = {float(lower):g} must not be above upper = {float(upper):g}")


def require_joint(name: str, value: object) -> None:
    """Raise an error unless an object to attach is a joint with finite numbers."""
    if not isinstance(value, Joint):
        raise ArgumentTypeError(f"{name} must be a joint, such as udk.Weld(...), {describe(value)}")
    for leaf in jax.tree.leaves(value):
        if isinstance(leaf, np.ndarray | jax.Array | float):
            require_finite(name, leaf)
