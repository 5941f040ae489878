"""Axes: the quantities that a sweep varies, by name; and designs, which sample members from their ranges.

An axis of numbers (parameters, tolerances, gains) is batched in one compiled program. An axis of choices (methods, solvers,
step size controllers, mechanisms, initial states) divides the members into groups by the structure of their choices. Each group
has a program, and no member executes the branches of other choices. Choices that differ only in numbers share a program; so do
dense pseudoinverses, among which machine code selects by number.
"""

import abc
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Protocol, TypeAlias, cast

import equinox as eqx
import numpy as np
from jaxtyping import Float

from udkjax.annotations import Numbers
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.integrate.compiled_mechanism import reason_for_plain
from udkjax.pinv import Auto, Dense, Elimination, OneOf
from udkjax.positions.assembling.assembly import State
from udkjax.requirements import ArgumentTypeError, describe, require_count
from udkjax.scene.model import Model
from udkjax.study.choices import Choice
from udkjax.study.members import structure_of
from udkjax.study.quantities import Setter, StudyModel

# Settings of a run that are choices, with the label of None for each.
NONE_LABELS = {
    "mechanism": "",
    "state": "assembled",
    "method": "Auto",
    "solver": "Dopri8",
    "stabilization": "none",
    "formulation": "UdwadiaKalaba",
    "max_steps": "",
    "stepsize_controller": "default",
}


class Distribution(Protocol):
    """A frozen distribution of scipy.stats."""

    def ppf(self, q: np.ndarray) -> np.ndarray: ...


AxisChoice: TypeAlias = "StudyModel | State | int | Choice"
# Numbers (n, ...) or choices; a range or a distribution if there is a design.
Values: TypeAlias = "Distribution | State | Numbers | Sequence[AxisChoice]"


class Axis:
    """The values of an axis, and the quantity that they set.

    Functions and parameters are applied in the order of the axes.

    Args:
        values: numbers (n, ...), one entry per value, or instances such as `[SVD(), Varga()]`; with a design, a range (low, high)
            or a frozen distribution of scipy.stats.
        of: the name of a parameter or a setting, several tied names that take the same value, or a pure function (mechanism,
            value) -> mechanism; by default the axis's name.
        units: units of the values, if `of` does not determine them.
    """

    def __init__(self, values: Values, of: str | Sequence[str] | Setter | None = None, units: str | None = None):
        self.values, self.units = values, units
        is_list = isinstance(of, Sequence) and all(isinstance(name, str) for name in of)
        if not (of is None or callable(of) or is_list):
            raise ArgumentTypeError(f"of must be a name, a list of names or a function of (mechanism, value), {describe(of)}")
        self.of = (of,) if isinstance(of, str) else of if of is None or callable(of) else tuple(of)

    def __repr__(self) -> str:
        return f"Axis({self.values!r}, of={self.of!r})"


class Zipped(NamedTuple):
    """Axes of equal length that vary together, along one dimension.

    Args:
        axes: an `Axis`, or its values, by name.
    """

    axes: Mapping[str, "AxisValues"]


AxisValues: TypeAlias = "Axis | Zipped | Values"


@dataclass(frozen=True, eq=False)
class AxisColumn:
    """An axis with its values along a dimension."""

    name: str
    values: np.ndarray | tuple[AxisChoice, ...]  # numbers (n, ...), or choices
    of: tuple[str, ...] | Setter
    units: str = ""
    labels: tuple[str, ...] = ()  # of choices, unique

    @property
    def is_choice(self) -> bool:
        """True if the values are choices, not numbers."""
        return bool(self.labels)

    @property
    def numbers(self) -> np.ndarray:
        """The values of an axis of numbers."""
        assert isinstance(self.values, np.ndarray)
        return self.values

    @property
    def choices(self) -> tuple[AxisChoice, ...]:
        """The values of an axis of choices."""
        assert isinstance(self.values, tuple)
        return self.values

    @cached_property
    def computed(self) -> tuple[AxisChoice, ...]:
        """The choices as inputs of programs: dense methods are replaced by a `OneOf`, which selects the method by number."""
        return one_of_several(self.choices) if self.setting == "method" else self.choices

    @property
    def setting(self) -> str:
        """The setting that the choices set."""
        assert self.is_choice and not callable(self.of)
        return self.of[0]

    @property
    def coordinate(self) -> np.ndarray:
        """The values as written in a dataset: numbers, or labels."""
        if not self.is_choice:
            return self.numbers
        if self.of == ("max_steps",):
            return np.array(self.choices)
        return np.array(self.labels, dtype=object)


@dataclass(frozen=True, eq=False)
class Dimension:
    """A dimension of the sweep, and the axes that vary along it."""

    name: str
    size: int
    columns: tuple[AxisColumn, ...]


