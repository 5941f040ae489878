"""Fits by optax's optimizers: the minimum of least squares, and of other losses."""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum
from udkjax.study.identify.identification import identify
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.records.records import IdentificationError, Record
from udkjax.study.identify.search.optimizer import GradientMethod, Minimizer, minimize_by_gradient

TOL, NOISE = (1e-9, 1e-9), 1e-3


def problem_of(angle: np.ndarray) -> FitProblem:
    first = pendulum(0.4, 0.15)
    return FitProblem(first, unknowns_of(first, NAMES), [Record(TS, {ANGLE: angle}, noise=NOISE)])


def objective(problem: FitProblem):
    return partial(problem.row_blocks, tol=TOL)


@pytest.fixture(scope="module")
def noisy(measured):
    return measured[1] + NOISE * np.random.default_rng(1).standard_normal(len(TS))


OTHERS = {
    "adam": (optax.adam(optax.exponential_decay(0.05, 30, 0.6)), 1e-5, 1e-4),
    "L-BFGS without line search": (optax.lbfgs(linesearch=None), 1e-6, 1e-5),
    "L-BFGS of scipy": (None, 1e-6, 1e-5),
}


@pytest.mark.slow
@pytest.mark.parametrize(("optimizer", "step_tol", "within"), OTHERS.values(), ids=list(OTHERS))
def test_optimizers_end_where_least_squares_do(noisy, optimizer, step_tol, within):
    problem = problem_of(noisy)
    fit = minimize_by_gradient(GradientMethod(optimizer), objective(problem), np.zeros(2), steps=600, step_tol=step_tol)
    squares = Minimizer().minimize(problem, np.zeros(2), TOL)
    assert fit.converged and np.abs(fit.z - squares.z).max() < within
    costs = [cost for cost, _ in fit.history]
    assert costs == sorted(costs, reverse=True) and costs[-1] == fit.cost


def test_a_loss_of_the_users_own(noisy):
    """Smoothed absolute residuals are insensitive to an outlier of a hundred standard deviations; squares are not."""
    noisy = noisy.copy()
    noisy[5::10] += 0.1
    problem = problem_of(noisy)
    method = GradientMethod(None, lambda r: jnp.sum(jnp.sqrt(1.0 + r**2)))
    fit = minimize_by_gradient(method, objective(problem), np.zeros(2), steps=200)
    squares = Minimizer().minimize(problem, np.zeros(2), TOL)
    truth = problem.unknowns.z_of(np.array([0.375, 0.2]))
    assert fit.converged and np.abs(fit.z - truth).max() < 0.02
    assert np.abs(squares.z - truth).max() > 3.0 * np.abs(fit.z - truth).max()


def test_identify_takes_them(noisy):
    first, record = pendulum(0.4, 0.15), Record(TS, {ANGLE: noisy}, noise=NOISE)
    squares = identify(first, record, NAMES, progress=False)
    several: list[dict[str, Any]] = [{"optimizer": optax.lbfgs(linesearch=None)}, {"loss": lambda r: 0.5 * jnp.sum(r**2)}]
    for choices in several:
        estimate = identify(first, record, NAMES, progress=False, **choices)
        assert estimate.converged and estimate.values == pytest.approx(squares.values, rel=1e-5)
    with pytest.raises(IdentificationError, match="use one without a line search"):
        identify(first, record, NAMES, progress=False, optimizer=optax.lbfgs())
