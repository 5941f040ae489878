"""An MJCF model in its plane: moving bodies, and their motions for values of the joints. Points are complex numbers x + iy."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mjcf.body_tree import BodyTree, TreeGeom, TreeJoint, unique_name
from udkjax.scene.mjcf.geom_masses import sum_masses
from udkjax.scene.mjcf.model_settings import merge_parts
from udkjax.scene.mjcf.xml_tree import XmlElement

AXES_TOL = 1e-6  # rad; tolerance of axes relative to the plane's normal, because files have seven digits


class MotionPlane(NamedTuple):
    """A plane through the origin of the world: its x and y axes, and the normal about which angles are anticlockwise."""

    across: np.ndarray  # (3,)
    up: np.ndarray  # (3,)
    normal: np.ndarray  # (3,)

    def flat(self, vector: np.ndarray) -> complex:
        """Return the projection of a point or a vector onto the plane."""
        return complex(vector @ self.across, vector @ self.up)


class PlaneMotion(NamedTuple):
    """Displacement of a body in the plane from its position in the file, and its velocity."""

    angle: float = 0.0  # rad
    shift: complex = 0j  # m; a point z is at exp(i angle) z + shift
    omega: float = 0.0  # rad/s
    rate: complex = 0j  # m/s; its velocity is rate + i omega times its position

    def point(self, z: complex) -> complex:
        """Return the position (m) of the point of the body that is at z in the position of the file."""
        return np.exp(1j * self.angle) * z + self.shift

    def velocity(self, z: complex) -> complex:
        """Return the velocity (m/s) of the body at its point whose current position is z."""
        return self.rate + 1j * self.omega * z

    def turn(self, anchor: complex, angle: float, rate: float) -> "PlaneMotion":
        """Return the motion after a further turn about a point of the body, which is at `anchor` in the position of the file.

        The turn has an angle (rad) and a rate (rad/s).
        """
        position, new_angle = self.point(anchor), self.angle + angle
        shift = position - np.exp(1j * new_angle) * anchor
        return PlaneMotion(new_angle, shift, self.omega + rate, self.rate - 1j * rate * position)

    def slide(self, direction: complex, distance: float, rate: float) -> "PlaneMotion":
        """Return the motion after a further slide by a distance (m), with a rate (m/s).

        The direction turns with the body; it is given in the position of the file.
        """
        now = np.exp(1j * self.angle) * direction
        return self._replace(shift=self.shift + distance * now, rate=self.rate + rate * now)


def plane_of(joints: Sequence[TreeJoint], gravity: np.ndarray) -> MotionPlane:
    """Return the plane in which all joints move, and refuse joints that leave it.

    Its y axis is the world's z axis, or the y axis if the plane is horizontal; its x axis has a positive component along the
    world's x axis, or else along y.
    """
    hinges, slides = ([joint.axis for joint in joints if joint.kind == kind] for kind in ("hinge", "slide"))
    across = (
        [np.cross(slides[0], vector) for vector in (*slides[1:], gravity, np.array([0.0, 0.0, 1.0]), np.eye(3)[0])]
        if slides
        else []
    )
    normal = next((v for v in (*hinges, *across) if np.linalg.norm(v) > AXES_TOL), np.array([0.0, -1.0, 0.0]))
    normal = normal / np.linalg.norm(normal)
    is_horizontal = np.hypot(normal[0], normal[1]) < AXES_TOL
    up = np.eye(3)[1 if is_horizontal else 2]
    up = up - (up @ normal) * normal
    up = up / np.linalg.norm(up)
    x = np.cross(up, normal)
    if x[0 if abs(x[0]) > AXES_TOL else 1] < 0:
        x, normal = -x, -normal
    for joint in joints:
        deviation = np.linalg.norm(np.cross(joint.axis, normal)) if joint.kind == "hinge" else abs(joint.axis @ normal)
        if deviation > AXES_TOL:
            numbers = " ".join(f"{v:.4g}" for v in normal)
            joint.read.refuse(
                f"leaves the plane in which the other joints move, whose normal is {numbers}: the model is not planar"
            )
    return MotionPlane(x, up, normal)


Pair = tuple[float, float]


class PlaneBody(NamedTuple):
    """A moving body, in the position of the file."""

    name: str
    centre: complex  # m
    angle: float  # rad
    mass: float  # kg
    inertia: float  # kg m^2


class Ends(NamedTuple):
    """Two points of two bodies, and their distance (m) in the position of the file."""

    bodies: tuple[int, int]
    points: tuple[complex, complex]

    @property
    def distance(self) -> float:
        """Distance between the points (m)."""
        return abs(self.points[1] - self.points[0])


class PlaneModel:
    """The bodies of a tree that have joints, by index; 0 is the ground."""

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
            angle = float(np.angle(side)) if abs(side) > 0.5 else 0.0  # arbitrary for a frame perpendicular to the plane
            name = unique_name(body.name, {b.name for b in self.bodies.values()})
            self.bodies[k] = PlaneBody(name, plane.flat(centre), angle, mass, inertia)
        places = [plane.flat(joint.anchor) for joint in tree.joints.values()] + [b.centre for b in self.bodies.values()]
        self.size = max(abs(z - places[0]) for z in places) or 1.0  # m

    @property
    def joints(self) -> list[TreeJoint]:
        """The joints, in the order of the model's coordinates."""
        return [joint for body in self.tree.bodies for joint in body.joints]

    def holder(self, body: int) -> int:
        """Return the index of the moving body (or the ground) that holds a body."""
        return self.tree.hosts[self.tree.bodies[body].parent]

    def has_rod(self, body: int) -> bool:
        """Return True if a body is held by two hinges, with a massless rod between them."""
        return [joint.kind for joint in self.tree.bodies[body].joints] == ["hinge", "hinge"]

    def local(self, body: int, point: complex) -> Pair:
        """Return a point of the plane in the frame of a body (m)."""
        z = (point - self.bodies[body].centre) * np.exp(-1j * self.bodies[body].angle)
        return float(z.real), float(z.imag)

    def direction(self, body: int, axis: complex) -> float:
        """Return the angle (rad) of a direction in the frame of a body."""
        return float(np.angle(axis * np.exp(-1j * self.bodies[body].angle)))

    def names(self, bodies: Sequence[int]) -> tuple[str, ...]:
        """Return the names that bodies have in the mechanism, by their indices."""
        return tuple(self.bodies[body].name for body in bodies)

    def attached(self, ends: Ends) -> tuple[tuple[str, ...], list[Pair]]:
        """Return the names of two bodies, and the points in their frames (m)."""
        return self.names(ends.bodies), [self.local(body, point) for body, point in zip(*ends, strict=True)]

    def relative_angle(self, body1: int, body2: int) -> float:
        """Return the angle (rad) of body 2 relative to body 1."""
        return self.bodies[body2].angle - self.bodies[body1].angle

    def sign(self, joint: TreeJoint) -> float:
        """Return 1 if a hinge is anticlockwise positive in the plane, otherwise -1."""
        return float(np.sign(joint.axis @ self.plane.normal))

    def reference(self, joint: TreeJoint, name: str = "ref") -> float:
        """Return the value (rad, m) of a joint in the position of the file (`ref`), or at which its spring is unloaded."""
        return joint.read.number(name) * (self.tree.settings.radians if joint.kind == "hinge" else 1.0)

    def motions(self, values: Mapping[str, float], rates: Mapping[str, float]) -> dict[int, PlaneMotion]:
        """Return the motions of bodies, by index, for values and rates of joints by name.

        By default joints have their values in the file, and zero rates.
        """
        by_body = {0: PlaneMotion()}
        for k, body in self.tree.moving():
            motion = by_body[self.holder(k)]
            for joint in body.joints:
                displacement = values.get(joint.name, self.reference(joint)) - self.reference(joint)
                rate = rates.get(joint.name, 0.0)
                if joint.kind == "hinge":
                    motion = motion.turn(self.plane.flat(joint.anchor), self.sign(joint) * displacement, self.sign(joint) * rate)
                else:
                    motion = motion.slide(self.plane.flat(joint.axis), displacement, rate)
            by_body[k] = motion
        return by_body

    def named_joints(self) -> Iterator[tuple[str, int, list[TreeJoint]]]:
        """Iterate over moving bodies: the name of the joint (its last hinge, if it has one), the body's index, its joints."""
        for k, body in self.tree.moving():
            hinges = [joint.name for joint in body.joints if joint.kind == "hinge"]
            yield (hinges or [body.joints[0].name])[-1], k, body.joints


