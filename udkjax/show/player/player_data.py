"""The data of the player: runs, modes, measures, arrows, and their bounds in the plane.

format     1
title      string
unit       of the timeline: "s", or "" for modes, which go through one cycle from 0 to 1
start, end of the timeline
speed      default playback speed: seconds of the timeline per second
length     the characteristic length of the mechanism (m)
bounds     [left, bottom, right, top] of everything drawn (m)
runs       a list of
    label, note    strings
    bodies         names
    marks          elements to draw (marks.py)
    symbols        their lines and circles (symbols.py)
    traces         a list of [body, x, y] whose paths are drawn
    time, q, v     packed (packing.py) tables of T rows: time; coordinates x, y, angle of each body; their rates times `frame`
    frame          the typical time between two instants (s)
    mode           instead of time, q, v: {q: numbers, shape: numbers, frequency: Hz or null}
    measures       a list of {name, unit, log, values: single precision, anchors: places whose speed it is, or the end, the corner
                   and the other end of an acute angle; a page computes these again}
    events         a list of {t, name}
    sticking       a list of {name, at: anchor, spans: [[from, to], ...]}: when each joint with set-valued friction sticks (s)
    reactions      {anchors, usual: force of an arrow of usual length (N), unique: booleans, force: packed table of T rows with x
                   and y of each anchor}, or null
    gaps           only if they are asked for: the least gap between links and their outlines (gap_records.py)
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject, Numbers
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.events.law.conditions import Gap
from udkjax.integrate.solution import Result
from udkjax.positions.assembling.channels import locate
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.mark_places import body_points, to_ground
from udkjax.show.player.marks.marks import BodyPoints, marks
from udkjax.show.player.marks.measure_curves import Measures, ShownMotion, measures_of, reaction_arrows, sticking_spans
from udkjax.show.player.marks.sketch import UNIT_PICTURE_SIDE, ForceArrow, TracedPath, view_of
from udkjax.show.player.marks.symbols import symbols_of
from udkjax.show.player.packing import floats, pack, unpack

Record = JsonObject
Traces = Sequence[str | tuple[str, Numbers]]  # joints, bodies, or points of bodies
PRECISION = 1e-5  # resolution of positions (characteristic lengths) and angles (rad): a hundredth of a pixel in 1000 pixels
TIME_PRECISION = 1e-9  # resolution of times, as a fraction of the timeline
FORCE_PRECISION = 1e-3  # resolution of forces, as a fraction of the usual force
USUAL_FORCE_QUANTILE = 0.95  # fraction of instants at which no joint force exceeds the usual force, to which arrows are scaled
MOST_INSTANTS = 2400  # number per run; a longer run is thinned out evenly, and interpolated with its velocities
MOST_TRACES = 8  # further traces would hide the mechanism
COMFORTABLE_DURATIONS = (4.0, 40.0)  # range of the playing time (s) at the default speed
PLAYBACK_SPEEDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
MODE_PERIOD = 2.0  # playing time of one cycle of a mode (s)
MODE_AMPLITUDE = 0.12  # amplitude of a shown mode, in characteristic lengths or rad
PATH_POINTS, MOST_PATH_POINTS = 4, 3000  # points of a path per instant of its run, and their largest number
SMALLEST_PATH = 1e-6  # points that move less, in characteristic lengths, have no path


def run_record(
    mechanism: Mechanism,
    solution: ShownMotion,
    label: str,
    measures: Measures,
    with_reactions: bool,
    traces: Traces | None,
    shapes: BodyPoints | None = None,
    gaps: Sequence[Gap] = (),
    targets: Numbers | None = None,
) -> tuple[Record, Float[np.ndarray, "T bodies 3"]]:
    """Return the record of a run, plain data without symbols, and its shown poses; a failed run is shown up to its failure.

    Args:
        mechanism: the mechanism of the run.
        solution: the run.
        label: label of the run; "" for a single run.
        measures: curves over time, as for `animate`.
        with_reactions: True to add arrows of joint forces.
        traces: joints, bodies or points whose paths are drawn; None for the moving pins.
        shapes: further points of bodies, as for `animate`.
        gaps: conditions of contacts, whose lines are drawn.
        targets: wanted places (n, 2) on the ground (m).

    Raises:
        ValueError: the run has no finite state.
    """
    ts, q, v = (np.asarray(x, float) for x in (solution.ts, solution.q, solution.v))
    alive = np.isfinite(q).all((1, 2)) & np.isfinite(v).all((1, 2))
    count = int(np.argmin(alive)) if not alive.all() else len(ts)
    if count == 0:
        cause = getattr(solution, "cause", "")
        raise ValueError(f"run {label!r} has no state to show" + (f": {cause}" if cause else ""))
    shown = np.unique(np.linspace(0, count - 1, min(count, MOST_INSTANTS)).round().astype(int))
    length = float(analyse(mechanism).length)
    steps = np.tile([PRECISION * length, PRECISION * length, PRECISION], q.shape[1])
    frame = float(np.median(np.diff(ts[shown]))) if len(shown) > 1 else 1.0
    poses = q[shown]
    traced = trace_anchors(mechanism, poses, traces, length)
    record = {
        "label": label,
        "note": failure_of(solution) or (getattr(solution, "cause", "") if count < len(ts) else ""),
        "bodies": list(mechanism.bodies),
        "marks": marks(mechanism, poses, shapes, gaps, targets, traced),
        "traces": traced,
        "time": pack(ts[shown, None], TIME_PRECISION * max(np.ptp(ts), frame)),
        "q": pack(poses.reshape(len(shown), -1), steps),
        "v": pack(frame * v[shown].reshape(len(shown), -1), steps),
        "frame": frame,
        "mode": None,
        "measures": [
            {"name": m.name, "unit": m.unit, "log": m.log, "values": floats(m.values[shown]), "anchors": [*map(list, m.anchors)]}
            for m in measures_of(mechanism, solution, measures, label)
        ],
        "events": _events_of(solution),
        "sticking": sticking_spans(mechanism, solution),
        "reactions": None,
    }
    if with_reactions:
        anchors, forces, unique = reaction_arrows(mechanism, solution)
        forces = np.nan_to_num(forces[shown])
        largest = np.linalg.norm(forces, axis=2).max(axis=1, initial=0.0)
        usual = float(np.quantile(largest, USUAL_FORCE_QUANTILE)) or float(largest.max(initial=0.0))
        if usual > 0:
            table = pack(forces.reshape(len(shown), -1), FORCE_PRECISION * usual)
            record["reactions"] = {"anchors": anchors, "usual": usual, "unique": unique, "force": table}
    return record, poses


def mode_record(
    mechanism: Mechanism, q: Numbers, shape: Numbers, frequency: float | None, label: str
) -> tuple[Record, Float[np.ndarray, "T bodies 3"]]:
    """Return the record of a mode q + amplitude shape sin(phase), scaled to a visible amplitude, and its poses in one cycle.

    Args:
        mechanism: the vibrating mechanism.
        q: equilibrium coordinates (bodies, 3).
        shape: mode shape, of any magnitude.
        frequency: natural frequency (Hz); None to show none.
        label: label of the mode.

    Raises:
        ValueError: the shape moves nothing.
    """
    q, shape = np.asarray(q, float), np.asarray(shape, float).reshape(np.shape(q))
    length = float(analyse(mechanism).length)
    largest = np.max(np.abs(shape) / [length, length, 1.0])
    if not (np.isfinite(largest) and largest > 0):
        raise ValueError(f"mode {label!r} does not move anything")
    shape = MODE_AMPLITUDE / largest * shape
    poses = q + np.sin(np.linspace(0, 2 * np.pi, 33))[:, None, None] * shape
    record = {
        "label": label,
        "note": "" if frequency is None else f"{frequency:.4g} Hz",
        "bodies": list(mechanism.bodies),
        "marks": marks(mechanism, poses),
        "traces": [],
        "frame": 1.0,
        "mode": {"q": q.ravel().tolist(), "shape": shape.ravel().tolist(), "frequency": frequency},
        "measures": [],
        "events": [],
        "sticking": [],
        "reactions": None,
    }
    return record, poses


def _events_of(solution: ShownMotion) -> list[JsonObject]:
    """Return the events {t, name} of a run in order of time; [] for a run without events."""
    events = getattr(solution, "events", None)
    if events is None:
        return []
    times, index = np.asarray(events.time), np.asarray(events.index)
    return [{"t": float(t), "name": events.names[k]} for t, k in zip(times, index, strict=True) if k >= 0]


def stuck_at(record: Record, t: float) -> list[list[float]]:
    """Return the anchors [body, x, y] of the joints of a run that stick at a time (s)."""
    return [joint["at"] for joint in record["sticking"] if any(start <= t <= end for start, end in joint["spans"])]


def motion_of(record: Record) -> Callable[[float], Float[np.ndarray, "bodies 3"]]:
    """Return a function of time for the coordinates of a run, as in the player: cubic between instants; for a mode, a sine."""
    shape = len(record["bodies"]), 3
    if record["mode"]:
        q, swing = (np.reshape(record["mode"][name], shape) for name in ("q", "shape"))
        return lambda t: q + np.sin(2 * np.pi * t) * swing
    ts, q, v = (unpack(record[name]) for name in ("time", "q", "v"))

    def at(t: float) -> Float[np.ndarray, "bodies 3"]:
        i, j, s = _place_in(ts[:, 0], t)
        h, r = ts[j, 0] - ts[i, 0], 1 - s
        ends = q[i] * r * r * (1 + 2 * s) + q[j] * s * s * (3 - 2 * s)
        return (ends + h / record["frame"] * s * r * (v[i] * r - v[j] * s)).reshape(shape)

    return at


def _place_in(ts: Float[np.ndarray, "T"], t: float) -> tuple[int, int, float]:
    """Return the indices of the instants before and after a time, and its fraction of the interval between them."""
    j = int(np.clip(np.searchsorted(ts, t, side="right"), 1, max(len(ts) - 1, 1)))
    i, j = j - 1, min(j, len(ts) - 1)
    h = ts[j] - ts[i]
    return i, j, float(np.clip((t - ts[i]) / h, 0, 1)) if h > 0 else 0.0


def arrows_of(record: Record) -> Callable[[float], list[ForceArrow]]:
    """Return a function of time for the arrows of a run's reactions, as in the player: linear between instants."""
    if not record["reactions"]:
        return lambda t: []
    shown, ts = record["reactions"], unpack(record["time"])[:, 0]
    forces = unpack(shown["force"]).reshape(len(ts), -1, 2) / shown["usual"]

    def at(t: float) -> list[ForceArrow]:
        i, j, s = _place_in(ts, t)
        now = (forces[i] * (1 - s) + forces[j] * s).tolist()
        anchors = zip(shown["anchors"], now, shown["unique"], strict=True)
        return [ForceArrow(int(body), (x, y), (fx, fy), unique) for (body, x, y), (fx, fy), unique in anchors]

    return at


