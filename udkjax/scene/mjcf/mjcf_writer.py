"""Write mechanisms as MJCF models: a tree of bodies in the world's x-z plane, closed by equalities."""

from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import jax
import numpy as np
from jaxtyping import Array

from udkjax.annotations import Number
from udkjax.scene.arguments import checked
from udkjax.scene.drawing import Drawing
from udkjax.scene.elements.bodies import GROUND, GROUND_FRAME_AT_REST, Point, between
from udkjax.scene.elements.couplings import Coupling, Gear, Screw, coordinate_of
from udkjax.scene.elements.forces import Spring, Torque, TorsionSpring
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.held import Held
from udkjax.scene.elements.joints import Angle, Constraint, Distance, Prismatic, Revolute, Slot, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.mechanism_tables import check_known
from udkjax.scene.mjcf.body_tree import unique_name
from udkjax.scene.mjcf.coupled_lengths import ROUNDING_OF_SUMS
from udkjax.scene.mjcf.mjcf_reader import INITIAL_KEYFRAME, OPEN_LOOP_TOL
from udkjax.scene.reshaping import attachments
from udkjax.scene.spanning_tree import spanning_tree
from udkjax.scene.suspicions import body_sizes
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import quote

IN_TREE = (Weld, Prismatic, Slot), (Revolute,), (Distance,), (Angle,)  # joints that no equality can express come first
PLANE_NORMAL = "0 -1 0"  # normal of the x-z plane: angles are anticlockwise about it, with x to the right and z up
BAR_THICKNESS = 0.04  # thickness of the drawn bars, relative to the size of the largest body

Attributes = dict[str, str]


class _TreeJoint(NamedTuple):
    """The name and attributes of a hinge or a slide, and its initial rate (rad/s, m/s)."""

    name: str
    attributes: Attributes
    rate: Number


@checked
def mjcf_text(mechanism: Mechanism | Drawing) -> str:
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
    mechanism = mechanism.mechanism() if isinstance(mechanism, Drawing) else mechanism
    mechanism.require_masses("motions in MuJoCo")
    check_known(mechanism, mechanism.name)
    return _Writer(jax.tree.map(np.asarray, mechanism.without_origin)).text()


