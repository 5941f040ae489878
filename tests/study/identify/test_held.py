"""Profiles of estimates of linear models, where they are known: what is asked of mechanisms is tested with the command line."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

from udkjax.study.identify import IdentificationError
from udkjax.study.identify.held import Held, profile_of, with_profiles
from udkjax.study.identify.problem import Evaluated

OFFSET, SCALE = np.array([2.0, -1.0]), np.array([0.5, 3.0])


class Linear:
    """r = r0 + J z; the last unknown is that of a start."""

    def __init__(self, K: int = 3):
        random = np.random.default_rng(0)
        self.J, self.r0 = random.normal(size=(40, K)), random.normal(size=40)
        self.program = SimpleNamespace(calls=0)
        P = min(K, 2)
        self.unknowns = SimpleNamespace(values=lambda z: OFFSET[:P] + SCALE[:P] * z, slopes=lambda z: SCALE[:P])

    def evaluate(self, z, tol, horizon=None):
        assert tol == (1e-9, 1e-9) and horizon is None
        return Evaluated(self.r0 + z @ self.J.T, np.tile(self.J, (len(z), 1, 1)), np.zeros(len(z), int))


def fitted(problem, noise=()):
    z = np.linalg.lstsq(problem.J, -problem.r0, rcond=None)[0]
    s = noise[0] if noise else 1.0
    errors = np.sqrt(np.diag(np.linalg.inv(problem.J.T @ problem.J)))[:2] * SCALE[: len(z)] * s
    values = problem.unknowns.values(z[:2])
    names = ("a", "b")[: len(values)]
    known = SimpleNamespace(standard_errors=errors, noise=np.array(noise), degrees_of_freedom=37)
    return SimpleNamespace(
        names=names,
        units=("kg", "m"),
        z=z,
        tol=(1e-9, 1e-9),
        loss=None,
        problem=problem,
        knowledge=known,
        parameters=dict(zip(names, values, strict=True)),
    )


def test_one_unknown_is_held():
    problem = Linear()
    held = Held(problem, 1, 0.7)
    z = np.array([[1.0, -1.0], [0.0, 2.0]])
    assert_allclose(held.whole(z), [[1.0, 0.7, -1.0], [0.0, 0.7, 2.0]])
    found = held.evaluate(z, (1e-9, 1e-9))
    assert_allclose(found.r, problem.r0 + held.whole(z) @ problem.J.T)
    assert_allclose(found.J[1], problem.J[:, [0, 2]])


@pytest.mark.parametrize("name", ["a", "b"])
def test_of_a_linear_model_the_interval_is_that_of_the_standard_error(name):
    estimate = fitted(Linear())
    found = profile_of(estimate, name)  # pyright: ignore[reportArgumentType]
    error = estimate.knowledge.standard_errors[estimate.names.index(name)]
    assert_allclose(found.interval, estimate.parameters[name] + 1.959964 * error * np.array([-1, 1]), rtol=2e-3)
    assert found.text.startswith(f"{name} is between")


def test_noise_that_was_estimated_and_a_single_unknown():
    estimate = fitted(Linear(1), (0.8,))
    found = profile_of(estimate, "a", level=0.9)  # pyright: ignore[reportArgumentType]
    half = 1.687094 * estimate.knowledge.standard_errors[0]  # of Student's t with 37 degrees of freedom
    assert_allclose(found.interval, estimate.parameters["a"] + half * np.array([-1, 1]), rtol=2e-3)
    data = with_profiles(xarray.Dataset(), estimate, [found], 0.9)  # pyright: ignore[reportArgumentType]
    assert_allclose(data["interval"].attrs["limit"], 1.687094**2, rtol=1e-6)
    x = (data["profile_value"][0] - estimate.parameters["a"]) / estimate.knowledge.standard_errors[0]
    assert_allclose(data["rise"][0], x**2, atol=1e-8)


def test_another_name_is_refused():
    with pytest.raises(IdentificationError, match='"aa" was not identified'):
        profile_of(fitted(Linear()), "aa")  # pyright: ignore[reportArgumentType]
