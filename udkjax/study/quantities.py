"""Models of a study, and quantities of them that are not single parameters: functions of a model and a value."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
from jaxtyping import Array
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.pinv import SVD
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import split_index
from udkjax.scene.reshaping import with_angle, with_length

StudyModel: TypeAlias = Mechanism | ConstrainedSystem  # the models of studies
Setter = TypeAliasType("Setter", Callable[[Any, NumberLike], StudyModel])  # (mechanism, value) -> mechanism, or of systems


@dataclass(frozen=True)
class Length:
    """A function of a mechanism and a value that sets the length (m) of bodies, all to this value: see `with_length`."""

    bodies: tuple[str, ...]
    as_rod: bool = False

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return with_length(mechanism, self.bodies, value, self.as_rod)

    def __str__(self) -> str:
        return " = ".join(f"length({body})" for body in self.bodies)


@dataclass(frozen=True)
class InitialAngle:
    """A function of a mechanism and a value that sets the initial angle (rad) of bodies: see `with_angle`."""

    bodies: tuple[str, ...]

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return with_angle(mechanism, self.bodies, value)


@dataclass(frozen=True)
class Scaled:
    """A function of a mechanism and a value that sets several parameters, each to its factor times the value."""

    factors: Mapping[str, float]

    def __call__(self, mechanism: Mechanism, value: NumberLike) -> Mechanism:
        return mechanism.with_parameters({name: factor * jnp.asarray(value) for name, factor in self.factors.items()})


def parameter_value(mechanism: StudyModel, name: str) -> Array:
    """Return the value of an existing parameter, or of an entry (`joint.A.points[1][0]`)."""
    known = mechanism.number_fields()
    owner, index = split_index(name, known)
    return jnp.asarray(known[owner].value)[index]


@deferred
@defined
def jacobians_at(system: Any, t: Any, q: Any, v: Any) -> Any:
    """Return Psi_q, and the rows (Psi_q; phi_v), at a state of a system whose functions are traced."""
    equations: Any = equations_of(system, SVD())
    t, q, v = (jnp.asarray(x, float) for x in (t, q, v))
    rows = equations.jacobian(t, q, v)
    return rows[: len(equations.violation(t, q, v)[0])], rows
