"""Signed distances of convex figures in the plane, many at a time.

A figure is the convex hull of V corners, anticlockwise: a point, a segment or a polygon; a radius around it is subtracted by the
caller. With unit vectors n from figure A to figure B, the signed distance is the largest over n of min n.(b - a). It is positive
between separate figures; if they overlap, it is minus the length of the shortest translation that separates them, their shortest
way out. The last axis of all arrays is that of the cases: pairs of figures.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.arrays import array_namespace

FEW_ROWS = 4  # up to which least numbers are faster found row by row than by `argmin`; 8 rows take a quarter longer
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


class Closest(NamedTuple):
    """Signed distances (N) of figures, unit vectors n (2, N) from A to B, and the closest features.

    `row` is the index of a pair of a corner and an edge in `_feature_table`; `side` and `at` are those of `Feature`.
    """

    distance: Any
    n: Any
    row: Any
    side: Any
    at: Any

    def features(self, counts: tuple[int, int], k: Any) -> Feature:
        """Return the features of the cases k; `counts` are the numbers of corners of A and B."""
        row = self.row[k]
        of_a, corner, edge, end = (x[row] for x in _feature_table(*counts)[:4])
        return Feature(of_a, corner, edge, end, self.side[k], self.at[k])


class _FeatureTable(NamedTuple):
    """Pairs of a corner and an edge: whether the corner is one of A, the corner, the edge's start and end, and its place in a
    list of all edges."""

    of_a: Any
    corner: Any
    start: Any
    end: Any
    edge: Any


@lru_cache
def _feature_table(count_a: int, count_b: int) -> _FeatureTable:
    found, edges = [], 0
    for of_a, count, corners in _sides_of(count_a, count_b):
        number = corners if corners > 2 else 1
        found += [(of_a, i, j, (j + 1) % corners, edges + j) for i in range(count) for j in range(number)]
        edges += number
    return _FeatureTable(*(np.array(x) for x in zip(*found, strict=True)))


def _sides_of(count_a: int, count_b: int) -> list[tuple[bool, int, int]]:
    """Return the comparisons of the corners of one figure with the edges of the other one.

    A comparison consists of True if the corners are those of A and False if they are those of B, the number of these corners, and
    the number of corners of the other figure. A point has no edges; for two points there is one comparison.
    """
    both = [(True, count_a, count_b), (False, count_b, count_a)]
    return [x for x in both if x[2] > 1] or both[:1]


class _CornerPlaces(NamedTuple):
    """Distances of the corners of one figure from the edges of another one, and properties of these edges.

    Attributes:
        left: the distance of each corner to the left of each edge (V, E, N).
        along: the distance along the edge from its start.
        past: the distance along the edge from its end.
        ex: x of the unit vector of each edge (E, N).
        ey: y of that vector.
        apart: the distance by which the edge separates the figures (E, N), negative if it does not.
    """

    left: Any
    along: Any
    past: Any
    ex: Any
    ey: Any
    apart: Any


def _corner_places(points: Corners, corners: Corners) -> _CornerPlaces:
    start = corners if len(corners) > 2 else corners[:1]
    way = (np.concatenate([corners[1:], corners[:1]]) if len(corners) > 2 else corners[-1:]) - start
    length = np.sqrt(way[:, 0] * way[:, 0] + way[:, 1] * way[:, 1])
    safe = np.maximum(length, np.finfo(float).tiny)
    ex, ey = way[:, 0] / safe, way[:, 1] / safe
    if not length.all():
        ex = np.where(length > 0, ex, 1.0)
    x, y = points[:, None, 0] - start[:, 0], points[:, None, 1] - start[:, 1]
    left, along = ex * y - ey * x, ex * x + ey * y
    past, apart = along - length, -left.max(0)
    if len(corners) <= 2:  # a segment has two sides, and ends: rounding decides on which side collinear segments are
        apart = np.maximum(np.maximum(apart, left.min(0)), np.maximum(-along.max(0), past.min(0)))
    return _CornerPlaces(left, along, past, ex, ey, apart)


def signed_distance(A: Corners, B: Corners) -> Float[np.ndarray, "N"]:
    """Return the signed distances of figures A and B."""
    return closest(A, B).distance


def closest(A: Corners, B: Corners) -> Closest:
    """Return the signed distances of figures A and B, and their closest features.

    If figures overlap, these are the features of the shortest way out of each other.
    """
    count, rows = A.shape[-1], _feature_table(len(A), len(B))
    sides = [_corner_places(*((A, B) if of_a else (B, A))) for of_a, *_ in _sides_of(len(A), len(B))]
    left, along, past = (_joined([x[k].reshape(-1, count) for x in sides]) for k in range(3))
    edge_x, edge_y, apart = (_joined([x[k] for x in sides]) for k in range(3, 6))
    beyond = np.maximum(np.maximum(-along, past), 0.0)
    row = _first_least(left * left + beyond * beyond)
    separation = apart.max(0)
    overlap = np.flatnonzero(separation < 0)
    right = np.ones(len(overlap), bool)
    if len(overlap):
        row[overlap], right = _ways_out([(x.left[..., overlap], x.apart[:, overlap]) for x in sides])
    every = np.arange(count)
    here, edge = row * count + every, rows.edge.take(row) * count + every
    to_left, a, p = left.take(here), along.take(here), past.take(here)
    ex, ey = edge_x.take(edge), edge_y.take(edge)
    side, b = np.where(to_left <= 0, 1.0, -1.0), np.minimum(a, 0.0) + np.maximum(p, 0.0)
    at = np.where(a < 0, 1, np.where(p > 0, 2, 0)) if max(len(A), len(B)) > 1 else np.ones(count, int)
    distance = np.sqrt(to_left * to_left + b * b)
    along_edge = distance == 0
    if len(overlap):
        side[overlap], at[overlap] = np.where(right, 1.0, -1.0), 0
        distance[overlap], along_edge[overlap] = separation[overlap], True
    safe = np.where(along_edge, 1.0, distance) * np.where(rows.of_a.take(row), -1.0, 1.0)
    n = np.stack([b * ex - to_left * ey, b * ey + to_left * ex]) / safe
    if along_edge.any():
        k = np.flatnonzero(along_edge)
        n[:, k] = np.stack([ey[k], -ex[k]]) * (side[k] * safe[k])
    return Closest(distance, n, row, side, at)


def _joined(arrays: list[np.ndarray]) -> np.ndarray:
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _first_least(rows: Float[np.ndarray, "R N"]) -> Int[np.ndarray, "N"]:
    """Return the index of the first row with the least number in each column; `argmin` is slow if there are few rows."""
    if len(rows) > FEW_ROWS:
        return rows.argmin(0)
    least, found = rows[0], np.zeros(rows.shape[1], int)
    for k in range(1, len(rows)):
        found = np.where(rows[k] < least, k, found)
        least = np.minimum(least, rows[k])
    return found


def _ways_out(sides: list[tuple[np.ndarray, np.ndarray]]) -> tuple[Int[np.ndarray, "N"], Bool[np.ndarray, "N"]]:
    """Return the shortest ways out of overlapping figures: rows of `_feature_table`, and True if they lead to the edge's right.

    `sides` has `left` and `apart` of `_CornerPlaces` for each comparison of `_sides_of`.
    """
    found, first = [], 0
    for left, apart in sides:
        corners, edges, count = left.shape
        k, best = np.arange(count), apart.argmax(0)
        deep = left[:, best, k]
        right = (-deep.max(0) >= deep.min(0)) | (edges > 1)
        corner = np.where(right, deep.argmax(0), deep.argmin(0))
        found.append((apart[best, k], first + corner * edges + best, right))
        first += corners * edges
    (apart, row, right), (other_apart, other, other_right) = found[0], found[-1]
    is_first = apart >= other_apart
    return np.where(is_first, row, other), np.where(is_first, right, other_right)


def gap_at(p: Any, start: Any, end: Any, side: Any, at: Any) -> tuple[Any, Any, Any]:
    """Return the signed distance of a point p from an edge or one of its ends, the unit vector to p, and the closest point.

    `side` and `at` are those of `Feature`. The distance is a smooth function of all points, which may be arrays of JAX.
    """
    xp = array_namespace(p, start, end)
    way, r = end - start, xp.where(at == 2, p - end, p - start)
    length, far = (xp.sqrt(xp.where(s > 0, s, 1.0)) for s in ((way * way).sum(0), (r * r).sum(0)))
    n = xp.where(at > 0, r / far, side * xp.stack([way[1], -way[0]]) / length)
    distance = (n * r).sum(0)
    return distance, n, p - distance * n
