"""What an axis can be the quantity of, besides parameters: functions of a mechanism and a value, which files can name."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from udkjax.scene.mechanism import Mechanism
from udkjax.scene.reshaping import with_angle, with_length


@dataclass(frozen=True)
class Length:
    """Gives bodies another length (m): `with_length` as the quantity of an axis."""

    bodies: tuple[str, ...]
    as_rod: bool = False

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return with_length(mechanism, self.bodies, value, self.as_rod)


@dataclass(frozen=True)
class Angle:
    """Gives bodies another initial angle (rad): `with_angle` as the quantity of an axis."""

    bodies: tuple[str, ...]

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return with_angle(mechanism, self.bodies, value)


@dataclass(frozen=True)
class Scaled:
    """Sets several parameters in proportion to one value."""

    factors: Mapping[str, float]

    def __call__(self, mechanism: Mechanism, value: Any) -> Mechanism:
        return mechanism.with_parameters({name: factor * value for name, factor in self.factors.items()})
