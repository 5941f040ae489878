"""Pairs of geoms of an MJCF model that may touch each other when it moves."""

from itertools import combinations

from udkjax.scene.mjcf.body_tree import BodyTree, TreeGeom
from udkjax.scene.mjcf.model_settings import merge_parts
from udkjax.scene.mjcf.motion_plane import MotionPlane
from udkjax.scene.mjcf.xml_tree import XmlElement


def contact_pairs(root: XmlElement, tree: BodyTree, plane: MotionPlane) -> list[str]:
    """Return the pairs of geoms that MuJoCo looks for contacts between, in words.

    Left out are those of one body, of a body and what it hangs on, of bodies that are excluded, those that nothing moves, and
    spheres around them that stay beside each other, above and below the plane of the motion.
    """
    parts = merge_parts(root, ("contact",)).children
    excluded = [{part.attributes.get("body1", ""), part.attributes.get("body2", "")} for part in parts if part.tag == "exclude"]
    found = [f"{p.attributes.get('geom1')} and {p.attributes.get('geom2')}" for p in parts if p.tag == "pair"]
    for one, two in combinations(tree.geoms, 2):
        a, b = tree.hosts[one.body], tree.hosts[two.body]
        hangs = b and a == tree.hosts[tree.bodies[b].parent], a and b == tree.hosts[tree.bodies[a].parent]
        beside = abs((one.centre - two.centre) @ plane.normal) > one.reach + two.reach
        names = {tree.bodies[one.body].name, tree.bodies[two.body].name}
        if a != b and not (a and b and any(hangs)) and _match(one, two) and not beside and names not in excluded:
            found.append(f"{one.name} and {two.name}")
    return found


def _match(one: TreeGeom, two: TreeGeom) -> bool:
    return bool(one.types[0] & two.types[1] or two.types[0] & one.types[1])
