"""Least squares of few rows: the triangular factor of residuals and Jacobian, and fits that agree."""

import numpy as np
import pytest

from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum
from udkjax.study.identify.fit_problem import FitProblem
from udkjax.study.identify.least_squares import Fit, reduce_rows
from udkjax.study.identify.parameters import unknowns_of
from udkjax.study.identify.records import Record
from udkjax.study.identify.search import count_agreeing

TOL = 1e-7, 1e-7


@pytest.mark.parametrize(("rows", "columns"), [(3, 5), (40, 3), (20_000, 4), (5000, 60)])
def test_reduced_rows_have_the_same_products(rows, columns):
    rng = np.random.default_rng(rows)
    J = rng.standard_normal((rows, columns)) * 10.0 ** np.linspace(0, -9, columns)  # J^T J would lose half of the digits
    J[:, -1] = J[:, 0] + J[:, -1] if columns > 3 else 0.0
    r = rng.standard_normal(rows)
    few, factor = reduce_rows(r, J)
    assert factor.shape == (min(rows, columns + 1), columns)
    np.testing.assert_allclose(few @ few, r @ r, rtol=1e-12)
    size = np.linalg.norm(J, axis=0)
    np.testing.assert_allclose(factor.T @ few, J.T @ r, atol=1e-12 * np.linalg.norm(r) * size.max())
    assert np.all(np.abs(factor.T @ factor - J.T @ J) <= 1e-12 * np.outer(size, size))


def test_fits_agree_whatever_the_value_of_an_unknown_at_its_bound():
    """Where a damping is best at zero, z tends to minus infinity, and each fit stops elsewhere on the way."""
    first, angle = pendulum(damping=0.2), np.sin(TS)
    angle = angle + 0.1 * np.random.default_rng(0).standard_normal(len(TS))
    problem = FitProblem(first, unknowns_of(first, NAMES), [Record(TS, {ANGLE: angle})])
    bound = np.array([False, True])

    def fit(z, stuck, cost=1.0):
        return Fit(np.array(z), cost, True, [], stuck)

    best = fit([0.1, -15.0], bound)
    assert count_agreeing(problem, [best, fit([0.1 + 1e-7, -11.0], bound, 1.0 + 1e-9)], TOL) == 2
    assert count_agreeing(problem, [best, fit([0.3, -11.0], bound, 1.1)], TOL) == 1  # another minimum
    assert count_agreeing(problem, [fit([0.1, -5.0], ~bound & bound), fit([0.1, -3.0], None, 1.1)], TOL) == 1
    assert count_agreeing(problem, [fit([0.1, -15.0], bound, np.inf)], TOL) == 0
