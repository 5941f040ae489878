"""The C++ program computes the exact motion: single runs, runs in lanes, and runs with derivatives."""

import numpy as np
import pytest

benchmarks = pytest.importorskip("benchmarks", reason="not in a source tree")

from benchmarks import native  # noqa: E402
from benchmarks.batch import END, OMEGA, angles, exact  # noqa: E402
from benchmarks.peers.peer import STARTS, problem  # noqa: E402
from udkjax.study.accuracy import pendulum  # noqa: E402


@pytest.fixture(scope="module", autouse=True)
def _compiler():
    if native.program() is None:
        pytest.skip("no C++ compiler")


@pytest.mark.parametrize("start", STARTS)
def test_it_is_exact(start):
    """From +60 degrees it crosses singular configurations, by singular values. The links stay on their pivots."""
    task = problem(start)
    for tolerance, error in ((1e-6, 1e-4), (1e-8, 1e-6), (1e-10, 1e-8)):
        run = native.run(states=True, start=start, tolerance=tolerance, seconds=0.0)
        q = run["states"][0, :, :12]
        assert task.error(q) < error
        assert (run["minimum_norms"] > 0) == (start > 0)
        links, half = q[:, :9].reshape(-1, 3, 3), 0.5
        feet = links[..., :2] - half * np.stack([np.cos(links[..., 2]), np.sin(links[..., 2])], axis=-1)
        # With kept factors, two Newton steps leave the more of an interpolated state's error, the nearer it is to being singular.
        assert np.abs(feet - [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]).max() < (1e-10 if start > 0 else 1e-13)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("outputs", [2, 21])
def test_lanes_are_as_exact_as_single_runs(start, outputs):
    releases = angles(start, 20)  # no multiple of eight
    truth = exact(releases, np.linspace(0.0, END, outputs))
    for lanes in (1, 8):
        run = native.run(
            states=True, mode="batch", starts=releases, lanes=lanes, tolerance=1e-8, t1=END, outputs=outputs, seconds=0.0
        )
        assert np.abs(run["states"][..., :12] - truth).max() < 1e-6


def test_dual_numbers_agree_with_differences_of_the_exact_motion():
    """The closed form: omega^2 = g (m1 / 2 + m2 / 2 + m3 / 2 + mc) / (I1 + I2 + I3 + (m1 + m2 + m3) / 4 + mc)."""

    def angle(numbers):
        *masses, coupler = numbers[:4]
        moment, inertia = sum(masses) / 2 + coupler, sum(numbers[4:7]) + sum(masses) / 4 + coupler
        return pendulum(np.array([END]), np.pi / 4, 0.0, np.sqrt(numbers[7] * moment / inertia))[0]

    numbers = np.array([1.0, 1.0, 1.0, 2.0, 0.1, 0.1, 0.1, 9.81])
    assert np.isclose(numbers[7] * 3.5 / 3.05, OMEGA**2)
    differences = [(angle(numbers + h) - angle(numbers - h)) / 2e-5 for h in 1e-5 * np.eye(8)]
    for count in (1, 2, 4, 8):
        run = native.run(mode="gradient", parameters=count, tolerance=1e-10, t1=END, outputs=2, seconds=0.0)
        assert run["angle"] == pytest.approx(angle(numbers) - np.pi / 4, abs=1e-8)
        np.testing.assert_allclose(run["gradient"], differences[:count], rtol=1e-6)
        assert tuple(run["parameters"]) == native.PARAMETERS[:count]
