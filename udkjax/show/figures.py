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


def driven_figure(mech: Mechanism, motion: Kinematics, driver: str) -> Figure:
    """Draw the poses and the angles of a mechanism over the values of a driver."""
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    scene, angles = figure.subplots(1, 2)
    q = np.asarray(motion.q)
    draw_motion(scene, mech, q[np.isfinite(q).all((1, 2))])
    draw_angles(angles, mech, motion.values, q)
    angles.set_xlabel(f"{driver} ({motion.unit})")
    figure.suptitle(mech.name)
    return figure


def draw_channels(axes: Axes, x: ArrayLike, channels: Mapping[str, Float[ArrayLike, "T"]], unit: str = "") -> Axes:
    """Draw quantities with the same unit, by name, over time or over the values of a driver."""
    for k, (name, values) in enumerate(channels.items()):
        axes.plot(np.asarray(x), np.asarray(values), DASHES[k % 4], color=COLOURS[k % len(COLOURS)], lw=1.3, label=name)
    axes.set(ylabel=unit)
    legend(axes)
    return plain(axes)


def channels_figure(
    x: ArrayLike, channels: Mapping[str, tuple[ArrayLike, str]], label: str = "time (s)", title: str = ""
) -> Figure:
    """Draw quantities (values and unit, by name), with one panel for each unit."""
    kinds = list(dict.fromkeys(unit for _, unit in channels.values()))
    figure = Figure(figsize=(8, 1.2 + 2.2 * len(kinds)), layout="constrained")
    panels = np.ravel(figure.subplots(len(kinds), 1, sharex=True))
    for axes, unit in zip(panels, kinds, strict=True):
        draw_channels(axes, x, {name: values for name, (values, of_unit) in channels.items() if of_unit == unit}, unit)
    panels[-1].set_xlabel(label)
    figure.suptitle(title)
    return figure


def reactions_figure(ts: ArrayLike, loads: Mapping[str, Mapping[str, ArrayLike]], title: str = "") -> Figure:
    """Draw the magnitude of the force at each pin over time."""
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    draw_reactions(figure.subplots(), ts, loads)
    figure.suptitle(title)
    return figure


def tolerances_figure(found: ToleranceAnalysis, title: str = "") -> Figure:
    """Draw, for each measure, the samples with the limits, and the shares of the variance."""
    figure = Figure(figsize=(8, 0.6 + 2.4 * len(found.names)), layout="constrained")
    for k, (name, (samples, bars)) in enumerate(
        zip(found.names, figure.subplots(len(found.names), 2, squeeze=False), strict=True)
    ):
        samples.hist(found.measured[np.isfinite(found.measured[:, k]), k], bins=80, color=COLOURS[0])
        for edge in found.limits_of(name):
            samples.axvline(edge, color=COLOURS[1])
        samples.set(xlabel=name, ylabel="samples")
        shares = found.shares[name]
        bars.barh(list(shares), [100 * share.total for share in shares.values()], color=COLOURS[2])
        bars.set(xlabel="share of the variance (%)")
        bars.invert_yaxis()
    figure.suptitle(title)
    return figure
