"""Stabilization needs gains of a few per second; gains of hundreds or thousands only make the problem stiff.

With Baumgarte's gains the drift obeys rho'' + 2 alpha rho' + (beta^2 - theta'^2) rho = 0 (see wire_law.py). With alpha = beta =
a it decays at the rate a - lambda, where lambda is the rate at which it grows without gains: 1.77 /s from rest at -45 degrees,
2.57 /s from -20 degrees. Any larger gain keeps the drift at the size of the integration errors. Large gains add an eigenvalue
-a to the equations of motion, which forces an explicit method to take steps of the order of 1/a: the number of right-hand sides
grows in proportion to a, at every tolerance. The paper's gains alpha = 1000, beta = 100 give the eigenvalues -1995 and -5.01:
the stiffness of a gain of two thousand, with a drift that decays no faster than with gains of 5.

Such short steps have smaller errors than the tolerance allows. Costs are therefore compared at equal error: right-hand sides
are divided by those that gains of 5 need for the same error, interpolated between tolerances.

Claim, for 20 s from two starts at tolerances of 1e-6 to 1e-12: without gains every run is lost; with gains of 3 and of 5 errors
stay below a hundred times the tolerance; at equal error, gains of 1000 and the paper's gains take more than ten times as many
right-hand sides.
"""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels
from experiments.parts.drift_law import linkage, scalar_law
from experiments.parts.linkage import OUTPUTS, exact, parallelogram, start
from experiments.parts.tuning import ABSOLUTE_RANK_TOL
from udkjax.show.style import COLOURS

STARTS = (-45.0, -20.0)  # degrees, at rest
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12)
EQUAL = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 5.0, 7.0, 10.0, 20.0, 50.0, 100.0, 300.0, 1000.0)  # alpha = beta, 1/s
PAPER = (1000.0, 100.0)
END = 20.0  # s
LOST = 0.1  # m, rad
ENOUGH, REFERENCE = (3.0, 5.0), 5.0
SHOWN = (3.0, 5.0, 20.0, 100.0, 1000.0)  # in the last panel


def study(smoke: bool) -> xarray.Dataset:
    """Errors, drift and cost of every start, tolerance and pair of gains, by singular values."""
    gains = ((0.0, 0.0), (REFERENCE, REFERENCE), PAPER) if smoke else (*((a, a) for a in EQUAL), PAPER)
    starts, tolerances = (STARTS[:1], TOLERANCES[:3:2]) if smoke else (STARTS, TOLERANCES)
    mech, ts = parallelogram(), np.linspace(0.0, END, OUTPUTS)
    states = [start(degrees) for degrees in starts]
    right = jnp.asarray(np.stack([exact(ts, state) for state in states]))

    def run(mechanism: udk.Mechanism, solution: Any) -> dict[str, Any]:
        own = right[jnp.argmin(jnp.abs(right[:, 0] - solution.q[0]).max((1, 2)))]
        error = jnp.where(solution.code == udk.Result.successful, jnp.abs(solution.q - own).max(), jnp.inf)
        return {"error": error, "drift": jnp.abs(udk.violation(mechanism, solution)).max()}

    axes = {
        "start": udk.Axis(states, of="state"),
        "tol": udk.Axis(tolerances, of=("rtol", "atol")),
        "gains": udk.Zipped({name: [pair[k] for pair in gains] for k, name in enumerate(("alpha", "beta"))}),
    }
    method = udk.SVD.absolute(ABSOLUTE_RANK_TOL)
    # An explicit method by name: the default goes on implicitly where gains make the problem stiff.
    chosen = {"method": method, "solver": diffrax.Dopri8(), "drift_tol": np.inf}
    runs = udk.sweep(mech, axes, ts, [run, "counts"], progress=False, **chosen)
    names = {"error": "run_error", "drift": "run_drift", "right_hand_sides": "right_hand_sides"}
    found = {name: runs[of].transpose("start", "tol", "gains").values for name, of in names.items()}
    exponents = [[exponent(degrees, *pair) for pair in gains] for degrees in starts]
    dims = ("start", "tol", "gains")
    data = xarray.Dataset(
        {name: (dims, values) for name, values in found.items()} | {"exponent": (("start", "gains"), exponents)},
        coords={
            "start": ("start", list(starts), {"units": "degree"}),
            "tol": list(tolerances),
            "alpha": ("gains", [a for a, _ in gains], {"units": "1/s"}),
            "beta": ("gains", [b for _, b in gains], {"units": "1/s"}),
        },
    )
    data["error"].attrs = {"long_name": "largest error of any coordinate", "units": "m, rad"}
    data["drift"].attrs = {"long_name": "largest violation of any row", "units": "m, rad"}
    data["exponent"].attrs = {"long_name": "growth rate of the drift, by theory", "units": "1/s"}
    return described(
        data, mech, {"rank_tol": ABSOLUTE_RANK_TOL, "end": END, "outputs": OUTPUTS, "solver": "Dopri8", "method": "SVD"}
    )


def exponent(degrees: float, alpha: float, beta: float) -> float:
    """Return the growth rate of the drift by theory; equal gains shift that without any."""
    motion = linkage(degrees)
    shift, alpha, beta = (alpha, 0.0, 0.0) if alpha == beta else (0.0, alpha, beta)
    return float(np.log(np.abs(scalar_law(motion, alpha, beta)[0])) / motion.period) - shift


