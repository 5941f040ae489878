"""Parameters from records: exact without noise, within their errors with it, and undetermined where they must be."""

import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum, swing
from udkjax.study.identify.identification import identify
from udkjax.study.identify.problem import prediction
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.initial_states import state_unknowns
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.problem.unknowns import sample_guesses
from udkjax.study.identify.search.search import horizons
from udkjax.study.noise import whiteness_of

TRUE = {"body.rod.inertia": 0.375, "force.spring.damping": 0.2}


def found(first, data, parameters=NAMES, **choices):
    return identify(first, data, parameters, progress=False, **choices)


def off(estimate):
    return max(abs(estimate.parameters[name] / value - 1.0) for name, value in TRUE.items() if name in estimate.parameters)


# --- without noise


@pytest.mark.parametrize("factors", [(1.5, 0.5), (0.6, 0.6)])
def test_values_are_found_again(measured, factors):
    first = pendulum(0.375 * factors[0], 0.2 * factors[1])
    estimate = found(first, {"time": TS, ANGLE: measured[1]})
    assert off(estimate) < 1e-10
    assert estimate.success and estimate.converged and estimate.ways == ("whole records",)
    assert estimate.message == "the records determine every parameter"
    assert estimate.mechanism.parameters()["body.rod.inertia"] == estimate.values[0]
    assert np.abs(estimate.residuals[0][ANGLE]).max() < 1e-10


def test_a_long_record_from_far_away():
    """Twenty swings: with twice the inertia the guess lags by many of them, and a fit of the whole record fails."""
    ts = np.linspace(0.0, 40.0, len(TS))
    truth = pendulum(damping=0.005)
    data = {"time": ts, ANGLE: swing(truth, ts)}
    first = pendulum(0.75, 0.01)
    estimate = found(first, data, n_starts=0)
    assert estimate.ways == ("whole records", "growing records")
    assert abs(estimate.values[0] / 0.375 - 1.0) < 1e-8 and abs(estimate.values[1] / 0.005 - 1.0) < 1e-8


def test_gaps_are_left_out(measured):
    angle = measured[1].copy()
    angle[7:30:2] = np.nan
    estimate = found(pendulum(0.5, 0.1), {"time": TS, ANGLE: angle})
    assert off(estimate) < 1e-9 and np.isnan(estimate.residuals[0][ANGLE]).sum() == 12
    assert estimate.uncertainty.degrees_of_freedom == pytest.approx(len(TS) - 12 - 2)


def test_several_guesses_in_one_call(measured):
    guesses = [[0.3, 0.1], [0.5, 0.3], [0.2, 0.4]]
    estimate = found(pendulum(5.0, 2.0), {"time": TS, ANGLE: measured[1]}, guesses=guesses)
    assert off(estimate) < 1e-9 and estimate.guesses == 4 and estimate.agreeing >= 3


# --- with noise


def test_errors_are_as_large_as_said(measured):
    sigma, inside, repetitions = 0.01 * measured[1].std(), [], 60
    for seed in range(repetitions):
        noise = sigma * np.random.default_rng(seed).standard_normal(len(TS))
        estimate = found(measured[0], {"time": TS, ANGLE: measured[1] + noise})
        inside.append([abs(estimate.parameters[n] - TRUE[n]) <= 2.0 * estimate.standard_errors[n] for n in NAMES])
        assert estimate.success
    assert 0.88 < np.mean(inside) <= 0.995  # of 120: 0.954 is expected, and three times its deviation is 0.057


def test_noise_that_is_given_and_noise_that_is_estimated(measured):
    sigma = 0.02
    data = {"time": TS, ANGLE: measured[1] + sigma * np.random.default_rng(5).standard_normal(len(TS))}
    given, estimated = found(measured[0], data, noise=sigma), found(measured[0], data)
    assert given.values == pytest.approx(estimated.values, rel=1e-6)
    assert given.noise[0][ANGLE] == pytest.approx([sigma] * len(TS))
    assert estimated.noise[0][ANGLE][0] == pytest.approx(sigma, rel=0.3)
    ratio = estimated.noise[0][ANGLE][0] / sigma
    assert estimated.uncertainty.standard_errors == pytest.approx(ratio * given.uncertainty.standard_errors, rel=1e-6)
    # The test for white noise knows which part of the residuals the fit has removed.
    for estimate in (given, estimated):
        left, sigma = estimate.residuals[0][ANGLE], estimate.noise[0][ANGLE] / estimate.problem.sigma
        J = estimate.problem.evaluate(estimate.z[None], estimate.tol).J[0] / sigma[:, None]
        H = J @ np.linalg.pinv(J)
        bands = np.array([np.append(np.diagonal(H, k), np.zeros(k)) for k in range(6)])
        assert estimate.whiteness[0, ANGLE].statistic == pytest.approx(whiteness_of(TS, left, bands).statistic, rel=1e-9)
        assert abs(whiteness_of(TS, left).statistic / whiteness_of(TS, left, bands).statistic - 1.0) > 1e-3


