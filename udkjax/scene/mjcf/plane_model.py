"""An MJCF model in its plane: its moving bodies, and how far each is turned and shifted where joints have given values."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from udkjax.scene.bodies import GROUND
from udkjax.scene.mjcf.body_tree import BodyTree, TreeJoint, unique_name
from udkjax.scene.mjcf.geom_masses import sum_masses
from udkjax.scene.mjcf.motion_plane import MotionPlane, PlaneMotion

Pair = tuple[float, float]


class PlaneBody(NamedTuple):
    """A moving body, in the position in which the model is written down."""

    name: str
    centre: complex  # m
    angle: float  # rad
    mass: float  # kg
    inertia: float  # kg m^2


class Ends(NamedTuple):
    """Two points, of two bodies, and their distance (m) where the model is written down."""

    bodies: tuple[int, int]
    points: tuple[complex, complex]

    @property
    def distance(self) -> float:
        """Distance of one point from the other (m)."""
        return abs(self.points[1] - self.points[0])


class PlaneModel:
    """The bodies of a tree that have joints, by their numbers; number 0 is the ground."""

    def __init__(self, tree: BodyTree, plane: MotionPlane):
        self.tree, self.plane = tree, plane
        self.bodies = {0: PlaneBody(GROUND, 0j, 0.0, np.inf, np.inf)}
        wanted = tree.settings.total_mass
        everything = sum(mass.mass for host in set(tree.hosts) for mass in tree.masses_of(host))
        scale = wanted / everything if wanted > 0 and everything else 1.0
        for k, body in tree.moving():
            mass, centre, inertia = sum_masses(tree.masses_of(k), plane.normal)
            mass, inertia = scale * mass, scale * inertia
            if not (mass > 0 and inertia > 0):
                tree.settings.problems.append(f"{body.where}: must have mass and inertia, by its geoms or an <inertial>")
            side = plane.flat(body.frame.axes[:, 0])
            angle = float(np.angle(side)) if abs(side) > 0.5 else 0.0  # of a frame that stands across the plane: any will do
            name = unique_name(body.name, {b.name for b in self.bodies.values()})
            self.bodies[k] = PlaneBody(name, plane.flat(centre), angle, mass, inertia)
        places = [plane.flat(joint.anchor) for joint in tree.joints.values()] + [b.centre for b in self.bodies.values()]
        self.size = max(abs(z - places[0]) for z in places) or 1.0  # m

    @property
    def joints(self) -> list[TreeJoint]:
        """The joints in the order of the model's coordinates."""
        return [joint for body in self.tree.bodies for joint in body.joints]

    def holder(self, body: int) -> int:
        """Return the number of the moving body, or the ground, that a body hangs on."""
        return self.tree.hosts[self.tree.bodies[body].parent]

    def has_rod(self, body: int) -> bool:
        """Return whether a body hangs on two hinges, with a rod without mass between them."""
        return [joint.kind for joint in self.tree.bodies[body].joints] == ["hinge", "hinge"]

    def local(self, body: int, point: complex) -> Pair:
        """Return a point of the plane in the frame of a body (m)."""
        z = (point - self.bodies[body].centre) * np.exp(-1j * self.bodies[body].angle)
        return float(z.real), float(z.imag)

    def direction(self, body: int, axis: complex) -> float:
        """Return the angle (rad) of a direction in the frame of a body."""
        return float(np.angle(axis * np.exp(-1j * self.bodies[body].angle)))

    def names(self, bodies: Sequence[int]) -> tuple[str, ...]:
        """Return the names of bodies."""
        return tuple(self.bodies[body].name for body in bodies)

    def attached(self, ends: Ends) -> tuple[tuple[str, ...], list[Pair]]:
        """Return the names of two bodies, and the points in their frames (m)."""
        return self.names(ends.bodies), [self.local(body, point) for body, point in zip(*ends, strict=True)]

    def relative_angle(self, one: int, two: int) -> float:
        """Return the angle (rad) of body two against body one."""
        return self.bodies[two].angle - self.bodies[one].angle

    def sign(self, joint: TreeJoint) -> float:
        """Return 1 where a hinge turns anticlockwise, else -1."""
        return float(np.sign(joint.axis @ self.plane.normal))

    def reference(self, joint: TreeJoint, name: str = "ref") -> float:
        """Return the value (rad, m) of a joint where the model is written down, or where its spring is at rest."""
        return joint.read.number(name) * (self.tree.settings.radians if joint.kind == "hinge" else 1.0)

    def motions(self, values: Mapping[str, float], rates: Mapping[str, float]) -> dict[int, PlaneMotion]:
        """Return how far bodies have moved where joints have these values and rates, by default those of the model as written."""
        found = {0: PlaneMotion()}
        for k, body in self.tree.moving():
            motion = found[self.holder(k)]
            for joint in body.joints:
                way = values.get(joint.name, self.reference(joint)) - self.reference(joint)
                rate = rates.get(joint.name, 0.0)
                if joint.kind == "hinge":
                    motion = motion.turn(self.plane.flat(joint.anchor), self.sign(joint) * way, self.sign(joint) * rate)
                else:
                    motion = motion.slide(self.plane.flat(joint.axis), way, rate)
            found[k] = motion
        return found

    def named_joints(self) -> Iterator[tuple[str, int, list[TreeJoint]]]:
        """Iterate over moving bodies: the name of what holds each (its last hinge, if it has one), its number, its joints."""
        for k, body in self.tree.moving():
            hinges = [joint.name for joint in body.joints if joint.kind == "hinge"]
            yield (hinges or [body.joints[0].name])[-1], k, body.joints


def gap_of(ends: Ends, motions: Mapping[int, PlaneMotion]) -> float:
    """Return how far apart two points are (m) where bodies have moved."""
    one, two = (motions[body].point(point) for body, point in zip(*ends, strict=True))
    return abs(two - one)
