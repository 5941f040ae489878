"""Bounds of gaps between poses: they hold, and become exact with the fourth power of the interval."""

import numpy as np
import pytest

from udkjax.positions.gaps.bounds import Moving, least_of_cubics
from udkjax.positions.gaps.motion import PolynomialMotion
from udkjax.positions.gaps.motion_tables import MotionTables, turning
from udkjax.positions.gaps.part_pairs import PartPairs
from udkjax.positions.gaps.search import PairSearch, _roots

SHARES = np.linspace(0.0, 1.0, 201)


def random_motion(rng, pieces=5, h=0.02):
    """Bodies that move by polynomials of degree five between random poses, and the ground."""
    u, w, phase = h * np.arange(pieces + 1.0), rng.uniform(0.3, 1.5, (3, 4, 1)), rng.uniform(0, 2 * np.pi, (3, 4, 1))
    q, v, a = (2 * w**n * np.sin(w * u + phase + n * np.pi / 2) for n in range(3))
    for x in (q, v, a):
        x[:, 3] = 0.0
    b1, b4 = q[..., :-1] + h * v[..., :-1] / 5, q[..., 1:] - h * v[..., 1:] / 5
    b2, b3 = 2 * b1 - q[..., :-1] + h * h * a[..., :-1] / 20, 2 * b4 - q[..., 1:] + h * h * a[..., 1:] / 20
    return PolynomialMotion.of(u, np.stack([q[..., :-1], b1, b2, b3, b4, q[..., 1:]]), "rad")


def corners(count, number, rng):
    angles = np.sort(rng.uniform(0, 2 * np.pi, (count, number)), 0)
    return 0.4 * np.stack([np.cos(angles), np.sin(angles)], 1) + 0.2 * rng.normal(size=(1, 2, number))


@pytest.mark.parametrize("counts", [(1, 1), (2, 1), (2, 2), (3, 2), (4, 3)])
def test_bounds_by_features_hold_and_are_of_the_fourth_order(counts):
    rng, number = np.random.default_rng(sum(counts)), 300
    bodies = np.array([rng.permutation(4)[:2] for _ in range(number)]).T
    A, B = (corners(count, number, rng) for count in counts)
    pairs = PartPairs(np.arange(number), np.zeros((2, number), int), bodies, A, B, np.full((2, number), 0.01))
    search = PairSearch(pairs, MotionTables(random_motion(rng)))
    k, excess = np.arange(number), []
    for share in (1.0, 0.25):
        s = np.stack([np.full(number, 2.0), np.full(number, 2.0 + share)], 1).ravel()
        points = np.repeat(k, 2)
        placed, near = pairs.closest(points, search._frames(points, s))
        low, at = search._bounds_by_features(k, s, 2 * k, placed, near)
        between = 2.0 + share * SHARES
        d = search._gaps(np.repeat(k, len(between)), np.tile(between, number)).reshape(number, -1) + 0.02
        assert (low <= d.min(1) + 1e-13).all() and (at >= 0).all() and (at <= 1).all()
        excess.append(d.min(1) - low)
    # where the closest features stay the same, which is so for most
    assert np.median(excess[1]) < np.median(excess[0]) / 150
    assert np.median(excess[0]) < 1e-3


def test_the_least_values_of_cubics():
    rng = np.random.default_rng(0)
    at, rate, h = rng.normal(size=(2, 500)), rng.normal(size=(2, 500)), rng.uniform(0.1, 2, 500)
    rate *= 10.0 ** rng.integers(-3, 3, 500)
    rate[:, :100], at[1, :100] = 1.7, at[0, :100] + 1.7 * h[:100]  # lines
    t = SHARES[:, None]
    f = (1 + 2 * t) * (1 - t) ** 2 * at[0] + t**2 * (3 - 2 * t) * at[1]
    f += t * (1 - t) * h * ((1 - t) * rate[0] - t * rate[1])
    least, place = least_of_cubics(Moving(at, rate), h)
    scale = np.abs(f).max(0)
    assert (least <= f.min(0) + 1e-12 * scale).all() and (f.min(0) - least < 1e-3 * scale).all()
    assert ((place >= 0) & (place <= 1)).all()


def test_directions_turn_no_faster_than_their_bounds():
    """For an angle of u, u^2 / 2, u^3 / 6 and u^4 / 24 in turn, at u = 0: derivatives of exp(i angle)."""
    rates = np.array([0.7, 1.3, 0.4, 2.1])
    i = 1j
    a, b, c, d = rates
    exact = [i * a, i * b - a**2, i * c - 3 * a * b - i * a**3, i * d - 4 * a * c - 3 * b**2 - 6 * i * a**2 * b + a**4]
    assert (np.abs(exact) <= turning(rates[:, None])[:, 0] + 1e-15).all()


def test_roots_of_smooth_functions_and_of_kinks():
    rng = np.random.default_rng(1)
    roots = rng.uniform(-1, 1, 60)

    def f(x, i):
        y = x - roots[i]
        return np.where(i < 20, np.sinh(3 * y), np.where(i < 40, y**3 + 1e-3 * y, np.where(y < 0, -1.0, 5.0)))

    every, start, end = np.arange(60), np.full(60, -1.5), np.full(60, 1.2)
    guess = roots + rng.normal(size=60) * 1e-3
    found = _roots(f, start, end, f(start, every), f(end, every), guess)
    assert np.abs(found - roots).max() < 1e-11
