"""Closed chains of revolute joints in space that move although their joints are too many: systems of one's own.

Coordinates are the points P of the joints between the links that move, and the axes u of these joints.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import udkjax as udk

G = 9.81  # m/s^2


def screw(angle: Any, length: float, twist: float) -> np.ndarray:
    """The frame of the next joint: turned about z, moved along x, twisted about x."""
    c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(twist), np.sin(twist)
    return np.array([[c, -s * ct, s * st, length * c], [s, c * ct, -c * st, length * s], [0, st, ct, 0], [0, 0, 0, 1]])


def chain(lengths: Sequence[float], twists: Sequence[float], angles: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """The points and axes of all joints but the first two, the ends of the fixed link, which are returned as well."""
    frames = [np.eye(4)]
    for angle, length, twist in zip(angles[:-1], lengths, twists, strict=False):
        frames.append(frames[-1] @ screw(angle, length, twist))
    last = np.linalg.inv(screw(0.0, lengths[-1], twists[-1]))
    assert np.allclose(frames[-1][:3, 3], last[:3, 3])  # the given angles close the chain
    points, axes = (np.array([frame[:3, k] for frame in frames]) for k in (3, 2))
    return points, axes


def closed_chain(
    lengths: Sequence[float], twists: Sequence[float], angles: Sequence[float], mass: float = 1.0, inertia: float = 0.05
) -> udk.ConstrainedSystem:
    """A closed chain of links between joints with masses at its joints, with its state at rest; gravity is along -y."""
    points, axes = chain(lengths, twists, angles)
    masses = np.repeat([mass, inertia], 3 * (len(points) - 2))
    return _system(points, axes, np.diag(masses), mass * G)


def _system(points: np.ndarray, axes: np.ndarray, inertia: np.ndarray, weight: float) -> udk.ConstrainedSystem:
    """The system of all points and axes between those of the fixed link, with a constant M and a weight at each point.

    Each link keeps its length, and its common normal and the angle with the axes at its ends; axes keep their length.
    """
    count, links = len(points) - 2, np.diff(points, axis=0)
    sizes, cosines = np.sum(links**2, 1), np.sum(axes[1:] * axes[:-1], 1)

    def constraint(t, q):
        P, u = q.reshape(2, count, 3)
        P = jnp.concatenate([points[:1], P, points[-1:]])
        u = jnp.concatenate([axes[:1], u, axes[-1:]])
        links = P[1:] - P[:-1]
        rows = [jnp.sum(links**2, 1) - sizes, jnp.sum(links * u[:-1], 1), jnp.sum(links * u[1:], 1)]
        rows += [jnp.sum(u[:-1] * u[1:], 1) - cosines, jnp.sum(u[1:-1] ** 2, 1) - 1.0]
        return jnp.concatenate(rows)

    weights = np.concatenate([np.tile([0.0, weight, 0.0], count), np.zeros(3 * count)])
    q = np.concatenate([points[1:-1].ravel(), axes[1:-1].ravel()])
    return udk.ConstrainedSystem(
        lambda q: jnp.asarray(inertia), constraint=constraint, potential=lambda t, q: weights @ q, q0=q, v0=np.zeros_like(q)
    )


def bennett(first: float = 2.0) -> udk.ConstrainedSystem:
    """Bennett's four-bar: lengths 1 and 0.7 in the ratio of the sines of their twists."""
    alpha = np.deg2rad(50.0)
    beta = np.arcsin(0.7 * np.sin(alpha))
    second = 2 * np.arctan(np.sin((alpha + beta) / 2) / np.sin((beta - alpha) / 2) / np.tan(first / 2))
    angles = [first, second, -first, -second]
    return closed_chain([1.0, 0.7, 1.0, 0.7], [alpha, beta, alpha, beta], angles)


def bricard(first: float = np.pi / 2) -> udk.ConstrainedSystem:
    """Bricard's six-bar of equal links with right twists; by default along the edges of a cube.

    Alternate angles are a and b, with cos a + cos b + cos a cos b = 0.
    """
    right, second = np.pi / 2, np.arccos(-np.cos(first) / (1 + np.cos(first)))
    return closed_chain([1.0] * 6, [right, -right] * 3, [first, second] * 3)


A04_POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], float)  # P3 is the third
A04_AXES = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0]], float)
A04_WIDTH = 0.1  # of the rods' square section (m)


def a04() -> udk.ConstrainedSystem:
    """The IFToMM benchmark A04: Bricard's chain of five rods of 1 kg and 1 m along the edges of a cube, let go from rest.

    With links normal to their axes, the velocity of each point of a rod is linear in those of its ends and axes: M is constant.
    """
    count = len(A04_POINTS) - 2
    ends = np.zeros((count + 2, count + 2))
    for k in range(count + 1):
        ends[k : k + 2, k : k + 2] += np.array([[2.0, 1.0], [1.0, 2.0]]) / 6
    axes = 2 * A04_WIDTH**2 / 12 * np.eye(count)  # of the two rods that meet in a joint
    blocks = [np.kron(part, np.eye(3)) for part in (ends[1:-1, 1:-1], axes)]
    inertia = np.block([[blocks[0], np.zeros_like(blocks[0])], [np.zeros_like(blocks[0]), blocks[1]]])
    return _system(A04_POINTS, A04_AXES, inertia, G)
