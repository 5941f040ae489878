"""The least gaps of pairs of parts over a motion, proven between its poses, and where pairs begin and cease to touch.

With L the length of the ways of both parts over an interval, d >= (d0 + d1 - L) / 2. With n the direction in which the gap at one
end is measured, d >= min n.(b - a) over all points of the parts, of which each is above its chord minus M h^2 / 8, with M the
sum of the largest accelerations. Intervals in which a gap could be below the least one found are split.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize.elementwise import find_root

from udkjax.positions.gaps.convex import Feature
from udkjax.positions.gaps.motion import PolynomialMotion, de_casteljau
from udkjax.positions.gaps.part_pairs import Closest, PartPairs, part_pairs
from udkjax.positions.gaps.shapes import ConvexPart

PROVEN = 1e-10  # of the size of the mechanism: how far below the least gap found another one might be
OPENED = 1e-6  # of the size: smaller openings within a stretch of contact may be passed over
BLOCK = 16  # polynomials of a motion in the first intervals
SPLITS = 4  # parts into which an interval within a polynomial is split
MOST_INTERVALS = 100_000  # at a time; beyond that, the bound that is proven is returned
BESIDE = 1e-6  # of the interval around a least gap: where both sides of a kink are seen
Stretches = list[tuple[float, float]]


class Least(NamedTuple):
    """The least gap of a pair of links: parameter, piece, distance (m), proven bound (m), parts, places and features.

    Where the gap has a kink, at which one feature closes and another opens, `features` are both.
    """

    u: float
    piece: int
    distance: float
    bound: float
    parts: tuple[int, int]
    places: Float[np.ndarray, "2 2"]
    features: tuple[Feature, ...]
    fixed: bool  # at an end of the motion


def search(
    parts: Sequence[ConvexPart], order: Sequence[str], pairs: Sequence[tuple[str, str]], motion: PolynomialMotion
) -> tuple[list[Least], list[Stretches]]:
    """Return the least gap of each pair of links, and the stretches of u over which it touches.

    Args:
        parts: convex parts of links with concrete numbers.
        order: names of the bodies, in the order of poses.
        pairs: the pairs of links.
        motion: the motion.
    """
    searches = [PairSearch(group, motion) for group in part_pairs(parts, order, pairs)]
    least, low = np.full((2, len(pairs)), np.inf)
    found: dict[int, Least] = {}
    touches: list[Stretches] = [[] for _ in pairs]
    for one in searches:
        one.run(least)
        np.minimum.at(low, one.pairs.owner, one.low)
        for owner, stretches in one.touches():
            touches[owner] += stretches
    for one in searches:
        best = np.flatnonzero(one.least <= least[one.pairs.owner])
        found |= dict(zip(one.pairs.owner[best].tolist(), one.found(best, low), strict=True))
    return [found[k] for k in range(len(pairs))], [_joined(x) for x in touches]


class PairSearch:
    """The gaps of pairs of parts of the same numbers of corners along a motion."""

    def __init__(self, pairs: PartPairs, motion: PolynomialMotion):
        self.pairs, self.motion, self.nodes, self.steps = pairs, motion, motion.nodes, np.diff(motion.u)
        self.controls = motion.points.reshape(len(motion.points), -1, 3)  # of piece p and body b in row p * bodies + b
        known, count, h = motion.known, len(pairs.owner), self.steps
        places = self.nodes[:, np.unique(pairs.bodies), :2][np.append(known, False) | np.append(False, known)]
        self.size = float(np.ptp(places, axis=(0, 1)).max()) + float(pairs.reach.max()) + float(pairs.radius.max())
        speeds, accelerations = motion.largest_derivatives()
        ways = np.where(known[:, None], h[:, None] * speeds, 0.0)
        self.ways = np.concatenate([np.zeros_like(ways[:, :1]), np.cumsum(ways, 1)], 1)
        self.bends = accelerations[0], accelerations[1] + speeds[1] ** 2
        self.starts = np.flatnonzero(known & ~np.append(False, known[:-1]))
        self.ends = np.flatnonzero(known & ~np.append(known[1:], False)) + 1
        self.reach, (self.least, self.low) = pairs.reach, np.full((2, count), np.inf)
        self.u, self.piece, self.step = np.zeros(count), np.zeros(count, int), np.zeros(count)
        self.crossings: list[np.ndarray] = []  # pairs, pieces, ends u, gaps there

    def gaps(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray) -> Float[np.ndarray, "n"]:
        """Return the gaps (m) of the pairs k at parameters u of pieces of the motion."""
        pairs = self.pairs.take(k)
        return pairs.gaps([pose for pose, _ in self._poses(pairs, piece, u)])

    def closest(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray) -> Closest:
        """Return the closest places of pairs k at parameters."""
        pairs = self.pairs.take(k)
        return pairs.closest(self._poses(pairs, piece, u))

    def _poses(self, pairs: PartPairs, piece: np.ndarray, u: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the poses (3, n) of both bodies of pairs, and their derivatives by u; contiguous, as arithmetic is fastest."""
        h = self.steps[piece]
        t, (degree, count) = (u - self.motion.u[piece]) / h, (len(self.controls), self.nodes.shape[1])
        rows = (self.controls.take(piece * count + body, 1) for body in pairs.bodies)
        return [de_casteljau(np.ascontiguousarray(x.reshape(degree, -1, 3).swapaxes(1, 2)), t, h) for x in rows]

    def run(self, least: Float[np.ndarray, "owners"]) -> None:
        """Split intervals until no gap can be below the least found, which is updated, and no touch is hidden within one."""
        k, piece, u, d = self._between_poses(least)
        while len(k):
            low, high = self._bounds(k, piece, u, d)
            split = self._is_open(k, low, high, d, least)
            if split.sum() > MOST_INTERVALS:
                split[:] = False
            self._finish(k[~split], piece[~split], u[~split], d[~split], low[~split])
            k, piece, u, d = self._split(k[split], piece[split], u[split], d[split], least)

    def _between_poses(self, least: Float[np.ndarray, "owners"]) -> tuple[np.ndarray, ...]:
        """Return the pairs, pieces, parameters and gaps at the ends of pieces that the bound by ways does not exclude."""
        ends = [range(start, end, BLOCK) for start, end in zip(self.starts, self.ends, strict=True)]
        i, j = np.array([(x, min(x + BLOCK, e)) for xs, e in zip(ends, self.ends, strict=True) for x in xs]).T
        k = np.repeat(np.arange(len(self.least)), len(i))
        i, j, u, found = np.tile(i, len(self.least)), np.tile(j, len(self.least)), self.motion.u, []
        d = np.stack([self._at_nodes(k, x) for x in (i, j)], 1)
        for x, piece, column in ((i, i, 0), (j, j - 1, 1)):
            self._note(k, piece, u[x], d[:, column], u[j] - u[i], least)
        while len(k):
            way = 0.5 * self._way(k, i, j)
            low, high = d.mean(1) - way, d.mean(1) + way
            is_open, is_single = self._is_open(k, low, high, d, least), j - i == 1
            found.append([x[is_open & is_single] for x in (k, i, np.stack([u[i], u[j]], 1), d)])
            self._finish(*(x[~is_open] for x in (k, i, np.stack([u[i], u[j]], 1), d, low)))
            k, i, j, d = (x[is_open & ~is_single] for x in (k, i, j, d))
            middle = (i + j) // 2
            between = self._at_nodes(k, middle)
            self._note(k, middle, u[middle], between, u[j] - u[i], least)
            k, i, j = np.tile(k, 2), np.append(i, middle), np.append(middle, j)
            d = np.stack([np.append(d[:, 0], between), np.append(between, d[:, 1])], 1)
        return tuple(np.concatenate(x) for x in zip(*found, strict=True))

    def _at_nodes(self, k: np.ndarray, node: np.ndarray) -> np.ndarray:
        pairs = self.pairs.take(k)
        return pairs.gaps([np.ascontiguousarray(self.nodes[node, body].T) for body in pairs.bodies])

    def _way(self, k: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return the sum (m) of the lengths of the paths of both parts of pairs k, from node i to node j."""
        line, turn = self.ways[:, j, self.pairs.bodies[:, k]] - self.ways[:, i, self.pairs.bodies[:, k]]
        return (line + turn * self.reach[:, k]).sum(0)

    def _is_open(
        self, k: np.ndarray, low: np.ndarray, high: np.ndarray, d: np.ndarray, least: np.ndarray
    ) -> Bool[np.ndarray, "n"]:
        """Return True for intervals in which a gap may be below the least one, or may change its sign unseen."""
        slack = PROVEN * self.size
        hides = ((low < -slack) & (d > 0).all(1)) | ((high > OPENED * self.size) & (d < 0).all(1))
        crosses = ((d[:, 0] < 0) != (d[:, 1] < 0)) & (high - low > OPENED * self.size)
        return (low < least[self.pairs.owner[k]] - slack) | hides | crosses

    def _finish(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray, d: np.ndarray, low: np.ndarray) -> None:
        np.minimum.at(self.low, k, low)
        crosses = (d[:, 0] < 0) != (d[:, 1] < 0)
        if crosses.any():
            self.crossings.append(np.column_stack([k, piece, u, d])[crosses])

    def _note(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray, d: np.ndarray, step: np.ndarray, least: np.ndarray) -> None:
        """Keep the least gaps so far, with their parameters and the length of the intervals around them."""
        order = np.lexsort((d, k))
        first = order[np.append(True, np.diff(k[order]) > 0)[: len(k)]]
        better = first[d[first] < self.least[k[first]]]
        for kept, new in ((self.least, d), (self.u, u), (self.piece, piece), (self.step, step)):
            kept[k[better]] = new[better]
        np.minimum.at(least, self.pairs.owner[k[better]], d[better])

    def _bounds(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of the gaps of pairs k over intervals within pieces, below and above."""
        h, bodies = u[:, 1] - u[:, 0], self.pairs.bodies[:, k]
        way = 0.5 * self._way(k, piece, piece + 1) * h / np.diff(self.motion.u)[piece]
        line, turn = (x[piece, bodies] for x in self.bends)
        sag = (line + turn * self.reach[:, k]).sum(0) * h**2 / 8
        here = self.closest(np.tile(k, 2), np.tile(piece, 2), u.T.ravel())  # at the starts, then at the ends
        A, B = ((here.n * np.roll(x, len(k), -1)).sum(1) for x in here.placed)  # places at one end, along n of the other one
        chords = np.minimum(d.T, (B.min(0) - A.max(0)).reshape(2, -1) - self.pairs.radius[k])
        return np.maximum(d.mean(1) - way, chords.max(0) - sag), d.mean(1) + way

    def _split(self, k: np.ndarray, piece: np.ndarray, u: np.ndarray, d: np.ndarray, least: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the parts of intervals, with their gaps."""
        steps = u[:, :1] + (u[:, 1:] - u[:, :1]) * np.arange(SPLITS + 1) / SPLITS
        steps[:, -1] = u[:, 1]
        inner = steps[:, 1:-1].ravel()
        ks, pieces = np.repeat(k, SPLITS - 1), np.repeat(piece, SPLITS - 1)
        inside = self.gaps(ks, pieces, inner)
        self._note(ks, pieces, inner, inside, np.repeat(steps[:, 1] - steps[:, 0], SPLITS - 1), least)
        gaps = np.concatenate([d[:, :1], inside.reshape(-1, SPLITS - 1), d[:, 1:]], 1)
        ends = (np.stack([x[:, :-1].ravel(), x[:, 1:].ravel()], 1) for x in (steps, gaps))
        return np.repeat(k, SPLITS), np.repeat(piece, SPLITS), *ends

    def found(self, k: Int[np.ndarray, "n"], low_of: Float[np.ndarray, "owners"]) -> list[Least]:
        """Return the least gaps of pairs of parts k, where they cease to fall or at an end, with bounds of pairs of links."""
        m, u, step = self.motion, self.u[k], self.step[k]
        every, chain = np.arange(len(k)), np.searchsorted(self.starts, self.piece[k], side="right") - 1
        first, last = self.starts[chain], self.ends[chain] - 1

        def at(u: np.ndarray, some: Any = slice(None)) -> tuple[np.ndarray, ...]:
            pieces = np.searchsorted(m.u, u, side="right") - 1
            return k[some], np.clip(pieces, first[some], last[some]), u

        ends = low, high = np.maximum(m.u[first], u - step), np.minimum(m.u[last + 1], u + step)
        slopes = self.closest(*at(np.concatenate(ends), np.tile(every, 2))).rate.reshape(2, -1)
        root, inner = u.copy(), np.flatnonzero((slopes[0] < 0) & (slopes[1] > 0))
        root[inner] = _roots(lambda x, some: self.closest(*at(x, some)).rate, low[inner], high[inner], inner)
        places = np.stack([root, low, high, u])
        u = places[np.argmin(self.gaps(*at(places.ravel(), np.tile(every, 4))).reshape(4, -1), 0), every]
        distances, here = self.gaps(*at(u)), self.closest(*at(u))
        fixed = ((u <= m.u[first]) & (slopes[0] > 0)) | ((u >= m.u[last + 1]) & (slopes[1] < 0))
        sides = [self.closest(*at(np.clip(u + side * BESIDE * step, low, high))) for side in (-1, 1)]
        kink = (sides[0].rate < -(BESIDE**0.5) * np.abs(slopes[0])) & (sides[1].rate > BESIDE**0.5 * np.abs(slopes[1])) & ~fixed
        ends = here.places + np.array([[[1.0]], [[-1.0]]]) * self.pairs.radii[:, None, k] * here.n
        found = []
        for n, pair in enumerate(k.tolist()):
            features = [x.features.take(n) for x in (sides if kink[n] else [here])]
            owner, parts = int(self.pairs.owner[pair]), self.pairs.parts[:, pair]
            bound = min(float(distances[n]), float(low_of[owner]))
            found.append(
                Least(
                    float(u[n]), int(at(u)[1][n]), float(distances[n]), bound, (int(parts[0]), int(parts[1])),
                    ends[:, :, n], tuple(features), bool(fixed[n]),
                )
            )  # fmt: skip
        return found

    def touches(self) -> list[tuple[int, Stretches]]:
        """Return the stretches of u in which pairs of parts touch, with the numbers of the pairs of links."""
        rows = np.concatenate([np.zeros((0, 6)), *self.crossings])
        k, piece = rows[:, :2].T.astype(int)
        places = _roots(lambda u, some: self.gaps(k[some], piece[some], u), rows[:, 2], rows[:, 3], np.arange(len(rows)))
        found, falls = [], rows[:, 4] >= 0
        at_ends = [
            self._at_nodes(np.repeat(np.arange(len(self.least)), len(x)), np.tile(x, len(self.least))).reshape(-1, len(x)) < 0
            for x in (self.starts, self.ends)
        ]
        for pair, owner in enumerate(self.pairs.owner.tolist()):
            begins, ceases = (
                np.sort(np.append(places[(k == pair) & (falls == first)], self.motion.u[ends][touching[pair]]))
                for first, ends, touching in zip((True, False), (self.starts, self.ends), at_ends, strict=True)
            )
            found.append((owner, list(zip(begins.tolist(), ceases.tolist(), strict=True))))
        return found


def _roots(f: Callable[[Any, Any], Any], low: np.ndarray, high: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Return the roots of the functions with the indices `some`, between parameters at which their signs differ."""
    return find_root(lambda x, some: f(x, some.astype(int)), (low, high), args=(some,)).x if len(some) else low


def _joined(stretches: Stretches) -> Stretches:
    """Return stretches in which overlapping ones are merged."""
    found: Stretches = []
    for start, end in sorted(stretches):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return found
