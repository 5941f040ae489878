"""Events: actions on a mechanism where a scalar condition along its motion crosses zero.

An event is a `condition`, the `direction` in which its zero counts, and an `action`. A condition receives the
frames of all bodies by name:

    udk.Event(lambda t, at: at["link"].angle, udk.Log(), name="vertical")

Ready-made ones: `JointLimit`, `Contact`. Numbers that are traced or differentiated belong in an equinox module whose `__call__`
is the condition, like the ready-made ones: numbers that a plain function closes over are fixed when it is compiled.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import is_dataclass, replace
from functools import reduce
from typing import Any, Literal, Protocol, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from udkjax.annotations import NumberLike
from udkjax.arrays import is_traced, number
from udkjax.integrate.events.law.actions import Action, Impact, RubbingImpact, Stop
from udkjax.integrate.events.law.checks import number_if_any, require_limits, require_normal, require_vector
from udkjax.integrate.events.law.conditions import (
    BodyCondition,
    Gap,
    WithinLimit,
    joint_coordinate,
    probe_arguments,
    require_name,
    sees_velocity,
)
from udkjax.printing import PrintedTable, PrintsLine, PrintsTable, units
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.requirements import ArgumentTypeError, describe, require_function, require_text
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import Mistakes
from udkjax.wording import quote, suggestion


class Event(PrintsLine):
    """An `action` that happens where a scalar `condition` crosses zero along the motion.

    `frames` maps the name of each body, and "ground", to its frame: x, y, angle, cos, sin, vx, vy, omega, `point`, `velocity`.
    `direction` is 1 for rising, -1 for falling, 0 for either; for an `Impact`, whose condition is positive before the
    zero, 0 and -1 mean the same. Only crossings count: a run that starts at a zero, or touches zero and turns back, does not
    cross it. But an `Impact` whose condition is zero at the start, and falling, happens at once.

    Args:
        condition: a function (t, frames) -> number of a mechanism, or (t, q, v) -> number of a `ConstrainedSystem`.
        action: consequence of the event: `Stop`, `Log`, `Impact`, `Release`, `Attach` or `Lock`.
        direction: 1: where the condition rises; -1: where it falls; 0: both.
        name: name in lists.
    """

    condition: Callable[..., NumberLike]
    action: Action = Stop()
    direction: int = eqx.field(static=True, default=0)
    name: str = eqx.field(static=True, default="")

    def expand(self, mechanism: Any) -> list["Event"]:
        """Return this event as a list; ready-made objects such as `JointLimit` may expand to several events."""
        return [self]


class JointLimit(PrintsLine):
    """A stop at the `lower` or `upper` end of a joint's travel, or both: an `Impact` at each.

    The coordinate of a revolute joint is theta2 - theta1 (rad), that of a prismatic joint or a slot the distance of point 2 from
    point 1 along the axis (m). The events have the name of the joint (or `name`) with ".lower" or ".upper" appended.

    Args:
        joint: the name of a revolute or prismatic joint, or of a slot.
        lower: lower end of travel (rad, m); None: no limit.
        upper: upper end of travel (rad, m); None: no limit.
        restitution: ratio of the rebound speed to the approach speed, 0 to 1.
        at_rest: "hold": rest in contact; "stop": end the run.
        name: name in lists; by default that of the joint.
    """

    joint: str = eqx.field(static=True)
    lower: Float[Array, ""] | None = eqx.field(converter=number_if_any, default=None)
    upper: Float[Array, ""] | None = eqx.field(converter=number_if_any, default=None)
    restitution: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    at_rest: Literal["hold", "stop"] = eqx.field(static=True, default="hold")
    name: str = eqx.field(static=True, default="")

    def expand(self, mechanism: Mechanism) -> list[Event]:
        """Return one event for each limit that is given."""
        require_text("JointLimit: joint", self.joint)
        require_text("JointLimit: name", self.name, may_be_empty=True)
        name, found = self.name or self.joint, []
        where = f"limit {quote(name)}"
        coordinate = joint_coordinate(mechanism, self.joint, where)
        require_limits(where, self.lower, self.upper)
        for side, limit, sign in (("lower", self.lower, 1.0), ("upper", self.upper, -1.0)):
            if limit is not None:
                action = Impact(self.restitution, self.at_rest)
                found.append(Event(WithinLimit(coordinate, limit, number(sign)), action, -1, f"{name}.{side}"))
        return found


class Contact(PrintsLine):
    """A point of a body that cannot pass a line, fixed to the ground or to another body: an `Impact` where it hits the line.

    The line goes through the point `through` of the body `on`; the `normal`, of any length, points to the allowed side. Both
    are in that body's own frame (m).

    With a `coefficient` the contact has Coulomb's friction along the line. While the point rests on the line with the normal
    force N, it slides with the force `coefficient` N, or it sticks, as a constraint, with at most `static_coefficient` N.
    In an impact the impulse along the line is at most `coefficient` times the normal one, and the restitution is Poisson's
    instead of Newton's: the ratio of the normal impulses after and before the largest compression. Energy never grows.

    Args:
        body: the name of the body that hits.
        point: point of that body, in its own frame (m).
        through: a point of the line, in the frame of `on` (m).
        normal: normal of the line, towards the allowed side, in the frame of `on`.
        restitution: ratio of the rebound speed to the approach speed, 0 to 1.
        on: the body with the line, or "ground".
        at_rest: "hold": rest in contact; "stop": end the run.
        name: name in lists.
        coefficient: coefficient of friction while sliding, not negative; by default there is no friction.
        static_coefficient: coefficient of friction while sticking, at least `coefficient`, which is the default.
    """

    body: str = eqx.field(static=True)
    point: Float[Array, "2"] = eqx.field(converter=number_if_any, default=(0.0, 0.0))
    through: Float[Array, "2"] = eqx.field(converter=number_if_any, default=(0.0, 0.0))
    normal: Float[Array, "2"] = eqx.field(converter=number_if_any, default=(0.0, 1.0))
    restitution: Float[Array, ""] = eqx.field(converter=number_if_any, default=0.0)
    on: str = eqx.field(static=True, default=GROUND)
    at_rest: Literal["hold", "stop"] = eqx.field(static=True, default="hold")
    name: str = eqx.field(static=True, default="")
    coefficient: Float[Array, ""] | None = eqx.field(converter=number_if_any, default=None)
    static_coefficient: Float[Array, ""] | None = eqx.field(converter=number_if_any, default=None)

    def expand(self, mechanism: Mechanism) -> list[Event]:
        """Return the event of the contact as a list of one."""
        for argument, text in (("body", self.body), ("on", self.on), ("name", self.name)):
            require_text(f"Contact: {argument}", text, may_be_empty=argument == "name")
        name = self.name or f"{self.body} on {self.on}"
        where = f"contact {quote(name)}"
        for body in (self.body, self.on):
            require_name(body, [*mechanism.body_names, GROUND], where, "body")
        if self.body == self.on:
            raise ValueError(f"{where}: {quote(self.body)} cannot touch itself")
        require_vector(f"{where}: point", self.point)
        require_vector(f"{where}: through", self.through)
        require_normal(f"{where}: normal", self.normal)
        gap = Gap((self.body, self.on), self.point, self.through, self.normal)
        if self.coefficient is None and self.static_coefficient is not None:
            raise ValueError(f"{where}: the static_coefficient belongs to a coefficient, which is missing")
        if self.coefficient is None:
            return [Event(gap, Impact(self.restitution, self.at_rest), -1, name)]
        numbers = self.restitution, self.at_rest, self.coefficient, self.static_coefficient
        return [Event(gap, RubbingImpact(*numbers), -1, name)]


class Events(PrintsTable):
    """The events of a run in order: times (s), states before and after, and the index of each in `names`.

    With traced numbers, or in a batch, arrays have `max_events` entries, padded with infinity, and -1 for `index`.

    Attributes:
        time: time of each event (s).
        q_before: coordinates right before each event.
        v_before: velocities right before each event.
        q_after: coordinates right after each event.
        v_after: velocities right after each event.
        count: number of events.
        names: the names of all events that may happen; "" for an index without such an event.
    """

    time: Float[Array, "events"]
    index: Int[Array, "events"]  # index of each event in `names`
    q_before: Float[Array, "events bodies 3"]
    v_before: Float[Array, "events bodies 3"]
    q_after: Float[Array, "events bodies 3"]
    v_after: Float[Array, "events bodies 3"]
    count: Int[Array, ""]
    unresolved: Float[Array, "conditions"]  # time (s) from which a condition varies too quickly to be resolved; else inf
    undefined: Bool[Array, "conditions"]  # whether a condition was NaN and ended the run
    names: tuple[str, ...] = eqx.field(static=True)

    _units = units(time="s", unresolved="s")

    def _table(self) -> PrintedTable:
        if np.ndim(self.count):
            counts = {name: np.asarray(count) for name, count in self.counts.items() if np.any(count)}
            rows = [(name, f"{count.sum()} in {np.sum(count > 0)} members") for name, count in counts.items()]
            return PrintedTable(f"events of {np.size(self.count)} members", rows)
        listed = [(t, int(k)) for t, k in zip(np.asarray(self.time), np.asarray(self.index), strict=True) if k >= 0]
        return PrintedTable(f"events: {int(self.count)}", [(f"{t:.9g} s", self.names[k]) for t, k in listed])

    def of(self, name: str) -> Float[Array, "k"]:
        """Return the times (s) of the events with this name, in a single run (not a batch)."""
        require_name(name, [x for x in self.names if x], "events", "event")
        return self.time[np.asarray(self.index) == self.names.index(name)]

    @property
    def undefined_names(self) -> str:
        """The names of the events whose NaN conditions ended a single run, as a string."""
        return ", ".join(f"event {quote(self.names[k])}" for k in np.flatnonzero(self.undefined))

    @property
    def counts(self) -> dict[str, Int[Array, ""]]:
        """The number of events by name."""
        return {name: (self.index == k).sum(-1) for k, name in enumerate(self.names) if name}


class ExpandsToEvents(Protocol):
    """An `Event`, or an object such as `JointLimit` that expands to one or several events."""

    def expand(self, mechanism: Mechanism) -> list[Event]:
        """Return the events for a mechanism."""
        ...


EventsLike: TypeAlias = ExpandsToEvents | Sequence[ExpandsToEvents] | Mapping[str, ExpandsToEvents]


def listed_events(events: EventsLike) -> tuple[ExpandsToEvents, ...]:
    """Return one event, a sequence of events, or events by name as a tuple; the keys of a mapping become the names of its events.

    Raise `ValueError` if a value of a mapping is not an event.
    """
    if isinstance(events, Mapping):
        return tuple(_called(event, name) for name, event in events.items())
    return tuple(events) if isinstance(events, Sequence) else (events,)


@cached_by_identity  # the same events again compile nothing
def _called(event: Any, name: str) -> ExpandsToEvents:
    require_text("events: name", name)
    if not hasattr(event, "expand") or not is_dataclass(event) or isinstance(event, type):
        raise ValueError(f"events[{quote(name)}]: {_expected(event)}")
    named: Any = replace(event, name=name)
    return named


def _expected(event: Any) -> str:
    return f"must be an Event, a JointLimit or a Contact, {describe(event)}"


def expand_events(events: Sequence[ExpandsToEvents], mechanism: Any) -> tuple[Event, ...]:
    """Return all events to which the given ones expand, with unique names; raise `ValueError` if one is invalid or none given."""
    found: list[Event] = []
    for k, event in enumerate(events):
        try:
            _expand(event, k, mechanism, found)
        except Mistakes:
            raise
        except ValueError as error:
            raise type(error)(f"events[{k}]: {error}") from error
    if not found:
        raise ValueError("events: the list is empty; leave it out for a run without events")
    return tuple(found)


def _expand(event: ExpandsToEvents, k: int, mechanism: Any, found: list[Event]) -> None:
    if not hasattr(event, "expand"):
        raise ValueError(_expected(event))
    if not isinstance(event, Event):
        cure = "write udk.Event(lambda t, q, v: ...) for this system"
        mechanism.require_bodies(f"a {type(event).__name__} is for mechanisms; {cure}")
    expanded: Any = event
    for one in expanded.expand(mechanism):
        require_text("name", one.name, may_be_empty=True)
        name = one.name or f"event{k + 1}"
        _check_kinds(one, f"event {quote(name)}")
        if any(name == other.name for other in found):
            raise ValueError(f"event {quote(name)}: two events have this name; give one of them another (`name=`)")
        found.append(_with_name(one, name))
        _check(found[-1], mechanism)


def has_usable_numbers(events: Sequence[Event]) -> Bool[Array, ""]:
    """Return True if the numbers of events are valid: restitutions from 0 to 1, limits in order, numbers of contacts finite.

    This is for traced numbers; concrete numbers are checked when events are expanded.
    """
    are_usable, limits = jnp.array(True), {}
    for e in events:
        if isinstance(e.condition, WithinLimit):
            limits[e.name] = e.condition.limit
        are_usable &= e.action.has_usable_numbers()
        if isinstance(e.condition, WithinLimit | Gap):
            are_usable &= jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(e.condition)]))
        if isinstance(e.condition, Gap):
            are_usable &= jnp.any(e.condition.normal != 0)
    joints = (name[: -len(".lower")] for name in limits if name.endswith(".lower"))
    return reduce(jnp.logical_and, (limits[f"{n}.lower"] <= limits.get(f"{n}.upper", jnp.inf) for n in joints), are_usable)


def _with_name(event: Event, name: str) -> Event:
    falls = event.action.is_impact and event.direction in (0, -1)  # impacts come from above zero, and do not pass it
    return Event(event.condition, event.action, -1 if falls else event.direction, name)


def _check_kinds(event: Event, where: str) -> None:
    if not isinstance(event.action, Action):
        raise ArgumentTypeError(f"{where}: the action must be Stop(), Log(), Impact(...), ..., {describe(event.action)}")
    if not isinstance(event.direction, int) or isinstance(event.direction, bool) or event.direction not in (-1, 0, 1):
        raise ValueError(f"{where}: the direction must be -1, 0 or 1, {describe(event.direction)}")


def _check(event: Event, mechanism: Any) -> None:
    where, action = f"event {quote(event.name)}", event.action
    arguments = "(t, frames)" if mechanism.has_bodies else "(t, q, v)"
    require_function(f"{where}: the condition", event.condition, arguments)
    if not isinstance(event.condition, BodyCondition):  # a trial would take milliseconds, for each new number
        _try_condition(event, mechanism, where)
    if action.is_impact:
        if event.direction == 1:
            cure = "turn the condition's sign, and leave the direction out"
            raise ValueError(f"{where}: an Impact is where its condition falls to zero, and not where direction=1: {cure}")
        if sees_velocity(event.condition, mechanism):
            raise ValueError(f"{where}: the condition of an Impact must depend on positions alone")
    if action.needs_joints:
        kind = type(action).__name__
        mechanism.require_bodies(f"{where}: {kind} changes the joints of a mechanism, and this system has none")
    if action.changes:
        mechanism.require_masses("motions after events")
    action.check(mechanism, where)


def _try_condition(event: Event, mechanism: Any, where: str) -> None:
    has_traced = is_traced(event)
    try:
        with nullcontext() if has_traced else jax.ensure_compile_time_eval():
            value = event.condition(0.0, *probe_arguments(mechanism))
    except KeyError as error:
        if not mechanism.has_bodies:
            raise
        name = error.args[0]
        raise ValueError(f"{where}: no body named {quote(str(name))}{suggestion(name, mechanism.body_names)}") from error
    if not has_traced and isinstance(value, Tracer):  # derivatives with respect to the traced numbers would be lost
        cure = "make it an equinox module that holds them and has a `__call__`"
        raise ValueError(f"{where}: the condition closes over traced numbers; {cure}")
    try:
        kind = jnp.asarray(value).dtype
    except (TypeError, ValueError):
        raise ArgumentTypeError(f"{where}: the condition must return one number, {describe(value)}") from None
    if shape := np.shape(value):
        raise ValueError(f"{where}: the condition must return one number, not an array of shape {shape}")
    if not jnp.issubdtype(kind, jnp.floating) and not jnp.issubdtype(kind, jnp.integer):
        cure = "return the difference of both sides of a comparison, which passes zero where the comparison changes"
        raise ValueError(f"{where}: the condition must return a real number, not one of the type {kind}: {cure}")
