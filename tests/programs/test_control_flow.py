"""Branches of programs that may be batched."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from udkjax.programs.control_flow import cond_of_batch

XS = jnp.array([0.5, 1.0, 2.0])


def growing(x):
    """Grow to 3 x in at most twenty steps."""

    def step(y, _):
        return cond_of_batch(y < 3 * x, lambda: 1.5 * y + 0.1 * x * jnp.sin(y), lambda: y), None

    return jax.lax.scan(step, jnp.ones(()), None, length=20)[0]


@pytest.mark.parametrize("transform", [lambda f: f, jax.grad, jax.hessian, jax.jacfwd])
def test_a_batch_of_branches_is_its_members(transform):
    function = transform(growing)
    np.testing.assert_allclose(jax.vmap(function)(XS), [function(x) for x in XS], rtol=1e-13)
    np.testing.assert_allclose(
        jax.vmap(jax.vmap(function))(XS[:, None] * XS), [[function(x * y) for y in XS] for x in XS], rtol=1e-13
    )


def test_a_batch_computes_what_a_member_needs():
    calls = []

    def counted(x):
        def function():
            jax.debug.callback(lambda _: calls.append(0), x)
            return 2 * x

        return cond_of_batch(x > 1.0, function, lambda: x)

    np.testing.assert_array_equal(jax.jit(jax.vmap(counted))(XS), [0.5, 1.0, 4.0])
    jax.effects_barrier()
    assert calls
    calls.clear()
    np.testing.assert_array_equal(jax.jit(jax.vmap(counted))(XS / 2), XS / 2)
    jax.effects_barrier()
    assert not calls
