"""Models of a study, and quantities of them that are not single parameters: functions of a model and a value."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from typing_extensions import TypeAliasType

from udkjax.annotations import NumberLike, NumericArray
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.states.quantities import equations_of
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.pinv import SVD
from udkjax.programs.deferred import deferred
from udkjax.programs.undefined import defined
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.numbers.number_fields import parameters_of, split_index
from udkjax.scene.reshaping import with_angle, with_length

StudyModel: TypeAlias = Mechanism | ConstrainedSystem  # the models of studies
Setter = TypeAliasType("Setter", Callable[[Any, NumberLike], StudyModel])  # (mechanism, value) -> mechanism, or of systems


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


def parameter_value(mechanism: StudyModel, name: str) -> Array:
    """Return the value of an existing parameter, or of an entry (`joint.A.points[1][0]`)."""
    known = parameters_of(mechanism)
    owner, index = split_index(name, known)
    return jnp.asarray(known[owner].value)[index]


def analysis_of(model: StudyModel) -> Analysis | None:
    """Return the analysis of a mechanism; a user-defined system has none."""
    return analyse(model) if isinstance(model, Mechanism) else None


def state_shape(model: StudyModel, state: object = None) -> tuple[int, ...]:
    """Return the shape of coordinates: (bodies, 3), or (n,) of a system, by its guess or a state."""
    if isinstance(model, Mechanism):
        return len(model.body_names), 3
    q = model.q0 if state is None else getattr(getattr(state, "state", state), "q", None)
    return () if q is None else np.shape(q)


def body_names(model: StudyModel) -> tuple[str, ...]:
    """Return the names of the bodies of a mechanism; a user-defined system has none."""
    return model.body_names if isinstance(model, Mechanism) else ()


def with_guess(model: Any, q: NumericArray, v: NumericArray) -> Any:
    """Return a mechanism, or a system with a guess, with another initial guess."""
    if not isinstance(model, Mechanism):
        return model.with_parameters({"q0": q, "v0": v})
    values: dict[str, NumericArray] = {}
    for k, body in enumerate(model.body_names):
        values |= {f"body.{body}.position": q[k, :2], f"body.{body}.angle": q[k, 2]}
        values |= {f"body.{body}.velocity": v[k, :2], f"body.{body}.angular_velocity": v[k, 2]}
    return model.with_parameters(values)


@deferred
@defined
def jacobians_of_system(system: Any, t: Any, q: Any, v: Any) -> Any:
    """Return Psi_q, and the rows (Psi_q; phi_v), of a system of traced functions at a state."""
    equations: Any = equations_of(system, SVD())
    t, q, v = (jnp.asarray(x, float) for x in (t, q, v))
    rows = equations.jacobian(t, q, v)
    return rows[: len(equations.violation(t, q, v)[0])], rows
