"""Random linkages whose crank turns.

A dyad of pins closes over the whole turn if the sum of its lengths exceeds the largest distance of P and Q, and their difference
is below the smallest; with a rail, if its length exceeds the largest distance of P from the rail; with a slide, if its offset is
below the smallest distance of P and Q. Numbers are drawn within these limits, so that few linkages are rejected.
"""

import numpy as np

from udkjax.arrays import FULL_TURN
from udkjax.synthesis.curves.descent import Sampling
from udkjax.synthesis.curves.dyad_forms import PINS, RAIL, SLIDE, cross
from udkjax.synthesis.curves.dyads import (
    BASE_LINKS,
    DYAD_NUMBERS,
    GEARED_CRANK,
    HEAD_NUMBERS,
    SECOND_ANGLE,
    SECOND_PIVOT,
    SPAN_INDEX,
    TAIL_NUMBERS,
    Topology,
    number_count,
    positions,
)
from udkjax.synthesis.curves.targets import CurveTarget

GEAR_RATIOS = (1, -1, 2, -2, 3, -3, 4, -4, 5, -5)  # turns of a second crank for one of the crank
MATCHED_ANGLES = 72  # angles of the crank over a turn
Linkages = tuple[np.ndarray, Topology]


def turn_angles(K: int) -> np.ndarray:
    """Return evenly spaced angles of the crank over a turn, the same for K linkages (K, 72)."""
    return np.broadcast_to(np.arange(MATCHED_ANGLES) * (FULL_TURN / MATCHED_ANGLES), (K, MATCHED_ANGLES))


def random_linkages(K: int, dyads: int, rng: np.random.Generator, geared: bool = False, slides: float = 0.0) -> Linkages:
    """Return K random linkages with cranks of about unit length; geared ones begin with a five-bar of two cranks."""
    x = np.zeros((K, number_count(dyads)))
    x[:, SPAN_INDEX] = FULL_TURN
    first, second = np.ones((K, dyads), int), np.zeros((K, dyads), int)
    ratio = rng.choice(GEAR_RATIOS, K) if geared else np.zeros(K, int)
    topology = Topology(first, second, rng.choice([-1.0, 1.0], (K, dyads)), random_forms((K, dyads), slides, rng), ratio)
    x[:, HEAD_NUMBERS] = np.exp(rng.normal(0.0, 0.3, K))
    pivot = np.exp(rng.normal(0.7, 0.5, K)) * np.exp(1j * rng.uniform(0.0, FULL_TURN, K))
    at = HEAD_NUMBERS + 2
    if geared:
        at, second[:, 0] = SECOND_PIVOT, GEARED_CRANK
        x[:, SECOND_ANGLE], x[:, HEAD_NUMBERS + 2] = rng.uniform(0.0, FULL_TURN, K), np.exp(rng.normal(-0.3, 0.5, K))
    x[:, at], x[:, at + 1] = np.real(pivot), np.imag(pivot)
    for d in range(dyads):
        k, links = HEAD_NUMBERS + DYAD_NUMBERS * d, BASE_LINKS + 2 * d
        if d:
            likely = np.array([1.0, 0.5, 0.5 * geared, *[1.0] * (2 * d - 2), 2.0, 2.0])  # rather the last links: deeper linkages
            A, B = rng.choice(links, (2, K), p=likely / likely.sum())
            A = np.where(A == B, np.where(links - 2 == B, links - 1, links - 2), A)
            first[:, d], second[:, d] = A, B
            x[:, k : k + 2], x[:, k + 2 : k + 4] = random_places(x, topology, A, rng), random_places(x, topology, B, rng)
        x[:, k + 4 : k + 6] = closing_lengths(x, topology, turn_angles(K), d, rng)
    length = link_lengths(x, topology, np.full(K, BASE_LINKS + 2 * dyads - 2))
    x[:, -2], x[:, -1] = rng.uniform(-1.0, 2.0, K) * length, rng.normal(0.0, 1.0, K) * length
    return x, topology


def closing_lengths(x: np.ndarray, topology: Topology, theta: np.ndarray, d: int, rng: np.random.Generator) -> np.ndarray:
    """Return random numbers `one` and `two` (K, 2) of dyad d, with which it closes at all angles `theta` (K, T) of the crank."""
    k = HEAD_NUMBERS + DYAD_NUMBERS * (d + 1)
    known = np.concatenate([x[:, :k], x[:, -TAIL_NUMBERS:]], 1)
    known[:, k - 2 : k] = 1.0
    first, second, side, form = (a[:, : d + 1] for a in topology[:4])
    pinned = np.concatenate([form[:, :d], np.full((len(x), 1), PINS)], 1)
    at = positions(known, Topology(first, second, side, pinned, topology.ratio), theta)
    way, angle = at.origins[-1] - at.origins[-2], rng.uniform(0.0, FULL_TURN, len(x))
    far, near = np.abs(way).max(1), np.abs(way).min(1)
    above, between = 1.03 + rng.exponential(0.5, len(x)), rng.uniform(-0.97, 0.97, len(x))
    rail = at.turns[second[:, d], np.arange(len(x))] * np.exp(1j * angle[:, None])
    one = (0.5 * (far * above + near * between), np.abs(cross(rail, way)).max(1) * above, near * between)
    two = (0.5 * (far * above - near * between), angle, far)
    return np.stack([np.choose(form[:, d], one), np.choose(form[:, d], two)], 1)


