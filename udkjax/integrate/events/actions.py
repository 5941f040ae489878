"""Actions: what an event does.

A new action is a class here, its name in the stubs, and, if nothing below says what it does, a jump of its own in `jumps`. The
plan of a run, its phases and pages read the attributes and methods of `Action`; no other module asks for the type of an action.
"""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.arrays import number, optional_number
from udkjax.integrate.events.checks import number_if_any, require_joint, require_name_text, require_restitution
from udkjax.integrate.events.conditions import JointCoordinate, joint_coordinate, require_name
from udkjax.printing import PrintsLine
from udkjax.requirements import describe
from udkjax.scene.bodies import GROUND
from udkjax.scene.joints import Angle, Joint, fill
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote


class Action(PrintsLine):
    """The base of all actions, which changes nothing about constraints or velocities.

    Attributes:
        is_impact: reverses the rate of its condition, which then falls to zero and depends on positions alone.
        stops: ends the run.
        changes: changes the motion; an event that does not leaves contacts as they are.
        adds: adds a joint, its `addition`.
        on_page: the engine of live pages knows it.
    """

    is_impact: ClassVar[bool] = False
    stops: ClassVar[bool] = False
    changes: ClassVar[bool] = True
    adds: ClassVar[bool] = False
    on_page: ClassVar[bool] = False

    @property
    def rebound(self) -> Any:
        """The part of the approaching speed that comes back."""
        return 0.0

    @property
    def rest(self) -> Literal["", "hold", "stop"]:
        """The consequence when an impact comes to rest: "hold" the contact, or "stop" the run."""
        return ""

    @property
    def removed(self) -> frozenset[str]:
        """The names of the constraints that it takes away."""
        return frozenset()

    def addition(self, mechanism: Mechanism, where: str) -> tuple[str, Joint] | None:
        """Return the name of the joint that it adds, and the joint, without the numbers that the state at the event decides."""
        return None

    def check(self, mechanism: Mechanism, where: str):
        """Raise an error, whose message begins with `where`, if its arguments do not fit a mechanism."""

    def has_usable_numbers(self) -> Bool[Array, ""]:
        """Tell whether its numbers, which may be traced, are within their limits."""
        return jnp.array(True)


class Stop(Action):
    """End the run: `Result.event_stop`."""

    stops = True
    changes = False
    on_page = True


class Log(Action):
    """Record time and state, and go on."""

    changes = False
    on_page = True


class Impact(Action):
    """Reverse the rate of the condition, g >= 0 being what is allowed: g_dot+ = -restitution g_dot-.

    All contacts that are closed at the instant are hit together: no impulse pulls, none is penetrated, energy never grows
    (`impacts`). The jump of the velocities is the smallest in the metric of M that keeps all constraints: no friction. Rebounds
    that have become too small to follow end in rest: with `at_rest="hold"` the condition is held at zero, as a constraint, until
    the contact would have to pull; with "stop" the run ends there (`Result.at_rest`).

    Args:
        restitution: ratio of the rebound speed to the approach speed, 0 to 1.
        at_rest: "hold": rest in contact; "stop": end the run.
    """

    restitution: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    at_rest: Literal["hold", "stop"] = eqx.field(static=True, default="hold")

    is_impact = True
    on_page = True

    @property
    def rebound(self):
        return self.restitution

    @property
    def rest(self):
        return self.at_rest

    def check(self, mechanism, where):
        require_restitution(f"{where}: the restitution", self.restitution)
        if not isinstance(self.at_rest, str) or self.at_rest not in ("hold", "stop"):
            raise ValueError(f'{where}: at_rest must be "hold" or "stop", {describe(self.at_rest)}')

    def has_usable_numbers(self):
        return (self.restitution >= 0) & (self.restitution <= 1)


class Release(Action):
    """Remove a joint or driver from then on, by its name: one of the scene's, or one that `Attach` or `Lock` has added.

    Args:
        name: name of the joint or driver.
    """

    name: str = eqx.field(static=True)

    @property
    def removed(self):
        return frozenset([self.name])

    def check(self, mechanism, where):
        require_name_text(f"{where}: the name of Release", self.name)


class Attach(Action):
    """Add a joint, under a `name`, from then on. Numbers that it leaves to the guess are those of the state at the event.

    Velocities jump as in an inelastic impact: the smallest change in the metric of M that the new constraints allow.

    Args:
        joint: such as `Revolute(...)`.
        name: under which it is added.
    """

    joint: Joint
    name: str = eqx.field(static=True)

    adds = True

    def addition(self, mechanism, where):
        return self.name, self.joint

    def check(self, mechanism, where):
        require_name_text(f"{where}: the name of Attach", self.name)
        require_joint(f"{where}: the joint of Attach", self.joint)
        if self.name in mechanism.constraints:
            raise ValueError(f"{where}: {quote(self.name)} is in the scene already; attach the joint under another name")
        for body in self.joint.bodies:
            require_name(body, [*mechanism.body_names, GROUND], where, "body")


class Lock(Action):
    """Stop all motion in a revolute or prismatic joint or a slot's sliding, where it is, as `Attach` does.

    Its constraint is named after the joint, with ".lock" appended: `Release("elbow.lock")` removes it again.

    Args:
        joint: the name of a joint of the scene.
    """

    joint: str = eqx.field(static=True)

    adds = True

    def addition(self, mechanism, where):
        at = joint_coordinate(mechanism, self.joint, where)
        if at.points is None or at.axis is None:
            return f"{self.joint}.lock", Angle(at.bodies)
        return f"{self.joint}.lock", Displacement(at.bodies, at.points, at.axis)

    def check(self, mechanism, where):
        require_name_text(f"{where}: the joint of Lock", self.joint)
        joint_coordinate(mechanism, self.joint, where)


class Displacement(Joint):
    """Point 2 stays where it is along `axis` of body 1. 1 row (m): its distance from point 1 along it, less `position`."""

    points: Float[Array, "2 2"] = eqx.field(converter=number)
    axis: Float[Array, ""] = eqx.field(converter=number)
    position: Float[Array, ""] | None = eqx.field(converter=optional_number, default=None)

    def residual(self, t, *frames):
        assert self.position is not None  # `complete` fills it in
        return [self._along(*frames) - self.position]

    def complete(self, *frames):
        return fill(self, "position", self._along(*frames))

    def _along(self, one, two):
        return JointCoordinate(self.bodies, self.points, self.axis).of(one, two)
