"""A design in a file: the mechanism, its goals and its limits, in units of the file."""

import csv
import inspect
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from udkjax.annotations import TomlTable
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.files import load
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.mechanism_tables import parse_toml
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.complete.complete_design import CompleteSearch
from udkjax.synthesis.curve_goal import CurveGoal
from udkjax.synthesis.curves.curve_file import read_curve_file
from udkjax.synthesis.design import DesignSearch
from udkjax.synthesis.goals import FunctionGoal, Goal, PathGoal, PoseGoal
from udkjax.synthesis.motion_goals import EnergyGoal, FrequencyGoal, GapGoal, LoadGoal, MotionTerm, ToleranceGoal, TorqueGoal
from udkjax.synthesis.robust_goal import RobustGoal
from udkjax.wording import abbreviate, plural, quote, unknown_key

TOP_KEYS = (
    "mechanism",
    "units",
    "goal",
    "motion",
    "complete",
    "free",
    "driver",
    "bounds",
    "areas",
    "length",
    "transmission",
    "rotation",
)
SEARCH_SETTINGS = ("free", "motion")  # settings that a search for all solutions does not have
LENGTH_KEYS = ("pins", "least", "most")
# The keys of each kind of goal, and their SI units; "value" is the unit of the driver.
GOAL_KINDS: dict[str, tuple[Callable[..., Goal], dict[str, str]]] = {
    "path": (PathGoal, {"point": "", "targets": "m", "values": "value", "start": "", "line": "", "at": "m"}),
    "poses": (
        PoseGoal,
        {"body": "", "targets": "pose", "arm": "m", "pin": "", "values": "value", "start": "", "line": ""},
    ),
    "function": (
        FunctionGoal,
        {"output": "", "values": "value", "targets": "output", "start": "", "output_start": "", "line": ""},
    ),
    "curve": (CurveGoal, {"pin": "", "points": "m", "part": "", "samples": ""}),
}
# Columns of a table of targets: x, y; x, y, angle; value of the driver, output.
TARGET_COLUMNS = {"path": 2, "poses": 3, "function": 2}
# The kinds of motion goals, each with the unit of its measure; "effort" is the unit of the driver's effort. Below: further keys.
MOTION_KINDS: dict[str, tuple[Callable[..., MotionTerm], str]] = {
    "torque": (TorqueGoal, "effort"),
    "load": (LoadGoal, "N"),
    "energy": (EnergyGoal, "J"),
    "frequency": (FrequencyGoal, "1/s"),
    "tolerance": (ToleranceGoal, "m"),
    "gap": (GapGoal, "m"),
}
MOTION_KEYS = ("kind", "most", "least", "speed", "weight", "samples")
MOTION_GOAL_NAMES = (*MOTION_KINDS, "robust")
ROBUST_KEYS = ("kind", "goal", "tolerances", "sigmas", "most", "weight")
OWN_KEYS = {"load": ("joint",), "tolerance": ("point", "tolerances"), "gap": ("one", "other")}


def read_design(path: str | os.PathLike[str]) -> DesignSearch | CompleteSearch:
    """Return the search that a file describes; with `complete = true`, the search for all solutions.

    Args:
        path: the file; the mechanism's file is named relative to it.

    Raises:
        SceneError: the file has mistakes; the error lists them all.
        OSError: a file cannot be read.
    """
    name = os.fspath(path)
    table = parse_toml(Path(path).read_text(encoding="utf-8"), name, SceneError)
    problems = [f"{key}: {unknown_key(key, TOP_KEYS)}" for key in table if key not in TOP_KEYS]
    problems += [f"{key} is missing" for key in ("mechanism", "goal") if key not in table]
    units = Units(table.get("units"))
    problems += units.problems
    complete = table.get("complete", False)
    if not isinstance(complete, bool):
        problems.append("complete must be true or false")
    elif complete:
        problems += [
            f"{key} is given with complete = true, which finds all solutions: leave it out"
            for key in SEARCH_SETTINGS
            if key in table
        ]
    if problems:
        raise SceneError(problems, name)
    mechanism = load(Path(path).parent / str(table["mechanism"]))
    goal = _read_goal(mechanism, _with_table(table["goal"], Path(path).parent, problems), units, problems)
    bounds = _read_bounds(mechanism, table.get("bounds", {}), units, problems)
    lengths = _read_lengths(table.get("length", []), units, problems)
    motions = [(f"motion[{k}]", entry) for k, entry in enumerate(table.get("motion", []))]
    terms = [_read_motion(where, mechanism, goal, entry, units, problems) for where, entry in motions]
    areas = {pin: units.convert(f"areas.{pin}", area, "m", problems) for pin, area in dict(table.get("areas", {})).items()}
    transmission = units.convert("transmission", table.get("transmission", 0.0), "rad", problems)
    if isinstance(transmission, bool) or not isinstance(transmission, float | int | None):
        problems.append(f"transmission: must be an angle, not {abbreviate(table['transmission'])}")
    if problems:
        raise SceneError(problems, name)
    assert goal is not None and isinstance(transmission, float | int)
    if complete:
        if not isinstance(goal, PathGoal | PoseGoal):
            raise SceneError(['goal.kind must be "path" or "poses" with complete = true'], name)
        limits = {"bounds": bounds, "lengths": lengths, "areas": areas, "transmission": transmission}
        return CompleteSearch(mechanism, goal, table.get("driver"), {**limits, "rotation": table.get("rotation", False)})
    choices = {key: table[key] for key in ("free", "driver", "rotation") if key in table}
    try:
        goals = [goal, *(term for term in terms if term is not None)]
        return DesignSearch(
            mechanism, goals, bounds=bounds, lengths=lengths, areas=areas, transmission=float(transmission), **choices
        )
    except (TypeError, ValueError) as problem:
        if isinstance(problem, SceneError):
            raise
        raise SceneError([str(problem)], name) from None


