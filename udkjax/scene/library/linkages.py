"""Linkages with one degree of freedom, including the paper's. SI units, radians."""

from typing import Annotated

import numpy as np

from udkjax.annotations import NumberLike
from udkjax.argument_types import COUNT, POSITIVE
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute, Slot
from udkjax.scene.library.posed_bodies import (
    bodies_on_pose,
    gravity_vector,
    uniform_rod,
    unit_vector,
    with_concrete_numbers,
)
from udkjax.scene.mechanism import Mechanism


@with_concrete_numbers
def parallelogram(
    angle: NumberLike = -np.pi / 4,
    angular_velocity: NumberLike = 0.0,
    length: Annotated[NumberLike, POSITIVE] = 1.0,
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    inertia: Annotated[NumberLike, POSITIVE] = 0.1,
    coupler_mass: Annotated[NumberLike, POSITIVE] = 2.0,
    coupler_inertia: Annotated[NumberLike, POSITIVE] = 0.2,
    gravity: NumberLike = 9.81,
    spacing: Annotated[NumberLike, POSITIVE] = 1.0,
) -> Mechanism:
    """Return the paper's five-bar parallelogram: three parallel links carry a coupler. 12 rows, rank 11, one degree of freedom.

    `length` (m) is the length of the links, and `spacing` (m) the distance of neighbouring pivots, on the ground and on the
    coupler: a parallelogram of another size needs both. Ground pivots are at (0, 0), (spacing, 0), (2 spacing, 0); `angle` and
    `angular_velocity` are those of the links. The bodies are link1, link2, link3 and coupler. The rows are those of A1, A2, A3
    (link minus ground), then of B1, B2, B3 (link minus coupler). The paper does not print the initial state: release from rest
    at -45 degrees is inferred from its tables.
    """

    across = spacing * np.array([1.0, 0.0])

    def pose(s):
        e = unit_vector(s)
        links = [(k * across + 0.5 * length * e, s) for k in range(3)]
        return [*links, (across + length * e, 0.0 * s)]

    links = ("link1", "link2", "link3")
    physics = [(mass, inertia)] * 3 + [(coupler_mass, coupler_inertia)]
    half = 0.5 * length
    return Mechanism(
        bodies_on_pose((*links, "coupler"), physics, pose, angle, angular_velocity),
        {f"A{i + 1}": Revolute((GROUND, link), [(i * spacing, 0.0), (-half, 0.0)]) for i, link in enumerate(links)}
        | {f"B{i + 1}": Revolute(("coupler", link), [((i - 1) * spacing, 0.0), (half, 0.0)]) for i, link in enumerate(links)},
        gravity=gravity_vector(gravity),
        name="five-bar parallelogram",
    )


@with_concrete_numbers
def n_four_bar(
    n: Annotated[int, COUNT] = 2, angle: NumberLike = np.pi / 2, angular_velocity: NumberLike = -1.0, gravity: NumberLike = 9.81
) -> Mechanism:
    """Return the IFToMM benchmark A02: n square four-bars in a row, which pass through singular configurations twice a turn.

    There are n + 1 links, link0, ..., on pivots (i, 0) at a common `angle`, and n couplers, coupler0, ...; all are uniform rods
    of 1 m and 1 kg. The rows are those of A0, ... (links on the ground), then, for each coupler, of Bi (its left end on link i)
    and Ci (its right end on link i + 1).
    """

    def pose(s):
        e = unit_vector(s)
        links = [(np.array([float(i), 0.0]) + 0.5 * e, s) for i in range(n + 1)]
        return links + [(np.array([i + 0.5, 0.0]) + e, 0.0 * s) for i in range(n)]

    names = [f"link{i}" for i in range(n + 1)] + [f"coupler{i}" for i in range(n)]
    joints = {f"A{i}": Revolute((GROUND, f"link{i}"), [(float(i), 0.0), (-0.5, 0.0)]) for i in range(n + 1)}
    for i in range(n):
        joints[f"B{i}"] = Revolute((f"link{i}", f"coupler{i}"), [(0.5, 0.0), (-0.5, 0.0)])
        joints[f"C{i}"] = Revolute((f"link{i + 1}", f"coupler{i}"), [(0.5, 0.0), (0.5, 0.0)])
    bodies = bodies_on_pose(names, [uniform_rod(1.0, 1.0)] * len(names), pose, angle, angular_velocity)
    return Mechanism(bodies, joints, gravity=gravity_vector(gravity), name=f"{n}-four-bar")


@with_concrete_numbers
def elliptic_trammel(
    angle: NumberLike = np.pi / 4,
    angular_velocity: NumberLike = 0.0,
    length: Annotated[NumberLike, POSITIVE] = 2.0,
    mass: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return a uniform rod whose end A slides on the y axis and whose end B slides on the x axis.

    The centre of mass is at length / 2 (cos `angle`, sin `angle`); the angle of the rod is -`angle`.
    """
    half = 0.5 * length

    def pose(s):
        return [(half * unit_vector(s), -s)]

    return Mechanism(
        bodies_on_pose(("rod",), [uniform_rod(mass, length)], pose, angle, angular_velocity),
        {
            "A": Slot((GROUND, "rod"), [(0.0, 0.0), (-half, 0.0)], axis=np.pi / 2),
            "B": Slot((GROUND, "rod"), [(0.0, 0.0), (half, 0.0)], axis=0.0),
        },
        gravity=gravity_vector(gravity),
        name="elliptic trammel",
    )
