import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.integrate import Result, Solution
from udkjax.show.summary import trust
from udkjax.study.accuracy import accuracy, conserves_energy, exact_coordinates, largest_violation


def solution(mech, ts, q, v) -> Solution:
    tol = jnp.array(1e-8)
    return Solution(ts, q, v, jnp.array(int(Result.successful)), ts[-1], {}, tol, tol, mech.body_names, ())


def test_the_largest_violation_is_that_of_any_row():
    np.testing.assert_array_equal(largest_violation(np.array([[0.0, -3.0], [1.0, 2.0]])), [3, 2])
    np.testing.assert_array_equal(largest_violation(np.empty((2, 0))), [0, 0])


def test_what_is_put_in_is_found():
    """The exact motion with one body moved by 1e-3 m, and a fall with a wrong energy; after a failure there is nothing."""
    mech = udk.library.parallelogram()
    ts = jnp.linspace(0.0, 1.0, 11)
    q = np.array(exact_coordinates(mech, ts, mech.q0, mech.v0))
    v = np.zeros_like(q)
    right = accuracy(mech, solution(mech, ts, jnp.asarray(q), jnp.asarray(v)))
    assert right.error is not None and right.error < 1e-15 and right.violation < 1e-14 and right.kinetic_energy == 0.0
    mass = [float(body.mass) for body in mech.bodies.values()]
    height = q[:, :, 1] @ mass
    assert right.energy_change == pytest.approx(9.81 * np.abs(height - height[0]).max())
    q[4, 3, 0] += 1e-3
    q[9:] = np.nan
    wrong = accuracy(mech, solution(mech, ts, jnp.asarray(q), jnp.asarray(v)))
    assert wrong.error == pytest.approx(1e-3) and wrong.violation == pytest.approx(1e-3)
    assert accuracy(udk.library.four_bar(), solution(udk.library.four_bar(), ts, *2 * [jnp.zeros((11, 3, 3))])).error is None


def test_work_is_told_from_errors_of_the_energy():
    ts = np.linspace(0.0, 0.5, 6)
    for mech, works in (
        (udk.library.simple_pendulum(), False),
        (udk.library.driven_pendulum(), True),
        (held(udk.Polynomial([0.1])), False),
        (held(udk.Polynomial([0.1]), udk.Torque(["ground", "a"], 1.0)), True),
        (held(udk.Polynomial([0.1]), udk.TorsionSpring(["ground", "a"], 2.0)), False),
        (held(udk.Polynomial([0.1]), udk.TorsionSpring(["ground", "a"], 2.0, 0.1)), True),
        (held(udk.Polynomial([0.1]), udk.TorsionSpring(["ground", "a"], 2.0, angle=udk.Held([0.1, 0.1], 0.1))), False),
        (held(udk.Polynomial([0.1]), udk.TorsionSpring(["ground", "a"], 2.0, angle=udk.Held([0.1, 0.2], 0.1))), True),
        (held(udk.Polynomial([0.1]), udk.Friction("A", torque=0.1, velocity=0.1)), True),
        (held(udk.Polynomial([0.1]), udk.Friction("A", coefficient=0.1, radius=0.01)), True),
        (held(udk.Polynomial([0.1]), udk.Friction("A", coefficient=0.1, radius=0.01, law="set-valued")), True),
    ):
        assert conserves_energy(mech, ts) != works
    mech = udk.library.driven_pendulum()
    found = accuracy(mech, udk.simulate(mech, ts))
    total = udk.energy(mech, udk.simulate(mech, ts)).total
    assert found.work == pytest.approx(float(total[-1] - total[0])) and "J of work" in trust(found)["energy"]
    rest = accuracy(held(udk.Polynomial([0.1])), udk.simulate(held(udk.Polynomial([0.1])), ts))
    lines = trust(rest)
    assert rest.work is None and lines["energy"].startswith("changes by at most 0 J")
    assert lines["constraint violation"].startswith("at most 0 m")


def held(motion: udk.Motion, *forces: udk.ForceElement) -> udk.Mechanism:
    """A body on a pin, turned by a driver, with forces."""
    bodies = {"a": udk.Body(1.0, 0.1, angle=0.1)}
    pin = udk.Revolute(["ground", "a"], [[0.0, 0.0], [0.0, 0.0]])
    return udk.Mechanism(bodies, {"A": pin}, {"hold": udk.Driver(["ground", "a"], "angle", motion)}, list(forces))


@pytest.mark.slow
def test_efforts_are_what_inverse_dynamics_finds_by_another_way():
    mech, ts = udk.library.slider_crank(), np.linspace(0.0, 0.5, 6)
    sol, needed = udk.simulate(mech, ts, rtol=1e-11, atol=1e-11), udk.inverse_dynamics(mech, ts)
    (name,) = mech.driver_names
    wanted = np.asarray(needed.efforts[name])
    assert_allclose(udk.efforts(mech, sol)[name], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    data = sol.to_xarray(mech)
    assert_allclose(data.effort.sel(driver=name), wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    q = sol.q.at[3:].set(jnp.nan)

    def alive(q):
        found = udk.efforts(mech, eqx.tree_at(lambda s: s.q, sol, q))[name]
        return jnp.sum(found[:3]), found

    gradient, failed = jax.jit(jax.grad(alive, has_aux=True))(q)
    assert np.isnan(failed[3:]).all() and np.isfinite(failed[:3]).all() and np.isfinite(gradient).all()
