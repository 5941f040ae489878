"""Axes: what a sweep varies, each under a name.

An axis of numbers (parameters, tolerances, gains, initial states) is batched in one compiled program. An axis of choices (methods,
solvers, mechanisms) divides the members into groups, one program each: no member executes a branch that it did not choose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

# The settings of a run that are numbers, with their units: one program serves all their values.
NUMBERS = {
    "rtol": "1",
    "atol": "1",
    "rank_tol": "1",  # relative; in the units of D where the method is absolute
    "branch_tol": "1",
    "alpha": "1/s",
    "beta": "1/s",
    "t1": "s",
    "drift_tol": "m, rad",
    "dt0": "s",
    "state": "m, rad",
}
CHOICES = ("mechanism", "method", "solver", "stabilization", "formulation", "max_steps")  # those that are types


class Axis:
    """The values of one quantity, and what it is the quantity of.

    `values` are numbers (n, ...), one entry a value, or instances such as `[SVD(), Varga()]`; with a design a range (low, high) or
    a frozen distribution of scipy.stats. `of` is the name of a parameter or of a setting, several names that all take the value
    (tied), or a pure function (mechanism, value) -> mechanism; by default the axis's own name. Functions and parameters are
    applied in the order of the axes.
    """

    def __init__(self, values: Any, of: str | Sequence[str] | Callable[[Any, Any], Any] | None = None, units: str | None = None):
        self.values, self.units = values, units
        self.of = (of,) if isinstance(of, str) else of if of is None or callable(of) else tuple(of)

    def __repr__(self) -> str:
        return f"Axis({self.values!r}, of={self.of!r})"


class Zipped(NamedTuple):
    """Axes of equal length that advance together, along one dimension."""

    axes: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Column:
    """An axis with its values laid out along a dimension."""

    name: str
    values: Any  # numbers (n, ...), a State of such, or a tuple of choices
    of: tuple[str, ...] | Callable[[Any, Any], Any]
    units: str
    labels: tuple[str, ...] = ()  # of choices, unique

    @property
    def chosen(self) -> bool:
        """Whether its values are choices, not numbers."""
        return bool(self.labels)


@dataclass(frozen=True, eq=False)
class Dimension:
    """A dimension of the sweep, and the axes that advance along it."""

    name: str
    size: int
    columns: tuple[Column, ...]
