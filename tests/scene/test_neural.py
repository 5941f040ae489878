"""Fields of a user-defined class that hold functions and names, and a force law that is a neural network."""

from collections.abc import Callable
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

import udkjax as udk

TS = np.linspace(0.0, 1.0, 6)
DAMPING = 0.4


class Network(udk.ForceElement):
    """A learned torque on a body, a function of its angular velocity."""

    law: eqx.nn.MLP

    def loads(self, t, *frames):
        (body,) = frames
        return [(0.0, 0.0, self.law(jnp.stack([body.omega]))[0])]


class Named(udk.Joint):
    kind: str
    shape: Callable

    def residual(self, t, *frames):
        one, two = frames
        return [self.shape({"turning": two.angle - one.angle, "sliding": two.x - one.x}[self.kind])]


def pendulum(element) -> udk.Mechanism:
    plain = udk.library.simple_pendulum()
    return udk.Mechanism(plain.bodies, plain.joints, forces={"friction": element})


@pytest.fixture(scope="module")
def network():
    (rod,) = udk.library.simple_pendulum().body_names
    return pendulum(Network([rod], eqx.nn.MLP(1, 1, 4, 1, activation=jnp.tanh, key=jax.random.key(0))))


def test_it_computes_what_the_network_says(network):
    law = network.forces["friction"].law
    a, free = (udk.accelerations(m, 0.0, network.q0, network.v0 + 1.0) for m in (network, udk.library.simple_pendulum()))
    torque = law(jnp.ones(1) + network.v0[0, 2])[0]
    body = network.bodies[network.body_names[0]]
    arm = float(jnp.linalg.norm(network.joints[network.joint_names[0]].points[1]))
    assert_allclose(a[0, 2] - free[0, 2], torque / (body.inertia + body.mass * arm**2), rtol=1e-10)


@pytest.mark.slow
def test_it_learns_a_damper(network):
    """A few steps of gradient descent on the weights of the network, towards the motion with a linear damper."""
    (rod,) = network.body_names
    damped = pendulum(udk.TorsionSpring(["ground", rod], stiffness=0.0, damping=DAMPING))
    wanted = udk.simulate(damped, TS, rtol=1e-6, atol=1e-6).q[:, 0, 2]
    analysis = udk.analyse(network)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def loss(law):
        mechanism = eqx.tree_at(lambda m: m.forces["friction"].law, network, law)
        found = udk.simulate(mechanism, TS, rtol=1e-6, atol=1e-6, analysis=analysis, throw=False).q[:, 0, 2]
        return jnp.sum((found - wanted) ** 2)

    law, optimizer, losses = network.forces["friction"].law, optax.adam(0.05), []
    state = optimizer.init(eqx.filter(law, eqx.is_array))
    for _ in range(15):
        value, slope = loss(law)
        losses.append(float(value))
        change, state = optimizer.update(slope, state)
        law = eqx.apply_updates(law, change)
    assert losses[-1] < 0.1 * losses[0]


def test_what_is_no_number_is_static_by_itself():
    bodies = {"one": udk.Body(1.0, 1.0), "two": udk.Body(1.0, 1.0, [1.0, 0.0])}
    turning = udk.Mechanism(bodies, {"same": Named(["one", "two"], "turning", jnp.sin)})
    again = udk.Mechanism(bodies, {"same": Named(["one", "two"], "turning", jnp.sin)})
    other = udk.Mechanism(bodies, {"same": Named(["one", "two"], "sliding", jnp.sin)})
    assert jax.tree.structure(turning) == jax.tree.structure(again) != jax.tree.structure(other)
    assert all(eqx.is_array(leaf) for leaf in jax.tree.leaves(turning))
    q = turning.q0.at[1].set(jnp.array([1.5, 0.0, 0.3]))
    for mechanism, expected in ((turning, np.sin(0.3)), (other, np.sin(1.5))):
        still = udk.State(q, jnp.zeros_like(q))
        at = SimpleNamespace(ts=jnp.zeros(1), q=still.q[None], v=still.v[None])
        assert_allclose(udk.violation(mechanism, at), [[expected]], rtol=1e-14)
