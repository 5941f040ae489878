"""The vector loops of a drawing: closed chains of vectors from pin to pin, in an order in which each has two unknowns."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from udkjax.arrays import FULL_TURN
from udkjax.positions.answers.counting import Count
from udkjax.positions.assembling.coordinates import Coordinate
from udkjax.scene.drawing import Drawing
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.joints import Prismatic, Revolute, Slot
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote

NEGLIGIBLE = 1e-9  # relative to the extent of the pins: vectors and offsets that are shorter are left out
MOST_SEARCHED = 16  # bodies of which groups are looked for; there are 2^16


class Connection(NamedTuple):
    """A joint of two bodies, with the name of its point.

    Attributes:
        name: name of the joint.
        bodies: names of the two bodies; the first one carries the line of a slot or slide.
        pin: name of the point, a pin of the drawing.
        slides: True if the point moves along a line of the first body.
        turns: True if the bodies turn on each other.
    """

    name: str
    bodies: tuple[str, str]
    pin: str
    slides: bool
    turns: bool

    def other(self, body: str) -> str:
        """Return the other one of the two bodies."""
        return self.bodies[1] if body == self.bodies[0] else self.bodies[0]


class LoopVector(NamedTuple):
    """A vector of a loop, from one point to another, in the direction of its own angle.

    Attributes:
        start, end: names of the points, in the direction of the vector.
        sign: 1, or -1 where the loop runs against the vector.
        body: the body with which the vector turns.
        turn: angle of the vector relative to that of the body (rad).
        size: length of the vector (m).
        slide: name of the joint along whose line the vector lies, so that its length changes; "" if there is none.
    """

    start: str
    end: str
    sign: float
    body: str
    turn: float
    size: float
    slide: str = ""


class VectorLoop(NamedTuple):
    """A closed chain of vectors, and the unknowns that it determines: angles of bodies, and lengths along slots and slides."""

    vectors: list[LoopVector]
    angles: list[str]
    slides: list[str]


def drawing_of(mechanism: Mechanism) -> Drawing:
    """Return the drawing of a mechanism; raise `SceneError` if it was not drawn."""
    if not isinstance(mechanism.drawing, Drawing):
        raise SceneError(["a worked solution needs a drawing: pins and links, in format 2"], mechanism.name)
    return mechanism.drawing


class Geometry:
    """Points, lines and angles of a drawn mechanism in one position.

    Args:
        mechanism: a drawn mechanism of pins, slides and slots.
        q: coordinates (bodies, 3) of the position.
        driven: the driven coordinate, of a link or slide on the ground.

    Attributes:
        angles: angle of each body (rad): that of its first vector, from its pin on the ground if it has one.
    """

    def __init__(self, mechanism: Mechanism, q: np.ndarray, driven: Coordinate):
        drawing = drawing_of(mechanism)
        self.mechanism, self.drawing, self.driven = mechanism, drawing, driven
        self.frames = dict(zip(mechanism.body_names, q, strict=True)) | {GROUND: np.zeros(3)}
        offsets = {body: Count.of(mechanism, Coordinate((GROUND, body))).offset for body in mechanism.body_names} | {GROUND: 0.0}
        self.angles = {body: wrapped(float(frame[2]) + offsets[body]) for body, frame in self.frames.items()}
        self.connections = list(_connections(mechanism, drawing))
        self.places = {joint.pin: self._place(joint) for joint in self.connections}
        self.extent = float(np.max(np.ptp(np.array([*self.places.values()]), axis=0), initial=0.0)) or 1.0
        self.lines = {joint.name: self._line(joint) for joint in self.connections if joint.slides}

    def _place(self, joint: Connection) -> np.ndarray:
        points, body = np.asarray(self.mechanism.joints[joint.name].points), joint.bodies[1]
        x, y, angle = self.frames[body]
        c, s = np.cos(angle), np.sin(angle)
        return np.array([x + c * points[1][0] - s * points[1][1], y + s * points[1][0] + c * points[1][1]])

    def _line(self, joint: Connection) -> tuple[str, float, float]:
        """Return the pin from which lengths along a joint's line are counted, the angle of the line (rad), and its offset (m)."""
        guide, place = joint.bodies[0], self.places[joint.pin]
        way = float(np.asarray(self.mechanism.joints[joint.name].axis)) + float(self.frames[guide][2])
        along = np.array([np.cos(way), np.sin(way)])
        pins = [one.pin for one in self.connections if guide in one.bodies and not (one.slides and one.bodies[0] == guide)]
        own = self.drawing.ground if guide == GROUND else self.drawing.links[guide].pins
        pins = list(dict.fromkeys([*pins, *(pin for pin in own if pin in self.places)]))
        if not pins:
            raise SceneError([f"the line of {joint.name} is on {guide}, which has no pin to count from"], self.mechanism.name)
        arms = {pin: place - self.places[pin] for pin in pins}
        offsets = {pin: float(along[0] * arm[1] - along[1] * arm[0]) for pin, arm in arms.items()}
        least, fixed = NEGLIGIBLE * self.extent, self.drawing.ground
        start = min(pins, key=lambda pin: (round(abs(offsets[pin]) / least), pin not in fixed))
        sign = -1.0 if along @ arms[start] < 0 else 1.0
        return start, float(np.arctan2(sign * along[1], sign * along[0])), sign * offsets[start]

    def root(self, body: str) -> str:
        """Return the body with which a body keeps its angle because it slides on it, directly or through others."""
        for joint in self.connections:
            if not joint.turns and joint.bodies[1] == body:
                return self.root(joint.bodies[0])
        return body

    def within(self, body: str, start: str, end: str) -> list[LoopVector]:
        """Return a list with the vector between two pins of a body; an empty list if the pins coincide.

        The vector runs from `end` to `start`, with the sign -1, if it is then along its body or, on the ground, at most 90
        degrees from x.
        """
        arm = self.places[end] - self.places[start]
        size = float(np.hypot(*arm))
        if size <= NEGLIGIBLE * self.extent:
            return []
        root = self.root(body)
        turn = wrapped(float(np.arctan2(arm[1], arm[0])) - self.angles[root])
        is_against = (
            abs(abs(turn) - np.pi) < NEGLIGIBLE if root != GROUND else turn > 0.5 * np.pi + NEGLIGIBLE or turn < -0.5 * np.pi
        )
        if is_against:
            return [LoopVector(end, start, -1.0, root, _tidy(wrapped(turn + np.pi)), size)]
        return [LoopVector(start, end, 1.0, root, _tidy(turn), size)]

    def along(self, joint: Connection, sign: float) -> list[LoopVector]:
        """Return the vectors from the pin from which a line is counted to the sliding pin: across the line, and along it."""
        start, way, offset = self.lines[joint.name]
        root = self.root(joint.bodies[0])
        turn = wrapped(way - self.angles[root])
        arm = self.places[joint.pin] - self.places[start]
        size = float(arm @ [np.cos(way), np.sin(way)])
        foot, found = start, []
        if abs(offset) > NEGLIGIBLE * self.extent:
            foot = f"{joint.pin}′"
            side = wrapped(turn + np.copysign(0.5 * np.pi, offset))
            found.append(LoopVector(start, foot, sign, root, _tidy(side), abs(offset)))
        found.append(LoopVector(foot, joint.pin, sign, root, _tidy(turn), size, joint.name))
        return found if sign > 0 else found[::-1]

    def chain(self, body: str, entry: Connection, leave: Connection) -> list[LoopVector]:
        """Return the vectors of a loop within a body, from the joint `entry`, at which the loop enters, to the joint `leave`."""
        before, after, start, end = [], [], entry.pin, leave.pin
        if entry.slides and entry.bodies[0] == body:
            start, before = self.lines[entry.name][0], self.along(entry, -1.0)
        if leave.slides and leave.bodies[0] == body:
            end, after = self.lines[leave.name][0], self.along(leave, 1.0)
        return [*before, *self.within(body, start, end), *after]


