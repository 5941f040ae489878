"""Rows phi(t, q, v) = 0 that depend on q strongly: an error of q is an error of v as well, which the step control must see."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from udkjax.equations.systems.general import prepare_general
from udkjax.equations.systems.traced_system import trace_system
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.integrate.native_engine import mark_rows
from udkjax.integrate.native_equations import native_equations
from udkjax.native.module.steps import NEAREST_STAGE

LAG, RATE = 1e-4, 2.0  # s, rad/s


@pytest.mark.parametrize("method", [udk.Auto(), pytest.param(udk.SVD(), marks=pytest.mark.slow)], ids=lambda x: type(x).__name__)
def test_a_fast_filter_is_right_to_the_tolerance(method):
    """A filter of first order, q' = (sin(2 t) - q) / LAG, beside a pendulum."""
    system = udk.ConstrainedSystem(
        lambda q: jnp.eye(3),
        lambda t, q, v: jnp.stack([0.0, 0.0, -9.81]),
        constraint=lambda t, q: q[1:] @ q[1:] - 1.0,
        velocity_constraint=lambda t, q, v: v[0] + (q[0] - jnp.sin(RATE * t)) / LAG,
    )
    ts, a = np.linspace(0.0, 2.0, 21), RATE * LAG
    run = udk.simulate(system, ts, udk.State([0.0, 0.6, -0.8], [0.0, 0.0, 0.0]), rtol=1e-6, atol=1e-6, method=method)
    exact = (np.sin(RATE * ts) - a * np.cos(RATE * ts) + a * np.exp(-ts / LAG)) / (1 + a**2)
    assert int(run.stats["implicit"]) > 0
    assert np.abs(run.q[:, 0] - exact).max() < 1e-5


def test_tangent_parts_near_dependent_rows():
    """The rank-revealing fallback of elimination, where a row of phi nearly depends on one of Psi."""
    system = udk.ConstrainedSystem(
        lambda q: jnp.diag(jnp.array([1.0, 2.0, 3.0])) + 0.5 * jnp.ones((3, 3)) * jnp.cos(q[1]) ** 2,
        constraint=lambda t, q: q[0] - jnp.sin(q[2]),
        velocity_constraint=lambda t, q, v: v[0] - jnp.cos(q[2]) * v[2] + 0.5 * NEAREST_STAGE * (v[1] + 3.0 * q[2] * q[1]),
    )
    t, dq, dv = jnp.array(0.0), jnp.array([0.1, 0.2, -0.3]), jnp.array([0.3, -0.1, 0.2])
    q, v = jnp.array([np.sin(0.7), 0.4, 0.7]), jnp.array([np.cos(0.7), -3.0 * 0.7 * 0.4, 1.0])
    compiled = compile_mechanism(trace_system(system, 3), None, udk.Auto(), udk.Projection(), None, udk.BDF())
    by_code = native_equations(compiled, mark_rows(compiled, t, q, v, None, 1.0)).tangent_part(t, q, v, dq, dv)
    plain = prepare_general(system, udk.SVD(1e-9), None).tangent_part(t, q, v, dq, dv)
    assert float(jnp.abs(plain.dv).max()) > 0.1
    for x, wanted in zip(by_code, plain, strict=True):
        assert_allclose(x, wanted, rtol=0, atol=1e-9)
