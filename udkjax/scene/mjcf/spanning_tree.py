"""The joints of a mechanism that make a tree of its bodies; the others close loops."""

from udkjax.scene.bodies import GROUND
from udkjax.scene.joints import Angle, Distance, Prismatic, Revolute, Slot, Weld
from udkjax.scene.mechanism import Mechanism

IN_TREE = ((Weld, Prismatic, Slot), (Revolute,), (Distance,), (Angle,))  # what no equality can express comes before the others


def spanning_tree(mechanism: Mechanism) -> tuple[dict[str, str], dict[str, str]]:
    """Return the body on which each hangs, from the ground on, and the joint by which; without one it is free on the ground."""
    groups, edges = {name: name for name in (GROUND, *mechanism.body_names)}, dict[str, list[tuple[str, str]]]()

    def group(name: str) -> str:
        while groups[name] != name:
            name = groups[name]
        return name

    for kinds in IN_TREE:
        for name, joint in mechanism.joints.items():
            if isinstance(joint, kinds) and group(joint.bodies[0]) != group(joint.bodies[1]):
                one, two = joint.bodies
                groups[group(one)] = group(two)
                edges.setdefault(one, []).append((two, name))
                edges.setdefault(two, []).append((one, name))
    parents, holders = dict[str, str](), dict[str, str]()
    for root in (GROUND, *mechanism.body_names):
        reached = [] if root in parents else [root]
        if reached and root != GROUND:
            parents[root] = GROUND
        for name in reached:  # grows while it is gone through
            for other, joint in edges.get(name, []):
                if other != GROUND and other not in parents:
                    parents[other], holders[other] = name, joint
                    reached.append(other)
    return parents, holders