def random_forms(shape: tuple[int, ...], slides: float, rng: np.random.Generator) -> np.ndarray:
    """Return random forms of dyads, of which the fraction `slides` has a slide; if it is 0, no random number is drawn."""
    if not slides:
        return np.full(shape, PINS)
    return np.where(rng.random(shape) < slides, rng.choice([RAIL, SLIDE], shape), PINS)


def link_lengths(x: np.ndarray, topology: Topology, link: np.ndarray) -> np.ndarray:
    """Return a usual length (K,) of one link of each linkage, whose numbers are `link` (K,)."""
    rows, (dyad, other) = np.arange(len(x)), np.divmod(np.maximum(link - BASE_LINKS, 0), 2)
    form = topology.form[rows, np.minimum(dyad, topology.dyads - 1)]
    return x[
        rows, np.minimum(HEAD_NUMBERS + DYAD_NUMBERS * dyad + 4 + np.where(form == PINS, other, form == SLIDE), x.shape[1] - 1)
    ]


def random_places(x: np.ndarray, topology: Topology, link: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random place (K, 2) on one link of each linkage, whose numbers are `link` (K,), in the frame of the link."""
    K, length = len(x), link_lengths(x, topology, link)
    between = np.stack([rng.uniform(-0.6, 1.6, K) * length, rng.normal(0.0, 0.5, K) * length], 1)
    about = rng.normal(0.0, np.where(link == 0, 2.0, 0.8)[:, None], (K, 2))
    return np.where((link >= BASE_LINKS)[:, None], between, about)


def grown(
    linkages: Linkages,
    target: CurveTarget,
    sample: Sampling,
    tries: int,
    keep: int,
    rng: np.random.Generator,
    slides: float = 0.0,
) -> Linkages:
    """Return `keep` linkages with one more dyad for each of the given linkages: the best of `tries` random ones.

    The P of the new dyad is the old drawing pin, so that with the new pin at P the curve is the old one; the place of the new pin
    on the new link follows by least squares from the nearest points of curve and target.
    """
    x, topology = linkages
    (K, D), n = topology.first.shape, len(x) * tries
    parent, links = np.repeat(np.arange(K), tries), BASE_LINKS + 2 * D
    x, topology = x[parent], topology.take(parent)
    A = np.full(n, links - 2)
    has_second = topology.ratio != 0
    B = rng.integers(0, links - 2 + has_second)
    B += (B >= GEARED_CRANK) & ~has_second
    B += links - 2 == B
    B = np.where(rng.random(n) < 0.3, 0, B)
    k = HEAD_NUMBERS + DYAD_NUMBERS * D
    y = np.concatenate([x[:, :k], x[:, -TAIL_NUMBERS:], random_places(x, topology, B, rng), np.ones((n, 2)), np.zeros((n, 2))], 1)
    side = rng.choice([-1.0, 1.0], (n, 1))
    added = A[:, None], B[:, None], side, random_forms((n, 1), slides, rng)
    first, second, branch, form = (np.concatenate(pair, 1) for pair in zip(topology[:4], added, strict=True))
    new = Topology(first, second, branch, form, topology.ratio)
    theta = sample.angles(y)
    y[:, k + 4 : k + 6] = closing_lengths(y, new, theta, D, rng)
    at = positions(y, new, theta)
    c, u, rows = at.pin[:, : sample.drawing], at.turns[-2][:, : sample.drawing], np.arange(n)[:, None]
    distance = np.abs(c[::tries, :, None] - target.points)
    near, nearest = distance.argmin(2)[parent], distance.argmin(1)[parent]
    one, two = target.points[near] - c, target.points - c[rows, nearest]
    on_one, on_two = u, u[rows, nearest]
    p = 0.5 * ((np.conj(on_one) * one).mean(1) + (np.conj(on_two) * two).mean(1))
    y[:, -2], y[:, -1] = np.real(p), np.imag(p)
    left = (np.abs(one - p[:, None] * on_one) ** 2).mean(1) + (np.abs(two - p[:, None] * on_two) ** 2).mean(1)
    best = np.argsort(left.reshape(K, tries), 1, kind="stable")[:, :keep] + np.arange(K)[:, None] * tries
    return y[best.ravel()], new.take(best.ravel())
