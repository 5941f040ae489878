"""Results of each property: number of cases, the worst error, and its place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import ArrayLike


@dataclass(frozen=True)
class Property:
    """A claim that errors, each in its own unit, stay below a tolerance; `tolerance_because` gives the reason for its value."""

    claim: str
    tolerance: float
    tolerance_because: str


@dataclass
class Found:
    """The errors of one property so far."""

    cases: int = 0
    worst: float = 0.0
    at: str = ""


@dataclass
class Tally:
    """The errors of all properties, and the numbers of cases that were left out, by reason."""

    found: dict[str, Found] = field(default_factory=dict)
    left_out: dict[str, int] = field(default_factory=dict)

    def add(self, name: str, errors: ArrayLike | Sequence[float], at: str) -> None:
        """Count one or several errors of a case; NaN counts as infinite."""
        found = self.found.setdefault(name, Found())
        for error in np.ravel(np.asarray(errors, float)):
            error = math.inf if math.isnan(error) else float(error)
            found.cases += 1
            if error > found.worst or not found.at:
                found.worst, found.at = error, at

    def leave_out(self, reason: str, count: int = 1) -> None:
        """Count cases that cannot test a property."""
        self.left_out[reason] = self.left_out.get(reason, 0) + count

    def merge(self, other: "Tally") -> None:
        """Add the results of another part of a run."""
        for name, one in other.found.items():
            found = self.found.setdefault(name, Found())
            found.cases += one.cases
            if one.worst > found.worst or not found.at:
                found.worst, found.at = one.worst, one.at
        for reason, count in other.left_out.items():
            self.leave_out(reason, count)


def relative(found: np.ndarray, right: np.ndarray, unit: np.ndarray | float = 1.0, least: float = 0.0) -> float:
    """Return the largest difference over the largest entry, both in units; `least`, in units, is the smallest that counts."""
    size = max(np.max(np.abs(right / unit), initial=0.0), least)
    difference = np.max(np.abs((found - right) / unit), initial=0.0)
    return float(difference / size) if size else float(difference)
