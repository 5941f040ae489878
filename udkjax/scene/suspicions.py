"""Likely mistakes in a valid scene: points in the wrong unit, degrees for radians, loose bodies."""

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.reshaping import attachments
from udkjax.wording import quote

# A point farther from its body's centre of mass than this many sizes of the largest body is probably in a wrong unit (mm).
# The size of a body is the largest distance of its other points, or twice its radius of gyration.
FAR_OUT = 50.0
ANGLE_FIELDS = ("angle", "axis", "phase")  # fields in radians


def suspicions(mechanism: Mechanism) -> list[str]:
    """Return the likely mistakes in a scene of concrete numbers, each with the name of its element and a cure."""
    return [*_far_points(mechanism), *_degrees(mechanism), *_loose_bodies(mechanism)]


def body_sizes(mechanism: Mechanism) -> dict[str, float]:
    """Return the size of each body (m): the distance of its farthest point from its centre, or twice its radius of gyration."""
    mechanism = jax.tree.map(np.asarray, mechanism.without_origin)  # in a traced function, JAX would trace concrete numbers, too
    return {
        name: max(2 * _gyration(body), *(_length(p) for _, p in attachments(mechanism, name)), 0.0)
        for name, body in mechanism.bodies.items()
    }


def _gyration(body: Any) -> float:
    return float(np.sqrt(np.asarray(body.inertia) / np.asarray(body.mass)))


def _length(point: Any) -> float:
    return float(np.hypot(*np.asarray(point)))


def _far_points(mechanism: Mechanism) -> Iterator[str]:
    reaches = {number: _length(p) for name in mechanism.body_names for number, p in attachments(mechanism, name)}
    gyration = max(2 * _gyration(body) for body in mechanism.bodies.values())
    owner = {number: name for name in mechanism.body_names for number, _ in attachments(mechanism, name)}
    for number, reach in reaches.items():
        size = max(gyration, *(other_reach for other, other_reach in reaches.items() if other != number), 0.0)
        if reach > FAR_OUT * size:
            yield f"{number} is {reach:.3g} m from the centre of mass of {quote(owner[number])}{_comparison(size)}"
    places, size = np.asarray(mechanism.q0)[:, :2], max(gyration, *reaches.values(), 0.0)
    for number, point in attachments(mechanism, GROUND):
        distance = float(np.min(np.hypot(*(places - np.asarray(point)).T)))
        if distance > FAR_OUT * size:
            yield f"{number} is {distance:.3g} m from the nearest body{_comparison(size)}"


def _comparison(size: float) -> str:
    return f", and no body reaches farther than {size:.3g} m: is it in metres?"


def _degrees(mechanism: Mechanism) -> Iterator[str]:
    """Iterate over angles of more than a turn that are integers or half-integers, like degrees and unlike radians."""
    for name, value in mechanism.parameters().items():
        if name.rpartition(".")[2] in ANGLE_FIELDS and np.ndim(value) == 0:
            angle = float(value)
            if abs(angle) > 2 * np.pi and (2 * angle).is_integer():
                yield f"{name} is {angle:g} rad, which looks like degrees: {angle:g} degrees are {np.radians(angle):.6g} rad"


def _loose_bodies(mechanism: Mechanism) -> Iterator[str]:
    """Iterate over bodies without joint or driver, if any body has a joint or driver."""
    connected = {name for element in mechanism.constraints.values() for name in mechanism.frames_of(element)}
    for name in mechanism.body_names if connected else ():
        if name not in connected:
            yield f"body {quote(name)} belongs to no joint: it moves freely"
