"""Gains can be tuned by gradient if steps are equal; with adaptive steps, any gains of a few per second do as well.

The function to minimize is the mean square of Psi at the ends of the steps of a run, in terms of the logarithms of alpha and
beta. Runs with adaptive steps are not suitable: their violation jumps from one pair of gains to the next, and its derivative is
taken with the step sizes held constant, which ignores the effect of the gains on the steps. From 2 to 20 /s the drift falls or
stays the same, as steps become shorter; with the steps held, it seems to grow as the third power of the gains, or the sixth
power of large gains. Runs therefore take as many equal steps of Dopri8 as the tolerance requires with gains of 5. This bounds
the cost: the number of right-hand sides is given, and gains too large for the step, with alpha h or beta h of the order of one,
show as drift. The function is smooth, and a sum of squares, which `minimize_squares` of udkjax.study.identify minimizes.

From a closed start at rest, the parallelogram's motion does not excite the unstable drift of the redundant constraints. The
smallest gains would then do for 4 s of motion, but not for long: by theory (see gains.py) drift grows with them. Starts are
therefore open by a hundredth of the tolerance, which is about the violation that adaptive steps leave.

At outputs between the steps, interpolation has larger errors than the drift. The drift of runs with adaptive steps is therefore
measured at the ends of four runs of different lengths.

Claim, for two linkages and tolerances of 1e-6 to 1e-10: four guesses lead to the same gains, between 0.5 and 10 /s, in about
ten gradients each, of which one takes as long as three runs. With equal steps, the tuned gains drift less than any equal gains
of a grid of nine, but not by a factor of two; with the steps of another tolerance, they drift at most 1.3 times as much as
gains tuned for these steps. With adaptive steps, they take no more right-hand sides than gains of 5, and drift up to five times
as much as the best (which is also the luckiest) gains of the grid that take no more, and seldom less; which gains are best
changes whenever the ends of the steps change. Equal steps differ from adaptive ones: the four-bar, whose steps differ in size,
drifts a hundred times less with adaptive steps.
"""

from typing import Any

import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import described, panels, tracked
from experiments.gains import exponent
from experiments.parts.linkage import parallelogram
from experiments.parts.tuning import (
    ABSOLUTE_RANK_TOL,
    DEGREES,
    ENDS,
    GUESSES,
    OPEN,
    REFERENCE,
    SCENES,
    SEED,
    SETTLED,
    SPAN,
    Drift,
    by_tolerance,
    length,
    scene,
)
from udkjax.show.style import COLOURS

TOLERANCES = (1e-6, 1e-8, 1e-10)
# alpha = beta, 1/s: those of gains.py around the tuned ones. The first takes fewer right-hand sides than these: without it
# nothing in the grid would be as cheap, and nothing compared.
GRID = (1.0, 1.5, 2.0, 2.5, 3.0, 5.0, 7.0, 10.0, 20.0)
MORE = 1.02  # times the right-hand sides: not more, but for a step or two
SCAN = 2.0, 20.0  # alpha = beta, 1/s: neighbours 5 % apart
MAP = np.geomspace(0.7, 14.0, 14), np.geomspace(1.0, 20.0, 14)  # alpha, beta, 1/s


def study(smoke: bool) -> xarray.Dataset:
    """Steps that tolerances ask for; gains tuned on as many equal ones; adaptive runs with them and with those of the grid."""
    names, tolerances, grid = (SCENES[:1], TOLERANCES[:1], GRID[::3]) if smoke else (SCENES, TOLERANCES, GRID)
    alphas, betas = (x[:: 4 if smoke else 1] for x in MAP)
    return described(
        xarray.concat(
            [of_scene(name, tolerances, grid, alphas, betas) for name in tracked(names, "tune_gains")],
            "scene",
            coords="different",
            compat="equals",
        ),
        parallelogram(),
        {
            "start": DEGREES,
            "open": OPEN,
            "span": SPAN,
            "ends": ENDS,
            "guesses": GUESSES,
            "settled": SETTLED,
            "rank_tol": ABSOLUTE_RANK_TOL,
        }
        | {"solver": "Dopri8", "method": "SVD", "four-bar": "udk.library.four_bar()"},
        SEED,
    )


