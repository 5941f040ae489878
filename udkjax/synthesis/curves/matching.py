"""Parts of the curves of random linkages that resemble a target after turning, scaling and moving, by cross-correlation."""

from typing import NamedTuple

import numpy as np

from udkjax.arrays import FULL_TURN
from udkjax.synthesis.curves.descent import LinkageLimits
from udkjax.synthesis.curves.dyad_forms import RAIL
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    HEAD_NUMBERS,
    SECOND_ANGLE,
    SECOND_PIVOT,
    SPAN_INDEX,
    Topology,
    positions,
)
from udkjax.synthesis.curves.random_linkages import Linkages, random_linkages, turn_angles
from udkjax.synthesis.curves.targets import WantedCurve, resampled

CURVE_POINTS = 96  # of a curve, at equal arc lengths
PART_POINTS = (20, 28, 36, 44, 52, 60, 68, 76, 84)  # points of parts that are compared with an open target


class _Matches(NamedTuple):
    """The best part of each curve: error, first point, number of points, and the similarity p -> factor p + offset."""

    error: np.ndarray
    start: np.ndarray
    count: np.ndarray
    factor: np.ndarray
    offset: np.ndarray


def find_starts(
    wanted: WantedCurve,
    limits: LinkageLimits,
    dyads: int,
    samples: int,
    keep: int,
    rng: np.random.Generator,
    geared: bool = False,
    slides: float = 0.0,
) -> Linkages:
    """Return the `keep` linkages of `samples` random ones whose curves are most similar to the target, moved onto it.

    Args:
        wanted: the wanted curve.
        limits: the limits; linkages whose dyads exceed the cosine are left out.
        dyads: the number of dyads.
        samples: the number of random linkages.
        keep: the largest number of linkages to return.
        rng: the generator of random numbers.
        geared: whether linkages have a second crank.
        slides: the fraction of dyads that have a slide.
    """
    x, topology = random_linkages(samples, dyads, rng, geared, slides)
    at = positions(x, topology, turn_angles(samples))
    turns = (np.abs(at.cosines) < limits.cosine).all((0, 2))
    x, topology = x[turns], topology.take(turns)
    curves, places = _by_arc_length(at.pin[turns])
    match = _match(curves, _parts(wanted))
    best = np.argsort(match.error, kind="stable")[:keep]
    x, topology, match, places = x[best], topology.take(best), _Matches(*(a[best] for a in match)), places[best]
    rows, end = np.arange(len(best)), match.start + match.count - 1
    step = FULL_TURN / at.pin.shape[1]
    first = places[rows, match.start] * step
    last = places[rows, end % CURVE_POINTS] * step + FULL_TURN * (end >= CURVE_POINTS)
    is_whole = match.count == CURVE_POINTS
    x = _moved(x, topology, match.factor, match.offset, np.where(is_whole, 0.0, first))
    x[:, SPAN_INDEX] = np.where(is_whole, FULL_TURN, last - first)
    return x, topology


def _parts(wanted: WantedCurve) -> list[np.ndarray]:
    """Return the targets to which parts of curves are compared: the wanted curve at the number of points of each part.

    For a whole turn, an open curve runs forth and back.
    """
    if wanted.is_closed:
        return [resampled(wanted.points, CURVE_POINTS, True)]
    there = wanted.points
    whole = [resampled(np.concatenate([there, there[-2::-1]]), CURVE_POINTS, True)]
    return whole if wanted.is_whole else [*whole, *(resampled(there, count) for count in PART_POINTS)]


