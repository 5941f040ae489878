"""Positions, velocities and accelerations of all pins and links of a mechanism, as tables."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike
from udkjax.argument_types import HISTORY, NUMBERS_BY_NAME, ArgumentRequirement
from udkjax.arrays import by_numpy, library_for
from udkjax.positions.answers.counting import DRAWN_TOL, Count
from udkjax.positions.assembling.channels import pins_of, point_of_pin
from udkjax.positions.assembling.coordinates import value_of
from udkjax.positions.following.drive import Drive, constant_speed, only_driver
from udkjax.positions.following.kinematics import Kinematics, kinematics
from udkjax.printing import PRINTED_AS_ZERO, PrintedTable, PrintsTable, fields_table, format_number, has_numbers, units
from udkjax.requirements import GivenArguments, concrete_only, require_finite
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Revolute
from udkjax.scene.mechanism import Mechanism

TableRows = Sequence[Sequence[float]] | np.ndarray  # of a table, (T, columns)


class PinMotion(PrintsTable):
    """Motion of the pins and links of a mechanism over values of its driver; NaN at values that are not reached.

    Attributes:
        values: values of the driver (T,), in rad or m.
        pins: by name, x and y of the position (m), velocity (m/s) and acceleration (m/s^2): (T, 3, 2).
        links: by name, angle (rad), angular velocity (rad/s) and angular acceleration (rad/s^2): (T, 3).
        rate: the rate of the driver (T,), in rad/s or m/s.
        count: the zero and the units in which values are shown; None: SI units.
    """

    values: Float[Array, "T"]
    pins: dict[str, Float[Array, "T 3 2"]]
    links: dict[str, Float[Array, "T 3"]]
    rate: Float[Array, "T"]
    count: Count | None = eqx.field(static=True, default=None)

    _units = units(pins="m, m/s, m/s²", links="rad, rad/s, rad/s²")

    def _table(self) -> PrintedTable:
        if self.count is None or np.ndim(self.values) != 1 or not has_numbers((self.values, self.pins, self.links)):
            return fields_table(self, self._units, "motion of pins and links")
        pins, links = self.tables()
        width = len(pins.heads) - len(links.heads)
        below = [[*row, *[""] * width] for row in ([""] * len(links.heads), links.heads, *links.rows)]
        return PrintedTable(pins.title, [*pins.rows, *below], pins.heads)

    def tables(self) -> list[PrintedTable]:
        """Return the table of pins and that of links, in the units of the drawing.

        If there are several values of the driver, each has a row for each pin or link.

        Raises:
            ValueError: `count` is None.
        """
        count = self.count
        if count is None:
            raise ValueError("count is None: the units of the tables are not known; use udk.motion_at")
        unit = count.units.shown("m")
        heads = ["pin", f"x ({unit})", f"y ({unit})", f"v ({unit}/s)", "at (deg)", f"a ({unit}/s²)", "at (deg)"]
        links = ["link", "angle (deg)", "omega (rad/s)", "alpha (rad/s²)", *(["torque ratio"] if count.is_angle else [])]
        scale = np.array([180 / np.pi, 1.0, 1.0])
        motions = {name: np.asarray(motion) / count.units.size("m") for name, motion in self.pins.items()}
        usual, turning = self._usual(count.is_angle)
        largest = [max([usual[k], *(float(np.nanmax(np.abs(x[:, k]), initial=0.0)) for x in motions.values())]) for k in range(3)]
        pin_rows = {name: [_pin_row(x, [DRAWN_TOL * y for y in largest]) for x in motion] for name, motion in motions.items()}
        link_rows: dict[str, np.ndarray] = {name: np.asarray(motion) * scale for name, motion in self.links.items()}
        if len(self.values) == 1:  # over several values, angles are continuous
            for rows in link_rows.values():
                rows[:, 0] = 180.0 - (180.0 - rows[:, 0]) % 360.0
        if count.is_angle:  # torque out for one of the driver: power in is power out
            ratios = {name: _ratio(np.asarray(self.rate), np.asarray(motion)) for name, motion in self.links.items()}
            link_rows = {name: np.column_stack([rows, ratios[name]]) for name, rows in link_rows.items()}
        x, v, a = largest
        first = self._rows(count, self.title(), heads, pin_rows, [x, x, v, 0.0, a, 0.0])
        return [first, self._rows(count, "", links, link_rows, [0.0, turning, turning**2, 0.0])]

    def _usual(self, is_angle: bool) -> tuple[list[float], float]:
        """Return usual sizes of places, velocities and accelerations of pins (shown units), and of angular velocities (rad/s).

        They follow from the size of the mechanism and the rate of its driver. Numbers that are far smaller are rounding errors.
        """
        assert self.count is not None
        places = [np.asarray(motion)[:, 0] for motion in self.pins.values()]
        size = max([0.0, *(float(np.nanmax(np.abs(x), initial=0.0)) for x in places)]) / self.count.units.size("m")
        rate = float(np.nanmax(np.abs(np.asarray(self.rate)), initial=0.0))
        turning = rate if is_angle else rate / self.count.units.size("m") / size if size else 0.0
        return [size, size * turning, size * turning**2], turning

    def counted(self, count: Count) -> "PinMotion":
        """Return the same motion with another `Count`, by which the driver's values are shown."""
        return dataclasses.replace(self, count=count)

    def title(self) -> str:
        """Return a title with the driver's value, or its first and last, the counted quantity and its zero, and its rate."""
        count = self.count
        assert count is not None
        ends = [count.text(float(x)) for x in (self.values[0], self.values[-1])]
        at = f"at {ends[0]}" if len(self.values) == 1 else f"from {ends[0]} to {ends[1]}"
        return f"{at}, {count.words}; {count.rate_text(float(self.rate[0]))}"

    def _rows(
        self, count: Count, title: str, heads: list[str], rows: Mapping[str, TableRows], usual: Sequence[float]
    ) -> PrintedTable:
        """Return a table with a row for each name and value; the driver's values are a column if there are several.

        Args:
            count: the count of the driver's values.
            title: the title of the table.
            heads: its heads.
            rows: its numbers by name.
            usual: the least size that is assumed for the numbers of each column, to recognize rounding errors.
        """
        many = len(self.values) > 1
        sizes = np.abs(np.array([row for motion in rows.values() for row in motion]).reshape(-1, len(heads) - 1))
        largest = np.maximum(np.max(sizes, axis=0, initial=0.0, where=np.isfinite(sizes)), usual[: len(heads) - 1])
        scales = [
            360.0 if "deg" in head else None if "ratio" in head else DRAWN_TOL / PRINTED_AS_ZERO * x
            for head, x in zip(heads[1:], largest, strict=True)
        ]
        cells = [
            [name, *([count.number(value)] if many else []), *map(_cell, row, scales)]
            for name, motion in rows.items()
            for value, row in zip(np.asarray(self.values), motion, strict=True)
        ]
        return PrintedTable(title, cells, [heads[0], *([f"driver ({count.unit})"] if many else []), *heads[1:]])