@pytest.mark.parametrize(("loss", "noise"), [("huber", 0.003), ("soft_l1", None)])
def test_wrong_numbers_count_less(measured, loss, noise):
    angle = measured[1] + 0.003 * np.random.default_rng(6).standard_normal(len(TS))
    angle[5::9] += 0.5
    data = {"time": TS, ANGLE: angle}
    squares, robust = found(measured[0], data, noise=noise), found(measured[0], data, noise=noise, loss=loss)
    assert off(robust) < 0.2 * off(squares) and off(robust) < 0.03
    assert [one.row for one in robust.outliers] == list(range(5, len(TS), 9))
    assert robust.noise[0][ANGLE][0] == pytest.approx(0.003, rel=0.3) and "gives outliers little weight" in robust.message


def test_one_wrong_number_is_named_and_is_no_noise(measured):
    """One of two records begins before its first sample; least squares counts the outlier, and reports it."""
    sigma, rng = 0.003, np.random.default_rng(7)
    angles = {first: measured[1][first:] + sigma * rng.standard_normal(len(TS) - first) for first in (0, 3)}

    def records():
        return [udk.Record(TS[first:], {ANGLE: angle}, t0=0.0) for first, angle in angles.items()]

    without = found(measured[0], records())
    angles[3][20] -= 0.3
    estimate, robust = found(measured[0], records()), found(measured[0], records(), loss="huber")
    (one,) = estimate.outliers
    assert (one.record, one.channel, one.row, one.time, one.units) == (1, ANGLE, 20, TS[23], "rad")
    assert one.residual == pytest.approx(-0.3, abs=0.02) and one.deviations == pytest.approx(100.0, rel=0.3)
    assert estimate.noise[1][ANGLE][0] == pytest.approx(sigma, rel=0.2)
    assert f"row 20 ({TS[23]:.6g} s) by -0." in str(estimate) and "replace them by nan" in estimate.message
    assert not without.outliers and "row" not in without.message
    errors = without.uncertainty.standard_errors
    assert (np.abs(robust.values - without.values) < 0.5 * errors).all()
    assert robust.uncertainty.standard_errors == pytest.approx(errors, rel=0.1)
    assert (np.abs(estimate.values - without.values) < 3.0 * estimate.uncertainty.standard_errors).all()


def test_what_the_mechanism_lacks_is_told(measured):
    estimate = found(measured[0], {"time": TS, ANGLE: measured[1] + 0.02 * np.sin(2.0 * TS)}, n_starts=0)
    assert "not white noise" in estimate.message


def test_a_prior_counts_as_one_more_measurement(measured):
    mean, sigma = 0.385, 0.003
    data = {"time": TS, ANGLE: measured[1] + 0.05 * np.random.default_rng(8).standard_normal(len(TS))}
    parameters = [udk.Parameter(NAMES[0], prior=(mean, sigma)), NAMES[1]]
    with_prior, without = found(measured[0], data, parameters, noise=0.05), found(measured[0], data, noise=0.05)
    error = without.standard_errors[NAMES[0]]
    assert error > sigma
    expected = (without.values[0] / error**2 + mean / sigma**2) / (1 / error**2 + 1 / sigma**2)
    assert with_prior.values[0] == pytest.approx(expected, abs=0.02 * sigma)  # the problem is not quite linear
    assert with_prior.standard_errors[NAMES[0]] < sigma


# --- what cannot be known


