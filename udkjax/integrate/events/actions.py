"""Actions: what an event does."""

from typing import Literal

import equinox as eqx
from jaxtyping import Array, Float

from udkjax.integrate.events.checks import number_if_any
from udkjax.printing import PrintsLine
from udkjax.scene.joints import Joint


class Action(PrintsLine):
    """The base of all actions."""


class Stop(Action):
    """End the run: `Result.event_stop`."""


class Log(Action):
    """Note time and state, and go on."""


class Impact(Action):
    """Reverse the rate of the condition, g >= 0 being what is allowed: g_dot+ = -restitution g_dot-.

    All contacts that are closed at the instant are hit together: no impulse pulls, none is penetrated, energy never grows
    (`impacts`). The jump of the velocities is the smallest in the metric of M that keeps all constraints: no friction. Rebounds
    that have become too small to follow end in rest: with `at_rest="hold"` the condition is held at zero, as a constraint, until
    the contact would have to pull; with "stop" the run ends there (`Result.at_rest`).

    Args:
        restitution: the part of the approaching speed that comes back, 0 to 1.
        at_rest: "hold": rest in contact; "stop": end the run.
    """

    restitution: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    at_rest: Literal["hold", "stop"] = eqx.field(static=True, default="hold")


class Release(Action):
    """Take a joint or driver away, from then on: one of the scene's, or what `Attach` or `Lock` has added, by its name.

    Args:
        name: of the joint or driver.
    """

    name: str = eqx.field(static=True)


class Attach(Action):
    """Add a joint, under a `name`, from then on. Numbers that it leaves to the guess are those of the state at the event.

    Velocities jump as in an inelastic impact: the smallest change in the metric of M that the new constraints allow.

    Args:
        joint: such as `Revolute(...)`.
        name: under which it is added.
    """

    joint: Joint
    name: str = eqx.field(static=True)


class Lock(Action):
    """Stop all motion in a revolute or prismatic joint or a slot's sliding, where it is, as `Attach` does.

    Its constraint has the name of the joint with ".lock" behind it: `Release("elbow.lock")` takes it away again.

    Args:
        joint: the name of a joint of the scene.
    """

    joint: str = eqx.field(static=True)