def paths_of(record: Record) -> list[TracedPath]:
    """Return the paths of the traced points of a run, through points at equal intervals of time."""
    if not record["traces"]:
        return []
    ts = unpack(record["time"])[:, 0]
    motion = motion_of(record)
    times = np.linspace(ts[0], ts[-1], min(PATH_POINTS * len(ts), MOST_PATH_POINTS))
    poses = np.array([motion(t) for t in times])
    return [TracedPath(int(body), to_ground((x, y), poses[:, int(body)])) for body, x, y in record["traces"]]


def player_data(title: str, runs: Sequence[tuple[Mechanism, Record, Float[np.ndarray, "T bodies 3"]]]) -> Record:
    """Return the data of the player for runs or for modes, each given by its mechanism, its record and its poses."""
    is_mode = runs[0][1]["mode"] is not None
    ends = [(0.0, 1.0)] if is_mode else [_ends(record) for _, record, _ in runs]
    start, end = min(first for first, _ in ends), max(last for _, last in ends)
    boxes = np.array([_box(mechanism, record, poses) for mechanism, record, poses in runs])
    bounds = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    view = view_of(bounds, int(UNIT_PICTURE_SIDE))
    return {
        "format": 1,
        "title": title,
        "unit": "" if is_mode else "s",
        "start": start,
        "end": end,
        "speed": 1 / MODE_PERIOD if is_mode else _speed(end - start),
        "length": float(analyse(runs[0][0]).length),
        "bounds": bounds,
        "runs": [record | {"symbols": symbols_of(record["marks"], view.pt / view.scale)} for _, record, _ in runs],
    }


