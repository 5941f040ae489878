"""Mechanisms at rest with friction, and the bounds of the effort that holds them, by closed forms.

All loads are given as forces, without gravity, so that the masses are free: no bound depends on them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import udkjax as udk

STILL = [0.0, 0.0]


class Held(NamedTuple):
    """A mechanism as a function of the masses of its bodies, the coordinate that holds it, its value, and both bounds."""

    mechanism: Callable[[np.ndarray], udk.Mechanism]
    bodies: int
    coordinate: str | udk.Coordinate
    value: float
    bounds: tuple[float, float]


def friction(joint: str, coefficient: float, **more: Any) -> udk.Friction:
    return udk.Friction(joint, coefficient=coefficient, law="set-valued", **more)


def wedge(slope: float, coefficient: float, load: float) -> Held:
    """A wedge of given slope below a block in a vertical guide: P = W tan(slope +- phi)."""

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        bodies = {"wedge": udk.Body(masses[0], masses[0]), "block": udk.Body(masses[1], masses[1], [0.0, 1.0])}
        joints = {
            "floor": udk.Prismatic(["ground", "wedge"], [STILL, STILL], axis=0.0),
            "guide": udk.Prismatic(["ground", "block"], [STILL, STILL], axis=np.pi / 2),
            "face": udk.Slot(["wedge", "block"], [[0.0, 1.0], STILL], axis=-slope),
        }
        forces = {"rub": friction("face", coefficient), "load": udk.Force("block", [0.0, -load])}
        return udk.Mechanism(bodies, joints, forces=forces, gravity=STILL)

    phi = np.arctan(coefficient)
    steep = slope + phi > np.pi / 2
    return Held(mechanism, 2, "body.wedge.x", 0.0, (load * np.tan(slope - phi), np.inf if steep else load * np.tan(slope + phi)))


def rubbing_wedge(slope: float, coefficient: float, load: float) -> Held:
    """The wedge with friction on its floor, too: P = W (tan(slope + phi) + tan(phi)) to lift."""
    held, phi = wedge(slope, coefficient, load), np.arctan(coefficient)

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        scene = held.mechanism(masses)
        forces = dict(scene.forces) | {"floor rub": friction("floor", coefficient)}
        return udk.Mechanism(scene.bodies, scene.joints, forces=forces, gravity=STILL)

    return held._replace(
        mechanism=mechanism,
        bounds=(load * (np.tan(slope - phi) - np.tan(phi)), load * (np.tan(slope + phi) + np.tan(phi))),
    )


def jack(pitch_radius: float, slope: float, coefficient: float, load: float) -> Held:
    """A screw jack, its thread unrolled by a rack: M = W r tan(slope +- phi)."""
    held = wedge(slope, coefficient, load)

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        scene = held.mechanism(masses)
        bodies = dict(scene.bodies) | {"spindle": udk.Body(masses[2], masses[2], [0.0, pitch_radius])}
        joints = dict(scene.joints) | {
            "pivot": udk.Revolute(["ground", "spindle"], [[0.0, pitch_radius], STILL]),
            "mesh": udk.Rack(["wedge", "spindle"], pitch_radius, 0.0),
        }
        return udk.Mechanism(bodies, joints, forces=dict(scene.forces), gravity=STILL)

    lower, upper = held.bounds
    return Held(mechanism, 3, "body.spindle.angle", 0.0, (pitch_radius * lower, pitch_radius * upper))


def worm(pitch_radius: float, wheel_radius: float, lead: float, coefficient: float, torque: float) -> Held:
    """A worm that turns a wheel against a torque, both unrolled by racks: M = T r / R tan(lead +- phi)."""
    held = jack(pitch_radius, lead, coefficient, torque / wheel_radius)

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        scene = held.mechanism(masses)
        bodies = dict(scene.bodies) | {"wheel": udk.Body(masses[3], masses[3], [wheel_radius, 1.0])}
        joints = dict(scene.joints) | {
            "axle": udk.Revolute(["ground", "wheel"], [[wheel_radius, 1.0], STILL]),
            "teeth": udk.Rack(["block", "wheel"], wheel_radius, np.pi / 2),
        }
        load = {"load": udk.Torque(["ground", "wheel"], -torque)}  # presses the block down
        forces = {name: x for name, x in scene.forces.items() if name != "load"} | load
        return udk.Mechanism(bodies, joints, forces=forces, gravity=STILL)

    return held._replace(mechanism=mechanism, bodies=4)


def incline(slope: float, coefficient: float, load: float) -> Held:
    """A block on an incline, held by a horizontal force: P = W tan(slope +- phi)."""

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        return udk.Mechanism(
            {"block": udk.Body(masses[0], masses[0], STILL, slope)},
            {"plane": udk.Prismatic(["ground", "block"], [STILL, STILL], axis=slope)},
            forces={"rub": friction("plane", coefficient), "load": udk.Force("block", [0.0, -load])},
            gravity=STILL,
        )

    phi = np.arctan(coefficient)
    return Held(mechanism, 1, "body.block.x", 0.0, (load * np.tan(slope - phi), load * np.tan(slope + phi)))


def ladder(angle: float, length: float, floor: float, wall: float, load: float) -> Held:
    """A ladder between floor and wall, loaded in its middle; the torque that keeps it from slipping down or up.

    With the force N1 of the floor and N2 of the wall, which also pulls: N2 = s mu1 N1 and N1 + s mu1 mu2 N1 = W, where s is 1 as
    it slips down and -1 as it slips up.
    """
    c, s = np.cos(angle), np.sin(angle)

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        return udk.Mechanism(
            {"ladder": udk.Body(masses[0], masses[0], [-length / 2 * c, length / 2 * s], np.pi - angle)},
            {
                "floor": udk.Slot(["ground", "ladder"], [STILL, [-length / 2, 0.0]], axis=0.0),
                "wall": udk.Slot(["ground", "ladder"], [[-length * c, 0.0], [length / 2, 0.0]], axis=np.pi / 2),
            },
            forces={
                "floor rub": friction("floor", floor),
                "wall rub": friction("wall", wall),
                "load": udk.Force("ladder", [0.0, -load]),
            },
            gravity=STILL,
        )

    def torque(way: float) -> float:
        """Return the torque at the angle pi - a, which grows as the ladder slips down."""
        foot = load / (1 + way * floor * wall)
        top = way * floor * foot
        # About the foot at the origin; the top is at (-l c, l s), the wall pushes to the right.
        return -(load * length / 2 * c - length * s * top - length * c * wall * top)

    return Held(mechanism, 1, "body.ladder.angle", np.pi - angle, tuple(sorted(torque(way) for way in (1.0, -1.0))))  # pyright: ignore


def lever(arm: float, load_arm: float, radius: float, coefficient: float, load: float) -> Held:
    """A lever on a thick pin with parallel forces: P (a -+ mu r) = W (b +- mu r), as for a rope on a pulley with a thick axle."""
    circle = coefficient * radius

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        return udk.Mechanism(
            {"lever": udk.Body(masses[0], masses[0])},
            {"pin": udk.Revolute(["ground", "lever"], [STILL, STILL])},
            forces={
                "rub": friction("pin", coefficient, radius=radius),
                "load": udk.Force("lever", [0.0, -load], [load_arm, 0.0]),
            },
            gravity=STILL,
        )

    # The hand acts at the left end; it pushes down, against the direction of y.
    hand = udk.Coordinate(("ground", "lever"), "y", [[0.0, 0.0], [-arm, 0.0]])
    forces = (load * (load_arm - circle) / (arm + circle), load * (load_arm + circle) / (arm - circle))
    return Held(mechanism, 1, hand, 0.0, (-forces[1], -forces[0]))


def toggle(share: float, coefficient: float, radius: float, length: float, push: float) -> Held:
    """A toggle clamp held at its slider; it locks where its knee is lower than 2 mu r, `share` of which is its height.

    Above, the rods' forces are inclined by asin(2 mu r / l) within the circles of friction: without a guide's friction that does
    not change the force along the guide, which is the push.
    """
    sine = share * 2 * coefficient * radius / length
    angle, c, s = np.arcsin(sine), length * np.sqrt(1 - sine**2), length * sine

    def mechanism(masses: np.ndarray) -> udk.Mechanism:
        bodies = {
            "lever": udk.Body(masses[0], masses[0], [c / 2, s / 2], angle),
            "rod": udk.Body(masses[1], masses[1], [1.5 * c, s / 2], -angle),
            "slider": udk.Body(masses[2], masses[2], [2 * c, 0.0]),
        }
        joints = {
            "A": udk.Revolute(["ground", "lever"], [STILL, [-length / 2, 0.0]]),
            "B": udk.Revolute(["lever", "rod"], [[length / 2, 0.0], [-length / 2, 0.0]]),
            "C": udk.Revolute(["rod", "slider"], [[length / 2, 0.0], STILL]),
            "S": udk.Prismatic(["ground", "slider"], [STILL, STILL], 0.0),
        }
        forces: dict[str, Any] = {pin: friction(pin, coefficient, radius=radius) for pin in "ABC"}
        return udk.Mechanism(bodies, joints, forces=forces | {"work": udk.Force("slider", [-push, 0.0])}, gravity=STILL)

    bounds = (-np.inf, np.inf) if share < 1 else (push, push)
    return Held(mechanism, 3, "body.slider.x", 2 * c, bounds)


THREAD = np.deg2rad(3.64)
CASES: dict[str, Held] = {
    "wedge": wedge(0.1, 0.3, 1000.0),
    "wedge with a rubbing floor": rubbing_wedge(0.1, 0.3, 1000.0),
    "steep wedge, locked upwards": wedge(np.pi / 2 - np.arctan(0.5) + 1e-3, 0.5, 1000.0),
    "screw": wedge(THREAD, 0.15, 1000.0),
    "jack": jack(0.015, THREAD, 0.15, 5000.0),
    "worm": worm(0.02, 0.1, np.deg2rad(5.0), 0.1, 200.0),
    "block on an incline": incline(0.3, 0.2, 50.0),
    "ladder": ladder(1.1, 3.0, 0.4, 0.2, 700.0),
    "lever on a thick pin": lever(0.4, 0.1, 0.03, 0.25, 300.0),
    "toggle, locked": toggle(0.9, 0.1, 0.01, 0.2, 500.0),
    "toggle, not locked": toggle(1.5, 0.1, 0.01, 0.2, 500.0),
}
