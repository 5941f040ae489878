"""Marks of a mechanism's picture: plain data shared by the player in the browser and the writers of pictures.

A mark is a dict with a `kind`, whose further fields are listed in mark_kinds.py. Places are in metres in the frame of a body,
which is given by its index in the mechanism, or -1 for the ground; an `anchor` is [body, x, y]. symbols.py draws the marks.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from udkjax.annotations import JsonObject, Numbers
from udkjax.integrate.events.law.conditions import Gap
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.elements.couplings import Coupling, Gear, Rack, Screw
from udkjax.scene.elements.drivers import Driver
from udkjax.scene.elements.forces import Force, ForceElement, Spring, Torque, TorsionSpring
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.joints import Cam, Distance, Joint, Prismatic, Revolute, Slot, Weld
from udkjax.scene.elements.rolling import KnifeEdge, Wheel
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.marks.mark_kinds import MarkKind
from udkjax.show.player.marks.mark_places import SAME_PLACE, body_points, corners_of, distinct, in_frame, to_ground

Mark = JsonObject
BodyPoints = Mapping[str, Numbers]  # points (n, 2) by body
Poses = Float[np.ndarray, "T bodies 3"]
PROFILE_POINTS = 180  # number of points of a cam's outline
TOUCHING_GAP = 0.02  # relative to their distance: wheels with a larger gap are joined by a belt
ROD_TOL = 0.01  # relative difference from the inertia of a uniform rod up to which a body is drawn as a rod
SAME_MARK = 1e-6  # relative to the size: a traced point closer to a mark is shown by it
RAIL_MARGIN = 0.08  # length of a rail beyond the used range, relative to the mechanism's length


def marks(
    mechanism: Mechanism,
    poses: Numbers,
    shapes: BodyPoints | None = None,
    gaps: Sequence[Gap] = (),
    targets: Numbers | None = None,
    traced: Sequence[Sequence[float]] = (),
) -> list[Mark]:
    """Return the marks of a mechanism, from back to front.

    Args:
        mechanism: mechanism to draw.
        poses: all poses in which it will be drawn.
        shapes: further points (n, 2) of bodies by name, in the bodies' frames (m), that the drawn bodies pass through.
        gaps: conditions of contacts, whose lines are drawn.
        targets: wanted places (n, 2) on the ground (m).
        traced: anchors, [index of a body, x, y], whose paths are drawn; they get a mark where no other one is.

    Raises:
        ValueError: a name in `shapes` is not a body.
    """
    unknown = [name for name in shapes or {} if name not in mechanism.bodies]
    if unknown:
        raise ValueError(f"shapes: there is no body {unknown[0]!r}")
    drawing = _Drawing(mechanism, np.asarray(poses, float), shapes or {})
    for gap in gaps:
        drawing.add_floor(gap)
    places = np.zeros((0, 2)) if targets is None else np.asarray(targets, float)
    wanted = [{"kind": MarkKind.TARGET, "body": -1, "at": place} for place in places.tolist()]
    links = drawing.links()
    plates = [mark for mark in links if mark.get("closed")]
    bars = [mark for mark in links if not mark.get("closed")]
    in_links = [mark for mark in drawing.rails if mark.get("slot") and mark["body"] >= 0]  # they cover their links
    rails = [mark for mark in drawing.rails if mark not in in_links]
    rings = [mark for mark in drawing.wheels if mark.get("internal")]
    wheels = [mark for mark in drawing.wheels if not mark.get("internal")]
    found = [*rings, *rails, *plates, *wheels, *bars, *in_links, *drawing.elements, *drawing.pins, *wanted]
    return [*found, *drawing.unmarked(traced, found)]


class _Drawing:
    """The marks of one mechanism, collected in layers, since later marks cover earlier ones."""

    def __init__(self, mechanism: Mechanism, poses: Poses, shapes: BodyPoints):
        self.mechanism, self.poses = mechanism, poses
        drawn = {} if mechanism.drawing is None else mechanism.drawing.shapes()
        polygons = () if mechanism.drawing is None else mechanism.drawing.polygons
        self.polygons = {body: np.asarray(drawn[body], float) for body in polygons if body not in shapes}
        holes = {} if mechanism.drawing is None else mechanism.drawing.holes()
        self.holes = {body: np.asarray(x, float).tolist() for body, x in holes.items() if body not in shapes}
        self._names = [*mechanism.bodies, GROUND]  # by index, -1 for the ground
        self.number = {GROUND: -1, **{body: k for k, body in enumerate(mechanism.bodies)}}
        self.points = body_points(mechanism)
        for body, points in {**drawn, **shapes}.items():
            self.points[body] = distinct(
                [*map(tuple, self.points[body].tolist()), *map(tuple, np.asarray(points, float).tolist())]
            )
        self.size = _size(self)
        self.rails: list[Mark] = []
        self.wheels: list[Mark] = []
        self.elements: list[Mark] = []
        self.pins: list[Mark] = []
        self.shaped: set[str] = set()  # bodies drawn as something other than a link
        for name, joint in mechanism.joints.items():
            self._joint(name, joint)
        for driver in mechanism.drivers.values():
            self._driver(driver)
        for force in mechanism.forces.values():
            self._force(force)

    def links(self) -> list[Mark]:
        """Return the links and discs of bodies.

        A link is drawn through the points of a body; from a single point, it leads to the centre of mass, or to the other end of
        a uniform rod. Bodies with fewer than two points get a disc, except rods and bodies with another symbol, such as wheels.
        """
        found: list[Mark] = []
        for body, points in self.points.items():
            if body == GROUND:
                continue
            k, single = self.number[body], len(points) == 1
            inertia, mass = (float(getattr(self.mechanism.bodies[body], name)) for name in ("inertia", "mass"))
            reach = float(np.linalg.norm(points[0])) if single else 0.0
            # A uniform rod of length 2 r has the inertia m r^2 / 3; if attached at one end, it is drawn to its other end.
            rod = single and abs(3 * inertia - mass * reach**2) < ROD_TOL * mass * reach**2
            if single and reach > SAME_PLACE * self.size:
                points = np.concatenate([points, -points if rod else np.zeros((1, 2))])
            if len(points) > 1:
                corners, closed = corners_of(points, self.polygons.get(body))
                found.append({"kind": MarkKind.LINK, "body": k, "points": corners.tolist(), "closed": closed})
                found[-1] |= {"holes": self.holes[body]} if body in self.holes else {}
            if len(self.points[body]) < 2 and body not in self.shaped and not rod:
                radius = min(np.sqrt(inertia / mass), self.size / 4)
                found.append({"kind": MarkKind.DISC, "body": k, "at": [0.0, 0.0], "radius": radius})
        return found

    def unmarked(self, traced: Sequence[Sequence[float]], drawn: Sequence[Mark]) -> list[Mark]:
        """Return a mark for each of the `traced` anchors that coincides with no mark in `drawn` in the first pose."""

        def place(body: float, at: Numbers) -> np.ndarray:
            return self._path(self._names[int(body)], at)[0]

        places = [place(mark["body"], mark["at"]) for mark in drawn if "at" in mark]
        near = SAME_MARK * self.size
        free = [one for one in traced if all(np.linalg.norm(place(one[0], one[1:]) - x) > near for x in places)]
        return [{"kind": MarkKind.TRACED, "body": int(body), "at": [x, y]} for body, x, y in free]

    def _joint(self, name: str, joint: Joint) -> None:
        match joint:
            case Revolute():
                self._pin(name, self._held(joint.bodies, joint.points))
            case Weld():
                self.elements.append({"kind": MarkKind.WELD, **self._held(joint.bodies, joint.points)})
            case Prismatic() | Slot():
                self._rail(joint)
            case Distance():
                a, b = self._anchors(joint.bodies, joint.points)
                self.elements.append({"kind": MarkKind.ROD, "a": a, "b": b})
                for k, x, y in (a, b):
                    self._pin(name, {"body": int(k), "at": [x, y]})
            case Gear():
                self._gear(name, joint)
            case Rack():
                self._rack(joint)
            case Screw():
                self._thread(joint)
            case KnifeEdge():
                self._edge(joint)
            case Wheel():  # seen from above
                self.elements.append(
                    {"kind": MarkKind.BLOCK, **self._at(joint.bodies[1], joint.point), "axis": float(joint.axis)}
                )
            case Coupling():
                pass  # the joints that guide its bodies are drawn
            case Cam():
                rim = joint.profile.rim(PROFILE_POINTS, joint.face is not None)
                place = self._at(joint.bodies[0], joint.points[0])
                self.wheels.append({"kind": MarkKind.OUTLINE, **place, "points": rim.tolist()})
                self.elements.append({"kind": MarkKind.ROLLER, **self._at(joint.bodies[1], joint.points[1])})
                self.shaped.add(joint.bodies[0])
            case _ if (points := getattr(joint, "points", None)) is not None and len(joint.bodies) == 2:
                self._pin(name, self._held(joint.bodies, points))

    def _pin(self, name: str, mark: Mark) -> None:
        self.pins.append({"kind": MarkKind.PIN, "name": name, **mark})
        if mark["body"] < 0:
            self.rails.append({"kind": MarkKind.SUPPORT, **mark})

    def _driver(self, driver: Driver) -> None:
        if driver.coordinate == "angle":
            self.elements.append({"kind": MarkKind.MOTOR, **self._axle(driver.bodies)})
        elif driver.coordinate == "distance":
            a, b = self._anchors(driver.bodies, driver.points)
            self.elements.append({"kind": MarkKind.PISTON, "a": a, "b": b})

    def _force(self, force: ForceElement) -> None:
        match force:
            case Spring():
                a, b = self._anchors(force.bodies, force.points)
                ends = (self._path(body, point) for body, point in zip(force.bodies, np.asarray(force.points), strict=True))
                length = float(np.median(np.linalg.norm(np.subtract(*ends), axis=1)))
                damper = force.damping is not None
                self.elements.append({"kind": MarkKind.SPRING, "a": a, "b": b, "damper": damper, "length": length})
            case TorsionSpring():
                self.elements.append({"kind": MarkKind.SPIRAL, **self._axle(force.bodies)})
            case Friction():
                of = self.mechanism.joints[force.joint]
                place = self._axle(of.bodies) if isinstance(of, Revolute) else self._at(of.bodies[1], of.points[1])
                self.elements.append({"kind": MarkKind.FRICTION, **place})
            case Force():
                place = self._at(force.body, force.point)
                vector = np.asarray(_at_start(force.vector), float).tolist()
                self.elements.append({"kind": MarkKind.FORCE, **place, "vector": vector, "turns": force.frame == "body"})
            case Torque():
                sign = 1 if float(_at_start(force.value)) >= 0 else -1
                self.elements.append({"kind": MarkKind.TORQUE, **self._axle(force.bodies), "sign": sign})

    def _rail(self, joint: Prismatic | Slot) -> None:
        first, second = joint.bodies
        axis = float(joint.axis)
        slot = isinstance(joint, Slot)
        start, end = self._travel(first, joint.points[0], axis, second, joint.points[1])
        margin = RAIL_MARGIN * self.size
        rail = {**self._at(first, joint.points[0]), "axis": axis, "span": [start - margin, end + margin], "slot": slot}
        self.rails.append({"kind": MarkKind.RAIL, **rail})
        if slot:
            self.pins.append({"kind": MarkKind.ROLLER, **self._at(second, joint.points[1])})
        else:
            block = {"kind": MarkKind.BLOCK, **self._at(second, joint.points[1]), "axis": axis - float(np.asarray(joint.angle))}
            self.elements.append(block)
            self.shaped.add(second)

    def add_floor(self, gap: Gap) -> None:
        """Add the line of a contact, over the range in which the point of the contact comes close to it."""
        (body, on), margin = gap.bodies, RAIL_MARGIN * self.size
        nx, ny = np.asarray(gap.normal, float)
        axis = float(np.arctan2(-nx, ny))
        gap_vector, turned = self._path(body, gap.point) - self._path(on, gap.through), axis + self._frames(on)[:, 2]
        positions, gaps = (gap_vector[:, 0] * np.cos(a) + gap_vector[:, 1] * np.sin(a) for a in (turned, turned + np.pi / 2))
        near = positions[gaps <= gaps.min() + margin]
        span = [float(near.min()) - margin, float(near.max()) + margin]
        self.rails.append({"kind": MarkKind.FLOOR, **self._at(on, gap.through), "axis": axis, "span": span})

    def _gear(self, name: str, joint: Gear) -> None:
        largest, radii = int(np.argmax(np.asarray(joint.radii))), np.asarray(joint.radii, float)
        strands, teeth, pair = self._belt(joint), self._teeth(name), []
        self.elements.extend({"kind": MarkKind.ROD, "a": a, "b": b} for a, b in strands)
        for k, (body, radius) in enumerate(zip(joint.bodies, radii.tolist(), strict=True)):
            place = self._held_by(body, joint.carrier)
            is_ring = joint.internal and k == largest and not strands
            wheel = {"kind": MarkKind.WHEEL, **place, "radius": radius, "internal": is_ring, "teeth": teeth[k], "phase": None}
            same = [other for other in self.wheels if wheel | {"phase": other.get("phase")} == other]
            self.wheels += [] if same else [wheel]
            pair.append((same or [wheel])[0])
            self.shaped.add(body)
        if all(teeth) and not strands:
            self._mesh(*(pair if pair[1]["phase"] is None else pair[::-1]))

    def _teeth(self, name: str) -> list[int]:
        """Return the numbers of teeth of the two wheels of a gear; [0, 0] if they are not known."""
        drawn = None if self.mechanism.drawing is None else self.mechanism.drawing.groups["gear"].get(name)
        counts = getattr(drawn, "teeth", None)
        return [0, 0] if counts is None else [round(count) for count in np.asarray(counts, float).tolist()]

    def _mesh(self, held: Mark, wheel: Mark) -> None:
        """Set the phase of a wheel so that, in the first pose, its teeth are in the gaps of the wheel `held`.

        A wheel that already has a phase keeps it.
        """
        held["phase"] = held["phase"] or 0.0
        if wheel["phase"] is not None:
            return
        frames = [self._frames(self._names[mark["body"]])[0] for mark in (held, wheel)]
        centres = [to_ground(mark["at"], frame[None])[0] for mark, frame in zip((held, wheel), frames, strict=True)]
        inner = held["internal"] or wheel["internal"]
        x, y = (centres[1] - centres[0]) * (1 if held["radius"] > wheel["radius"] or not inner else -1)
        contact = np.arctan2(y, x)  # from the centre of the first wheel
        share = (contact - frames[0][2] - held["phase"]) * held["teeth"] / (2 * np.pi)  # 0 in a gap, 1/2 on a tooth
        other = share if inner else 0.5 - share
        towards = contact - frames[1][2] - (0.0 if inner else np.pi)
        wheel["phase"] = float((towards - 2 * np.pi * other / wheel["teeth"]) % (2 * np.pi / wheel["teeth"]))

    def _belt(self, joint: Gear) -> list[tuple[list[float], ...]]:
        """Return the two strands of the belt of a gear, each as two anchors on the carrier; [] for wheels that touch or overlap.

        The belt of an internal gear, which keeps the sense of rotation, is open; any other belt is crossed.
        """
        radii, carrier = np.asarray(joint.radii, float), self._frames(joint.carrier)[0]
        axles = [self._path(body, self._held_by(body, joint.carrier)["at"])[0] for body in joint.bodies]
        centres = [in_frame(carrier, axle) for axle in axles]
        arm = centres[1] - centres[0]
        distance, reach = float(np.hypot(*arm)), radii[0] - radii[1] if joint.internal else radii[0] + radii[1]
        if abs(distance - abs(reach)) <= TOUCHING_GAP * distance or distance <= abs(reach):
            return []
        strands, along = [], np.arctan2(arm[1], arm[0])
        for side in (1.0, -1.0):  # the normal of a strand has the angle acos(reach / distance) to the line of centres
            angle = along + side * np.arccos(reach / distance)
            normal = np.array([np.cos(angle), np.sin(angle)])
            ends = centres[0] + radii[0] * normal, centres[1] + (radii[1] if joint.internal else -radii[1]) * normal
            strands.append(tuple([self.number[joint.carrier], *end.tolist()] for end in ends))
        return strands

    def _rack(self, joint: Rack) -> None:
        first, second = joint.bodies
        axis, radius = float(joint.axis), float(joint.radius)
        frame, pinion = self._frames(first)[0], self._frames(second)[0, :2]
        right = np.array([np.sin(axis), -np.cos(axis)])
        origin = in_frame(frame, pinion) + radius * right
        start, end = self._travel(first, origin, axis, second, (0.0, 0.0))
        self.rails.append(
            {"kind": MarkKind.RACK, **self._at(first, origin), "axis": axis, "span": [start - radius, end + radius]}
        )
        wheel = {"radius": radius, "internal": False, "teeth": 0, "phase": 0.0}
        self.wheels.append({"kind": MarkKind.WHEEL, **self._at(second, (0.0, 0.0)), **wheel})
        self.shaped.add(second)

    def _thread(self, joint: Screw) -> None:
        first, second = joint.bodies
        axis, margin = float(joint.axis), RAIL_MARGIN * self.size
        origin = in_frame(self._frames(first)[0], self._path(second, joint.points[1])[0])
        start, end = self._travel(first, origin, axis, second, joint.points[1])
        span = [start - margin, end + margin]
        self.rails.append({"kind": MarkKind.RACK, **self._at(first, origin), "axis": axis, "span": span})

    def _edge(self, joint: KnifeEdge) -> None:
        k, axis, point = self.number[joint.bodies[1]], float(joint.axis), np.asarray(joint.point, float)
        along = RAIL_MARGIN * self.size * np.array([np.cos(axis), np.sin(axis)])
        ends = ([k, *(point + sign * along).tolist()] for sign in (-1.0, 1.0))
        self.elements.append({"kind": MarkKind.ROD, **dict(zip("ab", ends, strict=True))})

    def _travel(self, one: str, at: Numbers, axis: float, two: str, point: Numbers) -> tuple[float, float]:
        """Return the range (m) of a point of body `two` along an axis of body `one`, measured from the point `at` of `one`."""
        gap = self._path(two, point) - self._path(one, at)
        direction = axis + self._frames(one)[:, 2]
        displacements = gap[:, 0] * np.cos(direction) + gap[:, 1] * np.sin(direction)
        return float(displacements.min()), float(displacements.max())

    def _frames(self, body: str) -> Float[np.ndarray, "T 3"]:
        return np.zeros((len(self.poses), 3)) if body == GROUND else self.poses[:, self.number[body]]

    def _path(self, body: str, point: Numbers) -> Float[np.ndarray, "T 2"]:
        return to_ground(point, self._frames(body))

    def _at(self, body: str, point: Numbers) -> Mark:
        return {"body": self.number[body], "at": np.asarray(point, float).tolist()}

    def _held(self, bodies: Sequence[str], points: Numbers) -> Mark:
        """Return the place of a joint: on the ground if the ground is one of its bodies, else on its first body."""
        side = 1 if bodies[1] == GROUND else 0
        return self._at(bodies[side], np.asarray(points)[side])

    def _anchors(self, bodies: Sequence[str], points: Numbers | None) -> list[list[float]]:
        return [[self.number[body], x, y] for body, (x, y) in zip(bodies, np.asarray(points, float).tolist(), strict=True)]

    def _held_by(self, body: str, other: str) -> Mark:
        """Return the point of a revolute joint of two bodies in the frame of `body`, or the origin if there is no such joint."""
        for joint in self.mechanism.joints.values():
            if isinstance(joint, Revolute) and set(joint.bodies) == {body, other}:
                return self._at(body, joint.points[joint.bodies.index(body)])
        return self._at(body, (0.0, 0.0))

    def _axle(self, bodies: Sequence[str]) -> Mark:
        """Return the point about which two bodies turn: their revolute joint, or else the second body's centre of mass."""
        first, second = bodies
        return self._held_by(first if second == GROUND else second, second if second == GROUND else first)


def _size(drawing: _Drawing) -> float:
    """Return the extent of a mechanism's points and centres of mass in the first pose (m); 1 if it is zero."""
    all_points = [to_ground(point, drawing._frames(body)[:1])[0] for body, points in drawing.points.items() for point in points]
    all_points += [frame[:2] for frame in drawing.poses[0]]
    return float(np.ptp(np.array(all_points), axis=0).max()) or 1.0


def _at_start(number: Any) -> Any:
    """Return the first sample of a held number; return any other number unchanged."""
    return number(0.0) if isinstance(number, Held) else number
