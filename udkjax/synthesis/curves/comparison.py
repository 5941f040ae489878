"""The smooth Chamfer distance of curves from a target, with its exact derivatives.

With the distances d of points from the nearest place of the other polyline, and rho(d) = sqrt(d^2 + blur^2) - blur, it is

    sum_i sigma_i rho(d_i) + mean_j rho(d_j)

over the points i of the curve and j of the target; sigma_i are shares of the curve's length. The derivative of a distance is that
with the nearest place held. In the second derivatives for steps, distances along normals have full weight and tangential ones
little, except past an end.

Source: E. Weiszfeld, "Sur le point pour lequel la somme des distances de n points donnés est minimum", 1937 (weights);
S. Rusinkiewicz and M. Levoy, "Efficient variants of the ICP algorithm", 2001 (distances along normals).
"""

from typing import NamedTuple

import numpy as np

from udkjax.synthesis.curves.dyad_forms import TINY
from udkjax.synthesis.curves.targets import CurveTarget

# Weight of tangential moves within neighbours, relative to normal ones: it keeps points from sliding for nothing.
TANGENTIAL_WEIGHT = 0.02


class CurveComparison(NamedTuple):
    """Smooth Chamfer distances of K curves of N points.

    Attributes:
        distance: the distances (K,).
        pull: their derivatives with respect to the points, d/dx + i d/dy (K, N).
        moments: xx, xy and yy of a positive second derivative for each point (3, K, N).
        of_curve: rho of the points of the curves, times their shares (K, N).
        of_target: rho of the points of the target, each an even share (K, M).
    """

    distance: np.ndarray
    pull: np.ndarray
    moments: np.ndarray
    of_curve: np.ndarray
    of_target: np.ndarray


class _Feet(NamedTuple):
    """The places of a polyline that are nearest to points, each on a segment from the nearest vertex to one of its neighbours.

    Attributes:
        offset: the vector from the nearest place to the point, complex.
        share: the distance of the place from the vertex, as a fraction of the segment.
        is_next: whether the neighbour is the next vertex; otherwise it is the previous one.
        normal: the unit normal of the segment, complex.
        is_between: whether the place is not at an end of the segment.
    """

    offset: np.ndarray
    share: np.ndarray
    is_next: np.ndarray
    normal: np.ndarray
    is_between: np.ndarray


def _feet(p: np.ndarray, vertex: np.ndarray, following: np.ndarray, previous: np.ndarray) -> _Feet:
    """Return the places nearest to points p, on the segments from each `vertex` to its neighbours `following` and `previous`."""
    found = []
    for way in (following - vertex, previous - vertex):
        square = np.real(way) ** 2 + np.imag(way) ** 2
        share = np.clip(np.real(np.conj(way) * (p - vertex)) / (square + TINY), 0.0, 1.0)
        offset = p - vertex - share * way
        found.append((np.real(offset) ** 2 + np.imag(offset) ** 2, offset, share, way, (share > 0.0) & (share < 1.0)))
    is_next = found[0][0] <= found[1][0]
    offset, share, way, is_between = (np.where(is_next, a, b) for a, b in zip(found[0][1:], found[1][1:], strict=True))
    size = np.abs(way)
    return _Feet(offset, share, is_next, np.where(size > 0.0, 1j * way / np.maximum(size, TINY), 1.0), is_between)


def _pairs(offset: np.ndarray, feet: _Feet, blur: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rho, its derivatives with respect to the offsets, d/dx + i d/dy, and positive second derivatives xx, xy, yy."""
    length = np.sqrt(np.real(offset) ** 2 + np.imag(offset) ** 2 + blur**2)
    x, y, weight = np.real(feet.normal), np.imag(feet.normal), 1.0 / length
    along = np.where(feet.is_between, TANGENTIAL_WEIGHT, 1.0)
    moments = weight * np.stack([x * x + along * y * y, (1.0 - along) * x * y, y * y + along * x * x])
    return length - blur, weight * offset, moments


def compare(c: np.ndarray, target: CurveTarget, is_whole: bool, blur: float) -> CurveComparison:
    """Return the smooth Chamfer distances of curves (K, N) from a target, with derivatives.

    Args:
        c: complex points of the curves.
        target: the target.
        is_whole: whether the last points of the curves meet the first.
        blur: distance below which squares count.
    """
    (K, N), rows = c.shape, np.arange(len(c))[:, None]
    following, previous = np.roll(c, -1, 1), np.roll(c, 1, 1)
    if not is_whole:
        following[:, -1], previous[:, 0] = c[:, -1], c[:, 0]
    way = following - c
    step = np.abs(way)
    total = step.sum(1, keepdims=True) + TINY
    share = 0.5 * (step + np.abs(c - previous)) / total
    distance = (np.real(c)[:, :, None] - np.real(target.points)) ** 2
    distance += (np.imag(c)[:, :, None] - np.imag(target.points)) ** 2
    near, nearest = distance.argmin(2), distance.argmin(1)

    feet = _feet(c, target.points[near], target.following[near], target.previous[near])
    rho, slope, moments = _pairs(feet.offset, feet, blur)
    of_curve, pull, moments = share * rho, share * slope, share * moments
    # Shares change with the lengths of segments.
    mean = of_curve.sum(1, keepdims=True)
    tension = 0.5 * (rho + np.roll(rho, -1, 1) - 2.0 * mean) / total * way / (step + TINY)
    pull += np.roll(tension, 1, 1) - tension

    feet = _feet(target.points, c[rows, nearest], following[rows, nearest], previous[rows, nearest])
    rho, slope, more = _pairs(-feet.offset, feet, blur)
    even = 1.0 / len(target.points)
    neighbour = nearest + np.where(feet.is_next, 1, -1)
    neighbour = neighbour % N if is_whole else np.clip(neighbour, 0, N - 1)
    for place, part in ((nearest, even * (1.0 - feet.share)), (neighbour, even * feet.share)):
        index = (rows * N + place).ravel()
        x, y, *seconds = (
            np.bincount(index, (part * a).ravel(), K * N).reshape(K, N) for a in (np.real(slope), np.imag(slope), *more)
        )
        pull += x + 1j * y
        moments += np.stack(seconds)
    return CurveComparison(mean[:, 0] + even * rho.sum(1), pull, moments, of_curve, even * rho)