def labels_of(setting: str, choices: Sequence[AxisChoice], replaced: Collection[str] = ()) -> tuple[str, ...]:
    """Return readable, unique names of choices.

    These are the names of their types; if several choices are of the same type, numbers are added, except those in `replaced`.
    """
    plain = [_short_label(setting, choice) for choice in choices]
    alike = {name: [choice for choice, own in zip(choices, plain, strict=True) if own == name] for name in plain}
    names = [
        name if len(alike[name]) == 1 else _label_with_numbers(name, choice, alike[name], replaced)
        for name, choice in zip(plain, choices, strict=True)
    ]
    return tuple(name if name not in names[:k] else f"{name} #{names[:k].count(name) + 1}" for k, name in enumerate(names))


def _short_label(setting: str, choice: AxisChoice) -> str:
    if choice is None:
        return NONE_LABELS[setting]
    if isinstance(choice, Model):
        return choice.name
    return str(choice) if isinstance(choice, int) else type(choice).__name__


def _label_with_numbers(name: str, choice: AxisChoice, alike: Sequence[AxisChoice], replaced: Collection[str]) -> str:
    """Return the name of a choice with its scalar fields, except those that other axes replace.

    Python numbers are options of diffrax's classes, which have many: they are only shown if they differ among the choices
    `alike`.
    """
    if isinstance(choice, ConstrainedSystem):
        return name

    def is_shown(key: str, value: object) -> bool:
        if isinstance(value, float | int):
            return any(getattr(other, key) != value for other in alike)
        return eqx.is_array(value) and np.ndim(value) == 0

    fields = {key: value for key, value in getattr(choice, "__dict__", {}).items() if key not in replaced}
    numbers = {key: value for key, value in fields.items() if is_shown(key, value)}
    return f"{name}({', '.join(f'{key}={float(value):g}' for key, value in numbers.items())})" if numbers else name


def one_of_several(methods: Sequence[AxisChoice]) -> tuple[AxisChoice, ...]:
    """Return the methods, with compilable dense ones of several kinds replaced by a `OneOf` of all these kinds.

    All of these then have the same structure, and share a program.
    """
    dense: dict[int, Dense] = {}
    for k, method in enumerate(methods):
        if isinstance(method, Dense) and not isinstance(method, Auto | Elimination | OneOf) and not reason_for_plain(method):
            dense[k] = method
    kinds = {k: replace(method, rank_tol=None, relative=True) for k, method in dense.items()}
    distinct = {structure_of(kind): kind for kind in kinds.values()}
    if len(distinct) < 2:
        return tuple(methods)
    replaced, structures = list(methods), list(distinct)
    for k, method in dense.items():
        number = structures.index(structure_of(kinds[k]))
        replaced[k] = OneOf(method.rank_tol, method.relative, tuple(distinct.values()), np.asarray(number))
    return tuple(replaced)


# --- designs: members sampled from ranges, instead of all combinations of values


@dataclass(frozen=True)
class SweepDesign(abc.ABC):
    """A sample of `n` members from the ranges of the axes; the same `seed` gives the same members.

    Args:
        n: number of members.
        seed: seed of the random numbers.
    """

    n: int
    seed: int = 0

    def __post_init__(self):
        require_count("n", self.n)
        require_count("seed", self.seed, least=0)

    @abc.abstractmethod
    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        """Return `n` points of the unit cube, with a coordinate for each axis that is a range or a distribution."""


class Sobol(SweepDesign):
    """A scrambled Sobol sequence, which fills the ranges most evenly if `n` is a power of two."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        from scipy.stats import qmc

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The balance properties", category=UserWarning)
            return qmc.Sobol(dimensions, rng=np.random.default_rng(self.seed)).random(self.n)


class LatinHypercube(SweepDesign):
    """A Latin hypercube: each axis is divided into `n` parts of equal probability, with one member in each."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        from scipy.stats import qmc

        return qmc.LatinHypercube(dimensions, rng=np.random.default_rng(self.seed)).random(self.n)


class Random(SweepDesign):
    """Members that are sampled independently of each other."""

    def unit(self, dimensions: int) -> Float[np.ndarray, "n d"]:
        return np.random.default_rng(self.seed).random((self.n, dimensions))


def scale_to_range(values: Values, unit: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"] | None:
    """Return points of a range (low, high) or of a frozen distribution of scipy.stats; None for other values.

    They are mapped from points `unit` of the unit interval.
    """
    if hasattr(values, "ppf"):
        return np.asarray(cast(Distribution, values).ppf(unit), float)
    ends = np.asarray(cast(Numbers, values), float)
    if ends.shape != (2,) or not ends[0] < ends[1]:
        return None
    return ends[0] + (ends[1] - ends[0]) * unit