def of_scene(name: str, tolerances: Any, grid: Any, alphas: Any, betas: Any) -> xarray.Dataset:
    """All of one scene."""
    one, equal = scene(name), np.repeat(np.asarray(grid)[:, None], 2, axis=1)
    many = len(grid) + len(tolerances)  # as many pairs at all times, so that one compiled program serves all runs
    known = [by_tolerance(one, np.repeat([REFERENCE], many, axis=0), tol) for tol in tolerances]
    asked = [run["steps"][0] for run in known]
    losses = [Drift(one, int(steps), OPEN * tol) for steps, tol in zip(asked, tolerances, strict=True)]
    fits = [loss.tuned() for loss in losses]
    evaluations = [loss.calls / len(GUESSES) for loss in losses]
    closed = Drift(one, int(asked[0]), 0.0).tuned()
    best, unheld = (np.exp([min(each, key=lambda fit: fit.cost).z for each in found]) for found in (fits, [closed]))
    gains = np.concatenate([equal, best])
    runs = [by_tolerance(one, gains, tol) for tol in tolerances]
    scan = np.log(np.geomspace(*SCAN, many * len(ENDS)))
    psi, slope, _ = one.adaptive(np.stack([scan, scan], 1), losses[0].state, np.full(len(scan), SPAN), tolerances[0])
    scans = dict(zip(("controlled", "equal"), (length(psi, slope), losses[0].last(np.stack([scan, scan], 1))), strict=True))
    places = np.stack(np.meshgrid(np.log(alphas), np.log(betas), indexing="ij"), -1)
    lands = losses[0](places.reshape(-1, 2)).reshape(places.shape[:2])
    rates = lambda pairs: [exponent(DEGREES, *pair) if name == SCENES[0] else np.nan for pair in pairs]  # noqa: E731
    return xarray.Dataset(
        {key: (("tol", "gains"), np.array([run[key] for run in runs])) for key in runs[0]}
        | {f"scan_{key}": ("scanned", value) for key, (value, _) in scans.items()}
        | {f"slope_{key}": ("scanned", value) for key, (_, value) in scans.items()}
        | {
            "asked": ("tol", np.asarray(asked), {"long_name": "steps that the tolerance asks for, with the reference's gains"}),
            "asked_right_hand_sides": ("tol", [run["right_hand_sides"][0] for run in known]),
            "tuned": (("tol", "guess", "of"), np.exp([[fit.z for fit in each] for each in fits]), {"units": "1/s"}),
            "tuned_drift": (
                ("tol", "guess"),
                [[d.unit * np.sqrt(2 * fit.cost) for fit in f] for f, d in zip(fits, losses, strict=True)],
            ),
            "evaluations": ("tol", evaluations, {"long_name": "per guess"}),
            "equal_drift": (("tol", "gains"), np.array([loss(np.log(gains)) for loss in losses])),
            "from_closed": ("of", unheld[0], {"units": "1/s", "long_name": "tuned from a closed start, at the first tolerance"}),
            "exponent": ("tol", rates(best), {"long_name": "growth rate of the drift, by theory", "units": "1/s"}),
            "exponent_from_closed": ((), rates(unheld)[0], {"units": "1/s"}),
            "landscape": (("map_alpha", "map_beta"), lands, {"long_name": "drift by equal steps, at the first tolerance"}),
            "alpha": ("gains", gains[:, 0], {"units": "1/s"}),
            "beta": ("gains", gains[:, 1], {"units": "1/s"}),
        },
        coords={
            "tol": list(tolerances),
            "tuned_at": ("gains", [0.0] * len(grid) + list(tolerances), {"long_name": "tolerance; 0: of the grid"}),
            "scanned": np.exp(scan),
            "map_alpha": alphas,
            "map_beta": betas,
            "of": ["alpha", "beta"],
        },
    ).assign_coords(scene=name)


