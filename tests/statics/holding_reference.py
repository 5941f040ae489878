"""Bounds of holding efforts by free bodies and SciPy's linear programs, and random scenes at rest to compare.

Nothing here uses the package's equations: joints are drawn as forces on free bodies in the scene's own position. Unknown are the
forces of joints, the friction, and the effort; where friction depends on the size of a force, its direction is guessed, and the
program is repeated with the direction it found, from many guesses.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import linprog

import udkjax as udk

ROUNDS = 40
Vector = np.ndarray | tuple[np.ndarray, np.ndarray]  # columns of a force's components; of one component, with their factors


class FreeBodies:
    """Equilibrium of all bodies of a scene in its initial position: rows (x, y, torque about the origin) of each body."""

    def __init__(self, mechanism: udk.Mechanism, body: str, coordinate: str):
        self.names = list(mechanism.body_names)
        self.pose = {n: (np.asarray(b.position, float), float(b.angle)) for n, b in mechanism.bodies.items()}
        self.pose["ground"] = (np.zeros(2), 0.0)
        self.columns: list[np.ndarray] = []
        self.limits: list[tuple[int, float, float, Sequence[Vector]]] = []  # friction: column, constant, factor, vectors
        self.joint_columns: dict[str, Any] = {}
        for name, joint in mechanism.joints.items():
            self._joint(name, joint)
        for friction in mechanism.forces.values():
            if isinstance(friction, udk.Friction):
                self._friction(mechanism, friction)
        effort = np.zeros(3 * len(self.names))
        at = self.names.index(body)
        effort[3 * at + 2] = 1.0 if coordinate == "angle" else 0.0
        if coordinate in "xy":
            effort[3 * at : 3 * at + 3] = self._wrench(self.pose[body][0], np.eye(2)["xy".index(coordinate)])
        self.effort = len(self.columns)
        self.columns.append(effort)
        self.loads = np.zeros(3 * len(self.names))
        g = np.asarray(mechanism.gravity, float)
        for k, name in enumerate(self.names):
            self.loads[3 * k : 3 * k + 3] += self._wrench(self.pose[name][0], float(mechanism.bodies[name].mass) * g)
        for force in mechanism.forces.values():
            if isinstance(force, udk.Force):
                k = self.names.index(force.body)
                point = self._place(force.body, np.asarray(force.point, float))
                self.loads[3 * k : 3 * k + 3] += self._wrench(point, np.asarray(force.vector, float))
            elif isinstance(force, udk.Torque):
                assert not isinstance(force.value, udk.Held)
                self.loads += self._pair(force.bodies, np.zeros(2), np.zeros(2), float(force.value))

    def _place(self, body: str, point: np.ndarray) -> np.ndarray:
        position, angle = self.pose[body]
        c, s = np.cos(angle), np.sin(angle)
        return position + np.array([[c, -s], [s, c]]) @ point

    @staticmethod
    def _wrench(point: np.ndarray, force: np.ndarray) -> np.ndarray:
        return np.array([*force, point[0] * force[1] - point[1] * force[0]])

    def _pair(self, bodies: Any, point: np.ndarray, force: np.ndarray, torque: float = 0.0) -> np.ndarray:
        """Return a force and torque on the second body, and the opposite on the first."""
        column = np.zeros(3 * len(self.names))
        for body, sign in zip(bodies, (-1.0, 1.0), strict=True):
            if body != "ground":
                k = self.names.index(body)
                column[3 * k : 3 * k + 3] += sign * (self._wrench(point, force) + [0.0, 0.0, torque])
        return column

    def _add(self, column: np.ndarray) -> int:
        self.columns.append(column)
        return len(self.columns) - 1

    def _joint(self, name: str, joint: Any) -> None:
        bodies = joint.bodies
        point = self._place(bodies[1], np.asarray(joint.points[1], float))
        if isinstance(joint, udk.Revolute):
            self.joint_columns[name] = point, [self._add(self._pair(bodies, point, e)) for e in np.eye(2)]
            return
        angle = self.pose[bodies[0]][1] + float(joint.axis)
        along, normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        own = [self._add(self._pair(bodies, point, normal))]
        if isinstance(joint, udk.Prismatic):
            own.append(self._add(self._pair(bodies, point, np.zeros(2), 1.0)))
        self.joint_columns[name] = point, own, along

    def _friction(self, mechanism: udk.Mechanism, friction: udk.Friction) -> None:
        joint = mechanism.joints[friction.joint]
        point, own, *along = self.joint_columns[friction.joint]
        constant = 0.0 if friction.torque is None else float(friction.torque)
        mu = 0.0
        if friction.coefficient is not None:
            mu = float(friction.coefficient if friction.static_coefficient is None else friction.static_coefficient)
        if isinstance(joint, udk.Revolute):
            column = self._add(self._pair(joint.bodies, point, np.zeros(2), 1.0))
            radius = 0.0 if friction.radius is None else float(friction.radius)
            self.limits.append((column, constant, mu * radius, [np.array(own)]))
            return
        column = self._add(self._pair(joint.bodies, point, along[0]))
        if friction.length is None:
            self.limits.append((column, constant, mu, [np.array(own[:1])]))
        else:
            ends = [(np.array(own), np.array([0.5, side / float(friction.length)])) for side in (1.0, -1.0)]
            self.limits.append((column, constant, mu, ends))

    def bound(self, sign: float, seed: int = 0, guesses: int = 24, least: bool = False) -> float:
        """Return the largest `sign` times effort that is found from many guessed directions; `least`: no internal loads."""
        E = np.stack(self.columns, 1)
        scale = np.abs(self.loads).max() or 1.0
        rest = [k for k in range(E.shape[1]) if k not in [c for c, *_ in self.limits]]
        exact = np.zeros(E.shape[1])
        exact[rest] = np.linalg.lstsq(E[:, rest], -self.loads, rcond=1e-10)[0]
        c = np.zeros(E.shape[1])
        c[self.effort] = -sign
        random = np.random.default_rng(seed)
        best = sign * exact[self.effort]
        slides = [len(v[0]) == 1 or isinstance(v[0], tuple) for *_, v in self.limits]
        counts = [len(v) for (*_, v), slide in zip(self.limits, slides, strict=True) if slide]
        signs = list(itertools.product((1.0, -1.0), repeat=sum(counts)))
        for k in range(guesses):
            x, direction = exact, None
            if k:
                choice = iter(signs[k % len(signs)])
                direction = []
                for (*_, vectors), slide in zip(self.limits, slides, strict=True):
                    if slide:
                        direction.append([np.array([next(choice)]) for _ in vectors])
                    else:
                        a = random.uniform(0, 2 * np.pi)
                        direction.append([np.array([np.cos(a), np.sin(a)])])
            value = -np.inf
            for _ in range(ROUNDS):
                rows, right = [], []
                for j, (column, constant, factor, vectors) in enumerate(self.limits):
                    tangent = np.zeros(E.shape[1])
                    for i, vector in enumerate(vectors):
                        at, size = (vector[0], vector[1]) if isinstance(vector, tuple) else (vector, None)
                        load = np.array([size @ x[at]]) if size is not None else x[at]
                        d = direction[j][i] if direction is not None else load / (np.linalg.norm(load) or 1.0)
                        tangent[at] += d[0] * size if size is not None else d
                    for side in (1.0, -1.0):
                        row = -factor * tangent
                        row[column] += side
                        rows.append(row)
                        right.append(constant)
                feasible = np.array(rows) @ exact <= np.array(right) + 1e-12 * scale
                if direction is not None and not feasible.all() and not self.redundant:
                    break
                direction = None
                found = linprog(
                    c,
                    np.array(rows),
                    np.array(right) / scale,
                    E,
                    -self.loads / scale,
                    (None, None),
                    "highs",
                    options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
                )
                if found.status == 3:
                    return np.inf
                if found.status != 0:
                    break
                new = -found.fun * scale
                x = found.x * scale
                if new <= value + 1e-12 * abs(new):
                    break
                value = new
            best = max(best, value)
        return best

    @property
    def redundant(self) -> int:
        """The number of independent internal loads."""
        rest = [k for k in range(len(self.columns)) if k not in [c for c, *_ in self.limits]]
        E = np.stack([self.columns[k] for k in rest], 1)
        return len(rest) - int(np.linalg.matrix_rank(E, 1e-9 * np.linalg.norm(E)))


def random_scene(seed: int) -> tuple[udk.Mechanism, str]:
    """Return a random mechanism of one degree of freedom at rest with friction, and the coordinate that holds it."""
    random = np.random.default_rng(seed)
    kind = ("slider crank", "four bar", "wedge", "six bar", "cranks", "double guide", "cranks and slider")[seed % 7]
    bodies: dict[str, Any] = {}
    joints: dict[str, Any] = {}

    def inertia() -> tuple[float, float]:
        mass = 10 ** random.uniform(-4, 1.5)
        return mass, mass * random.uniform(0.03, 0.2) ** 2

    def rod(name: str, a: np.ndarray, b: np.ndarray) -> None:
        d = b - a
        bodies[name] = udk.Body(*inertia(), (a + b) / 2, np.arctan2(d[1], d[0]))

    def block(name: str, at: np.ndarray, angle: float = 0.0) -> None:
        bodies[name] = udk.Body(*inertia(), at, angle)

    def local(body: str, place: np.ndarray) -> list[float]:
        if body == "ground":
            return list(place)
        b = bodies[body]
        a = float(b.angle)
        c, s = np.cos(a), np.sin(a)
        return list(np.array([[c, s], [-s, c]]) @ (place - np.asarray(b.position)))

    def pin(name: str, a: str, b: str, at: np.ndarray) -> None:
        joints[name] = udk.Revolute([a, b], [local(a, at), local(b, at)])

    def slide(name: str, a: str, b: str, at: np.ndarray, angle: float, kind: Any = None) -> None:
        turn = float(bodies[a].angle) if a != "ground" else 0.0
        joints[name] = (kind or udk.Prismatic)([a, b], [local(a, at), local(b, at)], axis=angle - turn)

    def polar(r: float, angle: float) -> np.ndarray:
        return r * np.array([np.cos(angle), np.sin(angle)])

    u = random.uniform
    drive = "body.crank.angle"
    if kind in ("slider crank", "double guide", "six bar"):
        A = np.zeros(2)
        B = polar(u(0.1, 0.3), u(0.4, 2.7) * random.choice([-1, 1]))
        C = B + polar(u(0.4, 0.7), u(-0.6, 0.6))
        rod("crank", A, B)
        rod("rod", B, C)
        block("slider", C)
        pin("A", "ground", "crank", A)
        pin("B", "crank", "rod", B)
        pin("C", "rod", "slider", C)
        way = u(-0.2, 0.2)
        slide("S", "ground", "slider", C + polar(u(-0.02, 0.02), 1.0), way)
        if kind == "double guide":
            slide("S2", "ground", "slider", C + polar(u(0.05, 0.1), way), way)
        if kind == "six bar":
            D, E = B + 0.6 * (C - B) + polar(0.1, u(0, 6)), np.array([0.3, -0.5]) + polar(0.1, u(0, 6))
            rod("link", D, E)
            block("other", E, 0.3)
            pin("D", "rod", "link", D)
            pin("E", "link", "other", E)
            slide("T", "ground", "other", E, u(-1.0, 1.0))
    elif kind in ("four bar", "cranks", "cranks and slider"):
        A, B = np.zeros(2), polar(0.2, u(0.4, 2.7) * random.choice([-1, 1]))
        if kind == "four bar":
            C, D = np.array([0.5, 0.35]) + polar(0.1, u(0, 6)), np.array([0.6, 0.0])
            rod("crank", A, B)
            rod("rod", B, C)
            rod("rocker", D, C)
            pin("A", "ground", "crank", A)
            pin("B", "crank", "rod", B)
            pin("C", "rod", "rocker", C)
            pin("D", "ground", "rocker", D)
        else:
            places = [np.array([x, 0.0]) for x in (0.0, u(0.3, 0.6), u(0.7, 1.0))]
            for name, place in zip(("crank", "second", "third"), places, strict=True):
                rod(name, place, place + B)
            rod("bar", B, places[2] + B)
            for name, letter, place in zip(("crank", "second", "third"), "ABC", places, strict=True):
                pin(letter, "ground", name, place)
                pin(letter + "2", name, "bar", place + B)
            if kind == "cranks and slider":
                E = places[2] + B + polar(0.5, u(-0.5, 0.5))
                rod("rod", places[2] + B, E)
                block("slider", E)
                pin("D", "bar", "rod", places[2] + B)
                pin("E", "rod", "slider", E)
                slide("S", "ground", "slider", E, u(-0.3, 0.3))
    else:
        drive = "body.wedge.x"
        slope = u(0.03, 1.0)
        block("wedge", np.array([0.0, 0.0]))
        block("nut", np.array([u(-0.05, 0.05), 0.3]))
        slide("floor", "ground", "wedge", np.array([u(-0.1, 0.1), -0.05]), u(-0.1, 0.1))
        slide("guide", "ground", "nut", np.array([0.1, u(0.25, 0.35)]), np.pi / 2 + u(-0.2, 0.2))
        slide("thread", "wedge", "nut", np.array([u(-0.05, 0.05), 0.15]), -slope, udk.Slot)
    forces: dict[str, Any] = {}
    for k, (name, joint) in enumerate(joints.items()):
        if random.random() < 0.8 and (kind != "cranks and slider" or name in "DES"):
            mu = u(0.02, 0.3)
            given: dict[str, Any] = {"coefficient": mu, "law": "set-valued"}
            if random.random() < 0.3:
                given["static_coefficient"] = mu * u(1.0, 1.5)
            if isinstance(joint, udk.Revolute):
                given["radius"] = u(0.002, 0.03)
                if random.random() < 0.4:
                    given["torque"] = u(0.0, 0.3)
            elif isinstance(joint, udk.Prismatic) and random.random() < 0.5:
                given["length"] = u(0.1, 0.3)
            forces[f"rub{k}"] = udk.Friction(name, **given)
    for k, body in enumerate(bodies):
        if random.random() < 0.6:
            forces[f"load{k}"] = udk.Force(body, list(polar(u(1.0, 100.0), u(0, 6.3))), list(polar(0.03, u(0, 6.3))))
    if not any(isinstance(x, udk.Friction) for x in forces.values()):
        name = next(iter(joints))
        given = {"radius": 0.01} if isinstance(joints[name], udk.Revolute) else {}
        forces["rub"] = udk.Friction(name, coefficient=0.2, law="set-valued", **given)
    return udk.Mechanism(bodies, joints, forces=forces, gravity=[0.0, -9.81]), drive
