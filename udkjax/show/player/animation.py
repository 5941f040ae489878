"""`animate`: a mechanism in motion, shown in a notebook or a browser, or written to a file."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject, Numbers
from udkjax.argument_types import COORDINATES_OF_BODIES, require_history
from udkjax.arrays import ROUNDING
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.extras import WRITING_PACKAGES, require
from udkjax.integrate.events.law.conditions import Gap
from udkjax.integrate.events.law.event import EventsLike, ExpandsToEvents, expand_events, listed_events
from udkjax.integrate.simulate import simulate
from udkjax.positions.gaps.gaps import LeastGaps
from udkjax.requirements import ArgumentError, concrete_only
from udkjax.scene.arguments import checked, require_mechanism
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player import pictures
from udkjax.show.player.gap_records import ShownGaps, add_gaps
from udkjax.show.player.live import live_data
from udkjax.show.player.live_parameters import Live
from udkjax.show.player.marks.drawn_systems import PlacesBodies, drawn_system
from udkjax.show.player.marks.marks import BodyPoints
from udkjax.show.player.marks.measure_curves import Measures, ShownMotion
from udkjax.show.player.marks.sketch import ForceArrow, TracedPath
from udkjax.show.player.page import frame, page
from udkjax.show.player.picture_labels import PictureLabels, labels_of
from udkjax.show.player.player_data import (
    Traces,
    arrows_of,
    failure_of,
    mode_record,
    motion_of,
    paths_of,
    player_data,
    run_record,
    stuck_at,
)

if TYPE_CHECKING:
    from udkjax.show.player.widget import PlayerWidget

LIVE_SECONDS, LIVE_INSTANTS = 10.0, 501  # duration and output times of a live page without a given run
USUAL_MEASURES = ("violation", "energy", "friction", "rank")
FRAME_HEIGHT = 560  # height of the player inside another page (px)


class FailedRunWarning(UserWarning):
    """A run that is shown has failed; the message gives the cause."""


class Animation:
    """An animation, the result of `animate`. A notebook displays it as a page in a frame.

    The page still works when the notebook is opened without Python, and in exports of nbconvert. `widget` returns a player that
    Python can control.

    Attributes:
        data: data of the player, as JSON (player_data.py).
        failures: causes of failed runs by label.
        mechanisms: the mechanism of each run; pictures with labels name its points and links.
        gaps: the gaps between links of each run; None for a run without them.
    """

    def __init__(
        self,
        data: JsonObject,
        failures: Mapping[str, str] | None = None,
        mechanisms: Sequence[Mechanism] = (),
        gaps: Sequence[LeastGaps | None] = (),
    ):
        self.data, self.failures, self.mechanisms = data, dict(failures or {}), mechanisms
        self.gaps = [*gaps] or [None] * len(data["runs"])
        self._motions = [motion_of(record) for record in data["runs"]]
        self._arrows = [arrows_of(record) for record in data["runs"]]
        self._paths: list[list[TracedPath]] | None = None

    def html(self, theme: str | None = None, autoplay: bool = False) -> str:
        """Return a self-contained HTML page. `theme` is "light" or "dark"; by default the preference of the reader's system."""
        return page(self.data, {"theme": theme, "autoplay": autoplay})

    def widget(self) -> "PlayerWidget":
        """Return an anywidget whose `time` (s) and `playing` are synchronized with the player; needs the extra `notebook`."""
        from udkjax.show.player.widget import PlayerWidget

        return PlayerWidget(data=self.data, time=self.data["start"])

    def save(self, path: str | Path, t: float | None = None, **options: Any) -> Path:
        """Write the animation in the format given by the suffix of the path.

        Args:
            path: .html for the player; .gif (extra `plot`) or .mp4 (`video`) for the motion; .svg, .png (`plot`) or .dxf (`dxf`)
                for a pose.
            t: time of the pose (s); by default the start of the motion.
            options: for .html `theme` and `autoplay`; for .gif and .mp4 `fps` (1/s), `width` (px), `theme` and `speed` (seconds
                of motion per second, by default the player's speed); for .svg and .png `width` (px), `theme`, and `labels`: True
                to write the names of points and the lengths of links; for .dxf `labels`, by default True.

        Returns:
            The path.

        Raises:
            ValueError: the suffix of the path is unknown, or the motion does not contain the time.
            ImportError: a package is missing; the message names the extra that installs it.
        """
        path = Path(path)
        kind = path.suffix.lower()
        require(*WRITING_PACKAGES.get(kind, ()))
        if kind == ".html":
            path.write_text(self.html(**options), encoding="utf-8")
        elif kind == ".svg":
            path.write_text(pictures.svg(self, t, **options), encoding="utf-8")
        elif kind == ".dxf":
            pictures.save_dxf(self, path, t, **options)
        elif kind in (".gif", ".mp4", ".png"):
            from udkjax.show.player import films  # imported here because it needs an extra

            if kind == ".gif":
                films.save_gif(self, path, **options)
            elif kind == ".mp4":
                films.save_mp4(self, path, **options)
            else:
                films.image(self, t, **options).save(path)
        else:
            raise ValueError(f"{path.name}: the suffix must be .html, .gif, .mp4, .svg, .png or .dxf")
        return path

    def pose(self, t: float | None = None) -> list[Float[np.ndarray, "bodies 3"]]:
        """Return the coordinates of the bodies of each run at time t, as the player shows them.

        t is in s, or for modes the fraction of a cycle; by default it is the start of the motion.
        """
        t = self._time(t)
        return [motion(t) for motion in self._motions]

    def paths(self) -> list[list[TracedPath]]:
        """Return the paths (m) of the traced points of each run."""
        if self._paths is None:
            self._paths = [paths_of(record) for record in self.data["runs"]]
        return self._paths

    def arrows(self, t: float | None = None) -> list[list[ForceArrow]]:
        """Return the arrows of the reactions of each run at time t (s), by default at the start; none if they are not shown."""
        t = self._time(t)
        return [arrows(t) for arrows in self._arrows]

    def sticking(self, t: float | None = None) -> list[list[list[float]]]:
        """Return the places [body, x, y] of the joints of each run that stick at time t (s), by default at the start."""
        t = self._time(t)
        return [stuck_at(record, t) for record in self.data["runs"]]

    def touching(self, t: float | None = None) -> list[list[JsonObject]]:
        """Return the outlines {body, points, radius} of the links of each run that touch at time t (s), by default at the start.

        The list of a run without gaps is empty.
        """
        shown = zip(self.data["runs"], self.gaps, self.pose(t), strict=True)
        return [
            []
            if found is None
            else [run["gaps"]["parts"][k] for k in found.touching(dict(zip(run["bodies"], pose, strict=True)))]
            for run, found, pose in shown
        ]

    def labels(self) -> list[PictureLabels]:
        """Return the names of points and the lengths of links of each run."""
        shown = zip(self.mechanisms, self.data["runs"], strict=True)
        return [labels_of(mechanism, run["marks"]) for mechanism, run in shown]

    def _time(self, t: float | None) -> float:
        """Return the time of a pose, by default the start of the motion; raise an error if the motion does not contain it."""
        start, end = float(self.data["start"]), float(self.data["end"])
        if t is None:
            return start
        margin = ROUNDING * max(abs(start), abs(end))
        if not start - margin <= t <= end + margin:
            unit = "" if self.data["runs"][0]["mode"] else " s"
            raise ArgumentError(f"t must be a time of the motion, from {start:g} to {end:g}{unit}, not {t:g}{unit}")
        return float(t)

    def _repr_html_(self) -> str:
        return frame(self.data, FRAME_HEIGHT)

    def __repr__(self) -> str:
        runs, data = self.data["runs"], self.data
        what = "modes" if runs[0]["mode"] else f"{data['end'] - data['start']:g} s"
        return f'<Animation of {data["title"]!r}: {len(runs)} {"run" if len(runs) == 1 else "runs"}, {what}; save("motion.html")>'


