"""The least gaps of pairs of parts over a motion, proven between its poses, and where pairs begin and cease to touch.

Let d0 and d1 be the gaps at both ends of an interval of length h, and L the sum of the lengths of the paths of both parts. Then a
gap d within the interval is at least (d0 + d1 - L) / 2. With n the direction of the gap at one end, d >= min n.(b - a) over all
points of the parts; each of these products is above its chord minus M h^2 / 8, with M the sum of the largest accelerations.
Within a polynomial of the motion, `bounds` has narrower bounds. Intervals in which a gap could be below the least one found are
split.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from udkjax.arrays import ROUNDING
from udkjax.positions.gaps.bounds import Moving, MovingPart, bounds_by_features
from udkjax.positions.gaps.convex import Closest, Corners, Feature
from udkjax.positions.gaps.motion import PolynomialMotion
from udkjax.positions.gaps.motion_tables import MotionTables
from udkjax.positions.gaps.part_pairs import ClosestPlaces, PartPairs, PlacedFrames, part_pairs
from udkjax.positions.gaps.shapes import ConvexPart

PROVEN_TOL = 1e-10  # of the size of the mechanism: how far below the least gap found another one might be
OPENING_TOL = 1e-6  # of the size: smaller openings within a stretch of contact may be passed over
# Parts into which an interval is split; it decides only the time: for bars 2 takes a fifth longer, 8 a tenth less.
SPLIT_PARTS = 4
BLOCK_PIECES = SPLIT_PARTS**2  # polynomials of a motion in the first intervals
MOST_INTERVALS = 100_000  # at a time; beyond that, the bound that is proven is returned
MOST_NUMBERS = 20_000  # of an array of pairs of corners at places measured at a time; more are no faster, a quarter is slower
KINK_OFFSET = 1e-6  # of a piece, from a least gap: where both sides of a kink are seen
MOST_STEPS = 100  # to a root
LAST_STEP = 1e-12  # to it, of a piece
STEEP_FRACTION = 1e-2  # of the values at the ends: a smaller one, not at a jump, allows a last step 1 / STEEP_FRACTION as long
Stretches = list[tuple[float, float]]


class Least(NamedTuple):
    """The least gap of a pair of links.

    Attributes:
        u: the parameter of the motion at which the gap is least.
        piece: the index of the polynomial of the motion at u.
        distance: the gap (m).
        bound: a proven lower bound of the gap over the motion (m).
        parts: the indices of the closest part of each link.
        places: the closest points of both outlines (m), the first on the first link.
        features: the closest features; two at a kink, where the gap of one feature falls and that of another one rises.
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
    """Return the least gap of each pair of links, and the intervals of u over which the links of each pair touch.

    Args:
        parts: convex parts of links with concrete numbers.
        order: names of the bodies in the order of their poses, with the ground last.
        pairs: the pairs of links.
        motion: the motion.
    """
    tables = MotionTables(motion)
    searches = [PairSearch(group, tables) for group in part_pairs(parts, order, pairs)]
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


class Intervals(NamedTuple):
    """Intervals of a motion: each belongs to a pair of parts k and is from place s0, with the gap d0, to s1, with the gap d1.

    `low` is a lower bound of the gap within the interval.
    """

    k: Int[np.ndarray, "n"]
    s0: Float[np.ndarray, "n"]
    s1: Float[np.ndarray, "n"]
    d0: Float[np.ndarray, "n"]
    d1: Float[np.ndarray, "n"]
    low: Float[np.ndarray, "n"]

    @classmethod
    def joined(cls, intervals: "Sequence[Intervals]") -> "Intervals":
        """Return the intervals of several `Intervals` as one."""
        return cls(*(np.concatenate(x) for x in zip(*intervals, strict=True)))


