"""Values of a driver as textbooks count them: the angle of a crank as drawn, from the x axis, in the units of the drawing."""

import math
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from udkjax.arrays import FULL_TURN, ROUNDING
from udkjax.positions.assembling.coordinates import Coordinate, element_of
from udkjax.printing import format_number
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate

DRAWN_TOL = 1e-10  # relative to the largest: smaller is rounding of a drawing's numbers, which editors write with twelve digits


class Count(NamedTuple):
    """The scale on which a driver's values, or the times of a run, are shown and read: the number is (value + offset) / size.

    Attributes:
        offset: the angle, length or time (rad, m, s) that is added to the value.
        size: the size of the shown unit in rad, m or s.
        unit: the name of the shown unit.
        words: a phrase that names the quantity and where it is measured from, such as "the angle of A-B from the x axis".
        units: the units of the drawing, in which other quantities are shown, and numbers without a unit are read.
    """

    offset: float
    size: float
    unit: str
    words: str
    units: Units

    @classmethod
    def of(cls, mechanism: Mechanism, driver: str | Coordinate) -> "Count":
        """Return the `Count` of a driver or coordinate; numbers of the mechanism are concrete.

        The angle of a drawn link on the ground is that of the line from its pin on the ground to its first other pin; the angles
        of other links are those of their bodies. Lengths are in the unit of the drawing, coordinates of slides from the drawn
        position.
        """
        units, element = Units.of(mechanism.drawing), element_of(mechanism, driver)
        first, second = element.bodies
        if element.coordinate != "angle":
            return cls(0.0, units.size("m"), units.shown("m"), _words_of_length(mechanism, driver, element), units)
        size = math.pi / 180
        if first != GROUND or not isinstance(mechanism.drawing, Drawing) or second not in mechanism.drawing.links:
            of = f"the angle of {second}" if first == GROUND else f"the angle of {second} from {first}"
            return cls(0.0, size, "deg", of, units)
        if len(mechanism.drawing.links[second].pins) < 2:
            return cls(0.0, size, "deg", f"the angle of {second}, from the drawn position", units)
        start, end, offset = _link_line(mechanism.drawing, second)
        return cls(offset, size, "deg", f"the angle of {start}-{end} from the x axis", units)

    @classmethod
    def of_run(cls, mechanism: Mechanism, unit: str) -> "Count":
        """Return the `Count` of the times of a run, if `unit` is "s", or of the values of an unknown driver, in "rad" or "m"."""
        units = Units.of(mechanism.drawing)
        if unit == "rad":
            return cls(0.0, math.pi / 180, "deg", "the angle of the driver", units)
        return cls(0.0, units.size(unit), units.shown(unit), "time" if unit == "s" else "the way of the driver", units)

    @property
    def is_angle(self) -> bool:
        """True if the driver is an angle."""
        return self.unit == "deg"

    @property
    def rate_unit(self) -> str:
        """The SI unit of the driver's rate."""
        return "rad/s" if self.is_angle else "m/s"

    def shown(self, value: float) -> float:
        """Return the shown number for a driver's value (rad, m)."""
        return (float(value) + self.offset) / self.size

    def text(self, value: float) -> str:
        """Return the shown number for a driver's value (rad, m), as text with its unit."""
        return f"{self.number(value)} {self.unit}"

    def number(self, value: float) -> str:
        """Return the shown number for a driver's value (rad, m), as text without its unit."""
        return format_number(self.shown(value), scale=360.0 if self.is_angle else 0.0)

    def within_turn(self, value: float) -> str:
        """Return a driver's value (rad, m) as `text` does, but an angle from 0 to 360 degrees."""
        whole = math.floor((value + self.offset) / FULL_TURN + ROUNDING) if self.is_angle else 0
        return self.text(value - FULL_TURN * whole)

    def read(self, given: object, name: str) -> float:
        """Return the driver's value (rad, m) for a shown number: a number in the unit of the drawing, or a text with its unit.

        Raises:
            SceneError: it is not a finite number, or the unit does not fit; the message begins with `name`.
        """
        return self._number(given, "rad" if self.is_angle else "m", name) - self.offset

    def read_rate(self, given: object, name: str, order: int = 1) -> float:
        """Return a rate of the driver (rad/s, m/s), or its acceleration if `order` is 2, as `read` does for a value."""
        return self._number(given, self.rate_unit + (str(order) if order > 1 else ""), name)

    def rate_text(self, rate: float) -> str:
        """Return a rate of the driver (rad/s, m/s) as a phrase, such as "at 62.8319 rad/s (600 rpm)"."""
        if self.is_angle:
            return f"at {format_number(rate, 'rad/s')} ({format_number(rate * 30 / np.pi, 'rpm')})"
        return f"at {format_number(rate / self.size, self.unit)}/s"

    def nearest(self, value: float, start: float) -> float:
        """Return a driver's value (rad, m), in the case of an angle shifted by whole turns to be nearest to `start`."""
        return value - FULL_TURN * round((value - start) / FULL_TURN) if self.is_angle else value

    def _number(self, given: object, unit: str, name: str) -> float:
        """Return a number in an SI unit, from a number in the unit of the drawing or a text with its unit."""
        problems: list[str] = []
        with suppress(ValueError):  # a text with a unit
            given = float(given) if isinstance(given, str) else given
        found = self.units.convert(name, given, unit, problems)
        if problems or not isinstance(found, int | float | np.number):
            raise SceneError(problems or [f"{name}: must be a number, or a text with a number and its unit"])
        if not math.isfinite(found):
            raise SceneError([f"{name}: must be finite, not {abbreviate(given)}"])
        return float(found)


def _link_line(drawing: Drawing, link: str) -> tuple[str, str, float]:
    """Return the two pins whose line gives a link its angle in textbooks, and its difference from the body's angle (rad).

    The line begins at a pin on the ground if the link has one. A link of one pin has its body's angle.
    """
    places = {name: np.asarray(place) for name, place in drawing.pins.items()}
    pins = list(drawing.links[link].pins)
    if len(pins) < 2:
        return pins[0], pins[0], 0.0
    start = next((pin for pin in pins if pin in drawing.ground), pins[0])
    end = next(pin for pin in pins if pin != start)
    drawn, of_frame = places[end] - places[start], places[pins[1]] - places[pins[0]]
    return start, end, math.atan2(of_frame[0] * drawn[1] - of_frame[1] * drawn[0], of_frame @ drawn)


def _words_of_length(mechanism: Mechanism, driver: str | Coordinate, element: Coordinate) -> str:
    """Return a phrase with the length that a driver or coordinate prescribes and its zero, such as "the distance A-B"."""
    first, second = element.bodies
    motors = mechanism.drawing.groups["motor"] if isinstance(mechanism.drawing, Drawing) else {}
    motor = motors.get(driver) if isinstance(driver, str) else None
    if motor is not None:
        return "the distance " + "-".join(motor.between) if motor.between else f"the way of {second} from the drawn position"
    what = "the distance" if element.coordinate == "distance" else f"the displacement along {element.coordinate}"
    return f"{what} of {second} from {first}"