@concrete_only()
def animate(
    mechanism: Mechanism | ConstrainedSystem | Mapping[str, Mechanism],
    solution: ShownMotion | Mapping[str, ShownMotion] | None = None,
    *,
    drawing: PlacesBodies | None = None,
    measures: Measures = USUAL_MEASURES,
    reactions: bool = False,
    traces: Traces | None = None,
    shapes: BodyPoints | None = None,
    targets: Numbers | None = None,
    title: str | None = None,
    live: Live = False,
    gaps: ShownGaps = False,
    events: EventsLike = (),
) -> Animation:
    """Show the motion of a mechanism, or several motions side by side and synchronized.

    Args:
        mechanism: the mechanism that moves; for runs of different mechanisms, a mechanism for each label; or a
            `ConstrainedSystem`, which needs a `drawing`.
        solution: a `Solution`, or any object with ts (T,), q and v (T, bodies, 3); for several runs a mapping by label, such as
            {"projected": first, "not stabilized": second}. By default the mechanism is shown at rest, as in its scene.
        drawing: for a `ConstrainedSystem` a function of t and q in jax.numpy that returns x, y (m) and, if it turns, the angle
            (rad) of each body to be drawn, by name; `shapes` has their outlines.
        measures: curves over time below the motion: any of "violation" (constraint violation in m, with radians as arcs of the
            characteristic length), "energy", "friction" (its power in W, if there is any), "rank" (of the constraint Jacobian),
            "effort" (driving torques in N m and forces in N), "speed" (of the pins) and "transmission" (acute angles in degrees
            between coupler and output), or {"torque (N m)": array} for your own values, and
            {"torque (N m)": {label: array}} for several runs.
        reactions: True to draw joint forces as arrows, in pictures and films as well. Forces shared by redundant constraints are
            not unique; the forces of least norm are drawn, dashed in the page and paler in pictures.
        traces: joints, bodies (their centres of mass) or points of bodies, ("coupler", (x, y)), whose paths are drawn; by default
            the moving pins, up to eight.
        shapes: further points (n, 2) of bodies by name, in the bodies' frames (m), that the drawn bodies pass through.
        targets: wanted places (n, 2) on the ground (m), which are marked.
        title: title; by default the mechanism's name.
        live: parameters (`parameters()`), or single entries of them, that get sliders in a live page. Such a page simulates the
            motion again when a number changes, and lets the reader pull bodies. {"pin.B[0]": (0.5, 2.0)} sets the range of a
            slider; True adds sliders for all numbers of the scene. A slider acts on all runs that have its parameter. Without
            `solution`, ten seconds are simulated. A live page has all measures except "rank", and computes them again for each
            motion; your own measures are shown for the first motion only.
        gaps: True to paint links red while they touch, also in pictures and films; a page has marks on the timeline where they
            begin and cease to, and a button that leads to the least gap between links. A result of `udkjax.gaps` for the run, or
            results by label, in place of True, shows other pairs or shapes than its defaults. A live page, whose motion changes,
            has no gaps.
        events: events of live runs, as for `simulate`; the page locates them in each new motion. It supports the actions `Log`,
            `Stop` and `Impact` (one contact at a time), and draws the lines of contacts.

    Returns:
        An `Animation`, which notebooks display; `save("motion.html")` writes it to a file: .html, .gif, .mp4, .svg, .png or .dxf.
        A failed run is shown up to its failure; a `FailedRunWarning` and the page give the cause.

    Raises:
        ValueError: the solution is a batch, a name is unknown, a run has no states or cannot be live, or a drawing is missing.
    """
    if isinstance(mechanism, ConstrainedSystem):
        if drawing is None or solution is None or live:
            raise ValueError("a ConstrainedSystem has no bodies to draw: give a solution and a drawing, a function of t and q")
        mechanism, solution, curves = drawn_system(mechanism, solution, drawing)
        measures = curves if isinstance(measures, Sequence) else measures
        title = title or "system"
    events = listed_events(events)
    if events and not live:
        raise ValueError("events: needed only for a live page; otherwise the events of the solution are shown: leave them out")
    if gaps and live:
        raise ValueError("gaps are those of a run, which a live page changes: leave out gaps or live")
    if live:
        solution, measures = _live_runs(mechanism, solution, measures, events)
    runs: dict[str, ShownMotion | None] = dict(solution) if isinstance(solution, Mapping) else {"": solution}
    if not runs:
        raise ValueError("there is no run to show")
    records, failures, known = [], {}, []
    for label, run in runs.items():
        mech = require_mechanism(mechanism[label] if isinstance(mechanism, Mapping) else mechanism)
        run = _Still(mech) if run is None else run
        require_history(f"solution[{label!r}]" if label else "solution", run, {"mechanism": mech})
        conditions = [event.condition for event in (expand_events(events, mech) if events else ())]
        lines = [condition for condition in conditions if isinstance(condition, Gap)]
        record, poses = run_record(mech, run, label, measures, reactions, traces, shapes, lines, targets)
        known.append(add_gaps(record, mech, run, gaps.get(label) if isinstance(gaps, Mapping) else gaps) if gaps else None)
        records.append((mech, record, poses))
        if failure := failure_of(run):
            failures[label] = failure
            warnings.warn(f"run {label!r} failed: {failure}" if label else f"the run failed: {failure}", FailedRunWarning, 2)
    data = player_data(title or records[0][0].name or "mechanism", records)
    if live:
        shown: Any = [(mech, run, record) for (mech, *_), run, record in zip(records, runs.values(), data["runs"], strict=True)]
        data["live"] = live_data(shown, live, events)
    return Animation(data, failures, [mech for mech, *_ in records], known)


