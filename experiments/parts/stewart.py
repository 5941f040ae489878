"""A Stewart platform of thirteen bodies by quaternions, with more rows than it needs, and its motion by six coordinates."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import udkjax as udk

GRAVITY, STIFFNESS = 9.81, 3000.0  # m/s^2; N/m of the spring along each leg
MASS, INERTIA = 6.0, np.array([0.12, 0.12, 0.2])  # kg, kg m^2 of the platform
CYLINDER, ROD = (1.2, np.array([0.03, 0.03, 0.002])), (0.7, np.array([0.02, 0.02, 0.001]))
HALF = 0.3  # m, of a cylinder and of a rod: their ends are that far from their centres
LEGS = 6
X, Y, Z = np.eye(3)


def _circle(radius: float, spread: float) -> np.ndarray:
    """Return the points of the joints (6, 3): three pairs, each `spread` (rad) apart."""
    pairs = np.repeat(2 * np.pi / 3 * np.arange(3), 2) + np.tile([-spread / 2, spread / 2], 3)
    return np.stack([radius * np.cos(pairs), radius * np.sin(pairs), 0 * pairs], axis=1)


BASE, TOP = _circle(0.8, 0.4), _circle(0.5, 1.7)


def turned(p: Any, x: Any) -> Any:
    """Return a vector of a body, turned by its unit quaternion."""
    return x + 2 * jnp.cross(p[1:], jnp.cross(p[1:], x) + p[0] * x)


def _rate(p: Any, dp: Any) -> Any:
    """Return the angular velocity in the axes of the body."""
    w, x, y, z = p
    return 2 * jnp.array([[-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]) @ dp


class Spread(NamedTuple):
    """Bodies of all legs and the platform: each a place and a quaternion."""

    cylinders: Any  # (6, 7)
    rods: Any  # (6, 7)
    platform: Any  # (7,)

    @staticmethod
    def of(q: Any) -> "Spread":
        """Take the coordinates (91,) apart."""
        q = q.reshape(2 * LEGS + 1, 7)
        return Spread(q[:LEGS], q[LEGS:-1], q[-1])


def _kinetic(mass: float, inertia: np.ndarray, q: Any, dq: Any) -> Any:
    omega = _rate(q[3:], dq[3:])
    # The last term is an inertia of the rate of |p|, which is zero.
    return (mass * dq[:3] @ dq[:3] + omega @ (inertia * omega) + inertia[0] * (2 * q[3:] @ dq[3:]) ** 2) / 2


def _leg_rows(base: Any, top: Any, cylinder: Any, rod: Any, platform: Any) -> Any:
    """Fourteen rows of rank twelve: cross products say by three rows what two would."""
    axis = turned(cylinder[3:], Z)
    return jnp.concatenate(
        [
            cylinder[:3] - HALF * axis - base,
            jnp.stack([turned(cylinder[3:], Y) @ X, turned(rod[3:], X) @ turned(cylinder[3:], Y)]),
            jnp.cross(turned(rod[3:], Z), axis),
            jnp.cross(rod[:3] - cylinder[:3], axis),
            rod[:3] + HALF * turned(rod[3:], Z) - platform[:3] - turned(platform[3:], top),
        ]
    )


def _stretched(length: Any, rest: Any) -> Any:
    return STIFFNESS / 2 * jnp.sum((length - rest) ** 2)


def system(rest: Any) -> udk.ConstrainedSystem:
    """Return the platform on springs of these lengths (6,) at rest: 91 coordinates, 97 rows of rank 85."""

    def kinetic(q: Any, dq: Any) -> Any:
        q, dq = Spread.of(q), Spread.of(dq)
        legs = jax.vmap(lambda c, r, dc, dr: _kinetic(*CYLINDER, c, dc) + _kinetic(*ROD, r, dr))
        return jnp.sum(legs(q.cylinders, q.rods, dq.cylinders, dq.rods)) + _kinetic(MASS, INERTIA, q.platform, dq.platform)

    def potential(t: Any, q: Any) -> Any:
        q = Spread.of(q)
        heights = CYLINDER[0] * jnp.sum(q.cylinders[:, 2]) + ROD[0] * jnp.sum(q.rods[:, 2]) + MASS * q.platform[2]
        return GRAVITY * heights + _stretched(_leg(_ends(q.platform[:3], q.platform[3:]) - BASE)[0], rest)

    def rows(t: Any, q: Any) -> Any:
        bodies = Spread.of(q)
        legs = jax.vmap(_leg_rows, (0, 0, 0, 0, None))(jnp.asarray(BASE), jnp.asarray(TOP), *bodies)
        return {"legs": legs.ravel(), "quaternions": jnp.sum(q.reshape(-1, 7)[:, 3:] ** 2, axis=1) - 1.0}

    return udk.ConstrainedSystem.of_energy(kinetic, potential=potential, constraint=rows)


def bodies(pose: Any) -> Any:
    """Return all coordinates (91,) by the platform's pose (6,): its centre, and its angles about x, y and z, in this order."""
    place, (a, b, c) = pose[:3], pose[3:] / 2
    p = _times(_times(_about(X, a), _about(Y, b)), _about(Z, c))
    along = _ends(place, p) - BASE
    length, alpha, beta = _leg(along)
    turns = jax.vmap(lambda a, b: _times(_about(X, a / 2), _about(Y, b / 2)))(alpha, beta)
    axes = along / length[:, None]
    cylinders = jnp.concatenate([BASE + HALF * axes, turns], axis=1)
    rods = jnp.concatenate([BASE + along - HALF * axes, turns], axis=1)
    return jnp.concatenate([cylinders.ravel(), rods.ravel(), place, p])


