"""Actions: the consequences of events.

To add an action, write a class here (CONTRIBUTING.md). The plan of a run, its phases and pages use attributes and methods of
`Action`, never the type of an action. If these cannot describe the effect, add an attribute, and use it in `jumps`: one that does
not depend on numbers through a mask of `EventPlan`, a number through `NUMBERS_OF_ACTIONS`, so that both engines and derivatives
have it.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from udkjax.arrays import number, optional_number
from udkjax.integrate.events.law.checks import number_if_any, require_friction, require_joint, require_restitution
from udkjax.integrate.events.law.conditions import JointCoordinate, joint_coordinate, require_name
from udkjax.printing import PrintsLine
from udkjax.requirements import describe, require_text
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Angle, Joint, fill
from udkjax.scene.mechanism import Mechanism


class Action(PrintsLine):
    """The base of all actions, which changes nothing about constraints or velocities.

    Attributes:
        is_impact: whether the action reverses the rate of its event's condition, which must fall to zero and depend on positions
            alone.
        stops: whether the action ends the run.
        changes: whether the action changes the motion; if not, contacts stay as they are.
        adds: whether the action adds a joint, its `addition`.
        needs_joints: whether the action changes joints, which a user-defined system lacks.
    """

    is_impact: ClassVar[bool] = False
    stops: ClassVar[bool] = False
    changes: ClassVar[bool] = True
    adds: ClassVar[bool] = False
    needs_joints: ClassVar[bool] = True

    @property
    def rebound(self) -> Any:
        """The ratio of the rebound speed to the approach speed of an impact; 0 for other actions."""
        return 0.0

    @property
    def friction(self) -> Any:
        """The coefficient of friction of an impact; None for an impact without friction, and for other actions."""
        return None

    @property
    def rest(self) -> Literal["", "hold", "stop"]:
        """The consequence when an impact comes to rest: "hold" the contact, or "stop" the run; "" for other actions."""
        return ""

    @property
    def turn(self) -> tuple[int, float, float] | None:
        """The index of the side that the action turns, and factor and shift of `TurnSide` (kinks.py); None if it turns none."""
        return None

    @property
    def removed(self) -> frozenset[str]:
        """The names of the constraints that the action removes."""
        return frozenset()

    def addition(self, mechanism: Mechanism, where: str) -> tuple[str, Joint] | None:
        """Return the name and the joint that the action adds; None if it adds none.

        The joint lacks the numbers that depend on the state at the event. Error messages begin with `where`.
        """
        return None

    def check(self, mechanism: Any, where: str):
        """Raise an error, whose message begins with `where`, if the action does not fit the mechanism; by default it fits."""

    def has_usable_numbers(self) -> Bool[Array, ""]:
        """Return True if the numbers of the action, which may be traced, are within their limits."""
        return jnp.array(True)


# The attributes of actions that are numbers, which may be traced, in the order of `numbers_of_actions`. None counts as zero.
NUMBERS_OF_ACTIONS = ("rebound", "friction")


def numbers_of_actions(actions: Sequence[Action], xp: ModuleType) -> Float[Any, "N E"]:
    """Return the numbers of E actions (N, E), one row for each of the N names in `NUMBERS_OF_ACTIONS`."""

    def row(name: str) -> Any:
        values = [getattr(action, name) for action in actions]
        return xp.stack([xp.asarray(0.0 if x is None else x, float) for x in values])

    return xp.stack([row(name) for name in NUMBERS_OF_ACTIONS])


class Stop(Action):
    """End the run: `Result.event_stop`."""

    stops = True
    changes = False
    needs_joints = False


class Log(Action):
    """Record time and state, and go on."""

    changes = False
    needs_joints = False


class Impact(Action):
    """Reverse the rate of the condition, to keep g >= 0: g_dot+ = -restitution g_dot-.

    All contacts that are closed at that instant are hit together: no impulse pulls, no contact is penetrated, and energy never
    grows (`impacts`). The jump of the velocities is the smallest in the metric of M that keeps all constraints: no friction. A
    contact whose rebounds are too small to follow comes to rest: with `at_rest="hold"` the condition is held at zero, as a
    constraint, until the contact would have to pull; with "stop" the run ends there (`Result.at_rest`).

    Args:
        restitution: ratio of the rebound speed to the approach speed, 0 to 1.
        at_rest: "hold": rest in contact; "stop": end the run.
    """

    restitution: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    at_rest: Literal["hold", "stop"] = eqx.field(static=True, default="hold")

    is_impact = True
    needs_joints = False

    @property
    def rebound(self):
        return self.restitution

    @property
    def rest(self):
        return self.at_rest

    def check(self, mechanism, where):
        require_restitution(f"{where}: the restitution", self.restitution)
        if self.at_rest != "stop":
            cure = 'let the run end there, Impact(restitution, at_rest="stop"), or go on with a system that has the row'
            mechanism.require_bodies(f"{where}: the constraints of a ConstrainedSystem do not change; {cure}")
        if not isinstance(self.at_rest, str) or self.at_rest not in ("hold", "stop"):
            raise ValueError(f'{where}: at_rest must be "hold" or "stop", {describe(self.at_rest)}')

    def has_usable_numbers(self):
        return (self.restitution >= 0) & (self.restitution <= 1)


class RubbingImpact(Impact):
    """An impact of a contact with friction: see `Contact`.

    The impulse along the line is within the cone of friction, and the law of restitution is Poisson's (`impulses_with_friction`).
    """

    coefficient: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    static_coefficient: Float[Array, ""] | None = eqx.field(converter=number_if_any, default=None)

    @property
    def friction(self):
        return self.coefficient

    def check(self, mechanism, where):
        super().check(mechanism, where)
        require_friction(where, self.coefficient, self.static_coefficient, self.at_rest)

    def has_usable_numbers(self):
        given = [x for x in (self.coefficient, self.static_coefficient) if x is not None]
        return super().has_usable_numbers() & jnp.all(jnp.stack([(x >= 0) & jnp.isfinite(x) for x in given]))


class Release(Action):
    """Remove a joint or driver, and the friction in it: one of the scene, or a joint that `Attach` or `Lock` has added.

    Args:
        name: name of the joint or driver.
    """

    name: str = eqx.field(static=True)

    @property
    def removed(self):
        return frozenset([self.name])

    def check(self, mechanism, where):
        require_text(f"{where}: the name of Release", self.name)


class Attach(Action):
    """Add a joint. Numbers that default to the initial guess are taken from the state at the event.

    The new joint replaces a joint of the same name that events have added before. The name may be that of a joint of the scene
    which an event releases: the added joint then takes its place. Velocities jump as in an inelastic impact: the smallest
    change in the metric of M that the new constraints allow.

    Args:
        joint: the joint to add, such as `Revolute(...)`.
        name: the name of the added joint.
    """

    joint: Joint
    name: str = eqx.field(static=True)

    adds = True

    def addition(self, mechanism, where):
        return self.name, self.joint

    def check(self, mechanism, where):
        require_text(f"{where}: the name of Attach", self.name)
        require_joint(f"{where}: the joint of Attach", self.joint)
        for body in self.joint.bodies:
            require_name(body, [*mechanism.body_names, GROUND], where, "body")


class Lock(Action):
    """Lock a revolute or prismatic joint, or the sliding of a slot, in its position at the event, as if by `Attach`.

    The added constraint is named after the joint, with ".lock" appended: `Release("elbow.lock")` removes it again.

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
        require_text(f"{where}: the joint of Lock", self.joint)
        joint_coordinate(mechanism, self.joint, where)


class Displacement(Joint):
    """Point 2 keeps its place along `axis` of body 1. 1 row (m): its distance from point 1 along the axis, less `position`."""

    points: Float[Array, "2 2"] = eqx.field(converter=number)
    axis: Float[Array, ""] = eqx.field(converter=number)
    position: Float[Array, ""] | None = eqx.field(converter=optional_number, default=None)

    def residual(self, t, *frames):
        assert self.position is not None  # set by `complete`
        return [self._along(*frames) - self.position]

    def complete(self, *frames):
        return fill(self, "position", self._along(*frames))

    def _along(self, one, two):
        return JointCoordinate(self.bodies, self.points, self.axis).of(one, two)
