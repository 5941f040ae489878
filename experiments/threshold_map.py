"""Without stabilization, every pseudoinverse loses the redundant linkage; the rank threshold only decides when.

Because of the redundancy, a drift rho grows at 1.77 /s from rest at -45 degrees (wire_law.py), beginning with the errors of
rounding and integration. Off the manifold, the twelfth singular value of D is no longer zero but about 0.57 rho. As long as it
is below the rank threshold, the rank is held at 11 and the drift grows until it is as large as the mechanism itself: at 1.77 /s
from rounding errors, this takes about 18 s, whatever the tolerance. As soon as the singular value exceeds the threshold, all 12
rows are enforced; the twelfth direction consists of rounding errors, divided by 0.57 rho, and the run is lost at once. A
threshold tied to the integration tolerance TOL, as in the paper, is therefore the worst choice: the smaller TOL, the earlier
the end. A fixed choice of 11 rows has no redundancy, and projection removes the drift as it arises: with either, no run is
lost.

Claim: a run is lost when it deviates from the exact solution by 0.1 (m, rad). With a threshold of 1e-2, every method loses the
run between 13 and 21 s, at every TOL from 1e-4 to 1e-12; with a threshold of TOL, each run is lost earlier. The time falls with
the logarithm of the threshold, at the growth rate of the law, within 10 %. With 11 rows, or with projection at any threshold,
no run is lost in 30 s, and errors are below 100 TOL at 20 s.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import udkjax as udk
from experiments.common import described, panels
from experiments.parts.linkage import OUTPUTS, exact, parallelogram, start
from udkjax.show.style import COLOURS

METHODS = {
    "SVD": udk.SVD,
    "Varga": udk.Varga,
    "Householder": udk.Householder,
    "Gram-Schmidt": udk.GramSchmidt,
    "Greville": udk.Greville,
}
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
THRESHOLDS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)  # absolute, in the units of D: kg^(-1/2), m kg^(-1/2)
DEGREES, END, LOST = -45.0, 30.0, 0.1
AT = 320  # the output at 20 s
GROWTH = 1.770  # 1/s, of the drift from this start: wire_law.py
MAX_STEPS = 3_000  # three times what the most exact run takes that is not lost


def study(smoke: bool) -> xarray.Dataset:
    """Return the time at which each method loses the linkage, by threshold and tolerance, and its error at 20 s: three sweeps."""
    thresholds = THRESHOLDS[:3:2] if smoke else THRESHOLDS
    tolerances = TOLERANCES[1:2] if smoke else TOLERANCES
    ts, state, mech = np.linspace(0.0, END, OUTPUTS), start(DEGREES), parallelogram()
    exact_q = exact(ts, state)

    def run(mechanism: udk.Mechanism, solution: Any) -> dict[str, Any]:
        wrong = jnp.abs(solution.q - exact_q)
        is_lost = ~jnp.all(wrong <= LOST, (1, 2))  # a maximum may ignore NaN
        error = jnp.where(jnp.isfinite(solution.q[AT]).all(), wrong[AT].max(), jnp.nan)
        return {"lost": jnp.append(ts, jnp.inf)[jnp.argmax(jnp.append(is_lost, True))], "error": error}

    tol, threshold = udk.Axis(tolerances, of=("rtol", "atol")), udk.Axis(thresholds, of="rank_tol")
    free, svd = udk.Baumgarte(0.0, 0.0), udk.SVD.absolute(1.0)  # gains of zero are none; the threshold is an axis
    methods = [make.absolute(1.0) for make in list(METHODS.values())[: 1 if smoke else None]]
    sweep = partial(udk.sweep, mech, ts=ts, progress=False, measure=run, state=state, drift_tol=np.inf, max_steps=MAX_STEPS)
    of_methods = sweep({"method": methods, "tol": tol, "threshold": threshold}, stabilization=free)
    # The rows are chosen when the mechanism is built: one threshold stands for all.
    rows = sweep({"tol": tol}, method=udk.Elimination(), stabilization=free)
    maps = {name: of_methods.isel(pseudoinverse=k, drop=True) for k, name in enumerate(list(METHODS)[: len(methods)])}
    if not smoke:
        maps["SVD, projected"] = sweep({"tol": tol, "threshold": threshold}, method=svd)
    maps["11 rows"] = rows.expand_dims(threshold=list(thresholds), axis=1)
    lost_at, error = (
        np.stack([one[f"run_{name}"].transpose("tol", "threshold") for one in maps.values()]) for name in ("lost", "error")
    )
    dims = ("variant", "tol", "threshold")
    data = xarray.Dataset(
        {
            "lost": (dims, lost_at, {"long_name": "time at which the run is lost; infinite: it is not", "units": "s"}),
            "error": (dims, error, {"long_name": "largest error of any coordinate at 20 s", "units": "m, rad"}),
        },
        coords={"variant": list(maps), "tol": list(tolerances), "threshold": list(thresholds)},
    )
    return described(data, mech, {"start": DEGREES, "end": END, "lost": LOST, "solver": "Dopri8", "max_steps": MAX_STEPS})


def unstable(data: xarray.Dataset) -> list[str]:
    """Return the methods that are not stabilized."""
    return [name for name in METHODS if name in data.variant]


def tied(data: xarray.Dataset) -> np.ndarray:
    """Return when (s) methods whose threshold is TOL lose the run, for each TOL that is also a threshold."""
    return np.stack([data.lost.sel(variant=unstable(data), tol=tol, threshold=tol) for tol in shared(data)], axis=1)


def held(data: xarray.Dataset) -> np.ndarray:
    """Return when (s) methods that hold the rank lose the run, for each TOL that is also a threshold."""
    return data.lost.sel(variant=unstable(data), threshold=THRESHOLDS[0], tol=shared(data)).values


def shared(data: xarray.Dataset) -> list[float]:
    """Return the tolerances that are also thresholds."""
    return [float(tol) for tol in data.tol.values if tol in data.threshold]


def rates(data: xarray.Dataset) -> np.ndarray:
    """Return the rate (1/s) of drift by which each method is lost the earlier, the smaller the threshold, over all TOL."""
    mean = data.lost.sel(variant=unstable(data)).mean("tol")
    return np.array([1 / np.polyfit(np.log(data.threshold), one, 1)[0] for one in mean])


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """The claim, part by part."""
    safe = [name for name in data.variant.values if name not in METHODS]
    return {
        "with its rank held it is lost between 13 and 21 s": bool(((held(data) > 13) & (held(data) < 21)).all()),
        "tied to TOL, earlier": bool((tied(data) < held(data)).all()),
        "drift grows at the rate of the law": bool((np.abs(rates(data) / GROWTH - 1) < 0.1).all()),
        "11 rows and projection are not lost": bool(np.isinf(data.lost.sel(variant=safe)).all()),
        "they are exact": bool((data.error.sel(variant=safe) < 100 * data.tol).all()),
    }


def headline(data: xarray.Dataset) -> str:
    """Return the times at which runs are lost, and the errors of the others, as text."""
    text = f"lost at {_range(held(data))} s with the rank held, at {_range(tied(data))} s with a threshold of TOL; "
    text += "growth rates from these times: " + ", ".join(f"{name} {x:.2f} /s" for name, x in zip(unstable(data), rates(data)))
    rows = data.error.sel(variant="11 rows").isel(threshold=0)
    errors = ", ".join(f"{float(e):.0e} (TOL {t:.0e})" for t, e in zip(data.tol.values, rows))
    return f"{text}; errors at 20 s with 11 rows: {errors}"


def _range(times: np.ndarray) -> str:
    return f"{times.min():.1f} to {times.max():.1f}"


def figure(data: xarray.Dataset) -> Figure:
    """Draw a map of failure times for every method, threshold = TOL framed, and the errors of the runs that are not lost."""
    names = [name for name in data.variant.values if name != "11 rows"]
    figure, axes = panels(2, 4, 13, 6.2)
    for one, name in zip(axes.ravel(), names, strict=False):
        times = data.lost.sel(variant=name)
        one.imshow(np.minimum(times, END), cmap="viridis", vmin=0, vmax=END, aspect="auto")
        for (row, column), time in np.ndenumerate(times.values):
            text, colour = (f"{time:.0f}", "white" if time < END / 2 else "black") if np.isfinite(time) else ("–", "black")
            one.text(column, row, text, ha="center", va="center", fontsize="small", color=colour)
            if data.tol[row] == data.threshold[column]:
                one.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, fill=False, ec=COLOURS[1], lw=2))
        one.set_xticks(range(data.sizes["threshold"]), [f"{x:.0e}" for x in data.threshold.values], fontsize="x-small")
        one.set_yticks(range(data.sizes["tol"]), [f"{x:.0e}" for x in data.tol.values], fontsize="x-small")
        one.set(title=name, xlabel="rank threshold", ylabel="TOL")
        one.grid(False)
    for one in axes.ravel()[len(names) : 6]:
        one.axis("off")
    times, last = axes[1, 2:]
    for number, name in enumerate(unstable(data)):
        mean = data.lost.sel(variant=name).mean("tol")
        times.semilogx(data.threshold, mean, "os^vD"[number], color=COLOURS[number], mfc="none", label=name)
    line = held(data).mean() + np.log(data.threshold / THRESHOLDS[0]) / GROWTH
    times.semilogx(data.threshold, line, color="black", ls=":", lw=0.8, label=f"slope 1 / ({GROWTH:.2f} /s)")
    times.set(title="Lost at, mean over TOL", xlabel="rank threshold", ylabel="time (s)")
    times.legend(fontsize="small", frameon=False)
    for number, name in enumerate(n for n in ("11 rows", "SVD, projected") if n in data.variant):
        worst = data.error.sel(variant=name).max("threshold")
        last.loglog(data.tol, worst, "os"[number] + "-", color=COLOURS[number], mfc="none", lw=1, label=name)
    last.loglog(data.tol, data.tol, color="black", ls=":", lw=0.8, label="TOL")
    last.set(title="Runs that are not lost", xlabel="TOL", ylabel="error at 20 s (m, rad)")
    last.legend(fontsize="small", frameon=False)
    figure.suptitle("Not stabilized, from rest at -45 degrees: when the run is lost; framed: threshold = TOL; –: not in 30 s")
    return figure
