"""Random mechanisms, closed by construction: bodies are thrown into the plane, and joints are put where the bodies are.

A scene is a table as in a scene file. It is closed at t = 0, its velocities are those that its constraints allow, and its
redundant rows agree. Generators that are seeded serve better here than hypothesis's strategies: ten thousand mechanisms take
minutes, a case is drawn again from the three numbers that a failure prints, whatever else is drawn, and scenes of one structure
with other numbers are one compilation. What hypothesis would shrink, `shrunk` does: it takes elements away while a failure lasts.
"""

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

import udkjax as udk
from experiments.parts.reference_equations import closed_spline, evaluate
from udkjax.scene.tables.schema import CLASSES_BY_TYPE, SECTIONS

Table = dict[str, Any]

# Rows of each type, and how often it is drawn.
ROWS = {"revolute": 2, "prismatic": 2, "slot": 1, "weld": 3, "distance": 1, "angle": 1, "gear": 1, "rack": 1, "cam": 1}
WEIGHTS = (0.46, 0.1, 0.09, 0.05, 0.1, 0.04, 0.05, 0.05, 0.06)
COORDINATES = ("angle", "x", "y", "distance")
FORCES = ("spring", "torsion_spring", "force", "torque", "friction")
DECADES = {"length": (-6.0, 3.0), "time": (-2.0, 2.0), "mass": (-4.0, 4.0)}  # of m, s, kg
CONSISTENT = 1e-9  # relative: what the constraints ask for beyond it contradicts itself


class RandomScene(NamedTuple):
    """A scene, the three numbers that it is drawn from again (seed, structure, numbers), and its own units (m, s, kg)."""

    table: Table
    seed: tuple[int, int, int]
    length: float
    time: float
    mass: float

    @property
    def label(self) -> str:
        """The call that draws it again."""
        return f"random_scene{self.seed}"


def random_scene(seed: int, structure: int, numbers: int, bodies: tuple[int, int] = (1, 6), forces: bool = True) -> RandomScene:
    """Draw a mechanism.

    Args:
        seed: Of the whole series.
        structure: Of its topology: bodies, types, copies of constraints, drivers and forces.
        numbers: Of its numbers; scenes that differ in these alone are one compilation.
        bodies: How many there are at least, and at most.
        forces: Whether it has force elements.

    Returns:
        The scene, closed at t = 0 and moving as its constraints allow.
    """
    draw = _Draw(np.random.default_rng([seed, structure]), np.random.default_rng([seed, structure, numbers, 1]), bodies, forces)
    table = draw.scene()
    if not _moves(table, draw):  # a driver moves what joints hold
        table["driver"] = []
        _moves(table, draw)
    return RandomScene(table, (seed, structure, numbers), draw.length, draw.time, draw.mass)


def build(table: Table) -> udk.Mechanism:
    """Make a mechanism of a table, in Python: what reading it from a file makes."""
    made: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
    for section in SECTIONS:
        for number, entry in enumerate(table.get(section, []), 1):
            keys = {key: value for key, value in entry.items() if key not in ("name", "type")}
            if section == "driver":
                motion = keys["motion"]
                law = CLASSES_BY_TYPE["motion"][motion["type"]]
                keys["motion"] = law(**{key: value for key, value in motion.items() if key != "type"})
            cls = {"body": udk.Body, "driver": udk.Driver}.get(section) or CLASSES_BY_TYPE[section][entry["type"]]
            made[section][entry.get("name", f"{section}{number}")] = cls(**keys)
    return udk.Mechanism(made["body"], made["joint"], made["driver"], made["force"], table["gravity"], table.get("name", ""))


