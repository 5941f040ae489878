"""How runs end: codes, causes, times, and the outputs after the end; for single runs and in batches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.scenes import TS, Until, with_force

RESULTS = udk.Result


class BlowUp(udk.ForceElement):
    """A force that grows without bound as some time approaches."""

    end: float

    def loads(self, t, *frames):
        return [(1.0 / (self.end - t) ** 2, 0.0, 0.0)]


def ended(sol, result, time, tol):
    """Require that the run ended with this code at about this time, and that later outputs are NaN."""
    assert sol.result == result
    assert_allclose(sol.time, time, atol=tol)
    reached = np.asarray(sol.ts <= sol.time)
    assert np.isfinite(sol.q[reached]).all() and np.isfinite(sol.v[reached]).all()
    assert np.isnan(sol.q[~reached]).all() and np.isnan(sol.v[~reached]).all()
    assert reached[0]


def test_success(motion):
    assert motion.result is RESULTS.successful
    assert motion.time == 1.0
    assert "end time" in motion.cause
    assert motion.q.shape == motion.v.shape == (11, 1, 3)
    assert_allclose(motion.ts, TS)


def test_step_limit(pendulum):
    with pytest.raises(udk.SimulationError, match=r"step limit at t = 0\.\d+ s.*max_steps") as caught:
        udk.simulate(pendulum, TS, max_steps=4)
    ended(caught.value.solution, RESULTS.step_limit, 0.5, 0.4)
    assert caught.value.solution.stats["steps"] == 4
    sol = udk.simulate(pendulum, TS, max_steps=4, throw=False)
    assert_allclose(sol.q, caught.value.solution.q)


def test_a_number_that_is_not_finite(pendulum):
    mech = with_force(pendulum, Until("rod", 0.45))
    sol = udk.simulate(mech, TS, throw=False)
    ended(sol, RESULTS.not_finite, 0.45, 1e-3)
    assert_allclose(sol.q[:5], udk.simulate(with_force(pendulum, Until("rod", 9.0)), TS).q[:5], atol=1e-7)
    with pytest.raises(udk.SimulationError, match="not finite"):
        udk.simulate(mech, TS)


def test_not_finite_from_the_start(pendulum):
    sol = udk.simulate(with_force(pendulum, Until("rod", -1.0)), TS, throw=False)
    assert sol.result == RESULTS.not_finite
    assert sol.time == 0.0
    assert np.isnan(sol.q[1:]).all()


def test_a_step_that_is_too_small():
    mech = udk.Mechanism({"stone": udk.Body(1.0, 1.0)}, forces=[BlowUp("stone", 0.55)])
    sol = udk.simulate(mech, TS, throw=False)
    ended(sol, RESULTS.step_too_small, 0.55, 1e-6)
    with pytest.raises(udk.SimulationError, match=r"step too small at t = 0\.55"):
        udk.simulate(mech, TS)


def test_drift(pendulum):
    """A violation above `drift_tol` ends the solution where it was first seen."""
    sol = udk.simulate(pendulum, TS, rtol=1e-4, atol=1e-4, stabilization=None, drift_tol=1e-6, throw=False)
    psi = np.abs(udk.violation(pendulum, sol)).max(1)
    assert sol.result == RESULTS.drift
    first = int(np.flatnonzero(np.asarray(sol.ts) == float(sol.time))[0])
    assert (psi[:first] <= 1e-6).all() and psi[first] > 1e-6
    assert np.isnan(psi[first + 1 :]).all() and first < 10
    with pytest.raises(udk.SimulationError, match=r"drift at.*stabilize"):
        udk.simulate(pendulum, TS, rtol=1e-4, atol=1e-4, stabilization=None, drift_tol=1e-6)


def test_what_cannot_be_assembled(hung):
    mech = hung.with_parameters({"joint.thread.points[0][1]": 2.0})
    with pytest.raises(udk.AssemblyError, match=r'"(line|thread)"'):
        udk.simulate(mech, TS)
    sol = udk.simulate(mech, TS, throw=False)
    assert sol.result == RESULTS.could_not_assemble
    assert sol.time == 0.0
    assert np.isfinite(sol.q[0]).all() and np.isnan(sol.q[1:]).all()
    assert sol.stats["steps"] < 100


@pytest.fixture(scope="module")
def pinned_twice(pendulum):
    """The same pin twice. `at` moves the second one along the rod, which then cannot turn."""
    mech = udk.Mechanism(pendulum.bodies, {"pin": pendulum.joints["pin"], "again": pendulum.joints["pin"]})
    assert udk.analyse(mech).redundant_rows == (2, 3)
    along = np.array([np.cos(float(mech.q0[0, 2])), np.sin(float(mech.q0[0, 2]))])
    return lambda at: mech.with_parameters({"joint.again.points[0]": at * along, "joint.again.points[1][0]": at - 0.75})


def test_rows_that_become_independent_count_again(pinned_twice):
    """It cannot move, and does not move silently, even with the analysis of other numbers."""
    stuck, other = pinned_twice(0.4), udk.analyse(pinned_twice(0.0))
    assert udk.analyse(stuck).redundant_rows != other.redundant_rows == (2, 3)
    sol = udk.simulate(stuck, TS, throw=False, analysis=other)
    assert sol.result == RESULTS.successful
    assert_allclose(sol.q, jnp.broadcast_to(stuck.q0, sol.q.shape), atol=1e-9)


def test_and_say_so_where_numbers_are_traced(pinned_twice, motion):
    run = jax.jit(lambda at: udk.simulate(pinned_twice(at), TS))
    assert run(0.4).code == RESULTS.drift
    free = run(0.0)
    assert free.code == RESULTS.successful
    assert_allclose(free.q, motion.q, atol=1e-9)


def test_a_batch_with_members_that_fail(hung):
    """One cannot be closed, and one gets a NaN. The others equal their single runs, and no exception is raised."""

    def run(height, end, mass):
        values = {"joint.thread.points[0][1]": height, "force.motor.end": end, "body.rod.mass": mass}
        return udk.simulate(hung.with_parameters(values), TS)

    members = jnp.array([[0.3, 99.0, 1.0], [2.0, 99.0, 1.0], [0.5, 99.0, 1.0], [0.3, 0.35, 1.0], [0.3, 99.0, 4.0]])
    batch = jax.jit(jax.vmap(run))(*members.T)
    assert list(batch.result) == [RESULTS.successful, RESULTS.could_not_assemble, RESULTS.successful, RESULTS.not_finite, 0]
    assert batch.q.shape == (5, 11, 1, 3) and batch.stats["steps"].shape == (5,)
    single = eqx.filter_jit(run)
    for k in (0, 2, 4):
        alone = single(*members[k])
        assert_allclose(batch.q[k], alone.q, atol=1e-11)
        assert batch.stats["steps"][k] == alone.stats["steps"]
    assert np.isnan(batch.q[1, 1:]).all() and np.isnan(batch.q[3, 4:]).all()
    assert_allclose(batch.q[3, :4], batch.q[0, :4], atol=1e-7)
    assert jnp.abs(batch.q[4, -1] - batch.q[0, -1]).max() > 1e-3


def test_a_batch_says_how_each_ended(pendulum):
    codes = jnp.array([0, 3])
    sol = udk.simulate(pendulum, TS)
    many = eqx.tree_at(lambda s: s.code, sol, codes)
    assert_allclose(many.result, codes)
