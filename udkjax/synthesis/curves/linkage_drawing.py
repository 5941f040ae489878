"""A linkage of dyads as a drawing, and the check of its whole turn by the kinematics of the mechanism."""

from itertools import count
from string import ascii_uppercase
from typing import Any

import numpy as np

from udkjax.arrays import FULL_TURN
from udkjax.equations.states.quantities import violation
from udkjax.positions.assembling.channels import locate
from udkjax.positions.following.kinematics import kinematics
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.synthesis.curves.dyad_forms import PINS, RAIL, SLIDE
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    GEARED_CRANK,
    HEAD_NUMBERS,
    SECOND_PIVOT,
    TAIL_NUMBERS,
    Topology,
    positions,
)
from udkjax.synthesis.curves.targets import WantedCurve

PATH_PIN = "P"  # name of the drawing pin
CHECKED_POSITIONS = 720  # positions of a turn at which the constraints must hold, on one branch
CLOSED_TO = 1e-12  # largest residual of a constraint at these positions, relative to coordinates of its pins, or to a turn
SAME_BRANCH = 1e-8  # largest distance of a pin from itself by another method, relative to these; beyond, it is another branch
STEEL_DENSITY = 7850.0  # kg/m^3, of steel
LINK_WIDTH, LINK_THICKNESS = 0.03, 0.01  # of links, relative to the extent of the curve
WHEEL_RADII = 0.6  # sum of the radii of two wheels, relative to the distance of their centres
THIN_AREA = 1e-3  # a plate with a smaller area, relative to the square of its longest side, is drawn as a bar of a given mass
TURNS_PER_SECOND = 1.0
CRANK_SPEED = f"{60 * TURNS_PER_SECOND:g} rpm"
PIN_LETTERS = [a for a in ascii_uppercase if a not in (PATH_PIN, "O")]

LinkPoint = tuple[int, complex]  # number of a link, and a place in its frame


def pins_of_linkage(x: np.ndarray, topology: Topology) -> dict[str, list[LinkPoint]]:
    """Return the pins of a linkage by name, each as a list of the links that it joins, with its place in their frames."""
    pins: dict[str, list[LinkPoint]] = {"O": [(0, complex(x[0], x[1])), (1, 0j)]}
    if topology.ratio[0]:
        pins["O2"] = [(0, complex(x[SECOND_PIVOT], x[SECOND_PIVOT + 1])), (GEARED_CRANK, 0j)]
    names = (f"{a}{k or ''}" for k in count() for a in PIN_LETTERS)
    for d in range(topology.dyads):
        k, one, two = HEAD_NUMBERS + DYAD_NUMBERS * d, BASE_LINKS + 2 * d, BASE_LINKS + 2 * d + 1
        form = int(topology.form[0, d])
        pins[next(names)] = [(int(topology.first[0, d]), complex(x[k], x[k + 1])), (one, 0j)]
        if form != RAIL:
            pins[next(names)] = [(int(topology.second[0, d]), complex(x[k + 2], x[k + 3])), (two, 0j)]
        if form != SLIDE:
            pins[next(names)] = [(one, complex(x[k + 4])), (two, 0j if form == RAIL else complex(x[k + 5]))]
    return pins | {PATH_PIN: [(BASE_LINKS + 2 * topology.dyads - 2, complex(x[-TAIL_NUMBERS], x[-TAIL_NUMBERS + 1]))]}


def _link_name(number: int) -> str:
    return f"link{number - BASE_LINKS + 1}" if number >= BASE_LINKS else (GROUND, "crank", "crank2")[number]


