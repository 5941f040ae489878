"""Linkages as they are made: yields over tolerances, gaps between links and outlines from files, against other ways to find them.

A million four-bars whose lengths deviate turn in a process of its own, through 72 positions each. Ten linkages whose positions
have closed forms give mean and standard deviation of a pin's place by quadrature of these: no published analysis could be read
with its numbers, so closed forms stand in their place. Second-order terms of ten mechanisms, trusted by 20,000 samples,
are compared with 200,000 others; the deviations of the last are large. The cheapest tolerances for 99 % are confirmed by new
samples, and a path is passed by the nearest four-bar and by one that is robust.

Gaps of random linkages are compared with those of shapely at 20,000 positions, contacts with roots of shapely's gaps, gradients
with differences, and layers of ten drawings with enumeration. Profiles with holes are drawn in DXF files.

Claim: moments are those of closed forms and samples where they are trusted; yields are those of new samples; no gap between
samples is smaller than the proven one; contacts are exact to 1e-9 rad, slopes to 1e-8; layers are the fewest; outlines are
exact to 1e-12.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels, tracked
from experiments.parts.gap_linkages import (
    compare_with_shapely,
    contact_errors,
    fewest_layers,
    gradient_error,
    random_linkage,
    turning_bars,
)
from experiments.parts.made_tolerances import TURN, closed_forms, drawing
from experiments.parts.outline_profiles import profile
from udkjax.positions.following.drive import drive
from udkjax.show.plots import COLOURS

WANTED = 0.99  # yield
LENGTHS = {"length(crank)": "3 mm", "length(coupler)": "4 mm", "length(rocker)": "5 mm"}
SWING = "range(body.rocker.angle)"
LIMIT = {SWING: (1.1245, 1.1315)}  # rad, around the nominal 1.128
SECOND_ORDER = {  # drawings, what is measured, and deviations of all constructed lengths and pins
    "crank_rocker": ("range(body.rocker.angle)", "0.1 mm"),
    "jansen_leg": ("range(pin.F.x)", "0.5 mm"),
    "klann_leg": ("range(pin.G.x)", "0.05 mm"),
    "quick_return": ("range(pin.R.x)", "0.1 mm"),
    "six_bar": ("range(body.output.angle)", "0.05 mm"),
    "toggle_press": ("range(pin.R.y)", "0.1 mm"),
    "cam_follower": ("max(pin.Q.y)", "0.1 mm"),
}
TARGETS = np.column_stack([np.linspace(0.06, 0.02, 7), np.full(7, 0.12)])


def study(smoke: bool, linkages: int = 500, samples: int = 1_000_000, positions: int = 20_000) -> xarray.Dataset:
    """Compare yields, moments, gaps, contacts, slopes, layers and outlines with other ways to find them."""
    if smoke:
        linkages, samples, positions = 2, 20_000, 2_000
    few, rest = (2, 1) if smoke else (10, 20)
    code = "import json, sys; from experiments.made import *; print(json.dumps(million(int(sys.argv[1]))))"
    ran = subprocess.run([sys.executable, "-c", code, str(samples)], capture_output=True, text=True, check=True)
    speed = json.loads(ran.stdout.splitlines()[-1]) | gap_speed()
    closed = {name: moments(case, samples // 5) for name, case in list(closed_forms().items())[:few]}
    second = {name: second_order(*case, samples // 5) for name, case in list(mechanisms().items())[:few]}
    compared = np.array([compare_with_shapely(k, positions) for k in tracked(range(linkages), "random linkages")])
    contacts = [error for k in range(min(linkages, 3 * rest)) for error in contact_errors(k)]
    slopes = [gradient_error(k) for k in range(min(linkages, rest))]
    drawn = dict(list(layered().items())[:few])
    layers = [(udk.layers(mech).count, fewest_layers(mech, positions // 40)) for mech in tracked(drawn.values(), "drawings")]
    with tempfile.TemporaryDirectory() as folder:
        outlines = [outline_errors(k, Path(folder)) for k in range(rest)]
    yields = cheapest(samples // 5) | ({} if smoke else robust(samples // 10))
    data = xarray.Dataset(
        {
            "speed": ("figure", list(speed.values()), {"long_name": "of a million four-bars, and of gaps of 105 pairs"}),
            "closed": (("closed_form", "of"), list(closed.values()), {"long_name": "difference of moments, in deviations"}),
            "second": (("mechanism", "by"), list(second.values()), {"long_name": "difference from samples, in deviations"}),
            "yield": ("design", list(yields.values())),
            "gap": (("linkage", "what"), compared, {"long_name": "difference from shapely, relative to the size"}),
            "contact": ("touch", contacts or [0.0], {"units": "rad"}),
            "slope": ("gradient", slopes, {"long_name": "relative error"}),
            "layers": (("drawing", "way"), layers),
            "outline": (("profile", "property"), outlines, {"long_name": "relative error"}),
        },
        coords={
            "figure": list(speed), "closed_form": list(closed), "of": ["mean", "deviation", "deviation of samples"],
            "mechanism": list(second), "by": ["mean", "deviation", "trusted"], "design": list(yields), "drawing": list(drawn),
            "what": ["pairs", "below", "above", "overlaps"], "way": ["found", "enumerated"],
            "property": ["area", "centroid", "inertia"],
        },
    )  # fmt: skip
    return described(data, udk.library.four_bar(), {"samples": samples, "positions": positions, "lengths": list(LENGTHS)}, 0)


# --- tolerances


def million(samples: int) -> dict[str, float]:
    """Return yield, time and memory of so many four-bars at 72 positions each, once the program is compiled."""
    import resource

    def analysis(samples: int, seed: int = 0) -> udk.ToleranceAnalysis:
        given = {"drive": "body.crank.angle", "limits": LIMIT, "progress": False}
        return udk.tolerances(udk.library.four_bar(), LENGTHS, [SWING], samples=samples, seed=seed, **given)

    analysis(1000, 1)
    before, wall, cpu = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, time.perf_counter(), time.process_time())
    found = analysis(samples)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {
        "yield": found.yield_, "standard error": found.standard_error, "wall (s)": wall, "CPU (s)": cpu,
        "peak memory (MB)": peak, "more than for 1,000 (MB)": peak - before,
    }  # fmt: skip


def moments(case: Any, samples: int) -> tuple[float, float, float]:
    """Return the errors of mean and deviation by second-order terms and by samples, relative to the deviation."""
    start = float(drive(case.mechanism, case.drive).value(case.mechanism.q0))
    values, measures = start + np.linspace(0.0, TURN, 8), [case.measure]
    found = udk.tolerances(case.mechanism, case.tolerances(), measures, drive=case.drive, values=values, samples=samples)
    mean, deviation = case.moments()
    second = found.second_order
    return (
        (second.mean[case.measure] - mean) / deviation,
        second.standard_deviation[case.measure] / deviation - 1,
        found.standard_deviation[case.measure] / deviation - 1,
    )


def mechanisms() -> dict[str, tuple[udk.Mechanism, dict[str, Any], str, str]]:
    """Return ten mechanisms with tolerances, a measure and the drive."""
    found = {}
    for name, (measure, deviation) in SECOND_ORDER.items():
        mech = drawing(name)
        names = [x for x in mech.parameters() if x.startswith("pin.") and (x.endswith(".length") or x.count(".") == 1)]
        found[name] = (mech, dict.fromkeys(names, deviation), measure, mech.driver_names[0])
    four_bar, crank = udk.library.four_bar(), "body.crank.angle"
    found["slider-crank"] = (
        udk.library.slider_crank(), {"length(crank)": "1 mm", "length(rod)": "2 mm"}, "range(body.slider.x)", "motor"
    )  # fmt: skip
    found["four_bar"] = (four_bar, LENGTHS, SWING, crank)
    found["largest deviation"] = (four_bar, LENGTHS, "deviation(pin.C)", crank)
    return found


def second_order(mech: udk.Mechanism, tolerances: dict[str, Any], measure: str, driver: str, samples: int) -> tuple[float, ...]:
    """Return the differences of mean and deviation from those of other samples, in deviations, and whether they are trusted."""
    few = udk.tolerances(mech, tolerances, [measure], drive=driver, samples=20_000)
    many = udk.tolerances(mech, tolerances, [measure], drive=driver, samples=samples, seed=1)
    second, spread = few.second_order, many.standard_deviation[measure]
    off = (second.mean[measure] - many.mean[measure]) / spread, second.standard_deviation[measure] / spread - 1
    return *off, float(second.trusted[measure])


def cheapest(samples: int) -> dict[str, float]:
    """Return the yield of the cheapest tolerances as promised, and of other samples with these tolerances."""
    given = {"drive": "body.crank.angle", "limits": LIMIT}
    best = udk.tolerances(udk.library.four_bar(), LENGTHS, [SWING], samples=samples, **given).cheapest(WANTED)
    made = {name: udk.Tolerance(ends) for name, ends in best.deviations.items()}
    found = udk.tolerances(udk.library.four_bar(), made, [SWING], samples=samples, seed=7, **given)
    return {"cheapest, promised": best.yield_, "cheapest, made": found.yield_}


def robust(samples: int) -> dict[str, float]:
    """Return the yields of the four-bar nearest to seven targets, and of a robust one."""
    links = {"crank": "OA", "coupler": "ABP", "rocker": "CB"}
    drawn = udk.Drawing(
        pins={"O": (0, 0), "A": (30, 40), "B": (120, 90), "P": (60, 120), "C": (100, 0)},
        links={name: {"pins": list(pins), "mass": 1} for name, pins in links.items()},
        ground=["O", "C"],
        motors={"motor": {"pin": "O", "speed": "60 rpm"}},
        units={"length": "mm"},
    )
    path = udk.PathGoal("P", TARGETS, values=np.linspace(0, 1.2, 7), start="free")
    deviations = dict.fromkeys([*(f"length({name})" for name in links), "joint.C.points[0]"], "0.3 mm")
    goals = {"plain": [path], "robust": [path, udk.RobustGoal(path, deviations, sigmas=6, most=0.6e-3)]}
    lengths = {("O", "A"): (0.02, 0.1), ("O", "C"): (0.05, 0.2), ("A", "B"): (0.05, 0.2), ("C", "B"): (0.05, 0.2)}
    found = {}
    for name, goal in goals.items():
        best = udk.design(drawn, goal, lengths=lengths, starts=8)[0]
        error = {"error": udk.PathGoal("P", TARGETS, values=best.values)}
        given = {"values": best.values, "limits": {"error": 0.6e-3}, "samples": samples}
        found[name] = udk.tolerances(best.mechanism, deviations, error, **given).yield_
    return found


# --- gaps and outlines


def gap_speed() -> dict[str, float]:
    """Return the least CPU and wall time of all gaps of 105 pairs of bars over 720 positions of a run."""
    mech, pairs = turning_bars()
    run, times = udk.simulate(mech, np.linspace(0, 2 * np.pi, 720)), []
    for _ in range(6):
        begun = time.process_time(), time.perf_counter()
        udk.gaps(mech, run=run, pairs=pairs)
        times.append((1e3 * (time.process_time() - begun[0]), 1e3 * (time.perf_counter() - begun[1])))
    cpu, wall = np.min(times, axis=0)
    return {"gaps, CPU (ms)": float(cpu), "gaps, wall (ms)": float(wall)}


def layered() -> dict[str, udk.Mechanism]:
    """Return ten drawings whose links have outlines and turn."""
    wide = {"crank": ["O", "A"], "coupler": ["A", "B"], "rocker": ["B", "C"]}
    pins = {"O": [0, 0], "A": [0.03, 0.04], "B": [0.16, 0.11], "C": [0.18, 0]}
    motors = {"motor": {"pin": "O", "speed": 1.0}}

    def four_bar(width: float) -> udk.Mechanism:
        links = {name: udk.Link(ends, mass=1, width=width) for name, ends in wide.items()}
        return udk.Drawing(pins=pins, links=links, ground=["O", "C"], motors=motors).mechanism()

    drawn = {name: drawing(name) for name in SECOND_ORDER}
    return drawn | {"narrow four-bar": four_bar(0.01), "wide four-bar": four_bar(0.11), "random linkage": random_linkage(3)[0]}


def outline_errors(seed: int, folder: Path) -> tuple[float, float, float]:
    """Return the relative errors of area, centroid and inertia of a profile that is read from a file."""
    wanted = profile(seed)
    wanted.file.saveas(folder / "link.dxf")
    return wanted.errors(udk.read_outline(folder / "link.dxf"))


# --- claim


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Compare each part of the claim with the data."""
    trusted = data.second.sel(by="trusted") > 0
    off = np.abs(data.second.sel(by=["mean", "deviation"])).max("by")
    near = 3 / np.sqrt(json.loads(data.attrs["settings"])["samples"] / 10)  # of a standard deviation, by samples
    parts = {
        "second-order terms are those of closed forms": bool(np.abs(data.closed.sel(of=["mean", "deviation"])).max() < 0.01),
        "samples are those of closed forms": bool(np.abs(data.closed.sel(of="deviation of samples")).max() < 0.01 + near),
        "trusted moments are within 5 %": bool((off < 0.05 + near)[trusted].all()),
        "moments that are not are not trusted": bool(trusted[off < 0.04].all()) and not bool(trusted[off > 0.06].any()),
        "the cheapest tolerances have their yield": bool(np.abs(data["yield"][:2] - WANTED).max() < 0.003 + near),
        "no gap between samples is smaller": bool(data.gap.sel(what="below").max() < 1e-12),
        "contacts": bool(data.contact.max() < 1e-9),
        "slopes": bool(data.slope.max() < 1e-8),
        "layers are the fewest": bool((data.layers[:, 0] == data.layers[:, 1]).all()),
        "outlines are exact": bool(data.outline.max() < 1e-12),
    }
    if not data.attrs["smoke"]:
        of = data["yield"].sel(design=["plain", "robust"]).values
        parts["the robust design has a higher yield"] = bool(of[1] > of[0] and of[1] >= 0.985)
        parts["the standard error of the yield"] = bool(data.speed.sel(figure="standard error") < 5e-4)
    return parts


