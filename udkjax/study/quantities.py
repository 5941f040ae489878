"""Quantities of a mechanism that are no single number of it: functions of a mechanism and a value, which texts can name."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from udkjax.scene.mechanism import Mechanism
from udkjax.scene.reshaping import with_angle, with_length


@dataclass(frozen=True)
class Length:
    """Gives bodies another length (m), all the same: see `with_length`."""

    bodies: tuple[str, ...]
    as_rod: bool = False

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return with_length(mechanism, self.bodies, value, self.as_rod)

    def __str__(self) -> str:
        return " = ".join(f"length({body})" for body in self.bodies)


@dataclass(frozen=True)
class Angle:
    """Gives bodies another initial angle (rad): see `with_angle`."""

    bodies: tuple[str, ...]

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return with_angle(mechanism, self.bodies, value)


@dataclass(frozen=True)
class Scaled:
    """Sets several parameters in proportion to one value."""

    factors: Mapping[str, float]

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return mechanism.with_parameters({name: factor * value for name, factor in self.factors.items()})
