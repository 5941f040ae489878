"""Transmission of motion and force through a linkage: transmission angle, mechanical advantage; and reachable points."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import Numbers
from udkjax.argument_types import FINITE, HISTORY, POINT, ArgumentRequirement
from udkjax.arrays import number
from udkjax.positions.assembling.assembly import State
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.assembling.coordinates import COORDINATE, Coordinate, is_coordinate, value_of
from udkjax.positions.following.kinematics import Kinematics, kinematics
from udkjax.printing import prints_table, units
from udkjax.requirements import ArgumentTypeError, GivenArguments, describe, require_finite
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion


@prints_table
class Workspace(NamedTuple):
    """Places of a point over the values of a first driver (S,) and a second one (T,).

    Attributes:
        points: places of the point (m); NaN where a pair of values is not reached.
        reached: whether each pair of values is reached.
    """

    points: Float[Array, "S T 2"]
    reached: Bool[Array, "S T"]

    _units = units(points="m")


def _require_values_of_drivers(name: str, value: Any, given: GivenArguments) -> None:
    if not (isinstance(value, Mapping) and all(map(is_coordinate, value))):
        raise ArgumentTypeError(f"{name} must map two drivers to their values, {describe(value)}")
    for driver, values in value.items():
        require_finite(f"{name}[{driver!r}]", values)


VALUES_OF_DRIVERS = ArgumentRequirement("finite numbers by driver", _require_values_of_drivers)


@checked
def transmission_angle(mechanism: Mechanism, motion: Annotated[StateHistory, HISTORY], joint: str) -> Float[Array, "T"]:
    """Return the angle (rad, 0 to pi) at a pin between the two links that it joins: acos(u . w / (|u| |w|)).

    u and w point from the pin to the other pin of each link. Force is transmitted best at pi/2, and not at 0 and pi.

    Args:
        mechanism: the linkage.
        motion: anything with q (T, bodies, 3), a `Kinematics` or a `Solution`.
        joint: a revolute joint of two moving links, each with exactly one other pin.

    Returns:
        The angle (T,) in rad.

    Raises:
        SceneError: no such pin, or a link that does not have exactly two pins.
    """
    pins = {name: pin for name, pin in mechanism.joints.items() if isinstance(pin, Revolute)}
    if joint not in pins:
        raise SceneError([f"{quote(joint)} is not a revolute joint; there are {', '.join(map(quote, pins))}"], mechanism.name)
    arms = []
    for body, here in zip(pins[joint].bodies, pins[joint].points, strict=True):
        others = [pin.points[pin.bodies.index(body)] for name, pin in pins.items() if name != joint and body in pin.bodies]
        if len(others) != 1 or body not in mechanism.body_names:
            problem = f"{quote(body)} at {quote(joint)} has {len(others)} other pins, not one"
            raise SceneError([f"{problem}: a transmission angle is that between two links of two pins each"], mechanism.name)
        angle = motion.q[..., mechanism.body_names.index(body), 2]
        frame = Frame(0.0, 0.0, angle, jnp.cos(angle), jnp.sin(angle))
        arms.append(frame.vector(others[0] - here))
    u, w = arms
    return jnp.arctan2(jnp.abs(u.x * w.y - u.y * w.x), u.dot(w))


@checked
def mechanical_advantage(
    mechanism: Mechanism, motion: Annotated[Kinematics, HISTORY], output: Annotated[str | Coordinate, COORDINATE]
) -> Float[Array, "T"]:
    """Return the effort of the output for one unit of effort at the driver: s_dot / o_dot, since power in is power out.

    Efforts are torques (N m) for angles and forces (N) for lengths; losses and inertia are neglected.

    Args:
        mechanism: the mechanism.
        motion: its `Kinematics` over the values s of the driver.
        output: a coordinate o, by name or as a `Coordinate`.

    Returns:
        The ratio (T,): positive where both move the same way, infinite at a toggle of the output.
    """
    value = value_of(mechanism, output)

    def rate(q: Float[Array, "bodies 3"], v: Float[Array, "bodies 3"]) -> Float[Array, ""]:
        return jax.jvp(value, (q,), (v,))[1]

    return motion.rate / jax.vmap(rate)(motion.q, motion.v)


@checked
def coupler_curve(
    mechanism: Mechanism,
    driver: str | Coordinate,
    values: Annotated[Float[ArrayLike, "T"], FINITE],
    body: str,
    point: Annotated[Numbers, POINT] = (0.0, 0.0),
    **choices: Any,
) -> Float[Array, "T 2"]:
    """Return the path of a point of a body over the values of a driver.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold.
        driver: a driver or a coordinate, as for `kinematics`.
        values: values of the driver (rad, m), in the order in which they are reached.
        body: the name of the body.
        point: the point in the body's own frame (m).
        **choices: other arguments of `kinematics`: state, rate, acceleration, held.

    Returns:
        x and y (T, 2) in m; NaN at values that are not reached.

    Raises:
        SceneError: no such body, driver or coordinate, or positions do not follow from it.
    """
    _require_body(mechanism, body)
    return kinematics(mechanism, driver, values, **choices).path(body, jnp.asarray(point))


@checked
def workspace(
    mechanism: Mechanism,
    drivers: Annotated[Mapping[str, Float[ArrayLike, "S"]], VALUES_OF_DRIVERS],
    body: str,
    point: Annotated[Numbers, POINT] = (0.0, 0.0),
    state: State | None = None,
) -> Workspace:
    """Return the places of a point of a body over all pairs of values of two drivers, all reached along the branch of `state`.

    Args:
        mechanism: a mechanism of two degrees of freedom once its drivers hold.
        drivers: the values (rad, m) of two drivers or coordinates, by name; the first is followed with the second held at its
            first value.
        body: body of the point.
        point: a point in the body's own frame (m).
        state: a position on the branch; by default the initial guess, assembled.

    Returns:
        A `Workspace`: the places (S, T, 2) in m, NaN where the pair of values is not reached.

    Raises:
        SceneError: no such body, driver or coordinate, or positions do not follow from them.
    """
    _require_body(mechanism, body)
    if len(drivers) != 2:
        raise SceneError([f"a workspace is over two drivers, not {len(drivers)}"], mechanism.name)
    (first, outer), (second, inner) = ((name, number(values)) for name, values in drivers.items())
    along = kinematics(mechanism, first, outer, state, held={second: inner[0]})

    def across(value: Float[Array, ""], q: Float[Array, "bodies 3"]) -> tuple[Float[Array, "T 2"], Bool[Array, "T"]]:
        found = kinematics(mechanism, second, inner, State(q, jnp.zeros_like(q)), held={first: value})
        return found.path(body, jnp.asarray(point)), found.reached

    safe = jnp.where(along.reached[:, None, None], along.q, mechanism.q0)
    points, reached = jax.vmap(across)(outer, safe)
    reached = reached & along.reached[:, None]
    return Workspace(jnp.where(reached[..., None], points, jnp.nan), reached)


def _require_body(mechanism: Mechanism, body: str) -> None:
    if body not in mechanism.body_names:
        raise SceneError([f"body: no body named {quote(body)}{suggestion(body, mechanism.body_names)}"], mechanism.name)
