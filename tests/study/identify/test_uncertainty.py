"""Uncertainty from residuals and their Jacobian, compared with linear regression."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from udkjax.study.identify.answers.uncertainty import Uncertainty, UnknownValues, describe, estimate_uncertainty
from udkjax.study.identify.problem.residuals import Residuals, reduce_groups

RNG = np.random.default_rng


def positive(*names, x=None, units="kg"):
    x = np.ones(len(names)) if x is None else np.array(x, float)
    return UnknownValues(names, [units] * len(names), x, x, ["positive"] * len(names))


def uncertainty_of(J, r, values, noise_group=None, parameters=None, priors=0) -> Uncertainty:
    """The uncertainty from rows that come in blocks."""
    parts = [rows for rows in np.array_split(np.arange(len(r)), 3) if len(rows)]
    blocks = [Residuals(r[None, rows], J[None, rows], np.zeros(1, int), rows) for rows in parts]
    group = np.full(len(r), -1) if noise_group is None else noise_group
    return estimate_uncertainty(reduce_groups(blocks, J.shape[1], group, priors), values, parameters)


def problem(R=60, K=3, seed=0, noise=1.0):
    """A regression at its minimum: the Jacobian, and residuals of white noise."""
    random = RNG(seed)
    J = random.standard_normal((R, K)) * 10.0 ** random.uniform(0.0, 1.0, K)
    e = noise * random.standard_normal(R)
    return J, e - J @ np.linalg.lstsq(J, e, rcond=None)[0]


def test_standard_errors_are_those_of_linear_regression():
    J, r = problem()
    x = np.array([2.0, 0.5, 30.0])
    known = uncertainty_of(J, r, positive("a", "b", "c", x=x))
    covariance = np.outer(x, x) * np.linalg.inv(J.T @ J)
    assert_allclose(known.covariance, covariance, rtol=1e-10)
    assert_allclose(known.standard_errors, np.sqrt(np.diag(covariance)), rtol=1e-10)
    errors = np.sqrt(np.diag(covariance))
    assert_allclose(known.correlation, covariance / np.outer(errors, errors), rtol=1e-10)
    assert_allclose(known.chi2, r @ r)
    assert known.degrees_of_freedom == 57 and known.dead == known.flat == () and known.messages == ()
    # The directions are those of J: J^T J = V S^2 V^T.
    assert_allclose(known.directions.T * known.singular**2 @ known.directions, J.T @ J, rtol=1e-9)


def test_noise_that_is_not_known_is_estimated():
    J, r = problem(noise=7.0)
    known = uncertainty_of(J, r, positive("a", "b", "c"), noise_group=np.zeros(len(r), int))
    s2 = r @ r / (60 - 3)
    assert_allclose(known.noise, [np.sqrt(s2)])
    assert_allclose(known.covariance, s2 * np.linalg.inv(J.T @ J), rtol=1e-9)
    assert_allclose(known.chi2, known.degrees_of_freedom)


def test_exact_data_have_no_noise():
    J, _ = problem()
    known = uncertainty_of(J, np.zeros(60), positive("a", "b", "c"), noise_group=np.zeros(60, int))
    assert np.all(known.standard_errors < 1e-14) and known.messages == ()


def test_each_group_has_its_own_noise_and_priors_have_theirs():
    """Two channels, one five times as noisy, and a prior: estimates of the noise are unbiased."""
    random, found = RNG(1), []
    J = random.standard_normal((80, 4))
    group = np.repeat([0, 1, -1], [30, 50, 1])
    J = np.vstack([J, [3.0, 0.0, 0.0, 0.0]])
    true = np.array([2.0, 0.4, 1.0])
    for _ in range(300):
        e = true[group] * random.standard_normal(81)
        weighted = J / true[group][:, None]
        z = np.linalg.lstsq(weighted, -e / true[group], rcond=None)[0]
        known = uncertainty_of(J, e + J @ z, positive(*"abcd"), noise_group=group)
        found.append(known.noise**2)
    assert_allclose(np.mean(found, axis=0), true[:2] ** 2, rtol=0.04)  # the mean of 300 of 25 degrees of freedom: 1.6 %
    assert_allclose(known.standard_errors, uncertainty_of(weighted, e, positive(*"abcd")).standard_errors, rtol=0.5)


def test_errors_are_as_large_as_the_standard_errors_say():
    """95 % of estimates from 400 measurements are within 1.96 standard errors."""
    random, hits = RNG(2), 0
    J, _ = problem(R=40, K=2, seed=2)
    for _ in range(400):
        e = random.standard_normal(40)
        z = np.linalg.lstsq(J, e, rcond=None)[0]
        known = uncertainty_of(J, e - J @ z, positive("a", "b"))
        hits += np.count_nonzero(np.abs(z) < 1.96 * known.standard_errors)
    assert abs(hits / 800 - 0.95) < 0.025  # three standard deviations


def test_unknowns_of_starts_are_eliminated():
    J, r = problem(K=5)
    known = uncertainty_of(J, r, positive(*"abcde"), parameters=2)
    A, B, D = J[:, :2].T @ J[:, :2], J[:, :2].T @ J[:, 2:], J[:, 2:].T @ J[:, 2:]
    assert_allclose(known.covariance, np.linalg.inv(A - B @ np.linalg.solve(D, B.T)), rtol=1e-9)
    assert known.names == ("a", "b") and known.degrees_of_freedom == 55
    assert np.all(known.standard_errors > uncertainty_of(J[:, :2], r, positive("a", "b")).standard_errors)


def test_a_common_factor_is_found_and_said():
    """J (1, 1, 0) = 0 up to the errors of derivatives: only the ratio of two masses is determined."""
    J, r = problem()
    J[:, 1] = -J[:, 0] + 1e-9 * RNG(3).standard_normal(60)
    known = uncertainty_of(J, r, positive("body.link1.mass", "body.coupler.mass", "c", x=[1.0, 4.0, 2.0]))
    (flat,) = known.flat
    assert flat.text == "body.link1.mass and body.coupler.mass by a common factor"
    assert_allclose(flat.coefficients, [1.0, 1.0], rtol=1e-6)
    fixed = uncertainty_of(J[:, 1:], r, positive("b", "c", x=[4.0, 2.0]))
    assert_allclose(known.standard_errors, [np.inf, np.inf, fixed.standard_errors[1]], rtol=1e-6)
    assert np.isinf(known.covariance[0, 0]) and np.isnan(known.covariance[0, 2]) and np.isnan(known.correlation[1, 2])
    assert_allclose(known.covariance[2, 2], fixed.covariance[1, 1], rtol=1e-6)
    assert known.degrees_of_freedom == 58 and known.correlated == () and known.poor == ()
    assert known.messages == (
        f"no measured quantity changes with {flat.text}: fix one of them, give one a prior, or measure more",
    )


def test_two_flat_directions_are_told_apart():
    J, r = problem(K=6)
    J[:, 1], J[:, 4] = -2.0 * J[:, 0], 0.53 * J[:, 3]
    names = ("body.a.mass", "body.b.inertia", "c", "d", "e", "f")
    first, second = uncertainty_of(J, r, positive(*names)).flat
    assert first.text == "body.a.mass +1 % with body.b.inertia +0.5 %"
    assert second.text == "d -0.53 % with e +1 %"
    assert first.names == names[:2] and second.names == ("d", "e")


def test_priors_alone_show_a_direction_in_the_residuals_and_in_the_errors():
    """Measurements are 1e12 times better than priors: b = -a in z, so that two priors, 2 and 1, determine the common factor."""
    J, r = problem()
    J[:, 1] = -J[:, 0]
    priors = np.array([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    known = uncertainty_of(np.vstack([1e12 * J, priors]), np.append(r, [0.0, 0.0]), positive(*"abc"), priors=2)
    assert known.flat == () and known.degrees_of_freedom == 62 - 3
    assert_allclose(known.standard_errors[:2], 1 / np.sqrt(2**2 + 1**2))
    U = 1e12 * J @ known.projector  # U U^T projects onto the residuals that a change of unknowns can make
    assert_allclose(U @ U.T, J @ np.linalg.pinv(J), atol=1e-12)


def test_directions_in_words():
    values = UnknownValues(
        ["m", "x", "k", "b"], ["kg", "m", "", "s"], np.array([2.0, 0.3, 5.0, 4.0]), np.array([2.0, 0.5, 5.0, 1.0]), []
    )
    values = values._replace(kinds=["positive", "free", "positive", "bounded"])
    assert describe(values, np.array([2.0, 1.0, 0.0, 0.0])).text == "m +1 % with x +0.0025 m"
    assert describe(values, np.array([1.0, 0.0, 0.0, 4.0])).text == "m and b by a common factor"  # 4 dz of 1 s is all of 4 s
    assert describe(values, np.array([0.0, 2.0, 0.0, 0.0])).text == "x +0.005 m"
    assert describe(values, np.array([1.0, 0.0, -0.5, 0.02])).text == "m +1 % with k -0.5 % and b +0.005 %"


def test_what_nothing_depends_on_is_named():
    J, r = problem(K=4)
    J[:, 2] = 1e-12
    known = uncertainty_of(J, r, positive(*"abcd"), parameters=3)
    assert known.dead == ("c",) and known.flat == () and np.isinf(known.standard_errors[2])
    rest = uncertainty_of(np.delete(J, 2, 1), r, positive(*"abd"), parameters=2)
    assert_allclose(known.standard_errors[:2], rest.standard_errors)
    assert known.messages == ("no measured quantity depends on c: do not identify it, or measure other quantities",)
    nothing = uncertainty_of(np.zeros((5, 2)), np.ones(5), positive("a", "b"))
    assert nothing.dead == ("a", "b") and np.isinf(nothing.standard_errors).all()


@pytest.mark.parametrize("R", [2, 3])
def test_too_few_residuals(R):
    J = RNG(4).standard_normal((R, 3))
    known = uncertainty_of(J, np.zeros(R), positive(*"abc"), noise_group=np.zeros(R, int))
    assert np.isnan(known.noise).all() and not np.isfinite(known.standard_errors).any()
    assert any("too few to estimate the noise" in text for text in known.messages)
    assert len(known.flat) == 3 - R
    given = uncertainty_of(J, np.zeros(R), positive(*"abc"))
    assert np.isfinite(given.standard_errors).all() == (R == 3)


def test_poorly_known_parameters_are_named_with_their_numbers():
    J = np.diag([100.0, 1.25, 4.0, 1.0])
    kinds = ["positive", "positive", "free", "bounded"]
    values = UnknownValues(
        ["a", "b", "c", "d"], ["kg", "kg m2", "m", ""], np.array([2.0, 3.0, 0.0, 8.0]), np.array([2.0, 3.0, 0.1, 6.0]), kinds
    )
    known = uncertainty_of(J, np.zeros(4), values)
    assert_allclose(known.standard_errors, [0.02, 2.4, 0.025, 6.0])
    assert known.poor == ("b", "d")
    assert known.messages == (
        "b is poorly determined: 3 kg m2 with a standard error of 2.4 kg m2 (80 %)",
        "d is poorly determined: 8 with a standard error of 6 (75 %)",
    )


def test_parameters_hardly_known_apart_are_named():
    J, r = problem(K=2)
    J[:, 1] = J[:, 0] + 0.1 * J[:, 1] / np.linalg.norm(J[:, 1]) * np.linalg.norm(J[:, 0])
    known = uncertainty_of(J, r, positive("a", "b"))
    ((one, other, rho),) = known.correlated
    assert (one, other) == ("a", "b") and -1.0 < rho < -0.98
    assert known.messages == (f"a and b are hard to distinguish: the correlation of their errors is {rho:.4f}",)


@pytest.mark.parametrize(("noise", "said"), [(1.0, ""), (2.0, "times as large as the given noise"), (0.5, "are only")])
def test_noise_that_is_not_as_given_is_noticed(noise, said):
    J, r = problem(R=200, noise=noise)
    texts = uncertainty_of(J, r, positive(*"abc")).messages
    assert bool(texts) == bool(said) and all(said in text and "197 degrees of freedom" in text for text in texts)
