"""Channels: what can be measured of a motion, each under a name in the dialect of the parameters' names.

    body.NAME.x  y  angle  vx  vy  omega  ax  ay  alpha       centre of mass and angle, their rates and accelerations
    body.NAME(px, py).x  y  vx  vy  ax  ay                    a point given in the body's own frame (m)
    joint.NAME.angle  omega  alpha                            theta_2 - theta_1 of the joint's two bodies: an encoder at the pin
    joint.NAME.fx  fy  torque                                 what the joint does to its second body, as in `reactions`
    joint.NAME.BODY.fx  fy  torque                            what it does to one that is named
    driver.NAME.load                                          what the driver exerts on its second body along its coordinate
    distance.BODY(px, py).BODY2(px, py)                       between two points; a body may be "ground"

Torques are about the centre of mass, those on the ground about the origin. SI units throughout.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from udkjax.equations.abstract_system import MechanismSystem
from udkjax.equations.textbook import prepare
from udkjax.pinv import SVD
from udkjax.scene.bodies import GROUND, Frame, between
from udkjax.scene.checks import quoted, suggestion
from udkjax.scene.mechanism import Mechanism

Needs = Literal["states", "accelerations", "reactions"]
Point = tuple[float, float]  # in a body's own frame (m)
_CENTRE: Point = (0.0, 0.0)
_POINT_UNITS = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "ax": "m/s2", "ay": "m/s2"}
_ANGLE_UNITS = {"angle": "rad", "omega": "rad/s", "alpha": "rad/s2"}
LOADS = {"fx": "N", "fy": "N", "torque": "N m"}
_UNITS = {**_POINT_UNITS, **_ANGLE_UNITS, **LOADS}
_ACCELERATIONS = ("ax", "ay", "alpha")


class Trajectory(Protocol):
    """What is measured: a pytree with output times ts (T,) and states q and v (T, bodies, 3), such as a `Solution`."""

    @property
    def ts(self) -> Array: ...

    @property
    def q(self) -> Array: ...

    @property
    def v(self) -> Array: ...


@dataclass(frozen=True)
class Channel:
    """One measured quantity: plain data, equal where the canonical names are, and so fit to be static in a compiled program."""

    name: str
    units: str
    needs: Needs
    section: str  # body, joint, driver or distance
    owner: str  # the joint or driver; else empty
    bodies: tuple[str, ...]  # whose it is; of an angle at a joint, and of a distance, both
    points: tuple[Point, ...] = ()  # of each body
    quantity: str = ""


@dataclass(frozen=True, eq=False)
class Quantity:
    """A channel of the user's own, equal only to itself: made once and used again, it compiles once.

    Attributes:
        name: what it is called in tables and messages.
        function: of the mechanism and its solution, written in jax.numpy; returns (T,) in `units`.
        units: SI units, as text.
    """

    name: str
    function: Callable[[Mechanism, Trajectory], Float[Array, "T"]]
    units: str = ""

    def __str__(self) -> str:
        return self.name


# --- names


def channel_of(mechanism: Mechanism, text: str) -> Channel:
    """Return the channel of a name; names of bodies and joints may contain dots.

    Raises:
        ValueError: no such channel; the message says what is wrong and what was probably meant.
    """
    text = text.strip()
    section, _, rest = text.partition(".")
    if section not in _PARSERS:
        raise ValueError(f"begins with none of {', '.join(f'{s}.' for s in _PARSERS)}{suggestion(text, channels_of(mechanism))}")
    return _PARSERS[section](mechanism, rest)


def channels_of(mechanism: Mechanism) -> list[str]:
    """Return the names of all channels that need no point, in the order of the scene."""
    found = [f"body.{name}.{q}" for name in mechanism.body_names for q in (*_POINT_UNITS, *_ANGLE_UNITS)]
    for name, joint in mechanism.joints.items():
        found += [f"joint.{name}.{q}" for q in (*(_ANGLE_UNITS if len(joint.bodies) == 2 else ()), *LOADS)]
    return [*found, *(f"driver.{name}.load" for name in mechanism.driver_names)]


def _parse_body(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("body", mechanism.body_names, text)
    point, rest = _split_point(rest, _CENTRE)
    shown = _with_point(name, point) if point is not _CENTRE else name
    known = _POINT_UNITS if point is not _CENTRE else {**_POINT_UNITS, **_ANGLE_UNITS}
    quantity = _check_quantity(f"body {quoted(shown)}", rest, known)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(f"body.{shown}.{quantity}", _UNITS[quantity], needs, "body", "", (name,), (point,), quantity)


def _parse_joint(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("joint", mechanism.joint_names, text)
    bodies = mechanism.frames_of(mechanism.joints[name])
    for body in sorted(bodies, key=len, reverse=True):
        if rest.startswith(f".{body}."):
            quantity = _check_quantity(f"joint {quoted(name)} on body {quoted(body)}", rest.removeprefix(f".{body}"), LOADS)
            return Channel(f"joint.{name}.{body}.{quantity}", _UNITS[quantity], "reactions", "joint", name, (body,), (), quantity)
    pair = bodies[:2]
    known = {**(_ANGLE_UNITS if len(pair) == 2 else {}), **LOADS}
    quantity = _check_quantity(f"joint {quoted(name)}", rest, known, [f"{b}.{q}" for b in bodies for q in LOADS])
    units, label = _UNITS[quantity], f"joint.{name}.{quantity}"
    if quantity in LOADS:
        return Channel(label, units, "reactions", "joint", name, pair[-1:], (), quantity)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(label, units, needs, "joint", name, pair, (), quantity)


def _parse_driver(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("driver", mechanism.driver_names, text)
    quantity = _check_quantity(f"driver {quoted(name)}", rest, {"load": ""})
    driver = mechanism.drivers[name]
    units = "N m" if driver.coordinate == "angle" else "N"
    return Channel(f"driver.{name}.{quantity}", units, "reactions", "driver", name, driver.bodies[1:], (), quantity)


def _parse_distance(mechanism: Mechanism, text: str) -> Channel:
    one, rest = _split_owner("body", (*mechanism.body_names, GROUND), text)
    point, rest = _split_point(rest)
    if not rest.startswith("."):
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the first point comes {quoted(rest)}")
    two, rest = _split_owner("body", (*mechanism.body_names, GROUND), rest[1:])
    other, rest = _split_point(rest)
    if rest:
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the second point comes {quoted(rest)}")
    name = f"distance.{_with_point(one, point)}.{_with_point(two, other)}"
    return Channel(name, "m", "states", "distance", "", (one, two), (point, other), "distance")


_PARSERS: dict[str, Callable[[Mechanism, str], Channel]] = {
    "body": _parse_body,
    "joint": _parse_joint,
    "driver": _parse_driver,
    "distance": _parse_distance,
}


def _split_owner(kind: str, names: Sequence[str], text: str) -> tuple[str, str]:
    """Split a text into one of these names, the longest that fits, and what follows it."""
    fitting = [name for name in names if text.startswith(name) and text[len(name) :].startswith((".", "("))]
    if fitting or text in names:
        name = max(fitting, key=len, default=text)
        return name, text[len(name) :]
    given = re.split(r"\(|\.[^.]*$", text)[0]
    if given == GROUND:
        raise ValueError(f'"{GROUND}" does not move; name a body')
    known = f"; there are {', '.join(map(quoted, names))}" if names else "; the mechanism has none"
    raise ValueError(f"no {kind} named {quoted(given)}{suggestion(given, names) or known}")


def _split_point(text: str, default: Point | None = None) -> tuple[Point, str]:
    """Split a text into the point that it begins with and what follows it."""
    if not text.startswith("("):
        if default is None:
            raise ValueError("must be distance.BODY(px, py).BODY2(px, py): each body needs a point, in its own frame (m)")
        return default, text
    inside, closed, rest = text[1:].partition(")")
    try:
        x, y = map(float, inside.split(","))
    except ValueError:
        x = y = float("nan")
    if not closed or not abs(x) + abs(y) < float("inf"):
        raise ValueError(f"a point is (px, py), two numbers (m) in the body's own frame, not {quoted('(' + inside + closed)}")
    return (x, y), rest


def _check_quantity(owner: str, text: str, known: Iterable[str], more: Iterable[str] = ()) -> str:
    name = text.removeprefix(".")
    if text.startswith(".") and name in known:
        return name
    near = suggestion(name, [*known, *more]) or f"; it has {', '.join([*known, *more])}"
    raise ValueError(f"{owner} has no {quoted(name)}{near}" if name else f"{owner}: name one of {', '.join([*known, *more])}")


def _with_point(name: str, point: Point) -> str:
    return f"{name}({point[0]!r}, {point[1]!r})"


# --- values


def measure(mechanism: Mechanism, solution: Trajectory, channels: Sequence[Channel | Quantity]) -> Float[Array, "T C"]:
    """Compute the values of channels at the output times of a solution; it may be traced and batched.

    Accelerations and reactions are those of the constraints without stabilization,

        lambda = -(D^+)^T D^+ b,    M a = F - Psi_q^T lambda,

    of minimum norm where constraints are redundant, by singular values (`SVD`), whatever the method of the run: a batch would
    compute both sides of a branch. They are only computed where a channel needs them.

    Args:
        mechanism: the mechanism that moved.
        solution: a `Solution`, or another pytree with ts (T,), q and v (T, bodies, 3).
        channels: what is measured of it.

    Returns:
        Values (T, C) in SI units, one channel a column. Where a state is not a number, after a run has failed, nor are its
        values; derivatives are zero there, and unharmed elsewhere.
    """
    reached = jnp.all(jnp.isfinite(solution.q) & jnp.isfinite(solution.v), axis=(1, 2))
    finite = reached[:, None, None]
    # The scene's guess stands in: any state at which all derivatives are numbers.
    q, v = (jnp.where(finite, x, jax.lax.stop_gradient(x0)) for x, x0 in ((solution.q, mechanism.q0), (solution.v, mechanism.v0)))
    filled = eqx.tree_at(lambda s: (s.q, s.v), solution, (q, v))
    motion = _Motion(mechanism, solution.ts, q, v)
    columns = [c.function(mechanism, filled) if isinstance(c, Quantity) else _MEASURES[c.section](c, motion) for c in channels]
    return jnp.where(reached[:, None], jnp.stack(columns, -1), jnp.nan) if columns else jnp.zeros((len(q), 0))


class _Dynamics(NamedTuple):
    """Psi_q, lambda, the constraint of each of its m rows, and the accelerations, at all output times."""

    psi_q: Float[Array, "T m bodies 3"]
    multipliers: Float[Array, "T m"]
    row_owners: list[str]
    a: Float[Array, "T bodies 3"]


@dataclass(frozen=True, eq=False)
class _Motion:
    """States at all output times, and what follows from them."""

    mechanism: Mechanism
    ts: Float[Array, "T"]
    q: Float[Array, "T bodies 3"]
    v: Float[Array, "T bodies 3"]

    @cached_property
    def dynamics(self) -> _Dynamics:
        """Solve the equations of motion: only where a channel asks for it."""
        equations: MechanismSystem = prepare(self.mechanism, SVD())
        mass = jnp.stack([jnp.stack([body.mass, body.mass, body.inertia]) for body in self.mechanism.bodies.values()])

        def at(t, q, v):
            _, F, psi_q, _ = equations.matrices(t, q.ravel(), v.ravel())
            multipliers = equations.multipliers(t, q.ravel(), v.ravel())
            return psi_q.reshape(-1, *q.shape), multipliers, (F - psi_q.T @ multipliers).reshape(q.shape) / mass

        psi_q, multipliers, a = jax.vmap(at)(self.ts, self.q, self.v)
        return _Dynamics(psi_q, multipliers, [name for name, _ in equations.row_names], a)

    @cached_property
    def frames(self) -> dict[str, Frame]:
        """The frame of each body and of the ground, each of its entries (T,)."""
        found = {}
        for body in (*self.mechanism.body_names, GROUND):
            (x, y, angle), (vx, vy, omega) = self._entries(self.q, body), self._entries(self.v, body)
            found[body] = Frame(x, y, angle, jnp.cos(angle), jnp.sin(angle), vx, vy, omega)
        return found

    @cached_property
    def loads(self) -> dict[str, Float[Array, "T bodies 3"]]:
        """Forces and torques of each constraint on all bodies, -Psi_q^T lambda of its rows."""
        psi_q, multipliers, owners, _ = self.dynamics
        by_row = -multipliers[..., None, None] * psi_q
        rows = {owner: [k for k, name in enumerate(owners) if name == owner] for owner in owners}
        return {owner: by_row[:, own[0] : own[-1] + 1].sum(1) for owner, own in rows.items()}

    def acceleration(self, body: str) -> list[Array]:
        """ax, ay and alpha of a body, each (T,)."""
        return self._entries(self.dynamics.a, body)

    def load(self, owner: str, body: str) -> tuple[Array, Array, Array]:
        """Force and torque of a constraint on a body; on the ground: minus those on the others."""
        loads = self.loads[owner]
        if body != GROUND:
            fx, fy, torque = self._entries(loads, body)
            return fx, fy, torque
        fx, fy, torque = (loads[..., k] for k in range(3))
        about_origin = torque + self.q[..., 0] * fy - self.q[..., 1] * fx
        return -fx.sum(1), -fy.sum(1), -about_origin.sum(1)

    def _entries(self, x: Array, body: str) -> list[Array]:
        place = None if body == GROUND else self.mechanism.body_names.index(body)
        return [jnp.zeros(len(x)) if place is None else x[:, place, k] for k in range(3)]


def _measure_body(channel: Channel, motion: _Motion) -> Array:
    (name,), (point,), quantity = channel.bodies, channel.points, channel.quantity
    frame = motion.frames[name]
    if quantity in ("angle", "omega"):
        return getattr(frame, quantity)
    if quantity == "alpha":
        return motion.acceleration(name)[2]
    axis = quantity[-1]
    if channel.needs == "accelerations":  # a + alpha x r - omega^2 r
        ax, ay, alpha = motion.acceleration(name)
        arm, square = frame.vector(point), frame.omega**2
        return ax - alpha * arm.y - square * arm.x if axis == "x" else ay + alpha * arm.x - square * arm.y
    return getattr(frame.velocity(point) if quantity[0] == "v" else frame.point(point), axis)


def _measure_joint(channel: Channel, motion: _Motion) -> Array:
    if channel.needs == "reactions":
        return motion.load(channel.owner, channel.bodies[0])[list(LOADS).index(channel.quantity)]
    if channel.quantity == "alpha":
        one, two = (motion.acceleration(body)[2] for body in channel.bodies)
    else:
        one, two = (getattr(motion.frames[body], channel.quantity) for body in channel.bodies)
    return two - one


def _measure_driver(channel: Channel, motion: _Motion) -> Array:
    """-lambda: the row of a driver is its coordinate minus what is prescribed."""
    return -motion.dynamics.multipliers[:, motion.dynamics.row_owners.index(channel.owner)]


def _measure_distance(channel: Channel, motion: _Motion) -> Array:
    return between(channel.points, *(motion.frames[body] for body in channel.bodies)).norm()


_MEASURES: dict[str, Callable[[Channel, _Motion], Array]] = {
    "body": _measure_body,
    "joint": _measure_joint,
    "driver": _measure_driver,
    "distance": _measure_distance,
}
