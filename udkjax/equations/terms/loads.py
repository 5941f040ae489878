"""Masses, loads and energies of a mechanism: M, F, T and V (de Falco, Pennestri, Vita 2005, section 3).

The functions are written as in the paper, on arrays; JAX differentiates the potential energies of the force elements.
t, q and v are defined as in constraints.py.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import NumberLike, NumericArray
from udkjax.arrays import ArrayLibrary
from udkjax.equations.terms.constraints import BodyArray, bodies, vector
from udkjax.equations.terms.structure import ElementKind, Result, evaluate_by_kind, numbers_as_vector
from udkjax.programs.deferred import traced_once
from udkjax.scene.elements.bodies import Frame
from udkjax.scene.elements.forces import ForceElement
from udkjax.scene.mechanism import Mechanism


def mass(mechanism: Mechanism) -> Float[Array, "n"]:
    """Return the diagonal of M. Origins are centres of mass, so M is diagonal and constant.

    Args:
        mechanism: The scene.

    Returns:
        m, m (kg) and I (kg m^2) of each body (n,).
    """
    return vector([m for body in mechanism.bodies.values() for m in (body.mass, body.mass, body.inertia)])


def mass_of(mechanism: Mechanism, xp: ArrayLibrary) -> NumericArray:
    """Return the diagonal of the mass matrix, by NumPy or JAX."""
    bodies = mechanism.bodies.values()
    mass, inertia = (numbers_as_vector([getattr(body, name) for body in bodies]) for name in ("mass", "inertia"))
    return xp.ravel(xp.stack([mass, mass, inertia], 1))


@traced_once
def force(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, "n"]:
    """Return F = -V_q + the loads of force elements, without friction that depends on the loads of joints.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q.

    Returns:
        Force x, force y (N) and torque (N m) on each body (n,).
    """
    return element_loads(mechanism, t, q, v) - jax.grad(lambda q: potential_energy(mechanism, t, q, v))(vector(q))


def kinetic_energy(mechanism: Mechanism, v: BodyArray) -> Float[Array, ""]:
    """Return T = v^T M v / 2.

    Args:
        mechanism: The scene.
        v: Velocities (m/s, rad/s), (n,) or (bodies, 3).

    Returns:
        T (J).
    """
    return mass(mechanism) @ vector(v) ** 2 / 2


@traced_once
def potential_energy(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, ""]:
    """Return V, the potential energy of gravity, zero at the origin, and of the force elements that have one.

    Args:
        mechanism: The scene.
        t: Time (s).
        q: Coordinates (m, rad), (n,) or (bodies, 3).
        v: Velocities (m/s, rad/s), in the shape of q; V does not depend on them.

    Returns:
        V (J).
    """
    gravity = jnp.tile(jnp.append(mechanism.gravity, 0.0), len(mechanism.body_names))
    potentials = evaluate_forces(lambda e, *frames: e.potential(t, *frames), mechanism, q, v)
    return sum((jnp.sum(V) for _, V in potentials if V is not None), -(mass(mechanism) * gravity) @ vector(q))


@traced_once
def element_loads(mechanism: Mechanism, t: NumberLike, q: BodyArray, v: BodyArray) -> Float[Array, "n"]:
    """Return the sum of the loads that the methods `loads` of all force elements return; loads of potentials are not included."""

    time = jnp.asarray(t, jnp.result_type(float))

    def loads(element: ForceElement, *frames: Frame) -> Float[Array, "frames 3"] | None:
        result = element.loads(time, *frames)
        return None if result is None else jnp.stack([vector(list(load)) for load in result])

    total = jnp.zeros((len(mechanism.body_names), 3))
    for kind, values in evaluate_forces(loads, mechanism, q, v):
        if values is not None:
            total = total.at[kind.bodies.T].add(values[:, ~np.array(kind.structure.ground)])
    return total.ravel()


def loads_on_frames(element: ForceElement, t: NumberLike, *frames: Frame) -> Float[Array, "frames 3"]:
    """Return all loads of a force element on its frames (N, N m), those of its potential included."""
    time = jnp.asarray(t, jnp.result_type(float))

    def potential(places: Float[Array, "frames 3"]) -> Array:
        turned = zip(frames, places, strict=True)
        moved = [f._replace(x=x, y=y, angle=a, cos=jnp.cos(a), sin=jnp.sin(a)) for f, (x, y, a) in turned]
        value = element.potential(time, *moved)
        return jnp.zeros(()) if value is None else jnp.sum(jnp.asarray(value))

    total = -jax.grad(potential)(jnp.stack([vector(list(frame[:3])) for frame in frames]))
    stated = element.loads(time, *frames)
    return total if stated is None else total + jnp.stack([vector(list(load)) for load in stated])


def evaluate_forces(
    function: Callable[..., Result], mechanism: Mechanism, q: BodyArray, v: BodyArray
) -> list[tuple[ElementKind, Result]]:
    """Evaluate `function(element, *frames)` for the force elements of each kind together; see `evaluate_by_kind`."""
    return evaluate_by_kind(function, mechanism, [*mechanism.forces.values()], bodies(q), bodies(v))
