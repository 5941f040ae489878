"""Tolerances of numbers: deviations to both sides and their distributions, grades of ISO 286, and the play of pins."""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from udkjax.requirements import require_choice, require_number, require_numbers, require_text
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.numbers.quantities import conversion_factor, read_quantity
from udkjax.wording import quote

DeviationKind = Literal["normal", "uniform", "truncated"]


@dataclass(frozen=True)
class Tolerance:
    """The deviation of a number from its nominal value.

    Attributes:
        deviation: the largest deviation to both sides; or the lower and the upper deviation, such as (-0.03, 0).
        unit: the unit of `deviation`; by default SI.
        distribution: "normal", "uniform" between the limits, or "truncated": normal, without the pieces beyond the limits.
        sigmas: standard deviations from the middle to a limit, if normal or truncated.
        shared: a name; numbers with the same name deviate together, as holes made with one drill jig.
    """

    deviation: float | tuple[float, float]
    unit: str = ""
    distribution: DeviationKind = "normal"
    sigmas: float = 3.0
    shared: str = ""

    def __post_init__(self):
        if np.ndim(self.deviation):
            require_numbers("deviation", self.deviation, (2,), "a number, or two, the lower and the upper deviation")
        low, high = self.limits
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ValueError(f"deviation must be a positive number, or a lower and a larger upper one, not {self.deviation}")
        require_text("unit", self.unit, may_be_empty=True)
        require_text("shared", self.shared, may_be_empty=True)
        require_choice("distribution", self.distribution, get_args(DeviationKind))
        require_number("sigmas", self.sigmas, "positive")

    @property
    def limits(self) -> tuple[float, float]:
        """The lower and the upper deviation, in `unit`."""
        given = np.asarray(self.deviation, float)
        low, high = (-given, given) if given.ndim == 0 else given
        return float(low), float(high)

    def middle_and_deviation(self, unit: str) -> tuple[float, float]:
        """Return the middle of the limits and the standard deviation, in `unit`."""
        factor = conversion_factor(self.unit, unit) if self.unit else 1.0
        low, high = (factor * x for x in self.limits)
        return (low + high) / 2.0, self.spread * (high - low) / 2.0

    @property
    def spread(self) -> float:
        """The standard deviation, relative to half the distance between the limits."""
        if self.distribution == "uniform":
            return 1.0 / 3.0**0.5
        if self.distribution == "normal":
            return 1.0 / self.sigmas
        density = np.exp(-(self.sigmas**2) / 2.0) / (2.0 * np.pi) ** 0.5
        return float(np.sqrt(1.0 - 2.0 * self.sigmas * density / (2.0 * ndtr(self.sigmas) - 1.0)) / self.sigmas)

    @property
    def kurtosis(self) -> float:
        """The mean of u^4, with u the deviation from the middle in standard deviations: 3 for a normal distribution."""
        if self.distribution == "uniform":
            return 1.8
        if self.distribution == "normal":
            return 3.0
        a, mass = self.sigmas, 2.0 * ndtr(self.sigmas) - 1.0
        share = 2.0 * a * np.exp(-(a**2) / 2.0) / (2.0 * np.pi) ** 0.5 / mass
        return float((3.0 - share * (a**2 + 3.0)) / (1.0 - share) ** 2)

    def units(self, normal: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Return deviations of unit variance with this distribution, from numbers with a standard normal distribution."""
        if self.distribution == "normal":
            return normal
        share = ndtr(normal)
        if self.distribution == "uniform":
            return (2.0 * share - 1.0) * 3.0**0.5
        low = ndtr(-self.sigmas)
        return ndtri(low + (1.0 - 2.0 * low) * share) / (self.sigmas * self.spread)


@dataclass(frozen=True)
class PinClearance:
    """The play of a pin in its hole: the pin is off the centre of its hole by the whole clearance, in any direction.

    This is a massless link between the two bodies with the length of the clearance. It belongs to positions: forces that press
    the pin to one side are not considered.

    Attributes:
        radius: the difference between the radii of hole and pin (m), or a text such as "0.02 mm".
    """

    radius: float | str

    def __post_init__(self):
        require_number("radius", self.size, "positive")

    @property
    def size(self) -> float:
        """The clearance in m."""
        return read_quantity(self.radius, "m") if isinstance(self.radius, str) else self.radius


ToleranceLike: TypeAlias = "float | str | Tolerance | PinClearance"

# ISO 286-1:2010, table 1: standard tolerances (um) of nominal sizes up to these (mm).
NOMINAL_SIZES = (3, 6, 10, 18, 30, 50, 80, 120, 180, 250, 315, 400, 500)
GRADES = {
    5: (4, 5, 6, 8, 9, 11, 13, 15, 18, 20, 23, 25, 27),
    6: (6, 8, 9, 11, 13, 16, 19, 22, 25, 29, 32, 36, 40),
    7: (10, 12, 15, 18, 21, 25, 30, 35, 40, 46, 52, 57, 63),
    8: (14, 18, 22, 27, 33, 39, 46, 54, 63, 72, 81, 89, 97),
    9: (25, 30, 36, 43, 52, 62, 74, 87, 100, 115, 130, 140, 155),
    10: (40, 48, 58, 70, 84, 100, 120, 140, 160, 185, 210, 230, 250),
    11: (60, 75, 90, 110, 130, 160, 190, 220, 250, 290, 320, 360, 400),
    12: (100, 120, 150, 180, 210, 250, 300, 350, 400, 460, 520, 570, 630),
    13: (140, 180, 220, 270, 330, 390, 460, 540, 630, 720, 810, 890, 970),
    14: (250, 300, 360, 430, 520, 620, 740, 870, 1000, 1150, 1300, 1400, 1550),
}  # fmt: skip
_SIDES = {"h": (-1.0, 0.0), "H": (0.0, 1.0), "js": (-0.5, 0.5), "JS": (-0.5, 0.5), "IT": (-0.5, 0.5)}


def grade(text: str, length: float) -> Tolerance | None:
    """Return the tolerance of a grade of ISO 286, such as "h9", for a nominal length (m); None if the text is not a grade.

    Raises:
        ValueError: the grade or the length is not in the table.
    """
    letters, digits = text.rstrip("0123456789"), text[len(text.rstrip("0123456789")) :]
    if letters not in _SIDES or not digits:
        return None
    size = abs(length) * 1e3
    if int(digits) not in GRADES:
        raise ValueError(f"{quote(text)}: grades are {min(GRADES)} to {max(GRADES)}; give the deviation in mm")
    if not 0.0 < size <= NOMINAL_SIZES[-1]:
        raise ValueError(f"{quote(text)}: a length of {size:g} mm has no grade, only one up to {NOMINAL_SIZES[-1]} mm")
    width = GRADES[int(digits)][next(k for k, most in enumerate(NOMINAL_SIZES) if size <= most)] * 1e-6
    low, high = _SIDES[letters]
    return Tolerance((low * width, high * width), "m")


def read_tolerance(given: Any, units: str, nominal: float, drawn: Units) -> Tolerance:
    """Return the tolerance of a number from a number, a text such as "0.05 mm" or "h9", or a `Tolerance`.

    Args:
        given: the tolerance.
        units: the SI unit of the number.
        nominal: its nominal value.
        drawn: the units of the drawing, for texts without a unit.

    Raises:
        ValueError: the text cannot be read, or is a grade of another quantity than a length.
        TypeError: `given` is neither a number nor a text nor a `Tolerance`.
    """
    if isinstance(given, Tolerance):
        return given
    if isinstance(given, str):
        if units == "m" and (of_grade := grade(given.strip(), nominal)) is not None:
            return of_grade
        if units != "m" and grade(given.strip(), 0.1) is not None:
            raise ValueError(f"{quote(given)} is a grade of a length; this number is measured in {units or 'no unit'}")
        text = given.strip().removeprefix("+-").removeprefix("±")
        return Tolerance(drawn.read_text(text, units), units)
    if isinstance(given, bool) or np.ndim(given) or not np.isreal(given):
        raise TypeError('must be a number, a text such as "0.05 mm" or "h9", a Tolerance or a PinClearance')
    return Tolerance(float(given), units)