@pytest.mark.slow
def test_a_common_factor_of_masses_is_not_known(measured):
    """The motion of a pendulum without a spring determines the ratio of mass and inertia, the force on its pin the mass."""
    mech = udk.library.compound_pendulum()
    ts = np.linspace(0.0, 3.0, 40)
    solution = udk.simulate(mech, ts, rtol=1e-12, atol=1e-12)
    data = {"time": ts, ANGLE: np.asarray(solution.q)[:, 0, 2]}
    names = ["body.rod.mass", "body.rod.inertia"]
    first = mech.with_parameters({names[0]: 1.4, names[1]: 0.2})
    estimate = found(first, data, names)
    assert not estimate.success and "common factor" in estimate.message and all(name in estimate.message for name in names)
    assert np.isinf(estimate.uncertainty.standard_errors).all()
    true = [float(mech.parameters()[name]) for name in names]
    assert estimate.values[1] / estimate.values[0] == pytest.approx(true[1] / true[0], rel=1e-8)
    known = found(first, data, [udk.Parameter(names[0], prior=(2.0, 0.1)), names[1]])
    assert known.success and known.values == pytest.approx(true, rel=1e-7)
    data["joint.pin.fy"] = np.asarray(udk.reactions(mech, solution)["pin"]["rod"])[:, 1]
    assert found(first, data, names).values == pytest.approx(true, rel=1e-9)


# --- the problem


@pytest.fixture(scope="module")
def two_records(measured):
    """A record from an estimated start, and a shorter one from the scene's start with another spring."""
    stiffer = measured[0].with_parameters({"force.spring.stiffness": 4.0})
    records = [
        udk.Record(TS[3:], {ANGLE: measured[1][3:]}, noise=0.01, t0=0.0, initial_state=udk.Start(estimate="both")),
        udk.Record(TS[:9], {ANGLE: swing(stiffer)[:9]}, noise=0.02, conditions={"force.spring.stiffness": 4.0}),
    ]
    return FitProblem(measured[0], unknowns_of(measured[0], NAMES), records)


def test_residuals_vanish_at_the_truth(two_records):
    assert two_records.all_names[2:] == ("record 1: body.rod.angle", "record 1: body.rod.omega")
    found = two_records.evaluate(np.zeros((1, 4)), (1e-12, 1e-12))
    assert found.ok.all() and found.r.shape == (1, len(TS) - 3 + 9) and np.abs(found.r).max() < 1e-8


def test_jacobian_against_differences(two_records):
    tol, h = (1e-12, 1e-12), 1e-5
    z = np.array([[0.1, -0.2, 0.05, 0.1]])
    J = two_records.evaluate(z, tol).J[0]
    for k in range(4):
        e = h * np.eye(4)[k]
        ahead, behind = (two_records.evaluate(z + s * e, tol).r[0] for s in (1.0, -1.0))
        assert J[:, k] == pytest.approx((ahead - behind) / (2 * h), abs=2e-6 * np.abs(J[:, k]).max())


def test_a_part_of_the_records(two_records):
    z, tol = np.full((1, 4), 0.1), (1e-10, 1e-10)
    whole, part = two_records.evaluate(z, tol), two_records.evaluate(z, tol, horizon=2.0)
    early = two_records.ts[tuple(two_records.index[:, :2].T)] <= 2.0
    assert 9 < early.sum() < len(early)  # all of the second record
    assert part.r[0, early] == pytest.approx(whole.r[0, early], abs=1e-6) and (part.r[0, ~early] == 0.0).all()
    parts = horizons(two_records)
    assert parts[-1] == TS[-1] and parts == sorted(parts) and 0.0 < parts[0] < TS[-1]


def test_guesses_beside_the_first():
    u = unknowns_of(pendulum(), [NAMES[0], udk.Parameter(NAMES[1], bounds=(0.1, 0.6)), "body.rod.angle"])
    x = u.values(sample_guesses(u, np.zeros(3), 64, 0))
    low, high = x.min(0), x.max(0)
    assert low[0] < 0.5 * u.guess[0] < 2.0 * u.guess[0] < high[0] < 2.6 * u.guess[0]
    assert (np.abs(x[:, 2] - u.guess[2]) <= 0.5 * np.abs(u.guess[2])).all()
    assert 0.1 < low[1] < 0.15 and 0.5 < high[1] < 0.6
    assert (x == u.values(sample_guesses(u, np.zeros(3), 64, 0))).all()


# --- few samples, and numbers without influence


@pytest.mark.parametrize("times", [[0.0], [5.0], [1.7e9], [0.0, 0.1]])
@pytest.mark.parametrize("since", [0.0, 0.5])
@pytest.mark.parametrize("strategy", ["auto", "pieces"])
def test_few_samples(times, since, strategy):
    record = udk.Record(times, {ANGLE: [0.7, 0.9][: len(times)]}, t0=times[0] - since)
    estimate = found(pendulum(), record, ["body.rod.inertia"], n_starts=1, strategy=strategy)
    data = estimate.to_xarray()
    assert data["measured"].shape == data["noise"].shape == (1, len(times), 1)
    assert "records in pieces" not in estimate.ways
    (noise,) = estimate.to_dict()["noise"]
    is_known = len(times) > 1 or not since  # the first sample of a motion does not depend on the parameter
    assert list(noise) == [ANGLE] and (noise[ANGLE] is not None) == is_known
    assert ("1 residual is too few to estimate the noise" not in estimate.message) == is_known
    assert ("estimated noise" in str(estimate)) == is_known


