"""Signed distances of convex figures in the plane, many at a time.

A figure is the convex hull of V corners, anticlockwise: a point, a segment or a polygon; a radius around it is subtracted by the
caller. With n from figure A to figure B, the signed distance is the largest over n of min n.(b - a). It is positive between
separate figures, and minus the shortest way out of each other if they overlap. The last axis of all arrays counts cases.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.arrays import array_namespace

Corners = Float[np.ndarray, "V 2 N"]


class Feature(NamedTuple):
    """The features at which figures A and B are closest: a corner of one, and a corner or an edge of the other one."""

    of_a: Bool[np.ndarray, "N"]  # whether the one is A
    corner: Int[np.ndarray, "N"]
    start: Int[np.ndarray, "N"]  # the edge of the other one,
    end: Int[np.ndarray, "N"]
    side: Float[np.ndarray, "N"]  # 1 if it is left to the right, -1 to the left,
    at: Int[np.ndarray, "N"]  # or its end that is closest: 1 the start, 2 the end; 0: neither

    def take(self, k: Any) -> "Feature":
        """Return the features of the cases k."""
        return Feature(*(x[k] for x in self))


class _Places(NamedTuple):
    """Distances of corners from edges: to the left, before the start, after the end (V, E, N); and separations (E, N)."""

    left: Any
    before: Any
    after: Any
    apart: Any

    @property
    def square(self) -> Any:
        """The squares of the distances."""
        beyond = np.maximum(np.maximum(self.before, self.after), 0.0)
        return self.left * self.left + beyond * beyond


def _places(points: Corners, corners: Corners) -> _Places:
    count = len(corners)
    start = corners if count > 2 else corners[:1]
    way = np.roll(corners, -1, axis=0)[: len(start)] - start
    length = np.sqrt(way[:, 0] ** 2 + way[:, 1] ** 2)
    safe = np.where(length > 0, length, 1.0)
    ex, ey = np.where(length > 0, way[:, 0] / safe, 1.0), way[:, 1] / safe
    x, y = points[:, None, 0] - start[:, 0], points[:, None, 1] - start[:, 1]
    left, before = ex * y - ey * x, -(ex * x + ey * y)
    after, apart = -before - length, -left.max(0)
    if count <= 2:  # a segment has two sides, and ends: rounding decides on which side collinear segments are
        apart = np.maximum(np.maximum(apart, left.min(0)), np.maximum(before.min(0), after.min(0)))
    return _Places(left, before, after, apart)


def signed_distance(A: Corners, B: Corners) -> Float[np.ndarray, "N"]:
    """Return the signed distances of figures A and B."""
    if len(A) == len(B) == 1:
        return np.hypot(*(B[0] - A[0]))
    sides = [_places(*pair) for pair in ((A, B), (B, A)) if len(pair[1]) > 1]
    apart = np.max([x.apart.max(0) for x in sides], axis=0)
    return np.where(apart < 0, apart, np.sqrt(np.min([x.square.min((0, 1)) for x in sides], axis=0)))


def feature(A: Corners, B: Corners) -> Feature:
    """Return the closest features of figures A and B, or, if they overlap, those of the shortest way out."""
    k, found = np.arange(A.shape[-1]), []
    for points, corners in ((A, B), (B, A)):
        if len(corners) == 1 < len(points):
            continue
        places, edges = _places(points, corners), max(1, len(corners) - (len(corners) == 2))
        square = places.square.reshape(-1, len(k))
        near, best = square.argmin(0), places.apart.argmax(0)
        apart, left = places.apart[best, k], places.left[:, best, k]
        right = (-left.max(0) >= left.min(0)) | (len(corners) > 2)
        is_out = apart >= 0
        corner = np.where(is_out, near // edges, np.where(right, left.argmax(0), left.argmin(0)))
        edge = np.where(is_out, near % edges, best)
        at = np.where(places.before[corner, edge, k] > 0, 1, np.where(places.after[corner, edge, k] > 0, 2, 0)) * is_out
        side = np.where(np.where(is_out, places.left[corner, edge, k] <= 0, right), 1.0, -1.0)
        of_a = np.full(len(k), points is A)
        found.append((apart, square[near, k], Feature(of_a, corner, edge, (edge + 1) % len(corners), side, at)))
    (apart, square, one), (apart_b, square_b, other) = found[0], found[-1]
    first = np.where(np.maximum(apart, apart_b) < 0, apart >= apart_b, square <= square_b)
    return Feature(*(np.where(first, x, y) for x, y in zip(one, other, strict=True)))


def gap_at(p: Any, start: Any, end: Any, side: Any, at: Any) -> tuple[Any, Any, Any]:
    """Return the signed distance of a point p from an edge or its end, the unit vector to p, and the closest place (2, ...).

    The distance is a smooth function of all places, also of JAX.
    """
    xp = array_namespace(p, start, end)
    way, r = end - start, xp.where(at == 2, p - end, p - start)
    length, far = (xp.sqrt(xp.where(s > 0, s, 1.0)) for s in ((way * way).sum(0), (r * r).sum(0)))
    n = xp.where(at > 0, r / far, side * xp.stack([way[1], -way[0]]) / length)
    distance = (n * r).sum(0)
    return distance, n, p - distance * n
