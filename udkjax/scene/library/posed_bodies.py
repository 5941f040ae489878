"""Poses, and bodies that move with them, for the mechanisms of the library.

Each mechanism starts closed, with velocities that its constraints allow: its pose q(s) is written over one coordinate s, and
the velocity is the pose's derivative times the rate of s.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from udkjax.scene.bodies import Body
from udkjax.scene.fields import Numbers, number
from udkjax.scene.mechanism import Mechanism

ORIGINS = ((0.0, 0.0), (0.0, 0.0))
P = ParamSpec("P")
COMPILED_BODIES = 32  # bodies whose motion is compiled as a whole


def known_at_once(build: Callable[P, Mechanism]) -> Callable[P, Mechanism]:
    """Make a mechanism whose arguments are known of known numbers, also while something else is traced."""

    @wraps(build)
    def made(*arguments: P.args, **named: P.kwargs) -> Mechanism:
        if any(isinstance(x, Tracer) for x in jax.tree.leaves((arguments, named))):
            return build(*arguments, **named)
        with jax.ensure_compile_time_eval():
            return build(*arguments, **named)

    return made


def bodies_on_pose(names: Sequence[str], physics: Sequence[tuple], pose: Callable, s: Numbers, rate: Numbers) -> dict[str, Body]:
    """Make the bodies of the (mass, inertia)s, at the [(position, angle), ...] of pose(s), moving as s does at its rate."""

    def motion(s, rate):
        return jax.jvp(pose, (s,), (rate,))

    # By itself each operation is a program to compile, of which large mechanisms need no more than small ones.
    places, rates = (jax.jit(motion) if len(names) <= COMPILED_BODIES else motion)(number(s), number(rate))
    bodies = zip(names, physics, places, rates, strict=True)
    return {name: Body(mass, inertia, *place, *speed) for name, (mass, inertia), place, speed in bodies}


def uniform_rod(mass: ArrayLike, length: ArrayLike) -> tuple:
    """Return mass and inertia of a uniform rod."""
    return number(mass), number(mass * length**2 / 12)


def uniform_disc(mass: ArrayLike, radius: ArrayLike) -> tuple:
    """Return mass and inertia of a uniform disc."""
    return number(mass), number(mass * radius**2 / 2)


def bar_pose(start, end):
    """Return position and angle of a bar between two points."""
    along = end - start
    return 0.5 * (start + end), jnp.arctan2(along[1], along[0])


def hanging_rod_pose(pivot, length, angle):
    """Return position and angle of a rod that hangs from a point, at an angle from straight down."""
    return pivot + 0.5 * length * jnp.array([jnp.sin(angle), -jnp.cos(angle)]), angle - np.pi / 2


def apex(start, end, a, b):
    """Return the point at distances a from start and b from end, to the left of the way from start to end."""
    along = end - start
    square = along @ along
    x = (square + a**2 - b**2) / (2 * square)
    y = jnp.sqrt(a**2 / square - x**2)
    return start + x * along + y * jnp.stack([-along[1], along[0]])


def gravity_vector(gravity: ArrayLike) -> Float[Array, "2"]:
    """Return the acceleration of gravity along -y."""
    return number([0.0, 0.0 - gravity])
