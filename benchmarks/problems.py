"""Initial value problems that the integrators are measured on: three that are not stiff, and three that are."""

from typing import Any, NamedTuple

import jax.numpy as jnp


class Problem(NamedTuple):
    """y' = f(t, y) from (0, y0) to `end`."""

    f: Any
    y0: tuple
    end: float


def pendulum(t, y, xp=jnp):
    """theta'' = -9.81 sin(theta), released at 2 rad."""
    return xp.stack([y[1], -9.81 * xp.sin(y[0])])


MU = 0.012277471


def arenstorf(t, y, xp=jnp):
    """The restricted problem of three bodies: Hairer, Norsett, Wanner I, (0.1)."""
    x, z, u, v = y[0], y[1], y[2], y[3]
    a = ((x + MU) ** 2 + z**2) ** 1.5
    b = ((x - 1 + MU) ** 2 + z**2) ** 1.5
    p = x + 2 * v - (1 - MU) * (x + MU) / a - MU * (x - 1 + MU) / b
    q = z - 2 * u - (1 - MU) * z / a - MU * z / b
    return xp.stack([u, v, p, q])


def pleiades(t, y, xp=jnp):
    """Seven stars in the plane, the i-th of mass i: Hairer, Norsett, Wanner I, II.10."""
    x, z = y[:7], y[7:14]
    dx, dz = x - x[:, None], z - z[:, None]
    mass = xp.arange(1.0, 8.0)
    cube = (dx**2 + dz**2 + xp.eye(7)) ** 1.5
    return xp.concatenate([y[14:], (mass * dx / cube).sum(1), (mass * dz / cube).sum(1)])


def van_der_pol(t, y, xp=jnp):
    """Relaxation oscillations: x'' = 1000 (1 - x^2) x' - x."""
    return xp.stack([y[1], 1000 * (1 - y[0] ** 2) * y[1] - y[0]])


def robertson(t, y, xp=jnp):
    """Three reactions, with rates from 0.04 to 3e7: Hairer, Wanner II, (1.4)."""
    slow, back, fast = 0.04 * y[0], 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return xp.stack([back - slow, slow - back - fast, fast])


def hires(t, y, xp=jnp):
    """High irradiance responses of a plant, eight reactants: Hairer, Wanner II, IV.10."""
    a, b, c, d, e, f, g, h = (y[i] for i in range(8))
    bound = 280 * f * h - 1.81 * g
    return xp.stack(
        [
            -1.71 * a + 0.43 * b + 8.32 * c + 0.0007,
            1.71 * a - 8.75 * b,
            -10.03 * c + 0.43 * d + 0.035 * e,
            8.32 * b + 1.71 * c - 1.12 * d,
            -1.745 * e + 0.43 * f + 0.43 * g,
            -280 * f * h + 0.69 * d + 1.71 * e - 0.43 * f + 0.69 * g,
            bound,
            -bound,
        ]
    )


STIFF = {
    "van der Pol": Problem(van_der_pol, (2.0, 0.0), 2000.0),
    "Robertson": Problem(robertson, (1.0, 0.0, 0.0), 1e5),
    "HIRES": Problem(hires, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057), 321.8122),
}