def gap_of(ends: Ends, motions: Mapping[int, PlaneMotion]) -> float:
    """Return the distance between two points (m) after motions of their bodies."""
    point1, point2 = (motions[body].point(point) for body, point in zip(*ends, strict=True))
    return abs(point2 - point1)


def contact_pairs(root: XmlElement, tree: BodyTree, plane: MotionPlane) -> list[str]:
    """Return the pairs of geoms between which MuJoCo looks for contacts, in words.

    Pairs are left out if they belong to one body or to a body and its holder, are excluded, cannot move relative to each other,
    or have bounding spheres that are separate along the normal of the plane.
    """
    elements = merge_parts(root, ("contact",)).children
    excluded = [
        {element.attributes.get("body1", ""), element.attributes.get("body2", "")}
        for element in elements
        if element.tag == "exclude"
    ]
    pairs = [f"{p.attributes.get('geom1')} and {p.attributes.get('geom2')}" for p in elements if p.tag == "pair"]
    for geom1, geom2 in combinations(tree.geoms, 2):
        a, b = tree.hosts[geom1.body], tree.hosts[geom2.body]
        is_held = b and a == tree.hosts[tree.bodies[b].parent], a and b == tree.hosts[tree.bodies[a].parent]
        is_apart = abs((geom1.centre - geom2.centre) @ plane.normal) > geom1.reach + geom2.reach
        names = {tree.bodies[geom1.body].name, tree.bodies[geom2.body].name}
        if a != b and not (a and b and any(is_held)) and _may_collide(geom1, geom2) and not is_apart and names not in excluded:
            pairs.append(f"{geom1.name} and {geom2.name}")
    return pairs


def _may_collide(geom1: TreeGeom, geom2: TreeGeom) -> bool:
    return bool(geom1.types[0] & geom2.types[1] or geom2.types[0] & geom1.types[1])
