"""Larger mechanisms: a straight-line linkage, a planetary gear. SI units, radians."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from udkjax.annotations import NumberLike
from udkjax.argument_types import COUNT, POSITIVE, several
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Gear
from udkjax.scene.elements.joints import Joint, Revolute
from udkjax.scene.library.posed_bodies import (
    ORIGINS,
    apex,
    bar_pose,
    bodies_on_pose,
    gravity_vector,
    uniform_disc,
    uniform_rod,
    unit_vector,
    with_concrete_numbers,
)
from udkjax.scene.mechanism import Mechanism


@with_concrete_numbers
def peaucellier(
    angle: NumberLike = np.pi / 6,
    angular_velocity: NumberLike = 0.0,
    crank: Annotated[NumberLike, POSITIVE] = 0.6,
    arm: Annotated[NumberLike, POSITIVE] = 2.0,
    side: Annotated[NumberLike, POSITIVE] = 1.2,
    density: Annotated[NumberLike, POSITIVE] = 1.0,
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return the Peaucellier-Lipkin linkage, which converts a rotation to an exact straight line.

    Two arms from O = (0, 0) hold the corners A and B of a rhombus of `side`; the crank, pivoted at Q = (`crank`, 0), moves its
    corner C on a circle through O; the opposite corner D then moves on the line x = (arm^2 - side^2) / (2 crank). A pin of three
    bars is two revolutes. Bars are uniform, `density` in kg/m; `gravity` acts along +x, so that the linkage hangs. Arms and
    sides are collinear, a singular configuration, at |angle| = 2 acos((arm - side) / (2 crank)): 96 degrees by default.
    """
    r, a, b = crank, arm, side

    def pose(s):
        o, q = np.zeros(2), r * np.array([1.0, 0.0])
        c = q + r * unit_vector(s)
        upper, lower = apex(o, c, a, b), apex(c, o, b, a)
        d = upper + lower - c
        return [bar_pose(*ends) for ends in ((q, c), (o, upper), (o, lower), (c, upper), (c, lower), (upper, d), (lower, d))]

    names = ("crank", "armA", "armB", "CA", "CB", "AD", "BD")
    lengths = (r, a, a, b, b, b, b)
    ends = {name: ((-0.5 * length, 0.0), (0.5 * length, 0.0)) for name, length in zip(names, lengths, strict=True)}

    def pin(bar1, end1, bar2, end2):
        return Revolute((bar1, bar2), [ends[bar1][end1], ends[bar2][end2]])

    joints = {
        "Q": Revolute((GROUND, "crank"), [(r, 0.0), ends["crank"][0]]),
        "O1": Revolute((GROUND, "armA"), [(0.0, 0.0), ends["armA"][0]]),
        "O2": Revolute((GROUND, "armB"), [(0.0, 0.0), ends["armB"][0]]),
        "C1": pin("crank", 1, "CA", 0),
        "C2": pin("crank", 1, "CB", 0),
        "A1": pin("armA", 1, "CA", 1),
        "A2": pin("armA", 1, "AD", 0),
        "B1": pin("armB", 1, "CB", 1),
        "B2": pin("armB", 1, "BD", 0),
        "D": pin("AD", 1, "BD", 1),
    }
    bodies = bodies_on_pose(names, [uniform_rod(density * k, k) for k in lengths], pose, angle, angular_velocity)
    return Mechanism(bodies, joints, gravity=[gravity, 0.0], name="Peaucellier-Lipkin linkage")


@with_concrete_numbers
def planetary_gear(
    planets: Annotated[int, COUNT] = 3,
    angular_velocity: NumberLike = 1.0,
    sun: Annotated[NumberLike, POSITIVE] = 0.2,
    planet: Annotated[NumberLike, POSITIVE] = 0.1,
    masses: Annotated[Sequence[NumberLike], several(3, "positive")] = (4.0, 1.0, 2.0),
    gravity: NumberLike = 0.0,
) -> Mechanism:
    """Return a planetary gear with a fixed ring: `planets` planets on a carrier mesh with the sun and the ring.

    `sun` and `planet` are radii; the ring's radius is sun + 2 planet. `angular_velocity` is the sun's; `masses` are those of sun,
    planet (discs) and carrier (a disc up to the planets' centres). One degree of freedom; 4 + 4 planets rows, of which
    planets - 1 are redundant. By default it lies flat, without `gravity`.
    """
    r, p = sun, planet
    ring, reach = r + 2 * p, r + p
    angles = [2 * np.pi * i / planets for i in range(planets)]

    def pose(s):
        carrier_angle = s * r / (r + ring)
        spin = carrier_angle - (s - carrier_angle) * r / p
        centres = [(reach * unit_vector(carrier_angle + angle), spin) for angle in angles]
        return [(np.zeros(2), s), *centres, (np.zeros(2), carrier_angle)]

    joints: dict[str, Joint] = {
        "sun axle": Revolute((GROUND, "sun"), ORIGINS),
        "carrier axle": Revolute((GROUND, "carrier"), ORIGINS),
    }
    for i, angle in enumerate(angles):
        name = f"planet{i + 1}"
        joints[f"axle{i + 1}"] = Revolute(("carrier", name), [(reach * np.cos(angle), reach * np.sin(angle)), (0.0, 0.0)])
        joints[f"sun mesh{i + 1}"] = Gear(("sun", name), [r, p], carrier="carrier")
        joints[f"ring mesh{i + 1}"] = Gear((GROUND, name), [ring, p], internal=True, carrier="carrier")
    physics = [uniform_disc(masses[0], r), *[uniform_disc(masses[1], p)] * planets, uniform_disc(masses[2], reach)]
    names = ("sun", *(f"planet{i + 1}" for i in range(planets)), "carrier")
    return Mechanism(
        bodies_on_pose(names, physics, pose, 0.0, angular_velocity),
        joints,
        gravity=gravity_vector(gravity),
        name="planetary gear",
    )
