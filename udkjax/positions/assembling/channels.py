"""Channels: measurable quantities of a motion, named like parameters.

    body.NAME.x  y  angle  vx  vy  omega  ax  ay  alpha       centre of mass and angle, their rates and accelerations
    body.NAME(px, py).x  y  vx  vy  ax  ay                    a point given in the body's own frame (m)
    pin.NAME.x  y  vx  vy  ax  ay                             the point of a joint; joint.NAME.x is the same
    joint.NAME.angle  omega  alpha                            theta_2 - theta_1 of the joint's two bodies: an encoder at the pin
    joint.NAME.fx  fy  torque                                 load of the joint on its second body, as in `reactions`
    joint.NAME.BODY.fx  fy  torque                            load of the joint on the named body
    driver.NAME.load                                          load of the driver on its second body along its coordinate
    distance.BODY(px, py).BODY2(px, py)                       between two points; a body may be "ground"
    q[K]  v[K]                                                coordinate K of a user-defined system, and its rate

Torques are about the centre of mass, those on the ground about the origin. SI units throughout.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from jaxtyping import Array, Float

from udkjax.annotations import Numbers
from udkjax.arrays import number
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.requirements import require_function, require_text
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Joint
from udkjax.scene.mechanism import Mechanism
from udkjax.wording import quote, suggestion

Needs = Literal["states", "accelerations", "reactions"]
LocalPoint = tuple[float, float]  # in the body's frame (m)
_CENTRE: LocalPoint = (0.0, 0.0)  # the centre of mass, the origin of a body's frame
POINT_UNITS = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "ax": "m/s2", "ay": "m/s2"}
_ANGLE_UNITS = {"angle": "rad", "omega": "rad/s", "alpha": "rad/s2"}
LOADS = {"fx": "N", "fy": "N", "torque": "N m"}
_UNITS = {**POINT_UNITS, **_ANGLE_UNITS, **LOADS}
RATES = ("vx", "vy", "omega")  # the rates of the coordinates of a body
_ACCELERATIONS = ("ax", "ay", "alpha")


class StateHistory(Protocol):
    """A motion to measure: a pytree with output times ts (T,) and states q and v (T, bodies, 3), such as a `Solution`."""

    @property
    def ts(self) -> Float[Any, "T"]: ...

    @property
    def q(self) -> Float[Any, "T bodies 3"]: ...

    @property
    def v(self) -> Float[Any, "T bodies 3"]: ...


@dataclass(frozen=True)
class Channel:
    """A measurable quantity of a motion: plain data, equal if canonical names are equal, and thus static in JAX programs.

    Attributes:
        name: the canonical name, such as "body.link1.angle".
        units: the SI unit, as text.
        needs: the part of a motion's computation that the channel needs; accelerations and reactions take more time.
    """

    name: str
    units: str
    needs: Needs
    section: str  # body, joint, pin, driver, distance or state
    owner: str  # name of the joint or driver; q or v of a system; else empty
    bodies: tuple[str, ...]  # names of its bodies: two for an angle at a joint or a distance
    points: tuple[LocalPoint, ...] = ()  # a point of each body
    quantity: str = ""

    @property
    def is_of_point(self) -> bool:
        """True if the channel is x or y of the position, velocity or acceleration of a point."""
        return self.quantity in POINT_UNITS


@dataclass(frozen=True, eq=False)
class Quantity:
    """A user-defined channel, equal only to itself: create it once and reuse it, so that it compiles once.

    Attributes:
        name: name in tables and messages.
        function: function of the mechanism and its solution, written in jax.numpy; returns (T,) in `units`.
        units: SI units, as text.
    """

    name: str
    function: Callable[[Any, StateHistory], Float[Array, "T"]]
    units: str = ""

    def __post_init__(self):
        require_text("name", self.name)
        require_function("function", self.function, "(mechanism, solution)")
        require_text("units", self.units, may_be_empty=True)

    def __repr__(self) -> str:
        function = getattr(self.function, "__name__", type(self.function).__name__)
        return f"Quantity(name={self.name!r}, function={function}, units={self.units!r})"

    def __str__(self) -> str:
        return self.name


# --- points


def has_point(joint: Joint) -> bool:
    """Return True if a joint has points on its bodies: its name is then also the name of a pin."""
    return getattr(joint, "points", None) is not None


def pins_of(mechanism: Mechanism) -> list[str]:
    """Return the names of all named points: joints that have points, and pins of the drawing at which no two links meet."""
    drawn = () if mechanism.drawing is None else mechanism.drawing.groups["pin"]
    joints = [name for name, joint in mechanism.joints.items() if has_point(joint)]
    return [*joints, *(name for name in drawn if name not in mechanism.joints)]


def point_of_pin(mechanism: Mechanism, name: str) -> tuple[str, Float[Array, "2"]]:
    """Return the point of a joint, or of a pin of the drawing: a body, or "ground", and the point (m) in its frame.

    For joints with two points, such as a slot, a distance or a cam, this is the point of the second body.
    """
    if name in mechanism.joints:
        joint = mechanism.joints[name]
        last = len(joint.points) - 1
        return joint.bodies[last], joint.points[last]
    found = None if mechanism.drawing is None else mechanism.drawing.locate_pin(name)
    if found is None:
        raise ValueError(f"there is no pin {quote(name)}{suggestion(name, pins_of(mechanism))}")
    return found


def locate(mechanism: Mechanism, of: str, point: Numbers | None = None) -> tuple[str, Float[Array, "2"]]:
    """Return a body, or "ground", and a point (m) in its frame, from the name of a pin, or from a body and a point.

    Raises:
        ValueError: there is no such body or joint, or the joint has no point; the message suggests another name.
    """
    section, _, name = of.partition(".")
    known = {"body": (*mechanism.body_names, GROUND), "pin": pins_of(mechanism)}
    known["joint"] = known["pin"]
    if section in known and name in known[section] and of not in (*known["body"], *known["pin"]):
        kinds = [section]
    else:
        kinds, name = [kind for kind in ("body", "pin") if of in known[kind]], of
    if len(kinds) == 2 and point is None:
        raise ValueError(f"{quote(of)} is a body and a joint: write {quote(f'body.{of}')} or {quote(f'joint.{of}')}")
    if not kinds:
        everything = (*mechanism.body_names, *pins_of(mechanism))
        if of in mechanism.joints:
            raise ValueError(f"joint {quote(of)}, a {type(mechanism.joints[of]).__name__}, is not at a point: name a body")
        raise ValueError(f"{quote(of)} is neither a body nor a pin{suggestion(of, everything) or _listed(everything)}")
    if "body" in kinds:
        local = number(_CENTRE if point is None else point)
        if local.shape != (2,):
            meant = f"(px, py), two numbers (m) in the frame of {quote(name)}"
            raise ValueError(f"point must be {meant}; its shape is {local.shape}")
        return name, local
    if point is not None:
        raise ValueError(f"{quote(of)} is a pin, whose point is known; a point is given in the frame of a body")
    return point_of_pin(mechanism, name)


def _listed(names: Sequence[str]) -> str:
    return f"; there are {', '.join(map(quote, names))}"


# --- names


def channel_of(mechanism: Mechanism | ConstrainedSystem, text: str) -> Channel:
    """Return the channel that a name such as "body.link1.angle" denotes; names of bodies and joints may contain dots.

    Raises:
        ValueError: no such channel; the message suggests another name.
    """
    text = text.strip()
    if isinstance(mechanism, ConstrainedSystem):
        return _parse_entry(mechanism, text)
    section, _, rest = text.partition(".")
    if section not in _PARSERS:
        raise ValueError(f"begins with none of {', '.join(f'{s}.' for s in _PARSERS)}{suggestion(text, channels_of(mechanism))}")
    return _PARSERS[section](mechanism, rest)


def _parse_entry(system: ConstrainedSystem, text: str) -> Channel:
    found = re.fullmatch(r"([qv])\[(\d+)\]", text)
    if found is None:
        raise ValueError(f"must be a coordinate such as q[0], a velocity such as v[0], or a Quantity; {quote(text)} is not")
    if system.q0 is not None and int(found[2]) >= len(system.q0):
        raise ValueError(
            f"there are {len(system.q0)} coordinates, from q[0] to q[{len(system.q0) - 1}]; {quote(text)} is not one"
        )
    return Channel(text, "", "states", "state", found[1], (), (), found[2])


def channels_of(mechanism: Mechanism) -> list[str]:
    """Return the names of all channels that need no point, in the order of the scene."""
    found = [f"body.{name}.{q}" for name in mechanism.body_names for q in (*POINT_UNITS, *_ANGLE_UNITS)]
    for name, joint in mechanism.joints.items():
        found += [f"joint.{name}.{q}" for q in (*(_ANGLE_UNITS if len(joint.bodies) == 2 else ()), *LOADS)]
    found += [f"pin.{name}.{q}" for name in pins_of(mechanism) for q in POINT_UNITS]
    return [*found, *(f"driver.{name}.load" for name in mechanism.driver_names)]


def _parse_body(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("body", mechanism.body_names, text)
    point, rest = _split_point(rest, _CENTRE)
    shown = _with_point(name, point) if point is not _CENTRE else name
    known = POINT_UNITS if point is not _CENTRE else {**POINT_UNITS, **_ANGLE_UNITS}
    quantity = _check_quantity(f"body {quote(shown)}", rest, known)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(f"body.{shown}.{quantity}", _UNITS[quantity], needs, "body", "", (name,), (point,), quantity)


def _parse_joint(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("joint", mechanism.joint_names, text)
    bodies = mechanism.frames_of(mechanism.joints[name])
    for body in sorted(bodies, key=len, reverse=True):
        if rest.startswith(f".{body}."):
            quantity = _check_quantity(f"joint {quote(name)} on body {quote(body)}", rest.removeprefix(f".{body}"), LOADS)
            return Channel(f"joint.{name}.{body}.{quantity}", _UNITS[quantity], "reactions", "joint", name, (body,), (), quantity)
    pair = bodies[:2]
    places = POINT_UNITS if has_point(mechanism.joints[name]) else {}
    known = {**places, **(_ANGLE_UNITS if len(pair) == 2 else {}), **LOADS}
    quantity = _check_quantity(f"joint {quote(name)}", rest, known, [f"{b}.{q}" for b in bodies for q in LOADS])
    units, label = _UNITS[quantity], f"joint.{name}.{quantity}"
    if quantity in LOADS:
        return Channel(label, units, "reactions", "joint", name, pair[-1:], (), quantity)  # on the last
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(label, units, needs, "joint", name, pair, (), quantity)


def _parse_pin(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("pin", pins_of(mechanism), text)
    quantity = _check_quantity(f"pin {quote(name)}", rest, POINT_UNITS)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    body, _ = point_of_pin(mechanism, name)
    return Channel(f"pin.{name}.{quantity}", _UNITS[quantity], needs, "pin", name, (body,), (), quantity)


def _parse_driver(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _split_owner("driver", mechanism.driver_names, text)
    quantity = _check_quantity(f"driver {quote(name)}", rest, {"load": ""})
    driver = mechanism.drivers[name]
    return Channel(f"driver.{name}.{quantity}", driver.effort_unit, "reactions", "driver", name, driver.bodies[1:], (), quantity)


def _parse_distance(mechanism: Mechanism, text: str) -> Channel:
    body, rest = _split_owner("body", (*mechanism.body_names, GROUND), text)
    point, rest = _split_point(rest)
    if not rest.startswith("."):
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the first point comes {quote(rest)}")
    body_2, rest = _split_owner("body", (*mechanism.body_names, GROUND), rest[1:])
    point_2, rest = _split_point(rest)
    if rest:
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the second point comes {quote(rest)}")
    name = f"distance.{_with_point(body, point)}.{_with_point(body_2, point_2)}"
    return Channel(name, "m", "states", "distance", "", (body, body_2), (point, point_2), "distance")


_PARSERS: dict[str, Callable[[Mechanism, str], Channel]] = {
    "body": _parse_body,
    "joint": _parse_joint,
    "pin": _parse_pin,
    "driver": _parse_driver,
    "distance": _parse_distance,
}


def _split_owner(kind: str, names: Sequence[str], text: str) -> tuple[str, str]:
    """Split a string into the longest of the `names` that it begins with, and the rest; raise `ValueError` if there is none."""
    fitting = [name for name in names if text.startswith(name) and text[len(name) :].startswith((".", "("))]
    if fitting or text in names:
        name = max(fitting, key=len, default=text)
        return name, text[len(name) :]
    given = re.split(r"\(|\.[^.]*$", text)[0]
    if given == GROUND:
        raise ValueError(f'"{GROUND}" does not move; name a body')
    known = _listed(names) if names else "; the mechanism has none"
    raise ValueError(f"no {kind} named {quote(given)}{suggestion(given, names) or known}")


def _split_point(text: str, default: LocalPoint | None = None) -> tuple[LocalPoint, str]:
    """Split a string into the point with which it begins, such as "(0.1, 0)", or else the default, and the rest.

    Raises a `ValueError` if there is no point and no default, or the point is malformed.
    """
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
        raise ValueError(f"a point is (px, py), two numbers (m) in the body's own frame, not {quote('(' + inside + closed)}")
    return (x, y), rest


def _check_quantity(owner: str, text: str, known: Iterable[str], more: Iterable[str] = ()) -> str:
    name = text.removeprefix(".")
    if text.startswith(".") and name in known:
        return name
    near = suggestion(name, [*known, *more]) or f"; it has {', '.join([*known, *more])}"
    raise ValueError(f"{owner} has no {quote(name)}{near}" if name else f"{owner}: name one of {', '.join([*known, *more])}")


def _with_point(name: str, point: LocalPoint) -> str:
    return f"{name}({point[0]!r}, {point[1]!r})"