def headline(data: xarray.Dataset) -> str:
    """Return the claim in figures."""
    value = lambda name: float(data.speed.sel(figure=name))  # noqa: E731
    off = np.abs(data.second.sel(by=["mean", "deviation"])).max("by")
    trusted = data.second.sel(by="trusted") > 0
    yields = ", ".join(f"{name} {100 * x:.2f} %" for name, x in zip(data.design.values, data["yield"].values, strict=True))
    others, gap = float(off[~trusted].max()) if (~trusted).any() else 0.0, data.gap
    shown = ", ".join(map(str, data.layers[:, 0].values))
    return (
        f"{json.loads(data.attrs['settings'])['samples']} four-bars at 72 positions: yield {100 * value('yield'):.3f} ± "
        f"{100 * value('standard error'):.3f} % in {value('wall (s)'):.1f} s ({value('CPU (s)'):.1f} s CPU), peak memory "
        f"{value('peak memory (MB)'):.0f} MB; {data.sizes['closed_form']} closed forms: second order off by at most "
        f"{float(np.abs(data.closed[:, :2]).max()):.2g} deviations, samples {float(np.abs(data.closed[:, 2]).max()):.2g}; "
        f"second order of {data.sizes['mechanism']} mechanisms: {int(trusted.sum())} trusted, off by at most "
        f"{float(off[trusted].max()):.2g} deviations, others {others:.2g}; "
        f"yields: {yields}; 105 gaps at 720 positions: {value('gaps, CPU (ms)'):.0f} ms CPU; "
        f"{data.sizes['linkage']} random linkages, {int(gap.sel(what='pairs').sum())} pairs: smallest gap of shapely "
        f"{-float(gap.sel(what='below').max()):.1g} above the proven one, relative to the size; "
        f"{data.sizes['touch']} contacts: {float(data.contact.max()):.1g} rad; slopes {float(data.slope.max()):.1g}; "
        f"{data.sizes['drawing']} drawings: layers {shown}, as enumerated; {data.sizes['profile']} outlines off by at most "
        f"{float(data.outline.max()):.1g}"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw differences of moments, gaps and outlines."""
    fig, axes = panels(1, 3, 11.0, 3.6)
    first, middle, last = axes[0]
    first.barh(data.mechanism.values, 100 * np.abs(data.second.sel(by=["mean", "deviation"])).max("by"), color=COLOURS[0])
    first.axvline(5, color="0.5", lw=0.8)
    first.set(xscale="log", xlabel="second order against samples (%)")
    below = np.sort(-data.gap.sel(what="below"))
    middle.plot(below, (np.arange(len(below)) + 0.5) / len(below), color=COLOURS[0])
    middle.set(xscale="log", xlabel="sampled gap above the proven one / size", ylabel="share of linkages")
    for k, name in enumerate(data.property.values):
        last.plot(np.sort(data.outline[:, k]) + 1e-17, ".-", label=name, color=COLOURS[k])
    last.legend(fontsize=7)
    last.set(yscale="log", ylabel="relative error of outlines", xlabel="profile")
    return fig
