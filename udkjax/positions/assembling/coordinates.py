"""Coordinates that can be driven, by the name of a driver, by the name of a channel, or as objects."""

from collections.abc import Callable
from typing import Any, Literal, cast, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from udkjax.annotations import Numbers
from udkjax.argument_types import ArgumentRequirement, of_kind
from udkjax.arrays import is_traced, number, number_called
from udkjax.positions.assembling.channels import channel_of, point_of_pin
from udkjax.printing import PrintsLine
from udkjax.requirements import ArgumentTypeError, describe, require_choice
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME, Frame
from udkjax.scene.elements.drivers import Driver, Motion, Polynomial, effort_unit
from udkjax.scene.elements.fields import names
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import free_name, quote, suggestion

CoordinateName = Literal["angle", "x", "y", "distance"]
COORDINATE_NAMES = get_args(CoordinateName)


def _names_of_bodies(value: Any) -> tuple[str, ...]:
    try:
        return names(value)
    except TypeError:
        raise ArgumentTypeError(f"bodies must be a name, or a list of names, {describe(value)}") from None


class Coordinate(PrintsLine):
    """A coordinate of body 2 relative to body 1 that can be driven, like that of a `Driver`.

    `angle`: theta2 - theta1 (rad), including whole turns; `x`, `y`: point 2 minus point 1 in body 1's frame (m); `distance` (m).

    Args:
        bodies: the names of two bodies, or "ground".
        coordinate: "angle", "x", "y" or "distance".
        points: one point of each body, in its frame (m); by default the origins.
        axis: for x and y: the direction of x in body 1's frame (rad); by default that of the frame.
    """

    bodies: tuple[str, ...] = eqx.field(static=True, converter=_names_of_bodies)
    coordinate: CoordinateName = eqx.field(static=True, default="angle")
    points: Float[Array, "2 2"] | None = eqx.field(converter=number_called("points", optional=True), default=None)
    axis: Float[Array, ""] | None = eqx.field(converter=number_called("axis", optional=True), default=None)

    def __check_init__(self):
        require_choice("coordinate", self.coordinate, COORDINATE_NAMES)

    @classmethod
    def of(cls, driver: Driver) -> "Coordinate":
        """Return the coordinate that a driver prescribes."""
        return cls(driver.bodies, driver.coordinate, driver.points, driver.axis)

    def driver(self, motion: Motion | None = None) -> Driver:
        """Return the driver that prescribes this coordinate by a motion law; by default it is held at zero."""
        return Driver(self.bodies, self.coordinate, constant_motion(0.0) if motion is None else motion, self.points, self.axis)

    def value(self, *frames: Frame) -> Float[Array, ""]:
        """Return the value (rad, m) of the coordinate, from the frames of its bodies.

        Raises an `ArgumentTypeError` unless two `Frame` objects are given.
        """
        if len(frames) != len(self.bodies) or not all(isinstance(x, Frame) for x in frames):
            given = ", ".join(type(x).__name__ for x in frames) or "nothing"
            raise ArgumentTypeError(f"value takes a udk.Frame of each of {', '.join(map(quote, self.bodies))}, not {given}")
        driver = self.driver().complete()
        if is_traced((driver, frames)):
            return jnp.asarray(driver.residual(0.0, *frames)[0])
        return number(np.asarray(jax.tree.map(np.asarray, driver).residual(0.0, *frames)[0]))

    @property
    def effort_unit(self) -> str:
        """The unit of the effort along the coordinate."""
        return effort_unit(self.coordinate)


def value_of(mechanism: Mechanism, coordinate: str | Coordinate) -> Callable[[Array], Array]:
    """Return the value (rad, m) of a coordinate as a function of q (bodies, 3)."""
    element = element_of(mechanism, coordinate)
    places = [None if b == GROUND else mechanism.body_names.index(b) for b in element.bodies]

    def value(q: Float[Array, "bodies 3"]) -> Float[Array, ""]:
        rows: Any = q if isinstance(q, Tracer) else np.asarray(q)  # JAX would compile a program to take a row
        return element.value(*(GROUND_FRAME if k is None else Frame.at(rows[k, :2], rows[k, 2]) for k in places))

    return value


def element_of(mechanism: Mechanism, driver: str | Coordinate) -> Coordinate:
    """Return the `Coordinate` of a driver or of a channel's name; a `Coordinate` is returned as it is.

    Raises a `SceneError` if there is no such driver or coordinate.
    """
    return named_element(mechanism, driver)[1]


def named_element(mechanism: Mechanism, driver: str | Coordinate) -> tuple[str, Coordinate]:
    """Return the name of a driver and its coordinate; for a coordinate without a driver, an unused name and the coordinate.

    Raises a `SceneError` if there is no such driver or coordinate.
    """
    if isinstance(driver, str) and driver in mechanism.drivers:
        return driver, Coordinate.of(mechanism.drivers[driver])
    element = coordinate_of(mechanism, driver) if isinstance(driver, str) else driver
    return free_name("value", mechanism.constraints), element


def coordinate_of(mechanism: Mechanism, text: str) -> Coordinate:
    """Return the coordinate with the name of a channel: `body.NAME.angle`, `body.NAME(px, py).x`, `joint.NAME.angle`, a distance.

    Raises a `SceneError` if there is no such channel, or it cannot be driven.
    """
    try:
        channel = channel_of(mechanism, text)
    except ValueError as problem:
        drivers = ", ".join(map(quote, mechanism.driver_names)) or "none"
        cure = suggestion(text, mechanism.driver_names) or f"; drivers: {drivers}; coordinates: body.NAME.angle, joint.NAME.angle"
        raise SceneError([f"{quote(text)} is neither a driver nor a coordinate: {problem}{cure}"], mechanism.name) from None
    if channel.quantity not in COORDINATE_NAMES:
        raise SceneError([f"{quote(text)} cannot be driven: name an angle, x, y or a distance"], mechanism.name)
    kind = cast(CoordinateName, channel.quantity)
    with jax.ensure_compile_time_eval():
        if len(channel.bodies) == 2 and (kind == "angle" or channel.points):
            return Coordinate(channel.bodies, kind, channel.points or None)
        if channel.owner:
            body, point = point_of_pin(mechanism, channel.owner)
            return Coordinate((GROUND, body), kind, [(0.0, 0.0), point])
        return Coordinate((GROUND, *channel.bodies), kind, [(0.0, 0.0), *channel.points])


def constant_motion(value: Numbers) -> Polynomial:
    """Return the motion law that holds a value (rad, m)."""
    return Polynomial(jnp.stack([value]) if isinstance(value, Tracer) else np.reshape(value, 1))


def is_coordinate(x: Any) -> bool:
    """Return True for the name of a driver or a coordinate, or a `Coordinate`."""
    return bool(x) if isinstance(x, str) else hasattr(x, "bodies")


COORDINATE = ArgumentRequirement(
    "a coordinate", of_kind("be the name of a coordinate, such as body.crank.angle, or a Coordinate", is_coordinate)
)
