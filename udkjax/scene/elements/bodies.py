"""Rigid bodies, and their frames, which are the arguments of joints and force elements."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import array_namespace, is_traced, number
from udkjax.printing import PrintsLine, one_line
from udkjax.scene.elements.fields import POSITIVE, given_number

GROUND = "ground"
COORDINATES = ("x", "y", "angle")  # of each body, in the order of q and v
PlaneVector = Float[Array, "2"] | Sequence[Number]  # two components


class Body(PrintsLine):
    """A rigid body in the plane; its frame has its origin at the centre of mass.

    `position`, `angle`, `velocity` and `angular_velocity` are the initial guess from which `assemble` closes the loops.

    Args:
        mass: in kg, greater than zero.
        inertia: about the centre of mass, in kg m^2, greater than zero.
        position: of the centre of mass (m).
        angle: of the frame, anticlockwise from the x axis (rad).
        velocity: of the centre of mass (m/s).
        angular_velocity: in rad/s, anticlockwise positive.
    """

    mass: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # kg, > 0
    inertia: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)  # kg m^2 about the centre of mass, > 0
    position: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))  # m
    angle: Float[Array, ""] = eqx.field(converter=given_number, default=0.0)  # rad, anticlockwise from the x axis
    velocity: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))  # m/s
    angular_velocity: Float[Array, ""] = eqx.field(converter=given_number, default=0.0)  # rad/s

    def frame(self) -> "Frame":
        """Return the body's frame at its initial guess, with its velocities."""
        vx, vy = self.velocity
        return Frame.at(self.position, self.angle)._replace(vx=vx, vy=vy, omega=self.angular_velocity)


class Point(NamedTuple):
    """A point, a vector or a velocity in ground coordinates.

    Attributes:
        x: component along x, in m or m/s.
        y: component along y, in m or m/s.
    """

    x: Number
    y: Number

    def __repr__(self) -> str:
        return one_line(self)

    def dot(self, other: "Point") -> Number:
        """Return the scalar product with another vector."""
        return self.x * other.x + self.y * other.y

    def norm(self, least: Number = 0.0) -> Array:
        """Return the length of the vector. Its derivative at the zero vector, where the length has a kink, is set to zero.

        Args:
            least: Length up to which a vector is treated as zero.
        """
        square = self.dot(self)
        xp, nonzero = array_namespace(square), square > least * least
        return xp.where(nonzero, xp.sqrt(xp.where(nonzero, square, 1.0)), 0.0)


class Frame(NamedTuple):
    """Position and velocity of a body as scalars: the argument of joints and force elements.

    In joints `vx`, `vy` and `omega` are None, because ideal joints constrain positions only. The ground is `GROUND_FRAME`.

    Attributes:
        x: x coordinate of the centre of mass (m).
        y: y coordinate of the centre of mass (m).
        angle: anticlockwise from the x axis (rad), not wrapped; relative angles of bodies are differences of angles.
        cos: cosine of the angle.
        sin: sine of the angle.
        vx: x velocity of the centre of mass (m/s).
        vy: y velocity of the centre of mass (m/s).
        omega: angular velocity, anticlockwise (rad/s).
    """

    x: Number  # m
    y: Number  # m
    angle: Number  # rad
    cos: Number
    sin: Number
    vx: Number = None  # pyright: ignore[reportAssignmentType]  # m/s
    vy: Number = None  # pyright: ignore[reportAssignmentType]  # m/s
    omega: Number = None  # pyright: ignore[reportAssignmentType]  # rad/s

    def __repr__(self) -> str:
        return one_line(self)

    @classmethod
    def at(cls, position: PlaneVector, angle: Number) -> "Frame":
        """Return the frame of a body at a position (m) and an angle (rad), without velocities."""
        xp = array_namespace(angle)
        return cls(position[0], position[1], angle, xp.cos(angle), xp.sin(angle))

    def vector(self, local: PlaneVector) -> Point:
        """Transform a vector from the body's frame to ground coordinates."""
        x, y = local[0], local[1]
        return Point(self.cos * x - self.sin * y, self.sin * x + self.cos * y)

    def point(self, local: PlaneVector) -> Point:
        """Return the ground coordinates (m) of a point given in the body's frame."""
        arm = self.vector(local)
        return Point(self.x + arm.x, self.y + arm.y)

    def velocity(self, local: PlaneVector) -> Point:
        """Return the velocity, in ground coordinates (m/s), of a point given in the body's frame."""
        arm = self.vector(local)
        return Point(self.vx - self.omega * arm.y, self.vy + self.omega * arm.x)

    def local(self, vector: PlaneVector) -> Point:
        """Transform a vector from ground coordinates to the body's frame: the inverse of `vector`."""
        x, y = vector[0], vector[1]
        return Point(self.cos * x + self.sin * y, self.cos * y - self.sin * x)


GROUND_FRAME = Frame(0.0, 0.0, 0.0, 1.0, 0.0)  # for joints
GROUND_FRAME_AT_REST = Frame(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)  # for force elements: with velocities


def frame_over_time(names: Sequence[str], q: Float[Array, "T bodies 3"], v: Float[Array, "T bodies 3"], body: str) -> Frame:
    """Return the frame of a body over time: each of its numbers is an array (T,).

    Args:
        names: The bodies, in the order of q and v.
        q: Coordinates (m, m, rad).
        v: Velocities (m/s, m/s, rad/s).
        body: The name of a body, or "ground".

    Returns:
        The frame, with its velocities.

    Raises:
        ValueError: There is no body of this name.
    """
    if body == GROUND:
        zero = jnp.zeros_like(q[..., 0, 0])
        return Frame(zero, zero, zero, zero + 1.0, zero, zero, zero, zero)
    if body not in names:
        cure = "a pin is found by udk.path(mechanism, solution, pin)"
        raise ValueError(f'no body named "{body}"; there are {", ".join(names)}; {cure}')
    k = names.index(body)
    (x, y, angle), (vx, vy, omega) = (jnp.moveaxis(jnp.asarray(s)[..., k, :], -1, 0) for s in (q, v))
    return Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)


def between(points: Float[Array, "2 2"] | Sequence[PlaneVector], one: Frame, two: Frame) -> Point:
    """Return the vector from `points[0]` of body 1 to `points[1]` of body 2.

    Args:
        points: The two points, each in the frame of its body (m).
        one: The frame of body 1.
        two: The frame of body 2.

    Returns:
        The vector in ground coordinates (m).
    """
    p, q = one.point(points[0]), two.point(points[1])
    return Point(q.x - p.x, q.y - p.y)


def stack_coordinates(vectors: Sequence[Array], numbers: Sequence[Array]) -> Float[Array, "bodies 3"]:
    """Return one array with a row for each body: the two components of its vector, then its number."""
    concrete = not is_traced((vectors, numbers))  # NumPy is faster for many small arrays
    if concrete:
        return number(np.column_stack([np.stack([np.asarray(x) for x in vectors]), [np.asarray(x) for x in numbers]]))
    return jnp.column_stack([jnp.stack(vectors), jnp.stack(numbers)])
