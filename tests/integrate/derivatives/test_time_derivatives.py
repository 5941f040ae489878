"""Derivatives with respect to times, by machine code: of outputs, the start, control intervals and assembly."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.programs.deferred import deferred

# A rod that hangs from a slider: its body's first end is on a horizontal rail. Small, as derivatives take long to compile.
ROD = {"rod": udk.Body(1.0, 0.1, [0.3, -0.4], -0.9)}
ENDS = [[0.0, 0.0], [-0.5, 0.0]]
RAIL = {"rail": udk.Slot(["ground", "rod"], ENDS, 0.0)}
MOTOR = ["ground", "rod"]
ARMS = {
    "driven": udk.Mechanism(ROD, RAIL, {"motor": udk.Driver(MOTOR, "x", udk.Sine(0.5, 3.0, 0.3), ENDS)}),
    "splined": udk.Mechanism(ROD, RAIL, {"motor": udk.Driver(MOTOR, "x", udk.Spline([0, 0.5, 1.2], [0, 0.3, -0.2]), ENDS)}),
    "held": udk.Mechanism(ROD, RAIL, forces={"motor": udk.Torque(MOTOR, udk.Held(np.array([1.0, 2.0, -3.0, 4.0]), 0.23))}),
}
X = np.array([0.1, 0.9])  # the start and the length of a run (s)


def states(mechanism, x):
    """q and v in the middle and at the end of a run whose times depend on x, assembled at its start."""
    run = udk.simulate(mechanism, x[0] + x[1] * jnp.array([0.0, 0.5, 1.0]), rtol=1e-11, atol=1e-11)
    return jnp.concatenate([run.q.ravel(), run.v.ravel()])


def differences(f, x, h=1e-4):
    return np.stack([(8 * (f(x + e) - f(x - e)) - f(x + 2 * e) + f(x - 2 * e)) / (12 * h) for e in h * np.eye(len(x))], -1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "transform"),
    [("splined", jax.jacrev), ("driven", jax.jacfwd), ("driven", jax.jacrev), ("held", jax.jacrev)],
)
def test_states_change_by_times_as_by_differences(name, transform):
    f = deferred(lambda x: states(ARMS[name], x))
    wanted = differences(f, X)
    assert_allclose(transform(f)(X), wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.slow
def test_second_derivatives_by_times_and_numbers():
    def f(x):
        found = states(ARMS["driven"].with_parameters({"body.rod.mass": x[2]}), x)
        return jnp.cos(jnp.arange(1.0, 1.0 + found.size)) @ found

    x = np.append(X, 1.3)
    slope, second = deferred(jax.grad(f)), deferred(jax.jacfwd(jax.grad(f)))
    wanted = differences(slope, x)
    assert_allclose(second(x), wanted, atol=1e-5 * np.abs(wanted).max())


@pytest.mark.slow
def test_members_share_what_is_differentiated():
    """This includes batches in which only the changes of states are batched; eagerly and compiled."""
    arm, shares = ARMS["driven"], jnp.array([0.9, 1.1])

    def f(x):
        def run(share):
            return states(arm.with_parameters({"body.rod.mass": share * x[2]}), x[:2]).sum()

        return jax.vmap(run)(shares).sum()

    x = np.append(X, 1.3)
    wanted = differences(deferred(f), x)
    for transform in (jax.grad(f), jax.jit(jax.grad(f))):
        assert_allclose(transform(x), wanted, rtol=1e-6)


def test_times_may_be_a_list_of_which_some_are_traced():
    of_list, of_array = (jax.grad(lambda t, f=f: udk.simulate(ARMS["driven"], f(t)).q.sum())(0.5) for f in TIMES)
    assert of_list == of_array != 0.0


TIMES = lambda t: [0.0, t], lambda t: jnp.stack([0.0, t])


@pytest.mark.slow
def test_control_intervals_change_by_length_and_time():
    arm = ARMS["driven"]

    def f(x):
        state = udk.step(arm, udk.assemble(arm, x[0]), None, x[1], x[0], rtol=1e-11, atol=1e-11)
        return jnp.concatenate([state.q.ravel(), state.v.ravel()])

    x = np.array([0.1, 0.05])
    wanted = differences(f, x)
    for transform in (jax.jacfwd, jax.jacrev):
        assert_allclose(transform(f)(x), wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


def test_no_integrator_in_python_is_compiled():
    arm = ARMS["driven"]
    for f in (
        lambda t: states(arm, jnp.stack([t, 0.9])).sum(),
        lambda t: states(arm, jnp.stack([0.1, t])).sum(),
        lambda t: udk.step(arm, udk.State(arm.q0, arm.v0), None, t, t).q.sum(),
        lambda t: udk.assemble(arm, t).q.sum(),
    ):
        assert "stablehlo.while" not in jax.jit(jax.grad(f)).lower(0.5).as_text()


def test_tolerances_and_first_steps_have_no_derivatives():
    def f(x):
        return udk.simulate(ARMS["driven"], [0.0, 1.0], rtol=x[0], atol=x[1], dt0=x[2]).q.sum()

    x = np.array([1e-8, 1e-8, 1e-3])
    assert not np.any(jax.grad(f)(x))
    assert "stablehlo.while" not in jax.jit(jax.grad(f)).lower(x).as_text()


class Lift(udk.Joint):
    """A user-defined joint that depends on time: the first body's point moves up."""

    def residual(self, t, *frames):
        one, two = frames
        return [two.x - one.x - 0.5 * jnp.cos(t), two.y - one.y - 0.5 * jnp.sin(t) + t**2]


@pytest.mark.slow
def test_assembly_of_joints_that_depend_on_time():
    rod = udk.Mechanism({"rod": udk.Body(1.0, 0.1, [0.5, 0.0])}, {"lift": Lift(["ground", "rod"])})

    def f(t):
        state = udk.assemble(rod, t)
        return jnp.concatenate([state.q[0], state.v[0]])

    wanted = (f(0.3 + 1e-5) - f(0.3 - 1e-5)) / 2e-5
    assert_allclose(jax.jacfwd(f)(0.3), wanted, atol=1e-8)