def own(data: xarray.Dataset, name: str) -> xarray.DataArray:
    """Return what belongs to the gains tuned at a tolerance, at that tolerance (scene, tol)."""
    tuned = [int(np.argmax((data.tuned_at == tol).values)) for tol in data.tol]
    return data[name].isel(gains=xarray.DataArray(tuned, dims="tol"), tol=xarray.DataArray(range(len(tuned)), dims="tol"))


def advantage(data: xarray.Dataset) -> xarray.DataArray:
    """Drift by equal steps of the best equal gains, over that of the tuned ones (scene, tol)."""
    return data.equal_drift.where(data.tuned_at == 0).min("gains") / own(data, "equal_drift")


def elsewhere(data: xarray.Dataset) -> xarray.DataArray:
    """Drift by equal steps of gains tuned at any tolerance, over that of those tuned at the tolerance itself."""
    return data.equal_drift.where(data.tuned_at > 0) / own(data, "equal_drift")


def controlled(data: xarray.Dataset) -> xarray.DataArray:
    """Drift of runs at a tolerance with the tuned gains, over that of the best of the grid that takes no more (scene, tol)."""
    affordable = (data.tuned_at == 0) & (data.right_hand_sides <= MORE * own(data, "right_hand_sides"))
    return own(data, "drift") / data.drift.where(affordable).min("gains")


def price(data: xarray.Dataset) -> xarray.DataArray:
    """Right-hand sides of runs at a tolerance with the tuned gains, over those with the reference's (scene, tol)."""
    return own(data, "right_hand_sides") / data.asked_right_hand_sides


def misfit(data: xarray.Dataset, key: str) -> np.ndarray:
    """Return the errors of derivatives relative to changes of drift between neighbouring gains: medians (scene,)."""
    step = np.diff(np.log(data.scanned))
    changes = np.diff(np.log(data[f"scan_{key}"].values), axis=1)
    slopes = data[f"slope_{key}"].values
    wrong = np.abs(changes - step * (slopes[:, 1:] + slopes[:, :-1]) / 2)
    return np.median(wrong, axis=1) / np.median(np.abs(changes), axis=1)


