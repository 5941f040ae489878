"""Subtrees of an elimination tree that are alike, each as one front.

Mechanisms repeat themselves: most of the fronts of a chain of loops are at the bottom of the tree, in subtrees of a few kinds.
What happens within one then needs no place in memory, and nothing is fetched but the entries of its own rows. Two subtrees are
alike if their blocks, in an order that depends on nothing but their structure, are alike one by one.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Sequence

from udkjax.pinv.dissection import Front

# Rows of a subtree at most: with more there are fewer fronts above them, but more kinds of them, and each takes more code.
ROWS = 16
# So many alike are worth code of their own.
ALIKE = 2


def merged(
    sizes: Sequence[int], near: Sequence[Sequence[int]], fronts: Sequence[Front], kind: Callable[[Front], Hashable]
) -> list[Front]:
    """Return the tree with subtrees of at most `ROWS` rows as one front each, the largest of which `ALIKE` are of one kind."""
    below: list[list[int]] = []  # all blocks of a front's subtree
    for front in fronts:
        below.append([*(i for child in front.children for i in below[child]), *front.eliminated])
    rows = [sum(sizes[i] for i in blocks) for blocks in below]
    taken: dict[int, Front] = {}
    known: set[Hashable] = set()
    waiting = {k for k, front in enumerate(fronts) if not front.depth}
    while waiting:
        found = {k: _as_front(sizes, near, below[k], fronts[k]) for k in waiting if 0 < rows[k] <= ROWS}
        kinds = {k: kind(front) for k, front in found.items()}
        known.update(kind for kind, count in Counter(kinds.values()).items() if count >= ALIKE)
        taken.update((k, front) for k, front in found.items() if kinds[k] in known)
        waiting = {c for k in waiting if k not in taken for c in fronts[k].children}
    return _without(fronts, taken)


def _without(fronts: Sequence[Front], taken: dict[int, Front]) -> list[Front]:
    """Leave out what lies below the roots of some subtrees."""
    kept = {k for k, front in enumerate(fronts) if not front.depth}
    for k in reversed(range(len(fronts))):  # parents before their children
        if k in kept and k not in taken:
            kept.update(fronts[k].children)
    left: list[Front] = []
    place: dict[int, int] = {}
    for k in sorted(kept):
        place[k] = len(left)
        front = taken.get(k, fronts[k])
        left.append(front._replace(children=[place[c] for c in front.children]))
    return left


def _as_front(sizes: Sequence[int], near: Sequence[Sequence[int]], blocks: list[int], root: Front) -> Front:
    """Order blocks by minimum degree, of several the one whose surroundings come first."""
    mine = {*blocks, *root.boundary}
    coupled = {i: mine.intersection(near[i]) for i in blocks}
    coupled.update((j, {i for i in blocks if j in coupled[i]}) for j in root.boundary)
    ahead = {i: set(coupled[i]) for i in blocks}  # whom they are coupled to when their turn comes
    colour = {i: hash((sizes[i], i in ahead)) for i in coupled}
    order: list[int] = []
    left = set(blocks)
    while left:
        colour = _refined(coupled, colour)
        i = min(left, key=lambda i: (sum(sizes[j] for j in ahead[i]), colour[i]))
        left.remove(i)
        colour[i] = hash((len(order), colour[i]))
        order.append(i)
        for j in ahead[i] & left:
            ahead[j] = (ahead[j] | ahead[i]) - {i, j}
    colour = _refined(coupled, colour)
    return Front(order, sorted(root.boundary, key=lambda j: colour[j]), [], root.depth)


def _refined(coupled: dict[int, set[int]], colour: dict[int, int]) -> dict[int, int]:
    """Tell blocks apart by what they are coupled to, and by what that is coupled to."""
    for _ in range(2):
        colour = {i: hash((colour[i], *sorted(colour[j] for j in others))) for i, others in coupled.items()}
    return colour
