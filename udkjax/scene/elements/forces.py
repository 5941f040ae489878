"""Force elements: springs, dampers and applied loads, each defined by a potential energy, by loads, or by both.

Conventions that hold throughout: forces are in ground axes (N), torques are positive anticlockwise and about the centre of mass
of the body that they act on (N m). Each element lists the loads on its bodies in the order of `bodies`; the loads on body 1 are
the reactions to the loads on body 2.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.printing import PrintsLine
from udkjax.scene.elements.bodies import Frame, Point, between
from udkjax.scene.elements.fields import BODY, NOT_NEGATIVE, given_names, given_number, given_or_none
from udkjax.scene.elements.held import Held, given_sampled, value_at

Wrench = tuple[Number, Number, Number]  # force x, force y (N, ground axes), torque about the centre of mass (N m)

# Fraction of a spring's length. Ends that are closer count as coincident, because the derivatives of the force's direction lose
# more digits the closer the ends are: all digits between pins that a joint holds together.
NEAREST_ENDS = float(np.sqrt(np.finfo(float).eps))


class ForceElement(PrintsLine):
    """A force element. Subclass it and write `potential`, `loads` or both; a method that is not written costs nothing.

    If its loads are piecewise smooth in time, `breakpoints` lists the times where the pieces meet; loads may jump there.

    Args:
        bodies: the names of the bodies whose frames `potential` and `loads` receive.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    n_bodies: ClassVar[int] = 2  # number of `bodies`, for types of the scene format

    @property
    def may_have_kinks(self) -> bool:
        """False for the types of this package's scenes, whose comparisons of the state only guard against division by zero."""
        return not type(self).__module__.startswith(f"{__package__}.")

    def potential(self, t: Number, *frames: Frame) -> Number | None:
        """Return the potential energy V (J), whose generalized force is -dV/dq; None (the default): no energy."""
        return None

    def loads(self, t: Number, *frames: Frame) -> Sequence[Wrench] | None:
        """Return (force x, force y, torque about the centre of mass) for each body, in ground axes (N, N m); None: no loads."""
        return None

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where the loads are not smooth: steps end there, and no interpolation crosses them. Empty by default."""
        return ()

    def piece(self, t: Number, *frames: Frame) -> Number | None:
        """Return the index of the current smooth piece of the loads, or None if they are smooth everywhere (the default).

        Loads are continuous where pieces meet. No interpolation crosses from one piece to another. If the index depends on t,
        runs have no second derivatives.
        """
        return None


class Spring(ForceElement):
    """A spring between two points, V = 1/2 stiffness (|d| - length)^2, d from point 1 to point 2, with a damper in parallel.

    Longer than `length`, it pulls the points together. The damper's force on point 2 along d/|d| is -damping d|d|/dt, and on
    point 1 the opposite. The order of the bodies does not matter.

    Where its ends coincide, d has no direction and the force of a spring with a length is zero, so that it has no effect between
    pins that a joint holds together. Where its ends pass through each other the force jumps: the motion is right, but its
    derivatives lack the contribution of the jump.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the ends, each in the frame of its body (m).
        stiffness: in N/m, not negative.
        length: free length (m), not negative.
        damping: in N s/m, not negative; None: no damper.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    length: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    damping: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)

    def potential(self, t, *frames):
        d = between(self.points, *frames)
        distance = d.norm(NEAREST_ENDS * self.length)
        # |d| has a kink where the ends meet, but the energy of a spring without a length is smooth: |d|^2 is d.d.
        square = jnp.where(self.length > 0, (distance - self.length) ** 2, d.dot(d) - (2 * distance - self.length) * self.length)
        return 0.5 * self.stiffness * square

    def loads(self, t, *frames):
        if self.damping is None:
            return None
        frame1, frame2 = frames
        d, v1, v2 = between(self.points, frame1, frame2), frame1.velocity(self.points[0]), frame2.velocity(self.points[1])
        square, rate = d.dot(d), d.dot(Point(v2.x - v1.x, v2.y - v1.y))
        pull = self.damping * rate / jnp.where(square > 0, square, 1.0)
        force = Point(pull * d.x, pull * d.y)  # on point 1
        return [_load(frame1, self.points[0], force), _load(frame2, self.points[1], Point(-force.x, -force.y))]


class TorsionSpring(ForceElement):
    """A torsion spring, V = 1/2 stiffness (theta2 - theta1 - angle)^2, with a damper in parallel.

    The torque on body 2 is -stiffness (theta2 - theta1 - angle) - damping (omega2 - omega1), anticlockwise, and on body 1 the
    opposite. The relative angle is not wrapped: after a turn it has grown by 2 pi.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        stiffness: in N m/rad, not negative.
        damping: in N m s/rad, not negative; None: no damper.
        angle: theta2 - theta1 without load (rad); a `Held` makes it the setpoint of a servo.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    damping: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    angle: Float[Array, ""] | Held = eqx.field(converter=given_sampled, default=0.0)

    def potential(self, t, *frames):
        frame1, frame2 = frames
        return 0.5 * self.stiffness * (frame2.angle - frame1.angle - value_at(self.angle, t)) ** 2

    def loads(self, t, *frames):
        if self.damping is None:
            return None
        frame1, frame2 = frames
        return couple(-self.damping * (frame2.omega - frame1.omega))


class Force(ForceElement):
    """A force on a body at a `point` that moves with it; `vector` is fixed to the ground, or turns with the body.

    Args:
        body: the name of the body.
        vector: the force (N) on the body: constant, or a `Held` of values (N, 2).
        point: point of application, in the body's frame (m).
        frame: the axes of the vector's components: "ground" or "body".
    """

    bodies: tuple[str, ...] = eqx.field(static=True, init=False, default_factory=tuple)
    body: str = eqx.field(static=True, metadata=BODY)
    vector: Float[Array, "2"] | Held = eqx.field(converter=given_sampled)
    point: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))
    frame: Literal["ground", "body"] = eqx.field(static=True, default="ground")

    def __post_init__(self):
        self.bodies = (self.body,) if isinstance(self.body, str) else ()  # anything else is refused by the check of `body`

    def loads(self, t, *frames):
        (body,) = frames
        vector = value_at(self.vector, t)
        force = body.vector(vector) if self.frame == "body" else Point(vector[0], vector[1])
        return [_load(body, self.point, force)]


class Torque(ForceElement):
    """A torque `value` on body 2, anticlockwise positive, and -value on body 1.

    Args:
        bodies: the names of the two bodies, the reacting one first; "ground" is the fixed frame.
        value: in N m: constant, or a `Held`.
    """

    value: Float[Array, ""] | Held = eqx.field(converter=given_sampled)

    def loads(self, t, *frames):
        return couple(value_at(self.value, t))


def _load(frame: Frame, point: Float[Array, "2"], force: Point) -> Wrench:
    """Return the load about the centre of mass of a force, in ground axes, at a point given in the body's frame."""
    arm = frame.vector(point)
    return force.x, force.y, arm.x * force.y - arm.y * force.x


def load_at(frame: Frame, point: Point, force: Point) -> Wrench:
    """Return the load about the centre of mass of a force on a body at a point in ground coordinates."""
    return force.x, force.y, (point.x - frame.x) * force.y - (point.y - frame.y) * force.x


def couple(torque: Number) -> list[Wrench]:
    """Return the loads of a torque on body 2 and its reaction on body 1, in the order of the bodies."""
    return [(0.0, 0.0, -torque), (0.0, 0.0, torque)]
