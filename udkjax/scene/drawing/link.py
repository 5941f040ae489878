"""A link: a rigid body that is drawn through its pins."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.printing import PrintsLine
from udkjax.scene.bodies import Body, Frame
from udkjax.scene.drawing.shapes import Points, Shape, bar, disc, polygon
from udkjax.scene.fields import NOT_NEGATIVE, OUTLINE, PIN, POSITIVE, array_namespace, given_names, given_number, given_or_none
from udkjax.scene.fields import Number as Scalar

Places = Mapping[str, Points]  # world coordinates of pins (m)


class Pin(PrintsLine):
    """A point of a drawing, in world coordinates, where links meet, and its initial velocity."""

    position: Float[Array, "2"] = eqx.field(converter=given_number)  # m
    velocity: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m/s; None: at rest


class Link(PrintsLine):
    """A rigid body through pins: a disc about one, a bar along two, a plate of more, or of an `outline`.

    A bar goes from the first pin to the last, with half-round ends of diameter `width` about them; more pins may lie on it.
    Without a width a link of three or more pins is a plate, the polygon of its pins in their order. A link of one pin is a disc
    of diameter `width` about it. Mass, centre and inertia follow from `density` and `thickness`; or from `mass` alone, for the
    same shape, of which a bar without a width is a thin rod. `centre` and `inertia`, about it, may be given beside either.

    Args:
        pins: the names of its pins, in their order.
        density: in kg/m^3.
        width: of a bar, or the diameter of a disc (m).
        thickness: in m.
        mass: in kg.
        inertia: about the centre (kg m^2).
        centre: of mass, in world coordinates (m).
        outline: corners of the polygon, in world coordinates (m).
    """

    pins: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=PIN)
    density: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg/m^3
    width: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)  # m
    thickness: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # m
    mass: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg
    inertia: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)  # kg m^2
    centre: Float[Array, "2"] | None = eqx.field(converter=given_or_none, default=None)  # m, in world coordinates
    outline: Float[Array, "n 2"] | None = eqx.field(converter=given_or_none, default=None, metadata=OUTLINE)  # m, likewise

    @property
    def kind(self) -> str:
        """Shape it is drawn as: an outline, a disc, a bar, or a plate."""
        if self.outline is not None:
            return "outline"
        if len(self.pins) == 1:
            return "disc"
        return "bar" if len(self.pins) == 2 or self.width is not None else "plate"

    def shape(self, places: Places) -> Shape:
        """Return its shape, of the places of the pins. A disc needs a width; a bar without one is a thin rod."""
        width = 0.0 if self.width is None else self.width
        if self.outline is not None:
            return polygon(self.outline)
        if self.kind == "disc":
            return disc(places[self.pins[0]], width)
        if self.kind == "bar":
            return bar(places[self.pins[0]], places[self.pins[-1]], width)
        points = [places[name] for name in self.pins]
        return polygon(array_namespace(*points).stack(points))

    def body(self, places: Places, velocities: Places) -> "DrawnBody":
        """Return its mass properties, place and velocity, of the places (m) and velocities (m/s) of the pins."""
        if self.inertia is not None and self.centre is not None and self.mass is not None:
            shape = Shape(0.0, self.centre, 0.0)
        else:
            shape = self.shape(places)
        if self.mass is not None:
            mass = self.mass
        else:
            assert self.density is not None and self.thickness is not None
            mass = self.density * self.thickness * shape.area
        inertia = mass * shape.square_radius if self.inertia is None else self.inertia
        centre = shape.centre if self.centre is None else self.centre
        first, angle, rate = places[self.pins[0]], 0.0, 0.0
        speed = velocities[self.pins[0]]
        if len(self.pins) > 1:
            way = places[self.pins[1]] - first
            angle = array_namespace(way).arctan2(way[1], way[0])
            change = velocities[self.pins[1]] - speed
            rate = (way[0] * change[1] - way[1] * change[0]) / (way @ way)
        arm = centre - first
        velocity = array_namespace(arm, rate, speed).stack([speed[0] - rate * arm[1], speed[1] + rate * arm[0]])
        return DrawnBody(Frame.at((centre[0], centre[1]), angle), Body(mass, inertia, centre, angle, velocity, rate))


class DrawnBody(NamedTuple):
    """A link as a body, and its frame: its origin at the centre of mass, its x axis from the first pin towards the second."""

    frame: Frame
    body: Body

    def local(self, point: Points) -> tuple[Scalar, Scalar]:
        """Return a point of the drawing in the frame of the body (m)."""
        return self.frame.local((point[0] - self.frame.x, point[1] - self.frame.y))


def with_known_numbers(tree):
    """Return a tree with NumPy's arrays in place of all that are not traced: what follows from them alone stays known."""
    return jax.tree.map(lambda x: x if isinstance(x, Tracer) else np.asarray(x), tree)
