"""User-defined systems with known motions, for tests."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import udkjax as udk

G = 9.81


def pendulum(mass=2.0, length=1.0):
    """A spatial pendulum: a point mass on a sphere."""
    return udk.ConstrainedSystem(
        lambda q: mass * jnp.eye(3),
        constraint=lambda t, q: q @ q - length**2,
        potential=lambda t, q: mass * G * q[2],
    )


def bead_on_hoop(rate, radius=0.5):
    """A bead on a hoop of this radius that turns about the vertical at a given rate."""

    def constraint(t, q):
        return jnp.stack([q @ q - radius**2, q[0] * jnp.sin(rate * t) - q[1] * jnp.cos(rate * t)])

    return udk.ConstrainedSystem(lambda q: jnp.eye(3), constraint=constraint, potential=lambda t, q: G * q[2])


def disc(mass=1.5, radius=0.4):
    """A thin disc that rolls on a plane; x, y of its centre, its heading, its lean and its spin."""
    across, along = mass * radius**2 / 4, mass * radius**2 / 2

    def kinetic(q, v):
        _, _, _, lean, _ = q
        dx, dy, turn, fall, spin = v
        centre = dx**2 + dy**2 + (radius * jnp.sin(lean) * fall) ** 2
        return (mass * centre + across * (fall**2 + (turn * jnp.cos(lean)) ** 2) + along * (spin + turn * jnp.sin(lean)) ** 2) / 2

    def rolls(t, q, v):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        forward, sideways = c * v[0] + s * v[1], c * v[1] - s * v[0]
        return jnp.stack([forward - radius * (v[4] + v[2] * jnp.sin(q[3])), sideways + radius * v[3] * jnp.cos(q[3])])

    return udk.ConstrainedSystem.of_energy(
        kinetic, velocity_constraint=rolls, potential=lambda t, q: mass * G * radius * jnp.cos(q[3])
    )


def steady_spin(lean, turn, mass=1.5, radius=0.4):
    """The rate about its axis at which the disc rolls in a circle, from the balance of moments about its centre."""
    across, along = mass * radius**2 / 4, mass * radius**2 / 2
    s, c = np.sin(lean), np.cos(lean)
    return (across * turn**2 * s * c - mass * G * radius * s) / (turn * c * (along + mass * radius**2))


def satellites(distance, rate, masses=(2.0, 1.0)):
    """Two satellites about a centre of unit attraction: the second circles the first at a fixed distance, in a tilted plane."""

    def constraint(t, q):
        phase = rate * t
        gap = distance * jnp.stack([jnp.cos(phase), 0.8 * jnp.sin(phase), 0.6 * jnp.sin(phase)])
        return q[3:] - q[:3] - gap

    def potential(t, q):
        return -masses[0] / jnp.sqrt(q[:3] @ q[:3]) - masses[1] / jnp.sqrt(q[3:] @ q[3:])

    inertia = np.repeat(masses, 3)
    return udk.ConstrainedSystem(lambda q: jnp.diag(inertia), constraint=constraint, potential=potential)


def spinning(p, dp):
    """The angular velocity of a body in its own axes, 2 E p', and the rate of the norm of its quaternion."""
    w, x, y, z = p
    E = jnp.array([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    return 2 * E @ dp, 2 * p @ dp


def quaternion_body(inertia, along: Any = 1.0):
    """A free rigid body by a unit quaternion. The kinetic energy of rotation alone has a singular mass matrix: the rate of the
    norm, which the constraint sets to zero, gets an inertia of its own."""

    def kinetic(p, dp):
        omega, stretch = spinning(p, dp)
        return (omega @ (inertia * omega) + along * stretch**2) / 2

    return udk.ConstrainedSystem.of_energy(kinetic, constraint=lambda t, p: p @ p - 1.0)