def _with_table(goal: Any, folder: Path, problems: list[str]) -> Any:
    """Return a goal's entries, with the contents of a file in place of the name of a file of targets or of points of a curve.

    A table of a function has the values of the driver in its first column. Other goals are returned unchanged.
    """
    if isinstance(goal, Mapping) and goal.get("kind") == "curve" and isinstance(goal.get("points"), str):
        try:
            return {**goal, "points": read_curve_file(folder / goal["points"]).tolist()}
        except ValueError as problem:
            problems.append(f"goal.points: {problem}")
    if not isinstance(goal, Mapping) or not isinstance(goal.get("targets"), str) or goal.get("kind") not in TARGET_COLUMNS:
        return goal
    file, columns, rows = folder / goal["targets"], TARGET_COLUMNS[goal["kind"]], []
    for k, row in enumerate(csv.reader(io.StringIO(file.read_text(encoding="utf-8-sig")))):
        try:
            numbers = [float(x) for x in row[:columns]]
        except ValueError:
            numbers = []
        if len(numbers) == columns:
            rows.append(numbers)
        elif any(map(str.strip, row)) and k:  # the first line may be a heading
            problems.append(f"goal.targets: line {k + 1} of {file.name} must begin with {plural(columns, 'number')}")
    if goal["kind"] != "function":
        return {**goal, "targets": rows}
    return {**goal, "values": [row[0] for row in rows], "targets": [row[1] for row in rows]}


def _read_goal(mechanism: Mechanism, table: Any, units: Units, problems: list[str]) -> Goal | None:
    kind = table.get("kind") if isinstance(table, Mapping) else None
    if not isinstance(kind, str) or kind not in GOAL_KINDS:
        problems.append(f"goal.kind must be one of {', '.join(map(quote, GOAL_KINDS))}, not {quote(str(kind))}")
        return None
    make, keys = GOAL_KINDS[kind]
    before = len(problems)
    problems += [f"goal.{key}: {unknown_key(key, keys)}" for key in table if key not in (*keys, "kind")]
    given = {key: value for key, value in table.items() if key in keys}
    problems += _missing("goal", make, given)
    for key, unit in keys.items():
        if key in given and unit == "pose":
            given[key] = [_pose(f"goal.{key}[{k}]", row, units, problems) for k, row in enumerate(given[key])]
        elif key in given and unit:
            si = "m" if unit == "m" else _unit_of(given.get("output", "")) if unit == "output" else _driven_unit(mechanism)
            given[key] = units.convert(f"goal.{key}", given[key], si, problems)
    if len(problems) > before:
        return None
    try:
        return make(**given)
    except (TypeError, ValueError) as problem:
        problems.append(f"goal: {problem}")
        return None


