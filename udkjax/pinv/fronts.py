"""The fronts of an elimination tree as arrays: where each of their entries comes from.

A front holds the rows that it eliminates (e) and those of its boundary (b). Of the symmetric matrix

    [S_ee  S_eb]
    [S_be   .  ]     plus the updates that its children send,

it takes S_ee and S_eb, and of its boundary only what the children say. All fronts of one depth are worked on together, padded
to a few common shapes, and laid out as (row, column, front), so that arithmetic runs along the fronts. Everything here is
NumPy, done once for a structure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from udkjax.pinv.dissection import Front

# What one more group on a level costs, counted in entries gathered, of 0.8 ns each: about fifteen kernels of 100 ns, and a third
# of a second to compile them. Shapes share a group where padding costs less.
GROUP = 8000
# So many multiply-adds along the fronts cost as much as one entry gathered.
GATHER = 4.0


@dataclass(frozen=True, eq=False)
class Group:
    """Fronts of one depth, padded to e rows eliminated and b rows of boundary. An array of places may have several summands.

    `pivot`, `side`, `corner` and `carried`, `passed` are places in what the fronts of the level below send up: their updates of
    the matrix (b, b, fronts) and of the right-hand side (b, fronts), flattened, group after group.
    """

    eliminated: int
    boundary: int
    fronts: int
    entries: np.ndarray  # (e, e + b, fronts): places in S, of `Matrix`
    rows: np.ndarray  # (e, fronts): places in the right-hand side
    pivot: np.ndarray  # (summands, e, e, fronts)
    side: np.ndarray  # (summands, e, b, fronts)
    corner: np.ndarray  # (summands, b, b, fronts)
    carried: np.ndarray  # (summands, e, fronts)
    passed: np.ndarray  # (summands, b, fronts)
    above: np.ndarray  # (b, fronts): places in the solution found so far


class Plan(NamedTuple):
    """The groups of every level, the deepest first. Solutions (e, fronts) are found from the root, group after group."""

    levels: list[list[Group]]
    solution: np.ndarray  # (blocks, width): places in the solution found


class Matrix:
    """Where the entries of a block-sparse symmetric matrix lie in [diagonal, coupling, 0, 1], flattened."""

    def __init__(self, sizes: Sequence[int], pairs: np.ndarray):
        self.blocks, self.width = len(sizes), max(sizes)
        self.first = np.cumsum([0, *sizes])
        self.block = np.repeat(np.arange(self.blocks), sizes)
        self.offset = np.arange(self.first[-1]) - self.first[self.block]
        keys = np.concatenate([pairs @ [self.blocks, 1], pairs @ [1, self.blocks], [self.blocks**2]])
        order = np.argsort(keys)
        self.keys = keys[order]
        self.coupling = np.append(np.tile(np.arange(len(pairs)), 2), 0)[order]
        self.turned = order >= len(pairs)
        self.zero = (self.blocks + len(pairs)) * self.width**2

    def rows(self, blocks: Sequence[int]) -> np.ndarray:
        return np.concatenate([np.arange(0), *(np.arange(self.first[i], self.first[i + 1]) for i in blocks)])

    def places(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the places of S[i, j], of rows; -1 is a row of padding, all zero."""
        (at, to), (row, column) = (self.block[i], self.block[j]), (self.offset[i], self.offset[j])
        key = at * self.blocks + to
        near = np.searchsorted(self.keys, key)
        turned, width = self.turned[near], self.width
        coupled = (self.blocks + self.coupling[near]) * width**2 + np.where(turned, column * width + row, row * width + column)
        place = np.where(self.keys[near] == key, coupled, self.zero)
        place = np.where(at == to, (at * width + row) * width + column, place)
        return np.where((i < 0) | (j < 0), self.zero, place)


class _Seat(NamedTuple):
    """Where a front lies: its group's padded shape, its number in it, and where the group's arrays begin."""

    eliminated: int
    boundary: int
    fronts: int
    number: int
    update: int  # (b, b, fronts)
    right: int  # (b, fronts)