def _pin_row(motion: Float[np.ndarray, "3 2"], least: Sequence[float]) -> list[float]:
    """Return x and y of a pin, and size and direction (deg) of its velocity and acceleration.

    Components of the position, velocity and acceleration below the three numbers of `least` are rounding errors, shown as zero.
    """
    place, *vectors = np.where(np.abs(motion) > np.reshape(least, (3, 1)), motion, np.where(np.isnan(motion), np.nan, 0.0))
    sizes = [[float(np.hypot(*vector)), float(np.degrees(np.arctan2(vector[1], vector[0])))] for vector in vectors]
    return [*place.tolist(), *sizes[0], *sizes[1]]


def _ratio(rate: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Return the driver's rate over a link's angular velocity, (T,): infinite where the link stands still, NaN if it never turns.

    `motion` has the link's angle, angular velocity and angular acceleration, (T, 3).
    """
    omega, alpha = motion[:, 1], motion[:, 2]
    still = np.abs(omega) <= DRAWN_TOL * np.abs(rate)
    never = np.all(still & (np.abs(alpha) <= DRAWN_TOL * rate**2))
    return np.full_like(omega, np.nan) if never else np.where(still, np.inf, rate / np.where(still, 1.0, omega))


def _cell(x: float, scale: float | None) -> str:
    if scale is None:  # a ratio
        return "" if np.isnan(x) else format_number(x)
    return format_number(x, scale=scale)


def _require_finite_or_text(name: str, value: Any, given: GivenArguments) -> None:
    if not isinstance(value, str):
        require_finite(name, value)


FINITE_OR_TEXT = ArgumentRequirement("finite, or a number with its unit", _require_finite_or_text)


@checked
def pin_motion(mechanism: Mechanism, motion: Annotated[Kinematics, HISTORY]) -> PinMotion:
    """Return position, velocity and acceleration of each moving pin, and angle, angular velocity and acceleration of each link.

    With the arm r from the centre of a link, v = v_c + omega x r and a = a_c + alpha x r - omega^2 r. A drawn link's angle is
    that of the direction from its first pin to its second. Differentiable like the `Kinematics`.

    Args:
        mechanism: the mechanism.
        motion: its kinematics.

    Returns:
        A `PinMotion`.
    """
    fixed = [name for name, joint in mechanism.joints.items() if isinstance(joint, Revolute) and GROUND in joint.bodies]
    named = pins_of(mechanism) if mechanism.drawing is None else list(mechanism.drawing.pins)  # a drawn slide has its link's pin
    places = {name: point_of_pin(mechanism, name) for name in named if name not in fixed}
    pins = {name: _point_motion(motion, *place) for name, place in places.items() if place[0] != GROUND}
    parts = [by_numpy(x) for x in (motion.q, motion.v, motion.a)]
    xp = library_for(parts)
    links = {name: xp.stack([x[:, k, 2] for x in parts], 1) for k, name in enumerate(motion.bodies)}
    return PinMotion(motion.values, pins, links, motion.rate)


def _point_motion(motion: Kinematics, body: str, local: Array) -> Float[Array, "T 3 2"]:
    """Return position, velocity and acceleration, in ground axes, of the point `local` of a body, given in its frame (m)."""
    q, v, a, (px, py) = (by_numpy(x) for x in (motion.q, motion.v, motion.a, local))
    xp = library_for((q, v, a, px))
    k = motion.bodies.index(body)
    (x, y, angle), (vx, vy, omega), (ax, ay, alpha) = (xp.moveaxis(z[:, k], -1, 0) for z in (q, v, a))
    c, s = xp.cos(angle), xp.sin(angle)
    rx, ry = c * px - s * py, s * px + c * py
    rows = [[x + rx, y + ry], [vx - omega * ry, vy + omega * rx]]
    rows.append([ax - alpha * ry - omega**2 * rx, ay + alpha * rx - omega**2 * ry])
    return xp.stack([xp.stack(row, -1) for row in rows], 1)


@checked
@concrete_only()
def motion_at(
    mechanism: Mechanism,
    at: NumberLike | str | Sequence[float | str],
    driver: Drive = None,
    rate: Annotated[NumberLike | str, FINITE_OR_TEXT] | None = None,
    acceleration: Annotated[NumberLike | str, FINITE_OR_TEXT] = 0.0,
    held: Annotated[Mapping[str, NumberLike], NUMBERS_BY_NAME] | None = None,
) -> PinMotion:
    """Return the motion of all pins and links at values of the driver: `udk.motion_at(mech, "60 deg", rate="600 rpm")`.

    Angles are those of the drawing: the angle of a crank is that of the line from its pin on the ground to its other pin,
    from the x axis.

    Args:
        mechanism: a mechanism of one degree of freedom once its drivers hold; its numbers are not traced.
        at: one or several values of the driver, in the unit of the drawing (SI without a drawing), or texts with units.
        driver: a driver or coordinate, as for `kinematics`; by default the only driver.
        rate: its rate, in the unit of the drawing or as text, "60 rpm"; by default that of a motor at constant speed, or 1
            rad/s or m/s.
        acceleration: its acceleration, in rad/s^2 or m/s^2, or as text.
        held: values that other drivers or coordinates hold, as for `kinematics`.

    Returns:
        A `PinMotion`, which prints as a table.

    Raises:
        SceneError: there is no such driver, positions do not follow from it, or a value cannot be read.
    """
    driver = only_driver(mechanism) if driver is None else driver
    count = Count.of(mechanism, driver)
    given = list(at) if isinstance(at, list | tuple) else np.atleast_1d(at).tolist()
    values = np.array([count.read(value, "at") for value in given])
    if len(values) == 1:
        values[0] = count.nearest(values[0], float(value_of(mechanism, driver)(mechanism.q0)))
    rate = usual_rate(mechanism, driver) if rate is None else count.read_rate(rate, "rate")
    second = 0.0 if acceleration == 0.0 else count.read_rate(acceleration, "acceleration", 2)
    motion = kinematics(mechanism, driver, values, rate=rate, acceleration=second, held=held)
    return pin_motion(mechanism, motion).counted(count)


def usual_rate(mechanism: Mechanism, driver: Drive) -> float:
    """Return the constant speed of a driver (rad/s, m/s); 1 if it has none, or for a coordinate without a driver."""
    return (constant_speed(mechanism, driver) if isinstance(driver, str) else 0.0) or 1.0
