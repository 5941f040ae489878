"""Pendulums. SI units, radians."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import COUNT, POSITIVE, several
from udkjax.scene.elements.bodies import GROUND, Body
from udkjax.scene.elements.drivers import Driver, Sine
from udkjax.scene.elements.joints import Distance, Revolute
from udkjax.scene.library.posed_bodies import (
    ORIGINS,
    bodies_on_pose,
    gravity_vector,
    hanging_rod_pose,
    uniform_rod,
    unit_vector,
    with_concrete_numbers,
)
from udkjax.scene.mechanism import Mechanism


@with_concrete_numbers
def simple_pendulum(
    position: Annotated[Numbers, several(2)] = (-1.0, 0.0),
    velocity: Annotated[Numbers, several(2)] = (0.0, 0.0),
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return the IFToMM benchmark A01: a point mass on a massless rod from the origin to `position`.

    A body needs an inertia: 1 kg m^2, which has no effect, since the rod holds the bob at its centre.
    """
    bodies = {"bob": Body(mass, 1.0, position, velocity=velocity)}
    return Mechanism(bodies, {"rod": Distance((GROUND, "bob"), ORIGINS)}, gravity=gravity_vector(gravity), name="simple pendulum")


@with_concrete_numbers
def compound_pendulum(
    angle: NumberLike = np.pi / 3,
    angular_velocity: NumberLike = 0.0,
    length: Annotated[NumberLike, POSITIVE] = 1.5,
    mass: Annotated[NumberLike, POSITIVE] = 2.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a uniform rod pinned at one end; `angle` is measured from the downward vertical."""

    def pose(s):
        return [hanging_rod_pose(np.zeros(2), length, s)]

    return Mechanism(
        bodies_on_pose(("rod",), [uniform_rod(mass, length)], pose, angle, angular_velocity),
        {"pin": Revolute((GROUND, "rod"), [(0.0, 0.0), (-0.5 * length, 0.0)])},
        gravity=gravity_vector(gravity),
        name="compound pendulum",
    )


@with_concrete_numbers
def double_pendulum(
    angles: Annotated[Sequence[NumberLike], several(2)] = (np.pi / 2, np.pi / 2),
    angular_velocities: Annotated[Sequence[NumberLike], several(2)] = (0.0, 0.0),
    lengths: Annotated[Sequence[NumberLike], several(2, "positive")] = (1.0, 1.0),
    masses: Annotated[Sequence[NumberLike], several(2, "positive")] = (1.0, 1.0),
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a double pendulum of two uniform rods, which is chaotic; `angles` are measured from the downward vertical."""
    a, b = (0.5 * length for length in lengths)

    def pose(s):
        tip = 2 * hanging_rod_pose(np.zeros(2), 2 * a, s[0])[0]
        return [hanging_rod_pose(np.zeros(2), 2 * a, s[0]), hanging_rod_pose(tip, 2 * b, s[1])]

    physics = [uniform_rod(mass, length) for mass, length in zip(masses, lengths, strict=True)]
    return Mechanism(
        bodies_on_pose(("upper", "lower"), physics, pose, angles, angular_velocities),
        {
            "shoulder": Revolute((GROUND, "upper"), [(0.0, 0.0), (-a, 0.0)]),
            "elbow": Revolute(("upper", "lower"), [(a, 0.0), (-b, 0.0)]),
        },
        gravity=gravity_vector(gravity),
        name="double pendulum",
    )


@with_concrete_numbers
def driven_pendulum(
    amplitude: NumberLike = 0.8,
    frequency: NumberLike = 3.0,
    length: Annotated[NumberLike, POSITIVE] = 1.0,
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a uniform rod pinned at one end and driven to the angle `amplitude` sin(`frequency` t) from the x axis."""
    half = 0.5 * length

    def pose(s):
        return [(half * unit_vector(s), s)]

    return Mechanism(
        bodies_on_pose(("rod",), [uniform_rod(mass, length)], pose, 0.0, amplitude * frequency),
        {"pin": Revolute((GROUND, "rod"), [(0.0, 0.0), (-half, 0.0)])},
        {"motor": Driver((GROUND, "rod"), "angle", Sine(amplitude, frequency))},
        gravity=gravity_vector(gravity),
        name="driven pendulum",
    )


@with_concrete_numbers
def chain(
    n: Annotated[int, COUNT] = 10,
    angle: NumberLike = np.pi / 2,
    angular_velocity: NumberLike = 0.0,
    length: Annotated[NumberLike, POSITIVE] = 1.0,
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a chain of n uniform rods, suspended at one end: an n-fold pendulum.

    `length` and `mass` are those of the whole chain. The bodies, from the top, are link0, ..., all at the same `angle` from the
    downward vertical; the joints are pin0 (on the ground), pin1, ...
    """
    half = 0.5 * length / n

    def pose(s):
        first, angle = hanging_rod_pose(np.zeros(2), 2 * half, s)
        return [((2 * i + 1) * first, angle) for i in range(n)]

    names = [f"link{i}" for i in range(n)]
    ends = [((0.0, 0.0), (-half, 0.0))] + [((half, 0.0), (-half, 0.0))] * (n - 1)
    attached = zip([GROUND, *names[:-1]], names, strict=True)
    return Mechanism(
        bodies_on_pose(names, [uniform_rod(mass / n, 2 * half)] * n, pose, angle, angular_velocity),
        {f"pin{i}": Revolute(bodies, end) for i, (bodies, end) in enumerate(zip(attached, ends, strict=True))},
        gravity=gravity_vector(gravity),
        name=f"chain of {n} links",
    )
