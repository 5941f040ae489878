"""Differences and their errors, for functions with known derivatives."""

import itertools

import numpy as np
import pytest

from udkjax.study.differences import DIFFERENCE_STEPS, DifferenceSums

TS = np.linspace(0.5, 3.0, 40)
SERIES = np.repeat([0, 1], [25, 15])
SLOPE = -TS * np.sin(TS)


def seen(h):
    """The values of cos((1 + h) t) at all steps of the ladder."""
    return np.cos((1.0 + h[:, None]) * TS)


def ladder(function):
    return np.stack([function(DIFFERENCE_STEPS), function(-DIFFERENCE_STEPS)], axis=1)


def differences(y, errors, ends=(0, 40)):
    """Return the differences of rows that are added in blocks."""
    sums = DifferenceSums(2)
    for a, b in itertools.pairwise(ends):
        sums.add(y[..., a:b], errors[..., a:b], SERIES[a:b], SLOPE[a:b], np.arange(a, b))
    return sums.differences()


def chosen(found):
    """Return the actual errors of differences at the best step, in each series, and the predicted ones."""
    errors = found.noise + found.truncation
    best = np.nanargmin(errors, axis=0)
    off = found.discrepancy[best, np.arange(2)]
    return off, errors[best, np.arange(2)], found.steps[best]


def test_of_a_smooth_function_they_are_as_exact_as_rounding_lets_them_be():
    y = ladder(seen)
    off, errors, steps = chosen(differences(y, np.zeros_like(y)))
    assert (off < errors).all() and (errors < 1e-11).all() and (steps > 1e-3).all()


@pytest.mark.parametrize("level", [1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("kind", ["jumping", "moving"])
def test_noise_is_told_before_they_are_compared(level, kind):
    """Errors that differ at each step, as from a step controller; and errors that vary with the parameter."""
    random = np.random.default_rng(0)
    errors = level * random.standard_normal((len(DIFFERENCE_STEPS), 2, len(TS)))
    if kind == "moving":
        errors = ladder(lambda h: level * np.sin(TS + 30.0 * h[:, None]))
    y = ladder(seen)
    off, floor, _ = chosen(differences(y + errors, errors))
    assert (off < 3.0 * floor).all() and (floor < 100.0 * off).all()
    if kind == "moving":
        assert (floor > 10.0 * level).all()  # no step is small enough to get rid of them


def test_truncation_is_told_before_they_are_compared():
    y = ladder(seen)
    found = differences(y, np.zeros_like(y))
    assert found.truncation[:3] == pytest.approx(found.discrepancy[:3], rel=0.05)


def test_steps_where_runs_fail_are_left_out():
    y = ladder(seen)
    y[:3, 0], y[5, 1] = np.nan, np.nan
    found = differences(y, np.zeros_like(y))
    assert np.isnan(found.noise[:3]).all() and np.isnan(found.noise[4:6]).all() and np.isfinite(found.noise[[3, 6, 7]]).all()
    off, errors, _ = chosen(found)
    assert (off < errors).all()
    assert np.isnan(differences(np.full_like(y, np.nan), y).noise).all()


def test_a_jump_has_no_derivative():
    y = ladder(lambda h: seen(h) + np.sign(h)[:, None])
    assert np.isnan(differences(y, np.zeros_like(y)).truncation).all()


def test_what_moves_by_rounding_only_is_no_derivative():
    random = np.random.default_rng(1)
    errors = 1e-16 * random.standard_normal((len(DIFFERENCE_STEPS), 2, len(TS)))
    y = 1.0 + errors
    found = differences(y, errors)
    errors = found.noise + found.truncation
    best = np.nanargmin(errors, axis=0)
    assert (found.size[best, [0, 1]] < errors[best, [0, 1]]).all() and (errors[best, [0, 1]] < 1e-13).all()


def test_blocks_of_rows_give_the_same():
    """Memory holds the rows of a block only; a row of the whole is the worst one."""
    random = np.random.default_rng(2)
    errors = 1e-9 * random.standard_normal((len(DIFFERENCE_STEPS), 2, len(TS)))
    y = ladder(seen) + errors
    for one, other in zip(differences(y, errors), differences(y, errors, (0, 7, 30, 40)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
