"""A linkage of dyads as a drawing, and the check of its whole turn by `kinematics`."""

from string import ascii_uppercase
from typing import Any

import numpy as np

from udkjax.positions.answers.pin_motion import pin_motion
from udkjax.positions.following.drive import drive, only_driver
from udkjax.positions.following.kinematics import FULL_TURN, Kinematics, kinematics
from udkjax.scene.drawing import Drawing
from udkjax.scene.mechanism import Mechanism
from udkjax.synthesis.curves.dyads import BASE, EACH, HEAD, TAIL, Topology, positions
from udkjax.synthesis.curves.targets import WantedCurve

PIN = "P"  # name of the drawing pin
TURN_VALUES = 720  # positions of a turn that `kinematics` has to reach on the same branch
AGREEMENT = 1e-9  # largest distance of a pin of the motion from its closed form, relative to the size of the linkage
DENSITY = 7850.0  # kg/m^3, of steel
WIDTH, THICKNESS = 0.03, 0.01  # of links, relative to the extent of the curve
THIN = 1e-3  # a plate with a smaller area, relative to the square of its longest side, is drawn as a bar of a given mass
SPEED = "60 rpm"
LETTERS = [a for a in ascii_uppercase if a not in (PIN, "O")]

LinkPoint = tuple[int, complex]  # number of a link, and a place in its frame


def pins_of_linkage(x: np.ndarray, topology: Topology) -> dict[str, list[LinkPoint]]:
    """Return the pins by name, each as a point of the links that it joins."""
    pins: dict[str, list[LinkPoint]] = {"O": [(0, complex(x[0], x[1])), (1, 0j)]}
    names = iter([*LETTERS, *(f"{a}{k}" for k in range(1, 10) for a in LETTERS)])
    for d in range(topology.dyads):
        k, one, two = HEAD + EACH * d, BASE + 2 * d, BASE + 2 * d + 1
        a, b, c = next(names), next(names), next(names)
        pins[a] = [(int(topology.first[0, d]), complex(x[k], x[k + 1])), (one, 0j)]
        pins[b] = [(int(topology.second[0, d]), complex(x[k + 2], x[k + 3])), (two, 0j)]
        pins[c] = [(one, complex(x[k + 4])), (two, complex(x[k + 5]))]
    return pins | {PIN: [(BASE + 2 * topology.dyads - 2, complex(x[-TAIL], x[-TAIL + 1]))]}


def _link_name(number: int) -> str:
    return "crank" if number == 1 else f"link{number - BASE + 1}"


def drawing_of(x: np.ndarray, topology: Topology, wanted: WantedCurve, name: str) -> Drawing:
    """Return the drawing of a normalized linkage at the beginning of its curve, in metres."""
    at = positions(x[None], topology, np.zeros((1, 1)), 0.0)
    pins = pins_of_linkage(x, topology)
    places, members = {}, {}
    for pin, points in pins.items():
        link, local = points[0]
        places[pin] = wanted.middle + wanted.scale * complex(at.origins[link, 0, 0] + at.turns[link, 0, 0] * local)
        for link, _ in points:
            members.setdefault(link, []).append(pin)
    links = {_link_name(k): _link(members[k], places, wanted.extent) for k in sorted(members) if k}
    written = {pin: (z.real, z.imag) for pin, z in places.items()}
    return Drawing(written, links, ground=members[0], motors=[{"pin": "O", "speed": SPEED}], gravity=(0.0, 0.0), name=name)


def _link(pins: list[str], places: dict[str, complex], extent: float) -> dict[str, Any]:
    """Return the table of a link through pins: a bar, or a plate whose corners are in order about its middle."""
    shape = {"density": DENSITY, "thickness": THICKNESS * extent}
    if len(pins) == 2:
        return {"pins": pins, "width": WIDTH * extent, **shape}
    z = np.array([places[pin] for pin in pins])
    order = np.argsort(np.angle(z - z.mean()), kind="stable")
    sides = np.abs(np.roll(z[order], -1) - z[order])
    order = np.roll(order, -int(sides.argmax()))  # the longest side gives the link its direction
    z = z[order]
    area = 0.5 * abs(float(np.sum(np.imag(np.conj(z) * np.roll(z, -1)))))
    named = {"pins": [pins[k] for k in order]}
    if area > THIN * sides.max() ** 2:
        return named | shape
    mass = DENSITY * THICKNESS * extent * WIDTH * extent * float(sides.max())
    middle = z.mean()
    return named | {"mass": mass, "centre": (middle.real, middle.imag), "inertia": mass * float(sides.max()) ** 2 / 12}


def turn_of(mechanism: Mechanism, x: np.ndarray, topology: Topology, wanted: WantedCurve) -> Kinematics | None:
    """Return the motion over a turn of 720 steps; None if `kinematics` does not reach it on the branch of the closed form."""
    driver = only_driver(mechanism)
    drawn = float(drive(mechanism, driver).value(mechanism.q0))
    theta = np.linspace(0.0, FULL_TURN, TURN_VALUES + 1)
    motion = kinematics(mechanism, driver, drawn + theta)
    if not np.all(np.asarray(motion.reached)):
        return None
    moved, at = pin_motion(mechanism, motion).pins, positions(x[None], topology, theta[None], 0.0)
    for pin, points in pins_of_linkage(x, topology).items():
        if any(link == 0 for link, _ in points):
            continue
        place = np.asarray(moved[pin])[:, 0]
        for link, local in points:
            z = wanted.middle + wanted.scale * (at.origins[link, 0] + at.turns[link, 0] * local)
            if not np.max(np.abs(place[:, 0] + 1j * place[:, 1] - z)) <= AGREEMENT * np.abs(z - wanted.middle).max():
                return None
    return motion