class PairSearch:
    """A search for the least gaps and the contacts of pairs of parts along a motion; places s are those of `MotionTables`.

    For each pair of parts, `least` is the least gap found, `s` its place, `step` the length of the intervals around it, and `low`
    a lower bound of its gaps over the motion.
    """

    def __init__(self, pairs: PartPairs, motion: MotionTables):
        self.pairs, self.motion, self.reach, self.radius = pairs, motion, pairs.reach, pairs.radius
        bodies, count = np.unique(pairs.bodies), len(pairs.owner)
        extent = (motion.highest[:, bodies].max(1) - motion.lowest[:, bodies].min(1)).max()
        self.size = float(extent) + float(self.reach.max()) + float(self.radius.max())
        self.rounding, self.points = ROUNDING * self.size, MOST_NUMBERS // (pairs.counts[0] * pairs.counts[1])
        self.least, self.low = np.full((2, count), np.inf)
        self.s, self.step = np.zeros((2, count))
        self.crossings: list[np.ndarray] = []  # pairs, places s0 and s1, gaps there
        self.touching_at_ends: list[np.ndarray] = []  # pairs that touch at the starts and at the ends of chains (pairs, chains)

    def closest_places(self, k: np.ndarray, s: np.ndarray) -> ClosestPlaces:
        """Return the closest places of the pairs of parts k at places s of the motion."""
        return self.pairs.closest_places(k, [self.motion.poses(bodies[k], s) for bodies in self.pairs.bodies])

    def _gaps(self, k: np.ndarray, s: np.ndarray) -> Float[np.ndarray, "n"]:
        return self.pairs.closest(k, self._frames(k, s))[1].distance - self.radius[k]

    def _frames(self, k: np.ndarray, s: np.ndarray) -> list[PlacedFrames]:
        return [PlacedFrames.of(self.motion.poses(bodies[k], s)[0]) for bodies in self.pairs.bodies]

    def run(self, least: Float[np.ndarray, "owners"]) -> None:
        """Split intervals until no gap within one can be below the least found and no contact can be hidden in one.

        Args:
            least: the least gap found of each pair of links, which is updated in place.
        """
        left, step = self._first_intervals(least), float(BLOCK_PIECES)
        while 0 < len(left.k) <= MOST_INTERVALS:
            step /= SPLIT_PARTS
            rows, found = max(1, self.points // (SPLIT_PARTS + 1)), []
            for first in range(0, len(left.k), rows):
                k, s0, s1 = (x[first : first + rows, None] for x in left[:3])
                s = np.minimum(s0 + step * np.arange(SPLIT_PARTS + 1), s1).ravel()
                k = np.broadcast_to(k, (len(k), SPLIT_PARTS + 1)).ravel()
                kept = np.append(True, (s[1:] != s[:-1]) | (k[1:] != k[:-1]))
                inside = (np.arange(len(k)) % (SPLIT_PARTS + 1) > 0)[kept][1:]
                k, s = k[kept], s[kept]
                found.append(self._open(k, s, self._frames(k, s), inside, step, least)[0])
            left = Intervals.joined(found)
        self._finish(left)

    def _first_intervals(self, least: Float[np.ndarray, "owners"]) -> Intervals:
        """Evaluate intervals of `BLOCK_PIECES` pieces, and return those that must be split; set `touching_at_ends`."""
        motion, count = self.motion, len(self.least)
        blocks = [np.append(np.arange(*ends, BLOCK_PIECES), ends[1]) for ends in zip(motion.starts, motion.ends, strict=True)]
        s, last = np.concatenate(blocks).astype(float), np.cumsum([len(x) for x in blocks]) - 1
        first, inside = np.append(0, last[:-1] + 1), np.ones(len(s), bool)
        inside[last] = False
        bodies, rows = np.unique(self.pairs.bodies, return_inverse=True)
        frames = PlacedFrames.of(motion.poses(np.repeat(bodies, len(s)), np.tile(s, len(bodies)))[0])
        rows, found, touching = rows.reshape(2, -1), [], []
        size = max(1, self.points // len(s))
        for start in range(0, count, size):
            some = np.arange(start, min(start + size, count))
            at = ((rows[:, some] * len(s))[..., None] + np.arange(len(s))).reshape(2, -1)
            k, places, within = np.repeat(some, len(s)), np.tile(s, len(some)), np.tile(inside, len(some))[:-1]
            intervals, gaps = self._open(k, places, [frames.take(x) for x in at], within, float(BLOCK_PIECES), least)
            found.append(intervals)
            touching.append(gaps.reshape(-1, len(s)) < 0)
        self.touching_at_ends = [np.concatenate([x[:, ends] for x in touching]) for ends in (first, last)]
        return Intervals.joined(found)

    def _open(
        self, k: np.ndarray, s: np.ndarray, frames: list[PlacedFrames], inside: np.ndarray, step: float, least: np.ndarray
    ) -> tuple[Intervals, Float[np.ndarray, "n"]]:
        """Return the intervals between neighbouring places that must be split, and the gaps at all places; finish the others.

        Args:
            k: the pair of parts of each place, in increasing order.
            s: places.
            frames: frames of both bodies at these places.
            inside: True where a place and the next one are the ends of an interval.
            step: the largest length of the intervals.
            least: the least gap found of each pair of links, which is updated in place.
        """
        corners, near = self.pairs.closest(k, frames)
        radius = self.radius[k]
        d = near.distance - radius
        self._note(k, s, d, step, least)
        low, high = self._bounds(k, s, d, corners, near.n, radius, step)
        is_open = self._is_open(k[:-1], low, high, d[:-1], d[1:], least) & inside
        if step <= 1 and len(i := np.flatnonzero(is_open)):
            bound, at = self._bounds_by_features(k[i], s, i, corners, near)
            low[i], between = np.fmax(low[i], bound - radius[i]), s[i] + at * (s[i + 1] - s[i])
            self._note(k[i], between, self._gaps(k[i], between), step, least)
            is_open[i] = self._is_open(k[i], low[i], high[i], d[i], d[i + 1], least)
        is_closed = inside & ~is_open
        intervals = k[:-1], s[:-1], s[1:], d[:-1], d[1:], low
        self._finish(Intervals(*(x[is_closed] for x in intervals)))
        return Intervals(*(x[is_open] for x in intervals)), d

    def _finish(self, found: Intervals) -> None:
        np.minimum.at(self.low, found.k, found.low)
        crosses = (found.d0 < 0) != (found.d1 < 0)
        if crosses.any():
            self.crossings.append(np.stack([x[crosses] for x in found[:5]]))

    def _bounds(
        self, k: np.ndarray, s: np.ndarray, d: np.ndarray, corners: tuple[Corners, Corners], n: np.ndarray, radius: np.ndarray,
        step: float,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return lower and upper bounds of gaps between neighbouring places, by lengths of paths and directions at the ends."""
        u = self.motion.parameters(s)
        h, piece, (speed, acceleration) = u[1:] - u[:-1], self.motion.piece_at[s[:-1].astype(int)], np.zeros((2, len(k) - 1))
        largest, k = self.motion.over(max(1, int(step))), k[:-1]
        for bodies, reach in zip(self.pairs.bodies, self.reach, strict=True):
            (v, a), (w, c) = largest.take(bodies[k] * self.motion.pieces + piece, -1)
            speed += v + reach[k] * w
            acceleration += a + reach[k] * c
        A, B = corners
        to_end = (n[:, :-1] * B[..., 1:]).sum(1).min(0) - (n[:, :-1] * A[..., 1:]).sum(1).max(0) - radius[1:]
        to_start = (n[:, 1:] * B[..., :-1]).sum(1).min(0) - (n[:, 1:] * A[..., :-1]).sum(1).max(0) - radius[1:]
        chord = np.maximum(np.minimum(d[:-1], to_end), np.minimum(d[1:], to_start)) - acceleration * h**2 / 8
        mean, way = 0.5 * (d[:-1] + d[1:]), 0.5 * speed * h
        return np.maximum(mean - way, chord), mean + way

    def _bounds_by_features(
        self, k: np.ndarray, s: np.ndarray, i: np.ndarray, corners: tuple[Corners, Corners], near: Closest
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the results of `bounds_by_features` for the intervals from places i to i + 1: lower bounds, and fractions."""
        ends, u = np.stack([i, i + 1]), self.motion.parameters(s)
        piece, parts = s[i].astype(int), []
        for bodies, places, reach in zip(self.pairs.bodies, corners, self.reach, strict=True):
            body = bodies[k]
            q, v = (x.reshape(3, 2, -1) for x in self.motion.poses(np.tile(body, 2), s[ends].ravel()))
            at, row = places.take(ends, -1), body * self.motion.pieces + piece
            rate = v[:2] + v[2] * np.stack([q[1] - at[:, 1], at[:, 0] - q[0]], 1)
            directions = np.concatenate([np.ones((1, len(k))), self.motion.directions.take(row, -1)])
            parts.append(MovingPart(Moving(at, rate), q[:2], v[2], reach[k], self.motion.places.take(row, -1), directions))
        return bounds_by_features(parts[0], parts[1], near.features(self.pairs.counts, ends), u[i + 1] - u[i])

    def _is_open(
        self, k: np.ndarray, low: np.ndarray, high: np.ndarray, d0: np.ndarray, d1: np.ndarray, least: np.ndarray
    ) -> Bool[np.ndarray, "n"]:
        """Return a mask of the intervals in which a gap may be below the least one, or a change of its sign is not isolated."""
        slack, opened = PROVEN_TOL * self.size, OPENING_TOL * self.size
        hides = ((low < -slack) & (np.minimum(d0, d1) > 0)) | ((high > opened) & (np.maximum(d0, d1) < 0))
        crosses = ((d0 < 0) != (d1 < 0)) & (high - low > opened)
        return (low < least[self.pairs.owner[k]] - slack) | hides | crosses

    def _note(self, k: np.ndarray, s: np.ndarray, d: np.ndarray, step: float, least: np.ndarray) -> None:
        """Update the least gaps of the pairs of parts k by gaps d at places s; `step` is the length of the intervals around s.

        Of equal gaps the first one is kept. `least`, of the pairs of links, is updated, too.
        """
        begins = np.flatnonzero(np.append(True, k[1:] != k[:-1]))
        equal = np.minimum.reduceat(d, begins) + self.rounding
        at = np.flatnonzero(d <= np.repeat(equal, np.diff(np.append(begins, len(k)))))
        at = at[np.append(True, k[at[1:]] != k[at[:-1]])]
        kept = self.least[k[at]]
        at = at[(d[at] < kept - self.rounding) | ((d[at] <= kept + self.rounding) & (s[at] < self.s[k[at]]))]
        pair = k[at]
        self.least[pair], self.s[pair], self.step[pair] = np.minimum(self.least[pair], d[at]), s[at], step
        np.minimum.at(least, self.pairs.owner[pair], d[at])

    def found(self, k: Int[np.ndarray, "n"], low_of: Float[np.ndarray, "owners"]) -> list[Least]:
        """Return the least gaps of the pairs of parts k, located to rounding: where their rate changes its sign, or at an end.

        `low_of` has a lower bound of the gap of each pair of links.
        """
        motion, s, step = self.motion, self.s[k], self.step[k]
        chain = np.searchsorted(motion.starts, s, side="right") - 1
        first, last = motion.starts[chain], motion.ends[chain]
        bracket = low, high = np.maximum(first, s - step), np.minimum(last, s + step)
        ends = self.closest_places(np.tile(k, 2), np.concatenate(bracket))
        slopes, root = ends.rate.reshape(2, -1), s.copy()
        inner = np.flatnonzero((slopes[0] < 0) & (slopes[1] > 0))
        root[inner] = _roots(lambda x, i: self.closest_places(k[inner[i]], x).rate, *(x[inner] for x in (low, high, *slopes, s)))

        def around(i: np.ndarray, s: np.ndarray) -> list[ClosestPlaces]:
            places = np.maximum(s - KINK_OFFSET, low[i]), s, np.minimum(s + KINK_OFFSET, high[i])
            at = self.closest_places(np.tile(k[i], 3), np.concatenate(places))
            return [at.take(slice(n * len(i), (n + 1) * len(i))) for n in range(3)]

        sides = around(np.arange(len(k)), root)
        gaps = np.stack([sides[1].gap - self.rounding, *ends.gap.reshape(2, -1), self.least[k]])
        best = gaps.argmin(0)
        other = np.flatnonzero(best > 0)
        if len(other):
            places = np.stack([root, low, high, s])[best, np.arange(len(k))]
            for kept, new in zip(sides, around(other, places[other]), strict=True):
                for x, y in zip(kept.arrays, new.arrays, strict=True):
                    x[..., other] = y
            root = places
        before, here, after = sides
        fixed = ((root <= first) & (slopes[0] > 0)) | ((root >= last) & (slopes[1] < 0))
        steep = KINK_OFFSET**0.5 * np.abs(slopes)
        kink = (before.rate < -steep[0]) & (after.rate > steep[1]) & ~fixed
        places = here.places + np.array([[[1.0]], [[-1.0]]]) * self.pairs.radii[:, None, k] * here.n
        bounds = np.minimum(here.gap, low_of[self.pairs.owner[k]])
        features = [list(map(Feature._make, zip(*(y.tolist() for y in x.features), strict=True))) for x in (before, here, after)]
        shown = [(x, z) if is_kink else (y,) for is_kink, x, y, z in zip(kink.tolist(), *features, strict=True)]
        numbers = (motion.parameters(root), motion.piece_at[root.astype(int)], here.gap, bounds)
        columns = (
            *(x.tolist() for x in numbers),
            map(tuple, self.pairs.parts[:, k].T.tolist()),
            np.moveaxis(places, -1, 0),
            shown,
        )
        return [Least._make(x) for x in zip(*columns, fixed.tolist(), strict=True)]

    def touches(self) -> list[tuple[int, Stretches]]:
        """Return for each pair of parts that touches the index of its pair of links, and the intervals of u of its contacts."""
        at_start, at_end = self.touching_at_ends
        rows = np.concatenate([np.zeros((5, 0)), *self.crossings], 1)
        k, motion, (s0, s1, d0, d1) = rows[0].astype(int), self.motion, rows[1:]
        places = motion.parameters(_roots(lambda s, i: self._gaps(k[i], s), s0, s1, d0, d1, 0.5 * (s0 + s1)))
        found, falls = [], d0 >= 0
        for pair in np.flatnonzero(at_start.any(1) | (np.bincount(k, minlength=len(self.least)) > 0)).tolist():
            begins, ceases = (
                np.sort(np.append(places[(k == pair) & (falls == first)], motion.motion.u[ends][touching[pair]]))
                for first, ends, touching in ((True, motion.starts, at_start), (False, motion.ends, at_end))
            )
            found.append((int(self.pairs.owner[pair]), list(zip(begins.tolist(), ceases.tolist(), strict=True))))
        return found


def _roots(
    f: Callable[[Any, Any], Any], low: np.ndarray, high: np.ndarray, f_low: np.ndarray, f_high: np.ndarray, guess: np.ndarray
) -> Float[np.ndarray, "n"]:
    """Return a root of each of n functions, from an interval at whose ends its values have different signs.

    The method is that of secants, each of which replaces one end; the value at an end that stays is reduced.

    Args:
        f: returns the values at some places (first argument) of the functions with the given indices (second argument).
        low: one end of each interval.
        high: the other end.
        f_low: the values at `low`.
        f_high: the values at `high`.
        guess: a first place within each interval.

    Source: N. Anderson and A. Bjorck, A new high order method of regula falsi type, BIT 13 (1973).
    """
    (a, b), (fa, fb), i = np.array([low, high]), np.array([f_low, f_high]), np.arange(len(low))
    place, steep = guess, STEEP_FRACTION * np.maximum(np.abs(f_low), np.abs(f_high))
    for _ in range(MOST_STEPS):
        if not len(i):
            break
        far, near, f_far, f_near = a[i], b[i], fa[i], fb[i]
        value = f(place, i)
        passed = (value < 0) != (f_near < 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = 1.0 - value / f_near
        a[i], fa[i] = np.where(passed, near, far), np.where(passed, f_near, f_far * np.where(share > 0, share, 0.5))
        b[i], fb[i] = place, value
        step = np.minimum(np.abs(place - near), np.abs(place - a[i]))
        i = i[(value != 0) & (step > np.where(np.abs(value) > steep[i], LAST_STEP, LAST_STEP / STEEP_FRACTION))]
        place = b[i] - fb[i] * (b[i] - a[i]) / (fb[i] - fa[i])
    return b


def _joined(stretches: Stretches) -> Stretches:
    """Return stretches in which overlapping ones are merged."""
    found: Stretches = []
    for start, end in sorted(stretches):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(end, found[-1][1])
        else:
            found.append((start, end))
    return found
