"""Implicit Runge-Kutta methods by machine code: their order, their lanes, their derivatives, and stiff forces."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import udkjax as udk
from tests.choices import fast
from tests.textbook import terms

SOLVERS = [diffrax.Kvaerno5(), pytest.param(diffrax.Kvaerno4(), marks=pytest.mark.slow), diffrax.Kvaerno3()]
TS = np.linspace(0.0, 1.0, 11)


def damped(damping, stiffness=0.0, scene=None):
    """A four-bar linkage with a torsional damper at its crank, or another scene with one."""
    scene = udk.library.four_bar() if scene is None else scene
    damper = udk.TorsionSpring(["ground", scene.body_names[0]], stiffness=stiffness, damping=damping)
    return udk.Mechanism(scene.bodies, scene.joints, forces={"damper": damper})


def by_radau(mechanism, ts):
    """The motion from M a + Psi_q^T lambda = F, Psi_q a = gamma, by SciPy's implicit method."""
    state = udk.assemble(mechanism)
    n = state.q.size

    def slope(t, y):
        _, A, _, gamma, M, F = terms(mechanism, t, y[:n], y[n:])
        root = np.sqrt(M)
        a = F / M + np.linalg.pinv(A / root, rcond=1e-8) @ (gamma - A @ (F / M)) / root
        return np.concatenate([y[n:], a])

    y0 = np.concatenate([np.ravel(state.q), np.ravel(state.v)])
    ys = solve_ivp(slope, (ts[0], ts[-1]), y0, "Radau", t_eval=ts, rtol=1e-9, atol=1e-9).y.T
    return ys[:, :n].reshape(len(ts), -1, 3), ys[:, n:].reshape(len(ts), -1, 3)


def assert_motion_is_that_by_radau(solution, damping):
    """Compare a run of the damped linkage, whose motion is slower the larger the damping is."""
    q, v = by_radau(damped(damping), TS)
    assert_allclose(solution.q, q, atol=1e-6 * min(1.0, 1e3 / damping))
    assert_allclose(solution.v[1:], v[1:], atol=1e-5 * min(1.0, 1e3 / damping))


def run(mechanism, tol=1e-6, solver=None, ts=TS, **choices):
    solver = diffrax.Kvaerno5() if solver is None else solver
    return udk.simulate(mechanism, ts, rtol=tol, atol=tol, solver=solver, **choices)


@pytest.fixture(scope="module")
def pendulum():
    """A damped pendulum, and its motion by an explicit method."""
    mechanism = damped(0.1, scene=udk.library.compound_pendulum())
    return mechanism, udk.simulate(mechanism, TS, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda x: type(x).__name__)
def test_errors_and_steps_follow_the_tolerance(pendulum, solver):
    """Steps are as many as the order says: an estimated error is of the order of h^order."""
    mechanism, exact = pendulum
    tols = 1e-7, 1e-10
    found = [run(mechanism, tol, solver) for tol in tols]
    for solution, tol in zip(found, tols, strict=True):
        assert solution.settings["engine"] == "native"
        assert_allclose(solution.q, exact.q, atol=30 * tol)
        assert_allclose(solution.v, exact.v, atol=150 * tol)
    ratio = int(found[1].stats["accepted"]) / int(found[0].stats["accepted"])
    order = np.log(tols[0] / tols[1]) / np.log(ratio)
    assert abs(order - solver.error_order(diffrax.ODETerm(lambda t, y, args: y))) < 0.5


@pytest.mark.parametrize("damping", fast([1e5, 1e9], [10.0, 1e5, 1e9]))
def test_stiff_dampers(damping):
    """From no stiffness to time constants of 1e-11 s; the linkage barely moves then, but with the right velocity."""
    solution = run(damped(damping))
    assert_motion_is_that_by_radau(solution, damping)
    assert int(solution.stats["steps"]) < 60


def test_a_driven_body_relaxes_as_its_equation_says():
    """The rate of I omega' = T - c omega is T / c after a few times I / c = 1e-5 s."""
    body = udk.Body(1.0, 0.1, angular_velocity=3.0)
    pin = udk.Revolute(["ground", "wheel"], ((0.0, 0.0), (0.0, 0.0)))
    forces = {"damper": udk.TorsionSpring(["ground", "wheel"], 0.0, 1e4), "torque": udk.Torque(["ground", "wheel"], 50.0)}
    wheel = udk.Mechanism({"wheel": body}, {"pin": pin}, forces=forces, gravity=(0.0, 0.0))
    ts = np.array([0.0, 1e-5, 3e-5, 0.5, 1.0])
    solution, rate, end = run(wheel, 1e-8, ts=ts), 1e4 / 0.1, 50.0 / 1e4
    decay = np.exp(-rate * ts)
    assert_allclose(solution.v[:, 0, 2], end + (3.0 - end) * decay, atol=1e-5)
    assert_allclose(solution.q[:, 0, 2], end * ts + (3.0 - end) * (1 - decay) / rate, atol=1e-9)


