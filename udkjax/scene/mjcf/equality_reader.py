"""Equalities of an MJCF model as joints: connect, weld, fixed angles and distances, and coupled joints."""

from collections.abc import Mapping

import numpy as np

from udkjax.scene.elements.couplings import Coupling, Gear
from udkjax.scene.elements.joints import Angle, Distance, Joint, Revolute, Weld
from udkjax.scene.mjcf.body_tree import unique_name
from udkjax.scene.mjcf.coupled_lengths import CoupledLength, CoupledLengths
from udkjax.scene.mjcf.model_settings import merge_parts
from udkjax.scene.mjcf.plane_model import AXES_TOL, Ends, PlaneMotion
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement

DEFAULT_POLYNOMIAL = (0.0, 1.0, 0.0, 0.0, 0.0)  # of a polycoef that is not given
MESHING_TOL = 1e-9  # rad, times the largest factor: rounding error of the angles of gears that mesh in the initial state


class EqualityReader:
    """A reader of the equalities of a model, whose attribute `joints` has the joints that represent them, by name.

    `motions` are the motions of bodies in the initial state; `taken` are the names of the other joints of the mechanism.
    """

    def __init__(self, root: XmlElement, lengths: CoupledLengths, motions: Mapping[int, PlaneMotion], taken: list[str]):
        self.lengths, self.model, self._motions, self._taken = lengths, lengths.model, motions, taken
        self.joints: dict[str, Joint] = {}
        kinds = {"connect": self._add_connect, "weld": self._add_weld, "joint": self._add_joint, "tendon": self._add_tendon}
        for element in merge_parts(root, ("equality",)).children:
            read = self.model.tree.settings.read(element, section="equality")
            if (
                "equality" not in self.model.tree.settings.disabled
                and element.tag in kinds
                and read.choice("active", ("true", "false"), "true") == "true"
            ):
                kinds[element.tag](read)

    def _add_connect(self, read: AttributeReader) -> None:
        ends, _ = self._attachment(read, "body1")
        self._put_joint(read, ends, Revolute(*self.model.attached(ends)))

    def _add_weld(self, read: AttributeReader) -> None:
        ends, rotation = self._attachment(read, "body2")
        if not read.number("torquescale", 1.0):
            read.refuse("with a torquescale of 0 it acts as a <connect>: write a <connect>")
        normal = self.model.plane.normal
        if np.linalg.norm(rotation @ normal - normal) > AXES_TOL:
            read.refuse("turns its bodies out of the plane of the motion")
        angle = self.model.relative_angle(*ends.bodies) + float(
            np.angle(self.model.plane.flat(rotation @ self.model.plane.across))
        )
        self._put_joint(read, ends, Weld(*self.model.attached(ends), angle))

    def _attachment(self, read: AttributeReader, anchored: str) -> tuple[Ends, np.ndarray]:
        """Return the points that an equality joins, and the rotation (3, 3) of body 2 from its position in the file.

        `anchored` is the body in whose frame MJCF gives the anchor: "body1" or "body2".
        """
        tree, rotation = self.model.tree, np.eye(3)
        if "site1" in read or "site2" in read:
            located = [tree.find(read, f"site{k}", tree.sites, "site") or (0, tree.bodies[0].frame) for k in (1, 2)]
            (body1, frame1), (body2, frame2) = located
            points, rotation = (frame1.origin, frame2.origin), frame1.axes @ frame2.axes.T
        else:
            body1, body2 = tree.index_of(read, "body1", ""), tree.index_of(read, "body2")
            frames = {"body1": tree.bodies[body1].frame, "body2": tree.bodies[body2].frame}
            anchor = frames[anchored].point(read.numbers("anchor", (0.0, 0.0, 0.0)))
            points = anchor, anchor
            pose = read.numbers("relpose", (0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            if pose[3:].any():
                values = {"pos": " ".join(map(repr, pose[:3].tolist())), "quat": " ".join(map(repr, pose[3:].tolist()))}
                wanted = frames["body1"].within(self.model.tree.settings.frame(AttributeReader(read.element, values, [])))
                points, rotation = (wanted.origin, anchor), wanted.axes @ frames["body2"].axes.T
        if abs((points[1] - points[0]) @ self.model.plane.normal) > AXES_TOL * self.model.size:
            read.refuse("its two points are not at one height above the plane of the motion")
        if tree.hosts[body1] == tree.hosts[body2]:
            read.refuse("connects a body to itself")
        flat = self.model.plane.flat(points[0]), self.model.plane.flat(points[1])
        return Ends((tree.hosts[body1], tree.hosts[body2]), flat), rotation

    def _add_joint(self, read: AttributeReader) -> None:
        coefficients = read.numbers("polycoef", DEFAULT_POLYNOMIAL, fewest=1)
        length1 = self.lengths.named_joint(read, "joint1")
        length2 = self.lengths.named_joint(read, "joint2") if "joint2" in read else None
        if not length1 or ("joint2" in read and not length2):
            return  # refused
        turns = bool(length1.angles) and (length2 is None or bool(length2.angles))
        if turns and (length2 is None or not coefficients[2:].any()):
            offset, slope = coefficients[:2] if length2 else (coefficients[0], 0.0)
            terms = [(length1, 1.0)] if length2 is None else [(length1, 1.0), (length2, -float(slope))]
            total = self.lengths.sum_lengths(terms, read)
            if total is None or len(total.angles) == 2 or self._is_in_mesh(total, offset):
                self._hold(read, total, float(offset))
                return
        self._couple(read, length1, length2, coefficients)

    def _couple(
        self, read: AttributeReader, length1: CoupledLength, length2: CoupledLength | None, polynomial: np.ndarray
    ) -> None:
        """Add the joint that makes one joint coordinate a polynomial of another, both relative to their values in the file.

        Without a second joint coordinate, only the constant of the polynomial is used.
        """
        y = self.lengths.between_bodies(length1)
        x = y if length2 is None else self.lengths.between_bodies(length2)  # of a constant, x may be any coordinate
        if y is None or x is None:
            read.refuse(
                "couples one of two hinges of a body, or a slide of a body with oblique slides, or with a hinge between them: "
                "not supported"
            )
            return
        powers = polynomial * x.factor ** np.arange(len(polynomial)) if length2 else polynomial[:1]
        coefficients = np.polynomial.Polynomial(powers / y.factor)(np.polynomial.Polynomial([-x.start, 1.0])).coef
        coefficients[0] += y.start
        names = self.model.names
        joint = Coupling(names(y.bodies), names(x.bodies), np.trim_zeros(coefficients, "b"), y.axis, x.axis, y.points, x.points)
        self.joints[self._joint_name(read)] = joint

    def _add_tendon(self, read: AttributeReader) -> None:
        if "tendon2" in read:
            read.refuse("couples two tendons: not supported")
        offset = read.numbers("polycoef", DEFAULT_POLYNOMIAL, fewest=1)[0]
        self._hold(read, self.lengths.named_tendon(read, "tendon1"), float(offset))

    def _is_in_mesh(self, length: CoupledLength, offset: float) -> bool:
        """Return True if the initial state satisfies an equality of angles, so that gears can start in mesh."""
        mismatch = sum(factor * self._motions[body].angle for body, factor in length.angles.items())
        return len(length.angles) == 3 and not offset and abs(mismatch) <= MESHING_TOL * max(map(abs, length.angles.values()))

    def _hold(self, read: AttributeReader, length: CoupledLength | None, offset: float) -> None:
        """Add the joint that fixes a length at its value in the file plus an offset."""
        if length is None:
            return
        angles = length.angles
        if length.ends:
            self._put_joint(read, length.ends, Distance(*self.model.attached(length.ends), length.ends.distance + offset))
        elif len(angles) == 2:
            (body1, _), (body2, factor) = angles.items()
            angle = self.model.relative_angle(body1, body2) + offset / factor
            self.joints[self._joint_name(read)] = Angle(self.model.names((body1, body2)), angle)
        elif len(angles) == 3:
            if not self._is_in_mesh(length, offset):
                read.refuse(
                    "is not satisfied in the initial state, and gears start in mesh: change the ref or the key of a joint"
                )
            # The three factors add up to zero, and any body may be the carrier: choose the ground, or the largest factor.
            carrier = 0 if 0 in angles else max(angles, key=lambda body: abs(angles[body]))
            body1, body2 = (body for body in angles if body != carrier)
            radii, internal = (abs(angles[body1]), abs(angles[body2])), angles[body1] * angles[body2] < 0
            self.joints[self._joint_name(read)] = Gear(
                self.model.names((body1, body2)), radii, internal, self.model.names((carrier,))[0]
            )
        else:
            read.refuse("holds a slide, or couples more than three bodies: not supported")

    def _put_joint(self, read: AttributeReader, ends: Ends, joint: Joint) -> None:
        self.joints[self._joint_name(read, "-".join(self.model.names(ends.bodies)))] = joint

    def _joint_name(self, read: AttributeReader, default: str = "") -> str:
        return unique_name(read.text("name") or default or read.element.tag, {*self.joints, *self._taken})