def _live_runs(
    mechanism: Mechanism | Mapping[str, Mechanism],
    solution: ShownMotion | Mapping[str, ShownMotion] | None,
    measures: Measures,
    events: Sequence[ExpandsToEvents],
) -> tuple[ShownMotion | Mapping[str, ShownMotion], Measures]:
    """Return the runs and the measures of a live page; without `solution`, ten seconds are simulated."""
    mechanisms = [require_mechanism(m) for m in (mechanism.values() if isinstance(mechanism, Mapping) else [mechanism])]
    runs: Any = solution
    if runs is None:
        ts = np.linspace(0.0, LIVE_SECONDS, LIVE_INSTANTS)
        solutions = [simulate(mech, ts, throw=False, events=events or None) for mech in mechanisms]
        runs = dict(zip(mechanism, solutions, strict=True)) if isinstance(mechanism, Mapping) else solutions[0]
    own_measures: Mapping[str, Any] = measures if isinstance(measures, Mapping) else dict.fromkeys(measures)
    efforts = ["effort"] if any(mech.driver_names for mech in mechanisms) else []
    # The page computes these again. Unless others are asked for, the effort is shown first.
    first = () if measures == USUAL_MEASURES else own_measures
    wanted = dict.fromkeys([*first, *efforts, "transmission", "speed", "energy", "friction", "violation"])
    return runs, {name: own_measures.get(name) for name in wanted if name != "rank"}


