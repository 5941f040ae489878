from collections import Counter

import numpy as np
import pytest

import udkjax as udk
from experiments.paper import study as paper
from experiments.paper.cases import FIRST_STEP, FULL, GAINS, METHODS, QUICK, RANK_HELD, SMOKE, TOLERANCES, Case, plan
from tests.choices import fast
from udkjax.integrate.solvers import solver_named


def test_the_papers_runs_are_all_planned_as_the_paper_says():
    cases = [case for case in plan(FULL) if case.group == "paper"]
    assert {(c.method, c.tol, c.alpha, c.beta) for c in cases} == {
        (method, tol, *gains) for method in METHODS for tol in TOLERANCES for gains in ((0.0, 0.0), GAINS)
    }
    assert len(cases) == 30
    for case in cases:
        assert case.rank_tol == case.tol and case.solver == "Adams" and case.end == 20.0 and not case.projected
    assert (GAINS, FIRST_STEP) == ((1000.0, 100.0), 0.0066)


def test_the_quick_plan_has_the_papers_runs_too_but_cuts_the_stiff_ones():
    full, quick = ({(c.method, c.tol, c.alpha): c for c in plan(scope) if c.group == "paper"} for scope in (FULL, QUICK))
    assert full.keys() == quick.keys()
    for key, case in quick.items():
        assert (case.end < full[key].end) == case.stiff
    integrations = [{case.program for case in plan(scope) if case.solver != "VODE"} for scope in (QUICK, FULL)]
    assert len(integrations[0]) < 10 < len(integrations[1])  # to compile


def test_what_would_have_been_better_is_planned_at_every_tolerance():
    for scope in (FULL, QUICK):
        groups = Counter((case.group, case.tol) for case in plan(scope))
        for tol in TOLERANCES:
            assert groups["rank held", tol] == 9 + len(scope.others)  # five methods here and by VODE, one by each other
            assert groups["other integrators", tol] == 5 + len(scope.others)  # five by VODE, one of them with gains too
            assert groups["fixed rows", tol] == groups["default", tol] == 1
            assert groups["small gains", tol] == 3 * len(scope.gains_for)


def test_thresholds_and_starts_are_those_of_the_case():
    mech = udk.library.parallelogram()
    state = udk.State(mech.q0, mech.v0)
    tied, held, nudged = (
        paper._inputs(case, state, 4.0, seed=1)
        for case in (
            Case("paper", "SVD", "Adams", 1e-8, 1e-8, 1000.0, 100.0, end=2.0),
            Case("rank held", "SVD", "Adams", 1e-8),
            Case("start", "SVD", "Adams", 1e-8, start=2),
        )
    )
    assert [float(x) for x in tied[2:]] == [1e-8, 1e-8, 0.0, 1000.0, 100.0]
    assert (float(tied[0][0]), float(tied[0][-1])) == (0.0, 2.0)
    assert float(held[3]) == 4.0 * RANK_HELD
    assert 0 < np.abs(nudged[1].q - state.q).max() < 1e-15
    again = paper._inputs(Case("start", "SVD", "Adams", 1e-8, start=2), state, 4.0, seed=1)
    np.testing.assert_array_equal(nudged[1].q, again[1].q)


@pytest.mark.parametrize("name", fast(["SVD", "GramSchmidt"], METHODS))
def test_the_papers_methods_have_their_threshold_in_the_units_of_the_matrix(name):
    method = paper.pseudoinverse(name, 0.5, paper.number_of(name))
    assert isinstance(method, udk.OneOf)
    assert type(method.methods[int(method.number)]).__name__ == name and not method.relative
    matrix = np.diag([30.0, 3.0, 0.4])
    assert int(method.rank(matrix)) == 2  # 0.4 is beyond 1 % of 30, but not beyond 0.5


def test_solvers_are_found_by_name():
    for name in ("Adams", "BDF", "Verner65", "Dopri8", "Tsit5"):
        assert type(solver_named(name)).__name__ == name
    for name in ("Dopri9", "ODETerm", "diffeqsolve"):
        with pytest.raises(ValueError, match=f"'{name}' is not a solver"):
            solver_named(name)


@pytest.mark.slow
def test_a_small_study_is_run_and_judged():
    """Two runs, of 20 s without and of 0.1 s with the paper's gains, by the integrator that compiles fastest."""
    told = []
    data = paper.study(SMOKE, solver="Dopri8", tell=lambda what, part: told.append(part))
    free, stiff = (data.isel(run=k) for k in (0, 1))
    assert (free.verdict.item(), float(free.alpha), float(stiff.alpha)) == (free.verdict.item(), 0.0, 1000.0)
    assert free.kind == "correct up to" and 11.0 < float(free.correct_to) < 16.0  # lost when sigma_12 reaches 1e-6
    risen = int(np.argmax(free["rank"].values == 12))
    assert float(free.time[risen]) == pytest.approx(float(free.correct_to), abs=0.8)
    # Greville's |c| is the length of what is left of the last row: sigma_12 at least, and not ten times as much
    assert 1e-7 < float(free.sigma_12[risen]) < 1.1e-6
    assert float(free.growth) == pytest.approx(float(data.law_rate[0]), rel=0.03)
    assert stiff.kind == "correct" and float(stiff.error_max) < 1e-9
    assert float(stiff.time[-1]) == pytest.approx(0.1)
    assert (data.right_hand_sides > data.accepted).all() and (data.cpu > 0).all()
    assert data.attrs["setting_rank_held"] == RANK_HELD and "[[body]]" in data.attrs["scene"]
    assert told == sorted(told) and told[-1] == 1.0
