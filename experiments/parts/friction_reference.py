"""Friction in all joints of random mechanisms, by hand: an independent solution of the equations with friction.

With rows J, masses M and the loads s (N) of the joints that rub, M a + J^T lambda = F - sum s_j d_j, where d_j is the friction of
joint j under a unit load. Its multipliers are affine in s and in y, which redundant rows leave open; and the loads are functions
of the multipliers:

    lambda = lambda_0 + B s + N y,        s_j = size_j(lambda).

Repeated substitution solves this for s if friction answers weakly to itself; SciPy's `root` does from many starts.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog, root

from experiments.parts.random_scenes import RandomScene, Table
from experiments.parts.reference_equations import Terms

PIN, COEFFICIENT, SPEED = 0.05, 0.15, 0.05  # radius and speed of transition in units of the scene
SUBSTITUTIONS, SETTLED = 1000, 1e-14  # the change of loads by the last one, relative to the loads
STARTS, SOLVED = 24, 1e-9  # of `root`, and what it may leave, relative to the loads
GAP = 1e-9, 1e-4  # singular values, relative to the largest, of which rows are neither redundant nor independent
FAR = 10.0  # sampled loads that balance each other, relative to those of the motion: joints pressed to either side


class Rub(NamedTuple):
    """Friction of a joint: its force of unit load (n,), mu(s), the rows of its multipliers, and size(multipliers), its load.

    The load is the largest of the linear `forms` (k, rows) of the multipliers; that of a pin is nearly.
    """

    along: np.ndarray
    coefficient: float
    rows: slice
    size: Callable[[np.ndarray], float]
    forms: np.ndarray


def with_friction(scene: RandomScene) -> RandomScene:
    """Return a scene with friction in all pins, slides and slots."""
    table, rate = dict(scene.table), scene.length / scene.time
    rubs: list[Table] = []
    for k, joint in enumerate(table["joint"]):
        if joint["type"] in ("revolute", "prismatic", "slot"):
            rub: Table = {"name": f"rub{k}", "type": "friction", "joint": joint["name"], "coefficient": COEFFICIENT}
            rub |= {"speed": SPEED * rate} | ({"radius": PIN * scene.length} if joint["type"] == "revolute" else {})
            rubs.append(rub | ({"length": 4 * scene.length} if joint["type"] == "prismatic" and k % 2 else {}))
    table["force"] = [*table["force"], *rubs]
    return scene._replace(table=table)


def rubs_of(table: Table, q: np.ndarray, v: np.ndarray) -> dict[str, Rub]:
    """Return the friction of each joint at q and v (bodies, 3), by hand."""
    index = {body["name"]: k for k, body in enumerate(table["body"])}
    by_joint = {f["joint"]: f for f in table["force"] if f["type"] == "friction" and "speed" in f}
    counts, start, found = {"revolute": 2, "prismatic": 2, "slot": 1, "weld": 3}, 0, {}
    for joint in table["joint"]:
        rows = slice(start, start + counts.get(joint["type"], 1))
        start = rows.stop
        if joint["name"] not in by_joint:
            continue
        rub, along = by_joint[joint["name"]], np.zeros((len(q), 3))
        frames = [(np.zeros(3), np.zeros(3)) if b == "ground" else (q[index[b]], v[index[b]]) for b in joint["bodies"]]
        (q1, v1), (q2, v2) = frames
        if joint["type"] == "revolute":
            speed, size, forms = rub["radius"] * (v2[2] - v1[2]), np.linalg.norm, _circle(32)
            wrenches = [np.array([0.0, 0.0, sign * rub["radius"]]) for sign in (-1.0, 1.0)]
        else:
            axis = complex(np.exp(1j * (q1[2] + joint["axis"])))
            arm = complex(np.exp(1j * q2[2])) * complex(*joint["points"][1])
            arms = complex(*q2[:2]) + arm - complex(*q1[:2]), arm
            rates = [complex(*w[:2]) + 1j * float(w[2]) * r for w, r in zip((v1, v2), arms, strict=True)]
            speed = ((rates[1] - rates[0]) * axis.conjugate()).real
            wrenches = [
                s * np.array([axis.real, axis.imag, (r.conjugate() * axis).imag]) for s, r in zip((-1, 1), arms, strict=True)
            ]
            size, forms = _edges(rub.get("length")), _forms(joint["type"], rub.get("length"))
        for body, wrench in zip(joint["bodies"], wrenches, strict=True):
            if body != "ground":
                along[index[body]] += wrench
        found[joint["name"]] = Rub(along.ravel(), _coefficient(rub, speed), rows, size, forms)
    return found


def _coefficient(rub: Table, speed: float) -> float:
    """Return mu(s) of Brown and McPhee (2016), with its sign."""
    x, sliding = speed / rub["speed"], rub["coefficient"]
    more = rub.get("static_coefficient", sliding) - sliding
    return sliding * np.tanh(4 * x) + more * x / (x**2 / 4 + 3 / 4) ** 2 + rub.get("viscous", 0.0) * speed


def _edges(length: float | None) -> Callable[[np.ndarray], float]:
    if length is None:
        return lambda x: abs(x[0])
    return lambda x: abs(x[0] / 2 + x[1] / length) + abs(x[0] / 2 - x[1] / length)


def _circle(count: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _forms(kind: str, length: float | None) -> np.ndarray:
    """Return the linear forms whose largest is the load of a slide or a slot."""
    if length is None:
        return np.array([[1.0], [-1.0]]) if kind == "slot" else np.array([[1.0, 0.0], [-1.0, 0.0]])
    return np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 2 / length], [0.0, -2 / length]])


class Balance:
    """The equations of a state with friction. Multipliers x (m,) are lambda times the scales of their rows."""

    def __init__(self, scene: RandomScene, terms: Terms, rubs: Sequence[Rub]):
        self.terms, self.rubs = terms, rubs
        unit = np.tile([scene.length, scene.length, 1.0], len(terms.mass) // 3)
        self.unit, self.load = unit, scene.mass * scene.length / scene.time**2
        self.row = np.max(abs(terms.psi_q * unit), axis=1)
        J = self._J = terms.psi_q * unit / self.row[:, None]
        u, sigma, _ = np.linalg.svd(J)
        padded = np.append(sigma, np.zeros(len(u) - len(sigma)))
        self.is_clear = not np.any((padded > GAP[0] * sigma[0]) & (padded < GAP[1] * sigma[0]))
        self.N = u[:, padded <= GAP[0] * sigma[0]]
        kg = scene.mass * scene.length**2
        inverse = kg * np.linalg.pinv((J / unit**2 / terms.mass * kg) @ J.T, 1e-11)
        self._drags = np.array([r.along * r.coefficient for r in rubs]).reshape(len(rubs), len(unit)).T  # of unit loads
        self._x0 = inverse @ (J @ (terms.force / terms.mass / unit) - terms.gamma / self.row)
        self._B = -inverse @ (J @ (self._drags / terms.mass[:, None] / unit[:, None]))

    def solve(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return a (n,) and x (m,) by repeated substitution of the loads; None if it does not end.

        Args:
            y: Multipliers that balance each other: `N` y, in the loads of the scene.
        """
        start = self._x0 + self.N @ y * self.load * self.unit[0]
        s = np.zeros(len(self.rubs))
        for _ in range(SUBSTITUTIONS):
            with np.errstate(over="ignore", invalid="ignore"):  # substitution may run away
                new = self.sizes(start + self._B @ s)
            size = np.max(new)
            if not np.isfinite(size):
                return None
            if np.max(abs(new - s)) <= SETTLED * size:
                x = start + self._B @ new
                return self.accelerations(x), x
            s = new
        return None

    def solutions(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Return the different loads s that SciPy finds from some starts, for y = 0."""
        found: list[np.ndarray] = []
        unit = np.max(self.sizes(self._x0)) or self.load
        for k in range(STARTS):
            start = rng.exponential(10.0 ** rng.uniform(-1, 2), len(self.rubs)) if k else self.sizes(self._x0) / unit
            it = root(lambda s: s - self.sizes(self._x0 / unit + self._B @ s), start, method=("hybr", "lm")[k % 2])
            left, size = np.max(abs(it.fun)), np.max(abs(it.x))
            if left <= SOLVED * size and not any(np.max(abs(it.x * unit - s)) <= 1e-6 * size * unit for s in found):
                found.append(it.x * unit)
        return found

    def accelerations(self, x: np.ndarray) -> np.ndarray:
        """Return a (n,) of equilibrium with the multipliers x."""
        return (self.terms.force + self.friction(x) - (self._J.T @ x) / self.unit) / self.terms.mass

    def friction(self, x: np.ndarray) -> np.ndarray:
        """Return the loads of friction (n,)."""
        return -self._drags @ self.sizes(x)

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Return the loads of the joints (N) by which their friction grows."""
        return np.array([float(r.size(x[r.rows] / self.row[r.rows])) for r in self.rubs])

    def power(self, x: np.ndarray, v: np.ndarray) -> float:
        """Return the power that friction takes (W): a convex function of x."""
        return float(-v @ self.friction(x))

    def extremes(self, v: np.ndarray, x: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
        """Return the least and the largest power of friction of loads x + N y in a box of y, friction changing no multiplier.

        Loads are the largest of their linear `forms`, and so the least power is a linear program: with a bound s on each load,

            minimize w . s,        s_j >= f . (x + N y) for each form f of load j,        -1 <= y <= 1,

        where w_j is the power of a unit load. The largest is that of random corners.
        """
        k, rubs = self.N.shape[1], self.rubs
        unit = FAR * (np.linalg.norm(x) + self.load * self.unit[0])
        weights = v @ self._drags
        spread, given, bounds = [], [], []
        for j, rub in enumerate(rubs):
            forms = rub.forms / self.row[rub.rows]
            spread.append(forms @ self.N[rub.rows] * unit)
            given.append(forms @ x[rub.rows])
            bounds.append(np.zeros((len(forms), len(rubs))))
            bounds[-1][:, j] = -1.0

        def power(y: np.ndarray) -> float:
            return float(weights @ [np.max(A @ y + b) for A, b in zip(spread, given, strict=True)])

        scale = max(np.max(abs(np.vstack(spread))), np.max(abs(np.concatenate(given)))) or 1.0
        A = np.hstack([np.vstack(spread) / scale, np.vstack(bounds)])
        cost = np.append(np.zeros(k), weights / (np.max(weights) or 1.0))
        limits = [(-1.0, 1.0)] * k + [(0.0, None)] * len(rubs)
        exact = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
        low = linprog(cost, A, -np.concatenate(given) / scale, bounds=limits, method="highs", options=exact)
        corners = [rng.choice([-1.0, 1.0], k) for _ in range(8)]
        values = [power(y) for y in (low.x[:k], np.zeros(k), *corners, *(-c for c in corners))]
        return min(values), max(values)
