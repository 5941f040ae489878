"""Spanning trees of a mechanism: joints by which each body is reached from the ground exactly once."""

from collections.abc import Iterator, Mapping
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple

from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism


class TreeEdge(NamedTuple):
    """A body, its holder (parent) and the joint between them; if `joint` is "", the body is a root, like the ground."""

    body: str
    holder: str
    joint: str


def spanning_tree(mechanism: Mechanism, weights: Mapping[str, int]) -> Iterator[TreeEdge]:
    """Iterate over the bodies from the ground on, holders first (Prim's algorithm).

    Args:
        mechanism: The scene.
        weights: The weights of the joints that may be used, by name; ties go to the joint nearest to the ground.

    Returns:
        A spanning tree of minimum weight.
    """
    neighbours: dict[str, list[tuple[int, str, str]]] = {name: [] for name in (GROUND, *mechanism.body_names)}
    for joint, weight in weights.items():
        body1, body2 = mechanism.joints[joint].bodies
        neighbours[body1].append((weight, body2, joint))
        neighbours[body2].append((weight, body1, joint))
    reached, order = set[str](), count()
    for root in neighbours:
        pending = [(0, next(order), TreeEdge(root, GROUND, ""))]
        while pending:
            edge = heappop(pending)[-1]
            if edge.body in reached:
                continue
            reached.add(edge.body)
            if edge.body != GROUND:
                yield edge
            for weight, neighbour, joint in neighbours[edge.body]:
                heappush(pending, (weight, next(order), TreeEdge(neighbour, edge.body, joint)))
