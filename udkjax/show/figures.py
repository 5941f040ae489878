"""Figures of the command line: a driven motion, channels over time, and reactions."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.extras import OptionalImport
from udkjax.positions.following.kinematics import Kinematics
from udkjax.scene.mechanism import Mechanism
from udkjax.show.plots import draw_angles, draw_motion, draw_reactions
from udkjax.show.style import COLOURS, DASHES, legend, plain
from udkjax.study.tolerancing import ToleranceAnalysis

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator


def driven_figure(mech: Mechanism, motion: Kinematics, along: Float[np.ndarray, "T"], label: str) -> Figure:
    """Return a figure with poses of a mechanism, and with the angles of its bodies along the values of a driver.

    Args:
        mech: the mechanism.
        motion: its positions at the values of the driver.
        along: the values of the driver as shown; if there is a single value, its pose is drawn alone.
        label: the driver, with the unit of these values.
    """
    q, is_alone = np.asarray(motion.q), len(along) == 1
    figure = Figure(figsize=(6 if is_alone else 10, 4.6), layout="constrained")
    scene, *angles = np.ravel(figure.subplots(1, 1 if is_alone else 2))
    draw_motion(scene, mech, q[np.isfinite(q).all((1, 2))])
    for axes in angles:
        draw_angles(axes, mech, along, q)
        axes.set_xlabel(label)
        _tick_turns(axes, label)
    figure.suptitle(": ".join(filter(None, (mech.name, f"{label}: {along[0]:.6g}" if is_alone else ""))))
    return figure


def draw_channels(axes: Axes, x: ArrayLike, channels: Mapping[str, Float[ArrayLike, "T"]], unit: str = "") -> Axes:
    """Draw quantities with the same unit, by name, over x, such as time or the values of a driver; return the axes."""
    for k, (name, values) in enumerate(channels.items()):
        axes.plot(np.asarray(x), np.asarray(values), DASHES[k % 4], color=COLOURS[k % len(COLOURS)], lw=1.3, label=name)
    axes.set(ylabel=unit)
    legend(axes)
    return plain(axes)


def channels_figure(
    x: ArrayLike, channels: Mapping[str, tuple[ArrayLike, str]], label: str = "time (s)", title: str = ""
) -> Figure:
    """Return a figure of quantities (values and unit, by name) over x, with one panel for each unit; `label` describes x."""
    kinds = list(dict.fromkeys(unit for _, unit in channels.values()))
    figure = Figure(figsize=(8, 1.2 + 2.2 * len(kinds)), layout="constrained")
    panels = np.ravel(figure.subplots(len(kinds), 1, sharex=True))
    for axes, unit in zip(panels, kinds, strict=True):
        draw_channels(axes, x, {name: values for name, (values, of_unit) in channels.items() if of_unit == unit}, unit)
    panels[-1].set_xlabel(label)
    _tick_turns(panels[-1], label)
    figure.suptitle(title)
    return figure


def _tick_turns(axes: Axes, label: str) -> None:
    """Place ticks at fractions of a turn if the label says that the axis is in degrees."""
    if label.endswith("(deg)"):
        axes.xaxis.set_major_locator(MaxNLocator(9, steps=[1, 1.5, 3, 4.5, 9, 10]))


def reactions_figure(ts: ArrayLike, loads: Mapping[str, Mapping[str, ArrayLike]], title: str = "") -> Figure:
    """Return a figure with the magnitude of the force at each pin over time; `loads` is a result of `udk.reactions`."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    draw_reactions(figure.subplots(), ts, loads)
    figure.suptitle(title)
    return figure


def tolerances_figure(found: ToleranceAnalysis, title: str = "") -> Figure:
    """Return a figure with a row for each measure: a histogram of the samples with the limits, and the shares of the variance."""
    figure = Figure(figsize=(8, 0.6 + 2.4 * len(found.names)), layout="constrained")
    for k, (name, (samples, bars)) in enumerate(
        zip(found.names, figure.subplots(len(found.names), 2, squeeze=False), strict=True)
    ):
        unit, size = found.shown(name)
        samples.hist(found.measured[np.isfinite(found.measured[:, k]), k] / size, bins=80, color=COLOURS[0])
        for edge in found.limits_of(name):
            samples.axvline(edge / size, color=COLOURS[1])
        samples.set(xlabel=f"{name} ({unit})" if unit else name, ylabel="samples")
        shares = found.shares[name]
        bars.barh(list(shares), [100 * share.total for share in shares.values()], color=COLOURS[2])
        bars.set(xlabel="share of the variance (%)")
        bars.invert_yaxis()
    figure.suptitle(title)
    return figure
