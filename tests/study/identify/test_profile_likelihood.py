"""Profile likelihoods compared with linear regression and known curves."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from udkjax.study.identify.answers.profile_likelihood import fix_unknown, profile_likelihood, profiles_dataset, trace_profile
from udkjax.study.identify.problem.residuals import Residuals


def linear(J, r0):
    """Fits of r = r0 + J z with one unknown fixed, and their number."""
    count = []

    def fit(index, held, z0):
        assert z0[index] == held
        count.append(held)
        others = np.delete(np.arange(J.shape[1]), index)
        z = np.zeros(J.shape[1])
        z[index] = held
        z[others] = np.linalg.lstsq(J[:, others], -(r0 + J[:, index] * held), rcond=None)[0]
        r = r0 + J @ z
        return z, 0.5 * r @ r

    return fit, count


def curve(cost):
    """Fits of one unknown whose cost is a given function of it."""
    return lambda index, held, z0: (np.array([held]), cost(held))


@pytest.fixture(scope="module")
def regression():
    random = np.random.default_rng(0)
    J, r0 = random.standard_normal((40, 3)) @ [[1.0, 0.9, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 3.0]], random.standard_normal(40)
    z = np.linalg.lstsq(J, -r0, rcond=None)[0]
    return J, r0, z, 0.5 * np.sum((r0 + J @ z) ** 2), np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


@pytest.mark.parametrize("guess", [0.1, 1.0, 7.0, np.inf])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_of_a_linear_model_it_is_the_standard_error(regression, k, guess):
    J, r0, z, cost, errors = regression
    fit, count = linear(J, r0)
    found = trace_profile(fit, k, z, cost, guess * errors[k], name="a", units="kg")
    assert_allclose(found.interval, z[k] + np.array([-1.0, 1.0]) * 1.959964 * errors[k], rtol=2e-3)
    assert np.all(np.diff(found.values) > 0) and found.best == np.searchsorted(found.values, z[k])
    assert_allclose(found.costs - cost, 0.5 * ((found.values - z[k]) / errors[k]) ** 2, atol=1e-9 * max(found.costs))
    assert_allclose(found.z[:, k], found.values)
    assert len(count) == len(found.values) - 1 < (10 if guess == 1.0 else 25)
    assert found.text == f"a is between {found.interval[0]:.4g} and {found.interval[1]:.4g} kg (95 %)"


def test_other_levels_and_noise_that_was_estimated(regression):
    J, r0, z, cost, errors = regression
    fit, _ = linear(J, r0)
    s = np.sqrt(2 * cost / 37)
    t = stats.t.ppf(0.95, 37)
    found = trace_profile(fit, 1, z, cost, errors[1], level=0.9, noise=s, degrees_of_freedom=37)
    assert_allclose(found.interval, z[1] + np.array([-t, t]) * s * errors[1], rtol=2e-3)


def test_a_flat_direction_is_open():
    """Two unknowns of which only the sum is determined: each compensates for the other."""
    J = np.array([[1.0, 1.0], [2.0, 2.0]])
    fit, count = linear(J, np.array([0.1, -0.05]))
    found = trace_profile(fit, 0, np.zeros(2), 0.00625, 1.0, value=lambda z: 3.0 * np.exp(z), name="a", units="kg")
    assert found.interval == (-np.inf, np.inf) and len(count) < 20
    assert found.text == (
        "a is undetermined: no lower end up to 6.183e-09 kg (the limit of the search), "
        "no upper end up to 1.455e+09 kg (the limit of the search)"
    )


def test_one_end_may_be_open():
    """For a very small friction, the curve over its logarithm falls off to a level below the quantile."""
    found = trace_profile(
        curve(lambda z: 1.0 * (np.exp(z) - 1.0) ** 2), 0, np.zeros(1), 0.0, 0.5, value=np.exp, name="b", units="N s/m"
    )
    end = 1.0 + np.sqrt(stats.chi2.ppf(0.95, 1) / 2)
    assert found.interval[0] == -np.inf
    assert_allclose(found.interval[1], end, rtol=2e-3)
    looked = "no lower end up to 2.061e-09 N s/m (the limit of the search)"
    assert found.text == f"b is below {found.interval[1]:.4g} N s/m (95 %): {looked}"


def test_it_may_be_longer_on_one_side():
    found = trace_profile(curve(lambda z: 50.0 * (np.exp(z) - 1.0) ** 2), 0, np.zeros(1), 0.0, 0.1)
    half = np.sqrt(stats.chi2.ppf(0.95, 1)) / 10.0
    assert_allclose(found.interval, np.log([1.0 - half, 1.0 + half]), rtol=2e-3)


def test_it_ends_before_what_cannot_be_fitted():
    def cost(z):
        return z**2 if z < 0.7 else np.nan

    found = trace_profile(curve(cost), 0, np.zeros(1), 0.0, 1.0)
    assert_allclose(found.interval[0], -np.sqrt(stats.chi2.ppf(0.95, 1) / 2), rtol=2e-3)
    assert found.interval[1] == np.inf and np.isfinite(found.costs).all()
    assert 0.69 < found.values[-1] < 0.7 and found.text.endswith("(no fit was found beyond)")


def test_few_steps_leave_it_open():
    found = trace_profile(curve(lambda z: 1e-6 * z**2), 0, np.zeros(1), 0.0, 1e-3, steps=5)
    assert found.interval == (-np.inf, np.inf) and "(not reached in 5 steps)" in found.text and len(found.values) == 11


def test_steps_below_the_rounding_of_the_unknown_end_the_walk():
    found = trace_profile(curve(lambda z: 0.0), 0, np.array([1e9]), 0.0, 1e-9, bounds=(0.0, 2e9))
    assert found.interval == (-np.inf, np.inf) and len(found.values) == 1


def test_a_better_fit_on_the_way_is_said():
    """There is a second, lower minimum at 1."""

    def cost(z):
        return 4.0 * z**2 * (z - 1.0) ** 2 - 0.2 * z**2

    found = trace_profile(curve(cost), 0, np.zeros(1), 0.0, 0.3, name="a", units="m")
    assert found.costs[found.best] < -0.1 and 0.8 < found.values[found.best] < 1.3
    assert found.text.endswith(f"a better fit was found at {found.values[found.best]:.6g} m: identify again from that guess")


def test_curves_that_jump_and_estimates_at_a_bound():
    found = trace_profile(curve(lambda z: z**2 if z < 0.7 else 50.0), 0, np.zeros(1), 0.0, 1.0, bounds=(0.0, 9.0))
    assert found.interval[0] == -np.inf and found.values[0] == 0.0  # nothing to walk on that side
    assert 0.69 < found.interval[1] < 0.7


# --- of problems

OFFSET, SCALE = np.array([2.0, -1.0]), np.array([0.5, 3.0])


class Linear:
    """r = r0 + J z; the last unknown is that of an initial state."""

    def __init__(self, K: int = 3):
        random = np.random.default_rng(0)
        self.J, self.r0 = random.normal(size=(40, K)), random.normal(size=40)
        P = min(K, 2)
        self.unknowns: Any = SimpleNamespace(
            names=("a", "b")[:P], units=("kg", "m"), values=lambda z: OFFSET[:P] + SCALE[:P] * z, dx_dz=lambda z: SCALE[:P]
        )

    def evaluate(self, z):
        return [Residuals(self.r0 + z @ self.J.T, np.tile(self.J, (len(z), 1, 1)), np.zeros(len(z), int))]


def fitted(problem, noise=()):
    """The estimate of a linear model: its uncertainty, and a function that makes profiles."""
    z = np.linalg.lstsq(problem.J, -problem.r0, rcond=None)[0]
    s = noise[0] if noise else 1.0
    errors = np.sqrt(np.diag(np.linalg.inv(problem.J.T @ problem.J)))[:2] * SCALE[: len(z)] * s
    known: Any = SimpleNamespace(standard_errors=errors, noise=np.array(noise), degrees_of_freedom=37)
    values = dict(zip(problem.unknowns.names, problem.unknowns.values(z[:2]), strict=True))
    return known, values, partial(profile_likelihood, problem.evaluate, problem.unknowns, z, known)


def test_one_unknown_is_fixed():
    problem = Linear()
    (found,) = fix_unknown(problem.evaluate, 1, 0.7)(np.array([[1.0, -1.0], [0.0, 2.0]]))
    assert_allclose(found.r, problem.r0 + np.array([[1.0, 0.7, -1.0], [0.0, 0.7, 2.0]]) @ problem.J.T)
    assert_allclose(found.J[1], problem.J[:, [0, 2]])


def test_noise_that_was_estimated_and_a_single_unknown():
    known, values, profile = fitted(Linear(1), (0.8,))
    found = profile("a", level=0.9)
    half = 1.687094 * known.standard_errors[0]  # of Student's t with 37 degrees of freedom
    assert_allclose(found.interval, values["a"] + half * np.array([-1, 1]), rtol=2e-3)
    data = profiles_dataset([found], values, known, 0.9)
    assert_allclose(data["interval"].attrs["limit"], 1.687094**2, rtol=1e-6)
    x = (data["profile_value"][0] - values["a"]) / known.standard_errors[0]
    assert_allclose(data["rise"][0], x**2, atol=1e-8)
