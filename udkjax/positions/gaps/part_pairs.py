"""Pairs of convex parts of links in poses: their gaps, their closest points and features, and the rates of the gaps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from udkjax.positions.gaps.convex import Closest, Corners, Feature, closest
from udkjax.positions.gaps.shapes import ConvexPart


class PlacedFrames(NamedTuple):
    """The frames of bodies (n): their origins, and the cosines and sines of their angles."""

    x: np.ndarray
    y: np.ndarray
    cos: np.ndarray
    sin: np.ndarray

    @classmethod
    def of(cls, q: Float[np.ndarray, "3 n"]) -> "PlacedFrames":
        """Return the frames of n bodies in the poses q: x, y (m) and angle (rad)."""
        return cls(q[0], q[1], np.cos(q[2]), np.sin(q[2]))

    def take(self, k: Int[np.ndarray, "n"]) -> "PlacedFrames":
        """Return the frames with the indices k."""
        return PlacedFrames(*(x.take(k) for x in self))

    def place(self, corners: Corners) -> Corners:
        """Return corners in ground axes, from the corners (V, 2, n) in these frames."""
        a, b = corners[:, 0], corners[:, 1]
        placed = np.empty_like(corners)
        np.subtract(self.cos * a, self.sin * b, out=placed[:, 0])
        np.add(self.sin * a, self.cos * b, out=placed[:, 1])
        placed[:, 0] += self.x
        placed[:, 1] += self.y
        return placed


class ClosestPlaces(NamedTuple):
    """The closest places of n pairs of parts A and B.

    Attributes:
        gap: the gaps (m), (n,).
        features: the closest features.
        places: the closest points of the hulls of the corners, without radii, in ground axes (m): (part, xy, n).
        n: unit vectors from A to B, (2, n).
        rate: derivatives of the gaps by the parameter of the motion, (n,).
    """

    gap: np.ndarray
    features: Feature
    places: np.ndarray
    n: np.ndarray
    rate: np.ndarray

    @property
    def arrays(self) -> list[np.ndarray]:
        """A list of all arrays, with those of `features`."""
        return [self.gap, *self.features, self.places, self.n, self.rate]

    def take(self, k: slice) -> "ClosestPlaces":
        """Return the closest places of the cases k."""
        return ClosestPlaces(self.gap[k], self.features.take(k), self.places[..., k], self.n[:, k], self.rate[k])


class PartPairs(NamedTuple):
    """Pairs of convex parts with the same numbers of corners.

    Attributes:
        owner: the index of the pair of links to which each pair of parts belongs.
        parts: the indices of both parts in the list of all parts.
        bodies: the indices of the bodies of both parts.
        A: corners of the first parts, in the frames of their bodies (m).
        B: corners of the second parts.
        radii: the radii around both parts (m).
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

    @property
    def counts(self) -> tuple[int, int]:
        """The number of corners of each first part, and of each second part."""
        return len(self.A), len(self.B)

    @property
    def reach(self) -> Float[np.ndarray, "2 n"]:
        """The largest distance of a corner of each part from the origin of its body (m)."""
        return np.stack([np.sqrt((x * x).sum(1).max(0)) for x in (self.A, self.B)])

    def placed(self, k: Int[np.ndarray, "n"], frames: Sequence[PlacedFrames]) -> tuple[Corners, Corners]:
        """Return the corners of both parts of the pairs k in ground axes, with their bodies in the given frames."""
        return frames[0].place(self.A.take(k, -1)), frames[1].place(self.B.take(k, -1))

    def closest(self, k: Int[np.ndarray, "n"], frames: Sequence[PlacedFrames]) -> tuple[tuple[Corners, Corners], Closest]:
        """Return the corners of the pairs k as `placed` does, and their `Closest`, whose distances ignore the radii."""
        corners = self.placed(k, frames)
        return corners, closest(*corners)

    def closest_places(self, k: Int[np.ndarray, "n"], poses: Sequence[tuple[np.ndarray, np.ndarray]]) -> ClosestPlaces:
        """Return the closest places of the pairs k, from the poses (3, n) of both bodies and their derivatives (3, n)."""
        corners, near = self.closest(k, [PlacedFrames.of(q) for q, _ in poses])
        found, every = near.features(self.counts, slice(None)), np.arange(len(k))
        A, B = (x[np.minimum(found.corner, len(x) - 1), :, every].T for x in corners)
        way = near.distance * near.n
        places = np.where(found.of_a, [A, A + way], [B - way, B])
        rates = [
            near.n[0] * (v[0] - v[2] * (here[1] - q[1])) + near.n[1] * (v[1] + v[2] * (here[0] - q[0]))
            for (q, v), here in zip(poses, places, strict=True)
        ]
        return ClosestPlaces(near.distance - self.radius[k], found, places, near.n, rates[1] - rates[0])


def part_pairs(parts: Sequence[ConvexPart], order: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[PartPairs]:
    """Return all pairs of parts of the given pairs of links, grouped by the numbers of corners of both parts.

    Args:
        parts: the parts of all links.
        order: names of the bodies, by their indices.
        pairs: the names of the links of each pair.
    """
    groups: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    corners, of_body = [np.asarray(part.corners, float) for part in parts], {}
    for k, part in enumerate(parts):
        of_body.setdefault(part.body, []).append(k)
    for owner, (one, other) in enumerate(pairs):
        for i in of_body[one]:
            for j in of_body[other]:
                groups.setdefault((len(corners[i]), len(corners[j])), []).append((owner, i, j))
    found, body = [], np.array([order.index(part.body) for part in parts])
    radius = np.array([float(part.radius) for part in parts])
    for (one, other), members in groups.items():
        owner, *both = np.array(members).T
        shapes = {n: np.stack([x if len(x) == n else np.zeros((n, 2)) for x in corners], -1) for n in {one, other}}
        A, B = (shapes[n].take(x, -1) for n, x in zip((one, other), both, strict=True))
        found.append(PartPairs(owner, np.array(both), body[np.array(both)], A, B, radius[np.array(both)]))
    return found