def _read_motion(
    where: str, mechanism: Mechanism, goal: Goal | None, table: Any, units: Units, problems: list[str]
) -> MotionTerm | None:
    kind = table.get("kind") if isinstance(table, Mapping) else None
    if kind == "robust":
        return _read_robust(where, mechanism, goal, table, units, problems)
    if not isinstance(kind, str) or kind not in MOTION_KINDS:
        problems.append(f"{where}.kind must be one of {', '.join(map(quote, (*MOTION_KINDS, 'robust')))}, not {quote(str(kind))}")
        return None
    make, unit = MOTION_KINDS[kind]
    keys, before = (*MOTION_KEYS, *OWN_KEYS.get(kind, ())), len(problems)
    problems += [f"{where}.{key}: {unknown_key(key, keys)}" for key in table if key not in keys]
    given, driven = {key: value for key, value in table.items() if key != "kind"}, _driven_unit(mechanism)
    problems += _missing(where, make, given)
    unit = {"rad": "N m", "m": "N"}[driven] if unit == "effort" else unit
    for key, si in (("most", unit), ("least", unit), ("speed", f"{driven}/s")):
        if key in given:
            given[key] = units.convert(f"{where}.{key}", given[key], si, problems)
    if "tolerances" in given:
        tolerances = dict(given["tolerances"])
        given["tolerances"] = {n: units.convert(f"{where}.tolerances.{n}", x, "m", problems) for n, x in tolerances.items()}
    if len(problems) > before:
        return None
    try:
        return make(**given)
    except (TypeError, ValueError) as problem:
        problems.append(f"{where}: {problem}")
        return None


def _read_robust(
    where: str, mechanism: Mechanism, goal: Goal | None, table: TomlTable, units: Units, problems: list[str]
) -> MotionTerm | None:
    """Return the robust goal of a table: of the motion goal in its entry `goal` or, without one, of the positional goal.

    Mistakes are appended to `problems`; the result is then None.
    """
    before = len(problems)
    problems += [f"{where}.{key}: {unknown_key(key, ROBUST_KEYS)}" for key in table if key not in ROBUST_KEYS]
    plain = _read_motion(f"{where}.goal", mechanism, None, table["goal"], units, problems) if "goal" in table else goal
    given: dict[str, Any] = {key: value for key, value in table.items() if key not in ("kind", "goal")}
    problems += [] if "tolerances" in given else [f"{where}.tolerances: missing"]
    if "most" in given:
        si = _unit_of(goal.output) if isinstance(goal, FunctionGoal) else "m"  # pyright: ignore[reportArgumentType]
        given["most"] = units.convert(f"{where}.most", given["most"], si, problems)
    tolerances = given["tolerances"] = dict(given.get("tolerances", {}))
    for name, x in tolerances.items():
        if not isinstance(x, str):
            si = mechanism.unit_of(name) if name in mechanism.parameters() else "m"
            tolerances[name] = units.convert(f"{where}.tolerances.{name}", x, si, problems)
    if len(problems) > before or plain is None:
        return None
    try:
        return RobustGoal(plain, **given)
    except (TypeError, ValueError) as problem:
        problems.append(f"{where}: {problem}")
        return None


def _missing(where: str, make: Callable[..., Any], given: TomlTable) -> list[str]:
    """Return a message for each argument that `make` requires and `given` lacks."""
    needed = [key for key, value in inspect.signature(make).parameters.items() if value.default is value.empty]
    return [f"{where}.{key}: missing" for key in needed if key not in given]


def _pose(path: str, row: Any, units: Units, problems: list[str]) -> list[Any]:
    if not isinstance(row, list) or len(row) != 3:
        problems.append(f"{path}: must be x, y and an angle")
        return [0.0] * 3
    return [
        units.convert(f"{path}[{k}]", x, unit, problems) for k, (x, unit) in enumerate(zip(row, ("m", "m", "rad"), strict=True))
    ]


def _unit_of(coordinate: str) -> str:
    return "rad" if str(coordinate).endswith("angle") else "m"


def _driven_unit(mechanism: Mechanism) -> str:
    angles = [driver.coordinate == "angle" for driver in mechanism.drivers.values()]
    return "rad" if all(angles) else "m"


def _read_bounds(mechanism: Mechanism, table: Any, units: Units, problems: list[str]) -> dict[str, Any]:
    if not isinstance(table, Mapping):
        problems.append('bounds must be a table, such as "pin.A" = [[0, 0], [50, 50]]')
        return {}
    return {
        key: units.convert(f"bounds.{key}", ends, "m" if key.startswith("pin.") else "", problems) for key, ends in table.items()
    }


def _read_lengths(tables: Any, units: Units, problems: list[str]) -> dict[tuple[str, str], tuple[float, float]]:
    ranges = {}
    for k, table in enumerate(tables):
        where = f"length[{k}]"
        problems += [f"{where}.{key}: {unknown_key(key, LENGTH_KEYS)}" for key in table if key not in LENGTH_KEYS]
        pins = table.get("pins")
        if not isinstance(pins, list) or len(pins) != 2 or not all(isinstance(pin, str) for pin in pins):
            problems.append(f'{where}.pins: must name two pins, such as ["A", "B"]')
            continue
        least = units.convert(f"{where}.least", table.get("least", 0.0), "m", problems)
        most = units.convert(f"{where}.most", table.get("most", float("inf")), "m", problems)
        ranges[tuple(pins)] = (least, most)
    return ranges
