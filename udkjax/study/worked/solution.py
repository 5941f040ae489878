"""The worked solution of an exercise: positions, velocities, accelerations and forces of one position, line by line."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from udkjax.annotations import NumberLike
from udkjax.equations.states import evaluate
from udkjax.positions.answers.counting import Count
from udkjax.positions.answers.pin_motion import PinMotion, pin_motion, usual_rate
from udkjax.positions.assembling.coordinates import element_of, value_of
from udkjax.positions.following.drive import only_driver
from udkjax.positions.following.kinematics import kinematics
from udkjax.printing import PRINTED_AS_ZERO
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.statics import resting_forces
from udkjax.study.worked.equations import (
    Position,
    Rates,
    Symbols,
    System,
    acceleration_system,
    closure,
    solve,
    velocity_system,
)
from udkjax.study.worked.figures import Side
from udkjax.study.worked.loops import Geometry, Loop, loops_of
from udkjax.study.worked.page import page_of
from udkjax.study.worked.terms import Line, Product, Style, Symbol, Term, total


class LoopSolution(NamedTuple):
    """The solution of one loop, or of loops that are solved together.

    Attributes:
        loops: their vectors.
        closures: the two components of the closure of each.
        shared: lines of the positions that all branches share.
        branches: the positions of the unknowns; empty if they follow by iteration alone.
        found: the unknowns in this position.
        velocity, acceleration: the linear systems of their derivatives.
    """

    loops: list[Loop]
    closures: list[Line]
    shared: list[Line]
    branches: list[Position]
    found: list[Symbol]
    velocity: System
    acceleration: System


class WorkedSolution:
    """A worked solution; `lines` are its equations, `html` is its page, and `save` writes it.

    Attributes:
        title: the name of the mechanism, the place of the driver and its rate.
        loops: the loops, in the order in which they are solved.
        balances: by link, the equations of its equilibrium under the loads; empty without loads.
        motion: the motion of all pins and links.
        velocities, accelerations: the polygons.
        style: the units and the digits of numbers.
    """

    def __init__(self, mechanism: Mechanism, motion: PinMotion, geometry: Geometry, symbols: Symbols, digits: int):
        self.mechanism, self.motion, self.geometry, self.symbols = mechanism, motion, geometry, symbols
        assert motion.count is not None
        self.title = f"{mechanism.name or 'mechanism'}, {motion.title()}"
        self.style = Style(motion.count.units, digits)
        dyads, together = loops_of(geometry)
        self.loops = [_solved(symbols, [loop]) for loop in dyads] + ([_solved(symbols, together)] if together else [])
        self.velocities, self.accelerations = (_polygon(geometry, motion, order) for order in (1, 2))
        self.balances: dict[str, list[Line]] = {}

    @property
    def lines(self) -> list[Line]:
        """All equations, in order."""
        found: list[Line] = []
        for one in self.loops:
            found += [*one.closures, *one.shared, *(line for branch in one.branches for line in branch.lines)]
            found += [line for row in one.velocity.matrix for line in row]
            for system in (one.velocity, one.acceleration):
                found += [*system.right, *system.lines]
        return [*found, *(line for balance in self.balances.values() for line in balance)]

    @property
    def residual(self) -> float:
        """The largest residual of an equation, relative to its terms."""
        return max((line.residual for line in self.lines), default=0.0)

    def __str__(self) -> str:
        return "\n".join([self.title, *("  " + line.text(self.style) for line in self.lines)])

    def __repr__(self) -> str:
        return f"WorkedSolution({self.title!r}, {len(self.lines)} equations)"

    def html(self) -> str:
        """Return the solution as a page, typeset by MathML, which also prints."""
        return page_of(self)

    def save(self, path: str | Path) -> None:
        """Write the page to a file."""
        Path(path).write_text(self.html(), encoding="utf-8")


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
        forces: whether to add the static equilibrium of each link, if there are loads.

    Returns:
        The `WorkedSolution`.

    Raises:
        SceneError: the drawing has other elements than pins, slides and slots, or no position there.
    """
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
    angles = {name: (geometry.angle(name), float(rates[0][k]), float(rates[1][k])) for k, name in enumerate(names)}
    slides = {joint.name: _slide(geometry, joint.name, v, a) for joint in geometry.connections if joint.slides}
    pins = {joint.name: joint.pin for joint in geometry.connections}
    symbols = Symbols(Rates(angles, slides), pins)
    solution = WorkedSolution(mechanism, pin_motion(mechanism, found).counted(count), geometry, symbols, digits)
    if forces:
        solution.balances = _balances(mechanism, geometry, q)
    return solution


