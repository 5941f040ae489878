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


def carts(masses=(0.4, 0.4), stiffness=(10.0, 10.0, 10.0), damping=(0.02, 0.02)):
    """Two carts on a track, between springs from wall to wall."""
    bodies = {"one": udk.Body(masses[0], 0.01, position=[0.1, 0.0]), "two": udk.Body(masses[1], 0.01, position=[0.35, 0.0])}
    rails = {name: udk.Prismatic(["ground", name], [[0, 0], [0, 0]], axis=0.0) for name in bodies}
    ends = {
        "left": (["ground", "one"], [[-0.5, 0.0], [0.0, 0.0]]),
        "middle": (["one", "two"], [[0.0, 0.0], [0.0, 0.0]]),
        "right": (["two", "ground"], [[0.0, 0.0], [1.0, 0.0]]),
    }
    dampings = damping[0], 0.0, damping[1]
    springs = {name: udk.Spring(*end, k, 0.5, c) for (name, end), k, c in zip(ends.items(), stiffness, dampings, strict=True)}
    return udk.Mechanism(bodies, rails, forces=springs)


@pytest.mark.slow
def test_coloured_noise_and_a_damping_that_is_best_at_zero_need_few_guesses():
    """Nothing explains coloured noise, so that other guesses are tried, until enough of them lead to the same minimum."""
    ts, rng = np.linspace(0.0, 20.0, 1200), np.random.default_rng(1)
    x = np.array(udk.simulate(carts((0.42, 0.38), (11.0, 9.0, 10.5), (0.0, 0.05)), ts).q)[:, :, 0]
    noise, white = np.zeros_like(x), rng.standard_normal(x.shape)
    for k in range(1, len(ts)):
        noise[k] = 0.6 * noise[k - 1] + 0.8 * white[k]
    x = x + 0.01 * noise
    names = ["body.one.mass", *(f"force.{spring}.stiffness" for spring in ("left", "middle", "right"))]
    dampings = ["force.left.damping", "force.right.damping"]
    found = udk.identify(
        carts(),
        {"time": ts, "body.one.x": x[:, 0], "body.two.x": x[:, 1]},
        names + dampings,
        initial_state="both",
        progress=False,
    )
    assert found.success and found.at_bounds == ("force.left.damping",)
    assert found.agreeing == found.guesses == 4 and found.evaluations < 600
    truth = np.array([0.42, 11.0, 9.0, 10.5])
    assert np.all(np.abs(found.values[:4] - truth) < 4.0 * found.uncertainty.standard_errors[:4])
