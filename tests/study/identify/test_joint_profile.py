"""Joint confidence regions compared with ellipses of linear models and with the cost on their edges."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing

SIGMA = 0.01


def fit(sigma: float, names=(*NAMES, "force.spring.stiffness"), **more) -> udk.Estimate:
    record = udk.Record(TS, {ANGLE: swing(pendulum()) + sigma * np.cos(97.0 * TS)}, **more)
    return udk.identify(pendulum(0.4), record, names, n_starts=0, progress=False)


@pytest.fixture(scope="module")
def accurate():
    return fit(1e-3, noise=1e-3)


def test_the_edge_is_the_ellipse_if_the_model_is_linear(accurate):
    found = accurate.joint_profile(*NAMES)
    assert_allclose(found.edge, found.ellipse, atol=0.01 * np.ptp(found.ellipse, axis=0).min())
    errors = accurate.uncertainty.standard_errors[:2]
    for level in (0.5, 0.95):
        extent = np.ptp(accurate.ellipse(*NAMES, level), axis=0) / 2
        assert_allclose(extent, np.sqrt(chi2.ppf(level, 2)) * errors, rtol=0.01)
    x = (accurate.ellipse(*NAMES) - accurate.values[:2]) / errors
    rho = accurate.uncertainty.correlation[0, 1]
    assert_allclose(x[:, 0] ** 2 - 2 * rho * x[:, 0] * x[:, 1] + x[:, 1] ** 2, (1 - rho**2) * chi2.ppf(0.95, 2), rtol=1e-9)
    assert str(found) == found.text and "jointly (95 %)" in found.text and NAMES[1] in found.text


def test_on_the_edge_the_cost_rises_to_the_limit():
    estimate = fit(0.1, NAMES, noise=0.1)
    found = estimate.joint_profile(*NAMES, level=0.9)
    problem = estimate.problem
    z = problem.unknowns.z_of(np.concatenate([estimate.values[None], found.edge]))
    costs = 0.5 * np.sum(problem.evaluate(z, estimate.tol).r ** 2, axis=1)
    assert_allclose(2 * (costs[1:] - costs[0]), chi2.ppf(0.9, 2), rtol=0.01)
    assert np.abs(found.edge - found.ellipse).max() > 0.02 * np.ptp(found.ellipse[:, 0])  # the model is not linear


def test_wrong_names_and_undetermined_parameters_are_named(accurate):
    with pytest.raises(udk.IdentificationError, match=r"was not identified; did you mean"):
        accurate.joint_profile(NAMES[0], "force.spring.dampin")
    with pytest.raises(udk.IdentificationError, match="two different parameters"):
        accurate.ellipse(NAMES[0], NAMES[0])
    both = fit(1e-3, ("body.rod.mass", *NAMES, "force.spring.stiffness"), noise=1e-3)
    with pytest.raises(udk.IdentificationError, match=r"do not determine body\.rod\.mass: .* give it a prior"):
        both.joint_profile("body.rod.mass", NAMES[0])
    assert np.isnan(both.ellipse("body.rod.mass", NAMES[0])).all()


def test_strong_correlations_and_intervals_are_printed():
    short = udk.Record(TS[:11], {ANGLE: swing(pendulum())[:11] + 1e-3 * np.cos(97.0 * TS[:11])}, 1e-3)
    names = ["body.rod.mass", "force.spring.stiffness"]
    found = udk.identify(pendulum(0.4), short, names, n_starts=0, progress=False)
    rho = found.uncertainty.correlation[0, 1]
    assert 0.9 < abs(rho) < 0.98 and f"correlated errors: {names[0]} and {names[1]} {rho:.2f}" in str(found)
    assert str(found.profile(names[0])) == found.profile(names[0]).text
