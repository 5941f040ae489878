"""Initial value problems for the integrators: three non-stiff and three stiff ones.

Each right-hand side computes in NumPy (`xp=numpy`) as well as in JAX.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np


class Problem(NamedTuple):
    """y' = f(t, y) from (0, y0) to `end`, where the state is `reached`."""

    f: Callable[..., Any]
    y0: tuple[float, ...]
    end: float
    reached: tuple[float, ...]
    scale: tuple[float, ...] = (1.0,)  # of each component: if it is smaller, its error is relative to this

    def error(self, y: Any) -> float:
        """Return the largest error of any component of the end state."""
        return float(np.max(np.abs(np.asarray(y) - self.reached) / (np.array(self.scale) + np.abs(self.reached))))


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
    pull = xp.arange(1.0, 8.0) / (dx**2 + dz**2 + xp.eye(7)) ** 1.5
    return xp.concatenate([y[14:], (pull * dx).sum(1), (pull * dz).sum(1)])


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


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(float(x) for x in text.split())


# By Jacobi's elliptic functions; a periodic orbit, with the period that the book gives; the end state that it gives.
ORBIT = _numbers("0.994 0 0 -2.00158510637908252240537862224")
NOT_STIFF = {
    "pendulum": Problem(pendulum, (2.0, 0.0), 10.0, (0.015728632141429, 5.270898793229828)),
    "Arenstorf": Problem(arenstorf, ORBIT, 17.0652165601579625588917206249, ORBIT),
    "Pleiades": Problem(
        pleiades,
        _numbers("3 3 -1 -3 2 -2 2   3 -3 2 0 0 -4 4   0 0 0 0 0 1.75 -1.5   0 0 0 -1.25 1 0 0"),
        3.0,
        _numbers("""
            0.3706139143970502 3.237284092057233 -3.222559032418324 0.6597091455775310 0.3425581707156584
            1.562172101400631 -0.7003092922212495 -3.943437585517392 -3.271380973972550 5.225081843456543
            -2.590612434977470 1.198213693392275 -0.2429682344935824 1.091449240428980 3.417003806314313
            1.354584501625501 -2.590065597810775 2.025053734714242 -1.155815100160448 -0.8072988170223021
            0.5952396354208710 -3.741244961234010 0.3773459685750630 0.9386858869551073 0.3667922227200571
            -0.3474046353808490 2.344915448180937 -1.947020434263292"""),
    ),
}

# By SciPy's Radau, rtol = 1e-12: tests/data/stiff_problems.json.
STIFF = {
    "van der Pol": Problem(van_der_pol, (2.0, 0.0), 2000.0, _numbers("1.70616773217 -8.9280970102e-4"), (1.0, 1e-3)),
    "Robertson": Problem(
        robertson, (1.0, 0.0, 0.0), 1e5, _numbers("0.0178659211421 7.27475146845e-8 0.982134006110"), (1e-2, 1e-6, 1e-2)
    ),
    "HIRES": Problem(
        hires,
        (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057),
        321.8122,
        _numbers("""
            7.371312573325e-4 1.442485726316e-4 5.88872974097e-5 1.175651343283e-3
            2.38635619883e-3 6.23896825274e-3 2.849998395185e-3 2.850001604815e-3"""),
        (1e-3,),
    ),
}
PROBLEMS = NOT_STIFF | STIFF
