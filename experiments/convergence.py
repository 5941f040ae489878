"""Every integrator has its theoretical order, also with projection; at outputs between steps, some have a lower order.

The error of q after 2 s is measured against the exact solution, with steps of equal size, on the paper's linkage, released at
-45 degrees. The error of a method of order p is proportional to h^p. A multistep method begins with order one, so its first
step is a millionth of h, and each step is a tenth longer than the one before until it reaches h. An Adams method of order k
predicts with k points and corrects with k + 1, and therefore converges like h^(k+1); a backward differentiation formula of
order k converges like h^k. At k = 12 no such law is visible: with one prediction and one correction, the method is unstable
until its steps are so small that it is exact up to rounding. (With variable order, the program itself finds this.)

Projection after each step moves the state by no more than the error of the step, O(h^(p+1)), towards Psi = 0 and Psi_dot = 0,
which the exact solution satisfies. It therefore cannot lower the order (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical
Integration, 2006, theorem IV.4.1). At orders above eight, the error falls to the rounding level within a decade of step sizes;
terms of higher order still contribute there, and the measured slope is steeper. Output times lie between steps, where a result
is as accurate as the interpolating polynomial of the method: Dopri8's has order 5, Dopri5's and Tsit5's order 4, Verner65's
order 4. The error between steps falls like h^6 and h^5 whatever the order of the steps, and dominates at small steps.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels, tracked
from experiments.parts.stepping import by_equal_steps
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import exact_coordinates

RUNGE_KUTTA: dict[str, tuple[Callable[[], Any], int]] = {
    "Heun": (diffrax.Heun, 2),
    "Bosh3": (diffrax.Bosh3, 3),
    "Dopri5": (diffrax.Dopri5, 5),
    "Tsit5": (diffrax.Tsit5, 5),
    "Verner65": (lambda: udk.Verner65(), 6),
    "Dopri8": (diffrax.Dopri8, 8),
}
ADAMS = {f"Adams, k = {k}": (lambda k=k: udk.Adams(min_order=k, max_order=k), k + 1) for k in (1, 2, 4, 6, 8, 10, 12)}
BDF = {f"BDF, k = {k}": (lambda k=k: udk.BDF(min_order=k, max_order=k), k) for k in (1, 2, 3, 4, 5)}
SOLVERS = RUNGE_KUTTA | ADAMS | BDF
UNPROJECTED = (*RUNGE_KUTTA, "Adams, k = 4", "Adams, k = 8", "BDF, k = 3")
UNSTABLE = "Adams, k = 12"
SMOKE = ("Bosh3", "Dopri8", "Adams, k = 4")
END, OUTPUTS = 2.0, 41  # s
STEPS = sorted({round(2 ** (k / 4)) for k in range(8, 33)} | {round(2 ** (k / 2)) for k in range(16, 25)})
ROUNDING, COARSE = 2e-13, 0.03  # m, rad: errors between which the order shows
FINEST = 6  # points, of those, to which a line is fitted


def study(smoke: bool) -> xarray.Dataset:
    mechanism = udk.library.parallelogram(np.deg2rad(-45.0))
    ts = np.linspace(0.0, END, OUTPUTS)
    exact = np.reshape(exact_coordinates(mechanism, ts, mechanism.q0, mechanism.v0), (OUTPUTS, 12))
    names, steps = (SMOKE, [n for n in STEPS if n < 200]) if smoke else (tuple(SOLVERS), STEPS)
    errors = np.full((2, len(names), len(steps), 2), np.nan)
    for row, name in enumerate(tracked(names, "convergence")):
        make, _ = SOLVERS[name]
        for projected in [1] if smoke or name not in UNPROJECTED else [0, 1]:
            run = by_equal_steps(mechanism, make(), ts, bool(projected))
            for column, n in enumerate(steps):
                wrong = np.abs(np.asarray(run(n))[:, :12] - exact).max(axis=1)
                errors[projected, row, column] = wrong[-1], wrong.max()
    dims = ("projected", "solver", "steps")
    data = xarray.Dataset(
        {
            "error": (dims, errors[..., 0], {"long_name": "largest error of q at the end of the last step", "units": "m, rad"}),
            "between": (dims, errors[..., 1], {"long_name": "largest error of q at 41 output times", "units": "m, rad"}),
            "claimed": ("solver", [SOLVERS[name][1] for name in names]),
        },
        coords={"projected": [0, 1], "solver": list(names), "steps": list(steps)},
    )
    return described(data, mechanism, {"end": END, "outputs": OUTPUTS, "method": "Elimination"})


def order(steps: np.ndarray, error: np.ndarray) -> float:
    """Return the exponent of the step in the error, by a line through the finest steps whose error is not rounding's."""
    rounded = np.flatnonzero(error <= ROUNDING)
    steps, error = (x[: rounded[0] if rounded.size else None] for x in (steps, error))
    seen = np.flatnonzero(error < COARSE)[-FINEST:]
    return -np.polyfit(np.log(steps[seen]), np.log(error[seen]), 1)[0] if len(seen) > 2 else np.nan