def lengths(pose: Any) -> Any:
    """Return the lengths of the legs (6,)."""
    return _leg(_legs_along(pose))[0]


def _legs_along(pose: Any) -> Any:
    platform = bodies(pose)[-7:]
    return _ends(platform[:3], platform[3:]) - BASE


def _ends(place: Any, p: Any) -> Any:
    """Return the upper ends of the legs (6, 3)."""
    return place + jax.vmap(lambda top: turned(p, top))(jnp.asarray(TOP))


def _leg(along: Any) -> Any:
    """Return length and angles of the legs: each universal joint turns about x, then about its own y."""
    x, y, z = along.T
    return jnp.sqrt(jnp.sum(along**2, axis=1)), jnp.arctan2(-y, z), jnp.arctan2(x, jnp.hypot(y, z))


def _about(axis: np.ndarray, half: Any) -> Any:
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


def _times(p: Any, r: Any) -> Any:
    return jnp.concatenate([(p[0] * r[0] - p[1:] @ r[1:])[None], p[0] * r[1:] + r[0] * p[1:] + jnp.cross(p[1:], r[1:])])


def poses(start: Any, rest: Any, ts: np.ndarray) -> np.ndarray:
    """Return the platform's poses (len(ts), 6) from rest, by Lagrange's equations of its six coordinates, without constraints."""

    def centres(y: Any) -> Any:
        q = Spread.of(bodies(y))
        return q.cylinders[:, :3], q.rods[:, :3], q.platform

    def kinetic(y: Any, w: Any) -> Any:
        (_, _, platform), (dc, dr, dp) = jax.jvp(centres, (y,), (w,))
        (_, _, beta), (_, da, db) = jax.jvp(lambda y: _leg(_legs_along(y)), (y,), (w,))
        omega = jnp.stack([da * jnp.cos(beta), db, da * jnp.sin(beta)], axis=1)  # of a leg, in its own axes
        legs = sum(m * jnp.sum(d**2) + jnp.sum(omega**2 @ inertia) for d, (m, inertia) in ((dc, CYLINDER), (dr, ROD)))
        turning = _rate(platform[3:], dp[3:])
        return (legs + MASS * dp[:3] @ dp[:3] + turning @ (INERTIA * turning)) / 2

    def potential(y: Any) -> Any:
        cylinders, rods, platform = centres(y)
        heights = CYLINDER[0] * jnp.sum(cylinders[:, 2]) + ROD[0] * jnp.sum(rods[:, 2]) + MASS * platform[2]
        return GRAVITY * heights + _stretched(lengths(y), rest)

    @jax.jit
    def slope(z: Any) -> Any:
        y, w = z[:6], z[6:]
        momentum = jax.grad(kinetic, 1)
        force = jax.grad(kinetic)(y, w) - jax.grad(potential)(y) - jax.jvp(lambda y: momentum(y, w), (y,), (w,))[1]
        return jnp.concatenate([w, jnp.linalg.solve(jax.jacfwd(momentum, 1)(y, w), force)])

    begin = np.concatenate([start, np.zeros(6)])
    found = solve_ivp(lambda t, z: np.asarray(slope(z)), (ts[0], ts[-1]), begin, "DOP853", ts, rtol=1e-12, atol=1e-12)
    return found.y[:6].T