def trace_anchors(
    mechanism: Mechanism, poses: Float[np.ndarray, "T bodies 3"], wanted: Traces | None, length: float
) -> list[list[float]]:
    """Return the anchors [body, x, y] whose paths are drawn: the `wanted` joints, bodies and points, or else the moving pins.

    Of these pins, the `MOST_TRACES` with the largest paths are chosen; `length` is the mechanism's characteristic length (m).

    Raises:
        ValueError: a name is neither a body nor a pin, or a point does not move.
    """
    bodies = list(mechanism.bodies)
    if wanted is not None:
        return [_anchor(mechanism, bodies, name) for name in wanted]
    found: list[tuple[np.ndarray, list[float]]] = []
    for body, points in body_points(mechanism).items():
        if body not in bodies:
            continue
        k = bodies.index(body)
        for point in points.tolist() or [[0.0, 0.0]]:
            path = to_ground(point, poses[:, k])
            moves = np.ptp(path, axis=0).max() > SMALLEST_PATH * length
            if moves and all(np.abs(path - other).max() > SMALLEST_PATH * length for other, _ in found):
                found.append((path, [k, *point]))
    found.sort(key=lambda item: -float(np.ptp(item[0], axis=0).max()))
    return [anchor for _, anchor in found[:MOST_TRACES]]


