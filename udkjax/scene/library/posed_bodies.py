"""Poses, and bodies that move with them, for the mechanisms of the library.

Each mechanism starts closed, with velocities that satisfy its constraints: its pose q(s) is a function of one coordinate s, and
the velocity is the derivative of the pose times the rate of s. The derivative is computed by NumPy, without compiling anything,
or by JAX if a number of the pose is traced. Therefore poses use the functions of `array_namespace` of their numbers.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import signature
from typing import ParamSpec, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PyTree

from udkjax.arrays import array_namespace, number
from udkjax.programs.deferred import deferred
from udkjax.requirements import ArgumentError
from udkjax.scene.arguments import bind_arguments, checked
from udkjax.scene.elements.bodies import Body
from udkjax.scene.mechanism import Mechanism

ORIGINS = ((0.0, 0.0), (0.0, 0.0))  # the centres of mass of two bodies, as points of a joint
P = ParamSpec("P")
OneOrMore: TypeAlias = ArrayLike | Sequence[ArrayLike]  # one number or several
COMPLEX_STEP = 1e-100  # the square is negligible relative to 1, and products with a rate are not denormal


def with_concrete_numbers(build: Callable[P, Mechanism]) -> Callable[P, Mechanism]:
    """Return a function of the library that checks its arguments and passes numbers that are not traced as NumPy arrays."""
    parameters, build_deferred = signature(build), deferred(build, keeps_concrete=True)

    @wraps(build)
    def build_with_concrete_numbers(*arguments: P.args, **named: P.kwargs) -> Mechanism:
        bound = bind_arguments(build.__name__, parameters, arguments, named)
        bound.apply_defaults()
        for name, value in bound.arguments.items():
            if not isinstance(parameters.parameters[name].default, int):  # counts and switches are passed unchanged
                bound.arguments[name] = jax.tree.map(_as_concrete, value)
        return build_deferred(*bound.args, **bound.kwargs)

    return checked(build_with_concrete_numbers)


def _as_concrete(value: ArrayLike) -> ArrayLike:
    return value if isinstance(value, Tracer) else np.asarray(value, float)


def value_and_rate(function: Callable[..., PyTree], s: ArrayLike, rate: OneOrMore) -> tuple[PyTree, PyTree]:
    """Return the value of a function at s, and its rate of change for a given rate of s.

    The rate is exact up to rounding. It is computed by JAX if a number is traced, otherwise by a complex step in NumPy.

    Source: Squire and Trapp, Using complex variables to estimate derivatives of real functions, SIAM Review 40, 1998.
    """
    value = function(s)
    if array_namespace(s, value) is jnp:
        return jax.jvp(function, (number(s),), (number(rate),))
    axes = np.eye(np.size(s)).reshape(-1, *np.shape(s))
    slopes = [jax.tree.map(np.imag, function(s + 1j * COMPLEX_STEP * axis)) for axis in axes]
    rates = [component / COMPLEX_STEP for component in as_array(rate).ravel()]
    return value, jax.tree.map(
        lambda *partials: sum(slope * component for slope, component in zip(partials, rates, strict=True)), *slopes
    )


def bodies_on_pose(
    names: Sequence[str], physics: Sequence[tuple], pose: Callable, s: OneOrMore, rate: OneOrMore
) -> dict[str, Body]:
    """Return bodies by name at the poses pose(s) = [(position, angle), ...], with velocities that follow from the rate of s.

    `physics` has the mass and the inertia of each.
    """
    poses, rates = value_and_rate(pose, as_array(s), rate)
    bodies = zip(names, physics, poses, rates, strict=True)
    return {name: Body(mass, inertia, *body_pose, *body_rate) for name, (mass, inertia), body_pose, body_rate in bodies}


def as_array(numbers: OneOrMore) -> Array | np.ndarray:
    """Return an array of one number or several: a JAX array if any of them is one, otherwise a NumPy array."""
    return array_namespace(numbers).asarray(numbers)


def uniform_rod(mass, length) -> tuple:
    """Return the mass, and the moment of inertia about the centre, of a uniform rod."""
    return mass, mass * length**2 / 12


def uniform_disc(mass, radius) -> tuple:
    """Return the mass, and the moment of inertia about the centre, of a uniform disc."""
    return mass, mass * radius**2 / 2


def unit_vector(angle):
    """Return the unit vector at an angle to the x axis."""
    xp = array_namespace(angle)
    return as_array([xp.cos(angle), xp.sin(angle)])


def bar_pose(start, end):
    """Return the position of the centre, and the angle, of a bar between two points."""
    return 0.5 * (start + end), _angle_of(end - start)


def _angle_of(vector):
    x, y = vector
    angle = array_namespace(x, y).arctan2(y.real, x.real)
    if not isinstance(x, complex | np.complexfloating):
        return angle
    return angle + 1j * (x.real * y.imag - y.real * x.imag) / (x.real**2 + y.real**2)  # derivative of the arc tangent


def hanging_rod_pose(pivot, length, angle):
    """Return the position of the centre, and the angle from the x axis, of a rod that hangs from a pivot.

    `angle` is measured from the downward vertical.
    """
    xp = array_namespace(angle)
    return pivot + 0.5 * length * as_array([xp.sin(angle), -xp.cos(angle)]), angle - np.pi / 2


def apex(start, end, a, b):
    """Return the point at distances a from start and b from end, to the left of the line from start to end."""
    xp = array_namespace(start, end, a, b)
    base = end - start
    square = base @ base
    x = (square + a**2 - b**2) / (2 * square)
    height = a**2 / square - x**2
    if xp is np and height.real < 0:
        distance = np.sqrt(square.real)
        raise ArgumentError(f"links of {a:g} and {b:g} m cannot meet: their other ends are {distance:g} m apart in this position")
    y = xp.sqrt(height)
    return start + x * base + y * as_array([-base[1], base[0]])


def gravity_vector(gravity: ArrayLike) -> Float[Array, "2"]:
    """Return the acceleration of gravity as a vector along -y, from its magnitude."""
    return number([0.0, 0.0 - gravity])
