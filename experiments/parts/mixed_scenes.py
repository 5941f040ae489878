"""Random scenes in which many features meet: up to nine of them on a linkage or tree that is closed as drawn.

A scene is a table as in a scene file, with `event` entries and four force elements that no file has: an elastic stop, a saturated
servo, a force that jumps in space, and quadratic drag. Scenes that differ in their third number alone have one structure.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import udkjax as udk
from experiments.parts.mixed_topologies import Linkage
from experiments.parts.random_scenes import RandomScene, Table
from experiments.parts.random_scenes import build as build_elements
from experiments.parts.reference_equations import evaluate

SMOOTH = ("spring", "torsion", "stiff", "drag", "force", "torque", "smooth_friction", "friction_by_load", "driver")
KINKED = ("held", "bumper", "servo", "zone", "square_drag")
EVENTS = ("contact", "rubbing_contact", "limit", "stop", "log", "release", "attach", "lock")
FEATURES = (*SMOOTH, *KINKED, "set_valued_friction", *EVENTS)
MOST = 9  # features at once
LEAST_RANK = 1e-8  # singular values of Psi_q M^(-1/2), relative to the largest, of rows that count


class Bumper(udk.ForceElement):
    """Elastic one-sided stop of a relative angle, with the potential k max(s (limit - angle), 0)^2 / 2."""

    stiffness: Float[Array, ""]
    limit: Float[Array, ""]
    side: Float[Array, ""]

    def potential(self, t, one, two):
        return self.stiffness * jnp.maximum(self.side * (self.limit - (two.angle - one.angle)), 0.0) ** 2 / 2


class Servo(udk.ForceElement):
    """Saturated torque clip(-k (angle - target), -most, most)."""

    stiffness: Float[Array, ""]
    target: Float[Array, ""]
    most: Float[Array, ""]

    def loads(self, t, one, two):
        torque = jnp.clip(-self.stiffness * (two.angle - one.angle - self.target), -self.most, self.most)
        return [(0.0, 0.0, -torque), (0.0, 0.0, torque)]


class Zone(udk.ForceElement):
    """A force against a direction u, at the centre of a body where u . r exceeds a level: a jump in space."""

    force: Float[Array, ""]
    direction: Float[Array, "2"]
    level: Float[Array, ""]

    def loads(self, t, body):
        x, y = self.direction
        force = jnp.where(x * body.x + y * body.y > self.level, -self.force, 0.0)
        return [(force * x, force * y, 0.0)]


class SquareDrag(udk.ForceElement):
    """Torque -c |w| w of a relative rate w, whose second derivative jumps."""

    drag: Float[Array, ""]

    def loads(self, t, one, two):
        rate = two.omega - one.omega
        torque = -self.drag * jnp.abs(rate) * rate
        return [(0.0, 0.0, -torque), (0.0, 0.0, torque)]


OWN_FORCES = {"bumper": Bumper, "servo": Servo, "zone": Zone, "square_drag": SquareDrag}


class Level(eqx.Module):
    """Condition: a point of a body passes the line u . r = level."""

    body: str = eqx.field(static=True)
    point: Float[Array, "2"]
    direction: Float[Array, "2"]
    level: Float[Array, ""]

    def __call__(self, t, at):
        place = at[self.body].point(self.point)
        return self.direction[0] * place.x + self.direction[1] * place.y - self.level


class Clock(eqx.Module):
    """Condition: a time passes."""

    time: Float[Array, ""]

    def __call__(self, t, at):
        return t - self.time


def build(table: Table) -> udk.Mechanism:
    """Make the mechanism of a table."""
    own = {entry["name"]: entry for entry in table["force"] if entry["type"] in OWN_FORCES}
    given = [_with_samples(entry) for entry in table["force"] if entry["type"] not in OWN_FORCES]
    rest = build_elements(table | {"force": given})
    made = dict(rest.forces)
    for name, entry in own.items():
        numbers = {k: jnp.asarray(x, float) for k, x in entry.items() if k not in ("name", "type", "bodies", "body")}
        made[name] = OWN_FORCES[entry["type"]](entry.get("bodies") or [entry["body"]], **numbers)
    forces = {entry["name"]: made[entry["name"]] for entry in table["force"]}
    return udk.Mechanism(rest.bodies, rest.joints, rest.drivers, forces, gravity=rest.gravity)


def _with_samples(entry: Table) -> Table:
    value = entry.get("value")
    return entry | {"value": udk.Held(**value)} if isinstance(value, dict) else entry


def events(table: Table) -> list[Any]:
    """Make the events of a table."""
    return [_event(entry) for entry in table["event"]]


def _event(entry: Table) -> Any:
    name = entry["name"]
    if entry["type"] == "contact":
        rubs = {"coefficient": entry["coefficient"]} if "coefficient" in entry else {}
        place = entry["body"], entry["point"], entry["through"], entry["normal"]
        return udk.Contact(*place, restitution=entry["restitution"], name=name, **rubs)
    if entry["type"] == "limit":
        return udk.JointLimit(entry["joint"], entry["lower"], entry["upper"], entry["restitution"], name=name)
    number = lambda key: jnp.asarray(entry[key], float)  # noqa: E731
    is_clock = entry["type"] == "clock"
    condition = Clock(number("time")) if is_clock else Level(entry["body"], *map(number, ("point", "direction", "level")))
    match entry["action"]:
        case "release":
            action: Any = udk.Release(entry["joint"])
        case "lock":
            action = udk.Lock(entry["joint"])
        case "attach":
            action = udk.Attach(udk.Distance(*entry["attaches"]), "rod")
        case other:
            action = {"stop": udk.Stop, "log": udk.Log}[other]()
    return udk.Event(condition, action, direction=entry["sign"], name=name)


def mixed_scene(seed: int, structure: int, numbers: int = 0, features: tuple[str, ...] | None = None) -> RandomScene:
    """Draw a scene with several features at once, moving as its constraints allow at t = 0.

    Args:
        seed: Of the whole series.
        structure: Of its topology and features; their number is one to nine.
        numbers: Of its numbers; scenes that differ in these alone have the same structure.
        features: names of FEATURES, instead of random ones.
    """
    pick, of = np.random.default_rng([seed, structure, 7]), np.random.default_rng([seed, structure, numbers, 8])
    chosen = tuple(str(x) for x in pick.choice(FEATURES, int(pick.integers(1, MOST + 1)), replace=False))
    linkage = Linkage(pick, of)
    draw = _Draw(linkage)
    for feature in chosen if features is None else features:
        getattr(draw, f"_{feature}")()
    gravity = [0.0, -9.81] if pick.random() < 0.7 else (pick.random() < 0.7) * of.uniform(-10, 10, 2)
    table: Table = {"format": 1, "gravity": [float(x) for x in gravity], "body": list(linkage.bodies.values())}
    table |= {"joint": list(linkage.joints.values()), "driver": draw.drivers, "force": draw.forces, "event": draw.events}
    _set_velocities(table, of.normal(0, 1, (len(linkage.bodies), 3)) * of.choice([0.3, 1, 2]))
    return RandomScene(table, (seed, structure, numbers), 1.0, 1.0, 1.0)


def _set_velocities(table: Table, v: np.ndarray) -> None:
    """Give the bodies the velocities nearest to v, in the metric of M, that the constraints allow."""
    q = np.array([[*b["position"], b["angle"]] for b in table["body"]], float)
    terms = evaluate(table, 0.0, q, 0 * q)
    if len(terms.psi):
        root = 1 / np.sqrt(terms.mass)
        miss = terms.psi_q @ v.ravel() + terms.psi_dot
        v = v - (root * np.linalg.lstsq(terms.psi_q * root, miss, rcond=LEAST_RANK)[0]).reshape(v.shape)
    for body, (x, y, rate) in zip(table["body"], v, strict=True):
        body["velocity"], body["angular_velocity"] = [float(x), float(y)], float(rate)


class _Draw:
    """The features of one scene: each method adds one, where the linkage has a place for it."""

    def __init__(self, linkage: Linkage):
        self.linkage, self.pick, self.of = linkage, linkage.pick, linkage.of
        self.forces: list[Table] = []
        self.drivers: list[Table] = []
        self.events: list[Table] = []

    def _pair(self) -> list[str]:
        two = str(self.pick.choice(self.linkage.names))
        return [str(self.pick.choice(["ground", *(name for name in self.linkage.names if name != two)])), two]

    def _add(self, name: str, kind: str, **numbers: Any) -> None:
        self.forces.append({"name": name, "type": kind, **numbers})

    def _between(self, pair: list[str]) -> float:
        return self.linkage.angle(pair[1]) - self.linkage.angle(pair[0])

    def _spring(self, name: str = "spring", damping: float | None = None) -> None:
        pair = self._pair()
        points = [self.linkage.near(1.5 if body == "ground" else 0.4) for body in pair]
        numbers = {"stiffness": float(10 ** self.of.uniform(0, 3)), "length": float(self.of.uniform(0, 1))}
        damping = float(self.of.uniform(0.1, 3)) if damping is None else damping
        self._add(name, "spring", bodies=pair, points=points, damping=damping, **numbers)

    def _torsion(self) -> None:
        pair = self._pair()
        numbers = {"stiffness": float(10 ** self.of.uniform(-1, 2)), "damping": float(self.of.uniform(0.01, 0.5))}
        angle = self._between(pair) + float(self.of.uniform(-1, 1))
        self._add("torsion", "torsion_spring", bodies=pair, angle=angle, **numbers)

    def _stiff(self) -> None:
        damping = float(10 ** self.of.uniform(2, 8))
        if self.pick.random() < 0.5:
            self._spring("stiff", damping)
        else:
            pair = self._pair()
            self._add("stiff", "torsion_spring", bodies=pair, stiffness=5.0, damping=damping, angle=self._between(pair))

    def _drag(self) -> None:
        damping = float(self.of.uniform(0.01, 0.3))
        self._add("drag", "torsion_spring", bodies=self._pair(), stiffness=0.0, damping=damping, angle=0.0)

    def _force(self) -> None:
        frame = "ground" if self.pick.random() < 0.5 else "body"
        vector, point = self.of.uniform(-5, 5, 2).tolist(), self.linkage.near()
        self._add("force", "force", body=self._pair()[1], vector=vector, point=point, frame=frame)

    def _torque(self) -> None:
        self._add("torque", "torque", bodies=self._pair(), value=float(self.of.uniform(-2, 2)))

    def _held(self) -> None:
        count = int(self.pick.integers(3, 25))
        dt, t0 = (float(self.pick.choice(x)) for x in ([0.05, 0.04, 0.1, self.pick.uniform(0.02, 0.1)], [0, -0.03, 0.1]))
        samples = {"values": self.of.uniform(-2, 2, count).tolist(), "dt": dt, "t0": t0}
        self._add("held", "torque", bodies=self._pair(), value=samples)

    def _smooth_friction(self) -> None:
        if self.linkage.pins:
            joint = str(self.pick.choice(self.linkage.pins))
            numbers = {"torque": float(self.of.uniform(0.05, 0.5)), "velocity": float(self.of.uniform(0.05, 0.5))}
            self._add("smooth friction", "friction", joint=joint, **numbers)

    def _friction_by_load(self) -> None:
        for k, joint in enumerate(self._without_friction(self.linkage.pins)[:3]):
            numbers = self._coefficients() | {"speed": float(10 ** self.of.uniform(-3, -1))}
            if self.pick.random() < 0.5:
                numbers["viscous"] = float(self.of.uniform(0.01, 0.2))
            self._add(f"friction {k}", "friction", joint=joint, radius=float(self.of.uniform(0.005, 0.05)), **numbers)

    def _set_valued_friction(self) -> None:
        for k, joint in enumerate(self._without_friction(self.linkage.pins)[: int(self.pick.integers(1, 4))]):
            radius = float(self.of.uniform(0.005, 0.05))
            self._add(f"sticking {k}", "friction", joint=joint, radius=radius, law="set-valued", **self._coefficients())
        for joint in self.linkage.slides[:1]:
            self._add("sticking slide", "friction", joint=joint, law="set-valued", **self._coefficients())

    def _without_friction(self, joints: list[str]) -> list[str]:
        """Return the joints that have no coefficient of friction yet: one is all that a joint may have."""
        return [name for name in joints if not any(f.get("joint") == name and "coefficient" in f for f in self.forces)]

    def _coefficients(self) -> Table:
        sliding, ratio = float(self.of.uniform(0.05, 0.3)), float(self.pick.choice([1, 1.3]))
        return {"coefficient": sliding} | ({"static_coefficient": ratio * sliding} if ratio > 1 else {})

    def _bumper(self) -> None:
        pair, stiffness = self._pair(), float(10 ** self.of.uniform(0, 4))
        limit = self._between(pair) - float(self.of.uniform(0.05, 0.5))
        self._add("bumper", "bumper", bodies=pair, stiffness=stiffness, limit=limit, side=1.0)

    def _servo(self) -> None:
        pair, numbers = self._pair(), {"stiffness": float(10 ** self.of.uniform(0, 2)), "most": float(self.of.uniform(0.3, 3))}
        self._add("servo", "servo", bodies=pair, target=self._between(pair) + float(self.of.uniform(-0.8, 0.8)), **numbers)

    def _zone(self) -> None:
        body, direction = self._pair()[1], self.linkage.direction()
        level = float(direction @ self.linkage.bodies[body]["position"] + self.of.uniform(-0.2, 0.2))
        self._add("zone", "zone", body=body, force=float(self.of.uniform(0.5, 5)), direction=direction.tolist(), level=level)

    def _square_drag(self) -> None:
        self._add("square drag", "square_drag", bodies=self._pair(), drag=float(self.of.uniform(0.01, 0.5)))

    def _driver(self) -> None:
        if self.linkage.topology == "tree":  # its joints may hold what a driver moves
            return
        now, of = self.linkage.angle("b0"), self.of
        match str(self.pick.choice(["polynomial", "sine", "spline"])):
            case "polynomial":
                motion: Table = {"coefficients": [now, float(of.uniform(-4, 4)), float(of.uniform(-1, 1))]}
                kind = "polynomial"
            case "sine":
                size, phase, rate = float(of.uniform(0.1, 0.5)), float(of.uniform(-3, 3)), float(of.uniform(1, 8))
                motion = {"amplitude": size, "frequency": rate, "phase": phase, "offset": now - size * float(np.sin(phase))}
                kind = "sine"
            case _:
                values = [now, *(now + of.uniform(-0.4, 0.4, 5)).tolist()]
                motion, kind = {"times": [0, 0.17, 0.41, 0.66, 0.9, 1.3], "values": values}, "spline"
        on = {"bodies": ["ground", "b0"], "coordinate": "angle"}
        self.drivers.append({"name": "driver", **on, "motion": {"type": kind, **motion}})

    def _contact(self, name: str = "contact", **friction: float) -> None:
        body, point = self._pair()[1], self.linkage.near()
        normal = np.array([0.0, 1.0]) if self.pick.random() < 0.6 else self.linkage.direction()
        through = (self.linkage.place(body, point) - normal * self.of.uniform(0.02, 0.4)).tolist()
        restitution = float(self.pick.choice([0.0, 0.3, 0.7, 1.0]))
        place = {"body": body, "point": point, "through": through, "normal": normal.tolist(), "restitution": restitution}
        self.events.append({"name": name, "type": "contact", **place, **friction})

    def _rubbing_contact(self) -> None:
        # from one that hardly rubs to one that stops what it hits at once
        self._contact("rubbing contact", coefficient=float(10 ** self.of.uniform(-1.3, 0.5)))

    def _limit(self) -> None:
        if joints := self.linkage.pins + self.linkage.slides:
            joint = str(self.pick.choice(joints))
            below, above = self.of.uniform(0.05, 0.8, 2)
            now, restitution = self.linkage.coordinate(joint), float(self.pick.choice([0.0, 0.4, 0.9]))
            ends = {"lower": float(now - below), "upper": float(now + above), "restitution": restitution}
            self.events.append({"name": "limit", "type": "limit", "joint": joint, **ends})

    def _at(self, action: str, **what: Any) -> None:
        """Add an event where a point passes a line, or at a time."""
        body, point, direction = self._pair()[1], self.linkage.near(), self.linkage.direction()
        away = self.of.uniform(0.03, 0.3) * self.pick.choice([-1, 1])
        if self.pick.random() < 0.7:
            level = float(direction @ self.linkage.place(body, point) + away)
            place: Table = {"type": "level", "body": body, "point": point, "direction": direction.tolist(), "level": level}
        else:
            place = {"type": "clock", "time": float(self.pick.choice([0.1, 0.3, 0.5, self.pick.uniform(0.05, 0.9)]))}
        sign = int(self.pick.choice([0, 1, -1]))
        self.events.append({"name": action, **place, "action": action, "sign": sign, **what})

    def _stop(self) -> None:
        self._at("stop")

    def _log(self) -> None:
        self._at("log")

    def _release(self) -> None:
        if self.linkage.joints:
            self._at("release", joint=str(self.pick.choice(list(self.linkage.joints))))

    def _lock(self) -> None:
        if joints := self.linkage.pins or self.linkage.slides:
            self._at("lock", joint=str(self.pick.choice(joints)))

    def _attach(self) -> None:
        pair = self._pair()
        self._at("attach", attaches=(pair, [self.linkage.near(1.0), self.linkage.near()]))
