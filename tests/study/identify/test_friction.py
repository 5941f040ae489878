"""Friction of the pins of a four-bar from noisy torque and motion, at several speeds."""

import numpy as np
import pytest

import udkjax as udk

TRUE = {"A": 0.12, "B": 0.18, "C": 0.09, "D": 0.15}
NAMES = [f"friction.{pin}.coefficient" for pin in TRUE]


def four_bar(coefficients, **numbers):
    """A four-bar whose crank a motor turns; `numbers` are those of the friction at A."""
    friction = {pin: {"pin": pin, "radius": 10, "coefficient": value} for pin, value in coefficients.items()}
    friction["A"] |= numbers
    links = {"crank": ("A", "B", 1), "rod": ("B", "C", 3), "rocker": ("C", "D", 3)}
    return udk.Drawing(
        pins={"A": [0, 0], "B": [0, 100], "C": [300, 200], "D": [300, 0]},
        links={name: {"pins": [one, two], "mass": mass} for name, (one, two, mass) in links.items()},
        ground=["A", "D"],
        motors={"motor": {"pin": "A", "speed": "6 rad/s"}},
        friction=friction,
        units={"length": "mm"},
    ).mechanism()


def measured(machine, speeds, seed, samples=3000):
    """Return records of two turns each, with noise of 2 mN m, about a hundredth of the torque of friction, and of 1 mrad."""
    rng, records = np.random.default_rng(seed), []
    for speed in speeds:
        turning, ts = machine.with_parameters({"motor.motor.speed": speed}), np.linspace(0.0, 4 * np.pi / speed, samples)
        run = udk.simulate(turning, ts)
        values = {
            "driver.motor.load": np.asarray(udk.efforts(turning, run)["motor"]) + 2e-3 * rng.standard_normal(samples),
            "body.rocker.angle": np.asarray(run.q)[:, 2, 2] + 1e-3 * rng.standard_normal(samples),
        }
        records.append(udk.Record(ts, values, conditions={"motor.motor.speed": speed}))
    return records


@pytest.mark.slow
def test_four_coefficients_to_one_percent():
    guess, values = four_bar(dict.fromkeys(TRUE, 0.1)), np.array(list(TRUE.values()))
    for seed in range(5):
        found = udk.identify(guess, measured(four_bar(TRUE), (1.0, 12.0, 20.0), seed), NAMES, progress=False)
        errors = found.uncertainty.standard_errors
        assert found.success and found.ways == ("whole records",)
        assert np.all(np.abs(found.values / values - 1.0) < 0.01)
        assert np.all(np.abs(found.values - values) < 4.0 * errors) and np.all(errors < 0.01 * values)


@pytest.mark.slow
def test_a_curve_that_no_record_shows_is_not_determined():
    numbers = ["coefficient", "static_coefficient", "speed"]
    names, values = [f"friction.A.{number}" for number in numbers], np.array([0.12, 0.2, 0.003])
    machine = four_bar(TRUE, static_coefficient=0.2, speed="3 mm/s")
    guess = four_bar(TRUE | {"A": 0.1}, static_coefficient=0.15, speed="2 mm/s")
    slow = udk.identify(guess, measured(machine, (0.2, 0.5, 2.0), 0), names, progress=False)
    assert slow.success and np.all(np.abs(slow.values / values - 1.0) < 0.02)
    fast = udk.identify(guess, measured(machine, (12.0, 20.0), 0), names, progress=False)
    assert not fast.success and abs(fast.values[0] / 0.12 - 1.0) < 0.01
    assert np.isinf(fast.uncertainty.standard_errors[1:]).all() and "no measured quantity" in fast.message
