"""The worked solution of an exercise: positions, velocities, accelerations and forces of one position, line by line."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from udkjax.annotations import NumberLike
from udkjax.equations import loads as load_terms
from udkjax.positions.answers.counting import Count
from udkjax.positions.answers.pin_motion import PinMotion, pin_motion, usual_rate
from udkjax.positions.assembling.coordinates import element_of, value_of
from udkjax.positions.following.drive import only_driver
from udkjax.positions.following.kinematics import kinematics
from udkjax.printing import PRINTED_AS_ZERO, align_columns
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.statics.resting_forces import has_gravity, resting_forces
from udkjax.study.worked.figures import PolygonSide
from udkjax.study.worked.iterations import PositionMotion
from udkjax.study.worked.loop_solutions import LoopSolution, solution_of
from udkjax.study.worked.loops import Geometry, drawing_of, loops_of
from udkjax.study.worked.page import page_of
from udkjax.study.worked.symbols import PositionSymbols
from udkjax.study.worked.terms import EquationLine, EquationTerm, NamedQuantity, NumberStyle, ProductOfTerms, total


@dataclass(frozen=True, eq=False, repr=False)
class WorkedSolution:
    """A worked solution: its equations, line by line, which print as text and as a page.

    Attributes:
        title: the name of the mechanism, the place of the driver and its rate.
        loops: the solutions of the loops, in order.
        motion: the motion of all pins and links.
        polygons: the arrows of the polygons of velocities (m/s) and of accelerations (m/s^2).
        balances: the equations of equilibrium of each link under the loads, by name; empty without loads.
        style: the units and the digits of numbers.
        geometry: pins, lines and angles in this position.
        symbols: the symbols, with their values.
    """

    title: str
    loops: list[LoopSolution]
    motion: PinMotion
    polygons: tuple[list[PolygonSide], list[PolygonSide]]
    balances: dict[str, list[EquationLine]]
    style: NumberStyle
    geometry: Geometry
    symbols: PositionSymbols

    @property
    def lines(self) -> list[EquationLine]:
        """All equations, in order."""
        found: list[EquationLine] = []
        for one in self.loops:
            found += [*one.closures, *one.shared, *(line for branch in one.branches for line in branch.lines)]
            found += one.velocity.coefficients
            for system in (one.velocity, one.acceleration):
                found += [*system.right, *system.lines]
        return [*found, *(line for balance in self.balances.values() for line in balance)]

    @property
    def residual(self) -> float:
        """The largest residual of an equation, relative to its terms."""
        return max((line.residual for line in self.lines), default=0.0)

    def __str__(self) -> str:
        steps = [row for one in self.loops for row in one.step_rows(self.style)]
        return "\n".join([self.title, *("  " + line.text(self.style) for line in self.lines), *align_columns(steps)])

    def __repr__(self) -> str:
        return f"WorkedSolution({self.title!r}, {len(self.lines)} equations)"

    def html(self) -> str:
        """Return the solution as an HTML page with formulas in MathML, which can be printed."""
        return page_of(self.title, self.geometry, self.style, self.loops, self.motion, self.polygons, self.balances)

    def save(self, path: str | Path) -> None:
        """Write the page to a file."""
        Path(path).write_text(self.html(), encoding="utf-8", newline="\n")


@checked
@concrete_only()
def worked_solution(mechanism: Mechanism, at: NumberLike | str, digits: int = 6, forces: bool = True) -> WorkedSolution:
    """Return the solution of a drawing of pins, slides and slots in one position, line by line, with numbers put in.

    Each loop of vectors gives its unknowns in closed form, on both branches; derivatives in time follow from linear systems.
    Numbers are those of `motion_at`, and forces those that hold the mechanism at rest.

    Args:
        mechanism: a drawn mechanism with one motor: of a link about a pin of the ground, or of a slide on the ground.
        at: the value of the motor, in the unit of the drawing, or a text with a unit, such as "40 deg".
        digits: significant digits of printed numbers.
        forces: True to add the static equilibrium of each link, if there are loads and, with gravity, each link has a mass.

    Returns:
        The `WorkedSolution`.

    Raises:
        SceneError: there is no drawing, not one motor, other elements than pins, slides and slots, or no position there.
    """
    drawing_of(mechanism)
    if not mechanism.driver_names:
        raise SceneError(
            ["a worked solution needs a motor: add one, such as [[motor]] with the pin of the crank"], mechanism.name
        )
    driver = only_driver(mechanism)
    count, rate = Count.of(mechanism, driver), usual_rate(mechanism, driver)
    value = count.nearest(count.read(at, "at"), float(value_of(mechanism, driver)(mechanism.q0)))
    found = kinematics(mechanism, driver, [value], rate=rate)
    if not np.all(found.reached):
        raise SceneError([f"at: {count.text(value)} cannot be reached"], mechanism.name)
    q, v, a = (np.asarray(x)[0] for x in (found.q, found.v, found.a))
    geometry = Geometry(mechanism, q, element_of(mechanism, driver))
    names = mechanism.body_names
    fastest = [PRINTED_AS_ZERO * float(np.max(np.abs(x[:, 2]), initial=0.0)) for x in (v, a)]
    rates = [np.where(np.abs(x[:, 2]) > least, x[:, 2], 0.0) for x, least in zip((v, a), fastest, strict=True)]
    angles = {name: (geometry.angles[name], float(rates[0][k]), float(rates[1][k])) for k, name in enumerate(names)}
    slides = {joint.name: _slide(geometry, joint.name, v, a) for joint in geometry.connections if joint.slides}
    pins = {joint.name: joint.pin for joint in geometry.connections}
    symbols = PositionSymbols(PositionMotion(angles, slides), pins)
    motion = pin_motion(mechanism, found).counted(count)
    solved = [solution_of(symbols, loops) for loops in loops_of(geometry)]
    polygons = _polygon(geometry, motion, 1), _polygon(geometry, motion, 2)
    balances = _balances(mechanism, geometry, q) if forces and (not mechanism.massless or not has_gravity(mechanism)) else {}
    title = f"{mechanism.name or 'mechanism'}, {motion.title()}"
    return WorkedSolution(title, solved, motion, polygons, balances, NumberStyle(count.units, digits), geometry, symbols)


def _slide(geometry: Geometry, name: str, v: np.ndarray, a: np.ndarray) -> tuple[float, float, float]:
    """Return the length along a joint's line, from the pin from which it is counted, and its first two derivatives in time."""
    joint = next(one for one in geometry.connections if one.name == name)
    start, way, _ = geometry.lines[name]
    rates = dict(zip(geometry.mechanism.body_names, zip(v, a, strict=True), strict=True)) | {GROUND: (np.zeros(3), np.zeros(3))}
    place, along = geometry.places[joint.pin], np.array([np.cos(way), np.sin(way)])
    across = np.array([-along[1], along[0]])
    on_pin, on_line = (_point_motion(geometry, rates, body, place) for body in (joint.bodies[1], joint.bodies[0]))
    relative, further = on_pin[0] - on_line[0], on_pin[1] - on_line[1]
    omega = float(rates[joint.bodies[0]][0][2])
    speed = float(along @ relative)
    second = float(along @ (further - 2 * omega * speed * across))
    return float(along @ (place - geometry.places[start])), speed, second


