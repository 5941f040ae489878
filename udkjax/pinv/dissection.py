"""Nested dissection: an order of elimination whose tree is as shallow as the graph allows.

Removing a separator leaves parts that do not touch each other; each is dissected in turn, and the separator is eliminated
after all of them (A. George, SIAM J. Numer. Anal. 10, 345 (1973)). The parts below one separator can be eliminated at the same
time, so a chain of n blocks takes log2 n stages where any order from end to end takes n.

Separators are sought where the graphs of planar mechanisms have small ones: a single block whose removal disconnects a part
(chains, trees, loops in series), else the front of a sweep through it (grids of loops).
"""

from collections.abc import Iterable, Sequence
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np

# No side of a separator holds more than this share of a part: with 2/3, the depth grows like log n whatever the graph.
BALANCE = 2 / 3


class Front(NamedTuple):
    """A node of the elimination tree: the blocks it eliminates, and the later ones that these are coupled to."""

    eliminated: list[int]
    boundary: list[int]  # in the order of their elimination
    children: list[int]  # at most two, by their place in the list of fronts
    depth: int  # 0 at a root


def dissect(sizes: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[Front]:
    """Return the elimination tree of a graph of blocks, children before their parents.

    Every front has at most two children (fronts that eliminate nothing join more), so that its sum of updates has a fixed form;
    parts that do not touch have roots of their own.
    """
    near: list[list[int]] = [[] for _ in sizes]
    for i, j in pairs:
        near[i].append(j)
        near[j].append(i)
    tree = _Tree(sizes, near)
    roots = [tree.grow(part) for part in components(near, range(len(sizes)))]
    return tree.fronts(roots)


class _Tree:
    def __init__(self, sizes: Sequence[int], near: list[list[int]]):
        self.sizes, self.near = sizes, near
        self.eliminated: list[list[int]] = []  # by node, children before their parents
        self.children: list[list[int]] = []
        self.height: list[int] = []

    def grow(self, part: list[int]) -> int:
        """Add the tree of a connected part, and return its root."""
        separator = self.separator(part)
        if 2 * sum(self.sizes[i] for i in separator) > sum(self.sizes[i] for i in part):
            return self.add(part, [])  # one block, or coupled too tightly to be worth two levels
        rest = set(part).difference(separator)
        below = [self.grow(p) for p in components(self.near, rest)]
        while len(below) > 2:  # the two shallowest are joined, which adds least to the depth
            below.sort(key=lambda node: -self.height[node])
            below.append(self.add([], [below.pop(), below.pop()]))
        return self.add(separator, below)

    def add(self, eliminated: list[int], children: list[int]) -> int:
        self.eliminated.append(eliminated)
        self.children.append(children)
        self.height.append(1 + max((self.height[c] for c in children), default=-1))
        return len(self.height) - 1

    def separator(self, part: list[int]) -> list[int]:
        """Return the smallest separator found of a connected part that leaves no side too large; the part, if none does."""
        sizes, near = self.sizes, self.near
        if 1 < len(part) <= 3:  # minimum degree: the blocks of fewer neighbours go first
            return [max(part, key=lambda i: (len(set(near[i]).intersection(part)), len(near[i])))]
        total = sum(sizes[i] for i in part)
        order, ahead = _sweep(sizes, near, part, _farthest(near, part))
        cuts = zip(np.cumsum([sizes[i] for i in order]).tolist(), ahead, range(1, len(part)), strict=False)
        cuts = [(rows, max(behind, total - behind - rows), n) for behind, rows, n in cuts if behind + rows < total]
        # The most even of the smallest; or one that leaves many parts, whatever the side that they lie on.
        even = [cut for cut in cuts if cut[1] <= BALANCE * total] or [cut for cut in cuts if cut[0] == min(cuts)[0]][:1]
        found = self.ahead(order, min(even)[2]) if even else part
        if len(found) > 1:
            single, larger = _articulation(sizes, near, part)
            if larger <= min(BALANCE * total, total - sizes[single] - 1):
                return [single]
        left = components(near, set(part).difference(found))
        return found if max((sum(sizes[i] for i in p) for p in left), default=total) <= BALANCE * total else part

    def ahead(self, order: list[int], passed: int) -> list[int]:
        """Return what borders on the first blocks of an order."""
        before = set(order[:passed])
        return [i for i in order[passed:] if not before.isdisjoint(self.near[i])]

    def fronts(self, roots: list[int]) -> list[Front]:
        place, depth = {}, dict.fromkeys(roots, 0)
        for node, blocks in enumerate(self.eliminated):
            place.update({i: (node, k) for k, i in enumerate(blocks)})
        for node in reversed(range(len(self.children))):
            depth.update(dict.fromkeys(self.children[node], depth[node] + 1))
        boundary: list[list[int]] = []
        for node, blocks in enumerate(self.eliminated):
            later = {j for i in blocks for j in self.near[i] if place[j][0] > node}
            later.update(j for child in self.children[node] for j in boundary[child] if place[j][0] != node)
            boundary.append(sorted(later, key=lambda j: place[j]))
        return [
            Front(e, b, c, depth[node])
            for node, (e, b, c) in enumerate(zip(self.eliminated, boundary, self.children, strict=True))
        ]


def components(near: list[list[int]], part: Iterable[int]) -> list[list[int]]:
    """Return the connected parts of some of a graph's blocks, each in the order of a breadth-first search."""
    left, found = set(part), []
    for start in sorted(left):
        if start in left:
            left.remove(start)
            reached = [start]
            for i in reached:
                for j in near[i]:
                    if j in left:
                        left.remove(j)
                        reached.append(j)
            found.append(reached)
    return found


def _farthest(near: list[list[int]], part: list[int]) -> int:
    """Return a block of a connected part as far as any from one that few others border on."""
    start = min(part, key=lambda i: len(near[i]))
    left, reached = set(part) - {start}, [start]
    for i in reached:
        for j in near[i]:
            if j in left:
                left.remove(j)
                reached.append(j)
    return reached[-1]


def _sweep(sizes: Sequence[int], near: list[list[int]], part: list[int], start: int) -> tuple[list[int], list[int]]:
    """Return the blocks of a connected part in an order that keeps its front narrow, and the front's rows after each of them.

    The front are the blocks next to those passed; the next is always the one that adds the fewest rows to it (I. P. King,
    Int. J. Numer. Methods Eng. 2, 523 (1970)).
    """
    inside = set(part)
    new = {i: sum(sizes[j] for j in near[i] if j in inside) for i in part}  # rows that the block would add
    known, passed, order, ahead, rows = set(), set(), [], [], 0
    heap: list[tuple[int, int, int]] = []

    def meet(i: int):
        known.add(i)
        heappush(heap, (new[i] - sizes[i], len(known), i))
        for j in near[i]:
            if j in inside:
                new[j] -= sizes[i]
                if j in known and j not in passed:
                    heappush(heap, (new[j] - sizes[j], len(known), j))

    meet(start)
    rows = sizes[start]
    while heap:
        i = heappop(heap)[2]
        if i not in passed:
            passed.add(i)
            order.append(i)
            fresh = [j for j in near[i] if j in inside and j not in known]
            for j in fresh:
                meet(j)
            rows += sum(sizes[j] for j in fresh) - sizes[i]
            ahead.append(rows)
    return order, ahead


def _articulation(sizes: Sequence[int], near: list[list[int]], part: list[int]) -> tuple[int, float]:
    """Return the block of a connected part whose removal leaves the smallest largest piece, and that piece's rows.

    By one depth-first search: a child whose subtree has no edge back above its parent becomes a piece of its own (R. Tarjan,
    SIAM J. Comput. 1, 146 (1972)).
    """
    inside, total = set(part), sum(sizes[i] for i in part)
    start = part[0]
    number, low, below = {start: 0}, {start: 0}, {start: sizes[start]}
    pieces: dict[int, list[int]] = {start: []}  # the rows of the subtrees that the removal of a block cuts off
    stack = [(start, iter(near[start]))]
    while stack:
        i, edges = stack[-1]
        for j in edges:
            if j in inside and j not in number:
                number[j] = low[j] = len(number)
                below[j], pieces[j] = sizes[j], []
                stack.append((j, iter(near[j])))
                break
            if j in inside:
                low[i] = min(low[i], number[j])
        else:
            stack.pop()
            if stack:
                parent = stack[-1][0]
                low[parent] = min(low[parent], low[i])
                below[parent] += below[i]
                if low[i] >= number[parent]:
                    pieces[parent].append(below[i])
    largest = {i: max([total - sizes[i] - sum(pieces[i]), *pieces[i]]) for i in part}
    best = min(part, key=lambda i: largest[i])
    return best, largest[best]