@pytest.mark.parametrize(
    "stabilization",
    [udk.Projection(), *(pytest.param(x, marks=pytest.mark.slow) for x in (None, udk.Baumgarte(5.0, 5.0)))],
    ids=lambda x: type(x).__name__,
)
def test_members_in_lanes_are_those_alone(stabilization):
    """Bit for bit, though one converges sooner than another."""
    mechanism, ts = damped(1.0), np.linspace(0.0, 1.0, 5)
    analysis, state = udk.analyse(mechanism), udk.assemble(mechanism)

    def motion(damping):
        moved = mechanism.with_parameters({"force.damper.damping": damping})
        found = run(moved, ts=ts, state=state, analysis=analysis, stabilization=stabilization, drift_tol=1e-2, throw=False)
        return found.q, found.v, found.stats["steps"], found.stats["right_hand_sides"]

    dampings = np.geomspace(0.1, 1e9, 11)
    together = jax.jit(jax.vmap(motion))(dampings)
    for k, damping in enumerate(dampings):
        for x, y in zip(together, motion(damping), strict=True):
            np.testing.assert_array_equal(x[k], y)


def end_of(mechanism, name, tol=1e-10, **choices):
    state, analysis = udk.assemble(mechanism), udk.analyse(mechanism)

    def end(x):
        found = run(mechanism.with_parameters({name: x}), tol, state=state, analysis=analysis, throw=False, **choices)
        return found.q[5, 0, 2] + found.v[-1, 0, 2]

    return end


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.3, 1e6])
def test_first_derivatives(damping):
    """Forward and reverse agree to rounding, and with differences of runs."""
    end = end_of(damped(damping), "force.damper.damping")
    by_differences = (end(damping * 1.0003) - end(damping * 0.9997)) / (6e-4 * damping)
    forward = jax.jvp(end, (damping,), (1.0,))[1]
    assert_allclose(jax.grad(end)(damping), forward, rtol=1e-10)
    assert_allclose(forward, by_differences, rtol=2e-5)


@pytest.mark.slow
def test_derivatives_of_batches_and_of_second_order():
    """Members in lanes, several directions at once, and second derivatives, which follow from the first ones."""
    mechanism = damped(0.3, scene=udk.library.compound_pendulum())
    end = end_of(mechanism, "force.damper.damping")
    dampings = np.linspace(0.2, 3.0, 9)
    slopes = np.array([jax.jvp(end, (x,), (1.0,))[1] for x in dampings])
    assert_allclose(jax.vmap(jax.grad(end))(dampings), slopes, rtol=1e-10)
    assert_allclose(jax.vmap(lambda x: jax.jvp(end, (x,), (1.0,))[1])(dampings), slopes, rtol=1e-10)
    by_differences = (jax.grad(end)(0.3003) - jax.grad(end)(0.2997)) / 6e-4
    assert_allclose(jax.grad(jax.grad(end))(0.3), by_differences, rtol=1e-5)

    def of_both(x):
        moved = mechanism.with_parameters({"force.damper.damping": x[0], "body.rod.mass": x[1]})
        return run(moved, 1e-9, throw=False).v[-1, 0, 2]

    at = jnp.array([0.3, 1.5])
    assert_allclose(jax.jacfwd(of_both)(at), jax.jacrev(of_both)(at), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("choices", [{"method": udk.SVD()}, {"formulation": udk.Augmented()}], ids=["SVD", "Augmented"])
def test_other_equations(choices):
    mechanism = damped(1e3)
    q, _ = by_radau(mechanism, TS)
    solution = run(mechanism, **choices)
    assert solution.settings["engine"] == "native"
    assert_allclose(solution.q, q, atol=1e-6)


@pytest.mark.slow
def test_a_large_scene_is_integrated_by_loops():
    """A chain whose programs are loops: the same motion as by an explicit method, in lanes too."""
    chain = udk.library.chain(20)
    mechanism = udk.Mechanism(
        chain.bodies, chain.joints, forces={"d": udk.TorsionSpring(["ground", chain.body_names[0]], 0.0, 0.5)}
    )
    ts = np.linspace(0.0, 0.3, 4)
    exact = udk.simulate(mechanism, ts, rtol=1e-10, atol=1e-10)
    assert_allclose(run(mechanism, 1e-7, ts=ts).q, exact.q, atol=1e-5)
