"""The order in which the blocks of D D^T are eliminated, and which later ones each of them meets."""

from collections.abc import Sequence, Set
from typing import NamedTuple

from udkjax.pinv.sparse import minimum_degree


class Elimination(NamedTuple):
    """Blocks that are eliminated one after the other, in the same way."""

    size: int  # rows of each block
    sizes: tuple[int, ...]  # rows of the later blocks that each of them meets
    blocks: list[int]
    later: list[list[int]]  # of each block, in the order of elimination


def eliminations(sizes: Sequence[int], holds: Sequence[Set[int]]) -> list[Elimination]:
    """Return an order of least fill, in runs of blocks that are alike. Blocks meet where they hold the same thing.

    A block waits for those before it that meet it, and for nothing else: of those that need not wait, as many that are alike come
    next as there are.
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

    def kind(k: int) -> tuple[int, tuple[int, ...]]:
        return sizes[k], tuple(sizes[j] for j in later[k])

    for k in order:
        if not waits[k]:
            ready.setdefault(kind(k), []).append(k)
    found = []
    while ready:
        key = max(ready, key=lambda key: len(ready[key]))
        blocks = ready[key]
        for k in blocks:  # those that need wait no more join while it goes on
            j = parent[k]
            if j >= 0:
                waits[j] -= 1
                if not waits[j]:
                    ready.setdefault(kind(j), []).append(j)
        del ready[key]
        found.append(Elimination(*key, blocks, [later[k] for k in blocks]))
    return found
