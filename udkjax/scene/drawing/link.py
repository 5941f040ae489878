"""A link: a rigid body that is drawn through its pins."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import array_namespace, by_numpy
from udkjax.printing import PrintsLine
from udkjax.scene.drawing.pin_forms import Places, PointArray
from udkjax.scene.elements.bodies import Body, Frame
from udkjax.scene.elements.fields import NOT_NEGATIVE, OUTLINE, PIN, POSITIVE, given_names, given_or_none

NOMINAL_MASS = 1.0  # kg, of a link without mass; no result depends on it


class Shape(NamedTuple):
    """A plane figure of uniform thickness.

    All formulas are exact. They accept NumPy or JAX numbers, and are differentiable unless the shape has zero length.
    """

    area: Number  # m^2
    centre: PointArray  # m
    square_radius: Number  # m^2, squared radius of gyration about the centre


def bar(start: PointArray, end: PointArray, width: Number) -> Shape:
    """Return a bar of a width (m) between two points, with half-round ends about them.

    It is a rectangle between the points and two half discs of radius r = width / 2, whose second moments about the middle are
    l w (l^2 + w^2) / 12 and, for both half discs, pi r^4 / 2 + pi r^2 l^2 / 4 + 4 r^3 l / 3. A bar of zero width is a thin rod.
    """
    xp = array_namespace(start, end, width)
    axis = end - start
    length, w = xp.sqrt(axis @ axis), width
    # Area and moment divided by the width, which may be zero.
    area = length + np.pi * w / 4
    moment = length * (length**2 + w**2) / 12 + np.pi * w**3 / 32 + np.pi * w * length**2 / 16 + w**2 * length / 6
    return Shape(w * area, 0.5 * (start + end), moment / area)


def disc(centre: PointArray, diameter: Number) -> Shape:
    """Return a disc with a centre (m) and a diameter (m)."""
    return Shape(np.pi * diameter**2 / 4, centre, diameter**2 / 8)


def polygon(points: PointArray) -> Shape:
    """Return the polygon of points in order, clockwise or anticlockwise, by Green's theorem.

    With c_k = x_k y_(k+1) - x_(k+1) y_k: twice the area is sum c, six times the area times the centre is sum (p_k + p_(k+1)) c,
    and twelve times the second moment about the origin is sum (|p_k|^2 + p_k . p_(k+1) + |p_(k+1)|^2) c.
    """
    xp = array_namespace(points)
    middle = xp.mean(points, axis=0)  # as the origin, to avoid cancellation
    p = points - middle
    q, cross = _next_and_cross(p)
    twice = xp.sum(cross)
    centre = xp.sum((p + q) * cross[:, None], axis=0) / (3 * twice)
    moment = xp.sum(xp.sum(p * p + p * q + q * q, axis=1) * cross) / (6 * twice)
    return Shape(0.5 * xp.abs(twice), middle + centre, moment - centre @ centre)


def pierced(whole: Shape, holes: Sequence[PointArray]) -> Shape:
    """Return a shape without the polygons of its holes."""
    parts = [whole, *(polygon(points)._replace(area=-polygon(points).area) for points in holes)]
    area: Any = sum(part.area for part in parts)
    centre: Any = sum(part.area * part.centre for part in parts) / area
    arms = [part.centre - centre for part in parts]
    moment: Any = sum(part.area * (part.square_radius + arm @ arm) for part, arm in zip(parts, arms, strict=True))
    return Shape(area, centre, moment / area)


def twice_area(points: PointArray) -> Number:
    """Return twice the area of a polygon (m^2), negative if its points are in clockwise order."""
    return array_namespace(points).sum(_next_and_cross(points - points[0])[1])


def _next_and_cross(points: PointArray) -> tuple[PointArray, PointArray]:
    """Return the successor of each point in a polygon, and the cross product of the point and its successor."""
    following = array_namespace(points).roll(points, -1, axis=0)
    return following, points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]


class Link(PrintsLine):
    """A rigid body through pins: a disc about one pin, a bar along two, a plate of three or more, or any `outline`.

    A bar goes from the first pin to the last, with half-round ends of diameter `width` about them; more pins may lie on it.
    Without a width a link of three or more pins is a plate, the polygon of its pins in order. A link of one pin is a disc of
    diameter `width` about it. Mass, centre and inertia follow from the shape with `density` and `thickness`, or with `mass`; a
    bar of given mass without a width is a thin rod. `centre` and `inertia` may be given in addition. Positions, velocities, and
    a motion that motors determine need no mass. Without a mass, everything that depends on it is refused.

    Args:
        pins: the names of its pins, in order.
        density: in kg/m^3.
        width: width of a bar, or diameter of a disc (m).
        thickness: in m.
        mass: in kg.
        inertia: moment of inertia about the centre (kg m^2).
        centre: centre of mass, in world coordinates (m).
        outline: corners of the polygon, in world coordinates (m); in files also the name of a DXF or SVG file.
        holes: corners of holes in the outline, in world coordinates (m), the same number for each; corners may be repeated.
    """

    pins: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=PIN)
    density: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg/m^3
    width: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)  # m
    thickness: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m
    mass: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg
    inertia: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg m^2
    centre: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m, world
    outline: Float[Array, "n 2"] | None = eqx.field(converter=given_or_none, default=None, metadata=OUTLINE)  # m, world
    holes: Float[Array, "holes corners 2"] | None = eqx.field(converter=given_or_none, default=None)  # m, world

    @property
    def kind(self) -> str:
        """The kind of the link's shape: an outline, a disc, a bar, or a plate."""
        if self.outline is not None:
            return "outline"
        if len(self.pins) == 1:
            return "disc"
        return "bar" if len(self.pins) == 2 or self.width is not None else "plate"

    @property
    def sides(self) -> list[tuple[str, str]]:
        """The pairs of pins whose distances are the link's lengths: the ends of a bar, and pins that follow each other."""
        ends = [(self.pins[0], self.pins[-1])] if self.kind == "bar" else []
        return list(dict.fromkeys([*ends, *around(self.pins, closed=self.kind != "bar")]))

    def shape(self, places: Places) -> Shape:
        """Return the link's shape, given the positions of the pins. A disc needs a width; a bar without one is a thin rod."""
        width = 0.0 if self.width is None else by_numpy(self.width)
        if self.outline is not None:
            return pierced(polygon(by_numpy(self.outline)), [] if self.holes is None else list(by_numpy(self.holes)))
        if self.kind == "disc":
            return disc(places[self.pins[0]], width)
        if self.kind == "bar":
            return bar(places[self.pins[0]], places[self.pins[-1]], width)
        points = [places[name] for name in self.pins]
        return polygon(array_namespace(*points).stack(points))

    def _nominal_shape(self, places: Places) -> Shape:
        """Return a shape for a link without mass, as large as the whole drawing: it only weighs corrections of positions."""
        assert all(np.shape(place) == (2,) for place in places.values())  # else a part of the drawing is missing
        xp = array_namespace(*places.values())
        size = xp.max(xp.ptp(xp.stack([*places.values()]), axis=0))
        centre = xp.mean(xp.stack([places[name] for name in self.pins]), axis=0)
        return Shape(0.0, centre, xp.where(size > 0.0, size, 1.0) ** 2 / 12)

    def body(self, places: Places, velocities: Places) -> "DrawnBody":
        """Return the link's mass properties, position and velocity, given the positions (m) and velocities (m/s) of the pins."""
        if self.inertia is not None and self.centre is not None and self.mass is not None:
            shape = Shape(0.0, by_numpy(self.centre), 0.0)  # area and radius are not used
        elif self.mass is None and self.density is None:
            shape = self._nominal_shape(places)
        else:
            shape = self.shape(places)
        mass = self.mass  # a number that the link gives is the same object in the body: one leaf
        if mass is None and self.density is None:
            mass = NOMINAL_MASS
        elif mass is None:
            assert self.density is not None and self.thickness is not None
            mass = by_numpy(self.density) * by_numpy(self.thickness) * shape.area
        inertia = by_numpy(mass) * shape.square_radius if self.inertia is None else self.inertia
        position = shape.centre if self.centre is None else self.centre
        centre = by_numpy(position)
        first, angle, rate = places[self.pins[0]], 0.0, 0.0
        first_velocity = velocities[self.pins[0]]
        if len(self.pins) > 1:
            axis = places[self.pins[1]] - first
            angle = array_namespace(axis).arctan2(axis[1], axis[0])
            difference = velocities[self.pins[1]] - first_velocity
            rate = (axis[0] * difference[1] - axis[1] * difference[0]) / (axis @ axis)
        arm = centre - first
        velocity = array_namespace(arm, rate, first_velocity).stack(
            [first_velocity[0] - rate * arm[1], first_velocity[1] + rate * arm[0]]
        )
        return DrawnBody(Frame.at((centre[0], centre[1]), angle), Body(mass, inertia, position, angle, velocity, rate))


def around(pins: Sequence[str], closed: bool) -> list[tuple[str, str]]:
    """Return the pairs of pins that follow each other; if `closed`, the last and the first of three or more, too."""
    return [*pairwise(pins), *([(pins[-1], pins[0])] if closed and len(pins) > 2 else [])]


class DrawnBody(NamedTuple):
    """A link as a body, and its frame: origin at the centre of mass, x axis from the first pin towards the second."""

    frame: Frame
    body: Body

    def local(self, point: PointArray) -> tuple[Number, Number]:
        """Return the coordinates in the body's frame (m) of a point that is given in world coordinates (m)."""
        return self.frame.local((point[0] - self.frame.x, point[1] - self.frame.y))


def with_concrete_numbers(tree):
    """Return a tree with its concrete numbers as NumPy arrays: numbers computed from these alone stay concrete."""
    return jax.tree.map(lambda x: x if isinstance(x, Tracer) else np.asarray(x), tree)
