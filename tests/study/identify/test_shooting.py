"""Records in pieces: exact derivatives, the fit of whole records if there is one, and otherwise a fit of chaotic motion."""

from itertools import pairwise

import numpy as np
import pytest

import udkjax as udk
from tests.study.identify.conftest import ANGLE, NAMES, TS, pendulum
from udkjax.study.identify.identification import identify
from udkjax.study.identify.problem.fit_problem import FitProblem
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.records.records import Record
from udkjax.study.identify.search.growing_records import fit_growing_records
from udkjax.study.identify.search.optimizer import Minimizer
from udkjax.study.identify.search.search import explains, search
from udkjax.study.identify.search.shooting import MultipleShooting, cut_records, fit_pieces

TOL = 1e-10, 1e-10
NOISE = 1e-3


@pytest.fixture(scope="module")
def problem(measured):
    noisy = measured[1] + NOISE * np.random.default_rng(1).standard_normal(len(TS))
    first = pendulum(0.5, 0.1)
    return FitProblem(first, unknowns_of(first, NAMES), [Record(TS, {ANGLE: noisy}, noise=NOISE)])


@pytest.fixture(scope="module")
def pieces(problem):
    return MultipleShooting(problem, np.zeros(problem.K), TOL, samples=6)


def test_each_number_is_in_one_piece(problem, pieces):
    parts = cut_records(problem, 12)
    assert parts == pieces.pieces and len(parts) == 5
    assert parts[0].first == 0 and parts[-1].end == len(TS) - 1
    assert all(one.end == two.first for one, two in pairwise(parts))
    assert np.array_equal(pieces.runs.ts[pieces.run, pieces.time], TS)
    assert np.array_equal(pieces.runs.ts[1:, 0], pieces.runs.ts[:-1, -1]) and (np.diff(pieces.runs.ts) > 0).all()
    assert pieces.K == 2 + 4 * 2 == len(pieces.all_names) == len(pieces.all_units)


@pytest.mark.parametrize("time", [0.0, 5.0, 1.7e9])
def test_a_record_of_one_sample_is_one_piece(measured, time):
    records = [Record(TS, {ANGLE: measured[1]}), Record([time], {ANGLE: [1.0]})]
    first = pendulum(0.5, 0.1)
    together = FitProblem(first, unknowns_of(first, NAMES), records)
    assert (np.diff(together.ts) > 100.0 * np.spacing(together.ts[:, :-1])).all()
    assert cut_records(together, 12)[-1] == (1, 0, 1)
    pieces = MultipleShooting(together, np.zeros(together.K), TOL, samples=6)
    assert (np.diff(pieces.runs.ts) > 0).all() and pieces.runs.ts[pieces.run[-1], pieces.time[-1]] == time


def test_derivatives(pieces):
    z = pieces.guess + 0.1 * np.random.default_rng(0).standard_normal(pieces.K)
    h = 1e-5
    moved = np.concatenate([z + h * np.eye(pieces.K), z - h * np.eye(pieces.K)])
    r = pieces.evaluate(moved, TOL).r
    by_differences = (r[: pieces.K] - r[pieces.K :]).T / (2.0 * h)
    J = pieces.evaluate(z[None], TOL).J[0]
    assert np.abs(J - by_differences).max() < 1e-5 * np.abs(J).max()
    assert J.shape == (len(TS) + pieces.extra_rows, pieces.K)


def test_a_first_guess_follows_what_was_measured(pieces):
    """With an inertia a third too large, each piece begins near the measured motion."""
    found = pieces.evaluate(pieces.guess[None], TOL)
    assert np.sqrt(np.mean(found.r[0, : len(TS)] ** 2)) < 30.0  # 0.03 rad of 1.2
    assert 1e-3 < pieces.gaps(pieces.guess[None], TOL)[0] < 1.0


def test_the_fit_is_that_of_the_whole_record(problem):
    pieces, fit = fit_pieces(problem, np.zeros(problem.K), TOL, Minimizer(), samples=6)
    assert fit.converged and explains(pieces, fit, TOL)
    assert pieces.gaps(fit.z[None], TOL)[0] < 1e-7
    whole = Minimizer().minimize(problem, fit.z[:2], TOL)
    assert np.abs(fit.z[:2] - whole.z).max() < 1e-5
    assert np.all(np.abs(problem.unknowns.values(fit.z[:2]) / [0.375, 0.2] - 1.0) < 0.02)
    # Errors of the integration, 1e-9, count in defects, which weigh 1e7.
    assert fit.cost == pytest.approx(whole.cost, rel=1e-3)


@pytest.mark.slow
def test_whole_records_end_the_fit_where_they_can(problem):
    found = search(problem, np.zeros((1, problem.K)), TOL, Minimizer(), strategy="pieces")
    assert found.ways == ("records in pieces",) and found.problem is problem and found.fit.converged
    assert found.fit.z.shape == (2,)


def test_an_unknown_strategy_is_refused(problem):
    with pytest.raises(ValueError, match='strategy must be one of "auto", "pieces", not "shoot"'):
        identify(pendulum(), problem.records[0], NAMES, strategy="shoot")  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_chaos():
    """A double pendulum for 25 s, in which errors grow by 1e12: no whole run follows the measurements, however exact."""
    noise, ts = 0.01, np.linspace(0.0, 25.0, 501)
    truth = udk.library.double_pendulum(angles=(np.pi / 2, 0.0))
    names = ("body.lower.mass", "length(upper)", "joint.elbow.points[1][0]")
    values = np.array([1.0, 1.0, -0.5])
    q = np.asarray(udk.simulate(truth, ts, rtol=1e-12, atol=1e-12).q)[:, :, 2]
    q = q + noise * np.random.default_rng(0).standard_normal(q.shape)
    record = Record(ts, {"body.upper.angle": q[:, 0], "body.lower.angle": q[:, 1]}, noise=noise)
    for factors in ((1.4, 0.6, 1.5), (0.55, 1.45, 0.6)):
        first = truth.with_parameters({names[0]: factors[0], names[2]: values[2] * factors[2]})
        first = udk.with_length(first, "upper", factors[1])
        whole = FitProblem(first, unknowns_of(first, names), [record])
        along = fit_growing_records(whole, np.zeros(3), TOL, Minimizer())
        assert along.cost > 1e3 * q.size  # half of it would be noise
        estimate = identify(first, record, names, progress=False)
        assert estimate.ways[-1] == "records in pieces" and isinstance(estimate.problem, MultipleShooting)
        assert estimate.success
        errors = estimate.uncertainty.standard_errors
        assert np.all(errors < 1e-3 * np.abs(values)) and np.all(np.abs(estimate.values - values) < 4.0 * errors)
        assert estimate.uncertainty.chi2 / estimate.uncertainty.degrees_of_freedom == pytest.approx(1.0, abs=0.15)
