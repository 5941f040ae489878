import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate import Result, Solution
from udkjax.study import exact_coordinates
from udkjax.study.accuracy import accuracy, largest_violation


def solution(mech, ts, q, v) -> Solution:
    tol = jnp.array(1e-8)
    return Solution(ts, q, v, jnp.array(int(Result.successful)), ts[-1], {}, tol, tol, mech.body_names, ())


def test_the_largest_violation_is_that_of_any_row():
    np.testing.assert_array_equal(largest_violation(np.array([[0.0, -3.0], [1.0, 2.0]])), [3, 2])
    np.testing.assert_array_equal(largest_violation(np.empty((2, 0))), [0, 0])


def test_what_is_put_in_is_found():
    """The exact motion, with one body moved by 1e-3 m and a fall that misses its energy; after a failure there is nothing."""
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