def drawing_of(x: np.ndarray, topology: Topology, wanted: WantedCurve, name: str, unit: str = "m") -> Drawing:
    """Return the drawing of a normalized linkage at the beginning of its curve, with lengths in `unit`."""
    at = positions(x[None], topology, np.zeros((1, 1)), 0.0)
    pins = pins_of_linkage(x, topology)
    size = Units({"length": unit}).size("m")
    places, members = {}, {}
    for pin, points in pins.items():
        link, local = points[0]
        place = wanted.middle + wanted.scale * complex(at.origins[link, 0, 0] + at.turns[link, 0, 0] * local)
        places[pin] = place / size
        for link, _ in points:
            members.setdefault(link, []).append(pin)
    links = {_link_name(k): _link(members[k], places, wanted.extent, size) for k in sorted(members) if k}
    written = {pin: (z.real, z.imag) for pin, z in places.items()}
    slides = []
    for d in np.flatnonzero(topology.form[0] != PINS).tolist():
        on = int(topology.second[0, d]) if topology.form[0, d] == RAIL else BASE_LINKS + 2 * d
        turn = complex(at.turns[BASE_LINKS + 2 * d + 1, 0, 0])
        slides.append({"link": _link_name(BASE_LINKS + 2 * d + 1), "direction": (turn.real, turn.imag), "on": _link_name(on)})
    motor, units = {"pin": "O", "speed": CRANK_SPEED}, {"length": unit}
    rest: dict[str, Any] = {
        "ground": members[0],
        "motors": [motor],
        "slides": slides,
        "gravity": (0.0, 0.0),
        "name": name,
        "units": units,
    }
    if ratio := int(topology.ratio[0]):
        wheel = WHEEL_RADII * max(abs(places["O2"] - places["O"]), LINK_WIDTH * wanted.extent / size) / (1 + abs(ratio))
        belt = "open" if ratio > 0 else "crossed"
        rest["gears"] = [{"links": ["crank", "crank2"], "radii": (abs(ratio) * wheel, wheel), "belt": belt}]
    return Drawing(written, links, **rest)


def _link(pins: list[str], places: dict[str, complex], extent: float, size: float) -> dict[str, Any]:
    """Return a link as a table for `Drawing`: a disc or bar, or a plate with corners in order; a thin plate has a given mass.

    Args:
        pins: the names of its pins.
        places: the places of all pins, complex, in the unit of the drawing.
        extent: the extent of the curve (m).
        size: the unit of the drawing in m.
    """
    shape = {"density": STEEL_DENSITY, "thickness": LINK_THICKNESS * extent / size}
    if len(pins) <= 2:
        return {"pins": pins, "width": LINK_WIDTH * extent / size, **shape}
    z = np.array([places[pin] for pin in pins])
    order = np.argsort(np.angle(z - z.mean()), kind="stable")
    sides = np.abs(np.roll(z[order], -1) - z[order])
    order = np.roll(order, -int(sides.argmax()))  # the longest side gives the link its direction
    z = z[order]
    area = 0.5 * abs(float(np.sum(np.imag(np.conj(z) * np.roll(z, -1)))))
    named = {"pins": [pins[k] for k in order]}
    if area > THIN_AREA * sides.max() ** 2:
        return named | shape
    length, middle = size * float(sides.max()), z.mean()
    mass = STEEL_DENSITY * LINK_THICKNESS * extent * LINK_WIDTH * extent * length
    return named | {"mass": mass, "centre": (middle.real, middle.imag), "inertia": f"{mass * length**2 / 12!r} kg m2"}


def turns_on_its_branch(mechanism: Mechanism, x: np.ndarray, topology: Topology, wanted: WantedCurve, size: float) -> bool:
    """Return True if `kinematics` follows a mechanism over a turn, with all constraints closed, on the branch of the linkage.

    Args:
        mechanism: the mechanism of a drawing of the linkage.
        x: the numbers of the linkage.
        topology: its structure.
        wanted: the curve.
        size: an upper bound of the coordinates of pins (m).
    """
    turns = np.linspace(0.0, 1.0, CHECKED_POSITIONS + 1)
    motion = kinematics(mechanism, None, turns / TURNS_PER_SECOND)
    if not np.all(motion.reached):
        return False
    open_by = np.abs(violation(mechanism, motion))
    of_motor = len(mechanism.drivers)  # the last rows, in rad
    pin = wanted.middle + wanted.scale * positions(x[None], topology, FULL_TURN * turns[None], 0.0).pin[0]
    off = np.abs(np.asarray(motion.path(*locate(mechanism, f"pin.{PATH_PIN}", None))) @ [1, 1j] - pin)
    is_closed = open_by[:, :-of_motor].max() <= CLOSED_TO * size and open_by[:, -of_motor:].max() <= CLOSED_TO * FULL_TURN
    return bool(is_closed and off.max() <= SAME_BRANCH * size)
