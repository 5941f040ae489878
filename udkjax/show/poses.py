"""The shapes of a mechanism in a plot: which points hold its bodies, where they are, and which poses differ most."""

import numpy as np
from jaxtyping import Float

from udkjax.scene import GROUND, Mechanism


def farthest_instants(q: Float[np.ndarray, "T bodies 3"], count: int) -> list[int]:
    """Return up to `count` instants, from the first on, whose poses differ most: each is the farthest from those before it."""
    poses = np.concatenate([q[..., :2], np.cos(q[..., 2:]), np.sin(q[..., 2:])], axis=-1).reshape(len(q), -1)
    chosen, distance = [0], np.linalg.norm(poses - poses[0], axis=1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(poses - poses[chosen[-1]], axis=1))
    return chosen


def attachments(mech: Mechanism) -> dict[str, Float[np.ndarray, "points 2"]]:
    """Return the points at which joints hold each body, in its own frame, each of them once; the ground is one of the bodies."""
    points: dict[str, list[tuple[float, float]]] = {body: [] for body in (*mech.bodies, GROUND)}
    for joint in mech.joints.values():
        for body, point in zip(joint.bodies, np.asarray(getattr(joint, "points", np.empty((0, 2)))), strict=False):
            points[body].append((float(point[0]), float(point[1])))
    return {body: np.array(list(dict.fromkeys(held))).reshape(-1, 2) for body, held in points.items()}


def outline(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    """Return a line through the points that hold a body, closed where they span an area; a single one is joined to its centre."""
    if len(points) < 2:
        points = np.concatenate([points, np.zeros((1, 2))])
    spread = points - points.mean(axis=0)
    along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
    flat = np.linalg.matrix_rank(spread, tol=1e-9 * np.abs(spread).max()) < 2
    order = np.argsort(along if flat else np.arctan2(spread[:, 1], spread[:, 0]))
    return points[order if flat else np.append(order, order[0])]


def to_ground(points: Float[np.ndarray, "points 2"], coordinates: Float[np.ndarray, "3"]) -> Float[np.ndarray, "points 2"]:
    """Return where points of a body's own frame are, in ground coordinates."""
    x, y, angle = coordinates
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
