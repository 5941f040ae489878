"""The constraints of a mechanism along a motion: Psi, Psi_q, Psi_dot and gamma (de Falco, Pennestri, Vita 2005, section 3).

Each joint and driver says what its residual is, and nothing more; all derivatives are taken of that by JAX. Here this is done
as it reads, on arrays, without regard to which entries are zero. Faster forms of the same functions are held against this one.

In all of them t is the time (s), and q and v are the coordinates and velocities of the n / 3 bodies, x, y (m) and angle (rad) of
one after another: flat (n,), or (bodies, 3), which is made flat. The m rows are those of the joints in their order, then those
of the drivers (`row_names`); a row is in m or in rad.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from udkjax.scene.bodies import GROUND, Frame
from udkjax.scene.mechanism import Mechanism

State = Float[ArrayLike, "n"] | Float[ArrayLike, "n/3 3"]


def psi(mechanism: Mechanism, t: ArrayLike, q: State) -> Float[Array, "m"]:
    """Psi(t, q), which is zero where all joints are closed (m, rad)."""
    known = frames(mechanism, q)
    rows = [c.residual(t, *(known[name] for name in mechanism.frames_of(c))) for c in mechanism.constraints.values()]
    return vector([row for part in rows for row in part])


def psi_q(mechanism: Mechanism, t: ArrayLike, q: State) -> Float[Array, "m n"]:
    """Psi_q = dPsi/dq, the Jacobian."""
    return jax.jacfwd(lambda q: psi(mechanism, t, q))(vector(q))


def psi_dot(mechanism: Mechanism, t: ArrayLike, q: State, v: State) -> Float[Array, "m"]:
    """Psi_dot = Psi_q v + Psi_t, the rate of Psi along a motion (m/s, rad/s)."""
    return along_motion(lambda t, q: psi(mechanism, t, q), t, q, v)


def gamma(mechanism: Mechanism, t: ArrayLike, q: State, v: State) -> Float[Array, "m"]:
    """gamma = -(Psi_q v)_q v - 2 Psi_qt v - Psi_tt, with which Psi_ddot = Psi_q a - gamma (m/s^2, rad/s^2).

    It is minus the rate of Psi_dot along the motion of constant v.
    """
    return -along_motion(lambda t, q: psi_dot(mechanism, t, q, v), t, q, v)


def row_names(mechanism: Mechanism) -> list[tuple[str, int]]:
    """The constraint that each row of Psi belongs to, and its number within it."""
    found = []
    for name, c in mechanism.constraints.items():
        known = frames(mechanism, mechanism.q0)
        rows = jax.eval_shape(lambda c=c, known=known: vector(c.residual(0.0, *(known[n] for n in mechanism.frames_of(c)))))
        found += [(name, k) for k in range(len(rows))]
    return found


def along_motion(f: Any, t: ArrayLike, q: State, v: State) -> Array:
    """df/dt + (df/dq) v of f(t, q)."""
    t, q, v = jnp.asarray(t, jnp.result_type(float)), vector(q), vector(v)
    return jax.jvp(f, (t, q), (jnp.ones_like(t), v))[1]


def frames(mechanism: Mechanism, q: State, v: State | None = None) -> dict[str, Frame]:
    """The frame of each body and of the ground, by name; without v, joints and drivers see no velocities."""
    q, rates = vector(q).reshape(-1, 3), None if v is None else vector(v).reshape(-1, 3)
    found = {GROUND: Frame(0.0, 0.0, 0.0, 1.0, 0.0, *(() if v is None else (0.0, 0.0, 0.0)))}
    for k, name in enumerate(mechanism.body_names):
        x, y, angle = q[k]
        found[name] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), *(() if rates is None else rates[k]))
    return found


def vector(values: Any) -> Float[Array, "n"]:
    """Numbers, a list or an array of them, as one vector."""
    if isinstance(values, list | tuple):
        return jnp.stack([jnp.asarray(x, jnp.result_type(float)) for x in values]) if values else jnp.zeros(0)
    return jnp.ravel(jnp.asarray(values, jnp.result_type(float)))
