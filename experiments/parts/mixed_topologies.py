"""Linkages and trees on which random features are hung: closed as drawn, in units of about a metre, a kilogram and a second."""

import copy
from typing import Any

import numpy as np

from experiments.parts.random_scenes import Table
from experiments.parts.reference_equations import closed_spline

TOPOLOGIES = ("chain", "four_bar", "slider_crank", "parallelogram", "tree")
TREE_JOINTS = {"revolute": 3, "prismatic": 1, "slot": 1, "distance": 1, "weld": 1, "rack": 1, "cam": 1, "none": 1}
LOOP_JOINTS = ("distance", "gear", "slot", "revolute")


def turn(angle: float) -> np.ndarray:
    """Return the matrix of a rotation."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


class Linkage:
    """Bodies and joints of one random topology: `pick` decides on its structure, `of` gives numbers."""

    def __init__(self, pick: np.random.Generator, of: np.random.Generator, topology: str | None = None):
        self.pick, self.of = pick, of
        self.bodies: dict[str, Table] = {}
        self.joints: dict[str, Table] = {}
        self.topology = str(pick.choice(TOPOLOGIES))
        self.topology = topology or self.topology
        getattr(self, f"_{self.topology}")()

    @property
    def names(self) -> list[str]:
        return list(self.bodies)

    @property
    def pins(self) -> list[str]:
        """Revolute joints that are neither copies nor close a loop of a tree."""
        return [name for name, j in self.joints.items() if j["type"] == "revolute" and name not in ("loop", "copy")]

    @property
    def slides(self) -> list[str]:
        return [name for name, j in self.joints.items() if j["type"] in ("prismatic", "slot") and name not in ("loop", "copy")]

    def angle(self, body: str) -> float:
        """Return the angle of a body, or of the ground."""
        return 0.0 if body == "ground" else self.bodies[body]["angle"]

    def place(self, body: str, point: Any) -> np.ndarray:
        """Return where a point of a body is in the plane."""
        if body == "ground":
            return np.array(point, float)
        return np.array(self.bodies[body]["position"]) + turn(self.angle(body)) @ np.array(point, float)

    def local(self, body: str, place: Any) -> list[float]:
        """Return a place in the plane as a point of a body."""
        if body == "ground":
            return [float(x) for x in place]
        return (turn(-self.angle(body)) @ (np.asarray(place) - self.bodies[body]["position"])).tolist()

    def coordinate(self, joint: str) -> float:
        """Return the coordinate of a pin (rad), or of a slide (m)."""
        entry = self.joints[joint]
        one, two = entry["bodies"]
        if entry["type"] == "revolute":
            return self.angle(two) - self.angle(one)
        gap = self.place(two, entry["points"][1]) - self.place(one, entry["points"][0])
        return float(gap @ turn(self.angle(one) + entry["axis"])[:, 0])

    def direction(self) -> np.ndarray:
        """Return a random unit vector."""
        return turn(self.of.uniform(-np.pi, np.pi))[:, 0]

    def near(self, size: float = 0.4) -> list[float]:
        """Return a random point of a body."""
        return self.of.uniform(-size, size, 2).tolist()

    def _body(self, name: str, place: Any, angle: float) -> None:
        mass, inertia = self.of.uniform(0.3, 2), self.of.uniform(0.02, 0.2)
        at_rest = {"velocity": [0.0, 0.0], "angular_velocity": 0.0}
        place = [float(x) for x in place]
        self.bodies[name] = {"name": name, "mass": mass, "inertia": inertia, "position": place, "angle": float(angle)} | at_rest

    def _bar(self, name: str, start: Any, end: Any) -> None:
        """A body between two places, with its centre beside the line and its frame at some angle to it."""
        start, end = np.array(start, float), np.array(end, float)
        along = np.arctan2(*(end - start)[::-1])
        centre = (start + end) / 2 + turn(along) @ self.of.uniform(-0.1, 0.1, 2)
        self._body(name, centre, along + self.of.uniform(-0.3, 0.3))

    def _joint(self, name: str, kind: str, one: str, two: str, place: Any, other: Any = None, **numbers: Any) -> None:
        points = [self.local(one, place), self.local(two, place if other is None else other)]
        self.joints[name] = {"name": name, "type": kind, "bodies": [one, two], "points": points, **numbers}

    def _chain(self) -> None:
        place, last = np.zeros(2), "ground"
        for k in range(int(self.pick.integers(1, 4))):
            end = place + self.direction() * self.of.uniform(0.4, 1.0)
            self._bar(f"b{k}", place, end)
            self._joint(f"j{k}", "revolute", last, f"b{k}", place)
            place, last = end, f"b{k}"

    def _four_bar(self) -> None:
        of = self.of
        first, last = np.zeros(2), np.array([of.uniform(0.8, 1.5), of.uniform(-0.2, 0.2)])
        crank = turn(of.uniform(0.4, 2.5))[:, 0] * of.uniform(0.25, 0.5)
        rocker = last + turn(of.uniform(0.6, 2.2))[:, 0] * of.uniform(0.6, 1.1)
        self._bar("b0", first, crank)
        self._bar("b1", crank, rocker)
        self._bar("b2", last, rocker)
        for k, (one, two, place) in enumerate(
            [("ground", "b0", first), ("b0", "b1", crank), ("b1", "b2", rocker), ("ground", "b2", last)]
        ):
            self._joint(f"j{k}", "revolute", one, two, place)

    def _slider_crank(self) -> None:
        of = self.of
        crank = turn(of.uniform(0.3, 2.8))[:, 0] * of.uniform(0.2, 0.45)
        slider = np.array([crank[0] + of.uniform(0.6, 1.2), of.uniform(-0.2, 0.2)])
        self._bar("b0", [0, 0], crank)
        self._bar("b1", crank, slider)
        self._body("b2", slider, 0.0)
        for k, (one, two, place) in enumerate([("ground", "b0", [0, 0]), ("b0", "b1", crank), ("b1", "b2", slider)]):
            self._joint(f"j{k}", "revolute", one, two, place)
        axis = of.uniform(-0.3, 0.3)
        guide = slider - turn(axis)[:, 0] * of.uniform(0.1, 0.5)
        self._joint("j3", "prismatic", "ground", "b2", guide, slider, axis=float(axis))

    def _parallelogram(self) -> None:
        count, crank = int(self.pick.integers(2, 4)), turn(self.of.uniform(0.4, 2.6))[:, 0] * self.of.uniform(0.4, 0.9)
        pivots = [np.array([0.6 * k, 0.1 * k]) for k in range(count)]
        self._bar("c", pivots[0] + crank, pivots[-1] + crank)
        for k, pivot in enumerate(pivots):
            self._bar(f"b{k}", pivot, pivot + crank)
            self._joint(f"j{k}", "revolute", "ground", f"b{k}", pivot)
            self._joint(f"k{k}", "revolute", f"b{k}", "c", pivot + crank)

    def _tree(self) -> None:
        pick, of = self.pick, self.of
        names = [f"b{k}" for k in range(int(pick.integers(2, 5)))]
        weights = np.array(list(TREE_JOINTS.values()), float)
        for k, name in enumerate(names):
            self._body(name, of.uniform(-1, 1, 2), of.uniform(-3, 3))
            holder = "ground" if k == 0 or pick.random() < 0.3 else names[int(pick.integers(0, k))]
            self._between(f"j{k}", str(pick.choice(list(TREE_JOINTS), p=weights / weights.sum())), holder, name)
        if pick.random() < 0.6:
            one, two = pick.choice(names, 2, replace=False)
            self._between("loop", str(pick.choice(LOOP_JOINTS)), str(one), str(two))
        if self.joints and pick.random() < 0.3:
            copied = list(self.joints)[int(pick.integers(0, len(self.joints)))]
            self.joints["copy"] = copy.deepcopy(self.joints[copied]) | {"name": "copy"}

    def _between(self, name: str, kind: str, one: str, two: str) -> None:
        of, pick = self.of, self.pick
        place = self.place(two, self.near(0.6))
        match kind:
            case "revolute" | "weld":
                self._joint(name, kind, one, two, place)
            case "prismatic" | "slot":
                axis = of.uniform(-3, 3)
                along = turn(self.angle(one) + axis)[:, 0] * of.uniform(-0.5, 0.5)
                self._joint(name, kind, one, two, place, place + along, axis=float(axis))
            case "distance":
                self._joint(name, kind, one, two, place, place + self.direction() * of.uniform(0.3, 1))
            case "gear":
                radii, internal = of.uniform(0.2, 1, 2).tolist(), bool(pick.random() < 0.5)
                self.joints[name] = {"name": name, "type": kind, "bodies": [one, two], "radii": radii, "internal": internal}
            case "rack":
                numbers = {"radius": float(of.uniform(0.2, 0.8)), "axis": float(of.uniform(-3, 3))}
                self.joints[name] = {"name": name, "type": kind, "bodies": [one, two], **numbers}
            case "cam":
                knots = int(pick.integers(4, 8))
                angles = (np.sort(of.uniform(0, 0.5, knots)) + np.arange(knots)) * 2 * np.pi / (knots + 0.5)
                radii = 0.5 * (1 + 0.15 * of.uniform(-1, 1, knots))
                polar = of.uniform(-3, 3)
                reach = closed_spline(angles, radii)(polar) * turn(self.angle(one) + polar)[:, 0]
                profile = {"angle": angles.tolist(), "radius": radii.tolist()}
                self._joint(name, kind, one, two, place, place + reach, profile=profile)