def orders(data: xarray.Dataset, what: str, projected: int = 1) -> dict[str, float]:
    """Return measured orders by solver, of the `error` at the end of a step or `between` the steps."""
    chosen = data[what].sel(projected=projected)
    found = {str(s): order(data.steps.values, chosen.sel(solver=s).values) for s in data.solver.values}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def holds(data: xarray.Dataset) -> dict[str, bool]:
    claimed = dict(zip(data.solver.values, data.claimed.values))
    ends, free, between = orders(data, "error"), orders(data, "error", 0), orders(data, "between")
    right = lambda found: all(-0.7 < p - claimed[name] < 1.5 for name, p in found.items() if name != UNSTABLE)  # noqa: E731
    parts = {
        "projected, each integrator has its order": right(ends) and set(ends) == set(claimed),
        "Dopri8 between the steps: order 6": abs(between["Dopri8"] - 6) < 0.5,
    }
    if UNSTABLE in claimed:
        at = data.between.sel(projected=1, steps=64)
        parts["Adams of order 12 is unstable where order 10 is accurate"] = bool(
            at.sel(solver=UNSTABLE) > 1e3 * at.sel(solver="Adams, k = 10")
        )
    if free:
        parts["not projected, too"] = right(free) and set(free) == set(UNPROJECTED)
    return parts


def headline(data: xarray.Dataset) -> str:
    ends, between = orders(data, "error"), orders(data, "between")
    listed = ", ".join(f"{name.replace(', k = ', ' ')} {p:.1f}" for name, p in ends.items() if name != UNSTABLE)
    return f"measured orders: {listed}; Dopri8 at outputs between steps {between['Dopri8']:.1f}"


def figure(data: xarray.Dataset) -> Figure:
    page, axes = panels(1, 3, 12.5, 4.6, sharex=True, sharey=True)
    groups = {
        "Runge-Kutta": [s for s in data.solver.values if s in RUNGE_KUTTA],
        "Adams, order k + 1": [s for s in data.solver.values if s in ADAMS],
        "BDF, order k": [s for s in data.solver.values if s in BDF],
    }
    measured = orders(data, "error")
    for axis, (title, solvers) in zip(axes.ravel(), groups.items()):
        for number, solver in enumerate(solvers):
            one = data.sel(projected=1, solver=solver)
            color = COLOURS[number % len(COLOURS)]
            axis.loglog(
                data.steps, one.error, ".-", ms=4, lw=1, color=color, label=f"{solver}: {measured.get(str(solver), np.nan):.2f}"
            )
            axis.loglog(data.steps, one.between, ":", lw=1, color=color)
        axis.set(title=title, xlabel="steps in 2 s", ylim=(1e-16, 10.0))
        if len(solvers):
            axis.legend(title="measured order", fontsize=8)
    axes[0, 0].set_ylabel("error of q (m, rad): end of a step; dotted: between")
    return page
