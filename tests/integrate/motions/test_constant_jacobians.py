"""Mechanisms with a constant Psi_q: whether a pivot is small depends only on their numbers, which may be traced."""

import jax
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.choices import fast

PUSH = udk.Torque(["ground", "one"], 0.7)
ONE, TWO = udk.Body(1.0, 0.1), udk.Body(2.0, 0.3, [1.0, 0.0])
SCENES = {
    "angle": udk.Mechanism({"one": ONE, "two": TWO}, {"same": udk.Angle(["one", "two"])}, forces=[PUSH]),
    "gears": udk.Mechanism({"one": ONE, "two": TWO}, {"teeth": udk.Gear(["one", "two"], [0.4, 0.6])}, forces=[PUSH]),
}


@pytest.mark.parametrize("name", fast(["gears"], SCENES))
def test_reverse_mode_under_jit(name):
    mechanism, parameter = SCENES[name], "body.one.inertia"
    value = float(mechanism.bodies["one"].inertia)

    def end(x):
        q = udk.simulate(mechanism.with_parameters({parameter: x}), [0.0, 0.5, 1.0], rtol=1e-10, atol=1e-10).q[-1]
        return q[0, 0] + 2.0 * q[0, 2] + q[-1, 2]

    step = 1e-4
    expected = (end(value + step) - end(value - step)) / (2 * step)
    assert_allclose(jax.jit(jax.grad(end))(value), expected, rtol=1e-6)
