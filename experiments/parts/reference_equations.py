"""Constraints and loads of a scene's table by NumPy alone: Taylor series of second order along straight motions.

Written from the scene format, without a line of the package: what its equations are held against. Along q + s w at t + s tau the
coefficients of s and s^2 of Psi are its derivative and half of its second derivative: with w a unit vector a column of Psi_q,
with w = v and tau = 1 Psi_dot and -gamma / 2. All directions are taken at once.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

Table = dict[str, Any]


class Terms(NamedTuple):
    """Psi, Psi_q, Psi_dot and gamma of all rows, joints first; the diagonal of M; loads, and those of them with a potential."""

    psi: np.ndarray
    psi_q: np.ndarray
    psi_dot: np.ndarray
    gamma: np.ndarray
    mass: np.ndarray
    force: np.ndarray
    potential: float
    conservative: np.ndarray


class Series:
    """a + b s + c s^2, arrays over directions."""

    __array_ufunc__ = None

    def __init__(self, a: Any, b: Any = 0.0, c: Any = 0.0):
        self.a, self.b, self.c = a, b, c

    def __add__(self, other: Any) -> "Series":
        if not isinstance(other, Series):
            return Series(self.a + other, self.b, self.c)
        return Series(self.a + other.a, self.b + other.b, self.c + other.c)

    def __neg__(self) -> "Series":
        return Series(-self.a, -self.b, -self.c)

    def __sub__(self, other: Any) -> "Series":
        if not isinstance(other, Series):
            return Series(self.a - other, self.b, self.c)
        return Series(self.a - other.a, self.b - other.b, self.c - other.c)

    def __rsub__(self, other: Any) -> "Series":
        return Series(other - self.a, -self.b, -self.c)

    def __mul__(self, other: Any) -> "Series":
        if not isinstance(other, Series):
            return Series(self.a * other, self.b * other, self.c * other)
        a, b, c = other.a, other.b, other.c
        return Series(self.a * a, self.a * b + self.b * a, self.a * c + self.b * b + self.c * a)

    __radd__, __rmul__ = __add__, __mul__

    def of(self, value: Any, slope: Any, curvature: Any) -> "Series":
        """Return f of the series, by f, f' and f'' at a."""
        return Series(value, slope * self.b, slope * self.c + 0.5 * curvature * self.b**2)


def _sin(x: Series) -> Series:
    return x.of(value := np.sin(x.a), np.cos(x.a), -value)


def _cos(x: Series) -> Series:
    return x.of(value := np.cos(x.a), -np.sin(x.a), -value)


def _sqrt(x: Series) -> Series:
    root = np.sqrt(x.a)
    return x.of(root, 0.5 / root, -0.25 / (root * x.a))


def _polar(x: Series, y: Series) -> Series:
    """The angle of a vector: its rate is (x y' - y x') / (x^2 + y^2)."""
    square = x.a**2 + y.a**2
    rate = (x.a * y.b - y.a * x.b) / square
    radial = 2 * (x.a * x.b + y.a * y.b) / square
    return Series(np.arctan2(y.a, x.a), rate, (x.a * y.c - y.a * x.c) / square - 0.5 * rate * radial)


def closed_spline(angles: Any, radii: Any) -> CubicSpline:
    """Return the periodic cubic spline through a cam's profile, over the polar angle."""
    around, closed = np.append(angles, angles[0] + 2 * np.pi), np.append(radii, radii[0])
    return CubicSpline(around, closed, bc_type="periodic", extrapolate="periodic")


def _law(motion: Table, t: Series) -> Series:
    if motion["type"] == "polynomial":
        value: Any = Series(0.0)
        for c in reversed(motion["coefficients"]):
            value = value * t + c
        return value
    if motion["type"] == "sine":
        return motion.get("offset", 0.0) + motion["amplitude"] * _sin(motion["frequency"] * t + motion.get("phase", 0.0))
    times, values = np.array(motion["times"]), np.array(motion["values"])
    if len(times) == 2:
        slope = (values[1] - values[0]) / (times[1] - times[0])
        return slope * (t - times[0]) + values[0]
    spline, within = CubicSpline(times, values, bc_type="natural"), np.clip(t.a, times[0], times[-1])
    curvature = spline(within, 2) * (within == t.a)
    return t.of(spline(within) + spline(within, 1) * (t.a - within), spline(within, 1), curvature)


class _Frame(NamedTuple):
    x: Any
    y: Any
    angle: Any
    cos: Any
    sin: Any

    def point(self, p: Any) -> tuple[Any, Any]:
        x, y = p
        if x == y == 0.0:
            return self.x, self.y
        return self.x + self.cos * x - self.sin * y, self.y + self.sin * x + self.cos * y


