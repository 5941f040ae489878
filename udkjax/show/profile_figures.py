"""Pictures of profile likelihoods: how far a parameter can go while all others make up for it."""

from typing import TYPE_CHECKING

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.show.fit_figures import MOST_COLUMNS, title
from udkjax.show.style import COLOURS, plain

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    import xarray

HIGHEST_COST = 3.0  # times the limit: what is higher is not drawn


def profiles(data: "xarray.Dataset") -> Figure:
    """Draw the curves of a dataset with profiles, what the standard error says of them, and the confidence intervals.

    The rise of the cost C is 2 (C - C_min) / s^2: of a linear model, the square of the distance in standard errors.
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
    one, known, limit = data.sel(profile=name), data.sel(parameter=name), data["interval"].attrs["limit"]
    x, rise = (part[np.isfinite(part)] for part in (one["profile_value"].values, one["rise"].values))
    value, error = float(known["value"]), float(known["standard_error"])
    axes.plot(x, rise, "o-", ms=3, lw=1.2, color=COLOURS[0], label="fitted anew")
    left, right = x.min(), x.max()
    axes.axvspan(*(np.clip(one["interval"].values, left, right)), color="0.9", lw=0, zorder=0)
    if np.isfinite(error) and error > 0:
        line = np.linspace(left, right, 101)
        axes.plot(line, ((line - value) / error) ** 2, "--", lw=1, color=COLOURS[1], label="from the standard error")
    axes.axhline(limit, color="0.5", lw=0.8)
    axes.set_ylim(min(0.0, 1.1 * rise.min()) - 0.03 * limit, max(1.25 * limit, min(1.1 * rise.max(), HIGHEST_COST * limit)))
    axes.set_title(name, fontsize="small", loc="left")
    units = str(known["parameter_units"].values)
    axes.set_xlabel("" if units == "1" else units)
    axes.set_ylabel("rise of the cost")
    axes.locator_params(axis="x", nbins=5)
    plain(axes)
