"""Pictures of an identification, drawn from its dataset: fit, residuals, correlations and standard errors, convergence."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.show.fit_figures import MOST_COLUMNS, fit, residuals, title
from udkjax.show.style import COLOURS, plain

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

if TYPE_CHECKING:
    import xarray

MOST_WRITTEN = 14  # largest number of parameters for which correlations are written as numbers
LARGEST_ERROR = 1e3  # largest standard error that is drawn, in percent
HIGHEST_COST = 3.0  # upper end of a profile's axis, in multiples of the limit of the cost
ZERO_DRAWN = 1e-18  # drawn instead of zero on a logarithmic axis


def pictures(data: "xarray.Dataset") -> dict[str, Figure]:
    """Return the figures of an identification by name, drawn from the dataset of `Estimate.to_xarray`.

    The names are "fit", "residuals", "convergence"; with several parameters "correlation"; with profile likelihoods "profiles".
    """
    figures = {"fit": fit(data), "residuals": residuals(data), "convergence": convergence(data)}
    figures |= {"correlation": correlation(data)} if data.sizes["parameter"] > 1 else {}
    return figures | ({"profiles": profiles(data)} if "profile" in data else {})


def save_fit_pictures(data: "xarray.Dataset", folder: Path) -> Iterator[str]:
    """Write each of the `pictures` to the folder as a PNG file, and yield its file name."""
    for name, figure in pictures(data).items():
        figure.savefig(folder / f"{name}.png", dpi=150)
        yield f"{name}.png"


def correlation(data: "xarray.Dataset") -> Figure:
    """Return a figure with the correlations of the parameters' errors, and the standard errors.

    Correlations of unidentifiable parameters are grey.
    """
    names = [_short(str(name)) for name in data["parameter"].values]
    values, count = data["correlation"].values, len(names)
    size = 0.42 if count <= MOST_WRITTEN else 0.26
    figure = Figure(figsize=(4.5 + 0.055 * max(map(len, names)) + size * count, 1.9 + size * count), layout="constrained")
    matrix, errors = figure.subplots(1, 2, width_ratios=(size * count, 1.6))
    matrix.set_facecolor("0.75")
    drawn = matrix.imshow(np.ma.masked_invalid(values), cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    if count <= MOST_WRITTEN:
        for i, j in np.argwhere(np.isfinite(values)):
            colour = "white" if abs(values[i, j]) > 0.6 else "black"
            matrix.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize=6.5, color=colour)
    positions = np.arange(count)
    matrix.set_xticks(positions, [str(k + 1) for k in positions], fontsize="small")
    matrix.set_yticks(positions, [f"{name}  {k + 1}" for k, name in enumerate(names)], fontsize="small")
    matrix.set_title("correlation of errors", fontsize="small", loc="left")
    _errors(errors, data)
    errors.set_ylim(matrix.get_ylim())
    figure.colorbar(drawn, ax=matrix, location="bottom", aspect=30, shrink=0.8, pad=0.02)
    title(figure, data, "correlations and standard errors of the parameters")
    return figure


def _errors(axes: Axes, data: "xarray.Dataset") -> None:
    """Draw standard errors in percent of the values; in place of infinite errors, write "unknown"."""
    error, value = data["standard_error"].values, np.abs(data["value"].values)
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = np.where(np.isfinite(error), np.clip(100 * error / value, ZERO_DRAWN, LARGEST_ERROR), np.nan)
    positions, known = np.arange(len(error)), np.isfinite(percent)
    low = np.nanmin(percent, initial=LARGEST_ERROR) / 10 if known.any() else 1.0
    axes.barh(positions[known], percent[known] - low, left=low, height=0.6, color=COLOURS[0])
    axes.set_xscale("log")
    axes.set_xlim(low, max(10 * low, 3 * np.nanmax(percent, initial=low)))
    for k in positions[~known]:
        axes.text(0.04, k, "unknown", transform=axes.get_yaxis_transform(), va="center", fontsize="small", color=COLOURS[1])
    axes.set_yticks([])
    axes.set_title("standard error (% of value)", fontsize="small", loc="left")
    plain(axes)


def convergence(data: "xarray.Dataset") -> Figure:
    """Return a figure with the cost of each trial of the fit, and the largest change of an unknown in the next step.

    Within a fit the cost never rises. Where it rises, another fit begins, with a longer part of the records, another guess, or
    other weights.
    """
    figure = Figure(figsize=(7, 5.4), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    trials = np.arange(1, data.sizes["trial"] + 1)
    fits = np.split(trials, np.flatnonzero(np.diff(data["cost"].values) > 0) + 1)
    words = {"cost": "cost (half of the sum of squares)", "change": "largest change of an unknown"}
    for axes, name in zip(panels, words, strict=True):
        values = data[name].values
        for trials_of_fit in fits:
            axes.semilogy(trials_of_fit, np.maximum(values[trials_of_fit - 1], ZERO_DRAWN), "o-", ms=3, lw=1, color=COLOURS[0])
        axes.set_ylabel(words[name])
        plain(axes)
    panels[-1].set_xlabel("trial")
    panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    gaps = "after a gap: another guess, part of the records, tolerance or weight of channels"
    title(figure, data, "convergence of the fit", gaps if fits[1:] else "")
    return figure


def _short(name: str) -> str:
    """Return the name of a parameter; for tied parameters, the first name and the number of names."""
    first, *others = name.split(" = ")
    return f"{first} = ... ({len(others) + 1} tied)" if others else first


def profiles(data: "xarray.Dataset") -> Figure:
    """Return a figure of profile likelihoods, their approximations from the standard errors, and the confidence intervals.

    The rise of the cost C is 2 (C - C_min) / s^2; for a linear model, it is the square of the distance in standard errors.
    """
    names = [str(name) for name in data["profile"].values]
    columns = min(MOST_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(0.6 + 4.0 * columns, 1.1 + 2.7 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, name in zip(grid, names, strict=False):
        _profile(axes, data, name)
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    figure.legend(
        *grid[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns, fontsize="small", frameon=False
    )
    title(figure, data, f"profile likelihoods; grey: {100 * data['interval'].attrs['level']:g} % confidence intervals")
    return figure


def _profile(axes: Axes, data: "xarray.Dataset", name: str) -> None:
    curve, known, limit = data.sel(profile=name), data.sel(parameter=name), data["interval"].attrs["limit"]
    x, rise = (values[np.isfinite(values)] for values in (curve["profile_value"].values, curve["rise"].values))
    value, error = float(known["value"]), float(known["standard_error"])
    axes.plot(x, rise, "o-", ms=3, lw=1.2, color=COLOURS[0], label="other parameters refitted")
    left, right = x.min(), x.max()
    axes.axvspan(*(np.clip(curve["interval"].values, left, right)), color="0.9", lw=0, zorder=0)
    if np.isfinite(error) and error > 0:
        line = np.linspace(left, right, 101)
        axes.plot(line, ((line - value) / error) ** 2, "--", lw=1, color=COLOURS[1], label="approximated by the standard error")
    axes.axhline(limit, color="0.5", lw=0.8)
    axes.set_ylim(min(0.0, 1.1 * rise.min()) - 0.03 * limit, max(1.25 * limit, min(1.1 * rise.max(), HIGHEST_COST * limit)))
    axes.set_title(name, fontsize="small", loc="left")
    units = str(known["parameter_units"].values)
    axes.set_xlabel("" if units == "1" else units)
    axes.set_ylabel("rise of the cost")
    axes.locator_params(axis="x", nbins=5)
    plain(axes)