def _point_motion(geometry: Geometry, rates: Mapping[str, Any], body: str, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity and acceleration of the point of a body that is at a place.

    `rates` are velocities and accelerations (x, y, angle) of bodies, by name.
    """
    v, a = rates[body]
    arm = place - np.asarray(geometry.frames[body])[:2]
    side = np.array([-arm[1], arm[0]])
    return v[:2] + v[2] * side, a[:2] + a[2] * side - v[2] ** 2 * arm


def _polygon(geometry: Geometry, motion: PinMotion, order: int) -> list[PolygonSide]:
    """Return the arrows of the polygon of velocities (`order` 1) or of accelerations (2).

    There are arrows from the pole for each pin, and between the pins of each link.
    """
    drawing = geometry.drawing
    vectors = {pin: np.asarray(x)[0, order] for pin, x in motion.pins.items()}
    largest = max((float(np.hypot(*x)) for x in vectors.values()), default=0.0)
    vectors = {pin: np.where(np.abs(x) > PRINTED_AS_ZERO * largest, x, 0.0) for pin, x in vectors.items()}
    letter = ("v", "a")[order - 1]
    zero = np.zeros(2)
    sides = [PolygonSide(zero, x, f"{letter}_{pin}", "pole") for pin, x in vectors.items() if np.any(x)]
    for link in drawing.links.values():
        moving = [pin for pin in link.pins if pin in vectors]
        for start, end in itertools.pairwise(moving):
            if np.any(vectors[start]) and np.any(vectors[end]):
                sides.append(PolygonSide(vectors[start], vectors[end], f"{letter}_{end}{start}", "relative"))
    return sides


def _balances(mechanism: Mechanism, geometry: Geometry, q: np.ndarray) -> dict[str, list[EquationLine]]:
    """Return the equations of equilibrium of each link: forces along x and y, and moments about its centre of mass."""
    loads = np.asarray(load_terms.force(mechanism, 0.0, q, np.zeros_like(q))).reshape(-1, 3)
    if not np.any(np.abs(loads) > 0.0):
        return {}
    held, found = resting_forces(mechanism, q, 0.0), {}
    pins = {joint.name: joint.pin for joint in geometry.connections}
    at_pins = [(pins.get(pin, pin), on) for pin, on in held.forces.items()]
    force = max(float(np.max(np.abs(loads[:, :2]))), *(abs(x) for _, on in at_pins for load in on.values() for x in load[:2]))
    least = PRINTED_AS_ZERO * np.array([force, force, force * geometry.extent])
    for k, body in enumerate(mechanism.body_names):
        forces = [(pin, np.where(np.abs(on[body]) > least, on[body], 0.0)) for pin, on in at_pins if body in on]
        efforts = {
            name: held.efforts[name] * (1.0 if driver.bodies[1] == body else -1.0)
            for name, driver in mechanism.drivers.items()
            if body in driver.bodies
        }
        found[body] = _balance(geometry, body, np.where(np.abs(loads[k]) > least, loads[k], 0.0), forces, efforts)
    return found


def _balance(
    geometry: Geometry,
    body: str,
    load: np.ndarray,
    forces: Sequence[tuple[str, np.ndarray]],
    efforts: Mapping[str, float],
) -> list[EquationLine]:
    centre, mechanism = np.asarray(geometry.frames[body])[:2], geometry.mechanism
    sums: list[list[tuple[float, EquationTerm]]] = [[], [], []]
    for axis, (name, unit) in enumerate((("x", "N"), ("y", "N"), ("M", "N m"))):
        if load[axis]:
            sums[axis].append((1.0, NamedQuantity("W", f"{body},{name}", float(load[axis]), unit)))
    for pin, (fx, fy, moment) in forces:
        arm = geometry.places[pin] - centre
        arm = np.where(np.abs(arm) > PRINTED_AS_ZERO * geometry.extent, arm, 0.0)
        force = [NamedQuantity("F", f"{pin},{name}", float(x), "N") for name, x in zip("xy", (fx, fy), strict=True)]
        lever = [NamedQuantity(name, pin, float(x), "arm") for name, x in zip("xy", arm, strict=True)]
        for axis in (0, 1):
            sums[axis].append((1.0, force[axis]))
        sums[2] += [(1.0, ProductOfTerms((lever[0], force[1]))), (-1.0, ProductOfTerms((lever[1], force[0])))]
        if moment:
            sums[2].append((1.0, NamedQuantity("M", pin, float(moment), "N m")))
    for name, effort in efforts.items():
        driver = mechanism.drivers[name]
        if driver.coordinate == "angle":
            sums[2].append((1.0, NamedQuantity("M", name, effort, "N m")))
            continue
        axis_angle = 0.0 if driver.axis is None else float(np.asarray(driver.axis))
        for axis, part in enumerate((np.cos(axis_angle), np.sin(axis_angle))):
            sums[axis].append((1.0, NamedQuantity("F", f"{name},{'xy'[axis]}", float(effort * part), "N")))
    return [EquationLine(total(*parts)) for parts in sums]
