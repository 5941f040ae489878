"""The test for white noise: its error rate, and its power."""

import numpy as np
import pytest

from udkjax.study.noise import MAX_LAGS, HatBands, whiteness_of

SEEDS = 300


def left(kind, samples, unknowns, correlation, seed):
    """Times, residuals of a fit of cosines to noise, and the fit's projection. `correlation` is that of neighbouring samples."""
    random = np.random.default_rng(seed)
    t = np.sort(random.uniform(0.0, 10.0, samples)) if kind == "irregular" else np.linspace(0.0, 10.0, samples)
    if kind == "gaps":
        t = np.delete(t, [*range(samples // 3, samples // 2), *random.integers(0, samples // 3, samples // 20)])
    e = random.standard_normal(len(t))
    for i in range(1, len(t)):
        a = correlation ** ((t[i] - t[i - 1]) / (10.0 / samples)) if correlation else 0.0
        e[i] = a * e[i - 1] + np.sqrt(1.0 - a * a) * e[i]
    U = np.linalg.qr(np.cos(np.pi * np.outer(t, np.arange(unknowns)) / 10.0))[0]
    bands = HatBands(len(t), unknowns)
    bands.add(U)
    return t, e - U @ (U.T @ e), bands.values


@pytest.mark.parametrize("parts", [(20,), (3, 1, 4, 12), (7, 0, 13)])
def test_diagonals_of_the_hat_matrix_from_rows_in_parts(parts):
    U = np.random.default_rng(0).standard_normal((20, 3))
    bands = HatBands(20, 3)
    for own in np.split(U, np.cumsum(parts)[:-1]):
        bands.add(own)
    H = U @ U.T
    expected = [np.append(np.diagonal(H, k), np.zeros(k)) for k in range(MAX_LAGS + 1)]
    np.testing.assert_allclose(bands.values, expected, atol=1e-14)


@pytest.mark.parametrize("kind", ["regular", "gaps", "irregular"])
def test_white_noise_is_told_as_often_as_it_should_be(kind):
    p = np.array([whiteness_of(*left(kind, 100, 5, 0.0, seed)).p for seed in range(SEEDS)])
    for level in (0.05, 0.3):
        assert abs(np.mean(p < level) - level) < 3.0 * np.sqrt(level * (1 - level) / SEEDS)
    assert np.mean(p < 1e-3) < 0.02


def test_what_a_fit_takes_away_is_allowed_for():
    """A fit of ten unknowns makes neighbours of white noise differ: without the hat matrix this looks like a correlation."""
    with_it, without = [], []
    for seed in range(SEEDS):
        t, e, hat = left("regular", 100, 10, 0.0, seed)
        with_it.append(whiteness_of(t, e, hat).p < 0.05)
        without.append(whiteness_of(t, e).p < 0.05)
    assert np.mean(without) > 0.2 and np.mean(with_it) < 0.09


@pytest.mark.parametrize("kind", ["regular", "gaps", "irregular"])
def test_coloured_noise_is_noticed(kind):
    found = [whiteness_of(*left(kind, 300, 5, 0.6, seed)) for seed in range(50)]
    assert np.mean([not w.white for w in found]) > 0.9
    w = found[0]
    assert 0.3 < w.lag1 < 0.75
    text = w.text('"body.a.angle" in record "one"')
    assert text.startswith('residuals of "body.a.angle" in record "one" are not white noise: neighbours have a correlation of 0.')
    assert f"{w.samples} samples" in text


def test_the_correlation_of_neighbours():
    t, e, _ = left("regular", 20000, 1, 0.6, 0)
    assert abs(whiteness_of(t, e).lag1 - 0.6) < 0.02
    # Neighbours on the two sides of a gap are no neighbours.
    w = whiteness_of(np.concatenate([np.arange(50.0), 1000.0 + np.arange(50.0)]), np.repeat([1.0, -1.0], 50))
    assert w.lag1 == pytest.approx(1.0) and not w.white


def test_an_offset_and_a_wave_are_no_noise():
    t, random = np.linspace(0.0, 5.0, 200), np.random.default_rng(5)
    for more in (0.8, 0.8 * np.sin(3.0 * t)):
        assert not whiteness_of(t, random.standard_normal(200) + more).white


def test_few_samples_say_nothing():
    for n in (0, 1, 2, 5, 15):
        w = whiteness_of(np.arange(float(n)), np.ones(n))
        assert np.isnan(w.p) and w.white and w.text("it") == "" and w.samples == n
    values = np.where(np.arange(60) % 2, np.nan, 1.0)
    assert whiteness_of(np.arange(60.0), values).samples == 30
    assert np.isnan(whiteness_of(np.arange(60.0), np.zeros(60)).p)
