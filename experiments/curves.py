"""Linkages found without any data draw letters and classic curves, by growth from random ones and exact derivatives.

Each curve is given to `udk.mechanisms_for` with its defaults, but for the number of rounds, with which results do not depend on
the machine: one round, for classic curves two, of which the second begins with geared cranks. By default, a search has 60 s of
CPU time, for about five rounds; `--set rounds=5` repeats the study with as many. An interrupted study continues.

The error is the Chamfer distance in RMS radii: of 2,000 points of each curve at equal arc lengths, the mean distances from the
other curve, added. Every mechanism is followed over 720 positions by `udk.kinematics`. The plain way, for comparison, improves up
to 300 random linkages of 12 bars one after another by BFGS, moved onto the curve, with the same derivatives and CPU time. Random
linkages, whose curves are searched, have 4, 7 or 10 joints; these searches end with an error below 0.005, or after three rounds.
Some letters are searched again with slides in a third of all dyads, in as many rounds.

Claim: the mean error of 26 letters is below 0.02, and every linkage turns fully, with loops closed to 1e-12, within its limits.
Errors of BFGS are larger on average. Nine of ten curves that come from a random linkage are met to 0.005.
"""

import shutil

import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import HERE, described, panels, tracked
from experiments.parts.curve_runs import BARS, SEGMENTS, TIMES, Result, by_bfgs, search, stored
from experiments.parts.curve_sets import LETTERS, classic_curves, curves_of_mechanisms, letter
from udkjax.show.plots import COLOURS
from udkjax.synthesis.curves.linkage_drawing import CLOSED_TO
from udkjax.synthesis.curves.mechanisms_for import DEFAULT_TRANSMISSION

SEEDED = "KRAEX"  # letters that are searched with several seeds
MET, MEAN, SHARE = 0.005, 0.02, 0.9
KEPT = HERE / "data" / ".curves"  # results of an interrupted study
SAME_PATH = 0.01  # largest distance of the followed pin from the returned curve, in extents: half the distance of its points


