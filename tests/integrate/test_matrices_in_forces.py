"""Forces that solve small linear systems run as machine code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk


class SolvedSpring(udk.ForceElement):
    """A torsion spring between the ground and a body, written by way of matrices: -k angle."""

    stiffness: jax.Array

    def loads(self, t, ground, body):
        A = jnp.stack([jnp.stack([1.0 + jnp.sin(body.angle), 2.0 + body.angle**2]), jnp.array([3.0, 0.5])])
        x = jnp.stack([body.angle, jnp.ones(())])
        one = jnp.linalg.det(A) * jnp.linalg.det(jnp.linalg.inv(A))
        halved = jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, 0.5 * s[1]), (0, jnp.linalg.solve(A, A @ x)))[1]
        torque = -8.0 * self.stiffness * one * halved[0]
        return (0.0, 0.0, -torque), (0.0, 0.0, torque)


@pytest.mark.slow
def test_a_spring_by_way_of_matrices():
    """The rows of A are exchanged, as its first pivot is the smaller one."""
    rod, pin = udk.Body(1.0, 0.1, [0.5, 0.0]), udk.Revolute(["ground", "rod"], [[0.0, 0.0], [-0.5, 0.0]])
    ts, found = np.linspace(0.0, 1.0, 6), []
    for spring in (SolvedSpring(["ground", "rod"], jnp.asarray(7.0)), udk.TorsionSpring(["ground", "rod"], stiffness=7.0)):
        mechanism = udk.Mechanism({"rod": rod}, {"pin": pin}, forces={"spring": spring})
        solution = udk.simulate(mechanism, ts, engine="native", rtol=1e-11, atol=1e-11)
        angle = lambda k, m=mechanism: udk.simulate(m.with_parameters({"force.spring.stiffness": k}), ts).q[-1, 0, 2]  # noqa: E731
        found.append((solution.q, jax.grad(angle)(7.0)))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-9)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-5)
