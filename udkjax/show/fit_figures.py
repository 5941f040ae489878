"""Pictures of measurements and predictions of a mechanism, and of their residuals."""

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from udkjax.extras import OptionalImport
from udkjax.show.style import COLOURS, plain

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

if TYPE_CHECKING:
    import xarray

MOST_PANELS = 24  # panels of the picture of the fit, one for each channel of each record; others are only in the dataset
MOST_COLUMNS = 3  # panels side by side
MOST_CHANNELS = 8  # channels in the picture of residuals; those least like noise are chosen
MOST_COLOURS = 7  # records with different colours
MOST_BINS = 40  # bins of a histogram
MOST_LAGS = 30  # lags of an autocorrelation
NOISE_RANGE = 4.0  # range of a distribution, in standard deviations of the noise
SAMPLES_PER_LAG = 4  # smallest number of samples per lag


class Series(NamedTuple):
    """The samples of one channel in one record, with predictions, residuals, and standard deviations of the noise."""

    record: str
    channel: str
    units: str
    time: Float[np.ndarray, "N"]
    measured: Float[np.ndarray, "N"]
    predicted: Float[np.ndarray, "N"]
    residual: Float[np.ndarray, "N"]
    noise: Float[np.ndarray, "N"]


def series(data: "xarray.Dataset") -> list[Series]:
    """Return the series of all records, channel by channel, from the dataset of `Estimate.to_xarray`.

    Channels that a record lacks are left out.
    """
    all_series = []
    for c, r in product(range(data.sizes["channel"]), range(data.sizes["record"])):
        channel_of_record = data.isel(record=r, channel=c)
        present = np.isfinite(channel_of_record["measured"].values)
        if present.any():
            columns = (channel_of_record[name].values[present] for name in ("time", "measured", "predicted", "residual", "noise"))
            all_series.append(
                Series(
                    str(channel_of_record["record"].values),
                    str(channel_of_record["channel"].values),
                    _unit(channel_of_record),
                    *columns,
                )
            )
    return all_series


