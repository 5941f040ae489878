"""Lower bounds of signed distances of convex parts over intervals within one polynomial of a motion.

With any unit vectors n(u), the signed distance is at least min n.(b - a) over all corners a and b. Let n turn with the closest
features at an end of the interval. If these are a corner and an edge, n is the normal of the edge. If they are two corners a' and
b', with r from a' to b', n = r / |r|, and n.(b - a) is |r|, plus r.(b - b') / |r| and r.(a' - a) / |r| for the other corners.

All these are products of two vectors. Each is above the cubic with the same values and slopes at both ends, minus F h^4 / 384,
with F a bound of its fourth derivative by Leibniz's rule. So a gap that is constant, or least within the interval, is proven
without splitting the interval into parts as short as bounds of the second derivative require.
"""

from math import comb
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.positions.gaps.convex import Feature
from udkjax.positions.gaps.motion_tables import DERIVATIVE_ORDERS


class Moving(NamedTuple):
    """Vectors (..., 2, ends, n) at both ends of n intervals, or products of them (..., ends, n), and their derivatives by u."""

    at: Any
    rate: Any

    def __sub__(self, other: "Moving") -> "Moving":
        return Moving(self.at - other.at, self.rate - other.rate)

    def dot(self, other: "Moving") -> "Moving":
        """Return the scalar products of these vectors with others."""
        return Moving(_dot(self.at, other.at), _dot(self.rate, other.at) + _dot(self.at, other.rate))

    def one(self, corner: Any, k: Any) -> "Moving":
        """Return the vectors of corners (V, 2, ends, n) of one corner in each of the intervals k: `corner` has their indices."""
        return Moving(*(np.moveaxis(x[corner, :, :, k], 0, -1) for x in self))

    def take(self, k: Any) -> "Moving":
        """Return the vectors or products in the intervals k."""
        return Moving(self.at.take(k, -1), self.rate.take(k, -1))


def _dot(x: Any, y: Any) -> Any:
    return x[..., 0, :, :] * y[..., 0, :, :] + x[..., 1, :, :] * y[..., 1, :, :]


class MovingPart(NamedTuple):
    """The first or the second convex part of a pair, in each of n intervals.

    Attributes:
        corners: the corners in ground axes (V, 2, ends, n).
        origin: positions of the origin of the part's body (2, ends, n).
        turn: derivatives of the body's angle by u (ends, n).
        reach: the largest distance of a corner from the origin (n).
        places: bounds of the derivatives by u of the origin (orders, n).
        directions: bounds of unit vectors that turn with the body, and of their derivatives by u (1 + orders, n).
    """

    corners: Moving
    origin: Any
    turn: Any
    reach: Any
    places: Any
    directions: Any


def _fourth_of_product(one: Any, other: Any) -> Any:
    """Return bounds of the fourth derivatives of scalar products, from bounds of vectors and of derivatives (1 + orders, n)."""
    return sum(comb(DERIVATIVE_ORDERS, k) * one[k] * other[DERIVATIVE_ORDERS - k] for k in range(DERIVATIVE_ORDERS + 1))


def least_of_cubics(f: Moving, h: Any) -> tuple[Any, Any]:
    """Return the least values over intervals h of cubics with given values and slopes (..., ends, n) at both ends.

    The second result is the fraction of the interval at which each cubic has its minimum, clipped to 0 and 1.
    """
    (f0, f1), (d0, d1) = np.moveaxis(f.at, -2, 0), np.moveaxis(f.rate, -2, 0) * h
    # f0 + d0 t + c2 t^2 + c3 t^3; its slope d0 + 2 c2 t + 3 c3 t^2 rises through zero at a minimum
    c2, c3 = 3 * (f1 - f0) - 2 * d0 - d1, 2 * (f0 - f1) + d0 + d1
    root = np.sqrt(np.maximum(c2 * c2 - 3 * c3 * d0, 0.0))
    over, under = np.where(c2 >= 0, -d0, root - c2), np.where(c2 >= 0, c2 + root, 3 * c3)
    t = np.minimum(np.maximum(over / np.where(under > 0, under, np.inf), 0.0), 1.0)
    return np.minimum(np.minimum(f0, f1), f0 + t * (d0 + t * (c2 + t * c3))), t


