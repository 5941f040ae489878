"""Pictures of draws from a posterior density: each number and each pair of numbers, and the predictions of the records."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.scene.arguments import checked
from udkjax.show.fit_figures import MOST_COLUMNS, MOST_PANELS
from udkjax.show.style import COLOURS, legend, plain
from udkjax.study.belief import Posterior
from udkjax.study.identify import Estimate, IdentificationError
from udkjax.wording import quote, suggestion

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_NUMBERS = 8  # numbers of a corner plot; with more, panels are too small
MOST_POINTS = 2000  # points of a panel, which would hide each other
SHOWN_QUANTILES = 0.001, 0.999  # quantiles of the draws at the ends of an axis
CONFIDENCE_DASHES = {0.5: "--", 0.95: "-"}  # joint confidence of the ellipses, and their dashes


@checked
def plot_posterior(posterior: Posterior, estimate: Estimate | None = None, names: Sequence[str] | None = None) -> Figure:
    """Draw a corner plot of a posterior: the draws of each number as a histogram, and of each pair of numbers as points.

    The numbers are the unknowns of an identification.

    Args:
        posterior: draws from `sample`.
        estimate: a result of `identify`, whose normal distribution and joint confidence ellipses (50 % and 95 %) are drawn over
            the draws.
        names: the numbers to draw, as in `posterior.names`; by default the first eight.

    Returns:
        A figure of matplotlib, with one column and one row for each number.

    Raises:
        IdentificationError: a name is not among the unknowns.
    """
    names = list(posterior.names[:MOST_NUMBERS] if names is None else names)
    if wrong := [name for name in names if name not in posterior.names]:
        raise IdentificationError([f"names: there are no draws of {quote(x)}{suggestion(x, posterior.names)}" for x in wrong])
    count = len(names)
    figure = Figure(figsize=(1.2 + 2.0 * count, 0.9 + 1.8 * count), layout="constrained")
    grid = figure.subplots(count, count, squeeze=False, sharex="col")
    units = dict(zip(posterior.names, posterior.problem.units, strict=True))
    for row, name in enumerate(names):
        for column, other in enumerate(names):
            axes = grid[row, column]
            if column > row:
                axes.set_axis_off()
            elif column == row:
                draw_marginal(axes, posterior, name, estimate)
                axes.set_yticks([])
            else:
                draw_pair(axes, posterior, other, name, estimate)
            label = lambda name: f"{name}\n({units[name]})" if units[name] not in ("", "1") else name  # noqa: E731
            axes.set(xlabel=label(other) if row == count - 1 else "", ylabel=label(name) if column == 0 < row else "")
            axes.tick_params(labelbottom=row == count - 1, labelleft=column == 0 < row, labelsize="small")
            axes.xaxis.label.set_size("small")
            axes.yaxis.label.set_size("small")
    handles, labels = grid[-1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", fontsize="small", frameon=False)
    return figure


def draw_marginal(axes: Axes, posterior: Posterior, name: str, estimate: Estimate | None = None) -> Axes:
    """Draw a histogram of the draws of an unknown, and the normal distribution of an estimate with its standard error."""
    values = posterior.draws[name].ravel()
    axes.hist(values, bins=40, range=_range(values), density=True, color=COLOURS[4], label="draws")
    error = estimate.standard_errors.get(name, np.inf) if estimate is not None else np.inf
    if estimate is not None and np.isfinite(error) and error > 0.0:
        x = np.linspace(*_range(values), 201)
        normal = np.exp(-0.5 * ((x - estimate.parameters[name]) / error) ** 2) / (error * np.sqrt(2.0 * np.pi))
        axes.plot(x, normal, color=COLOURS[1], lw=1.2, label="identify")
    axes.locator_params(axis="x", nbins=3)
    return plain(axes)


def draw_pair(axes: Axes, posterior: Posterior, one: str, other: str, estimate: Estimate | None = None) -> Axes:
    """Draw a point for each draw of two unknowns, `one` along x, and the joint confidence ellipses of an estimate."""
    x, y = (posterior.draws[name].ravel() for name in (one, other))
    every = -(-len(x) // MOST_POINTS)
    axes.scatter(x[::every], y[::every], 3, COLOURS[4], lw=0, alpha=0.6, label="draws", rasterized=True)
    if estimate is not None and {one, other} <= {*estimate.names}:
        for level, dashes in CONFIDENCE_DASHES.items():
            ellipse = estimate.ellipse(one, other, level)
            closed = np.concatenate([ellipse, ellipse[:1]])
            axes.plot(*closed.T, dashes, color=COLOURS[1], lw=1.2, label=f"identify, {100 * level:g} %")
    axes.set(xlim=_range(x), ylim=_range(y))
    axes.locator_params(nbins=3)
    return plain(axes)


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, SHOWN_QUANTILES).tolist()
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def draw_prediction(axes: Axes, posterior: Posterior, channel: str, record: int = 0) -> Axes:
    """Draw the measurements of a channel in a record, and the range that would contain 94 % of repeated measurements.

    `record` is the index of the record; the median of the predictions is drawn as a line.
    """
    return _draw_prediction(axes, posterior, record, channel, posterior.prediction_intervals()[record][channel])


def _draw_prediction(axes: Axes, posterior: Posterior, record: int, channel: str, interval: np.ndarray) -> Axes:
    fit = posterior.problem.fit_problem
    data, (low, middle, high) = fit.by_record(fit.measured)[record][channel], interval
    ts = fit.records[record].times
    known = np.isfinite(data)
    axes.fill_between(ts[known], low[known], high[known], color=COLOURS[4], alpha=0.4, lw=0, label="94 % of predictions")
    axes.plot(ts[known], middle[known], color=COLOURS[0], lw=1.2, label="median")
    axes.plot(ts[known], data[known], "o", ms=3, mew=0, alpha=0.6, color=COLOURS[5], label="measured")
    unit = fit.channels[fit.channel_names.index(channel)].units
    axes.set(xlabel="time (s)", ylabel=f"{channel} ({unit})" if unit not in ("", "1") else channel)
    legend(axes)
    return plain(axes)


def prediction_figure(posterior: Posterior) -> Figure:
    """Return a figure with a panel for each channel of each record, up to `MOST_PANELS`: measurements and predictions."""
    intervals = posterior.prediction_intervals()
    shown = [(k, name) for k, channels in enumerate(intervals) for name in channels][:MOST_PANELS]
    columns = min(MOST_COLUMNS, -(-len(shown) // 4))
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(0.8 + 5.5 * columns, 0.4 + 2.4 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (record, channel) in zip(grid, shown, strict=False):
        _draw_prediction(axes, posterior, record, channel, intervals[record][channel])
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    return figure


def save_posterior_pictures(posterior: Posterior, estimate: Estimate, folder: Path) -> Iterator[str]:
    """Write the pictures of a posterior to the folder as PNG files, and yield their file names."""
    for name, figure in {"corner": plot_posterior(posterior, estimate), "predictions": prediction_figure(posterior)}.items():
        figure.savefig(folder / f"{name}.png", dpi=150)
        yield f"{name}.png"
