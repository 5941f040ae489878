"""Masses, loads and energies of a mechanism: M, F, T and V (de Falco, Pennestri, Vita 2005, section 3).

As it reads, on arrays, by JAX's derivatives of what each force element says of itself. t, q and v are those of constraints.py.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from udkjax.equations.constraints import State, frames, vector
from udkjax.scene.bodies import GROUND
from udkjax.scene.mechanism import Mechanism


def mass(mechanism: Mechanism) -> Float[Array, "n"]:
    """The diagonal of M: m, m (kg) and I (kg m^2) of each body. Origins are centres of mass, so M is diagonal and constant."""
    return vector([m for body in mechanism.bodies.values() for m in (body.mass, body.mass, body.inertia)])


def force(mechanism: Mechanism, t: ArrayLike, q: State, v: State) -> Float[Array, "n"]:
    """F = -V_q + the loads that force elements state: force x, force y (N) and torque (N m) on each body."""
    return stated_loads(mechanism, t, q, v) - jax.grad(lambda q: potential_energy(mechanism, t, q, v))(vector(q))


def kinetic_energy(mechanism: Mechanism, v: State) -> Float[Array, ""]:
    """T = v^T M v / 2 (J)."""
    return mass(mechanism) @ vector(v) ** 2 / 2


def potential_energy(mechanism: Mechanism, t: ArrayLike, q: State, v: State) -> Float[Array, ""]:
    """V (J): of gravity, zero at the origin, and of the force elements that have one. It does not depend on v."""
    known = frames(mechanism, q, v)
    gravity = jnp.tile(jnp.append(mechanism.gravity, 0.0), len(mechanism.body_names))
    stored = [e.potential(t, *(known[name] for name in mechanism.frames_of(e))) for e in mechanism.forces.values()]
    return sum((V for V in stored if V is not None), -(mass(mechanism) * gravity) @ vector(q))


def stated_loads(mechanism: Mechanism, t: ArrayLike, q: State, v: State) -> Float[Array, "n"]:
    """The loads of the force elements that state them: all that does not come from a potential."""
    known, n = frames(mechanism, q, v), 3 * len(mechanism.body_names)
    total = {name: [jnp.zeros(())] * 3 for name in mechanism.body_names}
    for element in mechanism.forces.values():
        names = mechanism.frames_of(element)
        for name, load in zip(names, element.loads(t, *(known[name] for name in names)) or [], strict=False):
            if name != GROUND:
                total[name] = [a + b for a, b in zip(total[name], load, strict=True)]
    return vector([x for load in total.values() for x in load]) if n else jnp.zeros(0)
