"""Mechanisms of bodies and joints converted into drawings with the same motion: pins in world coordinates and links through them.

Each revolute joint becomes a pin, each body a link with its mass, inertia and centre; slots, slides, gears, springs, motors and
loads become the corresponding elements of drawings. Distance joints stay as in format 1, with points in the links' frames.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from udkjax.positions.assembling.assembly import assemble
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_forces import shift_motion
from udkjax.scene.elements.bodies import GROUND, Body
from udkjax.scene.elements.couplings import Gear
from udkjax.scene.elements.drivers import Driver, Polynomial
from udkjax.scene.elements.forces import ForceElement, Spring, Torque, TorsionSpring
from udkjax.scene.elements.joints import Distance, Joint, Prismatic, Revolute, Slot
from udkjax.scene.files import dumps
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError

SAME_PLACE = 1e-9  # fraction of the extent: joints that are closer share a pin


def drawing_text_of(mechanism: Mechanism) -> str:
    """Return a mechanism as the text of a drawing; raise `SceneError` if it cannot be drawn."""
    if isinstance(mechanism.drawing, Drawing) and not mechanism.departs_from_drawing:
        return dumps(mechanism)
    return dumps(_Draft(mechanism).drawing())


class _Draft:
    """A drawing under construction: places of pins, and bodies that they join (`members`), by name; elements by section."""

    def __init__(self, mechanism: Mechanism):
        self.mechanism = mechanism
        state = assemble(mechanism)
        q, v = np.asarray(state.q), np.asarray(state.v)
        self.frames = dict(zip(mechanism.bodies, q, strict=True)) | {GROUND: np.zeros(3)}
        self.rates = dict(zip(mechanism.bodies, v, strict=True)) | {GROUND: np.zeros(3)}
        self.places: dict[str, np.ndarray] = {}
        self.members: dict[str, list[str]] = {}  # bodies of each pin
        self.elements: dict[str, dict[str, Any]] = {}
        points = [p for e in mechanism.constraints.values() for p in np.ravel(np.asarray(getattr(e, "points", 0.0), float))]
        self.format_1: list[tuple[str, str, Any]] = []  # section, name, element
        self.near = SAME_PLACE * max([1e-300, *map(abs, map(float, points)), *np.abs(q[:, :2]).ravel().tolist()])

    def drawing(self) -> Drawing:
        mechanism = self.mechanism
        for name, joint in mechanism.joints.items():
            if isinstance(joint, Revolute):
                self.pin(name, joint.bodies, self.world_point(joint.bodies[0], joint.points[0]))
        for name, joint in mechanism.joints.items():
            self.joint(name, joint)
        for name, driver in mechanism.drivers.items():
            self.driver(name, driver)
        for name, force in mechanism.forces.items():
            self.force(name, force)
        for name in mechanism.bodies:  # velocities of pins determine the angular velocity of a link only if it has two
            centre = self.frames[name][:2]
            if not self.pins_of(name):
                self.pin(f"{name}'", [name], centre)
            if len(self.pins_of(name)) == 1 and self.rates[name][2]:
                body = mechanism.bodies[name]
                self.pin(f"{name}'", [name], centre + [np.sqrt(float(body.inertia / body.mass)), 0.0])
        for section, name, element in self.format_1:
            self.add(section, name, self.in_links(element))
        links = {name: self.link(name, body) for name, body in mechanism.bodies.items()}
        ground = [pin for pin, members in self.members.items() if GROUND in members]
        velocities = {pin: self.velocity(pin) for pin, members in self.members.items() if GROUND not in members}
        largest = max((float(np.abs(v).max()) for v in velocities.values()), default=0.0)
        nonzero_velocities = {pin: v for pin, v in velocities.items() if np.abs(v).max() > SAME_PLACE * largest}
        return Drawing(
            pins={name: position.tolist() for name, position in self.places.items()},
            links=links,
            ground=ground,
            velocities=nonzero_velocities,
            gravity=mechanism.gravity,
            name=mechanism.name,
            **{f"{section}s": group for section, group in self.elements.items()},
        )

    def world_point(self, body: str, point: Any) -> np.ndarray:
        x, y, angle = self.frames[body]
        px, py = np.asarray(point, float)
        c, s = np.cos(angle), np.sin(angle)
        return np.array([x + c * px - s * py, y + s * px + c * py])

    def pin(self, name: str, bodies: Sequence[str], position: np.ndarray) -> str:
        """Return the name of the pin of bodies at a position: a pin that one of them has there already, or else a new pin.

        `name` is the name of a new pin, with primes if it is taken.
        """
        for pin, pin_position in self.places.items():
            if np.abs(position - pin_position).max() <= self.near and set(bodies) & set(self.members[pin]):
                self.members[pin] += [body for body in bodies if body not in self.members[pin]]
                return pin
        fresh = name
        while fresh in self.places:
            fresh += "'"
        self.places[fresh], self.members[fresh] = position, list(bodies)
        return fresh

    def add(self, section: str, name: str, element: Any) -> None:
        self.elements.setdefault(section, {})[name] = element

    def angle(self, bodies: Sequence[str]) -> float:
        """Return the angle of the second body relative to the first (rad)."""
        return float(self.frames[bodies[1]][2] - self.frames[bodies[0]][2])

    def joint(self, name: str, joint: Joint) -> None:
        """Draw a joint; revolute joints are skipped, since their pins are drawn before."""
        match joint:
            case Revolute():
                return
            case Slot():
                body1, body2 = joint.bodies
                pin = self.pin(name, [body2], self.world_point(body2, joint.points[1]))
                self.add(
                    "slot", name, {"pin": pin, "direction": self.world_direction(body1, joint.axis), "on": body1, "link": body2}
                )
            case Prismatic():
                body1, body2 = joint.bodies
                self.pin(f"{body2}'", [body2], self.world_point(body2, joint.points[1]))
                self.add("slide", name, {"link": body2, "direction": self.world_direction(body1, joint.axis), "on": body1})
            case Gear() if all(self.has_centre(body, joint.carrier) for body in joint.bodies):
                gear = {"links": list(joint.bodies), "radii": np.asarray(joint.radii), "internal": joint.internal}
                self.add("gear", name, gear | {"carrier": joint.carrier})
            case _:
                self.keep_distance("joint", name, joint)

    def has_centre(self, wheel: str, carrier: str) -> bool:
        """Return True if a wheel turns on its carrier about a single pin."""
        return sum(wheel in members and carrier in members for members in self.members.values()) == 1

    def world_direction(self, body: str, axis: Any) -> list[float]:
        angle = float(axis) + float(self.frames[body][2])
        return [float(np.cos(angle)), float(np.sin(angle))]

    def pin_between(self, bodies: Sequence[str]) -> str:
        """Return the name of the pin about which two bodies turn on each other; "" if there is none."""
        return next((pin for pin, members in self.members.items() if set(bodies) <= set(members)), "")

    def driver(self, name: str, driver: Driver) -> None:
        """Draw a driver as a motor that turns two links about their pin, or changes the distance of two pins."""
        pin = self.pin_between(driver.bodies)
        if driver.coordinate == "angle" and pin:
            where, drawn = {"pin": pin, "of": list(driver.bodies)}, self.angle(driver.bodies)
        elif driver.coordinate == "distance":
            ends = self.ends(name, driver.bodies, driver.points)
            where, drawn = {"between": ends}, float(np.linalg.norm(self.places[ends[1]] - self.places[ends[0]]))
        else:
            return self.keep_distance("driver", name, driver)
        motion = driver.motion
        if isinstance(motion, Polynomial) and len(motion.coefficients) == 2:
            law: dict[str, Any] = {"speed": float(motion.coefficients[1])}
        else:
            law = {"motion": shift_motion(motion, jnp.asarray(-drawn))}
        return self.add("motor", name, where | law)

    def ends(self, name: str, bodies: Sequence[str], points: Any) -> list[str]:
        return [
            self.pin(f"{name}{k + 1}", [body], self.world_point(body, point))
            for k, (body, point) in enumerate(zip(bodies, np.asarray(points), strict=True))
        ]

    def force(self, name: str, force: ForceElement) -> None:
        match force:
            case Spring():
                ends = self.ends(name, force.bodies, force.points)
                spring = {"between": ends, "stiffness": force.stiffness, "length": force.length, "damping": force.damping}
                self.add("spring", name, {key: value for key, value in spring.items() if value is not None})
            case TorsionSpring(angle=angle) if self.pin_between(force.bodies) and eqx.is_array(angle):
                pin, free = self.pin_between(force.bodies), float(np.asarray(angle)) - self.angle(force.bodies)
                spring = {"pin": pin, "of": list(force.bodies), "stiffness": force.stiffness, "damping": force.damping}
                self.add("spring", name, {key: value for key, value in spring.items() if value is not None} | {"angle": free})
            case Torque(value=value) if force.bodies[0] == GROUND and eqx.is_array(value):
                self.add("load", name, {"link": force.bodies[1], "torque": value})
            case _:
                self.keep_distance("force", name, force)

    def keep_distance(self, section: str, name: str, element: Any) -> None:
        """Keep a distance joint in format 1; raise `SceneError` for any other element."""
        if not isinstance(element, Distance):
            cure = "draw it with the pins, slots, slides, gears and motors of format 2"
            raise SceneError([f"{section} {name!r}: the studio cannot draw elements of class {type(element).__name__}; {cure}"])
        for k, (body, point) in enumerate(zip(element.bodies, np.asarray(element.points), strict=True)):
            if body != GROUND:
                self.pin(f"{name}{k + 1}", [body], self.world_point(body, point))
        self.format_1.append((section, name, element))

    def in_links(self, element: Any) -> Any:
        """Return an element with its points in the frames of links.

        The origin of such a frame is the centre of mass, and its x axis leads from the link's first pin to the second.
        """
        moved = []
        for body, point in zip(element.bodies, np.asarray(element.points), strict=True):
            position = self.world_point(body, point)
            if body != GROUND:
                pins = [self.places[pin] for pin in self.pins_of(body)]
                axis = pins[1] - pins[0] if len(pins) > 1 else np.array([1.0, 0.0])
                c, s = axis / np.linalg.norm(axis)
                position = np.array([[c, s], [-s, c]]) @ (position - self.frames[body][:2])
            moved.append(position)
        return eqx.tree_at(lambda e: e.points, element, jnp.asarray(moved))

    def pins_of(self, body: str) -> list[str]:
        return [pin for pin, members in self.members.items() if body in members]

    def link(self, name: str, body: Body) -> dict[str, Any]:
        x, y, _ = self.frames[name]
        return {"pins": self.pins_of(name), "mass": body.mass, "inertia": body.inertia, "centre": [float(x), float(y)]}

    def velocity(self, pin: str) -> np.ndarray:
        body = next(body for body in self.members[pin] if body != GROUND)
        vx, vy, rate = self.rates[body]
        arm = self.places[pin] - self.frames[body][:2]
        return np.array([vx - rate * arm[1], vy + rate * arm[0]])
