"""Spanning trees of a mechanism: joints by which every body is reached from the ground, each once."""

from collections.abc import Iterator, Mapping
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple

from udkjax.scene.bodies import GROUND
from udkjax.scene.mechanism import Mechanism


class TreeEdge(NamedTuple):
    """A body, and the holder that it hangs on by a joint; without a joint it is a root of its own, beside the ground."""

    body: str
    holder: str
    joint: str


def spanning_tree(mechanism: Mechanism, weights: Mapping[str, int]) -> Iterator[TreeEdge]:
    """Iterate over the bodies from the ground on, holders before what hangs on them (Prim's algorithm).

    Args:
        mechanism: The scene.
        weights: The joints that may be taken, by name: the least first, and of one weight those nearest to the ground.

    Returns:
        A tree of least weight.
    """
    neighbours: dict[str, list[tuple[int, str, str]]] = {name: [] for name in (GROUND, *mechanism.body_names)}
    for joint, weight in weights.items():
        one, two = mechanism.joints[joint].bodies
        neighbours[one].append((weight, two, joint))
        neighbours[two].append((weight, one, joint))
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
            for weight, other, joint in neighbours[edge.body]:
                heappush(pending, (weight, next(order), TreeEdge(other, edge.body, joint)))
