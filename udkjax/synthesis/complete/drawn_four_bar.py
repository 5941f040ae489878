"""Roles of the pins of a drawn four-bar, and its pins and driver's values in batches."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from udkjax.positions.assembling.coordinates import element_of
from udkjax.positions.following.drive import Drive
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.complete.four_bars import FourBars
from udkjax.wording import quote

OTHER_SECTIONS = ("slide", "slot", "gear", "cam", "body", "joint")


class DrawnFourBar(NamedTuple):
    """Names of a four-bar's pins and links, and the sign and origin of its driver.

    Attributes:
        mechanism: the mechanism of the drawing.
        driver: the driver of the crank.
        pins: the pins by role: O, A, B, C, P.
        coupler: the link with the traced point.
        sign: 1.0 if the driver is the crank's angle, -1.0 if it is the negative angle.
        is_reversed: whether the x axis of the crank's frame points from A to O.
    """

    mechanism: Mechanism
    driver: Drive
    pins: Mapping[str, str]
    coupler: str
    sign: float
    is_reversed: bool

    def places(self, bars: FourBars, which: np.ndarray, position: np.ndarray) -> dict[str, np.ndarray]:
        """Return the places (M, 2) of pins by name, for the four-bars `which` (M,), each in the position with an index (M,)."""
        joints = {"O": bars.O[which], "C": bars.C[which], "P": bars.P[position]}
        joints |= {"A": bars.A[which, position], "B": bars.B[which, position]}
        return {f"pin.{self.pins[key]}": np.stack([np.real(z), np.imag(z)], 1) for key, z in joints.items()}

    def coordinates(self, joints: Mapping[str, np.ndarray], start: np.ndarray) -> dict[str, np.ndarray]:
        """Return complex x and y (2,) by the name of a pin, from x + i y and x - i y by the letter of a joint, minus `start`."""
        return {f"pin.{self.pins[key]}": start + np.array([z + w, (z - w) / 1j]) / 2 for key, (z, w) in joints.items()}

    def values(self, bars: FourBars, angles: np.ndarray) -> np.ndarray:
        """Return the driver's values (M, J) (rad) for crank angles (M, J), from the value in the drawn first position."""
        drawn = bars.crank_angles[:, :1] + np.pi * self.is_reversed
        drawn = drawn - 2 * np.pi * np.ceil((drawn - np.pi) / (2 * np.pi))
        return self.sign * (drawn + angles - angles[:, :1])


def read_four_bar(mechanism: Mechanism, point: str, driver: Drive) -> DrawnFourBar:
    """Return the roles of a drawing's pins; raise `SceneError` unless it is a four-bar with `point` on its coupler."""
    if mechanism.drawing is None:
        raise SceneError(["drawing: all solutions are found only for drawn four-bars: give a Drawing"], mechanism.name)
    groups = mechanism.drawing.groups
    ground: tuple[str, ...] = getattr(mechanism.drawing, "ground")  # noqa: B009  # of a drawing, whose class is above
    links = {name: list(getattr(link, "pins")) for name, link in groups["link"].items()}  # noqa: B009
    point = point.removeprefix("pin.")
    pivoting = {name: pins for name, pins in links.items() if set(pins) & set(ground)}
    free = [name for name in links if name not in pivoting]
    problems = [f"a four-bar has no {section}s: delete them" for section in OTHER_SECTIONS if groups.get(section)]
    if (
        len(links) != 3
        or len(free) != 1
        or any(len(pins) != 2 or len(set(pins) & set(ground)) != 1 for pins in pivoting.values())
    ):
        problems.append(
            "a four-bar has three links: two with two pins each, one of them on the ground, and one that connects these links"
        )
    if problems:
        raise SceneError([f"drawing: {p}" for p in problems], mechanism.name)
    (coupler,), pins = free, links[free[0]]
    element = element_of(mechanism, driver) if driver is not None else None
    turned = [] if element is None else [body for body in element.bodies if body in pivoting]
    if element is None or element.coordinate != "angle" or GROUND not in element.bodies or not turned:
        cure = f"drive the angle of {' or '.join(map(quote, pivoting))} against the ground"
        raise SceneError([f"driver: all solutions are classified for a crank: {cure}"], mechanism.name)
    crank, (other,) = turned[0], [name for name in pivoting if name != turned[0]]
    roles = {"P": point}
    for name, (fixed, moving) in ((crank, "OA"), (other, "CB")):
        roles[fixed] = next(p for p in pivoting[name] if p in ground)
        roles[moving] = next(p for p in pivoting[name] if p not in ground)
    if {*pins} != {roles["A"], roles["B"], point} or len(pins) != 3:
        raise SceneError(
            [
                f"goal: the coupler {quote(coupler)} must have the pins {quote(roles['A'])}, {quote(roles['B'])} and the point "
                f"of the goal, {quote(point)}; it has {', '.join(map(quote, pins))}"
            ],
            mechanism.name,
        )
    sign = 1.0 if element.bodies[0] == GROUND else -1.0
    return DrawnFourBar(mechanism, driver, roles, coupler, sign, pivoting[crank][0] != roles["O"])
