"""Parts of compiled programs that NumPy evaluates if they are reached."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from tests.choices import needs_deferred
from udkjax.native.host.host_function import call_seldom


def _roots(x, scale, names):
    """Return roots by Newton's method, each in a loop of its own, and a flag."""

    def root(x):
        x = jnp.abs(x)
        more = lambda y: jnp.abs(y * y - x) > 1e-12 * x  # noqa: E731
        return jax.lax.while_loop(more, lambda y: 0.5 * (y + x / y), x)

    return {names[0]: scale["by"] * jax.vmap(root)(x), "positive": jnp.all(x > 0)}


def _reach(x):
    seldom = lambda: call_seldom(_roots, x, {"by": 2.0 * x[0]}, ("root",))  # noqa: E731
    return jax.lax.cond(x[0] > 0, seldom, lambda: {"root": jnp.zeros_like(x), "positive": jnp.asarray(False)})


@needs_deferred
def test_what_is_seldom_reached_is_right_and_not_compiled():
    x = jnp.array([[4.0, 2e6, 1e-6], [-1.0, 1.0, 1.0], [9.0, 1.0, 3.0]])
    found = jax.jit(_reach)(x[0])
    assert_allclose(found["root"], 8.0 * np.sqrt(x[0]), rtol=1e-12)
    assert found["positive"].dtype == bool and bool(found["positive"])
    many = jax.jit(jax.vmap(_reach))(x)
    assert_allclose(many["root"], [8.0 * np.sqrt(x[0]), np.zeros(3), 18.0 * np.sqrt(x[2])], rtol=1e-12)
    assert many["positive"].tolist() == [True, False, True]
    assert "while" not in jax.jit(_reach).lower(x[0]).as_text()
    assert_allclose(jax.grad(lambda x: jnp.sum(x * _reach(jax.lax.stop_gradient(x))["root"]))(x[0]), found["root"])
    assert "erf_inv" in jax.jit(lambda x: call_seldom(jax.scipy.special.erfinv, x)).lower(x).as_text()  # NumPy does not know it


def test_what_is_not_finite_is_so_by_numpy_too():
    """A running program does not call JAX, not even for a matrix that NumPy refuses to decompose."""
    x = jnp.stack([jnp.eye(2), jnp.full((2, 2), jnp.nan)])
    s = jax.jit(lambda x: call_seldom(_singular_values, x))(x)
    assert_allclose(s, [[1.0, 1.0], [np.nan, np.nan]])


def _singular_values(x):
    return jnp.linalg.svd(x, full_matrices=False)[1]
