"""Mass, centre and inertia of MJCF geoms (spheres, capsules, cylinders, ellipsoids, boxes) and of <inertial>."""

from typing import NamedTuple

import numpy as np

from udkjax.scene.mjcf.orientations import SpaceFrame, shortest_turn_of_z
from udkjax.scene.mjcf.xml_tree import AttributeReader

SHAPE_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}  # number of sizes
WITHOUT_MASS = ("plane", "hfield", "mesh", "sdf")  # the first two are massless; the masses of the others are not computed
DEFAULT_DENSITY = 1000.0  # kg/m^3, the default density of MJCF


class SpaceMass(NamedTuple):
    """A mass in space."""

    mass: float  # kg
    centre: np.ndarray  # (3,) m, in world coordinates
    inertia: np.ndarray  # (3, 3) kg m^2 about the centre, in world axes

    def about(self, axis: np.ndarray, point: np.ndarray) -> float:
        """Return the moment of inertia (kg m^2) about the line through a point (m) in the direction of a unit vector `axis`."""
        arm = self.centre - point
        return float(axis @ self.inertia @ axis + self.mass * (arm @ arm - (arm @ axis) ** 2))


def inertial_mass(read: AttributeReader, frame: SpaceFrame) -> SpaceMass:
    """Return the mass given by <inertial>; `frame` is its frame in the world."""
    xx, yy, zz, xy, xz, yz = read.numbers("fullinertia", np.zeros(6))
    diagonal = read.numbers("diaginertia", (xx, yy, zz))
    local = np.diag(diagonal) + (0 if "diaginertia" in read else np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]]))
    if "mass" not in read or ("diaginertia" in read) == ("fullinertia" in read):
        read.refuse("needs a mass, and either diaginertia or fullinertia")
    return SpaceMass(read.number("mass"), frame.origin, frame.axes @ local @ frame.axes.T)


def geom_shape(read: AttributeReader, frame: SpaceFrame) -> tuple[str, np.ndarray, SpaceFrame]:
    """Return the kind of a geom, its sizes (3,) (m), and its frame in the world, given by its `pos` or `fromto`.

    `frame` is the frame of the geom, or if it has a `fromto`, the frame of these coordinates.
    """
    kind = read.choice("type", (*SHAPE_SIZES, *WITHOUT_MASS), "sphere")
    if kind not in SHAPE_SIZES:
        return kind, np.zeros(3), frame
    ends, count = None, SHAPE_SIZES[kind]
    if "fromto" in read and kind != "sphere":
        ends, count = read.numbers("fromto", np.zeros(6)).reshape(2, 3), 1
    size = read.numbers("size", np.zeros(3), fewest=count)
    if ends is not None:
        direction = ends[1] - ends[0]
        half = 0.5 * float(np.linalg.norm(direction))
        size = np.array([size[0], half, 0.0] if SHAPE_SIZES[kind] == 2 else [size[0], size[0], half])
        axes = shortest_turn_of_z(direction) if half > 0 else np.eye(3)
        frame = frame.within(SpaceFrame(axes, ends.mean(axis=0)))
    if not np.all(size[: SHAPE_SIZES[kind]] > 0):
        read.refuse(
            f"the sizes of a {kind} must be greater than zero, not {' '.join(f'{x:g}' for x in size[: SHAPE_SIZES[kind]])}"
        )
    return kind, size, frame


def geom_mass(read: AttributeReader, kind: str, size: np.ndarray, frame: SpaceFrame) -> SpaceMass | None:
    """Return the mass of a geom with a kind, sizes (m) and a frame in the world, as from `geom_shape`; None if it is massless."""
    if "mass" in read and not read.number("mass"):
        return None
    if kind not in SHAPE_SIZES:
        if kind in ("mesh", "sdf"):
            read.refuse(f"the mass of a {kind} is not computed: give its body an <inertial>")
        return None
    a, b, c = size
    if kind in ("capsule", "cylinder"):
        tube, caps = 2 * np.pi * a**2 * b, (4 / 3 * np.pi * a**3 if kind == "capsule" else 0.0)
        volume = tube + caps
        across = tube * (a**2 / 4 + b**2 / 3) + caps * (2 / 5 * a**2 + b**2 + 3 / 4 * a * b)
        unit = np.array([across, across, tube * a**2 / 2 + caps * 2 / 5 * a**2]) / volume
    else:
        a, b, c = (a, a, a) if kind == "sphere" else (a, b, c)
        volume = a * b * c * (8.0 if kind == "box" else 4 / 3 * np.pi)
        unit = np.array([b**2 + c**2, c**2 + a**2, a**2 + b**2]) / (3.0 if kind == "box" else 5.0)
    mass = read.number("mass") if "mass" in read else volume * read.number("density", DEFAULT_DENSITY)
    return SpaceMass(mass, frame.origin, frame.axes @ np.diag(mass * unit) @ frame.axes.T)


def sum_masses(masses: list[SpaceMass], axis: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Return mass (kg), centre (3,) (m), and moment of inertia (kg m^2) about the line through the centre along a unit axis."""
    mass = sum(part.mass for part in masses)
    centre = sum((part.mass * part.centre for part in masses), np.zeros(3)) / (mass or 1.0)
    return mass, centre, sum(part.about(axis, centre) for part in masses)
