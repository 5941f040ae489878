"""The constraints of a mechanism along a motion: Psi, Psi_q, Psi_dot and gamma (de Falco, Pennestri, Vita 2005, section 3).

Each joint and driver defines only its residual; JAX computes all derivatives. The functions are written as in the paper, on dense
arrays; elements of the same structure are evaluated together (structure.py). The tests compare the faster forms with these.

In all functions t is the time (s), and q and v are coordinates and velocities: x, y (m) and angle (rad) of each body in turn, as
(n,) or (bodies, 3), n = 3 bodies. The m rows are those of the joints in their order, then those of the drivers (`row_names`); a
row is in m or in rad. The rows of rolling joints restrict velocities alone: their Psi is zero, their Psi_q are the coefficients
of the velocities, and their Psi_dot is Psi_q v.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from udkjax.annotations import Number, NumberLike
from udkjax.argument_types import COORDINATES_OF_BODIES
from udkjax.equations.terms.structure import ElementKind, element_kinds, entries, evaluate_by_kind, numbers_as_vector
from udkjax.programs.deferred import traced_once
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.joints import Constraint
from udkjax.scene.elements.rolling import RollingJoint
from udkjax.scene.mechanism import Mechanism

# x, y and angle of each body, or their rates
BodyArray: TypeAlias = Annotated[Float[ArrayLike, "n"] | Float[ArrayLike, "bodies 3"], COORDINATES_OF_BODIES]


@traced_once
def psi(mechanism: Mechanism, t: NumberLike, q: BodyArray) -> Float[Array, "m"]:
    """Return Psi(t, q), the residuals of all constraints, which are zero where all joints are closed.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).

    Returns:
        Psi (m,), in m or rad.
    """
    kinds = evaluate_by_kind(
        lambda c, *frames: vector(c.residual(t, *frames)), mechanism, [*mechanism.constraints.values()], bodies(q)
    )
    return _in_order(kinds) if kinds else jnp.zeros(0)


@traced_once
def psi_q(mechanism: Mechanism, t: NumberLike, q: BodyArray) -> Float[Array, "m n"]:
    """Return Psi_q = dPsi/dq, the Jacobian of the constraints.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).

    Returns:
        Psi_q (m, n).
    """
    slopes = jax.jacfwd(lambda q: psi(mechanism, t, q))(vector(q))
    if not rolling_rows(mechanism).any():
        return slopes
    return slopes + jax.jacfwd(lambda v: rolling_rates(mechanism, t, q, v))(jnp.zeros_like(vector(q)))


@traced_once
def psi_dot(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, "m"]:
    """Return Psi_dot = Psi_q v + Psi_t, the rate of Psi along a motion.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.

    Returns:
        Psi_dot (m,), in m/s or rad/s.
    """
    rate = rate_along_motion(lambda t, q: psi(mechanism, t, q), t, q, v)
    return rate + rolling_rates(mechanism, t, q, v) if rolling_rows(mechanism).any() else rate


def rolling_rates(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, "m"]:
    """Return the rates A v of the rows of rolling joints, with A the coefficients of the velocities, and zero for all other rows.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.

    Returns:
        The rates (m,), in m/s or rad/s.
    """

    now = jnp.asarray(t)

    def rates(constraint: Constraint, *frames: Frame) -> Array:
        if isinstance(constraint, RollingJoint):
            return vector(constraint.rates(now, *frames))
        return jnp.zeros_like(vector(constraint.residual(now, *frames)))

    kinds = evaluate_by_kind(rates, mechanism, [*mechanism.constraints.values()], bodies(q), bodies(v))
    return _in_order(kinds)


def rolling_rows(mechanism: Mechanism) -> Bool[np.ndarray, "m"]:
    """Return a mask of the rows that restrict velocities alone, those of rolling joints; an empty array if there are none."""
    if not any(isinstance(joint, RollingJoint) for joint in mechanism.joints.values()):
        return np.zeros(0, bool)
    return np.array([isinstance(mechanism.constraints[name], RollingJoint) for name, _ in row_names(mechanism)], bool)


@traced_once
def gamma(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, "m"]:
    """Return gamma = -(Psi_q v)_q v - 2 Psi_qt v - Psi_tt, with which Psi_ddot = Psi_q a - gamma.

    -gamma is the rate of Psi_dot along a motion with constant v.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.

    Returns:
        gamma (m,), in m/s^2 or rad/s^2.
    """
    return -rate_along_motion(lambda t, q: psi_dot(mechanism, t, q, v), t, q, v)


def row_names(mechanism: Mechanism) -> list[tuple[str, int]]:
    """Return, for each row of Psi, the name of its constraint and its index among the rows of this constraint."""
    names, constraints = list(mechanism.constraints), [*mechanism.constraints.values()]
    residual = lambda c, *frames: vector(c.residual(0.0, *frames))  # noqa: E731
    rows = jax.eval_shape(lambda: [rows for _, rows in evaluate_by_kind(residual, mechanism, constraints, bodies(mechanism.q0))])
    size = np.zeros(len(names), int)
    for kind, values in zip(element_kinds(mechanism, constraints), rows, strict=True):
        size[kind.members] = values.shape[1]
    return [(name, k) for name, count in zip(names, size, strict=True) for k in range(count)]


def _in_order(kinds: Sequence[tuple[ElementKind, Array]]) -> Float[Array, "m"]:
    """Return the rows that were evaluated kind by kind as one vector, in the order of their constraints."""
    rows = jnp.concatenate([jnp.ravel(rows) for _, rows in kinds])
    owner = np.concatenate([np.repeat(kind.members, rows.shape[1]) for kind, rows in kinds])
    return entries(rows, np.argsort(owner, kind="stable")) if len(owner) else rows


def rate_along_motion(f: Callable[[Array, Array], Array], t: NumberLike, q: BodyArray, v: BodyArray) -> Array:
    """Return df/dt + (df/dq) v, the rate of f(t, q) along a motion with velocities v."""
    t, q, v = jnp.asarray(t, jnp.result_type(float)), vector(q), vector(v)
    return jax.jvp(f, (t, q), (jnp.ones_like(t), v))[1]


def bodies(state: BodyArray) -> Float[Array, "bodies 3"]:
    """Return q or v as an array (bodies, 3)."""
    is_flat = isinstance(state, list | tuple) or np.ndim(state) != 2
    return vector(state).reshape(-1, 3) if is_flat else jnp.asarray(state, jnp.result_type(float))


def vector(values: ArrayLike | Sequence[Number]) -> Float[Array, "n"]:
    """Return a number, a list of numbers or an array as a vector of floats."""
    if isinstance(values, list | tuple):
        return jnp.asarray(numbers_as_vector(values), jnp.result_type(float))
    return jnp.ravel(jnp.asarray(values, jnp.result_type(float)))
