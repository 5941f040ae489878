"""Nested frames in space in the forms of MJCF: quaternions, axis and angle, Euler angles, axes."""

from typing import NamedTuple

import numpy as np

from udkjax.scene.mjcf.xml_tree import AttributeReader

ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")


class SpaceFrame(NamedTuple):
    """A frame in space: the columns of `axes` are its x, y and z axes in world coordinates."""

    axes: np.ndarray  # (3, 3)
    origin: np.ndarray  # (3,) m

    def point(self, local: np.ndarray) -> np.ndarray:
        """Return the world coordinates (m) of a point that is given in this frame (m)."""
        return self.origin + self.axes @ local

    def within(self, child: "SpaceFrame") -> "SpaceFrame":
        """Return the frame in world coordinates of a frame `child` that is given relative to this one."""
        return SpaceFrame(self.axes @ child.axes, self.point(child.origin))


WORLD_FRAME = SpaceFrame(np.eye(3), np.zeros(3))


def frame_of(read: AttributeReader, radians: float, sequence: str) -> SpaceFrame:
    """Return the frame of an element in its parent's frame, from its `pos` and its orientation.

    Args:
        read: the element's attributes.
        radians: the unit of angles in the file (rad).
        sequence: the sequence of Euler angles, as in the compiler's `eulerseq`.
    """
    given = [name for name in ORIENTATIONS if name in read]
    if len(given) > 1:
        read.refuse(f"has several orientations: {', '.join(given)}")
    return SpaceFrame(_axes(read, given[0], radians, sequence) if given else np.eye(3), read.numbers("pos", (0.0, 0.0, 0.0)))


def _axes(read: AttributeReader, kind: str, radians: float, sequence: str) -> np.ndarray:
    size = {"quat": 4, "axisangle": 4, "xyaxes": 6, "zaxis": 3, "euler": 3}[kind]
    value = read.numbers(kind, np.full(size, np.nan))
    if np.isnan(value).any():
        return np.eye(3)
    vectors = {"quat": [value], "axisangle": [value[:3]], "xyaxes": [value[:3], value[3:]], "zaxis": [value], "euler": []}[kind]
    if not all(np.linalg.norm(vector) > 0 for vector in vectors):
        read.refuse(f"{kind}={read.text(kind)!r} has no direction")
        return np.eye(3)
    if kind == "quat":
        return _from_quaternion(value)
    if kind == "axisangle":
        return turn_about(value[:3], value[3] * radians)
    if kind == "zaxis":
        return shortest_turn_of_z(value)
    if kind == "xyaxes":
        x = value[:3] / np.linalg.norm(value[:3])
        y = value[3:] - (value[3:] @ x) * x
        y = y / np.linalg.norm(y)
        return np.column_stack([x, y, np.cross(x, y)])
    axes = np.eye(3)
    for letter, angle in zip(sequence, value * radians, strict=True):
        turn = turn_about(np.eye(3)["xyz".index(letter.lower())], angle)
        axes = axes @ turn if letter.islower() else turn @ axes  # lower-case axes turn with the frame
    return axes


def _from_quaternion(value: np.ndarray) -> np.ndarray:
    w, x, y, z = value / np.linalg.norm(value)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation about an axis, a vector of any length, by an angle (rad)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def shortest_turn_of_z(direction: np.ndarray) -> np.ndarray:
    """Return the shortest rotation that turns the z axis into a direction, a vector of any length."""
    z = direction / np.linalg.norm(direction)
    axis = np.cross([0.0, 0.0, 1.0], z)
    sine = float(np.linalg.norm(axis))
    return turn_about(axis if sine > 0 else np.array([1.0, 0.0, 0.0]), float(np.arctan2(sine, z[2])))
