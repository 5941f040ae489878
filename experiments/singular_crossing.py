"""To cross a singular configuration takes a truncated pseudoinverse and projection; elimination alone is not enough.

Where the links of the paper's linkage are in line, theta = 0 and pi, the rank of D drops to 10, and the parallelogram could
turn into an anti-parallelogram. Near this configuration, a violation Psi is a distance of Psi / sigma_11 from the motion, with
sigma_11 = 1.05 |theta|: if loops are not closed, the run bounces or changes branch. If loops are closed to machine precision,
and directions of small singular values are left out of both accelerations and projection, inertia carries the mechanism across.
Elimination of rows that are independent elsewhere divides by a pivot proportional to theta^2, which loses digits twice as fast.
`Auto` eliminates where its pivots are safe, and uses singular values elsewhere.

A single start would be misleading. Here are 256 starts: 64 each, spread by 5 degrees, about +60 degrees, about +45 degrees, in
line and at rest, and upright with an angular velocity of -1 rad/s. Each runs for 20 s at a tolerance of 1e-9. A run fails if it
deviates from the exact solution by 0.1 (m, rad), or has not finished after 1,000 steps. Runs that cross well need about half of
these steps; most failures are runs whose steps shrink near the singular configuration, some of which would finish with more
steps.

Claim: without stabilization, and with gains of 10, every method fails on most starts. With projection, the singular value
decomposition and `Auto` fail on none at thresholds of 1e-2, 1e-4 and 1e-6, with errors below 1e-6, and the methods of Varga,
Householder, Gram and Schmidt, and Greville fail on none at 1e-4. Elimination alone, which leaves out rows instead of
directions, fails on some starts at each threshold, and on most at 1e-2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels
from experiments.parts.linkage import exact, parallelogram, start
from udkjax.show.style import COLOURS

GROUPS = {"+60 at rest": (60.0, 0.0), "+45 at rest": (45.0, 0.0), "in line at rest": (0.0, 0.0), "up, -1 rad/s": (90.0, -1.0)}
SPREAD, MEMBERS, SEED = 5.0, 64, 0  # degrees; the first of each group is its centre
THRESHOLDS = (1e-2, 1e-4, 1e-6)  # thresholds of the rank, relative to the largest singular value or a substitute
TOL, END, OUTPUTS, LOST = 1e-9, 20.0, 81, 0.1
MAX_STEPS = 1_000  # two to three times the number of steps of a run that crosses well
DENSE = {"Varga": udk.Varga, "Householder": udk.Householder, "Gram-Schmidt": udk.GramSchmidt, "Greville": udk.Greville}
STABILIZATIONS = {
    "projection": udk.Projection(),
    "gains of 10": udk.Baumgarte(10.0, 10.0),
    "none": udk.Baumgarte(0.0, 0.0),
}


class Variant(NamedTuple):
    """A method with each of some thresholds, and a stabilization."""

    method: str
    make: Callable[[float], Any]
    stabilization: str
    thresholds: tuple[float, ...]


def variants() -> dict[str, Variant]:
    """Return what is compared, by name; other than with the first three methods and projection at the default threshold alone."""
    found = [
        Variant("Auto", udk.Auto, "projection", THRESHOLDS),
        Variant("Elimination", udk.Elimination, "projection", THRESHOLDS),
    ]
    found += [Variant("SVD", udk.SVD, "projection", THRESHOLDS)]
    found += [Variant(name, make, "projection", THRESHOLDS[1:2]) for name, make in DENSE.items()]
    for stabilization in ("gains of 10", "none"):
        found += [Variant("Auto", udk.Auto, stabilization, THRESHOLDS[1:2])]
        found += [Variant("Elimination", udk.Elimination, stabilization, THRESHOLDS[1:2])]
        found += [Variant("SVD", udk.SVD, stabilization, THRESHOLDS[1:2])]
    return {f"{variant.method}, {variant.stabilization}": variant for variant in found}


def starts(members: int) -> list[udk.State]:
    """Return the initial states, group after group."""
    random = np.random.default_rng(SEED)
    spread = [np.append(0.0, random.uniform(-SPREAD, SPREAD, members - 1)) for _ in GROUPS]
    return [start(degrees + d, rate) for (degrees, rate), some in zip(GROUPS.values(), spread, strict=True) for d in some]


def study(smoke: bool) -> xarray.Dataset:
    """Return the result of each run, and its error."""
    members = 1 if smoke else MEMBERS
    thresholds = THRESHOLDS[1:2] if smoke else THRESHOLDS
    compared = dict(list(variants().items())[: 2 if smoke else None])
    mechanism, ts, states = parallelogram(), np.linspace(0.0, END, OUTPUTS), starts(members)
    right = np.stack([exact(ts, state) for state in states])
    shape = (len(compared), len(thresholds), len(GROUPS), members)
    found = {name: np.full(shape, np.nan, np.float32) for name in ("error", "steps")}
    cells = [(k, n, v) for k, v in enumerate(compared.values()) for n, x in enumerate(thresholds) if x in v.thresholds]
    chosen = {
        "method": [variant.make(thresholds[n]) for _, n, variant in cells],
        "stabilization": [STABILIZATIONS[variant.stabilization] for _, _, variant in cells],
    }
    axes = {"cell": udk.Zipped(chosen), "start": udk.Axis(states, of="state")}
    settings = {"rtol": TOL, "atol": TOL, "drift_tol": np.inf, "max_steps": MAX_STEPS}
    runs = udk.sweep(mechanism, axes, ts, "states", progress=False, **settings)
    for cell, (k, n, _) in enumerate(cells):
        run = runs.isel(cell=cell)
        wrong = np.abs(run.q.values - right).max((1, 2, 3))
        wrong = np.where((run.result.values == udk.Result.successful) & (wrong <= LOST), wrong, np.inf)
        found["error"][k, n], found["steps"][k, n] = wrong.reshape(shape[2:]), run.steps.values.reshape(shape[2:])
    dims = ("variant", "threshold", "group", "member")
    data = xarray.Dataset(
        {name: (dims, values) for name, values in found.items()},
        coords={"variant": list(compared), "threshold": list(thresholds), "group": list(GROUPS)},
    )
    data["angle"] = (("group", "member"), np.array([float(s.q[0, 2]) for s in states]).reshape(shape[2:]), {"units": "rad"})
    data["error"].attrs = {
        "long_name": "largest error of any coordinate in 20 s; infinite: failed; nan: not run",
        "units": "m, rad",
    }
    settings = {"tol": TOL, "end": END, "lost": LOST, "max_steps": MAX_STEPS, "spread": SPREAD, "solver": "Dopri8"}
    return described(data, mechanism, settings, SEED)


def failed(data: xarray.Dataset, variant: str) -> xarray.DataArray:
    """Return the fraction of runs that fail, of each group, by threshold; only thresholds that were run."""
    errors = data.error.sel(variant=variant).dropna("threshold", how="all")
    return np.isinf(errors).mean("member")


def worst(data: xarray.Dataset, variant: str) -> xarray.DataArray:
    """Return the largest error of the runs that do not fail, by threshold."""
    errors = data.error.sel(variant=variant).dropna("threshold", how="all")
    return errors.where(np.isfinite(errors)).max(["group", "member"])


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """The claim, part by part."""
    safe = data.sel(threshold=[x for x in THRESHOLDS if x in data.threshold])
    parts = {
        "Auto with projection fails on none": bool((failed(safe, "Auto, projection") == 0).all()),
        "its errors stay small": bool((worst(safe, "Auto, projection") < 1e-6).all()),
        "elimination alone fails on some": bool((failed(data, "Elimination, projection").mean("group") > 0).all()),
    }
    for name in (str(n) for n in data.variant.values if not str(n).endswith("projection")):
        parts[f"{name}: fails on most"] = bool((failed(data, name).mean("group") > 0.5).all())
    for name in ("SVD", *DENSE):
        if (name := f"{name}, projection") in data.variant:
            parts[f"{name}: fails on none"] = bool((failed(safe, name) == 0).all())
    return parts


def headline(data: xarray.Dataset) -> str:
    """Return the numbers of failures at a threshold of 1e-4 as text."""
    count = data.sizes["group"] * data.sizes["member"]

    def one(name: str) -> str:
        share = failed(data, name).mean("group").sel(threshold=THRESHOLDS[1])
        return f"{name} {round(float(share) * count)}"

    error = float(worst(data.sel(threshold=[THRESHOLDS[1]]), "Auto, projection").max())
    counts = "; ".join(one(str(name)) for name in data.variant.values)
    return f"failed runs of {count} at a threshold of 1e-4: {counts}. Largest error of Auto, projection: {error:.0e}"


def figure(data: xarray.Dataset) -> Figure:
    """Draw the share of runs that fail by every variant at every threshold, and the errors of those that are not."""
    figure, ((left, right),) = panels(1, 2, 12.5, 5.6, width_ratios=(1, 1.2))
    names = [str(name) for name in data.variant.values]
    share = np.full((len(names), data.sizes["threshold"]), np.nan)
    for row, name in enumerate(names):
        for part in failed(data, name).mean("group").transpose("threshold"):
            share[row, list(data.threshold.values).index(float(part.threshold))] = float(part)
    left.imshow(share, cmap="Oranges", vmin=0, vmax=1, aspect="auto")
    for (row, column), value in np.ndenumerate(share):
        text = "" if np.isnan(value) else f"{100 * value:.0f} %" if value == 0 or value > 0.01 else f"{100 * value:.1f} %"
        left.text(column, row, text, ha="center", va="center", fontsize="small", color="white" if value > 0.6 else "black")
    left.set_xticks(range(share.shape[1]), [f"{x:.0e}" for x in data.threshold.values])
    left.set_yticks(range(len(names)), names)
    left.set(xlabel="rank threshold", title="Runs that fail (empty: not run)")
    left.grid(False)
    for row, name in enumerate(names):
        errors = data.error.sel(variant=name).dropna("threshold", how="all")
        errors = errors.sel(threshold=THRESHOLDS[1])
        for number in range(data.sizes["group"]):
            values = errors[number].values[np.isfinite(errors[number].values)]
            spread = row + 0.18 * (number - 1.5) + np.linspace(-0.06, 0.06, max(len(values), 1))[: len(values)]
            label = str(data.group.values[number]) if row == 0 else None
            right.semilogx(values, spread, ".", ms=3, color=COLOURS[number], label=label)
    right.set(xlabel="largest error in 20 s (m, rad)", ylim=(len(names) - 0.5, -0.5), title="Runs that do not, at 1e-4")
    right.set_yticks(range(len(names)), [])
    right.legend(fontsize="small", frameon=False, title="start", markerscale=3, loc="lower center")
    return figure
