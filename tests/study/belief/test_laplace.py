"""Normal approximations compared with integrals, exact curvatures, and distributions with known tails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

import udkjax as udk
from tests.study.belief.test_log_density import record
from tests.study.identify.conftest import ANGLE, NAMES, pendulum
from udkjax.study.identify.density.laplace import approximate, pareto_exponent


def test_it_is_exact_to_the_curvature_and_its_evidence_is_the_integral():
    problem = udk.inference(pendulum(0.38), record(), NAMES[:1], priors={NAMES[0]: (0.4, 0.05)}, tol=1e-10)
    found = approximate(problem, problem.start)
    assert found.trusted and "may be trusted" in found.message
    assert abs(float(jax.jit(jax.grad(problem.log_density))(found.mode)[0]) * found.root[0, 0]) < 1e-4
    z = found.mode[0] + found.root[0, 0] * np.linspace(-8.0, 8.0, 401)
    densities = np.asarray(problem.log_densities(z[:, None]))
    top = densities.max()
    integral = top + np.log(np.trapezoid(np.exp(densities - top), z))
    assert abs(found.log_evidence - integral) < 4 * found.log_evidence_error + 1e-3
    spread = np.sqrt(np.average((z - np.average(z, weights=np.exp(densities - top))) ** 2, weights=np.exp(densities - top)))
    assert_allclose(abs(found.root[0, 0]), spread, rtol=0.02)


def test_of_an_estimate_its_deviations_are_the_standard_errors():
    estimate = udk.identify(pendulum(0.4), record(None), NAMES)
    found = estimate.laplace()
    assert found.problem.names == (*NAMES, f"noise of {ANGLE}")
    values, errors = np.array([found.parameters[name] for name in NAMES]).T
    assert_allclose(errors, estimate.uncertainty.standard_errors, rtol=0.05)
    assert np.abs((values - estimate.values) / estimate.uncertainty.standard_errors).max() < 0.2
    noise, spread = found.parameters[f"noise of {ANGLE}"]
    assert_allclose(spread, noise / np.sqrt(2 * len(estimate.problem.index)), rtol=0.05)
    draws = found.draws(4000)
    assert_allclose(np.cov(draws.T), found.covariance, rtol=0.1, atol=0.1 * np.abs(found.covariance).max())
    assert estimate.laplace().k == found.k


def idle(mech, value):
    return mech


def test_unknowns_that_nothing_determines_are_named_and_a_prior_determines_them():
    parameters = [NAMES[0], udk.Parameter(idle, guess=1.0)]
    problem = udk.inference(pendulum(0.4), record(), parameters)
    with pytest.raises(udk.IdentificationError, match="neither the records nor a prior determine idle: give"):
        approximate(problem, problem.start)
    problem = udk.inference(pendulum(0.4), record(), parameters, priors={"idle": (2.0, 0.3)})
    assert_allclose(approximate(problem, problem.start).parameters["idle"], (2.0, 0.3), rtol=1e-6)


def test_heavy_tails_are_not_trusted():
    parameter = udk.Parameter(idle, guess=1.0, transform="free")
    problem = udk.inference(pendulum(0.4), record(), parameter, priors={"idle": lambda x: -jnp.log1p((10 * x) ** 2)})
    found = approximate(problem, np.array([-0.99]))
    assert not found.trusted and "sample the posterior" in found.message


def test_a_robust_fit_has_no_density():
    estimate = udk.identify(pendulum(0.4), record(), NAMES[:1], loss="huber", n_starts=0)
    with pytest.raises(udk.IdentificationError, match="the loss is no log density"):
        estimate.laplace()


@pytest.mark.parametrize("k", [0.2, 0.5, 1.0])
def test_the_exponent_is_that_of_pareto_distributions(k):
    weights = -k * np.log(np.random.default_rng(1).random((20, 4000)))
    found = [pareto_exponent(row) for row in weights]
    assert abs(np.mean(found) - k) < 0.05 and np.std(found) < 0.15
    assert_allclose(pareto_exponent(weights[0] + 700.0), found[0], rtol=1e-9)
    assert pareto_exponent(np.zeros(100)) == -np.inf


def test_errors_of_means_and_deviations_are_those_of_integrals():
    """A skew density with short tails, whose mode is 1 and whose curvature there is 1."""
    parameter = udk.Parameter(idle, guess=1.0, transform="free")
    density = lambda y: -(y**2) / 2 - 0.4 * y**3 - 0.3 * y**4  # noqa: E731
    problem = udk.inference(pendulum(0.4), record(), parameter, priors={"idle": lambda x: density(x - 1.0)})
    found = approximate(problem, problem.start)
    total, first, second = (quad(lambda y, n=n: y**n * np.exp(density(y)), -6.0, 6.0)[0] for n in range(3))
    mean = first / total
    assert_allclose(found.shift, abs(mean), atol=0.08)
    assert_allclose(found.ratio, 1.0 / np.sqrt(second / total - mean**2), rtol=0.08)
    assert found.k < 0.5 and not found.trusted and "deviations by a factor of" in found.message
