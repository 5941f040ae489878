"""Friction of slides whose normal force passes through zero, where its magnitude has a kink."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk

AXIS = 1.0  # of the slot (rad)
ALONG, ACROSS = np.array([np.cos(AXIS), np.sin(AXIS)]), np.array([-np.sin(AXIS), np.cos(AXIS)])
TURN = 3.0  # initial angular velocity (rad/s)
EARLY, END = 0.3, 0.6  # outputs before and after the normal force, and with set-valued friction the speed, change their sign (s)


def slot(law, unit=1.0, length=None):
    """Return a body that turns about a pin in a slot, or a slide with a guide, pulled to and fro by a spring; and its state.

    `unit` is the unit of length (m).
    """
    angle, arm = 2.7, np.array([-0.3, -0.2])
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ arm
    body = udk.Body(0.9 if length is None else 0.4, 0.036 * unit**2, unit * (np.array([1.0, -0.7]) - turned), angle)
    velocity = unit * (5 * ALONG - TURN * np.array([-turned[1], turned[0]]))
    friction = udk.Friction("slot", coefficient=0.08, law=law, **({"speed": 0.2 * unit} if law == "smooth" else {}))
    points, at = unit * np.array([[1.0, -0.7], arm]), ("ground", "body")
    spring = udk.Spring(
        at, unit * np.array([[-0.5, 0.5], [0.07, -0.26]]), stiffness=4.2, length=(0.16 if length is None else 1.7) * unit
    )
    if length is None:
        joint = udk.Slot(at, points, axis=AXIS)
        state = jnp.array([*velocity, TURN])
    else:
        joint = udk.Prismatic(at, points, axis=AXIS)
        friction = udk.Friction("slot", coefficient=0.08, law=law, length=length * unit, speed=0.2 * unit)
        state = jnp.array([*(unit * 5 * ALONG), 0.0])
    mech = udk.Mechanism(
        {"body": body}, {"slot": joint}, forces={"spring": spring, "rubs": friction}, gravity=(0.0, -9.81 * unit)
    )
    return mech, udk.State(mech.q0, state[None])


def end(x, law, tol, unit=1.0, length=None):
    """Return positions (units of length, rad) and velocities where x scales the stiffness of the spring."""
    mech, start = slot(law, unit, length)
    mech = mech.with_parameters({"force.spring.stiffness": 4.2 * x})
    run = udk.simulate(mech, [0.0, EARLY, END], start, rtol=tol, atol=tol)
    return jnp.stack([run.q[1:, 0], run.v[1:, 0]]) / jnp.array([unit, unit, 1.0])


@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_derivatives_follow_the_tolerance(law):
    """Forward and reverse mode agree, and their error falls with the tolerance, not with its root."""
    forward, reverse = (lambda tol, of=of: of(lambda x: end(x, law, tol))(1.0) for of in (jax.jacfwd, jax.jacrev))
    loose, tight, exact = (np.asarray(forward(tol)) for tol in (1e-8, 1e-10, 1e-12))
    size = np.max(np.abs(exact))
    np.testing.assert_allclose(loose, exact, rtol=0, atol=1e-6 * size)
    np.testing.assert_allclose(tight, exact, rtol=0, atol=1e-8 * size)
    np.testing.assert_allclose(reverse(1e-10), tight, rtol=0, atol=1e-8 * size)
    h = 1e-4
    values = lambda x: end(x, law, 1e-12)  # noqa: E731
    differences = (8 * (values(1 + h) - values(1 - h)) - (values(1 + 2 * h) - values(1 - 2 * h))) / (12 * h)
    np.testing.assert_allclose(exact, differences, rtol=0, atol=1e-7 * size)


@pytest.mark.parametrize("length", [None, 0.4])
def test_second_derivatives_pass_zeros_of_loads(length):
    """They agree with differences of first derivatives, in any unit of length, for slots and for both edges of a guide."""
    units, h = jnp.array([1.0, 1e-6, 1e3]), 1e-4
    first = jax.jit(jax.vmap(lambda x: jax.jacfwd(lambda x: end(x, "smooth", 1e-10, length=length))(x)))
    before, after = np.asarray(first(jnp.array([1 - h, 1 + h])))
    twice = jax.jacfwd(jax.jacfwd(end))
    second = np.asarray(jax.jit(jax.vmap(lambda unit: twice(1.0, "smooth", 1e-10, unit, length)))(units))
    differences = (after - before) / (2 * h)
    np.testing.assert_allclose(
        second, np.broadcast_to(differences, second.shape), rtol=0, atol=1e-4 * np.max(np.abs(differences))
    )


class Swing(udk.ForceElement):
    """A force that depends on time."""

    size: jax.Array

    def loads(self, t, body):
        return [(self.size * jnp.sin(3 * t), 0.0, 0.0)]


def test_second_derivatives_end_at_zeros_of_loads_that_depend_on_time():
    """Their jump is that of a surface in the space of states, which does not move."""

    def moved(x):
        mech, start = slot("smooth")
        swing = {"swing": Swing(("body",), 0.5 * x)}
        mech = udk.Mechanism(mech.bodies, mech.joints, forces={**mech.forces, **swing}, gravity=mech.gravity)
        return udk.simulate(mech, [0.0, EARLY, END], start, rtol=1e-8, atol=1e-8).q[1:, 0, 0]

    early, late = jax.jit(jax.jacfwd(jax.jacfwd(moved)))(1.0)
    assert np.isfinite(early) and np.isnan(late)


@pytest.mark.parametrize("law", ["smooth", "set-valued"])
def test_a_slide_without_load_takes_no_more_steps(law):
    """The sign of a normal force that is zero is that of rounding errors, and no step ends where it changes."""
    steps = []
    for rubs in (True, False):
        forces: dict = {"pull": udk.Spring(("ground", "body"), [-0.6 * ALONG, (0, 0)], stiffness=20.0, length=0.5)}
        forces |= {"rubs": udk.Friction("slide", coefficient=0.1, law=law)} if rubs else {}
        body = udk.Body(1.3, 0.02, 0.4 * ALONG, 0.0, 1.1 * ALONG)
        joints = {"slide": udk.Prismatic(("ground", "body"), [(0, 0), (0, 0)], axis=AXIS)}
        mech = udk.Mechanism({"body": body}, joints, forces=forces, gravity=tuple(9.81 * ALONG))
        steps.append(int(udk.simulate(mech, [0.0, 0.5], rtol=1e-10, atol=1e-10).stats["steps"]))
    assert steps[0] <= steps[1] + 2