def _slide(geometry: Geometry, name: str, v: np.ndarray, a: np.ndarray) -> tuple[float, float, float]:
    """Return the length along a line, from the pin from which it is counted, and its first and second derivative in time."""
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
    """Return velocity and acceleration of the point of a body at a place."""
    v, a = rates[body]
    arm = place - np.asarray(geometry.frames[body])[:2]
    side = np.array([-arm[1], arm[0]])
    return v[:2] + v[2] * side, a[:2] + a[2] * side - v[2] ** 2 * arm


def _solved(symbols: Symbols, loops: list[Loop]) -> LoopSolution:
    closures = [line for loop in loops for line in closure(symbols, loop)]
    shared, branches = solve(symbols, loops[0]) if len(loops) == 1 else ([], [])
    lines_of = {x.slide: x for loop in loops for x in loop.vectors if x.slide}
    found = [symbols.angle(body) for loop in loops for body in loop.angles]
    found += [symbols.length(lines_of[slide]) for loop in loops for slide in loop.slides]
    systems = velocity_system(symbols, loops), acceleration_system(symbols, loops)
    return LoopSolution(loops, closures, shared, branches, found, *systems)


def _polygon(geometry: Geometry, motion: PinMotion, order: int) -> list[Side]:
    """Return the polygon of velocities or accelerations: each pin's from the pole, and between the pins of each link."""
    drawing = geometry.drawing
    vectors = {pin: np.asarray(x)[0, order] for pin, x in motion.pins.items()}
    largest = max((float(np.hypot(*x)) for x in vectors.values()), default=0.0)
    vectors = {pin: np.where(np.abs(x) > PRINTED_AS_ZERO * largest, x, 0.0) for pin, x in vectors.items()}
    letter = ("v", "a")[order - 1]
    zero = np.zeros(2)
    sides = [Side(zero, x, f"{letter}_{pin}", "pole") for pin, x in vectors.items() if np.any(x)]
    for link in drawing.links.values():
        moving = [pin for pin in link.pins if pin in vectors]
        for start, end in itertools.pairwise(moving):
            if np.any(vectors[start]) and np.any(vectors[end]):
                sides.append(Side(vectors[start], vectors[end], f"{letter}_{end}{start}", "relative"))
    return sides


def _balances(mechanism: Mechanism, geometry: Geometry, q: np.ndarray) -> dict[str, list[Line]]:
    """Return the equations of equilibrium of each link: forces along x and y, and moments about its centre of mass."""
    loads = np.asarray(evaluate.force(mechanism, 0.0, q, np.zeros_like(q))).reshape(-1, 3)
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
) -> list[Line]:
    centre, mechanism = np.asarray(geometry.frames[body])[:2], geometry.mechanism
    sums: list[list[tuple[float, Term]]] = [[], [], []]
    for axis, (name, unit) in enumerate((("x", "N"), ("y", "N"), ("M", "N m"))):
        if load[axis]:
            sums[axis].append((1.0, Symbol("W", f"{body},{name}", float(load[axis]), unit)))
    for pin, (fx, fy, moment) in forces:
        arm = geometry.places[pin] - centre
        arm = np.where(np.abs(arm) > PRINTED_AS_ZERO * geometry.extent, arm, 0.0)
        force = [Symbol("F", f"{pin},{name}", float(x), "N") for name, x in zip("xy", (fx, fy), strict=True)]
        lever = [Symbol(name, pin, float(x), "arm") for name, x in zip("xy", arm, strict=True)]
        for axis in (0, 1):
            sums[axis].append((1.0, force[axis]))
        sums[2] += [(1.0, Product((lever[0], force[1]))), (-1.0, Product((lever[1], force[0])))]
        if moment:
            sums[2].append((1.0, Symbol("M", pin, float(moment), "N m")))
    for name, effort in efforts.items():
        driver = mechanism.drivers[name]
        if driver.coordinate == "angle":
            sums[2].append((1.0, Symbol("M", name, effort, "N m")))
            continue
        axis_angle = 0.0 if driver.axis is None else float(np.asarray(driver.axis))
        for axis, part in enumerate((np.cos(axis_angle), np.sin(axis_angle))):
            sums[axis].append((1.0, Symbol("F", f"{name},{'xy'[axis]}", float(effort * part), "N")))
    return [Line(total(*parts)) for parts in sums]
