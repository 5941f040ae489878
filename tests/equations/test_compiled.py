"""The public functions of a state: each is one program, with the values and derivatives of the uncompiled function."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.quantities import QUANTITIES, arguments
from udkjax.equations import constraints, determinacy

PLAIN = {name: sys.modules[function.__module__].__dict__[name] for name, function in QUANTITIES.items()}
PLAIN |= {name: getattr(determinacy, name) for name in ("singular_values", "uniqueness")}
MECH = udk.library.slider_crank(0.3, 4.0)
Q, V = np.asarray(MECH.q0), np.asarray(MECH.v0)


@pytest.mark.parametrize("name", PLAIN)
def test_it_is_one_program(name, compilations):
    function = getattr(udk.equations, name)
    udk.analyse(MECH)
    other = MECH.with_parameters({"body.rod.mass": 3.0})
    udk.analyse(other)
    given = [jnp.asarray(x, float) for x in arguments(PLAIN[name], 0.1, Q, V)]  # JAX compiles this conversion
    assert len(compilations(lambda: function(MECH, *given))) <= 1  # none where another test has called it
    assert not compilations(lambda: function(other, *arguments(PLAIN[name], 0.2, Q, V)))  # numbers are not part of it
    plain = jax.jit(lambda *state: PLAIN[name](MECH, *state))(*given)
    jax.tree.map(lambda x, y: assert_allclose(x, y, rtol=1e-12, atol=1e-12), function(MECH, *given), plain)


@pytest.mark.slow
def test_it_is_transformed_as_the_plain_one_is():
    """Differentiated with respect to time, positions and numbers of the scene; mapped over positions given as lists."""

    def values(psi, gamma, singular_values):
        mech = lambda length: MECH.with_parameters({"joint.B.points": jnp.stack([jnp.stack([length, 0.0]), jnp.zeros(2)])})  # noqa: E731
        return (
            jax.jacfwd(lambda t: psi(MECH, t, Q))(0.2),
            jax.grad(lambda q: psi(MECH, 0.2, q) @ psi(MECH, 0.2, q))(jnp.asarray(Q)),
            jax.jacfwd(lambda x: gamma(mech(x), 0.2, Q, V))(0.75),
            jax.vmap(lambda q: gamma(MECH, 0.2, q, V))(jnp.stack([Q, Q + 0.1])),
            jax.jit(lambda q: singular_values(MECH, 0.2, q))(Q),
            psi(MECH, 0.2, Q.tolist()),
        )

    plain = constraints.psi, constraints.gamma, determinacy.singular_values
    public = udk.equations.psi, udk.equations.gamma, udk.equations.singular_values
    for found, expected in zip(values(*public), values(*plain)):
        assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
