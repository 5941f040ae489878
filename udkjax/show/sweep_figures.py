"""Pictures of a sweep, drawn from its dataset: a map of the members' results, and a map of each number saved per member."""

from collections.abc import Callable, Iterator, Sequence
from itertools import islice, product
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from udkjax.extras import OptionalImport
from udkjax.integrate import Result
from udkjax.show.style import COLOURS, legend

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm, Normalize
    from matplotlib.figure import Figure

if TYPE_CHECKING:
    import xarray

Colours = tuple[Colormap | str, Normalize]

RESULT_VARIABLE, MEMBER_DIMENSION = "result", "member"  # names of the variable of result codes, and of the dimension of a design
OTHER_RESULT = "not computed"  # label of codes outside `Result`
# Colours of the members of `Result` in order, success in grey; then the colour of other codes.
RESULT_COLOURS = ("#d9d9d9", *COLOURS[1:6], "white")
MISSING_COLOUR = "0.75"  # grey level of missing values
LOGARITHMIC_RATIO = 1e2  # colours and axes are logarithmic if the ratio of the largest to the smallest value exceeds this
MOST_COLUMNS = 4  # number of columns of panels
MOST_PANELS = 12  # number of panels in one picture; of other dimensions only the first values are drawn


def pictures(data: "xarray.Dataset", most_panels: int = MOST_PANELS) -> dict[str, Figure]:
    """Return figures of a sweep's dataset by variable: `result`, and the `scalars` that differ between members.

    The two dimensions with the most values are the axes of a map; each combination of the others has a panel. A single dimension
    is drawn as a line. Members of a design, which has no grid, are points over its first two axes.
    """
    differing = [name for name in scalars(data) if len(np.unique(data[name])) > 1]
    return {name: _picture(data, name, most_panels) for name in (RESULT_VARIABLE, *differing)}


def scalars(data: "xarray.Dataset") -> list[str]:
    """Return the names of the variables, other than `result`, with one number for each member."""
    return [
        str(n)
        for n in data.data_vars
        if n != RESULT_VARIABLE and data[n].dims == data[RESULT_VARIABLE].dims and data[n].dtype.kind in "iuf"
    ]


def _dims(data: "xarray.Dataset") -> tuple[str, ...]:
    return tuple(map(str, data[RESULT_VARIABLE].dims))


def _picture(data: "xarray.Dataset", name: str, most_panels: int) -> Figure:
    across, panels = _layout(data, most_panels)
    count, others = len(panels), [d for d in _dims(data) if d not in across]
    columns = min(count, MOST_COLUMNS, data.sizes[others[-1]] if others else 1)
    rows = -(-count // columns)
    figure = Figure(figsize=(1.2 + 3.4 * columns, 0.8 + 2.9 * rows), layout="constrained")
    grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)).ravel()
    colours = _codes() if name == RESULT_VARIABLE else _scale(data[name].values)
    drawn = None
    for axes, (chosen, title) in zip(grid, panels, strict=False):
        drawn = _panel(axes, data.isel(chosen), name, across, colours)
        axes.set_title(title, fontsize="small")
    for axes in grid[:count][-columns:]:  # the lowest panel of each column
        axes.tick_params(labelbottom=True)
        axes.set_xlabel(words(data, across[-1]) if len(across) == 2 else axes.get_xlabel())
    for axes in grid[count:]:
        axes.set_axis_off()
    if drawn is not None:
        _key(figure, drawn, data, name)
    all_panels = prod(data.sizes[d] for d in others)
    remarks = [f"the first {count} of {all_panels} panels"] if count < all_panels else []
    remarks += ["grey: missing values"] if drawn is not None and not np.isfinite(data[name].values).all() else []
    figure.suptitle("; ".join([words(data, name), *remarks]))
    return figure


def draw_panel(axes: Axes, data: "xarray.Dataset", name: str) -> ScalarMappable | None:
    """Draw `result` or another variable with one number per member; return the mappable of a colour bar, None for a line.

    Raises:
        ValueError: the sweep has more than two dimensions.
    """
    across, panels = _layout(data)
    if len(panels) > 1:
        raise ValueError(
            f"a sweep over {', '.join(map(str, data[RESULT_VARIABLE].dims))} needs several panels: select values by data.sel"
        )
    return _panel(axes, data.isel(panels[0][0]), name, across, _codes() if name == RESULT_VARIABLE else _scale(data[name].values))


