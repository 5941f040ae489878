"""The drift of redundant constraints grows like the distance of a bead on a rotating wire.

A pseudoinverse truncated at the rank r of a closed mechanism enforces P (Psi'' + 2 alpha Psi' + beta^2 Psi) = 0, with P the
projector onto the range of the constraint Jacobian, and Q = I - P the projector onto its left null space. If loops are slightly
open, Psi = Psi_q dq is in this range: Q Psi = 0 to first order, and this remains true while the range turns. Differentiation
gives the law

    p = P Psi',        Psi' = p - Q' Psi,        p' = -Q' p + Q'^2 Psi - 2 alpha p - beta^2 Psi.

In axes that turn with the range, the drift obeys rho'' + 2 alpha rho' + (beta^2 - W) rho = 0, where W = P Q'^2 P contains the
squared rates at which the left null space turns. In the paper's linkage this space has one direction, (e, -2e, e, -e, 2e, -e)
with the axis e of the links. W is then theta'^2, and with the exact solution theta(t) the law is a scalar equation of Hill's
type,

    rho'' + 2 alpha rho' + (beta^2 - theta'^2) rho = 0.

Claim: in the full nonlinear equations, a drift of 1e-9 at the start grows at the Floquet exponent of this law, to five digits:
for the linkage from five starts, with and without gains, and for a scissor lift with two redundant rows, whose left null space
turns at two different rates, neither of them constant. Gains alpha = beta = a shift the exponent by -a: a few per second are
enough.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels, tracked
from experiments.parts.drift_law import LIFT, Motion, Range, law, lift, linkage, opened, scalar_law, turning
from udkjax.show.style import COLOURS

STARTS = (-20.0, -30.0, -45.0, -50.0, -70.0)  # degrees, at rest
GAINS = ((0.0, 0.0), (2.0, 2.0), (1.0, 0.5), (3.0, 1.0), (1.0, 3.0))  # alpha, beta in 1/s; the last lets the drift oscillate
TOL = 1e-13  # of integration: 1e-4 of the drift at its smallest
TRUNCATE = 1e-2  # in the units of D: above what a drift opens, below the smallest singular value along these motions
SMALL, LARGE = 1e-9, 1e-5  # where a drift that grows or falls begins: rounding, and what is of second order, stay far below it
SPAN = np.log(1e5)  # by which it may grow or fall meanwhile, but for a whole number of periods
OUTPUTS, KEPT = 481, 4  # of every run, divisible by 1 to 4 periods; of which each fourth is kept
BOUND = 1e-5  # relative: of the rates measured


def simulated(motion: Motion, state: udk.State, alpha: float, beta: float, periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times and Psi (T, m) of the full nonlinear equations, by singular values, their rank held."""
    ts = np.linspace(0, periods * motion.period, OUTPUTS)
    sol = udk.simulate(
        motion.mechanism, ts, state, TOL, TOL, udk.SVD.absolute(TRUNCATE), udk.Baumgarte(alpha, beta), drift_tol=np.inf
    )
    return ts, np.asarray(udk.violation(motion.mechanism, sol))


def exponent(ts: np.ndarray, psi: np.ndarray, periods: int, oscillates: bool) -> float:
    """Return the rate at which Psi grows from period to period (1/s): a line through log |Psi|, or, where Psi turns into another
    direction meanwhile, the roots of the recurrence x[k+2] = a x[k+1] + b x[k] that its component along the first one obeys."""
    every = (OUTPUTS - 1) // periods
    ts, psi = ts[::every], psi[::every]
    if not oscillates:
        return np.polyfit(ts, np.log(np.linalg.norm(psi, axis=1)), 1)[0]
    x = psi @ psi[0]
    weight = 1 / np.hypot(x[1:-1], x[:-2])
    a, b = np.linalg.lstsq(np.stack([x[1:-1], x[:-2]], 1) * weight[:, None], x[2:] * weight)[0]
    return np.log(np.abs(np.roots([1, -a, -b])).max()) / ts[1]


class Measured(NamedTuple):
    """Exponents (1/s) by the law in one direction, by the general law, and measured; the run, |Psi| in m or rad over s."""

    theory: float
    general: float
    measured: float
    time: np.ndarray
    drift: np.ndarray


def compare(motion: Motion, turn: Callable[[float], Range], alpha: float, beta: float) -> Measured | None:
    """Hold one motion with one pair of gains against the laws; None: the law has no direction that dominates."""
    P, plus, slope = turn(motion.coordinate(0.0)[0])
    general, start = law(motion, turn, alpha, beta)
    multiplier = general
    if motion.mechanism.drivers:
        if _is_complex(general):
            return None
    else:  # the left null space is one direction: the one that it turns into is the drift's
        multiplier, start = scalar_law(motion, alpha, beta)
        start = np.kron(start, np.linalg.eigh(P @ slope @ slope @ P)[1][:, -1])
    theory, general = (float(np.log(np.abs(x)) / motion.period) for x in (multiplier, general))
    oscillates = _is_complex(multiplier)
    periods = 4 if oscillates else int(np.clip(SPAN / (abs(theory) * motion.period), 1, 4))
    start = np.real(start) / np.linalg.norm(np.real(start)[: len(P)])
    psi, p = (SMALL if theory > 0 else LARGE) * start.reshape(2, -1)
    ts, psi = simulated(motion, opened(motion, plus, psi, p), alpha, beta, periods)
    return Measured(theory, general, exponent(ts, psi, periods, oscillates), ts[::KEPT], np.linalg.norm(psi, axis=1)[::KEPT])


def _is_complex(multiplier: complex) -> bool:
    return abs(multiplier.imag) > 1e-6 * abs(multiplier)


