"""D D^T of rows in blocks, eliminated front by front by code written out for each kind of them (front_code.py).

As in levels.py, on the same tree, for scenes whose fronts are of few kinds: that takes half of the time, where XLA makes one
fusion of each program, i.e. in the loops that it compiles into one function. Elsewhere it would take long to compile.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from udkjax.pinv.dissection import Front, dissect
from udkjax.pinv.front_code import FrontCode, Structure, front_code
from udkjax.pinv.places import take
from udkjax.pinv.subtrees import merged
from udkjax.straightline import Loop, cut

# Multiplications of all kinds of fronts together, at most. Rows of loops and chains of any length have 1,100 to 2,100, of 10 to
# 14 kinds; random trees of 40, 80 and 160 joints 1,900, 3,100 and 5,700, of 23, 34 and 56 kinds, and take 5, 12 and 22 s to
# compile, where levels take 2.
WRITTEN = 2_500
VECTOR = 8  # numbers: what the widest vector units hold


@dataclass(frozen=True, eq=False)
class Alike:
    """Fronts of one depth and structure, and the places of what their programs take."""

    code: FrontCode
    D: np.ndarray  # (entries, fronts): in D, flat
    sent: np.ndarray  # (summands, fronts): in what the level below sends up of D D^T
    rows: np.ndarray  # (e, fronts): in the right-hand side, flat
    carried: np.ndarray  # (summands, fronts): in what the level below sends up of the right-hand side
    above: np.ndarray  # (b, fronts): in the solution found so far


class Known(NamedTuple):
    """What fronts that are alike are factorized of, whenever they are."""

    D: Array  # (entries, fronts)
    sent: Array  # (summands, fronts)


class Right(NamedTuple):
    """Their part of a right-hand side."""

    own: Array  # (e, fronts)
    carried: Array  # (summands, fronts)


class WrittenOut:
    """The elimination of all D of one pattern: `levels` of fronts that are alike, the deepest first."""

    def __init__(self, pattern: Any):
        """Analyse a `BlockPattern`."""
        rows = _Rows(pattern)
        pairs = pattern.coupled[0].tolist()
        fronts = merged(rows.sizes, rows.near, dissect(rows.sizes, pairs), lambda front: rows.structure(front, []))
        met = _met(fronts, rows)
        depths: list[dict[Structure, list[int]]] = [{} for _ in range(1 + max((f.depth for f in fronts), default=-1))]
        children = [sorted(front.children, key=lambda child: met[child].tolist()) for front in fronts]
        for k, front in enumerate(fronts):
            structure = rows.structure(front, [met[child] for child in children[k]])
            depths[front.depth].setdefault(structure, []).append(k)
        self.operations = sum(s.operations for s in {s for groups in depths for s in groups})
        self.levels: list[list[Alike]] = []
        if self.operations > WRITTEN:
            return
        # The array that a front's numbers are in begins with the number of the front, and has so many fronts between two numbers.
        sent, carried, fronts_of = np.zeros((3, len(fronts)), int)
        found, end = np.zeros(rows.count, int), 0
        for groups in depths:
            begin = np.zeros(2, int)
            for structure, members in groups.items():
                e, b, count = structure.eliminated, structure.boundary, _filled(len(members))
                for f, k in enumerate(members):
                    sent[k], carried[k], fronts_of[k] = *(begin + f), count
                    found[rows.of(fronts[k].eliminated)] = end + f + count * np.arange(e)
                begin, end = begin + np.array([b * (b + 1) // 2, b]) * count, end + e * count

        def places(k: int) -> tuple[np.ndarray, ...]:
            """Of a front: those of an `Alike`."""
            of_D, e, b = rows.entries(fronts[k]), rows.of(fronts[k].eliminated), rows.of(fronts[k].boundary)
            numbers = [(child, len(met[child])) for child in children[k]]
            parts = [sent[c] + fronts_of[c] * np.arange(n * (n + 1) // 2) for c, n in numbers]
            rights = [carried[c] + fronts_of[c] * np.arange(n) for c, n in numbers]
            return of_D, _joined(parts), rows.place[e], _joined(rights), found[b]

        for groups in reversed(depths):
            level = []
            for structure, members in groups.items():
                every = [*members, *members[-1:] * (_filled(len(members)) - len(members))]
                stacked = (np.stack(p, -1).astype(np.int32) for p in zip(*map(places, every), strict=True))
                level.append(Alike(front_code(structure), *stacked))
            self.levels.append(level)
        self.solution = np.zeros(pattern.rows * pattern.blocks, np.int32)
        self.solution[rows.place] = found
        self.padding = np.isin(np.arange(self.solution.size), rows.place, invert=True).reshape(pattern.rows, pattern.blocks)

    @property
    def worthwhile(self) -> bool:
        """Whether there are few enough kinds of fronts."""
        return bool(self.levels)

    def factor(self, D: Array, drop: Any, loop: Loop | None) -> tuple[list[list[Known]], Array]:
        """As `Levels.factor`, of D itself: return what `solve` takes, and whether every pivot is safe."""
        factors, safe, sent = [], [], jnp.zeros(0, D.dtype)
        for level in self.levels:
            known = [Known(*cut([take(D.ravel(), group.D), take(sent, group.sent)])) for group in level]
            done = [group.code.up(each.D, each.sent, drop, loop) for group, each in zip(level, known, strict=True)]
            sent = _joined([x for update, _ in done for x in update], jnp)
            safe += [s for _, s in done]
            factors.append(known)
        return factors, jnp.all(_joined(safe, jnp))

    def solve(self, factors: Any, r: Array, loop: Loop | None) -> Array:
        """Return y (rows of a block, blocks) with D D^T y = r; zero beyond a block's size."""
        rights, sent = [], jnp.zeros(0, r.dtype)
        for level, known in zip(self.levels, factors, strict=True):
            right = [Right(*cut([take(r.ravel(), group.rows), take(sent, group.carried)])) for group in level]
            parts: list[Array] = []
            for group, k, b in zip(level, known, right, strict=True):
                parts += group.code.forward(k.D, k.sent, b.own, b.carried, loop)
            sent = _joined(parts, jnp)
            rights.append(right)
        found = jnp.zeros(0, r.dtype)
        for level, known, right in zip(reversed(self.levels), reversed(factors), reversed(rights), strict=True):
            parts = [found]
            for group, k, b in zip(level, known, right, strict=True):
                (above,) = cut([take(found, group.above)])
                parts += group.code.backward(k.D, k.sent, b.own, b.carried, above, loop)
            found = _joined(parts, jnp)
        y = take(found, self.solution).reshape(r.shape)
        return jnp.where(self.padding, 0, y) if self.padding.any() else y


