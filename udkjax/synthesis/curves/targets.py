"""The wanted curve, resampled at equal arc lengths, and the Chamfer distance of other curves from it."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from udkjax.requirements import require_finite

CHAMFER_POINTS = 2000  # points of each curve by which distances are measured
FEWEST_POINTS = 3  # points of a curve
# Extent (m) of a curve, and one over the smallest: the fifth powers of both, in moments of inertia, are finite.
LARGEST_EXTENT = 1e30
CLOSED_GAP = 0.02  # a curve whose ends are nearer, relative to its length, is closed
# A curve of at least MANY_POINTS is also closed if its ends are nearer than CLOSED_SPACING times the usual distance of points.
CLOSED_SPACING, MANY_POINTS = 1.25, 12


def read_curve(curve: object, name: str = "curve") -> np.ndarray:
    """Return the points (n, 2) of a curve (m) without repetitions of a point; `name` is the argument's name, for messages.

    Raises:
        ValueError: the points are not finite, fewer than three, or all coincide, or powers of their extent would overflow.
    """
    require_finite(name, curve)
    points = np.asarray(curve, float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name} must have the shape (n, 2), one row x, y for each point, not {points.shape}")
    if len(points) < FEWEST_POINTS:
        raise ValueError(f"{name} must have at least {FEWEST_POINTS} points, not {len(points)}")
    size = float(np.hypot(*np.ptp(points, axis=0)))
    if not size > 4 * np.finfo(float).eps * np.abs(points).max():
        raise ValueError(f"{name} has no size: all of its points coincide")
    if not 1.0 / LARGEST_EXTENT < size < LARGEST_EXTENT:
        raise ValueError(
            f"{name} has an extent of {size:.3g} m: give it in another unit, "
            f"between {1 / LARGEST_EXTENT:g} and {LARGEST_EXTENT:g}"
        )
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return points[np.concatenate([[True], step > np.finfo(float).eps * size])]


def closes(points: np.ndarray) -> bool:
    """Return True if the ends of a curve nearly meet, or if only the last side of a polygon of many points is missing."""
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    usual = CLOSED_SPACING * float(np.median(step)) if len(points) >= MANY_POINTS else 0.0
    return float(np.linalg.norm(points[0] - points[-1])) <= max(CLOSED_GAP * float(step.sum()), usual)


def resampled(points: np.ndarray, count: int, is_closed: bool = False) -> np.ndarray:
    """Return complex points (count,) at equal arc lengths along a polyline (n, 2); a closed one ends before its first point."""
    if is_closed:
        points = np.concatenate([points, points[:1]])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, way[-1], count + is_closed)[:count]
    return np.interp(at, way, points[:, 0]) + 1j * np.interp(at, way, points[:, 1])


def as_points(z: np.ndarray) -> np.ndarray:
    """Return complex numbers (n,) as points (n, 2)."""
    return np.stack([np.real(z), np.imag(z)], 1)


def chamfer(curve: np.ndarray, target: np.ndarray) -> float:
    """Return the Chamfer distance of two sets of points (n, 2).

    It is the mean distance of the points of each set from the nearest point of the other, the sum for both.
    """
    return float(cKDTree(target).query(curve)[0].mean() + cKDTree(curve).query(target)[0].mean())


class CurveTarget(NamedTuple):
    """A wanted curve as a search sees it: centred, and scaled to an RMS radius of 1.

    Attributes:
        points: complex points at equal arc lengths (M,).
        following: the next point of each point (M,); the last point of an open curve is followed by itself.
        previous: the previous point of each point (M,); the first point of an open curve is preceded by itself.
    """

    points: np.ndarray
    following: np.ndarray
    previous: np.ndarray


class WantedCurve:
    """A wanted curve in metres, and its normalized forms.

    Args:
        curve: points (n, 2) (m).
        whole: whether the whole turn of the crank draws it, even if it is open.
        name: the name of the argument, for messages.
    """

    def __init__(self, curve: object, whole: bool = False, name: str = "curve"):
        given = read_curve(curve, name)
        self.is_closed = closes(given)
        self.is_whole = self.is_closed or whole
        z = resampled(given, CHAMFER_POINTS, self.is_closed)
        self.middle = complex(z.mean())
        self.scale = float(np.sqrt(np.mean(np.abs(z - self.middle) ** 2)))
        self.extent = float(np.linalg.norm(np.ptp(given, axis=0)))
        self.points = (given - as_points(np.array([self.middle]))) / self.scale
        self.fine = as_points(resampled(self.points, CHAMFER_POINTS, self.is_closed))
        self.length = float(np.abs(np.diff(resampled(self.points, CHAMFER_POINTS + 1))).sum())

    def target(self, count: int) -> CurveTarget:
        """Return the normalized curve resampled at `count` points."""
        z = resampled(self.points, count, self.is_closed)
        following, previous = np.roll(z, -1), np.roll(z, 1)
        if not self.is_closed:
            following[-1], previous[0] = z[-1], z[0]
        return CurveTarget(z, following, previous)

    def error(self, pin: np.ndarray) -> float:
        """Return the Chamfer distance of a normalized path, by complex points, from the curve, in RMS radii of the curve.

        If the whole turn draws the curve, the path is closed.
        """
        path = as_points(pin)
        return chamfer(as_points(resampled(path, CHAMFER_POINTS, self.is_whole)), self.fine)
