"""What in a scene is likely a mistake, although it can be computed: points in another unit, degrees for radians, loose bodies."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from udkjax.scene.bodies import GROUND
from udkjax.scene.checks import quote
from udkjax.scene.mechanism import Mechanism

# Of the largest of all bodies: a point farther away from its own body is likely in another unit (mm, of which a metre has 1,000).
# A body reaches as far as its other points, or twice its radius of gyration.
FAR_OUT = 50.0
ANGLES = ("angle", "axis", "phase")  # fields in radians


def suspicions(mechanism: Mechanism) -> list[str]:
    """Return what in a scene of known numbers is likely a mistake, each with the name of its element and a cure."""
    return [*_far_points(mechanism), *_degrees(mechanism), *_loose_bodies(mechanism)]


def body_points(mechanism: Mechanism) -> dict[str, list[tuple[str, np.ndarray]]]:
    """Return where each body, and the ground, is attached: the number's name, and the point in the body's own frame (m)."""
    found: dict[str, list[tuple[str, np.ndarray]]] = {name: [] for name in (GROUND, *mechanism.body_names)}
    groups: dict[str, Mapping[str, Any]] = {"joint": mechanism.joints, "driver": mechanism.drivers, "force": mechanism.forces}
    for section, elements in groups.items():
        for name, element in elements.items():
            points = getattr(element, "points", None)
            if points is not None and np.shape(points) == (len(element.bodies), 2):
                for k, body in enumerate(element.bodies):
                    found[body].append((f"{section}.{name}.points[{k}]", np.asarray(points[k])))
            if hasattr(element, "point") and getattr(element, "body", None) in found:
                found[element.body].append((f"{section}.{name}.point", np.asarray(element.point)))
    return found


def body_sizes(mechanism: Mechanism) -> dict[str, float]:
    """Return how far each body reaches from its centre of mass (m): to its farthest point, or twice its radius of gyration."""
    points = body_points(mechanism)
    return {
        name: max(2 * _gyration(body), *(float(np.hypot(*p)) for _, p in points[name]), 0.0)
        for name, body in mechanism.bodies.items()
    }


def _gyration(body: Any) -> float:
    return float(np.sqrt(np.asarray(body.inertia) / np.asarray(body.mass)))


def _far_points(mechanism: Mechanism) -> Iterator[str]:
    """Iterate over points that are far outside of all bodies."""
    points = body_points(mechanism)
    places = np.asarray(mechanism.q0)[:, :2]
    for name, attached in points.items():
        for k, (number, point) in enumerate(attached):
            others = [2 * _gyration(body) for body in mechanism.bodies.values()]
            others += [
                float(np.hypot(*p))
                for n, ps in points.items()
                if n != GROUND
                for i, (_, p) in enumerate(ps)
                if (n, i) != (name, k)
            ]
            reach = float(np.hypot(*point)) if name != GROUND else float(np.min(np.hypot(*(places - point).T)))
            if reach > FAR_OUT * max(others):
                what = f"from the centre of mass of {quote(name)}" if name != GROUND else "from the nearest body"
                yield f"{number} is {reach:.3g} m {what}, and no body reaches farther than {max(others):.3g} m: is it in metres?"


def _degrees(mechanism: Mechanism) -> Iterator[str]:
    """Iterate over angles that are more than a turn and a whole number, or half of one, as degrees are and radians are not."""
    for name, value in mechanism.parameters().items():
        if name.rpartition(".")[2] in ANGLES and np.ndim(value) == 0:
            angle = float(value)
            if abs(angle) > 2 * np.pi and (2 * angle).is_integer():
                yield f"{name} is {angle:g} rad, which looks like degrees: {angle:g} degrees are {np.radians(angle):.6g} rad"


def _loose_bodies(mechanism: Mechanism) -> Iterator[str]:
    """Iterate over bodies that no joint and no driver holds, beside others that are held."""
    held = {name for element in mechanism.constraints.values() for name in mechanism.frames_of(element)}
    for name in mechanism.body_names if held else ():
        if name not in held:
            yield f"body {quote(name)} is in no joint: it flies by itself"
