"""Mechanisms with other lengths and starts, whose initial guess stays as closed as it was.

A length is not one number of a scene: a link that gets longer moves its attachments, and with them the bodies that hang on it. So
does an initial angle. A change is passed on along the pins, body after body from the ground on, each turned as its
guess has it: along a tree of pins, which holds each body once, no pin opens. The rest is for `assemble` to close.
"""

from collections.abc import Iterator, Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Scalar
from udkjax.scene.arguments import checked
from udkjax.scene.bodies import GROUND, GROUND_FRAME_AT_REST, Frame
from udkjax.scene.checks import SceneError, quote, suggestion
from udkjax.scene.fields import Number, Numbers, number
from udkjax.scene.joints import Revolute, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.spanning_tree import spanning_tree


@checked
def with_length(mechanism: Mechanism, bodies: Sequence[str] | str, length: Scalar, as_rod: bool = False) -> Mechanism:
    """Return the mechanism with another length of some bodies: the largest distance between two points where a body is attached.

    All attachments of these bodies, to joints, drivers and forces, are scaled about their centres of mass, so that these stay
    in their places between them. Angles stay, and positions and velocities of the initial guess follow along the pins. The
    function is pure and differentiable.

    Args:
        mechanism: The scene.
        bodies: The name of a body, or several.
        length: The length (m); it may be traced.
        as_rod: Change mass and inertia to those of a rod of the same mass per metre, in proportion to the length and to its third
            power; by default they stay.

    Returns:
        The mechanism; the one that was given does not change.

    Raises:
        SceneError: A name is not that of a body, or a body is attached at fewer than two points.
    """
    names = _check_names(mechanism, bodies)
    values: dict[str, Numbers] = {}
    for body in names:
        points = dict(attachments(mechanism, body))
        scale = number(length) / length_of(mechanism, body)
        values |= {name: scale * point for name, point in points.items()}
        if as_rod:
            element = mechanism.bodies[body]
            values |= {f"body.{body}.mass": scale * element.mass, f"body.{body}.inertia": scale**3 * element.inertia}
    return _move_along_pins(mechanism, mechanism.with_parameters(values))


def length_of(mechanism: Mechanism, body: str) -> Float[Array, ""]:
    """Return the largest distance (m) between two points where a body is attached. Raises `SceneError`."""
    _check_names(mechanism, body)
    points = [point for _, point in attachments(mechanism, body)]
    if len(points) < 2:
        raise SceneError([f"body {quote(body)} has no length: it is attached at fewer than two points"], mechanism.name)
    stacked = jnp.stack(points)
    square = jnp.sum((stacked[:, None] - stacked[None]) ** 2, axis=-1)
    return jnp.sqrt(jnp.max(square))


@checked
def with_angle(
    mechanism: Mechanism, bodies: Sequence[str] | str, angle: Scalar, angular_velocity: Scalar | None = None
) -> Mechanism:
    """Return the mechanism with another initial angle, and angular velocity, of some bodies.

    Positions and velocities of the initial guess follow along the pins: a parallelogram stays closed where all links are given.
    The function is pure and differentiable.

    Args:
        mechanism: The scene.
        bodies: The name of a body, or several.
        angle: The angle (rad); it may be traced.
        angular_velocity: The angular velocity (rad/s); None: as it is.

    Returns:
        The mechanism; the one that was given does not change.

    Raises:
        SceneError: A name is not that of a body.
    """
    names = _check_names(mechanism, bodies)
    values: dict[str, Numbers] = {f"body.{body}.angle": angle for body in names}
    if angular_velocity is not None:
        values |= {f"body.{body}.angular_velocity": angular_velocity for body in names}
    return _move_along_pins(mechanism, mechanism.with_parameters(values))


def _check_names(mechanism: Mechanism, bodies: Sequence[str] | str) -> tuple[str, ...]:
    names = (bodies,) if isinstance(bodies, str) else tuple(bodies)
    known = mechanism.body_names
    problems = [f"no body named {quote(name)}{suggestion(name, known)}" for name in names if name not in known]
    if problems:
        raise SceneError(problems, mechanism.name)
    return names


def attachments(mechanism: Mechanism, body: str) -> Iterator[tuple[str, Float[Array, "2"]]]:
    """Iterate over the points (m) of a body, or of the ground, under their names as parameters, in its own frame."""
    groups = {"joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    for section, elements in groups.items():
        for name, element in elements.items():
            points = getattr(element, "points", None)
            if points is not None:
                yield from ((f"{section}.{name}.points[{k}]", points[k]) for k, b in enumerate(element.bodies) if b == body)
            if getattr(element, "body", None) == body and hasattr(element, "point"):
                yield f"{section}.{name}.point", element.point


def _move_along_pins(before: Mechanism, after: Mechanism) -> Mechanism:
    """Move bodies by as much as the pins that hold them have moved: a guess in which nothing has changed stays as it is."""
    old = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in before.bodies.items()}
    new = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in after.bodies.items()}
    values: dict[str, Numbers] = {}
    pins = {name: 0 for name, joint in before.joints.items() if isinstance(joint, Revolute | Weld)}
    for body, holder, joint in spanning_tree(before, pins):
        if not joint:
            continue  # a root stays
        was, now = before.joints[joint], after.joints[joint]
        one, two = (0, 1) if was.bodies[1] == body else (1, 0)
        frame = new[body]
        # Of the holder and of the body itself, how the pin has moved; then the body makes up for the difference.
        shift = _subtract(_pin_state(new[holder], now.points[one]), _pin_state(old[holder], was.points[one]))
        own = _subtract(_pin_state(frame, now.points[two]), _pin_state(old[body], was.points[two]))
        x, y, vx, vy = (a - b for a, b in zip(shift, own, strict=True))
        frame = frame._replace(x=frame.x + x, y=frame.y + y, vx=frame.vx + vx, vy=frame.vy + vy)
        new[body] = frame
        values[f"body.{body}.position"] = jnp.stack([frame.x, frame.y])
        values[f"body.{body}.velocity"] = jnp.stack([frame.vx, frame.vy])
    return after.with_parameters(values) if values else after


def _pin_state(frame: Frame, local: Float[Array, "2"]) -> tuple[Number, Number, Number, Number]:
    """Return the position (m) and the velocity (m/s) of a point of a body."""
    (x, y), (vx, vy) = frame.point(local), frame.velocity(local)
    return x, y, vx, vy


def _subtract(one: tuple, two: tuple) -> tuple:
    return tuple(a - b for a, b in zip(one, two, strict=True))