def at(data: xarray.Dataset, alpha: float, beta: float | None = None) -> xarray.Dataset:
    """Return the runs with a pair of gains, by default equal ones."""
    chosen = (data.alpha == alpha) & (data.beta == (alpha if beta is None else beta))
    return data.isel(gains=np.flatnonzero(chosen)).squeeze("gains")


def price(data: xarray.Dataset, runs: xarray.Dataset) -> np.ndarray:
    """Return the right-hand sides of runs relative to those of the reference gains at equal error, if these reach it."""
    found = []
    for k in range(data.sizes["start"]):
        known = at(data, REFERENCE).isel(start=k).sortby("error")
        for error, cost in zip(runs.error.values[k], runs.right_hand_sides.values[k], strict=True):
            if known.error[0] <= error <= known.error[-1]:
                equal = np.exp(np.interp(np.log(error), np.log(known.error), np.log(known.right_hand_sides)))
                found.append(cost / equal)
    return np.array(found)


def stiff(data: xarray.Dataset) -> dict[str, np.ndarray]:
    """Return the prices of the large gains that there are."""
    pairs = {"1000": (1000.0, 1000.0), "1000 and 100": PAPER}
    return {name: price(data, at(data, *pair)) for name, pair in pairs.items() if pair in present(data)}


def present(data: xarray.Dataset) -> set[tuple[float, float]]:
    """Return the pairs of gains that were run."""
    return set(zip(data.alpha.values.tolist(), data.beta.values.tolist(), strict=True))


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Return whether each part of the claim holds."""
    bound = 100 * data.tol
    parts = {"without gains every run is lost": bool((at(data, 0.0).error > LOST).all())}
    for gain in (a for a in ENOUGH if (a, a) in present(data)):
        parts[f"gains of {gain:g} are enough"] = bool((at(data, gain).error < bound).all())
    for name, prices in stiff(data).items():
        parts[f"gains of {name} take more than ten times as much"] = prices.size > 0 and bool(prices.min() > 10)
    return parts


def headline(data: xarray.Dataset) -> str:
    """Return the cost of large gains as text."""
    dear = ", ".join(f"{name}: {p.min():.0f} to {p.max():.0f} times" for name, p in stiff(data).items())
    middle = {"start": 0, "tol": -2}
    one, other = (at(data, *pair).isel(middle) for pair in ((REFERENCE,), PAPER))
    where = f"from {float(data.start[0]):.0f} deg at {float(data.tol[-2]):.0e}"
    return (
        f"right-hand sides at equal error, relative to gains of 5: {dear}; {where}: {int(one.right_hand_sides)} at 5 "
        f"(error {float(one.error):.0e}), {int(other.right_hand_sides)} at 1000 and 100 (error {float(other.error):.0e})"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw errors and costs against the gain, and error against cost."""
    figure, ((left, middle, right),) = panels(1, 3, 12.5, 4.0)
    equal = data.isel(gains=np.flatnonzero(data.alpha == data.beta))
    x = np.maximum(equal.alpha, 0.25)  # zero, on a logarithmic scale
    drawn = [tol for tol in TOLERANCES[:3:2] if tol in data.tol]
    for k, degrees in enumerate(data.start.values):
        for tol, style in zip(drawn, ("-", "--"), strict=False):
            runs = equal.isel(start=k).sel(tol=tol)
            choices = {"color": COLOURS[k], "ls": style, "marker": ".", "lw": 1, "label": f"{degrees:.0f} deg, TOL {tol:.0e}"}
            left.loglog(x, runs.error, **choices)
            middle.loglog(x, runs.right_hand_sides, **choices)
        paper = at(data, *PAPER).isel(start=k).sel(tol=drawn)
        left.loglog([PAPER[0]] * len(drawn), paper.error, "x", color=COLOURS[k], ms=7)
        middle.loglog([PAPER[0]] * len(drawn), paper.right_hand_sides, "x", color=COLOURS[k], ms=7)
        rate = float(at(data, 0.0).exponent[k])
        left.axvline(rate, color=COLOURS[k], ls=":", lw=1)
        left.text(rate, 1.5, "λ", color=COLOURS[k], ha="center", va="bottom", fontsize="small")
    pole = np.array([50.0, 1000.0])
    middle.loglog(pole, 13 * END * pole / 5, color="black", lw=0.8, ls=":", label="proportional to the gain")
    for one, label in ((left, "largest error in 20 s (m, rad)"), (middle, "right-hand sides")):
        one.set(xlabel="gain alpha = beta (1/s), 0 at the left; x: 1000 and 100", ylabel=label)
        one.legend(fontsize="small", frameon=False)
    pairs = [((a, a), f"{a:g}") for a in SHOWN if (a, a) in present(data)] + [(PAPER, "1000 and 100")]
    for number, (pair, label) in enumerate(pairs):
        runs = at(data, *pair).isel(start=0)
        right.loglog(runs.right_hand_sides, runs.error, "os^vDx"[number] + "-", color=COLOURS[number], lw=1, ms=4, label=label)
    right.set(xlabel="right-hand sides", ylabel="largest error in 20 s (m, rad)")
    right.legend(title=f"gains, from {float(data.start[0]):.0f} deg", fontsize="small", frameon=False)
    left.set_title("Above λ the drift is held")
    middle.set_title("Large gains make it stiff")
    right.set_title("At equal error")
    return figure
