"""Systems of the user's own with known motions, for tests."""

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


# --- closed chains of revolute joints in space, by the points P and the axes u of their joints


def screw(angle, length, twist):
    """The frame of the next joint: turned about z, moved along x, twisted about x."""
    c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
    return np.array([[c, -s * ct, s * st, length * c], [s, c * ct, -c * st, length * s], [0, st, ct, 0], [0, 0, 0, 1]])


def chain(lengths, twists, angles):
    """The points and axes of all joints but the first two, the ends of the fixed link, which are returned as well."""
    frames = [np.eye(4)]
    for angle, length, twist in zip(angles[:-1], lengths, twists, strict=False):
        frames.append(frames[-1] @ screw(angle, length, twist))
    last = np.linalg.inv(screw(0.0, lengths[-1], twists[-1]))
    assert np.allclose(frames[-1][:3, 3], last[:3, 3])  # the given angles close the chain
    points, axes = (np.array([frame[:3, k] for frame in frames]) for k in (3, 2))
    return points, axes


def closed_chain(lengths, twists, angles, mass=1.0, inertia=0.05):
    """A closed chain of links between joints: all points and axes between those of the fixed link, with its state at rest.

    Each link keeps its length, and its common normal and the angle with the axes at its ends; axes keep their length.
    """
    points, axes = chain(lengths, twists, angles)
    count = len(lengths) - 2
    fixed = points[[0, -1]], axes[[0, -1]]

    def constraint(t, q):
        P, u = q.reshape(2, count, 3)
        P = jnp.concatenate([fixed[0][:1], P, fixed[0][1:]])
        u = jnp.concatenate([fixed[1][:1], u, fixed[1][1:]])
        links = P[1:] - P[:-1]
        rows = [jnp.sum(links**2, 1) - np.square(lengths[:-1]), jnp.sum(links * u[:-1], 1), jnp.sum(links * u[1:], 1)]
        rows += [jnp.sum(u[:-1] * u[1:], 1) - np.cos(twists[:-1]), jnp.sum(u[1:-1] ** 2, 1) - 1.0]
        return jnp.concatenate(rows)

    masses = np.repeat([mass, inertia], 3 * count)
    weight = np.concatenate([np.tile([0.0, mass * G, 0.0], count), np.zeros(3 * count)])
    system = udk.ConstrainedSystem(lambda q: jnp.diag(masses), constraint=constraint, potential=lambda t, q: weight @ q)
    q = np.concatenate([points[1:-1].ravel(), axes[1:-1].ravel()])
    return system, udk.State(q, np.zeros_like(q))


def bennett(first=2.0):
    """Bennett's four-bar: lengths 1 and 0.7 in the ratio of the sines of their twists."""
    alpha = np.deg2rad(50.0)
    beta = np.arcsin(0.7 * np.sin(alpha))
    second = 2 * np.arctan(np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2) / np.tan(first / 2))
    angles = [first, second, -first, -second]
    return closed_chain([1.0, 0.7, 1.0, 0.7], [alpha, beta, alpha, beta], angles)


def bricard():
    """Bricard's six-bar of equal links with right twists: first along the edges of a cube."""
    right = np.pi / 2
    return closed_chain([1.0] * 6, [right, -right] * 3, [right, right] * 3)


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
