"""Instant centres of the links of a mechanism."""

import math
from collections.abc import Mapping
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.argument_types import COORDINATES_OF_BODIES
from udkjax.positions.answers.counting import DRAWN_TOL, Count
from udkjax.positions.following.kinematics import Kinematics
from udkjax.printing import PRINTED_AS_ZERO, PrintedTable, format_number
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism


class InstantCentre(NamedTuple):
    """The point at which two links have the same velocity.

    `place` has its coordinates (m); if the point is at infinity, `place` is a unit vector towards it.
    """

    place: Float[np.ndarray, "2"]
    at_infinity: bool


@checked
@concrete_only()
def instant_centres(
    mechanism: Mechanism,
    q: Annotated[Float[ArrayLike, "bodies 3"], COORDINATES_OF_BODIES],
    v: Annotated[Float[ArrayLike, "bodies 3"], COORDINATES_OF_BODIES],
) -> Mapping[tuple[str, str], InstantCentre]:
    """Return the instant centres of all pairs of links in a position, by the names of the links; "ground" is one of them.

    With u the velocity that a link has at the origin, (u_1 - u_2) + (omega_1 - omega_2) x p = 0. Links of the same angular
    velocity have their centre at infinity, across their relative velocity; links that move as one have none.

    Args:
        mechanism: the mechanism.
        q: coordinates of its bodies (m, m, rad), (bodies, 3) or flat.
        v: their rates (m/s, m/s, rad/s), of the same shape.

    Returns:
        The centres by pairs of names.
    """
    q, v = (np.reshape(x, (-1, 3)) for x in (q, v))
    at_origin = np.stack([v[:, 0] + v[:, 2] * q[:, 1], v[:, 1] - v[:, 2] * q[:, 0], v[:, 2]], 1)
    motions = {GROUND: np.zeros(3)} | dict(zip(mechanism.body_names, at_origin, strict=True))
    names, found = list(motions), {}
    fastest = np.max(np.abs(v[:, 2]), initial=0.0)
    speed = np.max(np.hypot(at_origin[:, 0], at_origin[:, 1]), initial=0.0)
    for k, one in enumerate(names):
        for other in names[k + 1 :]:
            ux, uy, omega = motions[one] - motions[other]
            if abs(omega) > DRAWN_TOL * fastest:
                found[one, other] = InstantCentre(np.array([-uy, ux]) / omega, False)
            elif np.hypot(ux, uy) > DRAWN_TOL * speed:
                found[one, other] = InstantCentre(np.array([-uy, ux]) / np.hypot(ux, uy), True)
    return found


def centres_table(mechanism: Mechanism, motion: Kinematics, counted: Count) -> PrintedTable:
    """Return the table of the instant centres of all pairs of links in the first position of a motion, in units of `counted`."""
    rows, unit, size = [], counted.units.shown("m"), counted.units.size("m")
    centres = instant_centres(mechanism, motion.q[0], motion.v[0])
    finite = [float(np.max(np.abs(place))) for place, at_infinity in centres.values() if not at_infinity]
    largest = max([float(np.max(np.abs(np.asarray(motion.q)[0, :, :2]))), *finite])
    for pair, (place, at_infinity) in centres.items():
        x, y = (format_number(z / size, scale=DRAWN_TOL / PRINTED_AS_ZERO * largest / size) for z in place)
        direction = format_number(math.degrees(math.atan2(place[1], place[0])), "deg", 360.0)
        rows.append([" and ".join(pair), *((x, y) if not at_infinity else ("at infinity", direction))])
    return PrintedTable("instant centres", rows, ("links", f"x ({unit})", f"y ({unit})"))