def study(
    smoke: bool, rounds: int = 1, classics: int = 10, plain: int = 26, seeds: int = 5, linkages: int = 100
) -> xarray.Dataset:
    """Errors of letters and classic curves, of `plain` letters by BFGS, of some with seeds, and of curves of random linkages."""
    letters, seeded, folder = ("L", "L", None) if smoke else (LETTERS, SEEDED, KEPT / str(rounds))
    classics, seeds, linkages = (0, 2, 1) if smoke else (classics, seeds, linkages)
    curves = {name: letter(name) for name in letters} | dict(list(classic_curves().items())[:classics])
    found: dict[str, Result] = {}
    for name, curve in tracked(curves.items(), "curves"):
        each = rounds + (name not in letters)
        found[name] = stored(folder, name, lambda curve=curve, each=each: search(curve, each))
    tried = [*seeded, *(name for name in letters if name not in seeded)][:plain]
    bfgs = {
        name: stored(folder, f"bfgs {name}", lambda name=name: by_bfgs(letter(name), found[name]["seconds"], BARS[-1], 0))
        for name in tracked(tried, "BFGS")
    }
    runs = [(name, seed, False) for name in seeded for seed in range(1, seeds)] + [(name, 0, True) for name in seeded]
    other = {
        run: stored(
            folder, " ".join(map(str, run)), lambda run=run: search(letter(run[0]), rounds, run[1], slides=run[2], results=3)
        )
        for run in tracked(runs, "seeds")
    }
    of_linkages = curves_of_mechanisms(linkages, np.random.default_rng(1))
    random = [
        stored(folder, f"linkage {k}", lambda curve=curve: search(curve, rounds + 2, error=MET, results=1))
        for k, curve in enumerate(tracked(of_linkages, "random linkages"))
    ]
    every = [*found.values(), *other.values(), *random]
    long_name = "Chamfer distance in RMS radii"
    reports, links = np.full((len(curves), TIMES, 2), np.nan), np.full((len(curves), SEGMENTS, 2, 2), np.nan)
    for k, one in enumerate(found.values()):
        reports[k, : len(one["reports"])] = one["reports"]
        links[k, : len(one["links"])] = one["links"]
    by_seed = [[other.get((name, seed, False), found[name])["error"][-1] for seed in range(seeds)] for name in seeded]
    sliding = [other[name, 0, True]["error"][-1] for name in seeded]
    data = xarray.Dataset(
        {
            "error": (
                ("curve", "bars"),
                [one["error"] for one in found.values()],
                {"long_name": f"{long_name}, least with so many bars"},
            ),
            "bars_used": ("curve", [one["bars"] for one in found.values()]),
            "seconds": ("curve", [one["seconds"] for one in found.values()], {"units": "s", "long_name": "CPU time"}),
            "path": (("curve", "point", "axis"), np.array([one["path"] for one in found.values()], "f4"), {"units": "m"}),
            "link": (("curve", "segment", "end", "axis"), links.astype("f4"), {"units": "m"}),
            "time": (("curve", "report"), reports[:, :, 0].astype("f4"), {"units": "s", "long_name": "CPU time"}),
            "over_time": (("curve", "report"), reports[:, :, 1].astype("f4"), {"long_name": long_name}),
            "seeds": (("letter", "seed"), by_seed, {"long_name": long_name}),
            "slides": ("letter", sliding, {"long_name": f"{long_name}, with slides in a third of all dyads"}),
            "bfgs": ("plain", [one["error"] for one in bfgs.values()], {"long_name": f"{long_name}, by BFGS in equal CPU time"}),
            "random": (
                "linkage",
                [one["error"][-1] for one in random],
                {"long_name": f"{long_name}, of random linkages' curves"},
            ),
            "random_seconds": ("linkage", [one["seconds"] for one in random], {"units": "s", "long_name": "CPU time"}),
            "following": ("result", [one["following"] for one in every], {"units": "s", "long_name": "CPU time of kinematics"}),
            "turned": (
                "result",
                [int(one["turned"]) for one in every],
                {"long_name": "whether the mechanism returns after a turn"},
            ),
            "open": ("result", [one["open"] for one in every], {"long_name": "largest gap of a loop, relative to coordinates"}),
            "size": ("result", [one["size"] for one in every], {"long_name": "largest distance of a pin, relative to its limit"}),
            "off": (
                "result",
                [one["off"] for one in every],
                {"long_name": "distance of the followed pin from the returned curve, in extents"},
            ),
        },
        coords={"curve": list(curves), "bars": list(BARS), "letter": list(seeded), "plain": tried},
    )
    if not smoke:
        shutil.rmtree(KEPT, ignore_errors=True)
    return described(data, "linkages of a crank and dyads", {"rounds": rounds, "transmission": DEFAULT_TRANSMISSION}, 0)


def _letters(data: xarray.Dataset) -> xarray.Dataset:
    return data.sel(curve=[name for name in data.curve.values if len(name) == 1])