@checked
@concrete_only()
def animate_modes(
    mechanism: Mechanism,
    q: Annotated[Numbers, COORDINATES_OF_BODIES],
    shapes: Numbers,
    frequencies: Sequence[float] | None = None,
    labels: Sequence[str] | None = None,
    title: str | None = None,
) -> Animation:
    """Show vibration modes side by side, q + amplitude shape sin(phase), with an adjustable amplitude.

    Args:
        mechanism: the vibrating mechanism.
        q: equilibrium coordinates (bodies, 3) (m, m, rad).
        shapes: mode shapes (modes, bodies, 3), of any magnitude; each is scaled to a visible amplitude.
        frequencies: natural frequencies (Hz) shown with the labels.
        labels: labels; by default "mode 1", "mode 2", ...
        title: title; by default the mechanism's name.

    Returns:
        An `Animation` of all modes.

    Raises:
        ValueError: `shapes` has the wrong shape, or a mode moves nothing.
    """
    mechanism.require_masses("modes")
    shapes = np.asarray(shapes, float)
    if shapes.shape[1:] != (len(mechanism.bodies), 3) or not len(shapes):
        raise ValueError(f"shapes has shape {shapes.shape}, not (modes, {len(mechanism.bodies)}, 3)")
    records = []
    for k, shape in enumerate(shapes):
        frequency = None if frequencies is None else float(frequencies[k])
        records.append((mechanism, *mode_record(mechanism, q, shape, frequency, labels[k] if labels else f"mode {k + 1}")))
    return Animation(player_data(title or mechanism.name or "mechanism", records), mechanisms=[mechanism] * len(records))


class _Still:
    """A run with one instant: a mechanism in the position of its scene."""

    def __init__(self, mechanism: Mechanism):
        self.ts, self.q, self.v = np.zeros(1), np.asarray(mechanism.q0)[None], np.zeros((1, len(mechanism.bodies), 3))
