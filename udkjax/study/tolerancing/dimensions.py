"""Tolerances of numbers of a mechanism, and the numbers of samples.

Each number is x = x0 + c + s u: its nominal value, the middle of its limits, its standard deviation, and a random deviation u
with zero mean and unit variance. Numbers that share a source, such as holes of one drill jig, have the same u.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import ndtr, ndtri

from udkjax.positions.assembling.channels import has_point
from udkjax.requirements import require_choice, require_number, require_numbers, require_text
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.units import conversion_factor, read_quantity
from udkjax.scene.tables.checks import SceneError
from udkjax.study.identify.problem.parameters import Parameter, unknowns_of
from udkjax.study.identify.problem.unknowns import Target, apply_values
from udkjax.study.identify.records.records import IdentificationError
from udkjax.wording import quote, suggestion

DeviationKind = Literal["normal", "uniform", "truncated"]


@dataclass(frozen=True)
class Tolerance:
    """The deviation of a number from its nominal value.

    Attributes:
        deviation: the largest deviation, to both sides; or the lower and upper one, such as (-0.03, 0).
        unit: its unit; by default SI.
        distribution: "normal", "uniform" between the limits, or "truncated": normal, without the pieces beyond the limits.
        sigmas: standard deviations from the middle to a limit, if normal or truncated.
        shared: a name; numbers with the same one deviate together, as holes of one drill jig.
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
        """The mean of u^4: 3 of a normal distribution."""
        if self.distribution == "uniform":
            return 1.8
        if self.distribution == "normal":
            return 3.0
        a, mass = self.sigmas, 2.0 * ndtr(self.sigmas) - 1.0
        share = 2.0 * a * np.exp(-(a**2) / 2.0) / (2.0 * np.pi) ** 0.5 / mass
        return float((3.0 - share * (a**2 + 3.0)) / (1.0 - share) ** 2)

    def units(self, normal: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
        """Return deviations u of unit variance from numbers with a normal distribution."""
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
SIZES = (3, 6, 10, 18, 30, 50, 80, 120, 180, 250, 315, 400, 500)
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
    """Return the tolerance of a grade of ISO 286, such as "h9", for a nominal length (m); None if the text is no grade.

    Raises:
        ValueError: the grade or the length is not in the table.
    """
    letters, digits = text.rstrip("0123456789"), text[len(text.rstrip("0123456789")) :]
    if letters not in _SIDES or not digits:
        return None
    size = abs(length) * 1e3
    if int(digits) not in GRADES:
        raise ValueError(f"{quote(text)}: grades are {min(GRADES)} to {max(GRADES)}; give the deviation in mm")
    if not 0.0 < size <= SIZES[-1]:
        raise ValueError(f"{quote(text)}: a length of {size:g} mm has no grade, only one up to {SIZES[-1]} mm")
    width = GRADES[int(digits)][next(k for k, most in enumerate(SIZES) if size <= most)] * 1e-6
    low, high = _SIDES[letters]
    return Tolerance((low * width, high * width), "m")


class DeviationSource(NamedTuple):
    """An independent deviation u: its name, and the tolerance whose distribution it has; a clearance has two."""

    name: str
    tolerance: Tolerance
    clearance: bool = False


@dataclass(frozen=True)
class _Play:
    """Moves a pin in its hole along x or y of the second body."""

    joint: str
    axis: int

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        name = f"joint.{self.joint}.points"
        return mechanism.with_parameters({name: jnp.asarray(mechanism.parameters()[name]).at[1, self.axis].add(value)})


class ToleratedNumbers:
    """The numbers of a mechanism that have tolerances.

    Args:
        mechanism: the mechanism.
        given: tolerances by name: a name of `parameters()`, `length(crank)`, or a joint with a `PinClearance`.

    Raises:
        SceneError: lists every mistake.
    """

    def __init__(self, mechanism: Mechanism, given: Mapping[str, ToleranceLike]):
        self.mechanism, problems = mechanism, []
        self.names: list[str] = []
        self.targets: list[Target] = []
        self.sources: list[DeviationSource] = []
        rows: list[tuple[float, float, float, int]] = []  # nominal value, middle, standard deviation, source
        # Clearances come last: a pin of a drawing that moves takes the points of its joints with it.
        for name, tolerance in sorted(given.items(), key=lambda item: isinstance(item[1], PinClearance)):
            try:
                rows += self._play(name, tolerance) if isinstance(tolerance, PinClearance) else self._numbers(name, tolerance)
            except SceneError as error:
                problems += [f"tolerances: {problem}" for problem in error.problems]
            except (ValueError, TypeError) as problem:
                problems += [f"tolerances: {quote(name)}: {problem}"]
        if not given:
            problems.append('tolerances: none is given: name one, such as {"length(crank)": "0.05 mm"}')
        if problems:
            raise SceneError(problems, mechanism.name)
        table = np.array(rows)
        self.nominal, self.middle, self.sizes = table[:, 0], table[:, 1], table[:, 2]
        self.owners = table[:, 3].astype(int)

    @property
    def count(self) -> int:
        """The number P of numbers."""
        return len(self.nominal)

    def moved(self, x: Array) -> Mechanism:
        """Return the mechanism with the numbers x (P,), which may be traced."""
        return apply_values(self.mechanism, self.targets, x)

    def values(self, u: Float[np.ndarray, "N K"], scales: Float[np.ndarray, "K"] | float = 1.0) -> Float[np.ndarray, "N P"]:
        """Return the numbers of samples from the deviations of their sources, which may be scaled."""
        return self.nominal + self.middle + self.sizes * (u * scales)[:, self.owners]

    def deviations(self, normal: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N K"]:
        """Return the deviations u of all sources from numbers with a normal distribution."""
        u = np.empty_like(normal)
        for k, source in enumerate(self.sources):
            u[:, k] = source.tolerance.units(normal[:, k])
        for k in [k for k, source in enumerate(self.sources) if source.clearance][::2]:  # x and y: a random direction
            pair = normal[:, k : k + 2]
            u[:, k : k + 2] = pair * (2.0**0.5 / np.maximum(np.hypot(pair[:, 0], pair[:, 1]), 1e-300))[:, None]
        return u

    def _source(self, source: DeviationSource) -> int:
        """Return the number of a source, a new one unless it is shared."""
        shared = source.tolerance.shared
        for k, other in enumerate(self.sources):
            if shared and other.tolerance.shared == shared:
                same = (other.tolerance.distribution, other.tolerance.sigmas)
                if same != (source.tolerance.distribution, source.tolerance.sigmas):
                    raise ValueError(f"shares {quote(shared)} with another distribution: give both the same")
                return k
        self.sources.append(source)
        return len(self.sources) - 1

    def _numbers(self, name: str, given: ToleranceLike) -> list[tuple[float, float, float, int]]:
        try:
            unknowns = unknowns_of(self.mechanism, [Parameter(name)])
        except IdentificationError as error:
            raise ValueError("; ".join(p.removeprefix("parameters: ") for p in error.problems)) from None
        owner = name.partition(".")[2].partition(".")[0]
        if name.startswith("driver.") and owner in self.mechanism.drivers:
            raise ValueError("is prescribed by a driver, and has no tolerance: sweep it instead")
        rows = []
        for entry, units, target, nominal in zip(unknowns.names, unknowns.units, unknowns.targets, unknowns.guess, strict=True):
            tolerance = _read(given, units, float(nominal))
            factor = conversion_factor(tolerance.unit, units) if tolerance.unit else 1.0
            low, high = (factor * x for x in tolerance.limits)
            known = DeviationSource(tolerance.shared or entry, tolerance)
            rows.append((float(nominal), (low + high) / 2.0, tolerance.spread * (high - low) / 2.0, self._source(known)))
            self.names.append(entry)
            self.targets.append(target)
        return rows

    def _play(self, name: str, clearance: PinClearance) -> list[tuple[float, float, float, int]]:
        joints = [k for k, joint in self.mechanism.joints.items() if has_point(joint)]
        joint = name.removeprefix("joint.").removeprefix("pin.")
        if joint not in joints:
            raise ValueError(f"there is no joint with a pin of this name{suggestion(joint, joints)}")
        size = clearance.size / 2.0**0.5
        rows = []
        for axis, letter in enumerate("xy"):
            entry = f"clearance({joint}).{letter}"
            self.sources.append(DeviationSource(entry, Tolerance(size, "m"), True))
            rows.append((0.0, 0.0, size, len(self.sources) - 1))
            self.names.append(entry)
            self.targets.append(Target(function=_Play(joint, axis)))
        return rows


def _read(given: Any, units: str, nominal: float) -> Tolerance:
    if isinstance(given, Tolerance):
        return given
    if isinstance(given, str):
        if units == "m" and (of_grade := grade(given.strip(), nominal)) is not None:
            return of_grade
        if units != "m" and grade(given.strip(), 0.1) is not None:
            raise ValueError(f"{quote(given)} is a grade of a length; this number is measured in {units or 'no unit'}")
        text = given.strip().removeprefix("+-").removeprefix("±")
        return Tolerance(read_quantity(text, units), units)
    if isinstance(given, bool) or np.ndim(given) or not np.isreal(given):
        raise TypeError('must be a number, a text such as "0.05 mm" or "h9", a Tolerance or a PinClearance')
    return Tolerance(float(given), units)
