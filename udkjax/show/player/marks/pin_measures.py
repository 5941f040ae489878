"""Measures of pins: speeds and transmission angles, which a page computes again from the places of their anchors."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.equations.rows.analysis import analyse
from udkjax.positions import pins_with_bodies, transmission_pins
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.mark_places import to_ground

AT_REST = 1e-9  # displacements, in characteristic lengths, of pins that do not move and have no speed to show

PinAnchor = list[float]  # [body, x, y]
Placed = tuple[str, str, list[PinAnchor], Float[np.ndarray, "T"]]  # name, unit, anchors and values


def pin_speeds(mechanism: Mechanism, q: Float[np.ndarray, "T bodies 3"], v: Float[np.ndarray, "T bodies 3"]) -> list[Placed]:
    """Return the speed (m/s) of each pin that moves, free pins of a drawing included, as name, unit, anchors and values."""
    found, length = [], float(analyse(mechanism).length)
    for name, (body, place) in _moving_pins(mechanism).items():
        k = mechanism.body_names.index(body)
        if np.ptp(to_ground(place, q[:, k]), axis=0).max() > AT_REST * length:
            found.append((f"speed of {name}", "m/s", [_anchor(mechanism, body, place)], _speed(place, q[:, k], v[:, k])))
    return found


def transmission_angles(mechanism: Mechanism, q: Float[np.ndarray, "T bodies 3"]) -> list[Placed]:
    """Return the acute angle (deg) between the links at each pin that transmits motion to an undriven link.

    Each angle has the name, the unit and the anchors of its curve; the second of the three anchors is the corner.
    """
    found = []
    driven = {body for driver in mechanism.drivers.values() for body in driver.bodies}
    for name, ((one, here, end), (other, _, far)) in transmission_pins(mechanism, driven).items():
        places = [(one, end), (one, here), (other, far)]
        a, corner, b = (to_ground(place, q[:, mechanism.body_names.index(body)]) for body, place in places)
        anchors = [_anchor(mechanism, body, place) for body, place in places]
        found.append((f"transmission angle at {name}", "°", anchors, _acute(a - corner, b - corner)))
    return found


def _moving_pins(mechanism: Mechanism) -> Mapping[str, tuple[str, Numbers]]:
    """Return, for each pin that is not on the ground, one of its bodies and the place of the pin in its frame (m)."""
    joined = {name: next(iter(at.items())) for name, at in pins_with_bodies(mechanism).items() if GROUND not in at}
    return joined | ({} if mechanism.drawing is None else dict(mechanism.drawing.free_pins()))


def _anchor(mechanism: Mechanism, body: str, place: Numbers) -> PinAnchor:
    return [mechanism.body_names.index(body), *np.asarray(place, float).tolist()]


def _speed(place: Numbers, frames: Float[np.ndarray, "T 3"], rates: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T"]:
    arm = to_ground(place, frames) - frames[:, :2]
    return np.hypot(rates[:, 0] - rates[:, 2] * arm[:, 1], rates[:, 1] + rates[:, 2] * arm[:, 0])


def _acute(one: Float[np.ndarray, "T 2"], other: Float[np.ndarray, "T 2"]) -> Float[np.ndarray, "T"]:
    cross, along = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0], (one * other).sum(1)
    return np.degrees(np.arctan2(np.abs(cross), np.abs(along)))
