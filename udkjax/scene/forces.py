"""Force elements: springs, dampers, constant loads and friction, each by its potential energy, its loads, or the sum of both."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.printing import PrintsLine
from udkjax.scene.bodies import Frame, Point, between
from udkjax.scene.fields import (
    BODY,
    NOT_NEGATIVE,
    POSITIVE,
    REVOLUTE,
    Number,
    given_names,
    given_number,
    given_or_none,
)
from udkjax.scene.held import Held, given_sampled, value_at

Load = tuple[Number, Number, Number]  # force x, force y (N), torque about the centre of mass (N m), in ground axes

# Of a spring's length: nearer, its ends are taken to be in one place. Derivatives of the direction of its force lose as many
# digits as the ends are near: between pins that joints hold together, where rounding alone is between them, all of them.
NEAREST = float(np.sqrt(np.finfo(float).eps))


class ForceElement(PrintsLine):
    """A force element. Subclass it and write `potential` or `loads`; the other one stays None, and costs nothing.

    One that is smooth in pieces of time names the times where they meet in `breakpoints`; its loads may jump there.

    Args:
        bodies: the names of the bodies whose frames `potential` and `loads` get.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, converter=given_names, metadata=BODY)
    n_bodies: ClassVar[int] = 2  # number of `bodies` of a type of the scene format

    def potential(self, t: Number, *frames: Frame) -> Number | None:
        """Return the potential energy V (J), or None; the load is -dV/dq."""
        return None

    def loads(self, t: Number, *frames: Frame) -> Sequence[Load] | None:
        """Return (force x, force y, torque about the centre of mass) for each attached body, in ground axes (N, N m), or None."""
        return None

    @property
    def breakpoints(self) -> Float[Array, "k"] | Sequence[Number]:
        """The times (s) where the loads are not smooth: steps end there, and no interpolation reaches across. By default none."""
        return ()

    def piece(self, t: Number, *frames: Frame) -> Number | None:
        """Return the number of the smooth piece in which the loads are, or None where they are smooth everywhere (the default).

        Where pieces meet, loads are continuous. No interpolation reaches from one piece to another.
        """
        return None


class Spring(ForceElement):
    """V = 1/2 stiffness (|d| - length)^2 between two points, d from point 1 to point 2, and a damper beside it.

    The damper's force on point 2 is -damping d|d|/dt along the line. Units: N/m, N s/m, m.

    Where its ends meet, a spring with a length pulls nowhere, since d has no direction; between pins that a joint holds together
    it changes nothing. Where its ends pass through one another its force jumps: the motion is right, its derivatives lack what
    they change by at that moment.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        points: the ends, each in its own body's frame (m).
        stiffness: in N/m, not negative.
        length: without load (m), not negative.
        damping: in N s/m, not negative; None: no damper.
    """

    points: Float[Array, "2 2"] = eqx.field(converter=given_number)
    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    length: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    damping: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)

    def potential(self, t, *frames):
        d = between(self.points, *frames)
        distance = d.norm(NEAREST * self.length)
        # Where the ends meet, |d| has a kink, but the energy of a spring without a length has none: its |d|^2 is d.d.
        square = jnp.where(self.length > 0, (distance - self.length) ** 2, d.dot(d) - (2 * distance - self.length) * self.length)
        return 0.5 * self.stiffness * square

    def loads(self, t, *frames):
        if self.damping is None:
            return None
        one, two = frames
        d, v1, v2 = between(self.points, one, two), one.velocity(self.points[0]), two.velocity(self.points[1])
        square, rate = d.dot(d), d.dot(Point(v2.x - v1.x, v2.y - v1.y))
        pull = self.damping * rate / jnp.where(square > 0, square, 1.0)
        force = Point(pull * d.x, pull * d.y)  # on point 1
        return [_load(one, self.points[0], force), _load(two, self.points[1], Point(-force.x, -force.y))]


