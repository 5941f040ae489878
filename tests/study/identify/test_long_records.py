"""Records of many swings, from first guesses wrong by a factor: found if the data determine the answer."""

import numpy as np
import pytest

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.study.identify.identification import identify
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.records.records import Record
from udkjax.study.identify.search.growing_records import fit_growing_records, noise_of_records
from udkjax.study.identify.search.optimizer import Minimizer
from udkjax.study.noise import noise_of_differences, outlier_rows

LOOSE_TOL = 1e-7, 1e-7


def test_noise_is_seen_before_anything_is_fitted():
    rng = np.random.default_rng(0)
    for t in (np.linspace(0.0, 10.0, 400), np.sort(rng.uniform(0.0, 10.0, 400))):
        y = np.sin(2.0 * t) + 0.05 * rng.standard_normal(len(t))
        y[[20, 21, 200]] += 30.0
        y[50:60] = np.nan
        assert noise_of_differences(t, y) == pytest.approx(0.05, rel=0.2)
    assert np.isnan(noise_of_differences(t[:2], y[:2]))


def test_a_record_grows_as_far_as_it_is_predicted():
    """Twenty swings, twice the inertia and a degree of noise: a few parts, each many times as long as the previous one."""
    truth, ts = pendulum(damping=0.005), np.linspace(0.0, 40.0, len(TS))
    angle = swing(truth, ts) + 0.02 * np.random.default_rng(1).standard_normal(len(ts))
    first = pendulum(0.75, 0.01)
    problem, parts = FitProblem(first, unknowns_of(first, NAMES), [Record(ts, {ANGLE: angle})]), []
    fit = fit_growing_records(problem, np.zeros(2), LOOSE_TOL, Minimizer(report=parts.append))
    found = problem.unknowns.values(fit.z)
    assert fit.converged and np.all(np.abs(found / [0.375, 0.005] - 1.0) < [0.01, 0.2])
    assert len({text.split(":")[0] for text in parts}) <= 8
    assert problem.predictor.evaluations < 60


def test_a_record_that_begins_late():
    """The motion began several swings before the first sample: further guesses are ranked and tried."""
    truth, ts = pendulum(damping=0.02), np.linspace(10.0, 20.0, len(TS) - 1)
    angle = swing(truth, np.append(0.0, ts))[1:] + 0.01 * np.random.default_rng(2).standard_normal(len(ts))
    estimate = identify(pendulum(0.2, 0.04), Record(ts, {ANGLE: angle}, t0=0.0), NAMES, progress=False)
    assert estimate.success and "better minimum" not in estimate.message
    assert np.all(np.abs(estimate.values - [0.375, 0.02]) < 4.0 * estimate.uncertainty.standard_errors)


def test_outliers_are_single_numbers():
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((2000, 300))
    assert sum(outlier_rows(row).any() for row in noise) <= 12  # two are expected; noise of a sample's median makes a few more
    r = noise[0].copy()
    r[[7, 8, 250]] = 30.0, -8.0, 9.0
    assert np.flatnonzero(outlier_rows(r)).tolist() == [7, 8, 250]
    r[100:110] = 30.0  # another signal
    assert np.flatnonzero(outlier_rows(r)).tolist() == [7, 8, 250]
    assert not outlier_rows(np.zeros(9)).any() and not outlier_rows(np.zeros(0)).any()


def test_noise_that_is_given_is_taken():
    first = pendulum()
    angle = np.sin(TS) + 0.01 * np.random.default_rng(0).standard_normal(len(TS))
    for noise, expected in ((0.3, 0.3), (None, noise_of_differences(TS, angle))):
        problem = FitProblem(first, unknowns_of(first, NAMES), [Record(TS, {ANGLE: angle}, noise=noise)])
        assert noise_of_records(problem) == pytest.approx(expected)


@pytest.mark.slow
def test_two_hundred_pendulums():
    """A pendulum at 20 Hz for 25 s, 14 swings, with a degree of noise; guesses are off by up to a factor of two.

    A fit is right if its residuals are the added noise, and both values are within five standard errors.
    """
    names, truth, sigma = ("joint.pin.points[1][1]", "force.d.damping"), np.array([0.75, 0.09 * 0.75**2]), np.radians(1.0)
    angle, ts = np.radians(55.0), np.arange(0.0, 25.001, 0.05)
    bob = udk.Body(1.0, 1e-4, (0.75 * np.sin(angle), -0.75 * np.cos(angle)), angle)
    pin = udk.Revolute((udk.GROUND, "bob"), [(0.0, 0.0), (0.0, truth[0])])
    mech = udk.Mechanism({"bob": bob}, {"pin": pin}, forces={"d": udk.TorsionSpring((udk.GROUND, "bob"), 0.0, truth[1])})
    clean = np.asarray(udk.simulate(mech, ts, rtol=1e-11, atol=1e-11).q)[:, 0, 2]
    arrived, inside = 0, []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        guess = (1.3, 0.25) if seed == 0 else truth * 2.0 ** rng.uniform(-1.0, 1.0, 2)
        data = {"time": ts, "body.bob.angle": clean + sigma * rng.standard_normal(len(ts))}
        estimate = identify(mech.with_parameters(dict(zip(names, guess, strict=True))), data, names, progress=False)
        off = np.abs(estimate.values - truth) / estimate.uncertainty.standard_errors
        noise = estimate.noise[0]["body.bob.angle"][0] / sigma
        arrived += bool(estimate.success and abs(noise - 1.0) < 0.15 and off.max() < 5.0)
        inside.append(off.max() < 3.0)
    assert arrived == 200
    assert np.mean(inside) > 0.97  # 0.995 is expected of two parameters