def _panel(axes: Axes, part: "xarray.Dataset", name: str, across: Sequence[str], colours: Colours) -> ScalarMappable | None:
    if MEMBER_DIMENSION in across:
        return _points(axes, part, name, *colours)
    if len(across) == 1:
        return _line(axes, part, name, across[0])
    return _map(axes, part, name, across, *colours)


def _layout(data: "xarray.Dataset", most_panels: int = MOST_PANELS) -> tuple[tuple[str, ...], list[tuple[dict[str, int], str]]]:
    """Return the dimensions that are axes of a panel, and for each panel its indices in the other dimensions and its title."""
    dims = _dims(data)
    longest = sorted(dims, key=lambda d: (_numeric(data, d), data.sizes[d]), reverse=True)[:2]
    across = (MEMBER_DIMENSION,) if MEMBER_DIMENSION in dims else tuple(d for d in dims if d in longest)
    others = [d for d in dims if d not in across]
    indices = islice(product(*(range(data.sizes[d]) for d in others)), most_panels)
    return across, [
        (dict(zip(others, k, strict=True)), ", ".join(_value(data, d, i) for d, i in zip(others, k))) for k in indices
    ]


def _map(
    axes: Axes, part: "xarray.Dataset", name: str, across: Sequence[str], cmap: Colormap | str, norm: Normalize
) -> ScalarMappable:
    """Draw a heat map with the first dimension upwards and the second to the right."""
    up, right = across
    values = np.ma.masked_invalid(_drawable(part[name], name).transpose(up, right).values)
    axes.set_facecolor(MISSING_COLOUR)
    drawn = axes.pcolormesh(_edges(part, right, axes.set_xscale), _edges(part, up, axes.set_yscale), values, cmap=cmap, norm=norm)
    for dim, ticks in ((right, axes.set_xticks), (up, axes.set_yticks)):
        if not _numeric(part, dim):
            ticks(np.arange(part.sizes[dim]), [str(v) for v in part[dim].values], rotation=30 if dim == right else 0)
    if not _numeric(part, up):
        axes.set_ylim(part.sizes[up] - 0.5, -0.5)  # in reading order, from top to bottom
    _label(axes, words(part, right), words(part, up))
    return drawn


def _line(axes: Axes, part: "xarray.Dataset", name: str, dim: str) -> None:
    """Draw a value over one axis; a cross at the lower edge marks a failed member."""
    codes, values = part[RESULT_VARIABLE].values, _drawable(part[name], name).values
    numeric = _numeric(part, dim)
    x = part[dim].values if numeric else np.arange(part.sizes[dim])
    if name == RESULT_VARIABLE:
        for code in np.unique(codes):
            axes.plot(x[codes == code], values[codes == code], "o", color=COLOURS[int(code) % len(COLOURS)])
        shown = sorted({int(v) for v in values})
        axes.set_yticks(shown, [_result(code) for code in shown])
    else:
        axes.plot(x, values, "o-", ms=3.5, color=COLOURS[0], lw=1.2)
        failed = codes != Result.successful
        if failed.any():
            axes.plot(
                x[failed], np.zeros(failed.sum()), "x", color=COLOURS[1], transform=axes.get_xaxis_transform(), label="failed"
            )
            axes.lines[-1].set_clip_on(False)
            legend(axes)
        if _decades(values):
            axes.set_yscale("log")
    if numeric and _decades(x):
        axes.set_xscale("log")
    elif not numeric:
        axes.set_xticks(x, [str(v) for v in part[dim].values], rotation=30)
    _label(axes, words(part, dim), "" if name == RESULT_VARIABLE else words(part, name))


def _points(axes: Axes, part: "xarray.Dataset", name: str, cmap: Colormap | str, norm: Normalize) -> ScalarMappable:
    """Draw the members of a design over its first two axes, or, if it has a single axis, the values over this one."""
    names = [
        str(c)
        for c in part.coords
        if part[c].dims == (MEMBER_DIMENSION,) and part[c].dtype.kind in "iuf" and c != MEMBER_DIMENSION
    ][:2]
    values = _drawable(part[name], name).values
    x = part[names[0]].values if names else np.arange(len(values))
    y = part[names[1]].values if len(names) > 1 else values
    missing = ~np.isfinite(values)
    if len(names) > 1:
        axes.plot(x[missing], y[missing], "x", color=MISSING_COLOUR, ms=3)
    drawn = axes.scatter(x[~missing], y[~missing], c=values[~missing], s=9, cmap=cmap, norm=norm, lw=0)
    for values_, scale in ((x, axes.set_xscale), (y, axes.set_yscale)):
        if _decades(values_):
            scale("log")
    _label(axes, words(part, names[0]) if names else MEMBER_DIMENSION, words(part, names[1] if len(names) > 1 else name))
    return drawn