@pytest.fixture(scope="module")
def driven():
    """A slider-crank at constant speed, and the torque of its motor over time."""
    crank = udk.library.slider_crank()
    motor = udk.Driver(("ground", "crank"), "angle", udk.Polynomial([crank.q0[0, 2], 5.0]))
    mech = udk.Mechanism(crank.bodies, crank.joints, drivers={"motor": motor})
    ts = np.linspace(0.0, 1.0, 15)
    return mech, ts, np.asarray(udk.efforts(mech, udk.simulate(mech, ts))["motor"])


@pytest.mark.parametrize("factor", [1.0, 1.5])
@pytest.mark.parametrize("strategy", ["auto", "pieces"])
def test_what_changes_nothing_but_rounding_errors_is_undetermined(driven, factor, strategy):
    """The crank turns steadily whatever its inertia; as all motion is prescribed, pieces have no states of their own."""
    mech, ts, torque = driven
    data = {"time": ts, "driver.motor.load": factor * torque}
    estimate = found(mech, data, ["body.crank.inertia"], n_starts=4, strategy=strategy)
    assert not estimate.success and estimate.uncertainty.dead == ("body.crank.inertia",)
    assert estimate.converged and estimate.values[0] == mech.parameters()["body.crank.inertia"]
    assert estimate.message.startswith("no measured quantity depends on body.crank.inertia")


# --- bad input


def test_every_mistake_is_told(measured):
    with pytest.raises(udk.IdentificationError) as error:
        identify(measured[0], {"time": TS, "body.rot.angle": measured[1]}, ["body.rod.mas"], solvr=None)
    told = str(error.value)
    assert all(part in told for part in ("body.rod.mass", "rod", "solver")) and len(error.value.problems) == 3


@pytest.mark.parametrize(
    ("choices", "told"),
    [
        ({"loss": "cauchy"}, "huber"),
        ({"n_starts": -1}, "between 0 and 1,000,000"),
        ({"guesses": [[1.0]]}, r"\(B, 2\)"),
        ({"guesses": [[-1.0, 1.0]]}, "not positive"),
        ({"rtol": 1e-3}, "rtol"),
    ],
)
def test_settings_that_cannot_be(measured, choices, told):
    with pytest.raises(udk.IdentificationError, match=told):
        found(measured[0], {"time": TS, ANGLE: measured[1]}, **choices)


def test_parameters_that_would_open_a_loop():
    linkage = udk.library.parallelogram()
    with pytest.raises(udk.IdentificationError, match=r"length\(link1\) = length\(link2\) = length\(link3\)"):
        found(linkage, {"time": TS, "body.link1.angle": TS}, ["length(link1)", "length(link2)", "length(link3)"])


@pytest.mark.slow
def test_a_mechanism_that_cannot_be_closed_at_all():
    apart = udk.with_length(udk.library.four_bar(), "coupler", 20.0)
    with pytest.raises(udk.AssemblyError, match="open"):
        found(apart, {"time": TS, "body.crank.angle": TS}, ["body.crank.mass"])


# --- what takes long to compile


@pytest.mark.slow
def test_members_in_lanes_are_those_one_by_one(two_records, monkeypatch):
    z = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 4))
    single = two_records.evaluate(z, (1e-10, 1e-10))
    monkeypatch.setattr(prediction, "FEWEST_IN_LANES", 1)
    lanes = two_records.evaluate(z, (1e-10, 1e-10))
    assert np.abs(lanes.r - single.r).max() < 1e-6 and np.abs(lanes.J - single.J).max() < 1e-4


