"""Conditions of events: frames, the coordinate of a joint, the gap of a contact."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Number
from udkjax.arrays import ArrayLibrary, library_for
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME_AT_REST, Frame, Point, between
from udkjax.scene.elements.joints import Prismatic, Revolute, Slot
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote, suggestion

Frames = Mapping[str, Frame]


Coordinates = Array | np.ndarray | list[Any]


def frames_of(names: Sequence[str], q: Coordinates, v: Coordinates | None = None) -> dict[str, Frame]:
    """Return the frames of all bodies and the ground by name, from flat q and v; if v is None, the frames have no velocities.

    While a program is traced, lists of numbers take half the time of arrays, whose entries are operations each.
    """
    xp = library_for((q, v))
    rates = [()] * len(names) if v is None else _by_body(v, xp)
    frames: dict[str, Frame] = {GROUND: GROUND_FRAME_AT_REST}
    for name, x, dx in zip(names, _by_body(q, xp), rates, strict=True):
        frames[name] = Frame(x[0], x[1], x[2], xp.cos(x[2]), xp.sin(x[2]), *dx)
    return frames


def _by_body(x: Coordinates, xp: ArrayLibrary) -> Any:
    return [x[k : k + 3] for k in range(0, len(x), 3)] if isinstance(x, list) else xp.asarray(x).reshape(-1, 3)


@cache
def probe_frames(names: tuple[str, ...], moving: bool = True) -> dict[str, Frame]:
    """Return frames of bodies at an arbitrary concrete state, with velocities if `moving`, to try conditions."""
    probe = np.linspace(0.1, 0.9, 3 * len(names))
    return frames_of(names, probe, probe if moving else None)


class JointCoordinate(eqx.Module):
    """The coordinate of a joint: theta2 - theta1 (rad), or the distance of point 2 from point 1 along the axis (m)."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    points: Float[Array, "2 2"] | None = None
    axis: Float[Array, ""] | None = None

    def of(self, one: Frame, two: Frame) -> Number:
        """Return the coordinate from the frames of its bodies."""
        if self.points is None or self.axis is None:
            return two.angle - one.angle
        return one.vector((jnp.cos(self.axis), jnp.sin(self.axis))).dot(between(self.points, one, two))


class BodyCondition(eqx.Module):
    """A condition that depends on time and on the frames of its `bodies` alone."""

    by_velocity: ClassVar[bool] = False  # whether it depends on velocities

    @abstractmethod
    def of_bodies(self, names: tuple[str, ...]) -> Self:
        """Return the same condition, which knows its bodies by other names."""

    @abstractmethod
    def __call__(self, t: Number, frames: Frames) -> Number:
        """Return the value of the condition."""


class WithinLimit(BodyCondition):
    """The condition of a joint limit: the distance of the joint from its limit."""

    coordinate: JointCoordinate
    limit: Float[Array, ""]
    sign: Float[Array, ""]

    @property
    def bodies(self) -> tuple[str, ...]:
        return self.coordinate.bodies

    def of_bodies(self, names):
        return WithinLimit(replace(self.coordinate, bodies=names), self.limit, self.sign)

    def __call__(self, t: Number, frames: Frames) -> Number:
        return self.sign * (self.coordinate.of(*(frames[name] for name in self.bodies)) - self.limit)


class Gap(BodyCondition):
    """The condition of a contact: the distance of a point from a line (m)."""

    bodies: tuple[str, ...] = eqx.field(static=True)
    point: Float[Array, "2"]
    through: Float[Array, "2"]
    normal: Float[Array, "2"]

    def of_bodies(self, names):
        return replace(self, bodies=names)

    def __call__(self, t: Number, frames: Frames) -> Number:
        one, two = (frames[name] for name in self.bodies)
        p, q, n = one.point(self.point), two.point(self.through), two.vector(self.normal)
        return Point(p.x - q.x, p.y - q.y).dot(n) / jnp.sqrt(self.normal[0] ** 2 + self.normal[1] ** 2)


def joint_coordinate(mechanism: Mechanism, joint: str, where: str) -> JointCoordinate:
    """Return the coordinate of a joint by its name; raise `ValueError`, whose message begins with `where`, if there is none."""
    require_name(joint, mechanism.joint_names, where, "joint")
    found = mechanism.joints[joint]
    if isinstance(found, Revolute):
        return JointCoordinate(found.bodies)
    if isinstance(found, Prismatic | Slot):
        return JointCoordinate(found.bodies, found.points, found.axis)
    kinds = "a revolute or prismatic joint, or a slot"
    raise ValueError(f"{where}: {quote(joint)} is a {type(found).__name__}, and must be {kinds}")


def probe_arguments(model: Any, moving: bool = True) -> tuple[Any, ...]:
    """Return the arguments after t, at an arbitrary state, with which conditions of a model can be tried.

    These are (frames,) for a mechanism and (q, v) for a system. Unless `moving`, frames have no velocities, and v is None.
    """
    if model.has_bodies:
        return (probe_frames(model.body_names, moving),)
    probe = np.linspace(0.1, 0.9, model.coordinate_count)
    return probe, probe if moving else None


def sees_velocity(condition: Callable[..., Any], model: Any) -> bool:
    """Return True if a condition depends on velocities: a trial without velocities then fails."""
    if isinstance(condition, BodyCondition):
        return condition.by_velocity
    try:
        return condition(0.0, *probe_arguments(model, moving=False)) is None
    except (TypeError, AttributeError, ValueError):  # errors of arithmetic with None, in Python, JAX or NumPy
        return True


def require_name(name: str, known: Sequence[str], where: str, what: str) -> None:
    """Raise `ValueError` unless a name is among the `known` names; its message says "`where`: no `what` named ..."."""
    if name not in known:
        raise ValueError(f"{where}: no {what} named {quote(name)}{suggestion(name, known)}")
