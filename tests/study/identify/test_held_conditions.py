"""Records in which a number of the scene was held between samples, each with its own."""

from typing import Any

import numpy as np
import pytest

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, pendulum
from udkjax.study.identify.problem.unknowns import conditions_of

SETPOINT = "force.spring.angle"
TS = np.linspace(0.0, 2.0, 21)
SAMPLES = 0.5 * np.cos(np.arange(12.0))


def record(value, **choices):
    """A record of the true pendulum whose servo follows a setpoint."""
    run = udk.simulate(pendulum().with_parameters({SETPOINT: value}), TS, rtol=1e-12, atol=1e-12)
    return udk.Record(TS, {ANGLE: run.q[:, 0, 2]}, 0.01, conditions={SETPOINT: value}, **choices)


@pytest.mark.slow
def test_parameters_are_found_from_records_with_other_samples():
    """Also with fewer samples in one record, and a constant number in another."""
    records = [record(udk.Held(SAMPLES, 0.15)), record(udk.Held(-SAMPLES[:7], 0.15)), record(np.array(0.2))]
    estimate = udk.identify(pendulum(0.5, 0.1), records, NAMES, progress=False)
    assert estimate.success
    assert estimate.values == pytest.approx((0.375, 0.2), rel=1e-8)


def test_samples_that_do_not_fit_together_are_named():
    first, other = record(udk.Held(SAMPLES, 0.15)), record(udk.Held(SAMPLES, 0.1))
    with pytest.raises(udk.IdentificationError, match=r'"force.spring.angle" must be held with the same `dt` and `t0` in all'):
        conditions_of(pendulum(), [first, other])
    vectors = udk.Record(TS, first.values, conditions={SETPOINT: udk.Held(np.zeros((3, 2)), 0.1)})
    with pytest.raises(udk.IdentificationError, match=r"must be of shape \(\) at each sample"):
        conditions_of(pendulum(), [vectors])


@pytest.mark.parametrize("usual", [udk.Held(np.zeros(3), 0.15), 0.0], ids=["sampled", "constant"])
def test_a_number_that_the_scene_samples_may_be_given_too(usual):
    """Its samples in the scene are those of the records that do not give any; a constant one may be held in some records."""
    scene = pendulum().with_parameters({SETPOINT: usual})
    given = record(udk.Held(SAMPLES, 0.15))
    other = udk.Record(TS, given.values, 0.01)
    found: Any = conditions_of(scene, [given, other])[SETPOINT]
    assert (found.dt, found.t0) == (0.15, 0.0)
    np.testing.assert_array_equal(found.values, [SAMPLES, np.zeros(12)])
    constant = udk.Record(TS, given.values, 0.01, conditions={SETPOINT: 0.3})
    found = conditions_of(scene, [given, constant])[SETPOINT]
    np.testing.assert_array_equal(found.values[1], np.full(12, 0.3))
    np.testing.assert_array_equal(conditions_of(scene, [constant])[SETPOINT], [0.3])
    entry = udk.Record(TS, given.values, 0.01, conditions={f"{SETPOINT}.values": SAMPLES})
    if isinstance(usual, udk.Held):
        samples = udk.Record(TS, given.values, 0.01, conditions={f"{SETPOINT}.values": SAMPLES[:3]})
        np.testing.assert_array_equal(conditions_of(scene, [samples])[f"{SETPOINT}.values"], [SAMPLES[:3]])
    else:
        with pytest.raises(udk.IdentificationError, match="no parameter"):
            conditions_of(scene, [entry])
