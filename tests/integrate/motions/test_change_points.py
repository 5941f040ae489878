"""Friction by the loads of joints where a mechanism passes a change point: a parallelogram whose links are all in line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.programs.deferred import deferred

# Length of the cranks, distance of their pivots and radius of the pin that rubs (m), speed (rad/s), end of the run (s).
SIZES = jnp.array([[0.5, 0.8, 0.01, 6.0, 0.3], [0.2, 1.0, 0.001, 9.0, 0.3], [0.005, 0.008, 1e-4, 60.0, 0.03]])
# Factors of the friction and of a mass, and their changes for differences.
ONE, STEP = jnp.ones(2), 1e-2
SHIFTS = STEP * jnp.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def parallelogram(length, spacing, radius, speed, coefficient, **forces):
    """Return a parallelogram with two cranks at 0.6 rad, which turn towards 0 at a `speed` (rad/s), and friction in a pin."""
    e, half = jnp.array([jnp.cos(0.6), jnp.sin(0.6)]), 0.5 * length
    along, across = jnp.array([1.0, 0.0]), jnp.array([-e[1], e[0]])
    bodies = {
        f"crank{i}": udk.Body(
            1.2 + 0.2 * i, 0.08 * length**2, half * e + i * spacing * along, 0.6, -half * speed * across, angular_velocity=-speed
        )
        for i in range(2)
    }
    middle = length * e + 0.5 * spacing * along
    bodies["coupler"] = udk.Body(0.7, 0.08 * spacing**2, middle, 0.0, -length * speed * across, angular_velocity=0.0)
    joints = {}
    for i in range(2):
        joints[f"A{i}"] = udk.Revolute(("ground", f"crank{i}"), [(i * spacing, 0.0), (-half, 0.0)])
        joints[f"B{i}"] = udk.Revolute(("coupler", f"crank{i}"), [((i - 0.5) * spacing, 0.0), (half, 0.0)])
    rubs = {"rubs": udk.Friction("A1", coefficient=coefficient, radius=radius, speed=0.02)}
    return udk.Mechanism(bodies, joints, forces=rubs | forces, gravity=(0.0, -9.81))


def end_angle(x, size, **forces):
    """Return the angle of a crank past the change point, where x scales the friction of the pin and the mass of the coupler."""
    length, spacing, radius, speed, end = size
    mech = parallelogram(length, spacing, radius, speed, 0.1 * x[0], **forces).with_parameters({"body.coupler.mass": 0.7 * x[1]})
    return udk.simulate(mech, jnp.array([0.0, 0.5, 1.0]) * end, rtol=1e-9, atol=1e-9, throw=False).q[-1, 0, 2]


def sticking(size):
    """Return set-valued friction in another pin, which is located by events."""
    return {"sticks": udk.Friction("B1", coefficient=0.05, radius=0.3 * size[2], law="set-valued")}


def test_no_run_goes_on_from_within_a_step_across():
    """Friction jams this parallelogram at angles of 2e-4 to 1e-3: within the step across, no state is one of its motion.

    Of 121 such runs two failed, and two ended 1e-3 and 2e-3 rad off.
    """
    masses = jnp.linspace(0.97, 1.03, 61)
    angles = jax.jit(jax.vmap(lambda x: end_angle(jnp.stack([1.0, x]), SIZES[0], **sticking(SIZES[0]))))(masses)
    assert np.abs(np.diff(angles, 2)).max() < 1e-4  # nan if one has failed


@pytest.mark.parametrize("sticks", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_derivatives_pass_a_change_point_with_friction_by_load(sticks):
    """Differences, forward and reverse mode agree for three parallelograms in lanes."""

    def angle(x, size):
        return end_angle(x, size, **(sticking(size) if sticks else {}))

    of_sizes = jax.jit(jax.vmap(lambda size: jax.vmap(lambda x: angle(x, size))(ONE + SHIFTS)))
    found = np.asarray(of_sizes(SIZES))
    assert np.all(found < 0)  # past the change point at 0
    differences = (found[:, ::2] - found[:, 1::2]) / (2 * STEP)
    forward = jax.jit(jax.vmap(jax.jacfwd(angle), (None, 0)))(ONE, SIZES)
    reverse = jax.jit(jax.vmap(jax.grad(angle), (None, 0)))(ONE, SIZES)
    # Steps across the change point leave rows out, whose motion the differences include.
    np.testing.assert_allclose(forward, differences, rtol=2e-3)
    # Both modes differ by rounding errors, multiplied beside the change point: 1e-4 with some lengths of registers.
    np.testing.assert_allclose(reverse, forward, rtol=1e-3)


def test_second_derivatives_end_where_loads_are_left_out_of_friction():
    """Past a change point, at 0.06 s, they would depend on the steps that leave the loads out; before it they are right."""

    def angles(x):
        length, spacing, radius, speed = SIZES[1, :4]
        mech = parallelogram(length, spacing, radius, speed, 0.1 * x[0]).with_parameters({"body.coupler.mass": 0.7 * x[1]})
        return udk.simulate(mech, [0.0, 0.03, 0.1], rtol=1e-9, atol=1e-9).q[1:, 0, 2]

    first = np.asarray(jax.jit(jax.vmap(jax.jacrev(angles)))(jnp.concatenate([ONE[None], ONE + SHIFTS / 10])))
    second = np.asarray(deferred(jax.jacfwd(jax.jacrev(angles)))(ONE))  # the first row uses nothing of what is lost
    assert np.all(np.isfinite(first))
    assert np.all(np.isnan(second[1]))
    differences = (first[1::2, 0] - first[2::2, 0]) / (2 * STEP / 10)
    np.testing.assert_allclose(second[0], differences, rtol=0, atol=1e-5 * np.max(np.abs(differences)))
