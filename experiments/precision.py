"""In float32 errors are larger by the ratio of the rounding units, 5e8; to cross singularities, float32 needs wider thresholds.

The same programs run in one process with `JAX_ENABLE_X64=0` and in one without. The errors of the orthogonal pseudoinverses
stay at eps cond. The default thresholds are proportional to eps, and so is the inverse of the condition number at which a
method loses the rank. A run of the paper's linkage, 20 s with projection, follows its tolerance until rounding takes over: each
of n steps adds about eps |y|, and a smaller tolerance takes more steps, which does not help; below a tolerance of about 10 eps,
steps shrink to zero.

From +60 degrees the linkage crosses singular configurations. If a direction with the singular value s is kept, accelerations
have an error of eps / s, with elimination and a pivot p an error of eps / p. If this error exceeds the tolerance, the
controller sees jumps that no step is small enough for. The rank threshold, and the pivot at which `Auto` switches to singular
values, therefore have to be above eps / tol. In float64 the defaults, 1e-4 and 1e-6, allow tolerances down to 2e-10; at smaller
tolerances, steps are placed around the configuration, and cost no more than with wider thresholds. In float32 the defaults
allow no tolerance at all: runs are lost or, if the tolerance is loose, end far from the solution. With 1e-2 and 1e-3, runs in
float32 cross.
"""

import os
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import HERE, described, panels, tracked
from experiments.parts.in_precision import END, OUTPUTS, STARTS, THRESHOLDS
from experiments.pinv_accuracy import LINEAR, collection
from udkjax.show.style import COLOURS

PRECISIONS = {"float64": "1", "float32": "0"}


