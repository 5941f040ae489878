"""Names of channels, in the dialect of the parameters' names: read, checked, and given back as they are usually written."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from udkjax.scene.bodies import GROUND
from udkjax.scene.checks import quoted, suggestion
from udkjax.scene.mechanism import Mechanism

Needs = Literal["states", "accelerations", "reactions"]
Spot = tuple[float, float]
_CENTRE: Spot = (0.0, 0.0)
_OF_POINTS = {"x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "ax": "m/s2", "ay": "m/s2"}
_OF_ANGLES = {"angle": "rad", "omega": "rad/s", "alpha": "rad/s2"}
LOADS = {"fx": "N", "fy": "N", "torque": "N m"}
_UNITS = {**_OF_POINTS, **_OF_ANGLES, **LOADS}
_ACCELERATIONS = ("ax", "ay", "alpha")


@dataclass(frozen=True)
class Channel:
    """One measured quantity: plain data, equal where the canonical names are, and so fit to be static in a compiled program."""

    name: str
    units: str
    needs: Needs
    section: str  # body, joint, driver or distance
    owner: str  # the joint or driver; else empty
    bodies: tuple[str, ...]  # whose it is; of an angle at a joint, and of a distance, both
    spots: tuple[Spot, ...] = ()  # a point of each, in its own frame (m)
    quantity: str = ""


def channel_of(mechanism: Mechanism, text: str) -> Channel:
    """Return the channel of a name; names of bodies and joints may contain dots. Raises ValueError, which says what is wrong."""
    text = text.strip()
    section, _, rest = text.partition(".")
    if section not in _READERS:
        raise ValueError(f"begins with none of {', '.join(f'{s}.' for s in _READERS)}{suggestion(text, channels_of(mechanism))}")
    return _READERS[section](mechanism, rest)


def channels_of(mechanism: Mechanism) -> list[str]:
    """Return the names of all channels that need no point."""
    found = [f"body.{name}.{q}" for name in mechanism.body_names for q in (*_OF_POINTS, *_OF_ANGLES)]
    for name, joint in mechanism.joints.items():
        found += [f"joint.{name}.{q}" for q in (*(_OF_ANGLES if len(joint.bodies) == 2 else ()), *LOADS)]
    return [*found, *(f"driver.{name}.load" for name in mechanism.driver_names)]


def _body(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _owner("body", mechanism.body_names, text)
    spot, rest = _spot(rest, _CENTRE)
    shown = _shown(name, spot) if spot is not _CENTRE else name
    known = _OF_POINTS if spot is not _CENTRE else {**_OF_POINTS, **_OF_ANGLES}
    quantity = _quantity(f"body {quoted(shown)}", rest, known)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(f"body.{shown}.{quantity}", _UNITS[quantity], needs, "body", "", (name,), (spot,), quantity)


def _joint(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _owner("joint", mechanism.joint_names, text)
    bodies = mechanism.frames_of(mechanism.joints[name])
    for body in sorted(bodies, key=len, reverse=True):
        if rest.startswith(f".{body}."):
            quantity = _quantity(f"joint {quoted(name)} on body {quoted(body)}", rest.removeprefix(f".{body}"), LOADS)
            return Channel(f"joint.{name}.{body}.{quantity}", _UNITS[quantity], "reactions", "joint", name, (body,), (), quantity)
    two = bodies[:2]
    known = {**(_OF_ANGLES if len(two) == 2 else {}), **LOADS}
    quantity = _quantity(f"joint {quoted(name)}", rest, known, [f"{b}.{q}" for b in bodies for q in LOADS])
    units, label = _UNITS[quantity], f"joint.{name}.{quantity}"
    if quantity in LOADS:
        return Channel(label, units, "reactions", "joint", name, two[-1:], (), quantity)
    needs: Needs = "accelerations" if quantity in _ACCELERATIONS else "states"
    return Channel(label, units, needs, "joint", name, two, (), quantity)


def _driver(mechanism: Mechanism, text: str) -> Channel:
    name, rest = _owner("driver", mechanism.driver_names, text)
    quantity = _quantity(f"driver {quoted(name)}", rest, {"load": ""})
    driver = mechanism.drivers[name]
    units = "N m" if driver.coordinate == "angle" else "N"
    return Channel(f"driver.{name}.{quantity}", units, "reactions", "driver", name, driver.bodies[1:], (), quantity)


def _distance(mechanism: Mechanism, text: str) -> Channel:
    one, rest = _owner("body", (*mechanism.body_names, GROUND), text)
    spot, rest = _spot(rest)
    if not rest.startswith("."):
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the first point comes {quoted(rest)}")
    two, rest = _owner("body", (*mechanism.body_names, GROUND), rest[1:])
    other, rest = _spot(rest)
    if rest:
        raise ValueError(f"must be distance.BODY(px, py).BODY2(px, py); after the second point comes {quoted(rest)}")
    name = f"distance.{_shown(one, spot)}.{_shown(two, other)}"
    return Channel(name, "m", "states", "distance", "", (one, two), (spot, other), "distance")


_READERS: dict[str, Callable[[Mechanism, str], Channel]] = {
    "body": _body,
    "joint": _joint,
    "driver": _driver,
    "distance": _distance,
}


def _owner(kind: str, names: Sequence[str], text: str) -> tuple[str, str]:
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


def _spot(text: str, default: Spot | None = None) -> tuple[Spot, str]:
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


def _quantity(owner: str, text: str, known: Iterable[str], more: Iterable[str] = ()) -> str:
    name = text.removeprefix(".")
    if text.startswith(".") and name in known:
        return name
    near = suggestion(name, [*known, *more]) or f"; it has {', '.join([*known, *more])}"
    raise ValueError(f"{owner} has no {quoted(name)}{near}" if name else f"{owner}: name one of {', '.join([*known, *more])}")


def _shown(name: str, spot: Spot) -> str:
    return f"{name}({spot[0]!r}, {spot[1]!r})"
