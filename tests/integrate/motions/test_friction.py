"""Runs with friction that depends on the loads of joints: closed forms, independent integrations, derivatives, jams."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import udkjax as udk
from tests.friction import G, block, cart, cart_by_scipy, drawer, mu, pendulum, pendulum_by_scipy, rubbing

TOL: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}


def test_block_slides_and_turns_round():
    """It decelerates by g (sin + mu cos), and slides back by g (sin - mu cos) if mu < tan."""
    angle, coefficient = 0.6, 0.2
    up, down = (G * (np.sin(angle) + sign * coefficient * np.cos(angle)) for sign in (1, -1))
    mechanism, turn = block(angle, coefficient, speed=1e-6, uphill=2.0), 2.0 / up
    solution = udk.simulate(mechanism, [0.0, turn, turn + 1.0], **TOL)
    along = np.asarray(solution.q[:, 0, 0]) / np.cos(angle)
    assert along[1] == pytest.approx(2.0 * turn / 2, rel=1e-6)
    assert along[1] - along[2] == pytest.approx(down / 2, rel=1e-4)
    assert solution.settings["engine"] == "native"


def test_block_creeps_where_it_would_stick():
    """Below the angle of friction it creeps at the speed at which mu(s) = tan."""
    angle = 0.2
    solution = udk.simulate(block(angle, 0.3), [0.0, 1.0, 100.0])
    creep = 1e-3 * np.arctanh(np.tan(angle) / 0.3) / 4
    assert float(np.linalg.norm(solution.v[-1, 0, :2])) == pytest.approx(creep, rel=1e-6)


@pytest.mark.slow
def test_jam_is_named():
    solution = udk.simulate(drawer(0.26), [0.0, 1.0], throw=False)
    assert solution.result != udk.Result.successful
    assert 'friction jams joint "S" at 0 s' in solution.cause
    assert udk.simulate(drawer(0.24), [0.0, 1.0]).result == udk.Result.successful


@pytest.mark.slow
def test_a_jam_on_the_way_is_named_by_both_laws():
    """Near the position where all links are in line, the forces that balance friction grow without bound."""
    ends = []
    for law in ("smooth", "set-valued"):
        mechanism = rubbing(udk.library.n_four_bar(), 0.15, 0.005, law=law)
        solution = udk.simulate(mechanism, [0.0, 4.0], throw=False, **TOL)
        assert "friction jams joints" in solution.cause and " at 0.7151" in solution.cause
        assert "make the coefficient or the radius of the pin smaller" in solution.cause
        ends.append(float(solution.time))
    assert ends[0] == pytest.approx(ends[1], abs=1e-6)


def test_a_jam_is_named_after_an_event_and_where_steps_run_out():
    """Steps become ever shorter towards the jam: more of them would not help."""
    mechanism = rubbing(udk.library.n_four_bar(1), 0.15, 0.005)
    watch = udk.Event(lambda t, at: t - 0.2, udk.Log(), name="log")
    solution = udk.simulate(mechanism, [0.0, 0.4, 4.0], events=[watch], throw=False, max_steps=100, rtol=1e-10, atol=1e-10)
    assert solution.events is not None and solution.events.count == 1 and solution.result == udk.Result.step_limit
    assert "steps was reached: friction jams joints" in solution.cause


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_pendulum_on_a_thick_pin(engine):
    ts = np.linspace(0.0, 3.0, 31)
    numbers = {"coefficient": 0.2, "static_coefficient": 0.3, "speed": 0.02, "viscous": 0.1}
    solution = udk.simulate(pendulum(radius=0.06, **numbers), ts, engine=engine, **TOL)
    expected = pendulum_by_scipy(ts, lambda s: mu(s, 0.2, 0.3, 0.02, 0.1), 0.06)
    np.testing.assert_allclose(solution.q[:, 0, 2], expected, atol=2e-8)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "jax"])
def test_cart_with_a_pendulum(engine):
    ts = np.linspace(0.0, 2.0, 21)
    solution = udk.simulate(cart(0.15, speed=0.05), ts, engine=engine, **TOL)
    expected = cart_by_scipy(ts, lambda s: mu(s, 0.15, 0.15, 0.05))
    np.testing.assert_allclose(solution.q[:, 0, 0], expected[0], atol=2e-8)
    np.testing.assert_allclose(solution.q[:, 1, 2], expected[1] - np.pi / 3, atol=2e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["four_bar", "slider_crank", "double_pendulum"])
def test_engines_agree_and_energy_falls(name):
    mechanism = rubbing(getattr(udk.library, name)(), speed=0.05)
    ts = np.linspace(0.0, 0.5, 6)
    solution, reference = (udk.simulate(mechanism, ts, engine=engine, **TOL) for engine in ("native", "jax"))
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-8)
    assert np.all(np.diff(udk.energy(mechanism, solution).total) < 0)


@pytest.mark.slow
def test_strong_friction_takes_more_rounds():
    """Friction at 0.9 of the jamming coefficient: machine code settles, and lanes with less friction stay as they are."""
    mechanism, ts, strong = pendulum(coefficient=0.3, radius=0.1, speed=0.05), np.linspace(0.0, 0.2, 3), 4.6

    def end(coefficient):
        return udk.simulate(mechanism.with_parameters({"force.rub.coefficient": coefficient}), ts, **TOL).q[-1]

    alone, reference = end(strong), mechanism.with_parameters({"force.rub.coefficient": strong})
    np.testing.assert_allclose(alone, udk.simulate(reference, ts, engine="jax", **TOL).q[-1], atol=2e-9)
    lanes, weak = (jax.vmap(end)(jnp.array([0.3, x])) for x in (strong, 0.1))
    np.testing.assert_array_equal(lanes[0], weak[0])
    np.testing.assert_allclose(lanes[1], alone, atol=1e-11)


@pytest.mark.slow
def test_lanes_equal_single_runs():
    mechanism, ts = rubbing(udk.library.four_bar(), speed=0.05), np.linspace(0.0, 0.5, 3)

    def end(scale):
        changed = mechanism.with_parameters({"force.rub A.coefficient": 0.2 * scale})
        return udk.simulate(changed, ts, **TOL).q[-1]

    scales = jnp.linspace(0.5, 1.5, 7)
    np.testing.assert_allclose(jax.vmap(end)(scales), jnp.stack([end(x) for x in scales]), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("build", [lambda: pendulum(coefficient=0.2, radius=0.1), lambda: cart(0.2, 0.1)])
def test_derivatives_agree_with_differences(build):
    """First derivatives forward and in reverse, and second ones, of a run in machine code."""
    mechanism = build().with_parameters({"force.rub.speed": 0.1})
    names = [name for name in mechanism.parameters() if name.startswith("force.rub.")] + ["gravity"]
    at, unravel = ravel_pytree({name: mechanism.parameters()[name] for name in names})

    def end(x):
        return udk.simulate(mechanism.with_parameters(unravel(x)), [0.0, 0.4], rtol=1e-11, atol=1e-11).q[-1, -1, 2]

    gradient, step = jax.grad(end)(at), 1e-4
    np.testing.assert_allclose(jax.jacfwd(end)(at), gradient, rtol=1e-8, atol=1e-12)
    seeds = step * np.eye(len(at))
    differences = [(end(at + seed) - end(at - seed)) / (2 * step) for seed in seeds]
    np.testing.assert_allclose(gradient, differences, rtol=1e-5, atol=1e-7)
    hessian = jax.jacfwd(jax.jacfwd(end))(at)
    differences = [(jax.grad(end)(at + seed) - jax.grad(end)(at - seed)) / (2 * step) for seed in seeds]
    np.testing.assert_allclose(hessian, differences, rtol=1e-4, atol=1e-4 * np.abs(hessian).max())


@pytest.mark.slow
def test_derivatives_of_both_engines_agree():
    mechanism = pendulum(coefficient=0.2, radius=0.1, speed=0.1)

    def end(x, engine):
        return udk.simulate(mechanism.with_parameters({"force.rub.radius": x}), [0.0, 0.4], engine=engine, **TOL).q[-1, 0, 2]

    native, reference = (jax.jacfwd(lambda x, engine=engine: end(x, engine))(0.1) for engine in ("native", "jax"))
    assert float(native) == pytest.approx(float(reference), rel=1e-7)