class _Writer:
    def __init__(self, mechanism: Mechanism):
        self.mechanism, self.problems = mechanism, list[str]()
        self.size = max(body_sizes(mechanism).values())
        self.frames = {GROUND: GROUND_FRAME_AT_REST} | {name: body.frame() for name, body in mechanism.bodies.items()}
        self.sites: dict[str, list[Attributes]] = {name: [] for name in self.frames}
        self.springs: dict[str, Attributes] = {}  # attributes of hinges by name
        self.losses: dict[str, Attributes] = {}  # dry friction of hinges by name
        self.sections: dict[str, list[str]] = {"tendon": [], "equality": [], "actuator": []}
        self.controls: list[float] = []
        self.taken: set[str] = set()  # names of sites and tendons
        rubbing = {force.joint for force in mechanism.forces.values() if isinstance(force, Friction)}  # no equality has friction
        by_kind = [[name for name, joint in mechanism.joints.items() if isinstance(joint, kinds)] for kinds in IN_TREE]
        preferred = [name for names in by_kind for name in sorted(names, key=lambda name: name not in rubbing)]
        self.tree = {edge.body: edge for edge in spanning_tree(mechanism, {name: k for k, name in enumerate(preferred)})}
        tree_joints = {edge.joint for edge in self.tree.values()}
        self.turns: dict[str, dict[str, float]] = {GROUND: {}}  # hinges whose sum is the angle of each body
        self.joints = {name: self._joints(name) for name in self.tree}
        for name, joint in mechanism.joints.items():
            if name not in tree_joints:
                self._add_loop(name, joint)
        for name, force in mechanism.forces.items():
            self._add_force(name, force)
        if "world" in mechanism.bodies:
            self.problems.append('body "world": in MJCF this is the name of the ground')
        self.problems += [
            f"driver {quote(name)}: MJCF cannot prescribe a motion; a <velocity> actuator is similar"
            for name in mechanism.drivers
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
        for section, items in self.sections.items():
            lines += [f"  <{section}>", *(f"    {item}" for item in items), f"  </{section}>"] if items else []
        if any(rates) or any(self.controls):
            values = {"qvel": _numbers(*rates)} | ({"ctrl": _numbers(*self.controls)} if self.controls else {})
            lines += ["  <keyframe>", f"    <key{_attributes(name=INITIAL_KEYFRAME, **values)}/>", "  </keyframe>"]
        if self.problems:
            raise SceneError(self.problems, self.mechanism.name)
        return "\n".join([*lines, "</mujoco>", ""])

    def _joints(self, name: str) -> list[_TreeJoint]:
        """Return the hinges and slides between a body and its parent."""
        _, parent, joint_name = self.tree[name]
        parent_frame, body_frame = self.frames[parent], self.frames[name]
        self.turns[name] = dict(self.turns[parent])
        hinges_and_slides: list[_TreeJoint] = []

        def hinge(title: str, pin: Point, rate: Number) -> None:
            self.turns[name][title] = 1.0
            hinges_and_slides.append(
                _TreeJoint(
                    title,
                    {"axis": PLANE_NORMAL, "pos": _in_space(body_frame.local((pin.x - body_frame.x, pin.y - body_frame.y)))},
                    rate,
                )
            )

        def slide(title: str, direction: Point, pin: Point) -> None:
            velocities = [frame.velocity(frame.local((pin.x - frame.x, pin.y - frame.y))) for frame in (parent_frame, body_frame)]
            rate = direction.dot(Point(velocities[1].x - velocities[0].x, velocities[1].y - velocities[0].y))
            hinges_and_slides.append(_TreeJoint(title, {"type": "slide", "axis": _in_space(body_frame.local(direction))}, rate))

        turning = body_frame.omega - parent_frame.omega
        if not joint_name:
            slide(f"{name}.x", Point(1.0, 0.0), Point(body_frame.x, body_frame.y))
            slide(f"{name}.y", Point(0.0, 1.0), Point(body_frame.x, body_frame.y))
            hinge(f"{name}.angle", Point(body_frame.x, body_frame.y), turning)
            return hinges_and_slides
        joint = self.mechanism.joints[joint_name]
        gap = float(np.max(np.abs(joint.residual(0.0, *(self.frames[body] for body in joint.bodies)))))
        if gap > OPEN_LOOP_TOL * max(self.size, 1.0):
            cure = "MJCF uses the initial positions as they are: close them with `udk.assemble`"
            self.problems.append(f"joint {quote(joint_name)}: is open by {gap:.3g} (m, rad), and {cure}")
        first, second = (self.frames[body] for body in joint.bodies)
        if isinstance(joint, Revolute):
            hinge(joint_name, body_frame.point(joint.points[joint.bodies.index(name)]), turning)
        elif isinstance(joint, Prismatic | Slot):
            pin, slide_axis = second.point(joint.points[1]), first.vector((float(np.cos(joint.axis)), float(np.sin(joint.axis))))
            slide(joint_name if isinstance(joint, Prismatic) else f"{joint_name}.slide", slide_axis, pin)
            if isinstance(joint, Slot):
                hinge(joint_name, pin, turning)
                hinges_and_slides = hinges_and_slides if name == joint.bodies[1] else hinges_and_slides[::-1]
        elif isinstance(joint, Distance):
            ends = [
                body_frame.point(joint.points[joint.bodies.index(name)]),
                parent_frame.point(joint.points[joint.bodies.index(parent)]),
            ]
            rod = Point(ends[0].x - ends[1].x, ends[0].y - ends[1].y)
            rates = [
                frame.velocity(joint.points[joint.bodies.index(body)])
                for frame, body in ((body_frame, name), (parent_frame, parent))
            ]
            spin = (rod.x * (rates[0].y - rates[1].y) - rod.y * (rates[0].x - rates[1].x)) / rod.dot(rod)
            hinge(f"{joint_name}.rod", ends[1], spin - parent_frame.omega)
            hinge(joint_name, ends[0], body_frame.omega - spin)
        elif isinstance(joint, Angle):
            slide(f"{joint_name}.x", Point(1.0, 0.0), Point(body_frame.x, body_frame.y))
            slide(f"{joint_name}.y", Point(0.0, 1.0), Point(body_frame.x, body_frame.y))
        return hinges_and_slides

    def _body_lines(self, name: str) -> list[str]:
        """Return the lines of a body, without its children and its end tag."""
        body, parent_frame, body_frame = self.mechanism.bodies[name], self.frames[self.tree[name].holder], self.frames[name]
        angle = body_frame.angle - parent_frame.angle
        position = _in_space(parent_frame.local((body_frame.x - parent_frame.x, body_frame.y - parent_frame.y)))
        inertia = _numbers(body.inertia, body.inertia, body.inertia)
        radius = 0.5 * BAR_THICKNESS * self.size
        points = [Point(*np.asarray(point).tolist()) for _, point in attachments(self.mechanism, name)]
        ends = {_in_space(point) for point in points if point.norm() > radius}
        look = {"mass": "0", "contype": "0", "conaffinity": "0", "size": _numbers(radius)}
        return [
            f"<body{_attributes(name=name, pos=position, axisangle=f'{PLANE_NORMAL} {_numbers(angle)}')}>",
            *(f"  <joint{_attributes(name=j.name, **j.attributes, **self._passive(j.name))}/>" for j in self.joints[name]),
            f"  <inertial{_attributes(pos='0 0 0', mass=_numbers(body.mass), diaginertia=inertia)}/>",
            *(f"  <geom{_attributes(type='capsule', fromto=f'0 0 0 {end}', **look)}/>" for end in sorted(ends)),
            *([] if ends else [f"  <geom{_attributes(**look)}/>"]),
            *(f"  <site{_attributes(**site)}/>" for site in self.sites[name]),
        ]

    def _passive(self, hinge: str) -> Attributes:
        return self.springs.get(hinge, {}) | self.losses.get(hinge, {})

    # --- loop closures and forces

    def _add_loop(self, name: str, joint: Constraint) -> None:
        section = self.sections["equality"]
        if isinstance(joint, Revolute | Weld):
            kind = "connect" if isinstance(joint, Revolute) else "weld"
            angle = float(joint.angle) if isinstance(joint, Weld) else 0.0  # of body 2 relative to body 1
            first_name, second_name = self._add_sites(name, joint.bodies, joint.points, angle)
            section.append(f"<{kind}{_attributes(name=name, site1=first_name, site2=second_name)}/>")
        elif isinstance(joint, Distance):
            tendon = self._add_spatial(name, joint.bodies, joint.points)
            offset = float(joint.length) - between(joint.points, *(self.frames[body] for body in joint.bodies)).norm()
            section.append(f"<tendon{_attributes(name=name, tendon1=tendon, polycoef=_numbers(offset, 0.0))}/>")
        elif isinstance(joint, Gear | Angle):
            first_name, second_name = joint.bodies
            if isinstance(joint, Gear):
                first, second = float(joint.radii[0]), float(joint.radii[1]) * (-1 if joint.internal else 1)
                factors, offset = {first_name: first, second_name: second, joint.carrier: -first - second}, 0.0
            else:
                factors = {second_name: 1.0, first_name: -1.0}
                offset = float(joint.angle - self.frames[second_name].angle + self.frames[first_name].angle)
            if tendon := self._add_fixed(name, self._hinges(factors), "joint"):
                section.append(f"<tendon{_attributes(name=name, tendon1=tendon, polycoef=_numbers(offset, 0.0))}/>")
        elif isinstance(joint, Screw | Coupling):
            self._add_coupling(name, joint)
        else:
            closes = " that closes a loop" if isinstance(joint, Slot | Prismatic) else ""
            self.problems.append(f"joint {quote(name)}: MJCF has no equality for a {type(joint).__name__.lower()}{closes}")

    def _add_coupling(self, name: str, joint: Screw | Coupling) -> None:
        """Add an equality: the coordinate of one joint of the tree is a polynomial of another's, from their initial positions.

        If the format cannot express the coupling, a problem is noted.
        """
        if isinstance(joint, Screw):
            sides = (joint.bodies, joint.axis, joint.points), (joint.turning, None, None)
            polynomial = np.polynomial.Polynomial([float(joint.constant), float(joint.lead) / (2 * np.pi)])
        else:
            sides = (joint.bodies, joint.axis, joint.points), (joint.to, joint.to_axis, joint.to_points)
            polynomial = np.polynomial.Polynomial(np.asarray(joint.coefficients))
        joint1, joint2 = (self._tree_joint(*side) for side in sides)
        if joint1 is None or joint2 is None or polynomial.degree() > 4:
            limit = "joints of its tree of bodies, by polynomials of degree 4 at most: one of its coordinates is no such joint"
            self.problems.append(f"joint {quote(name)}: MJCF couples {limit}, or the degree is higher")
            return
        (name1, sign1), (name2, sign2) = joint1, joint2
        y, x = (float(coordinate_of(a, points, *(self.frames[body] for body in bodies))) for bodies, a, points in sides)
        shifted = np.asarray(polynomial(np.polynomial.Polynomial([x, sign2])).coef, float)
        shifted[0] -= y
        coefficients = sign1 * shifted
        numbers = _numbers(*coefficients, *[0.0] * (5 - len(coefficients)))
        self.sections["equality"].append(f"<joint{_attributes(name=name, joint1=name1, joint2=name2, polycoef=numbers)}/>")

    def _tree_joint(
        self, bodies: Sequence[str], axis: Number | None, points: Array | np.ndarray | None
    ) -> tuple[str, float] | None:
        """Return the hinge or slide of the tree whose coordinate is a coordinate of two bodies, up to its sign, and the sign.

        The coordinate is a displacement along the axis, or the relative angle without one; None if no hinge or slide has it.
        """
        if axis is None:
            hinges = self._hinges({bodies[1]: 1.0, bodies[0]: -1.0})
            (hinge, weight), *further = [*hinges.items(), ("", 0.0)]
            return (hinge, weight) if len(further) == 1 and abs(weight) == 1 else None
        for body, sign in ((bodies[1], 1.0), (bodies[0], -1.0)):
            edge = self.tree.get(body)
            joint = self.mechanism.joints.get(edge.joint) if edge else None
            if edge is None or {edge.body, edge.holder} != set(bodies) or not isinstance(joint, Prismatic | Slot):
                continue
            directions = [self.frames[b].angle + float(a) for b, a in ((bodies[0], axis), (joint.bodies[0], joint.axis))]
            lengthwise = float(np.cos(directions[1] - directions[0]))
            same_point = joint.bodies == tuple(bodies) and points is not None and np.array_equal(points[1], joint.points[1])
            if abs(abs(lengthwise) - 1) <= ROUNDING_OF_SUMS and (isinstance(joint, Prismatic) or same_point):
                return (edge.joint if isinstance(joint, Prismatic) else f"{edge.joint}.slide"), sign * float(np.sign(lengthwise))
        return None

    def _add_force(self, name: str, force: Any) -> None:
        if any(isinstance(value, Held) for value in vars(force).values()):
            self.problems.append(
                f"force {quote(name)}: MJCF has no samples; give a number here, and pass the samples to MuJoCo as controls"
            )
        elif isinstance(force, Spring):
            attributes = {"springlength": _numbers(force.length), "stiffness": _numbers(force.stiffness)}
            self._add_spatial(name, force.bodies, force.points, **attributes, **_damping(force.damping))
        elif isinstance(force, TorsionSpring | Torque):
            self._add_turning(name, force)
        elif isinstance(force, Friction):
            self._add_friction(name, force)
        else:
            self.problems.append(f"force {quote(name)}: MJCF has no element for a {type(force).__name__.lower()}")

    def _add_friction(self, name: str, force: Friction) -> None:
        """Add friction to a hinge of the tree: in MuJoCo, this is a torque of constant size that also holds the hinge at rest."""
        hinges = [joint.name for joints in self.joints.values() for joint in joints]
        is_hinge = isinstance(self.mechanism.joints[force.joint], Revolute) and force.joint in hinges
        if force.coefficient is not None:
            self.problems.append(f"force {quote(name)}: MJCF has no friction that depends on the load of a joint")
        elif not force.sticks:
            self.problems.append(f'force {quote(name)}: friction in MJCF sticks: give it law="set-valued", without a velocity')
        elif not is_hinge:
            self.problems.append(f"force {quote(name)}: its joint closes a loop, and MJCF has friction in hinges only")
        else:  # the only friction of its joint: a scene has no second one beside friction that sticks
            self.losses[force.joint] = {"frictionloss": _numbers(force.torque)}

    def _add_turning(self, name: str, force: Any) -> None:
        """Add a torsion spring, or a torque, to the hinge between its bodies, or to a tendon over several hinges."""
        body1, body2 = force.bodies
        hinges = self._hinges({body2: 1.0, body1: -1.0})
        (hinge, sign), *further = [*hinges.items(), ("", 0.0)]
        is_single = len(further) == 1 and abs(sign) == 1
        if (value := getattr(force, "value", None)) is not None:  # a torque
            tendon = "" if is_single else self._add_fixed(name, hinges, "force")
            target = {"joint": hinge, "gear": _numbers(sign)} if is_single else {"tendon": tendon}
            if is_single or tendon:
                self.sections["actuator"].append(f"<motor{_attributes(name=name, **target)}/>")
                self.controls.append(float(value))
            return
        free_angle = float(force.angle - self.frames[body2].angle + self.frames[body1].angle)
        spring = {"stiffness": _numbers(force.stiffness)} | _damping(force.damping)
        if is_single and hinge not in self.springs:
            self.springs[hinge] = {"springref": _numbers(sign * free_angle), **spring}
        else:
            direction = -1.0 if free_angle < 0 else 1.0  # a springlength of -1 means the length in the position of the file
            factors = {joint: direction * factor for joint, factor in hinges.items()}
            self._add_fixed(name, factors, "force", springlength=_numbers(abs(free_angle)), **spring)

    def _hinges(self, factors: dict[str, float]) -> dict[str, float]:
        """Return a weighted sum of angles of bodies as a weighted sum of angles of hinges: the weights by hinge."""
        hinges: dict[str, float] = {}
        for body, factor in factors.items():
            for hinge, weight in self.turns[body].items():
                hinges[hinge] = hinges.get(hinge, 0.0) + factor * weight
        threshold = ROUNDING_OF_SUMS * max(map(abs, hinges.values()), default=0.0)
        return {hinge: weight for hinge, weight in hinges.items() if abs(weight) > threshold}

    def _add_fixed(self, name: str, hinges: dict[str, float], kind: str, **attributes: str) -> str:
        """Add a tendon that is a sum of hinges; return its name, or an empty string if the sum is empty."""
        if not hinges:
            self.problems.append(
                f"{kind} {quote(name)}: its bodies do not turn against each other, and MJCF only has the angles of hinges"
            )
            return ""
        title = self._unique(name)
        joint_tags = "".join(f"<joint{_attributes(joint=hinge, coef=_numbers(factor))}/>" for hinge, factor in hinges.items())
        self.sections["tendon"].append(f"<fixed{_attributes(name=title, **attributes)}>{joint_tags}</fixed>")
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
            orientation = {"axisangle": f"{PLANE_NORMAL} {_numbers(turn)}"} if turn else {}
            self.sites[body].append({"name": title, "pos": _in_space(Point(*point.tolist())), **orientation})
        return titles

    def _unique(self, name: str) -> str:
        unique = unique_name(name, self.taken)
        self.taken.add(unique)
        return unique


def _damping(value: object) -> Attributes:
    return {} if value is None else {"damping": _numbers(value)}


def _in_space(point: Point) -> str:
    return _numbers(point.x, 0.0, point.y)


def _numbers(*values: object) -> str:
    """Return numbers as text that reads back as the same numbers."""
    return " ".join(repr(float(value)) for value in values)  # pyright: ignore[reportArgumentType]


def _attributes(**values: str) -> str:
    return "".join(f" {name}={quoteattr(value)}" for name, value in values.items())
