"""Area, centre and radius of gyration of the shapes that links have: a bar with round ends, a disc, a polygon.

All formulas are exact. They take numbers of NumPy or of JAX, and are differentiable where the shape is none of length zero.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from udkjax.scene.fields import Number, array_namespace

Points = Float[Array, "n 2"] | np.ndarray


class Shape(NamedTuple):
    """A plane figure of uniform thickness."""

    area: Number  # m^2
    centre: Points  # m
    square_radius: Number  # m^2: the square of the radius of gyration about the centre


def bar(start: Points, end: Points, width: Number) -> Shape:
    """Return a bar of a width (m) around the way between two points, with half-round ends about them.

    It is a rectangle between the points and two half discs of radius r = width / 2, whose second moments about the middle are
    l w (l^2 + w^2) / 12 and, for both together, pi r^4 / 2 + pi r^2 l^2 / 4 + 4 r^3 l / 3. Of width zero it is a thin rod.
    """
    xp = array_namespace(start, end, width)
    way = end - start
    length, w = xp.sqrt(way @ way), width
    # Both over the width, which may be zero.
    area = length + np.pi * w / 4
    moment = length * (length**2 + w**2) / 12 + np.pi * w**3 / 32 + np.pi * w * length**2 / 16 + w**2 * length / 6
    return Shape(w * area, 0.5 * (start + end), moment / area)


def disc(centre: Points, diameter: Number) -> Shape:
    """Return a disc of a diameter (m)."""
    return Shape(np.pi * diameter**2 / 4, centre, diameter**2 / 8)


def polygon(points: Points) -> Shape:
    """Return the polygon of points in their order, either way around, by Green's theorem.

    With c_k = x_k y_(k+1) - x_(k+1) y_k: twice the area is sum c, six times the area times the centre is sum (p_k + p_(k+1)) c,
    and twelve times the second moment about the origin is sum (|p_k|^2 + p_k . p_(k+1) + |p_(k+1)|^2) c.
    """
    xp = array_namespace(points)
    middle = xp.mean(points, axis=0)  # near which nothing cancels
    p = points - middle
    q, cross = _next_and_cross(p)
    twice = xp.sum(cross)
    centre = xp.sum((p + q) * cross[:, None], axis=0) / (3 * twice)
    moment = xp.sum(xp.sum(p * p + p * q + q * q, axis=1) * cross) / (6 * twice)
    return Shape(0.5 * xp.abs(twice), middle + centre, moment - centre @ centre)


def twice_area(points: Points) -> Number:
    """Return twice the area of a polygon (m^2), negative where its points go around clockwise."""
    return array_namespace(points).sum(_next_and_cross(points - points[0])[1])


def _next_and_cross(points: Points) -> tuple[Points, Points]:
    """Return the point after each one, and the cross product of both."""
    after = array_namespace(points).roll(points, -1, axis=0)
    return after, points[:, 0] * after[:, 1] - after[:, 0] * points[:, 1]