def study(smoke: bool) -> xarray.Dataset:
    """Theory and measurement of every motion with every pair of gains."""
    motions = {f"{start:.0f} deg": linkage(start) for start in (STARTS[2:3] if smoke else STARTS)}
    motions |= {} if smoke else {"scissor lift": lift()}
    gains = GAINS[:3:2] if smoke else GAINS
    found = np.full((3, len(motions), len(gains)), np.nan)
    runs = np.full((2, len(motions), len(gains), (OUTPUTS - 1) // KEPT + 1), np.nan, np.float32)
    for row, motion in enumerate(tracked(motions.values(), "wire_law")):
        turn = turning(motion)
        for column, (alpha, beta) in enumerate(gains):
            result = compare(motion, turn, alpha, beta)
            if result is not None:
                found[:, row, column], runs[:, row, column] = result[:3], result[3:]
    about = ("by the law in one direction", "by the general law", "of the simulation")
    dims = ("motion", "gains")
    data = xarray.Dataset(
        {
            name: (dims, values, {"long_name": f"growth rate of the drift {what}", "units": "1/s"})
            for name, values, what in zip(("theory", "general", "measured"), found, about, strict=True)
        },
        coords={"motion": list(motions), "alpha": ("gains", [a for a, _ in gains]), "beta": ("gains", [b for _, b in gains])},
    )
    data["time"] = ((*dims, "output"), runs[0], {"units": "s"})
    data["drift"] = ((*dims, "output"), runs[1], {"long_name": "|Psi|", "units": "m, rad"})
    if not smoke:
        turn, angles = turning(lift()), np.linspace(0.1, 1.4, 66)
        rates = [np.linalg.svd((np.eye(len(r.P)) - r.P) @ r.dQ)[1][:2] for r in map(turn, angles)]
        data["turning"] = (("angle", "null direction"), np.array(rates), {"long_name": "turning of the lift's left null space"})
        data["angle"] = ("angle", angles, {"units": "rad"})
    settings = {"tol": TOL, "rank_tol": TRUNCATE, "solver": "Dopri8", "drift": [SMALL, LARGE], "lift": list(LIFT.values())}
    return described(data, "\n".join(udk.dumps(motion.mechanism) for motion in motions.values()), settings)


def deviation(data: xarray.Dataset) -> xarray.DataArray:
    """Return by how much the measured exponent differs from theory, relative to it."""
    return np.abs(data.measured / data.theory - 1)


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """The measured rates are the law's; the general law is the scalar one where that applies; alpha = beta = a shifts by -a."""
    pair = [np.flatnonzero((data.alpha == a) & (data.beta == a)) for a in (0.0, 2.0)]
    parts = {
        "the drift grows at the law's rate": bool(deviation(data).max() < BOUND),
        "the general law gives the scalar law's rate": bool(np.abs(data.general - data.theory).max() < 1e-8),
        "without gains it grows": bool((data.measured[:, pair[0]] > 0).all()),
    }
    if pair[1].size:
        shift = data.measured[:, pair[1][0]] - data.measured[:, pair[0][0]]
        parts["gains of 2 shift the rate by -2"] = bool(np.abs(shift + 2).max() < 1e-4)
    return parts


def headline(data: xarray.Dataset) -> str:
    """The worst deviation, and the rates from -45 and -50 degrees."""
    rates = ", ".join(f"{float(data.measured[k, 0]):.5f} /s ({name})" for k, name in enumerate(data.motion.values))
    worst = float(deviation(data).max())
    return f"{int(data.measured.count())} growth rates differ from theory by at most {worst:.0e}; without gains: {rates}"


def figure(data: xarray.Dataset) -> Figure:
    """Draw the drift without gains, the turning of the lift's null space, and the deviations from theory."""
    figure, ((left, middle, right),) = panels(1, 3, 12.5, 4.0)
    for row, name in enumerate(data.motion.values):
        time, drift, rate = data.time[row, 0], data.drift[row, 0], float(data.theory[row, 0])
        left.semilogy(time, drift, color=COLOURS[row], lw=1.2, label=f"{name}: {rate:.3f} /s")
        left.semilogy(time, drift[0] * np.exp(rate * time), color=COLOURS[row], lw=0.8, ls=":")
    left.set(xlabel="time (s)", ylabel="|Psi| (m, rad)", title="Drift without gains (dotted: theory)")
    left.legend(fontsize="small", frameon=False)
    if "turning" in data:
        middle.plot(data.angle, data.turning[:, 0], color=COLOURS[5], label="scissor lift, the faster")
        middle.plot(data.angle, data.turning[:, 1], color=COLOURS[4], label="scissor lift, the slower")
    middle.axhline(1, color=COLOURS[0], ls="--", lw=1, label="parallelogram")
    middle.set(xlabel="angle s of the bars (rad)", ylabel="turning of the left null space (rad/rad)", ylim=(0, 1.5))
    middle.set_title("How fast the wire turns, for s' = 1")
    middle.legend(fontsize="small", frameon=False)
    for column, (alpha, beta) in enumerate(zip(data.alpha.values, data.beta.values, strict=True)):
        x, y = data.theory[:, column], np.maximum(deviation(data)[:, column], 1e-10)
        right.semilogy(x, y, "os^vD"[column], color=COLOURS[column], mfc="none", label=f"alpha {alpha:g}, beta {beta:g}")
    right.axhline(1e-3, color="black", lw=0.8, ls="--")
    right.text(0.98, 1.2e-3, "0.1 %", transform=right.get_yaxis_transform(), ha="right", va="bottom", fontsize="small")
    right.set(
        xlabel="growth rate by theory (1/s)", ylabel="|measured / theory - 1|", title="All motions and gains", ylim=(1e-10, 1.0)
    )
    right.legend(fontsize="small", frameon=False, loc="upper center", ncols=2)
    return figure
