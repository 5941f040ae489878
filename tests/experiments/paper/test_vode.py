from functools import partial

import numpy as np
import pytest

import udkjax as udk
from experiments.paper import vode
from udkjax.integrate import Result
from udkjax.study.accuracy import exact_coordinates


@pytest.fixture(scope="module")
def linkage():
    mech = udk.library.parallelogram()
    return mech, udk.State(mech.q0, mech.v0)


@pytest.fixture(scope="module")
def program(linkage):
    return partial(vode.run, linkage[0], lambda rank_tol, number: udk.OneOf.absolute(rank_tol, number=number), 1e-2, 1200)


def test_it_is_right_and_counts(linkage, program):
    mech, state = linkage
    ts = np.linspace(0.0, 1.0, 11)
    run = program(ts, state, 1e-9, 1e-4, 2, 0.0, 0.0)
    exact = exact_coordinates(mech, ts, state.q, state.v)
    assert np.abs(run.q - exact).max() < 1e-7
    assert (run.time, run.code) == (1.0, Result.successful)
    assert 20 < run.stats["accepted"] < run.stats["right_hand_sides"] < 400


def test_gains_reach_it_and_a_run_that_takes_too_many_steps_is_given_up(linkage, program):
    _, state = linkage
    ts = np.linspace(0.0, 1.0, 11)
    run = program(ts, state, 1e-9, 1e-4, 2, 1000.0, 100.0)
    assert run.code == Result.step_limit  # 60 steps from one instant to the next are too few for what is stiff
    alive = np.isfinite(run.q).all((1, 2))
    assert alive[0] and not alive[-1] and run.time < 1.0
    assert run.time >= ts[alive][-1]