@pytest.mark.slow
def test_through_a_singular_configuration():
    mech = udk.library.parallelogram(angle=np.pi / 3)
    ts = np.linspace(0.0, 5.0, 101)
    solution = udk.simulate(mech, ts, rtol=1e-12, atol=1e-12)
    data = {"time": ts, "body.link1.angle": np.asarray(solution.q)[:, 0, 2]}
    names = ["length(link1, link2, link3)", "body.link1.mass = body.link2.mass = body.link3.mass"]
    first = udk.with_length(mech, ["link1", "link2", "link3"], 1.3)
    alone = found(first, data, names)
    assert not alone.success and len(alone.uncertainty.flat) == 1  # angles tell one number, the period
    data["body.coupler.x"] = np.asarray(solution.q)[:, 3, 0]
    estimate = found(first, data, names)
    assert estimate.values == pytest.approx([1.0, 1.0], rel=1e-8)


@pytest.mark.slow
def test_a_first_guess_that_cannot_be_closed():
    mech = udk.library.four_bar()
    ts = np.linspace(0.0, 3.0, 60)
    q = np.asarray(udk.simulate(mech, ts, rtol=1e-12, atol=1e-12).q)
    data = {"time": ts, "body.crank.angle": q[:, 0, 2], "body.rocker.angle": q[:, 2, 2]}
    first = udk.with_length(mech, "coupler", 0.9)
    estimate = found(first, data, ["length(coupler)", "body.rocker.mass"])
    assert estimate.values == pytest.approx([2.5, 2.0], rel=1e-8)


@pytest.mark.slow
def test_a_start_for_all_records(measured):
    data = {"time": TS, ANGLE: measured[1]}
    turned = pendulum(0.5, 0.1, angle=1.1)
    estimate = found(turned, data, initial_state="position")
    assert off(estimate) < 1e-9 and [name.endswith("body.rod.angle") for name in estimate.initial_state_values] == [True]
    assert float(estimate.initial_states[0].q[0, 2]) == pytest.approx(measured[1][0], abs=1e-10)


# --- progress


def test_progress_is_that_of_every_other_function(measured, capsys):
    data, seen = {"time": TS, ANGLE: measured[1]}, []
    identify(pendulum(0.5, 0.15), data, NAMES, progress=seen.append)
    assert {(state.what, state.total) for state in seen} == {("identify", None)} and len(seen) > 3
    assert [state.done for state in seen] == list(range(1, len(seen) + 1)) and "cost" in seen[-1].message
    identify(pendulum(0.5, 0.15), data, NAMES, progress=True)
    assert "identify: 00:0" in capsys.readouterr().err
    identify(pendulum(0.5, 0.15), data, NAMES, progress=False)
    assert capsys.readouterr() == ("", "")


# --- initial states


@pytest.mark.parametrize("metre", fast([1e3], [1e-6, 1e3]))
def test_initial_states_are_found_whatever_the_size(metre):
    """A slider on a spring that begins a hundredth of its way farther out, and moving: the fit is the same at every size."""
    k, m, x0, v0 = 30.0, 2.0, 0.31 * metre, 0.5 * metre
    slider = udk.Body(mass=m, inertia=0.1 * metre**2, position=(1.3 * metre, 0.0))
    rail = udk.Prismatic(("ground", "slider"), points=np.zeros((2, 2)), axis=0.0)
    spring = udk.Spring(("ground", "slider"), points=np.zeros((2, 2)), stiffness=0.8 * k, length=metre)
    first = udk.Mechanism({"slider": slider}, {"rail": rail}, forces={"spring": spring}, gravity=(0.0, 0.0))
    ts, w = np.linspace(0.0, 2.0, 30), np.sqrt(k / m)
    data = {"time": ts, "body.slider.x": metre + x0 * np.cos(w * ts) + v0 / w * np.sin(w * ts)}
    estimate = found(first, data, ["force.spring.stiffness"], initial_state="both", noise=1e-3 * metre)
    changes = [change / metre for change, _ in estimate.initial_state_values.values()]
    assert estimate.success and len(estimate.history) < 12
    assert [estimate.values[0], *changes] == pytest.approx([k, 0.01, 0.5], rel=1e-6)


def test_the_states_of_large_scenes_have_coordinates_too():
    chain = udk.library.chain(21)  # more elements than the analysis takes by dense matrices
    unknowns = state_unknowns(chain, 0.0, None, "both", "start")
    assert unknowns.names[::21] == ("start: body.link0.angle", "start: body.link0.omega") and len(unknowns.names) == 42
    J = np.asarray(udk.equations.psi_q(chain, 0.0, chain.q0))
    assert np.abs(J @ unknowns.basis[0, :, :21]).max() < 1e-12 * np.abs(J).max() * np.abs(unknowns.basis).max()
    assert np.linalg.matrix_rank(unknowns.basis[0, :, :21]) == 21
