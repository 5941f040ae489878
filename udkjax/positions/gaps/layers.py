"""`layers`: the fewest layers (parallel planes) in which the links of a mechanism move without hitting each other."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Bool, Float

from udkjax.argument_types import BY_NAME, HISTORY
from udkjax.positions.assembling.channels import StateHistory
from udkjax.positions.following.drive import Drive
from udkjax.positions.gaps.gaps import RANGE, gaps
from udkjax.positions.gaps.pairs import LinkPair, joined_pairs
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism

MOST_EXACT = 20  # links up to which no smaller number of layers is possible


class Layers(PrintsTable):
    """Layers of links in which no two links of one layer hit each other.

    Attributes:
        of: the layer of each link, from 0.
        conflicts: the pairs of links that cannot be in one layer, because they share a joint or hit each other.
        is_least: whether it is proven that no smaller number of layers is possible.
    """

    of: dict[str, int] = eqx.field(static=True)
    conflicts: tuple[LinkPair, ...] = eqx.field(static=True)
    is_least: bool = eqx.field(static=True)

    @property
    def count(self) -> int:
        """The number of layers."""
        return 1 + max(self.of.values())

    def _table(self) -> PrintedTable:
        rows = [(k, ", ".join(name for name, layer in self.of.items() if layer == k)) for k in range(self.count)]
        word = "fewest layers" if self.is_least else "layers; fewer may be enough"
        return PrintedTable(f"{self.count} {word}", rows)


@checked
@concrete_only()
def layers(
    mechanism: Mechanism,
    drive: Drive = None,
    values: Annotated[Float[ArrayLike, "T"] | Sequence[float], RANGE] | None = None,
    run: Annotated[StateHistory, HISTORY] | None = None,
    shapes: Annotated[Mapping[str, Any], BY_NAME] | None = None,
) -> Layers:
    """Return the fewest layers of links in which nothing hits anything over a motion.

    Links that share a joint are in different layers, and so are links that touch anywhere in the motion (`gaps`): the layers are
    the colours of the graph of these conflicts. Up to 20 links, branch and bound finds the smallest number of layers; for more
    links, a greedy colouring (DSATUR) finds a number that may not be the smallest.

    Args:
        mechanism: the mechanism; its numbers are not traced.
        drive: a driver or coordinate, as for `gaps`.
        values: values of the driver (rad, m), which moves from the least to the largest of them, as for `gaps`.
        run: a `Solution` or `Kinematics`, instead of a driver.
        shapes: outlines by link or "ground", as for `gaps`.

    Returns:
        A `Layers`; with its attribute `of` as the argument `layers`, `gaps` finds no contact.

    Raises:
        SceneError: as `gaps`.
    """
    names = [*mechanism.body_names, *([GROUND] if GROUND in (shapes or {}) else [])]
    joined = joined_pairs(mechanism)
    conflicts = [pair for pair in combinations(names, 2) if pair in joined]
    if len(conflicts) < len(names) * (len(names) - 1) // 2:
        found = gaps(mechanism, drive, values=values, run=run, shapes=shapes)
        conflicts += [gap.pair for gap in found.pairs if float(gap.distance) <= 0]
    hits = np.zeros((len(names), len(names)), bool)
    for one, other in conflicts:
        i, j = names.index(one), names.index(other)
        hits[i, j] = hits[j, i] = True
    is_least = len(names) <= MOST_EXACT
    colours = colouring(hits, is_least)
    return Layers(dict(zip(names, colours, strict=True)), tuple(conflicts), is_least)


def colouring(edges: Bool[np.ndarray, "n n"], exact: bool = True) -> list[int]:
    """Return a colour, from 0, of each node of a graph such that the nodes of an edge have different colours.

    If `exact`, the number of colours is the smallest possible one; otherwise it is the one that DSATUR finds. `edges` is
    symmetric.

    Source: D. Brelaz, New methods to color the vertices of a graph, Communications of the ACM 22 (1979).
    """
    n = len(edges)
    neighbours, best = [np.flatnonzero(row).tolist() for row in edges], list(range(n))

    def extend(colours: list[int], used: int) -> bool:
        """Colour the remaining nodes, of which `colours` is -1, and note a better colouring in `best`; return True to stop."""
        nonlocal best
        if used >= 1 + max(best):
            return False
        free = [k for k in range(n) if colours[k] < 0]
        if not free:
            best = list(colours)
            return not exact
        taken = {k: {colours[j] for j in neighbours[k]} - {-1} for k in free}
        k = max(free, key=lambda k: (len(taken[k]), len(neighbours[k])))
        for colour in range(used + 1):  # a new colour last
            if colour not in taken[k]:
                colours[k] = colour
                if extend(colours, max(used, colour + 1)):
                    return True
                colours[k] = -1
        return False

    if n and edges.any():
        extend([-1] * n, 0)
        return best
    return [0] * n