def _key(figure: Figure, drawn: ScalarMappable, data: "xarray.Dataset", name: str) -> None:
    """Draw the colour bar."""
    bar = figure.colorbar(drawn, ax=figure.axes, aspect=30)
    if name == RESULT_VARIABLE:
        name_results(bar)


def name_results(bar: Colorbar) -> None:
    """Label the colours of a colour bar of results."""
    bar.set_ticks(range(len(Result) + 1), labels=[_result(code) for code in range(len(Result) + 1)])
    bar.ax.tick_params(length=0)


def _codes() -> Colours:
    """Return the colour map and the norm of result codes: a colour for each `Result`, and one for all other codes."""
    count = len(Result) + 1
    return ListedColormap(RESULT_COLOURS[:count]), BoundaryNorm(np.arange(count + 1) - 0.5, count)


def _scale(values: np.ndarray) -> Colours:
    """Return a colour map and its norm, from the smallest to the largest value, logarithmic if their ratio is large."""
    finite = values[np.isfinite(values)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    return "viridis", LogNorm(low, high) if _decades(finite) else Normalize(low, high)


def _drawable(values: "xarray.DataArray", name: str) -> "xarray.DataArray":
    """Return the values to draw; of `result`, all codes outside `Result` are replaced by a single code."""
    return values.where(values.isin([int(r) for r in Result]), len(Result)) if name == RESULT_VARIABLE else values


def _edges(part: "xarray.Dataset", dim: str, scale: Callable[[str], object]) -> np.ndarray:
    """Return the edges of a map's cells: halfway between values, or between the positions of labels.

    `scale` sets the scale of the axis; it is called if the values span decades.
    """
    if not _numeric(part, dim):
        return np.arange(part.sizes[dim] + 1) - 0.5
    values = part[dim].values.astype(float)
    if _decades(values):
        scale("log")
        return np.exp(_between(np.log(values)))
    return _between(values)


def _between(values: np.ndarray) -> np.ndarray:
    if len(values) == 1:
        return values[0] + np.array([-0.5, 0.5])
    middle = (values[1:] + values[:-1]) / 2
    return np.concatenate([[2 * values[0] - middle[0]], middle, [2 * values[-1] - middle[-1]]])


def _decades(values: np.ndarray) -> bool:
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    return values.size > 0 and values.min() > 0 and values.max() >= LOGARITHMIC_RATIO * values.min()


def _numeric(data: "xarray.Dataset", dim: str) -> bool:
    """Return True if the values of a dimension are numbers that increase, or decrease, from each to the next."""
    values = data[dim].values
    return values.dtype.kind in "iuf" and (len(values) < 2 or bool(np.all(np.diff(values) > 0) or np.all(np.diff(values) < 0)))


def words(data: "xarray.Dataset", name: str) -> str:
    """Return the label of a variable or an axis, with its unit."""
    units = data[name].attrs.get("units", "")
    return f"{name.replace('_', ' ')} ({units})" if units not in ("", "1") else name.replace("_", " ")


def _value(data: "xarray.Dataset", dim: str, index: int) -> str:
    value = data[dim].values[index]
    return f"{dim} {value:.4g}" if data[dim].dtype.kind in "iuf" else str(value)


def _label(axes: Axes, right: str, up: str) -> None:
    if axes.get_subplotspec() is None or axes.get_subplotspec().is_last_row():  # pyright: ignore[reportOptionalMemberAccess]
        axes.set_xlabel(right)
    if axes.get_subplotspec() is None or axes.get_subplotspec().is_first_col():  # pyright: ignore[reportOptionalMemberAccess]
        axes.set_ylabel(up)


def _result(code: int) -> str:
    return Result(code).name.replace("_", " ") if code in list(Result) else OTHER_RESULT


def save_sweep_pictures(data: "xarray.Dataset", folder: Path) -> Iterator[str]:
    """Write each of the `pictures` to the folder as a PNG file, and yield its file name."""
    for name, figure in pictures(data).items():
        figure.savefig(folder / f"{name}.png", dpi=150)
        yield f"{name}.png"
