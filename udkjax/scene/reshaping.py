"""Change lengths and initial angles of a mechanism without opening the pins of its initial guess.

A length is not a single number of a scene: a longer link moves its attachments, and with them the bodies attached to it; so does
another initial angle. The change is propagated from the ground along a spanning tree of the pins, with the angles of the initial
guess: no pin of the tree opens. `assemble` closes the others.
"""

from collections.abc import Iterator, Sequence
from typing import Annotated

import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.annotations import Number, NumberLike, Numbers
from udkjax.argument_types import POSITIVE
from udkjax.arrays import number
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME_AT_REST, Frame
from udkjax.scene.elements.joints import Revolute, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.spanning_tree import spanning_tree
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote, suggestion


@checked
def with_length(
    mechanism: Mechanism, bodies: Sequence[str] | str, length: Annotated[NumberLike, POSITIVE], as_rod: bool = False
) -> Mechanism:
    """Return the mechanism with another length of bodies: the largest distance between two attachment points of a body.

    All attachment points of these bodies, to joints, drivers and forces, are scaled about the centre of mass. Angles do not
    change; positions and velocities of the initial guess follow along the pins. The function is pure and differentiable.

    Args:
        mechanism: The scene.
        bodies: The name of a body, or several.
        length: The length (m); it may be traced.
        as_rod: Scale the mass with the length and the inertia with its third power, as for a rod with constant mass per metre; by
            default they do not change.

    Returns:
        The changed mechanism.

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
    """Return the largest distance (m) between two attachment points of a body. Raises `SceneError`."""
    _check_names(mechanism, body)
    points = [point for _, point in attachments(mechanism, body)]
    if len(points) < 2:
        raise SceneError([f"body {quote(body)} has no length: it is attached at fewer than two points"], mechanism.name)
    stacked = jnp.stack(points)
    square = jnp.sum((stacked[:, None] - stacked[None]) ** 2, axis=-1)
    return jnp.sqrt(jnp.max(square))


@checked
def with_angle(
    mechanism: Mechanism,
    bodies: Sequence[str] | str,
    angle: NumberLike,
    angular_velocity: NumberLike | None = None,
) -> Mechanism:
    """Return the mechanism with another initial angle, and angular velocity, of bodies.

    Positions and velocities of the initial guess follow along the pins: a parallelogram stays closed if all its links are named.
    The function is pure and differentiable.

    Args:
        mechanism: The scene.
        bodies: The name of a body, or several.
        angle: The angle (rad); it may be traced.
        angular_velocity: The angular velocity (rad/s); by default unchanged.

    Returns:
        The changed mechanism.

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
    """Iterate over the attachment points (m) of a body or the ground, in its frame, with their names as parameters."""
    groups = {"joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    for section, elements in groups.items():
        for name, element in elements.items():
            points = getattr(element, "points", None)
            if points is not None:
                yield from (
                    (f"{section}.{name}.points[{k}]", points[k]) for k, attached in enumerate(element.bodies) if attached == body
                )
            if getattr(element, "body", None) == body and hasattr(element, "point"):
                yield f"{section}.{name}.point", element.point


def _move_along_pins(before: Mechanism, after: Mechanism) -> Mechanism:
    """Return `after` with its bodies moved so that no pin of the tree opens more than in `before`.

    Each body moves by the displacement of the pin that holds it: if no pin moves, the initial guess does not change.
    """
    old = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in before.bodies.items()}
    new = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in after.bodies.items()}
    values: dict[str, Numbers] = {}
    pins = {name: 0 for name, joint in before.joints.items() if isinstance(joint, Revolute | Weld)}
    for body, holder, joint in spanning_tree(before, pins):
        if not joint:
            continue  # a root does not move
        old_joint, new_joint = before.joints[joint], after.joints[joint]
        holder_end, body_end = (0, 1) if old_joint.bodies[1] == body else (1, 0)
        frame = new[body]
        # Displacements of the pin on the holder and on the body; the body moves by their difference.
        holder_shift = _subtract(
            _pin_state(new[holder], new_joint.points[holder_end]), _pin_state(old[holder], old_joint.points[holder_end])
        )
        body_shift = _subtract(_pin_state(frame, new_joint.points[body_end]), _pin_state(old[body], old_joint.points[body_end]))
        x, y, vx, vy = (a - b for a, b in zip(holder_shift, body_shift, strict=True))
        frame = frame._replace(x=frame.x + x, y=frame.y + y, vx=frame.vx + vx, vy=frame.vy + vy)
        new[body] = frame
        values[f"body.{body}.position"] = jnp.stack([frame.x, frame.y])
        values[f"body.{body}.velocity"] = jnp.stack([frame.vx, frame.vy])
    return after.with_parameters(values) if values else after


def _pin_state(frame: Frame, local: Float[Array, "2"]) -> tuple[Number, Number, Number, Number]:
    """Return the position (m) and the velocity (m/s) of a point of a body."""
    (x, y), (vx, vy) = frame.point(local), frame.velocity(local)
    return x, y, vx, vy


def _subtract(first: tuple, second: tuple) -> tuple:
    return tuple(a - b for a, b in zip(first, second, strict=True))
