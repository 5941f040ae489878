import numpy as np
import pytest

import udkjax as udk
from experiments.paper.drift_law import Swing, drift, growth_rate, swing_of

OMEGA = np.sqrt(3.5 * 9.81 / 3.05)  # of the paper's linkage: 3.05 theta'' = -3.5 g cos(theta)


def swing(degrees: float) -> Swing:
    return Swing(OMEGA, np.radians(90 + degrees))


@pytest.mark.parametrize(("start", "rate"), [(-50, 1.590), (-45, 1.770), (-30, 2.272)])
def test_a_drift_grows_at_the_rate_found_in_the_full_equations(start, rate):
    """The rates were measured in nonlinear runs, and agree with the Floquet multipliers of their 24 states."""
    assert growth_rate(swing(start)) == pytest.approx(rate, abs=6e-4)


@pytest.mark.parametrize("gain", [0.5, 2.0, 5.0])
def test_equal_gains_lower_the_rate_by_themselves(gain):
    """rho = exp(-a t) u turns rho'' + 2 a rho' + (a^2 - theta'^2) rho = 0 into u'' - theta'^2 u = 0."""
    assert growth_rate(swing(-45), gain, gain) == pytest.approx(growth_rate(swing(-45)) - gain, abs=1e-7)


def test_without_motion_the_law_is_a_damped_oscillator():
    resting = Swing(OMEGA, 0.0)
    assert growth_rate(resting, 1.0, 3.0) == pytest.approx(-1.0, abs=1e-8)
    assert growth_rate(resting, 1000.0, 100.0) == pytest.approx(-1000 + np.sqrt(1000**2 - 100**2), rel=1e-6)


def test_a_drift_follows_its_rate_from_one():
    ts = np.linspace(0.0, 10 * swing(-45).period, 21)
    rho = drift(swing(-45), ts)
    assert rho[0] == 1.0
    slopes = np.diff(np.log(rho)) / np.diff(ts)
    np.testing.assert_allclose(slopes[5:], growth_rate(swing(-45)), rtol=1e-6)


def test_the_swing_is_that_of_the_linkage():
    mech = udk.library.parallelogram(np.radians(-50))
    found = swing_of(mech, mech.q0)
    assert found.omega == pytest.approx(OMEGA)
    assert found.amplitude == pytest.approx(np.radians(40))
    assert found.period == pytest.approx(1.931360489894851)  # 4 K(sin 20 deg) / omega
    with pytest.raises(ValueError, match="not a parallelogram"):
        swing_of(udk.library.double_pendulum(), udk.library.double_pendulum().q0)
