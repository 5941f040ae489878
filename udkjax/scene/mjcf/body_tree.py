"""The tree of bodies of an MJCF model in space, in the position of the file."""

from collections.abc import Container, Iterator
from itertools import count
from typing import NamedTuple

import numpy as np

from udkjax.scene.mjcf.geom_masses import SpaceMass, geom_mass, geom_shape, inertial_mass
from udkjax.scene.mjcf.model_settings import MAIN_CLASS, ModelSettings
from udkjax.scene.mjcf.orientations import WORLD_FRAME, SpaceFrame
from udkjax.scene.mjcf.xml_tree import AttributeReader, XmlElement
from udkjax.wording import quote, suggestion

JOINT_TYPES = ("hinge", "slide")


class TreeJoint(NamedTuple):
    """A hinge or a slide of the body with index `body`."""

    name: str
    kind: str
    body: int
    axis: np.ndarray  # (3,) unit vector, in world coordinates
    anchor: np.ndarray  # (3,) m, in world coordinates
    read: AttributeReader


class TreeGeom(NamedTuple):
    """The properties of a geom that matter for contacts."""

    name: str
    body: int
    types: tuple[int, int]  # contype, conaffinity
    centre: np.ndarray  # (3,) m
    reach: float  # m, radius of the bounding sphere


def unique_name(name: str, taken: Container[str]) -> str:
    """Return a name, with a number appended ("arm-2") if it is taken."""
    return next(candidate for k in count(1) if (candidate := name if k == 1 else f"{name}-{k}") not in taken)


class TreeBody:
    """A body: its frame in the world, its joints in order, its masses. Body 0 is the world."""

    def __init__(self, name: str, parent: int, frame: SpaceFrame, where: str):
        self.name, self.parent, self.frame, self.where = name, parent, frame, where
        self.joints: list[TreeJoint] = []
        self.given: list[SpaceMass] = []  # from <inertial>
        self.geoms: list[tuple[AttributeReader, str, np.ndarray, SpaceFrame]] = []  # with kinds, sizes and frames


