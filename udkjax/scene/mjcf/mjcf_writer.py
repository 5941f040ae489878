"""Write mechanisms as MJCF models: a tree of bodies in the world's x-z plane, closed by equalities."""

from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import jax
import numpy as np
from jaxtyping import Array

from udkjax.annotations import Number
from udkjax.scene.arguments import checked
from udkjax.scene.bodies import GROUND, GROUND_FRAME_AT_REST, Point, between
from udkjax.scene.checks import SceneError
from udkjax.scene.forces import Spring, Torque, TorsionSpring
from udkjax.scene.held import Held
from udkjax.scene.joints import Angle, Constraint, Distance, Gear, Prismatic, Revolute, Slot, Weld
from udkjax.scene.mechanism import AbstractDrawing, Mechanism
from udkjax.scene.mechanism_tables import check_known
from udkjax.scene.mjcf.body_tree import unique_name
from udkjax.scene.mjcf.coupled_lengths import EVEN
from udkjax.scene.mjcf.mjcf_reader import INITIAL, OPEN_LOOP
from udkjax.scene.reshaping import attachments
from udkjax.scene.spanning_tree import spanning_tree
from udkjax.scene.suspicions import body_sizes
from udkjax.wording import quote

IN_TREE = (Weld, Prismatic, Slot), (Revolute,), (Distance,), (Angle,)  # joints that no equality can express come first
NORMAL = "0 -1 0"  # of the x-z plane: angles are anticlockwise about it, with x to the right and z up
THICKNESS = 0.04  # of the drawn bars, relative to the size of the largest body

Attributes = dict[str, str]


class _TreeJoint(NamedTuple):
    """The text of a hinge or a slide, and its initial rate (rad/s, m/s)."""

    name: str
    attributes: Attributes
    rate: Number


@checked
def mjcf_text(mechanism: Mechanism | AbstractDrawing) -> str:
    """Return a mechanism as an MJCF model, the XML format of MuJoCo, in the world's x-z plane; `read_mjcf` reads it back.

    The joints of a spanning tree become hinges and slides, the others equalities: `connect`, `weld`, or equalities of tendons.
    Bodies are drawn as thin bars without mass or contacts. Initial velocities, and torques as controls of motors, are in the
    keyframe "initial". Equalities are soft in MuJoCo: see its `solref`.

    Args:
        mechanism: The scene.

    Returns:
        The text.

    Raises:
        SceneError: MJCF has no equivalent for an element, or a joint of the tree is open; the error lists all of them.
    """
    mechanism = mechanism.mechanism() if isinstance(mechanism, AbstractDrawing) else mechanism
    check_known(mechanism, mechanism.name)
    return _Writer(jax.tree.map(np.asarray, mechanism)).text()


