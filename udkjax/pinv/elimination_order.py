"""Elimination orders of least fill for the rows or blocks of D D^T. Two rows meet if both have an entry in the same column."""

from collections.abc import Sequence, Set
from heapq import heapify, heappop, heappush
from typing import NamedTuple


def minimum_degree(rows: Sequence[set[int]]) -> list[int]:
    """Order rows by minimum degree, for little fill in D D^T: the row that meets the fewest others comes next.

    A row waits for the earlier rows that it meets. Ties go to the row that ends the shortest chain of waiting rows, then to the
    first: rows that do not wait for each other can be eliminated in parallel.

    Args:
        rows: the columns in which each row has entries.

    Returns:
        The indices of the rows, in the order of elimination.
    """
    rows_of_column: dict[int, set[int]] = {}
    for i, row in enumerate(rows):
        for k in row:
            rows_of_column.setdefault(k, set()).add(i)
    neighbours = [set().union(*(rows_of_column[k] for k in row)) - {i} if row else set() for i, row in enumerate(rows)]
    order: list[int] = []
    wait = [0] * len(rows)  # length of the longest chain of earlier rows
    queue, remaining = [(len(others), 0, i) for i, others in enumerate(neighbours)], set(range(len(rows)))
    heapify(queue)
    while remaining:
        *queued, i = heappop(queue)
        if i not in remaining or queued != [len(neighbours[i]), wait[i]]:  # outdated entry of the queue
            continue
        remaining.remove(i)
        order.append(i)
        for k in neighbours[i]:
            neighbours[k] = (neighbours[k] | neighbours[i]) - {i, k}
            wait[k] = max(wait[k], wait[i] + 1)
            heappush(queue, (len(neighbours[k]), wait[k], k))
    return order


class Fronts(NamedTuple):
    """Blocks of rows that are eliminated one after another by the same operations.

    A front is a block with the later blocks that it meets; these fronts have equal sizes.
    """

    size: int  # number of rows of each block
    later_sizes: tuple[int, ...]  # numbers of rows of the later blocks that each block meets
    blocks: list[int]
    later: list[list[int]]  # for each block the later blocks that it meets, in the order of elimination


def order_blocks(sizes: Sequence[int], entries_of_blocks: Sequence[Set[int]]) -> list[Fronts]:
    """Return an elimination order of blocks for little fill, grouped into runs of fronts of equal sizes.

    A block waits only for the earlier blocks that it meets. The next run is the largest group of equal fronts that wait for none.

    Args:
        sizes: the number of rows of each block.
        entries_of_blocks: the columns, or bodies, in which each block has entries; two blocks meet if they share one.
    """
    position = {k: i for i, k in enumerate(minimum_degree([set(entries) for entries in entries_of_blocks]))}
    order = sorted(position, key=lambda k: position[k])
    blocks_of_entry: dict[int, list[int]] = {}
    for k, entries in enumerate(entries_of_blocks):
        for x in entries:
            blocks_of_entry.setdefault(x, []).append(k)
    neighbours = [{j for x in entries for j in blocks_of_entry[x]} - {k} for k, entries in enumerate(entries_of_blocks)]
    later: list[list[int]] = [[] for _ in sizes]
    waits, parent = [0] * len(sizes), [-1] * len(sizes)
    filled: list[set[int]] = [{j for j in others if position[j] > position[k]} for k, others in enumerate(neighbours)]
    for k in order:
        later[k] = sorted(filled[k], key=lambda j: position[j])
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
    fronts = []
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
        fronts.append(Fronts(*key, blocks, [later[k] for k in blocks]))
    return fronts