class BodyTree:
    """Bodies, joints, sites and geoms of a model, by name, in the order of the file."""

    def __init__(self, root: XmlElement, settings: ModelSettings):
        self.settings = settings
        self.bodies = [TreeBody("world", 0, WORLD_FRAME, "<worldbody>")]
        self.sites: dict[str, tuple[int, SpaceFrame]] = {}
        self.geoms: list[TreeGeom] = []
        self.joints: dict[str, TreeJoint] = {}
        self._index = {"world": 0}
        pending = [
            (child, 0, WORLD_FRAME, MAIN_CLASS) for world in root.children if world.tag == "worldbody" for child in world.children
        ]
        pending.reverse()
        while pending:
            element, body, frame, childclass = pending.pop()
            if element.tag in ("body", "frame"):
                read = AttributeReader(element, element.attributes, settings.problems)
                frame = frame.within(settings.frame(read))
                childclass = read.text("childclass", childclass)
                body = self._add_body(element, body, frame) if element.tag == "body" else body
                pending.extend((child, body, frame, childclass) for child in reversed(element.children))
            elif element.tag in ("inertial", "joint", "site", "geom"):
                read = settings.read(element, childclass)
                getattr(self, f"_add_{element.tag}")(read, body, frame)
        self.hosts = self._hosts()

    def index_of(self, read: AttributeReader, attribute: str, default: str = "world") -> int:
        """Return the index of the body that an attribute names; for an unknown name, refuse the attribute and return 0."""
        return self.find(read, attribute, self._index, "body", default) or 0

    def find(self, read: AttributeReader, attribute: str, known: dict, what: str, default: str = ""):
        """Return the object in `known` whose name an attribute gives; if there is none, refuse the attribute and return None.

        `what` is the noun for such objects in messages.
        """
        name = read.text(attribute, default)
        if name not in known:
            read.refuse(f"{attribute}={quote(name)}: no {what} has this name{suggestion(name, known)}")
        return known.get(name)

    def masses_of(self, host: int) -> list[SpaceMass]:
        """Return the masses of the body with index `host` and of the bodies fixed to it."""
        chosen, (low, high) = self.settings.mass_from_geoms, self.settings.mass_groups
        masses: list[SpaceMass] = []
        for body in (body for k, body in enumerate(self.bodies) if k and self.hosts[k] == host):
            if chosen == "false" or (chosen == "auto" and body.given):
                masses += body.given
            else:
                shapes = [shape for shape in body.geoms if low <= shape[0].number("group") <= high]
                masses += [mass for mass in (geom_mass(*shape) for shape in shapes) if mass]
        return masses

    def moving(self) -> Iterator[tuple[int, TreeBody]]:
        """Iterate over the bodies that have joints, with their indices."""
        yield from ((k, body) for k, body in enumerate(self.bodies) if body.joints)

    def _hosts(self) -> list[int]:
        """Return the index of the body to which each body is fixed: itself if it has joints, else its parent's."""
        hosts = [0]
        for k, body in enumerate(self.bodies[1:], 1):
            hosts.append(k if body.joints else hosts[body.parent])
        return hosts

    def _add_body(self, element: XmlElement, parent: int, frame: SpaceFrame) -> int:
        name = element.attributes.get("name") or f"body{len(self.bodies)}"
        if self._index.setdefault(name, len(self.bodies)) < len(self.bodies):
            self.settings.problems.append(f"{element.where}: another body has this name")
        self.bodies.append(TreeBody(name, parent, frame, element.where))
        return len(self.bodies) - 1

    def _add_inertial(self, read: AttributeReader, body: int, frame: SpaceFrame) -> None:
        if self.bodies[body].given:
            read.refuse("the body has another one")
        self.bodies[body].given.append(inertial_mass(read, frame.within(self.settings.frame(read))))

    def _add_joint(self, read: AttributeReader, body: int, frame: SpaceFrame) -> None:
        kind = read.text("type", "hinge")
        axis = frame.axes @ read.numbers("axis", (0.0, 0.0, 1.0))
        size = float(np.linalg.norm(axis))
        if kind not in JOINT_TYPES:
            cure = "; a free planar body has two slides and a hinge" if kind == "free" else ""
            read.refuse(f"a {kind} joint does not stay in a plane{cure}")
        elif not body:
            read.refuse("the world has no joints")
        elif not size:
            read.refuse("its axis has no direction")
        else:
            name = read.text("name") or unique_name(self.bodies[body].name, self.joints)
            if name in self.joints:
                read.refuse("another joint has this name")
            anchor = frame.point(read.numbers("pos", (0.0, 0.0, 0.0)))
            self.joints[name] = TreeJoint(name, kind, body, axis / size, anchor, read)
            self.bodies[body].joints.append(self.joints[name])

    def _add_site(self, read: AttributeReader, body: int, frame: SpaceFrame) -> None:
        site_frame = self.settings.frame(read)
        if "fromto" in read:
            site_frame = site_frame._replace(origin=read.numbers("fromto", np.zeros(6)).reshape(2, 3).mean(axis=0))
        self.sites[read.text("name")] = body, frame.within(site_frame)

    def _add_geom(self, read: AttributeReader, body: int, frame: SpaceFrame) -> None:
        inside = frame if "fromto" in read else frame.within(self.settings.frame(read))
        kind, size, geom_frame = geom_shape(read, inside)
        self.bodies[body].geoms.append((read, kind, size, geom_frame))
        reach = float(np.linalg.norm(size)) if kind in ("box", "ellipsoid", "cylinder") else float(np.sum(size[:2]))
        types = int(read.number("contype", 1)), int(read.number("conaffinity", 1))
        name = read.text("name") or f"{kind} (line {read.element.line})"
        self.geoms.append(TreeGeom(name, body, types, geom_frame.origin, reach if np.any(size) else np.inf))
