"""Ranges of a motion: swing angles and strokes of the links on the ground, least and largest transmission angles."""

from typing import Annotated

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.argument_types import HISTORY
from udkjax.arrays import FULL_TURN
from udkjax.positions.answers.transmission import transmission_angle
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.assembling.coordinates import element_of
from udkjax.positions.following.drive import Drive
from udkjax.printing import PrintedTable, PrintsTable, fields_table, has_numbers
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Prismatic, Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError

FULL_SWING = FULL_TURN * (1 - 1e-9)  # (rad) a link with a larger swing makes full turns; the margin is for rounding


class MotionRanges(PrintsTable):
    """The ranges of a motion at its positions; between positions links may go slightly farther.

    Attributes:
        swings: the swing angle (rad) of each body that a revolute joint connects to the ground.
        strokes: the stroke (m) of each body that a prismatic joint connects to the ground.
        transmission_angles: by joint, the least and the largest angle (rad, 0 to pi) between the two links of a pin.
    """

    swings: dict[str, Float[Array, ""]]
    strokes: dict[str, Float[Array, ""]]
    transmission_angles: dict[str, Float[Array, "2"]]

    def _table(self) -> PrintedTable:
        if not has_numbers(self) or any(np.ndim(x) for x in (*self.swings.values(), *self.strokes.values())):
            return fields_table(self, {}, "ranges of motions")
        return PrintedTable("ranges of a motion", list(range_lines(self).items()))


@checked
def motion_ranges(mechanism: Mechanism, motion: Annotated[StateHistory, HISTORY], driver: Drive = None) -> MotionRanges:
    """Return the swing angles and strokes of the links on the ground along a motion, and the ranges of its transmission angles.

    Positions that are not reached (NaN) are ignored.

    Args:
        mechanism: the linkage.
        motion: anything with q (T, bodies, 3), a `Kinematics` or a `Solution`.
        driver: the driver or coordinate, as for `kinematics`; pins of the links that it drives have no transmission angle. None:
            every pin of two moving links with one other pin each has a transmission angle.

    Returns:
        A `MotionRanges`; NaN where the motion has no position.

    Raises:
        SceneError: no such driver or coordinate.
    """
    q = jnp.asarray(motion.q)
    driven = () if driver is None else element_of(mechanism, driver).bodies
    found = MotionRanges({}, {}, {})
    for name, joint in mechanism.joints.items():
        if not isinstance(joint, Revolute | Prismatic):
            continue
        moving = [body for body in joint.bodies if body != GROUND]
        if len(moving) == 1:
            x, y, angle = jnp.moveaxis(_ends(q[:, mechanism.body_names.index(moving[0])]), -1, 0)
            if isinstance(joint, Revolute):
                found.swings[moving[0]] = angle[1] - angle[0]
            else:
                found.strokes[moving[0]] = jnp.hypot(x[1] - x[0], y[1] - y[0])
        elif isinstance(joint, Revolute) and not set(moving) & set(driven):
            try:
                found.transmission_angles[name] = _ends(transmission_angle(mechanism, motion, name))
            except SceneError:  # links with more than two pins have no transmission angle
                continue
    return found


def _ends(x: Float[Array, "T *k"]) -> Float[Array, "2 *k"]:
    """Return the least and the largest value over the first axis, ignoring NaN."""
    return jnp.stack([jnp.nanmin(x, 0), jnp.nanmax(x, 0)])


def range_lines(found: MotionRanges) -> dict[str, str]:
    """Return the ranges as texts, by body or joint; ranges without a position are left out."""
    swings, strokes, angles = (
        {name: np.asarray(x) for name, x in ranges.items() if np.all(np.isfinite(x))}
        for ranges in (found.swings, found.strokes, found.transmission_angles)
    )
    lines = {
        name: "turns all the way round" if x > FULL_SWING else f"turns by {np.degrees(x):.4g} deg" for name, x in swings.items()
    }
    lines |= {name: f"slides by {x:.4g} m" for name, x in strokes.items()}
    for name, (least, largest) in angles.items():
        if largest > 0:  # otherwise all pins of a link coincide
            lines[f"angle at {name}"] = f"{np.degrees(least):.4g} to {np.degrees(largest):.4g} deg between its links"
    return lines