def state_of(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return q and v (bodies, 3) of a table."""
    bodies = table["body"]
    q = np.array([[*b["position"], b["angle"]] for b in bodies], float)
    return q, np.array([[*b["velocity"], b["angular_velocity"]] for b in bodies], float)


def shrunk(table: Table, fails: Callable[[Table], bool]) -> Table:
    """Take away elements, and bodies with all that hangs on them, as long as `fails` stays true; return the smallest table."""
    for smaller in _smaller(table):
        try:
            still = fails(smaller)
        except Exception:
            still = False
        if still:
            return shrunk(smaller, fails)
    return table


def _smaller(table: Table) -> Iterator[Table]:
    for body in table["body"] if len(table["body"]) > 1 else []:
        rest = copy.deepcopy(table)
        rest["body"] = [b for b in rest["body"] if b["name"] != body["name"]]
        for section in ("joint", "driver", "force"):
            rest[section] = [
                e for e in rest[section] if body["name"] not in (*e.get("bodies", ()), e.get("body"), e.get("carrier"))
            ]
        names = [j["name"] for j in rest["joint"]]
        rest["force"] = [f for f in rest["force"] if f.get("joint", names[:1] and names[0]) in names or "joint" not in f]
        yield rest
    for section in ("force", "driver", "joint"):
        for k, element in enumerate(table[section]):
            if section == "joint" and any(f.get("joint") == element["name"] for f in table["force"]):
                continue
            rest = copy.deepcopy(table)
            del rest[section][k]
            yield rest


def _moves(table: Table, draw: "_Draw") -> bool:
    """Give the bodies velocities that the constraints allow; tell whether there are any, and accelerations, too."""
    q, _ = state_of(table)
    speed = np.array([draw.length, draw.length, 1.0]) / draw.time
    at_rest = evaluate(table, 0.0, q, 0 * q)
    v = (draw.velocity.reshape(-1, 3) * speed).ravel()
    if len(at_rest.psi):
        unit = np.tile(speed, len(q))
        row = np.max(abs(at_rest.psi_q * unit), axis=1, initial=0.0)
        A = at_rest.psi_q * unit / row[:, None]
        for _ in range(2):
            rate = (at_rest.psi_q @ v + at_rest.psi_dot) / row
            v = v - unit * np.linalg.lstsq(A, rate, rcond=1e-8)[0]
        rate = (at_rest.psi_q @ v + at_rest.psi_dot) / row
        moving = evaluate(table, 0.0, q, v.reshape(-1, 3))
        c = moving.gamma / row
        left = c - A @ np.linalg.lstsq(A, c, rcond=1e-8)[0]
        if max(abs(rate)) > CONSISTENT or max(abs(left)) > CONSISTENT * max(1.0, max(abs(c))):
            return False
    for body, (x, y, turn) in zip(table["body"], v.reshape(-1, 3), strict=True):
        body["velocity"], body["angular_velocity"] = [float(x), float(y)], float(turn)
    return True


class _Draw:
    """Random draws for one scene: `pick` decides on the structure, `of` gives numbers."""

    def __init__(self, pick: np.random.Generator, of: np.random.Generator, bodies: tuple[int, int], forces: bool):
        self.pick, self.of, self.forces = pick, of, forces
        self.length, self.time, self.mass = (10 ** of.uniform(*DECADES[unit]) for unit in ("length", "time", "mass"))
        self.count = int(pick.integers(bodies[0], bodies[1] + 1))
        self.names = [f"b{k}" for k in range(self.count)]
        n = self.count
        self.velocity = of.standard_normal(3 * n)
        place = self.length * np.sqrt(n) * of.uniform(-1.0, 1.0, (n, 2))
        self.poses: dict[str, tuple[np.ndarray, float]] = {"ground": (np.zeros(2), 0.0)}
        self.poses |= {name: (x, a) for name, x, a in zip(self.names, place, of.uniform(-np.pi, np.pi, n), strict=True)}

    def scene(self) -> Table:
        load = self.mass * self.length / self.time**2
        gravity = self.length / self.time**2 * self._direction() * float(self.pick.random() < 0.8)
        joints, motif = self._parallelogram() if self.count > 2 and self.pick.random() < 0.15 else ([], set())
        joints += [self._joint(self._holder(k), name) for k, name in enumerate(self.names) if name not in motif if self._is(0.9)]
        for _ in range(self.pick.integers(0, 3)):  # loops
            one, two = self.pick.choice(["ground", *self.names], 2, replace=False)
            joint = self._joint(str(one), str(two))
            if self._rows(joints) + ROWS[joint["type"]] < 3 * self.count:
                joints.append(joint)
        joints += self._redundant(joints)
        for k, joint in enumerate(joints):
            joint["name"] = f"j{k}"
        bodies = []
        for name in self.names:
            mass = self.mass * 10 ** self.of.uniform(-0.5, 0.5)
            inertia = mass * (self.length * self.of.uniform(0.2, 0.6)) ** 2
            x, angle = self.poses[name]
            bodies.append({"name": name, "mass": mass, "inertia": inertia, "position": x.tolist(), "angle": float(angle)})
            bodies[-1] |= {"velocity": [0.0, 0.0], "angular_velocity": 0.0}
        free = 3 * self.count - self._rows(joints)
        drivers = [self._driver(k) for k in range(min(int(self.pick.integers(0, 3)), max(free, 0)))]
        forces = [self._force(k, load, joints) for k in range(self.pick.integers(0, 4))] if self.forces else []
        return {"format": 1, "gravity": gravity.tolist(), "body": bodies, "joint": joints, "driver": drivers, "force": forces}

    def _is(self, probability: float) -> bool:
        return bool(self.pick.random() < probability)

    def _holder(self, k: int) -> str:
        return "ground" if k == 0 or self._is(0.3) else self.names[int(self.pick.integers(0, k))]

    def _rows(self, joints: list[Table]) -> int:
        return sum(ROWS[joint["type"]] for joint in joints)

    def _direction(self) -> np.ndarray:
        a = self.of.uniform(-np.pi, np.pi)
        return np.array([np.cos(a), np.sin(a)])

    def _near(self, *names: str) -> np.ndarray:
        """A point of the plane near some bodies."""
        middle = np.mean([self.poses[name][0] for name in names], axis=0)
        return middle + self.length * self.of.uniform(0.2, 0.8) * self._direction()

    def _local(self, name: str, point: np.ndarray) -> list[float]:
        x, a = self.poses[name]
        dx, dy = point - x
        return [float(np.cos(a) * dx + np.sin(a) * dy), float(np.cos(a) * dy - np.sin(a) * dx)]

    def _points(self, one: str, two: str, first: np.ndarray, second: np.ndarray) -> list[list[float]]:
        return [self._local(one, first), self._local(two, second)]

    def _joint(self, one: str, two: str) -> Table:
        kind = str(self.pick.choice(list(ROWS), p=WEIGHTS))
        if kind in ("gear", "rack", "angle") and self._is(0.3):
            kind = "revolute"
        return getattr(self, f"_{kind}")(one, two)

    def _revolute(self, one: str, two: str, kind: str = "revolute") -> Table:
        point = self._near(one, two)
        return {"type": kind, "bodies": [one, two], "points": self._points(one, two, point, point)}

    def _weld(self, one: str, two: str) -> Table:
        return self._revolute(one, two, "weld")

    def _slot(self, one: str, two: str, kind: str = "slot") -> Table:
        point, axis = self._near(one, two), self.of.uniform(-np.pi, np.pi)
        along = axis + self.poses[one][1]
        other = point + self.length * self.of.uniform(-1.0, 1.0) * np.array([np.cos(along), np.sin(along)])
        return {"type": kind, "bodies": [one, two], "points": self._points(one, two, point, other), "axis": float(axis)}

    def _prismatic(self, one: str, two: str) -> Table:
        return self._slot(one, two, "prismatic")

    def _distance(self, one: str, two: str) -> Table:
        first = self._near(one, two)
        second = first + self.length * self.of.uniform(0.4, 1.5) * self._direction()
        return {"type": "distance", "bodies": [one, two], "points": self._points(one, two, first, second)}

    def _angle(self, one: str, two: str) -> Table:
        return {"type": "angle", "bodies": [one, two]}

    def _gear(self, one: str, two: str) -> Table:
        radii = (self.length * self.of.uniform(0.2, 1.0, 2)).tolist()
        found = {"type": "gear", "bodies": [one, two], "radii": radii, "internal": self._is(0.4)}
        others = [name for name in self.names if name not in (one, two)]
        return found | ({"carrier": str(self.pick.choice(others))} if others and self._is(0.3) else {})

    def _rack(self, one: str, two: str) -> Table:
        axis = float(self.of.uniform(-np.pi, np.pi))
        return {"type": "rack", "bodies": [one, two], "radius": float(self.length * self.of.uniform(0.2, 1.0)), "axis": axis}

    def _cam(self, one: str, two: str) -> Table:
        knots = int(self.pick.integers(3, 8))
        step = self.of.uniform(0.7, 1.0, knots)
        angles = -2.0 + np.cumsum(step) * 2 * np.pi / knots * 0.95
        radii = self.length * self.of.uniform(0.8, 1.2, knots)
        centre, polar = self._near(one, two), self.of.uniform(-np.pi, np.pi)
        reach = closed_spline(angles, radii)(polar)
        along = polar + self.poses[one][1]
        follower = centre + reach * np.array([np.cos(along), np.sin(along)])
        profile = {"angle": angles.tolist(), "radius": radii.tolist()}
        return {"type": "cam", "bodies": [one, two], "points": self._points(one, two, centre, follower), "profile": profile}

    def _parallelogram(self) -> tuple[list[Table], set[str]]:
        """Equal parallel cranks, and the coupler that all of them carry: redundant by its numbers."""
        cranks, coupler = self.names[: int(self.pick.integers(2, self.count))], self.names[-1]
        angle, arm, along = self.of.uniform(-np.pi, np.pi), self.length * self.of.uniform(0.5, 1.0), self._direction()
        crank, joints = arm * np.array([np.cos(angle), np.sin(angle)]), []
        origin = self.length * self.of.uniform(-1.0, 1.0, 2)
        self.poses[coupler] = (origin + crank + self.length * self.of.uniform(-0.5, 0.5, 2), self.poses[coupler][1])
        for k, name in enumerate(cranks):
            pivot = origin + k * self.length * along
            self.poses[name] = (pivot + 0.5 * crank, angle)
            for one, two, point in (("ground", name, pivot), (name, coupler, pivot + crank)):
                joints.append({"type": "revolute", "bodies": [one, two], "points": self._points(one, two, point, point)})
        return joints, {*cranks, coupler}

    def _redundant(self, joints: list[Table]) -> list[Table]:
        """Copies of joints, and joints that others imply."""
        found = []
        for joint in joints:
            if self._is(0.15):
                found += [copy.deepcopy(joint) for _ in range(int(self.pick.integers(1, 3)))]
            one, two = joint["bodies"]
            if joint["type"] == "weld" and self._is(0.5):
                kind = str(self.pick.choice(["revolute", "distance", "angle", "slot", "weld"]))
                found.append(getattr(self, f"_{kind}")(one, two))
            elif joint["type"] == "revolute" and self._is(0.1):
                found.append(copy.deepcopy(joint) | {"type": "slot", "axis": float(self.of.uniform(-np.pi, np.pi))})
            elif joint["type"] == "prismatic" and self._is(0.3):
                same = copy.deepcopy(joint) | {"type": "slot"}
                found.append({"type": "angle", "bodies": [one, two]} if self._is(0.5) else same)
        return found

    def _driver(self, k: int) -> Table:
        one = "ground" if self._is(0.7) else str(self.pick.choice(self.names))
        two = str(self.pick.choice([name for name in self.names if name != one] or self.names))
        one = "ground" if one == two else one
        coordinate = str(self.pick.choice(COORDINATES))
        found: Table = {"name": f"d{k}", "bodies": [one, two], "coordinate": coordinate}
        first = self._near(one, two)
        second = first + self.length * self.of.uniform(0.4, 1.5) * self._direction()
        unit = 1.0 if coordinate == "angle" else self.length
        if coordinate == "angle":
            now = self.poses[two][1] - self.poses[one][1]
        else:
            found["points"] = self._points(one, two, first, second)
            d = second - first
            turned = np.array(self._local(one, self.poses[one][0] + d))
            now = float(np.hypot(*d)) if coordinate == "distance" else float(turned[("x", "y").index(coordinate)])
        return found | {"motion": self._motion(float(now), unit)}

    def _motion(self, now: float, unit: float) -> Table:
        kind = str(self.pick.choice(["polynomial", "sine", "spline"]))
        if kind == "polynomial":
            more = unit * self.of.standard_normal(int(self.pick.integers(0, 4)))
            return {"type": kind, "coefficients": [now, *(float(c / self.time**k) for k, c in enumerate(more, 1))]}
        if kind == "sine":
            size, phase = unit * self.of.uniform(0.1, 0.5), self.of.uniform(-np.pi, np.pi)
            rate = self.of.uniform(0.3, 2.0) / self.time
            offset = now - size * np.sin(phase)
            return {
                "type": kind,
                "amplitude": float(size),
                "frequency": float(rate),
                "phase": float(phase),
                "offset": float(offset),
            }
        times = self.time * (np.cumsum(self.of.uniform(0.5, 1.5, int(self.pick.integers(2, 6)))) - 1.2)
        values = unit * self.of.uniform(-0.5, 0.5, len(times))
        here = min(max(0.0, times[0]), times[-1])
        spline = (
            CubicSpline(times, values, bc_type="natural") if len(times) > 2 else CubicSpline(times, values, bc_type="clamped")
        )
        if len(times) == 2:
            start = values[0] - times[0] * np.diff(values)[0] / np.diff(times)[0]
        else:
            start = float(spline(here)) + float(spline(here, 1)) * (0.0 - here)
        return {"type": kind, "times": times.tolist(), "values": (values + now - start).tolist()}

    def _force(self, k: int, load: float, joints: list[Table]) -> Table:
        kind = str(self.pick.choice(FORCES))
        two = str(self.pick.choice(self.names))
        others = [name for name in ("ground", *self.names) if name != two]
        one = str(self.pick.choice(others))
        name, torque = {"name": f"f{k}", "type": kind}, load * self.length
        if kind == "spring":
            points = [(self.length * self.of.uniform(-0.5, 0.5, 2)).tolist() for _ in range(2)]
            stiffness, length = load / self.length * self.of.uniform(0.2, 2.0), self.length * self.of.uniform(0.0, 1.0)
            found = {"bodies": [one, two], "points": points, "stiffness": float(stiffness), "length": float(length)}
            damping = float(self.mass / self.time * self.of.uniform(0.0, 0.5))
            return name | found | ({"damping": damping} if self._is(0.5) else {})
        if kind == "torsion_spring":
            found = {
                "bodies": [one, two],
                "stiffness": float(torque * self.of.uniform(0.1, 1.0)),
                "angle": float(self.of.normal()),
            }
            damping = float(torque * self.time * self.of.uniform(0.0, 0.3))
            return name | found | ({"damping": damping} if self._is(0.5) else {})
        pins = [j["name"] for j in joints if j["type"] == "revolute"]
        if kind == "friction" and pins:
            torque, rate = torque * self.of.uniform(0.0, 0.5), self.of.uniform(0.1, 1.0) / self.time
            return name | {"joint": str(self.pick.choice(pins)), "torque": float(torque), "velocity": float(rate)}
        if kind == "torque":
            return name | {"bodies": [one, two], "value": float(torque * self.of.normal())}
        vector, point = (load * self.of.standard_normal(2)).tolist(), (self.length * self.of.uniform(-0.5, 0.5, 2)).tolist()
        frame = "body" if self._is(0.5) else "ground"
        return {"name": f"f{k}", "type": "force", "body": two, "vector": vector, "point": point, "frame": frame}
