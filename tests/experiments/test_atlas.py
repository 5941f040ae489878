"""What the atlas counts as silently wrong and as the price of an error, and the independent equations behind its references."""

import tomllib

import numpy as np
import pandas
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from experiments import atlas
from experiments.common import PACKAGE_DATA, load
from experiments.parts.atlas_problems import PROBLEMS
from experiments.parts.atlas_reference import reference
from experiments.parts.atlas_runs import compare, parts, run
from experiments.parts.atlas_tables import DEFAULT, needed, price, silent, table, words
from experiments.parts.reference_equations import evaluate, evaluate_all


def runs(**columns):
    """Return a table of runs, by default of the default method, of one start, at a tolerance of 1e-6."""
    usual = DEFAULT | {"problem": "p", "part": "methods", "start": 0.0, "tol": 1e-6, "result": 0.0, "seconds": 1.0}
    size = max(len(x) for x in columns.values())
    return pandas.DataFrame({name: [value] * size for name, value in usual.items()} | columns)


def test_a_run_is_silently_wrong_if_nothing_explains_its_error():
    methods = ["Auto", "Varga", "SVD", "Greville", "Householder"]
    table = runs(
        method=methods,
        error=[
            1e-5,
            0.02,
            0.005,
            0.02,
            np.nan,
        ],  # wrong by itself: the second
        result=[0.0, 0.0, 0.0, 14.0, 1.0],
    )
    assert silent(table).tolist() == [False, True, False, False, False]
    assert not silent(table.assign(tol=1e-4)).any()  # little was asked for
    assert not silent(table.assign(error=[0.001, 0.02, 0.005, 0.02, np.nan])).any()  # the default is not much better


def test_the_price_of_an_error_is_the_least_of_the_tolerances_that_reach_it():
    table = runs(tol=[1e-4, 1e-6, 1e-8], error=[1e-3, 1e-5, 1e-7], right_hand_sides=[100.0, 200.0, 300.0])
    assert price(table, 2e-5) == (200.0, 1e-6) and price(table, 1e-7) == (300.0, 1e-8)
    assert np.isinf(price(table, 1e-9)[0])
    assert needed(table, 2e-5) == {"p": 1e-6} and needed(table.assign(error=1e-9), 1e-7) == {"p": 1e-4}
    failed = table.assign(error=[1e-3, np.nan, 1e-7])
    assert price(failed, 2e-5) == (300.0, 1e-8)


def test_words_name_what_differs_from_the_default():
    assert words(tuple(DEFAULT.values())) == "the defaults"
    assert words(("Varga", "none", "default", "Udwadia-Kalaba")) == "Varga, none"


def test_equations_of_several_states_are_those_of_each():
    mechanism = udk.library.slider_crank(driven=False, spring=(10.0, 0.5, 1.0))
    plain = udk.Mechanism(mechanism.bodies, mechanism.joints, mechanism.drivers, mechanism.forces, mechanism.gravity)
    table = {"driver": [], "force": [], **tomllib.loads(udk.dumps(plain))}
    random = np.random.default_rng(0)
    q, v = np.asarray(mechanism.q0) + 0.1 * random.standard_normal((2, 4, *mechanism.q0.shape))
    for k, together in enumerate(evaluate_all(table, 0.3, q, v)):
        for one, other in zip(together, evaluate(table, 0.3, q[k], v[k]), strict=True):
            assert_allclose(one, other, rtol=1e-14, atol=1e-14)


@pytest.mark.slow
def test_the_package_reads_the_table_of_the_committed_data():
    assert (PACKAGE_DATA / "atlas.json").read_text(encoding="utf-8") == table(load("atlas"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Bennett", "Bricard"])
def test_chains_in_space_move_as_their_quadratic_rows_say(name):
    problem = PROBLEMS[name]._replace(end=1.0)
    assert problem.redundant and reference(problem, 2).apart.max() < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("name", atlas.SPATIAL)
def test_small_rank_thresholds_cost_steps_in_space(name):
    """Violations within a step count as rank: rows depend on others in closed positions only."""
    problem = PROBLEMS[name]

    def steps(threshold):
        ts = [0.0, problem.end]
        run = udk.simulate(problem.mechanism, ts, problem.states(1)[0], 1e-6, 1e-6, udk.SVD(threshold))
        return int(run.stats["steps"])

    assert steps(1e-8) > 4 * steps(1e-4) and steps(1e-4) < 1.3 * steps(1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_starts_are_closed(name):
    problem = PROBLEMS[name]
    mechanism, length = problem.mechanism, problem.lengths[0]
    for state in problem.states(2):
        at_once = udk.simulate(mechanism, [0.0, 1e-9], state, drift_tol=np.inf)
        assert np.abs(np.asarray(udk.violation(mechanism, at_once))[0]).max() < 1e-12 * max(1.0, length)


@pytest.mark.slow
def test_a_cell_is_compared_with_its_own_start():
    problem = PROBLEMS["hanging"]._replace(end=1.0)
    expected = reference(problem, 3)
    assert expected.apart.max() < 1e-12 and expected.q.shape == (3, 21, 4, 3)
    part = parts(problem)["integrators"]
    part = part._replace(cells=part.cells[3:4], tolerances=(1e-4, 1e-8))
    ((cells, data),) = run(problem, expected, part, None)
    assert cells == part.cells and (data.slower >= data.seconds).all()
    wrong = data.wrong.values.reshape(2, 3)
    assert (wrong[0] < 1e-2).all() and (wrong[1] < 1e-6).all()
    shifted = expected._replace(q=expected.q[[1, 2, 0]])
    assert callable(compare(problem, expected))
    ((_, data),) = run(problem, shifted, part._replace(tolerances=(1e-8,)), None)
    assert data.wrong.values.min() > 1e-2
