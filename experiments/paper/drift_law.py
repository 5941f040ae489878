"""The law of the drift of a redundantly constrained linkage: a bead on a wire that turns with its links.

On the constraint manifold D of the paper's linkage has rank 11. While the rank is held at 11 a pseudoinverse enforces P Psi'' = 0
only, P the projector on the range of D, and that range turns with the links. The drift lies in the range; of its size rho in the
direction into which the left null vector turns, this leaves, to first order,

    rho'' + 2 alpha rho' + (beta^2 - theta'^2) rho = 0.

theta'^2 is a centrifugal force: without stabilization rho grows, from whatever rounding made of it. theta' has the period P of
the swing, so theta'^2 has P/2, and the rate of growth is log|mu| / (P/2), mu the largest Floquet multiplier over P/2.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from udkjax.scene import Mechanism
from udkjax.study.accuracy import as_pendulum, parallelogram

ALIKE = 1e-8  # of a link's length: how equal and parallel links are that assembly has closed
TOL = 1e-11  # of the law's own integration: ten digits of the rate


class Swing(NamedTuple):
    """phi'' = -omega^2 sin(phi), from rest at `amplitude` (rad); phi is the angle from hanging."""

    omega: float  # 1/s, of small oscillations
    amplitude: float

    @property
    def period(self) -> float:
        """4 K(sin(amplitude / 2)) / omega, in s."""
        return float(4 * ellipk(np.sin(self.amplitude / 2) ** 2) / self.omega)


def swing_of(mech: Mechanism, q: Float[ArrayLike, "bodies 3"]) -> Swing:
    """Return the swing of a parallelogram linkage that is released from rest at `q`; raise ValueError for other mechanisms."""
    linkage = parallelogram(mech, np.asarray(q), ALIKE)
    if linkage is None:
        raise ValueError(f"{mech.name} is not a parallelogram linkage that moves under gravity alone")
    angle, omega = as_pendulum(mech, linkage)
    return Swing(omega, angle)


def growth_rate(swing: Swing, alpha: float = 0.0, beta: float = 0.0) -> float:
    """Return the rate (1/s) at which a drift grows, negative where it decays, with gains alpha and beta (1/s)."""
    half = swing.period / 2
    columns = [_solve(swing, alpha, beta, start, [0.0, half])[:, -1] for start in ((1.0, 0.0), (0.0, 1.0))]
    return float(np.log(np.abs(np.linalg.eigvals(np.array(columns).T)).max()) / half)


def drift(swing: Swing, ts: Float[np.ndarray, "T"], alpha: float = 0.0, beta: float = 0.0) -> Float[np.ndarray, "T"]:
    """Return |rho| at the times `ts` (s) from 1 at rest at the first of them, where the swing starts."""
    return np.abs(_solve(swing, alpha, beta, (1.0, 0.0), ts)[0])


def _solve(swing: Swing, alpha: float, beta: float, start: tuple[float, float], ts) -> Float[np.ndarray, "2 T"]:
    def rates(t: float, y: np.ndarray) -> list[float]:
        phi, rate, rho, rho_rate = y
        return [rate, -(swing.omega**2) * np.sin(phi), rho_rate, (rate**2 - beta**2) * rho - 2 * alpha * rho_rate]

    solver: Callable = solve_ivp
    run = solver(rates, (ts[0], ts[-1]), [swing.amplitude, 0.0, *start], method="DOP853", t_eval=ts, rtol=TOL, atol=TOL)
    return run.y[2:]
