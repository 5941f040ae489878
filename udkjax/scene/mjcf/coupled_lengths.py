"""Coordinates of an MJCF model on which springs, motors and equalities act: joint coordinates and tendon lengths."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from udkjax.scene.mjcf.body_tree import TreeJoint, unique_name
from udkjax.scene.mjcf.model_settings import merge_parts
from udkjax.scene.mjcf.plane_model import AXES_TOL, Ends, Pair, PlaneModel, gap_of
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement

ROUNDING_OF_SUMS = 1e-12  # relative to the largest term: smaller sums of angles are rounding errors


class CoupledLength(NamedTuple):
    """A coordinate on which springs, motors and equalities act: a joint coordinate or a tendon length.

    It is a weighted sum of angles of bodies, a slide, or the distance between two points. Negative indices of bodies stand
    for massless rods, whose angles are not coordinates.
    """

    length: float  # rad or m, in the position of the file
    at_rest: float  # rad or m, where its springs are unloaded
    angles: Mapping[int, float] = {}
    slide: TreeJoint | None = None
    ends: Ends | None = None


class BodyCoordinate(NamedTuple):
    """A joint coordinate as a coordinate of two bodies: a relative angle, or a displacement along an axis.

    The change of the joint coordinate from its value in the file is `factor` times that of the coordinate from `start`.
    """

    bodies: tuple[int, int]
    start: float  # rad or m, the relative angle or displacement in the position of the file
    factor: float
    axis: float | None = None  # rad, in the frame of the first body; None: an angle
    points: list[Pair] | None = None  # m


class CoupledLengths:
    """The coordinates of `joints` and `tendons` by name; None for a tendon that was refused."""

    def __init__(self, root: XmlElement, model: PlaneModel):
        self.model, self.settings = model, model.tree.settings
        self.joints = {joint.name: self._joint_length(joint) for joint in model.joints}
        self.tendons: dict[str, CoupledLength | None] = {}
        self.tendon_attributes: dict[str, AttributeReader] = {}
        for element in merge_parts(root, ("tendon",)).children:
            if element.tag in ("fixed", "spatial"):
                read = self.settings.read(element, section="tendon")
                name = unique_name(read.text("name") or element.tag, self.tendons)
                self.tendons[name], self.tendon_attributes[name] = self._tendon_length(read), read

    def named_joint(self, read: AttributeReader, attribute: str) -> CoupledLength | None:
        """Return the coordinate of the joint that an attribute names; if it does not exist, refuse it and return None."""
        return self.model.tree.find(read, attribute, self.joints, "joint")

    def named_tendon(self, read: AttributeReader, attribute: str) -> CoupledLength | None:
        """Return the length of the tendon that an attribute names; if it does not exist, refuse it and return None."""
        return self.model.tree.find(read, attribute, self.tendons, "tendon")

    def _joint_length(self, joint: TreeJoint) -> CoupledLength:
        lengths = self.model.reference(joint), self.model.reference(joint, "springref")
        if joint.kind == "slide":
            return CoupledLength(*lengths, slide=joint)
        sign, body, holder = self.model.sign(joint), joint.body, self.model.holder(joint.body)
        if self.model.has_rod(body):  # indexed by the negative index of the body
            holder, body = (holder, -body) if joint is self.model.tree.bodies[body].joints[0] else (-body, body)
        return CoupledLength(*lengths, angles={holder: -sign, body: sign})

    def _tendon_length(self, read: AttributeReader) -> CoupledLength | None:
        readers = [AttributeReader(child, child.attributes, self.settings.problems) for child in read.element.children]
        if read.element.tag == "fixed":
            terms = [(self.named_joint(reader, "joint"), reader.number("coef")) for reader in readers]
            length = self.sum_lengths([(joint, coef) for joint, coef in terms if joint], read)
        else:
            length = self._distance(readers, read)
        given = read.numbers("springlength", (-1.0, -1.0), fewest=1)
        if "springlength" in read and len(read.text("springlength").split()) == 2 and given[1] > given[0]:
            read.refuse("a springlength of two different values, between which a tendon is slack, is not supported")
        return length if length is None or given[0] == -1 else length._replace(at_rest=float(given[0]))

    def _distance(self, sites: list[AttributeReader], read: AttributeReader) -> CoupledLength | None:
        ends = self._ends(sites, read)
        if ends is None:
            return None
        at_rest = {joint.name: self.model.reference(joint, "springref") for joint in self.model.joints}
        return CoupledLength(ends.distance, gap_of(ends, self.model.motions(at_rest, {})), ends=ends)

    def _ends(self, sites: list[AttributeReader], read: AttributeReader) -> Ends | None:
        if [site.element.tag for site in sites] != ["site", "site"]:
            read.refuse("a spatial tendon between two sites is a spring; over more sites, geoms or pulleys it is not supported")
            return None
        known = self.model.tree.sites
        located = [known[site.text("site")] for site in sites if self.model.tree.find(site, "site", known, "site")]
        if len(located) < 2:
            return None
        (body1, frame1), (body2, frame2) = located
        if abs((frame2.origin - frame1.origin) @ self.model.plane.normal) > AXES_TOL * self.model.size:
            read.refuse("its sites are not at one height above the plane of the motion")
        hosts = self.model.tree.hosts
        return Ends((hosts[body1], hosts[body2]), (self.model.plane.flat(frame1.origin), self.model.plane.flat(frame2.origin)))

    def between_bodies(self, length: CoupledLength) -> BodyCoordinate | None:
        """Return a joint coordinate as a coordinate of two bodies; None if it is neither a relative angle nor a displacement."""
        if length.slide is not None:
            return self._slide_between_bodies(length.slide)
        if len(length.angles) != 2 or min(length.angles) < 0:
            return None
        (body1, _), (body2, factor) = length.angles.items()
        return BodyCoordinate((body1, body2), self.model.relative_angle(body1, body2), factor)

    def _slide_between_bodies(self, slide: TreeJoint) -> BodyCoordinate | None:
        body, model = slide.body, self.model
        joints, holder = model.tree.bodies[body].joints, model.holder(body)
        kinds = "".join(joint.kind[0] for joint in joints)
        axes = [model.plane.flat(joint.axis) for joint in joints if joint.kind == "slide"]
        oblique = len(axes) == 2 and abs((axes[0] * np.conj(axes[1])).real) > AXES_TOL
        if kinds.strip("h").strip("s") or oblique:  # slides on both sides of the hinge, or not measured by projections
            return None
        pin = model.plane.flat(next((joint for joint in joints if joint.kind == "hinge"), slide).anchor)
        axis, bodies = model.plane.flat(slide.axis), (holder, body)
        if kinds.startswith("h"):  # its axis turns with the body
            axis, bodies = -axis, (body, holder)
        points = [model.local(k, pin) for k in bodies]
        return BodyCoordinate(bodies, 0.0, 1.0, model.direction(bodies[0], axis), points)

    def sum_lengths(self, terms: list[tuple[CoupledLength, float]], read: AttributeReader) -> CoupledLength | None:
        """Return a weighted sum of coordinates; refuse it and return None if it couples slides, or a body with two hinges."""
        if not all(term.angles for term, _ in terms):
            if len(terms) == 1 and terms[0][1] == 1.0:
                return terms[0][0]
            read.refuse("couples slides: not supported")
            return None
        angles: dict[int, float] = {}
        for term, factor in terms:
            for body, coefficient in term.angles.items():
                angles[body] = angles.get(body, 0.0) + factor * coefficient
        largest = max(map(abs, angles.values()), default=0.0)
        angles = {
            body: coefficient for body, coefficient in sorted(angles.items()) if abs(coefficient) > ROUNDING_OF_SUMS * largest
        }
        length, at_rest = (sum(factor * getattr(term, name) for term, factor in terms) for name in ("length", "at_rest"))
        if min(angles, default=0) < 0:
            read.refuse("couples one of the two hinges of a body: not supported")
            return None
        return CoupledLength(length, at_rest, angles)