def slopes(data: xarray.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """The exponent of the gain in the drift of runs at a tolerance over the scan: as it is, and with the steps held (scene,)."""
    found = np.polyfit(np.log(data.scanned), np.log(data.scan_controlled.values).T, 1)[0]
    return found, data.slope_controlled.mean("scanned").values


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """The claim, part by part."""
    spread = data.tuned.max("guess") / data.tuned.min("guess")
    true, held = slopes(data)
    redundant = np.isfinite(data.exponent_from_closed)
    return {
        "all guesses come to the same gains": bool((spread < 1.02).all()),
        "these are between 0.5 and 10 per second": bool((data.tuned > 0.5).all() and (data.tuned < 10).all()),
        "by equal steps no equal gains drift less": bool((advantage(data) >= 1).all()),
        "but less than twice as much": bool((advantage(data) < 2).all()),
        "gains of another tolerance drift 1.3 times as much at most": bool(elsewhere(data).max() < 1.3),
        "at a tolerance they take no more than gains of 5": bool((price(data) < MORE).all()),
        "where they drift a fifth to five times as much as the grid": bool((np.abs(np.log(controlled(data))) < np.log(5)).all()),
        "and not always less": bool((controlled(data) > 1).any()),
        "by equal steps derivatives tell the next gain's drift": bool((misfit(data, "equal") < 0.05).all()),
        "at a tolerance they do not": bool((misfit(data, "controlled") > 0.5).all()),
        "nor the trend": bool((held - true > 2).all()),
        "tuned from a closed start, they let drift grow": bool((data.exponent_from_closed.where(redundant, 1.0) > 0).all()),
        "tuned from an open one, they do not": bool((data.exponent.where(redundant, -1.0) < 0).all()),
    }


def headline(data: xarray.Dataset) -> str:
    """The gains, and what they are worth."""
    gains = "; ".join(
        f"{name}: " + ", ".join(f"{a:.1f} and {b:.1f}" for a, b in data.tuned.sel(scene=name).isel(guess=1).values)
        for name in data.scene.values
    )
    three = 1 / advantage(data), controlled(data), price(data)
    best, run, cost = (f"{float(x.min()):.2f} to {float(x.max()):.2f}" for x in three)
    true, held = slopes(data)
    tolerances, first = ", ".join(f"{tol:.0e}" for tol in data.tol.values), data.scene.values[0]
    few, many = float(data.evaluations.min()), float(data.evaluations.max())
    return (
        f"alpha and beta for {tolerances}, {gains}; in {few:.0f} to {many:.0f} gradients; drift relative to the best equal "
        f"gains: {best} with equal steps, {run} with adaptive steps; right-hand sides relative to gains of 5: {cost}; drift of "
        f"the {first} scales as the gain to the power of {true[0]:.1f}, by derivatives with held steps {held[0]:.1f}"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw drift by equal steps over both gains, along a scan, and against cost at a tolerance."""
    scenes = list(data.scene.values)
    figure, axes = panels(len(scenes), 3, 13.0, 3.9 * len(scenes))
    tol = float(data.tol[0])
    for (left, middle, right), name in zip(axes, scenes, strict=True):
        of = data.sel(scene=name)
        levels = np.log10(of.landscape.values.T)
        low = np.nanmin(levels)
        drawn = left.contourf(
            of.map_alpha, of.map_beta, np.minimum(levels, low + 3), np.linspace(low, low + 3, 25), cmap="viridis"
        )
        bar = figure.colorbar(drawn, ax=left, ticks=np.arange(np.ceil(low), low + 3))
        bar.set_label("log10 drift (m, rad)")
        inside = (of.map_alpha.values[[0, -1]], of.map_beta.values[[0, -1]])
        diagonal = np.array([max(x[0] for x in inside), min(x[1] for x in inside)])
        left.loglog(diagonal, diagonal, color="white", lw=0.8, ls=":")
        left.plot(*np.array(GUESSES).T, "o", mfc="none", color="white", ms=6)
        left.plot(*of.tuned.isel(tol=0, guess=1).values, "*", color="white", ms=11)
        left.set(xlabel="alpha (1/s)", ylabel="beta (1/s)", title=f"{name}: {int(of.asked[0])} equal steps; o guesses, * tuned")
        for number, (key, label) in enumerate((("controlled", f"TOL {tol:.0e}"), ("equal", "equal steps"))):
            middle.loglog(of.scanned, of[f"scan_{key}"], ".-", color=COLOURS[number], lw=1, label=label)
            for k in range(0, of.sizes["scanned"], 4):  # derivatives
                x, y, slope = (float(of[v][k]) for v in ("scanned", f"scan_{key}", f"slope_{key}"))
                beside = x * np.array([0.94, 1.06])
                middle.plot(beside, y * (beside / x) ** slope, color="black", lw=1.4, zorder=3)
        middle.set_xticks([2, 3, 5, 10, 20], ["2", "3", "5", "10", "20"])
        middle.minorticks_off()
        middle.set(
            xlabel="gain alpha = beta (1/s)", ylabel=f"drift at {SPAN:g} s (m, rad)", title="Black: derivatives, steps held"
        )
        middle.legend(fontsize="small", frameon=False)
        for number, each in enumerate(of.tol.values):
            runs = of.sel(tol=each)
            grid, tuned = (runs.isel(gains=np.flatnonzero(chosen)) for chosen in (of.tuned_at == 0, of.tuned_at > 0))
            colour = COLOURS[number]
            right.loglog(grid.right_hand_sides, grid.drift, ".-", color=colour, lw=1, label=f"equal, TOL {each:.0e}")
            here = tuned.tuned_at.values == each
            right.plot(tuned.right_hand_sides[here], tuned.drift[here], "*", color=colour, ms=11, mec="black")
            right.plot(tuned.right_hand_sides[~here], tuned.drift[~here], "x", color=colour, ms=6)
        right.set(
            xlabel="right-hand sides",
            ylabel="drift where runs end (m, rad)",
            title="* tuned for this TOL, x for another",
        )
        right.legend(fontsize="small", frameon=False)
    return figure