def wrapped(angle: float) -> float:
    """Return an angle (rad) above minus half a turn, and at most half a turn."""
    return float(np.pi - (np.pi - angle) % FULL_TURN)


def _tidy(angle: float) -> float:
    """Return an angle; zero if only rounding separates it from zero."""
    return 0.0 if abs(angle) < NEGLIGIBLE else angle


def _connections(mechanism: Mechanism, drawing: Drawing) -> Iterator[Connection]:
    for name, joint in mechanism.joints.items():
        if isinstance(joint, Revolute):
            pin = name if name in drawing.pins else name.rpartition("-")[0]
            yield Connection(name, joint.bodies, pin, False, True)  # pyright: ignore[reportArgumentType]
        elif isinstance(joint, Slot):
            yield Connection(name, joint.bodies, drawing.groups["slot"][name].pin, True, True)  # pyright: ignore
        elif isinstance(joint, Prismatic):
            yield Connection(name, joint.bodies, drawing.links[joint.bodies[1]].pins[0], True, False)  # pyright: ignore
        else:
            kind = f"{quote(name)} is a {type(joint).__name__.lower()}"
            raise SceneError([f"a worked solution has pins, slides and slots; {kind}"], mechanism.name)


def loops_of(geometry: Geometry) -> list[list[VectorLoop]]:
    """Return lists of loops that are solved in this order, the loops of each list together.

    A list has a single loop if this determines two unknowns; where no loop does, it has the fewest loops that do so together.
    """
    known_bodies, known_slides = _driven(geometry)
    bodies, found = list(geometry.mechanism.body_names), []
    used = {joint.name for joint in geometry.connections if set(joint.bodies) <= known_bodies}
    while not set(bodies) <= known_bodies:
        rated = [
            (path, *_unknowns(geometry, path, known_bodies, known_slides)) for path in _paths(geometry, known_bodies, {*bodies})
        ]
        if dyads := [one for one in rated if len(one[1]) + len(one[2]) == 2]:
            path, angles, slides = min(dyads, key=lambda one: len(one[0]))
            loops = [VectorLoop(_closed(geometry, path, known_bodies, used), angles, slides)]
            known_bodies |= {body for body, _ in path}
            used |= {joint.name for _, joint in path}
        else:
            group = _smallest_group(geometry, known_bodies)
            loops = _together(geometry, known_bodies, known_slides, used, group)
            known_bodies |= group
            used |= {joint.name for joint in geometry.connections if group & {*joint.bodies} and {*joint.bodies} <= known_bodies}
        found.append(loops)
        known_slides |= {slide for loop in loops for slide in loop.slides}
    return found


