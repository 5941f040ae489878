"""Quantities of a mechanism that are not single parameters: functions of a mechanism and a value, with names in files."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.number_fields import parameters_of, split_index
from udkjax.scene.reshaping import with_angle, with_length

Setter = TypeAliasType("Setter", Callable[[Mechanism, NumberLike], Mechanism])  # (mechanism, value) -> mechanism


@dataclass(frozen=True)
class Length:
    """Sets the length (m) of bodies, all to the same value: see `with_length`."""

    bodies: tuple[str, ...]
    as_rod: bool = False

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return with_length(mechanism, self.bodies, value, self.as_rod)

    def __str__(self) -> str:
        return " = ".join(f"length({body})" for body in self.bodies)


@dataclass(frozen=True)
class InitialAngle:
    """Sets the initial angle (rad) of bodies: see `with_angle`."""

    bodies: tuple[str, ...]

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return with_angle(mechanism, self.bodies, value)


@dataclass(frozen=True)
class Scaled:
    """Sets several parameters in proportion to one value."""

    factors: Mapping[str, float]

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return mechanism.with_parameters({name: factor * jnp.asarray(value) for name, factor in self.factors.items()})


def parameter_value(mechanism: Mechanism, name: str) -> Array:
    """Return the value of an existing parameter, or of an entry (`joint.A.points[1][0]`)."""
    known = parameters_of(mechanism)
    owner, index = split_index(name, known)
    return jnp.asarray(known[owner].value)[index]
