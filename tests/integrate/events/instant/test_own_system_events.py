"""Events of user-defined systems: conditions of t, q and v that record, stop, or reverse a rate."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.integrate.systems.own_systems import G, disc, pendulum, steady_spin

RATE = np.sqrt(G / 0.6)  # of the conical pendulum 0.6 m below its pivot
CONICAL = udk.State([0.8, 0.0, -0.6], [0.0, 0.8 * RATE, 0.0])
TIGHT: Any = {"rtol": 1e-10, "atol": 1e-10}
BOTH = ["native", pytest.param("jax", marks=pytest.mark.slow)]


@pytest.mark.parametrize("engine", BOTH)
def test_times_of_events(engine):
    """The conical pendulum crosses x = 0 twice a turn, and its speed along y rises through a value once; time ends the run."""
    events = [
        udk.Event(lambda t, q, v: q[0], udk.Log(), name="crosses"),
        udk.Event(lambda t, q, v: v[1] - 0.4 * RATE, udk.Log(), 1, name="rises"),
        udk.Event(lambda t, q, v: t - 2.1, udk.Stop(), name="end"),
    ]
    run = udk.simulate(pendulum(), [0.0, 1.0, 4.0], CONICAL, **TIGHT, events=events, engine=engine)
    assert run.events is not None
    assert run.settings["engine"].startswith("native" if engine == "native" else "jax")
    assert_allclose(run.events.of("crosses") * RATE / np.pi, [0.5, 1.5, 2.5], atol=1e-8)
    assert_allclose(run.events.of("rises") * RATE / np.pi, [5 / 3], atol=1e-8)
    assert run.result == udk.Result.event_stop
    assert_allclose(run.time, 2.1, atol=1e-13)
    assert run.events.q_before.shape == (5, 3)


@pytest.mark.slow
def test_events_of_independent_coordinates():
    event = udk.Event(lambda t, q, v: q[0], udk.Log(), name="crosses")
    run = udk.simulate(pendulum(), [0.0, 2.0], CONICAL, **TIGHT, events=[event], formulation=udk.CoordinatePartitioning())
    assert run.events is not None and run.settings["engine"] == "native"
    assert_allclose(run.events.of("crosses") * RATE / np.pi, [0.5, 1.5, 2.5], atol=1e-8)


def test_rolling_until_a_heading():
    """A disc that rolls in a circle has turned by a right angle after a quarter of its turn."""
    lean, turn = -0.3, 2.0
    spin = steady_spin(lean, turn)
    radius = 0.4 * spin / turn
    start = udk.State([0.0, 0.0, 0.0, lean, 0.0], [radius * turn, 0.0, turn, 0.0, spin - turn * np.sin(lean)])
    quarter = udk.Event(lambda t, q, v: q[2] - np.pi / 2, udk.Stop(), name="quarter")
    run = udk.simulate(disc(), [0.0, 2.0], start, **TIGHT, events=quarter)
    assert_allclose(run.time, np.pi / 4, atol=1e-9)
    assert run.events is not None
    assert_allclose(run.events.q_after[0, :2], [radius, radius], atol=1e-8)


def swung(engine, restitution=0.5):
    """A pendulum in the plane y = 0, let go at 90 degrees, that hits a wall at its lowest point, twice."""
    wall = udk.Event(lambda t, q, v: q[0], udk.Impact(restitution, at_rest="stop"), name="wall")
    start = udk.State([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    return udk.simulate(pendulum(), [0.0, 2.0], start, **TIGHT, events=wall, engine=engine)


@pytest.mark.parametrize("engine", BOTH)
def test_an_impact_on_a_wall(engine):
    """At each impact the speed halves, so that the next swing rises a quarter as high."""
    run = swung(engine)
    speed = np.sqrt(2 * G)
    assert run.events is not None
    assert_allclose(run.events.v_before[:2, 0], [-speed, -speed / 2], rtol=1e-8)
    assert_allclose(run.events.v_after[:2, 0], [speed / 2, speed / 4], rtol=1e-8)
    assert_allclose(run.events.v_after[:2, 1:], 0.0, atol=1e-12)


def coupled(a):
    """Two coordinates whose masses are coupled, a third that keeps up with the first, and a wall."""
    M = jnp.array([[2.0, 0.7, 0.0], [0.7, 1.0, 0.3], [0.0, 0.3, 1.5]])
    force = jnp.array([-1.0, -0.5, -0.6])
    system = udk.ConstrainedSystem(lambda q: M + 0 * q[0], lambda t, q, v: a * force, lambda t, q: q[2] - 2 * q[0])
    wall = udk.Event(lambda t, q, v: q[0] + q[1], udk.Impact(0.7, at_rest="stop"), name="wall")
    start = udk.State([0.3, 0.2, 0.6], [0.0, 0.0, 0.0])
    return udk.simulate(system, [0.0, 1.5], start, **TIGHT, events=wall, throw=False)


def reduced(a):
    """The state right after the first impact, by the two independent coordinates."""
    J = np.array([[1.0, 0.0], [0.0, 1.0], [2.0, 0.0]])
    M = J.T @ np.array([[2.0, 0.7, 0.0], [0.7, 1.0, 0.3], [0.0, 0.3, 1.5]]) @ J
    acceleration = np.linalg.solve(M, J.T @ (a * np.array([-1.0, -0.5, -0.6])))
    n = np.array([1.0, 1.0])
    t = np.sqrt(2 * 0.5 / -(n @ acceleration))
    v = acceleration * t
    direction = np.linalg.solve(M, n)
    return t, J @ (v - 1.7 * (n @ v) / (n @ direction) * direction)


def test_an_impact_of_coupled_masses():
    """The impulse acts through M, which is full, and through the constraint."""
    t, v = reduced(3.0)
    run = coupled(3.0)
    assert run.events is not None
    assert_allclose(run.events.time[0], t, atol=1e-10)
    assert_allclose(run.events.v_after[0], v, atol=1e-9)


@pytest.mark.slow
def test_derivatives_and_batches_of_impacts():
    """Through the impact, in reverse against differences; members are single runs."""
    end = lambda a: coupled(a).q[-1]  # noqa: E731
    difference = (end(3.0 + 1e-5) - end(3.0 - 1e-5)) / 2e-5
    assert_allclose(jax.jit(jax.jacrev(end))(3.0), difference, atol=1e-6)
    batch = jax.jit(jax.vmap(end))(jnp.array([2.5, 3.0, 3.5]))
    assert_allclose(batch[1], end(3.0), atol=1e-11)


@pytest.mark.slow
def test_other_solvers_with_events():
    stop = udk.Event(lambda t, q, v: q[0], udk.Stop(), name="stop")
    for solver in (diffrax.Kvaerno5(), udk.BDF()):
        run = udk.simulate(pendulum(), [0.0, 1.0], CONICAL, 1e-10, 1e-10, events=stop, solver=solver)
        assert_allclose(run.time, np.pi / 2 / RATE, atol=1e-6)


def test_mistakes():
    """Actions and ready-made events that need joints, and conditions of another shape, are refused with a cure."""
    by_state = lambda t, q, v: q[0]  # noqa: E731
    for event, message in (
        (udk.Event(by_state, udk.Release("A")), "changes the joints of a mechanism"),
        (udk.Event(by_state, udk.Impact(0.5)), 'at_rest="stop"'),
        (udk.Event(lambda t, q, v: q, udk.Stop()), "must return one number"),
        (udk.JointLimit("A", 0.0), "a JointLimit is for mechanisms"),
    ):
        with pytest.raises(ValueError, match=message):
            udk.simulate(pendulum(), [0.0, 1.0], CONICAL, events=event)
