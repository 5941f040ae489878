"""The arm of an excavator: an open chain of three bodies, the last one driven through a four-bar. SI units, radians."""

from collections.abc import Sequence
from typing import Annotated

import numpy as np

from udkjax.annotations import NumberLike, Numbers
from udkjax.argument_types import several
from udkjax.arrays import array_namespace
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Frame, between
from udkjax.scene.elements.drivers import Driver, Sine
from udkjax.scene.elements.forces import Spring
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.library.posed_bodies import (
    apex,
    as_array,
    bar_pose,
    bodies_on_pose,
    gravity_vector,
    uniform_rod,
    value_and_rate,
    with_concrete_numbers,
)
from udkjax.scene.mechanism import Mechanism

# Points of each body in units of its length; the origin is its first pin, and the x axis points towards its last pin.
BOOM = {"centre": (0.44, 0.09), "foot": (0.0, 0.0), "tip": (1.0, 0.0), "cylinder": (0.44, 0.12), "stick cylinder": (0.52, 0.20)}
STICK = {"centre": (0.35, 0.05), "tip": (0.0, 0.0), "rocker": (0.855, 0.02), "bucket": (1.0, 0.0)}
STICK |= {"cylinder": (-0.22, 0.10), "bucket cylinder": (0.05, 0.20)}
BUCKET = {"centre": (0.45, 0.20), "bucket": (0.0, 0.0), "link": (-0.13, 0.28)}
# Pin of the boom's cylinder on the ground, relative to the boom's foot, in units of the boom's length.
CYLINDER_BASE = (0.13, -0.09)