class TorsionSpring(ForceElement):
    """V = 1/2 stiffness (theta2 - theta1 - angle)^2, and a damper: the torque -damping (omega2 - omega1) on body 2.

    Units: N m/rad, N m s/rad, rad.

    Args:
        bodies: the names of the two bodies; "ground" is the fixed frame.
        stiffness: in N m/rad, not negative.
        damping: in N m s/rad, not negative; None: no damper.
        angle: theta2 - theta1 without load (rad); a `Held` is the target of a servo.
    """

    stiffness: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    damping: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    angle: Float[Array, ""] | Held = eqx.field(converter=given_sampled, default=0.0)

    def potential(self, t, *frames):
        one, two = frames
        return 0.5 * self.stiffness * (two.angle - one.angle - value_at(self.angle, t)) ** 2

    def loads(self, t, *frames):
        if self.damping is None:
            return None
        one, two = frames
        return _couple(-self.damping * (two.omega - one.omega))


class Force(ForceElement):
    """A force `vector` (N) at a `point` of a body, in the axes of the ground, or of the body: it then turns with it.

    Args:
        body: the name of the body.
        vector: the force (N): constant, or a `Held` of values (N, 2).
        point: point of attack, in the body's frame (m).
        frame: the axes of the vector: "ground", or "body", with which it turns.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, init=False, default_factory=tuple)
    body: str = eqx.field(static=True, metadata=BODY)
    vector: Float[Array, "2"] | Held = eqx.field(converter=given_sampled)
    point: Float[Array, "2"] = eqx.field(converter=given_number, default=(0.0, 0.0))
    frame: Literal["ground", "body"] = eqx.field(static=True, default="ground")

    def __post_init__(self):
        self.bodies = (self.body,) if isinstance(self.body, str) else ()  # anything else is refused by its own name

    def loads(self, t, *frames):
        (body,) = frames
        vector = value_at(self.vector, t)
        force = body.vector(vector) if self.frame == "body" else Point(vector[0], vector[1])
        return [_load(body, self.point, force)]


class Torque(ForceElement):
    """A torque `value` (N m) on body 2, and its reaction on body 1.

    Args:
        bodies: the names of two bodies: it acts on the second, its reaction on the first.
        value: in N m, anticlockwise: constant, or a `Held`.
    """

    value: Float[Array, ""] | Held = eqx.field(converter=given_sampled)

    def loads(self, t, *frames):
        return _couple(value_at(self.value, t))


class Friction(ForceElement):
    """Friction in a revolute joint: the torque -torque tanh(omega / velocity) on body 2, omega = omega2 - omega1.

    Dry friction of `torque` (N m), smoothed over `velocity` (rad/s). Its bodies are those of its `joint`, which the mechanism
    looks up (`Mechanism.frames_of`).

    Args:
        joint: the name of a revolute joint.
        torque: of dry friction (N m), not negative.
        velocity: over which it is smoothed (rad/s), greater than zero.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, init=False, default_factory=tuple)
    joint: str = eqx.field(static=True, metadata=REVOLUTE)
    torque: Float[Array, ""] = eqx.field(converter=given_number, metadata=NOT_NEGATIVE)
    velocity: Float[Array, ""] = eqx.field(converter=given_number, metadata=POSITIVE)

    def loads(self, t, *frames):
        one, two = frames
        return _couple(-self.torque * jnp.tanh((two.omega - one.omega) / self.velocity))


def _load(frame: Frame, point: Float[Array, "2"], force: Point) -> Load:
    """Return a force at a point of a body as a load about its centre of mass."""
    arm = frame.vector(point)
    return force.x, force.y, arm.x * force.y - arm.y * force.x


def _couple(torque: Number) -> list[Load]:
    """Return the loads of a torque on body 2 and its reaction on body 1."""
    return [(0.0, 0.0, -torque), (0.0, 0.0, torque)]