class _Rows:
    """The rows of a pattern, and which entries of D their products are made of."""

    def __init__(self, pattern: Any):
        self.pattern, self.sizes = pattern, pattern.sizes.tolist()
        self.first = np.cumsum([0, *self.sizes])
        self.count = int(self.first[-1])
        block = np.repeat(np.arange(pattern.blocks), self.sizes)
        self.offset = np.arange(self.count) - self.first[block]
        self.place = self.offset * pattern.blocks + block  # of a row, in (rows of a block, blocks)
        self.near: list[list[int]] = [[] for _ in self.sizes]
        self.shared: dict[tuple[int, int], list[tuple[int, int]]] = {}  # the slots in which two blocks meet
        pairs, turns = pattern.coupled
        for which, one, two in turns:
            for p, s, u in zip(which.tolist(), one.tolist(), two.tolist(), strict=True):
                i, j = pairs[p].tolist()
                self.shared.setdefault((i, j), []).append((s, u))
                self.shared.setdefault((j, i), []).append((u, s))
        for i, j in pairs.tolist():
            self.near[i].append(j)
            self.near[j].append(i)
        there = pattern.columns.reshape(pattern.deep, pattern.blocks) >= 0
        self.slots = [[k * pattern.blocks + i for k in np.flatnonzero(there[:, i])] for i in range(pattern.blocks)]
        self.columns = [np.flatnonzero(row).tolist() for row in pattern.present]

    def of(self, blocks: Sequence[int]) -> np.ndarray:
        """The rows of some blocks."""
        return _joined([np.arange(self.first[i], self.first[i + 1]) for i in blocks])

    def entries(self, front: Front) -> np.ndarray:
        """The places in D, flat, of what a front takes of it."""
        return np.array(list(self._products(front)[1]), int)

    def structure(self, front: Front, met: Sequence[np.ndarray]) -> Structure:
        """Of a front whose children's boundaries have these rows."""
        sent, carried = [], []
        for rows in met:
            one, two = rows[np.array(np.triu_indices(len(rows)))]
            sent += zip(np.maximum(one, two).tolist(), np.minimum(one, two).tolist(), strict=True)
            carried += rows.tolist()
        e, b = (sum(self.sizes[i] for i in blocks) for blocks in front[:2])
        return Structure(e, b, tuple(self._products(front)[0]), tuple(sent), tuple(carried))

    def _products(self, front: Front) -> tuple[list[tuple[int, int, int, int]], dict[int, int]]:
        """As `Structure` has them, and the number of each entry of D by its place: both by structure alone."""
        blocks = [*front.eliminated, *front.boundary]
        first = dict(zip(blocks, np.cumsum([0, *(self.sizes[i] for i in blocks)]).tolist(), strict=False))
        place = {i: k for k, i in enumerate(blocks)}
        numbers: dict[int, int] = {}
        products: list[tuple[int, int, int, int]] = []
        met: dict[int, list[int]] = {i: [] for i in blocks}  # slots, in an order that does not depend on their numbers

        def add(i: int, j: int, slots: list[tuple[int, int]], same: bool) -> None:
            for s, u in slots:
                for row in range(self.sizes[i]):
                    for column in range(row + 1 if same else self.sizes[j]):
                        for c in self.columns[row]:
                            if c in self.columns[column]:
                                a, b = self._entry(row, c, s), self._entry(column, c, u)
                                a, b = (numbers.setdefault(x, len(numbers)) for x in (a, b))
                                products.append((first[i] + row, first[j] + column, a, b))

        for j in front.eliminated:
            for i in sorted((i for i in self.near[j] if place.get(i, -1) > place[j]), key=lambda i: place[i]):
                add(i, j, self.shared[i, j], False)
                for s, u in self.shared[i, j]:
                    met[i] += [s] * (s not in met[i])
                    met[j] += [u] * (u not in met[j])
        for j in front.eliminated:
            slots = [*met[j], *(s for s in self.slots[j] if s not in met[j])]
            add(j, j, [(s, s) for s in slots], True)
        return products, numbers

    def _entry(self, row: int, column: int, slot: int) -> int:
        return (row * self.pattern.width + column) * len(self.pattern.columns) + slot


def _filled(fronts: int) -> int:
    """As many as fill vectors: what is left over would be worked off one by one."""
    width = VECTOR if fronts > VECTOR else 1
    return -(-fronts // width) * width


def _met(fronts: Sequence[Front], rows: _Rows) -> dict[int, np.ndarray]:
    """For every front with a parent: the places of its boundary's rows among those of its parent."""
    local, met = np.zeros(rows.count, int), {}
    for front in fronts:
        if front.children:
            mine = rows.of([*front.eliminated, *front.boundary])
            local[mine] = np.arange(len(mine))
            met.update({child: local[rows.of(fronts[child].boundary)] for child in front.children})
    return met


def _joined(parts: Sequence[Any], numpy: Any = np) -> Any:
    return numpy.concatenate(parts) if len(parts) else numpy.zeros(0, int)
