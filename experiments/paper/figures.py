"""The pictures of the report, each drawn from its dataset (record.py) and from nothing else."""

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.scene import loads
from udkjax.show.plots import draw_motion
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import exact_coordinates

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

WIDTH = 9.2  # inches, of the page's column
LEAST_PSI2 = 1e-36  # m2: below the square of any rounding error; drawn in place of zero, which has no logarithm
LEAST_ERROR = 1e-16  # rad
LEAST_ENERGY = 1e-17  # J
LEAST_SIGMA = 1e-18  # kg^(-1/2)
MARKERS = "os^Dvph"
GHOSTS = 4


def methods(data) -> list[str]:
    """Return the paper's methods in its order."""
    return list(dict.fromkeys(data.method.values[data.group.values == "paper"]))


def tolerances(data) -> list[float]:
    """Return the tolerances of the paper's runs, in its order."""
    return list(dict.fromkeys(data.tol.values[data.group.values == "paper"]))


def runs(data, group: str, **wanted):
    """Yield the runs of a group, as datasets of one run each, whose variables have the values `wanted`."""
    chosen = data.group.values == group
    for name, value in wanted.items():
        chosen = chosen & (data[name].values == value)
    for place in np.flatnonzero(chosen):
        yield data.isel(run=int(place))


def linkage(data) -> Figure:
    """Draw the mechanism at its start, and in later poses of the exact motion."""
    mech = loads(data.attrs["scene"])
    ts = np.linspace(0.0, float(data.attrs["law_period"]) / 2, 41)
    figure = Figure(figsize=(WIDTH * 0.6, 2.3), layout="constrained")
    axes = figure.subplots()
    q = exact_coordinates(mech, ts, mech.q0, mech.v0)
    if q is not None:
        draw_motion(axes, mech, q, GHOSTS)
    return figure


def figure_2(data) -> Figure:
    """Draw violation over time without and with Baumgarte's terms, the paper's figure 2, and next to it the error."""
    rows = tolerances(data)
    figure = Figure(figsize=(WIDTH, 1.1 + 2.1 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), 3, sharex="col", squeeze=False)
    for line, tol in zip(panels, rows, strict=True):
        without, gains, error = line
        for axes, stabilized in ((without, False), (gains, True)):
            for run in _paper(data, tol, stabilized):
                _log(axes, run, "psi2", LEAST_PSI2, _colour(data, run))
            _threshold(axes, tol**2)
            axes.set_ylim(1e-34, 1e-1)
            axes.set_ylabel("Σψ² (m²)" if axes is without else "")
        for stabilized, style in ((False, "-"), (True, ":")):
            for run in _paper(data, tol, stabilized):
                _log(error, run, "angle_error", LEAST_ERROR, _colour(data, run), style)
        _threshold(error, float(data.attrs["setting_lost"]))
        error.set_ylim(1e-15, 10)
        error.set_ylabel("error of the angles (rad)")
        without.text(0.04, 0.88, _named(tol), transform=without.transAxes)
    alpha, beta = data.attrs["setting_alpha"], data.attrs["setting_beta"]
    titles = ("without stabilization", f"Baumgarte, {alpha:g} and {beta:g}", "error (dotted: Baumgarte)")
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(title, fontsize="medium")
    _finish(figure, panels, data)
    return figure


def singular_values(data) -> Figure:
    """Draw the two least singular values of D against the threshold, and the rank that each method found."""
    columns = tolerances(data)
    figure = Figure(figsize=(WIDTH, 4.8), layout="constrained")
    panels = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False, height_ratios=(3, 1))
    for tol, (values, rank) in zip(columns, panels.T, strict=True):
        for place, run in enumerate(_paper(data, tol, False)):
            _log(values, run, "sigma_12", LEAST_SIGMA, _colour(data, run))
            values.semilogy(run.time, run.sigma_11, color="0.6", lw=0.8)
            rank.step(run.time, run["rank"] + 0.06 * (2 - place), where="post", color=_colour(data, run), lw=1.2)
        _threshold(values, tol)
        values.set_title(_named(tol), fontsize="medium")
        values.set_ylim(LEAST_SIGMA, 10)
        rank.set_yticks([10, 11, 12])
        rank.set_ylim(9.5, 12.5)
        rank.set_xlim(0, float(data.t_end.max()))
    panels[0, 0].set_ylabel("σ₁₁ (grey) and σ₁₂ (kg⁻½)")
    panels[1, 0].set_ylabel("rank")
    _finish(figure, panels, data)
    return figure


def energies(data) -> Figure:
    """Draw the angle of a link, and by how much the total energy changes."""
    columns = tolerances(data)
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    panels = figure.subplots(2, len(columns), sharex="col", sharey="row", squeeze=False)
    for tol, (angle, energy) in zip(columns, panels.T, strict=True):
        for run in runs(data, "default", tol=tol):
            angle.plot(run.time, run.angle, color="black", lw=0.9, alpha=0.7)
            _log(energy, run, "energy", LEAST_ENERGY, "black")
        for run in _paper(data, tol, False):
            angle.plot(run.time, run.angle, color=_colour(data, run), lw=1.1)
            _log(energy, run, "energy", LEAST_ENERGY, _colour(data, run))
        for run in _paper(data, tol, True):
            _log(energy, run, "energy", LEAST_ENERGY, _colour(data, run), ":")
        angle.set_title(_named(tol), fontsize="medium")
        energy.set_ylim(LEAST_ENERGY, 1e3)
        energy.set_xlim(0, float(data.t_end.max()))
    panels[0, 0].set_ylabel("angle of link1 (rad)")
    panels[1, 0].set_ylabel("|E − E(0)| (J)")
    _finish(figure, panels, data, [("defaults of udkjax", "black", "-")])
    return figure


