"""Elimination orders of least fill for the rows or blocks of D D^T. Two rows meet if both have an entry in the same column."""

from collections.abc import Sequence, Set
from heapq import heapify, heappop, heappush
from typing import NamedTuple


def minimum_degree(rows: Sequence[set[int]]) -> list[int]:
    """Order rows by minimum degree, for little fill in D D^T: the row that meets the fewest others comes next.

    Ties go to the row that waits for the fewest earlier rows, then to the first: rows that do not wait can run in parallel.
    """
    meets: dict[int, set[int]] = {}
    for i, row in enumerate(rows):
        for k in row:
            meets.setdefault(k, set()).add(i)
    near = [set().union(*(meets[k] for k in row)) - {i} if row else set() for i, row in enumerate(rows)]
    order: list[int] = []
    wait = [0] * len(rows)  # length of the longest chain of earlier rows
    queue, left = [(len(others), 0, i) for i, others in enumerate(near)], set(range(len(rows)))
    heapify(queue)
    while left:
        *known, i = heappop(queue)
        if i not in left or known != [len(near[i]), wait[i]]:  # an outdated entry of the queue
            continue
        left.remove(i)
        order.append(i)
        for k in near[i]:
            near[k] = (near[k] | near[i]) - {i, k}
            wait[k] = max(wait[k], wait[i] + 1)
            heappush(queue, (len(near[k]), wait[k], k))
    return order


class Fronts(NamedTuple):
    """Blocks eliminated consecutively by the same operations: fronts of equal sizes."""

    size: int  # rows of each block
    later_sizes: tuple[int, ...]  # rows of the later blocks that each of them meets
    blocks: list[int]
    later: list[list[int]]  # the later blocks that each block meets, in the order of elimination


def order_blocks(sizes: Sequence[int], holds: Sequence[Set[int]]) -> list[Fronts]:
    """Return an elimination order of least fill, grouped into runs of equal blocks. Two blocks meet if they share an entry.

    A block waits only for the earlier blocks that it meets. The next run is the largest group of equal blocks that are ready.
    """
    place = {k: i for i, k in enumerate(minimum_degree([set(h) for h in holds]))}
    order = sorted(place, key=lambda k: place[k])
    meets: dict[int, list[int]] = {}
    for k, held in enumerate(holds):
        for x in held:
            meets.setdefault(x, []).append(k)
    near = [{j for x in held for j in meets[x]} - {k} for k, held in enumerate(holds)]
    later: list[list[int]] = [[] for _ in sizes]
    waits, parent = [0] * len(sizes), [-1] * len(sizes)
    filled: list[set[int]] = [{j for j in n if place[j] > place[k]} for k, n in enumerate(near)]
    for k in order:
        later[k] = sorted(filled[k], key=lambda j: place[j])
        if later[k]:
            parent[k] = later[k][0]
            waits[parent[k]] += 1
            filled[parent[k]] |= filled[k] - {parent[k]}
    ready: dict[tuple[int, tuple[int, ...]], list[int]] = {}

    def front_sizes(k: int) -> tuple[int, tuple[int, ...]]:
        return sizes[k], tuple(sizes[j] for j in later[k])

    for k in order:
        if not waits[k]:
            ready.setdefault(front_sizes(k), []).append(k)
    found = []
    while ready:
        key = max(ready, key=lambda key: len(ready[key]))
        blocks = ready[key]
        for k in blocks:  # blocks that need not wait any longer join the list in this loop
            j = parent[k]
            if j >= 0:
                waits[j] -= 1
                if not waits[j]:
                    ready.setdefault(front_sizes(j), []).append(j)
        del ready[key]
        found.append(Fronts(*key, blocks, [later[k] for k in blocks]))
    return found
