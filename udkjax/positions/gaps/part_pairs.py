"""Pairs of convex parts of links in poses: their gaps, where they are closest, and how fast the gaps change."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from udkjax.positions.gaps.convex import Feature, feature, gap_at, signed_distance
from udkjax.positions.gaps.shapes import ConvexPart


class Closest(NamedTuple):
    """The closest features of parts, directions from A to B (2, n), places (2, 2, n), rates of gaps, and corners."""

    features: Feature
    n: np.ndarray
    places: np.ndarray
    rate: np.ndarray
    placed: list[np.ndarray]


class PartPairs(NamedTuple):
    """Pairs of convex parts with the same numbers of corners.

    Attributes:
        owner: the pair of links of each.
        parts: numbers of both parts.
        bodies: numbers of their bodies.
        A: corners of the first ones.
        B: corners of the second ones.
        radii: the radii around them (m).
    """

    owner: Int[np.ndarray, "n"]
    parts: Int[np.ndarray, "2 n"]
    bodies: Int[np.ndarray, "2 n"]
    A: Float[np.ndarray, "V 2 n"]
    B: Float[np.ndarray, "W 2 n"]
    radii: Float[np.ndarray, "2 n"]

    @property
    def radius(self) -> Float[np.ndarray, "n"]:
        """The sum of both radii of each pair (m)."""
        return self.radii[0] + self.radii[1]

    def take(self, k: Any) -> "PartPairs":
        """Return the pairs with the indices k."""
        return PartPairs(*(x.take(k, -1) for x in self))  # contiguous along the pairs, unlike x[..., k]

    @property
    def reach(self) -> Float[np.ndarray, "2 n"]:
        """The largest distances of corners from the origins of their bodies."""
        return np.stack([np.hypot(x[:, 0], x[:, 1]).max(0) for x in (self.A, self.B)])

    def placed(self, q: Sequence[Float[np.ndarray, "3 n"]]) -> list[np.ndarray]:
        """Return the corners in poses of the bodies."""
        found = []
        for corners, (x, y, angle) in zip((self.A, self.B), q, strict=True):
            cos, sin = np.cos(angle), np.sin(angle)
            a, b = corners[:, 0], corners[:, 1]
            found.append(np.stack([x + cos * a - sin * b, y + sin * a + cos * b], 1))
        return found

    def gaps(self, q: Sequence[Float[np.ndarray, "3 n"]]) -> Float[np.ndarray, "n"]:
        """Return the gaps in poses of the bodies."""
        return signed_distance(*self.placed(q)) - self.radius

    def closest(self, poses: Sequence[tuple[np.ndarray, np.ndarray]]) -> Closest:
        """Return the closest places of the pairs in poses (3, n) of the bodies, given with their rates."""
        A, B = placed = self.placed([q for q, _ in poses])
        found, every = feature(A, B), np.arange(len(self.owner))
        corner, start, end = (
            np.where(found.of_a, x[of_a % len(x), :, every].T, y[of_b % len(y), :, every].T)
            for x, of_a, y, of_b in (
                (A, found.corner, B, found.corner), (B, found.start, A, found.start), (B, found.end, A, found.end)
            )
        )  # fmt: skip
        _, n, place = gap_at(corner, start, end, found.side, found.at)
        n = np.where(found.of_a, -n, n)
        places = np.where(found.of_a, [corner, place], [place, corner])
        rates = []
        for (q, v), here in zip(poses, places, strict=True):
            arm = here - q[:2]
            rates.append((n * (v[:2] + v[2] * np.stack([-arm[1], arm[0]]))).sum(0))
        return Closest(found, n, places, rates[1] - rates[0], placed)


def part_pairs(parts: Sequence[ConvexPart], order: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[PartPairs]:
    """Return the pairs of parts of pairs of links, one group for each two numbers of corners."""
    groups: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    corners = [np.asarray(part.corners, float) for part in parts]
    for owner, pair in enumerate(pairs):
        one, other = ([k for k, part in enumerate(parts) if part.body == name] for name in pair)
        for i, j in ((i, j) for i in one for j in other):
            groups.setdefault((len(corners[i]), len(corners[j])), []).append((owner, i, j))
    found, body = [], np.array([order.index(part.body) for part in parts])
    radius = np.array([float(part.radius) for part in parts])
    for members in groups.values():
        owner, *both = np.array(members).T
        A, B = (np.stack([corners[k] for k in x], -1) for x in both)
        found.append(PartPairs(owner, np.array(both), body[np.array(both)], A, B, radius[np.array(both)]))
    return found