def growth(data) -> Figure:
    """Draw the drift of runs whose rank is held at 11 against its law, and the law's rate against the gains."""
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    drift, rates = figure.subplots(1, 2, width_ratios=(1.7, 1))
    middle = _middle(data)
    for run in runs(data, "start", tol=middle):
        drift.semilogy(run.time, run.sigma_12, color="0.8", lw=0.6, zorder=1)
    levels = []
    for run in runs(data, "rank held", tol=middle, solver=data.attrs["setting_solver"]):
        _log(drift, run, "sigma_12", LEAST_SIGMA, _colour(data, run))
        law = np.interp(run.time, data.law_time, data.law_drift)
        low, high = data.attrs["setting_fitted"]
        grown = ((run.sigma_12 > low) & (run.sigma_12 < high)).values
        if grown.any():
            levels.append(np.median((run.sigma_12.values / law)[grown]))
    if levels:
        drift.semilogy(data.law_time, np.median(levels) * data.law_drift, "--", color="black", lw=1.2, zorder=5)
    drift.set_ylim(LEAST_SIGMA, 10)
    drift.set(xlabel="time (s)", ylabel="σ₁₂ (kg⁻½), proportional to the drift", title=f"rank held at 11, {_named(middle)}")
    rates.plot(data.law_gain, data.law_rate, "-", color="black", lw=1.2)
    for run in [*runs(data, "rank held"), *runs(data, "law")]:
        rates.plot(float(run.alpha), float(run.growth), "o", ms=5, mfc="none", color=COLOURS[1])
    rates.axhline(0, color="0.5", lw=0.8)
    rates.set(xlabel="gain α = β (1/s)", ylabel="rate of growth (1/s)", title="the law (line), measured (rings)")
    for axes in (drift, rates):
        axes.title.set_fontsize("medium")
        axes.grid(color="0.92", lw=0.6)
    _name_methods(figure, data, [("law", "black", "--"), ("other starts, 1e-16 apart", "0.75", "-")])
    return figure


def work(data) -> Figure:
    """Draw the error of runs that are not lost against right-hand sides and against time."""
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    lines: dict[tuple[str, str, bool], list] = {}
    for run in runs(data, "work"):
        if run.result == "successful":
            lines.setdefault((run.method.item(), run.solver.item(), bool(run.projected)), []).append(run)
    names = list(dict.fromkeys(method for method, _, _ in lines))
    solvers = list(dict.fromkeys(solver for _, solver, projected in lines if not projected))
    colours = {(solver, False): COLOURS[k % len(COLOURS)] for k, solver in enumerate(solvers)}
    colours |= {(solver, True): "black" for _, solver, projected in lines if projected}
    marks = {name: MARKERS[k % len(MARKERS)] for k, name in enumerate(names)}
    for (name, solver, projected), line in lines.items():
        style = {"marker": marks[name], "ms": 4, "lw": 0.8, "mfc": "none", "color": colours[solver, projected]}
        error = [float(run.error_max) for run in line]
        panels[0].loglog([float(run.right_hand_sides) for run in line], error, **style)
        panels[1].loglog([1e3 * float(run.cpu) for run in line], error, **style)
    panels[0].set(xlabel="right-hand sides", ylabel="largest error of the angles (rad)")
    panels[1].set(xlabel="time (ms)")
    for axes in panels:
        axes.grid(color="0.92", lw=0.6)
    handles = [Line2D([], [], color=c, label=f"{s}, projection" if p else s) for (s, p), c in colours.items()]
    handles += [Line2D([], [], color="0.4", lw=0, marker=mark, mfc="none", label=name) for name, mark in marks.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=7, frameon=False, fontsize="small")
    return figure


def _paper(data, tol: float, stabilized: bool):
    for run in runs(data, "paper", tol=tol):
        if (run.alpha > 0) == stabilized:
            yield run


def _middle(data) -> float:
    return tolerances(data)[len(tolerances(data)) // 2]


def _named(tol: float) -> str:
    return f"TOL = $10^{{{round(np.log10(tol))}}}$"


def _colour(data, run) -> str:
    return COLOURS[methods(data).index(str(run.method.item()))]


def _log(axes: Axes, run, variable: str, least: float, colour: str, style: str = "-") -> None:
    axes.semilogy(run.time, np.maximum(np.abs(run[variable]), least), style, color=colour, lw=1.1, alpha=0.9)


def _threshold(axes: Axes, value: float) -> None:
    axes.axhline(value, color="black", lw=0.7, ls=(0, (6, 3)), zorder=0)


def _finish(figure: Figure, panels, data, more: list[tuple[str, str, str]] | None = None) -> None:
    for axes in panels.ravel():
        axes.grid(color="0.92", lw=0.6)
        axes.set_axisbelow(True)
    for axes in panels[-1]:
        axes.set_xlabel("time (s)")
    _name_methods(figure, data, more)


def _name_methods(figure: Figure, data, more: list[tuple[str, str, str]] | None = None) -> None:
    named = [(name, COLOURS[k], "-") for k, name in enumerate(methods(data))] + (more or [])
    handles = [Line2D([], [], color=colour, ls=style, label=name) for name, colour, style in named]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False, fontsize="small")
