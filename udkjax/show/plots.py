"""Plots of runs, sweeps and identifications; each draws on given matplotlib axes and returns them.

    from matplotlib import pyplot
    from udkjax.show import plots

    plots.draw_energy(pyplot.gca(), sol.ts, udk.energy(mech, sol))

Every axis is labelled with its unit. Colour-blind readers can distinguish the colours, and curves also differ by markers or
dashes. Only `trajectory` creates a new figure.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.equations.rows.analysis import analyse
from udkjax.equations.states.quantities import Energy, energy, violation
from udkjax.extras import OptionalImport
from udkjax.integrate import Solution
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.show import fit_figures, sweep_figures
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.mark_places import body_points, to_ground
from udkjax.show.player.marks.marks import Mark, marks
from udkjax.show.player.player_data import trace_anchors
from udkjax.show.style import COLOURS, DASHES, MARKERS, legend, plain
from udkjax.study.accuracy import largest_violation

with OptionalImport():
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

if TYPE_CHECKING:
    import xarray

WIDE_SCENE_RATIO = 1.5  # scenes with a larger ratio of width to height are drawn above the curves, others to the left of them
SMALLEST_VIOLATION = 1e-17  # smallest violation that is drawn (m, rad), since zero has no logarithm
SAME_ANGLE = 1e-6  # curves that differ by less (rad) are drawn as one
MOST_TICKS = 6  # number of labels along an axis of the plane; more would touch
_UNIT_CIRCLE = np.column_stack([f(np.linspace(0, 2 * np.pi, 73)[:-1]) for f in (np.cos, np.sin)])


def trajectory(mech: Mechanism, sol: Solution, ghosts: int = 5) -> Figure:
    """Draw a simulation: the mechanism at its start and in `ghosts` later poses, its angles, constraint violation and energy.

    Links look as in the player; the fine lines are the paths of moving pins.
    """
    ts, q = np.asarray(sol.ts), np.asarray(sol.q)
    alive = q[np.isfinite(q).all((1, 2))]  # a failed run is NaN after its failure
    if np.ptp(alive[..., 0]) > WIDE_SCENE_RATIO * np.ptp(alive[..., 1]):
        figure = Figure(figsize=(10, 6.2), layout="constrained")
        panels = figure.subplot_mosaic([["scene"] * 3, ["angles", "constraints", "energy"]], height_ratios=(1.5, 1))
        lowest = ("angles", "constraints", "energy")
    else:
        figure = Figure(figsize=(10, 5.6), layout="constrained")
        panels = figure.subplot_mosaic([["scene", "angles"], ["scene", "constraints"], ["scene", "energy"]])
        lowest = ("energy",)
    draw_motion(panels["scene"], mech, alive, ghosts)
    draw_angles(panels["angles"], mech, ts, q)
    draw_violation(panels["constraints"], ts, violation(mech, sol))
    if mech.massless:
        panels["energy"].text(0.5, 0.5, "no energies without masses", ha="center", transform=panels["energy"].transAxes)
    else:
        draw_energy(panels["energy"], ts, energy(mech, sol))
    for name in ("angles", "constraints", "energy"):
        panels[name].set_xlim(ts[0], ts[-1])
        panels[name].tick_params(labelbottom=name in lowest)
        panels[name].set_xlabel("time (s)" if name in lowest else "")
    figure.suptitle(mech.name)
    return figure


def draw_motion(axes: Axes, mech: Mechanism, q: Float[np.ndarray, "T bodies 3"], ghosts: int = 5) -> Axes:
    """Draw the mechanism in the first of the poses `q`, more faintly in `ghosts` others, and the paths of its pins."""
    attachments, drawn = body_points(mech), marks(mech, q)
    outlines = list(_outlines(drawn))
    for index, *point in trace_anchors(mech, q, None, float(analyse(mech).length)):
        path = to_ground(point, q[:, int(index)])
        axes.plot(*path.T, color=COLOURS[int(index) % len(COLOURS)], lw=0.6, alpha=0.6, zorder=1)
    for instant in reversed(farthest_instants(q, ghosts + 1)):
        strength = 1.0 if instant == 0 else 0.22
        for index, points, closed in outlines:
            colour = COLOURS[index % len(COLOURS)]
            x, y = to_ground(np.append(points, points[:1], axis=0) if closed else points, q[instant, index, None]).T
            if closed:
                axes.fill(x, y, facecolor=colour, alpha=0.25 * strength, lw=0, zorder=2)
            axes.plot(x, y, color=colour, alpha=strength, lw=2.6, solid_capstyle="round", solid_joinstyle="round", zorder=3)
    for index, body in enumerate(mech.bodies):
        colour = COLOURS[index % len(COLOURS)]
        if len(attachments[body]):
            axes.plot(*to_ground(attachments[body], q[0, index, None]).T, "o", ms=4.5, mfc="white", mec=colour, mew=1.2, zorder=4)
        axes.plot(*q[0, index, :2], "o", ms=3, color=colour, zorder=4)
    supports = [mark["at"] for mark in drawn if mark["kind"] == MarkKind.SUPPORT]
    axes.plot(*np.reshape(supports, (-1, 2)).T, "^", ms=9, color="0.45", lw=0, zorder=1.5)
    return _plane(axes, _units(mech))


def draw_angles(axes: Axes, mech: Mechanism, ts: ArrayLike, q: Float[np.ndarray, "T bodies 3"]) -> Axes:
    """Draw the angle of each body over time; bodies with the same angle share a curve."""
    groups: list[tuple[np.ndarray, list[str], str]] = []
    for index, body in enumerate(mech.bodies):
        angle = q[:, index, 2]
        for curve, names, _ in groups:
            if np.allclose(curve, angle, rtol=0, atol=SAME_ANGLE, equal_nan=True):
                names.append(body)
                break
        else:
            groups.append((angle, [body], COLOURS[index % len(COLOURS)]))
    units = _units(mech)
    for angle, names, colour in groups:
        angle = angle / units.size("rad")
        axes.plot(ts, angle, color=colour, lw=1.2, label=", ".join(names) if len(names) < 5 else f"{names[0]} ... {names[-1]}")
    axes.set(xlabel="time (s)", ylabel=f"angle ({units.shown('rad')})")
    if len(groups) <= len(COLOURS):
        legend(axes)
    return axes


def draw_violation(axes: Axes, ts: ArrayLike, violated: ArrayLike) -> Axes:
    """Draw the largest constraint violation over time, in metres or radians."""
    size = largest_violation(violated)
    axes.semilogy(ts, np.maximum(size, SMALLEST_VIOLATION), color=COLOURS[1], lw=1)
    axes.set_ylim(SMALLEST_VIOLATION, 1e3 * np.nanmax(size, initial=SMALLEST_VIOLATION))
    axes.set(xlabel="time (s)", ylabel="constraint violation (m, rad)")
    return axes


def draw_energy(axes: Axes, ts: ArrayLike, parts: Energy) -> Axes:
    """Draw the kinetic, potential and total energy over time.

    The total energy at the start is subtracted from the latter two.
    """
    start = np.asarray(parts.total)[0]
    axes.plot(ts, np.asarray(parts.kinetic), color=COLOURS[0], lw=1, label="kinetic")
    axes.plot(ts, np.asarray(parts.potential) - start, "--", color=COLOURS[2], lw=1, label="potential")
    axes.plot(ts, np.asarray(parts.total) - start, color="black", lw=1.4, label="total")
    axes.set(xlabel="time (s)", ylabel="energy (J)")
    legend(axes)
    return axes


def draw_sweep(axes: Axes, data: "xarray.Dataset", name: str) -> Axes:
    """Draw a variable of a sweep, one number per member, as a heat map over two axes of the sweep or as a line over one.

    Missing values in a map are grey.

    Raises:
        ValueError: the sweep has more than two axes; select values of the others by `data.sel` or `data.isel`.
    """
    drawn = sweep_figures.draw_panel(axes, data, name)
    if drawn is not None:
        axes.figure.colorbar(drawn, ax=axes, label=sweep_figures.words(data, name))
    return axes


def draw_reactions(
    axes: Axes,
    ts: ArrayLike,
    loads: Mapping[str, Mapping[str, ArrayLike]],
    unique: Mapping[str, Mapping[str, ArrayLike]] | None = None,
) -> Axes:
    """Draw the magnitude of each joint's force over time.

    Args:
        axes: axes to draw on.
        ts: times (s).
        loads: result of `udk.reactions`: by joint and body, force x, force y (N) and torque (N m).
        unique: result of `udk.unique_reactions`. Forces that are not unique at all times are dotted: redundant constraints
            share them, and the solution of least norm is drawn.
    """
    for k, (joint, bodies) in enumerate(loads.items()):
        body, load = next(iter(bodies.items()))
        force = np.linalg.norm(np.asarray(load, float)[:, :2], axis=1)
        is_unique = unique is None or bool(np.asarray(unique[joint][body])[:, :2].all())
        style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "ls": (DASHES[k % 3] if is_unique else ":")}
        axes.plot(np.asarray(ts), force, lw=1.3, label=joint if is_unique else f"{joint} (not unique)", **style)
    axes.set(xlabel="time (s)", ylabel="joint force (N)")
    axes.set_ylim(bottom=0)
    legend(axes)
    return plain(axes)


def draw_coupler_curves(axes: Axes, curves: Mapping[str, Float[ArrayLike, "T 2"]]) -> Axes:
    """Draw paths of points (m) by name, each with a marker at its start."""
    for k, (name, path) in enumerate(curves.items()):
        x, y = np.asarray(path, float).T
        colour = COLOURS[k % len(COLOURS)]
        axes.plot(x, y, DASHES[k % len(DASHES)], color=colour, lw=1.3, label=name)
        axes.plot(x[:1], y[:1], MARKERS[k % len(MARKERS)], color=colour, ms=4.5)
    legend(axes)
    return _plane(axes)


def draw_fit(axes: Axes, data: "xarray.Dataset", channel: str, record: str | None = None) -> Axes:
    """Draw the measurements of a channel as points, and the prediction of the identified mechanism as a line.

    Args:
        axes: axes to draw on.
        data: result of `Estimate.to_xarray`.
        channel: name of the channel.
        record: name of the record; by default the first one with the channel.

    Raises:
        ValueError: no record has the channel.
    """
    all_series = fit_figures.series(data)
    matching = [item for item in all_series if item.channel == channel and record in (None, item.record)]
    if not matching:
        raise ValueError(
            f"no record has a channel {channel!r}: there are {', '.join(sorted({item.channel for item in all_series}))}"
        )
    fit_figures.draw_series(axes, matching[0])
    axes.set(xlabel="time (s)", ylabel=f"{channel} ({matching[0].units})" if matching[0].units else channel)
    legend(axes)
    return axes


# --- drawing of mechanisms


def farthest_instants(q: Float[np.ndarray, "T bodies 3"], count: int) -> list[int]:
    """Return the indices of up to `count` poses that differ most: the first, then always the farthest from the chosen ones."""
    poses = np.concatenate([q[..., :2], np.cos(q[..., 2:]), np.sin(q[..., 2:])], axis=-1).reshape(len(q), -1)
    chosen, distance = [0], np.linalg.norm(poses - poses[0], axis=1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(poses - poses[chosen[-1]], axis=1))
    return chosen


def _outlines(drawn: Sequence[Mark]) -> Iterator[tuple[int, Float[np.ndarray, "points 2"], bool]]:
    """Yield the lines with which bodies are drawn: index of the body, points in its frame (m), True for a closed line."""
    for mark in drawn:
        if mark["kind"] in (MarkKind.LINK, MarkKind.OUTLINE):
            yield mark["body"], np.add(mark["points"], mark.get("at", (0.0, 0.0))), mark.get("closed", True)
            yield from ((mark["body"], np.asarray(hole), True) for hole in mark.get("holes", ()))
        elif mark["kind"] in (MarkKind.WHEEL, MarkKind.DISC):
            yield mark["body"], np.add(mark["at"], mark["radius"] * _UNIT_CIRCLE), True


def _units(mech: Mechanism) -> Units:
    """Return the units of a mechanism's drawing; SI units for a mechanism without a drawing."""
    return Units(dict(mech.drawing.units) if isinstance(mech.drawing, Drawing) else None)


def _plane(axes: Axes, units: Units | None = None) -> Axes:
    """Label the axes of a plane with the unit of lengths in `units`, by default m, make their scales equal, and return them.

    Places are drawn in m, whatever the unit of the labels.
    """
    unit, size = ("m", 1.0) if units is None else (units.shown("m"), units.size("m"))
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})", aspect="equal")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(_TicksInUnit(size))
        axis.set_major_formatter(lambda x, _: f"{x / size:.6g}")
    return plain(axes)


class _TicksInUnit(MaxNLocator):
    """Ticks at round numbers of a unit, along an axis in m."""

    def __init__(self, size: float):
        self.size = size
        super().__init__(MOST_TICKS, steps=[1, 2, 2.5, 5, 10])

    def tick_values(self, vmin: float, vmax: float) -> np.ndarray:
        return self.size * np.asarray(super().tick_values(vmin / self.size, vmax / self.size))