class _Writer:
    def __init__(self, mechanism: Mechanism):
        self.mechanism, self.problems = mechanism, list[str]()
        self.size = max(body_sizes(mechanism).values())
        self.frames = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in mechanism.bodies.items()}
        self.sites: dict[str, list[Attributes]] = {name: [] for name in self.frames}
        self.springs: dict[str, Attributes] = {}  # attributes of hinges by name
        self.sections: dict[str, list[str]] = {"tendon": [], "equality": [], "actuator": []}
        self.controls: list[float] = []
        self.taken: set[str] = set()  # names of sites and tendons
        preferred = [name for kinds in IN_TREE for name, joint in mechanism.joints.items() if isinstance(joint, kinds)]
        self.tree = {edge.body: edge for edge in spanning_tree(mechanism, {name: k for k, name in enumerate(preferred)})}
        held = {edge.joint for edge in self.tree.values()}
        self.turns: dict[str, dict[str, float]] = {GROUND: {}}  # hinges whose sum is the angle of each body
        self.joints = {name: self._joints(name) for name in self.tree}
        for name, joint in mechanism.joints.items():
            if name not in held:
                self._add_loop(name, joint)
        for name, force in mechanism.forces.items():
            self._add_force(name, force)
        if "world" in mechanism.bodies:
            self.problems.append('body "world": in MJCF this is the name of the ground')
        self.problems += [
            f"driver {quote(name)}: MJCF prescribes no motion; a <velocity> actuator comes near it" for name in mechanism.drivers
        ]

    def text(self) -> str:
        """Return the model; raise a `SceneError` if it does not represent the whole mechanism."""
        gravity = _numbers(self.mechanism.gravity[0], 0.0, self.mechanism.gravity[1])
        lines = [
            f"<mujoco{_attributes(model=self.mechanism.name) if self.mechanism.name else ''}>",
            '  <compiler angle="radian"/>',
            f"  <option{_attributes(gravity=gravity)}/>",
            "  <worldbody>",
            *(f"    <site{_attributes(**site)}/>" for site in self.sites[GROUND]),
        ]
        rates: list[Number] = []
        children = {name: [edge.body for edge in self.tree.values() if edge.holder == name] for name in self.frames}
        pending = [(name, 2) for name in reversed(children[GROUND])]
        while pending:
            name, depth = pending.pop()
            if name in self.frames:
                lines += ["  " * depth + line for line in self._body_lines(name)]
                rates += [joint.rate for joint in self.joints[name]]
                pending += [("", depth), *((child, depth + 1) for child in reversed(children[name]))]
            else:
                lines.append("  " * depth + "</body>")
        lines.append("  </worldbody>")
        for section, parts in self.sections.items():
            lines += [f"  <{section}>", *(f"    {part}" for part in parts), f"  </{section}>"] if parts else []
        if any(rates) or any(self.controls):
            given = {"qvel": _numbers(*rates)} | ({"ctrl": _numbers(*self.controls)} if self.controls else {})
            lines += ["  <keyframe>", f"    <key{_attributes(name=INITIAL, **given)}/>", "  </keyframe>"]
        if self.problems:
            raise SceneError(self.problems, self.mechanism.name)
        return "\n".join([*lines, "</mujoco>", ""])

    def _joints(self, name: str) -> list[_TreeJoint]:
        """Return the hinges and slides between a body and its parent."""
        _, parent, held = self.tree[name]
        one, two = self.frames[parent], self.frames[name]
        self.turns[name] = dict(self.turns[parent])
        found: list[_TreeJoint] = []

        def hinge(title: str, pin: Point, rate: Number) -> None:
            self.turns[name][title] = 1.0
            found.append(_TreeJoint(title, {"axis": NORMAL, "pos": _in_space(two.local((pin.x - two.x, pin.y - two.y)))}, rate))

        def slide(title: str, direction: Point, pin: Point) -> None:
            velocities = [frame.velocity(frame.local((pin.x - frame.x, pin.y - frame.y))) for frame in (one, two)]
            rate = direction.dot(Point(velocities[1].x - velocities[0].x, velocities[1].y - velocities[0].y))
            found.append(_TreeJoint(title, {"type": "slide", "axis": _in_space(two.local(direction))}, rate))

        turning = two.omega - one.omega
        if not held:
            slide(f"{name}.x", Point(1.0, 0.0), Point(two.x, two.y))
            slide(f"{name}.y", Point(0.0, 1.0), Point(two.x, two.y))
            hinge(f"{name}.angle", Point(two.x, two.y), turning)
            return found
        joint = self.mechanism.joints[held]
        gap = float(np.max(np.abs(joint.residual(0.0, *(self.frames[body] for body in joint.bodies)))))
        if gap > OPEN_LOOP * max(self.size, 1.0):
            cure = "MJCF takes bodies where they stand: start them from `udk.assemble`"
            self.problems.append(f"joint {quote(held)}: is open by {gap:.3g} (m, rad), and {cure}")
        first, second = (self.frames[body] for body in joint.bodies)
        if isinstance(joint, Revolute):
            hinge(held, two.point(joint.points[joint.bodies.index(name)]), turning)
        elif isinstance(joint, Prismatic | Slot):
            pin, along = second.point(joint.points[1]), first.vector((float(np.cos(joint.axis)), float(np.sin(joint.axis))))
            slide(held if isinstance(joint, Prismatic) else f"{held}.slide", along, pin)
            if isinstance(joint, Slot):
                hinge(held, pin, turning)
                found = found if name == joint.bodies[1] else found[::-1]
        elif isinstance(joint, Distance):
            ends = [two.point(joint.points[joint.bodies.index(name)]), one.point(joint.points[joint.bodies.index(parent)])]
            rod = Point(ends[0].x - ends[1].x, ends[0].y - ends[1].y)
            rates = [frame.velocity(joint.points[joint.bodies.index(body)]) for frame, body in ((two, name), (one, parent))]
            spin = (rod.x * (rates[0].y - rates[1].y) - rod.y * (rates[0].x - rates[1].x)) / rod.dot(rod)
            hinge(f"{held}.rod", ends[1], spin - one.omega)
            hinge(held, ends[0], two.omega - spin)
        elif isinstance(joint, Angle):
            slide(f"{held}.x", Point(1.0, 0.0), Point(two.x, two.y))
            slide(f"{held}.y", Point(0.0, 1.0), Point(two.x, two.y))
        return found

    def _body_lines(self, name: str) -> list[str]:
        """Return the lines of a body, without its children and its end tag."""
        body, one, two = self.mechanism.bodies[name], self.frames[self.tree[name].holder], self.frames[name]
        place = _in_space(one.local((two.x - one.x, two.y - one.y)))
        inertia = _numbers(body.inertia, body.inertia, body.inertia)
        radius = 0.5 * THICKNESS * self.size
        points = [Point(*np.asarray(point).tolist()) for _, point in attachments(self.mechanism, name)]
        ends = {_in_space(point) for point in points if point.norm() > radius}
        look = {"mass": "0", "contype": "0", "conaffinity": "0", "size": _numbers(radius)}
        return [
            f"<body{_attributes(name=name, pos=place, axisangle=f'{NORMAL} {_numbers(two.angle - one.angle)}')}>",
            *(f"  <joint{_attributes(name=j.name, **j.attributes, **self.springs.get(j.name, {}))}/>" for j in self.joints[name]),
            f"  <inertial{_attributes(pos='0 0 0', mass=_numbers(body.mass), diaginertia=inertia)}/>",
            *(f"  <geom{_attributes(type='capsule', fromto=f'0 0 0 {end}', **look)}/>" for end in sorted(ends)),
            *([] if ends else [f"  <geom{_attributes(**look)}/>"]),
            *(f"  <site{_attributes(**site)}/>" for site in self.sites[name]),
        ]

    # --- loop closures and forces

    def _add_loop(self, name: str, joint: Constraint) -> None:
        section = self.sections["equality"]
        if isinstance(joint, Revolute | Weld):
            kind = "connect" if isinstance(joint, Revolute) else "weld"
            angle = float(joint.angle) if isinstance(joint, Weld) else 0.0  # of body 2 relative to body 1
            one, two = self._add_sites(name, joint.bodies, joint.points, angle)
            section.append(f"<{kind}{_attributes(name=name, site1=one, site2=two)}/>")
        elif isinstance(joint, Distance):
            tendon = self._add_spatial(name, joint.bodies, joint.points)
            offset = float(joint.length) - between(joint.points, *(self.frames[body] for body in joint.bodies)).norm()
            section.append(f"<tendon{_attributes(name=name, tendon1=tendon, polycoef=_numbers(offset, 0.0))}/>")
        elif isinstance(joint, Gear | Angle):
            one, two = joint.bodies
            if isinstance(joint, Gear):
                first, second = float(joint.radii[0]), float(joint.radii[1]) * (-1 if joint.internal else 1)
                parts, offset = {one: first, two: second, joint.carrier: -first - second}, 0.0
            else:
                parts = {two: 1.0, one: -1.0}
                offset = float(joint.angle - self.frames[two].angle + self.frames[one].angle)
            if tendon := self._add_fixed(name, self._hinges(parts), "joint"):
                section.append(f"<tendon{_attributes(name=name, tendon1=tendon, polycoef=_numbers(offset, 0.0))}/>")
        else:
            closes = " that closes a loop" if isinstance(joint, Slot | Prismatic) else ""
            self.problems.append(f"joint {quote(name)}: MJCF has no equality for a {type(joint).__name__.lower()}{closes}")

    def _add_force(self, name: str, force: Any) -> None:
        if any(isinstance(value, Held) for value in vars(force).values()):
            self.problems.append(f"force {quote(name)}: MJCF has no samples; give a number, and MuJoCo the samples as controls")
        elif isinstance(force, Spring):
            rest = {"springlength": _numbers(force.length), "stiffness": _numbers(force.stiffness)}
            self._add_spatial(name, force.bodies, force.points, **rest, **_damping(force.damping))
        elif isinstance(force, TorsionSpring | Torque):
            self._add_turning(name, force)
        else:
            self.problems.append(f"force {quote(name)}: MJCF has no element for a {type(force).__name__.lower()}")

    def _add_turning(self, name: str, force: Any) -> None:
        """Add a torsion spring, or a torque, to the hinge between its bodies, or to a tendon over several hinges."""
        one, two = force.bodies
        hinges = self._hinges({two: 1.0, one: -1.0})
        (hinge, sign), *others = [*hinges.items(), ("", 0.0)]
        alone = len(others) == 1 and abs(sign) == 1
        if (value := getattr(force, "value", None)) is not None:  # a torque
            tendon = "" if alone else self._add_fixed(name, hinges, "force")
            target = {"joint": hinge, "gear": _numbers(sign)} if alone else {"tendon": tendon}
            if alone or tendon:
                self.sections["actuator"].append(f"<motor{_attributes(name=name, **target)}/>")
                self.controls.append(float(value))
            return
        rest = float(force.angle - self.frames[two].angle + self.frames[one].angle)
        spring = {"stiffness": _numbers(force.stiffness)} | _damping(force.damping)
        if alone and hinge not in self.springs:
            self.springs[hinge] = {"springref": _numbers(sign * rest), **spring}
        else:
            turned = -1.0 if rest < 0 else 1.0  # a springlength of -1 means the length in the position of the file
            parts = {joint: turned * part for joint, part in hinges.items()}
            self._add_fixed(name, parts, "force", springlength=_numbers(abs(rest)), **spring)

    def _hinges(self, parts: dict[str, float]) -> dict[str, float]:
        """Return a weighted sum of angles of bodies as a weighted sum of hinges."""
        found: dict[str, float] = {}
        for body, factor in parts.items():
            for hinge, part in self.turns[body].items():
                found[hinge] = found.get(hinge, 0.0) + factor * part
        least = EVEN * max(map(abs, found.values()), default=0.0)
        return {hinge: part for hinge, part in found.items() if abs(part) > least}

    def _add_fixed(self, name: str, hinges: dict[str, float], what: str, **attributes: str) -> str:
        """Add a tendon that is a sum of hinges; return its name, or an empty text if the sum is empty."""
        if not hinges:
            self.problems.append(
                f"{what} {quote(name)}: its bodies do not turn against each other, and MJCF knows angles of hinges alone"
            )
            return ""
        title = self._unique(name)
        parts = "".join(f"<joint{_attributes(joint=hinge, coef=_numbers(part))}/>" for hinge, part in hinges.items())
        self.sections["tendon"].append(f"<fixed{_attributes(name=title, **attributes)}>{parts}</fixed>")
        return title

    def _add_spatial(self, name: str, bodies: Sequence[str], points: Array | np.ndarray, **attributes: str) -> str:
        """Add a tendon between two points; return its name."""
        title = self._unique(name)
        ends = "".join(f"<site{_attributes(site=site)}/>" for site in self._add_sites(name, bodies, points))
        self.sections["tendon"].append(f"<spatial{_attributes(name=title, **attributes)}>{ends}</spatial>")
        return title

    def _add_sites(self, name: str, bodies: Sequence[str], points: Array | np.ndarray, angle: float = 0.0) -> list[str]:
        """Add a site for each of two points, the first turned by an angle (rad); return their names."""
        titles = [self._unique(f"{name}.{body}") for body in bodies]
        for title, body, point, turn in zip(titles, bodies, points, (angle, 0.0), strict=True):
            turned = {"axisangle": f"{NORMAL} {_numbers(turn)}"} if turn else {}
            self.sites[body].append({"name": title, "pos": _in_space(Point(*point.tolist())), **turned})
        return titles

    def _unique(self, name: str) -> str:
        found = unique_name(name, self.taken)
        self.taken.add(found)
        return found


def _damping(value: object) -> Attributes:
    return {} if value is None else {"damping": _numbers(value)}


def _in_space(point: Point) -> str:
    return _numbers(point.x, 0.0, point.y)


def _numbers(*values: object) -> str:
    """Return numbers as text that reads back as the same numbers."""
    return " ".join(repr(float(value)) for value in values)  # pyright: ignore[reportArgumentType]


def _attributes(**values: str) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items())
