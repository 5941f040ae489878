import json
from pathlib import Path

import numpy as np
import pytest

import udkjax as udk
from udkjax.study.accuracy import exact_coordinates, pendulum

LINKAGE = json.loads((Path(__file__).parents[1] / "data" / "seed_fivebar_parallelogram.json").read_text())["cases"]


def placed(theta, rate):
    """The linkage with its links at `theta` (rad), turning at `rate` (rad/s): q and v."""
    along, across = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    q = [[*(np.array([x, 0]) + along / 2), theta] for x in (0, 1, 2)] + [[*(np.array([1, 0]) + along), 0]]
    v = [[*(rate / 2 * across), rate]] * 3 + [[*(rate * across), 0]]
    return np.array(q), np.array(v)


@pytest.mark.parametrize("case", LINKAGE.values(), ids=LINKAGE)
def test_parallelogram_moves_as_the_published_reference_says(case):
    reference = {float(t): row for t, row in case["reference"].items()}
    ts = np.array(sorted(reference))
    theta = np.array([float(reference[t]["theta"]) for t in ts])
    q = exact_coordinates(udk.library.parallelogram(), ts, *placed(theta[0], case["thetad0"]))
    assert q is not None
    expected = np.array([placed(angle, 0)[0] for angle in theta])
    turned = np.round((q[:, :3, 2] - theta[:, None]) / (2 * np.pi)) * 2 * np.pi  # the reference stays within one turn
    expected[:, :3, 2] += turned
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "rate"), [(2.0, 0.0), (1.0, -3.0), (0.3, 9.0), (0.3, -9.0), (np.pi, -1.0), (3.5, 0.2), (0.0, 1e-9)]
)
def test_pendulum_keeps_its_energy_and_its_equation(angle, rate):
    omega, h = 3.0, 1e-4
    ts = np.linspace(0, 4, 9)[:, None] + h * np.array([-2, -1, 0, 1, 2])
    phi = angle + pendulum(ts, angle, rate, omega)
    speed = (phi @ [1, -8, 0, 8, -1]) / (12 * h)
    acceleration = (phi @ [-1, 16, -30, 16, -1]) / (12 * h**2)
    np.testing.assert_allclose(speed**2 / 2 - omega**2 * np.cos(phi[:, 2]), rate**2 / 2 - omega**2 * np.cos(angle), atol=1e-9)
    np.testing.assert_allclose(acceleration, -(omega**2) * np.sin(phi[:, 2]), atol=1e-5)
    assert phi[0, 2] == pytest.approx(angle)


def test_pendulum_that_stands_stands():
    np.testing.assert_array_equal(pendulum(np.linspace(0, 5, 3), np.pi, 0.0, 3.0), 0)
    np.testing.assert_array_equal(pendulum(np.linspace(0, 5, 3), 0.0, 0.0, 3.0), 0)


def test_weightless_pendulum_turns_evenly():
    np.testing.assert_allclose(pendulum(np.array([0.0, 2.0]), 1.0, 0.5, 0.0), [0.0, 1.0])


@pytest.mark.parametrize("change", [{"joint.A1.points[1][0]": -0.6}, {"joint.B2.points[0][0]": 0.1}])
def test_a_linkage_that_is_no_parallelogram_has_no_exact_solution(change):
    mech = udk.library.parallelogram()
    assert exact_coordinates(mech.with_parameters(change), [0.0, 1.0], *placed(-0.8, 0.0)) is None


def test_other_mechanisms_have_none_either():
    for name in ("four_bar", "double_pendulum", "slider_crank", "simple_pendulum"):
        mech = getattr(udk.library, name)()
        assert exact_coordinates(mech, [0.0, 1.0], mech.q0, mech.v0) is None, name