def _smallest_group(geometry: Geometry, known: set[str]) -> set[str]:
    """Return the smallest set of unknown bodies that are held by joints with each other and with known bodies, an Assur group.

    All unknown bodies are returned if there is no smaller set, or if there are too many bodies to search.
    """
    unknown = [body for body in geometry.mechanism.body_names if body not in known]
    for count in range(2, len(unknown) if len(unknown) <= MOST_SEARCHED else 2):
        for group in map(set, itertools.combinations(unknown, count)):
            own = [joint for joint in geometry.connections if group & {*joint.bodies} and {*joint.bodies} <= group | known]
            if 3 * count == sum(2 - (joint.slides and joint.turns) for joint in own):
                return group
    return {*unknown}


def _driven(geometry: Geometry) -> tuple[set[str], set[str]]:
    """Return the names of the bodies whose motion the driver gives, with the ground, and of the slides whose motion it gives.

    Raises:
        SceneError: the driver is of another kind.
    """
    driven = geometry.driven
    moving = [body for body in driven.bodies if body != GROUND]
    joints = [joint for joint in geometry.connections if set(joint.bodies) == set(driven.bodies)]
    if len(moving) == 1 and GROUND in driven.bodies and joints:
        if driven.coordinate == "angle" and joints[0].turns and not joints[0].slides:
            return {GROUND, moving[0]}, set()
        if driven.coordinate == "x" and not joints[0].turns:
            return {GROUND, moving[0]}, {joints[0].name}
    raise SceneError(
        ["a worked solution needs a motor that turns a link about a pin of the ground, or moves a slide on the ground"]
    )