def computed(precision: str, smoke: bool) -> dict[str, np.ndarray]:
    """Return the arrays that a process in this precision writes."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arrays.npz"
        command = [sys.executable, "-m", "experiments.parts.in_precision", str(file), *(["--smoke"] if smoke else [])]
        subprocess.run(command, check=True, cwd=HERE.parent, env=os.environ | {"JAX_ENABLE_X64": PRECISIONS[precision]})
        with np.load(file) as arrays:
            return dict(arrays)


def study(smoke: bool) -> xarray.Dataset:
    found = {precision: computed(precision, smoke) for precision in tracked(PRECISIONS, "precision")}
    first, every = found["float64"], lambda name: np.stack([arrays[name] for arrays in found.values()])
    matrices, dims = collection(), ("precision", "thresholds", "start", "tol")
    data = xarray.Dataset(
        {
            "eps": ("precision", every("eps")),
            "error": (("precision", "algorithm", "matrix"), every("error"), {"long_name": "relative error of the pseudoinverse"}),
            "rank": (("precision", "algorithm", "matrix"), every("rank")),
            "true_rank": ("matrix", [rank for _, _, rank, _ in matrices.values()]),
            "cond": ("matrix", [cond for *_, cond in matrices.values()]),
            "run": (dims, every("run"), {"long_name": "largest error of q", "units": "m, rad"}),
            "right_hand_sides": (dims, every("cost")),
            "code": (dims, every("code"), {"long_name": "udkjax.Result"}),
        },
        coords={"precision": list(found), "algorithm": [str(n) for n in first["names"]], "matrix": list(matrices)}
        | {"thresholds": list(THRESHOLDS), "start": list(STARTS), "tol": first["tol"]},
    )
    scene = udk.library.parallelogram(np.deg2rad(STARTS[0]))
    return described(data, scene, {"span": END, "outputs": OUTPUTS, "solver": "Dopri8", "method": "Auto"})


def constants(data: xarray.Dataset) -> xarray.DataArray:
    """Return the largest error / (eps cond) of each method, by precision, over the matrices whose rank it finds."""
    known = (data["rank"] == data.true_rank) & (data.eps * data.cond < 1e-2)
    return (data.error / (data.eps * data.cond)).where(known).max("matrix")


def best(data: xarray.Dataset) -> xarray.DataArray:
    """Return the least error of q of all tolerances, by precision, threshold and start; infinite if no run reaches the end."""
    return data.run.where(data.code == 0, np.inf).min("tol")


def holds(data: xarray.Dataset) -> dict[str, bool]:
    orthogonal = constants(data).sel(algorithm=[m for m in data.algorithm.values if m in LINEAR])
    single = data.sel(precision="float32")
    swings, crosses = STARTS
    parts = {
        "orthogonal pseudoinverses err by at most 10 eps cond in both precisions": bool((orthogonal < 10).all()),
        "float32 follows the tolerance down to 1e-5": bool(
            (single.run.sel(start=swings).where(single.tol > 0.9e-5, drop=True) < 10 * single.tol).all()
        ),
        "with the default thresholds float32 is lost or more than 0.1 rad off": bool(
            best(single).sel(start=crosses, thresholds="default") > 0.1
        ),
        "with 1e-2 and 1e-3 it does": bool(best(single).sel(start=crosses, thresholds="wide") < 3e-3),
    }
    if data.sizes["tol"] > 5:
        least = best(data).sel(start=swings, thresholds="default")
        ratio = float(least.sel(precision="float32") / least.sel(precision="float64")) / float(data.eps[1] / data.eps[0])
        cost = data.right_hand_sides.sel(precision="float64", start=crosses).isel(tol=-1)
        parts["at 1e-12 the default thresholds cost float64 no more than wide ones"] = bool(
            cost.sel(thresholds="default") < 1.2 * cost.sel(thresholds="wide")
        )
        parts["float64 reaches 1e-10 across singularities"] = bool(
            best(data).sel(precision="float64", start=crosses).max() < 1e-10
        )
        parts["what is reached is in the ratio of eps, or better"] = ratio < 1
    return parts


def headline(data: xarray.Dataset) -> str:
    least, worst = best(data).astype(float), constants(data).sel(algorithm="SVD")
    swings, crosses = STARTS
    f32, f64 = (least.sel(precision=p) for p in ("float32", "float64"))
    return (
        f"best error of q after 20 s in float32 and float64: {float(f32.sel(start=swings, thresholds='default')):.0e} and "
        f"{float(f64.sel(start=swings, thresholds='default')):.0e} without singularities; across them "
        f"{float(f32.sel(start=crosses, thresholds='default')):.0e} and "
        f"{float(f64.sel(start=crosses, thresholds='default')):.0e} with the default thresholds, "
        f"{float(f32.sel(start=crosses, thresholds='wide')):.0e} and {float(f64.sel(start=crosses, thresholds='wide')):.0e} "
        f"with wide ones; "
        f"SVD errs by at most {float(worst[1]):.1f} and {float(worst[0]):.1f} eps cond"
    )


def figure(data: xarray.Dataset) -> Figure:
    page, axes = panels(1, 3, 12.5, 4.4)
    left, middle, right = axes.ravel()
    for precision, marker in zip(data.precision.values, "o^"):
        one = data.sel(precision=precision)
        for number, method in enumerate(data.algorithm.values):
            look: dict = {"ls": "", "marker": marker, "ms": 3.5, "mfc": "none" if marker == "^" else None}
            label = str(method) if marker == "o" else None
            left.loglog(
                data.cond, np.clip(one.error.sel(algorithm=method), 1e-17, 10), color=COLOURS[number], label=label, **look
            )
        cond = np.array([1.0, 1e16])
        left.loglog(cond, float(one.eps) * cond, "k--", lw=0.8)
        for number, (start, thresholds) in enumerate(product(data.start.values, data.thresholds.values)):
            look = {"color": COLOURS[number], "ls": "-" if marker == "o" else "--", "marker": marker, "ms": 4}
            run = one.sel(start=start, thresholds=thresholds)
            reached = run.code == 0
            if reached.any():
                label = f"{start:+.0f}°, {thresholds} thresholds, {precision}"
                middle.loglog(data.tol.where(reached), run.run.where(reached), label=label, **look)
                right.loglog(run.right_hand_sides.where(reached), run.run.where(reached), **look)
    left.set(xlabel="cond(A)", ylabel="relative error of $A^+$", ylim=(1e-17, 30), title="filled: float64, open: float32")
    left.legend(fontsize=7)
    middle.set(xlabel="rtol = atol", ylabel="error of q after 20 s (m, rad)")
    middle.legend(fontsize=7)
    right.set(xlabel="right-hand sides", ylabel="error of q after 20 s (m, rad)")
    return page