def plan(sizes: Sequence[int], pairs: np.ndarray, fronts: Sequence[Front]) -> Plan:
    """Lay out the fronts of an elimination tree."""
    matrix = Matrix(sizes, pairs)
    eliminated, boundary = [matrix.rows(f.eliminated) for f in fronts], [matrix.rows(f.boundary) for f in fronts]
    depths: list[list[int]] = [[] for _ in range(1 + max(f.depth for f in fronts))]
    for k, front in enumerate(fronts):
        depths[front.depth].append(k)
    shapes = [(len(e), len(b)) for e, b in zip(eliminated, boundary, strict=True)]
    layout, seats, found, end = [], {}, np.zeros(matrix.first[-1], int), 0
    for members in depths:
        begin, groups = (0, 0), []
        for e, b, inside in _grouped(members, shapes):
            # The last front of a level's first group is empty: its updates are the zero that others refer to.
            count = len(inside) + (not groups)
            for f, k in enumerate(inside):
                seats[k] = _Seat(e, b, count, f, *begin)
                found[eliminated[k]] = end + f + count * np.arange(len(eliminated[k]))
            begin, end = (begin[0] + b * b * count, begin[1] + b * count), end + e * count
            groups.append((e, b, count, inside))
        layout.append(groups)
    met = _met(fronts, seats, eliminated, boundary)
    levels = []
    for depth in reversed(range(len(layout))):
        groups = []
        zero = layout[depth + 1][0][2] - 1 if depth + 1 < len(layout) else 0
        for e, b, count, inside in layout[depth]:
            at = np.full((e + b, count), -1)
            for f, k in enumerate(inside):
                at[: shapes[k][0], f], at[e : e + shapes[k][1], f] = eliminated[k], boundary[k]
            entries = matrix.places(at[:e, None], at[None])
            entries[np.arange(e), np.arange(e)] += at[:e] < 0  # the pivot of a row of padding is one
            rows = np.where(at[:e] < 0, 0, matrix.block[at[:e]] * matrix.width + matrix.offset[at[:e]])
            updates, right = _received(e + b, [fronts[k].children for k in inside], count, seats, met)
            parts = updates[:, :e, :e], updates[:, :e, e:], updates[:, e:, e:], right[:, :e], right[:, e:]
            sources = (_summands(part, zero) for part in parts)
            above = np.where(at[e:] < 0, 0, found[at[e:]])
            groups.append(Group(e, b, count, *(_places(p) for p in (entries, rows, *sources, above))))
        levels.append(groups)
    solution = np.zeros((matrix.blocks, matrix.width), int)
    solution[matrix.block, matrix.offset] = found
    return Plan(levels, _places(solution))


def _places(indices: np.ndarray) -> np.ndarray:
    return indices.astype(np.int32)


def _grouped(members: list[int], shapes: Sequence[tuple[int, int]]) -> list[tuple[int, int, list[int]]]:
    """Collect the fronts of one depth in groups (e, b, members), by joining two as long as that costs less than it saves."""
    by_shape: dict[tuple[int, int], list[int]] = {}
    for k in members:
        by_shape.setdefault(shapes[k], []).append(k)
    groups = [(e, b, inside) for (e, b), inside in sorted(by_shape.items())]
    while len(groups) > 1:
        _, i, j = min((_padding(one, other), i, j) for j, other in enumerate(groups) for i, one in enumerate(groups[:j]))
        if _padding(groups[i], groups[j]) > GROUP:
            break
        (e, b, inside), (f, c, others) = groups[i], groups.pop(j)
        groups[i] = max(e, f), max(b, c), inside + others
    return groups


def _padding(one: tuple[int, int, list[int]], other: tuple[int, int, list[int]]) -> float:
    joined = _work(max(one[0], other[0]), max(one[1], other[1]))
    return len(one[2]) * (joined - _work(*one[:2])) + len(other[2]) * (joined - _work(*other[:2]))


def _work(e: int, b: int) -> float:
    """Entries of a front, and its multiply-adds as if they were entries."""
    return (e + b) ** 2 + e * (e * (e + b) / 2 + b * b) / GATHER


def _met(
    fronts: Sequence[Front], seats: dict[int, _Seat], eliminated: list[np.ndarray], boundary: list[np.ndarray]
) -> dict[int, np.ndarray]:
    """For every front with a parent: the places of its boundary's rows among those of its parent, padding counted."""
    local = np.zeros(sum(len(e) for e in eliminated), int)
    met = {}
    for k, front in enumerate(fronts):
        if front.children:
            local[eliminated[k]] = np.arange(len(eliminated[k]))
            local[boundary[k]] = seats[k].eliminated + np.arange(len(boundary[k]))
            met.update({child: local[boundary[child]] for child in front.children})
    return met


def _received(rows: int, children: list[list[int]], count: int, seats: dict[int, _Seat], met: dict[int, np.ndarray]):
    """Return the places of the two children's updates of (row, row, front) and of (row, front), -1 where there is none."""
    own = np.full((2, rows, count), -1)  # the number of the row in the child's boundary
    width, stride, update, right = np.zeros((4, 2, count), int)
    for f, family in enumerate(children):
        for s, child in enumerate(family):
            seat = seats[child]
            own[s, met[child], f] = np.arange(len(met[child]))
            width[s, f], stride[s, f] = seat.boundary, seat.fronts
            update[s, f], right[s, f] = seat.update + seat.number, seat.right + seat.number
    i, j = np.minimum(own[:, :, None], own[:, None]), np.maximum(own[:, :, None], own[:, None])
    matrix = update[:, None, None] + (i * width[:, None, None] + j) * stride[:, None, None]
    return np.where(i < 0, -1, matrix), np.where(own < 0, -1, right[:, None] + own * stride[:, None])


def _summands(places: np.ndarray, zero: int) -> np.ndarray:
    """Move the summands that exist to the front, and leave out what is empty everywhere."""
    one, two = places
    first, second = np.where(one < 0, two, one), np.where(one < 0, -1, two)
    kept = [p for p in (first, second) if (p >= 0).any()]
    return np.where(np.array(kept) < 0, zero, kept) if kept else np.zeros((0, *one.shape), int)
