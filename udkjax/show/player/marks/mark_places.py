"""Places of a mechanism's picture: attachments of its bodies, their outlines, and places in moving frames."""

import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.forces import Spring
from udkjax.scene.mechanism import Mechanism

SAME_PLACE = 1e-9  # attachments closer than this, relative to the largest coordinate, are one point


def body_points(mechanism: Mechanism) -> dict[str, Float[np.ndarray, "points 2"]]:
    """Return the distinct points of each body (m, in its frame): attachments of joints, drivers and springs, and free pins."""
    attached: dict[str, list[tuple[float, float]]] = {body: [] for body in (*mechanism.bodies, GROUND)}
    springs = [force for force in mechanism.forces.values() if isinstance(force, Spring)]
    for element in (*mechanism.constraints.values(), *springs):
        points = getattr(element, "points", None)
        if points is None or getattr(element, "coordinate", "") == "angle":
            continue
        for body, (x, y) in zip(element.bodies, np.asarray(points, float).tolist()):
            attached[body].append((x, y))
    if mechanism.drawing is not None:
        for body, point in mechanism.drawing.free_pins().values():
            attached[body].append(tuple(np.asarray(point, float).tolist()))
    return {body: distinct(points) for body, points in attached.items()}


def distinct(points: list[tuple[float, float]]) -> Float[np.ndarray, "points 2"]:
    """Return the points without repetitions: of points at the same place, the first."""
    found: list[tuple[float, float]] = []
    size = max((abs(c) for point in points for c in point), default=0.0)
    for point in points:
        if all(np.hypot(point[0] - x, point[1] - y) > SAME_PLACE * size for x, y in found):
            found.append(point)
    return np.array(found).reshape(-1, 2)


def to_ground(point: Numbers, frames: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 2"]:
    """Return the ground coordinates (m) of a point of a body for each frame x, y, angle of the body.

    Several points (n, 2) are converted by a single frame.
    """
    x, y = np.asarray(point, float).T
    cos, sin = np.cos(frames[:, 2]), np.sin(frames[:, 2])
    return frames[:, :2] + np.column_stack([cos * x - sin * y, sin * x + cos * y])


def corners_of(
    points: Float[np.ndarray, "points 2"], polygon: Float[np.ndarray, "corners 2"] | None = None
) -> tuple[Float[np.ndarray, "corners 2"], bool]:
    """Return the shape of a body through points: the points in order and False for a bar, or corners and True for a plate.

    A bar has all points in line. The plate around other points is `polygon` if it contains all corners of their convex hull; else
    the convex hull.
    """
    from scipy.spatial import ConvexHull  # importing SciPy takes longer than the call

    spread = points - points.mean(axis=0)
    if np.linalg.matrix_rank(spread, tol=SAME_PLACE * np.abs(spread).max()) < 2:
        return points[np.argsort(spread @ np.linalg.svd(spread, full_matrices=False)[2][0])], False
    hull, near = points[ConvexHull(points).vertices], SAME_PLACE * np.abs(points).max()
    if polygon is not None and all(np.abs(polygon - corner).max(axis=1).min() <= near for corner in hull):
        return polygon, True
    return hull, True


def in_frame(frame: Float[np.ndarray, "3"], place: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Return a place, given in ground coordinates, in a body's frame."""
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    return np.array([[cos, sin], [-sin, cos]]) @ (place - frame[:2])
