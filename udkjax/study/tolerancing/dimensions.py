"""Tolerances of numbers of a mechanism, and the values of these numbers in samples.

Each number is x = x0 + c + s u, with x0 its nominal value, c the middle of its limits relative to x0, s its standard deviation,
and u a random deviation with zero mean and unit variance. Numbers that share a source, such as holes of one drill jig, have the
same u.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.positions.assembling.channels import has_point
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.identify.problem.parameters import Parameter, unknowns_of
from udkjax.study.identify.problem.unknowns import Target, apply_values
from udkjax.study.identify.records.records import IdentificationError
from udkjax.synthesis.ranges.deviations import PinClearance, Tolerance, ToleranceLike, read_tolerance
from udkjax.wording import quote, suggestion

# Least change of a number by the deviation of another, relative to its own deviation, that contradicts its tolerance: a share far
# above rounding errors, and below that to which tolerances are known.
LEAST_EFFECT = 1e-3
SHAPE_KINDS = "pin", "length", "number"  # kinds of numbers of a drawing that may set each other


class DeviationSource(NamedTuple):
    """An independent deviation u: its name, and the tolerance that has its distribution. A clearance has two, in x and y."""

    name: str
    tolerance: Tolerance
    clearance: bool = False


@dataclass(frozen=True)
class _Play:
    """A function of a mechanism and a value that moves a pin in its hole along x or y of the second body by this value (m)."""

    joint: str
    axis: int

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        name = f"joint.{self.joint}.points"
        return mechanism.with_parameters({name: jnp.asarray(mechanism.parameters()[name]).at[1, self.axis].add(value)})


def _kind(name: str) -> str:
    return name.partition("(")[0].partition(".")[0]


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
        self.units: list[str] = []
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
        self._require_independence(
            [name for name in given if not isinstance(given[name], PinClearance) and _kind(name) in SHAPE_KINDS]
        )

    def _require_independence(self, given: Sequence[str]):
        """Refuse numbers if one of them sets another, such as a pin and a length that ends there: one would hide the other."""
        if len({_kind(name) for name in given}) <= 1:
            return  # numbers of one kind are independent
        read, own = [Parameter(name) for name in given], {name: k for k, name in enumerate(self.names)}
        names = unknowns_of(self.mechanism, read).names
        nominal, sizes = (x[[own[name] for name in names]] for x in (self.nominal, self.sizes))
        problems = []
        for name in names:
            k = own[name]
            moved = apply_values(self.mechanism, [self.targets[k]], jnp.asarray([self.nominal[k] + self.sizes[k]]))
            changes = np.abs(np.asarray(unknowns_of(moved, read).guess) - nominal)
            set_by = [
                other for other, is_moved in zip(names, changes > LEAST_EFFECT * sizes, strict=True) if is_moved and other != name
            ]
            problems += [f"tolerances: {name} changes {other}, which has a tolerance, too: give one of them" for other in set_by]
        if problems:
            raise SceneError(problems, self.mechanism.name)

    @property
    def count(self) -> int:
        """The number P of numbers with tolerances."""
        return len(self.nominal)

    def moved(self, x: Array) -> Mechanism:
        """Return the mechanism with the numbers x (P,), which may be traced."""
        return apply_values(self.mechanism, self.targets, x)

    def values(self, u: Float[np.ndarray, "N K"], scales: Float[np.ndarray, "K"] | float = 1.0) -> Float[np.ndarray, "N P"]:
        """Return the P numbers in N samples, from the deviations u of their K sources, which are multiplied by `scales`."""
        return self.nominal + self.middle + self.sizes * (u * scales)[:, self.owners]

    def deviations(self, normal: Float[np.ndarray, "N K"]) -> Float[np.ndarray, "N K"]:
        """Return the deviations u of all sources, from independent standard normal numbers."""
        u = np.empty_like(normal)
        for k, source in enumerate(self.sources):
            u[:, k] = source.tolerance.units(normal[:, k])
        for k in [k for k, source in enumerate(self.sources) if source.clearance][::2]:  # x and y: a random direction
            pair = normal[:, k : k + 2]
            u[:, k : k + 2] = pair * (2.0**0.5 / np.maximum(np.hypot(pair[:, 0], pair[:, 1]), 1e-300))[:, None]
        return u

    def _source(self, source: DeviationSource) -> int:
        """Return the index of a source in `sources`, to which it is added if it is new.

        A source that has the same `shared` name as an earlier one has the index of the earlier one.
        """
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
            tolerance = read_tolerance(given, units, float(nominal), Units.of(self.mechanism.drawing))
            known = DeviationSource(tolerance.shared or entry, tolerance)
            rows.append((float(nominal), *tolerance.middle_and_deviation(units), self._source(known)))
            self.names.append(entry)
            self.units.append(units)
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
            self.units.append("m")
            self.targets.append(Target(function=_Play(joint, axis)))
        return rows
