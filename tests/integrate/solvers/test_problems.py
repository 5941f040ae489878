"""The benchmark problems end where they should."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipk

from benchmarks.problems import NOT_STIFF, PROBLEMS


def test_pendulum_ends_where_elliptic_functions_end():
    k, w = np.sin(1.0), np.sqrt(9.81)
    sn, cn, *_ = ellipj(ellipk(k**2) + 10 * w, k**2)
    np.testing.assert_allclose(NOT_STIFF["pendulum"].reached, [2 * np.arcsin(k * sn), 2 * k * w * cn], rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", NOT_STIFF)
def test_end_state(name):
    """The orbit magnifies an error of the first step by a factor of 1e3 to 1e4."""
    problem = NOT_STIFF[name]
    found = solve_ivp(lambda t, y: problem.f(t, y, np), (0, problem.end), problem.y0, method="DOP853", rtol=3e-14, atol=1e-15)
    assert problem.error(found.y[:, -1]) < {"pendulum": 1e-12, "Arenstorf": 3e-10, "Pleiades": 1e-11}[name]


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_same_in_numpy_and_in_jax(name):
    problem = PROBLEMS[name]
    y = np.array(problem.y0) + 0.01 * np.arange(len(problem.y0))
    np.testing.assert_allclose(problem.f(0.0, y), problem.f(0.0, y, np), rtol=1e-13)


def test_errors_are_relative_to_the_scale():
    problem = PROBLEMS["Robertson"]
    off = np.array(problem.reached) + np.array([0.0, 1e-9, 0.0])
    assert problem.error(off) == pytest.approx(1e-9 / (1e-6 + problem.reached[1]))


def test_stiff_problems_end_at_the_states_of_the_data(data):
    for name, known in data("stiff_problems").items():
        if name in PROBLEMS:
            assert known["times"][-1] == PROBLEMS[name].end
            assert known["scale"] == list(np.broadcast_to(PROBLEMS[name].scale, len(known["scale"])))
            np.testing.assert_allclose(PROBLEMS[name].reached, known["states"][-1], rtol=1e-10)