@with_concrete_numbers
def excavator(
    angles: Annotated[Sequence[NumberLike], several(3)] = (0.6, -1.1, -2.2),
    angular_velocities: Annotated[Sequence[NumberLike], several(3)] = (-0.2, 0.3, 0.6),
    driven: bool = False,
    lengths: Annotated[Sequence[NumberLike], several(5, "positive")] = (5.7, 2.9, 0.62, 0.6, 1.45),
    masses: Annotated[Sequence[NumberLike], several(5, "positive")] = (1500.0, 750.0, 80.0, 60.0, 900.0),
    stiffness: Annotated[Sequence[NumberLike], several(3)] = (1.5e7, 1.2e7, 8e6),
    damping: Annotated[Sequence[NumberLike], several(3)] = (6e4, 4e4, 1e4),
    strokes: Annotated[Sequence[NumberLike], several(3)] = (0.3, -0.4, -0.3),
    frequencies: Annotated[Sequence[NumberLike], several(3)] = (0.6, 0.8, 1.1),
    gravity: NumberLike = 9.81,
) -> Mechanism:
    """Return the arm of an excavator of 20 t: boom, stick, rocker, link and bucket, 12 rows, three degrees of freedom.

    `angles` are those of boom, stick and bucket to the horizontal; rocker and link form a four-bar with stick and bucket, which
    determines their angles. `lengths` (m) and `masses` (kg) are in the order of the bodies; the bucket's length is from its pin
    to its teeth, and attachment points of cylinders scale with the lengths. Inertias are those of rods.

    By default the valves shut while the arm moves at `angular_velocities`, and the oil in the cylinders of boom, stick and bucket
    acts as springs of `stiffness` (N/m) and `damping` (N s/m), with lengths that put the arm in equilibrium at `angles`. If
    `driven`, the cylinders start at rest and extend by `strokes` / 2 (1 - cos(`frequencies` t)) (m, rad/s), and their forces
    are reactions. With the default numbers neither motion meets a singular configuration within 20 s.
    """
    boom, stick, rocker, link, bucket = lengths
    on_boom, on_stick, on_bucket = _points(BOOM, boom), _points(STICK, stick), _points(BUCKET, bucket)
    on_rocker, on_link = ((k * np.array([-0.5, 0.0]), k * np.array([0.5, 0.0])) for k in (rocker, link))
    names = ("boom", "stick", "rocker", "link", "bucket")
    cylinders = {
        "boom cylinder": ((GROUND, "boom"), (boom * np.array(CYLINDER_BASE), on_boom["cylinder"])),
        "stick cylinder": (("boom", "stick"), (on_boom["stick cylinder"], on_stick["cylinder"])),
        "bucket cylinder": (("stick", "rocker"), (on_stick["bucket cylinder"], on_rocker[1])),
    }

    def pose(s):
        boom_pose = _pose_from_point(on_boom["foot"], np.zeros(2), s[0])
        stick_pose = _pose_from_point(on_stick["tip"], _world_point(boom_pose, on_boom["tip"]), s[1])
        bucket_pose = _pose_from_point(on_bucket["bucket"], _world_point(stick_pose, on_stick["bucket"]), s[2])
        start, end = _world_point(stick_pose, on_stick["rocker"]), _world_point(bucket_pose, on_bucket["link"])
        knee = apex(start, end, rocker, link)
        return [boom_pose, stick_pose, bar_pose(start, knee), bar_pose(knee, end), bucket_pose]

    def extents_and_energy(s):
        """Return the lengths of the cylinders (m) and the potential energy of the weights (J)."""
        poses = pose(s)
        frames = {GROUND: GROUND_FRAME} | {name: Frame.at(*pose_of_body) for name, pose_of_body in zip(names, poses, strict=True)}
        vectors = [between(points, *(frames[n] for n in pair)) for pair, points in cylinders.values()]
        energy = gravity * sum(mass * position[1] for mass, (position, _) in zip(masses, poses, strict=True))
        squares = as_array([vector.dot(vector) for vector in vectors])
        return array_namespace(squares).sqrt(squares), energy

    # Free minus actual length of each cylinder, by the principle of virtual work over the three angles.
    start = as_array(angles)
    values, rates = zip(*(value_and_rate(extents_and_energy, start, direction) for direction in np.eye(3)), strict=True)
    length, virtual_work = values[0][0], as_array([energy for _, energy in rates])
    arms = as_array([extents for extents, _ in rates])
    shortening = array_namespace(arms, virtual_work).linalg.solve(arms, virtual_work) / as_array(stiffness)
    half_stroke = 0.5 * as_array(strokes)
    drivers = {
        name: Driver(pair, "distance", Sine(half_stroke[k], frequencies[k], -np.pi / 2, length[k] + half_stroke[k]), points)
        for k, (name, (pair, points)) in enumerate(cylinders.items())
    }
    springs = {
        name: Spring(pair, points, stiffness[k], length[k] + shortening[k], damping[k])
        for k, (name, (pair, points)) in enumerate(cylinders.items())
    }
    physics = [uniform_rod(mass, k) for mass, k in zip(masses, (boom, stick, rocker, link, bucket), strict=True)]
    return Mechanism(
        bodies_on_pose(names, physics, pose, start, 0.0 * start if driven else angular_velocities),
        {
            "foot": Revolute((GROUND, "boom"), [(0.0, 0.0), on_boom["foot"]]),
            "tip": Revolute(("boom", "stick"), [on_boom["tip"], on_stick["tip"]]),
            "rocker pin": Revolute(("stick", "rocker"), [on_stick["rocker"], on_rocker[0]]),
            "knee": Revolute(("rocker", "link"), [on_rocker[1], on_link[0]]),
            "link pin": Revolute(("link", "bucket"), [on_link[1], on_bucket["link"]]),
            "bucket pin": Revolute(("stick", "bucket"), [on_stick["bucket"], on_bucket["bucket"]]),
        },
        drivers if driven else {},
        {} if driven else springs,
        gravity=gravity_vector(gravity),
        name="excavator",
    )


def _points(places, length) -> dict[str, Numbers]:
    """Return the points of a body in its own frame, relative to its centre of mass."""
    return {name: length * (np.array(point) - np.array(places["centre"])) for name, point in places.items()}


def _world_point(body_pose, local):
    return as_array(Frame.at(*body_pose).point(local))


def _pose_from_point(local, point, angle):
    """Return the position of a body's centre of mass and its angle, given its angle and the position of one of its points."""
    return point - as_array(Frame.at((0.0, 0.0), angle).vector(local)), angle
