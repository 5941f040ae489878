"""Runs without projection end if their drift is too large for a singular configuration that they meet."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from tests.choices import fast
from tests.ten_times import multiplied
from udkjax import Result

TS = np.linspace(0.0, 5.0, 26)
TIGHT = {"rtol": 1e-8, "atol": 1e-8, "throw": False}
TOLERANCES = jnp.array([1e-6, 1e-7])
SWING = np.deg2rad(45.0)  # the parallelogram is flat at zero, four times in these five seconds


def swing(angle=SWING):
    return udk.library.parallelogram(angle)


def kite(angle=0.8, scale=1.0):
    return udk.library.four_bar(angle, 4.0, (scale, 2 * scale, 2 * scale), scale, gravity=9.81 * scale)


def equal_crank(angle=0.8, speed=6.0):
    return udk.library.slider_crank(angle, speed, driven=False, crank=0.8, rod=0.8)


def reference(mech):
    return udk.simulate(mech, TS, rtol=1e-11, atol=1e-11).q


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("stabilization", "method"),
    [
        (None, udk.SVD(1e-4)),
        (None, udk.Auto()),
        (udk.Baumgarte(2.0, 2.0), udk.SVD(1e-4)),  # its energy falls from 24 J to less than zero, with Psi below 3e-4
        (udk.Baumgarte(2.0, 2.0), udk.Auto()),
    ],
)
def test_a_drifting_run_ends_at_a_singular_configuration(stabilization, method, engine):
    solution = udk.simulate(swing(), TS, method=method, stabilization=stabilization, engine=engine, **TIGHT)
    assert solution.result == Result.singular and not solution.result.is_success
    kept = float(solution.time) > TS
    assert not np.isfinite(solution.q[~kept]).any()
    energy = np.asarray(udk.energy(swing(), solution).total)[kept]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-3)
    assert "near a singular configuration of" in solution.cause and "Projection()" in solution.cause
    gains = "larger gains" in solution.cause
    assert gains == (stabilization is not None)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "method", [udk.SVD(1e-10), *(pytest.param(m(1e-10), marks=pytest.mark.slow) for m in (udk.Varga, udk.GramSchmidt))]
)
def test_redundant_rows_that_count_as_independent_end_a_run(method, engine):
    """They are violated by more than the threshold of the rank, and take the energy, with Psi below 1e-7."""
    run = {"stabilization": None, "engine": engine, "rtol": 1e-6, "atol": 1e-6, "throw": False}
    codes = jax.vmap(lambda tol: udk.simulate(swing(-0.6), 2 * TS, method=method, **run | {"rtol": tol}).code)(TOLERANCES)
    assert codes.tolist() == [Result.spurious_rank] * 2
    alone = udk.simulate(swing(-0.6), 2 * TS, method=method, **run)
    assert alone.result == Result.spurious_rank and "rank_tol" in alone.cause
    if engine == "native":
        assert udk.simulate(swing(-0.6), 2 * TS, method=udk.SVD(1e-4), **run).result == Result.successful
        assert udk.simulate(swing(-0.6), 2 * TS, method=method, drift_tol=np.inf, **run).result == Result.successful


@pytest.mark.parametrize("engine", ["native", *(pytest.param(x, marks=pytest.mark.slow) for x in ("diffrax", "jax"))])
def test_a_traced_mechanism_ends_as_a_concrete_one(engine):
    """Which of its rows are redundant is known only when the run begins."""

    def end(start):
        run = {"stabilization": None, "engine": engine, "rtol": 1e-6, "atol": 1e-6, "throw": False}
        solution = udk.simulate(swing(start), 2 * TS, method=udk.SVD(1e-10), **run)
        return solution.code, solution.time

    code, time = end(-0.6)
    assert code == Result.spurious_rank
    np.testing.assert_allclose(jax.jit(end)(-0.6), (code, time), rtol=1e-6)
    codes, times = jax.vmap(end)(jnp.array([-0.6, -0.6]))
    np.testing.assert_allclose((codes[1], times[1]), (code, time), rtol=1e-6)


PROJECTED = {"rtol": 1e-10, "atol": 1e-10, "throw": False}
METHODS = pytest.mark.parametrize("method", [udk.SVD, pytest.param(udk.Varga, marks=pytest.mark.slow)])


@METHODS
def test_a_misfit_that_counts_as_rank_ends_a_projected_run(method):
    """A pivot 1e-9 m beside its place: no pose closes the redundant row, which counts where the threshold is below its misfit.

    Rounding, which differs between processors, is a ten-millionth of the misfit and decides nothing.
    """
    mech, ts = swing(np.deg2rad(40.0)), np.linspace(0.0, 0.8, 5)  # flat at 0.39 s
    points = np.asarray(mech.parameters()["joint.B3.points"])
    misfit = mech.with_parameters({"joint.B3.points": points + [[1e-9, 0.0], [0.0, 0.0]]})

    def run(mech, rank_tol, rtol):
        return udk.simulate(mech, ts, method=method(rank_tol), **PROJECTED | {"rtol": rtol})

    alone = run(misfit, 1e-7, 1e-10)
    assert alone.result == Result.spurious_rank and "rank_tol" in alone.cause and 0.3 < alone.time < 0.5
    codes = jax.vmap(lambda rtol: run(misfit, 1e-7, rtol).code)(jnp.array([1e-10, 1e-9, 1e-8]))
    assert codes.tolist() == [Result.spurious_rank] * 3
    small = points + np.array([[1e-10, 0.0], [0.0, 0.0]])  # a redundant row that is closed, when the run begins
    traced = jax.jit(lambda points: run(mech.with_parameters({"joint.B3.points": points}), 1e-8, 1e-10).code)
    of_angle = jax.jit(lambda angle: run(swing(angle).with_parameters({"joint.B3.points": small}), 1e-8, 1e-10).code)
    assert traced(small) == of_angle(np.deg2rad(40.0)) == Result.spurious_rank
    passed, right = run(misfit, 1e-4, 1e-10), run(mech, 1e-4, 1e-10)
    assert passed.result == right.result == Result.successful
    np.testing.assert_allclose(passed.q, right.q, atol=1e-9 / 1e-4)  # a misfit divided by the distance at which its row counts


@METHODS
def test_a_run_whose_rounding_counts_as_rank_is_right_or_says_so(method):
    """Near a singular configuration the last digits of redundant rows may count as rank, in some runs or none, by processor."""
    mech = swing(np.deg2rad(40.0))
    right = udk.simulate(mech, 2 * TS, method=method(1e-6), **PROJECTED)
    total = udk.energy(mech, right).total
    assert right.result == Result.successful
    np.testing.assert_allclose(total, total[0], rtol=1e-8)
    for rank_tol in np.geomspace(1e-10, 1e-14, 9):
        found = udk.simulate(mech, 2 * TS, method=method(rank_tol), **PROJECTED)
        assert found.result in (Result.successful, Result.spurious_rank), rank_tol
        kept = np.isfinite(found.q).all((1, 2))
        assert kept.all() or found.result == Result.spurious_rank, rank_tol
        np.testing.assert_allclose(found.q[kept], right.q[kept], atol=1e-6, err_msg=str(rank_tol))


def squares():
    return udk.library.n_four_bar(2, angular_velocity=-1.5)


@pytest.mark.parametrize(
    ("make", "method"),
    [
        (squares, udk.Greville(0.1)),
        *(pytest.param(squares, method(0.1), marks=pytest.mark.slow) for method in (udk.SVD, udk.Householder, udk.Elimination)),
        pytest.param(lambda: swing(np.deg2rad(40.0)), udk.Elimination(0.01), marks=pytest.mark.slow),
    ],
)
def test_independent_rows_that_count_as_dependent_end_a_projected_run(make, method):
    """Near singular configurations the motion has more freedom than the mechanism, until the rows count again."""
    run = {"rtol": 1e-7, "atol": 1e-7, "throw": False}
    found = udk.simulate(make(), 2 * TS, method=method, **run)
    assert found.result == Result.missing_rank and "rank_tol" in found.cause
    assert np.isfinite(found.q[:2]).all() and not np.isfinite(found.q[-1]).any()
    small = type(method)(1e-5)
    assert udk.simulate(make(), TS, method=small, **run).result == Result.successful
    together = jax.vmap(lambda tol: udk.simulate(make(), 2 * TS, method=method, **run | {"rtol": tol}).code)(TOLERANCES)
    assert together.tolist() == [Result.missing_rank] * 2


def test_projected_velocities_may_open_psi_by_the_tolerance():
    """A step of 0.1 s opens Psi by a tenth of its rate; the first state is not projected."""
    from udkjax.integrate import diffrax_engine

    problem: Any = SimpleNamespace(drift_tol=1e-6, rtol=1e-4, atol=1e-4)
    equations: Any = SimpleNamespace(violation=lambda t, q, v: (q, v), violation_size=jnp.max)
    states = jnp.array([[0.0, 1.0], [0.0, 1.9e-3], [0.0, 2.1e-3]])
    missed = diffrax_engine._misses_rows(problem, equations, jnp.arange(3.0), states, jnp.array(0.1))
    assert missed.tolist() == [False, False, True]


@pytest.mark.slow
def test_the_other_engine_looks_for_missing_rows_at_outputs():
    """Positions that are too far open end a run as drift, there and in machine code."""
    ts, mech = np.linspace(0.0, 2.0, 201), squares()
    results = [
        udk.simulate(mech, ts, method=udk.Greville(tol), engine="jax", rtol=1e-7, atol=1e-7, throw=False).result
        for tol in (0.1, 1e-5)
    ]
    assert results[0] in (Result.missing_rank, Result.drift) and results[1] == Result.successful


@pytest.mark.slow
@pytest.mark.parametrize("method", [udk.SVD, udk.Varga, udk.Householder, udk.GramSchmidt, udk.Greville, udk.Elimination])
def test_default_thresholds_leave_out_no_row_that_counts(method):
    """Across singular configurations, at any tolerance; also thresholds of a thousandth, which leave out rows for a moment."""
    for mech in (swing(np.deg2rad(40.0)), squares(), kite(), equal_crank()):
        for rank_tol, least in ((None, 12), (1e-3, 8)):

            def code(tol, mech=mech, rank_tol=rank_tol):
                return udk.simulate(mech, 2 * TS, method=method(rank_tol), rtol=tol, atol=tol, throw=False).code

            codes = jax.vmap(code)(10.0 ** -jnp.arange(3.0, least + 1))
            assert not np.isin(codes, [Result.missing_rank, Result.spurious_rank]).any(), (mech.name, rank_tol, codes)


@pytest.mark.parametrize("engine", ["native", pytest.param("jax", marks=pytest.mark.slow)])
@pytest.mark.parametrize("gain", [30.0, pytest.param(100.0, marks=pytest.mark.slow)])
def test_a_run_that_is_stabilized_well_passes(gain, engine):
    solution = udk.simulate(swing(), TS, stabilization=udk.Baumgarte(gain, gain), engine=engine, **TIGHT)
    assert solution.result == Result.successful and np.abs(solution.q - reference(swing())).max() < 1e-6


@pytest.mark.parametrize("scale", fast([1e3], [1e-6, 1e3]))
def test_the_length_of_a_mechanism_does_not_matter(scale):
    mech, ended = kite(scale=scale), 0
    for method in (udk.SVD(1e-4), udk.Auto()):
        for stabilization in (None, udk.Baumgarte(2.0, 2.0), udk.Baumgarte(30.0, 30.0)):
            s = udk.simulate(mech, TS, method=method, stabilization=stabilization, **TIGHT)
            ended += s.result == Result.singular
            assert not s.result.is_success or np.abs(s.q[:, :, 2] - reference(mech)[:, :, 2]).max() < 1e-3
    assert 2 <= ended < 6


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_ten_times_more_or_less_changes_no_verdict(factor, monkeypatch):
    """A factor of ten in the nearest distance or in the limit makes no difference."""
    runs = [
        (swing(), None, udk.SVD(1e-4)),
        (swing(), udk.Baumgarte(2.0, 2.0), udk.Auto()),
        (equal_crank(), None, udk.Auto()),
        (udk.library.four_bar(1.0, 3.0), None, udk.Auto()),
        (udk.library.peaucellier(0.5, 0.3), udk.Baumgarte(10.0, 10.0), udk.Auto()),
    ]
    ts = [TS] * 4 + [np.linspace(0.0, 0.5, 6)]

    def verdicts(**choices):
        return [
            int(udk.simulate(m, t, method=method, stabilization=x, **TIGHT, **choices).code)
            for (m, x, method), t in zip(runs, ts, strict=True)
        ]

    before = verdicts()
    assert before == [Result.singular] * 3 + [Result.successful] * 2
    assert verdicts(drift_tol=1e-3 * factor) == before
    with multiplied(factor, "pinv.auto.NEAREST"):
        assert verdicts() == before


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.1, 1.0, 10.0])
def test_ten_times_more_or_less_refuses_no_projected_run_across_singular_configurations(factor):
    """The bound of Psi after a projection, in tolerances."""
    with multiplied(factor, "native.module.steps.CLOSED_TOL"):
        for mech in (swing(), swing(0.9), kite(), equal_crank(), udk.library.n_four_bar(2), udk.library.peaucellier(1.1, 2.0)):
            for method in (udk.Auto(), udk.SVD(1e-4), udk.Elimination(1e-3)):

                def code(tol, mech=mech, method=method):
                    return udk.simulate(mech, TS, method=method, rtol=tol, atol=tol, throw=False).code

                codes = jax.vmap(code)(jnp.array([1e-3, 1e-5, 1e-7, 1e-9, 1e-11]))
                assert codes.tolist() == [Result.successful] * 5, (mech.name, method)


@pytest.mark.slow
def test_each_member_of_a_batch_has_its_own_end_and_derivatives_as_other_failed_runs():
    angles, ts = jnp.array([SWING, 0.9]), np.linspace(0.0, 3.0, 4)

    def angle_at(a, k, **choices):
        return udk.simulate(udk.library.parallelogram(a), ts, **choices, **TIGHT).q[k, 0, 2]

    def code(a, alpha):
        mech = udk.library.parallelogram(a)
        return udk.simulate(mech, ts, stabilization=udk.Baumgarte(alpha, alpha), **TIGHT).code

    codes = jax.vmap(code)(jnp.array([SWING, SWING, 0.9]), jnp.array([2.0, 30.0, 30.0]))
    assert codes.tolist() == [Result.singular, Result.successful, Result.successful]
    for k in (1, -1):
        forward = jax.vmap(lambda a, k=k: jax.jvp(lambda a: angle_at(a, k, stabilization=None), (a,), (1.0,))[1])(angles)
        reverse = jax.vmap(jax.grad(lambda a, k=k: angle_at(a, k, stabilization=None)))(angles)
        limited = jax.vmap(jax.grad(lambda a, k=k: angle_at(a, k, max_steps=30)))(angles)
        np.testing.assert_allclose(forward, reverse, rtol=1e-5)
        np.testing.assert_allclose(limited, reverse, rtol=1e-5)
        assert np.isfinite(reverse).all() == (k == 1) and np.isnan(reverse).all() == (k == -1)


@pytest.mark.slow
@pytest.mark.parametrize("make", [swing, equal_crank, kite])
def test_no_run_is_successful_and_wrong(make):
    refused = right = 0
    for angle in np.linspace(0.4, 1.1, 4):
        mech = make(angle)
        exact = reference(mech)
        for method in (udk.SVD(1e-4), udk.Auto(), udk.SVD(), udk.Householder(), udk.Elimination()):
            for stabilization in (None, *(udk.Baumgarte(x, x) for x in (2.0, 10.0, 30.0, 100.0))):
                s = udk.simulate(mech, TS, method=method, stabilization=stabilization, max_steps=3000, **TIGHT)
                if s.result.is_success:
                    right += 1
                    assert np.abs(s.q[-1, :, 2] - exact[-1, :, 2]).max() < 1e-2, (angle, method, stabilization)
                refused += int(s.result == Result.singular)
    assert right > 20 and refused > 5