def _ratio(data: xarray.Dataset) -> np.ndarray:
    """Return the errors of BFGS relative to those of the search."""
    return data.bfgs.values / data.error.isel(bars=-1).sel(curve=data.plain.values).values


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Compare each part of the claim with the data; a small run only begins to search."""
    error, is_small = _letters(data).error.isel(bars=-1), bool(data.attrs["smoke"])
    parts = {
        "letters are drawn": bool(error.mean() < (10 if is_small else 1) * MEAN),
        "every linkage turns": bool(data.turned.all()),
        "loops are closed": bool(data.open.max() <= CLOSED_TO),
        "pins stay within the size": bool(data["size"].max() <= 1.0),
        "no branch changes": bool(data.off.max() <= SAME_PATH),
    }
    if not is_small:
        parts["better than BFGS on average"] = bool(_ratio(data).mean() > 1.0)
        parts["curves of linkages are met"] = bool((data.random < MET).mean() >= SHARE)
    return parts


def headline(data: xarray.Dataset) -> str:
    """Return the claim in figures."""
    letters = _letters(data)
    others = data.error.isel(bars=-1).drop_sel(curve=letters.curve.values)
    error = letters.error.isel(bars=-1)
    ratio = _ratio(data)
    missed = ", ".join(
        f"{name} {float(others.sel(curve=name)):.4f}" for name in others.curve.values if others.sel(curve=name) >= MET
    )
    classics = f"{int((others < MET).sum())} of {others.size} classic curves below {MET}{f' ({missed})' if missed else ''}"
    apart = float((data.seeds.max("seed") / data.seeds.min("seed")).max())
    sliding = float(np.exp(np.log(data.slides / data.seeds.isel(seed=0)).mean()))
    met, middle, names = float((data.random < MET).mean()), np.median(ratio), ", ".join(data.letter.values)
    return (
        f"{error.size} letters: mean {float(error.mean()):.4f}, median {float(error.median()):.4f}, "
        f"largest {float(error.max()):.4f}, on average {float(letters.seconds.mean()):.0f} s of CPU time and "
        f"{float(letters.bars_used.mean()):.1f} bars; {classics}; {met:.0%} of {data.sizes['linkage']} curves of random linkages "
        f"below {MET}, in {float(data.random_seconds.mean()):.1f} s each; "
        f"errors of {ratio.size} letters by BFGS larger by factors of {ratio.min():.2g} to {ratio.max():.2g}, "
        f"{middle:.2g} in the middle; errors of {names} with {data.sizes['seed']} seeds apart by factors of up to {apart:.2g}, "
        f"and {sliding:.2g} times as large with slides (geometric mean); "
        f"every mechanism is followed over a turn, in at most {1e3 * float(data.following.max()):.0f} ms"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw all curves with their linkages, and the errors over time, number of bars and curves of random linkages."""
    fig, axes = panels(5, 9, 11.0, 8.0)
    for ax, name in zip(axes[:4].ravel(), [*data.curve.values, *[""] * 36], strict=False):
        ax.grid(visible=False)
        ax.set_axis_off()
        if name:
            one = data.sel(curve=name)
            ax.plot(*np.moveaxis(one.link.values, 0, -1).reshape(2, 2, -1).transpose(1, 0, 2), color="0.75", lw=0.8)
            ax.plot(*one.path.values.T, color=COLOURS[0], lw=2)
            low, high = one.path.min("point").values, one.path.max("point").values
            middle, half = (low + high) / 2, 0.8 * np.max(high - low)
            ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
            ax.set_title(f"{float(one.error.min()):.4f}", fontsize=7, pad=1)
    grid = axes[4, 0].get_gridspec()
    for ax in axes[4]:
        ax.remove()
    over_time, bars, linkages = (fig.add_subplot(grid[4, k : k + 3]) for k in (0, 3, 6))
    letters = _letters(data)
    for k, name in enumerate(data.letter.values):
        one = data.sel(curve=name)
        over_time.plot(one.time, one.over_time, ".-", color=COLOURS[k % len(COLOURS)], label=str(name))
    over_time.legend(fontsize=7)
    over_time.set(xlabel="CPU time (s)", ylabel="error", yscale="log")
    bars.plot(data.bars, letters.error.T, color="0.8", lw=0.7)
    bars.plot(data.bars, letters.error.median("curve"), color=COLOURS[0], label="search")
    bars.axhline(float(data.bfgs.median()), color=COLOURS[1], ls="--", label="BFGS, 12 bars")
    bars.legend(fontsize=7)
    bars.set(xlabel="bars", yscale="log")
    linkages.plot(np.sort(data.random), np.arange(1, data.sizes["linkage"] + 1) / data.sizes["linkage"], ".-", color=COLOURS[0])
    linkages.axvline(MET, color="0.5", lw=0.8)
    linkages.set(xlabel="error of curves of random linkages", ylabel="share", xscale="log", ylim=(0, 1.05))
    return fig