def bounds_by_features(
    A: MovingPart, B: MovingPart, features: Feature, h: Float[np.ndarray, "n"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return lower bounds of signed distances over intervals, and the fractions of the intervals at which these are about least.

    Args:
        A: the first part of each pair.
        B: the second part.
        features: the closest features (ends, n) at both ends of each interval.
        h: the lengths of the intervals.
    """
    derivatives = A.places + A.reach * A.directions[1:] + B.places + B.reach * B.directions[1:]
    share, way = h**4 / 384, B.origin - A.origin
    apart = np.sqrt((way * way).sum(0).max(0)) + A.reach + B.reach + 0.5 * h * derivatives[0]
    relative = np.concatenate([apart[None], derivatives])  # of vectors from corners of A to those of B
    is_edge = features.at == 0
    low, at = np.empty(is_edge.shape), np.empty(is_edge.shape)
    for one, other, mask in ((A, B, is_edge & features.of_a), (B, A, is_edge & ~features.of_a)):
        end, k = np.nonzero(mask)
        if len(k):
            start, stop = (other.corners.one(x[end, k], k) for x in (features.start, features.end))
            way = stop.at - start.at
            length = np.sqrt((way * way).sum(0))
            n = np.stack([way[1], -way[0]]) * (features.side[end, k] / np.where(length > 0, length, np.nan))
            normal = Moving(n, other.turn[:, k] * np.stack([-n[1], n[0]]))
            least, t = least_of_cubics((one.corners.take(k) - start).dot(normal), h[k])
            first, every = least.argmin(0), np.arange(len(k))
            error = _fourth_of_product(other.directions[:, k], relative[:, k]) * share[k]
            low[end, k], at[end, k] = least[first, every] - error, t[first, every]
    end, k = np.nonzero(~is_edge)
    if len(k):
        f = features.take((end, k))
        nearest = np.where(f.at == 1, f.start, f.end)
        corners = np.where(f.of_a, f.corner, nearest), np.where(f.of_a, nearest, f.corner)
        low[end, k], at[end, k] = _bounds_by_corners(A, B, *corners, relative, h, k)
    return np.fmax(low[0], low[1]), np.where(low[0] >= low[1], at[0], at[1])  # NaN by an edge without length


def _bounds_by_corners(
    A: MovingPart, B: MovingPart, corner_a: Any, corner_b: Any, relative: Any, h: Any, k: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return the results of `bounds_by_features` for the intervals k, at an end of which two corners are closest.

    Args:
        A: the first part of each pair.
        B: the second part.
        corner_a: the index of the closest corner of A in each of the intervals k.
        corner_b: the index of the closest corner of B.
        relative: bounds of the vectors from corners of A to those of B and of their derivatives (1 + orders, n).
        h: the lengths of all n intervals.
        k: the indices of the intervals.
    """
    relative, h = relative[:, k], h[k]
    share, a, b = h**4 / 384, A.corners.one(corner_a, k), B.corners.one(corner_b, k)
    r, count, every = b - a, len(A.corners.at), np.arange(len(k))
    ways = a - A.corners.take(k), B.corners.take(k) - b
    vectors = Moving(*(np.concatenate([x[None], y, z]) for x, y, z in zip(r, *ways, strict=True)))
    least, at = least_of_cubics(vectors.dot(r), h)
    square = least[0] - _fourth_of_product(relative, relative) * share
    beside = np.zeros(len(k))
    for part, corner, products in ((A, corner_a, least[1 : 1 + count]), (B, corner_b, least[1 + count :])):
        if len(products) > 1:
            products = products - _fourth_of_product(2 * part.reach[k] * part.directions[:, k], relative) * share
            products[corner, every] = 0.0
            beside += products.min(0)
    distance = np.sqrt(np.where(square > 0, square, np.inf))
    return np.where(square > 0, distance + beside / distance, -np.inf), at[0]