def _by_arc_length(pin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (K, CURVE_POINTS) of closed curves (K, T) at equal arc lengths, and their fractional indices."""
    K, T = pin.shape
    closed = np.concatenate([pin, pin[:, :1]], 1)
    way = np.concatenate([np.zeros((K, 1)), np.cumsum(np.abs(np.diff(closed, axis=1)), 1)], 1)
    way /= np.maximum(way[:, -1:], 1e-300)
    rows, wanted = np.arange(K)[:, None], np.arange(CURVE_POINTS) / CURVE_POINTS
    low = np.searchsorted((way + rows).ravel(), (wanted + rows).ravel(), side="right").reshape(K, CURVE_POINTS) - 1
    low = np.clip(low - rows * (T + 1), 0, T - 1)
    before, after = way[rows, low], way[rows, low + 1]
    part = np.clip((wanted - before) / np.maximum(after - before, 1e-300), 0.0, 1.0)
    return closed[rows, low] * (1.0 - part) + closed[rows, low + 1] * part, low + part


def _match(curves: np.ndarray, targets: list[np.ndarray]) -> _Matches:
    """Return the part of each curve (K, CURVE_POINTS) most similar to a target, over all first points, targets and directions."""
    K, rows = len(curves), np.arange(len(curves))
    spectrum, twice = np.fft.fft(curves, axis=1), np.concatenate([curves, curves], 1)
    sums = np.concatenate([np.zeros((K, 1)), np.cumsum(twice, 1)], 1)
    squares = np.concatenate([np.zeros((K, 1)), np.cumsum(np.abs(twice) ** 2, 1)], 1)
    none = np.zeros(K, complex)
    best = _Matches(np.full(K, np.inf), np.zeros(K, int), np.zeros(K, int), none, none)
    for target in targets:
        m, middle = len(target), target.mean()
        mean = (sums[:, m : m + CURVE_POINTS] - sums[:, :CURVE_POINTS]) / m
        energy = np.maximum(squares[:, m : m + CURVE_POINTS] - squares[:, :CURVE_POINTS] - m * np.abs(mean) ** 2, 1e-12)
        size = np.sum(np.abs(target - middle) ** 2)
        for order in (target - middle, (target - middle)[::-1]):
            padded = np.concatenate([order, np.zeros(CURVE_POINTS - m)])
            product = np.conj(np.fft.ifft(spectrum * np.conj(np.fft.fft(padded))))
            error = 1.0 - np.abs(product) ** 2 / (energy * size)
            start = error.argmin(1)
            factor = product[rows, start] / energy[rows, start]
            new = _Matches(error[rows, start], start, np.full(K, m), factor, middle - factor * mean[rows, start])
            better = new.error < best.error
            best = _Matches(*(np.where(better, a, b) for a, b in zip(new, best, strict=True)))
    return best


def _moved(x: np.ndarray, topology: Topology, factor: np.ndarray, offset: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Return the numbers of linkages moved by p -> factor p + offset, whose turn begins at the angle `start` of the crank."""
    x, size = x.copy(), np.abs(factor)

    def move(k: int, a: np.ndarray, b: np.ndarray | float) -> None:
        p = a * (x[:, k] + 1j * x[:, k + 1]) + b
        x[:, k], x[:, k + 1] = np.real(p), np.imag(p)

    move(0, factor, offset)
    move(SECOND_PIVOT, factor, offset)
    x[:, SECOND_ANGLE] += topology.ratio * start + np.angle(factor)
    of_link = np.stack([factor, factor * np.exp(1j * start), size + 0j, size + 0j])
    rows = np.arange(len(x))
    for d in range(topology.dyads):
        k = HEAD_NUMBERS + DYAD_NUMBERS * d
        for j, link in ((k, topology.first[:, d]), (k + 2, topology.second[:, d])):
            move(j, of_link[np.minimum(link, BASE_LINKS), rows], np.where(link == 0, offset, 0.0))
        turned = np.angle(of_link[np.minimum(topology.second[:, d], BASE_LINKS), rows])
        x[:, k + 4] *= size
        x[:, k + 5] = np.where(topology.form[:, d] == RAIL, x[:, k + 5] + turned, x[:, k + 5] * size)
    move(x.shape[1] - 2, size + 0j, 0.0)
    return x
