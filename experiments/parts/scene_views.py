"""The same scene in another view: moved, turned, mirrored, delayed, in other units, with other names, orders and copies."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np

from experiments.parts.random_scenes import RandomScene, Table


def moved(scene: RandomScene, angle: float, shift: np.ndarray) -> RandomScene:
    """Return a scene that is turned and moved as a whole, with gravity."""
    table = copy.deepcopy(scene.table)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    table["gravity"] = (turn @ table["gravity"]).tolist()
    for body in table["body"]:
        body["position"] = (turn @ body["position"] + shift).tolist()
        body["velocity"] = (turn @ body["velocity"]).tolist()
        body["angle"] += angle
    for entry in (*table["joint"], *table["driver"], *table["force"]):
        kind, on = entry.get("type", ""), entry.get("bodies", [])
        if kind == "force" and entry["frame"] == "ground":
            entry["vector"] = (turn @ entry["vector"]).tolist()
        if kind == "zone":
            entry["direction"] = (turn @ entry["direction"]).tolist()
            entry["level"] += float(np.dot(entry["direction"], shift))
        for k, name in enumerate(on):
            if name == "ground" and "points" in entry:
                entry["points"][k] = (turn @ entry["points"][k] + shift).tolist()
        if "axis" in entry and on[0] == "ground":
            entry["axis"] += angle
        if kind == "cam" and on[0] == "ground":
            entry["profile"]["angle"] = [x + angle for x in entry["profile"]["angle"]]
        if kind in _TURNS:
            entry[_TURNS[kind]] = entry.get(_TURNS[kind], 0.0) + _turn_of(on) * angle
        if entry.get("coordinate") == "angle":
            _change_law(entry["motion"], 1.0, _turn_of(on) * angle)
    joints = {joint["name"]: joint for joint in table["joint"]}
    for event in table.get("event", []):
        _change_limits(event, joints, 1.0, lambda on: _turn_of(on) * angle)
        for key in ("normal", "direction"):
            if key in event:
                event[key] = (turn @ event[key]).tolist()
        if "through" in event:
            event["through"] = (turn @ event["through"] + shift).tolist()
        if event["type"] == "level":
            event["level"] += float(np.dot(event["direction"], shift))
        if "attaches" in event:
            on, points = event["attaches"]
            event["attaches"] = on, [(turn @ p + shift).tolist() if b == "ground" else p for b, p in zip(on, points, strict=True)]
    return scene._replace(table=table)


# The numbers of force elements that are angles between bodies.
_TURNS = {"torsion_spring": "angle", "bumper": "limit", "servo": "target"}


def _turn_of(on: list[str]) -> float:
    """Return by how much the angle between two bodies grows when everything but the ground turns by 1."""
    return float(on[0] == "ground") - float(on[1] == "ground")


def _change_law(motion: Table, factor: float, offset: float) -> None:
    """Multiply the values of a driver's motion, and add to them."""
    if "coefficients" in motion:
        motion["coefficients"] = [factor * c + offset * (k == 0) for k, c in enumerate(motion["coefficients"])]
    if "values" in motion:
        motion["values"] = [factor * x + offset for x in motion["values"]]
    if motion["type"] == "sine":
        motion["amplitude"] *= factor
        motion["offset"] = factor * motion.get("offset", 0.0) + offset


def _change_limits(event: Table, joints: dict[str, Table], factor: float, offset: Callable[[list[str]], float]) -> None:
    if event["type"] == "limit" and joints[event["joint"]]["type"] == "revolute":
        ends = [factor * event[key] + offset(joints[event["joint"]]["bodies"]) for key in ("lower", "upper")]
        event["lower"], event["upper"] = min(ends), max(ends)


def can_be_turned(table: Table) -> bool:
    """Return True if no element is tied to the axes or the origin of the ground."""
    axes = [e for e in table["driver"] if e["coordinate"] in ("x", "y") and e["bodies"][0] == "ground"]
    return not axes and not any(e["type"] == "rack" and e["bodies"][1] == "ground" for e in table["joint"])


def mirrored(scene: RandomScene) -> RandomScene:
    """Return a scene with -x for each x, of the plane and of all bodies: angles and torques change their sign."""
    table = copy.deepcopy(scene.table)

    def flip(point: Any) -> Any:
        return [-point[0], point[1]]

    table["gravity"] = flip(table["gravity"])
    for body in table["body"]:
        body["position"], body["velocity"] = flip(body["position"]), flip(body["velocity"])
        body["angle"], body["angular_velocity"] = -body["angle"], -body["angular_velocity"]
    for entry in (*table["joint"], *table["driver"], *table["force"]):
        kind = entry.get("type", "")
        if "points" in entry:
            entry["points"] = [flip(p) for p in entry["points"]]
        for key in ("vector", "direction", "point"):
            if key in entry:
                entry[key] = flip(entry[key])
        if "axis" in entry:  # a rack keeps its sense of rolling along the opposite axis
            entry["axis"] = -entry["axis"] if kind == "rack" else np.pi - entry["axis"]
        if kind == "cam":
            profile = entry["profile"]
            profile["angle"], profile["radius"] = [np.pi - x for x in profile["angle"][::-1]], profile["radius"][::-1]
        for key in (_TURNS.get(kind), "side" if kind == "bumper" else None):
            if key in entry:
                entry[key] = -entry[key]
        if kind == "torque":
            _scale_value(entry, -1.0)
        if entry.get("coordinate") in ("angle", "x"):
            _change_law(entry["motion"], -1.0, 0.0)
    joints = {joint["name"]: joint for joint in table["joint"]}
    for event in table.get("event", []):
        _change_limits(event, joints, -1.0, lambda _: 0.0)
        for key in ("point", "through", "normal", "direction"):
            if key in event:
                event[key] = flip(event[key])
        if "attaches" in event:
            event["attaches"] = event["attaches"][0], [flip(p) for p in event["attaches"][1]]
    return scene._replace(table=table)


