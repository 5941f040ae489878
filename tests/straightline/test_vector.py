"""Scalars as one vector."""

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.straightline.vector import vector

X = jnp.array([0.3, -0.7, 1.1])


def test_numbers_side_by_side():
    of = lambda x, y: vector([x * y, y, 2, jnp.sin(x)])  # noqa: E731
    np.testing.assert_allclose(of(0.3, 0.5), [0.15, 0.5, 2.0, np.sin(0.3)])
    np.testing.assert_allclose(jax.jit(jax.vmap(of, (None, 0)))(0.3, X)[1], of(0.3, X[1]), rtol=1e-15)
    np.testing.assert_allclose(vector([X, 2.0 * X]), [X, 2.0 * X])


def test_nothing_is_an_empty_vector():
    assert vector([]).shape == (0,) and vector([]).dtype == float
