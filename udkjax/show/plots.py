"""Pictures of a trajectory, as matplotlib figures that belong to nobody else."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from udkjax.equations import energy, violation
from udkjax.integrate import Solution
from udkjax.scene import GROUND, Mechanism

# Okabe and Ito's colours, told apart by everyone; the yellow is left out, since thin lines of it vanish on white.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
SAME_ANGLE = 1e-6  # rad: curves closer than the width of a line share it


def trajectory(mech: Mechanism, sol: Solution, ghosts: int = 5) -> Figure:
    """Draw one simulation: the mechanism at its start and as `ghosts` later instants, and its angles, constraints and energy.

    Links are drawn through the points at which joints hold them; the fine lines are the paths of the centres of mass.
    """
    figure = Figure(figsize=(10, 5.6), layout="constrained")
    panels = figure.subplot_mosaic([["scene", "angles"], ["scene", "constraints"], ["scene", "energy"]], width_ratios=(1.15, 1))
    ts = np.asarray(sol.ts)
    alive = np.isfinite(np.asarray(sol.q)).all((1, 2))  # a run that failed has no values after its end
    draw_motion(panels["scene"], mech, np.asarray(sol.q)[alive], ghosts)
    draw_angles(panels["angles"], mech, ts, np.asarray(sol.q))
    draw_violation(panels["constraints"], ts, violation(mech, sol))
    draw_energy(panels["energy"], ts, energy(mech, sol))
    for name in ("angles", "constraints"):
        panels[name].sharex(panels["energy"])
        panels[name].tick_params(labelbottom=False)
    panels["energy"].set_xlabel("time (s)")
    figure.suptitle(mech.name or None)
    return figure


def draw_motion(axes: Axes, mech: Mechanism, q: Float[np.ndarray, "T bodies 3"], ghosts: int) -> None:
    """Draw the mechanism at the first of the configurations `q`, fainter at `ghosts` later ones, and the paths of its bodies."""
    shapes = {body: outline(points) for body, points in attachments(mech).items()}
    for place, body in enumerate(mech.bodies):
        axes.plot(*q[:, place, :2].T, color=COLOURS[place % len(COLOURS)], lw=0.6, alpha=0.6, zorder=1)
    for instant in np.linspace(0, len(q) - 1, ghosts + 1).astype(int)[::-1]:
        strength = 1.0 if instant == 0 else 0.22
        for place, body in enumerate(mech.bodies):
            colour = COLOURS[place % len(COLOURS)]
            x, y = placed(shapes[body], q[instant, place]).T
            axes.fill(x, y, facecolor=colour, edgecolor=colour, alpha=0.25 * strength, lw=0, zorder=2)
            axes.plot(x, y, color=colour, alpha=strength, lw=2.6, solid_capstyle="round", solid_joinstyle="round", zorder=3)
            if instant == 0:
                axes.plot(x, y, "o", ms=4.5, mfc="white", mec=colour, mew=1.2, zorder=4)
                axes.plot(*q[instant, place, :2], "o", ms=3, color=colour, zorder=4)
    for point in attachments(mech)[GROUND]:
        axes.plot(*point, "^", ms=9, color="0.45", zorder=1.5)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_adjustable("datalim")
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)


def draw_angles(axes: Axes, mech: Mechanism, ts, q: Float[np.ndarray, "T bodies 3"]) -> None:
    """Draw the angle of each body over time; bodies that turn as one share a curve."""
    groups: list[tuple[np.ndarray, list[str], str]] = []
    for place, body in enumerate(mech.bodies):
        angle = q[:, place, 2]
        for curve, names, _ in groups:
            if np.allclose(curve, angle, rtol=0, atol=SAME_ANGLE, equal_nan=True):
                names.append(body)
                break
        else:
            groups.append((angle, [body], COLOURS[place % len(COLOURS)]))
    for angle, names, colour in groups:
        axes.plot(ts, angle, color=colour, lw=1.2, label=", ".join(names) if len(names) < 5 else f"{names[0]} ... {names[-1]}")
    axes.set_ylabel("angle (rad)")
    if len(groups) <= len(COLOURS):
        axes.legend(loc="upper right", fontsize="x-small", framealpha=0.85)


def draw_violation(axes: Axes, ts, violated) -> None:
    """Draw the largest violation of any constraint over time, in metres or radians."""
    axes.semilogy(ts, np.maximum(largest(violated), np.finfo(float).tiny), color=COLOURS[1], lw=1)
    axes.set_ylabel("violation (m, rad)")


def draw_energy(axes: Axes, ts, parts) -> None:
    """Draw the kinetic, potential and total energy over time, seen from their total at the start."""
    start = np.asarray(parts.total)[0]
    axes.plot(ts, np.asarray(parts.kinetic), color=COLOURS[0], lw=1, label="kinetic")
    axes.plot(ts, np.asarray(parts.potential) - start, color=COLOURS[2], lw=1, label="potential")
    axes.plot(ts, np.asarray(parts.total) - start, color="black", lw=1.4, label="total")
    axes.set_ylabel("energy (J)")
    axes.legend(loc="upper right", fontsize="x-small", framealpha=0.85, ncols=3)


def largest(violated) -> Float[np.ndarray, " T"]:
    """Return the largest violation over all constraints at each time, from values by name or from one array."""
    values = violated.values() if isinstance(violated, Mapping) else [violated]
    rows = [np.abs(np.asarray(value)).reshape(len(value), -1).max(axis=1, initial=0.0) for value in values]
    return np.max(rows, axis=0)


def attachments(mech: Mechanism) -> dict[str, Float[np.ndarray, "points 2"]]:
    """Return the points at which joints hold each body, in its own frame, each of them once; the ground is one of the bodies."""
    points: dict[str, list[tuple[float, float]]] = {body: [] for body in (*mech.bodies, GROUND)}
    for joint in mech.joints.values():
        for body, point in zip(joint.bodies, np.asarray(getattr(joint, "points", np.empty((0, 2)))), strict=False):
            points[body].append((float(point[0]), float(point[1])))
    return {body: np.array(list(dict.fromkeys(held))).reshape(-1, 2) for body, held in points.items()}


def outline(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    """Return a closed line through the points that hold a body, in turn around their middle; a single one is joined to its centre."""
    if len(points) < 2:
        points = np.concatenate([points, np.zeros((1, 2))])
    spread = points - points.mean(axis=0)
    along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
    flat = np.linalg.matrix_rank(spread, tol=1e-9 * np.abs(spread).max()) < 2
    order = np.argsort(along if flat else np.arctan2(spread[:, 1], spread[:, 0]))
    return points[order if flat else np.append(order, order[0])]


def placed(points: Float[np.ndarray, "points 2"], coordinates: Float[np.ndarray, "3"]) -> Float[np.ndarray, "points 2"]:
    """Return where points of a body's own frame are, in ground coordinates."""
    x, y, angle = coordinates
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