def _scale_value(entry: Table, factor: float) -> None:
    """Multiply a torque, or its samples."""
    if isinstance(entry["value"], dict):
        entry["value"]["values"] = [factor * x for x in entry["value"]["values"]]
    else:
        entry["value"] *= factor


def delayed(scene: RandomScene, time: float) -> RandomScene:
    """Return a scene whose laws and events are later by some time: its motion begins as the other does at t = 0."""
    table = copy.deepcopy(scene.table)
    for driver in table["driver"]:
        motion = driver["motion"]
        if motion["type"] == "polynomial":
            law = np.polynomial.Polynomial(motion["coefficients"])(np.polynomial.Polynomial([-time, 1.0]))
            motion["coefficients"] = law.coef.tolist()
        elif motion["type"] == "sine":
            motion["phase"] = motion.get("phase", 0.0) - motion["frequency"] * time
        else:
            motion["times"] = [x + time for x in motion["times"]]
    for force in table["force"]:
        if isinstance(force.get("value"), dict):
            force["value"]["t0"] += time
    for event in table.get("event", []):
        if event["type"] == "clock":
            event["time"] += time
    return scene._replace(table=table)


def in_units(scene: RandomScene, length: float, time: float, mass: float) -> RandomScene:
    """Return a scene whose numbers are those of other units: lengths `length` times as large, ..."""
    table, L, T, M = copy.deepcopy(scene.table), length, time, mass
    scale: Callable[[Any, float], Any] = lambda x, by: [scale(y, by) for y in x] if isinstance(x, list) else x * by  # noqa: E731

    def change(entry: Table, **units: float) -> None:
        for key, unit in units.items():
            if key in entry:
                entry[key] = scale(entry[key], unit)

    change(table, gravity=L / T**2)
    for body in table["body"]:
        change(body, mass=M, inertia=M * L**2, position=L, velocity=L / T, angular_velocity=1 / T)
    for joint in table["joint"]:
        change(joint, points=L, length=L, radii=L, radius=L)
        change(joint.get("profile", {}), radius=L)
    for driver in table["driver"]:
        unit, motion = (1.0 if driver["coordinate"] == "angle" else L), driver["motion"]
        change(driver, points=L)
        change(motion, amplitude=unit, offset=unit, values=unit, frequency=1 / T, times=T)
        if "coefficients" in motion:
            motion["coefficients"] = [c * unit / T**k for k, c in enumerate(motion["coefficients"])]
    F = M * L / T**2
    for force in table["force"]:
        match force["type"]:
            case "spring":
                change(force, points=L, stiffness=F / L, length=L, damping=F * T / L)
            case "torsion_spring" | "bumper" | "servo" | "square_drag":
                change(force, stiffness=F * L, damping=F * L * T, most=F * L, drag=F * L * T**2)
            case "friction":
                change(force, torque=F * L, velocity=1 / T, radius=L, length=L, speed=L / T, viscous=T / L)
            case "torque":
                _scale_value(force, F * L)
                if isinstance(force["value"], dict):
                    change(force["value"], dt=T, t0=T)
            case "zone":
                change(force, force=F, level=L)
            case _:
                change(force, vector=F, point=L)
    slides = {joint["name"] for joint in table["joint"] if joint["type"] in ("prismatic", "slot")}
    for event in table.get("event", []):
        change(event, point=L, through=L, level=L, time=T)
        if event.get("joint") in slides:
            change(event, lower=L, upper=L)
        if "attaches" in event:
            event["attaches"] = event["attaches"][0], scale(event["attaches"][1], L)
    return RandomScene(table, scene.seed, scene.length * L, scene.time * T, scene.mass * M)


def renamed(table: Table, new: Callable[[str], str]) -> Table:
    """Return a table with new names of everything but the ground."""
    table = copy.deepcopy(table)
    change = lambda name: name if name == "ground" else new(name)  # noqa: E731
    for section in ("body", "joint", "driver", "force"):
        for entry in table[section]:
            entry["name"] = change(entry["name"])
            for key in ("body", "carrier", "joint"):
                if key in entry:
                    entry[key] = change(entry[key])
            if "bodies" in entry:
                entry["bodies"] = [change(name) for name in entry["bodies"]]
    return table


def permuted(table: Table, rng: np.random.Generator) -> Table:
    """Return a table with its bodies, joints, forces and events in another order."""
    table = copy.deepcopy(table)
    for section in ("body", "joint", "force", "event"):
        if section in table:
            table[section] = [table[section][k] for k in rng.permutation(len(table[section]))]
    return table


def with_copies(table: Table, rng: np.random.Generator) -> Table:
    """Return a table in which joints and drivers are given once more, up to four times, anywhere among the others."""
    table = copy.deepcopy(table)
    for section in ("joint", "driver"):
        for entry in list(table[section]):
            for k in range(int(rng.integers(0, 4))):
                copied = copy.deepcopy(entry) | {"name": f"{entry['name']} copy {k}"}
                table[section].insert(int(rng.integers(0, len(table[section]) + 1)), copied)
    return table