def _residual(entry: Table, t: Series, frames: Callable[[str], _Frame], guess: Callable[[str], _Frame]) -> list[Any]:
    """Psi of a joint or a driver; numbers that it leaves to the guess are those of the frames `guess`."""
    one, two = (frames(name) for name in entry["bodies"])
    one0, two0 = (guess(name) for name in entry["bodies"])
    points = entry.get("points", [[0.0, 0.0], [0.0, 0.0]])

    def gap(a: _Frame, b: _Frame) -> tuple[Any, Any]:
        (px, py), (qx, qy) = a.point(points[0]), b.point(points[1])
        return qx - px, qy - py

    x, y = gap(one, two)
    if entry.get("type") == "revolute":
        return [x, y]
    turn = two.angle - one.angle
    if "coordinate" in entry:
        law = _law(entry["motion"], t)
        match entry["coordinate"]:
            case "angle":
                return [turn - law]
            case "distance":
                return [_sqrt(x * x + y * y) - law]
            case "x":
                return [one.cos * x + one.sin * y - law]
            case _:
                return [one.cos * y - one.sin * x - law]
    fixed = turn - entry.get("angle", two0.angle - one0.angle)
    side = np.cos(entry.get("axis", 0.0)), np.sin(entry.get("axis", 0.0))
    across = (one.cos * side[1] + one.sin * side[0]) * -1.0 * x + (one.cos * side[0] - one.sin * side[1]) * y
    match entry["type"]:
        case "weld":
            return [x, y, fixed]
        case "prismatic":
            return [across, fixed]
        case "slot":
            return [across]
        case "angle":
            return [fixed]
        case "distance":
            length = entry.get("length", np.hypot(*gap(one0, two0)))
            return [0.5 / length * (x * x + y * y) - 0.5 * length]
        case "gear":
            r1, r2 = entry["radii"][0], entry["radii"][1] * (-1.0 if entry["internal"] else 1.0)
            carrier = entry.get("carrier", "ground")

            def rolled(a: Any, b: Any, c: Any) -> Any:
                return r1 * (a.angle - c.angle) + r2 * (b.angle - c.angle)

            return [rolled(one, two, frames(carrier)) - rolled(one0, two0, guess(carrier))]
        case "rack":

            def along(a: Any, b: Any) -> Any:
                ux, uy = a.cos * side[0] - a.sin * side[1], a.sin * side[0] + a.cos * side[1]
                return ux * (b.x - a.x) + uy * (b.y - a.y) + entry["radius"] * (b.angle - a.angle)

            return [along(one, two) - along(one0, two0)]
        case "cam":
            lx, ly = one.cos * x + one.sin * y, one.cos * y - one.sin * x
            polar, spline = _polar(lx, ly), closed_spline(entry["profile"]["angle"], entry["profile"]["radius"])
            return [_sqrt(x * x + y * y) - polar.of(spline(polar.a), spline(polar.a, 1), spline(polar.a, 2))]
    raise ValueError(entry["type"])


def evaluate(table: Table, t: float, q: np.ndarray, v: np.ndarray) -> Terms:
    """Return all terms of the equations of motion of a table at t, q and v (bodies, 3)."""
    return evaluate_all(table, t, np.reshape(q, (1, -1, 3)), np.reshape(v, (1, -1, 3)))[0]


def evaluate_all(table: Table, t: float, q: np.ndarray, v: np.ndarray) -> list[Terms]:
    """Return the terms at t in several states, q and v (states, bodies, 3): one pass over the joints serves all of them."""
    states, bodies = q.shape[:2]
    n, index = 3 * bodies, {body["name"]: k for k, body in enumerate(table["body"])}
    # Directions of all states, one after another; the last of each is the motion itself.
    directions = np.tile(np.eye(n + 1, n), (states, 1))
    directions[n :: n + 1] = v.reshape(states, n)
    placed = np.repeat(q.reshape(states, n), n + 1, axis=0)
    time = Series(float(t), np.zeros(len(placed)))
    time.b[n :: n + 1] = 1.0

    def frame(x: Any, y: Any, angle: Any) -> _Frame:
        return _Frame(x, y, angle, _cos(angle), _sin(angle))

    ground = _Frame(Series(0.0), Series(0.0), Series(0.0), Series(1.0), Series(0.0))
    along = lambda k: [Series(placed[:, 3 * k + i], directions[:, 3 * k + i]) for i in range(3)]  # noqa: E731
    moving = [frame(*along(k)) for k in range(bodies)]
    still = {"ground": _Frame(0.0, 0.0, 0.0, 1.0, 0.0)}
    for body in table["body"]:
        (x, y), a = body["position"], body["angle"]
        still[body["name"]] = _Frame(x, y, a, np.cos(a), np.sin(a))
    rows = [
        r
        for entry in (*table["joint"], *table["driver"])
        for r in _residual(entry, time, lambda b: ground if b == "ground" else moving[index[b]], still.__getitem__)
    ]
    parts = np.empty((len(rows), 3, len(placed)))
    for row, of in zip(parts, rows, strict=True):
        row[0], row[1], row[2] = of.a, of.b, of.c
    blocks = parts.reshape(len(rows), 3, states, n + 1)
    mass = np.array([m for body in table["body"] for m in (body["mass"], body["mass"], body["inertia"])])
    weight = mass * np.tile([*table["gravity"], 0.0], bodies)
    found = []
    for k in range(states):
        block, (conservative, other, potential) = blocks[:, :, k], _loads(table, t, q[k], v[k], index)
        found.append(
            Terms(
                psi=block[:, 0, -1],
                psi_q=block[:, 1, :-1],
                psi_dot=block[:, 1, -1],
                gamma=-2 * block[:, 2, -1],
                mass=mass,
                force=conservative + other + weight,
                potential=float(potential - weight @ q[k].ravel()),
                conservative=conservative + weight,
            )
        )
    return found


