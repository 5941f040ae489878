"""The plane in which a model moves, and motions in it as complex numbers: x + iy."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from udkjax.scene.mjcf.body_tree import TreeJoint

AXES_TOL = 1e-6  # rad; how far axes may be off the plane: files write directions with seven digits


class MotionPlane(NamedTuple):
    """A plane through the origin of the world: its own x and y, and the axis about which angles are anticlockwise."""

    across: np.ndarray  # (3,)
    up: np.ndarray  # (3,)
    normal: np.ndarray  # (3,)

    def flat(self, vector: np.ndarray) -> complex:
        """Return a point or a vector of the world in the plane."""
        return complex(vector @ self.across, vector @ self.up)


class PlaneMotion(NamedTuple):
    """Motion of a body in the plane from where it is written down, and its velocity."""

    angle: float = 0.0  # rad
    shift: complex = 0j  # m; a point z is at exp(i angle) z + shift
    omega: float = 0.0  # rad/s
    rate: complex = 0j  # m/s; that point moves with rate + i omega z

    def point(self, z: complex) -> complex:
        """Return where a point is (m)."""
        return np.exp(1j * self.angle) * z + self.shift

    def velocity(self, z: complex) -> complex:
        """Return the velocity (m/s) of what is at a point now."""
        return self.rate + 1j * self.omega * z

    def turn(self, anchor: complex, angle: float, rate: float) -> "PlaneMotion":
        """Return the motion after a turn about a point of the body (rad, rad/s)."""
        here, turned = self.point(anchor), self.angle + angle
        shift = here - np.exp(1j * turned) * anchor
        return PlaneMotion(turned, shift, self.omega + rate, self.rate - 1j * rate * here)

    def slide(self, direction: complex, way: float, rate: float) -> "PlaneMotion":
        """Return the motion after a slide along a direction of the body (m, m/s)."""
        now = np.exp(1j * self.angle) * direction
        return self._replace(shift=self.shift + way * now, rate=self.rate + rate * now)


def plane_of(joints: Sequence[TreeJoint], gravity: np.ndarray) -> MotionPlane:
    """Return the plane in which all joints move, and refuse those that leave it.

    Its y is the world's z, or y where it is level; its x has a positive component along the world's x, or else y.
    """
    hinges, slides = ([joint.axis for joint in joints if joint.kind == kind] for kind in ("hinge", "slide"))
    across = (
        [np.cross(slides[0], other) for other in (*slides[1:], gravity, np.array([0.0, 0.0, 1.0]), np.eye(3)[0])]
        if slides
        else []
    )
    normal = next((v for v in (*hinges, *across) if np.linalg.norm(v) > AXES_TOL), np.array([0.0, -1.0, 0.0]))
    normal = normal / np.linalg.norm(normal)
    level = np.hypot(normal[0], normal[1]) < AXES_TOL
    up = np.eye(3)[1 if level else 2]
    up = up - (up @ normal) * normal
    up = up / np.linalg.norm(up)
    x = np.cross(up, normal)
    if x[0 if abs(x[0]) > AXES_TOL else 1] < 0:
        x, normal = -x, -normal
    for joint in joints:
        off = np.linalg.norm(np.cross(joint.axis, normal)) if joint.kind == "hinge" else abs(joint.axis @ normal)
        if off > AXES_TOL:
            there = " ".join(f"{v:.4g}" for v in normal)
            joint.read.refuse(
                f"leaves the plane in which the other joints move, whose normal is {there}: the model is not planar"
            )
    return MotionPlane(x, up, normal)
