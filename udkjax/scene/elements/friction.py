"""Friction in joints: smooth, or set-valued, so that joints stick."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.scene.elements.bodies import Frame, Point
from udkjax.scene.elements.fields import NOT_NEGATIVE, POSITIVE, RUBBING, given_number, given_or_none
from udkjax.scene.elements.forces import ForceElement, Wrench, couple, load_at
from udkjax.scene.elements.joints import Joint, Prismatic, Revolute, Slot

SLIDING_SPEED = 1e-3  # default speed of sliding at which smooth friction is largest (m/s)


def _is_concrete_number(x: Any) -> TypeGuard[float]:
    if isinstance(x, Tracer) or not isinstance(x, int | float | np.generic | np.ndarray | jax.Array):
        return False
    array = np.asarray(x)
    return array.shape == () and array.dtype.kind in "fiu"


class Friction(ForceElement):
    """Friction in a joint: a constant torque, or a coefficient times the load that the joint carries, or both.

    In a revolute joint with s = `radius` (omega2 - omega1), the speed of sliding, and the force R between the two bodies, the
    torque on body 2 is

        -torque tanh((omega2 - omega1) / velocity) - mu(s) radius |R|,

    and on body 1 the opposite. In a slot or a prismatic joint the force along the axis on body 2 is -mu(s) |N|, at its point,
    with s the speed of point 2 along the axis and N the normal force; on body 1 the opposite. With the `length` of the guide of
    a prismatic joint, whose middle is point 2, N and the torque T between the bodies press on its edges, and |N| becomes
    |N / 2 + T / length| + |N / 2 - T / length|. The coefficient is continuous (Brown and McPhee 2016),

        mu(s) = coefficient tanh(4 x) + (static_coefficient - coefficient) x / (x^2 / 4 + 3 / 4)^2 + viscous s,    x = s / speed,

    largest at s = `speed`, and zero at rest: what sticks in reality creeps slowly. R and N follow from the same equations as the
    accelerations (`udkjax.equations.friction.rubbing`). With law="set-valued", Coulomb's law, the coefficient is

        mu(s) = coefficient sign(s) + viscous s

    while the joint slides. At rest the joint sticks: a run holds it, as a constraint, while its force is at most `torque` +
    `static_coefficient` times the load. At a single state the same law
    decides for joints whose speed is zero, as in `udkjax.accelerations`.

    Args:
        joint: the name of a revolute joint; with a coefficient also of a slot or a prismatic joint.
        torque: constant torque of dry friction (N m), not negative; needs `velocity`, except in the set-valued law.
        velocity: relative angular velocity over which the constant torque is smoothed (rad/s), greater than zero.
        coefficient: coefficient of friction while sliding, not negative.
        radius: radius of the pin (m), greater than zero; for a revolute joint with a coefficient.
        static_coefficient: largest coefficient, reached at `speed` or, in the set-valued law, at rest; at least `coefficient`,
            which is the default.
        speed: speed of sliding at which the smooth coefficient is largest (m/s), greater than zero; by default 0.001.
        viscous: growth of the coefficient with the speed of sliding (s/m), not negative.
        length: length of the guide of a prismatic joint (m), greater than zero; by default only |N| counts.
        law: "smooth": continuous, the joint creeps; "set-valued": the joint sticks.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, init=False, default_factory=tuple)
    joint: str = eqx.field(static=True, metadata=RUBBING)
    torque: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    velocity: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)
    coefficient: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    radius: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)
    static_coefficient: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    speed: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)
    viscous: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=NOT_NEGATIVE)
    length: Float[Array, ""] | None = eqx.field(converter=given_or_none, default=None, metadata=POSITIVE)
    law: Literal["smooth", "set-valued"] = eqx.field(static=True, default="smooth")

    def __post_init__(self):
        if self.speed is None and self.law == "smooth":
            self.speed = given_number(SLIDING_SPEED)

    @property
    def rubs(self) -> bool:
        """True if the friction depends on the load of its joint: it has a coefficient."""
        return self.coefficient is not None

    @property
    def sticks(self) -> bool:
        """True if the law is set-valued, so that the joint may stick."""
        return self.law == "set-valued"

    @staticmethod
    def may_stick(forces: Iterable[ForceElement]) -> bool:
        """Return True if any of the given force elements is friction with the set-valued law."""
        return any(isinstance(force, Friction) and force.sticks for force in forces)

    @staticmethod
    def names_in(forces: Mapping[str, ForceElement]) -> tuple[str, ...]:
        """Return the names of those of the given force elements that are friction."""
        return tuple(name for name, force in forces.items() if isinstance(force, Friction))

    @staticmethod
    def mistakes(given: Mapping[str, object], joint: type | None) -> Iterator[str]:
        """Iterate over messages about numbers that are missing or do not fit, each of the form "name: message".

        Args:
            given: The numbers by name.
            joint: The class of the joint; None: unknown.
        """
        has_torque, rubs, turns = "torque" in given, "coefficient" in given, joint is None or issubclass(joint, Revolute)
        if not has_torque and not rubs:
            yield "coefficient: give a coefficient, or a constant torque"
        sticks = given.get("law") == "set-valued"
        if has_torque != ("velocity" in given) and not sticks:
            yield "velocity: a constant torque is smoothed over a velocity: give both, or neither"
        for name in ("velocity", "speed"):
            if name in given and sticks:
                yield f"{name}: the set-valued law is not smoothed: leave it out"
        for name in ("radius", "static_coefficient", "viscous", "length"):
            if name in given and not rubs:
                yield f"{name}: it belongs to a coefficient, which is missing"
        if rubs and "static_coefficient" in given:
            yield from Friction.mistakes_of_coefficients(given["coefficient"], given["static_coefficient"])
        if joint is None:
            return
        if has_torque and not turns:
            yield f"torque: a {joint.__name__.lower()} does not turn: give a coefficient"
        if rubs and turns != ("radius" in given):
            yield "radius: " + ("missing: the radius of the pin" if turns else "it belongs to a revolute joint")
        if "length" in given and not issubclass(joint, Prismatic):
            yield "length: it belongs to a prismatic joint"

    @staticmethod
    def mistakes_of_coefficients(sliding: object, static: object) -> Iterator[str]:
        """Yield a message if the static coefficient is less than the sliding one: a joint at rest could not begin to slide."""
        numbers = [float(x) for x in (sliding, static) if _is_concrete_number(x)]
        if len(numbers) == 2 and numbers[1] < numbers[0]:
            yield f"static_coefficient: must be at least the coefficient of sliding, {numbers[0]:g}, not {numbers[1]:g}"

    def loads(self, t, *frames):
        if self.torque is None:
            return None
        frame1, frame2 = frames
        return couple(-self._torque_at(frame2.omega - frame1.omega))

    def rubbing_loads(self, joint: Joint, multipliers: Sequence[Number], t: Number, *frames: Frame) -> Sequence[Wrench]:
        """Return the loads on the joint's bodies that depend on the load of the joint, in the form of `loads`.

        Args:
            joint: The joint.
            multipliers: The multipliers of its rows; the loads are homogeneous in these, of degree one.
            t: Time (s).
            frames: The frames of its bodies.
        """
        frame1, frame2 = frames
        _, coefficient, size = self.terms(joint, multipliers, *frames)
        if isinstance(joint, Revolute):
            assert self.radius is not None  # a mistake
            return couple(-coefficient * self.radius * size)
        assert isinstance(joint, Slot | Prismatic)
        point, axis = frame2.point(joint.points[1]), frame1.vector((jnp.cos(joint.axis), jnp.sin(joint.axis)))
        pull = -coefficient * size
        force = Point(pull * axis.x, pull * axis.y)  # on body 2
        return [load_at(frame1, point, Point(-force.x, -force.y)), load_at(frame2, point, force)]

    def terms(self, joint: Joint, multipliers: Sequence[Number], *frames: Frame) -> tuple[Number, Number, Number]:
        """Return the speed of sliding s (m/s), mu(s), and the load (N) that mu(s) multiplies."""
        speed = self.sliding_speed(joint, *frames)
        if isinstance(joint, Revolute):
            assert self.radius is not None  # a mistake
            speed = self.radius * speed
        return speed, self._coefficient_at(speed), self._load_of(joint, multipliers)

    @staticmethod
    def sliding_speed(joint: Joint, frame1: Frame, frame2: Frame) -> Number:
        """Return omega2 - omega1 of a revolute joint (rad/s), or the speed of point 2 along the axis (m/s)."""
        if isinstance(joint, Revolute):
            return frame2.omega - frame1.omega
        assert isinstance(joint, Slot | Prismatic)
        point, axis = frame2.point(joint.points[1]), frame1.vector((jnp.cos(joint.axis), jnp.sin(joint.axis)))
        rate = frame2.velocity(joint.points[1])
        speed = axis.x * (rate.x - frame1.vx + frame1.omega * (point.y - frame1.y))
        return speed + axis.y * (rate.y - frame1.vy - frame1.omega * (point.x - frame1.x))

    def largest_force(self, joint: Joint, multipliers: Sequence[Number]) -> Number:
        """Return the largest friction force (N), or torque in a revolute joint (N m), with which the set-valued law can stick.

        Args:
            joint: The joint.
            multipliers: The multipliers of its rows.
        """
        total: Number = 0.0 if self.torque is None else self.torque
        if self.coefficient is None:
            return total
        arm = self.radius if isinstance(joint, Revolute) else None
        size = self._load_of(joint, multipliers) if arm is None else arm * self._load_of(joint, multipliers)
        return total + (self.coefficient if self.static_coefficient is None else self.static_coefficient) * size

    def edge_loads(self, joint: Joint, multipliers: Sequence[Number]) -> list[Number]:
        """Return the signed loads (N) whose magnitudes the coefficient multiplies; an empty list for a revolute joint.

        A guide with a length has two, those of its edges; a slot, or a guide without a length, has one.
        """
        if isinstance(joint, Revolute):
            return []
        if self.length is None:
            return [multipliers[0]]
        half, couple = multipliers[0] / 2, multipliers[1] / self.length
        return [half + couple, half - couple]

    def _load_of(self, joint: Joint, multipliers: Sequence[Number]) -> Number:
        """Return the load (N) that the coefficient multiplies: |R|, or |N| of the edges of a guide."""
        if isinstance(joint, Revolute):
            x, y = multipliers
            square = x * x + y * y
            return jnp.where(square == 0, 0.0, jnp.sqrt(jnp.where(square == 0, 1.0, square)))  # NaN stays: it is a jam
        return sum(map(jnp.abs, self.edge_loads(joint, multipliers)))

    def _direction(self, speed: Number) -> Number:
        """Return the sign of a speed, 0 at rest."""
        return jnp.where(speed > 0, 1.0, jnp.where(speed < 0, -1.0, 0.0))

    def _torque_at(self, rate: Number) -> Number:
        """Return the torque of the constant friction `torque` (N m), smoothed or set-valued, at an angular velocity (rad/s).

        It has the sign of the angular velocity.
        """
        assert self.torque is not None
        if self.sticks:
            return self.torque * self._direction(rate)
        assert self.velocity is not None  # a mistake
        return self.torque * jnp.tanh(rate / self.velocity)

    def _coefficient_at(self, speed: Number) -> Number:
        """Return the coefficient of friction at a sliding speed (m/s), with the sign of the speed."""
        assert self.coefficient is not None
        if self.sticks:
            total: Number = self.coefficient * self._direction(speed)
        else:
            assert self.speed is not None  # set by __post_init__
            x = speed / self.speed
            total = self.coefficient * jnp.tanh(4 * x)
            if self.static_coefficient is not None:
                total = total + (self.static_coefficient - self.coefficient) * x / (x * x / 4 + 0.75) ** 2
        return total if self.viscous is None else total + self.viscous * speed