def _anchor(mechanism: Mechanism, bodies: list[str], wanted: str | tuple[str, Numbers]) -> list[float]:
    name, point = (wanted, None) if isinstance(wanted, str) else wanted
    try:
        body, local = locate(mechanism, name, None if point is None else np.asarray(point, float))
    except ValueError as error:
        raise ValueError(f"trace {name!r}: {error}") from None
    if body not in bodies:
        raise ValueError(f"trace {name!r}: the point does not move")
    return [bodies.index(body), *np.asarray(local, float).tolist()]


def _box(mechanism: Mechanism, record: Record, poses: Float[np.ndarray, "T bodies 3"]) -> list[float]:
    """Return the rectangle around everything drawn in any pose: left, bottom, right, top (m)."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)

    def hold(body: int, at: Numbers, radius: float = 0.0) -> None:
        nonlocal low, high
        path = to_ground(at, np.zeros((1, 3)) if body < 0 else poses[:, body])
        low, high = np.minimum(low, path.min(axis=0) - radius), np.maximum(high, path.max(axis=0) + radius)

    for mark in record["marks"]:
        if mark["kind"] in (MarkKind.RAIL, MarkKind.RACK, MarkKind.FLOOR):
            direction = np.array([np.cos(mark["axis"]), np.sin(mark["axis"])])
            for s in mark["span"]:
                hold(mark["body"], np.asarray(mark["at"]) + s * direction)
        elif "at" in mark:
            hold(mark["body"], mark["at"], mark.get("radius", 0.0))
        for point in mark.get("points", []):
            hold(mark["body"], np.add(point, mark.get("at", (0.0, 0.0))))
        for k, x, y in (mark[end] for end in ("a", "b") if end in mark):
            hold(int(k), (x, y))
    for part in record.get("gaps", {}).get("parts", []):  # links that touch are painted in their full width
        for point in part["points"]:
            hold(part["body"], point, part["radius"])
    for body, *at in [*record["traces"], *([k, 0.0, 0.0] for k in range(len(mechanism.bodies)))]:
        hold(int(body), at)
    least = 0.1 * float(analyse(mechanism).length)  # the box of a bar that moves along its line has no height
    grow = np.maximum(0.0, least - (high - low) / 2)
    return [*(low - grow).tolist(), *(high + grow).tolist()]


def _ends(record: Record) -> tuple[float, float]:
    ts = unpack(record["time"])[:, 0]
    return float(ts[0]), float(ts[-1])


def _speed(duration: float) -> float:
    """Return the default playback speed for a duration (s): 1 if the playing time is comfortable, else the nearest speed that
    makes it so.
    """
    shortest, longest = COMFORTABLE_DURATIONS
    if duration <= 0 or shortest <= duration <= longest:
        return 1.0
    if duration < shortest:
        return max((s for s in PLAYBACK_SPEEDS if s <= 1 and duration / s >= shortest), default=PLAYBACK_SPEEDS[0])
    return min((s for s in PLAYBACK_SPEEDS if s >= 1 and duration / s <= longest), default=PLAYBACK_SPEEDS[-1])


def failure_of(solution: ShownMotion) -> str:
    """Return the cause of a failed run; "" for other runs."""
    result, cause = getattr(solution, "result", None), getattr(solution, "cause", "")
    if isinstance(result, Result):
        return "" if result.is_success else cause
    finite = np.isfinite(np.asarray(solution.q)).all((1, 2))
    if finite.all():
        return ""
    return cause or f"the position is not finite at t = {float(np.asarray(solution.ts)[np.argmin(finite)]):g} s; shown until then"
