"""Distances of points from straight segments in the plane."""

import numpy as np
from jaxtyping import Float


def distances_from_segments(
    points: Float[np.ndarray, "P 2"], starts: Float[np.ndarray, "S 2"], ends: Float[np.ndarray, "S 2"]
) -> Float[np.ndarray, "P S"]:
    """Return the distance of each point from each segment; the start and the end of a segment may coincide."""
    way = ends - starts
    arms = points[:, None] - starts
    square = np.maximum((way**2).sum(1), np.finfo(float).tiny)
    share = np.clip((arms * way).sum(2) / square, 0.0, 1.0)
    return np.linalg.norm(arms - share[..., None] * way, axis=2)