def _loads(table: Table, t: float, q: np.ndarray, v: np.ndarray, index: dict[str, int]) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the loads of the elements: those that have a potential, the others, and the potential energy."""
    kept, lost, energy = np.zeros(q.shape), np.zeros(q.shape), 0.0
    pins = {joint["name"]: joint["bodies"] for joint in table["joint"]}

    def at(name: str, point: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Arm, position and velocity of a point of a body."""
        x, y, a = q[index[name]] if name in index else np.zeros(3)
        vx, vy, turn = v[index[name]] if name in index else np.zeros(3)
        arm = np.array([np.cos(a) * point[0] - np.sin(a) * point[1], np.sin(a) * point[0] + np.cos(a) * point[1]])
        return arm, arm + [x, y], np.array([vx - turn * arm[1], vy + turn * arm[0]])

    def add(to: np.ndarray, name: str, force: np.ndarray, arm: np.ndarray, torque: float = 0.0) -> None:
        if name in index:
            to[index[name]] += [*force, arm[0] * force[1] - arm[1] * force[0] + torque]

    def turning(pair: Any) -> tuple[float, float]:
        angle, rate = ([x[index[name], 2] if name in index else 0.0 for name in pair] for x in (q, v))
        return angle[1] - angle[0], rate[1] - rate[0]

    def couple(to: np.ndarray, pair: Any, torque: float) -> None:
        for name, sign in zip(pair, (-1.0, 1.0), strict=True):
            add(to, name, np.zeros(2), np.zeros(2), sign * torque)

    for entry in table["force"]:
        match entry["type"]:
            case "spring":
                (a1, p1, v1), (a2, p2, v2) = (at(b, p) for b, p in zip(entry["bodies"], entry["points"], strict=True))
                d = np.hypot(*(p2 - p1))
                unit = (p2 - p1) / d
                stretch, rate = d - entry["length"], unit @ (v2 - v1)
                energy += 0.5 * entry["stiffness"] * stretch**2
                for to, pull in ((kept, entry["stiffness"] * stretch), (lost, entry.get("damping", 0.0) * rate)):
                    add(to, entry["bodies"][0], pull * unit, a1)
                    add(to, entry["bodies"][1], -pull * unit, a2)
            case "torsion_spring":
                angle, rate = turning(entry["bodies"])
                twist = angle - entry.get("angle", 0.0)
                energy += 0.5 * entry["stiffness"] * twist**2
                couple(kept, entry["bodies"], -entry["stiffness"] * twist)
                couple(lost, entry["bodies"], -entry.get("damping", 0.0) * rate)
            case "torque":
                couple(lost, entry["bodies"], _torque(entry["value"], t))
            case "bumper":
                overlap = max(entry["side"] * (entry["limit"] - turning(entry["bodies"])[0]), 0.0)
                energy += 0.5 * entry["stiffness"] * overlap**2
                couple(kept, entry["bodies"], entry["stiffness"] * entry["side"] * overlap)
            case "servo":
                torque = -entry["stiffness"] * (turning(entry["bodies"])[0] - entry["target"])
                couple(lost, entry["bodies"], float(np.clip(torque, -entry["most"], entry["most"])))
            case "zone":
                u, (x, y, _) = np.array(entry["direction"]), q[index[entry["body"]]]
                add(lost, entry["body"], -entry["force"] * u * (u @ [x, y] > entry["level"]), np.zeros(2))
            case "square_drag":
                rate = turning(entry["bodies"])[1]
                couple(lost, entry["bodies"], -entry["drag"] * abs(rate) * rate)
            case "friction" if "torque" in entry:  # with a coefficient: friction_properties.py
                _, rate = turning(pins[entry["joint"]])
                couple(lost, pins[entry["joint"]], -entry["torque"] * np.tanh(rate / entry["velocity"]))
            case "force":
                arm, _, _ = at(entry["body"], entry.get("point", (0.0, 0.0)))
                turned = at(entry["body"], entry["vector"])[0] if entry.get("frame") == "body" else np.array(entry["vector"])
                add(lost, entry["body"], turned, arm)
    return kept.ravel(), lost.ravel(), energy


def _torque(value: Any, t: float) -> float:
    """Return a torque at t; samples are held, the first one before its time, too."""
    if not isinstance(value, dict):
        return value
    samples, start = value["values"], value["t0"]
    return samples[int(np.clip(np.floor((t - start) / value["dt"] + 1e-12), 0, len(samples) - 1))]
