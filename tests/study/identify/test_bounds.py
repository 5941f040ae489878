"""Parameters that are best at a bound, and where the motion of an estimate begins."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

LENGTH, GRAVITY = 0.5, 9.81
TIMES = np.arange(0.0, 5.0, 0.02)


def swing(damping=0.01, angle=0.5):
    """A pendulum of a point mass on a rod without mass, with a damper at its pin."""
    bob = udk.Body(1.0, 1e-6, [LENGTH * np.sin(angle), -LENGTH * np.cos(angle)], angle)
    pin = udk.Revolute(["ground", "bob"], [[0, 0], [0, LENGTH]])
    return udk.Mechanism(
        {"bob": bob}, {"pin": pin}, forces={"d": udk.TorsionSpring(["ground", "bob"], stiffness=0.0, damping=damping)}
    )


def measured(seed, **start):
    angle = udk.simulate(swing(0.0, **start), TIMES).q[:, 0, 2]
    return {"time": TIMES, "body.bob.angle": np.asarray(angle) + 0.01 * np.random.default_rng(seed).normal(size=len(TIMES))}


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("bounds", [None, (0.0, 1.0)], ids=["positive", "bounded"])
def test_a_damping_that_is_best_at_zero_is_at_its_bound(seed, bounds):
    parameters = [udk.Parameter("force.d.damping", bounds=bounds), "joint.pin.points[1][1]"]
    found = udk.identify(swing(), measured(seed), parameters, progress=False)
    assert found.success and found.converged and found.at_bounds == ("force.d.damping",)
    error = found.standard_errors["force.d.damping"]
    assert 2e-4 < error < 5e-4 and found.parameters["force.d.damping"] < 0.02 * error
    assert f"force.d.damping is at its bound, 0; from above it is known to {error:.2g} N m s/rad" in found.message
    assert found.evaluations < 100
    # As with the damping fixed at zero; the length errs by its standard error.
    assert_allclose(found.parameters["joint.pin.points[1][1]"], LENGTH, rtol=0, atol=4e-4)


def test_the_mechanism_of_an_estimate_begins_where_the_record_began():
    found = udk.identify(swing(0.05, 0.2), measured(0, angle=0.5), ["force.d.damping"], initial_state="position", progress=False)
    alone, fitted = udk.simulate(found.mechanism, TIMES), udk.simulate(found.mechanism, TIMES, found.initial_states[0])
    assert_allclose(alone.q, fitted.q, rtol=0, atol=1e-9)
    assert_allclose(udk.loads(udk.dumps(found.mechanism)).q0, found.initial_states[0].q, rtol=0, atol=1e-15)
    assert abs(float(alone.q[0, 0, 2]) - 0.5) < 0.01