def fit(data: "xarray.Dataset", most_panels: int = MOST_PANELS) -> Figure:
    """Return a figure with a panel for each channel of each record: measurements as points, and predictions as lines.

    If there are more than `most_panels` of them, only the first are drawn.
    """
    all_series, records = series(data), data.sizes["record"]
    columns, panels = _panels(data, all_series, most_panels)
    rows = 1 + max(panels) // columns
    figure = Figure(figsize=(1.0 + (6.5 if columns == 1 else 4.2) * columns, 1.1 + 1.9 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for index, axes in enumerate(grid):
        if index not in panels:
            axes.set_axis_off()
            continue
        shown = panels[index]
        draw_series(axes, shown)
        axes.set_title(shown.channel if records == 1 else f"{shown.channel}, {shown.record}", fontsize="small", loc="left")
        axes.set_ylabel(shown.units)
        axes.set_xlabel("time (s)" if not any(index + columns * k in panels for k in range(1, rows)) else "")
    _key(figure, grid[min(panels)])
    remark = f"{len(panels)} of {len(all_series)} panels; the dataset has all of them" if len(panels) < len(all_series) else ""
    title(figure, data, "measured and predicted", remark)
    return figure


def draw_series(axes: Axes, item: Series) -> None:
    """Draw measurements as points, and the prediction as a line."""
    axes.plot(item.time, item.measured, "o", ms=4, mew=0, alpha=0.5, color=COLOURS[5], label="measured")
    axes.plot(item.time, item.predicted, color=COLOURS[0], lw=1.1, label="predicted")
    axes.margins(x=0.01)
    plain(axes)


def _panels(data: "xarray.Dataset", all_series: list[Series], most_panels: int) -> tuple[int, dict[int, Series]]:
    """Return the number of columns, and the series to draw by the index of their panels, which are counted row by row.

    Two or three records have one column each.
    """
    records, channels = list(data["record"].values), list(data["channel"].values)
    columns, places = min(MOST_COLUMNS, -(-len(all_series) // 4)), list(range(len(all_series)))
    if 1 < len(records) <= MOST_COLUMNS:
        columns = len(records)
        places = [channels.index(s.channel) * columns + records.index(s.record) for s in all_series]
    return columns, {index: s for index, s in zip(places, all_series, strict=True) if index < most_panels}


def residuals(data: "xarray.Dataset", most_channels: int = MOST_CHANNELS) -> Figure:
    """Return a figure with a row for each channel: residuals over time, their distribution, and their autocorrelation.

    If there are more than `most_channels`, those are drawn whose residuals look least like noise.
    """
    all_series = series(data)
    channels = _least_white(data, most_channels)
    shown = channels[:most_channels]
    records = {str(name): k for k, name in enumerate(data["record"].values)}
    figure = Figure(figsize=(11, 1.1 + 2.0 * len(shown)), layout="constrained")
    grid = figure.subplots(len(shown), 3, squeeze=False, width_ratios=(3, 1, 1.2))
    for (over_time, spread, correlated), channel in zip(grid, shown, strict=True):
        of_channel = [item for item in all_series if item.channel == channel]
        for item in of_channel:
            colour = COLOURS[records[item.record] % len(COLOURS)] if len(of_channel) <= MOST_COLOURS else COLOURS[0]
            _over_time(over_time, item, colour)
        _distribution(spread, of_channel)
        _autocorrelation(correlated, of_channel)
        over_time.set_title(channel, fontsize="small", loc="left")
        over_time.set_ylabel(of_channel[0].units)
        spread.sharey(over_time)
        spread.tick_params(labelleft=False)
    for axes, words in zip(grid[-1], ("time (s)", "density", "lag (samples)"), strict=True):
        axes.set_xlabel(words)
    for axes, words in zip(grid[0, 1:], ("distribution", "autocorrelation"), strict=True):
        axes.set_title(words, fontsize="small", loc="left")
    if 1 < len(records) <= MOST_COLOURS:
        _key(figure, grid[0, 0])
    several = f"the {most_channels} of {len(channels)} channels that look least like noise"
    remark = several if len(channels) > most_channels else ""
    title(figure, data, "measured minus predicted; grey: two standard deviations of the noise", remark)
    return figure


def _least_white(data: "xarray.Dataset", most_channels: int) -> list[str]:
    """Return the names of all channels, beginning with those to draw.

    If there are more than `most_channels`, the channels to draw are those whose residuals look least like noise.
    """
    names = [str(name) for name in data["channel"].values]
    if len(names) <= most_channels:
        return names
    p_values = np.nan_to_num(data["correlated"].transpose("record", "channel").values, nan=1.0).min(0)
    first = set(np.argsort(p_values, kind="stable")[:most_channels])
    return [name for k, name in enumerate(names) if k in first] + [name for k, name in enumerate(names) if k not in first]


def _over_time(axes: Axes, item: Series, colour: str) -> None:
    axes.fill_between(item.time, -2 * item.noise, 2 * item.noise, color="0.9", lw=0, zorder=0)
    axes.plot(item.time, item.residual, "o-", ms=2, lw=0.5, color=colour, label=item.record)
    axes.axhline(0, color="0.6", lw=0.6, zorder=1)
    axes.margins(x=0.01)
    plain(axes)


def _distribution(axes: Axes, of_channel: list[Series]) -> None:
    """Draw a histogram of the residuals of all records, and the density of Gaussian noise of the assumed size."""
    left = np.concatenate([item.residual for item in of_channel])
    noise = np.concatenate([item.noise for item in of_channel])
    if np.ptp(left) > 0:
        count = int(np.clip(np.sqrt(len(left)), 5, MOST_BINS))
        axes.hist(left, count, density=True, orientation="horizontal", color=COLOURS[4], alpha=0.7, lw=0)
    sizes = noise[np.isfinite(noise) & (noise > 0)]
    if sizes.size:
        levels = np.unique(np.quantile(sizes, np.linspace(0, 1, MOST_BINS)))  # noise may differ from sample to sample
        y = NOISE_RANGE * sizes.max() * np.linspace(-1, 1, 201)
        density = np.exp(-0.5 * (y[:, None] / levels) ** 2) / (np.sqrt(2 * np.pi) * levels)
        axes.plot(density.mean(1), y, color="black", lw=1)
    axes.locator_params(axis="x", nbins=3)
    axes.set_xlim(left=0)
    plain(axes)


def _autocorrelation(axes: Axes, of_channel: list[Series]) -> None:
    """Draw the autocorrelation of the residuals divided by the noise, and the band with 95 % of the values of white noise."""
    whitened = [item.residual / np.where(item.noise > 0, item.noise, 1.0) for item in of_channel]
    whitened = [record for record in whitened if np.isfinite(record).all()]
    count = min(MOST_LAGS, max((len(record) for record in whitened), default=0) // SAMPLES_PER_LAG)
    power = sum(float(record @ record) for record in whitened)
    if count and power > 0:
        lags = np.arange(1, count + 1)
        values = [sum(float(record[lag:] @ record[:-lag]) for record in whitened if len(record) > lag) / power for lag in lags]
        band = 1.96 / np.sqrt(sum(map(len, whitened)))
        axes.axhspan(-band, band, color="0.9", lw=0, zorder=0)
        axes.vlines(lags, 0, values, color=COLOURS[0], lw=1.4)
        axes.axhline(0, color="0.6", lw=0.6)
        axes.set_ylim(min(-0.5, 1.1 * min(values)), max(0.5, 1.1 * max(values)))
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    plain(axes)


def _key(figure: Figure, axes: Axes) -> None:
    """Draw a legend for all panels from the curves of one panel."""
    figure.legend(
        *axes.get_legend_handles_labels(), loc="outside lower center", ncols=MOST_COLOURS, fontsize="small", frameon=False
    )


def _unit(item: "xarray.Dataset") -> str:
    units = str(item["channel_units"].values)
    return "" if units == "1" else units


def title(figure: Figure, data: "xarray.Dataset", words: str, remark: str = "") -> None:
    """Set the title of a figure: the mechanism, a description, and a remark."""
    figure.suptitle(f"{data.attrs.get('title') or 'mechanism'}: {words}" + (f"\n({remark})" if remark else ""), fontsize="medium")
