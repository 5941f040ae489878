"""Runs: inputs, outputs between steps, traced mechanisms, and what is compiled."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.scenes import TS


@pytest.mark.parametrize("ts", [0.0, [0.0], [[0.0, 1.0]], [0.0, 1.0, 1.0], [1.0, 0.0]])
def test_output_times_are_checked(pendulum, ts):
    with pytest.raises(ValueError, match="ts must"):
        udk.simulate(pendulum, ts)


def test_it_may_start_at_any_time():
    """Drivers use the time of `ts`."""
    mech = udk.library.driven_pendulum()
    ts = np.array([0.7, 0.8, 1.9])
    sol = udk.simulate(mech, ts)
    assert_allclose(sol.q[:, 0, 2], 0.8 * np.sin(3 * ts), atol=1e-12)
    assert_allclose(sol.v[:, 0, 2], 2.4 * np.cos(3 * ts), atol=1e-12)


def test_a_given_state_is_taken_as_it_is(pendulum, motion):
    rest = udk.simulate(pendulum, TS + 5.0, udk.State(motion.q[3], motion.v[3]))
    assert_allclose(rest.q[:8], motion.q[3:], atol=1e-7)
    assert_allclose(rest.q[0], motion.q[3], atol=0)


SOLVERS = {
    "Tsit5": diffrax.Tsit5(),
    "Dopri8": diffrax.Dopri8(),
    "Heun": diffrax.Heun(),
    "Kvaerno5": diffrax.Kvaerno5(),
}
FINE = np.sort(np.append(np.linspace(0.0, 1.0, 38), [1 / np.pi, 0.333]))


@pytest.mark.parametrize(
    "solver",
    [pytest.param(s, id=name, marks=pytest.mark.slow if name == "Kvaerno5" else ()) for name, s in SOLVERS.items()],
)
def test_outputs_lie_on_the_manifold_with_every_solver(pendulum, motion, solver):
    sol = udk.simulate(pendulum, FINE, rtol=1e-6, atol=1e-6, solver=solver)
    assert jnp.abs(udk.violation(pendulum, sol)).max() < 1e-14
    assert_allclose(sol.v[:, 0, 0], -sol.v[:, 0, 2] * sol.q[:, 0, 1], atol=1e-14)  # the velocity of the centre, by the constraint
    assert_allclose(sol.q[-1], motion.q[-1], atol=1e-4)
    energy = udk.energy(pendulum, sol).total
    assert_allclose(energy, energy[0], atol=2e-3)


@pytest.mark.slow
def test_output_times_do_not_change_the_motion(pendulum, motion):
    """The solver chooses its steps; outputs are interpolated between them."""
    sol = udk.simulate(pendulum, FINE)
    assert sol.stats["steps"] == motion.stats["steps"]
    assert_allclose(sol.q[-1], motion.q[-1], atol=1e-13)
    few = udk.simulate(pendulum, np.array([0.0, 1.0]))
    assert_allclose(few.q[-1], motion.q[-1], atol=1e-13)


@pytest.mark.parametrize("tol", [1e-4, 1e-3])
def test_an_output_beside_a_singular_configuration_is_closed(tol):
    """At 0.55 s the links are 2e-5 rad from being in line, where elimination may leave a row open up to the tolerance."""
    found = udk.simulate(udk.library.parallelogram(np.pi / 3), [0.0, 0.55, 1.0], rtol=tol, atol=tol, throw=False)
    assert abs(float(found.q[1, 0, 2])) < 1e-4 and found.settings["engine"] == "native"
    assert found.result == udk.Result.successful
    assert np.max(np.abs(udk.violation(udk.library.parallelogram(), found))) < 1e-9


def test_a_short_last_step_leaves_outputs_as_exact():
    """A free body moves on a line. Outputs just before a step a thousand times shorter once had wrong velocities."""
    body, ts = udk.Mechanism({"b": udk.Body(1.0, 0.1)}, gravity=[0, 0]), np.linspace(0.625, 0.63, 9)
    state = udk.State(np.array([[0.625, 0, 0]]), np.array([[1.000004, 0, 0]]))
    for rest in (1e-1, 1e-3, 1e-6):
        sol = udk.simulate(body, ts, state, dt0=(ts[-1] - ts[0]) * (1 - rest))
        assert_allclose(sol.v[:, 0, 0], 1.000004, rtol=1e-13)


def test_a_batch_of_mechanisms(pendulum):
    """`eqx.filter_vmap` over entire mechanisms, tolerances and times."""
    masses, tols = jnp.array([1.0, 2.0, 3.0]), jnp.array([1e-4, 1e-6, 1e-9])
    mechs = eqx.filter_vmap(lambda m: pendulum.with_parameters({"body.rod.mass": m}))(masses)
    batch = eqx.filter_vmap(lambda m, tol: udk.simulate(m, TS, rtol=tol, atol=tol))(mechs, tols)
    assert (batch.result == 0).all()
    assert (np.diff(batch.stats["steps"]) > 0).all()
    assert_allclose(batch.rtol, tols)
    # a heavier rod of the same inertia: a physical pendulum of its own frequency
    early = batch.q[:, 1, 0, 2] - batch.q[:, 0, 0, 2]
    acceleration = -9.81 * 0.75 * masses * np.sin(np.pi / 3) / (0.375 + 0.5625 * masses)
    assert_allclose(early, acceleration * 0.005, rtol=0.02)


def test_a_mechanism_made_within_a_traced_function():
    """With a traced mass or traced geometry it runs in machine code like any other."""
    ts = np.linspace(0.0, 0.5, 3)

    def angle(mass, length):
        rod = udk.Body(mass, 0.1, jnp.stack([0.5 * length, 0.0 * length]) if isinstance(length, jax.Array) else [0.5 * length, 0])
        pin = udk.Revolute(["ground", "rod"], [[0, 0], [-0.5, 0]])
        solution = udk.simulate(udk.Mechanism({"rod": rod}, {"pin": pin}), ts, throw=False)
        return solution.q[-1, 0, 2], solution.settings["engine"]

    engines = []

    def traced(*values):
        value, engine = angle(*values)
        engines.append(engine)
        return value

    expected = angle(2.0, 1.0)[0]
    assert_allclose(jax.jit(lambda m: traced(m, 1.0))(2.0), expected, atol=1e-12)
    assert_allclose(jax.jit(lambda x: traced(2.0, x))(1.0), expected, atol=1e-6)
    assert engines == ["native", "native"]


@pytest.mark.slow
def test_progress_is_printed(pendulum, capfd):
    udk.simulate(pendulum, np.array([0.0, 0.5, 1.0]), progress=True)
    jax.effects_barrier()
    assert "100" in capfd.readouterr().out
