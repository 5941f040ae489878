"""Quantities with units: strings such as "60 rpm", the dimensions of units, and the quantities of drawings.

pint knows more units, but importing it takes 0.2 s in every command, and it treats a radian as dimensionless: a frequency in 1/s
would pass for an angular velocity. Here angle is a separate dimension.
"""

import math
import re
from functools import lru_cache
from typing import NamedTuple

from udkjax.wording import quote


class _Unit(NamedTuple):
    size: float  # in SI units
    dimension: tuple[int, ...]  # powers of length, mass, time, angle

    def times(self, other: "_Unit", power: int) -> "_Unit":
        dimension = tuple(a + power * b for a, b in zip(self.dimension, other.dimension, strict=True))
        return _Unit(self.size * other.size**power, dimension)


# Powers of length, mass, time and angle.
_DIMENSIONLESS, _LENGTH, _MASS, _TIME, _ANGLE = (0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
_RATE, _FORCE, _TORQUE, _ACCELERATION = (0, 0, -1, 1), (1, 1, -2, 0), (2, 1, -2, 0), (1, 0, -2, 0)
_UNIT_SIZES = {
    _DIMENSIONLESS: {"1": 1.0},
    _LENGTH: {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048},
    _MASS: {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237},
    _TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    _ANGLE: {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "rev": 2 * math.pi},
    _RATE: {"rpm": 2 * math.pi / 60},
    _FORCE: {"N": 1.0, "mN": 1e-3, "kN": 1e3, "MN": 1e6, "lbf": 4.4482216152605},
    _TORQUE: {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3, "Nmm": 1e-3, "Ncm": 1e-2},
}
_UNITS = {name: _Unit(size, dimension) for dimension, sizes in _UNIT_SIZES.items() for name, size in sizes.items()}
_GRAVITY = _Unit(9.80665, _ACCELERATION)  # "g" of an accelerometer; elsewhere "g" is a gram
_SPELLINGS = {
    "°": "deg",
    "²": "2",
    "³": "3",
    "µ": "u",  # the micro sign
    "μ": "u",  # the Greek letter
    "·": " ",
    "**": "^",
    "*": " ",
}
_UNIT_WORDS = {
    **dict.fromkeys(("degree", "degrees"), "deg"),
    **dict.fromkeys(("radian", "radians"), "rad"),
    **dict.fromkeys(("turn", "turns"), "rev"),
    **dict.fromkeys(("second", "seconds", "sec"), "s"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
}
_USUAL_UNITS = (
    "m, mm, cm",
    "rad, deg, rev",
    "s, ms",
    "m/s, mm/s",
    "rad/s, deg/s, rpm",
    "m/s2, mm/s2, g",
    "rad/s2, deg/s2",
    "N, kN",
    "N m, N mm, kN m",
    "kg, g",
    "kg/m3, g/cm3",
    "N/m, N/mm",
    "N s/m, N s/mm",
    "N m/rad, N m/deg",
)
# Quantities whose units a file may choose, with their SI units, the default.
QUANTITY_KINDS = {
    "length": "m",
    "angle": "rad",
    "mass": "kg",
    "time": "s",
    "force": "N",
    "torque": "N m",
    "density": "kg/m3",
    "inertia": "kg m2",
    "velocity": "m/s",
    "angular_velocity": "rad/s",
    "acceleration": "m/s2",
    "stiffness": "N/m",
    "damping": "N s/m",
    "torsional_stiffness": "N m/rad",
    "torsional_damping": "N m s/rad",
}
QUANTITY_PATTERN = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")  # a number and its unit


def read_quantity(text: str, wanted: str) -> float:
    """Convert a string such as "60 rpm" to a number in the SI units `wanted`.

    Raises:
        ValueError: it is not a number with a unit, or its unit is unknown or has another dimension.
    """
    match = QUANTITY_PATTERN.fullmatch(text)
    if match is None:
        raise ValueError(f"must be a number, or a string with a number and its unit, not {quote(text)}")
    number, units = match.groups()
    if not units and wanted:
        raise ValueError(f"{quote(text)} has no unit; it is measured in {_usual_units(wanted)}")
    return float(number) * (conversion_factor(units, wanted) if wanted else 1.0)


def _usual_units(wanted: str) -> str:
    goal = _read(wanted)
    return next((unit for unit in _USUAL_UNITS if _read(unit.partition(",")[0]).dimension == goal.dimension), wanted)


def conversion_factor(units: str, wanted: str) -> float:
    """Return the factor that converts numbers in `units` to the SI units `wanted`.

    Args:
        units: products written with a space, powers as m/s2 or m/s^2. "g" is a gram; for an acceleration, 9.80665 m/s2.
        wanted: the SI units of the converted numbers.

    Raises:
        ValueError: `units` are unknown, or have another dimension.
    """
    if units.split() == wanted.split():
        return 1.0
    goal = _read(wanted)
    given = _GRAVITY if units.strip() == "g" and goal.dimension == _ACCELERATION else _read(units)
    if given.dimension != goal.dimension:
        raise ValueError(f"{quote(units)} does not fit; it is measured in {_usual_units(wanted)}")
    return given.size / goal.size


def dimension_of(units: str) -> tuple[int, ...]:
    """Return the powers of length, mass, time and angle of units; raise a `ValueError` if they are unknown."""
    return _read(units).dimension


@lru_cache(256)
def unit_of(dimension: tuple[int, ...]) -> str:
    """Return the SI unit of a dimension: that of a quantity of a drawing, or else a product of m, kg, s and rad, such as "m2"."""
    for unit in QUANTITY_KINDS.values():
        if dimension_of(unit) == dimension:
            return unit
    powers = dict(zip(("m", "kg", "s", "rad"), dimension, strict=True))
    above, below = ([f"{name}{abs(k) if abs(k) > 1 else ''}" for name, k in powers.items() if sign * k > 0] for sign in (1, -1))
    return "/".join([" ".join(above) or "1" * bool(below), *below])


def unit_sizes(wanted: str) -> dict[str, float]:
    """Return the size of each single unit with the dimension of `wanted`, an SI unit, by all spellings that are read."""
    names = {*_UNITS, *_UNIT_WORDS, *(name.replace(usual, spelling) for spelling, usual in _SPELLINGS.items() for name in _UNITS)}
    dimension = _read(wanted).dimension
    units = {name: _read(name) for name in sorted(names)}
    return {name: unit.size for name, unit in units.items() if unit.dimension == dimension}


def _read(text: str) -> _Unit:
    """Read a product of powers of units; a slash divides by the unit that follows it."""
    plain = text
    for spelling, usual in _SPELLINGS.items():
        plain = plain.replace(spelling, usual)
    product = _UNITS["1"]
    for slash, name, power in re.findall(r"(/?)\s*([^\W\d]+|1)\^?(-?\d+)?|\S", plain):
        name = _UNIT_WORDS.get(name, name)
        if name not in _UNITS:
            suggestions = [f"; did you mean {quote(unit)}?" for unit in _UNITS if unit.lower() == f"{name}".lower()]
            suggestions += ["; cycles a second are rev/s"] if f"{name}".endswith("Hz") else []
            cure = suggestions[0] if suggestions else f": they are made of {', '.join(_UNITS)}"
            raise ValueError(f"{quote(text)} is not a known unit{cure}")
        product = product.times(_UNITS[name], int(power or 1) * (-1 if slash else 1))
    return product