BodyPath = list[tuple[str, Connection]]  # bodies, each with the joint by which the path leaves it; the first body is known


def _paths(geometry: Geometry, known: set[str], allowed: set[str]) -> Iterator[BodyPath]:
    """Iterate over the chains of unknown bodies, out of those allowed, that begin and end at known bodies."""

    def onward(path: BodyPath, body: str) -> Iterator[BodyPath]:
        visited = {name for name, _ in path}
        for joint in geometry.connections:
            if body not in joint.bodies or any(joint.name == other.name for _, other in path):
                continue
            after = joint.other(body)
            if after in known:
                if path:
                    yield [*path, (body, joint)]
            elif after in allowed and after not in visited:
                yield from onward([*path, (body, joint)], after)

    for body in sorted(known, key=[*geometry.mechanism.body_names, GROUND].index):
        for path in onward([], body):
            if len(path) > 1:
                yield path


def _unknowns(geometry: Geometry, path: BodyPath, known: set[str], slides: set[str]) -> tuple[list[str], list[str]]:
    roots = [geometry.root(body) for body, _ in path if body not in known]
    angles = [root for root in dict.fromkeys(roots) if root not in known]
    return angles, [joint.name for _, joint in path if joint.slides and joint.name not in slides]


def _closed(geometry: Geometry, path: BodyPath, known: set[str], used: set[str]) -> list[LoopVector]:
    """Return the vectors of the loop of a path and of the known bodies that join its ends."""
    first, last = path[0][0], path[-1][1].other(path[-1][0])
    back = _shortest(geometry, last, first, used)
    ring = [*path, *back]
    return [x for k, (body, leave) in enumerate(ring) for x in geometry.chain(body, ring[k - 1][1], leave)]


def _shortest(geometry: Geometry, start: str, goal: str, used: set[str]) -> BodyPath:
    """Return the shortest chain of known bodies from one to another, by joints that loops have used."""
    ways: list[tuple[str, BodyPath]] = [(start, [])]
    seen = {start}
    for body, path in ways:
        if body == goal:
            return path
        for joint in geometry.connections:
            if joint.name in used and body in joint.bodies and joint.other(body) not in seen:
                seen.add(joint.other(body))
                ways.append((joint.other(body), [*path, (body, joint)]))
    raise AssertionError(f"{start} and {goal} are not connected")


def _together(geometry: Geometry, known: set[str], slides: set[str], used: set[str], group: set[str]) -> list[VectorLoop]:
    """Return independent loops of a group of bodies; each unknown belongs to the first loop that contains it."""
    joined, slides = set(known), set(slides)
    found: list[VectorLoop] = []
    basis: dict[int, int] = {}
    bits = {joint.name: 1 << k for k, joint in enumerate(geometry.connections)}
    for path in sorted(_paths(geometry, known, group), key=len):
        rest = sum(bits[joint.name] for _, joint in path)
        while rest and (top := rest.bit_length()) in basis:  # elimination modulo two
            rest ^= basis[top]
        if not rest:
            continue
        basis[rest.bit_length()] = rest
        angles, sliding = _unknowns(geometry, path, joined, slides)
        found.append(VectorLoop(_closed(geometry, path, known, used), angles, sliding))
        joined |= {body for body, _ in path}
        slides |= set(sliding)
    return found
